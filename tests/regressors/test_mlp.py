"""MLPEnsembleRegressor as a user meets it."""

import copy
import pickle
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import joblib
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from tests.sklearn_checks import run_checks
from trajlearn import MLPEnsembleRegressor
from trajlearn.regressors._samples import Rows, bootstrap_counts, held_out, standardisation

Floats = NDArray[np.float64]
SKIPPED = {"check_array_api_input": "runs only with SCIPY_ARRAY_API=1 set before scipy is imported"}


def small(**params: Any) -> MLPEnsembleRegressor:
    """A quick one: 30 steps of one small layer."""
    defaults = {"hidden_layer_sizes": (16,), "max_steps": 30, "random_state": 0}
    return MLPEnsembleRegressor(**(defaults | params))


def data(n: int = 60, n_targets: int = 2, seed: int = 0, noise: float = 0.0) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 3))
    y = np.stack([np.sin(3 * X[:, 0]) + X[:, k % 3] ** 2 for k in range(n_targets)], axis=1)
    return X, y + noise * rng.normal(size=y.shape)


# -- scikit-learn -------------------------------------------------------------------------


def test_scikit_learns_own_checks_pass() -> None:
    run_checks(MLPEnsembleRegressor(), allowed_skips=SKIPPED)


def test_scikit_learns_own_checks_pass_for_a_probabilistic_ensemble() -> None:
    model = MLPEnsembleRegressor(n_members=2, probabilistic=True, hidden_layer_sizes=(64, 64))
    run_checks(model, allowed_skips=SKIPPED)


