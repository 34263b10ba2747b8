"""scikit-learn's model selection, an episode as the sample, nested names of the defaults."""

import warnings

import numpy as np
import pytest
import sklearn
from sklearn.base import clone
from sklearn.experimental import enable_halving_search_cv  # noqa: F401
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    HalvingGridSearchCV,
    KFold,
    RandomizedSearchCV,
    cross_val_predict,
    cross_validate,
    learning_curve,
    train_test_split,
    validation_curve,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tests.dynamics.systems import SMALL, gain_policy, linear, truth
from trajlearn import (
    DirectRewardGP,
    DirectRewardNN,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryRegressor,
)
from trajlearn.exceptions import HorizonWarning

PUBLIC = (TrajectoryRegressor, OneStepRegressor, DirectRewardGP, DirectRewardNN)


@pytest.fixture(scope="module")
def ds():
    return linear(16, group=[i % 4 for i in range(16)])


def t(**settings):
    return TrajectoryRegressor(random_state=0).set_params(**SMALL | settings)


@pytest.fixture(autouse=True)
def _shorter_training_folds():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HorizonWarning)
        yield


def test_groups_stay_together(ds):
    scores = cross_validate(
        OneStepRegressor(LinearRegression()),
        ds,
        groups=ds.group,
        cv=GroupKFold(4),
        return_indices=True,
    )
    for learn, held_out in zip(scores["indices"]["train"], scores["indices"]["test"]):
        assert not set(ds.group[learn]) & set(ds.group[held_out])


def test_grid_search_prefers_what_is_better(ds):
    model = OneStepRegressor(Ridge())
    search = GridSearchCV(model, {"estimator__alpha": [1e-6, 1e6]}, cv=2).fit(ds)
    assert search.best_params_ == {"estimator__alpha": 1e-6}
    assert search.best_score_ > -1e-6
    assert search.predict(ds).mean.shape == truth(ds).shape


@pytest.mark.parametrize(
    ("model", "grid"),
    [
        (TrajectoryRegressor(), {"estimator__max_steps": [5, 6], "relabeler__starts": ["first"]}),
        (TrajectoryRegressor(), {"estimator__max_steps": [5], "scaler__horizon__n_scales": [1, 2]}),
        (OneStepRegressor(), {"estimator__max_steps": [5, 6], "inputs": ["params", "action"]}),
        (DirectRewardNN(), {"estimator__max_steps": [5, 6], "reward": [np.sum], "horizon": [3]}),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, dict) else type(value).__name__,
)
def test_grid_search_reaches_the_defaults(ds, model, grid):
    if "reward" in grid:
        grid = grid | {"reward": [first_state]}
    search = GridSearchCV(model, grid, cv=2, error_score="raise").fit(ds)
    for name, value in search.best_params_.items():
        assert search.best_estimator_.get_params()[name] == value
    assert search.best_estimator_.estimator_.n_steps_ in (5, 6)
    assert model.estimator is None  # the search works on clones


def first_state(states):
    return states[..., 0]


@pytest.mark.parametrize(
    "model",
    [TrajectoryRegressor(MLPEnsembleRegressor(hidden_layer_sizes=(16,))), TrajectoryRegressor()],
    ids=["given", "default"],
)
def test_halving_spends_gradient_steps(ds, model):
    search = HalvingGridSearchCV(
        model,
        {"gate": [0.02, 0.2]},
        resource="estimator__max_steps",
        min_resources=5,
        max_resources=10,
        factor=2,
        cv=2,
        random_state=0,
        error_score="raise",
    ).fit(ds)
    assert search.n_resources_ == [5, 10]
    assert search.best_estimator_.estimator_.n_steps_ == 10


def test_halving_spends_episodes(ds):
    search = HalvingGridSearchCV(
        OneStepRegressor(Ridge()), {"estimator__alpha": [1e-6, 1e6]}, min_resources=8, cv=2
    ).fit(ds)
    assert search.best_params_["estimator__alpha"] == 1e-6


def test_random_search_learning_and_validation_curves(ds):
    model = OneStepRegressor(Ridge())
    search = RandomizedSearchCV(
        model, {"estimator__alpha": [1e-6, 1e6]}, n_iter=2, cv=2, random_state=0
    )
    assert search.fit(ds).best_params_["estimator__alpha"] == 1e-6
    sizes, _, scores = learning_curve(model, ds, None, cv=2, train_sizes=[3, 8])
    assert sizes.tolist() == [3, 8]
    assert scores.shape == (2, 2)
    _, scores = validation_curve(
        model, ds, None, param_name="estimator__alpha", param_range=[1e-6, 1e6], cv=2
    )
    assert (scores[0] > scores[1]).all()


def test_out_of_fold_forecasts_are_in_order_and_of_others(ds):
    cv = KFold(4, shuffle=True, random_state=0)
    found = cross_val_predict(OneStepRegressor(LinearRegression()), ds, cv=cv)
    np.testing.assert_allclose(found.mean, truth(ds), atol=1e-9)
    assert found.lengths.tolist() == ds.lengths.tolist()


def test_train_test_split_takes_episodes(ds):
    learn, held_out = train_test_split(ds, test_size=0.25, random_state=0)
    assert (len(learn), len(held_out)) == (12, 4)
    assert OneStepRegressor(LinearRegression()).fit(learn).score(held_out) > -1e-20


