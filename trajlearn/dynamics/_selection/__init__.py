"""Which of several forecasters to trust at which horizon: folds, losses, choice, report."""
