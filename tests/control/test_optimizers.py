"""Searches against functions whose greatest value is known."""

import sys

import numpy as np
import pytest

from trajlearn.control import _optimizers
from trajlearn.control._optimizers import METHODS, Found, checked_bounds, maximise

# metres beside millinewtons
BOUNDS = np.array([[-1.0, 3.0], [1e-4, 5e-4], [-200.0, 900.0]])
BEST = BOUNDS[:, 0] + [0.3, 0.8, 0.55] * (BOUNDS[:, 1] - BOUNDS[:, 0])


def quadratic(best, bounds, condition=1.0):
    """0 at the best point, and minus a hundredth one tenth of the box away from it."""
    width = np.ptp(bounds, axis=1)
    weights = np.geomspace(1.0, condition, len(bounds))
    return lambda x: -(weights * ((x - best) / width) ** 2).sum(axis=1)


def search(value, bounds, *, seed=0, n_evaluations=800, **settings):
    return maximise(
        value,
        bounds,
        n_evaluations=n_evaluations,
        rng=np.random.default_rng(seed),
        **settings,
    )


@pytest.mark.parametrize(("method", "off"), [("cma", 1e-6), ("cem", 1e-6), ("random", 2e-2)])
def test_a_quadratic_in_other_units(method, off):
    found = search(quadratic(BEST, BOUNDS), BOUNDS, method=method)
    assert -off < found.value <= 0
    np.testing.assert_allclose((found.params - BEST) / np.ptp(BOUNDS, axis=1), 0, atol=np.sqrt(off))
    assert found.n_evaluations == 800


@pytest.mark.parametrize("method", ["cma", "cem"])
def test_a_narrow_valley(method):
    value = quadratic(BEST, BOUNDS, condition=1e4)
    found = np.median([search(value, BOUNDS, method=method, seed=seed).value for seed in range(5)])
    at_random = search(value, BOUNDS, method="random", n_evaluations=800).value
    assert at_random < 1000 * found
    assert found > -1e-2


@pytest.mark.parametrize("method", ["cma", "cem"])
@pytest.mark.parametrize("d", [1, 3])
def test_the_best_is_at_a_bound_and_no_candidate_is_beyond(method, d):
    bounds, seen = BOUNDS[:d], []

    def value(x):
        seen.append(x)
        return ((x - bounds[:, 0]) / np.ptp(bounds, axis=1)).sum(axis=1)

    found = search(value, bounds, method=method, n_evaluations=600)
    assert found.value > d - 1e-3
    everything = np.concatenate(seen)
    assert len(everything) == 600
    assert (everything >= bounds[:, 0]).all()
    assert (everything <= bounds[:, 1]).all()


@pytest.mark.parametrize(("method", "least"), [("cma", -1e-2), ("cem", -3.0)])
def test_sixty_one_dimensions(method, least):
    bounds = np.tile([-2.0, 2.0], (61, 1))
    best = np.linspace(-1.5, 1.5, 61)
    found = search(quadratic(best, bounds), bounds, method=method, n_evaluations=5000)
    assert found.value > least
    assert search(quadratic(best, bounds), bounds, method="random").value < -3.5


def test_cma_es_leaves_a_local_best():
    bounds = np.tile([-1.0, 1.0], (2, 1))
    centre, corner = np.zeros(2), np.full(2, 0.8)

    def two_hills(x):
        near = np.exp(-20 * ((x - centre) ** 2).sum(axis=1))
        return near + 2 * np.exp(-60 * ((x - corner) ** 2).sum(axis=1))

    found = search(two_hills, bounds, method="cma", n_evaluations=6000, start=centre)
    assert found.value == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_the_start_is_not_lost(method):
    needle = BOUNDS[:, 0] + [0.123, 0.456, 0.789] * np.ptp(BOUNDS, axis=1)

    def value(x):
        return np.where((x == needle).all(axis=1), 10.0, -np.abs(x[:, 0]))

    for start in (needle, np.stack([BOUNDS.mean(axis=1), needle])):
        for n_evaluations in (2, 300):
            found = search(value, BOUNDS, method=method, start=start, n_evaluations=n_evaluations)
            assert found.value == 10.0
            np.testing.assert_array_equal(found.params, needle)
            assert found.n_evaluations == n_evaluations
    # of more points than the budget the first are taken
    few = search(value, BOUNDS, method=method, start=start, n_evaluations=1)
    np.testing.assert_array_equal(few.params, start[0])


@pytest.mark.parametrize("method", METHODS)
def test_where_it_begins_is_in_the_first_batch(method):
    point, batches = BOUNDS[:, 0] + 0.1 * np.ptp(BOUNDS, axis=1), []
    settings = {"method": method, "begin": point, "population": 40}

    def value(x):
        batches.append(x)
        return -np.abs(x[:, 0] - point[0])

    found = search(value, BOUNDS, n_evaluations=100, **settings)
    np.testing.assert_array_equal(batches[0][0], point)
    assert list(map(len, batches)) == [41, 40, 19]
    np.testing.assert_array_equal(found.params, point)
    if method != "random":
        place = (batches[0] - BOUNDS[:, 0]) / np.ptp(BOUNDS, axis=1)
        assert place.mean() < 0.35
        # it learns from its own draws: a step of the search is another one than at random
        exact = search(quadratic(BEST, BOUNDS), BOUNDS, n_evaluations=800, **settings)
        assert exact.value > -1e-3
    assert search(value, BOUNDS, n_evaluations=1, **settings).n_evaluations == 1
    with pytest.raises(ValueError, match="not within the bounds"):
        search(value, BOUNDS, n_evaluations=9, **(settings | {"begin": BOUNDS[:, 1] + 1.0}))


