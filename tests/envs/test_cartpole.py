"""The cartpole against independent mechanics, and the contract of every environment.

The plant is checked against the equations of motion of a cart with a uniform rod, written
here in mass-matrix form and solved numerically, which shares no formula with the package.
"""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trajlearn.envs import Cartpole, Environment
from trajlearn.policies import LinearFeedback

G, CART, POLE, L = 9.8, 1.0, 0.1, 0.5
MODES = {
    "stable": (0.5, 1.5),
    "code": (1.0, 1.5),
    "periodic": (0.0, 0.75),
    "unstable": (-0.75, 0.75),
}
ANGLE_LIMIT, POSITION_LIMIT = np.deg2rad(24), 9.6

free_states = st.tuples(*(st.floats(-v, v) for v in (9.0, 10.0, 3.1, 10.0)))


def equations_of_motion(state, force):
    """Mass matrix times accelerations equals generalised forces (Lagrange)."""
    _, x_dot, theta, theta_dot = state
    mass = np.array(
        [[CART + POLE, POLE * L * np.cos(theta)], [POLE * L * np.cos(theta), 4 / 3 * POLE * L**2]]
    )
    forces = [force + POLE * L * theta_dot**2 * np.sin(theta), POLE * G * L * np.sin(theta)]
    x_ddot, theta_ddot = np.linalg.solve(mass, forces)
    return np.array([x_dot, x_ddot, theta_dot, theta_ddot])


def energy(states):
    _, x_dot, theta, theta_dot = np.moveaxis(np.asarray(states), -1, 0)
    kinetic = (
        0.5 * (CART + POLE) * x_dot**2
        + POLE * L * x_dot * theta_dot * np.cos(theta)
        + 2 / 3 * POLE * L**2 * theta_dot**2
    )
    return kinetic + POLE * G * L * np.cos(theta)


def energy_gradient(state):
    _, x_dot, theta, theta_dot = state
    sin, cos = np.sin(theta), np.cos(theta)
    return np.array(
        [
            0.0,
            (CART + POLE) * x_dot + POLE * L * theta_dot * cos,
            -POLE * L * x_dot * theta_dot * sin - POLE * G * L * sin,
            POLE * L * x_dot * cos + 4 / 3 * POLE * L**2 * theta_dot,
        ]
    )


def same_bits(a, b):
    return a.shape == b.shape and a.tobytes() == b.tobytes()


# The plant


@given(state=free_states, action=st.floats(-1, 1))
def test_derivatives_agree_with_the_mass_matrix_form(state, action):
    got = Cartpole().derivatives([state], [[action]])[0]
    np.testing.assert_allclose(got, equations_of_motion(state, 10 * action), rtol=1e-10, atol=1e-10)


@given(state=free_states, action=st.floats(-1, 1))
def test_the_force_is_the_only_source_of_energy(state, action):
    rate = energy_gradient(state) @ Cartpole().derivatives([state], [[action]])[0]
    assert rate == pytest.approx(10 * action * state[1], abs=1e-9)


@given(state=free_states, action=st.floats(-1, 1), dt=st.floats(1e-4, 0.1))
def test_a_step_is_one_explicit_euler_step(state, action, dt):
    system = Cartpole(dt=dt)
    s, a = np.array([state]), np.array([[action]])
    assert same_bits(system.step(s, a), s + dt * system.derivatives(s, a))


@pytest.mark.parametrize(
    ("system", "start", "gain"),
    [
        (Cartpole(linearization="exact"), [0.1, 0.0, 0.05, 0.0], None),
        (Cartpole(), [0.5, 0.0, 0.2, 0.0], None),
        (Cartpole(limit_scale=np.inf), [0.0, 0.0, 0.3, 0.0], np.zeros(4)),
    ],
    ids=["exact gain", "paper gain, saturated", "free fall"],
)
def test_the_euler_error_halves_with_the_step(system, start, gain):
    gain = system.lqr_gain if gain is None else gain

    def closed_loop(_, state):
        return equations_of_motion(state, 10 * np.clip(-gain @ state, -1, 1))

    truth = solve_ivp(closed_loop, (0, 1), start, rtol=1e-10, atol=1e-12, max_step=0.01).y[:, -1]
    errors = []
    for steps in (500, 1000, 2000):
        fine = Cartpole(limit_scale=system.limit_scale, dt=1 / steps)
        end = fine.rollout([start], gain, steps, policy=system.policy)[0].states[-1]
        errors.append(np.abs(end - truth).max())
    assert errors[0] < 0.1
    assert 1.7 < errors[0] / errors[1] < 2.3
    assert 1.7 < errors[1] / errors[2] < 2.3


