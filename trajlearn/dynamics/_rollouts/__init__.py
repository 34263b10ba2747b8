"""One-step models applied to their own output: states, past states, actions of a policy."""
