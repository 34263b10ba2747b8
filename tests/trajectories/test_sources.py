"""Episodes from Gymnasium and Minari: aligned, as applied, seeded, and refused where unclear."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories import TrajectoryDataset, from_gymnasium, from_minari

A = np.array([[0.9, 0.1], [-0.2, 0.8]])
B = np.array([[0.3], [0.7]])


class Linear(gymnasium.Env):
    """s' = A s + B a with a reward of the next state; ends where the state grows too large."""

    dt = 0.05

    def __init__(self, ends_at=np.inf, observation_space=None, action_space=None):
        self.observation_space = observation_space or spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.ends_at, self.closed, self.applied = ends_at, False, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=2)
        return self.state, {}

    def step(self, action):
        self.applied.append(np.array(action))
        # In place: what was handed out before must have been copied.
        self.state += A @ self.state + B @ np.ravel(action) - self.state
        ended = bool(np.abs(self.state).max() > self.ends_at)
        return self.state, float(self.state.sum()), ended, False, {}

    def close(self):
        self.closed = True


def gains(states, params, times):
    return states @ params.T if params.size else -states[:, :1]


# -- gymnasium ----------------------------------------------------------------------------------


def test_rows_are_aligned_so_that_a_linear_system_is_identified_exactly():
    theta = np.random.default_rng(0).normal(size=(4, 2))
    ds = from_gymnasium(Linear(), gains, n_episodes=4, max_steps=12, params=theta, random_state=0)
    assert ds.lengths.tolist() == [12] * 4
    np.testing.assert_array_equal(ds.params, theta)
    before = np.concatenate([np.hstack([e.states[:-1], e.actions]) for e in ds])
    after = np.concatenate([e.states[1:] for e in ds])
    solution, *_ = np.linalg.lstsq(before, after, rcond=None)
    np.testing.assert_allclose(solution.T, np.hstack([A, B]), atol=1e-10)
    np.testing.assert_allclose(ds.rewards, after.sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(ds[0].times, 0.05 * np.arange(13))


def test_actions_are_recorded_as_applied():
    env = Linear()
    theta = [[30.0, 0.0], [0.1, 0.1]]
    ds = from_gymnasium(env, gains, n_episodes=2, max_steps=8, params=theta, random_state=0)
    assert np.abs(ds[0].actions).max() == 1.0
    np.testing.assert_array_equal(ds.actions, np.array(env.applied))
    # In the precision of the action space.
    np.testing.assert_array_equal(ds.actions, ds.actions.astype(np.float32))
    wanted = np.clip(ds[1].states[:-1] @ [[0.1], [0.1]], -1, 1)
    np.testing.assert_allclose(ds[1].actions, wanted, rtol=1e-6)


def test_the_policy_gets_vectorised_arguments():
    seen = []

    def policy(states, params, times):
        seen.append((states.shape, params.shape, times.shape, times[0]))
        return np.zeros((1, 1))

    from_gymnasium(Linear(), policy, n_episodes=1, max_steps=2, params=[[1.0, 2.0, 3.0]], dt=0.5)
    assert seen == [((1, 2), (1, 3), (1,), 0.0), ((1, 2), (1, 3), (1,), 0.5)]
    seen.clear()
    from_gymnasium(Linear(), policy, n_episodes=1, max_steps=1)
    assert seen[0][1] == (1, 0)


def test_one_seed_an_episode():
    def run(n, seed, policy="random"):
        return from_gymnasium(Linear(), policy, n_episodes=n, max_steps=5, random_state=seed)

    assert run(3, 0) == run(3, 0)
    assert run(5, 0)[:3] == run(3, 0)
    assert run(3, 0) != run(3, 1)
    starts = [episode.states[0].tolist() for episode in run(5, 0)]
    assert len({tuple(start) for start in starts}) == 5
    assert len(np.unique(run(5, 0).actions)) == 25
    # The policy draws nothing: the starts do not depend on which one it is.
    assert [e.states[0].tolist() for e in run(5, 0, gains)] == starts
    by_state = np.random.RandomState(0)
    assert run(3, by_state) == run(3, 0)
    assert run(3, by_state) != run(3, 0)


def test_an_end_is_a_termination_a_time_limit_is_not():
    def grow(states, params, times):
        return np.sign(states[:, :1] + states[:, 1:])

    ds = from_gymnasium(Linear(ends_at=1.5), grow, n_episodes=8, max_steps=3, random_state=1)
    assert 0 < ds.terminated.sum() < 8
    for episode in ds:
        assert episode.terminated == (np.abs(episode.states[-1]).max() > 1.5)
        assert episode.terminated or len(episode) == 3
    # Gymnasium's own limit truncates, at 500 steps unless told otherwise.
    pendulum = from_gymnasium("Pendulum-v1", "random", n_episodes=1, random_state=0)
    assert (pendulum.lengths[0], pendulum.terminated[0]) == (200, False)
    limited = gymnasium.make("CartPole-v1", max_episode_steps=4)
    assert from_gymnasium(limited, "random", n_episodes=2).lengths.tolist() == [4, 4]


def test_discrete_actions_are_one_column():
    def lean(states, params, times):
        return states[:, [2]] > 0

    ds = from_gymnasium("CartPole-v1", lean, n_episodes=3, random_state=0)
    assert set(np.unique(ds.actions)) == {0.0, 1.0}
    np.testing.assert_array_equal(ds[0].actions[:, 0], ds[0].states[:-1, 2] > 0)
    assert ds.terminated.all()
    assert (ds.rewards == 1.0).all()
    shifted = Linear(action_space=spaces.Discrete(3, start=-1))
    ds = from_gymnasium(shifted, "random", n_episodes=1, max_steps=40, random_state=0)
    assert set(np.unique(ds.actions)) == {-1.0, 0.0, 1.0}


def test_boxes_of_any_shape_are_flattened():
    class Image(Linear):
        def reset(self, *, seed=None, options=None):
            return np.arange(6, dtype=np.uint8).reshape(2, 3), {}

        def step(self, action):
            assert action.shape == (2, 2)
            return np.ones((2, 3), dtype=np.uint8), 0.0, False, False, {}

    env = Image(
        observation_space=spaces.Box(0, 255, (2, 3), np.uint8),
        action_space=spaces.Box(-np.inf, np.inf, (2, 2)),
    )
    ds = from_gymnasium(env, lambda s, p, t: np.arange(4.0)[None], n_episodes=1, max_steps=1)
    assert ds[0].states.tolist() == [[0, 1, 2, 3, 4, 5], [1] * 6]
    assert ds[0].actions.tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize(("env", "dt"), [("CartPole-v1", 0.02), ("Pendulum-v1", 0.05)])
def test_dt_comes_from_the_environment(env, dt):
    ds = from_gymnasium(env, "random", n_episodes=1, max_steps=3)
    np.testing.assert_allclose(ds.times, dt * np.arange(len(ds.times)))
    assert from_gymnasium(env, "random", n_episodes=1, max_steps=3, dt=2.0).times[1] == 2.0


def test_dt_falls_back_to_metadata_and_then_to_one():
    class Plain(Linear):
        dt = None

    class Described(Plain):
        metadata = {"dt": 0.25, "render_fps": 50}  # noqa: RUF012

    settings = {"n_episodes": 1, "max_steps": 2}
    assert from_gymnasium(Plain(), "random", **settings).times.tolist() == [0.0, 1.0, 2.0]
    assert from_gymnasium(Described(), "random", **settings).times.tolist() == [0.0, 0.25, 0.5]


def test_only_an_environment_made_here_is_closed():
    made = []

    def factory():
        made.append(Linear())
        return made[-1]

    from_gymnasium(factory, "random", n_episodes=2, max_steps=2)
    assert len(made) == 1
    assert made[0].closed
    mine = Linear()
    from_gymnasium(mine, "random", n_episodes=1, max_steps=2)
    assert not mine.closed
    with pytest.raises(ValueError, match="the policy returned"):
        from_gymnasium(factory, lambda s, p, t: None, n_episodes=1, max_steps=2)
    assert made[1].closed


def test_names_and_other_ways_to_say_which_environment():
    ds = TrajectoryDataset.from_gymnasium(
        gymnasium.spec("Pendulum-v1"),
        "random",
        n_episodes=1,
        max_steps=2,
        params=[[1.0]],
        state_names=["cos", "sin", "speed"],
        action_names=["torque"],
        param_names=["kp"],
    )
    assert ds.state_names == ("cos", "sin", "speed")
    assert ds.action_names + ds.param_names == ("torque", "kp")
    assert from_gymnasium(Linear, "random", n_episodes=1, max_steps=2).lengths[0] == 2


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"policy": "greedy"}, "policy = 'greedy': give a callable or 'random'"),
        ({"policy": lambda s, p, t: np.zeros(1)}, r"episode 0, t = 0: .* shape \(1, 1\)"),
        ({"policy": lambda s, p, t: np.zeros((1, 2))}, r"shape \(1, 1\)"),
        ({"policy": lambda s, p, t: np.full((1, 1), np.nan)}, "expected finite actions"),
        ({"n_episodes": 0}, "n_episodes == 0, must be >= 1"),
        ({"max_steps": 0}, "max_steps == 0, must be >= 1"),
        ({"max_steps": None}, r"no time limit: give max_steps="),
        ({"params": [1.0, 2.0]}, r"params has shape \(2,\)"),
        ({"params": [[1.0]]}, r"params has shape \(1, 1\); give one row .* 2 episodes"),
        ({"params": [[1.0], [np.nan]]}, "params has values that are not finite"),
        ({"dt": -1.0}, "dt = -1.0 must be positive"),
        ({"env": 3}, "env is int"),
        ({"env": lambda: 3}, "env is int"),
        (
            {
                "env": Linear(
                    observation_space=spaces.Dict(a=spaces.Box(-1, 1), b=spaces.Discrete(2))
                )
            },
            r"Dict \['a', 'b'\].*FilterObservation",
        ),
        ({"env": Linear(observation_space=spaces.Discrete(3))}, "observation space is Discrete"),
        ({"env": Linear(action_space=spaces.MultiBinary(3))}, "action space is MultiBinary"),
        ({"env": Linear(action_space=spaces.Box(0, 9, dtype=np.int64))}, "int64 in a Box"),
        (
            {"env": Linear(action_space=spaces.Discrete(2)), "policy": lambda s, p, t: [[2]]},
            r"returned 2, which is no action of Discrete\(2\)",
        ),
        (
            {"env": Linear(action_space=spaces.Discrete(2)), "policy": lambda s, p, t: [[0.5]]},
            "returned 0.5, which is no action",
        ),
    ],
)
def test_what_cannot_be_run_is_refused(settings, match):
    plain = {"env": Linear(), "policy": gains, "n_episodes": 2, "max_steps": 3}
    with pytest.raises(ValueError, match=match):
        from_gymnasium(**(plain | settings))


