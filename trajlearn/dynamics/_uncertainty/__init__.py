"""Residuals of held-out episodes, and what they say of the errors to come."""
