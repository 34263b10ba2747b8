"""Filters of a dataset: which states each takes, fitted to episodes and run over them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MixedSamplingError
from trajlearn.trajectories._columns import runs
from trajlearn.trajectories._kalman_fit import Noise, Signals, fit_noise, fit_start
from trajlearn.trajectories._kalman_models import Motion, StateSpaceModel
from trajlearn.trajectories._state_space import Bank, Grid, combine
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["Block", "FittedBlock", "estimate", "fit_block", "training_grid"]

Floats = NDArray[np.float64]

# The likelihood is summed over at most so many stretches of so many states.
_N_STRETCHES, _LENGTH = 128, 128
# First states are learnt from at most so many episodes, each smoothed over so many states.
_N_STARTS, _START_LENGTH = 512, 128
# Episodes filtered side by side; what memory a dataset takes is bounded by it.
_CHUNK = 256


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
    mean: Floats
    covariance: Floats
    moved: Floats
    """How far smoothing moves the states that it measures (d,), root mean square."""
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
    mean, covariance, gap = fit_start(Signals(values, starts, motion), noise)
    if isinstance(motion, StateSpaceModel):
        if motion.R is not None:
            gap = combine(gap, np.asarray(np.linalg.inv(motion.scale), dtype=np.float64))
        if motion.initial_mean is not None:
            mean = np.asarray(motion.initial_mean, dtype=np.float64)
            covariance = np.asarray(motion.initial_covariance, dtype=np.float64)
    return FittedBlock(
        **vars(block),
        noise=noise,
        mean=mean,
        covariance=covariance,
        moved=np.sqrt(np.mean(gap**2, axis=0)),
        dt=float(np.median(grid.dt)),
    )


def estimate(
    blocks: Sequence[FittedBlock],
    ds: TrajectoryDataset,
    run: Callable[[Bank, Floats, NDArray[np.bool_]], Floats],
) -> list[Floats]:
    """Outputs of each block (rows, k), by a pass `run` over all episodes."""
    found = [np.empty((len(ds.states), len(block.outputs))) for block in blocks]
    for grid in _chunks(ds):
        rows = grid.rows[grid.known]
        position = 0
        for motion, items in groupby(blocks, key=lambda block: block.motion):
            group = list(items)
            _check_sampling(group[0], grid, ds)
            hidden = run(
                _bank(motion, group, grid),
                np.stack([block.measured(ds.states)[grid.rows] for block in group], axis=1),
                grid.known,
            )
            for b, block in enumerate(group):
                values = combine(hidden[:, b], block.outputs)
                found[position + b][rows] = values[grid.known]
            position += len(group)
    return found


def _bank(motion: Motion, blocks: Sequence[FittedBlock], grid: Grid) -> Bank:
    f, q = motion.matrices(grid.dt)
    return Bank(
        transition=f,
        process=q,
        measurement=motion.measurement,
        intensity=np.array([block.noise.intensity for block in blocks]),
        variance=np.stack([block.noise.variance for block in blocks]),
        mean=np.stack([block.mean for block in blocks]),
        covariance=np.stack([block.covariance for block in blocks]),
    )


def _chunks(ds: TrajectoryDataset) -> Iterator[Grid]:
    order = np.argsort(ds.lengths, kind="stable")
    for i in range(0, len(order), _CHUNK):
        chosen = order[i : i + _CHUNK]
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
