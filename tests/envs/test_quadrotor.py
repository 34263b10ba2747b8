"""The quadrotor against mechanics with a rotation matrix, conservation laws and symmetries.

The equations of motion are written here with positions of motors, cross products and the
derivative of the rotation matrix: no Euler angle, lever or sign is shared with the package.
"""

import copy
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joblib import parallel_config
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from trajlearn.envs import Airframe, AttitudePD, Quadrotor

NAMES = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "wx", "wy", "wz")
SETS = {
    "attitude": ("roll", "pitch", "wx", "wy", "wz"),
    "scored": ("vx", "vy", "roll", "pitch", "yaw"),
    "observed": NAMES[3:],
    "all": NAMES,
}
G, MASS, FULL = 9.81, 0.027, 65535.0
# front right, back right, back left, front left; x forward, y left, z up
MOTORS = 0.046 * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]]) / np.sqrt(2)
SPINS = np.array([1, -1, 1, -1])  # counterclockwise seen from above is positive
LOPSIDED = Airframe(mass=0.03, inertia=(2e-5, 3e-5, 4.5e-5))
GAINS = [500.0, 100.0, 300.0, 60.0]


def same_bits(a, b):
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def constant(commands):
    return lambda states, params, times: np.broadcast_to(commands, (len(states), 4))


def still(**known):
    """One state (1, 12) with the named values, zero elsewhere."""
    state = np.zeros((1, 12))
    for name, value in known.items():
        state[0, NAMES.index(name)] = value
    return state


def column(states, name):
    return np.asarray(states)[..., NAMES.index(name)]


def rotation(states):
    """Body to world: about z by yaw, then about the new y by pitch, then about x by roll."""
    return Rotation.from_euler("ZYX", np.asarray(states)[..., [8, 7, 6]])


def equations_of_motion(state, commands, airframe):
    """Rates of position, velocity, rotation matrix and angular velocity, flat (18,)."""
    velocity, matrix, omega = state[3:6], state[6:15].reshape(3, 3), state[15:]
    duty = np.asarray(commands) / FULL
    forces = (0.35 * duty + 0.26 * duty**2) / 4
    pushes = forces[:, None] * np.array([0.0, 0.0, 1.0])
    torque = np.cross(MOTORS, pushes).sum(axis=0)
    torque[2] -= airframe.torque_ratio * SPINS @ forces
    inertia = np.diag(airframe.inertia)
    acceleration = matrix @ pushes.sum(axis=0) / airframe.mass - [0.0, 0.0, G]
    spin = np.cross(np.eye(3), omega)  # the matrix of "omega cross"
    omega_dot = np.linalg.solve(inertia, torque - np.cross(omega, inertia @ omega))
    return np.concatenate([velocity, acceleration, (matrix @ -spin.T).ravel(), omega_dot])


def flown_with_matrices(start, commands, duration, airframe):
    """The state after holding the commands, angles recovered at the end."""
    flat = np.concatenate([start[:6], rotation(start).as_matrix().ravel(), start[9:]])
    end = solve_ivp(
        lambda _, s: equations_of_motion(s, commands, airframe),
        (0, duration),
        flat,
        rtol=1e-11,
        atol=1e-12,
    ).y[:, -1]
    yaw, pitch, roll = Rotation.from_matrix(end[6:15].reshape(3, 3)).as_euler("ZYX")
    return np.concatenate([end[:6], [roll, pitch, yaw], end[15:]])


def draw_states(rng, n):
    return rng.uniform(-1, 1, (n, 12)) * [1, 1, 1, 2, 2, 2, 0.7, 0.7, 2, 4, 4, 4]


# The plant


def test_the_spin_matrix_of_these_tests_turns_vectors():
    omega, v = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(-np.cross(np.eye(3), omega).T @ v, np.cross(omega, v))


