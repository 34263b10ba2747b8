"""Sub-trajectories: pairs of states of one episode, for trajectory-based models."""

from collections.abc import Callable, Iterator, Sequence
from numbers import Integral
from typing import Any, ClassVar

import numpy as np

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.trajectories._pairs import PairIndex, Stretches, draw_pairs
from trajlearn.trajectories._relabeler import Floats, Ints, Relabeler, generator
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["SubtrajectoryRelabeler"]


class SubtrajectoryRelabeler(Relabeler):
    """Rows (s_t, h, theta, ...) with target s_{t+h}: sub-trajectories, for trajectory-based models.

    An episode of T steps has T (T + 1) / 2 of them. They are never listed: row numbers are drawn
    and the cumulative pair count is inverted, so that time and memory follow the rows asked for.
    Where theta changes inside an episode, rows come only from stretches of constant theta.

    Parameters
    ----------
    max_rows : int or None, default=100_000
        Rows to draw (without repeats if uniform), at most as many as there are pairs. None, or
        at least as many as there are pairs with both schemes uniform: every pair once.
    starts : {"uniform", "early", "first"}, default="uniform"
        How the start is drawn. "early": 30 % at s_0, the rest at L u^2 with u ~ U(0, 1).
        "first": s_0 only.
    horizons : {"uniform", "mixture"}, default="uniform"
        "mixture": half log-uniform, half uniform over what the start leaves. Both schemes
        uniform is the paper's draw, uniform over pairs.
    max_horizon : int or None, default=None
        Longest horizon in steps.
    inputs : sequence of str or None, default=None
        Blocks of a row, out of ``state, horizon, params, context, references, phase``; None
        takes every block that the episodes have. `references` holds the values at t, at the
        knots and at t + h; `phase` the time since `time_origin`, at t and at t + h.
    n_knots : int, default=0
        Evenly spaced times between t and t + h at which a row holds the references, too. With
        irregular sampling they are interpolated linearly.
    random_state : int, RandomState, Generator or None, default=None

    Attributes
    ----------
    layout_ : mapping from block to slice
    sample_indices_ : ndarray of shape (n_rows,)
        Episode of each row of the last draw.
    context_categories_ : dict

    References
    ----------
    N. Lambert et al., "Learning Accurate Long-term Dynamics for Model-based Reinforcement
    Learning", CDC 2021, section III.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays(np.arange(4.0).reshape(1, 4, 1), params=[[7.0]], dt=0.5)
    >>> rows, targets = SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    >>> np.column_stack([rows, targets])  # s_t, h, theta, s_{t+h}
    array([[0. , 0.5, 7. , 1. ],
           [0. , 1. , 7. , 2. ],
           [0. , 1.5, 7. , 3. ],
           [1. , 0.5, 7. , 2. ],
           [1. , 1. , 7. , 3. ],
           [2. , 0.5, 7. , 3. ]])
    """

    _blocks = ("state", "horizon", "params", "context", "references", "phase")
    _required = ("state", "horizon")
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "max_rows": [Interval(Integral, 1, None, closed="left"), None],
        "starts": [StrOptions({"uniform", "early", "first"})],
        "horizons": [StrOptions({"uniform", "mixture"})],
        "max_horizon": [Interval(Integral, 1, None, closed="left"), None],
        "inputs": ["array-like", None],
        "n_knots": [Interval(Integral, 0, None, closed="left")],
        "random_state": ["random_state", np.random.Generator],
    }

    def __init__(
        self,
        *,
        max_rows: int | None = 100_000,
        starts: str = "uniform",
        horizons: str = "uniform",
        max_horizon: int | None = None,
        inputs: Sequence[str] | None = None,
        n_knots: int = 0,
        random_state: Any = None,
    ) -> None:
        self.max_rows = max_rows
        self.starts = starts
        self.horizons = horizons
        self.max_horizon = max_horizon
        self.inputs = inputs
        self.n_knots = n_knots
        self.random_state = random_state

    def _resample(
        self, ds: TrajectoryDataset, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Ints]:
        index = PairIndex(Stretches.of(ds), self.max_horizon)
        uniform = self.starts == "uniform" and self.horizons == "uniform"
        if self.max_rows is None or (uniform and self.max_rows >= index.total):
            pairs = index.pairs(np.arange(index.total))
        else:
            n_rows = min(self.max_rows, index.total)
            pairs = self._draw(index, n_rows, rng, replace=False)
        return self._rows(ds, index, pairs)

    def _draw(
        self, index: PairIndex, n_rows: int, rng: np.random.Generator, *, replace: bool
    ) -> tuple[Ints, Ints, Ints]:
        return draw_pairs(
            index, n_rows, starts=self.starts, horizons=self.horizons, rng=rng, replace=replace
        )

    def _rows(
        self, ds: TrajectoryDataset, index: PairIndex, pairs: tuple[Ints, Ints, Ints]
    ) -> tuple[Floats, Floats, Ints]:
        stretch, start, horizon = pairs
        begin = index.stretches.first_row[stretch] + start
        end = begin + horizon
        episode = index.stretches.episode[stretch]
        rows = self.rows(ds, episode, begin, end)
        return rows, ds.states.take(end, axis=0), episode

    def sampler(self, X: Any) -> Callable[[int, np.random.Generator], tuple[Floats, Floats, Ints]]:
        """Function ``draw(n_rows, rng)`` of fresh rows, targets and the episode of each row.

        Call `fit` first. Rows may repeat; `n_pairs` counts what there is to draw from.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory

        Returns
        -------
        callable
        """
        ds = as_dataset(X)
        index = PairIndex(Stretches.of(ds), self.max_horizon)

        def draw(n_rows: int, rng: np.random.Generator) -> tuple[Floats, Floats, Ints]:
            return self._rows(ds, index, self._draw(index, n_rows, rng, replace=True))

        return draw

    def n_pairs(self, X: Any) -> int:
        """Number of pairs (s_t, s_{t+h}) in the episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory

        Returns
        -------
        int
        """
        return PairIndex(Stretches.of(as_dataset(X)), self.max_horizon).total

    def stream(
        self, X: Any, batch_size: int, random_state: Any = None
    ) -> Iterator[tuple[Floats, Floats, Ints]]:
        """Endless fresh batches: rows, targets and the episode of each row.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        batch_size : int
        random_state : int, RandomState, Generator or None
            None takes the relabeler's own.

        Yields
        ------
        rows, targets, episode : ndarray
            As from `sampler`.
        """
        ds = as_dataset(X)
        draw = self.fit(ds).sampler(ds)
        rng = generator(self.random_state if random_state is None else random_state)
        while True:
            yield draw(batch_size, rng)
