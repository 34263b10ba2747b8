"""Losses of members by horizon, and what is chosen by them."""

import numpy as np
import pytest
from scipy.optimize import minimize

from trajlearn.dynamics._selection.choice import blend, pick, step_weights
from trajlearn.dynamics._selection.convex_weights import cauchy_weights, simplex_minimum
from trajlearn.dynamics._selection.losses import (
    averaged,
    horizon_losses,
    kernel_of,
    knots_of,
    paired,
)

INF, NAN = np.inf, np.nan


def losses_of(*members, units=None, bandwidth=0.0):
    errors = np.array(members, dtype=float)
    units = np.arange(errors.shape[1]) if units is None else np.asarray(units)
    return horizon_losses(errors, units, bandwidth)


def constant(value, n=8, steps=6):
    return np.full((n, steps), value)


# -- losses -------------------------------------------------------------------------------


def test_knots_are_every_step_at_first_and_then_three_per_cent_apart():
    assert knots_of(1).tolist() == [1]
    knots = knots_of(500)
    assert knots[:30].tolist() == list(range(1, 31))
    assert knots[-1] == 500
    assert (np.diff(knots[:-1]) <= np.maximum(1, 0.03 * knots[:-2])).all()
    assert len(knots) < 150


def test_the_loss_is_the_logarithm_of_one_plus_errors_over_those_of_the_best():
    rng = np.random.default_rng(0)
    errors = rng.gamma(1.0, size=(3, 9, 4)) * np.array([1.0, 2.0, 0.5])[:, None, None]
    losses = losses_of(*errors)
    typical = np.sqrt(np.median(errors, axis=1).min(axis=0) * errors.min(axis=0))
    np.testing.assert_allclose(losses.typical, typical)
    np.testing.assert_allclose(losses.values, np.log1p(errors / typical))
    np.testing.assert_allclose(losses.means, np.log1p(errors / typical).mean(axis=1))
    assert losses.width.sum() == 4


def test_neighbouring_horizons_are_averaged_before_the_logarithm():
    errors = np.abs(np.random.default_rng(0).normal(size=(1, 5, 60)))
    losses = losses_of(*errors, bandwidth=0.3)
    for k, knot in enumerate(losses.knots):
        gap = np.log(np.arange(1, 61) / knot) / 0.3
        weight = np.clip(1 - gap**2, 0, None)
        smooth = errors[0] @ weight / weight.sum()
        expected = np.log1p(np.sqrt(smooth / np.median(smooth)))
        np.testing.assert_allclose(losses.values[0, :, k], expected)


def test_a_divergence_is_not_felt_far_before_it():
    early = constant(1.0, steps=50)
    gone = early.copy()
    gone[:, 30:] = INF
    losses = losses_of(early, gone, bandwidth=0.3)
    before = losses.knots < 31 * np.exp(-0.3)
    np.testing.assert_array_equal(losses.values[0][:, before], losses.values[1][:, before])
    assert (losses.values[1][:, losses.knots >= 31] > 20).all()
    assert np.isfinite(losses.values).all()


def test_episodes_that_end_early_count_for_the_horizons_they_have():
    errors = constant(1.0, n=4)
    errors[0, 2:] = NAN
    errors[0, :2] = 100.0
    losses = losses_of(errors)
    np.testing.assert_array_equal(np.isnan(losses.values[0, 0]), np.arange(6) >= 2)
    np.testing.assert_allclose(losses.means[0, 2:], np.log(2))
    assert losses.means[0, 0] == pytest.approx((3 * np.log(2) + np.log(1 + np.sqrt(100))) / 4)
    # a neighbour that is missing takes no part in the average
    smooth = averaged(errors, ~np.isnan(errors), knots_of(6), 0.5)
    np.testing.assert_allclose(smooth[0, :3], 100.0)


def test_who_forecasts_fewer_episodes_to_a_horizon_is_not_eligible_there():
    whole, half = constant(1.0), constant(0.01)
    half[4:, 3:] = NAN
    losses = losses_of(whole, half)
    np.testing.assert_array_equal(losses.eligible[1], np.arange(6) < 3)
    choice = pick(losses, 1.0)
    assert choice.best == 0
    np.testing.assert_array_equal(choice.weights.argmax(axis=1), [1, 1, 1, 0, 0, 0])


def test_exact_members_are_equal():
    choice = pick(losses_of(constant(1e-29), constant(0.0), constant(1e-30)), 0.0)
    assert choice.best == 0
    assert (choice.weights[:, 0] == 1).all()


