"""Ways to fit an MLPEnsembleRegressor: weights, groups, going on, streams, failure."""

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from tests.regressors.small_mlp import Floats, clean, data, small
from trajlearn.regressors import mlp
from trajlearn.regressors._batches import row_batches
from trajlearn.regressors._samples import Rows, bootstrap_counts, held_out, standardisation

# -- weights and groups -------------------------------------------------------------------


@pytest.mark.parametrize(
    "params",
    [
        {},
        {"n_members": 3, "probabilistic": True},
        {"bootstrap": "row", "n_members": 2},
        {"bootstrap": "group", "n_members": 2},
        {"early_stopping": True},
    ],
    ids=str,
)
def test_weights_are_repeated_rows_to_the_bit(params: dict[str, Any]) -> None:
    X, y = data(50)
    rng = np.random.default_rng(1)
    weight, groups = rng.integers(0, 12, size=50), rng.integers(8, size=50)
    order = rng.permutation(weight.sum())
    repeated = np.repeat(np.arange(50), weight)[order]
    # more repeated rows than fit into a batch, yet no more different ones
    assert len(repeated) > 256
    by_weight = small(**params).fit(X, y, sample_weight=weight, groups=groups)
    by_rows = small(**params).fit(X[repeated], y[repeated], groups=groups[repeated])
    np.testing.assert_array_equal(by_weight.predict(X), by_rows.predict(X))
    np.testing.assert_array_equal(by_weight.residual_std_, by_rows.residual_std_)


def test_weights_of_many_rows_act_in_proportion() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(800, 2))
    # the same inputs with either answer: what counts is how often each is seen
    X, y = np.concatenate([X, X]), np.repeat([0.0, 1.0], 800)
    weight = np.where(y == 1, 3.0, 1.0)
    model = small(max_steps=400).fit(X, y, sample_weight=weight)
    assert model.predict(X).mean() == pytest.approx(0.75, abs=0.03)
    # the unweighted mean would be 0.5, and only the batches can tell
    model.target_mean_[:], model.target_scale_[:] = 0.0, 1.0
    again = small(max_steps=400, warm_start=True).fit(X, y)
    again.fit(X, y, sample_weight=weight)
    assert again.predict(X).mean() == pytest.approx(0.75, abs=0.03)


@pytest.mark.parametrize("n", [50, 400])
def test_rows_without_weight_might_as_well_not_be_there(n: int) -> None:
    X, y = data(n)
    weight = np.random.default_rng(0).integers(0, 2, size=n)
    keep = weight > 0
    y_wild = np.where(keep[:, None], y, 1e6)
    first = small(batch_size=64).fit(X, y_wild, sample_weight=weight)
    other = small(batch_size=64).fit(X[keep], y[keep], sample_weight=weight[keep])
    np.testing.assert_array_equal(first.predict(X), other.predict(X))


@pytest.mark.parametrize(
    ("weight", "message"),
    [(np.zeros(60), "at least one non-zero"), (-np.ones(60), "negative"), (np.ones(59), "shape")],
)
def test_impossible_weights_are_refused(weight: Floats, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small().fit(*data(), sample_weight=weight)


@given(
    labels=st.lists(st.integers(0, 6), min_size=2, max_size=40).filter(lambda v: len(set(v)) > 1),
    fraction=st.floats(0.05, 0.5),
    seed=st.integers(0, 100),
)
def test_held_out_rows_never_split_a_group(labels: list[int], fraction: float, seed: int) -> None:
    groups = np.array(labels)
    number = np.arange(len(groups), dtype=float)[:, None]
    rows = Rows(number, number, number[:, 0], groups)
    train, validation = held_out(rows, fraction, np.random.default_rng(seed))
    assert train.groups is not None
    assert validation.groups is not None
    assert len(train)
    assert len(validation)
    assert not set(train.groups) & set(validation.groups)
    assert sorted([*train.X[:, 0], *validation.X[:, 0]]) == list(number[:, 0])
    for part in (train, validation):
        np.testing.assert_array_equal(part.groups, groups[part.X[:, 0].astype(int)])
    wanted = int(np.ceil(fraction * len(set(labels))))
    assert len(set(validation.groups)) == wanted


def test_early_stopping_holds_out_the_groups_it_is_given() -> None:
    # noise by group: rows of a group in training would give the held-out ones away
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(20), 10)
    X, y = rng.normal(size=(20, 3))[groups], rng.normal(size=20)[groups]
    X = X + 0.01 * rng.normal(size=X.shape)
    settings = {"early_stopping": True, "validation_fraction": 0.4}
    settings |= {"max_steps": 1000, "learning_rate": 0.02}
    by_row = small(**settings).fit(X, y)
    by_group = small(**settings).fit(X, y, groups=groups)
    assert by_row.validation_loss_curve_.min() < 0.1
    assert by_group.validation_loss_curve_.min() > 0.3
    assert by_group.n_steps_ < by_row.n_steps_
    assert by_group.n_steps_ == 10 * len(by_group.validation_loss_curve_)


