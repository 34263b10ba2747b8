"""The contract holds for our estimators, and fails for those that break it."""

import time

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import Pipeline

from trajlearn import (
    CalibratedForecaster,
    DirectRewardGP,
    DirectRewardNN,
    LinearFeedback,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.testing import check_dynamics_estimator
from trajlearn.testing._case import Case
from trajlearn.testing._contract import checks
from trajlearn.testing._fitting import _Identity
from trajlearn.testing._system import oscillators, with_garbage
from trajlearn.trajectories import as_dataset, is_episodes

SMALL = {
    "estimator__hidden_layer_sizes": (16,),
    "estimator__max_steps": 30,
    "estimator__batch_size": 64,
}
THREE = {"estimator__n_members": 3, "estimator__probabilistic": True}
FEEDBACK = LinearFeedback(bounds=None)
GP = GaussianProcessRegressor(RBF() + WhiteKernel(), optimizer=None, normalize_y=True)


def few(rows):
    return SubtrajectoryRelabeler(max_rows=rows)


T = TrajectoryRegressor().set_params(**SMALL)
D = OneStepRegressor().set_params(**SMALL)
LINEAR = OneStepRegressor(LinearRegression())

# estimator, arguments of the check, checks that do not apply
CASES = {
    "T": (T, {}, set()),
    "TPE": (TrajectoryRegressor().set_params(**SMALL | THREE), {}, set()),
    "T forest": (
        TrajectoryRegressor(RandomForestRegressor(2, max_depth=4), relabeler=few(200)),
        {},
        {"uncertainty", "samples", "std"},
    ),
    "T sklearn GP": (TrajectoryRegressor(GP, relabeler=few(80)), {"same_bits": False}, set()),
    "D": (D, {"policy": FEEDBACK}, {"std"}),
    "PE": (OneStepRegressor().set_params(**SMALL | THREE), {"policy": FEEDBACK}, {"std"}),
    "PE unscented": (
        OneStepRegressor(propagation="unscented").set_params(**SMALL | THREE),
        {"policy": FEEDBACK},
        set(),
    ),
    "calibrated T": (CalibratedForecaster(T), {}, {"rows_and", "bad_rows"}),
    "D by policy": (OneStepRegressor(policy=FEEDBACK).set_params(**SMALL), {}, {"std"}),
    "D linear": (
        LINEAR,
        {"policy": FEEDBACK, "same_bits": False},
        {"uncertainty", "samples", "std"},
    ),
    "D irregular": (OneStepRegressor(inputs=("action", "dt")).set_params(**SMALL), {}, {"std"}),
    "C": (OneStepRegressor(inputs="params").set_params(**SMALL), {}, {"std"}),
    "pipeline": (
        Pipeline([("same", _Identity()), ("model", T)]),
        {},
        {"list", "save", "rows_and", "bad_rows", "forecast_is", "planning", "divergence"},
    ),
    "GP": (DirectRewardGP().set_params(estimator__n_restarts=0), {}, set()),
    "NN": (DirectRewardNN().set_params(**SMALL), {}, set()),
}


@pytest.mark.parametrize("name", CASES)
def test_the_contract_holds(name):
    estimator, settings, without = CASES[name]
    before = repr(estimator)
    started = time.process_time()
    ran = check_dynamics_estimator(estimator, **settings)
    assert time.process_time() - started < 20
    assert repr(estimator) == before
    assert not hasattr(estimator, "estimator_")
    known = [check for check, _ in checks(Case(estimator, None, True))]
    assert len(set(ran)) == len(ran)
    left_out = set(known) - set(ran)
    assert len(left_out) == len(without), left_out
    assert all(any(word in check for word in without) for check in left_out), left_out


def test_every_check_states_its_promise():
    for estimator in (T, DirectRewardNN().set_params(**SMALL)):
        for name, check in checks(Case(estimator, None, True)):
            promise = check.args[1].__doc__
            assert promise.endswith("."), name
            assert len(promise.split()) >= 6, name


# -- broken estimators --------------------------------------------------------------------


class Linear(OneStepRegressor):
    """A good estimator to spoil."""

    def __init__(self, estimator=None, *, inputs="params", random_state=None):
        super().__init__(estimator, inputs=inputs, random_state=random_state)

    def _defaults(self):
        return super()._defaults() | {"estimator": LinearRegression()}


class Spoiled(Linear):
    """Changes every forecast by `spoil`."""

    def forecast(self, X, **settings):
        forecast = super().forecast(X, **settings)
        ds = X if isinstance(X, TrajectoryDataset) else TrajectoryDataset(X)
        self.spoil(forecast, ds)
        return forecast


class PeeksAtStates(Spoiled):
    def spoil(self, forecast, ds):
        of = ds if forecast.episode is None else ds[forecast.episode]
        last = np.minimum(forecast.start + 1, of.lengths)
        forecast.mean += 1e-9 * of.states[of.offsets[:-1] + last][:, None]


class PeeksAtRewards(Spoiled):
    def spoil(self, forecast, ds):
        if ds.rewards is not None and forecast.episode is None:
            step_offsets = ds.offsets - np.arange(len(ds) + 1)
            last = ds.rewards[step_offsets[1:] - 1]
            forecast.mean += 1e-9 * last[:, None, None]


class PeeksAtTermination(Spoiled):
    def spoil(self, forecast, ds):
        if forecast.episode is None:
            forecast.mean += 1e-9 * ds.terminated[:, None, None]


class PeeksAtActions(Spoiled):
    def spoil(self, forecast, ds):
        if ds.actions is not None and forecast.episode is None:
            step_offsets = ds.offsets - np.arange(len(ds) + 1)
            forecast.mean += 1e-9 * ds.actions[step_offsets[1:] - 1][:, None]


class DependsOnTheBatch(Spoiled):
    def spoil(self, forecast, ds):
        forecast.mean += 1e-6 * np.nanmean(forecast.mean)


class DependsALittleOnTheBatch(Spoiled):
    """By less than anyone can see."""

    def spoil(self, forecast, ds):
        forecast.mean += 1e-13 * len(forecast)


class DependsOnTheOrder(Spoiled):
    def spoil(self, forecast, ds):
        forecast.mean += 1e-6 * np.arange(len(forecast))[:, None, None]


class ForgetsTheLastStep(Spoiled):
    def spoil(self, forecast, ds):
        forecast.mean = forecast.mean[:, :-1]


class CountsFromTheStart(Spoiled):
    """The first state is no prediction."""

    def spoil(self, forecast, ds):
        first = forecast.initial_states[:, None]
        forecast.mean = np.concatenate([first, forecast.mean[:, :-1]], axis=1)


class PadsWithZeros(Spoiled):
    def spoil(self, forecast, ds):
        forecast.mean = np.nan_to_num(forecast.mean)


class WrongTimes(Spoiled):
    def spoil(self, forecast, ds):
        forecast.times = forecast.times + 1e-3


class Random(Spoiled):
    def fit(self, X, y=None):
        super().fit(X, y)
        self.shift_ = 1e-6 * np.random.default_rng().normal()
        return self

    def spoil(self, forecast, ds):
        forecast.mean += self.shift_


class SeedOfItsOwn(Spoiled):
    """Random without a seed, and deaf to it."""

    def fit(self, X, y=None):
        super().fit(X, y)
        seed = None if self.random_state is None else 7
        self.shift_ = 1e-6 * np.random.default_rng(seed).normal()
        return self

    def spoil(self, forecast, ds):
        forecast.mean += self.shift_


class ChangesParameters(Linear):
    def fit(self, X, y=None):
        super().fit(X, y)
        self.inputs = ("params",)
        return self


class IgnoresTargets(Linear):
    def fit(self, X, y=None):
        rows = not isinstance(X, (TrajectoryDataset, list))
        return super().fit(X, y if rows else None)


class RemembersTheLastFit(Spoiled):
    def fit(self, X, y=None):
        super().fit(X, y)
        self.fits_ = getattr(self, "fits_", 0) + 1
        return self

    def spoil(self, forecast, ds):
        forecast.mean += 1e-6 * self.fits_


class LosesStateInPickles(Spoiled):
    def fit(self, X, y=None):
        super().fit(X, y)
        self.shift_ = 1e-6
        return self

    def __getstate__(self):
        return {k: v for k, v in super().__getstate__().items() if k != "shift_"}

    def spoil(self, forecast, ds):
        forecast.mean += getattr(self, "shift_", 0.0)


class IgnoresStart(Linear):
    def forecast(self, X, *, start=0, **settings):
        return super().forecast(X, **settings)


class IgnoresHorizon(Linear):
    def forecast(self, X, *, horizon=None, **settings):
        return super().forecast(X, **settings)


class InventsParams(Linear):
    def forecast(self, X, **settings):
        if isinstance(X, TrajectoryDataset) and not X.has_params:
            X = TrajectoryDataset.from_arrays(
                [e.states for e in X], params=np.zeros((len(X), 2)), dt=0.2
            )
        return super().forecast(X, **settings)


class TerseErrors(Linear):
    def forecast(self, X, **settings):
        try:
            return super().forecast(X, **settings)
        except ValueError:
            raise ValueError("bad input") from None


class ScoresTheWrongWay(Linear):
    def score(self, X, y=None, sample_weight=None):
        return -super().score(X, y, sample_weight)


class ForgivesDivergence(Linear):
    def score(self, X, y=None, sample_weight=None):
        squared = self.forecast(X).squared_errors(X)
        squared[~np.isfinite(squared)] = np.nan
        return -np.nanmean(np.nanmean(squared, axis=(1, 2)))


class RowsOfItsOwn(Linear):
    def predict(self, X, return_std=False, **settings):
        found = super().predict(X, return_std, **settings)
        return found if hasattr(found, "horizons") else found + 1e-3


class UnseededSamples(TrajectoryRegressor):
    def __init__(self, estimator=None, *, random_state=None):
        super().__init__(estimator, random_state=random_state)

    def forecast(self, X, *, random_state=None, **settings):
        return super().forecast(X, **settings)


class PeekingReward(DirectRewardNN):
    """Reads the second state."""

    def __init__(self, estimator=None, *, random_state=None):
        super().__init__(estimator, random_state=random_state)

    def predict(self, X, return_std=False):
        mean, std = super().predict(X, return_std=True)
        if is_episodes(X):
            ds = as_dataset(X)
            mean = mean + 1e-9 * ds.states[ds.offsets[:-1] + 1, 0]
        return (mean, std) if return_std else mean


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (PeeksAtStates, "nothing_after_the_start"),
        (PeeksAtRewards, "nothing_after_the_start"),
        (PeeksAtTermination, "nothing_after_the_start"),
        (PeeksAtActions, "nothing_after_the_start"),
        (DependsOnTheBatch, "alone_is_as_in_a_batch"),
        (DependsOnTheOrder, "alone_is_as_in_a_batch"),
        (ForgetsTheLastStep, "alone_is_as_in_a_batch"),
        (CountsFromTheStart, "rows_and_episodes_agree"),
        (PadsWithZeros, "shapes_of_the_log"),
        (WrongTimes, "shapes_of_the_log"),
        (Random, "seeds_decide_the_fit"),
        (SeedOfItsOwn, "seeds_decide_the_fit"),
        (ChangesParameters, "changes_no_parameter"),
        (IgnoresTargets, "refuses_targets"),
        (RemembersTheLastFit, "forgets_the_last_fit"),
        (LosesStateInPickles, "pickle_keeps"),
        (IgnoresStart, "starts_agree"),
        (IgnoresHorizon, "horizon_cuts"),
        (InventsParams, "missing_params"),
        (TerseErrors, "bad_starts"),
        (ScoresTheWrongWay, "score_is_minus"),
        (ForgivesDivergence, "divergence_counts"),
        (RowsOfItsOwn, "rows_and_episodes_agree"),
        (UnseededSamples, "seeds_decide_the_samples"),
        (PeekingReward, "nothing_after_the_start"),
    ],
)
def test_a_broken_estimator_fails_the_check_meant_for_it(broken, check):
    estimator = broken()
    if not isinstance(estimator, Linear):
        estimator.set_params(**SMALL)
    with pytest.raises(AssertionError, match=rf"breaks a promise \(check_\w*({check})") as caught:
        check_dynamics_estimator(estimator, same_bits=False)
    assert "Found:" in str(caught.value) or "Raised" in str(caught.value)