def test_the_unactuated_pole_keeps_its_energy_as_the_step_shrinks():
    drifts = []
    for steps in (1000, 2000):
        system = Cartpole(limit_scale=np.inf, dt=2 / steps)
        episode = system.rollout([[0.0, 0.3, 0.5, 0.0]], np.zeros(4), steps)[0]
        assert np.ptp(episode.states[:, 2]) > 2  # it swings through
        levels = energy(episode.states)
        drifts.append(np.abs(levels - levels[0]).max())
    assert drifts[1] < 0.6 * drifts[0]
    assert drifts[1] < 0.02


def test_constants_of_time_and_limits():
    assert Cartpole().dt == 0.02
    edge = np.array([[POSITION_LIMIT, 0, ANGLE_LIMIT, 0], [-POSITION_LIMIT, 0, -ANGLE_LIMIT, 0]])
    beyond = np.array([[9.61, 0, 0, 0], [-9.61, 0, 0, 0], [0, 0, 0.4189, 0], [0, 0, -0.4189, 0]])
    assert not Cartpole().is_terminal(edge).any()
    assert Cartpole().is_terminal(beyond).all()
    assert not Cartpole(limit_scale=2.0).is_terminal(beyond).any()
    assert Cartpole(limit_scale=2.0).is_terminal(2 * beyond).all()
    assert not Cartpole(limit_scale=np.inf).is_terminal(1e9 * beyond).any()


# The gain


def riccati_gain(a, b, q, r):
    """LQR gain from the stable eigenvectors of the Hamiltonian matrix."""
    hamiltonian = np.block([[a, -b @ b.T / r], [-q, -a.T]])
    values, vectors = np.linalg.eig(hamiltonian)
    stable = vectors[:, values.real < 0]
    solution = np.real(stable[len(a) :] @ np.linalg.inv(stable[: len(a)]))
    return (b.T @ solution / r)[0]


@pytest.mark.parametrize(
    ("linearization", "published"),
    [
        ("paper", [-0.7071, -4.2906, -37.4540, -8.0665]),
        ("exact", [-0.707, -0.840, -5.624, -1.441]),
    ],
)
def test_the_gain_solves_the_riccati_equation(linearization, published):
    system = Cartpole(linearization=linearization)
    expected = riccati_gain(*system.linearize(), np.diag([0.5, 0.05, 1.0, 0.05]), 1.0)
    np.testing.assert_allclose(system.lqr_gain, expected, rtol=1e-6)
    np.testing.assert_allclose(system.lqr_gain, published, atol=5e-4)


def finite_differences(width=1e-5):
    system = Cartpole()
    points = np.concatenate([np.eye(5), -np.eye(5)]) * width
    rates = system.derivatives(points[:, :4], points[:, 4:])
    jacobian = (rates[:5] - rates[5:]).T / (2 * width)
    return jacobian[:, :4], jacobian[:, 4:]


def test_the_exact_linearisation_is_the_jacobian_of_the_plant():
    for matrix, expected in zip(
        Cartpole(linearization="exact").linearize(), finite_differences(), strict=True
    ):
        np.testing.assert_allclose(matrix, expected, atol=1e-7)


def test_the_papers_linearisation_is_as_printed_and_not_the_jacobian():
    a, b = Cartpole().linearize()
    np.testing.assert_allclose(a, [[0, 1, 0, 0], [0, 0.98, 0, 0], [0, 0, 0, 1], [0, 0, 21.56, 0]])
    np.testing.assert_allclose(b, [[0], [1], [0], [-2]])
    true_a, true_b = finite_differences()
    assert np.abs(a - true_a).max() > 0.5
    assert np.abs(b - true_b).max() > 5


