"""A roll-out of a network in torch: rows of inputs that depend on the states before them.

Everything a row holds but states and what a policy makes of them is known before and comes from
the log. A policy is a function of numpy arrays; its slopes in the states are central differences.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajlearn.dynamics._rollouts.cloned_policy import ClonedPolicy
from trajlearn.dynamics._rollouts.rollout import checked_actions
from trajlearn.dynamics.propagation._steps import DIFFERENCE
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._history import past_actions, past_states

__all__ = ["Stretches", "Unrolled"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
# what follows rows of inputs (E, m, n_features): states (E, m, d_s)
StepOf = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Stretches:
    """Pieces of logged episodes: m for each of E members.

    Attributes
    ----------
    state : ndarray of shape (L, E * m)
        Rows of ``ds.states`` at which the steps begin; the last step of an episode is repeated.
    episode : ndarray of shape (E * m,)
    known : ndarray of shape (L, E * m)
        False for repeated steps.
    n_members : int
    """

    state: Ints
    episode: Ints
    known: NDArray[np.bool_]
    n_members: int

    @classmethod
    def of(cls, ds: TrajectoryDataset, begin: Ints, n_steps: int) -> "Stretches":
        """`n_steps` steps from the states (E, m), as far as there are some."""
        first = begin.ravel()
        episode = np.searchsorted(ds.offsets, first, side="right") - 1
        last = ds.offsets[1:][episode] - 2
        state = first + np.arange(n_steps)[:, None]
        return cls(np.minimum(state, last), episode, state <= last, len(begin))


class Unrolled:
    """Roll-outs of a fitted one-step model along logged episodes.

    Parameters
    ----------
    model : RollingEstimator
        Fitted.
    logged : TrajectoryDataset
    ds : TrajectoryDataset
        The same with the states that the model predicts, relative to its baseline if it has one.
    source : {"none", "logged", "policy"}
        Where actions come from.
    policy : callable or None
    device : torch device
    """

    def __init__(
        self,
        model: Any,
        logged: TrajectoryDataset,
        ds: TrajectoryDataset,
        source: str,
        policy: Any,
        device: torch.device,
    ) -> None:
        self._model, self._logged, self._ds = model, logged, ds
        self._policy: Any = policy if source == "policy" else None
        self._device = device
        self._layout = model.layout_
        self._history = model._history()
        width = np.ptp(model.rolled_range_, axis=0)
        self._reach = DIFFERENCE * np.where(width > 0, width, 1.0)
        clip = model._limits().clip
        self._clip = None if clip is None else [self._tensor(bound) for bound in clip]

    @property
    def magnitude(self) -> Floats:
        """Greatest size of each logged state (d_s,)."""
        largest: Floats = np.abs(self._logged.states).max(axis=0)
        return largest

    def targets(self, stretches: Stretches) -> Tensor:
        """Logged states after each step (L, E, m, d_s)."""
        return self._by_member(self._ds.states[stretches.state + 1], stretches)

    def paths(self, stretches: Stretches, step: StepOf) -> Iterator[tuple[Tensor, Tensor]]:
        """Rows (E, m, n_features) of one step after another, and the states that follow them."""
        logged = self._logged_rows(stretches)
        states = logged[0][..., self._layout["state"]]
        past, actions = self._past(stretches)
        first = stretches.state[0] == self._ds.offsets[stretches.episode]
        begins = self._tensor(first).view(stretches.n_members, -1, 1)
        previous = None
        for k, row in enumerate(logged):
            blocks = {name: row[..., columns] for name, columns in self._layout.items()}
            blocks["state"] = states
            if past:
                window = torch.stack([states, *past], dim=-2)
                blocks["past_states"] = (window[..., :-1, :] - window[..., 1:, :]).flatten(-2)
            if self._policy is not None:
                if actions:
                    blocks["past_actions"] = torch.cat(actions, dim=-1)
                now = blocks["action"] = self._actions(states, stretches, k)
                if "previous" in blocks:
                    # before the first step of an episode its own action stands for one
                    logged_before = torch.where(begins, now, blocks["previous"])
                    blocks["previous"] = logged_before if previous is None else previous
                previous, actions = now, [now, *actions][: len(actions)]
            rows = torch.cat([blocks[name] for name in self._layout], dim=-1)
            after = step(rows)
            if self._clip is not None:
                after = torch.minimum(torch.maximum(after, self._clip[0]), self._clip[1])
            yield rows, after
            past = [states, *past][: len(past)]
            states = after

    def _logged_rows(self, stretches: Stretches) -> Tensor:
        """Rows (L, E, m, n_features) of all steps as they were logged."""
        begin = stretches.state.ravel()
        episode = np.tile(stretches.episode, len(stretches.state))
        rows = self._model.relabeler_.rows(self._ds, episode, begin, begin + 1)
        return self._by_member(rows.reshape(*stretches.state.shape, -1), stretches)

    def _past(self, stretches: Stretches) -> tuple[list[Tensor], list[Tensor]]:
        """States and actions before the start, newest first, that a row shows."""
        if self._history == 1:
            return [], []
        where = stretches.episode, stretches.state[0], self._history
        states = np.moveaxis(past_states(self._ds, *where)[:, 1:], 1, 0)
        actions: list[Tensor] = []
        if "past_actions" in self._layout:
            taken = np.moveaxis(past_actions(self._ds, *where), 1, 0)
            actions = list(self._by_member(taken, stretches))
        return list(self._by_member(states, stretches)), actions

    # -- the policy -----------------------------------------------------------------------

    def _actions(self, states: Tensor, stretches: Stretches, k: int) -> Tensor:
        """What the policy does in states (E, m, d_s), relative to the baseline, at a step."""
        act = self._cloned if isinstance(self._policy, ClonedPolicy) else self._given
        at = stretches.state[k]
        base = self._logged.states[at] - self._ds.states[at]

        def values(states: Floats) -> Floats:
            n_copies = len(states) // len(at)
            whole = states + np.tile(base, (n_copies, 1))
            actions = act(whole, at, stretches.episode, n_copies)
            return checked_actions(actions, self._layout["action"], states)

        found: Tensor = _Policy.apply(states, values, self._reach)
        return found

    def _given(self, states: Floats, at: Ints, episode: Ints, n_copies: int) -> Any:
        theta = _theta(self._logged, at, episode)
        times = self._logged.times[at]
        return self._policy(states, np.tile(theta, (n_copies, 1)), np.tile(times, n_copies))

    def _cloned(self, states: Floats, at: Ints, episode: Ints, n_copies: int) -> Floats:
        clone = self._policy
        rows = np.tile(clone.relabeler.rows(self._logged, episode, at, at + 1), (n_copies, 1))
        blocks = {name: rows[:, columns] for name, columns in clone.relabeler.layout_.items()}
        found: Floats = clone.act(blocks | {"state": states})
        return found

    # -- tensors --------------------------------------------------------------------------

    def _by_member(self, values: Floats, stretches: Stretches) -> Tensor:
        """(L, E * m, width) as (L, E, m, width)."""
        shape = (len(values), stretches.n_members, -1, values.shape[-1])
        return self._tensor(values.reshape(shape))

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), device=self._device)


def _theta(ds: TrajectoryDataset, at: Ints, episode: Ints) -> Floats:
    """Theta in force (m, p) at rows of states."""
    if not ds.params_vary:
        return ds.params_at(0)[episode]
    assert ds.step_params is not None  # it varies
    return ds.step_params[at - episode]


class _Policy(torch.autograd.Function):
    """Actions (E, m, d_a) of a policy in states (E, m, d_s)."""

    @staticmethod
    def forward(ctx: Any, states: Tensor, values: Callable[[Floats], Floats], reach: Floats) -> Any:
        flat = states.detach().cpu().numpy().reshape(-1, len(reach))
        moved = flat[None]
        if ctx.needs_input_grad[0]:
            offsets = np.diag(reach)[:, None]
            moved = np.concatenate([moved, flat + offsets, flat - offsets])
        actions = values(moved.reshape(-1, len(reach))).reshape(*moved.shape[:2], -1)
        if ctx.needs_input_grad[0]:
            ahead, behind = np.split(actions[1:], 2)
            slopes = (ahead - behind) / (2 * reach[:, None, None])
            # (d_s, E * m, d_a) -> (E, m, d_s, d_a)
            by_row = torch.as_tensor(np.moveaxis(slopes, 0, 1), device=states.device)
            ctx.save_for_backward(by_row.unflatten(0, states.shape[:2]))
        return torch.tensor(actions[0], device=states.device).unflatten(0, states.shape[:2])

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        (slopes,) = ctx.saved_tensors
        return (slopes @ grads[0][..., None])[..., 0], None, None