@pytest.mark.parametrize("airframe", [Airframe(), LOPSIDED], ids=["crazyflie", "lopsided"])
def test_a_step_agrees_with_the_equations_in_a_rotation_matrix(airframe):
    rng = np.random.default_rng(0)
    states = draw_states(rng, 12)
    commands = airframe.hover + rng.uniform(-3000, 3000, (12, 4))
    got = Quadrotor("all", airframe=airframe, integrator="rk4").step(states, commands)
    for i in range(12):
        expected = flown_with_matrices(states[i], commands[i], 0.05, airframe)
        np.testing.assert_allclose(got[i], expected, rtol=1e-6, atol=1e-6)
        assert np.abs(expected - states[i])[9:].max() > 0.05


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
def test_the_error_falls_with_the_order_of_the_integrator(integrator, order):
    rng = np.random.default_rng(1)
    start, commands = draw_states(rng, 1), LOPSIDED.hover + rng.uniform(-2000, 2000, (1, 4))
    truth = flown_with_matrices(start[0], commands[0], 0.2, LOPSIDED)
    errors = []
    for n in (4, 8, 16):
        system = Quadrotor(
            "all", airframe=LOPSIDED, integrator=integrator, dt=0.2, n_substeps=n * (5 - order)
        )
        errors.append(np.abs(system.step(start, commands)[0] - truth).max())
    for coarse, fine in pairwise(errors):
        assert 0.8 * 2**order < coarse / fine < 1.25 * 2**order
    assert errors[-1] < (0.05 if order == 1 else 1e-5)


def test_euler_substeps_are_those_of_the_papers_method():
    states = draw_states(np.random.default_rng(2), 5)
    commands = np.full((5, 4), 30_000.0)
    many = Quadrotor("all").step(states, commands)
    one = Quadrotor("all", dt=0.005, n_substeps=1)
    for _ in range(10):
        states = one.step(states, commands)
    np.testing.assert_allclose(many, states, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("mass", [0.027, 0.035])
def test_the_hover_command_hovers(integrator, mass):
    airframe = Airframe(mass=mass)
    system = Quadrotor("all", noise=0.0, airframe=airframe, integrator=integrator)
    level = system.rollout(still(), GAINS, 200)[0]
    np.testing.assert_allclose(level.states, 0, atol=1e-9)
    np.testing.assert_array_equal(level.actions, airframe.hover)
    duty = airframe.hover / FULL
    assert 0.35 * duty + 0.26 * duty**2 == pytest.approx(mass * G)


def test_thrust_lifts_and_gravity_pulls():
    system = Quadrotor("all")
    for extra in (1000.0, -1000.0):
        after = system.step(still(), np.full((1, 4), Airframe().hover + extra))
        assert np.sign(column(after, "vz")[0]) == np.sign(extra)
    full = system.step(still(), np.full((1, 4), FULL))
    assert column(full, "vz")[0] == pytest.approx(0.05 * (0.61 / MASS - G))


def test_free_fall_is_that_of_a_stone_at_any_attitude():
    system = Quadrotor("all", noise=0.0, integrator="rk4")
    start = still(z=50.0, vx=1.0, vy=-2.0, vz=3.0, roll=0.4, pitch=-0.3, yaw=1.0)
    episode = system.rollout(start, None, 40, policy=constant(np.zeros(4)))[0]
    t = episode.times
    np.testing.assert_allclose(column(episode.states, "vz"), 3.0 - G * t)
    np.testing.assert_allclose(column(episode.states, "z"), 50 + 3.0 * t - G * t**2 / 2)
    np.testing.assert_allclose(column(episode.states, "x"), t, atol=1e-12)
    np.testing.assert_allclose(episode.states[:, 6:], np.tile(start[:, 6:], (41, 1)), atol=1e-12)


def test_a_tilted_craft_moves_to_the_side_that_it_leans_to():
    hover = np.full((1, 4), Airframe().hover)
    pushed = Quadrotor("all").step(still(pitch=0.1), hover)[0]
    assert column(pushed, "vx") > 0  # nose down is pitch > 0
    pushed = Quadrotor("all").step(still(roll=0.1), hover)[0]
    assert column(pushed, "vy") < 0  # the right side down is roll > 0
    turned = Quadrotor("all").step(still(pitch=0.1, yaw=np.pi / 2), hover)[0]
    assert column(turned, "vy") > 0
    assert column(turned, "vx") == pytest.approx(0, abs=1e-12)


def tumbling(integrator, n_substeps, airframe=LOPSIDED):
    system = Quadrotor(
        "all",
        noise=0.0,
        airframe=airframe,
        integrator=integrator,
        n_substeps=n_substeps,
        tilt_limit=1.57,
    )
    start = still(vx=1.0, vz=2.0, wx=0.4, wy=2.0, wz=-6.0)  # precesses, does not turn over
    episode = system.rollout(start, None, 60, policy=constant(np.zeros(4)))[0]
    assert episode.length == 60
    assert np.ptp(column(episode.states, "pitch")) > 0.5
    return episode.states


def conserved(states, airframe=LOPSIDED):
    """Energy in J and angular momentum in the world in 1e-6 kg m^2/s."""
    inertia = np.array(airframe.inertia)
    omega, velocity = states[:, 9:], states[:, 3:6]
    spinning = 0.5 * (inertia * omega**2).sum(axis=1)
    flying = airframe.mass * (0.5 * (velocity**2).sum(axis=1) + G * column(states, "z"))
    return spinning, flying, rotation(states).apply(inertia * omega) * 1e6


def test_torque_free_motion_conserves_energy_and_angular_momentum():
    spinning, flying, momentum = conserved(tumbling("rk4", 10))
    np.testing.assert_allclose(spinning, spinning[0], rtol=1e-6)
    np.testing.assert_allclose(flying, flying[0], rtol=1e-9)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (61, 1)), rtol=1e-5, atol=1e-3)