@pytest.mark.parametrize("method", ["cma", "cem"])
def test_a_search_begins_at_the_start(method):
    found = [
        search(quadratic(BEST, BOUNDS), BOUNDS, method=method, start=start, n_evaluations=100)
        for start in (BEST + 0.02 * np.ptp(BOUNDS, axis=1), BOUNDS[:, 0])
    ]
    batches = []
    search(
        quadratic(BEST, BOUNDS),
        BOUNDS,
        method=method,
        start=BOUNDS[:, 0],
        n_evaluations=65,
        on_batch=lambda x, values: batches.append(x),
    )
    assert found[0].value > -1e-2
    # a corner has its neighbours in the box within some 0.3 of the width
    place = (batches[1] - BOUNDS[:, 0]) / np.ptp(BOUNDS, axis=1)
    assert place.mean() < 0.3


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_bits_whatever_the_global_state(method):
    value = quadratic(BEST, BOUNDS)
    np.random.seed(0)  # noqa: NPY002
    one = search(value, BOUNDS, method=method, seed=3)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    two = search(value, BOUNDS, method=method, seed=3)
    np.testing.assert_array_equal(one.params, two.params)
    assert one.value == two.value
    assert search(value, BOUNDS, method=method, seed=4).value != one.value
    np.random.seed(0)  # noqa: NPY002
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


@pytest.mark.parametrize("method", METHODS)
def test_failures_count_as_worst(method):
    good = quadratic(BEST, BOUNDS)

    def failing(x):
        values = good(x)
        place = (x[:, 0] - BOUNDS[0, 0]) / np.ptp(BOUNDS[0])
        values[place > 0.6] = np.nan
        values[place < 0.1] = np.inf
        values[(place > 0.4) & (place < 0.5)] = -np.inf
        return values

    found = search(failing, BOUNDS, method=method)
    assert -3e-2 < found.value <= 0

    def hopeless(x):
        return np.full(len(x), np.nan)

    nothing = search(hopeless, BOUNDS, method=method, start=BEST)
    np.testing.assert_array_equal(nothing.params, BEST)
    assert nothing.value == -np.inf
    assert nothing.n_evaluations == 800


@pytest.mark.parametrize("method", METHODS)
def test_candidates_are_its_own(method):
    good = quadratic(BEST, BOUNDS)
    start = BEST.copy()

    def vandal(x):
        values = good(x)
        x[:] = np.nan
        return values

    found = search(vandal, BOUNDS, method=method, start=start)
    expected = search(good, BOUNDS, method=method, start=start)
    np.testing.assert_array_equal(found.params, expected.params)
    np.testing.assert_array_equal(start, BEST)


@pytest.mark.parametrize(
    ("method", "population", "sizes"),
    [
        ("random", None, [256, 44]),
        ("cem", None, [64] * 4 + [44]),
        ("cma", None, [32] * 9 + [12]),
        ("random", 1000, [300]),
        ("cma", 100, [100] * 3),
    ],
)
def test_batches_and_budget(method, population, sizes):
    seen = []
    found = search(
        quadratic(BEST, BOUNDS),
        BOUNDS,
        method=method,
        population=population,
        n_evaluations=300,
        on_batch=lambda x, values: seen.append((len(x), values.max())),
    )
    assert [n for n, _ in seen] == sizes
    assert found.value == max(best for _, best in seen)
    assert isinstance(found, Found)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ([[0.0, 1.0], [2.0, 1.0]], r"bounds\[1\] = \[2.0, 1.0\]: the lower bound must be less"),
        ([[0.0, 0.0]], "must be less than"),
        ([[0.0, np.inf]], "bounds has NaN or infinite"),
        ([0.0, 1.0], r"bounds has shape \(2,\)"),
        (np.zeros((0, 2)), r"bounds has shape \(0, 2\)"),
    ],
)
def test_wrong_bounds_are_named(bounds, message):
    with pytest.raises(ValueError, match=message):
        checked_bounds(bounds)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "grid"}, "method = 'grid'; choose one of"),
        ({"n_evaluations": 0}, "n_evaluations = 0"),
        ({"population": 0}, "population = 0"),
        ({"start": [0.0]}, r"start has shape \(1,\)"),
        ({"start": BOUNDS[:, 1] + [1e-3, 0, 0]}, "not within the bounds .* of parameter 0"),
        ({"start": [np.nan, 2e-4, 0.0]}, "not within the bounds"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        search(quadratic(BEST, BOUNDS), BOUNDS, **settings)


def test_a_value_of_another_shape_is_named():
    with pytest.raises(ValueError, match=r"value returned shape \(32, 3\) for 32 candidates"):
        search(lambda x: x, BOUNDS)


def test_a_start_off_by_rounding_is_within():
    found = search(
        quadratic(BEST, BOUNDS), BOUNDS, start=BOUNDS[:, 1] * (1 + 1e-15), n_evaluations=1
    )
    assert (found.params <= BOUNDS[:, 1]).all()


def test_without_pycma_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(ImportError, match=r"trajlearn\[search\]"):
        search(quadratic(BEST, BOUNDS), BOUNDS, method="cma")
    search(quadratic(BEST, BOUNDS), BOUNDS, method="cem", n_evaluations=10)


def test_each_restart_begins_somewhere_else():
    strategy = _optimizers._CmaEs(2, 8, np.random.default_rng(0))
    begins = []
    while len(begins) < 4:
        points = strategy.ask()
        # nothing is to be gained here
        strategy.tell(points, np.zeros(len(points)))
        if strategy._strategy is None:
            begins.append(strategy._begin)
    apart = np.linalg.norm(np.subtract.outer(begins, begins).diagonal(axis1=1, axis2=3), axis=2)
    assert (apart[~np.eye(4, dtype=bool)] > 0.05).all()
