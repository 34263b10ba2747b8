"""Pairs addressed by number: counts, a bijection, and the schemes of drawing them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare, kstest

from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._pairs import PairIndex, Stretches, draw_pairs

RAGGED = st.lists(st.integers(1, 12), min_size=1, max_size=6)
CAPS = st.one_of(st.none(), st.integers(1, 15))


def stretches(lengths):
    lengths = np.asarray(lengths, dtype=np.intp)
    first = np.concatenate([[0], np.cumsum(lengths + 1)[:-1]])
    return Stretches(np.arange(len(lengths)), first, lengths)


def listed(lengths, cap=None):
    """Every pair in order, by two loops."""
    return [
        (i, start, h)
        for i, steps in enumerate(lengths)
        for start in range(steps)
        for h in range(1, min(steps - start, cap or steps) + 1)
    ]


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 200])
def test_a_stretch_of_l_steps_has_l_times_l_plus_one_over_two_pairs(steps):
    # L + 1 states, and a pair for every two of them; the paper prints L (L - 1) / 2
    index = PairIndex(stretches([steps]))
    assert index.total == steps * (steps + 1) // 2
    assert index.total == len(listed([steps]))


@given(lengths=RAGGED, cap=CAPS)
def test_numbers_and_pairs_correspond_one_to_one(lengths, cap):
    index = PairIndex(stretches(lengths), cap)
    expected = listed(lengths, cap)
    assert index.total == len(expected)
    assert index.counts.tolist() == [len(listed([steps], cap)) for steps in lengths]
    found = index.pairs(np.arange(index.total))
    assert list(zip(*(part.tolist() for part in found))) == expected


def number_of(start, horizon, steps, cap):
    """Number of a pair in one long stretch, in exact integers."""
    start, horizon = int(start), int(horizon)
    full = steps - cap + 1
    before = min(start, full) * cap
    later = max(start - full, 0)
    return before + later * (cap - 1) - later * (later - 1) // 2 + horizon - 1


@given(
    steps=st.integers(1, 10**9),
    cap=st.one_of(st.none(), st.integers(1, 10**9)),
    where=st.lists(st.floats(0, 1), min_size=1, max_size=5),
)
@settings(max_examples=200)
def test_huge_stretches_lose_no_pair(steps, cap, where):
    cap = steps if cap is None else min(cap, steps)
    index = PairIndex(stretches([steps]), cap)
    total = index.total
    assert total == cap * (steps - cap) + cap * (cap + 1) // 2
    edges = [0, 1, total // 2, total - 3, total - 2, total - 1]
    numbers = [min(max(n, 0), total - 1) for n in [*edges, *(int(w * total) for w in where)]]
    _, start, horizon = index.pairs(np.array(numbers, dtype=np.intp))
    assert (horizon >= 1).all()
    assert (horizon <= cap).all()
    assert (start + horizon <= steps).all()
    assert [number_of(s, h, steps, cap) for s, h in zip(start, horizon)] == numbers


@given(
    changes=st.lists(st.lists(st.booleans(), min_size=1, max_size=8), min_size=1, max_size=5),
)
def test_stretches_are_the_runs_of_constant_theta(changes):
    theta = [np.cumsum(change, dtype=float)[:, None] for change in changes]
    ds = TrajectoryDataset.from_arrays([np.zeros((len(t) + 1, 1)) for t in theta], params=theta)
    expected, row = [], 0
    for i, t in enumerate(theta):
        begin = 0
        for k in range(1, len(t) + 1):
            if k == len(t) or t[k, 0] != t[begin, 0]:
                expected.append((i, row + begin, k - begin))
                begin = k
        row += len(t) + 1
    found = Stretches.of(ds)
    assert list(zip(found.episode, found.first_row, found.n_steps)) == expected


# -- drawing ------------------------------------------------------------------------------

N = 40_000


def drawn(lengths, *, starts, horizons, cap=None, n=N, seed=0, replace=True):
    index = PairIndex(stretches(lengths), cap)
    rng = np.random.default_rng(seed)
    return draw_pairs(index, n, starts=starts, horizons=horizons, rng=rng, replace=replace)


def share(values, n_values):
    return np.bincount(values, minlength=n_values)


@pytest.mark.parametrize("starts", ["uniform", "early", "first"])
@pytest.mark.parametrize("horizons", ["uniform", "mixture"])
@pytest.mark.parametrize("cap", [None, 1, 4])
def test_every_draw_is_a_pair(starts, horizons, cap):
    lengths = [1, 5, 9]
    stretch, start, horizon = drawn(lengths, starts=starts, horizons=horizons, cap=cap, n=2000)
    assert set(zip(stretch, start, horizon)) <= set(listed(lengths, cap))
    again = drawn(lengths, starts=starts, horizons=horizons, cap=cap, n=2000)
    np.testing.assert_array_equal(horizon, again[2])


def test_uniform_is_uniform_over_pairs():
    lengths = [2, 5]
    pairs = {pair: i for i, pair in enumerate(listed(lengths))}
    found = drawn(lengths, starts="uniform", horizons="uniform")
    counts = share([pairs[p] for p in zip(*(part.tolist() for part in found))], len(pairs))
    assert chisquare(counts).pvalue > 1e-3


def test_without_repeats_every_pair_comes_once():
    lengths = [3, 7, 4]
    everything = listed(lengths)
    found = drawn(lengths, starts="uniform", horizons="uniform", n=len(everything), replace=False)
    assert sorted(zip(*(part.tolist() for part in found))) == everything
    some = drawn(lengths, starts="uniform", horizons="uniform", n=20, replace=False)
    assert len(set(zip(*(part.tolist() for part in some)))) == 20


def test_every_logged_start_weighs_the_same():
    stretch, start, _ = drawn([10, 30], starts="uniform", horizons="mixture")
    position = start + np.where(stretch == 1, 10, 0)
    assert chisquare(share(position, 40)).pvalue > 1e-3


def test_early_starts_are_30_percent_at_the_first_state_and_quadratic_after():
    steps = 10_000
    stretch, start, _ = drawn([steps, 3 * steps], starts="early", horizons="uniform")
    assert abs((stretch == 1).mean() - 0.75) < 0.01
    at_first = (start == 0).mean()
    assert 0.29 < at_first < 0.32  # some of the others fall there as well
    later = start[(start > 0) & (stretch == 0)] / steps
    # u^2 with u uniform: the square root is uniform
    assert kstest(np.sqrt(later), "uniform").pvalue > 1e-3


def test_first_starts_at_the_first_state_only():
    stretch, start, horizon = drawn([4, 8], starts="first", horizons="uniform")
    assert not start.any()
    assert chisquare(share(horizon[stretch == 1] - 1, 8)).pvalue > 1e-3


def test_horizons_fill_what_the_start_leaves():
    _, start, horizon = drawn([6], starts="early", horizons="uniform")
    for s in range(6):
        left = horizon[start == s]
        assert chisquare(share(left - 1, 6 - s)).pvalue > 1e-4 if s < 5 else (left == 1).all()


def test_a_mixture_is_half_log_uniform_half_uniform():
    room = 1000
    _, _, horizon = drawn([room], starts="first", horizons="mixture")
    h = np.arange(1, room + 1)
    log_uniform = np.log((h + 1) / h) / np.log(room + 1)
    expected = N * (0.5 * log_uniform + 0.5 / room)
    counts = share(horizon - 1, room)
    edges = np.unique(np.geomspace(1, room, 25).astype(int)) - 1
    binned = np.add.reduceat(counts, edges), np.add.reduceat(expected, edges)
    assert chisquare(*binned).pvalue > 1e-3
    assert (horizon == 1).mean() > 0.04  # a thousand times less if uniform


def test_a_cap_bounds_the_horizons():
    _, start, horizon = drawn([50], starts="uniform", horizons="uniform", cap=5)
    assert horizon.max() == 5
    # uniform over the pairs within the cap: all but the last starts have five each
    assert chisquare(share(start[start < 45], 45)).pvalue > 1e-3
