"""The reacher against MuJoCo's kinematics and against mechanics written independently here.

The masses of a link are eight points that have the moments of its box, the planar arm is
three rods in absolute angles: neither shares a formula with the package or with MuJoCo.
"""

import copy
import pickle

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joblib import parallel_config
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from trajlearn.envs import Cartpole, reacher
from trajlearn.envs.reacher import Reacher
from trajlearn.policies import PID

seeds = st.integers(0, 2**32 - 1)
CONTROLLERS = ("angle", "cos")


def same_bits(a, b):
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def states_of(angles, velocities=0.0):
    angles = np.asarray(angles, dtype=float)
    return np.concatenate(
        [np.cos(angles), np.sin(angles), np.broadcast_to(velocities, angles.shape)], axis=-1
    )


def angles_of(states):
    return np.arctan2(states[..., 5:10], states[..., :5])


def constant(action):
    return lambda states, params, times: np.tile(action, (len(states), 1))


def link_frames(q):
    """Rotation of each link and position of the joint it hangs from."""
    z, x = ([Rotation.from_rotvec(a * axis) for a in q] for axis in np.eye(3)[[2, 0]])
    turns = [z[0] * x[1], z[2], z[3] * x[4]]
    rotation, joint = Rotation.identity(), np.array([0.0, 0.25, 0.0])
    for turn in turns:
        rotation = rotation * turn
        yield rotation, joint
        joint = joint + rotation.apply([0.0, -0.5, 0.0])
    yield rotation, joint


def kinetic_energy(state):
    """Energy of the three boxes, each as eight points with its moments."""
    q, velocity = angles_of(state), state[10:]
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    corners = signs * np.array([0.05, 0.25, 0.05]) / np.sqrt(3) - [0, 0.25, 0]

    def points(angles):
        return np.stack([r.apply(corners) + j for r, j in list(link_frames(angles))[:3]])

    width = 1e-6
    speeds = (points(q + width * velocity) - points(q - width * velocity)) / (2 * width)
    return 0.5 * (speeds**2).sum() / 8


@pytest.fixture(scope="module")
def collected():
    return {c: Reacher(c).collect(6, 300, random_state=0) for c in CONTROLLERS}


# The arm


