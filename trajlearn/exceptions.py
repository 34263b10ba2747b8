"""Errors and warnings of the package.

Errors are small subclasses of `ValueError`, so that ``except ValueError`` keeps working.
"""

__all__ = [
    "CalibrationWarning",
    "DivergenceWarning",
    "HorizonWarning",
    "InvalidEpisodeError",
    "MissingFieldError",
    "MixedSamplingError",
    "NoUncertaintyError",
    "SmoothingWarning",
    "UnknownFileError",
    "UnsafeProposalError",
]


class InvalidEpisodeError(ValueError):
    """An episode has wrong shapes, non-finite values, unsorted times or no step at all."""


class MissingFieldError(ValueError):
    """A model needs a field (actions, params, references, ...) that the episodes lack."""


class MixedSamplingError(ValueError):
    """A one-step model without the time step as an input met episodes of unequal sampling."""


class UnknownFileError(ValueError):
    """A file is not one of this package's, was truncated or was changed by hand."""


class NoUncertaintyError(ValueError):
    """An estimator was asked for a standard deviation or samples that it cannot give."""


class UnsafeProposalError(ValueError):
    """A policy search found no parameters that are likely enough to keep the constraint."""


class CalibrationWarning(UserWarning):
    """An interval or a standard deviation goes beyond what the calibration episodes say."""


class DivergenceWarning(UserWarning):
    """A forecast left every plausible range or became non-finite."""


class HorizonWarning(UserWarning):
    """A forecast reaches beyond the longest horizon of training, or its std of calibration."""


class SmoothingWarning(UserWarning):
    """A Kalman smoother met states that it cannot improve, or a forecast smoothed ones."""
