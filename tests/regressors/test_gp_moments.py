import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.exceptions import NotFittedError

from trajlearn.regressors import _gp_moments
from trajlearn.regressors._gp_moments import GaussianMoments, noise_variance
from trajlearn.regressors.gp import GPRegressor


def waves(X):
    """Two smooth functions of different wave lengths and heights."""
    return np.column_stack([np.sin(2 * X[:, 0]) + 0.3 * X[:, -1], 5.0 + 3 * np.cos(X.sum(axis=1))])


def fitted(k, *, n=60, sparse=False, scale=1.0):
    """GP of two outputs with `k` inputs; a sparse one has a basis for each output."""
    rng = np.random.default_rng(k)
    X = rng.uniform(-2, 2, size=(n, k)) * scale + 1.0
    Y = waves((X - 1.0) / scale) + 0.1 * rng.normal(size=(n, 2))
    settings = {"max_exact": 0, "n_inducing": 12} if sparse else {}
    return GPRegressor(n_restarts=0, max_iter=30, random_state=0, **settings).fit(X, Y)


@pytest.fixture(scope="module", params=["exact", "sparse"])
def plane(request):
    return fitted(2, sparse=request.param == "sparse", scale=4.0)


def semi_definite(rng, m, k, rank=None, scale=1.0):
    root = scale * rng.normal(size=(m, k, k if rank is None else rank))
    return root @ root.transpose(0, 2, 1)


def by_quadrature(gp, mean, covariance, n=80):
    """Moments at one Gaussian input from `gp.predict` at the nodes of a Gauss-Hermite grid."""
    k = len(mean)
    nodes, weights = np.polynomial.hermite_e.hermegauss(n)
    grid = np.stack(np.meshgrid(*[nodes] * k, indexing="ij"), axis=-1).reshape(-1, k)
    mass = np.prod(np.meshgrid(*[weights / weights.sum()] * k, indexing="ij"), axis=0).ravel()
    x = mean + grid @ np.linalg.cholesky(covariance).T
    return weighted(gp, x, mass)


def weighted(gp, x, mass):
    """Moments of f(x) and cross-covariance with x for inputs x of the given probabilities."""
    f, std = gp.predict(x, return_std=True)
    f, std = f.reshape(len(x), -1), std.reshape(len(x), -1)
    centred = f - mass @ f
    own = mass @ (std**2 - gp.noise_std_**2)
    return (
        mass @ f,
        (mass[:, None] * centred).T @ centred + np.diag(own),
        (mass[:, None] * (x - mass @ x)).T @ centred,
    )


# -- agreement with other computations ------------------------------------------------------


@pytest.mark.parametrize("sparse", [False, True], ids=["exact", "sparse"])
@pytest.mark.parametrize("std", [1e-5, 0.05, 0.5, 2.0])
def test_one_input_agrees_with_quadrature(sparse, std):
    gp = fitted(1, sparse=sparse)
    mean, covariance = np.array([[1.4], [-0.2]]), np.full((2, 1, 1), std**2)
    found = GaussianMoments(gp)(mean, covariance)
    for i in range(2):
        exact = by_quadrature(gp, mean[i], covariance[i], n=150)
        for ours, theirs in zip(found, exact):
            assert_allclose(ours[i], theirs, rtol=1e-8, atol=1e-10 * std)


def test_correlated_inputs_agree_with_quadrature(plane):
    mean = np.array([[1.0, 2.0], [5.0, -3.0]])
    covariance = np.array([[[1.0, 0.7], [0.7, 2.0]], [[4.0, -1.5], [-1.5, 1.0]]])
    found = GaussianMoments(plane)(mean, covariance)
    assert (np.abs(found[1][:, 0, 1]) > 0.02).all()  # the outputs do covary
    for i in range(2):
        for ours, theirs in zip(found, by_quadrature(plane, mean[i], covariance[i])):
            assert_allclose(ours[i], theirs, rtol=1e-8, atol=1e-10)


