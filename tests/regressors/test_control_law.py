"""The learner of control laws: exact where the law is bilinear and saturates."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.linear_model import LinearRegression

from tests.sklearn_checks import run_checks
from trajlearn.regressors._saturated import (
    Normal,
    forward_errors,
    forward_order,
    monomials,
    saturated_fit,
    terms_of,
)
from trajlearn.regressors.control_law import ControlLawRegressor

SKIPS = {"check_array_api_input": "needs SCIPY_ARRAY_API=1 before scipy is imported"}


def feedback(n=600, n_gains=2, *, limit=1.0, groups=30, seed=0):
    """Rows (s, theta) and clip(-theta s), theta the same within a group."""
    rng = np.random.default_rng(seed)
    label = np.arange(n) % groups
    theta = rng.uniform(0.5, 1.5, size=(groups, n_gains))[label]
    states = rng.normal(size=(n, n_gains))
    actions = np.clip(-(theta * states).sum(axis=1, keepdims=True), -limit, limit)
    return np.hstack([states, theta]), actions, label


def test_saturated_fit_recovers_the_law_behind_the_limits():
    rng = np.random.default_rng(0)
    Z = rng.normal(size=(300, 3))
    truth = np.array([2.0, -1.0, 0.5])
    y = np.clip(Z @ truth, -1, 0.5)
    assert (np.isin(y, [-1.0, 0.5])).mean() > 0.5
    assert_allclose(saturated_fit(Z, y, np.ones(300), (-1, 0.5), 1e-14), truth, atol=1e-8)
    # what plain least squares makes of the same rows
    assert np.abs(np.linalg.lstsq(Z, y, rcond=None)[0] - truth).max() > 0.3


def test_saturated_fit_is_the_least_of_its_objective():
    """Noise on the targets: no coefficients nearby are better, by the definition of the loss."""
    rng = np.random.default_rng(1)
    Z = rng.normal(size=(200, 2))
    y = np.clip(Z @ [1.0, -2.0] + 0.3 * rng.normal(size=200), -1, 1)

    def loss(w):
        miss = Z @ w - y
        beyond = ((y >= 1) & (Z @ w >= 1)) | ((y <= -1) & (Z @ w <= -1))
        return (np.where(beyond, 0, miss) ** 2).sum()

    best = saturated_fit(Z, y, np.ones(200), (-1, 1), 0.0)
    for step in 1e-3 * np.vstack([np.eye(2), -np.eye(2)]):
        assert loss(best + step) > loss(best)


def test_forward_order_takes_the_columns_that_matter():
    rng = np.random.default_rng(2)
    Z = rng.normal(size=(500, 8))
    y = 3 * Z[:, 5] - 2 * Z[:, 1] + 0.1 * Z[:, 6]
    assert forward_order(Normal.of(Z, y, np.ones(500)), 3) == [5, 1, 6]
    folds = [Normal.of(Z[k::4], y[k::4], np.ones(125)) for k in range(4)]
    errors = forward_errors(folds, 5, 1e-12)
    assert (np.diff(errors[:4]) < 0).all()
    assert errors[3] < 1e-12 * errors[0]
    # the same by an independent computation: drop a fold, fit, look at it
    held = 0.0
    for k in range(4):
        inside = np.arange(500) % 4 != k
        fitted = LinearRegression(fit_intercept=False).fit(Z[inside][:, [5, 1]], y[inside])
        held += ((fitted.predict(Z[~inside][:, [5, 1]]) - y[~inside]) ** 2).sum()
    assert_allclose(errors[2], held, rtol=1e-8)


def test_monomials_are_products_of_columns():
    X = np.random.default_rng(3).normal(size=(5, 3))
    terms = terms_of([0, 2], 2)
    assert terms == [(), (0,), (2,), (0, 0), (0, 2), (2, 2)]
    assert_allclose(monomials(X, terms)[:, 4], X[:, 0] * X[:, 2])


def test_linear_feedback_is_exact_from_few_gains():
    X, y, label = feedback(groups=3)  # p + 1 = 3
    model = ControlLawRegressor(random_state=0).fit(X, y, groups=label, gains=[2, 3])
    assert model.exact_.all()
    other, truth, _ = feedback(seed=9)
    assert_allclose(model.predict(other), np.clip(truth, y.min(), y.max()), atol=1e-6)


def test_terms_are_found_without_being_told_what_gains_are():
    X, y, label = feedback()
    model = ControlLawRegressor(random_state=0).fit(X, y, groups=label)
    assert not model.exact_.any()
    assert {(0, 2), (1, 3)} <= set(model.terms_[0])
    other, truth, _ = feedback(seed=9)
    assert_allclose(model.predict(other), truth, atol=1e-6)


@pytest.mark.parametrize(("degree", "least", "most"), [(1, 0.1, 1), (3, 0, 0.02)])
def test_degree(degree, least, most):
    rng = np.random.default_rng(4)
    X = rng.uniform(-1, 1, size=(400, 6))
    y = X[:, 0] * X[:, 1] * X[:, 2] + X[:, 0] + 0.2 * X[:, 1] * X[:, 2]
    model = ControlLawRegressor(degree=degree, tolerance=10, random_state=0).fit(X, y)
    assert least <= model.held_out_[0] <= most


def test_max_terms():
    X = np.random.default_rng(8).uniform(-1, 1, size=(400, 3))
    y = 2 * X[:, 0] * X[:, 1] + X[:, 1] * X[:, 2]
    short, full = (ControlLawRegressor(max_terms=k, tolerance=10).fit(X, y) for k in (1, 60))
    assert short.terms_[0] == [(0, 1)]
    assert full.held_out_[0] < 1e-6 < short.held_out_[0]


def test_network_is_taken_where_it_is_better_on_held_out_rows():
    rng = np.random.default_rng(5)
    X = rng.uniform(-1, 1, size=(500, 2))
    y = np.column_stack([np.sign(np.sin(9 * X[:, 0])) * np.cos(4 * X[:, 1]), X[:, 0] - X[:, 1]])
    settings = {"hidden_layer_sizes": (64, 64), "max_steps": 600, "random_state": 0}
    model = ControlLawRegressor(**settings).fit(X, y)
    assert model.by_network_.tolist() == [True, False]
    assert_allclose(model.predict(X)[:, 1], y[:, 1], atol=1e-8)
    patient = ControlLawRegressor(tolerance=10, **settings).fit(X, y)
    assert patient.network_ is None
    assert model.held_out_[0] < patient.held_out_[0]
    small = ControlLawRegressor(hidden_layer_sizes=(2,), max_steps=5, random_state=0).fit(X, y)
    assert small.held_out_[0] > model.held_out_[0]


def test_predictions_stay_in_the_range_of_the_targets():
    X, y, label = feedback(limit=0.4)
    model = ControlLawRegressor(random_state=0).fit(X, y, groups=label, gains=[2, 3])
    assert np.abs(model.predict(100 * X)).max() == pytest.approx(0.4)


def test_same_seed_same_bits_and_rows_alone():
    rng = np.random.default_rng(6)
    X = rng.normal(size=(200, 3))
    y = np.sin(3 * X[:, 0])
    first, second = (
        ControlLawRegressor(max_steps=50, random_state=1).fit(X, y).predict(X) for _ in range(2)
    )
    assert (first == second).all()
    law = ControlLawRegressor(tolerance=10).fit(X, y)
    assert (law.predict(X[:1]) == law.predict(X)[:1]).all()


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        ({"gains": [4]}, "gains = \\[4\\]: X has the columns 0 to 3"),
        ({"gains": [-1]}, "X has the columns 0 to 3"),
        ({"gains": [0.5]}, "must be a list of columns"),
        ({"gains": [[1]]}, "must be a list of columns"),
        ({"groups": [1, 2]}, "one label a row \\(20\\)"),
    ],
)
def test_what_does_not_fit_the_rows_is_refused(fit, message):
    X, y, _ = feedback(n=20)
    with pytest.raises(ValueError, match=message):
        ControlLawRegressor().fit(X, y, **fit)


def test_a_gain_is_one_however_often_it_is_named():
    X, y, label = feedback()
    once, twice, none = (
        ControlLawRegressor(tolerance=10).fit(X, y, groups=label, gains=gains)
        for gains in ([2, 3], [3, 2, 3], [])
    )
    assert once.terms_ == twice.terms_
    assert once.exact_.all()
    assert not none.exact_.any()


def test_weights_that_are_all_zero():
    X, y, _ = feedback(n=20)
    with pytest.raises(ValueError, match="at least one non-zero"):
        ControlLawRegressor().fit(X, y, sample_weight=np.zeros(20))


@pytest.mark.filterwarnings("ignore")
def test_sklearn_checks_pass():
    # networks as many as by default, and shorter
    results = run_checks(ControlLawRegressor(max_steps=20), allowed_skips=SKIPS)
    assert sum(result["status"] == "passed" for result in results) >= 45
