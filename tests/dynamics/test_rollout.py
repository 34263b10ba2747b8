"""The loop of a roll-out: particles, members, divergence."""

import numpy as np
import pytest

from trajlearn.dynamics._rollout import Limits, expected_step, roll_out, sampled_step

NO_LIMITS = Limits(None, np.zeros(1), np.full(1, 1e9))


def rows(states, k):
    return states


def drift(*drifts, std=0.0):
    """Members that each add a drift of their own to the state."""

    def moments(x):
        means = np.stack([x + d for d in drifts])
        return means, np.full(means.shape, std**2)

    return moments


def paths(moments, member, *, n=4000, steps=9, seed=0):
    step = sampled_step(moments, member, np.random.default_rng(seed))
    return roll_out(np.zeros((n, 1)), steps, rows, step, NO_LIMITS)[:, :, 0]


def test_expectation_averages_the_members_at_every_step():
    found = roll_out(np.zeros((2, 1)), 4, rows, expected_step(drift(1.0, 2.0)), NO_LIMITS)
    np.testing.assert_allclose(found[:, :, 0], [[1.5, 3.0, 4.5, 6.0]] * 2)


def test_tsinf_keeps_a_member_and_ts1_draws_one_at_every_step():
    h = np.arange(1, 10)
    moments = drift(-0.3, 0.3)
    kept = paths(moments, np.arange(4000) % 2)
    np.testing.assert_allclose(kept.std(axis=0), 0.3 * h)
    drawn = paths(moments, None)
    np.testing.assert_allclose(drawn.std(axis=0), 0.3 * np.sqrt(h), rtol=0.05)
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=0.06)


def test_noise_is_fresh_at_every_step():
    found = paths(drift(0.0, std=0.5), np.zeros(4000, dtype=int))
    np.testing.assert_allclose(found.std(axis=0), 0.5 * np.sqrt(np.arange(1, 10)), rtol=0.05)
    steps = np.diff(found, axis=1)
    assert np.abs(np.corrcoef(steps.T) - np.eye(8)).max() < 0.06


def test_a_diverged_particle_stays_inf_and_leaves_the_others_alone():
    seen = []

    def inputs(states, k):
        seen.append(states.copy())
        return states

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