def test_euler_drifts_in_proportion_to_its_step():
    drifts = []
    for n in (10, 20):
        spinning, _, momentum = conserved(tumbling("euler", n))
        drifts.append([np.ptp(spinning) / spinning[0], np.abs(momentum - momentum[0]).max()])
    ratio = np.array(drifts[0]) / np.array(drifts[1])
    assert (ratio > 1.6).all()
    assert (ratio < 2.4).all()


def test_left_and_right_are_mirror_images():
    mirror = np.ones(12)
    mirror[[1, 4, 6, 8, 9, 11]] = -1  # y, vy, roll, yaw, wx, wz
    starts = draw_states(np.random.default_rng(3), 6) * 0.5
    for integrator in ("euler", "rk4"):
        system = Quadrotor("all", noise=0.0, integrator=integrator)
        flown = system.rollout(starts, GAINS, 100)
        mirrored = system.rollout(starts * mirror, GAINS, 100)
        for a, b in zip(flown, mirrored, strict=True):
            np.testing.assert_allclose(a.states * mirror, b.states, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(a.actions[:, [3, 2, 1, 0]], b.actions, rtol=1e-9)
            assert np.ptp(a.actions[:, 0] - a.actions[:, 3]) > 10


def test_pitch_and_roll_are_alike():
    system = Quadrotor("all", noise=0.0)
    pitching = system.rollout(still(pitch=0.3, wy=0.2), [500, 100, 7, 8], 200)[0].states
    rolling = system.rollout(still(roll=0.3, wx=0.2), [7, 8, 500, 100], 200)[0].states
    for a, b, sign in (("pitch", "roll", 1), ("wy", "wx", 1), ("vx", "vy", -1), ("vz", "vz", 1)):
        np.testing.assert_allclose(
            column(pitching, a), sign * column(rolling, b), rtol=1e-9, atol=1e-12
        )
    assert np.abs(column(pitching, "roll")).max() < 1e-12


def test_a_turned_craft_flies_the_same_way_in_its_own_direction():
    starts = draw_states(np.random.default_rng(4), 4) * 0.5
    turned = starts.copy()
    turn = Rotation.from_euler("Z", 0.8)
    turned[:, 8] += 0.8
    turned[:, :3], turned[:, 3:6] = turn.apply(starts[:, :3]), turn.apply(starts[:, 3:6])
    system = Quadrotor("all", noise=0.0)
    for a, b in zip(
        system.rollout(starts, GAINS, 80), system.rollout(turned, GAINS, 80), strict=True
    ):
        np.testing.assert_allclose(turn.apply(a.states[:, 3:6].copy()), b.states[:, 3:6], atol=1e-9)
        np.testing.assert_allclose(a.states[:, [6, 7, 9, 10, 11]], b.states[:, [6, 7, 9, 10, 11]])


# The controller


def test_the_controller_pushes_back_and_damps():
    system = Quadrotor("all")
    for angle, rate, gains in (("pitch", "wy", [1, 0, 0, 0]), ("roll", "wx", [0, 0, 1, 0])):
        for name, theta in ((angle, gains), (rate, np.roll(gains, 1))):
            state = still(**{name: 0.2})
            commands = system.policy(state, 1000.0 * np.array([theta]), np.zeros(1))
            np.testing.assert_allclose(np.abs(commands - system.airframe.hover), 200.0)
            change = system.step(state, commands)[0] - state[0]
            assert column(change, rate) < -0.05
            others = [r for r in ("wx", "wy", "wz") if r != rate]
            np.testing.assert_allclose([column(change, r) for r in others], 0, atol=1e-9)


def test_the_gain_of_the_plant_at_hover_is_that_of_the_documentation():
    hover = Airframe().hover
    after = Quadrotor("all", dt=1.0, n_substeps=1).step(still(), hover + np.array([[-1, -1, 1, 1]]))
    assert column(after, "wx")[0] == pytest.approx(0.0131, abs=5e-5)
    assert round(hover) == 35395


def test_the_oscillation_grows_where_damping_is_below_that_lost_by_holding_the_command():
    # x'' = -u with u held for dt is stable just when D > P dt / 2
    system = Quadrotor("all", noise=0.0, integrator="rk4")
    p = 800.0
    for factor, grows in ((0.8, True), (1.25, False)):
        d = factor * p * system.dt / 2
        swing = system.rollout(still(pitch=0.05), [p, d, p, d], 200)[0].states[:, 7]
        assert (np.abs(swing[150:]).max() > np.abs(swing[:50]).max()) == grows
    assert system.rollout(still(pitch=0.05), [p, 0.0, p, 0.0], 500)[0].terminated


def test_the_share_of_full_episodes_is_that_of_the_documentation():
    for noise in (0.0, 0.01):
        episodes = Quadrotor(noise=noise).collect(400, 500, random_state=5)
        assert np.mean(~episodes.terminated) == pytest.approx(0.93, abs=0.03)
        weak = episodes.params[:, [1, 3]] < 0.025 * episodes.params[:, [0, 2]]
        assert weak.any(axis=1)[episodes.terminated].all()


@pytest.fixture(scope="module")
def collected():
    """Episodes of all twelve states, some of them ended early."""
    return Quadrotor("all").collect(40, 300, random_state=4)


def test_actions_recomputed_from_the_shown_states_are_the_logged_ones(collected):
    for states in ("attitude", "observed", "all", ("wy", "pitch", "yaw", "wx", "roll")):
        system = Quadrotor(states)
        shown = collected.select_states(system.state_names)
        for e in shown:
            theta = np.tile(e.params, (e.length, 1))
            assert same_bits(system.policy(e.states[:-1], theta, e.times[:-1]), e.actions)
            assert same_bits(system.reward(e.states[1:]), e.rewards)


def test_commands_are_clipped_and_logged_as_applied():
    system = Quadrotor("all", noise=0.0)
    start, gains = still(roll=0.3), [0.0, 0.0, 4e5, 0.0]
    episode = system.rollout(start, gains, 3)[0]
    np.testing.assert_array_equal(episode.actions[0], [FULL, FULL, 0.0, 0.0])
    asked = system.policy(start, [gains], np.zeros(1))  # as a model asks, which does not clip
    np.testing.assert_array_equal(asked, episode.actions[:1])
    greedy = system.rollout(still(), None, 3, policy=constant([-1e9, 1e9, 5.0, FULL]))[0]
    np.testing.assert_array_equal(greedy.actions, [[0.0, FULL, 5.0, FULL]] * len(greedy.actions))
    allowed, asked = ([[low, high, 5.0, FULL]] for low, high in ((0.0, FULL), (-9.0, 1e9)))
    assert same_bits(system.step(start, allowed), system.step(start, asked))
    np.testing.assert_array_equal(system.action_bounds, [[0, FULL]] * 4)


def test_the_controller_names_what_it_lacks():
    with pytest.raises(ValueError, match=r"lack wy, wx\. Choose states that hold them"):
        _ = Quadrotor("scored").policy
    policy = Quadrotor().policy
    with pytest.raises(ValueError, match=r"states must have shape \(n, 5\)"):
        policy(np.zeros((2, 4)), np.zeros((2, 4)), np.zeros(2))
    with pytest.raises(ValueError, match=r"params must have shape \(2, 4\)"):
        policy(np.zeros((2, 5)), np.zeros((2, 6)), np.zeros(2))
    with pytest.raises(ValueError, match=r"times must have shape \(2,\)"):
        policy(np.zeros((2, 5)), np.zeros((2, 4)), np.zeros(3))


# Noise


def test_noise_is_added_to_all_states_in_every_step(collected):
    system = Quadrotor("all")
    noise = [e.states[1:] - system.step(e.states[:-1], e.actions) for e in collected]
    pooled = np.concatenate(noise)
    np.testing.assert_allclose(pooled.std(axis=0), 0.01, rtol=0.05)
    np.testing.assert_allclose(pooled.mean(axis=0), 0, atol=5e-4)
    assert np.abs(np.corrcoef(pooled.T) - np.eye(12)).max() < 0.05
    whole = [n[:, 0] for n in noise if len(n) == 300]  # episodes have noise of their own
    assert np.abs(np.corrcoef(whole) - np.eye(len(whole))).max() < 0.4
    assert np.abs(np.corrcoef(pooled[:-1, 0], pooled[1:, 0])[0, 1]) < 0.05


def test_noise_is_a_parameter():
    small, large = (Quadrotor("all", noise=n).collect(3, 5, 0) for n in (1e-4, 0.02))
    calm = Quadrotor("all", noise=0.0).collect(3, 5, 0)
    for a, b, c in zip(small, large, calm, strict=True):
        np.testing.assert_allclose(
            (b.states - c.states)[1], 200 * (a.states - c.states)[1], rtol=1e-9
        )
        assert same_bits(a.states[0], b.states[0])


@settings(max_examples=10)
@given(
    seed=st.integers(0, 2**32 - 1),
    few=st.integers(1, 3),
    more=st.integers(1, 6),
    redraw=st.booleans(),
    states=st.sampled_from(sorted(SETS)),
)
def test_an_episode_does_not_depend_on_the_others(seed, few, more, redraw, states):
    system = Quadrotor(states, tilt_limit=0.3, redraw_terminated=redraw)  # many ends
    small = system.collect(few, 25, random_state=seed)
    large = system.collect(few + more, 25, random_state=seed)
    for a, b in zip(small, large, strict=False):
        assert same_bits(a.states, b.states)
        assert same_bits(a.actions, b.actions)
        assert same_bits(a.params, b.params)


def test_a_longer_collection_continues_the_same_episodes():
    short, long = (Quadrotor().collect(6, length, random_state=1) for length in (20, 60))
    for a, b in zip(short, long, strict=True):
        assert same_bits(a.states, b.states[: len(a.states)])


def test_seeds_decide_and_the_global_generator_is_left_alone():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    train, again, test = (Quadrotor().collect(5, 30, random_state=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    assert train == again
    assert not {tuple(e.states[0]) for e in train} & {tuple(e.states[0]) for e in test}
    assert not {tuple(e.params) for e in train} & {tuple(e.params) for e in test}


def test_a_rollout_has_the_noise_of_its_seed():
    system = Quadrotor()
    starts, theta = system.reset(4, 3), system.sample_params(4, 3)
    flown = system.rollout(starts, theta, 50, random_state=3)
    assert flown == system.collect(4, 50, random_state=3)  # positions do not act on attitudes
    assert flown != system.rollout(starts, theta, 50, random_state=4)
    assert system.rollout(starts, theta, 50) != system.rollout(starts, theta, 50)
    calm = replace(system, noise=0.0)
    assert calm.rollout(starts, theta, 50, random_state=3) == calm.rollout(starts, theta, 50)


def test_batched_flight_is_flight_one_by_one():
    system = Quadrotor("all", noise=0.0)
    starts, theta = system.reset(9, 0), system.sample_params(9, 0)
    together = system.rollout(starts, theta, 80)
    for i, episode in enumerate(together):
        alone = system.rollout(starts[i : i + 1], theta[i : i + 1], 80)[0]
        assert same_bits(alone.states, episode.states)
        assert same_bits(alone.actions, episode.actions)


def test_workers_change_nothing():
    system = Quadrotor(tilt_limit=0.35, redraw_terminated=True)
    serial = system.collect(7, 60, random_state=3)
    for backend in ("threading", "multiprocessing"):
        with parallel_config(backend=backend):
            assert system.collect(7, 60, random_state=3, n_jobs=2) == serial


# Ends


def test_an_episode_ends_at_the_first_tilt_beyond_the_limit(collected):
    assert collected.terminated.any()
    assert not collected.terminated.all()
    assert len(set(collected.lengths)) > 2
    for e in collected:
        tilted = (np.abs(e.states[1:, 6:8]) > np.deg2rad(45)).any(axis=1)
        assert not tilted[:-1].any()
        assert tilted[-1] == e.terminated
        assert e.terminated or e.length == 300


def test_the_limit_is_a_parameter():
    states = [still(**{name: sign * 0.5})[0] for name in ("roll", "pitch") for sign in (-1, 1)]
    assert not Quadrotor("all").is_terminal(states).any()
    assert Quadrotor("all", tilt_limit=0.49).is_terminal(states).all()
    assert not Quadrotor("all", tilt_limit=0.1).is_terminal(still(yaw=3.0)).any()


def test_redrawing_replaces_the_ended_episodes_only():
    kept = Quadrotor(d_range=(0.0, 60.0)).collect(20, 120, random_state=2)
    redrawn = Quadrotor(d_range=(0.0, 60.0), redraw_terminated=True).collect(20, 120, 2)
    assert 0 < kept.terminated.sum() < 20
    assert not redrawn.terminated.any()
    for a, b in zip(kept, redrawn, strict=True):
        assert same_bits(a.states, b.states) != a.terminated


def test_the_reward_is_one_for_a_level_craft():
    states = draw_states(np.random.default_rng(0), 24).reshape(2, 3, 4, 12)
    reward = Quadrotor("all").reward(states)
    up = rotation(states.reshape(-1, 12)).apply([0.0, 0.0, 1.0])[:, 2]  # the cosine of the tilt
    np.testing.assert_allclose(reward, up.reshape(2, 3, 4))
    assert Quadrotor("scored").reward(np.zeros(5)) == 1.0


# What is shown


@pytest.mark.parametrize("states", [*SETS, ("vz", "pitch"), ["yaw"]], ids=str)
def test_what_is_shown_does_not_change_what_is_flown(states, collected):
    names = SETS[states] if isinstance(states, str) else tuple(states)
    if "roll" in names:
        system = Quadrotor(states)
        episodes = system.collect(40, 300, random_state=4)
        assert system.state_names == episodes.state_names == names
        assert system.reset(3, 4).shape == (3, len(names))
        assert same_bits(system.reset(40, 4), np.stack([e.states[0] for e in episodes]))
    else:
        episodes = Quadrotor(states).collect(40, 300, random_state=4)
    assert episodes == collected.select_states(names)


@pytest.mark.parametrize("states", ["attitude", "observed", ("wy", "roll", "wx", "pitch", "wz")])
def test_closed_states_determine_their_own_future(states):
    system, whole = Quadrotor(states), Quadrotor("all")
    columns = [NAMES.index(name) for name in system.state_names]
    full = draw_states(np.random.default_rng(5), 20)
    actions = Airframe().hover + np.random.default_rng(6).uniform(-2000, 2000, (20, 4))
    assert same_bits(system.step(full[:, columns], actions), whole.step(full, actions)[:, columns])
    others = np.setdiff1d(np.arange(12), columns)
    full[:, others] = 0.3  # what is not shown does not matter
    assert same_bits(system.step(full[:, columns], actions), whole.step(full, actions)[:, columns])
    seen = []

    def policy(states, params, times):
        seen.append(states)
        return actions[: len(states)]

    flown = system.rollout(full[:, columns], None, 1, policy=policy)
    assert same_bits(seen[0], full[:, columns])
    assert flown.state_names == system.state_names


@pytest.mark.parametrize(
    ("states", "missing"),
    [
        ("scored", "wx, wy, wz"),
        (("roll", "pitch", "wx", "wy"), "wz"),
        (("z", "wx", "wy", "wz"), "vz, roll, pitch"),
        (("yaw", "wx", "wy", "wz"), "roll, pitch"),
        (("vx", "vy", "roll", "pitch", "wx", "wy", "wz"), "yaw"),
    ],
    ids=str,
)
def test_states_that_are_not_closed_cannot_start(states, missing):
    system = Quadrotor(states)
    start = np.zeros((1, len(system.state_names)))
    for call in (
        lambda: system.step(start, np.zeros((1, 4))),
        lambda: system.rollout(start, GAINS, 5),
    ):
        with pytest.raises(ValueError, match=f"go also depends on {missing}, so nothing can"):
            call()
    system.collect(2, 3, random_state=0)


def test_the_table_of_dependences_is_that_of_the_equations():
    from trajlearn.envs.quadrotor import DEPENDS_ON

    rng = np.random.default_rng(7)
    states = draw_states(rng, 30)
    single = Quadrotor("all", airframe=LOPSIDED, dt=1e-3, n_substeps=1)
    commands = 30_000 + rng.uniform(-2000, 2000, (30, 4))
    for j, name in enumerate(NAMES):
        moved = states.copy()
        moved[:, j] += 0.1
        change = single.step(moved, commands) - single.step(states, commands)
        change[:, j] = 0
        hit = {NAMES[k] for k in np.flatnonzero(np.abs(change).max(axis=0) > 1e-9)}
        assert hit == {k for k, needs in DEPENDS_ON.items() if name in needs}


# Draws and settings


def test_draws_fill_their_ranges():
    system = Quadrotor("all", p_range=(10, 20), d_range=(-1, 3))
    starts = system.reset(1000, random_state=0)
    half = np.array([0, 0, 0, 0.01, 0.01, 0.01, np.pi / 8, np.pi / 8, 0, 0.01, 0.01, 0.01])
    assert (np.abs(starts) <= half).all()
    assert (np.abs(starts).max(axis=0) >= 0.98 * half).all()
    params = system.sample_params(1000, random_state=0)
    low, high = system.param_bounds.T
    np.testing.assert_array_equal(low, [10, -1, 10, -1])
    np.testing.assert_array_equal(high, [20, 3, 20, 3])
    assert (params >= low).all()
    assert (params <= high).all()
    assert (np.ptp(params, axis=0) > 0.98 * (high - low)).all()
    assert np.abs(np.corrcoef(params.T) - np.eye(4)).max() < 0.15


def test_the_dataset_names_its_columns():
    episodes = Quadrotor().collect(2, 3, random_state=0)
    assert episodes.action_names == ("motor_1", "motor_2", "motor_3", "motor_4")
    assert episodes.param_names == ("p_pitch", "d_pitch", "p_roll", "d_roll")
    np.testing.assert_allclose(episodes[0].times, [0, 0.05, 0.1, 0.15])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"states": "five"}, r"states must be one of \['attitude', 'scored', 'observed', 'all'\]"),
        ({"states": ()}, "states must be one of"),
        ({"states": ("roll", "roll")}, "tuple of different names"),
        ({"states": ("roll", "p")}, "tuple of different names"),
        ({"noise": -1.0}, "noise must be a finite number of at least 0"),
        ({"noise": np.nan}, "noise must be a finite number of at least 0"),
        ({"noise": "a"}, "noise must be a finite number of at least 0; got 'a'"),
        ({"noise": True}, "noise must be a finite number of at least 0; got True"),
        ({"states": None}, "states must be one of .* got None"),
        ({"states": [["roll"]]}, "states must be one of"),
        ({"p_range": "ab"}, r"p_range must be two finite numbers .* got 'ab'"),
        ({"d_range": ((1,), (2, 3))}, "d_range must be two finite numbers"),
        ({"tilt_limit": None}, "tilt_limit must be between 0 and pi / 2"),
        ({"dt": "1"}, "dt must be a finite number greater than 0; got '1'"),
        ({"p_range": (2.0, 1.0)}, r"p_range must be two finite numbers \(low, high\)"),
        ({"d_range": (0.0, np.inf)}, r"d_range must be two finite numbers \(low, high\)"),
        ({"tilt_limit": np.pi / 2}, "tilt_limit must be between 0 and pi / 2"),
        ({"integrator": "rk45"}, "integrator must be 'euler' or 'rk4'; got 'rk45'"),
        ({"dt": 0.0}, "dt must be a finite number greater than 0"),
        ({"n_substeps": 2.5}, "n_substeps must be an integer of at least 1"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Quadrotor(**arguments)


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"mass": 0.0}, "mass must be a finite number greater than 0"),
        ({"inertia": (1e-5, 1e-5)}, "inertia must be 3 finite numbers greater than 0"),
        ({"inertia": (1e-5, 0.0, 1e-5)}, "inertia must be 3 finite numbers greater than 0"),
        ({"thrust": (0.0, 0.0)}, "thrust must be 2 finite numbers greater than 0"),
        ({"thrust": (1.0, -0.1)}, "thrust must not be negative"),
        ({"gravity": np.inf}, "gravity must be a finite number greater than 0"),
        ({"mass": 0.07}, r"the weight of 0.687 N is more than the motors lift, 0.61 N"),
    ],
)
def test_impossible_airframes_are_refused(constants, message):
    with pytest.raises(ValueError, match=message):
        Airframe(**constants)


