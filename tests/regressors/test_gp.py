import copy
import pickle
import warnings

import joblib
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_operator.utils.warnings import NumericalWarning
from scipy import sparse
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
from sklearn.model_selection import GridSearchCV

from tests.sklearn_checks import run_checks
from trajlearn.regressors._gp_models import cholesky
from trajlearn.regressors.gp import GPRegressor

KERNELS = ["rbf", "matern12", "matern32", "matern52"]


def wave(n, d=2, *, noise=0.1, seed=0):
    """Rows of a function of the first two inputs: (X, y, the function without noise)."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, size=(n, d))
    f = np.sin(2 * X[:, 0]) + (0.3 * X[:, 1] ** 2 if d > 1 else 0.0)
    return X, f + noise * rng.normal(size=n), f


@pytest.fixture(scope="module")
def fitted():
    X, y, _ = wave(61, 3)
    return GPRegressor(random_state=0).fit(X, np.column_stack([y, X[:, 2]]))


@pytest.fixture(scope="module")
def sparse_fitted():
    X, y, f = wave(2500, 4)
    return GPRegressor(n_inducing=80, max_iter=40, random_state=0).fit(X, y), X, y, f


def sklearn_twin(gp, X, y, target=0):
    """scikit-learn's GP at the hyper-parameters of ours, on data standardised by hand."""
    scale = y.std()
    length_scale = gp.length_scales_[target] / X.std(axis=0)
    base = (
        RBF(length_scale)
        if gp.kernel == "rbf"
        else Matern(length_scale, nu=int(gp.kernel.removeprefix("matern")[0]) / 2)
    )
    kernel = ConstantKernel((gp.signal_std_[target] / scale) ** 2) * base
    kernel += WhiteKernel((gp.noise_std_[target] / scale) ** 2)
    twin = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None)
    return twin.fit((X - X.mean(axis=0)) / X.std(axis=0), (y - y.mean()) / scale)


# -- scikit-learn's contract ----------------------------------------------------------------


def test_check_estimator():
    run_checks(
        GPRegressor(),
        allowed_skips={
            "check_array_api_input": "runs only if SCIPY_ARRAY_API=1 is set before importing scipy"
        },
    )


def test_shapes_follow_y(fitted):
    X, y, _ = wave(12)
    for shape in [(12,), (12, 1)]:
        gp = GPRegressor(n_restarts=0, random_state=0).fit(X, y.reshape(shape))
        mean, std = gp.predict(X[:5], return_std=True)
        assert mean.shape == std.shape == (5, *shape[1:])
    assert fitted.predict(np.zeros((7, 3))).shape == (7, 2)
    assert fitted.length_scales_.shape == (2, 3)
    for name in ("noise_std_", "signal_std_", "log_marginal_likelihood_", "n_iter_"):
        assert getattr(fitted, name).shape == (2,)


def test_data_frames_and_search():
    X, y, _ = wave(30)
    frame = pd.DataFrame(X, columns=["angle", "speed"])
    gp = GPRegressor(n_restarts=0, random_state=0).fit(frame, pd.Series(y))
    assert gp.feature_names_in_.tolist() == ["angle", "speed"]
    np.testing.assert_array_equal(gp.predict(frame), clone(gp).fit(X, y).predict(X))
    search = GridSearchCV(clone(gp), {"kernel": ["matern12", "rbf"]}, cv=3).fit(X, y)
    assert search.best_params_ == {"kernel": "rbf"}


# -- what it learns ---------------------------------------------------------------------------


def test_recovers_a_sine_and_its_noise():
    X, y, _ = wave(120, 1, noise=0.2)
    gp = GPRegressor(random_state=0).fit(X, y)
    grid = np.linspace(-1.9, 1.9, 50)[:, None]
    mean, std = gp.predict(grid, return_std=True)
    assert np.sqrt(np.mean((mean - np.sin(2 * grid[:, 0])) ** 2)) < 0.1
    assert 0.15 < gp.noise_std_[0] < 0.27
    assert (std >= gp.noise_std_[0]).all()
    assert std.max() < 1.5 * gp.noise_std_[0]


def test_what_is_smooth_and_exact_is_learned_to_some_ten_thousandths():
    X = np.random.default_rng(0).uniform(-2, 2, (120, 2))
    off = GPRegressor(n_restarts=0).fit(X[:100], np.sin(X[:100, 0]) * X[:100, 1]).predict(X[100:])
    off -= np.sin(X[100:, 0]) * X[100:, 1]
    assert np.abs(off).max() < 1e-4