def test_singular_covariance_agrees_with_monte_carlo():
    gp = fitted(3)
    rng = np.random.default_rng(1)
    covariance = semi_definite(rng, 1, 3, rank=1, scale=0.5)
    n = 40_000
    root = np.sqrt(np.diag(covariance[0])) * np.sign(covariance[0, 0])
    assert_allclose(np.outer(root, root), covariance[0])
    x = 1.0 + rng.normal(size=(n, 1)) * root
    mean, spread, cross = GaussianMoments(gp)(np.ones((1, 3)), covariance)
    f, std = gp.predict(x, return_std=True)
    own = std**2 - noise_variance(gp)
    centred = f - mean[0]
    draws = {
        "mean": (f, mean[0]),
        "spread": (centred[:, :, None] * centred[:, None] + own[:, :, None] * np.eye(2), spread[0]),
        "cross": ((x - 1.0)[:, :, None] * centred[:, None], cross[0]),
    }
    for sample, expected in draws.values():
        error = sample.std(axis=0) / np.sqrt(n)
        assert (np.abs(sample.mean(axis=0) - expected) < 4 * error).all()


def test_a_known_input_is_a_plain_prediction(plane):
    x = np.random.default_rng(0).uniform(-8, 10, size=(70, 2))
    mean, spread, cross = GaussianMoments(plane)(x, np.zeros((70, 2, 2)))
    predicted, std = plane.predict(x, return_std=True)
    assert_allclose(mean, predicted, rtol=1e-10)
    total = np.diagonal(spread, axis1=1, axis2=2) + noise_variance(plane)
    assert_allclose(total, std**2, rtol=1e-9)
    assert (spread[:, 0, 1] == 0).all()
    assert (cross == 0).all()


@pytest.mark.parametrize("std", [1e-7, 1e-4])
def test_a_little_spread_goes_through_the_slope(plane, std):
    # the excesses are of the order 1e-14: a difference of expectations would lose them
    x, step = np.array([[2.0, 1.0]]), 1e-4
    shape = np.array([[1.0, 0.4], [0.4, 2.0]])
    slope = np.stack([plane.predict(x + step * e) - plane.predict(x - step * e) for e in np.eye(2)])
    slope = slope[:, 0] / (2 * step)
    _, spread, cross = GaussianMoments(plane)(x, std**2 * shape[None])
    assert_allclose(cross[0] / std**2, shape @ slope, rtol=1e-5)
    assert_allclose(spread[0, 0, 1] / std**2, (slope.T @ shape @ slope)[0, 1], rtol=1e-4)


def test_a_linear_function_maps_moments_linearly():
    rng = np.random.default_rng(0)
    X, slope = rng.normal(size=(80, 3)), np.array([[1.0, -2.0], [0.5, 0.0], [0.0, 3.0]])
    gp = GPRegressor(n_restarts=0, random_state=0).fit(X, X @ slope + 7.0)
    mean, covariance = np.array([[0.1, -0.3, 0.2]]), semi_definite(rng, 1, 3, scale=0.3)
    found = GaussianMoments(gp)(mean, covariance)
    assert_allclose(found[0], mean @ slope + 7.0, rtol=1e-3)
    assert_allclose(found[1][0], slope.T @ covariance[0] @ slope, rtol=5e-3, atol=1e-3)
    assert_allclose(found[2][0], covariance[0] @ slope, rtol=5e-3, atol=1e-3)


def test_a_1d_target_has_one_output():
    gp = fitted(1)
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, size=(30, 1))
    gp = GPRegressor(n_restarts=0, random_state=0).fit(X, np.sin(3 * X[:, 0]))
    found = GaussianMoments(gp)([[0.2]], [[[0.01]]])
    assert [values.shape for values in found] == [(1, 1), (1, 1, 1), (1, 1, 1)]
    for ours, theirs in zip(found, by_quadrature(gp, np.array([0.2]), np.array([[0.01]]))):
        assert_allclose(ours[0], theirs, rtol=1e-6, atol=1e-9)
    assert noise_variance(gp).shape == (1,)


# -- invariants -----------------------------------------------------------------------------


def test_an_input_gets_the_same_bits_in_any_batch(plane):
    rng = np.random.default_rng(0)
    mean, covariance = rng.uniform(-7, 9, size=(61, 2)), semi_definite(rng, 61, 2)
    moments = GaussianMoments(plane)
    order = rng.permutation(61)
    batch, shuffled = moments(mean, covariance), moments(mean[order], covariance[order])
    for whole, other in zip(batch, shuffled):
        np.testing.assert_array_equal(whole[order], other)
    for i in (0, 17, 60):
        for whole, alone in zip(batch, moments(mean[i : i + 1], covariance[i : i + 1])):
            np.testing.assert_array_equal(whole[i], alone[0])