def test_easy_episodes_tell_members_apart_where_most_are_hard():
    # of two members one is exact in two of five episodes, in the others both are far off
    one, other = np.full((5, 4), 1e-3), np.full((5, 4), 1e-3)
    one[:2], other[:2] = 1e-11, 1e-6
    choice = pick(losses_of(other, one), 1.0)
    assert choice.best == 1


# -- paired differences -------------------------------------------------------------------


def test_the_standard_error_is_that_of_paired_differences():
    differences = np.random.default_rng(0).normal(size=(400, 3))
    mean, error = paired(differences, np.arange(400))
    np.testing.assert_allclose(mean, differences.mean(axis=0))
    np.testing.assert_allclose(error, differences.std(axis=0, ddof=1) / 20, rtol=3e-3)


def test_episodes_of_a_group_are_not_independent():
    by_group = np.random.default_rng(0).normal(size=(50, 1))
    _, alone = paired(by_group, np.arange(50))
    # each group has four episodes that say the same
    _, grouped = paired(np.repeat(by_group, 4, axis=0), np.repeat(np.arange(50), 4))
    _, taken_apart = paired(np.repeat(by_group, 4, axis=0), np.arange(200))
    np.testing.assert_allclose(grouped, alone)
    np.testing.assert_allclose(taken_apart, alone / 2, rtol=0.02)


def test_few_units_are_less_sure_and_one_says_nothing():
    two = np.array([[0.0], [1.0]])
    _, error = paired(two, np.arange(2))
    # Student's quantile with one degree of freedom at the level of one Gaussian deviation
    assert error[0] == pytest.approx(0.5 * 1.8373, rel=1e-4)
    assert paired(two, np.zeros(2, dtype=int))[1][0] == INF
    assert paired(np.array([[1.0], [NAN]]), np.arange(2))[1][0] == INF


# -- the choice ---------------------------------------------------------------------------


def crossing(gap, n=20, noise=0.3, seed=0):
    """Member 0 better to step 10, member 1 afterwards; `gap` in logarithms of the error."""
    rng = np.random.default_rng(seed)
    errors = np.exp(noise * rng.normal(size=(2, n, 20)))
    errors[0, :, 10:] *= np.exp(gap)
    errors[1, :, :10] *= np.exp(gap)
    return errors


def test_each_member_wins_where_it_is_better():
    losses = losses_of(*crossing(2.0))
    chosen = pick(losses, 1.0).weights.argmax(axis=1)
    np.testing.assert_array_equal(chosen, [0] * 10 + [1] * 10)
    np.testing.assert_array_equal(step_weights(pick(losses, 1.0), losses, 20).argmax(1), chosen)


def test_only_a_sure_gain_overrides_the_best_overall():
    # of two equal members, which is better at a horizon is chance
    losses = losses_of(*crossing(0.0))
    changes = [np.diff(pick(losses, m).weights[:, 0]).any() for m in (0.0, 4.0)]
    assert changes == [True, False]
    best = pick(losses, 4.0).best
    assert (pick(losses, 4.0).weights[:, best] == 1).all()


def test_who_was_judged_by_a_part_of_the_episodes_is_chosen_nowhere():
    # the other episodes end before what the part reaches
    whole, left = constant(1.0, n=12), constant(0.1, n=12)
    whole[4:, 3:] = NAN
    left[4:] = NAN
    losses = losses_of(whole, left)
    assert losses.eligible.tolist() == [[True] * 6, [False] * 6]
    assert (pick(losses, 1.0).weights[:, 0] == 1).all()


@pytest.mark.parametrize("reach", range(100, 131))
def test_nobody_is_chosen_beyond_what_he_forecasts(reach):
    far, near = constant(1.0, steps=200), constant(0.1, steps=200)
    near[:, reach:] = NAN
    losses = losses_of(far, near)
    weights = step_weights(pick(losses, 1.0), losses, 200)
    assert (weights[reach:, 0] == 1).all()
    assert (weights[: reach - 4, 1] == 1).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("margin", [0.0, 1.0])
def test_one_unit_overrides_nothing(margin):
    one, other = constant(1.0), constant(2.0)
    other[1:, 4:] = one[1:, 4:] = NAN
    other[:, 4:] /= 4
    assert (pick(losses_of(one, other), margin).weights[:, 0] == 1).all()


def test_one_episode_gone_wrong_decides_nothing():
    good, bad = constant(1.0, n=20), constant(1.5, n=20)
    good[0] = 30.0
    # by the mean squared error the other one would be chosen
    assert good.mean() > bad.mean()
    assert pick(losses_of(good, bad), 1.0).best == 0


