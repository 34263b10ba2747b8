"""Episodes from elsewhere: any Gymnasium environment, any Minari data set."""

from collections.abc import Callable, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state, check_scalar

from trajlearn.trajectories._extras import import_extra
from trajlearn.trajectories.dataset import TrajectoryDataset

if TYPE_CHECKING:
    import gymnasium
    import minari

__all__ = ["from_gymnasium", "from_minari"]

Floats = NDArray[np.float64]


class Policy(Protocol):
    """Vectorised policy: ``(n, d_s), (n, p), (n,) -> (n, d_a)``."""

    def __call__(self, states: Floats, params: Floats, times: Floats, /) -> ArrayLike: ...


def from_gymnasium(
    env: "str | gymnasium.Env | Callable[[], gymnasium.Env]",
    policy: Policy | Literal["random"],
    *,
    n_episodes: int,
    max_steps: int | None = None,
    params: ArrayLike | None = None,
    dt: float | None = None,
    random_state: Any = None,
    state_names: Sequence[str] | None = None,
    action_names: Sequence[str] | None = None,
    param_names: Sequence[str] | None = None,
) -> TrajectoryDataset:
    """Run a Gymnasium environment under a policy.

    Observations become the states (flattened), `terminated` is the environment's own flag at
    the last step; a time limit is not a termination.

    Parameters
    ----------
    env : str, gymnasium.Env or callable
        An id, an environment, or a function without arguments that makes one. Only an
        environment made here is closed at the end.
    policy : callable or "random"
        ``policy(states (1, d_s), params (1, p), times (1,)) -> actions (1, d_a)``, asked at
        every step; or ``"random"``, which samples the action space. Actions are recorded as
        applied: clipped to the bounds of a Box, in its precision. For a Discrete space the
        policy returns the number of the action, in one column.
    n_episodes : int
    max_steps : int, optional
        Longest episode. Default: the time limit the environment is registered with.
    params : array-like of shape (n_episodes, p), optional
        Controller parameters theta, one row an episode, handed to the policy and recorded.
    dt : float, optional
        Sampling time. Default: ``dt`` or ``tau`` of the environment or its metadata, else 1.
    random_state : int, RandomState instance or None
        Each episode has a seed of its own, so that the first episodes do not depend on how
        many follow.
    state_names, action_names, param_names : sequence of str, optional

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    ValueError
        For spaces other than Box observations and Box or Discrete actions, no time limit,
        params of a wrong shape, or a policy that returns anything but ``(1, d_a)`` finite
        numbers.
    ImportError
        Without gymnasium.

    Examples
    --------
    >>> import numpy as np
    >>> def push_to_center(states, params, times):
    ...     return params * states[:, [2]] > 0
    >>> ds = from_gymnasium(
    ...     "CartPole-v1", push_to_center, n_episodes=2, params=[[1.0], [2.0]], random_state=0
    ... )
    >>> bool(ds.lengths.min() > 10), ds.action_names, float(ds.times[1])
    (True, ('a0',), 0.02)
    """
    gym = import_extra("gymnasium", "gym", by="from_gymnasium")
    check_scalar(n_episodes, "n_episodes", Integral, min_val=1)
    if max_steps is not None:
        check_scalar(max_steps, "max_steps", Integral, min_val=1)
    if not callable(policy) and policy != "random":
        raise ValueError(f"policy = {policy!r}: give a callable or 'random'.")
    theta = _check_params(params, n_episodes)
    seeds = check_random_state(random_state).randint(np.iinfo(np.int32).max, size=(n_episodes, 2))

    made_here = not isinstance(env, gym.Env)
    environment: Any = _make(gym, env) if made_here else env
    try:
        runner = _Runner(gym, environment, policy, max_steps, dt)
        episodes = [
            runner.episode(i, theta[i : i + 1], *seeds[i].tolist()) for i in range(n_episodes)
        ]
    finally:
        if made_here:
            environment.close()
    fields: dict[str, Any] = {name: [item[name] for item in episodes] for name in episodes[0]}
    return TrajectoryDataset.from_arrays(
        **fields,
        params=theta if theta.shape[1] else None,
        dt=runner.dt,
        state_names=state_names,
        action_names=action_names,
        param_names=param_names,
    )


