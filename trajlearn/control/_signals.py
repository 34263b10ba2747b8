"""What a reward may name beside the states: actions, references and times of planned steps."""

import inspect
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._futures import Situation
from trajlearn.trajectories.rewards import Reward

__all__ = ["Signals", "named_by"]

Floats = NDArray[np.float64]


def named_by(reward: Reward) -> frozenset[str]:
    """Which signals a reward names."""
    names = set(inspect.signature(reward).parameters)
    return frozenset(names & {"actions", "references", "times"})


@dataclass(frozen=True)
class Signals:
    """Signals of the steps that lead into predicted states.

    Attributes
    ----------
    names : set of str
        Those that are needed.
    situation : Situation
        Its policy counts time from the start.
    steps : ndarray of shape (k,)
        The step that leads into each state.
    start_time : float
    planned : bool
        Whether candidates are sequences of actions; else actions come from the policy.
    """

    names: frozenset[str]
    situation: Situation
    steps: NDArray[np.intp]
    start_time: float
    planned: bool

    def of(self, states: Floats, candidates: Floats) -> dict[str, Any]:
        """Signals (..., n, k, width) of states (..., n, k, d_s), row i * n0 + j of candidate i."""
        found: dict[str, Any] = {}
        shape = states.shape[:-1]
        if "times" in self.names:
            found["times"] = np.broadcast_to(self.start_time + self.situation.horizons, shape)
        if "references" in self.names and self.situation.references is not None:
            references = self.situation.references(self.situation.horizons)
            found["references"] = np.broadcast_to(references, (*shape, references.shape[-1]))
        if "actions" in self.names:
            taken = self._planned if self.planned else self._by_policy
            found["actions"] = taken(states, self.situation.repeated(candidates))
        return found

    def _planned(self, states: Floats, sequences: Floats) -> Floats:
        taken = sequences[:, self.steps - 1]
        return np.broadcast_to(taken, (*states.shape[:-1], taken.shape[-1]))

    def _by_policy(self, states: Floats, params: Floats) -> Floats | None:
        """Actions of the policy in the states before."""
        if self.situation.policy is None:
            return None
        shape = states.shape[:-1]
        start = self.situation.starts(states.shape[-3] // len(self.situation.initial_states))
        first = np.broadcast_to(start[:, None], (*shape[:-1], 1, states.shape[-1]))
        before = np.concatenate([first, states[..., :-1, :]], axis=-2)
        theta = np.broadcast_to(params[:, None], (*shape, params.shape[-1]))
        times = np.broadcast_to(np.append(0.0, self.situation.horizons[:-1]), shape)
        actions = self.situation.policy(
            before.reshape(-1, before.shape[-1]), theta.reshape(-1, theta.shape[-1]), times.ravel()
        )
        return np.asarray(actions, dtype=np.float64).reshape(*shape, -1)
