import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import spearmanr

from trajlearn.evaluation import rank_correlation

NAN, INF = np.nan, np.inf


def scores(seed=0, n=40, noise=0.5):
    rng = np.random.default_rng(seed)
    true = rng.normal(size=n)
    return true + noise * rng.normal(size=n), true


@given(seed=st.integers(0, 1000), digits=st.sampled_from([0, 8]))
def test_correlations_agree_with_scipy(seed, digits):
    predicted, true = np.round(scores(seed), digits)  # 0 digits: many ties
    folds = np.random.default_rng(seed).permutation(np.repeat(list("abcd"), 10))
    found = rank_correlation(predicted, true, folds=folds, n_bootstrap=0)
    assert_allclose(found["pooled"], spearmanr(predicted, true).statistic)
    inside = [spearmanr(predicted[folds == f], true[folds == f]).statistic for f in "abcd"]
    assert_allclose(found["per_fold"], np.mean(inside))
    assert (found["n_episodes"], found["n_folds"], found["n_folds_undefined"]) == (40, 4, 0)


def test_the_mean_of_the_training_folds_is_anti_correlated_when_pooled():
    _, true = scores()
    folds = np.arange(40) % 5
    predicted = np.array([true[folds != f].mean() for f in folds])
    found = rank_correlation(predicted, true, folds=folds, n_bootstrap=20, random_state=0)
    assert found["pooled"] < -0.05
    # nothing is ranked inside a fold, and that is said instead of left out in silence
    assert np.isnan(found["per_fold"])
    assert np.isnan(found["per_fold_lower"])
    assert (found["n_folds"], found["n_folds_undefined"]) == (0, 5)


def test_folds_that_differ_in_level_only_do_not_hide_a_good_order():
    true = np.arange(12.0)
    folds = np.repeat([0, 1], 6)
    found = rank_correlation(true - 100 * folds, true, folds=folds, n_bootstrap=0)
    assert found["pooled"] < 0
    assert_allclose(found["per_fold"], 1)


def test_a_fold_without_an_order_is_left_out_and_counted():
    found = rank_correlation(
        [1.0, 2.0, 3.0, 3.0, 5.0], [1, 2, 3, 4, 5], folds=[0, 0, 1, 1, 2], n_bootstrap=0
    )
    assert_allclose(found["per_fold"], 1)
    assert (found["n_folds"], found["n_folds_undefined"]) == (1, 2)


@pytest.mark.parametrize(
    ("predicted", "true"),
    [([1.0, 1.0, 1.0], [1, 2, 3]), ([1.0, 2.0, 3.0], [2, 2, 2]), ([1.0], [1])],
)
def test_no_order_is_no_correlation(predicted, true):
    found = rank_correlation(predicted, true, n_bootstrap=5, random_state=0)
    assert np.isnan([found["pooled"], found["pooled_lower"], found["pooled_upper"]]).all()


def test_without_folds_there_is_no_correlation_inside_them():
    found = rank_correlation(*scores(), n_bootstrap=5, random_state=0)
    assert np.isnan(found["per_fold"])
    assert np.isnan(found["per_fold_upper"])
    assert found["n_folds"] == found["n_folds_undefined"] == 0


def test_a_diverged_forecast_ranks_last():
    true = [0.1, 0.5, 0.7, 0.9]
    worst = rank_correlation([-INF, 0.5, 0.6, 0.8], true, n_bootstrap=0)
    assert_allclose(worst["pooled"], 1)
    assert worst["n_diverged"] == 1
    assert_allclose(rank_correlation([0.1, 0.5, 0.6, INF], true, n_bootstrap=0)["pooled"], 1)
    assert rank_correlation([0.2, 0.5, 0.6, -INF], true, n_bootstrap=0)["pooled"] < 0
    both = rank_correlation([-INF, -INF, 0.6, INF], true, n_bootstrap=0)
    assert_allclose(both["pooled"], spearmanr([1, 1, 2, 3], true).statistic)


def test_only_the_order_matters():
    predicted, true = scores()
    folds = np.arange(40) % 4
    found = rank_correlation(predicted, true, folds=folds, random_state=0, n_bootstrap=30)
    stretched = rank_correlation(
        np.exp(predicted), true**3, folds=folds, random_state=0, n_bootstrap=30
    )
    assert stretched == found
    flipped = rank_correlation(-predicted, true, folds=folds, n_bootstrap=0)
    assert_allclose(
        [flipped["pooled"], flipped["per_fold"]], [-found["pooled"], -found["per_fold"]]
    )


