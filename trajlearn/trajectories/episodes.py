"""Whole episodes: one row and one reward each, for direct reward models."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np

from trajlearn._sklearn import Interval
from trajlearn.trajectories._relabeler import Floats, Ints, Relabeler
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.rewards import episode_rewards

__all__ = ["EpisodeRelabeler"]


class EpisodeRelabeler(Relabeler):
    """Rows (s_0, theta) with target the mean reward per step, for direct reward models.

    Parameters
    ----------
    reward : callable or None, default=None
        ``reward(states)`` (it may also name `actions`, `references`, `times`); None takes the
        logged rewards.
    horizon : int or None, default=None
        Number of steps; None takes those of the longest episode.
    terminal_reward : float or None, default=None
        What each step after an early termination is worth; needed where lengths differ.
    inputs : sequence of str or None, default=None
        Blocks out of ``state, params, context``; None takes every block that the episodes have.
    random_state : int, RandomState, Generator or None, default=None
        Unused; every episode gives one row. Present for the common interface.

    Attributes
    ----------
    layout_ : mapping from block to slice
    horizon_ : int
        Steps that the reward is averaged over.
    sample_indices_ : ndarray of shape (n,)

    Examples
    --------
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays([[[0.0], [1.0], [3.0]]], params=[[5.0]])
    >>> EpisodeRelabeler(reward=lambda states: -states[..., 0]).fit_resample(ds)
    (array([[0., 5.]]), array([-2.]))
    """

    _blocks = ("state", "params", "context")
    _required = ()
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "reward": [callable, None],
        "horizon": [Interval(Integral, 1, None, closed="left"), None],
        "terminal_reward": [Interval(Real, None, None, closed="neither"), None],
        "inputs": ["array-like", None],
        "random_state": ["random_state", np.random.Generator],
    }

    def __init__(
        self,
        *,
        reward: Any = None,
        horizon: int | None = None,
        terminal_reward: float | None = None,
        inputs: Sequence[str] | None = None,
        random_state: Any = None,
    ) -> None:
        self.reward = reward
        self.horizon = horizon
        self.terminal_reward = terminal_reward
        self.inputs = inputs
        self.random_state = random_state

    def fit(self, X: Any, y: None = None) -> Self:
        """Learn the layout, the categories of the context, and the common horizon.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Ignored.

        Returns
        -------
        self
        """
        super().fit(X)
        self.horizon_ = int(as_dataset(X).lengths.max()) if self.horizon is None else self.horizon
        return self

    def _resample(
        self, ds: TrajectoryDataset, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Ints]:
        episode = np.arange(len(ds))
        first = ds.offsets[:-1]
        return self.rows(ds, episode, first, first), self.targets(ds), episode

    def targets(self, ds: TrajectoryDataset) -> Floats:
        """Mean reward per step of each episode over the horizon learned in `fit`.

        Parameters
        ----------
        ds : TrajectoryDataset

        Returns
        -------
        ndarray of shape (n,)
        """
        return episode_rewards(
            ds, self.reward, horizon=self.horizon_, terminal_reward=self.terminal_reward
        )