def test_the_size_of_the_tiles_changes_nothing_but_round_off(plane, monkeypatch):
    rng = np.random.default_rng(0)
    args = rng.normal(size=(3, 2)), semi_definite(rng, 3, 2)
    whole = GaussianMoments(plane)(*args)
    monkeypatch.setattr(_gp_moments, "_TILE", 100)
    for ours, tiled in zip(whole, GaussianMoments(plane)(*args)):
        assert_allclose(tiled, ours, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rank", [0, 1, 3])
@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3, 1e9, 1e100])
def test_covariances_are_semi_definite(rank, scale):
    gp = fitted(3)
    rng = np.random.default_rng(2)
    covariance = semi_definite(rng, 20, 3, rank=rank, scale=scale)
    mean, spread, cross = GaussianMoments(gp)(rng.normal(size=(20, 3)), covariance)
    assert np.isfinite(mean).all()
    assert np.isfinite(cross).all()
    np.testing.assert_array_equal(spread, spread.transpose(0, 2, 1))
    assert (np.linalg.eigvalsh(spread) >= -1e-12 * gp.signal_std_.max() ** 2).all()


def test_round_off_leaves_no_negative_eigenvalue():
    above_one = np.array([[[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]], [[1.0, 0.5], [0.5, 1.0]]])
    mended = _gp_moments._semi_definite(above_one.copy())
    assert np.linalg.eigvalsh(mended[0])[0] >= -1e-15
    assert_allclose(mended[0], above_one[0], atol=2e-9)
    np.testing.assert_array_equal(mended[1], above_one[1])


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e12, 1e200])
@pytest.mark.parametrize("std", [0.0, 0.1, 1.0])
def test_far_from_the_data_is_the_prior(plane, distance, std):
    with np.errstate(over="raise", invalid="raise"):
        mean, spread, cross = GaussianMoments(plane)([[distance] * 2], std * np.eye(2)[None])
    assert_allclose(mean[0], plane.target_mean_)
    assert_allclose(spread[0], np.diag(plane.signal_std_**2), rtol=1e-12)
    assert_allclose(cross, 0.0, atol=1e-100)


def test_all_inputs_between_near_and_far_are_finite_and_smooth(plane):
    # kernels underflow and excesses overflow somewhere on the way out
    far = np.geomspace(1.0, 1e4, 400)
    mean, spread, _ = GaussianMoments(plane)(
        np.column_stack([far, far]), np.broadcast_to(np.eye(2), (400, 2, 2))
    )
    assert np.isfinite(mean).all()
    variance = np.diagonal(spread, axis1=1, axis2=2)
    assert (variance[far > 100] <= plane.signal_std_**2 * (1 + 1e-9)).all()
    assert (np.diff(variance[far > 100], axis=0) >= -1e-9).all()


# -- errors ---------------------------------------------------------------------------------


def test_other_kernels_are_refused():
    X = np.linspace(0, 1, 8)[:, None]
    gp = GPRegressor(kernel="matern52", n_restarts=0, max_iter=50, random_state=0).fit(X, X[:, 0])
    with pytest.raises(ValueError, match='kernel = "matern52"'):
        GaussianMoments(gp)([[0.5]], [[[0.1]]])


def test_an_unfitted_gp_is_refused():
    with pytest.raises(NotFittedError):
        GaussianMoments(GPRegressor())
    with pytest.raises(NotFittedError):
        noise_variance(GPRegressor())


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        (np.zeros((2, 3)), np.zeros((2, 2, 2)), r"mean has shape \(2, 3\)"),
        (np.zeros((2, 2)), np.zeros((1, 2, 2)), r"covariance \(1, 2, 2\)"),
        (np.array([[0.0, np.nan]]), np.zeros((1, 2, 2)), "mean has NaN"),
        (np.zeros((1, 2)), np.full((1, 2, 2), np.inf), "covariance has NaN or infinite"),
        (np.zeros((1, 2)), [[[1.0, 2.0], [2.0, 1.0]]], "covariance 0 is not symmetric and posit"),
        (np.zeros((1, 2)), [[[1.0, 0.5], [0.0, 1.0]]], "covariance 0 is not symmetric and posit"),
    ],
    ids=["inputs", "rows", "nan", "infinite", "indefinite", "asymmetric"],
)
def test_bad_inputs_are_refused(plane, mean, covariance, message):
    with pytest.raises(ValueError, match=message):
        GaussianMoments(plane)(mean, covariance)
