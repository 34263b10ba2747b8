"""Searches for the greatest value in a box, without gradients, candidates in batches."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats.qmc import Sobol

from trajlearn.trajectories._extras import import_extra

__all__ = ["METHODS", "Found", "checked_bounds", "checked_start", "maximise"]

Floats = NDArray[np.float64]
# candidates (m, d) to values (m,)
Value = Callable[[Floats], Floats]

# share of a batch that CEM learns from, and how much of the old distribution it keeps
_ELITES = 0.1
_KEPT = 0.2
# standard deviation of a first batch around a starting point, of a cube of side 1
_WIDTH = 0.3
# a distribution this narrow, in the same unit, has nothing left to find
_COLLAPSED = 1e-4


@dataclass(frozen=True)
class Found:
    """The best candidate of a search.

    Attributes
    ----------
    params : ndarray of shape (d,)
    value : float
        -inf if no candidate had a finite value; `params` is then the first.
    n_evaluations : int
        Candidates evaluated.
    """

    params: Floats
    value: float
    n_evaluations: int


class Sampler(Protocol):
    """Draws batches of candidates in the unit cube, and learns from their values."""

    def ask(self) -> Floats:
        """Next batch (population, d)."""

    def begin(self, point: Floats) -> None:
        """Start at a point (d,) of unknown value."""

    def tell(self, points: Floats, values: Floats) -> None:
        """Values (m,) of the batch, after those of start points; -inf is a failure."""


def checked_bounds(bounds: ArrayLike) -> Floats:
    """Bounds (d, 2), lower first.

    Raises
    ------
    ValueError
        If the shape is another, a bound is not finite, or a lower one is not below its upper one.
    """
    box = np.array(bounds, dtype=np.float64)
    if box.ndim != 2 or box.shape[1] != 2 or not len(box):
        raise ValueError(f"bounds has shape {box.shape}; expected (p, 2), lower bound first.")
    if not np.isfinite(box).all():
        raise ValueError("bounds has NaN or infinite values; a search needs finite ones.")
    wrong = np.flatnonzero(box[:, 0] >= box[:, 1])
    if len(wrong):
        raise ValueError(
            f"bounds[{wrong[0]}] = {box[wrong[0]].tolist()}: the lower bound must be less than "
            "the upper one."
        )
    return box


def maximise(
    value: Value,
    bounds: ArrayLike,
    *,
    method: str = "cma",
    n_evaluations: int,
    rng: np.random.Generator,
    start: ArrayLike | None = None,
    begin: ArrayLike | None = None,
    population: int | None = None,
    on_batch: Callable[[Floats, Floats], object] | None = None,
) -> Found:
    """Search a box for the candidate of the greatest value.

    Parameters
    ----------
    value : callable
        ``value(candidates (m, d)) -> (m,)``. NaN and infinite values count as worst.
    bounds : array-like of shape (d, 2)
        Lower bound first; no candidate lies beyond.
    method : {"cma", "cem", "random"}, default="cma"
        CMA-ES (pycma, with its own treatment of bounds; restarted from Sobol points while there
        is budget), the cross-entropy method, or uniform draws.
    n_evaluations : int
        Candidates that are evaluated in all.
    rng : Generator
    start : array-like of shape (d,) or (k, d), optional
        Evaluated first, so that what is found is never worse; CMA-ES and CEM begin at the best.
    begin : array-like of shape (d,), optional
        Where CMA-ES and CEM begin, whatever it is worth: evaluated in one batch with the first
        draws around it, for functions that take as long for one candidate as for many.
    population : int, optional
        Candidates a batch. None: 32 for CMA-ES, 64 for CEM, 256 for random search.
    on_batch : callable, optional
        Called with the candidates and the values of each batch.

    Returns
    -------
    Found

    Raises
    ------
    ValueError
        If the bounds, the start or the values have wrong shapes, or the start is out of bounds.
    """
    box = checked_bounds(bounds)
    if method not in _SAMPLERS:
        raise ValueError(f"method = {method!r}; choose one of {METHODS}.")
    sampler_of, default = _SAMPLERS[method]
    size = default if population is None else population
    if n_evaluations < 1 or size < 1:
        raise ValueError(
            f"n_evaluations = {n_evaluations} and population = {size} must be at least 1."
        )
    low, width = box[:, 0], box[:, 1] - box[:, 0]
    best = Found(box.mean(axis=1), -np.inf, 0)

    def evaluate(candidates: Floats) -> Floats:
        nonlocal best
        # a copy: the caller may do with it what it likes
        values = np.array(value(candidates.copy()), dtype=np.float64)
        if values.shape != (len(candidates),):
            raise ValueError(
                f"value returned shape {values.shape} for {len(candidates)} candidates; expected "
                f"({len(candidates)},)."
            )
        values[~np.isfinite(values)] = -np.inf
        top, done = int(values.argmax()), best.n_evaluations + len(values)
        if values[top] > best.value or not best.n_evaluations:
            best = Found(candidates[top].copy(), float(values[top]), done)
        best = Found(best.params, best.value, done)
        if on_batch is not None:
            on_batch(candidates, values)
        return values

    sampler = sampler_of(len(box), size, rng)
    if start is not None:
        first = checked_start(start, box)[:n_evaluations]
        sampler.tell(np.clip((first - low) / width, 0.0, 1.0), evaluate(first))
    waiting = np.empty((0, len(box)))
    if begin is not None:
        waiting = checked_start(begin, box)[:1]
        sampler.begin(np.clip((waiting[0] - low) / width, 0.0, 1.0))
    while (left := n_evaluations - best.n_evaluations) > 0:
        points = sampler.ask()[: left - len(waiting)]
        # rounding must not carry a candidate over a bound
        drawn = np.clip(low + points * width, box[:, 0], box[:, 1])
        values = evaluate(np.concatenate([waiting, drawn]))
        if len(values) < left:
            first = np.clip((waiting - low) / width, 0.0, 1.0)
            sampler.tell(np.concatenate([first, points]), values)
        waiting = waiting[:0]
    return best


def checked_start(start: ArrayLike, box: Floats) -> Floats:
    """Start points (k, d), within the bounds (d, 2).

    Raises
    ------
    ValueError
        If the shape is another, or a point is out of bounds by more than rounding.
    """
    points = np.atleast_2d(np.array(start, dtype=np.float64))
    if points.ndim != 2 or points.shape[1] != len(box) or not len(points):
        raise ValueError(
            f"start has shape {np.shape(start)}; expected ({len(box)},) or (k, {len(box)})."
        )
    inside = np.clip(points, box[:, 0], box[:, 1])
    off = ~(np.abs(points - inside) <= 1e-9 * (box[:, 1] - box[:, 0]))
    if off.any():
        row, column = np.argwhere(off)[0]
        raise ValueError(
            f"start {points[row].tolist()} is not within the bounds {box[column].tolist()} of "
            f"parameter {column}."
        )
    return inside


class _Uniform:
    def __init__(self, d: int, size: int, rng: np.random.Generator) -> None:
        self._shape, self._rng = (size, d), rng

    def ask(self) -> Floats:
        return self._rng.random(self._shape)

    def begin(self, point: Floats) -> None:
        pass

    def tell(self, points: Floats, values: Floats) -> None:
        pass


class _CrossEntropy:
    """A Gaussian, cut at the bounds, that moves towards the best tenth of what it drew."""

    def __init__(self, d: int, size: int, rng: np.random.Generator) -> None:
        self._shape, self._rng = (size, d), rng
        self._begin()

    def begin(self, point: Floats) -> None:
        self._begin(point)

    def _begin(self, point: Floats | None = None) -> None:
        d = self._shape[1]
        self._mean = point
        self._std = np.full(d, _WIDTH)
        self._elite: Floats = np.empty((0, d))
        self._elite_values: Floats = np.empty(0)

    def ask(self) -> Floats:
        if self._mean is None:
            return self._rng.random(self._shape)
        draws = self._mean + self._std * self._rng.standard_normal(self._shape)
        return np.clip(draws, 0.0, 1.0)

    def tell(self, points: Floats, values: Floats) -> None:
        n_elites = max(2, round(_ELITES * self._shape[0]))
        # the elites so far stay in the pool, so that the best is not lost from it
        points = np.concatenate([self._elite, points])
        values = np.concatenate([self._elite_values, values])
        order = np.argsort(-values, kind="stable")[:n_elites]
        order = order[np.isfinite(values[order])]
        self._elite, self._elite_values = points[order], values[order]
        if not len(order):
            return
        if self._mean is None or len(order) < n_elites:
            # too few to say anything about a width
            self._mean = points[order[0]]
            return
        self._mean = _KEPT * self._mean + (1 - _KEPT) * self._elite.mean(axis=0)
        self._std = _KEPT * self._std + (1 - _KEPT) * self._elite.std(axis=0)
        if self._std.max() < _COLLAPSED:
            self._begin()


class _CmaEs:
    """CMA-ES from the best starting point or the centre, then from Sobol points."""

    def __init__(self, d: int, size: int, rng: np.random.Generator) -> None:
        self._cma: Any = import_extra("cma", "search", by='method="cma"')
        self._d, self._size, self._rng = d, max(size, 4), rng
        self._sobol = Sobol(d, rng=rng)
        self._begin = np.full(d, 0.5)
        self._strategy: Any = None
        self._worst = -np.inf

    def begin(self, point: Floats) -> None:
        self._begin = point

    def ask(self) -> Floats:
        if self._strategy is None:
            self._strategy = self._new()
        # pycma has no 1-D search: a second, idle coordinate makes it one of 2-D
        self._asked = self._strategy.ask()
        return np.array(self._asked)[:, : self._d]

    def tell(self, points: Floats, values: Floats) -> None:
        if self._strategy is None:
            if np.isfinite(values).any():
                self._begin = points[values.argmax()]
            return
        # its own draws, not a start before them
        values = values[-len(self._asked) :]
        finite = values[np.isfinite(values)]
        # pycma takes no infinite values: failures are a little worse than the worst so far
        self._worst = float(np.max(-finite, initial=self._worst))
        failed = self._worst + 1e-3 * abs(self._worst) + 1e-9 if self._worst > -np.inf else 0.0
        losses = np.where(np.isfinite(values), -values, failed)
        self._strategy.tell(self._asked, losses.tolist())
        if self._strategy.stop():
            self._begin, self._strategy = self._sobol.random(1)[0], None

    def _new(self) -> Any:
        begin = np.append(self._begin, 0.5) if self._d == 1 else self._begin
        options = {
            "bounds": [0, 1],
            "BoundaryHandler": self._cma.BoundTransform,
            "popsize": self._size,
            "tolx": _COLLAPSED,
            # draw from `rng`, and leave numpy's global state alone
            "seed": np.nan,
            "randn": lambda *shape: self._rng.standard_normal(shape),
            # nothing printed, written or read
            "verbose": -9,
            "verb_log": 0,
            "signals_filename": "",
        }
        return self._cma.CMAEvolutionStrategy(begin, _WIDTH, options)


_SAMPLERS: dict[str, tuple[Callable[[int, int, np.random.Generator], Sampler], int]] = {
    "cma": (_CmaEs, 32),
    "cem": (_CrossEntropy, 64),
    "random": (_Uniform, 256),
}
METHODS = tuple(_SAMPLERS)