def test_columns_of_a_dataframe_are_remembered_without_a_warning() -> None:
    X, y = data()
    frame = pd.DataFrame(X, columns=["a", "b", "c"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = small().fit(frame, y)
        model.partial_fit(frame, y)
        np.testing.assert_array_equal(model.predict(frame), model.predict_members(frame)[0])
    with pytest.raises(ValueError, match="feature names"):
        model.predict(frame[["b", "a", "c"]])


@pytest.mark.parametrize("method", ["predict", "predict_members"])
def test_predicting_before_fit_says_so(method: str) -> None:
    with pytest.raises(NotFittedError):
        getattr(MLPEnsembleRegressor(), method)([[1.0]])


# -- what it learns -----------------------------------------------------------------------


def test_default_learns_a_smooth_function_of_200_rows() -> None:
    X, y = data(200, n_targets=1, seed=1)
    Xt, yt = data(500, n_targets=1, seed=2)
    model = MLPEnsembleRegressor(random_state=0).fit(X, y[:, 0])
    assert model.score(Xt, yt[:, 0]) > 0.99
    assert model.n_steps_ == 276


def test_targets_of_any_unit_are_learned_alike() -> None:
    X, y = data(80)
    scale, shift = np.array([1e-6, 1e5]), np.array([3.0, -1e6])
    plain = small(max_steps=200).fit(X, y)
    other = small(max_steps=200).fit(X, y * scale + shift)
    np.testing.assert_allclose((other.predict(X) - shift) / scale, plain.predict(X), atol=1e-3)
    np.testing.assert_allclose(other.residual_std_, plain.residual_std_ * scale, rtol=1e-3)


def test_shapes_of_targets_come_back() -> None:
    X, y = data()
    for target in (y[:, 0], y[:, :1], y):
        mean, std = small(n_members=3).fit(X, target).predict(X, return_std=True)
        assert mean.shape == std.shape == target.shape
        assert (std > 0).all()
    assert small(n_members=3).fit(X, y).predict_members(X).shape == (3, 60, 2)


def test_constant_targets_are_predicted() -> None:
    X, _ = data()
    y = np.tile([3.0, 0.0, -1e9], (60, 1))
    for probabilistic in (False, True):
        model = small(max_steps=200, probabilistic=probabilistic).fit(X, y)
        mean, std = model.predict(X, return_std=True)
        np.testing.assert_allclose(mean, y, atol=0.3)
        assert np.isfinite(std).all()


def test_one_row_is_enough() -> None:
    model = small().fit([[1.0, 2.0]], [5.0])
    assert model.predict([[1.0, 2.0]]) == pytest.approx(5.0, abs=0.3)


def test_single_precision_and_integer_inputs_count_as_the_same_numbers() -> None:
    X, y = data()
    X = np.round(10 * X).astype(np.int64)
    expected = small().fit(X.astype(float), y).predict(X.astype(float))
    assert expected.dtype == np.float64
    for dtype in (np.float32, np.int64):
        model = small().fit(X.astype(dtype), y)
        np.testing.assert_array_equal(model.predict(X.astype(dtype)), expected)


def test_no_hidden_layer_is_linear_regression() -> None:
    X, _ = data(100)
    y = X @ [1.0, -2.0, 0.5] + 4
    model = small(hidden_layer_sizes=(), max_steps=1500, learning_rate=0.02).fit(X, y)
    np.testing.assert_allclose(model.predict(X), y, atol=1e-2)


def test_std_recovers_noise_that_depends_on_the_input() -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (3000, 1))
    y = np.sin(2 * X[:, 0]) + (0.1 + 0.4 * X[:, 0] ** 2) * rng.normal(size=3000)
    model = MLPEnsembleRegressor(
        probabilistic=True, n_members=2, hidden_layer_sizes=(32, 32), max_steps=1200, random_state=0
    ).fit(X, y)
    grid = np.linspace(-0.95, 0.95, 39)[:, None]
    mean, std = model.predict(grid, return_std=True)
    truth = 0.1 + 0.4 * grid[:, 0] ** 2
    assert np.abs(std / truth - 1).mean() < 0.2
    assert np.abs(mean - np.sin(2 * grid[:, 0])).mean() < 0.05


def test_std_of_a_deterministic_ensemble_is_that_of_residuals_and_members() -> None:
    X, y = data(noise=0.3)
    model = small(n_members=4).fit(X, y)
    members = model.predict_members(X)
    residual = np.sqrt(((members - y) ** 2).mean(axis=1))
    np.testing.assert_allclose(model.residual_std_, residual)
    mean, std = model.predict(X, return_std=True)
    np.testing.assert_allclose(mean, members.mean(axis=0))
    np.testing.assert_allclose(std, np.sqrt((residual**2).mean(axis=0) + members.var(axis=0)))


def test_variance_bounds_are_trained() -> None:
    X, y = data(noise=0.1)
    model = small(probabilistic=True, n_members=2, max_steps=100).fit(X, y)
    low, high = model.logvar_bounds_
    assert low.shape == (2, 1, 2)
    assert (low > -10).all()
    assert (high < 0.5).all()
    assert len(np.unique(model.logvar_bounds_)) == 8


# -- parameters ---------------------------------------------------------------------------

CHANGES: list[dict[str, Any]] = [
    {"hidden_layer_sizes": (16, 16)},
    {"hidden_layer_sizes": (15,)},
    {"n_members": 2},
    {"probabilistic": True},
    {"activation": "relu"},
    {"activation": "tanh"},
    {"learning_rate": 1e-3},
    {"schedule": "constant"},
    {"batch_size": 8},
    {"batch_size": 256},
    {"max_steps": 31},
    {"max_epochs": 3},
    {"weight_decay": 0.5},
    {"bootstrap": "row"},
    {"bootstrap": "group"},
    {"early_stopping": True},
    {"random_state": 1},
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_every_parameter_changes_the_outcome(change: dict[str, Any]) -> None:
    X, y = data()
    groups = np.arange(60) // 6
    base = small(batch_size=16).fit(X, y, groups=groups).predict(X)
    again = small(batch_size=16).fit(X, y, groups=groups).predict(X)
    other = small(**({"batch_size": 16} | change)).fit(X, y, groups=groups).predict(X)
    np.testing.assert_array_equal(base, again)
    assert np.abs(base - other).max() > 1e-5


@pytest.mark.parametrize(
    ("base", "change"),
    [
        ({"probabilistic": True}, {"nll_beta": 0.0}),
        ({"probabilistic": True}, {"nll_beta": 1.0}),
        ({"early_stopping": True}, {"validation_fraction": 0.5}),
        ({"early_stopping": True, "max_steps": 300}, {"patience": 1}),
    ],
)
def test_every_dependent_parameter_changes_the_outcome(
    base: dict[str, Any], change: dict[str, Any]
) -> None:
    X, y = data(noise=0.5)
    first = small(**base).fit(X, y).predict(X)
    assert np.abs(first - small(**(base | change)).fit(X, y).predict(X)).max() > 1e-5


def test_budgets() -> None:
    X, y = data(100)
    assert small(max_steps=None).fit(X, y).n_steps_ == 188
    assert small(max_steps=None).fit(X[:10], y[:10]).n_steps_ == 100
    assert small(max_steps=7).fit(X, y).n_steps_ == 7
    assert small(max_epochs=3, batch_size=32).fit(X, y).n_steps_ == 12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hidden_layer_sizes": (16, 0)}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": (2.5,)}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": 16}, "hidden_layer_sizes"),
        ({"n_members": 0}, "n_members"),
        ({"activation": "gelu"}, "activation"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"schedule": "cosine"}, "schedule"),
        ({"batch_size": 0}, "batch_size"),
        ({"max_steps": 0}, "max_steps"),
        ({"max_epochs": 0}, "max_epochs"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"bootstrap": "column"}, "bootstrap"),
        ({"validation_fraction": 1.0}, "validation_fraction"),
        ({"patience": 0}, "patience"),
        ({"nll_beta": 1.5}, "nll_beta"),
        ({"device": "toaster"}, "device='toaster'"),
    ],
    ids=str,
)
def test_invalid_parameters_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(**change).fit(*data())


