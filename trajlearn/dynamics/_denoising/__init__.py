"""Errors in variables: a model of a step smooths the noisy states that it is learned from."""
