"""Linear feedback against the matrix product, and on bad input."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn.policies import LinearFeedback


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
