"""Transitions: one step of one episode, for one-step models."""

from collections.abc import Sequence
from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._history import (
    action_names,
    differences,
    past_actions,
    past_states,
    state_names,
)
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
    history : int, default=1
        States that a row shows, for plants whose state is logged in part: s_t, and the blocks
        `past_states` (s_t - s_{t-1}, ... of the `history` - 1 states before) and, with actions
        among the inputs, `past_actions` (a_{t-1}, ... between them). Before the start of an
        episode its first state is repeated, and actions are zero.
    pad : bool, default=True
        Whether the first steps of an episode, whose past is padded, are rows to learn from. A
        model then knows what to expect of an episode that has only begun, whatever its hidden
        state; but a learner that cannot tell such rows from others, such as a polynomial, mixes
        them up. Without, it is better where a forecast begins with a full window.
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

    _blocks = (
        *("state", "action", "params", "dt", "previous"),
        *("past_states", "past_actions", "context", "references"),
    )
    _required = ("state",)
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "inputs": [StrOptions({"action", "params"}), "array-like"],
        "history": [Interval(Integral, 1, None, closed="left")],
        "pad": ["boolean"],
        "max_rows": [Interval(Integral, 1, None, closed="left"), None],
        "random_state": ["random_state", np.random.Generator],
    }

    def __init__(
        self,
        *,
        inputs: str | Sequence[str] = "action",
        history: int = 1,
        pad: bool = True,
        max_rows: int | None = None,
        random_state: Any = None,
    ) -> None:
        self.inputs = inputs
        self.history = history
        self.pad = pad
        self.max_rows = max_rows
        self.random_state = random_state

    def _chosen(self, ds: TrajectoryDataset) -> tuple[str, ...]:
        past: tuple[str, ...] = ()
        if self.history > 1:
            past = ("past_states", "past_actions") if "action" in self.inputs else ("past_states",)
        if isinstance(self.inputs, str):
            extras = ("context",) if self.inputs == "action" else ("context", "references")
            own = (self.inputs, *(block for block in extras if has_block(ds, block)))
        else:
            own = tuple(block for block in self.inputs if block != "state")
        return ("state", *own, *(block for block in past if block not in own))

    def _columns(self, ds: TrajectoryDataset, block: str) -> tuple[str, ...]:
        if not block.startswith("past_"):
            return super()._columns(ds, block)
        if self.history == 1:
            raise ValueError(f"inputs={self.inputs!r}: {block!r} needs history= of 2 or more.")
        if block == "past_states":
            return state_names(ds.state_names, self.history)
        ds.require("actions", by=f"{type(self).__name__} (history={self.history})")
        return action_names(ds.action_names, self.history)

    def _values(
        self, ds: TrajectoryDataset, block: str, episode: Ints, begin: Ints, end: Ints
    ) -> Floats:
        if block == "past_states":
            return differences(past_states(ds, episode, begin, self.history))
        if block == "past_actions":
            return past_actions(ds, episode, begin, self.history).reshape(len(begin), -1)
        return super()._values(ds, block, episode, begin, end)

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
        if "previous" in self.layout_ and self.history > 1:
            raise ValueError(
                f'inputs={self.inputs!r}: "previous" is among the past actions that '
                f"history={self.history} shows already; leave it out."
            )
        self.dt_ = None if "dt" in self.layout_ else uniform_step(as_dataset(X))
        return self

    def begins(self, ds: TrajectoryDataset) -> Ints:
        """Rows of ``ds.states`` that a step to learn from begins at.

        Raises
        ------
        InvalidEpisodeError
            If no episode is as long as the window.
        """
        left_out = 0 if self.pad else self.history - 1
        taken = np.ones(len(ds.states), dtype=bool)
        taken[ds.offsets[1:] - 1] = False
        for ahead in range(left_out):
            taken[np.minimum(ds.offsets[:-1] + ahead, ds.offsets[1:] - 1)] = False
        if not taken.any():
            raise InvalidEpisodeError(
                f"no episode has the {self.history + 1} states that history={self.history} with "
                "pad=False takes: log longer ones, or use a shorter history, or pad=True."
            )
        return np.flatnonzero(taken)

    def _resample(
        self, ds: TrajectoryDataset, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Ints]:
        begin = self.begins(ds)
        if self.max_rows is not None and self.max_rows < len(begin):
            begin = np.sort(rng.choice(begin, size=self.max_rows, replace=False, shuffle=False))
        episode = np.searchsorted(ds.offsets, begin, side="right") - 1
        return self.rows(ds, episode, begin, begin + 1), ds.states.take(begin + 1, axis=0), episode
