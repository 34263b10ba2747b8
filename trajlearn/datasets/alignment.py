"""When the motion of a logged reference begins, to a fraction of a sample."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from trajlearn.exceptions import InvalidEpisodeError

__all__ = ["ReferenceAlignment", "align_references"]

Floats = NDArray[np.float64]

_MOVES = 0.01  # of the peak speed: the motion begins when the reference gets this fast
_ROUNDS = 3  # the template changes by less than the noise of one sample after the second
_SCALES = np.geomspace(0.5, 2.0, 13)  # first guesses, near enough for least squares
_COARSE = 80  # samples of a flight that the first guess looks at
_NO_FIT = np.full(3, np.nan)
_NO_START = (
    "no flight of the usual duration has its reference at rest in the first and the last sample, "
    "so when the motion begins is not known. Add a flight that logs the whole motion."
)


@dataclass(frozen=True, eq=False)
class ReferenceAlignment:
    """How each of n flights lies on the path that most of them fly.

    Attributes
    ----------
    time_origin : ndarray of shape (n,)
        Time at which the reference begins to move, in the flight's own times; before its first
        sample where the log begins later. NaN where the flight does not match the path.
    time_scale : ndarray of shape (n,)
        Duration of the flight's path over that of most flights; exactly 1 where it is the same
        within `scale_tolerance`. NaN where the flight does not match.
    residual : ndarray of shape (n,)
        RMS distance of the logged positions from the path, in the unit of the positions;
        infinite for a reference that stands still.
    """

    time_origin: Floats
    time_scale: Floats
    residual: Floats


def align_references(
    times: Sequence[ArrayLike],
    positions: Sequence[ArrayLike],
    velocities: Sequence[ArrayLike],
    *,
    tolerance: float = 0.01,
    scale_tolerance: float = 0.02,
) -> ReferenceAlignment:
    """Match the whole logged reference of each flight to the path that all of them share.

    The path is a template averaged over the flights themselves: it starts from a flight that
    logged the motion from rest to rest, of the middle duration, and is made anew from all flights
    that match it. Each flight gets the shift and the scale of time with the least squared
    distance to it. The motion begins when the speed of the template passes 1 % of its peak, so
    the origins of flights compare to a fraction of a sample even where the log starts in the
    middle of the motion.

    Parameters
    ----------
    times : sequence of n arrays of shape (m_i,)
        Strictly increasing.
    positions, velocities : sequence of n arrays of shape (m_i, d)
        The reference (set-point) at those times, of one path flown n times.
    tolerance : float, default=0.01
        Greatest RMS distance, in the unit of `positions`, of a flight that matches.
    scale_tolerance : float, default=0.02
        Durations that differ by less count as the same; these flights are then only shifted.

    Returns
    -------
    ReferenceAlignment

    Raises
    ------
    InvalidEpisodeError
        Wrong shapes, non-finite values, unsorted times, or no flight with the whole motion.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 4.0, 0.02)
    >>> def path(t):
    ...     phase = np.clip(t / 2.0, 0.0, 1.0)[:, None]
    ...     return phase**3 * (10 - 15 * phase + 6 * phase**2)
    >>> def speed(t):
    ...     return np.gradient(path(t)[:, 0], t)[:, None]
    >>> starts = [0.5, 0.7133, -0.25]
    >>> found = align_references(
    ...     [t] * 3, [path(t - start) for start in starts], [speed(t - start) for start in starts]
    ... )
    >>> (found.time_origin - found.time_origin[0]).round(4)
    array([ 0.    ,  0.2133, -0.75  ])
    """
    flights = [
        _Flight.check(i, *signals)
        for i, signals in enumerate(zip(times, positions, velocities, strict=True))
    ]
    origin, scale, residual = (np.full(len(flights), x) for x in (np.nan, np.nan, np.inf))
    moving = [i for i, flight in enumerate(flights) if flight.peak > 0]
    if moving:
        template, fits, same = _share_template(
            [flights[i] for i in moving], tolerance, scale_tolerance
        )
        onset = template.onset()
        for i, fit, is_same in zip(moving, fits, same):
            # Nothing but the shift is free where the duration is known to be the same.
            fit = _refine(template, flights[i], fit[:1] if is_same else fit[:2])
            residual[i] = fit[2]
            if fit[2] <= tolerance:
                origin[i], scale[i] = fit[0] + fit[1] * onset, fit[1]
    return ReferenceAlignment(origin, scale, residual)


@dataclass(frozen=True, eq=False)
class _Flight:
    """A logged reference and its greatest speed."""

    times: Floats
    positions: Floats
    velocities: Floats
    speed: Floats
    peak: float

    @classmethod
    def check(
        cls, i: int, times: ArrayLike, positions: ArrayLike, velocities: ArrayLike
    ) -> "_Flight":
        t, p, v = (np.asarray(x, dtype=np.float64) for x in (times, positions, velocities))
        if t.ndim != 1 or len(t) < 2 or p.ndim != 2 or len(p) != len(t) or v.shape != p.shape:
            raise InvalidEpisodeError(
                f"flight {i} has times {t.shape}, positions {p.shape} and velocities {v.shape}; "
                "expected (m,), (m, d) and (m, d) with m > 1."
            )
        if not all(np.isfinite(x).all() for x in (t, p, v)) or np.any(np.diff(t) <= 0):
            raise InvalidEpisodeError(
                f"flight {i} has missing or infinite values or times that do not increase: drop "
                "those samples."
            )
        speed = np.linalg.norm(v, axis=1)
        return cls(t, p, v, speed, float(speed.max()))


class _Template:
    """The mean reference over phase (time since an arbitrary origin), at rest before and after."""

    def __init__(self, flights: Sequence[_Flight], shifts: Sequence[float] | Floats) -> None:
        phase = np.concatenate([f.times - shift for f, shift in zip(flights, shifts)])
        rows = np.concatenate([np.c_[f.positions, f.velocities] for f in flights])
        width = np.median(np.concatenate([np.diff(f.times) for f in flights]))
        # The mean phase and the mean values of the samples in each bin lie on the path where it
        # is straight over a bin, that is, to a hundredth of a millimetre.
        _, cell, count = np.unique(np.floor(phase / width), return_inverse=True, return_counts=True)
        mean = np.zeros((len(count), 1 + rows.shape[1]))
        np.add.at(mean, cell, np.c_[phase, rows])
        mean /= count[:, None]
        self.phase, d = mean[:, 0], rows.shape[1] // 2
        self.path = PchipInterpolator(self.phase, mean[:, 1 : 1 + d])
        self.slope = self.path.derivative()
        self.speed = np.linalg.norm(mean[:, 1 + d :], axis=1)

    def at(self, phase: Floats) -> Floats:
        """Positions (..., d), those at the ends beyond the template."""
        return self.path(np.clip(phase, self.phase[0], self.phase[-1]))

    def slope_at(self, phase: Floats) -> Floats:
        """Derivatives of the positions by phase (..., d)."""
        inside = (phase > self.phase[0]) & (phase < self.phase[-1])
        return np.where(inside[..., None], self.slope(phase), 0.0)

    def onset(self) -> float:
        """Phase at which the speed passes its threshold."""
        excess = self.speed - _MOVES * self.speed.max()
        i = int(np.argmax(excess > 0))
        if i == 0:
            raise InvalidEpisodeError(_NO_START)
        return float(np.interp(0.0, excess[i - 1 : i + 1], self.phase[i - 1 : i + 1]))


def _share_template(
    flights: Sequence[_Flight], tolerance: float, scale_tolerance: float
) -> tuple[_Template, Floats, NDArray[np.bool_]]:
    """The path, (shift, scale, residual) of each flight, and who flies it in the usual time."""
    template, fits = _Template([_first(flights)], [0.0]), [_NO_FIT] * len(flights)
    for _ in range(_ROUNDS):
        fits = [_match(template, *pair, tolerance) for pair in zip(flights, fits)]
        table = np.array(fits)
        matched = table[:, 2] <= tolerance
        # The middle one, never a mean of two: the template must be a path that was flown.
        table[:, 1] /= np.sort(table[matched, 1])[matched.sum() // 2]
        same = matched & (np.abs(table[:, 1] - 1) <= scale_tolerance)
        template = _Template([f for f, s in zip(flights, same) if s], table[same, 0])
        fits = list(table)
    return template, table, same


def _first(flights: Sequence[_Flight]) -> _Flight:
    """The flight of the middle duration among those that are logged from rest to rest."""
    spans = []
    for i, flight in enumerate(flights):
        moves = np.flatnonzero(flight.speed > _MOVES * flight.peak)
        if moves[0] > 0 and moves[-1] < len(flight.times) - 1:
            spans.append((flight.times[moves[-1]] - flight.times[moves[0]], i))
    if not spans:
        raise InvalidEpisodeError(_NO_START)
    return flights[sorted(spans)[len(spans) // 2][1]]


def _match(template: _Template, flight: _Flight, fit: Floats, tolerance: float) -> Floats:
    """Shift, scale and residual, from those of an earlier template if they are known."""
    if np.isfinite(fit).all():
        return _refine(template, flight, fit[:2])
    fit = _refine(template, flight, _guess(template, flight, 1.0)[1:])
    if fit[2] > tolerance:
        guess = min(_guess(template, flight, scale) for scale in _SCALES)
        fit = min(fit, _refine(template, flight, guess[1:]), key=lambda found: found[2])
    return fit


def _guess(template: _Template, flight: _Flight, scale: float) -> tuple[float, float, float]:
    """Least mean squared distance over a grid of shifts, with that shift and the scale."""
    few = slice(None, None, max(len(flight.times) // _COARSE, 1))
    t, p = flight.times[few], flight.positions[few]
    step = (t[-1] - t[0]) / len(t)
    shifts = np.arange(t[0] - scale * template.phase[-1], t[-1] - scale * template.phase[0], step)
    error = template.at((t - shifts[:, None]) / scale) - p
    cost = np.mean(np.sum(error**2, axis=-1), axis=-1)
    best = int(np.argmin(cost))
    return float(cost[best]), float(shifts[best]), scale


def _refine(template: _Template, flight: _Flight, start: ArrayLike) -> Floats:
    """Least squares in the shift or, with two numbers to start from, in shift and scale."""
    start = np.asarray(start)
    t, n = flight.times, len(start)

    def phase(x: Floats) -> tuple[Floats, float]:
        scale = x[1] if n > 1 else 1.0
        return (t - x[0]) / scale, scale

    def error(x: Floats) -> Floats:
        return np.ravel(template.at(phase(x)[0]) - flight.positions)

    def slope(x: Floats) -> Floats:
        at, scale = phase(x)
        by_phase = template.slope_at(at) / -scale
        columns = [by_phase, by_phase * at[:, None]][:n]
        return np.stack([np.ravel(column) for column in columns], axis=1)

    x = least_squares(error, start, jac=slope, method="lm").x
    squared = np.sum(error(x).reshape(flight.positions.shape) ** 2, axis=1)
    return np.array([x[0], phase(x)[1], np.sqrt(squared.mean())])