@given(seed=seeds)
def test_the_fingertip_is_where_mujoco_and_a_chain_of_rotations_put_it(seed):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-3.14, 3.14, size=(4, 5))
    model = mujoco.MjModel.from_xml_string(Reacher().mjcf)
    data = mujoco.MjData(model)
    tips = Reacher().fingertip(states_of(angles))
    for q, tip in zip(angles, tips, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(tip, data.site("fingertip").xpos, atol=1e-12)
        np.testing.assert_allclose(tip, list(link_frames(q))[-1][1], atol=1e-12)


@given(seed=seeds)
def test_the_inertia_is_that_of_three_boxes(seed):
    rng = np.random.default_rng(seed)
    angles, velocities, momentum = *rng.uniform(-3, 3, size=(2, 5)), np.empty(5)
    # the last case is the one with the least inertia: the folded hand rolls about its long axis
    for q, v in ((angles, velocities), ([0, 0, 0, 0, np.pi / 2], [0, 0, 0, 1.0, 0])):
        model = mujoco.MjModel.from_xml_string(Reacher().mjcf)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_mulM(model, data, momentum, np.asarray(v))
        energy = kinetic_energy(states_of(q, v))
        assert energy == pytest.approx(0.5 * momentum @ v, rel=1e-6)


def test_joints_and_motors_stand_in_the_order_of_the_names():
    model = mujoco.MjModel.from_xml_string(Reacher(damping=3.5, goal=(1, 2, 3)).mjcf)
    names = [model.joint(i).name for i in range(model.njnt)]
    assert names == ["base_z", "base_x", "elbow_z", "wrist_z", "wrist_x"]
    assert [int(model.actuator(i).trnid[0]) for i in range(model.nu)] == list(range(5))
    system = Reacher()
    kinds = ("cos", "sin", "velocity")
    assert system.state_names == tuple(f"{kind}_{name}" for kind in kinds for name in names)
    assert system.action_names == tuple(f"torque_{name}" for name in names)
    kinds = ("p", "d", "target")
    assert system.param_names == tuple(f"{kind}_{name}" for kind in kinds for name in names)
    assert (model.dof_damping == 3.5).all()
    np.testing.assert_array_equal(model.site("goal").pos, [1, 2, 3])


def planar_arm(_, state, torque, damping):
    """Three rods in a plane, in absolute angles from -y (Lagrange)."""
    angles, rates = np.split(state, 2)
    reach = np.array([[2.25, 1.5, 0.5], [1.5, 1.25, 0.5], [0.5, 0.5, 0.25]]) * 0.5**2
    gap = angles[:, None] - angles
    mass = reach * np.cos(gap) + np.eye(3) * (0.1**2 + 0.5**2) / 12
    joints = np.eye(3) - np.eye(3, k=-1)  # joint angle = difference of two absolute angles
    force = joints.T @ (torque - damping * joints @ rates)
    return np.concatenate([rates, np.linalg.solve(mass, force - (reach * np.sin(gap)) @ rates**2)])


@pytest.mark.parametrize("damping", [0.5, 2.0])
def test_turning_about_z_only_the_arm_is_a_planar_one(monkeypatch, damping):
    action = np.array([0.3, 0.0, -0.2, 0.05, 0.0])
    z = [0, 2, 3]
    truth = solve_ivp(
        planar_arm, (0, 0.8), np.zeros(6), args=(10 * action[z], damping), rtol=1e-9, atol=1e-10
    ).y[:3, -1]
    truth = np.diff(truth, prepend=0)
    errors = []
    for substep in (0.002, 0.001):
        monkeypatch.setattr(reacher, "PHYSICS_STEP", substep)
        rest = states_of(np.zeros((1, 5)))
        episode = Reacher(damping=damping).rollout(rest, None, 100, policy=constant(action))[0]
        end = angles_of(episode.states[-1])
        np.testing.assert_allclose(end[[1, 4]], 0, atol=1e-10)
        errors.append(np.abs(end[z] - truth).max())
    assert np.abs(truth).max() > 0.5
    assert errors[0] < 5e-3
    assert 1.7 < errors[0] / errors[1] < 2.3


def test_friction_takes_the_energy_that_is_lost():
    rng = np.random.default_rng(0)
    starts = states_of(rng.uniform(-1, 1, size=(3, 5)), rng.uniform(-3, 3, size=(3, 5)))
    for damping, steps in ((0.0, 25), (0.2, 25), (2.0, 60)):
        system = Reacher(damping=damping)
        for episode in system.rollout(starts, None, steps, policy=constant(np.zeros(5))):
            energy = np.array([kinetic_energy(state) for state in episode.states])
            power = damping * (episode.states[:, 10:] ** 2).sum(axis=1)
            lost = np.trapezoid(power, dx=0.008)
            if damping == 0:
                assert energy[0] > 0.5
                np.testing.assert_allclose(energy, energy[0], rtol=0.03)
            else:
                assert (np.diff(energy) < 0).all()
            if damping == 0.2:
                assert energy[0] - energy[-1] == pytest.approx(lost, abs=0.03 * energy[0])
            if damping == 2:
                assert energy[-1] < 0.5 * energy[0]


def test_a_joint_stops_at_a_half_turn():
    push = constant([0.0, 0.0, 0.0, 1.0, 0.0])
    episode = Reacher().rollout(states_of([[0, 0, 0, 1.0, 0]]), None, 200, policy=push)[0]
    angle = np.unwrap(angles_of(episode.states)[:, 3])
    assert 3.1 < angle[-1] < 3.25
    assert abs(episode.states[-1, 13]) < 0.1


# The controller


def test_rows_are_aligned(collected):
    for controller, episodes in collected.items():
        system = Reacher(controller)
        for e in episodes:
            theta = np.tile(e.params, (e.length, 1))
            assert same_bits(system.policy(e.states[:-1], theta, e.times[:-1]), e.actions)
            assert same_bits(system.reward(e.states[1:]), e.rewards)
            assert e.states.shape == (301, 15)
            assert e.actions.shape == (300, 5)
            assert not e.terminated
            np.testing.assert_array_equal(e.times, np.arange(301) * 0.008)
    for e in collected["angle"]:
        stepped = Reacher().step(e.states[:-1], e.actions)
        np.testing.assert_allclose(stepped, e.states[1:], rtol=0, atol=1e-12)


def test_actions_are_logged_as_applied(collected):
    for controller, episodes in collected.items():
        actions = np.concatenate([e.actions for e in episodes])
        assert actions.min() == -1
        assert actions.max() == 1
        unclipped = PID(controller, bounds=None)
        wanted = [
            unclipped(e.states[:-1], np.tile(e.params, (300, 1)), e.times[:-1]) for e in episodes
        ]
        assert 0.01 < np.mean(np.abs(np.concatenate(wanted)) > 1) < 0.25
    state, action = Reacher().reset(1, 0), np.array([[5.0, -0.5, 0.2, -7.0, 0.0]])
    assert same_bits(Reacher().step(state, action), Reacher().step(state, np.clip(action, -1, 1)))


def test_the_angles_settle_at_their_targets():
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1, 1, size=(5, 5))
    theta = np.hstack([rng.uniform(0.5, 1, size=(5, 5)), rng.uniform(0, 1, size=(5, 5)), targets])
    system = Reacher(damping=8.0)
    episodes = system.rollout(system.reset(5, 0), theta, 500)
    ends = np.stack([e.states[-1] for e in episodes])
    np.testing.assert_allclose(angles_of(ends), targets, atol=5e-3)
    np.testing.assert_allclose(ends[:, 10:], 0, atol=0.02)
    light = Reacher().rollout(system.reset(5, 0), theta, 500)
    assert max(np.abs(e.states[-1, 10:]).max() for e in light) > 0.05  # the arm swings longer


