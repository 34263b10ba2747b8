"""Models of all folds, trained as one network: what they are when they are fitted one by one."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from tests.dynamics.systems import SMALL, gain_policy, linear
from trajlearn import (
    LSTMRegressor,
    MLPEnsembleRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._selection import joint_folds
from trajlearn.dynamics._selection.joint_folds import FoldFits
from trajlearn.regressors import _trained, polynomial

FOLDS = [(np.arange(8)[np.arange(8) % 2 != k], np.arange(8)[np.arange(8) % 2 == k]) for k in (0, 1)]


@pytest.fixture(autouse=True)
def few_reference_rows(monkeypatch):
    monkeypatch.setattr(_trained, "REFERENCE_ROWS", 500)


@pytest.fixture
def jointly(monkeypatch):
    """How many networks were trained together."""
    sizes = []
    fit_jointly = joint_folds.fit_jointly

    def counted(learners, jobs, **settings):
        sizes.append(len(learners))
        fit_jointly(learners, jobs, **settings)

    monkeypatch.setattr(joint_folds, "fit_jointly", counted)
    return sizes


def small(cls, **settings):
    return cls(**settings).set_params(**SMALL, estimator__batch_size=16)


def alone(estimator, ds):
    unfitted = seeded(estimator, np.random.default_rng(0))
    return [clone(unfitted).fit(ds[train]) for train, _ in FOLDS], unfitted.fit(ds)


def forecast(model, ds):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return model.predict(ds)


def fit_folds(estimator, ds, folds, *, rng, std=True):
    fits = FoldFits(estimator, ds, folds, rng=rng, std=std)
    return fits.fit(range(len(folds)), whole=True), fits.model


JOINT = [
    small(OneStepRegressor),
    small(OneStepRegressor, inputs="params"),
    small(OneStepRegressor, policy=gain_policy, baseline="mean", inputs="params", random_state=3),
    small(OneStepRegressor, policy="clone", policy_estimator=LinearRegression()),
    small(OneStepRegressor).set_params(estimator__n_members=2, estimator__probabilistic=True),
    small(OneStepRegressor, loss_horizon=2, policy=gain_policy),
    small(TrajectoryRegressor),
    small(TrajectoryRegressor, fresh_batches=False, relabeler=SubtrajectoryRelabeler(max_rows=90)),
]
IDS = ["D", "C", "baseline", "clone", "PE", "roll-outs", "T", "T of rows"]


@pytest.mark.parametrize("estimator", JOINT, ids=IDS)
def test_networks_of_every_formulation_are_trained_as_one(estimator, jointly):
    ds = linear(n=8, shortest=12, longest=15)
    found = fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0))
    assert jointly == [3]
    models, model = alone(estimator, ds)
    for one, other in zip([*models, model], [*found[0], found[1]], strict=True):
        a, b = forecast(one, ds), forecast(other, ds)
        np.testing.assert_allclose(a.mean, b.mean, rtol=1e-3, atol=1e-3)
        assert type(other.estimator_) is MLPEnsembleRegressor
        assert repr(other.get_params()) == repr(one.get_params())
    assert np.nanmax(np.abs(forecast(models[0], ds).mean - forecast(model, ds).mean)) > 1e-2


def test_models_of_folds_have_not_seen_what_was_held_out():
    ds = linear(n=8, shortest=12, longest=15)
    held_out = FOLDS[0][1]
    other = [
        TrajectoryDataset.from_list([episode]) if i not in held_out else linear(1, seed=i)
        for i, episode in enumerate(ds)
    ]
    other = TrajectoryDataset.from_list([part[0] for part in other])
    estimator = small(OneStepRegressor)
    models = [
        fit_folds(estimator, episodes, FOLDS, rng=np.random.default_rng(0))[0][0]
        for episodes in (ds, other)
    ]
    a, b = (forecast(model, ds).mean for model in models)
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "estimator",
    [
        OneStepRegressor(polynomial(2)),
        OneStepRegressor(LinearRegression(), policy="clone", policy_estimator=LinearRegression()),
        small(OneStepRegressor).set_params(estimator__early_stopping=True),
        small(
            OneStepRegressor,
            baseline=OneStepRegressor(LinearRegression(), inputs="params"),
            inputs="params",
        ),
        make_pipeline(FunctionTransformer(), OneStepRegressor(LinearRegression())),
    ],
    ids=["polynomial", "any learner", "stops early", "learned baseline", "Pipeline"],
)
def test_all_else_is_fitted_one_by_one(estimator, jointly):
    ds = linear(n=8, shortest=20, longest=25, dt=0.1)
    models, model = fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0))
    assert jointly == []
    for one, other in zip([*models, model], [*(a := alone(estimator, ds))[0], a[1]], strict=True):
        np.testing.assert_array_equal(forecast(one, ds).mean, forecast(other, ds).mean)


def test_a_recurrent_network_is_not_trained_with_others():
    assert joint_folds._network_of(LSTMRegressor()) is None
    assert joint_folds._network_of(TrajectoryRegressor()) is not None


def test_the_same_seed_gives_the_same_bits_and_leaves_the_estimator_alone():
    ds, estimator = linear(n=8, shortest=12, longest=15), small(OneStepRegressor)
    before = repr(estimator.get_params())
    found = [
        fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(seed))[1] for seed in (0, 0, 1)
    ]
    a, b, c = (forecast(model, ds).mean for model in found)
    np.testing.assert_array_equal(a, b)
    assert np.nanmax(np.abs(a - c)) > 1e-3
    assert repr(estimator.get_params()) == before
    assert not hasattr(estimator, "estimator_")


def test_folds_may_do_without_a_standard_deviation():
    ds, estimator = linear(n=8, shortest=12, longest=15), small(TrajectoryRegressor)
    found = [
        fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0), std=std)
        for std in (True, False)
    ]
    for with_std, without in zip(found[0][0], found[1][0]):
        np.testing.assert_allclose(
            forecast(with_std, ds).mean, forecast(without, ds).mean, rtol=1e-4, atol=1e-4
        )
        assert not hasattr(without.estimator_, "variance_coefs_")
    assert all(hasattr(model.estimator_, "variance_coefs_") for _, model in found)


def test_warnings_are_not_given_twice():
    ds = linear(n=8, shortest=12, longest=15)
    calls = []

    class Warned(SubtrajectoryRelabeler):
        def fit(self, X, y=None):
            calls.append(len(X))
            warnings.warn("seen", UserWarning, stacklevel=2)
            return super().fit(X, y)

    estimator = small(TrajectoryRegressor, relabeler=Warned())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0))
    assert len(caught) == len(FOLDS) + 1
    assert len(calls) == 2 * len(caught)


def test_an_error_in_a_fit_is_raised():
    with pytest.raises(ValueError, match="block 'action'"):
        fit_folds(
            small(OneStepRegressor),
            TrajectoryDataset.from_arrays(np.zeros((8, 5, 1))),
            FOLDS,
            rng=np.random.default_rng(0),
        )


@pytest.mark.parametrize(
    ("learner", "n_joint"), [(polynomial(1), []), (None, [2])], ids=["polynomial", "network"]
)
def test_noise_is_taken_out_once_for_all_folds(learner, n_joint, jointly, monkeypatch):
    ds = linear(n=8, shortest=150, longest=150).add_noise(0.3, random_state=0)
    smoothings = []
    smooth = OneStepRegressor.smooth
    monkeypatch.setattr(
        OneStepRegressor, "smooth", lambda self, X: smoothings.append(len(X)) or smooth(self, X)
    )
    estimator = OneStepRegressor(learner, denoise="em")
    if learner is None:
        estimator.set_params(estimator__hidden_layer_sizes=(16,), estimator__max_steps=300)
    models, model = fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0))
    assert model.noisy_
    assert smoothings == [8]
    assert jointly == n_joint
    for one in models:
        np.testing.assert_array_equal(one.measurement_noise_, model.measurement_noise_)
    again = clone(models[0])._fit_smoothed(model.smooth(ds)[FOLDS[0][0]], model.noise_)
    np.testing.assert_allclose(
        forecast(again, ds).mean, forecast(models[0], ds).mean, rtol=1e-3, atol=1e-3
    )


def test_without_noise_folds_are_fitted_on_what_was_logged():
    ds = linear(n=8, shortest=60, longest=60)
    estimator = OneStepRegressor(LinearRegression(), denoise="em")
    models, model = fit_folds(estimator, ds, FOLDS, rng=np.random.default_rng(0))
    assert not model.noisy_
    for one, (train, _) in zip(models, FOLDS):
        np.testing.assert_array_equal(
            forecast(one, ds).mean, forecast(clone(estimator).fit(ds[train]), ds).mean
        )


@pytest.mark.parametrize("denoise", [None, "em"])
def test_networks_of_folds_take_as_many_steps_as_that_of_all(denoise):
    rng = np.random.default_rng(0)
    ds = linear(20, shortest=20, longest=20).add_noise(0.1, random_state=0)
    folds = [(np.arange(5, 20), np.arange(5))]
    network = MLPEnsembleRegressor(hidden_layer_sizes=(4,), n_members=1, max_epochs=9, batch_size=8)
    fits = FoldFits(OneStepRegressor(network, denoise=denoise), ds, folds, rng=rng)
    (fold,) = fits.fit([0], whole=True)
    assert fold.estimator_.n_steps_ == fits.model.estimator_.n_steps_
