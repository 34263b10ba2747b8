"""Trajectory models in torch: the same means as the model, and their derivative in theta."""

import numpy as np
import pytest
import torch
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import (
    FunctionTransformer,
    QuantileTransformer,
    RobustScaler,
    StandardScaler,
)

from tests.dynamics.systems import SMALL, linear
from trajlearn import (
    BlockScaler,
    CalibratedForecaster,
    DirectRewardNN,
    HorizonFeatures,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.dynamics._differentiable import differentiable

THETA = np.array([[0.1, 0.3], [0.35, 0.05], [0.2, 0.2]])
STATES = np.array([[1.0, -0.5], [0.3, 0.8], [-1.0, 0.2]])
HORIZONS = np.array([0.5, 1.0, 4.0, 9.0])


def trained(ds=None, **settings):
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL | settings)
    return model.fit(linear() if ds is None else ds)


@pytest.fixture(scope="module")
def model():
    return trained(estimator__n_members=3)


VARIANTS = {
    "as in the paper": {"baseline": None, "estimator__probabilistic": True},
    "no gate": {"gate": None, "estimator__probabilistic": False},
    "relu": {"estimator__activation": "relu"},
    "tanh, three layers": {
        "estimator__activation": "tanh",
        "estimator__hidden_layer_sizes": (8, 9, 7),
    },
    "param bounds": {"scaler__param_bounds": [[-1.0, 1.0], [0.0, 2.0]]},
    "other scalers": {
        "scaler__params": RobustScaler(),
        "scaler__state": "passthrough",
        "scaler__horizon": "passthrough",
    },
    "rows drawn once": {"fresh_batches": False, "estimator__n_members": 2},
}


@pytest.mark.parametrize("name", VARIANTS)
def test_it_predicts_what_the_model_predicts(name):
    model = trained(**VARIANTS[name])
    means = differentiable(model, dtype=torch.float64)(STATES, THETA, HORIZONS)
    expected = model.predict_trajectory(STATES, params=THETA, horizons=HORIZONS).mean
    assert means.shape == (model.estimator_.n_members, 3, 4, 2)
    np.testing.assert_allclose(means.mean(0).numpy(), expected, rtol=0, atol=3e-6)
    single = differentiable(model)(STATES, THETA, HORIZONS).mean(0)
    assert single.dtype == torch.float64
    np.testing.assert_allclose(single.numpy(), expected, rtol=0, atol=3e-6)


def test_members_differ_and_are_those_of_the_learner(model):
    rows = np.column_stack([STATES, np.full(3, 4.0), THETA])
    expected = model._moments(means_only=True)(rows)[0]
    means = differentiable(model)(STATES, THETA, [4.0])[:, :, 0].numpy()
    np.testing.assert_allclose(means, expected, rtol=0, atol=3e-6)
    assert np.ptp(means, axis=0).min() > 1e-4


def test_the_derivative_is_that_of_the_predictions(model):
    theta = torch.tensor(THETA, requires_grad=True)
    states = torch.tensor(STATES, requires_grad=True)
    weight = np.random.default_rng(0).normal(size=(3, 4, 2))
    means = differentiable(model, dtype=torch.float64)(states, theta, HORIZONS).mean(0)
    (means * torch.tensor(weight)).sum().backward()

    def total(initial, params):
        found = model.predict_trajectory(initial, params=params, horizons=HORIZONS)
        return (found.mean * weight).sum(axis=(1, 2))

    # rounding in single precision limits central differences, truncation the longer step
    step = 3e-2
    for j in range(2):
        up, down = (THETA + sign * step * np.eye(2)[j] for sign in (1, -1))
        slope = (total(STATES, up) - total(STATES, down)) / (2 * step)
        np.testing.assert_allclose(theta.grad[:, j].numpy(), slope, rtol=0, atol=2e-3)
        up, down = (STATES + sign * step * np.eye(2)[j] for sign in (1, -1))
        slope = (total(up, THETA) - total(down, THETA)) / (2 * step)
        np.testing.assert_allclose(states.grad[:, j].numpy(), slope, rtol=0, atol=2e-3)
    assert theta.grad.abs().min() > 0.02
    # and to double precision, those of the torch function itself
    function = differentiable(model, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda s, t: function(s, t, HORIZONS), (states, theta))


def test_single_precision_is_enough_for_the_derivative(model):
    slopes = []
    for dtype in (torch.float32, torch.float64):
        theta = torch.tensor(THETA, requires_grad=True)
        differentiable(model, dtype=dtype)(STATES, theta, HORIZONS).sum().backward()
        slopes.append(theta.grad.numpy())
    np.testing.assert_allclose(*slopes, rtol=1e-4)


