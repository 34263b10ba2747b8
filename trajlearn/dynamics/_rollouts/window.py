"""The window of past states and actions that a roll-out carries along."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._query import Query
from trajlearn.trajectories._history import differences, past_actions, past_states

__all__ = ["Window"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Window:
    """What came before a state: `history` - 1 states and as many actions, newest first.

    In a roll-out it is one row for each state, (m, width): states, then actions.
    """

    history: int
    d_s: int
    d_a: int
    """0 where no actions are known."""

    def before(self, query: Query) -> Floats:
        """Rows at the starts of a query, as logged; padded before the first state."""
        episode = np.arange(len(query))
        states = past_states(query.ds, episode, query.rows, self.history)[:, 1:]
        actions = np.zeros((len(query), self.history - 1, self.d_a))
        if self.d_a and query.start.any():
            actions = past_actions(query.ds, episode, query.rows, self.history)
        return np.concatenate([states.reshape(len(query), -1), actions.reshape(len(query), -1)], 1)

    def after(self, rows: Floats, states: Floats, actions: Floats | None) -> Floats:
        """Rows one step on, when states (m, d_s) and actions (m, d_a) have become the past."""
        last, at = self.history - 2, (self.history - 1) * self.d_s
        parts = [states, rows[:, : last * self.d_s]]
        if self.d_a and actions is not None:
            parts += [actions, rows[:, at : at + last * self.d_a]]
        return np.concatenate(parts, axis=1)

    def blocks(self, rows: Floats, states: Floats) -> dict[str, Floats]:
        """Blocks of a learner's inputs: `past_states` and, where they are known, `past_actions`."""
        at = (self.history - 1) * self.d_s
        past = rows[:, :at].reshape(len(rows), -1, self.d_s)
        now = np.concatenate([states[:, None], past], axis=1)
        return {"past_states": differences(now), "past_actions": rows[:, at:]}