def test_bootstrap_by_group_spreads_members_more_than_by_row() -> None:
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(12), 20)
    X = rng.uniform(-1, 1, (240, 3))
    y = rng.normal(size=12)[groups] + 0.1 * rng.normal(size=240)
    spread = {}
    for bootstrap in (False, "row", "group"):
        model = small(n_members=8, bootstrap=bootstrap, max_steps=100)
        spread[bootstrap] = model.fit(X, y, groups=groups).predict_members(X).std(axis=0).mean()
    assert spread["row"] > 1.2 * spread[False]
    assert spread["group"] > 1.2 * spread["row"]


def test_bootstrap_counts_whole_groups() -> None:
    groups = np.array(["b", "a", "b", "c", "a", "b"])
    counts = bootstrap_counts(6, groups, 50, np.random.default_rng(0))
    for label in "abc":
        same = counts[:, groups == label]
        assert (same == same[:, :1]).all()
    np.testing.assert_array_equal(counts[:, [0, 1, 3]].sum(axis=1), 3)
    assert len(np.unique(counts, axis=0)) > 5
    by_row = bootstrap_counts(6, None, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(by_row.sum(axis=1), 6)


def test_missing_and_misfitting_groups_are_refused() -> None:
    X, y = data()
    with pytest.raises(ValueError, match=r"needs groups="):
        small(bootstrap="group").fit(X, y)
    with pytest.raises(ValueError, match="59 labels for 60 rows"):
        small(bootstrap="group").fit(X, y, groups=np.zeros(59))
    with pytest.raises(ValueError, match="at least two groups"):
        small(early_stopping=True).fit(X, y, groups=np.zeros(60))
    with pytest.raises(ValueError, match="at least two rows"):
        small(early_stopping=True).fit(X[:1], y[:1])


@pytest.mark.parametrize("offset", [0.0, 0.1, -1e9])
def test_spread_of_a_constant_is_not_round_off(offset: float) -> None:
    y = np.full((7, 1), offset)
    mean, scale = standardisation(y, np.arange(7.0))
    assert mean == pytest.approx(offset)
    assert scale == 1.0


# -- going on -----------------------------------------------------------------------------


def test_warm_start_goes_on_from_the_last_weights() -> None:
    X, y = data()
    model = small(warm_start=True, n_members=2, probabilistic=True).fit(X, y)
    assert (model.loss_curve_[-1] < model.loss_curve_[0]).all()
    bounds, before = model.logvar_bounds_, model.loss_curve_[-1]
    model.fit(X, y)
    assert (model.loss_curve_[0] < before + 1e-3).all()
    assert (model.loss_curve_[-1] < before).all()
    assert not np.array_equal(model.logvar_bounds_, bounds)
    cold = clone(model).set_params(warm_start=False).fit(X, y)
    assert (cold.fit(X, y).loss_curve_[0] > before).all()


def test_warm_start_keeps_the_scale_of_the_targets() -> None:
    X, y = data()
    model = small(warm_start=True).fit(X, y)
    mean, scale = model.target_mean_.copy(), model.target_scale_.copy()
    model.fit(X[:30], 2 * y[:30])
    np.testing.assert_array_equal(model.target_mean_, mean)
    np.testing.assert_array_equal(model.target_scale_, scale)


@pytest.mark.parametrize(
    "change", [{"hidden_layer_sizes": (17,)}, {"n_members": 2}, {"probabilistic": True}], ids=str
)
@pytest.mark.parametrize("method", ["fit", "partial_fit"])
def test_going_on_with_another_architecture_is_refused(change: dict[str, Any], method: str) -> None:
    X, y = data()
    model = small(warm_start=True).fit(X, y).set_params(**change)
    with pytest.raises(ValueError, match="changed since the last fit"):
        getattr(model, method)(X, y)


@pytest.mark.parametrize("method", ["fit", "partial_fit"])
def test_going_on_with_other_rows_is_refused(method: str) -> None:
    X, y = data()
    model = small(warm_start=True).fit(X, y)
    with pytest.raises(ValueError, match="2 features, but MLPEnsembleRegressor is expecting 3"):
        getattr(model, method)(X[:, :2], y)
    with pytest.raises(ValueError, match="y has 1 targets; fitted: 2"):
        getattr(model, method)(X, y[:, 0])


def test_partial_fit_is_one_constant_pass_and_keeps_the_moments() -> None:
    X, y = data(64)
    model = small(batch_size=64, n_members=2).partial_fit(X, y)
    assert model.n_steps_ == 1
    assert model.predict(X).shape == (64, 2)
    for _ in range(4):
        model.partial_fit(X, y)
    whole = small(batch_size=64, n_members=2, max_steps=5, schedule="constant").fit(X, y)
    # five passes over one batch are five steps of one run: same weights, moments and all
    np.testing.assert_array_equal(model.predict(X), whole.predict(X))


def test_partial_fit_after_few_rows_goes_on_with_many() -> None:
    X, y = data(300)
    model = small(batch_size=32, probabilistic=True, learning_rate=0.01)
    model.partial_fit(X[:20], y[:20])
    scale = model.target_scale_.copy()
    losses = [model.partial_fit(X, y).loss_curve_.mean() for _ in range(10)]
    assert model.n_steps_ == 10
    assert losses[-1] < losses[0] - 0.3
    np.testing.assert_array_equal(model.target_scale_, scale)


def test_partial_fit_shuffles_anew_in_every_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    first_draws = []

    def spy(*args: Any) -> Any:
        first_draws.append(copy.deepcopy(args[-1]).random())
        return row_batches(*args)

    monkeypatch.setattr(mlp, "row_batches", spy)
    X, y = data(64)
    models = [small(batch_size=16), small(batch_size=16)]
    for model in models:
        for _ in range(3):
            model.partial_fit(X, y)
    assert len(set(first_draws)) == 3
    assert first_draws[:3] == first_draws[3:]
    np.testing.assert_array_equal(models[0].predict(X), models[1].predict(X))


def test_partial_fit_takes_weights() -> None:
    X, y = data()
    weight = np.random.default_rng(0).integers(0, 4, size=60)
    rows = np.repeat(np.arange(60), weight)
    by_weight = small().partial_fit(X, y, sample_weight=weight)
    np.testing.assert_array_equal(
        by_weight.predict(X), small().partial_fit(X[rows], y[rows]).predict(X)
    )


@pytest.mark.parametrize("name", ["early_stopping", "bootstrap"])
def test_partial_fit_refuses_what_needs_all_rows(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}=.* needs all rows at once"):
        small(**{name: True if name == "early_stopping" else "row"}).partial_fit(*data())


# -- streams ------------------------------------------------------------------------------


def test_a_stream_is_learned() -> None:
    model = small(hidden_layer_sizes=(64, 64), max_steps=300, n_members=2, learning_rate=0.01)
    model.fit_stream(clean)
    X, y, _ = clean(500, np.random.default_rng(9))
    assert model.score(X, y) > 0.95
    assert model.n_steps_ == 300
    assert model.loss_curve_.shape[1] == 2
    again = clone(model).fit_stream(clean)
    np.testing.assert_array_equal(again.predict(X), model.predict(X))
    other = clone(model).fit_stream(clean, random_state=5)
    assert not np.array_equal(other.predict(X), model.predict(X))


def test_weights_of_a_stream_count() -> None:
    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
        X, wrong = rng.normal(size=(n, 2)), rng.random(n) < 0.5
        return X, np.where(wrong, -1.0, X[:, 0]), np.where(wrong, 0.0, 1.0)

    model = small(max_steps=400, learning_rate=0.01).fit_stream(draw)
    X = np.random.default_rng(0).normal(size=(200, 2))
    assert model.predict(X).shape == (200,)
    assert np.abs(model.predict(X) - X[:, 0]).mean() < 0.1
    assert model.target_mean_ == pytest.approx(0.0, abs=0.05)


def test_budget_of_a_stream_follows_the_number_of_different_rows() -> None:
    model = small(max_steps=None, hidden_layer_sizes=(2,), batch_size=2)
    assert model.fit_stream(clean, n_rows=200).n_steps_ == 276
    assert model.fit_stream(clean).n_steps_ == 4000


def test_warm_start_goes_on_with_a_stream() -> None:
    model = small(warm_start=True).fit(*data(100))
    scale = model.target_scale_.copy()
    before = model.loss_curve_[-1]
    X, y = data(100)

    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
        rows = rng.integers(100, size=n)
        return X[rows], y[rows], None

    model.fit_stream(draw)
    np.testing.assert_array_equal(model.target_scale_, scale)
    assert model.loss_curve_[-1] < before


@pytest.mark.parametrize(
    "params", [{"early_stopping": True}, {"bootstrap": "row"}, {"max_epochs": 2}], ids=str
)
def test_a_stream_refuses_what_needs_fixed_rows(params: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(params))}=.* needs fixed rows"):
        small(**params).fit_stream(clean)


