"""Pairs of states (i, j), i < j, of ragged episodes, addressed by number without listing them.

A stretch of L steps has L + 1 states and sum_{t=1..L} t = L (L + 1) / 2 pairs. (The paper prints
n L (L - 1) / 2; that is the count for L states.) Numbering the pairs of all stretches one after
the other, start by start, turns drawing rows into drawing whole numbers and inverting the
cumulative count: O(rows drawn) in time and memory, whatever the number of pairs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.trajectories.dataset import TrajectoryDataset

Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Stretches:
    """Maximal runs of steps with constant theta: episode, first row in ``ds.states``, steps."""

    episode: Ints
    first_row: Ints
    n_steps: Ints

    @classmethod
    def of(cls, ds: TrajectoryDataset) -> "Stretches":
        """Stretches of a dataset; whole episodes where theta never changes."""
        if not ds.params_vary:
            return cls(np.arange(len(ds)), ds.offsets[:-1], ds.lengths)
        params = ds.step_params
        assert params is not None  # params_vary implies it
        step_offsets = ds.offsets - np.arange(len(ds.offsets))
        begins = np.ones(len(params), dtype=bool)
        begins[1:] = (params[1:] != params[:-1]).any(axis=1)
        begins[step_offsets[:-1]] = True
        first_step = np.flatnonzero(begins)
        episode = np.searchsorted(step_offsets, first_step, side="right") - 1
        # one more state than steps in every earlier episode
        return cls(episode, first_step + episode, np.diff(np.append(first_step, len(params))))


@dataclass(frozen=True)
class PairIndex:
    """Numbering of all pairs of the stretches with a horizon of at most `max_horizon` steps."""

    stretches: Stretches
    max_horizon: int | None = None

    @property
    def counts(self) -> Ints:
        """Pairs in each stretch."""
        steps = self.stretches.n_steps
        cap = steps if self.max_horizon is None else np.minimum(steps, self.max_horizon)
        return cap * (steps - cap) + cap * (cap + 1) // 2

    @property
    def total(self) -> int:
        """Number of pairs."""
        return int(self.counts.sum())

    def pairs(self, number: Ints) -> tuple[Ints, Ints, Ints]:
        """Stretch, start (steps into the stretch) and horizon (steps) of the pairs `number`."""
        ends = np.cumsum(self.counts)
        stretch = np.searchsorted(ends, number, side="right")
        local = number - (ends - self.counts)[stretch]
        steps = self.stretches.n_steps[stretch]
        cap = steps if self.max_horizon is None else np.minimum(steps, self.max_horizon)
        # the first `full` starts have `cap` horizons each, the rest cap - 1, cap - 2, ..., 1
        full = steps - cap + 1
        in_full = local < full * cap
        start, horizon = _invert_triangle(np.where(in_full, 0, local - full * cap), cap - 1)
        start = np.where(in_full, local // cap, start + full)
        horizon = np.where(in_full, local % cap + 1, horizon)
        return stretch, start, horizon


def _invert_triangle(local: Ints, size: Ints) -> tuple[Ints, Ints]:
    """Start and horizon of pair `local` of a stretch of `size` steps, numbered start by start."""
    wide = 2 * size + 1
    # the difference in whole numbers: in floats it would lose the last starts of a long stretch
    start = ((wide - np.sqrt(wide**2 - 8 * local)) / 2).astype(np.intp)
    before = start * size - start * (start - 1) // 2
    # the root of a large number may be one off either way
    start -= before > local
    before = start * size - start * (start - 1) // 2
    start += local - before >= size - start
    before = start * size - start * (start - 1) // 2
    return start, local - before + 1


def draw_pairs(
    index: PairIndex,
    n_rows: int,
    *,
    starts: str,
    horizons: str,
    rng: np.random.Generator,
    replace: bool,
) -> tuple[Ints, Ints, Ints]:
    """Draw (stretch, start, horizon) by the schemes of `SubtrajectoryRelabeler`."""
    if starts == "uniform" and horizons == "uniform":
        if replace:
            number = rng.integers(index.total, size=n_rows)
        else:
            number = rng.choice(index.total, size=n_rows, replace=False, shuffle=False)
        return index.pairs(number)
    steps = index.stretches.n_steps
    # a stretch counts by its steps, so that every logged start weighs the same
    ends = np.cumsum(steps)
    position = rng.integers(ends[-1], size=n_rows)
    stretch = np.searchsorted(ends, position, side="right")
    length = steps[stretch]
    if starts == "uniform":
        start = position - (ends[stretch] - length)
    else:
        # "first": s_0 alone. "early": 30 % at s_0, the rest at L u^2 (measured best for forecasts
        # that begin at the reset state and still need starts on the way)
        start = np.zeros(n_rows, dtype=np.intp)
        if starts == "early":
            later = rng.random(n_rows) >= 0.3
            start[later] = (length[later] * rng.random(later.sum()) ** 2).astype(np.intp)
    room = length - start
    if index.max_horizon is not None:
        room = np.minimum(room, index.max_horizon)
    u = rng.random(n_rows)
    horizon = 1 + (u * room).astype(np.intp)
    if horizons == "mixture":
        log_uniform = rng.random(n_rows) < 0.5
        horizon[log_uniform] = np.exp(u * np.log(room + 1.0)).astype(np.intp)[log_uniform]
    return stretch, start, np.clip(horizon, 1, room)