def test_bad_shapes_are_named():
    system = Quadrotor()
    with pytest.raises(ValueError, match=r"initial_states must have shape \(n, 5\) \(roll, pitch"):
        system.rollout(np.zeros((1, 12)), GAINS, 5)
    with pytest.raises(ValueError, match=r"params must have shape \(1, 4\)"):
        system.rollout(np.zeros((1, 5)), np.zeros(6), 5)
    with pytest.raises(ValueError, match=r"states must have shape \(\.\.\., 5\)"):
        system.reward(np.zeros(12))
    with pytest.raises(ValueError, match=r"lack roll and pitch"):
        Quadrotor(("vx", "vy")).reward(np.zeros(2))


def test_a_system_is_an_immutable_value_that_can_be_copied():
    system = Quadrotor(["roll", "wx"], p_range=[10, 20], airframe=LOPSIDED)
    for twin in (pickle.loads(pickle.dumps(system)), copy.deepcopy(system)):
        assert twin == system != Quadrotor()
        assert hash(twin) == hash(system)
        assert twin.collect(2, 10, 0) == system.collect(2, 10, 0)
    assert system.states == ("roll", "wx")
    assert "states=('roll', 'wx')" in repr(system)
    with pytest.raises(AttributeError):
        system.noise = 0.0
    assert Quadrotor().policy == AttitudePD(SETS["attitude"], Airframe().hover)
    assert Quadrotor().dt == 0.05
