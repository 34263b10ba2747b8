"""Promises about the uncertainty of a forecast."""

from typing import Any

import numpy as np

from trajlearn.testing._case import Case, NotApplicable, explained, require


def _uncertain(case: Case, **settings: Any) -> Any:
    """A forecast with std and samples, where the estimator has them."""
    asked = {"return_std": True, "n_samples": 4, **settings}
    try:
        return case.fitted.predict(case.test, **asked)
    except ValueError as error:
        explained("return_std=True", error)
        raise NotApplicable from error


def check_uncertainty_has_the_shapes_of_the_mean(case: Case) -> None:
    """`std` and `samples` have the shape and padding of the mean, and intervals are ordered."""
    for settings in case.sources:
        forecast = _uncertain(case, random_state=0, **settings)
        mean, std, samples = forecast.mean, forecast.std, forecast.samples
        require(std.shape == mean.shape, f"std is {std.shape}, mean {mean.shape}.")
        require(samples.shape == (4, *mean.shape), f"samples are {samples.shape}.")
        padding = np.isnan(mean)
        require(np.array_equal(np.isnan(std), padding), "the padding of std is another.")
        require((np.isnan(samples) == padding).all(), "the padding of samples is another.")
        require((std[~padding] >= 0).all(), "std is negative.")
        lower, upper = forecast.interval(0.8)
        require((lower[~padding] <= upper[~padding]).all(), "an interval is empty.")


def check_seeds_decide_the_samples(case: Case) -> None:
    """Samples have the same bits with the same seed, and others with another."""
    first, again, other = (_uncertain(case, random_state=seed) for seed in (3, 3, 4))
    case.require_same(again.samples, first.samples, "samples, the same seed")
    case.require_same(again.std, first.std, "std, the same seed")
    spread = float(np.nanmax(first.std, initial=0.0))
    differ = not np.array_equal(other.samples, first.samples, equal_nan=True)
    require(differ or spread == 0, "samples do not depend on the seed.")
