"""Ratios of median errors: known answers, infinities, coverage."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import bootstrap

from benchmarks.paper._intervals import by_seed, ratio, ratio_of_each_seed, spread

INF = np.inf


def draws(seed, n_seeds=3, n=60, sigma=1.0):
    return np.random.default_rng(seed).lognormal(sigma=sigma, size=(n_seeds, n))


def test_a_constant_factor_is_known_exactly_because_episodes_are_paired():
    a = draws(0)
    assert ratio(4.0 * a, a) == (4.0, 4.0, 4.0)
    assert ratio_of_each_seed(a, 2.0 * a) == [0.5] * 3
    # without the pairing there is no such certainty
    _, low, high = ratio(4.0 * a[:, ::-1], a)
    assert low < 3.5
    assert high > 4.5


def test_the_estimate_is_the_ratio_of_what_the_tables_print():
    a, b = draws(1), draws(2)
    a[0] *= 100
    medians = [np.median(np.median(x, axis=1)) for x in (a, b)]
    assert ratio(a, b).estimate == pytest.approx(medians[0] / medians[1])


def test_the_interval_holds_the_true_ratio_about_as_often_as_it_says():
    true = 2.0
    inside = 0
    for i in range(60):
        _, low, high = ratio(true * draws(2 * i), draws(2 * i + 1), random_state=i)
        inside += low <= true <= high
    assert 53 <= inside <= 60


def test_one_seed_agrees_with_scipy():
    a, b = draws(3, n_seeds=1), draws(4, n_seeds=1)
    by_scipy = bootstrap(
        (a[0], b[0]),
        lambda x, y, axis: np.median(x, axis=axis) / np.median(y, axis=axis),
        paired=True,
        vectorized=True,
        method="percentile",
        n_resamples=4000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    _, low, high = ratio(a, b)
    assert low == pytest.approx(by_scipy.low, rel=0.1)
    assert high == pytest.approx(by_scipy.high, rel=0.1)


def test_more_episodes_say_more():
    few, many = (ratio(draws(5, n=n), draws(6, n=n)) for n in (20, 500))
    assert many.high / many.low < few.high / few.low


def test_episodes_are_drawn_within_their_seed():
    # constant within each seed: nothing is left to chance, however much the seeds differ
    a = [np.full(9, value) for value in (1.0, 10.0, 100.0)]
    assert ratio(a, [np.ones(9)] * 3) == (10.0, 10.0, 10.0)


def test_seeds_may_have_different_numbers_of_episodes():
    a = [np.full(n, 3.0) for n in (4, 7)]
    assert ratio(a, [np.ones(n) for n in (4, 7)]) == (3.0, 3.0, 3.0)


def test_the_same_random_state_gives_the_same_interval():
    a, b = draws(7), draws(8)
    assert ratio(a, b) == ratio(a, b)
    assert ratio(a, b, random_state=1) != ratio(a, b)
    assert ratio(a, b, random_state=1).estimate == ratio(a, b).estimate


def test_divergence_makes_the_ratio_infinite_or_zero():
    finite, diverged = np.ones((3, 9)), np.full((3, 9), INF)
    assert ratio(diverged, finite) == (INF, INF, INF)
    assert ratio(finite, diverged) == (0.0, 0.0, 0.0)


def test_some_divergence_shows_in_the_upper_end_only():
    a, b = draws(9, n=40), np.ones((3, 40))
    a[:, :18] = INF
    estimate, low, high = ratio(a, b)
    assert np.isfinite([estimate, low]).all()
    assert high == INF


def test_two_that_diverge_tell_nothing():
    diverged = np.full((3, 9), INF)
    estimate, low, high = ratio(diverged, diverged)
    assert np.isnan(estimate)
    assert (low, high) == (0.0, INF)


def test_perfect_against_perfect_tells_nothing():
    estimate, low, high = ratio(np.zeros((1, 5)), np.zeros((1, 5)))
    assert np.isnan(estimate)
    assert (low, high) == (0.0, INF)


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ([[1.0, 2.0]], [[1.0]], "shapes"),
        ([[1.0]], [[1.0], [1.0]], "shapes"),
        ([], [], "shapes"),
        ([[]], [[]], "shapes"),
        ([[-1.0]], [[1.0]], "at least 0"),
        ([[1.0]], [[np.nan]], "NaN"),
    ],
    ids=["episodes", "seeds", "no seed", "no episode", "negative", "missing"],
)
def test_errors_that_cannot_be_compared(a, b, message):
    with pytest.raises(ValueError, match=message):
        ratio(a, b)


def test_a_table_is_split_by_seed_in_the_order_of_episodes():
    table = pd.DataFrame(
        {"seed": [1, 0, 0, 1], "episode": [0, 1, 0, 1], "short": [3.0, 2.0, 1.0, INF]}
    )
    one, two = by_seed(table, "short")
    assert one.tolist() == [1.0, 2.0]
    assert two.tolist() == [3.0, INF]
    with pytest.raises(ValueError, match="more than once"):
        by_seed(pd.concat([table, table]), "short")


def test_spread_says_median_least_and_greatest():
    assert spread([3.0, 1.0, 2.0]) == "2 (1 to 3)"
    assert spread([INF, 1e-3, INF]) == "inf (0.001 to inf)"
