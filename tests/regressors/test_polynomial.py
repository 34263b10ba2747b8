"""Polynomial least squares: exact on polynomials, under every formulation, fast to roll out."""

import time

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from trajlearn import (
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    load,
)
from trajlearn.dynamics._learner import moments_of
from trajlearn.regressors import polynomial
from trajlearn.regressors._polynomial import polynomial_predictor


def cubic(X):
    a, b = X.T
    return np.stack([1 + a - 2 * a * b + b**3, a**2 * b - b], axis=1)


def rows(n=400, seed=0):
    X = np.random.default_rng(seed).normal(size=(n, 2))
    return X, cubic(X)


def oscillator(n=6, length=40, seed=0):
    """Duffing's oscillator with a force, by Euler's rule: of degree 3 in state and action."""
    rng = np.random.default_rng(seed)
    states, actions = np.empty((n, length + 1, 2)), rng.normal(size=(n, length, 1))
    states[:, 0] = rng.uniform(-1, 1, size=(n, 2))
    for t in range(length):
        x, v = states[:, t].T
        force = x - x**3 - 0.2 * v + actions[:, t, 0]
        states[:, t + 1] = np.stack([x + 0.05 * v, v + 0.05 * force], axis=1)
    return TrajectoryDataset.from_arrays(
        states, actions=actions, params=rng.uniform(size=(n, 1)), dt=0.05
    )


@pytest.mark.parametrize("alpha", [0.0, 1e-6])
def test_polynomials_up_to_the_degree_are_exact_and_others_are_not(alpha):
    X, y = rows()
    test, truth = rows(50, seed=1)
    exact = polynomial(3, alpha=alpha).fit(X, y)
    np.testing.assert_allclose(exact.predict(test), truth, atol=1e-6)
    assert np.abs(polynomial(2, alpha=alpha).fit(X, y).predict(test) - truth).max() > 0.1


def test_the_degree_is_three_and_nearly_unpenalised_unless_said_otherwise():
    features, linear = (step for _, step in polynomial().steps)
    assert (features.degree, linear.alpha) == (3, 1e-6)
    assert isinstance(polynomial(alpha=0)[-1], LinearRegression)


def test_a_penalty_shrinks_coefficients():
    X, y = rows(30)
    sizes = [np.linalg.norm(polynomial(3, alpha=a).fit(X, y)[-1].coef_) for a in (0, 1, 100)]
    assert sizes[0] > 1.02 * sizes[1] > 1.5 * sizes[2]


@pytest.mark.parametrize("alpha", [0.0, 1e-6])
def test_monomials_that_are_sums_of_others_do_no_harm(alpha):
    angle = np.random.default_rng(0).uniform(-np.pi, np.pi, 2000)
    X = np.stack([np.cos(angle), np.sin(angle), np.cos(angle)], axis=1)  # cos^2 + sin^2 = 1
    model = polynomial(3, alpha=alpha).fit(X, np.sin(2 * angle))
    assert np.abs(model[-1].coef_).max() < 10
    np.testing.assert_allclose(model.predict(X), np.sin(2 * angle), atol=1e-6)


@pytest.mark.parametrize("degree", [0, -1, 2.5, True, "3", None, [1], np.nan, np.inf])
def test_a_degree_that_is_none_is_refused(degree):
    with pytest.raises(ValueError, match=r"degree = .* must be a whole number"):
        polynomial(degree)


@pytest.mark.parametrize("alpha", [-1e-3, np.inf, np.nan, None, "1"])
def test_a_penalty_that_is_none_is_refused(alpha):
    with pytest.raises(ValueError, match=r"alpha = .* must be finite and not negative"):
        polynomial(alpha=alpha)


# -- the fast predictor -------------------------------------------------------------------


@pytest.mark.parametrize(
    "features",
    [
        PolynomialFeatures(1, include_bias=False),
        PolynomialFeatures(3),
        PolynomialFeatures(4, include_bias=False),
        PolynomialFeatures(3, interaction_only=True),
    ],
)
@pytest.mark.parametrize("linear", [Ridge(1e-3), LinearRegression(), Ridge(fit_intercept=False)])
@pytest.mark.parametrize("n_targets", [1, 2])
def test_the_fast_predictor_agrees_with_the_pipeline(features, linear, n_targets):
    X = np.random.default_rng(1).normal(size=(60, 4))
    y = cubic(X[:, :2])[:, :n_targets]
    model = make_pipeline(features, linear).fit(X, y[:, 0] if n_targets == 1 else y)
    fast = polynomial_predictor(model)
    assert fast is not None
    np.testing.assert_allclose(fast(X), model.predict(X).reshape(60, -1), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "learner",
    [
        make_pipeline(StandardScaler(), PolynomialFeatures(2), Ridge()),
        make_pipeline(StandardScaler(), Ridge()),
        make_pipeline(PolynomialFeatures((2, 3)), Ridge()),
        Ridge(),
    ],
)
def test_what_it_cannot_evaluate_predicts_by_itself(learner):
    X, y = rows(80)
    assert polynomial_predictor(learner.fit(X, y)) is None
    np.testing.assert_array_equal(moments_of(learner)(X)[0][0], learner.predict(X))


# -- under the formulations ---------------------------------------------------------------


def test_one_step_models_roll_a_polynomial_plant_out_exactly():
    ds, test = oscillator(), oscillator(3, seed=1)
    truth = np.stack([episode.states[1:] for episode in test])
    model = OneStepRegressor(polynomial(3)).fit(ds)
    np.testing.assert_allclose(model.predict(test).mean, truth, atol=1e-5)
    assert np.abs(OneStepRegressor(polynomial(2)).fit(ds).predict(test).mean - truth).max() > 1e-2


@pytest.mark.parametrize(
    "model",
    [
        OneStepRegressor(polynomial(2)),
        OneStepRegressor(polynomial(2), inputs="params", target="state"),
        OneStepRegressor(polynomial(2), propagation="moment"),
        TrajectoryRegressor(polynomial(2), relabeler=SubtrajectoryRelabeler(max_rows=500)),
    ],
    ids=["one-step", "closed-loop", "moment", "trajectory"],
)
def test_every_formulation_takes_it_and_stores_it(model, tmp_path):
    ds = oscillator()
    model = clone(model).set_params(random_state=0).fit(ds)
    forecast = np.asarray(model.predict(ds))
    assert np.isfinite(forecast).all()
    again = np.asarray(clone(model).fit(ds).predict(ds))
    np.testing.assert_array_equal(again, forecast)
    model.save(tmp_path / "model.safetensors")
    loaded = load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(np.asarray(loaded.predict(ds)), forecast)


def test_its_parameters_can_be_set_from_outside():
    model = OneStepRegressor(polynomial(1)).set_params(
        estimator__features__degree=3, estimator__linear__alpha=1e-3
    )
    model.fit(oscillator())
    assert model.estimator_["features"].degree == 3
    assert model.estimator_["linear"].alpha == 1e-3


def test_rolling_out_is_fast():
    ds = oscillator(100, 200)
    model = OneStepRegressor(polynomial(3)).fit(ds)
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        model.predict(ds)
        seconds.append(time.perf_counter() - began)
    # by scikit-learn's own predict it takes four times as long
    assert min(seconds) < 0.15