def test_the_other_controller_regulates_cosines():
    targets = np.array([[0.8, 0.5, 0.0, -0.4, -0.7]])
    theta = np.hstack([np.full((1, 5), 0.8), np.full((1, 5), 0.5), targets])
    start = states_of(np.full((1, 5), -0.01))
    end = Reacher("cos", damping=8.0).rollout(start, theta, 500)[0].states[-1]
    np.testing.assert_allclose(end[:5], targets[0], atol=0.01)
    np.testing.assert_allclose(angles_of(end), -np.arccos(targets[0]), atol=0.02)
    by_angle = Reacher(damping=8.0).rollout(start, theta, 500)[0].states[-1]
    np.testing.assert_allclose(angles_of(by_angle), targets[0], atol=5e-3)


def test_the_derivative_term_is_that_of_successive_errors(collected):
    for controller, episodes in collected.items():
        for e in episodes:
            _, d, target = np.split(e.params, 3)
            theta = np.tile(np.concatenate([np.zeros(5), d, target]), (e.length, 1))
            got = PID(controller, bounds=None)(e.states[:-1], theta, e.times[:-1])
            measured = angles_of(e.states[:-1]) if controller == "angle" else e.states[:-1, :5]
            exact = d * np.diff(target - measured, axis=0)
            assert np.abs(exact).max() > 2e-3
            deviation = got[30:] - exact[29:]
            assert np.sqrt(np.mean(deviation**2)) < 0.1 * np.sqrt(np.mean(exact[29:] ** 2))


