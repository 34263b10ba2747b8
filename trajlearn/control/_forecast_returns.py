"""Returns of a batch of candidates, from predicted trajectories or from a model of the reward."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._common_numbers import CommonNumbers
from trajlearn.control._futures import Situation, ask_forecast, ask_reward, draws_from_generators
from trajlearn.control._returns import Returns, States, flags
from trajlearn.dynamics.forecast import Forecast

__all__ = ["Moments", "RewardModel", "Trajectories"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Moments:
    """What is predicted of n candidates, each an average over the initial states.

    Attributes
    ----------
    reward : ndarray of shape (n,)
        Return of the mean trajectories, or mean return, as was asked for.
    expected, std : ndarray of shape (n,) or None
        Mean return and its standard deviation, where anything says how unsure it is.
    violation : ndarray of shape (n,) or None
        Share of the sampled trajectories that break the constraint.
    """

    reward: Floats
    expected: Floats | None = None
    std: Floats | None = None
    violation: Floats | None = None


@dataclass(frozen=True)
class Trajectories:
    """Returns by way of the states: of the mean trajectories, of sampled ones, or both.

    Attributes
    ----------
    model : estimator
    situation : Situation
    returns : Returns
    constraint : callable or None
    of_mean : bool
        Whether the reward is that of the mean trajectories.
    n_samples : int or None
        Trajectories sampled of each candidate and initial state.
    seed : int
        Of the samples, the same for all candidates.
    """

    model: Any
    situation: Situation
    returns: Returns
    constraint: States | None
    of_mean: bool
    n_samples: int | None
    seed: int

    def __call__(self, candidates: Floats) -> Moments:
        """Assess candidates (n, p), or (n, horizon, d_a)."""
        forecast = self._forecast(candidates)
        mean = None
        shape = len(candidates), len(self.situation.initial_states)
        if self.of_mean:
            returns, _ = self._judged(forecast.mean, _diverged(forecast), candidates)
            mean = returns.reshape(shape).mean(axis=1)
        if self.n_samples is None:
            assert mean is not None  # else samples are asked for
            return Moments(mean)
        samples = forecast.samples
        assert samples is not None  # asked for
        gone: Flags = np.asarray(~np.isfinite(samples).all(axis=-1))
        returns, broken = self._judged(samples, gone if gone.any() else None, candidates)
        by_sample = (self.n_samples, *shape)
        # contiguous, so that numpy adds in the same order for one candidate as for many
        drawn = np.ascontiguousarray(returns.reshape(by_sample).mean(axis=2).T)
        with np.errstate(invalid="ignore"):
            std = drawn.std(axis=1)
        std[np.isinf(drawn).any(axis=1)] = np.inf
        expected = drawn.mean(axis=1)
        share = None if broken is None else broken.reshape(by_sample).mean(axis=(0, 2))
        return Moments(expected if mean is None else mean, expected, std, share)

    def _forecast(self, candidates: Floats) -> Forecast:
        random_state: Any = self.seed
        if self.n_samples and draws_from_generators(self.model):
            n_starts = len(self.situation.initial_states)
            random_state = CommonNumbers(
                self.seed, self.n_samples, len(candidates) * n_starts, n_starts
            )
        return ask_forecast(
            self.model,
            self.situation,
            candidates,
            n_samples=self.n_samples,
            random_state=random_state,
        )

    def _judged(
        self, states: Floats, gone: Flags | None, candidates: Floats
    ) -> tuple[Floats, Flags | None]:
        """Returns (..., n) of trajectories (..., n, k, d_s), and which break the constraint."""
        states, count, ended = self.returns.lived(states, gone)
        returns = self.returns.of(states, count, candidates)
        if self.constraint is None or states.ndim == 3:
            return returns, None
        allowed = flags(self.constraint, states, "constraint")
        lived = np.arange(states.shape[-2]) < count[..., None]
        broken: Flags = np.asarray((~allowed & lived).any(axis=-1))
        if gone is not None:
            broken |= gone.any(axis=-1) & ~ended
        return returns, broken


@dataclass(frozen=True)
class RewardModel:
    """Returns by a direct model of the mean reward per step.

    Attributes
    ----------
    model : estimator
    situation : Situation
    horizon : int
    return_std : bool
    """

    model: Any
    situation: Situation
    horizon: int
    return_std: bool

    def __call__(self, candidates: Floats) -> Moments:
        """Assess candidates (n, p)."""
        mean, std = ask_reward(self.model, self.situation, candidates, return_std=self.return_std)
        shape = len(candidates), len(self.situation.initial_states)
        reward = self.horizon * mean.reshape(shape).mean(axis=1)
        if std is None:
            return Moments(reward)
        # errors of one model at several initial states go together
        return Moments(reward, reward, self.horizon * std.reshape(shape).mean(axis=1))


def _diverged(forecast: Forecast) -> Flags | None:
    """Where mean trajectories (n, k) are unknown; None if nowhere."""
    first = forecast.diverged_at[:, None]
    if not first.any():
        return None
    return (first > 0) & (np.arange(1, forecast.mean.shape[1] + 1) >= first)
