"""The loop of a roll-out: particles, members, divergence."""

import numpy as np
import pytest

from trajlearn.dynamics._learner import by_member
from trajlearn.dynamics._rollouts.rollout import Limits, roll_out
from trajlearn.dynamics.propagation._particles import drawn_step, expected_step, member_step

NO_LIMITS = Limits(None, np.zeros(1), np.full(1, 1e9))


def rows(states, k, actions):
    return states, None


def drift(*drifts, std=0.0):
    """Members that each add a drift of their own to the state."""

    def moments(x):
        # rows for all members, or a layer of rows for each
        means = x + np.array(drifts)[:, None, None]
        return means, np.full(means.shape, std**2)

    return moments


def paths(step, *, n=4000, steps=9):
    return roll_out(np.zeros((n, 1)), steps, rows, step, NO_LIMITS)[:, :, 0]


def by_members(moments, member, n_members=2):
    return member_step(by_member(moments, n_members), member, np.random.default_rng(0))


def test_expectation_averages_the_members_at_every_step():
    found = roll_out(np.zeros((2, 1)), 4, rows, expected_step(drift(1.0, 2.0)), NO_LIMITS)
    np.testing.assert_allclose(found[:, :, 0], [[1.5, 3.0, 4.5, 6.0]] * 2)


def test_tsinf_keeps_a_member_and_the_others_mix_them_at_every_step():
    h = np.arange(1, 10)
    moments = drift(-0.3, 0.3)
    kept = paths(by_members(moments, np.arange(4000) % 2))
    np.testing.assert_allclose(kept.std(axis=0), 0.3 * h)
    for step in (by_members(moments, 2), drawn_step(moments, np.random.default_rng(0))):
        drawn = paths(step)
        np.testing.assert_allclose(drawn.std(axis=0), 0.3 * np.sqrt(h), rtol=0.05)
        np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=0.06)


def test_ts1_keeps_the_shape_of_the_mixture_and_expectation_does_not():
    moments = drift(-1.0, 1.0, std=0.1)
    ts1 = paths(by_members(moments, 2), steps=1)
    assert (np.abs(np.abs(ts1) - 1) < 0.5).all()  # one of two narrow bumps
    drawn = paths(drawn_step(moments, np.random.default_rng(0)), steps=1)
    assert (np.abs(drawn) < 0.5).mean() > 0.3
    np.testing.assert_allclose(drawn.std(), np.sqrt(1.01), rtol=0.05)


def test_noise_is_fresh_at_every_step():
    found = paths(by_members(drift(0.0, std=0.5), np.zeros(4000, dtype=int), 1))
    np.testing.assert_allclose(found.std(axis=0), 0.5 * np.sqrt(np.arange(1, 10)), rtol=0.05)
    steps = np.diff(found, axis=1)
    assert np.abs(np.corrcoef(steps.T) - np.eye(8)).max() < 0.06


@pytest.mark.parametrize("seed", range(4))
def test_each_row_is_evaluated_by_its_own_member_only(seed):
    rng = np.random.default_rng(seed)
    member = rng.integers(3, size=50) if seed else np.full(50, 1)
    seen = []

    def own(x):
        seen.append(x.shape)
        means = 10.0 * x + np.arange(3)[:, None, None]
        return means, means + 0.5

    x = rng.normal(size=(50, 2))
    means, variances = by_member(own, 3)(x, member)
    np.testing.assert_array_equal(means, 10.0 * x + member[:, None])
    np.testing.assert_array_equal(variances, means + 0.5)
    assert seen == [(3, np.bincount(member).max(), 2)]


def test_actions_are_handed_to_the_next_step():
    seen = []

    def inputs(states, k, actions):
        seen.append(actions)
        return states, states + k

    found = roll_out(np.zeros((1, 1)), 3, inputs, lambda x, k: x + 1.0, NO_LIMITS)
    assert seen == [None, 0.0, 2.0]
    assert found.ravel().tolist() == [1.0, 2.0, 3.0]


def test_a_diverged_particle_stays_inf_and_leaves_the_others_alone():
    seen = []

    def inputs(states, k, actions):
        seen.append(states.copy())
        return states, None

    def step(x, k):
        out = x + 1.0
        if k == 2:
            out[0] = np.nan
        return out

    found = roll_out(np.zeros((2, 1)), 5, inputs, step, NO_LIMITS)[:, :, 0]
    np.testing.assert_array_equal(found[1], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(found[0], [1, 2, np.inf, np.inf, np.inf])
    assert np.isfinite(seen).all()  # learners and policies never see the divergence


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 11.0, -11.0])
def test_limits_tell_what_has_diverged(value):
    limits = Limits(None, np.array([0.0, 0.0]), np.array([10.0, 10.0]))
    _, off = limits.apply(np.array([[0.0, 10.0], [value, 0.0], [0.0, -10.0]]))
    assert off.tolist() == [False, True, False]


def test_clipped_states_do_not_diverge():
    limits = Limits((np.array([-2.0]), np.array([3.0])), np.zeros(1), np.array([10.0]))
    states, off = limits.apply(np.array([[99.0], [-99.0], [1.0]]))
    assert states.tolist() == [[3.0], [-2.0], [1.0]]
    assert not off.any()