@pytest.mark.parametrize("late", [False, True], ids=["at once", "later"])
@pytest.mark.parametrize("fault", ["fewer rows", "a column less", "short y", "short weight"])
def test_a_stream_of_wrong_shapes_is_refused(fault: str, late: bool) -> None:
    calls = []

    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats | None]:
        calls.append(n)
        X, y, weight = clean(n, rng)
        if late and len(calls) < 3:
            return X, y, weight
        return {
            "fewer rows": (X[1:], y[1:], None),
            "a column less": (X[:, 1:] if late else X[:, 0], y, None),
            "short y": (X, y[1:], None),
            "short weight": (X, y, np.ones(n - 1)),
        }[fault]

    with pytest.raises(ValueError, match=r"draw\(\d+, rng\) must give X of shape"):
        small(max_steps=200).fit_stream(draw)


# -- failing ------------------------------------------------------------------------------


@pytest.mark.parametrize("probabilistic", [False, True])
@pytest.mark.parametrize(
    ("factor", "params"),
    [(1.0, {"learning_rate": 1e4}), (1e6, {}), (1e30, {}), (1.0, {"learning_rate": 1e30})],
    ids=str,
)
def test_training_that_diverges_says_so(
    factor: float, params: dict[str, Any], probabilistic: bool
) -> None:
    X, y = data()
    model = small(probabilistic=probabilistic, warm_start=True, hidden_layer_sizes=(16, 16))
    model.fit(X, y)
    with pytest.raises(ValueError, match=r"training diverged .* scale the inputs, or lower learn"):
        model.set_params(**params).fit(X * factor, y)
    # what is left of it is no model
    with pytest.raises(NotFittedError):
        model.predict(X)
    model.set_params(learning_rate=0.003).fit(X, y)


def test_divergence_of_a_stream_and_of_a_pass_says_so() -> None:
    with pytest.raises(ValueError, match="training diverged"):
        small(learning_rate=1e30).fit_stream(clean)
    with pytest.raises(ValueError, match="training diverged"):
        small(learning_rate=1e38, batch_size=8).partial_fit(*data())


@pytest.fixture
def two_threads() -> Iterator[None]:
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


@pytest.mark.usefixtures("two_threads")
def test_threads_are_limited_while_training_and_restored_after() -> None:
    seen = []

    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
        seen.append(torch.get_num_threads())
        if len(seen) == 4:
            raise RuntimeError("the stream broke")
        return clean(n, rng)

    small(max_steps=70).fit_stream(draw)
    assert seen == [2, 2, 1]  # the third draw falls between two steps
    assert torch.get_num_threads() == 2
    with pytest.raises(RuntimeError, match="the stream broke"):
        small(max_steps=70).fit_stream(draw)
    assert torch.get_num_threads() == 2
    with pytest.raises(ValueError, match="diverged"):
        small(learning_rate=1e30).fit(*data())
    assert torch.get_num_threads() == 2