@pytest.mark.parametrize(
    ("linearization", "eigenvalues"),
    [
        ("paper", [-68.66, -6.095, -1.230, -0.197]),
        ("exact", [-4.703 - 0.372j, -4.703 + 0.372j, -1.744 - 1.230j, -1.744 + 1.230j]),
    ],
)
def test_the_closed_loop_of_the_true_plant_is_stable(linearization, eigenvalues):
    a, b = finite_differences()
    loop = a - b @ Cartpole(linearization=linearization).lqr_gain[None]
    values = np.sort_complex(np.linalg.eigvals(loop))
    np.testing.assert_allclose(values, eigenvalues, rtol=2e-3)
    assert (np.abs(1 + 0.02 * values) < 1).all()  # also when sampled every 20 ms


def test_the_linearisation_changes_what_the_data_show():
    start, drifts = [[1.0, 0.0, 0.1, 0.0]], {}
    for linearization in ("paper", "exact"):
        system = Cartpole(linearization=linearization)
        drifts[linearization] = system.rollout(start, system.lqr_gain, 200)[0].states[-1, 0]
    assert abs(drifts["exact"]) < 0.05 < 0.3 < abs(drifts["paper"])


# Draws


@pytest.mark.parametrize("mode", MODES)
def test_gains_are_drawn_from_the_interval_of_their_mode(mode):
    system = Cartpole(mode)
    gains = system.sample_params(500, random_state=0)
    low, high = MODES[mode]
    factors = gains / system.lqr_gain
    assert (factors.min(axis=0) >= low).all()
    assert (factors.max(axis=0) <= high).all()
    assert (np.ptp(factors, axis=0) > 0.95 * (high - low)).all()
    correlation = np.corrcoef(factors.T) - np.eye(4)
    assert np.abs(correlation).max() < 0.2  # one factor an element, not one for all
    lower, upper = system.param_bounds.T
    assert (lower < upper).all()
    assert (gains >= lower).all()
    assert (gains <= upper).all()


def test_initial_states_fill_their_box():
    starts = Cartpole().reset(1000, random_state=0)
    half = np.array([1.0, 0.05, 1.0, 0.05])
    assert (np.abs(starts) <= half).all()
    assert (np.abs(starts).max(axis=0) > 0.98 * half).all()
    assert np.abs(starts.mean(axis=0) / half).max() < 0.1


def test_collect_starts_from_reset_with_sampled_gains_in_every_mode():
    starts = Cartpole().reset(5, random_state=3)
    for mode in MODES:
        system = Cartpole(mode)
        episodes = system.collect(5, 4, random_state=3)
        assert same_bits(np.stack([e.states[0] for e in episodes]), starts)
        assert same_bits(np.stack([e.params for e in episodes]), system.sample_params(5, 3))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    few=st.integers(1, 4),
    more=st.integers(1, 12),
    redraw=st.booleans(),
    scale=st.sampled_from([1.0, np.inf]),
)
def test_an_episode_does_not_depend_on_the_others(seed, few, more, redraw, scale):
    system = Cartpole(redraw_terminated=redraw, limit_scale=scale)
    small = system.collect(few, 25, random_state=seed)
    large = system.collect(few + more, 25, random_state=seed)
    for a, b in zip(small, large, strict=False):
        assert same_bits(a.states, b.states)
        assert same_bits(a.actions, b.actions)
        assert same_bits(a.params, b.params)
    for episode in large:
        alone = system.rollout(episode.states[:1], episode.params, 25)[0]
        assert same_bits(alone.states, episode.states)


def test_a_longer_collection_continues_the_same_episodes():
    short = Cartpole().collect(10, 20, random_state=1)
    long = Cartpole().collect(10, 60, random_state=1)
    for a, b in zip(short, long, strict=True):
        assert same_bits(a.states, b.states[: len(a.states)])


def test_seeds():
    system = Cartpole()
    train, again, test = (system.collect(10, 30, random_state=s) for s in (0, 0, 1))
    assert train == again
    starts = [{tuple(e.states[0]) for e in ds} for ds in (train, test)]
    assert not starts[0] & starts[1]
    assert not {tuple(e.params) for e in train} & {tuple(e.params) for e in test}
    generator = np.random.RandomState(0)
    first, second = (system.collect(10, 30, random_state=generator) for _ in range(2))
    assert first == train
    assert first != second
    assert system.collect(3, 5) != system.collect(3, 5)