def test_only_the_controller_on_cosines_starts_with_a_kick(collected):
    for controller, episodes in collected.items():
        for e in episodes:
            p, d, target = np.split(e.params, 3)
            measured = angles_of(e.states[0]) if controller == "angle" else e.states[0, :5]
            error = target - measured
            change = error if controller == "cos" else -0.008 * e.states[0, 10:]
            np.testing.assert_allclose(e.actions[0], np.clip(5 * p * error + d * change, -1, 1))


def test_the_share_of_settled_joints_is_that_measured_before():
    for controller, expected in (("angle", 0.91), ("cos", 0.94)):
        episodes = Reacher(controller).collect(30, 500, random_state=1)
        angles = np.unwrap(angles_of(np.stack([e.states for e in episodes])), axis=1)
        share = np.mean(angles[:, -50:].std(axis=1) < 0.02)
        assert share == pytest.approx(expected, abs=0.08)
        assert max(np.abs(e.states[:, 10:]).max() for e in episodes) < 10


# The reward


def test_the_reward_is_minus_the_distance_to_the_goal():
    straight = states_of(np.zeros(5))
    assert Reacher(goal=(0.0, -1.25, 0.0)).reward(straight) == pytest.approx(0, abs=1e-15)
    assert Reacher(goal=(3.0, -1.25, -4.0)).reward(straight) == pytest.approx(-5)
    many = states_of(np.random.default_rng(0).uniform(-3, 3, size=(2, 3, 4, 5)), 7.0)
    rewards = Reacher().reward(many)
    assert rewards.shape == (2, 3, 4)
    tips = Reacher().fingertip(many)
    assert tips.shape == (2, 3, 4, 3)
    expected = -np.sqrt(((tips - [0.5, -0.5, 0.5]) ** 2).sum(axis=-1))
    np.testing.assert_allclose(rewards, expected)
    assert rewards[1, 2, 3] == pytest.approx(Reacher().reward(many[1, 2, 3]))


def test_the_default_goal_is_just_within_reach_of_the_targets():
    near = states_of([-0.249, -0.121, 1.0, 0.983, -1.0])
    assert Reacher().reward(near) > -5e-3
    far = states_of(np.random.default_rng(0).uniform(-1, 1, size=(500, 5)))
    assert Reacher().reward(far).max() < -0.1  # seldom met by chance


def test_a_shrunken_prediction_leaves_the_links_as_long_as_they_are():
    angles = np.random.default_rng(0).uniform(-2, 2, size=(20, 5))
    states = states_of(angles)
    shrunken = np.concatenate([0.7 * states[:, :10], states[:, 10:]], axis=1)
    np.testing.assert_allclose(Reacher().fingertip(shrunken), Reacher().fingertip(states))


def test_a_pair_of_zeros_is_no_angle_but_a_number():
    nowhere = states_of(np.zeros(5))
    nowhere[[0, 5]] = 0.0
    np.testing.assert_allclose(Reacher().fingertip(nowhere)[:2], [0.0, 0.25])


# Draws


def test_draws_fill_their_ranges():
    system = Reacher()
    starts = system.reset(500, random_state=0)
    small = np.hstack([angles_of(starts), starts[:, 10:]])
    assert (np.abs(small) <= 0.01).all()
    assert (np.abs(small).max(axis=0) > 0.0098).all()
    params = system.sample_params(500, random_state=0)
    low, high = system.param_bounds.T
    assert system.param_bounds.shape == (15, 2)
    np.testing.assert_array_equal(low, [0] * 10 + [-1] * 5)
    np.testing.assert_array_equal(high, [1] * 15)
    assert (params >= low).all()
    assert (params <= high).all()
    assert (np.ptp(params, axis=0) > 0.97 * (high - low)).all()
    assert np.abs(np.corrcoef(np.hstack([small, params]).T) - np.eye(25)).max() < 0.25
    np.testing.assert_array_equal(system.action_bounds, [[-1, 1]] * 5)


