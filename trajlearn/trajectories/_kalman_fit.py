"""Noise of a filter by maximum likelihood, where episodes begin, and whether the model fits."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from trajlearn.trajectories._kalman_models import Motion
from trajlearn.trajectories._state_space import (
    Bank,
    Grid,
    combine,
    innovations,
    smoothed,
    standardised,
)

__all__ = ["Noise", "Signals", "Start", "correlations", "fit_noise", "fit_start"]

Floats = NDArray[np.float64]

# Variance of a first hidden state of which nothing is known, in natural units.
_VAGUE = 1e8
# What is tried for (process / measurement noise) in natural units, from a model that never
# drifts to measurements without error.
_RATIOS = 10.0 ** np.arange(-20.0, 8.5, 1.0)
# The best of these is looked for on so many stretches.
_N_TRIED = 16
# Standard deviation of the measurement noise below which data count as exact, in changes.
_EXACT = 1e-9
# Order of the differences that tell noise from motion. Those beyond two standard deviations are
# motion; the others have 0.7737 of the variance if they are normal.
_ORDER, _CLIP, _INSIDE = 4, 2.0, 0.7737
# Standard deviation that the likelihood may choose, in what they show: that is an estimate, too.
_SLACK = 1.05
# Innovations beyond so many standard deviations count as such.
_CLIP_WHITE = 3.0


@dataclass(frozen=True, eq=False)
class Noise:
    """Measurement variances (d,), process noise, and -2 log likelihood a measured number."""

    variance: Floats
    intensity: float
    deviance: float = np.nan


@dataclass(frozen=True, eq=False)
class Start:
    """First hidden state: ``gain @ y + mean``, where y (d,) are its measured numbers."""

    gain: Floats
    mean: Floats
    covariance: Floats
    told: bool = True
    """Whether that takes account of y; else a filter has yet to."""


class Signals:
    """Measured numbers of many stretches of time, and a model of their motion.

    Parameters
    ----------
    values : ndarray of shape (rows, d)
    grid : Grid
    motion : Motion
    """

    def __init__(self, values: Floats, grid: Grid, motion: Motion) -> None:
        self.grid, self.motion = grid, motion
        self.measured = values[grid.rows][:, None]
        steps = np.diff(values[grid.rows], axis=0)[grid.known[1:]]
        self.change: Floats = np.sqrt(np.mean(steps**2, axis=0))
        self.dt = float(np.median(grid.dt[grid.known[1:]]))
        size = np.abs(self.measured).max(axis=(0, 1, 2))
        # positive also for constant signals
        scale = np.maximum(self.change, 1e-12 * size + 1e-150)
        self.unit, self.drift, self.hidden = motion.natural(scale, self.dt)
        self.transition, self.process = motion.matrices(grid.dt)

    def few(self, values: Floats, n: int) -> "Signals":
        """At most `n` of the stretches."""
        chosen = np.linspace(0, self.grid.rows.shape[1] - 1, n).astype(np.intp)
        grid = self.grid
        if n >= grid.rows.shape[1]:
            return self
        part = Grid(grid.rows[:, chosen], grid.known[:, chosen], grid.dt[:, chosen])
        return Signals(values, part, self.motion)

    def bank(self, variance: Floats, intensity: Floats) -> Bank:
        """B filters that know nothing of the first hidden state."""
        h = self.motion.measurement
        size = (variance / self.unit).max(axis=1) + intensity / self.drift
        first = self.measured[0, 0] @ np.linalg.pinv(h).T
        mean = np.broadcast_to(first, (len(intensity), *first.shape))
        vague = _VAGUE * size[:, None, None] * np.diag(self.hidden)
        return Bank(self.transition, self.process, h, intensity, variance, mean, vague)

    def roughness(self) -> Floats:
        """Variance of the measurement noise (d,) that neighbouring samples show, at most.

        A difference of order 4 (over uneven steps: a divided one) leaves of the motion only what
        no cubic follows; large ones are left out until the others look normal. NaN: too few
        samples.
        """
        t = np.cumsum(np.concatenate([np.zeros((1, self.grid.dt.shape[1])), self.grid.dt]), axis=0)
        n_rows = len(t) - _ORDER
        if n_rows < 1:
            return np.full(self.measured.shape[-1], np.nan)
        near = np.stack([t[i : i + n_rows] for i in range(_ORDER + 1)])
        gaps = near[:, None] - near[None]
        gaps[np.arange(_ORDER + 1), np.arange(_ORDER + 1)] = 1.0
        weights = 1 / (gaps / self.dt).prod(axis=1)
        weights /= np.sqrt((weights**2).sum(axis=0))
        values = [self.measured[i : i + n_rows, 0] for i in range(_ORDER + 1)]
        rough = sum(w[..., None] * v for w, v in zip(weights, values, strict=True))
        rough = np.abs(rough)[self.grid.known[_ORDER:]]
        return np.array([_core_variance(column) for column in rough.T])


def _core_variance(sizes: Floats) -> float:
    """Variance of a normal distribution about zero with outliers, from absolute values."""
    # an exact zero is a sensor's resolution, not its noise
    shown = sizes[sizes > 0]
    if not len(shown):
        return float("nan")
    variance = float(np.median(shown) / 0.6745) ** 2
    for _ in range(50):
        inside = shown[shown <= _CLIP * np.sqrt(variance)]
        if not len(inside):
            break
        before, variance = variance, float(np.mean(inside**2)) / _INSIDE
        if abs(variance - before) <= 1e-3 * before:
            break
    return variance


def fit_noise(
    values: Floats,
    grid: Grid,
    motion: Motion,
    variance: Floats,
    intensity: float,
    *,
    skip: int | None = None,
) -> Noise:
    """Maximise the exact likelihood of the innovations over what is NaN.

    The likelihood is a normal one: a few violent moments outweigh all the quiet ones, and would
    be explained by measurement noise. No noise may therefore exceed what the differences of
    neighbouring samples show.

    Parameters
    ----------
    values : ndarray of shape (rows, d)
        Measured numbers.
    grid : Grid
        Stretches of rows to sum the likelihood over.
    motion : Motion
    variance : ndarray of shape (d,)
        Of the measurement errors; NaN: to be estimated.
    intensity : float
        Of the process noise; likewise.
    skip : int, optional
        First states of each stretch that only tell the hidden state where it begins; default:
        as many as that takes.

    Returns
    -------
    Noise

    Raises
    ------
    ValueError
        If no stretch has a state beyond those.
    """
    signals = Signals(values, grid, motion)
    given = np.append(variance / signals.unit, intensity / signals.drift)
    free = np.flatnonzero(np.isnan(given))
    d, m = motion.measurement.shape
    skip = -(-m // d) if skip is None else skip
    if len(free) and not grid.known[skip:].any():
        raise ValueError(
            "the episodes are too short to estimate noise from: give measurement_noise and "
            "process_noise, or longer episodes."
        )

    def deviance(of: Signals, logs: Floats) -> Floats:
        """-2 log likelihood a number (up to a constant), of logarithms of what is free (B, k)."""
        full = np.tile(given, (len(logs), 1))
        full[:, free] = np.exp(logs)
        bank = of.bank(full[:, :-1] * signals.unit, full[:, -1] * signals.drift)
        counted = of.grid.known.copy()
        counted[:skip] = False
        log_variance, squares = innovations(bank, of.measured, counted)
        return (log_variance + squares) / max(d * int(counted.sum()), 1)

    best = np.empty(0)
    if len(free):
        rough = _SLACK**2 * signals.roughness() / signals.unit
        most = np.maximum(np.where(np.isnan(rough), 1.0, rough), _EXACT**2)
        # from the greatest noise downwards: where it is too small the likelihood is flat
        tried = np.tile(np.append(np.fmin(given[:-1], most), np.nan), (len(_RATIOS), 1))
        tried[:, -1] = _RATIOS * tried[0, :-1].min()
        limits = [(np.log(_EXACT**2), np.log(top)) for top in most] + [(-60.0, 40.0)]
        starts = np.log(tried[:, free])
        start = starts[np.argmin(deviance(signals.few(values, _N_TRIED), starts))]
        best = _descend(lambda x: deviance(signals, x), start, [limits[i] for i in free])
    value = float(deviance(signals, best[None])[0])
    # what was given stays as it is, to the bit
    found = np.append(variance, intensity)
    found[free] = np.exp(best) * np.append(signals.unit, signals.drift)[free]
    return Noise(found[:-1], float(found[-1]), value)


def _descend(
    objective: Callable[[Floats], Floats], start: Floats, limits: list[tuple[float, float]]
) -> Floats:
    """Least value within the limits, by slopes from one pass over neighbouring points."""
    step = 1e-4 * np.eye(len(start))

    def with_slope(x: Floats) -> tuple[Any, Any]:
        values = objective(np.concatenate([x[None], x + step, x - step]))
        ahead, behind = np.split(values[1:], 2)
        return values[0], (ahead - behind) / (2 * step[0, 0])

    # the objective is a mean over numbers: a millionth of it is noise in the estimates
    how: dict[str, Any] = {"method": "L-BFGS-B", "options": {"ftol": 1e-7, "gtol": 1e-4}}
    return np.asarray(minimize(with_slope, start, jac=True, bounds=limits, **how).x)


def fit_start(first: Signals, everywhere: Signals, noise: Noise) -> tuple[Start, Floats]:
    """Where new episodes begin, and how far smoothing moves the measured numbers.

    An episode may begin where none in training did, such as a window or one with another
    set-point. So nothing is assumed of what is measured: the first measurement is the estimate.
    The rest of the hidden state has the mean that it has at the start of training episodes, and
    deviates from it by as much as all states in training do. That covariance is widened as the
    predictive (Student t) distribution of another episode asks for; of too few it is vague.

    Parameters
    ----------
    first : Signals
        Episodes from their beginning on.
    everywhere : Signals
        Stretches from any part of them.
    noise : Noise

    Returns
    -------
    start : Start
    gap : ndarray of shape (rows, d)
        What smoothing takes off the measured numbers of `everywhere`.
    """
    h = everywhere.motion.measurement
    d, m = h.shape
    root, rank = np.sqrt(everywhere.hidden), int(np.linalg.matrix_rank(h))
    # several sensors of one thing count by their variances
    weight = 1 / np.sqrt(everywhere.unit if rank == d else noise.variance)
    gain = root[:, None] * np.linalg.pinv(weight[:, None] * h * root) * weight
    rest = np.eye(m) - gain @ h
    bank = everywhere.bank(noise.variance[None], np.array([noise.intensity]))
    hidden = smoothed(bank, everywhere.measured, everywhere.grid.known)
    gap = (everywhere.measured - combine(hidden, h))[:, 0][everywhere.grid.known]
    begin = smoothed(
        first.bank(noise.variance[None], np.array([noise.intensity])),
        first.measured,
        first.grid.known,
    )[0, 0]
    n, free = len(begin), m - rank
    mean = begin.mean(axis=0)
    spread = bank.covariance[0]
    if n >= free + 4:
        off = hidden[:, 0][everywhere.grid.known] - mean
        widen = (n - 1) * (n + 1) / (n * (n - free - 2))
        spread = widen * (off.T @ off) / len(off) + _EXACT**2 * np.diag(everywhere.hidden)
    covariance = (gain * noise.variance) @ gain.T + rest @ spread @ rest.T
    return Start(gain, rest @ mean, (covariance + covariance.T) / 2), gap


def correlations(signals: Signals, noise: Noise) -> tuple[Floats, Floats, int]:
    """Autocorrelations of the innovations, which a model that fits leaves white.

    Returns
    -------
    next : ndarray of shape (d,)
        Over one sample.
    later : ndarray of shape (d,)
        Sum of those over 2, 3 and 4 samples. After a jump that stays, a filter runs past it and
        comes back: they are negative.
    n : int
        Innovations that they are from.
    """
    bank = signals.bank(noise.variance[None], np.array([noise.intensity]))
    values = standardised(bank, signals.measured)[:, 0]
    d, m = signals.motion.measurement.shape
    known = signals.grid.known.copy()
    known[: -(-m // d)] = False
    # a few violent moments are not to decide alone
    values = np.where(known[..., None], np.clip(values, -_CLIP_WHITE, _CLIP_WHITE), 0.0)
    total = np.maximum((values**2).sum(axis=(0, 1)), np.finfo(np.float64).tiny)
    by_lag = np.zeros((5, d))
    for lag in range(1, min(5, len(values))):
        by_lag[lag] = (values[lag:] * values[:-lag]).sum(axis=(0, 1)) / total
    return by_lag[1], by_lag[2:].sum(axis=0), int(known.sum())