# Episodes


@pytest.fixture(scope="module")
def mixed():
    """Episodes of all modes and lengths, some of them ended early."""
    return [(mode, Cartpole(mode), Cartpole(mode).collect(30, 120, 7)) for mode in MODES]


def test_rows_are_aligned_bit_for_bit(mixed):
    for _, system, episodes in mixed:
        for e in episodes:
            theta = np.tile(e.params, (e.length, 1))
            assert same_bits(system.policy(e.states[:-1], theta, e.times[:-1]), e.actions)
            assert same_bits(system.step(e.states[:-1], e.actions), e.states[1:])
            assert same_bits(system.reward(e.states[1:]), e.rewards)
            assert e.states.shape == (e.length + 1, 4)
            np.testing.assert_array_equal(e.times, np.arange(e.length + 1) * 0.02)


def test_actions_are_logged_as_applied(mixed):
    for _, _, episodes in mixed:
        actions = np.concatenate([e.actions for e in episodes])
        assert actions.min() == -1.0
        assert actions.max() == 1.0


def test_the_reward_is_minus_the_squared_distances():
    states = np.random.default_rng(0).normal(size=(2, 3, 5, 4))
    reward = Cartpole().reward(states)
    assert reward.shape == (2, 3, 5)
    np.testing.assert_allclose(reward, -(states[..., 0] ** 2) - states[..., 2] ** 2)
    assert Cartpole().reward([3.0, 9.0, 4.0, 9.0]) == -25.0


def test_an_episode_ends_at_the_first_state_beyond_a_limit(mixed):
    for mode, _, episodes in mixed:
        terminated = np.array([e.terminated for e in episodes])
        assert terminated.any(), mode
        assert not terminated.all(), mode
        for e in episodes:
            outside = (np.abs(e.states[1:, 0]) > 9.6) | (np.abs(e.states[1:, 2]) > ANGLE_LIMIT)
            assert not outside[:-1].any()
            assert outside[-1] == e.terminated
            assert e.terminated or e.length == 120


def test_the_cart_position_can_end_an_episode():
    episode = Cartpole().rollout([[9.5, 20.0, 0.0, 0.0]], np.zeros(4), 10)[0]
    assert episode.terminated
    assert episode.length == 1
    assert episode.states[-1, 0] == pytest.approx(9.9)


def test_a_start_beyond_the_limit_is_kept_as_one_step():
    system = Cartpole()
    starts = [[0, 0, 0.9, 0], [0, 0, 0.1, 0], [0, 0, ANGLE_LIMIT + 1e-4, -0.05]]
    fallen, upright, returning = system.rollout(starts, system.lqr_gain, 50)
    assert fallen.terminated
    assert fallen.length == 1
    assert fallen.rewards[0] == system.reward(fallen.states[1])
    assert not upright.terminated
    assert upright.length == 50
    # The rule looks at the states stepped into, and the first step leads back inside.
    assert abs(returning.states[1, 2]) < ANGLE_LIMIT
    assert returning.length > 1


def test_redrawing_replaces_the_ended_episodes_only():
    kept = Cartpole().collect(40, 200, random_state=2)
    redrawn = Cartpole(redraw_terminated=True).collect(40, 200, random_state=2)
    assert not redrawn.terminated.any()
    assert (redrawn.lengths == 200).all()
    for a, b in zip(kept, redrawn, strict=True):
        assert same_bits(a.states, b.states) != a.terminated
        assert same_bits(a.params, b.params) != a.terminated
    # Survivorship: the initial angle is truncated.
    assert max(abs(e.states[0, 2]) for e in redrawn) < 0.43
    assert max(abs(e.states[0, 2]) for e in kept) > 0.9


def test_redrawing_gives_up_with_a_clear_error():
    class Doomed(Cartpole):
        max_draws = 3

        def is_terminal(self, states):
            return np.ones(np.shape(states)[:-1], dtype=bool)

    with pytest.raises(ValueError, match=r"4 of 4 episodes .*length=10 in each of 3 draws"):
        Doomed(redraw_terminated=True).collect(4, 10, random_state=0)
    assert Doomed().collect(4, 10, random_state=0).terminated.all()