def test_vectorised_environments_are_refused():
    env = gymnasium.make_vec("CartPole-v1", num_envs=2)
    with pytest.raises(ValueError, match="not a vectorised one"):
        from_gymnasium(env, "random", n_episodes=1)
    env.close()


def test_an_environment_that_returns_nan_names_the_episode():
    class Broken(Linear):
        def step(self, action):
            return np.full(2, np.nan), 0.0, False, False, {}

    with pytest.raises(InvalidEpisodeError, match="episode 0: states is nan at row 1"):
        from_gymnasium(Broken(), "random", n_episodes=1, max_steps=2)


def test_without_gymnasium_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gymnasium", None)
    with pytest.raises(ImportError, match=r'pip install "trajlearn\[gym\]"'):
        from_gymnasium("CartPole-v1", "random", n_episodes=1)


# -- minari -------------------------------------------------------------------------------------


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Function that writes a small local Minari data set from given episodes."""
    minari = pytest.importorskip("minari")
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def write(name, observations, actions, observation_space, action_space):
        buffers = []
        for i, (seen, done) in enumerate(zip(observations, actions, strict=True)):
            steps = len(done)
            ended = np.zeros(steps, dtype=bool)
            ended[-1] = i % 2 == 0
            cut = np.zeros(steps, dtype=bool)
            cut[-1] = i % 2 == 1
            buffers.append(
                EpisodeBuffer(
                    id=i,
                    observations=seen,
                    actions=done,
                    rewards=list(np.arange(steps) + 10.0 * i),
                    terminations=list(ended),
                    truncations=list(cut),
                )
            )
        return minari.create_dataset_from_buffers(
            name,
            buffers,
            observation_space=observation_space,
            action_space=action_space,
            data_format="arrow",
        )

    return write


BOX = spaces.Box(-np.inf, np.inf, (2,), np.float64)
PUSH = spaces.Box(-1.0, 1.0, (1,), np.float32)


@pytest.fixture
def pushed(record):
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(t + 1, 2)) for t in (3, 5, 4)]
    actions = [rng.uniform(-1, 1, (t, 1)).astype(np.float32) for t in (3, 5, 4)]
    return record("local/push-v0", states, actions, BOX, PUSH), states, actions


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


def test_minari_episodes_by_id_and_by_object(pushed):
    data, states, actions = pushed
    ds = from_minari("local/push-v0", dt=0.1, state_names=["x", "v"], action_names=["force"])
    assert ds == TrajectoryDataset.from_arrays(
        states,
        actions=actions,
        rewards=[np.arange(3.0), np.arange(5.0) + 10, np.arange(4.0) + 20],
        terminated=[True, False, True],
        dt=0.1,
        state_names=["x", "v"],
        action_names=["force"],
    )
    assert TrajectoryDataset.from_minari(data).states.tobytes() == ds.states.tobytes()


def test_minari_episodes_can_be_chosen(pushed):
    data, states, _ = pushed
    ds = from_minari(data, episodes=[2, -2])
    assert ds.ids.tolist() == [2, 1]
    np.testing.assert_array_equal(ds[0].states, states[2])
    # Positions in the data set given, which may be filtered already.
    ended = data.filter_episodes(lambda episode: bool(episode.terminations[-1]))
    assert from_minari(ended).ids.tolist() == [0, 2]
    assert from_minari(ended, episodes=[1]).ids.tolist() == [2]
    with pytest.raises(IndexError):
        from_minari(data, episodes=[3])


def test_minari_discrete_actions_and_wide_observations(record):
    wide = spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
    record(
        "local/wide-v0",
        [np.arange(12.0).reshape(3, 2, 2)],
        [np.array([1, 0])],
        wide,
        spaces.Discrete(2),
    )
    ds = from_minari("local/wide-v0")
    assert ds[0].states[1].tolist() == [4.0, 5.0, 6.0, 7.0]
    assert ds[0].actions.tolist() == [[1.0], [0.0]]


def test_minari_dictionaries_need_keys(record):
    states = {"position": np.arange(6.0).reshape(3, 2), "goal": -np.arange(6.0).reshape(3, 2)}
    space = spaces.Dict(position=BOX, goal=BOX)
    record("local/goal-v0", [states], [np.zeros((2, 1), np.float32)], space, PUSH)
    for keys in (None, ["position", "speed"], []):
        with pytest.raises(ValueError, match=r"keys \[.*'position'.*\].*observation_keys="):
            from_minari("local/goal-v0", observation_keys=keys)
    ds = from_minari("local/goal-v0", observation_keys=["position", "goal"])
    assert ds[0].states[1].tolist() == [2.0, 3.0, -2.0, -3.0]
    assert from_minari("local/goal-v0", observation_keys="goal")[0].states[2, 0] == -4.0


def test_minari_errors_say_what_is_missing(pushed, monkeypatch):
    with pytest.raises(FileNotFoundError, match="local/none-v0 not found"):
        from_minari("local/none-v0")
    with pytest.raises(ValueError, match="observation_keys is given, but"):
        from_minari("local/push-v0", observation_keys=["x"])
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(ImportError, match=r'pip install "trajlearn\[minari\]"'):
        from_minari("local/push-v0")
