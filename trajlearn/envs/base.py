"""What all simulated systems share: seeded episodes, given flights, checks."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from numbers import Integral
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.random import Generator, RandomState
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state

from trajlearn.envs._flight import Episode, Simulator, fly, fly_parallel
from trajlearn.policies import Policy
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["Environment"]


class _Streams(NamedTuple):
    """The random streams of one episode; separate, so that one never shifts the other."""

    state: Generator
    params: Generator
    noise: Generator

    def fresh_noise(self) -> Generator:
        """The noise of the next flight, whatever the flights before have used up."""
        return self.noise.spawn(1)[0]


class Environment(ABC):
    """Base class of the simulated systems.

    A system states its names, its time step, its bounds and its default controller, and
    implements the single-step functions below on batches; collecting data and flying given
    gains are inherited. Episode i of ``collect`` depends on the random state and on i only,
    not on the number of episodes or on what happens in the others.

    Attributes
    ----------
    state_names, action_names, param_names : tuple of str
        Names of the d_s states, the d_a actions and the p control parameters.
    dt : float
        Time between two states, in seconds.
    redraw_terminated : bool
        Whether ``collect`` replaces the episodes that ended early.
    max_draws : int
        How often one episode is drawn at most when ``redraw_terminated`` is on.
    """

    state_names: ClassVar[tuple[str, ...]]
    action_names: ClassVar[tuple[str, ...]]
    param_names: ClassVar[tuple[str, ...]]
    max_draws: ClassVar[int] = 1000
    dt: float
    redraw_terminated: bool

    @property
    @abstractmethod
    def policy(self) -> Policy:
        """The controller that flies the episodes of ``collect``."""

    @property
    @abstractmethod
    def action_bounds(self) -> NDArray[np.float64]:
        """Lowest and highest action the plant takes, shape (d_a, 2); others are clipped."""

    @property
    @abstractmethod
    def param_bounds(self) -> NDArray[np.float64]:
        """Range that the control parameters are drawn from, shape (p, 2), lower first."""

    @abstractmethod
    def reward(self, states: ArrayLike) -> NDArray[np.float64]:
        """Reward of stepping into ``states`` (..., d_s), shape (...)."""

    @abstractmethod
    def _draw_initial_state(self, generator: Generator) -> NDArray[np.float64]:
        """Draw one reset state, shape (d_s,)."""

    @abstractmethod
    def _draw_params(self, generator: Generator) -> NDArray[np.float64]:
        """Draw the control parameters of one episode, shape (p,)."""

    @abstractmethod
    def _step(
        self, states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Advance checked states (n, d_s) by one step under clipped actions (n, d_a)."""

    def _simulator(self, starts: NDArray[np.float64]) -> Simulator:
        """Start episodes from ``starts`` and return what advances them.

        ``advance(rows, states, actions)`` gives the next states of the episodes ``rows``, which
        are in ``states`` now; it may raise ``SimulationError``. A system whose simulator knows
        more than the state (an angle beyond a turn, a solver's warm start) keeps it there.
        """
        return lambda rows, states, actions: self._step(states, actions)

    def _disturbed(
        self, states: NDArray[np.float64], generators: Sequence[Generator]
    ) -> NDArray[np.float64]:
        """Add the process noise of one step, row i from the generator of its episode."""
        return states

    def is_terminal(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Whether an episode ends on stepping into ``states`` (..., d_s), shape (...)."""
        return np.zeros(self._checked_states(states).shape[:-1], dtype=bool)

    def step(self, states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]:
        """Advance a batch of states by one time step.

        Parameters
        ----------
        states : array-like of shape (n, d_s)
            Where the systems are.
        actions : array-like of shape (n, d_a)
            What the controllers ask for; clipped to ``action_bounds``.

        Returns
        -------
        ndarray of shape (n, d_s)
            The states ``dt`` later, without process noise.

        Raises
        ------
        ValueError
            If a shape is wrong, the actions are not finite, or the simulation goes wrong.
        """
        s = self._checked_batch(states, "states")
        return self._step(s, self._clipped(actions, len(s), "actions"))

    def reset(
        self, n_episodes: int, random_state: int | RandomState | None = None
    ) -> NDArray[np.float64]:
        """Draw the initial states that ``collect`` would draw first.

        Parameters
        ----------
        n_episodes : int
            How many, at least 1.
        random_state : int, RandomState instance or None, default=None
            Seed; an integer gives the same bits at every call.

        Returns
        -------
        ndarray of shape (n_episodes, d_s)
            One initial state an episode.
        """
        streams = self._episode_streams(n_episodes, random_state)
        return np.stack([self._draw_initial_state(stream.state) for stream in streams])

    def sample_params(
        self, n_episodes: int, random_state: int | RandomState | None = None
    ) -> NDArray[np.float64]:
        """Draw the control parameters that ``collect`` would draw first.

        Parameters
        ----------
        n_episodes : int
            How many, at least 1.
        random_state : int, RandomState instance or None, default=None
            Seed; an integer gives the same bits at every call.

        Returns
        -------
        ndarray of shape (n_episodes, p)
            One parameter vector an episode.
        """
        streams = self._episode_streams(n_episodes, random_state)
        return np.stack([self._draw_params(stream.params) for stream in streams])

    def collect(
        self,
        n_episodes: int,
        length: int,
        random_state: int | RandomState | None = None,
        *,
        n_jobs: int | None = None,
    ) -> TrajectoryDataset:
        """Fly episodes from random initial states under random control parameters.

        Parameters
        ----------
        n_episodes : int
            Number of episodes, at least 1.
        length : int
            Number of steps T of an episode that does not end early, at least 1.
        random_state : int, RandomState instance or None, default=None
            Seed. Every episode has a seed of its own derived from it: the first episodes of
            a larger collection are those of a smaller one. Training and test data need
            different seeds.
        n_jobs : int or None, default=None
            Number of joblib workers that share the episodes; -1 takes all processors, None one
            unless in a ``joblib.parallel_config``. The episodes are the same with any number.

        Returns
        -------
        TrajectoryDataset
            ``states`` (T + 1, d_s) with the reset state first, ``actions`` (T, d_a) as
            applied, ``rewards`` (T,) where r_t is the reward of stepping into s_{t+1},
            ``params`` (p,). An episode that ends early is kept with its own length, its last
            state the one that ended it, and ``terminated`` is True; unless
            ``redraw_terminated`` is set, which replaces it by a new draw.

        Raises
        ------
        ValueError
            If ``n_episodes`` or ``length`` is not a positive integer, if an episode still ends
            early after ``max_draws`` draws, or if the simulation of one goes wrong.

        Notes
        -----
        Redrawing until an episode survives is what the paper does. It is survivorship bias:
        the data hold only the pairs of initial state and gains that worked, so a model fitted
        on them knows nothing of failing and is scored on no failure.
        """
        length = _positive_integer(length, "length")
        streams = self._episode_streams(n_episodes, random_state)
        policy = self.policy
        kept: dict[int, Episode] = {}
        pending = list(range(len(streams)))
        for _ in range(self.max_draws):
            starts = np.stack([self._draw_initial_state(streams[i].state) for i in pending])
            params = np.stack([self._draw_params(streams[i].params) for i in pending])
            noise = [streams[i].fresh_noise() for i in pending]
            episodes = fly_parallel(self, starts, params, length, policy, pending, noise, n_jobs)
            for i, episode in zip(pending, episodes, strict=True):
                if not (self.redraw_terminated and episode.terminated):
                    kept[i] = episode
            pending = [i for i in pending if i not in kept]
            if not pending:
                return self._dataset([kept[i] for i in range(len(streams))])
        raise ValueError(
            f"{len(pending)} of {len(streams)} episodes (the first is episode {pending[0]}) ended "
            f"before length={length} in each of {self.max_draws} draws of {self!r}. Ask for "
            "shorter episodes or keep those that end early with redraw_terminated=False."
        )

    def rollout(
        self,
        initial_states: ArrayLike,
        params: ArrayLike | None,
        length: int,
        policy: Policy | None = None,
        *,
        random_state: int | RandomState | None = None,
    ) -> TrajectoryDataset:
        """Fly given control parameters from given initial states.

        Parameters
        ----------
        initial_states : array-like of shape (n, d_s)
            Where the episodes start.
        params : array-like of shape (n, p) or (p,), or None
            Control parameters of each episode, or of all; None for a ``policy`` without any.
        length : int
            Number of steps T of an episode that does not end early, at least 1.
        policy : callable or None, default=None
            ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``; None
            takes the system's own. With another policy, p may be any number.
        random_state : int, RandomState instance or None, default=None
            Seed of the process noise of systems that have any; with the seed of a ``collect``,
            the noise of its first draws.

        Returns
        -------
        TrajectoryDataset
            As from ``collect``; nothing is redrawn.

        Raises
        ------
        ValueError
            If a shape is wrong, a number is not finite, ``params`` is None without a
            ``policy``, the policy answers with actions of a wrong shape or not finite, or the
            simulation of an episode goes wrong.

        Notes
        -----
        Only states that a step leads into can end an episode. One that starts beyond the
        limits of ``is_terminal`` thus has one step, unless this step leads back.
        """
        starts = self._checked_batch(initial_states, "initial_states")
        _require_finite(starts, "initial_states")
        if params is None:
            if policy is None:
                raise ValueError(
                    "params is None, but the system's own policy needs them: pass an array of "
                    f"shape ({len(starts)}, {len(self.param_names)}) or another policy."
                )
            theta = np.empty((len(starts), 0))
            supplied = theta.shape
        else:
            theta = np.asarray(params, dtype=np.float64)
            supplied = theta.shape
            if theta.ndim == 1:
                theta = np.broadcast_to(theta, (len(starts), len(theta)))
        width = len(self.param_names) if policy is None else theta.shape[-1]
        if theta.shape != (len(starts), width):
            expected = f"({len(starts)}, {'p' if policy is not None else width})"
            raise ValueError(
                f"params must have shape {expected}, one row an initial state, or be one such row "
                f"for all; got {supplied}."
            )
        _require_finite(theta, "params")
        length = _positive_integer(length, "length")
        streams = self._episode_streams(len(starts), random_state)
        noise = [stream.fresh_noise() for stream in streams]
        numbers = range(len(starts))
        return self._dataset(
            fly(self, starts, theta, length, policy or self.policy, numbers, noise)
        )

    def _dataset(self, episodes: list[Episode]) -> TrajectoryDataset:
        params = np.stack([episode.params for episode in episodes])
        own = params.shape[1] == len(self.param_names)
        return TrajectoryDataset.from_arrays(
            [episode.states for episode in episodes],
            actions=[episode.actions for episode in episodes],
            rewards=[self.reward(episode.states[1:]) for episode in episodes],
            params=params,
            terminated=np.array([episode.terminated for episode in episodes]),
            dt=self.dt,
            state_names=self.state_names,
            action_names=self.action_names,
            param_names=self.param_names if own else None,
        )

    def _episode_streams(
        self, n_episodes: int, random_state: int | RandomState | None
    ) -> list[_Streams]:
        n_episodes = _positive_integer(n_episodes, "n_episodes")
        entropy = check_random_state(random_state).randint(2**32, size=4, dtype=np.uint32)
        seeds = np.random.SeedSequence(entropy.tolist()).spawn(n_episodes)
        return [_Streams(*map(np.random.default_rng, seed.spawn(3))) for seed in seeds]

    def _checked_states(self, states: ArrayLike) -> NDArray[np.float64]:
        s = np.asarray(states, dtype=np.float64)
        if s.ndim == 0 or s.shape[-1] != len(self.state_names):
            raise ValueError(
                f"states must have shape (..., {len(self.state_names)}) "
                f"({', '.join(self.state_names)}); got {s.shape}."
            )
        return s

    def _checked_batch(self, states: ArrayLike, name: str) -> NDArray[np.float64]:
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] != len(self.state_names) or not len(s):
            raise ValueError(
                f"{name} must have shape (n, {len(self.state_names)}) "
                f"({', '.join(self.state_names)}) with n >= 1; got {s.shape}."
            )
        return s

    def _clipped(self, actions: ArrayLike, n: int, name: str) -> NDArray[np.float64]:
        a = np.asarray(actions, dtype=np.float64)
        if a.shape != (n, len(self.action_names)):
            raise ValueError(
                f"{name} must have shape ({n}, {len(self.action_names)}), one row a state; "
                f"got {a.shape}."
            )
        _require_finite(a, name)
        low, high = self.action_bounds.T
        return np.clip(a, low, high)


def _positive_integer(value: object, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1; got {value!r}.")
    return int(value)


def _require_finite(array: NDArray[np.float64], name: str) -> None:
    bad = ~np.isfinite(array)
    if bad.any():
        row = int(np.argwhere(bad)[0, 0])
        raise ValueError(f"{name} must be finite; row {row} holds NaN or infinity.")