def test_an_absent_device_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    X, y = data()
    model = small().fit(X, y)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(ValueError, match="device='cuda': torch finds 0 CUDA devices"):
        small(device="cuda").fit(X, y)
    with pytest.raises(ValueError, match="torch finds 0 CUDA devices"):
        model.set_params(device="cuda:1").predict(X)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_gpu_learns_the_same() -> None:
    X, y = data(400)
    settings = {"n_members": 2, "probabilistic": True, "early_stopping": True}
    on_cpu = small(**settings).fit(X, y)
    on_gpu = small(device="cuda", **settings).fit(X, y)
    np.testing.assert_allclose(on_gpu.predict(X), on_cpu.predict(X), atol=1e-2)
    on_gpu.set_params(early_stopping=False).partial_fit(X, y)


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
    [(np.zeros(60), "zero everywhere"), (-np.ones(60), "negative"), (np.ones(59), "shape")],
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
    settings = {"early_stopping": True, "max_steps": 1000, "learning_rate": 0.02}
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


def test_partial_fit_shuffles_anew_in_every_pass() -> None:
    X, y = data(64)
    first = small(batch_size=16).partial_fit(X, y)
    second = copy.deepcopy(first).partial_fit(X, y)
    # undo what the first pass learned but not that there was one
    rewound = copy.deepcopy(first)
    rewound._moments = [np.zeros_like(m) for m in rewound._moments]
    assert not np.array_equal(second.predict(X), rewound.partial_fit(X, y).predict(X))
    np.testing.assert_array_equal(
        second.predict(X), small(batch_size=16).partial_fit(X, y).partial_fit(X, y).predict(X)
    )


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


