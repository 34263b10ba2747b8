"""One forecast of several: a mixture whose weights depend on the horizon."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._selection.held_out_noise import HeldOutNoise
from trajlearn.dynamics.forecast import Forecast
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["Part", "cut_after", "mixed", "shortened"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Part:
    """A forecast in a mixture.

    Attributes
    ----------
    forecast : Forecast
        Of the first steps of the mixture, as far as its weight goes.
    weight : ndarray of shape (H,)
        At each step of the mixture.
    noise : HeldOutNoise or None
        Uncertainty of a forecast that brings none.
    steps : ndarray of shape (H,)
        Steps of the mixture, from 0.
    """

    forecast: Forecast
    weight: Floats
    noise: HeldOutNoise | None
    steps: Ints

    @property
    def used(self) -> Ints:
        """Where it has weight, as far as it goes."""
        return np.flatnonzero(self.weight[: self.forecast.mean.shape[1]] > 0)

    @property
    def mean(self) -> Floats:
        """Mean at the used steps (n, used, d_s)."""
        return self.forecast.mean[:, self.used]

    @property
    def std(self) -> Floats:
        """Standard deviation at the used steps (n, used, d_s)."""
        if self.noise is not None:
            return self.noise.std(self.mean, self.steps[self.used])
        assert self.forecast.std is not None  # asked for
        return self.forecast.std[:, self.used]

    def samples(self, n_samples: int, rng: np.random.Generator) -> Floats:
        """Trajectories at the used steps (n_samples, n, used, d_s)."""
        if self.noise is not None:
            return self.noise.draw(self.mean, self.steps[self.used], n_samples, rng)
        assert self.forecast.samples is not None  # asked for
        return self.forecast.samples[:, :, self.used]


def mixed(
    parts: Sequence[Part], *, return_std: bool, n_samples: int | None, rng: np.random.Generator
) -> Forecast:
    """The mixture of forecasts of the same episodes.

    Its mean is the weighted one. Its std is that of the mixture: within the parts and between
    their means. Each of its samples is, at each step, a sample of one part: that in whose share of
    the weights a number falls that is drawn once a sample, so that a sample changes over from one
    part to another only where the weights do.
    """
    whole = max((part.forecast for part in parts), key=lambda forecast: forecast.mean.shape[1])
    shape = whole.mean.shape
    with np.errstate(invalid="ignore"):
        mean = np.zeros(shape)
        for part in parts:
            at = part.used
            mean[:, at] += part.weight[at, None] * part.mean
    lengths = _lengths(parts, whole)
    known = np.arange(shape[1]) < lengths[:, None]
    gone = np.logical_or.accumulate(~np.isfinite(mean).all(axis=2) & known, axis=1)
    std = _std(parts, mean) if return_std else None
    samples = _samples(parts, shape, n_samples, rng) if n_samples else None
    for values in (mean, std, samples):
        if values is not None:
            values[..., gone, :] = np.inf
            values[..., ~known, :] = np.nan
    return whole._replace(
        mean=mean,
        std=std,
        samples=samples,
        times=np.where(known, whole.times, np.nan),
        lengths=lengths,
        diverged_at=np.where(gone.any(axis=1), gone.argmax(axis=1) + 1, 0),
    )


def _lengths(parts: Sequence[Part], whole: Forecast) -> Ints:
    """Steps to which all parts that have weight there go."""
    steps = np.arange(whole.mean.shape[1])
    lacking = np.zeros((len(whole), len(steps)), dtype=bool)
    for part in parts:
        lacking |= (part.weight[: len(steps)] > 0) & (steps >= part.forecast.lengths[:, None])
    reached = np.where(lacking.any(axis=1), lacking.argmax(axis=1), len(steps))
    return np.minimum(reached, whole.lengths)


def _std(parts: Sequence[Part], mean: Floats) -> Floats:
    variance = np.zeros(mean.shape)
    with np.errstate(invalid="ignore", over="ignore"):
        for part in parts:
            at = part.used
            apart = part.mean - mean[:, at]
            variance[:, at] += part.weight[at, None] * (part.std**2 + apart**2)
        return np.sqrt(variance)


def _samples(
    parts: Sequence[Part], shape: tuple[int, ...], n_samples: int, rng: np.random.Generator
) -> Floats:
    n, n_steps, _ = shape
    found = np.zeros((n_samples, *shape))
    share = rng.random((n_samples, n, 1))
    low = np.zeros(n_steps)
    for part in parts:
        high = low + part.weight[:n_steps]
        # the weights sum to 1 but for round-off
        inside = (share >= low) & (share < np.where(high > 1 - 1e-9, np.inf, high))
        at = part.used
        drawn = part.samples(n_samples, rng)
        found[:, :, at] = np.where(inside[:, :, at, None], drawn, found[:, :, at])
        low = high
    return found


def cut_after(ds: TrajectoryDataset, start: Any, reach: int) -> TrajectoryDataset:
    """The episodes without what follows `reach` steps after the last start."""
    try:
        starts = [np.ravel(s) for s in start] if np.iterable(start) else [np.ravel(start)]
        last = int(np.concatenate(starts).max())
    except (TypeError, ValueError):
        # none at all; members say what is wrong
        return ds
    return ds.truncate(max(last, 0) + reach)


def shortened(found: Forecast, most: Ints) -> Forecast:
    """A forecast of at most so many steps (n,) of each episode."""
    if (found.lengths <= most).all():
        return found
    lengths = np.minimum(found.lengths, most)
    return found.at(np.arange(1, lengths.max() + 1))._replace(lengths=lengths)
