"""Members of ensembles as models of their own."""

import numpy as np
import pytest
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from tests.dynamics.systems import SMALL, linear
from trajlearn import (
    CalibratedForecaster,
    DirectRewardNN,
    DistilledForecaster,
    LSTMRegressor,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryRegressor,
)
from trajlearn.dynamics._members import member_of, n_members, unwrapped

KINDS = {"none": False, "joint": True, "separate": "separate"}


def trajectory(probabilistic="separate"):
    return TrajectoryRegressor(
        MLPEnsembleRegressor(
            hidden_layer_sizes=(8,), max_steps=20, n_members=3, probabilistic=probabilistic
        ),
        random_state=0,
    )


@pytest.fixture(scope="module")
def ds():
    return linear(6)


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_members_make_up_the_ensemble(ds, kind):
    model = trajectory(KINDS[kind]).fit(ds)
    whole = model.predict(ds, return_std=True)
    parts = [member_of(model, i).predict(ds, return_std=True) for i in range(3)]
    means = np.array([part.mean for part in parts])
    variances = np.array([part.std for part in parts]) ** 2
    np.testing.assert_allclose(means.mean(axis=0), whole.mean)
    total = variances.mean(axis=0) + means.var(axis=0)
    np.testing.assert_allclose(np.sqrt(total), whole.std)
    assert not np.allclose(parts[0].mean, parts[1].mean, equal_nan=True)
    # the model is as it was
    assert n_members(model) == 3
    assert n_members(member_of(model, 1)) == 1
    np.testing.assert_array_equal(model.predict(ds, return_std=True).mean, whole.mean)


def test_a_member_samples_and_plans(ds):
    model = trajectory().fit(ds)
    one = member_of(model, 2)
    paths = one.predict(ds, n_samples=4, random_state=0).samples
    assert paths.shape[0] == 4
    plan = one.predict_trajectory([1.0, 0.0], params=[0.1, 0.1], horizons=[1.0, 2.0])
    again = member_of(one, 0).predict_trajectory([1.0, 0.0], params=[0.1, 0.1], horizons=[1.0, 2.0])
    np.testing.assert_array_equal(plan.mean, again.mean)


def test_a_rolled_out_member_is_one_member_all_along(ds):
    learner = MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=20, n_members=2)
    model = OneStepRegressor(learner, random_state=0).fit(ds)
    rows, _ = model.relabeler_.fit_resample(ds)
    means = model._moments()(rows)[0]
    for i in range(2):
        np.testing.assert_allclose(member_of(model, i).predict(rows), means[i])


def test_a_direct_reward_model_has_members(ds):
    model = DirectRewardNN(reward=lambda s: s[..., 0], horizon=5, random_state=0)
    model.set_params(estimator__max_steps=20).fit(ds)
    means = np.array([member_of(model, i).predict(ds) for i in range(5)])
    np.testing.assert_allclose(means.mean(axis=0), model.predict(ds))
    assert np.ptp(means, axis=0).min() > 0


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.HorizonWarning")
def test_wrappers_are_looked_through(ds):
    inner = trajectory().fit(ds)
    expected = member_of(inner, 1).predict(ds).mean
    wrapped = {
        "pipeline": make_pipeline(FunctionTransformer(), inner),
        "frozen": FrozenEstimator(inner),
        "calibrated": CalibratedForecaster(FrozenEstimator(inner)).fit(linear(12, seed=1)),
    }
    for model in wrapped.values():
        assert unwrapped(model) is inner
        assert n_members(model) == 3
        np.testing.assert_array_equal(member_of(model, 1).predict(ds).mean, expected)
    assert wrapped["pipeline"][-1] is inner
    distilled = DistilledForecaster()
    distilled.student_ = inner
    np.testing.assert_array_equal(member_of(distilled, 1).predict(ds).mean, expected)
    search = GridSearchCV(trajectory(), {"gate": [0.1]}, cv=2).fit(ds)
    assert unwrapped(search) is search.best_estimator_
    found = member_of(search, 0).predict(ds).mean
    np.testing.assert_array_equal(found, member_of(search.best_estimator_, 0).predict(ds).mean)


def test_a_model_without_an_ensemble_is_its_own_member(ds):
    for model in (
        TrajectoryRegressor(LinearRegression(), random_state=0),
        LSTMRegressor(hidden_size=4, max_steps=2, random_state=0),
    ):
        model.fit(ds)
        assert n_members(model) == 1
        np.testing.assert_array_equal(member_of(model, 0).predict(ds).mean, model.predict(ds).mean)
        for i in (1, -1):
            with pytest.raises(ValueError, match=f"there is no member {i}: the model has 1"):
                member_of(model, i)


def test_small_settings_are_those_of_a_member(ds):
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL, estimator__n_members=2).fit(ds)
    one = member_of(model, 1)
    assert one.estimator_.n_members == 1
    assert model.estimator_.n_members == 2
    np.testing.assert_array_equal(
        one.estimator_.predict_members(np.zeros((1, one.estimator_.n_features_in_)))[0],
        model.estimator_.predict_members(np.zeros((1, one.estimator_.n_features_in_)))[1],
    )