def test_the_estimator_that_is_spoiled_is_good():
    check_dynamics_estimator(Linear(), same_bits=False)


def test_same_bits_are_asked_for_unless_told_otherwise():
    check_dynamics_estimator(DependsALittleOnTheBatch(), same_bits=False)
    with pytest.raises(AssertionError, match=r"(?s)alone_is_as_in_a_batch.*differ by up to"):
        check_dynamics_estimator(DependsALittleOnTheBatch())


def test_the_data_of_the_contract():
    ds = oscillators(10, seed=0)
    assert len(np.unique(ds.lengths)) > 2
    assert ds.terminated.any()
    np.testing.assert_array_equal(ds.states, oscillators(10, seed=0).states)
    assert clone(LINEAR).fit(ds).score(oscillators(5, seed=1)) > -1e-20
    start = np.arange(10) % 3
    dirty = with_garbage(ds, start, keep_actions=False)
    for clean, garbage, k in zip(ds, dirty, start):
        np.testing.assert_array_equal(clean.states[: k + 1], garbage.states[: k + 1])
        np.testing.assert_array_equal(clean.actions[:k], garbage.actions[:k])
        np.testing.assert_array_equal(clean.params, garbage.params)
        np.testing.assert_array_equal(clean.times, garbage.times)
        assert (clean.states[k + 1 :] != garbage.states[k + 1 :]).all()
        assert (clean.actions[k:] != garbage.actions[k:]).all()
        assert (clean.rewards[k:] != garbage.rewards[k:]).all()
