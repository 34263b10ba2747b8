"""Forecast cells (forecast, horizon, state) beside what was logged, in training ranges."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics import Forecast
from trajlearn.dynamics.forecast import shared_states
from trajlearn.evaluation._distributions import (
    gaussian_crps,
    gaussian_nll,
    gaussian_pit,
    sample_crps,
    sample_energy,
    sample_level,
    sample_nll,
    sample_pit,
    sample_std,
    sample_width,
)
from trajlearn.evaluation._matching import check_same_times, with_states_of

__all__ = ["Cells", "checked_levels", "matched"]

Floats = NDArray[np.float64]

# numbers of samples that are sorted at once
_CHUNK = 4_000_000


@dataclass(frozen=True)
class Cells:
    """Cells (n, H, k) of the k states that both the forecast and the log have."""

    forecast: Forecast
    names: tuple[str, ...]
    columns: NDArray[np.intp]
    scale: Floats
    errors: Floats  # logged minus mean, in ranges: NaN is absent, inf diverged

    @property
    def present(self) -> NDArray[np.bool_]:
        """Cells with a forecast and a logged state."""
        return ~np.isnan(self.errors)

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Cells from the divergence of their forecast on."""
        return np.isinf(self.errors)

    @property
    def calibrated(self) -> bool:
        """Whether the intervals of the forecast are conformal bands."""
        return self.forecast.bands is not None

    @property
    def by_samples(self) -> bool:
        """Whether they are quantiles of its samples."""
        return self.forecast.samples is not None and not self.calibrated

    @property
    def has_samples(self) -> bool:
        """Whether there are enough samples for a score."""
        return self._n_samples > 1

    def chosen(self, distribution: str) -> str:
        """Which distribution to score: "gaussian" or "samples".

        Raises
        ------
        ValueError
            If the forecast has no such distribution.
        """
        has = {"gaussian": self.forecast.std is not None, "samples": self._n_samples > 1}
        if distribution == "auto":
            distribution = next((name for name, there in has.items() if there), "none")
        elif distribution not in has:
            raise ValueError(
                f'distribution = {distribution!r}; choose "auto", "gaussian" or "samples".'
            )
        if distribution == "none":
            raise ValueError(
                "the forecast has no uncertainty: ask for return_std=True, or n_samples= at least "
                "2, when predicting."
            )
        if not has[distribution]:
            remedy = "return_std=True" if distribution == "gaussian" else "n_samples= at least 2"
            raise ValueError(
                f"distribution = {distribution!r} needs {remedy} when predicting; this is "
                f"{self.forecast!r}."
            )
        return distribution

    @property
    def _n_samples(self) -> int:
        return 0 if self.forecast.samples is None else len(self.forecast.samples)

    def slot(self, distribution: str) -> float:
        """Probability between two neighbouring samples; 0 for a Gaussian."""
        return 1 / (self._n_samples + 1) if self.chosen(distribution) == "samples" else 0.0

    # -- scores (n, H, k) -------------------------------------------------------------------

    def pit(self, distribution: str) -> Floats:
        """Probability below what was logged; NaN where diverged."""
        return self._score(distribution, gaussian_pit, sample_pit, np.nan)

    def crps(self, distribution: str) -> Floats:
        """Continuous ranked probability score, in ranges."""
        return self._score(distribution, gaussian_crps, sample_crps, np.inf)

    def nll(self, distribution: str) -> Floats:
        """Negative logarithm of the density of the scaled state."""
        return self._score(distribution, gaussian_nll, sample_nll, np.inf)

    def spread(self, distribution: str) -> Floats:
        """Standard deviation, in ranges; NaN where diverged."""
        return self._score(distribution, lambda y, std: std, sample_std, np.nan)

    def energy(self) -> Floats:
        """Energy score of the joint state (n, H)."""
        self.chosen("samples")
        (scores,) = self._over_samples([sample_energy], ordered=False)
        return self._filled(scores, np.inf)

    def hits(self, levels: Sequence[float]) -> Iterator[Floats]:
        """1 where what was logged is inside the interval of a level, else 0."""
        if self.by_samples:
            for level in levels:
                yield self._filled((self._needed_level <= level).astype(np.float64), 0.0)
        else:
            for level in levels:
                lower, upper = self._interval(level)
                inside = (lower <= self.errors) & (self.errors <= upper)
                yield self._filled(inside.astype(np.float64), 0.0)

    def widths(self, levels: Sequence[float]) -> Iterator[Floats]:
        """Width of the interval of each level, in ranges."""
        if self.by_samples:
            widths = [partial(sample_width, level=level) for level in levels]
            for width in self._over_samples(widths):
                yield self._filled(width, np.inf)
        else:
            for level in levels:
                lower, upper = self._interval(level)
                yield self._filled(upper - lower, np.inf)

    @cached_property
    def _needed_level(self) -> Floats:
        """Least level of an interval of samples that has what was logged inside."""
        return self._over_samples([sample_level])[0]

    def _interval(self, level: float) -> tuple[Floats, Floats]:
        """Bounds about the mean, in ranges."""
        with np.errstate(invalid="ignore"):
            lower, upper = (
                (bound - self.forecast.mean)[..., self.columns] / self.scale
                for bound in self.forecast.interval(level)
            )
        # an infinite multiple of a std of 0 is no bound
        return np.where(np.isnan(lower), -np.inf, lower), np.where(np.isnan(upper), np.inf, upper)

    def _score(
        self,
        distribution: str,
        gaussian: Callable[[Floats, Floats], Floats],
        sample: Callable[[Floats, Floats], Floats],
        diverged: float,
    ) -> Floats:
        if self.chosen(distribution) == "samples":
            (values,) = self._over_samples([sample])
            return self._filled(values, diverged)
        assert self.forecast.std is not None  # chosen() has checked
        with np.errstate(all="ignore"):
            std = self.forecast.std[..., self.columns] / self.scale
            return self._filled(gaussian(self.errors, std), diverged)

    def _over_samples(
        self, functions: Sequence[Callable[..., Any]], *, ordered: bool = True
    ) -> list[Floats]:
        """Value of each function of (samples, errors), some forecasts at a time."""
        samples, mean = self.forecast.samples, self.forecast.mean
        assert samples is not None  # chosen() or by_samples has checked
        n_chunks = max(min(len(self.forecast), -(-samples.size // _CHUNK)), 1)
        parts: list[list[Floats]] = [[] for _ in functions]
        with np.errstate(all="ignore"):
            for rows in np.array_split(np.arange(len(self.forecast)), n_chunks):
                x = (samples[:, rows] - mean[rows])[..., self.columns] / self.scale
                if ordered:
                    x.sort(axis=0)
                for function, part in zip(functions, parts):
                    part.append(function(x, self.errors[rows]))
        return [np.concatenate(part) for part in parts]

    def _filled(self, values: Floats, diverged: float) -> Floats:
        """`values` with those of diverged cells, and NaN where absent."""
        errors = self.errors if values.ndim == 3 else self.errors[..., 0]
        return np.where(np.isnan(errors), np.nan, np.where(np.isinf(errors), diverged, values))


def checked_levels(levels: ArrayLike) -> list[float]:
    """`levels` as floats.

    Raises
    ------
    ValueError
        If there is none, or one is not between 0 and 1.
    """
    values = [float(level) for level in np.atleast_1d(np.asarray(levels, dtype=np.float64))]
    if not values or not all(0 < level < 1 for level in values):
        raise ValueError(f"levels = {levels!r}: each must lie between 0 and 1.")
    return values


def matched(forecast: Forecast, truth: Any) -> Cells:
    """Cells of a forecast beside the logged states.

    Raises
    ------
    ValueError
        If the episodes are not those that were forecast, or the forecast is over times.
    """
    ds = with_states_of(forecast, truth)
    residuals = forecast.residuals(ds)
    check_same_times(forecast, ds)
    columns, names, _ = shared_states(forecast.state_names, ds)
    low, high = forecast.state_range[:, columns]
    scale = np.where(high > low, high - low, 1.0)
    return Cells(forecast, names, columns, scale, residuals / scale)
