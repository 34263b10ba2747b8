"""What the checks work on: an estimator, data, fitted copies, and how exactly to compare."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from trajlearn.exceptions import MixedSamplingError
from trajlearn.testing._system import oscillators

Floats = NDArray[np.float64]


class NotApplicable(Exception):
    """A promise that says nothing about the estimator at hand."""


def require(condition: Any, found: str) -> None:
    """Fail with what was found unless the condition holds."""
    if not condition:
        raise AssertionError(found)


def refused(what: str, call: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
    """Fail unless the call raises a ValueError, TypeError or IndexError that explains itself."""
    try:
        call(*args, **kwargs)
    except (ValueError, TypeError, IndexError) as error:
        explained(what, error)
    except Exception as error:
        raise AssertionError(
            f"{what}: {type(error).__name__} ({error}) instead of a ValueError or TypeError."
        ) from error
    else:
        raise AssertionError(f"{what}: no error.")


def explained(what: str, error: Exception) -> None:
    """Fail if the message is too short to say what to do."""
    require(len(str(error).split()) >= 4, f"{what}: the message is only {str(error)!r}.")


@dataclass
class Case:
    """An estimator under test."""

    estimator: Any
    policy: Any
    same_bits: bool

    @cached_property
    def forecasts(self) -> bool:
        """Whether it predicts states rather than one number an episode."""
        return hasattr(self.fitted.predict(self.test), "horizons")

    @cached_property
    def equal_lengths(self) -> bool:
        """Whether it needs episodes of equal length, as a mean reward does."""
        try:
            clone(self.estimator).fit(oscillators(24, seed=0))
        except ValueError:
            return True
        return False

    # Any: these episodes have every optional field, which the type of a dataset cannot say
    @cached_property
    def train(self) -> Any:
        """Training episodes: ragged, unless the estimator needs equal lengths."""
        return oscillators(24, seed=0, equal=self.equal_lengths)

    @cached_property
    def test(self) -> Any:
        """Episodes of other seeds, none longer than in training."""
        return oscillators(7, seed=1, equal=self.equal_lengths)

    @cached_property
    def fitted(self) -> Any:
        """The estimator fitted with a seed."""
        return self.new(0).fit(self.train)

    @cached_property
    def sources(self) -> list[dict[str, Any]]:
        """Ways to say where the actions of a forecast come from."""
        if self.policy is None or not self.forecasts:
            return [{}]
        return [{}, {"actions": "policy", "policy": self.policy}]

    @cached_property
    def trained(self) -> list[tuple[Any, Any]]:
        """Fitted estimators and test episodes: at regular times, and irregular ones if taken."""
        pairs = [(self.fitted, self.test)]
        train, test = (
            oscillators(n, seed=seed, irregular=True, equal=self.equal_lengths)
            for n, seed in ((24, 2), (7, 3))
        )
        try:
            return [*pairs, (self.new(0).fit(train), test)]
        except MixedSamplingError:
            return pairs

    def new(self, seed: Any) -> Any:
        """An unfitted copy with a seed, if it takes one."""
        copy = clone(self.estimator)
        names = [name for name in copy.get_params() if name.endswith("random_state")]
        if names:
            # the outermost: those inside are seeded from it
            copy.set_params(**{min(names, key=lambda name: name.count("__")): seed})
        return copy

    def require_same(self, found: Any, expected: Any, what: str, *, exact: bool = True) -> None:
        """Fail unless two predictions have the same bits, or agree to 1e-9 of the range."""
        found, expected = np.asarray(found), np.asarray(expected)
        require(found.shape == expected.shape, f"{what}: shape {found.shape}, {expected.shape}.")
        if exact or self.same_bits:
            same = np.array_equal(found, expected, equal_nan=True)
        else:
            same = bool((np.isnan(found) == np.isnan(expected)).all())
            same &= bool(np.nanmax(np.abs(found - expected), initial=0.0) <= 1e-9 * self.range)
        if not same:
            with np.errstate(invalid="ignore"):
                gap = np.nanmax(np.abs(found - expected), initial=0.0)
            raise AssertionError(f"{what}: they differ by up to {gap:g}.")

    @cached_property
    def range(self) -> float:
        """Largest range of a training state."""
        return float(np.ptp(self.train.states, axis=0).max())
