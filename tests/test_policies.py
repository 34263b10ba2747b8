"""Policies against independent computations, in batches and alone, and on bad input."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn.policies import PID, LinearFeedback, NetworkPolicy


@given(
    n=st.integers(1, 20),
    d_s=st.integers(1, 12),
    d_a=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_linear_feedback_is_minus_the_clipped_matrix_product(n, d_s, d_a, seed):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, d_s))
    gains = rng.normal(size=(n, d_a, d_s))
    expected = np.stack([np.clip(-k @ s, -0.5, 2.0) for k, s in zip(gains, states, strict=True)])
    policy = LinearFeedback(bounds=(-0.5, 2.0))
    actions = policy(states, gains.reshape(n, -1), np.zeros(n))
    assert actions.shape == (n, d_a)
    np.testing.assert_allclose(actions, expected, rtol=1e-12, atol=1e-12)


@given(
    n=st.integers(1, 40),
    d_s=st.integers(1, 24),
    d_a=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_row_gets_the_same_bits_alone_as_in_a_batch(n, d_s, d_a, seed):
    rng = np.random.default_rng(seed)
    states, gains = rng.normal(size=(n, d_s)), rng.normal(size=(n, d_a * d_s))
    policy = LinearFeedback(bounds=None)
    together = policy(states, gains, np.zeros(n))
    alone = [policy(states[i : i + 1], gains[i : i + 1], np.zeros(1)) for i in range(n)]
    np.testing.assert_array_equal(together, np.concatenate(alone))


def test_bounds_clip_and_none_does_not():
    states, gains = np.array([[1.0], [-1.0]]), np.full((2, 1), 5.0)
    assert LinearFeedback()(states, gains, np.zeros(2)).tolist() == [[-1.0], [1.0]]
    assert LinearFeedback(bounds=(-3, 2))(states, gains, np.zeros(2)).tolist() == [[-3.0], [2.0]]
    assert LinearFeedback(bounds=None)(states, gains, np.zeros(2)).tolist() == [[-5.0], [5.0]]


def test_no_rows_give_no_actions():
    actions = LinearFeedback()(np.empty((0, 4)), np.empty((0, 8)), np.empty(0))
    assert actions.shape == (0, 2)


def test_linear_feedback_is_an_immutable_picklable_value():
    policy = LinearFeedback(bounds=[-2, 2])
    assert pickle.loads(pickle.dumps(policy)) == policy == LinearFeedback(bounds=(-2.0, 2.0))
    assert hash(policy) == hash(LinearFeedback(bounds=(-2.0, 2.0)))
    assert policy != LinearFeedback()
    with pytest.raises(AttributeError):
        policy.bounds = None


@pytest.mark.parametrize("bounds", [(1.0, -1.0), (0.0, 0.0), (np.nan, 1.0), 1.0, (1, 2, 3), "ab"])
def test_bad_bounds_are_refused(bounds):
    with pytest.raises(ValueError, match="bounds must"):
        LinearFeedback(bounds=bounds)


@pytest.mark.parametrize(
    ("states", "params", "times", "message"),
    [
        (np.zeros(4), np.zeros((1, 4)), np.zeros(1), "states must have shape"),
        (np.zeros((2, 0)), np.zeros((2, 4)), np.zeros(2), "states must have shape"),
        (np.zeros((2, 4)), np.zeros((2, 5)), np.zeros(2), "params must have shape"),
        (np.zeros((2, 4)), np.zeros((2, 0)), np.zeros(2), "params must have shape"),
        (np.zeros((2, 4)), np.zeros((1, 4)), np.zeros(2), "each of the 2 rows"),
        (np.zeros((2, 4)), np.zeros(4), np.zeros(2), "params must have shape"),
        (np.zeros((2, 4)), np.zeros((2, 4)), np.zeros(3), "times must have shape"),
        (np.zeros((2, 4)), np.zeros((2, 4)), 0.0, "times must have shape"),
    ],
)
def test_wrong_shapes_are_named(states, params, times, message):
    with pytest.raises(ValueError, match=message):
        LinearFeedback()(states, params, times)


# PID


def joint_states(rng, n, m):
    angles = rng.uniform(-3.1, 3.1, size=(n, m))
    return angles, np.hstack([np.cos(angles), np.sin(angles), rng.normal(size=(n, m))])


@given(n=st.integers(1, 12), m=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_pid_is_the_law_written_out_joint_by_joint(n, m, seed):
    rng = np.random.default_rng(seed)
    angles, states = joint_states(rng, n, m)
    params = rng.normal(size=(n, 3 * m))
    got = {
        "angle": PID(dt=0.1, p_scale=3.0, bounds=(-0.5, 2.0))(states, params, np.zeros(n)),
        "cos": PID("cos", dt=0.1, p_scale=3.0, bounds=(-0.5, 2.0))(states, params, np.zeros(n)),
    }
    assert got["cos"].shape == (n, m)
    for i in range(n):
        for j in range(m):
            p, d, target = params[i, j::m]
            q, velocity = angles[i, j], states[i, 2 * m + j]
            u = 3 * p * (target - q) - d * 0.1 * velocity
            assert got["angle"][i, j] == pytest.approx(min(max(u, -0.5), 2.0), abs=1e-10)
            u = 3 * p * (target - np.cos(q)) + d * 0.1 * np.sin(q) * velocity
            assert got["cos"][i, j] == pytest.approx(min(max(u, -0.5), 2.0), abs=1e-10)


@pytest.mark.parametrize("feedback", ["angle", "cos"])
def test_the_derivative_term_is_the_change_of_the_error_over_dt(feedback):
    rng = np.random.default_rng(0)
    angles, states = joint_states(rng, 6, 2)
    velocity = states[:, 4:]
    params = np.hstack([np.zeros((6, 2)), np.ones((6, 4))])
    dt = 1e-5
    measure = np.cos if feedback == "cos" else np.asarray
    change = -(measure(angles) - measure(angles - dt * velocity))
    got = PID(feedback, dt=dt, bounds=None)(states, params, np.ones(6))
    np.testing.assert_allclose(got, change, rtol=1e-3)
    once = PID(feedback, dt=1.0, bounds=None)(states, params, np.ones(6))
    np.testing.assert_allclose(once * dt, got)


def test_pid_pushes_towards_the_target_and_against_the_motion():
    def act(angle, velocity, target):
        state = np.array([[np.cos(angle), np.sin(angle), velocity]])
        return PID(bounds=None)(state, np.array([[1.0, 1.0, target]]), np.zeros(1))[0, 0]

    assert act(0.0, 0.0, 1.0) == 5
    assert act(0.0, 0.0, -1.0) == -5
    assert act(0.5, 2.0, 0.5) == pytest.approx(-0.016)
    # a predicted pair of cosine and sine need not have length one
    short = PID(bounds=None)(np.array([[0.3, 0.3, 0.0]]), np.array([[1.0, 0, 0]]), np.zeros(1))
    assert short[0, 0] == pytest.approx(-5 * np.pi / 4)


def test_the_kick_is_in_the_first_step_only():
    _, states = joint_states(np.random.default_rng(0), 3, 2)
    params = np.random.default_rng(1).uniform(size=(3, 6))
    times = np.array([0.0, 0.008, 0.0])
    plain = PID("cos", bounds=None)(states, params, times)
    kicked = PID("cos", bounds=None, initial_kick=True)(states, params, times)
    np.testing.assert_array_equal(kicked[1], plain[1])
    p, d, target = np.hsplit(params, 3)
    np.testing.assert_allclose(kicked[::2], ((5 * p + d) * (target - states[:, :2]))[::2])
    assert (np.abs(kicked - plain)[::2] > 1e-3).all()


@given(n=st.integers(1, 40), m=st.integers(1, 8), seed=st.integers(0, 2**32 - 1))
def test_a_row_of_pid_gets_the_same_bits_alone_as_in_a_batch(n, m, seed):
    rng = np.random.default_rng(seed)
    _, states = joint_states(rng, n, m)
    params, times = rng.normal(size=(n, 3 * m)), rng.integers(0, 2, size=n) * 1.0
    for feedback in ("angle", "cos"):
        policy = PID(feedback, initial_kick=True)
        together = policy(states, params, times)
        alone = [policy(*(a[i : i + 1] for a in (states, params, times))) for i in range(n)]
        np.testing.assert_array_equal(together, np.concatenate(alone))
        strided = policy(np.asfortranarray(states), np.asfortranarray(params), times)
        np.testing.assert_array_equal(together, strided)


def test_bounds_of_pid():
    state, params = np.array([[1.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 1.0]])
    assert PID()(state, params, np.zeros(1)).tolist() == [[1.0]]
    assert PID(bounds=(0, 2))(state, params, np.zeros(1)).tolist() == [[2.0]]
    assert PID(bounds=None)(state, params, np.zeros(1)).tolist() == [[5.0]]
    assert PID()(np.empty((0, 6)), np.empty((0, 6)), np.empty(0)).shape == (0, 2)


def test_pid_is_an_immutable_picklable_value():
    policy = PID("cos", p_scale=2.0, bounds=[-2, 2])
    assert pickle.loads(pickle.dumps(policy)) == policy == PID("cos", p_scale=2, bounds=(-2.0, 2.0))
    assert hash(policy) == hash(PID("cos", p_scale=2.0, bounds=(-2.0, 2.0)))
    assert policy != PID("cos", p_scale=2.0)
    with pytest.raises(AttributeError):
        policy.dt = 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"feedback": "sin"}, "feedback must be 'angle' or 'cos'; got 'sin'"),
        ({"p_scale": 0.0}, "p_scale must be a finite number greater than 0"),
        ({"dt": -1.0}, "dt must be a finite number greater than 0"),
        ({"dt": np.nan}, "dt must be a finite number greater than 0"),
        ({"bounds": (1.0, -1.0)}, "bounds must satisfy low < high"),
        ({"bounds": 3.0}, "bounds must be None or a pair"),
    ],
)
def test_bad_settings_of_pid_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PID(**arguments)


@pytest.mark.parametrize(
    ("states", "params", "times", "message"),
    [
        (np.zeros(15), np.zeros((1, 15)), np.zeros(1), "states must have shape"),
        (np.zeros((2, 0)), np.zeros((2, 0)), np.zeros(2), "states must have shape"),
        (np.zeros((2, 14)), np.zeros((2, 14)), np.zeros(2), "states must have shape"),
        (np.zeros((2, 15)), np.zeros((2, 10)), np.zeros(2), "params must have shape"),
        (np.zeros((2, 15)), np.zeros(15), np.zeros(2), "of the 5 joints"),
        (np.zeros((2, 15)), np.zeros((2, 15)), np.zeros(3), "times must have shape"),
    ],
)
def test_wrong_shapes_for_pid_are_named(states, params, times, message):
    with pytest.raises(ValueError, match=message):
        PID()(states, params, times)


# NetworkPolicy


def by_hand(policy, state, weights):
    """One network at one state, layer by layer with plain loops."""
    sizes = [policy.n_states, *policy.hidden, policy.n_actions]
    weights, x = iter(weights.tolist()), state.tolist()
    for layer, outputs in enumerate(sizes[1:]):
        rows = [[next(weights) for _ in x] for _ in range(outputs)]
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + next(weights) for row in rows]
        if layer < len(sizes) - 2:
            x = [np.tanh(v) if policy.activation == "tanh" else max(v, 0.0) for v in x]
    assert next(weights, None) is None
    if policy.bounds is None:
        return x
    low, high = policy.bounds
    return [low + (high - low) * (np.tanh(v) + 1) / 2 for v in x]


NETWORKS = [
    NetworkPolicy(n_states=4, n_actions=1),
    NetworkPolicy((3, 6), n_states=2, n_actions=3, activation="relu", bounds=(-0.5, 2.0)),
    NetworkPolicy((), n_states=3, n_actions=2, bounds=None),
]


@pytest.mark.parametrize("policy", NETWORKS, ids=["default", "two layers", "no layer"])
@given(n=st.integers(1, 30), seed=st.integers(0, 2**32 - 1))
def test_every_row_is_a_network_of_its_own(policy, n, seed):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, policy.n_states))
    weights = rng.normal(size=(n, policy.n_params))
    together = policy(states, weights, np.zeros(n))
    want = [by_hand(policy, s, w) for s, w in zip(states, weights, strict=True)]
    np.testing.assert_allclose(together, want, rtol=1e-12, atol=1e-12)
    alone = [policy(states[i : i + 1], weights[i : i + 1], np.zeros(1)) for i in range(n)]
    np.testing.assert_array_equal(together, np.concatenate(alone))


@pytest.mark.parametrize("policy", NETWORKS, ids=["default", "two layers", "no layer"])
def test_responses_are_the_actions_at_the_probe_states(policy):
    rng = np.random.default_rng(0)
    probes = rng.normal(size=(5, policy.n_states))
    weights = rng.normal(size=(4, policy.n_params))
    got = policy.responses(weights, probes)
    assert got.shape == (4, 5 * policy.n_actions)
    want = [policy(probes, np.tile(row, (5, 1)), np.zeros(5)).ravel() for row in weights]
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-14)


def test_responses_do_not_see_the_order_of_hidden_units():
    policy = NetworkPolicy((3,), n_states=2, n_actions=1)
    weights = np.random.default_rng(0).normal(size=(1, policy.n_params))
    order = [2, 0, 1]
    inner, bias, outer = weights[0, :6].reshape(3, 2), weights[0, 6:9], weights[0, 9:12]
    swapped = np.concatenate([inner[order].ravel(), bias[order], outer[order], weights[0, 12:]])
    probes = np.random.default_rng(1).normal(size=(3, 2))
    assert not np.allclose(swapped, weights)
    np.testing.assert_allclose(
        policy.responses(swapped[None], probes), policy.responses(weights, probes)
    )


def test_number_of_weights_and_reach_of_the_actions():
    policy = NetworkPolicy((5,), n_states=4, n_actions=1, bounds=(-3, 1))
    assert policy.n_params == 4 * 5 + 5 + 5 + 1
    weights = 100 * np.random.default_rng(0).normal(size=(50, 31))
    actions = policy(np.ones((50, 4)), weights, np.zeros(50))
    assert actions.min() == pytest.approx(-3)
    assert actions.max() == pytest.approx(1)
    at_rest = policy(np.ones((1, 4)), np.zeros((1, 31)), np.zeros(1))
    assert at_rest[0, 0] == pytest.approx(-1)
    assert policy(np.empty((0, 4)), np.empty((0, 31)), np.empty(0)).shape == (0, 1)


def test_network_policy_is_an_immutable_picklable_value():
    policy = NetworkPolicy([4, 2], n_states=3, n_actions=1, bounds=[-2, 2])
    same = NetworkPolicy((4, 2), n_states=3, n_actions=1, bounds=(-2.0, 2.0))
    assert pickle.loads(pickle.dumps(policy)) == policy == same
    assert hash(policy) == hash(same)
    assert policy != NetworkPolicy((4, 2), n_states=3, n_actions=1)
    with pytest.raises(AttributeError):
        policy.hidden = (3,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hidden": 5}, "hidden must be a tuple of layer sizes"),
        ({"hidden": (5, 0)}, "every size in hidden must be an integer of at least 1; got 0"),
        ({"n_states": 0}, "n_states must be an integer of at least 1"),
        ({"n_actions": 1.5}, "n_actions must be an integer of at least 1"),
        ({"activation": "sin"}, "activation must be 'tanh' or 'relu'; got 'sin'"),
        ({"bounds": (1.0, -1.0)}, "bounds must satisfy low < high"),
        ({"bounds": (0.0, np.inf)}, "bounds must be finite"),
    ],
)
def test_bad_settings_of_a_network_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        NetworkPolicy(**({"n_states": 4, "n_actions": 1} | arguments))


@pytest.mark.parametrize(
    ("states", "params", "times", "message"),
    [
        (np.zeros(4), np.zeros((1, 31)), np.zeros(1), r"states must have shape \(n, 4\)"),
        (np.zeros((2, 3)), np.zeros((2, 31)), np.zeros(2), r"states must have shape \(n, 4\)"),
        (np.zeros((2, 4)), np.zeros((2, 30)), np.zeros(2), "weights of a network 4-5-1; got"),
        (np.zeros((2, 4)), np.zeros((1, 31)), np.zeros(2), "one row for each of the 2 states"),
        (np.zeros((2, 4)), np.zeros((2, 31)), 0.0, "times must have shape"),
    ],
)
def test_wrong_shapes_for_a_network_are_named(states, params, times, message):
    policy = NetworkPolicy(n_states=4, n_actions=1)
    with pytest.raises(ValueError, match=message):
        policy(states, params, times)


def test_wrong_probe_states_are_named():
    policy = NetworkPolicy(n_states=4, n_actions=1)
    with pytest.raises(ValueError, match="probe_states must have shape"):
        policy.responses(np.zeros((1, 31)), np.zeros((2, 3)))