def clean(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
    X = rng.uniform(-1, 1, (n, 3))
    return X, np.stack([np.sin(3 * X[:, 0]), X[:, 1] * X[:, 2]], axis=1), None


def test_a_stream_is_learned() -> None:
    model = small(hidden_layer_sizes=(64, 64), max_steps=300, batch_size=64, n_members=2)
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


# -- randomness and copies ----------------------------------------------------------------


def test_global_generators_are_left_alone() -> None:
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    model = small(bootstrap="row", early_stopping=True, probabilistic=True).fit(*data())
    model.set_params(bootstrap=False, early_stopping=False).partial_fit(*data())
    model.fit_stream(clean).predict(data()[0], return_std=True)
    assert torch.equal(torch.get_rng_state(), torch_before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


def test_a_seed_or_a_generator_decides_the_bits() -> None:
    X, y = data(300)
    torch.manual_seed(1)
    first = small(batch_size=32, bootstrap="row").fit(X, y)
    torch.manual_seed(2)
    second = small(batch_size=32, bootstrap="row").fit(X, y)
    for a, b in zip(first.coefs_, second.coefs_):
        np.testing.assert_array_equal(a, b)

    def with_state() -> Iterator[Floats]:
        state = np.random.RandomState(3)  # noqa: NPY002
        for _ in range(2):
            yield small(random_state=state).fit(X, y).predict(X)

    once, again = list(with_state()), list(with_state())
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once[0], once[1])


def test_members_differ_and_do_not_hang_on_the_number_of_members() -> None:
    X, y = data()
    members = small(n_members=3).fit(X, y).predict_members(X)
    assert np.abs(members[0] - members[1]).max() > 1e-3
    assert np.abs(members[1] - members[2]).max() > 1e-3


@pytest.mark.parametrize("params", [{}, {"n_members": 2, "probabilistic": True}], ids=str)
def test_copies_predict_the_same_bits_and_train_on(
    params: dict[str, Any], tmp_path: Any
) -> None:
    X, y = data()
    model = small(**params).partial_fit(X, y)
    path = tmp_path / "model.joblib"
    joblib.dump(model, path)
    on_disk = joblib.load(path, mmap_mode="r")
    assert not on_disk.coefs_[0].flags.writeable
    copies = [pickle.loads(pickle.dumps(model)), copy.deepcopy(model), joblib.load(path), on_disk]
    expected = model.predict(X, return_std=True)
    further = copy.deepcopy(model).partial_fit(X, y).predict(X)
    read_only = X.astype(np.float32), X.astype(np.float32).astype(np.float64)
    for array in read_only:
        array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for other in copies:
            for part, same in zip(other.predict(X, return_std=True), expected):
                np.testing.assert_array_equal(part, same)
            np.testing.assert_array_equal(other.predict(read_only[0]), other.predict(read_only[1]))
            np.testing.assert_array_equal(other.partial_fit(X, y).predict(X), further)
        small(**params).fit(read_only[0], y)


# -- what a user sees ---------------------------------------------------------------------


@pytest.mark.parametrize("n_steps", [1, 99, 100, 101, 250])
def test_loss_curve_has_about_a_hundred_values(n_steps: int) -> None:
    model = small(max_steps=n_steps, n_members=3).fit(*data())
    n_values, n_members = model.loss_curve_.shape
    assert n_members == 3
    assert min(n_steps, 100) <= n_values < 200
    assert model.validation_loss_curve_.shape == (0, 3)


def test_verbose_shows_a_bar_on_stderr_and_silence_is_the_default(
    capsys: pytest.CaptureFixture[str],
) -> None:
    X, y = data()
    small().fit(X, y)
    assert capsys.readouterr() == ("", "")
    small(verbose=1).fit(X, y)
    out, err = capsys.readouterr()
    assert out == ""
    assert "30/30" in err
    assert "loss=" in err
    stopped = small(verbose=1, early_stopping=True, max_steps=5000, patience=2, learning_rate=0.1)
    stopped.fit(*data(noise=1.0))
    assert f"{stopped.n_steps_}/5000" in capsys.readouterr().err


def test_fitting_does_not_import_torchs_compiler() -> None:
    # a second or more at the first fit of every process
    assert "torch._dynamo" not in sys.modules or _imported_elsewhere()


def _imported_elsewhere() -> bool:
    code = (
        "import sys, numpy as np; from trajlearn import MLPEnsembleRegressor as M; "
        "M(max_steps=2, hidden_layer_sizes=(2,)).fit(np.eye(3), np.arange(3.0)); "
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    import subprocess

    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