@pytest.mark.parametrize(
    ("mode", "scale", "expected"),
    [("stable", 1, 0.39), ("code", 1, 0.42), ("periodic", 1, 0.29), ("unstable", 2, 0.09)],
)
def test_the_share_of_full_episodes_is_that_of_the_published_setting(mode, scale, expected):
    episodes = Cartpole(mode, limit_scale=scale).collect(1500, 200, random_state=0)
    assert np.mean(~episodes.terminated) == pytest.approx(expected, abs=0.04)


# Flying what the user asks for


def test_rollout_with_a_policy_of_its_own():
    system = Cartpole(limit_scale=np.inf)
    times = []

    def swing(states, params, at):
        times.append(at)
        assert params.shape == (2, 0)
        return 3 * np.sin(at)[:, None]

    episodes = system.rollout(np.zeros((2, 4)), None, 100, policy=swing)
    np.testing.assert_allclose(np.array(times)[:, 0], np.arange(100) * 0.02)
    expected = np.clip(3 * np.sin(np.arange(100) * 0.02), -1, 1)
    np.testing.assert_allclose(episodes[1].actions[:, 0], expected)
    assert not episodes.has_params


def test_rollout_takes_one_parameter_row_for_all_or_one_each():
    system = Cartpole()
    starts = system.reset(3, 0) * [1, 1, 0.2, 1]
    shared = system.rollout(starts, system.lqr_gain, 20)
    each = system.rollout(starts, np.tile(system.lqr_gain, (3, 1)), 20)
    assert shared == each
    other = system.rollout(starts, 0.5 * system.lqr_gain, 20)
    assert other != shared
    wide = system.rollout(starts, np.ones(8), 20, policy=lambda s, p, t: p[:, 7:] * 0.5)
    assert wide.params.shape == (3, 8)
    assert (wide.actions == 0.5).all()


def test_the_dataset_names_its_columns():
    episodes = Cartpole().collect(2, 3, random_state=0)
    assert episodes.state_names == ("x", "x_dot", "theta", "theta_dot")
    assert episodes.action_names == ("force",)
    assert episodes.param_names == ("k_x", "k_x_dot", "k_theta", "k_theta_dot")


def test_a_system_is_an_immutable_picklable_value():
    system = Cartpole("periodic", linearization="exact", redraw_terminated=True, dt=0.01)
    copy = pickle.loads(pickle.dumps(system))
    assert copy == system != Cartpole("periodic")
    assert copy.collect(2, 10, 0) == system.collect(2, 10, 0)
    assert system.policy == LinearFeedback(bounds=(-1.0, 1.0))
    assert "gains='periodic'" in repr(system)
    with pytest.raises(AttributeError):
        system.gains = "stable"
    with pytest.raises(ValueError, match="read-only"):
        system.lqr_gain[0] = 1.0


class Drift(Environment):
    """The least a system must bring along: two integrators that never end an episode."""

    state_names = ("p", "q")
    action_names = ("u", "v")
    param_names = ("c",)
    dt = 0.5
    redraw_terminated = True
    action_bounds = np.array([[-1.0, 1.0], [0.0, 2.0]])
    param_bounds = np.array([[0.0, 3.0]])

    @property
    def policy(self):
        return lambda states, params, times: np.repeat(params, 2, axis=1)

    def reward(self, states):
        return self._checked_states(states).sum(axis=-1)

    def _draw_initial_state(self, generator):
        return generator.normal(size=2)

    def _draw_params(self, generator):
        return generator.uniform(0, 3, size=1)

    def _step(self, states, actions):
        return states + self.dt * actions


def test_a_new_system_gets_episodes_from_the_base_class():
    episodes = Drift().collect(6, 4, random_state=0)
    assert (episodes.lengths == 4).all()
    for e in episodes:
        c = e.params[0]
        np.testing.assert_allclose(e.actions, np.tile([min(c, 1), min(c, 2)], (4, 1)))
        moved = e.states[0] + 0.5 * np.arange(5)[:, None] * e.actions[0]
        np.testing.assert_allclose(e.states, moved)
        np.testing.assert_allclose(e.rewards, moved[1:].sum(axis=1))


# Bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gains": "chaotic"}, r"gains must be one of .*'periodic'.*; got 'chaotic'"),
        ({"linearization": "true"}, "linearization must be 'paper' or 'exact'"),
        ({"limit_scale": 0.0}, "limit_scale must be greater than 0"),
        ({"limit_scale": np.nan}, "limit_scale must be greater than 0"),
        ({"dt": 0.0}, "dt must be a finite number greater than 0"),
        ({"dt": np.inf}, "dt must be a finite number greater than 0"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Cartpole(**arguments)


@pytest.mark.parametrize("value", [0, -3, 2.5, "4", None, True])
def test_counts_must_be_positive_integers(value):
    system = Cartpole()
    with pytest.raises(ValueError, match="n_episodes must be an integer of at least 1"):
        system.collect(value, 10, random_state=0)
    with pytest.raises(ValueError, match="length must be an integer of at least 1"):
        system.collect(10, value, random_state=0)
    with pytest.raises(ValueError, match="length must be an integer of at least 1"):
        system.rollout(np.zeros((1, 4)), np.zeros(4), value)
    with pytest.raises(ValueError, match="n_episodes must be an integer of at least 1"):
        system.reset(value)


@pytest.mark.parametrize(
    ("starts", "params", "message"),
    [
        (np.zeros((2, 3)), np.zeros((2, 4)), r"initial_states must have shape \(n, 4\)"),
        (np.zeros(4), np.zeros((1, 4)), r"initial_states must have shape \(n, 4\)"),
        (np.zeros((0, 4)), np.zeros((0, 4)), "with n >= 1"),
        ([[0, 0, 0, 0], [0, np.nan, 0, 0]], np.zeros((2, 4)), "initial_states .* row 1 holds NaN"),
        ([[np.inf, 0, 0, 0]], np.zeros((1, 4)), "initial_states .* row 0"),
        (np.zeros((2, 4)), np.zeros((2, 5)), r"params must have shape \(2, 4\).*got \(2, 5\)"),
        (np.zeros((2, 4)), np.zeros(3), r"params must have shape \(2, 4\).*got \(3,\)"),
        (np.zeros((2, 4)), np.zeros((3, 4)), r"params must have shape \(2, 4\)"),
        (np.zeros((2, 4)), 1.0, r"params must have shape \(2, 4\)"),
        (np.zeros((1, 4)), [[0, 0, np.nan, 0]], "params must be finite; row 0"),
        (np.zeros((1, 4)), None, "params is None, but the system's own policy needs them"),
    ],
)
def test_bad_starts_and_params_are_named(starts, params, message):
    with pytest.raises(ValueError, match=message):
        Cartpole().rollout(starts, params, 5)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda s, p, t: np.zeros(len(s)), r"the policy's actions at step 0 must have shape"),
        (lambda s, p, t: np.zeros((len(s), 2)), r"must have shape \(1, 1\)"),
        (lambda s, p, t: np.where(t[:, None] > 0.05, np.nan, 0), "actions at step 3 must be fin"),
    ],
)
def test_bad_policies_are_named(policy, message):
    with pytest.raises(ValueError, match=message):
        Cartpole().rollout(np.zeros((1, 4)), None, 5, policy=policy)


def test_bad_states_and_actions_of_a_step_are_named():
    system = Cartpole()
    with pytest.raises(ValueError, match=r"states must have shape \(n, 4\)"):
        system.step(np.zeros(4), np.zeros((1, 1)))
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 1\)"):
        system.step(np.zeros((2, 4)), np.zeros(2))
    with pytest.raises(ValueError, match="actions must be finite; row 1"):
        system.derivatives(np.zeros((2, 4)), [[0], [np.nan]])
    with pytest.raises(ValueError, match=r"states must have shape \(\.\.\., 4\)"):
        system.reward(np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"states must have shape \(\.\.\., 4\)"):
        system.is_terminal(np.zeros(()))


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_simulation_that_blows_up_says_so():
    system = Cartpole(limit_scale=np.inf, dt=1e9)
    with pytest.raises(ValueError, match="left the finite numbers at step"):
        system.rollout([[0.0, 0.0, 0.1, 1.0]], np.zeros(4), 100)