def test_jitter_is_told_if_it_is_more_than_exact_data_need():
    nearly = torch.ones(6, 6, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        factor = cholesky(nearly)
    np.testing.assert_allclose(factor @ factor.T, nearly, atol=1e-7)
    with pytest.warns(NumericalWarning, match="jitter"):
        cholesky(nearly - 5e-7 * torch.eye(6))


def test_finds_the_input_that_does_not_matter():
    X, y, _ = wave(150, 3)
    length_scales = GPRegressor(random_state=0).fit(X, y).length_scales_[0]
    assert length_scales[2] > 10 * length_scales[0]
    assert length_scales[2] > 5 * length_scales[1]


def test_intervals_cover_what_they_promise():
    z = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        X = rng.uniform(0, 3, size=(300, 2))
        covariance = np.exp(-0.5 * ((X[:, None] - X) ** 2).sum(axis=2))
        f = np.linalg.cholesky(covariance + 1e-9 * np.eye(300)) @ rng.normal(size=300)
        y = 50 + 10 * (f + 0.3 * rng.normal(size=300))
        gp = GPRegressor(random_state=0).fit(X[:120], y[:120])
        mean, std = gp.predict(X[120:], return_std=True)
        z.append((y[120:] - mean) / std)
    assert 0.6 < np.mean(np.abs(z) < 1.0) < 0.75
    assert 0.91 < np.mean(np.abs(z) < 1.96) < 0.98


def test_far_away_it_knows_nothing():
    for kernel in KERNELS:
        X, y, _ = wave(20)
        gp = GPRegressor(kernel=kernel, n_restarts=0, random_state=0).fit(X, y)
        mean, std = gp.predict([[1e7, -1e7], [1e300, 1e300]], return_std=True)
        np.testing.assert_allclose(mean, y.mean())
        np.testing.assert_allclose(std, np.hypot(gp.signal_std_[0], gp.noise_std_[0]))


# -- agreement with independent computations --------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS)
def test_agrees_with_scikit_learn(kernel):
    X, y, _ = wave(60, 3)
    X, y = X * [1.0, 30.0, 0.01] + 5, 1e3 * y
    gp = GPRegressor(kernel=kernel, n_restarts=0, random_state=0).fit(X, y)
    twin = sklearn_twin(gp, X, y)
    new = wave(40, 3, seed=1)[0] * [1.0, 30.0, 0.01] + 5
    mean, std = gp.predict(new, return_std=True)
    twin_mean, twin_std = twin.predict((new - X.mean(axis=0)) / X.std(axis=0), return_std=True)
    np.testing.assert_allclose(mean, y.mean() + y.std() * twin_mean, atol=1e-6 * y.std())
    np.testing.assert_allclose(std, y.std() * twin_std, atol=1e-6 * y.std())
    log_likelihood = twin.log_marginal_likelihood_value_ - len(y) * np.log(y.std())
    np.testing.assert_allclose(gp.log_marginal_likelihood_, log_likelihood, rtol=1e-8)


def test_sparse_comes_close_to_exact(sparse_fitted):
    gp, X, y, _ = sparse_fitted
    assert gp.is_sparse_
    assert gp.basis_.shape == (1, 80, 4)
    assert 0.09 < gp.noise_std_[0] < 0.11
    new, _, f = wave(300, 4, seed=1)
    mean, std = gp.predict(new, return_std=True)
    twin = sklearn_twin(gp, X, y)
    twin_mean, twin_std = twin.predict((new - X.mean(axis=0)) / X.std(axis=0), return_std=True)
    exact = y.mean() + y.std() * twin_mean
    assert np.sqrt(np.mean((mean - exact) ** 2)) < 0.01
    np.testing.assert_allclose(std, y.std() * twin_std, rtol=0.02)
    assert np.sqrt(np.mean((mean - f) ** 2)) < 1.2 * np.sqrt(np.mean((exact - f) ** 2))
    exact_evidence = twin.log_marginal_likelihood_value_ - len(y) * np.log(y.std())
    assert exact_evidence - 30 < gp.log_marginal_likelihood_[0] < exact_evidence


# -- awkward data -----------------------------------------------------------------------------


def test_constant_columns_and_huge_offsets_are_harmless():
    X, y, _ = wave(60, 2)
    plain = GPRegressor(n_restarts=0, random_state=0).fit(X, y)
    times = 0.02 * np.arange(60)
    constants = [np.full(60, 7.0), np.zeros(60), (times + 0.02) - times]
    extended = np.column_stack([X[:, 0] + 1e8, X[:, 1], *constants])
    gp = GPRegressor(n_restarts=0, random_state=0).fit(extended, y + 1e8)
    new = wave(40, 2, seed=1)[0]
    new_extended = np.column_stack([new[:, 0] + 1e8, new[:, 1], np.tile([7.0, 0.0, 0.02], (40, 1))])
    np.testing.assert_allclose(gp.predict(new_extended) - 1e8, plain.predict(new), atol=0.01)
    # a constant that changes by a tenth is a small step, not a leap to where nothing is known
    new_extended[:, 2:] *= 1.1
    moved, std = gp.predict(new_extended, return_std=True)
    np.testing.assert_allclose(moved - 1e8, plain.predict(new), atol=0.05)
    assert np.median(std) < 2 * gp.noise_std_[0]


def test_constant_target():
    X, _, _ = wave(30)
    mean, std = GPRegressor(random_state=0).fit(X, np.full(30, 1e8)).predict(X, return_std=True)
    np.testing.assert_allclose(mean, 1e8)
    assert (std < 0.01).all()


def test_duplicated_rows_count_as_repeated_measurements():
    X, y, _ = wave(15)
    X, y = np.repeat(X, 20, axis=0), np.repeat(y, 20)
    y = y + 0.2 * np.random.default_rng(0).normal(size=len(y))
    gp = GPRegressor(random_state=0).fit(X, y)
    means = y.reshape(15, 20).mean(axis=1)
    np.testing.assert_allclose(gp.predict(X[::20]), means, atol=0.1)
    assert 0.15 < gp.noise_std_[0] < 0.25


def test_single_row():
    gp = GPRegressor(random_state=0).fit([[1.0, 2.0]], [3.0])
    mean, std = gp.predict([[1.0, 2.0], [100.0, 2.0]], return_std=True)
    np.testing.assert_allclose(mean, 3.0)
    assert 0 < std[0] < std[1]


def test_units_of_the_targets():
    X, y, _ = wave(30)
    gp = GPRegressor(n_restarts=0, random_state=0).fit(X, y)
    scaled = clone(gp).fit(X * 64, y * 1024 - 3)
    mean, std = gp.predict(X, return_std=True)
    big_mean, big_std = scaled.predict(X * 64, return_std=True)
    np.testing.assert_allclose(big_mean, mean * 1024 - 3, rtol=1e-3)
    np.testing.assert_allclose(big_std, std * 1024, rtol=1e-3)
    np.testing.assert_allclose(scaled.noise_std_, gp.noise_std_ * 1024, rtol=1e-3)
    np.testing.assert_allclose(scaled.length_scales_, gp.length_scales_ * 64, rtol=0.01)


# -- bits -------------------------------------------------------------------------------------


def test_targets_do_not_influence_each_other(fitted):
    X, y, _ = wave(61, 3)
    for i, target in enumerate([y, X[:, 2]]):
        alone = GPRegressor(random_state=0).fit(X, target)
        for ours, joint in zip(
            alone.predict(X, return_std=True), fitted.predict(X, return_std=True)
        ):
            np.testing.assert_array_equal(ours, joint[:, i])
        np.testing.assert_array_equal(alone.length_scales_[0], fitted.length_scales_[i])


@pytest.mark.parametrize("max_exact", [2000, 10])
def test_same_seed_same_bits_and_global_generators_untouched(max_exact):
    X, y, _ = wave(45)
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    model = GPRegressor(random_state=3, max_exact=max_exact, n_inducing=8)
    a, b = clone(model).fit(X, y), clone(model).fit(X, y)
    for ours, again in zip(a.predict(X, return_std=True), b.predict(X, return_std=True)):
        np.testing.assert_array_equal(ours, again)
    assert torch.equal(torch_state, torch.get_rng_state())
    np.testing.assert_array_equal(numpy_state, np.random.get_state()[1])  # noqa: NPY002


def test_threads_are_restored_and_do_not_matter(fitted):
    X, y, _ = wave(61, 3)
    one = fitted.predict(X, return_std=True)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        two = fitted.predict(X, return_std=True)
        refitted = clone(fitted).fit(X, np.column_stack([y, X[:, 2]]))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    for ours, other, again in zip(one, two, refitted.predict(X, return_std=True)):
        np.testing.assert_array_equal(ours, other)
        np.testing.assert_array_equal(ours, again)


@given(st.lists(st.integers(0, 149), min_size=1, max_size=150))
@settings(max_examples=40)
def test_a_row_gets_the_same_bits_in_any_company(fitted, chosen):
    # 61 training rows: an odd length is where matrix products are known to differ
    rows = wave(150, 3, seed=5)[0]
    mean, std = fitted.predict(rows, return_std=True)
    some_mean, some_std = fitted.predict(rows[chosen], return_std=True)
    np.testing.assert_array_equal(some_mean, mean[chosen])
    np.testing.assert_array_equal(some_std, std[chosen])
    np.testing.assert_array_equal(fitted.predict(rows[chosen]), mean[chosen])


@pytest.mark.parametrize("n", [1, 2, 3, 7, 16, 33, 127, 200])
def test_bits_for_other_numbers_of_training_rows(n):
    X, y, _ = wave(n)
    gp = GPRegressor(n_restarts=0, random_state=0).fit(X, y)
    rows = wave(101, seed=6)[0]
    together = np.array(gp.predict(rows, return_std=True))
    backwards = np.array(gp.predict(rows[::-1], return_std=True))[:, ::-1]
    alone = np.hstack([gp.predict(rows[i : i + 1], return_std=True) for i in range(101)])
    np.testing.assert_array_equal(backwards, together)
    np.testing.assert_array_equal(alone, together)


def test_bits_of_the_sparse_gp(sparse_fitted):
    gp = sparse_fitted[0]
    rows = wave(101, 4, seed=6)[0]
    together = np.array(gp.predict(rows, return_std=True))
    alone = np.hstack([gp.predict(rows[i : i + 1], return_std=True) for i in range(0, 101, 10)])
    np.testing.assert_array_equal(alone, together[:, ::10])


def test_copies_and_files_keep_the_bits(fitted, sparse_fitted, tmp_path):
    for gp in (fitted, sparse_fitted[0]):
        rows = wave(30, gp.n_features_in_, seed=7)[0]
        joblib.dump(gp, tmp_path / "gp.joblib")
        copies = [
            pickle.loads(pickle.dumps(gp)),
            joblib.load(tmp_path / "gp.joblib"),
            joblib.load(tmp_path / "gp.joblib", mmap_mode="r"),
            copy.deepcopy(gp),
        ]
        for other in copies:
            for ours, theirs in zip(
                gp.predict(rows, return_std=True), other.predict(rows, return_std=True)
            ):
                np.testing.assert_array_equal(ours, theirs)


def test_fitted_state_is_plain(fitted):
    state = {k: v for k, v in vars(fitted).items() if k not in fitted.get_params()}
    assert {type(v) for v in state.values()} <= {np.ndarray, int, bool}
    assert not hasattr(clone(fitted), "weights_")


# -- parameters -------------------------------------------------------------------------------


def test_kernel_changes_the_smoothness():
    X, y, _ = wave(40, noise=0.02)
    evidence = {}
    for kernel in KERNELS:
        gp = GPRegressor(kernel=kernel, n_restarts=0, random_state=0).fit(X, y)
        evidence[kernel] = gp.log_marginal_likelihood_[0]
    # an analytic function: the smoother the prior, the likelier the data
    assert sorted(KERNELS, key=evidence.get) == ["matern12", "matern32", "matern52", "rbf"]


def test_restarts_find_a_better_optimum():
    rng = np.random.default_rng(3)
    X = rng.normal(size=(50, 8))
    y = np.sin(1.5 * X).sum(axis=1) + 0.2 * rng.normal(size=50)
    reached = [
        GPRegressor(n_restarts=k, random_state=0).fit(X, y).log_marginal_likelihood_[0]
        for k in (0, 4)
    ]
    assert reached[1] > reached[0] + 1.0


def test_max_iter_stops_early_and_says_so():
    X, y, _ = wave(40)
    with pytest.warns(ConvergenceWarning, match="max_iter=2"):
        short = GPRegressor(max_iter=2, random_state=0).fit(X, y)
    long = GPRegressor(random_state=0).fit(X, y)
    assert short.n_iter_[0] == 2 < long.n_iter_[0]
    assert short.log_marginal_likelihood_[0] < long.log_marginal_likelihood_[0]


def test_max_exact_n_inducing_and_max_fit_rows():
    X, y, _ = wave(120, 2)
    model = GPRegressor(n_restarts=0, random_state=0, max_iter=30)
    exact = clone(model).set_params(max_exact=120).fit(X, y)
    assert not exact.is_sparse_
    assert exact.basis_.shape == (1, 120, 2)
    model.set_params(max_exact=119)
    bounds = []
    for n_inducing in (3, 12):
        gp = clone(model).set_params(n_inducing=n_inducing).fit(X, y)
        assert gp.basis_.shape == (1, n_inducing, 2)
        bounds.append(gp.log_marginal_likelihood_[0])
    assert bounds[0] < bounds[1] <= exact.log_marginal_likelihood_[0] + 1.0
    few = clone(model).set_params(n_inducing=12, max_fit_rows=40).fit(X, y)
    assert few.log_marginal_likelihood_[0] < bounds[1]
    # more points than different rows: as many as there are
    gp = clone(model).set_params(max_fit_rows=30, n_inducing=50).fit(X, y)
    assert gp.basis_.shape == (1, 30, 2)


def test_sparse_targets_have_their_own_points():
    X, y, _ = wave(90, 2)
    gp = GPRegressor(max_exact=50, n_inducing=6, max_iter=20, random_state=0)
    gp.fit(X, np.column_stack([y, X[:, 1] ** 3]))
    assert gp.basis_.shape == (2, 6, 2)
    mean, std = gp.predict(X, return_std=True)
    assert mean.shape == std.shape == (90, 2)
    assert np.corrcoef(mean[:, 1], X[:, 1] ** 3)[0, 1] > 0.95


def test_random_state_matters_where_rows_are_drawn():
    X, y, _ = wave(80)
    model = GPRegressor(max_exact=50, max_fit_rows=30, n_inducing=5, n_restarts=0, max_iter=20)
    a, b = (clone(model).set_params(random_state=seed).fit(X, y) for seed in (0, 1))
    assert not np.array_equal(a.predict(X), b.predict(X))


def test_verbose_prints_a_line_for_every_target(capsys):
    X, y, _ = wave(15)
    model = GPRegressor(n_restarts=0, random_state=0)
    model.fit(X, y)
    assert capsys.readouterr().out == ""
    model.set_params(verbose=1).fit(X, np.column_stack([y, X]))
    assert capsys.readouterr().out.count("length scales") == 3


# -- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"X": np.full((10, 2), np.nan)}, "Input X contains NaN"),
        ({"y": np.full(10, np.inf)}, "Input y contains infinity"),
        ({"y": np.zeros(9)}, "inconsistent numbers of samples"),
        ({"y": None}, "requires y to be passed"),
        ({"X": np.zeros(10)}, "Expected 2D array"),
        ({"X": np.zeros((0, 2)), "y": np.zeros(0)}, "0 sample"),
        ({"y": np.zeros((10, 2, 2))}, "dim 3"),
        ({"y": np.array(["fast"] * 10)}, "fast"),
        ({"X": np.linspace(0, 1e200, 20).reshape(10, 2)}, "Column 0 of X spreads so widely"),
        ({"y": np.linspace(0, 1e200, 10)}, "Column 0 of y spreads so widely"),
    ],
)
def test_errors_of_fit(change, message):
    arguments = {"X": wave(10)[0], "y": wave(10)[1]} | change
    with pytest.raises(ValueError, match=message):
        GPRegressor().fit(**arguments)


def test_sparse_matrices_are_refused():
    X, y, _ = wave(10)
    with pytest.raises(TypeError, match="dense data is required"):
        GPRegressor().fit(sparse.csr_array(X), y)
    with pytest.raises(TypeError, match="dense data is required"):
        GPRegressor().fit(X, sparse.csr_array(y[:, None]))


@pytest.mark.parametrize(
    "parameters",
    [
        {"kernel": "periodic"},
        {"n_restarts": -1},
        {"max_iter": 0},
        {"max_exact": -1},
        {"n_inducing": 0},
        {"max_fit_rows": 0},
        {"random_state": "seed"},
        {"verbose": -1},
    ],
)
def test_wrong_parameters(parameters):
    X, y, _ = wave(10)
    with pytest.raises(ValueError, match=f"'{next(iter(parameters))}' parameter of GPRegressor"):
        GPRegressor(**parameters).fit(X, y)


def test_errors_of_predict(fitted):
    with pytest.raises(NotFittedError):
        GPRegressor().predict([[0.0]])
    with pytest.raises(ValueError, match="expecting 3 features"):
        fitted.predict(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="contains NaN"):
        fitted.predict([[0.0, np.nan, 0.0]])