def test_one_member_is_chosen():
    choice = pick(losses_of(constant(1.0)), 1.0)
    assert choice.best == 0
    np.testing.assert_array_equal(choice.weights, np.ones((6, 1)))


def test_steps_take_the_choice_of_the_nearest_knot():
    errors = np.ones((2, 6, 300))
    errors[0, :, 200:], errors[1, :, :200] = 50, 50
    losses = losses_of(*errors)
    weights = step_weights(pick(losses, 1.0), losses, 300)
    assert weights.shape == (300, 2)
    assert abs(int(weights[:, 0].sum()) - 200) <= 3


# -- convex weights -----------------------------------------------------------------------


def test_the_least_quadratic_form_on_the_simplex():
    rng = np.random.default_rng(0)
    for _ in range(10):
        root = rng.normal(size=(4, 6)) + rng.normal(size=(1, 6))
        gram = root @ root.T
        found = simplex_minimum(gram)
        assert found.min() >= 0
        assert found.sum() == pytest.approx(1)
        best = minimize(
            lambda w, gram=gram: w @ gram @ w,
            np.full(4, 0.25),
            bounds=[(0, 1)] * 4,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
            options={"ftol": 1e-14},
        )
        assert found @ gram @ found <= best.fun * (1 + 1e-8)


def test_weights_of_opposite_errors_cancel_them():
    rng = np.random.default_rng(0)
    common = rng.normal(size=(30, 8, 1))
    residuals = np.stack([common, -common / 3, common + 5])
    typical = np.ones((30, 8))
    weights, errors = cauchy_weights(residuals, typical, np.eye(8))
    np.testing.assert_allclose(weights, np.tile([0.25, 0.75, 0], (8, 1)), atol=1e-3)
    np.testing.assert_allclose(errors, 0, atol=1e-4)


def test_an_episode_in_which_all_are_far_off_hardly_moves_the_weights():
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 40, 1, 1))
    one[0], other[0] = 1e3, -2e2
    clean, _ = cauchy_weights(np.stack([one[1:], other[1:]]), np.ones((39, 1)), np.eye(1))
    found, _ = cauchy_weights(np.stack([one, other]), np.ones((40, 1)), np.eye(1))
    # by least squares it alone would decide: 1/6 and 5/6
    assert abs(found - clean).max() < 0.1


def test_a_blend_loses_no_more_than_its_best_member():
    rng = np.random.default_rng(0)
    size = np.array([1, 1.2, 2, 30])[:, None, None, None]
    residuals = size * rng.standard_t(2, size=(4, 25, 30, 2))
    errors = (residuals**2).mean(axis=3)
    losses = losses_of(*errors, bandwidth=0.3)
    choice = blend(losses, residuals, 0.0, 3, 0.3)
    assert (choice.weights[:, 3] == 0).all()
    np.testing.assert_allclose(choice.weights.sum(axis=1), 1)
    kernel = kernel_of(30, losses.knots, 0.3)
    kernel /= kernel.sum(axis=1, keepdims=True)
    for k, weights in enumerate(choice.weights):
        mixed = (np.tensordot(weights, residuals, 1) ** 2).mean(axis=2) @ kernel[k]
        blended = np.log1p(mixed / losses.typical[:, k]).mean()
        assert blended <= losses.means[:, k].min() + 1e-6
    assert ((choice.weights > 0.05).sum(axis=1) > 1).any()


def test_a_blend_that_is_not_surely_better_than_the_pick_is_the_pick():
    rng = np.random.default_rng(0)
    # two members that err alike, but for a little
    common = rng.normal(size=(5, 30, 1))
    residuals = common + 0.5 * rng.normal(size=(2, *common.shape))
    losses = losses_of(*(residuals**2).mean(axis=3))
    free, sure = (blend(losses, residuals, margin, 2, 0.0).weights for margin in (0.0, 2.0))
    assert ((free > 0.01).sum(axis=1) > 1).sum() >= 3
    np.testing.assert_array_equal(sure, pick(losses, 2.0).weights)


def test_a_blend_where_nobody_covers_all_horizons_takes_the_best_that_does():
    one, other = constant(1.0), constant(2.0)
    one[4:, 3:] = NAN
    other[4:, :3] = NAN
    residuals = np.sqrt(np.stack([one, other]))[..., None]
    choice = blend(losses_of(one, other), residuals, 1.0, 5, 0.0)
    np.testing.assert_array_equal(choice.weights.argmax(axis=1), [0, 0, 0, 1, 1, 1])