# -- the bootstrap ------------------------------------------------------------------------


def test_intervals_agree_with_a_bootstrap_by_hand():
    predicted, true = scores(n=15)
    folds, groups = np.arange(15) % 2, np.arange(15) // 2  # groups of two, one of one
    found = rank_correlation(
        predicted, true, folds=folds, groups=groups, n_bootstrap=50, level=0.8, random_state=3
    )
    rng = np.random.RandomState(3)
    pooled, inside = [], []
    for _ in range(50):
        index = []
        for g in rng.randint(8, size=8):
            index += [i for i in range(15) if groups[i] == g]
        x, y, f = predicted[index], true[index], folds[index]
        pooled.append(spearmanr(x, y).statistic)
        inside.append(np.mean([spearmanr(x[f == k], y[f == k]).statistic for k in (0, 1)]))
    for name, draws in {"pooled": pooled, "per_fold": inside}.items():
        assert_allclose(found[f"{name}_lower"], np.quantile(draws, 0.1))
        assert_allclose(found[f"{name}_upper"], np.quantile(draws, 0.9))


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    # bivariate normal of correlation 0.6: Spearman's rho is 6 / pi * arcsin(0.3)
    rho, covered = 6 / np.pi * np.arcsin(0.3), 0
    for seed in range(1000, 1100):
        rng = np.random.default_rng(seed)
        true = rng.normal(size=60)
        predicted = 0.6 * true + 0.8 * rng.normal(size=60)
        found = rank_correlation(predicted, true, n_bootstrap=100, random_state=seed)
        covered += found["pooled_lower"] <= rho <= found["pooled_upper"]
    assert 80 <= covered <= 98  # 90 expected


def test_repeats_of_one_experiment_are_no_more_evidence():
    predicted, true = scores(n=20)
    once = rank_correlation(predicted, true, n_bootstrap=300, random_state=0)
    many, groups = (np.repeat(predicted, 5), np.repeat(true, 5)), np.repeat(np.arange(20), 5)
    whole = rank_correlation(*many, groups=groups, n_bootstrap=300, random_state=0)
    parted = rank_correlation(*many, n_bootstrap=300, random_state=0)

    def width(found):
        return found["pooled_upper"] - found["pooled_lower"]

    assert_allclose(width(whole), width(once), rtol=1e-9)
    assert width(parted) < 0.6 * width(whole)


def test_level_draws_and_seed():
    settings = {"n_bootstrap": 60, "level": 0.9, "random_state": 0}
    base = rank_correlation(*scores(), **settings)
    assert rank_correlation(*scores(), **settings) == pytest.approx(base, nan_ok=True)
    narrow = rank_correlation(*scores(), **settings | {"level": 0.5})
    assert base["pooled_lower"] < narrow["pooled_lower"] < base["pooled"]
    assert base["pooled"] < narrow["pooled_upper"] < base["pooled_upper"]
    for other in ({"random_state": 1}, {"n_bootstrap": 61}):
        found = rank_correlation(*scores(), **settings | other)
        assert found["pooled_lower"] != base["pooled_lower"]
        assert found["pooled"] == base["pooled"]
    none = rank_correlation(*scores(), n_bootstrap=0)
    assert np.isnan([none["pooled_lower"], none["pooled_upper"]]).all()


# -- arguments ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"predicted": [[1.0], [2.0]]}, r"predicted has shape \(2, 1\).*one score an episode"),
        ({"predicted": [1.0, NAN]}, "predicted has NaN"),
        ({"true": [1.0, INF]}, "every episode needs a true score"),
        ({"folds": [0]}, r"folds has shape \(1,\)"),
        ({"groups": [[0, 1]]}, r"groups has shape \(1, 2\)"),
        ({"level": 1.0}, r"level = 1\.0 must lie between 0 and 1"),
        ({"n_bootstrap": -1}, "n_bootstrap = -1 must not be negative"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        rank_correlation(**{"predicted": [1.0, 2.0], "true": [1.0, 2.0]} | arguments)
