"""Features of the controller under the formulations: seen by the learner, the same everywhere."""

import pickle
import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

from tests.dynamics.systems import SMALL, closed_loop, linear, truth
from trajlearn import (
    BlockScaler,
    DirectRewardNN,
    EpisodeRelabeler,
    HorizonFeatures,
    LSTMRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.exceptions import HorizonWarning
from trajlearn.testing import check_dynamics_estimator


def action(states, params):
    """What the controller of `linear` does, less its noise."""
    return -(states * params).sum(axis=1, keepdims=True)


def product(states, params):
    return states * params


def norm(states, params):
    return np.sqrt((states**2).sum(axis=1, keepdims=True))


def t(**settings):
    return TrajectoryRegressor(random_state=0).set_params(**SMALL | settings)


def test_a_linear_learner_is_exact_once_it_sees_what_is_not_linear():
    # s' = s + theta (0.3 - 0.2 s) - 0.1 s is linear in s, theta and their product
    ds, test = closed_loop(20), closed_loop(6, seed=1)
    model = OneStepRegressor(LinearRegression(), inputs="params")
    blind = np.abs(np.asarray(model.fit(ds).predict(test)) - truth(test)).max()
    model.set_params(scaler__features=product).fit(ds)
    np.testing.assert_allclose(np.asarray(model.predict(test)), truth(test), atol=1e-10)
    assert blind > 1e-3


@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("features", [action, product], ids=["action", "product"])
def test_the_split_first_layer_gives_what_rows_give(fresh, features):
    model = t(scaler__features=features, fresh_batches=fresh, estimator__n_members=2)
    model.fit(linear(12))
    # of one length (one product for all) and ragged
    for test in (linear(4, seed=1, shortest=6, longest=6), linear(4, seed=1, longest=9)):
        forecast = model.predict(test)
        for i, episode in enumerate(test):
            steps = np.arange(1, episode.length + 1)
            rows = [[*episode.states[0], h, *episode.params] for h in steps]
            np.testing.assert_allclose(
                forecast.mean[i, : len(steps)], model.predict(rows), atol=1e-6
            )


@pytest.mark.parametrize(
    "model",
    [
        t(scaler__features=action),
        OneStepRegressor(random_state=0, inputs=("action", "params")).set_params(
            **SMALL | {"scaler__features": action}
        ),
        OneStepRegressor(random_state=0).set_params(**SMALL | {"scaler__features": norm}),
        LSTMRegressor(max_steps=5, inputs=("action", "params"), random_state=0).set_params(
            scaler__features=action
        ),
    ],
    ids=["T", "one-step, params", "one-step, no params", "LSTM"],
)
def test_an_episode_is_forecast_with_the_same_bits_alone_and_in_a_batch(model):
    ds, test = linear(10), linear(7, seed=1, longest=9)
    model = clone(model).fit(ds)
    batch = model.predict(test)
    for i, steps in enumerate(test.lengths):
        np.testing.assert_array_equal(model.predict(test[[i]]).mean[0], batch.mean[i, :steps])
    plain = clone(model).set_params(scaler__features=None).fit(ds).predict(test)
    assert not np.array_equal(plain.mean, batch.mean, equal_nan=True)


def test_features_see_the_start_alone():
    seen = []

    def watched(states, params):
        seen.append(states)
        return action(states, params)

    model = t(scaler__features=watched).fit(linear(8))
    seen.clear()
    test = linear(3, seed=1)
    model.predict(test, start=2)
    starts = {tuple(episode.states[2]) for episode in test}
    assert {tuple(row) for states in seen for row in states} == starts


def test_without_params_and_with_context():
    shapes = set()

    def watched(states, params):
        shapes.add((states.shape[1], params.shape[1]))
        return norm(states, params)

    ds = linear(8, params=False, context={"task": ["a", "b"] * 4})
    assert np.isfinite(t(scaler__features=watched).fit(ds).score(ds))
    assert shapes == {(2, 0)}


def test_rows_are_fitted_with_features():
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, size=(400, 3))  # state, horizon, theta
    y = rows[:, 1] * rows[:, 0] * rows[:, 2]
    rest = {"relabeler": SubtrajectoryRelabeler(), "gate": None}
    model = TrajectoryRegressor(LinearRegression(), **rest).set_params(scaler__features=product)
    seen = model.fit(rows, y).scaler_.block_columns_["features"]
    np.testing.assert_allclose(model.scaler_.transform(rows)[:, seen].std(axis=0), 1.0)
    # s' = s theta is linear in the feature, alone and through the one-step model
    y = rows[:, 0] * rows[:, 2]
    np.testing.assert_allclose(model.fit(rows, y).predict(rows), y, atol=1e-10)
    one_step = OneStepRegressor(LinearRegression(), inputs="params")
    one_step.set_params(scaler__features=product).fit(rows[:, [0, 2]], y)
    np.testing.assert_allclose(one_step.predict(rows[:, [0, 2]]), y, atol=1e-10)


