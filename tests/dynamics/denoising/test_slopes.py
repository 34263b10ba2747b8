"""Slopes of learned steps: exact where they can be, and those of differences elsewhere."""

import numpy as np
import pytest
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from tests.dynamics.systems import A, linear
from trajlearn import BlockScaler, MLPEnsembleRegressor, OneStepRegressor
from trajlearn.dynamics._denoising import slopes as module
from trajlearn.dynamics._denoising.slopes import step_slopes
from trajlearn.regressors import polynomial

DS = linear(12, scale=2.0)


def network(**settings):
    return MLPEnsembleRegressor(hidden_layer_sizes=(20, 18), max_steps=60, **settings)


def fitted(learner, **settings):
    return OneStepRegressor(learner, random_state=0, **settings).fit(DS)


def rows_of(model):
    return model.relabeler_.fit_resample(DS)[0]


LEARNERS = {
    "cubic": polynomial(3),
    "with a constant": make_pipeline(PolynomialFeatures(2), Ridge(1e-3)),
    "scaled monomials": make_pipeline(PolynomialFeatures(2), StandardScaler(), LinearRegression()),
    "interactions": make_pipeline(PolynomialFeatures(3, interaction_only=True), Ridge()),
    # neither has slopes of its own: the coefficients of the second are those of centred columns
    "a step alone": make_pipeline(LinearRegression()),
    "partial least squares": make_pipeline(PolynomialFeatures(2), PLSRegression(2)),
    "silu": network(),
    "tanh ensemble": network(activation="tanh", n_members=3),
    "probabilistic": network(probabilistic=True, activation="relu"),
    "separate variance": network(probabilistic="separate"),
}


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("target", ["change", "state"])
def test_slopes_agree_with_differences(name, target, monkeypatch):
    model = fitted(LEARNERS[name], target=target)
    rows = rows_of(model)[:40]
    after, slopes = step_slopes(model)(rows)
    assert slopes.shape == (40, 2, 2)
    monkeypatch.setattr(module, "_slopes_of", lambda learner: None)
    same, about = step_slopes(model)(rows)
    np.testing.assert_allclose(after, same, atol=2e-6)
    off = np.abs(slopes - about)
    # a kink of relu within the difference is no slope
    assert np.quantile(off, 0.9) < 2e-3
    if not isinstance(LEARNERS[name], MLPEnsembleRegressor):
        assert off.max() < 1e-4


def test_slopes_of_a_linear_system_are_its_matrix():
    for learner in (LinearRegression(), polynomial(1), polynomial(2, alpha=0.0)):
        model = fitted(learner)
        _, slopes = step_slopes(model)(rows_of(model))
        np.testing.assert_allclose(slopes, np.broadcast_to(A, slopes.shape), atol=1e-7)


def test_a_scaler_that_is_not_linear_is_differentiated_too():
    def squares(states, params):
        return states**2

    model = fitted(polynomial(1), scaler=BlockScaler(features=squares))
    _, slopes = step_slopes(model)(rows_of(model))
    np.testing.assert_allclose(slopes, np.broadcast_to(A, slopes.shape), atol=1e-6)


def test_any_learner_has_slopes():
    model = fitted(KNeighborsRegressor(3))
    assert np.isfinite(step_slopes(model)(rows_of(model))[1]).all()


def test_a_row_has_the_same_bits_alone_and_among_others():
    model = fitted(network(n_members=2))
    rows, step = rows_of(model), step_slopes(model)
    after, slopes = step(rows)
    for i in (0, 17, len(rows) - 1):
        alone = step(rows[i : i + 1])
        np.testing.assert_array_equal(alone[0][0], after[i])
        np.testing.assert_array_equal(alone[1][0], slopes[i])