def _check_params(params: ArrayLike | None, n_episodes: int) -> Floats:
    if params is None:
        return np.empty((n_episodes, 0))
    theta = np.asarray(params, dtype=np.float64)
    if theta.ndim != 2 or len(theta) != n_episodes:
        raise ValueError(
            f"params has shape {theta.shape}; give one row of theta for each of the {n_episodes} "
            f"episodes: ({n_episodes}, p)."
        )
    if not np.isfinite(theta).all():
        raise ValueError("params has values that are not finite.")
    return theta


def _make(gym: Any, env: Any) -> Any:
    if isinstance(env, (str, gym.envs.registration.EnvSpec)):
        return gym.make(env)
    made = env() if callable(env) else env
    if not isinstance(made, gym.Env):
        raise ValueError(
            f"env is {type(made).__name__}: give an id, a gymnasium.Env (not a vectorised one) or "
            "a function that makes one."
        )
    return made


class _Runner:
    """An environment, a policy, and what both need to be told."""

    def __init__(
        self, gym: Any, env: Any, policy: Any, max_steps: int | None, dt: float | None
    ) -> None:
        self.env, self.policy = env, policy
        self.actions, observations = env.action_space, env.observation_space
        if not isinstance(observations, gym.spaces.Box):
            parts = list(observations) if isinstance(observations, gym.spaces.Dict) else ""
            raise ValueError(
                f"the observation space is {type(observations).__name__} {parts}, not Box. Wrap "
                "the environment: gymnasium.wrappers.FilterObservation chooses keys, "
                "FlattenObservation makes one vector of them."
            )
        self.is_box = isinstance(self.actions, gym.spaces.Box)
        if self.is_box and not np.issubdtype(self.actions.dtype, np.floating):
            raise ValueError(f"actions of type {self.actions.dtype} in a Box are not supported.")
        if not self.is_box and not isinstance(self.actions, gym.spaces.Discrete):
            raise ValueError(
                f"the action space is {type(self.actions).__name__}; Box and Discrete are "
                "supported. Wrap the environment to have one of them."
            )
        registered = env.spec.max_episode_steps if env.spec is not None else None
        limit = registered if max_steps is None else max_steps
        if limit is None:
            raise ValueError("the environment has no time limit: give max_steps=.")
        self.max_steps = int(limit)
        self.dt = _time_step(env) if dt is None else dt

    def episode(self, number: int, theta: Floats, seed: int, action_seed: int) -> dict[str, Any]:
        """Run to the end, and return states, actions, rewards and terminated."""
        observation, _ = self.env.reset(seed=seed)
        self.actions.seed(action_seed)
        states, actions = [_flat(observation)], []
        rewards: list[float] = []
        terminated = truncated = False
        while len(rewards) < self.max_steps and not (terminated or truncated):
            action = self._act(states[-1], theta, len(rewards) * self.dt, number)
            observation, reward, terminated, truncated, _ = self.env.step(action)
            states.append(_flat(observation))
            actions.append(_flat(action))
            rewards.append(float(reward))
        return {
            "states": np.array(states),
            "actions": np.array(actions),
            "rewards": np.array(rewards),
            "terminated": bool(terminated),
        }

    def _act(self, state: Floats, theta: Floats, time: float, number: int) -> Any:
        if self.policy == "random":
            return self.actions.sample()
        given = self.policy(state[None], theta, np.array([time]))
        action = np.asarray(given, dtype=np.float64)
        width = int(np.prod(self.actions.shape))
        if action.shape != (1, width) or not np.isfinite(action).all():
            raise ValueError(
                f"episode {number}, t = {time:g}: the policy returned {given!r}; expected finite "
                f"actions of shape (1, {width})."
            )
        if self.is_box:
            bounded = np.clip(
                action.reshape(self.actions.shape), self.actions.low, self.actions.high
            )
            return bounded.astype(self.actions.dtype)
        choice = self.actions.dtype.type(action[0, 0])
        if choice != action[0, 0] or not self.actions.contains(choice):
            raise ValueError(
                f"episode {number}, t = {time:g}: the policy returned {action[0, 0]:g}, which is "
                f"no action of {self.actions}."
            )
        return choice


