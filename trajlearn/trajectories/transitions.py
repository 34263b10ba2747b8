"""Transitions: one step of one episode, for one-step models."""

from collections.abc import Sequence
from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.trajectories._relabeler import Floats, Ints, Relabeler, has_block
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.times import uniform_step

__all__ = ["TransitionRelabeler"]


class TransitionRelabeler(Relabeler):
    """Rows (s_t, a_t) or (s_t, theta) with target s_{t+1}, for one-step models.

    ``actions[t]`` takes s_t to s_{t+1}: a linear system is identified exactly from these rows.

    Parameters
    ----------
    inputs : {"action", "params"} or sequence of str, default="action"
        "action": state, action, and the context where there is one. "params": state, params,
        and context and references where there are some. A sequence chooses exactly out of
        ``state, action, params, dt, previous, context, references``; ``state`` is always in. `dt`
        is the time step, needed where sampling is mixed; `previous` the action before, a_{t-1}
        (a_0 itself at the first step), for plants with actuator lag; `references` holds the
        values at t and t + 1.
    max_rows : int or None, default=None
        Rows to draw without repeats; None takes every step.
    random_state : int, RandomState, Generator or None, default=None

    Attributes
    ----------
    layout_ : mapping from block to slice
    sample_indices_ : ndarray of shape (n_rows,)
        Episode of each row.
    dt_ : float or None
        The common time step, None where `dt` is an input.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays([[[0.0], [1.0], [3.0]]], actions=[[[1.0], [2.0]]])
    >>> rows, targets = TransitionRelabeler().fit_resample(ds)
    >>> np.column_stack([rows, targets])  # s_t, a_t, s_{t+1}
    array([[0., 1., 1.],
           [1., 2., 3.]])
    """

    _blocks = ("state", "action", "params", "dt", "previous", "context", "references")
    _required = ("state",)
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "inputs": [StrOptions({"action", "params"}), "array-like"],
        "max_rows": [Interval(Integral, 1, None, closed="left"), None],
        "random_state": ["random_state", np.random.Generator],
    }

    def __init__(
        self,
        *,
        inputs: str | Sequence[str] = "action",
        max_rows: int | None = None,
        random_state: Any = None,
    ) -> None:
        self.inputs = inputs
        self.max_rows = max_rows
        self.random_state = random_state

    def _chosen(self, ds: TrajectoryDataset) -> tuple[str, ...]:
        if isinstance(self.inputs, str):
            extras = ("context",) if self.inputs == "action" else ("context", "references")
            return ("state", self.inputs, *(block for block in extras if has_block(ds, block)))
        return ("state", *(block for block in self.inputs if block != "state"))

    def fit(self, X: Any, y: None = None) -> Self:
        """Learn the layout, the categories of the context, and the common time step.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Ignored.

        Returns
        -------
        self

        Raises
        ------
        MixedSamplingError
            If the time step varies and is not an input.
        """
        super().fit(X)
        if "previous" in self.layout_ and "action" not in self.layout_:
            raise ValueError(
                f'inputs={self.inputs!r}: "previous" is the action before, which a roll-out knows '
                'only where "action" is an input, too.'
            )
        self.dt_ = None if "dt" in self.layout_ else uniform_step(as_dataset(X))
        return self

    def _resample(
        self, ds: TrajectoryDataset, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Ints]:
        last = np.zeros(len(ds.states), dtype=bool)
        last[ds.offsets[1:] - 1] = True
        begin = np.flatnonzero(~last)
        if self.max_rows is not None and self.max_rows < len(begin):
            begin = np.sort(rng.choice(begin, size=self.max_rows, replace=False, shuffle=False))
        episode = np.searchsorted(ds.offsets, begin, side="right") - 1
        return self.rows(ds, episode, begin, begin + 1), ds.states.take(begin + 1, axis=0), episode
