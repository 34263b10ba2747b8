"""PID control against the law written out, and on bad input."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn.policies import PID


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
