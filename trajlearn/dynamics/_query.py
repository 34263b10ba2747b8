"""What a forecast may read: the past up to the start, and what is known of the future."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics.propagation._algebra import applied
from trajlearn.exceptions import MixedSamplingError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.times import episode_steps, time_grids

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Query:
    """n starts to forecast from, for up to H steps each.

    Attributes
    ----------
    ds : TrajectoryDataset
        One episode a start (repeated where an episode has several).
    start : ndarray of shape (n,)
    lengths : ndarray of shape (n,)
        Steps to forecast.
    times : ndarray of shape (n, H)
        Absolute time of each step, extended past the log on a uniform grid.
    base : ndarray of shape (n, H + 1, d_s) or None
        The baseline at the start and at each step, where the states of `ds` are relative to it.
    start_root : ndarray of shape (n, d_s, d_s) or None
        Lower root of the covariance of each start; None where starts are taken as exact.
    """

    ds: TrajectoryDataset
    start: Ints
    lengths: Ints
    times: Floats
    base: Floats | None = None
    start_root: Floats | None = None

    def __len__(self) -> int:
        return len(self.start)

    @property
    def n_steps(self) -> int:
        """H."""
        return self.times.shape[1]

    @property
    def rows(self) -> Ints:
        """Row of each start in ``ds.states``."""
        return self.ds.offsets[:-1] + self.start

    @property
    def initial_states(self) -> Floats:
        """s_start (n, d_s)."""
        return self.ds.states[self.rows]

    def starts(self, copies: int, rng: np.random.Generator | None) -> Floats:
        """Copies of s_start (copies * n, d_s), drawn from what is known of it; None: its mean."""
        initial = np.tile(self.initial_states, (copies, 1))
        if rng is None or self.start_root is None:
            return initial
        root = np.tile(self.start_root, (copies, 1, 1))
        return initial + applied(root, rng.standard_normal(initial.shape))

    @property
    def initial_times(self) -> Floats:
        """Time of the start (n,)."""
        return self.ds.times[self.rows]

    @property
    def horizons(self) -> Floats:
        """Time from the start to each step (n, H), rounded to the time grid."""
        grid = time_grids(self.ds)[:, None]
        return np.rint((self.times - self.initial_times[:, None]) * grid) / grid

    def known(self) -> NDArray[np.bool_]:
        """Which of the (n, H) steps are asked for."""
        return np.arange(self.n_steps) < self.lengths[:, None]

    def future(self, values: Floats, *, steps: bool) -> Floats:
        """Rows of a field from the start on: (n, H, width) for steps, (n, H + 1, width) for states.

        Beyond the log the last row is repeated.
        """
        first = self.ds.offsets[:-1] - (np.arange(len(self)) if steps else 0)
        last = self.ds.lengths - (1 if steps else 0)
        reach = np.arange(self.n_steps + (0 if steps else 1))
        index = np.minimum(self.start[:, None] + reach, last[:, None])
        return values[first[:, None] + index]

    def params(self) -> Floats:
        """Theta in force at the start (n, p)."""
        return self.ds.params_at(self.start)


def make_query(
    ds: TrajectoryDataset,
    start: ArrayLike,
    horizon: int | None,
    *,
    within_log: bool,
    within_stretch: bool,
) -> tuple[Query, Ints | None]:
    """Check `start` and `horizon`, and say how far each forecast goes.

    Parameters
    ----------
    ds : TrajectoryDataset
    start : int, (n,), (n, k) or n arrays
        An index, one per episode, or several per episode.
    horizon : int or None
        None forecasts to the end of each episode.
    within_log : bool
        The model reads logged future signals, so it cannot go past the end of the log.
    within_stretch : bool
        The model holds for constant theta only.

    Returns
    -------
    query : Query
    episode : ndarray of shape (n * k,) or None
        Episode of each forecast where k > 1.
    """
    ds, starts, episode = _starts(ds, start)
    ds.state_rows(starts)
    remaining = ds.lengths - starts
    if horizon is None:
        lengths = remaining
    else:
        lengths = np.full(len(ds), _whole(horizon, "horizon", least=1))
        if within_log:
            lengths = np.minimum(lengths, remaining)
    if within_stretch and ds.params_vary:
        lengths = np.minimum(lengths, _to_end_of_stretch(ds, starts))
    if not lengths.any():
        raise ValueError(
            f"nothing to forecast: start {np.unique(starts).tolist()} is the last state of every "
            "episode. Give an earlier start, or horizon= to go past the log."
        )
    return Query(ds, starts, lengths, _times(ds, starts, int(lengths.max()), lengths)), episode


def _whole(value: Any, name: str, least: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < least:
        raise ValueError(f"{name} = {value!r} must be a whole number of steps, at least {least}.")
    return int(value)


def _starts(ds: TrajectoryDataset, start: Any) -> tuple[TrajectoryDataset, Ints, Ints | None]:
    try:
        starts = np.asarray(start)
    except ValueError:
        # numpy has no array of rows of unequal length
        starts = np.fromiter(start, dtype=object)
    by_row = starts.ndim == 2 or starts.dtype == object
    rows = [np.asarray(row) for row in starts] if by_row else [starts]
    # the type of an empty row says nothing
    wrong = [row.dtype for row in rows if row.size and row.dtype.kind not in "iu"]
    if wrong:
        raise ValueError(f"start must be whole numbers of steps, got {wrong[0]}.")
    if starts.ndim == 0:
        return ds, np.full(len(ds), int(starts)), None
    if len(starts) != len(ds) or starts.ndim > 2 or (by_row and any(r.ndim != 1 for r in rows)):
        raise ValueError(
            f"start has shape {starts.shape} for {len(ds)} episodes: give one index, one per "
            "episode (n,), or several per episode: (n, k), or n arrays of unequal length."
        )
    if not by_row:
        return ds, starts.astype(np.intp), None
    episode = np.repeat(np.arange(len(ds)), [len(row) for row in rows])
    if not len(episode):
        raise ValueError("start has no index in any episode, so there is nothing to forecast.")
    return ds[episode], np.concatenate(rows).astype(np.intp), episode


def _to_end_of_stretch(ds: TrajectoryDataset, starts: Ints) -> Ints:
    """Steps from each start until theta first changes; no limit where it does not."""
    steps = np.full(len(ds), np.iinfo(np.intp).max)
    params = ds.step_params
    assert params is not None  # theta varies
    first = ds.offsets[:-1] - np.arange(len(ds))
    for i, (begin, begin_of, length) in enumerate(zip(starts, first, ds.lengths)):
        own = params[begin_of + min(begin, length - 1) : begin_of + length]
        changes = np.flatnonzero((own != own[0]).any(axis=1))
        if len(changes):
            steps[i] = changes[0]
    return steps


def _times(ds: TrajectoryDataset, starts: Ints, n_steps: int, lengths: Ints) -> Floats:
    """Time of the steps start + 1 ... start + H; past the log on the uniform grid."""
    index = starts[:, None] + np.arange(1, n_steps + 1)
    beyond = index - ds.lengths[:, None]
    times = ds.times[ds.offsets[:-1][:, None] + np.minimum(index, ds.lengths[:, None])]
    asked = np.arange(1, n_steps + 1) <= lengths[:, None]
    past_log = (asked & (beyond > 0)).any(axis=1)
    if past_log.any():
        step = episode_steps(ds)
        unknown = past_log & np.isnan(step)
        if unknown.any():
            raise MixedSamplingError(
                f"the time step varies in episode {ds.ids[unknown][0]}, so nothing says when the "
                "steps past its log are. Ask for a horizon within the log, or give times: "
                "predict_trajectory(..., horizons=)."
            )
        times = times + np.where(past_log, step, 0.0)[:, None] * np.maximum(beyond, 0)
    return np.where(asked, times, np.nan)