@settings(max_examples=8)
@given(seed=seeds, few=st.integers(1, 3), more=st.integers(1, 9), c=st.sampled_from(CONTROLLERS))
def test_an_episode_does_not_depend_on_the_others(seed, few, more, c):
    system = Reacher(c)
    small = system.collect(few, 20, random_state=seed)
    large = system.collect(few + more, 30, random_state=seed)
    for a, b in zip(small, large, strict=False):
        assert same_bits(a.states, b.states[:21])
        assert same_bits(a.actions, b.actions[:20])
        assert same_bits(a.params, b.params)
    for episode in large:
        alone = system.rollout(episode.states[:1], episode.params, 30)[0]
        assert same_bits(alone.states, episode.states)


def test_a_step_from_a_state_does_not_depend_on_the_other_rows():
    rng = np.random.default_rng(0)
    angles = rng.choice([-3.14, 0.5, 3.14], size=(20, 5))  # a stop is where a solver starts
    states = states_of(angles, rng.uniform(-3, 3, size=(20, 5)))
    actions = rng.uniform(-1, 1, size=(20, 5))
    together = Reacher().step(states, actions)
    alone = [Reacher().step(states[i : i + 1], actions[i : i + 1]) for i in range(20)]
    assert same_bits(together, np.concatenate(alone))
    flown = Reacher().rollout(states, actions, 1, policy=lambda states, params, times: params)
    assert same_bits(together, np.stack([e.states[1] for e in flown]))


def test_seeds():
    system = Reacher()
    train, again, test = (system.collect(4, 10, random_state=s) for s in (0, 0, 1))
    assert train == again
    assert not {tuple(e.states[0]) for e in train} & {tuple(e.states[0]) for e in test}
    assert not {tuple(e.params) for e in train} & {tuple(e.params) for e in test}


@pytest.mark.parametrize("backend", ["multiprocessing", "threading"])
def test_workers_change_nothing(backend):
    serial = Reacher("cos").collect(5, 40, random_state=3)
    with parallel_config(backend=backend):
        for n_jobs in (2, 9) if backend == "threading" else (2,):
            assert Reacher("cos").collect(5, 40, random_state=3, n_jobs=n_jobs) == serial
    if backend == "threading":
        system = Cartpole(redraw_terminated=True)
        with parallel_config(backend=backend, n_jobs=2):
            assert system.collect(5, 40, random_state=3) == system.collect(5, 40, 3, n_jobs=1)


# What can go wrong


def test_a_joint_that_is_too_fast_is_an_error_naming_the_episode(monkeypatch):
    system = Reacher()
    episodes = system.collect(12, 60, random_state=5)
    speeds = np.stack([np.abs(e.states[1:, 10:]).max(axis=1) for e in episodes])
    bound = np.sort(speeds.max(axis=1))[-2]  # all but one episode stay within
    number = int(np.argmax(speeds.max(axis=1)))
    step = int(np.argmax(speeds[number] > bound))
    monkeypatch.setattr(reacher, "MAX_SPEED", bound)
    with pytest.raises(ValueError, match="moved a joint faster than") as caught:
        system.collect(12, 60, random_state=5)
    assert f"the simulation of episode {number} " in str(caught.value)
    assert f"at step {step}:" in str(caught.value)
    assert str(episodes[number].params.tolist()) in str(caught.value)
    with (
        parallel_config(backend="threading"),
        pytest.raises(ValueError, match=f"episode {number} "),
    ):
        system.collect(12, 60, random_state=5, n_jobs=3)


def test_a_step_that_is_too_fast_is_an_error_naming_the_row():
    states = states_of(np.zeros((3, 5)))
    states[1, 10] = -80.0
    message = "row 1 of the states moved a joint faster than 50 rad/s"
    with pytest.raises(ValueError, match=message) as caught:
        Reacher().step(states, np.zeros((3, 5)))
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(ValueError, match="episode 1 moved a joint faster than 50 rad/s at step 0"):
        Reacher().rollout(states, np.zeros(15), 5)


