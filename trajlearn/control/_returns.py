"""Sums of rewards along predicted trajectories, some of which end before the horizon."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._signals import Signals
from trajlearn.trajectories.rewards import Reward, step_rewards

__all__ = ["Quadrature", "Returns", "States", "flags"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
# a question to each of the states (..., d_s)
States = Callable[[Floats], Flags]


@dataclass(frozen=True)
class Quadrature:
    """Sum over all steps of rewards that are known at some, linear in between.

    Attributes
    ----------
    steps : ndarray of shape (k,)
        The steps at which states are predicted, increasing; the last is the horizon.
    weights : ndarray of shape (k,)
        Of the reward at each.
    until : ndarray of shape (k,)
        The same of a sum that ends there: the steps since the one before.
    start_weight : float
        Of the reward of the initial state.
    """

    steps: NDArray[np.intp]
    weights: Floats
    until: Floats
    start_weight: float

    @classmethod
    def of(cls, horizon: int, every: int, headless: bool = False) -> "Quadrature":
        """Each `every`-th step and the last.

        Without a reward of the initial state (`headless`), the first that is known stands for
        all steps before.
        """
        steps = np.unique(np.append(np.arange(every, horizon + 1, every), horizon))
        gaps = np.diff(steps, prepend=0)
        # of a straight line over a gap of g steps, (g + 1) / 2 belongs to its end
        until, after = (gaps + 1) / 2, np.append((gaps[1:] - 1) / 2, 0.0)
        before = (gaps[0] - 1) / 2
        if headless:
            until[0] += before
        return cls(steps, until + after, until, 0.0 if headless else float(before))

    def earned(self, count: NDArray[np.intp]) -> Floats:
        """Weights (..., k) of trajectories that earn at the first `count` (...) horizons only."""
        at, last = np.arange(len(self.weights)), count[..., None] - 1
        whole = last == at[-1]
        ends = np.where(at == last, self.until, 0.0)
        return np.where(whole | (at < last), self.weights, ends)


@dataclass(frozen=True)
class Returns:
    """Return of predicted trajectories: the sum of their rewards, with what an early end costs.

    Attributes
    ----------
    reward : callable
    quadrature : Quadrature
    initial_states : ndarray of shape (n0, d_s)
    start_part : ndarray of shape (n0,)
        What the reward of each initial state adds.
    signals : Signals
        What a reward may name.
    is_terminal : callable or None
    terminal_reward : float
        Of each step after the end.
    """

    reward: Reward
    quadrature: Quadrature
    initial_states: Floats
    start_part: Floats
    signals: Signals
    is_terminal: States | None
    terminal_reward: float

    def lived(self, states: Floats, gone: Flags | None) -> tuple[Floats, NDArray[np.intp], Flags]:
        """States, how many horizons a trajectory earns at, and whether the last is an end.

        Parameters
        ----------
        states : ndarray of shape (..., n, k, d_s)
            Row i * n0 + j from start j.
        gone : ndarray of shape (..., n, k) or None
            Where states are unknown, because the forecast diverged.

        Returns
        -------
        states : ndarray of shape (..., n, k, d_s)
            With states that are possible where a trajectory is unknown, or over.
        count : ndarray of shape (..., n)
        ended : ndarray of shape (..., n)
        """
        n_rows, n_horizons = states.shape[-3:-1]
        n_candidates = n_rows // len(self.initial_states)
        start = np.tile(self.initial_states, (n_candidates, 1))[:, None]
        if gone is not None:
            states = np.where(gone[..., None], start, states)
        count, ended = self._counted(states, gone)
        if (count < n_horizons).any():
            counts = np.arange(n_horizons) < count[..., None]
            states = np.where(counts[..., None], states, start)
        return states, count, ended

    def _counted(self, states: Floats, gone: Flags | None) -> tuple[NDArray[np.intp], Flags]:
        n_horizons = states.shape[-2]
        count = np.full(states.shape[:-2], n_horizons)
        ended = np.zeros(states.shape[:-2], dtype=bool)
        if gone is not None:
            count = np.where(gone.any(axis=-1), gone.argmax(axis=-1), count)
        if self.is_terminal is not None:
            terminal = flags(self.is_terminal, states, "is_terminal")
            if terminal.any():
                first = terminal.argmax(axis=-1) + 1
                ended = terminal.any(axis=-1) & (first <= count)
                count = np.where(ended, first, count)
        return count, ended

    def of(self, states: Floats, count: NDArray[np.intp], candidates: Floats) -> Floats:
        """Returns (..., n) of trajectories that `lived`, row i * n0 + j of candidate i."""
        values = step_rewards(self.reward, states, **self.signals.of(states, candidates))
        sums = self._sums(values, count)
        if not self.quadrature.start_weight:
            return sums
        start = np.tile(self.start_part, sums.shape[-1] // len(self.start_part))
        # one that ends before the first horizon earns nothing on the way there
        return np.where(count > 0, sums + start, sums)

    def _sums(self, values: Floats, count: NDArray[np.intp]) -> Floats:
        rule = self.quadrature
        early = count < values.shape[-1]
        with np.errstate(invalid="ignore"):
            # row by row in one order, so that a candidate has the same bits in any batch
            sums: Floats = np.ascontiguousarray(values * rule.weights).sum(axis=-1)
        if not early.any():
            return sums
        few, last, weights = values[early], count[early] - 1, rule.earned(count[early])
        # a reward after the end may be infinite
        earned = np.where(weights > 0, few, 0.0)
        steps = np.where(last >= 0, rule.steps[last], 0)
        missing = rule.steps[-1] - steps
        sums[early] = (earned * weights).sum(axis=-1) + missing * self.terminal_reward
        return sums


def flags(ask: States, states: Floats, name: str) -> Flags:
    """Answers (...) of a user's function about states (..., d_s).

    Raises
    ------
    ValueError
        If it does not give one truth value a state.
    """
    try:
        answers = np.asarray(ask(states))
    except IndexError as error:
        raise ValueError(
            f"{name} cannot index states of shape {states.shape} ({error}): states stand on the "
            "last axis, so write states[..., 0] for the first."
        ) from error
    if answers.shape != states.shape[:-1] or answers.dtype != bool:
        raise ValueError(
            f"{name} returned {answers.dtype} of shape {answers.shape} for states of shape "
            f"{states.shape}; expected bool of shape {states.shape[:-1]} (one a state)."
        )
    return answers