def test_direct_reward_models_see_them():
    ds = linear(12, shortest=5, longest=5)
    rewards = DirectRewardNN(reward=lambda states: -np.abs(states[..., 0]), random_state=0)
    plain = rewards.set_params(**SMALL).fit(ds).predict(ds)
    assert not np.array_equal(
        rewards.set_params(scaler__features=action).fit(ds).predict(ds), plain
    )


def test_weights_of_episodes_reach_the_features():
    ds = linear(8)
    weight = np.where(np.arange(8) < 4, 1.0, 50.0)
    values = {}
    for name, w in (("equal", None), ("weighted", weight), ("last", (weight > 1) * 1.0)):
        fitted = t(scaler__features=action).fit(ds, sample_weight=w)
        values[name] = fitted.scaler_.parts_[-1][1].var_[0]
    assert np.isclose(values["weighted"], values["last"], rtol=0.2)
    assert not np.isclose(values["weighted"], values["equal"], rtol=0.2)


def test_clone_pickle_and_nested_names():
    ds = linear(8)
    model = t(scaler__features=action)
    assert model.get_params()["scaler__features"] is action
    assert isinstance(model.scaler.horizon, HorizonFeatures)
    assert clone(model).scaler.features is action
    fitted = model.fit(ds)
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(ds).mean, fitted.predict(ds).mean)
    same = TrajectoryRegressor(
        scaler=BlockScaler(horizon=HorizonFeatures(), features=action), random_state=0
    ).set_params(**SMALL)
    np.testing.assert_array_equal(same.fit(ds).predict(ds).mean, fitted.predict(ds).mean)


def test_rows_without_what_features_need_are_refused():
    def error(states, params):
        return params[:, 1:] - states[:, 1:]  # no column at all where there are no params

    ds = linear(8, shortest=5, longest=5)
    with pytest.raises(ValueError, match=r"error returned .*params of shape \(40, 0\) \(inputs="):
        OneStepRegressor(LinearRegression(), scaler=BlockScaler(features=error)).fit(ds)
    relabeler = EpisodeRelabeler(reward=lambda states: states[..., 0], inputs=("params",))
    with pytest.raises(ValueError, match=r"features=error .*no block 'state'.*inputs="):
        DirectRewardNN(relabeler=relabeler, scaler=BlockScaler(features=error)).fit(ds)


def test_the_contract_of_dynamics_estimators_holds():
    check_dynamics_estimator(t(scaler__features=norm))


def test_features_that_fail_at_prediction_are_named():
    def root(states, params):
        with np.errstate(invalid="ignore"):
            return np.sqrt(1 - (states[:, :1] / 3) ** 2)

    model = t(scaler__features=root).fit(linear(8, scale=0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HorizonWarning)
        with pytest.raises(ValueError, match="features=root returned NaN"):
            model.predict(linear(8, scale=30.0))


def reciprocal(states, params):
    return 1 / states[:, :1]


@pytest.mark.parametrize(
    "model",
    [
        OneStepRegressor(inputs="params", random_state=0).set_params(**SMALL),
        LSTMRegressor(inputs="params", max_steps=3, random_state=0),
    ],
    ids=["one step", "recurrent"],
)
def test_features_are_asked_for_at_states_of_episodes_only(model):
    """A feature that is singular at zero, where no episode is: nor may a made-up row be."""
    ds = closed_loop(8)
    moved = ds.states + 5 - ds.states.min()
    ds = TrajectoryDataset.from_arrays(
        np.split(moved, ds.offsets[1:-1]), params=[episode.params for episode in ds]
    )
    model.set_params(scaler__features=reciprocal).fit(ds)
    starts = np.arange(len(ds)) % 3
    forecast = model.predict(ds, start=starts, horizon=2, return_std=True)
    assert np.isfinite(forecast.std).all()