def test_keywords_of_predict_pass_through_metadata_routing(ds):
    model = OneStepRegressor(LinearRegression())
    with sklearn.config_context(enable_metadata_routing=True):
        routed = clone(model).set_predict_request(horizon=True, policy=True)
        pipe = make_pipeline(Same(), routed).fit(ds)
        forecast = pipe.predict(ds, horizon=3, policy=gain_policy)
        assert forecast.mean.shape[1] == 3
        assert forecast.actions == "policy"
        weighted = (
            clone(model).set_fit_request(sample_weight=True).set_score_request(sample_weight=True)
        )
        scores = cross_validate(
            weighted, ds, params={"sample_weight": np.arange(16) % 2 + 1.0}, cv=2
        )
        assert (scores["test_score"] > -1e-20).all()


class Same(sklearn.base.BaseEstimator):
    def fit(self, X, y=None):
        self.n_features_in_ = X.states.shape[1]
        return self

    def transform(self, X):
        return X

    def set_output(self, *, transform=None):
        return self


def test_a_row_scaler_before_episodes_raises(ds):
    with pytest.raises(TypeError, match="scale by block themselves"):
        make_pipeline(StandardScaler(), t()).fit(ds)


def test_scorers_are_callables(ds):
    def within_two_steps(estimator, X, y=None):
        return -np.nanmean(estimator.predict(X, horizon=2).squared_errors(X))

    scores = cross_validate(t(), ds, cv=2, scoring={"two": within_two_steps})
    assert (scores["test_two"] < 0).all()


def test_score_weights_episodes(ds):
    model = t().fit(ds)
    alone = np.array([model.score(ds[[i]]) for i in range(4)])
    weight = np.array([1.0, 0.0, 3.0, 1.0])
    assert np.isclose(model.score(ds[:4], sample_weight=weight), alone @ weight / weight.sum())


@pytest.mark.parametrize("Model", PUBLIC)
def test_parameters_of_the_defaults_can_be_read_and_set(Model):
    model = Model()
    names = model.get_params()
    assert {"estimator", "relabeler", "scaler"} <= set(names)
    assert names["estimator"] is None
    assert names["relabeler__random_state"] is None
    assert model.get_params(deep=False).keys() < names.keys()
    model.set_params(relabeler__random_state=3)
    assert model.relabeler.random_state == 3
    assert model.estimator is None
    with pytest.raises(ValueError, match="Invalid parameter 'nonsense'"):
        model.set_params(estimator__nonsense=1)
    with pytest.raises(ValueError, match="Invalid parameter"):
        model.set_params(nonsense__deep=1)
    assert repr(clone(model)) == repr(model)
    assert model._repr_html_()


@pytest.mark.parametrize("Model", PUBLIC)
@pytest.mark.parametrize(
    "wrong",
    [
        {"estimator": 3},
        {"relabeler": "early"},
        {"scaler": 1.0},
        {"random_state": "zero"},
    ],
    ids=str,
)
def test_parameters_of_the_wrong_kind_are_refused(Model, wrong, ds):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"'{name}' parameter"):
        Model(**wrong).fit(ds)


@pytest.mark.parametrize(
    ("model", "name"),
    [
        (TrajectoryRegressor(gate=-1.0), "gate"),
        (TrajectoryRegressor(baseline="median"), "baseline"),
        (TrajectoryRegressor(error_score=2.0), "error_score"),
        (TrajectoryRegressor(fresh_batches="yes"), "fresh_batches"),
        (OneStepRegressor(target="next"), "target"),
        (OneStepRegressor(policy=3), "policy"),
        (OneStepRegressor(rollout_actions="both"), "rollout_actions"),
        (OneStepRegressor(clip_states=0.0), "clip_states"),
        (OneStepRegressor(propagation="ts2"), "propagation"),
        (OneStepRegressor(n_particles=1), "n_particles"),
        (OneStepRegressor(inputs="everything"), "inputs"),
        (DirectRewardGP(reward="squared"), "reward"),
        (DirectRewardNN(horizon=0), "horizon"),
        (DirectRewardNN(terminal_reward="low"), "terminal_reward"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_values_out_of_bounds_are_refused(model, name, ds):
    with pytest.raises(ValueError, match=f"'{name}' parameter"):
        model.fit(ds)


class Dear(LinearRegression):
    """A learner whose standard deviation nobody may ask for in vain."""

    def predict(self, X, return_std=False):
        if return_std:
            raise AssertionError("asked for a standard deviation that is not needed")
        return super().predict(X)


def test_a_mean_roll_out_asks_for_no_standard_deviation(ds):
    model = OneStepRegressor(Dear(), random_state=0).fit(ds)
    assert np.isfinite(model.predict(ds, horizon=3).mean).all()


def test_rows_without_return_std_ask_for_no_standard_deviation(ds):
    first = ds.offsets[:-1]
    rows = np.hstack([ds.states[first], np.ones((len(ds), 1))])  # one step ahead
    model = TrajectoryRegressor(Dear(), random_state=0).fit(rows, ds.states[first + 1])
    assert np.isfinite(model.predict(rows)).all()