@pytest.fixture
def explicit_integrator(monkeypatch, tmp_path):
    """What MuJoCo does with this arm when friction is integrated explicitly."""
    monkeypatch.setattr(reacher, "MJCF", reacher.MJCF.replace("implicitfast", "RK4"))
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file in the current folder
    start = states_of([[0.0, 0.0, 0.0, 0.1, 1.5]], 1.0)
    return Reacher(damping=8.0), start, constant(np.full(5, 0.5))


def test_a_diverging_simulation_is_an_error(explicit_integrator):
    system, start, push = explicit_integrator
    with pytest.raises(ValueError, match=r"episode 0 .* at step \d+: the step dt=0.008 is too"):
        system.rollout(start, None, 100, policy=push)


def test_a_warning_of_mujoco_is_an_error(explicit_integrator, monkeypatch):
    monkeypatch.setattr(reacher, "MAX_SPEED", np.inf)
    system, start, push = explicit_integrator
    with pytest.raises(ValueError, match=r"episode 0 made MuJoCo warn \(BADQ"):
        system.rollout(start, None, 100, policy=push)


def test_the_same_arm_is_stable_as_integrated_here():
    system = Reacher(damping=8.0)
    start = states_of([[0.0, 0.0, 0.0, 0.1, 1.5]], 1.0)
    episode = system.rollout(start, None, 100, policy=constant(np.full(5, 0.5)))[0]
    assert np.abs(episode.states[:, 10:]).max() < 5


def test_states_off_the_circle_are_refused():
    system = Reacher()
    good = system.reset(2, random_state=0)
    for bad in (good * 2, good * 0, good + 0.01):
        with pytest.raises(ValueError, match=r"\(cos, sin\) of base_z in row 1 of the states"):
            system.rollout(np.stack([good[0], bad[1]]), np.zeros(15), 5)
        with pytest.raises(ValueError, match="which no angle has"):
            system.step(bad, np.zeros((2, 5)))
    system.rollout(good.astype(np.float32), np.zeros(15), 5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"controller": "sin"}, "controller must be 'angle' or 'cos'; got 'sin'"),
        ({"goal": (1.0, 2.0)}, "goal must be three finite numbers"),
        ({"goal": (1.0, 2.0, np.nan)}, "goal must be three finite numbers"),
        ({"damping": -1.0}, "damping must be a finite number of at least 0"),
        ({"damping": np.inf}, "damping must be a finite number of at least 0"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Reacher(**arguments)


def test_bad_shapes_are_named():
    system = Reacher()
    with pytest.raises(ValueError, match=r"states must have shape \(\.\.\., 15\)"):
        system.reward(np.zeros((2, 18)))
    with pytest.raises(ValueError, match=r"actions must have shape \(1, 5\)"):
        system.step(system.reset(1, 0), np.zeros((1, 4)))
    with pytest.raises(ValueError, match=r"params must have shape \(1, 15\)"):
        system.rollout(system.reset(1, 0), np.zeros(10), 5)


def test_a_system_is_an_immutable_value_that_can_be_copied():
    system = Reacher("cos", goal=[0, 1, 2], damping=4.0)
    for twin in (pickle.loads(pickle.dumps(system)), copy.deepcopy(system)):
        assert twin == system != Reacher("cos")
        assert hash(twin) == hash(system)
        assert twin.collect(2, 10, 0) == system.collect(2, 10, 0)
    assert system.goal == (0.0, 1.0, 2.0)
    assert "controller='cos'" in repr(system)
    with pytest.raises(AttributeError):
        system.damping = 1.0
    assert system.policy == PID("cos", initial_kick=True)
    assert Reacher().policy == PID()
    assert Reacher().dt == 0.008
