"""Filters of a dataset: which states each takes, fitted to episodes and run over them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MixedSamplingError
from trajlearn.trajectories._columns import runs
from trajlearn.trajectories._kalman_fit import (
    Noise,
    Signals,
    Start,
    correlations,
    fit_noise,
    fit_start,
)
from trajlearn.trajectories._kalman_models import Motion, StateSpaceModel
from trajlearn.trajectories._state_space import Bank, Grid, combine
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["Block", "FittedBlock", "estimate", "fit_block", "training_grid"]

Floats = NDArray[np.float64]

# The likelihood is summed over at most so many stretches of so many states.
_N_STRETCHES, _LENGTH = 128, 128
# First states are learnt from at most so many episodes, each smoothed over so many states.
_N_STARTS, _START_LENGTH = 512, 128
# Cells (episodes times the longest of them) that are filtered side by side; what memory a dataset
# takes beyond its longest episode is bounded by it.
_CELLS = 2**16


@dataclass(frozen=True, eq=False, kw_only=True)
class Block:
    """One filter: the states that it measures and their model."""

    columns: tuple[int, ...]
    motion: Motion
    outputs: Floats
    """Rows (k, m): the estimates of the measured states, then of those appended."""
    appended: tuple[str, ...] = ()

    def measured(self, states: Floats) -> Floats:
        """Measured numbers (rows, d), with independent errors."""
        values = states[:, self.columns]
        if isinstance(self.motion, StateSpaceModel) and self.motion.R is not None:
            return combine(values, self.motion.scale)
        return values


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedBlock(Block):
    """A filter with its noise and the distribution of the first hidden state."""

    noise: Noise
    start: Start
    moved: Floats
    """How far smoothing moves the states that it measures (d,), root mean square."""
    correlated: tuple[Floats, Floats, int]
    """`correlations` of its innovations."""
    dt: float

    @property
    def sigma(self) -> Floats:
        """Standard deviation of the measurement noise (d,), in the units of the states."""
        if isinstance(self.motion, StateSpaceModel) and self.motion.R is not None:
            return np.sqrt(np.diag(np.asarray(self.motion.R, dtype=np.float64)))
        return np.sqrt(self.noise.variance)


def training_grid(ds: TrajectoryDataset) -> Grid:
    """Stretches of the episodes that the likelihood is summed over."""
    counts = ds.lengths + 1
    n_pieces = -(-counts // _LENGTH)
    size = -(-counts // n_pieces)
    episode = np.repeat(np.arange(len(ds)), n_pieces)
    begin = runs(np.zeros_like(n_pieces), n_pieces) * size[episode]
    length = np.minimum(size[episode], counts[episode] - begin)
    rows = ds.offsets[:-1][episode] + begin
    chosen = _spread(np.flatnonzero(length > 1), _N_STRETCHES)
    return Grid.of(rows[chosen], length[chosen], ds.times)


def fit_block(
    block: Block, ds: TrajectoryDataset, grid: Grid, variance: Floats, intensity: float, **how: int
) -> FittedBlock:
    """The block with its noise (where NaN) and its first hidden state learnt."""
    motion, values = block.motion, block.measured(ds.states)
    noise = fit_noise(values, grid, motion, variance, intensity, **how)
    chosen = _spread(np.arange(len(ds)), _N_STARTS)
    counts = np.minimum(ds.lengths[chosen] + 1, _START_LENGTH)
    starts = Grid.of(ds.offsets[:-1][chosen], counts, ds.times)
    everywhere = Signals(values, grid, motion)
    start, gap = fit_start(Signals(values, starts, motion), everywhere, noise)
    if isinstance(motion, StateSpaceModel):
        if motion.R is not None:
            gap = combine(gap, np.asarray(np.linalg.inv(motion.scale), dtype=np.float64))
        if motion.initial_mean is not None:
            start = Start(
                gain=np.zeros_like(start.gain),
                mean=np.asarray(motion.initial_mean, dtype=np.float64),
                covariance=np.asarray(motion.initial_covariance, dtype=np.float64),
                told=False,
            )
    return FittedBlock(
        **vars(block),
        noise=noise,
        start=start,
        moved=np.sqrt(np.mean(gap**2, axis=0)),
        correlated=correlations(everywhere, noise),
        dt=float(np.median(grid.dt)),
    )


def estimate(
    blocks: Sequence[FittedBlock],
    ds: TrajectoryDataset,
    run: Callable[[Bank, Floats, NDArray[np.bool_]], Floats],
) -> list[Floats]:
    """Outputs of each block (rows, k), by a pass `run` over all episodes."""
    values = [block.measured(ds.states) for block in blocks]
    found = [np.empty((len(ds.states), len(block.outputs))) for block in blocks]
    for grid in _chunks(ds):
        rows = grid.rows[grid.known]
        position = 0
        for motion, items in groupby(blocks, key=lambda block: block.motion):
            group = list(items)
            _check_sampling(group[0], grid, ds)
            of = values[position : position + len(group)]
            measured = np.stack([some[grid.rows] for some in of], axis=1)
            hidden = run(_bank(motion, group, grid, measured[0]), measured, grid.known)
            for b, block in enumerate(group):
                found[position + b][rows] = combine(hidden[:, b], block.outputs)[grid.known]
            position += len(group)
    return found


def _bank(motion: Motion, blocks: Sequence[FittedBlock], grid: Grid, first: Floats) -> Bank:
    """The filters, for episodes whose first measured numbers are `first` (B, n, d)."""
    f, q = motion.matrices(grid.dt)
    starts = [block.start for block in blocks]
    return Bank(
        transition=f,
        process=q,
        measurement=motion.measurement,
        intensity=np.array([block.noise.intensity for block in blocks]),
        variance=np.stack([block.noise.variance for block in blocks]),
        mean=np.stack([combine(y, s.gain) + s.mean for y, s in zip(first, starts, strict=True)]),
        covariance=np.stack([start.covariance for start in starts]),
        told=starts[0].told,
    )


def _chunks(ds: TrajectoryDataset) -> Iterator[Grid]:
    """Episodes of like lengths, so many that they fill at most `_CELLS`."""
    order = np.argsort(ds.lengths, kind="stable")
    counts = ds.lengths[order] + 1
    while len(order):
        cells = counts * np.arange(1, len(order) + 1)
        n = max(1, int(np.searchsorted(cells, _CELLS, side="right")))
        chosen, order, counts = order[:n], order[n:], counts[n:]
        yield Grid.of(ds.offsets[:-1][chosen], ds.lengths[chosen] + 1, ds.times)


def _check_sampling(block: FittedBlock, grid: Grid, ds: TrajectoryDataset) -> None:
    motion = block.motion
    if not isinstance(motion, StateSpaceModel) or not motion.for_one_step:
        return
    off = np.abs(grid.dt - block.dt) > 1e-3 * block.dt
    if off.any():
        row = grid.rows[1:][off][0]
        episode = int(np.searchsorted(ds.offsets, row, side="right") - 1)
        raise MixedSamplingError(
            f"F or Q of the model is one matrix, good for the time step {block.dt:g}, but episode "
            f"{ds.ids[episode]} has a step of {grid.dt[off][0]:g}: give functions of the time "
            "step, or resample(dt)."
        )


def _spread(index: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most so many of them, evenly spread."""
    if len(index) <= most:
        return index
    return index[np.linspace(0, len(index) - 1, most).astype(np.intp)]