def test_a_constant_parameter_is_scaled_as_in_training():
    ds = linear()
    fixed = np.concatenate([ds.params, np.full((len(ds), 1), 5.0)], axis=1)
    episodes = TrajectoryDataset.from_arrays([e.states for e in ds], params=fixed)
    model, theta = trained(episodes), np.column_stack([THETA, [5.0, 5.5, 4.5]])
    means = differentiable(model)(STATES, theta, HORIZONS).mean(0).numpy()
    expected = model.predict_trajectory(STATES, params=theta, horizons=HORIZONS).mean
    np.testing.assert_allclose(means, expected, rtol=0, atol=3e-6)


def test_the_context_is_that_given():
    ds = linear(context={"load": ["light", "heavy"] * 4})
    model = trained(ds)
    found = {}
    for load in ("light", "heavy"):
        given = {"load": load}
        expected = model.predict_trajectory(
            STATES, params=THETA, horizons=HORIZONS, context=given
        ).mean
        found[load] = differentiable(model, context=given)(STATES, THETA, HORIZONS).mean(0).numpy()
        np.testing.assert_allclose(found[load], expected, rtol=0, atol=3e-6)
    assert np.abs(found["light"] - found["heavy"]).max() > 1e-4
    with pytest.raises(ValueError, match="no context 'load'"):
        differentiable(model)


def test_models_of_rows_and_those_inside_others_have_the_same_means(model):
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(100, 5)), rng.normal(size=(100, 2))
    of_rows = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(X, y)
    calibrated = CalibratedForecaster(FrozenEstimator(model)).fit(linear(seed=1))
    tuned = GridSearchCV(model, {"gate": [0.05]}, cv=2).fit(linear())
    for fitted in (of_rows, calibrated, tuned):
        inner = getattr(fitted, "best_estimator_", fitted)
        expected = inner.predict_trajectory(STATES, params=THETA, horizons=[0.5, 1.0]).mean
        means = differentiable(fitted)(STATES, THETA, [0.5, 1.0]).mean(0).numpy()
        np.testing.assert_allclose(means, expected, rtol=0, atol=3e-6)


def gain(states, params):
    return (states * params).sum(axis=1, keepdims=True)


REFUSED = {
    "a one-step model": (lambda: OneStepRegressor(LinearRegression()), "OneStepRegressor is no"),
    "a pipeline": (
        lambda: make_pipeline(FunctionTransformer(), OneStepRegressor(LinearRegression())),
        "Pipeline is no",
    ),
    "a calibrated pipeline": (
        lambda: CalibratedForecaster(
            make_pipeline(FunctionTransformer(), TrajectoryRegressor(LinearRegression()))
        ),
        "Pipeline is no",
    ),
    "a direct reward model": (
        lambda: DirectRewardNN(reward=lambda states: states[..., 0], terminal_reward=0.0),
        "DirectRewardNN is no TrajectoryRegressor",
    ),
    "another learner": (lambda: TrajectoryRegressor(LinearRegression()), "LinearRegression"),
    "features": (
        lambda: TrajectoryRegressor(scaler=BlockScaler(horizon=HorizonFeatures(), features=gain)),
        "features=",
    ),
    "a baseline": (lambda: TrajectoryRegressor(baseline="mean"), "baseline='mean'"),
    "another scaler": (lambda: TrajectoryRegressor(scaler=StandardScaler()), "StandardScaler"),
    "a scaler that bends": (
        lambda: TrajectoryRegressor(scaler=BlockScaler(params=QuantileTransformer(n_quantiles=5))),
        "QuantileTransformer",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_derivative_says_so_and_what_to_do(name):
    make, said = REFUSED[name]
    model = make()
    settings = {key: value for key, value in SMALL.items() if key in model.get_params()}
    if not isinstance(getattr(model, "estimator", None), LinearRegression):
        model.set_params(**settings)
    model.fit(linear(shortest=9, longest=9))
    with pytest.raises(ValueError, match=said) as error:
        differentiable(model)
    assert "optimizer='cma'" in str(error.value)


@pytest.mark.parametrize("field", ["references", "time_origin"])
def test_known_signals_are_refused(field):
    ds = linear(4)
    value = [e.states for e in ds] if field == "references" else np.zeros(4)
    episodes = TrajectoryDataset.from_arrays(
        [e.states for e in ds], params=ds.params, **{field: value}
    )
    with pytest.raises(ValueError, match=r"references|phase"):
        differentiable(trained(episodes))


def test_a_model_without_params_is_refused():
    with pytest.raises(ValueError, match="without params"):
        differentiable(trained(linear(params=False)))


def test_wrong_shapes_are_named(model):
    function = differentiable(model)
    with pytest.raises(ValueError, match=r"params has shape \(3, 1\); expected \(n, 2\)"):
        function(STATES, THETA[:, :1], HORIZONS)
    with pytest.raises(ValueError, match="initial_states has 2 rows, params 3"):
        function(STATES[:2], THETA, HORIZONS)
