"""Episodes of a regime: those to learn from, as they are logged; those to forecast; the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._flights_data import flights, folds, starts
from benchmarks.paper._tasks import environment
from benchmarks.regimes._regimes import DEVELOPMENT, FRESH, Regime
from trajlearn import Cartpole, Trajectory, TrajectoryDataset

Floats = NDArray[np.float64]

N_TEST = {"full": 100, "quick": 20}
# cartpole episodes of no regime, for what a per cent of a state is
_SCALE_SEED, _SCALE_EPISODES = 9_000, 200
#: Steps of the real flights, from the beginning of the motion: what all but a few have.
FLIGHT_STEPS = 240
#: The fold of the flights that is held out; nothing was chosen on those of the fresh seeds.
FOLD_OF = dict(zip((*DEVELOPMENT, *FRESH), (0, 2, 3, 4), strict=True))


@dataclass(frozen=True, eq=False)
class Episodes:
    """What a cell works on.

    Attributes
    ----------
    train : TrajectoryDataset
        As logged.
    test : TrajectoryDataset
        As logged; a forecast sees its first states.
    truth : TrajectoryDataset
        The test episodes without measurement noise (of real flights: as logged).
    span : ndarray of shape (d_s,)
        Range of the training states without measurement noise.
    noise : ndarray of shape (d_s,)
        Standard deviation of the measurement noise; NaN if unknown.
    policy : callable or None
        The controller, where the regime has one that can be evaluated.
    reward : callable or None
        Of states (..., d_s).
    """

    train: TrajectoryDataset
    test: TrajectoryDataset
    truth: TrajectoryDataset
    span: Floats
    noise: Floats
    policy: Callable[..., Any] | None
    reward: Callable[[Floats], Floats] | None


def episodes(regime: Regime, seed: int, mode: str) -> Episodes:
    """Training and test episodes of a regime; their seeds never meet."""
    if regime.system == "flights":
        return _flights(seed)
    if regime.system == "cartpole":
        return _cartpole(regime, seed, N_TEST[mode])
    task = {"quadrotor": "quadrotor-sim"}.get(regime.system, regime.system)
    env = environment(task)
    train = env.collect(regime.n_train, regime.length, random_state=2 * seed)
    truth = env.collect(N_TEST[mode], regime.length, random_state=2 * seed + 1)
    unit = train.states.std(axis=0)
    if regime.system == "reacher":
        unit = np.ptp(train.states, axis=0)
    rng = _generator(seed)
    logged, test = (_measured(some, regime.noise * unit, rng) for some in (train, truth))
    span = np.ptp(train.states, axis=0)
    return Episodes(logged, test, truth, span, regime.noise * unit, env.policy, env.reward)


def _generator(seed: int) -> np.random.Generator:
    """Of the noise."""
    return np.random.default_rng([seed, 7])


def _with_states(ds: TrajectoryDataset, states: list[Floats]) -> TrajectoryDataset:
    """The same episodes in other states."""
    assert ds.actions is not None  # of a simulator
    return TrajectoryDataset.from_arrays(
        states,
        actions=[episode.actions for episode in ds],
        params=ds.params,
        times=[episode.times for episode in ds],
        terminated=ds.terminated,
        **ds.names,
    )


def _measured(ds: TrajectoryDataset, noise: Floats, rng: np.random.Generator) -> TrajectoryDataset:
    """The states with measurement noise of a standard deviation (d_s,)."""
    if not noise.any():
        return ds
    shown = [e.states + noise * rng.standard_normal(e.states.shape) for e in ds]
    return _with_states(ds, shown)


# -- cartpole -----------------------------------------------------------------------------


def _cartpole(regime: Regime, seed: int, n_test: int) -> Episodes:
    env = cart(regime.gains)
    unit = scale(regime.gains, regime.length)
    rng = _generator(seed)
    logs = [
        fly(env, n, regime, unit, random_state=2 * seed + k, rng=rng)
        for k, n in enumerate((regime.n_train, n_test))
    ]
    (train, train_truth), (test, truth) = (
        tuple(_as_logged(some, regime) for some in log) for log in logs
    )
    columns = [env.state_names.index(name) for name in train.state_names]
    where = [train.state_names.index(name) for name in ("x", "theta")]
    return Episodes(
        train,
        test,
        truth,
        np.ptp(train_truth.states, axis=0),
        regime.noise * unit[columns],
        env.policy if len(columns) == len(env.state_names) else None,
        lambda states: -(states[..., where] ** 2).sum(axis=-1),
    )


def cart(gains: str) -> Cartpole:
    if gains == "unstable":
        return Cartpole(gains, limit_scale=np.inf)
    return Cartpole(gains, redraw_terminated=True)


def scale(gains: str, length: int) -> Floats:
    """Standard deviation (d_s,) of the states without noise: the unit of all noise."""
    some = cart(gains).collect(_SCALE_EPISODES, length, random_state=_SCALE_SEED)
    return np.asarray(some.states.std(axis=0))


def _as_logged(ds: TrajectoryDataset, regime: Regime) -> TrajectoryDataset:
    """The states that are logged, at the steps that are logged."""
    ds = ds.select_states(regime.states) if regime.states else ds
    return ds.decimate(regime.every) if regime.every > 1 else ds


def fly(
    env: Cartpole,
    n: int,
    regime: Regime,
    unit: Floats,
    *,
    random_state: int,
    rng: np.random.Generator,
) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Episodes as measured, and as they were: with process noise, or a controller misled.

    As the simulator does, starts and gains are drawn again until an episode stays in the limits.

    Parameters
    ----------
    env : Cartpole
    n : int
        Episodes.
    regime : Regime
    unit : ndarray of shape (d_s,)
        What noise is a fraction of.
    random_state : int
        Of starts and gains.
    rng : Generator
        Of the noise.
    """
    draws = n if not env.redraw_terminated else 40 + 6 * n
    states, theta = env.reset(draws, random_state), env.sample_params(draws, random_state)
    alive = np.ones(draws, dtype=bool)
    true, shown, applied = [states], [], []
    for t in range(regime.length + 1):
        shown.append(states + regime.noise * unit * rng.standard_normal(states.shape))
        if t == regime.length:
            break
        seen = shown[-1] if regime.acts_on_noise else states
        applied.append(env.policy(seen, theta, np.full(draws, t * env.dt)))
        states = env.step(states, applied[-1])
        states = states + regime.process * unit * rng.standard_normal(states.shape)
        true.append(states)
        alive &= ~env.is_terminal(states)
    (kept,) = np.nonzero(alive)
    if len(kept) < n:
        raise ValueError(f"{len(kept)} of {draws} draws stay within the limits, of {n} wanted.")
    kept = kept[:n]
    measured, truth = (
        TrajectoryDataset.from_arrays(
            np.stack(some, axis=1)[kept],
            actions=np.stack(applied, axis=1)[kept],
            params=theta[kept],
            dt=env.dt,
            state_names=env.state_names,
            action_names=env.action_names,
            param_names=env.param_names,
        )
        for some in (shown, true)
    )
    return measured, truth


# -- real flights -------------------------------------------------------------------------


def _flights(seed: int) -> Episodes:
    """One fold of the flights, each from the beginning of its motion (or log) on."""
    every = flights().ds
    train, test = folds(every, "experiment")[FOLD_OF[seed]]
    first = [int(some[0]) for some in starts(every)]
    cut = [_from(episode, begin) for episode, begin in zip(every, first, strict=True)]
    logged = TrajectoryDataset.from_list(cut, **every.names).truncate(FLIGHT_STEPS)
    span = np.ptp(logged[train].states, axis=0)
    unknown = np.full_like(span, np.nan)
    return Episodes(logged[train], logged[test], logged[test], span, unknown, None, None)


def _from(episode: Trajectory, begin: int) -> Trajectory:
    """An episode without what is before a state."""
    fields = episode.to_dict()
    for name in ("states", "actions", "rewards", "references", "times"):
        if fields[name] is not None:
            fields[name] = fields[name][begin:]
    return Trajectory(**fields)
