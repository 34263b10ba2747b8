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
from sklearn.exceptions import NotFittedError

from tests.regressors.small_mlp import Floats, clean, data, small
from tests.sklearn_checks import run_checks
from trajlearn import MLPEnsembleRegressor

SKIPPED = {"check_array_api_input": "runs only with SCIPY_ARRAY_API=1 set before scipy is imported"}


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
    assert model.score(Xt, yt[:, 0]) > 0.97
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
    # where they start: the same for all members and targets
    assert (np.abs(low + 10) > 1e-2).all()
    assert (np.abs(high - 0.5) > 1e-2).all()
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
    ],
)
def test_every_dependent_parameter_changes_the_outcome(
    base: dict[str, Any], change: dict[str, Any]
) -> None:
    X, y = data(noise=0.5)
    first = small(**base).fit(X, y).predict(X)
    assert np.abs(first - small(**(base | change)).fit(X, y).predict(X)).max() > 1e-5


def test_patience_decides_when_to_stop() -> None:
    X, y = data(noise=1.0)
    settings = {"early_stopping": True, "max_steps": 1000, "learning_rate": 0.05}
    steps = [small(patience=p, **settings).fit(X, y).n_steps_ for p in (1, 5, 20)]
    assert steps[0] < steps[1] < steps[2] < 1000


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
        state = np.random.RandomState(3)
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
def test_copies_predict_the_same_bits_and_train_on(params: dict[str, Any], tmp_path: Any) -> None:
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


def test_fitting_does_not_import_torchs_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    # that takes a second or more, in every process that fits; None makes an import fail
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)
    small(probabilistic=True).fit(*data())
    with pytest.raises(ImportError):
        torch.optim.AdamW([torch.zeros(1, requires_grad=True)]).step()