def _flat(value: Any) -> Floats:
    return np.array(value, dtype=np.float64).ravel()


def _time_step(env: Any) -> float:
    """``dt`` or ``tau`` of the environment, else of its metadata, else 1."""
    inner = env.unwrapped
    candidates = [getattr(inner, name, None) for name in ("dt", "tau")]
    candidates.append((env.metadata or {}).get("dt"))
    for value in candidates:
        if isinstance(value, (int, float, np.number)) and np.isfinite(value) and value > 0:
            return float(value)
    return 1.0


def from_minari(
    dataset: "str | minari.MinariDataset",
    *,
    episodes: Sequence[int] | None = None,
    observation_keys: Sequence[str] | None = None,
    dt: float = 1.0,
    download: bool = False,
    state_names: Sequence[str] | None = None,
    action_names: Sequence[str] | None = None,
) -> TrajectoryDataset:
    """Episodes of a Minari data set.

    Parameters
    ----------
    dataset : str or minari.MinariDataset
        An id, or a data set already loaded.
    episodes : sequence of int, optional
        Positions of the episodes to take. Default: all.
    observation_keys : sequence of str, optional
        For dictionary observations: the entries that become the states, in this order.
    dt : float, default=1.0
        Sampling time; Minari does not record it.
    download : bool, default=False
        Whether to fetch a data set that is not on this machine.
    state_names, action_names : sequence of str, optional

    Returns
    -------
    TrajectoryDataset
        `ids` are Minari's episode numbers; an episode is `terminated` if its last step says so.

    Raises
    ------
    ValueError
        For dictionary or tuple observations (the message names the keys) and actions.
    IndexError
        For an episode that the data set does not have.
    ImportError
        Without minari, or without what it needs to read this kind of file.
    """
    module = import_extra("minari", "minari", by="from_minari")
    data = module.load_dataset(dataset, download) if isinstance(dataset, str) else dataset
    chosen = np.asarray(data.episode_indices)
    if episodes is not None:
        chosen = chosen[np.asarray(episodes)]
    states, actions, rewards, terminated, ids = [], [], [], [], []
    for episode in data.iterate_episodes(chosen):
        states.append(_observed(episode.observations, observation_keys))
        actions.append(_rows(episode.actions, "actions"))
        rewards.append(np.asarray(episode.rewards, dtype=np.float64))
        terminated.append(bool(episode.terminations[-1]))
        ids.append(int(episode.id))
    return TrajectoryDataset.from_arrays(
        states,
        actions=actions,
        rewards=rewards,
        terminated=terminated,
        ids=ids,
        dt=dt,
        state_names=state_names,
        action_names=action_names,
    )


def _observed(observations: Any, keys: Sequence[str] | None) -> Floats:
    keys = [keys] if isinstance(keys, str) else keys
    if not isinstance(observations, dict):
        if keys is not None:
            raise ValueError("observation_keys is given, but the observations are plain arrays.")
        return _rows(observations, "observations")
    if not keys or any(key not in observations for key in keys):
        raise ValueError(
            f"the observations are dictionaries with the keys {list(observations)}: choose with "
            f"observation_keys= which become the states (got {keys})."
        )
    return np.hstack([_rows(observations[key], f"observations[{key!r}]") for key in keys])


def _rows(values: Any, name: str) -> Floats:
    if isinstance(values, (dict, tuple)):
        parts = list(values) if isinstance(values, dict) else f"{len(values)} parts"
        raise ValueError(f"{name} is a {type(values).__name__} ({parts}), not one array.")
    array = np.asarray(values, dtype=np.float64)
    return array.reshape(len(array), -1)
