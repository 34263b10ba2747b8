"""Calibrated forecasts: their coverage, their spread, and the rules of the contract."""

import pickle
import warnings

import numpy as np
import pytest
from scipy.stats import betabinom, norm
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, GroupKFold, KFold, ShuffleSplit
from sklearn.pipeline import Pipeline

from tests.dynamics.calibration import Decay, decays
from tests.dynamics.systems import SMALL, linear, truth
from trajlearn import (
    HoldForecaster,
    KalmanSmoother,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
    cross_val_forecast,
    load,
)
from trajlearn.dynamics.calibrated import CalibratedForecaster
from trajlearn.exceptions import CalibrationWarning, DivergenceWarning, HorizonWarning
from trajlearn.testing import check_dynamics_estimator
from trajlearn.testing._case import Case
from trajlearn.testing._contract import checks
from trajlearn.testing._fitting import _Identity
from trajlearn.testing._system import with_garbage

# ragged episodes are few at their longest, of which these speak
pytestmark = [
    pytest.mark.filterwarnings("ignore:too few calibration episodes"),
    pytest.mark.filterwarnings("ignore:.*have infinite intervals"),
    pytest.mark.filterwarnings("ignore:a forecast reaches"),
]

LEVELS = (0.5, 0.9, 0.95)
# probability that a right implementation fails one of the coverage tests with another seed
ALPHA = 1e-3


def frozen(ds, model=None, **settings):
    model = Decay().fit(ds) if model is None else model
    return CalibratedForecaster(FrozenEstimator(model), random_state=0, **settings).fit(ds)


def inside(model, ds, level, **settings):
    """Whether each logged cell (n, H, d_s) lies in its interval; NaN where there is none."""
    lower, upper = model.predict(ds, return_std=True, **settings).interval(level)
    logged = truth(ds)
    return np.where(np.isnan(logged), np.nan, (lower <= logged) & (logged <= upper))


def in_beta_binomial_band(hits, n_tests, n_calibration, level, alpha):
    """Whether counts lie where those of conformal intervals do with probability 1 - alpha."""
    rank = np.ceil(np.round((n_calibration + 1) * level, 9))
    counts = betabinom(n_tests, rank, n_calibration + 1 - rank)
    low, high = counts.ppf(alpha / 2), counts.ppf(1 - alpha / 2)
    return (low <= hits) & (hits <= high)


# -- the guarantee ------------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["normal", "heavy"])
@pytest.mark.parametrize("by_params", [False, True])
def test_marginal_coverage_is_that_of_exchangeable_episodes(noise, by_params):
    calibration, test = (decays(n, seed=seed, noise=noise) for n, seed in ((150, 1), (600, 2)))
    # an std that is far off, and wrong in another way for each episode
    model = frozen(calibration, Decay(factor=0.3, by_params=by_params).fit(calibration))
    for level in LEVELS:
        hits = inside(model, test, level).sum(axis=0)
        alpha = ALPHA / (hits.size * len(LEVELS))
        assert in_beta_binomial_band(hits, len(test), 150, level, alpha).all(), (level, hits)


@pytest.mark.parametrize("noise", ["normal", "heavy"])
def test_simultaneous_coverage_is_that_of_exchangeable_episodes(noise):
    calibration, test = (decays(n, seed=seed, noise=noise) for n, seed in ((300, 3), (600, 4)))
    model = frozen(calibration, Decay(factor=3.0).fit(calibration), band="simultaneous")
    for level in LEVELS:
        hits = inside(model, test, level).all(axis=(1, 2)).sum()
        assert in_beta_binomial_band(hits, len(test), 150, level, ALPHA / len(LEVELS)), hits


def test_the_shape_of_simultaneous_bands_comes_from_other_episodes_than_their_size():
    ds, test = decays(10, seed=1), decays(1, seed=2)

    def widths(calibration):
        model = frozen(calibration, Decay().fit(ds), band="simultaneous")
        lower, upper = model.predict(test, return_std=True).interval(0.5)
        return upper - lower

    same_shape = []
    for i in range(10):
        states = [episode.states.copy() for episode in ds]
        states[i][5:] *= 1.5
        changed = TrajectoryDataset.from_arrays(states, params=ds.params, dt=0.1)
        ratio = widths(changed) / widths(ds)
        same_shape.append(np.allclose(ratio, ratio.mean()))
    assert sum(same_shape) == 5


@pytest.mark.parametrize("band", ["marginal", "simultaneous"])
def test_coverage_of_ragged_episodes(band):
    calibration, test = (
        decays(n, seed=seed, shortest=3, longest=14) for n, seed in ((300, 5), (600, 6))
    )
    model = frozen(calibration, Decay(factor=0.5).fit(calibration), band=band)
    assert (np.diff(model.n_calibration_) <= 0).all()
    assert model.n_calibration_[0] == 300
    assert model.n_calibration_[-1] == (calibration.lengths == 14).sum()
    for level in LEVELS:
        found = inside(model, test, level)
        if band == "simultaneous":
            hits = (np.nan_to_num(found, nan=1.0) == 1).all(axis=(1, 2)).sum()
            assert in_beta_binomial_band(hits, 600, 150, level, ALPHA / len(LEVELS)), hits
            continue
        hits, n_tests = np.nansum(found, axis=0), (~np.isnan(found)).sum(axis=0)
        n_calibration = np.repeat(model.n_calibration_[:, None], 2, axis=1)
        alpha = ALPHA / (hits.size * len(LEVELS))
        assert in_beta_binomial_band(hits, n_tests, n_calibration, level, alpha).all()


@pytest.mark.parametrize("band", ["marginal", "simultaneous"])
@pytest.mark.parametrize("start", [0, 4, "random"])
def test_coverage_of_a_fitted_model_on_new_episodes(band, start):
    ds, test = (decays(n, seed=seed, longest=16) for n, seed in ((400, 7), (500, 8)))
    base = TrajectoryRegressor(LinearRegression(), random_state=0)
    model = CalibratedForecaster(base, cv=0.5, band=band, start=start, random_state=0).fit(ds)
    rng = np.random.default_rng(0)
    starts = rng.integers(0, test.lengths) if start == "random" else np.full(500, start)
    forecast = model.predict(test, return_std=True, start=starts)
    n = 200 if band == "marginal" else 100
    for level in LEVELS:
        lower, _ = forecast.interval(level)
        found = np.where(
            np.isnan(forecast.residuals(test)),
            np.nan,
            np.abs(forecast.residuals(test)) <= forecast.mean - lower,
        )
        if band == "simultaneous":
            hits = (np.nan_to_num(found, nan=1.0) == 1).all(axis=(1, 2)).sum()
            assert in_beta_binomial_band(hits, 500, n, level, ALPHA / 3)
            continue
        # later steps are reached by few of the random starts
        hits, n_tests = np.nansum(found, axis=0)[:5], (~np.isnan(found)).sum(axis=0)[:5]
        n_cal = np.repeat(model.n_calibration_[:5, None], 2, axis=1)
        assert in_beta_binomial_band(hits, n_tests, n_cal, level, ALPHA / 30).all()


def test_random_starts_are_one_an_episode():
    ds = decays(200, seed=1)
    count = frozen(ds, start="random").n_calibration_
    assert count[0] == 200
    # 12 starts, of which h leave h steps or more
    np.testing.assert_allclose(count, 200 * np.arange(12, 0, -1) / 12, atol=25)
    assert frozen(ds, start=0).n_calibration_.tolist() == [200] * 12
    assert frozen(ds, start=4).n_calibration_.tolist() == [200] * 8


def test_out_of_fold_residuals_cover_about_as_often():
    ds, test = (decays(n, seed=seed, longest=16) for n, seed in ((60, 9), (500, 10)))
    base = TrajectoryRegressor(LinearRegression(), random_state=0)
    for cv in (5, KFold(3)):
        model = CalibratedForecaster(base, cv=cv, random_state=0).fit(ds)
        assert model.n_calibration_[0] == 60
        coverage = np.nanmean(inside(model, test, 0.9))
        assert 0.86 < coverage < 0.94
        # the final model has seen everything
        whole = clone(base).fit(ds).predict(test)
        np.testing.assert_array_equal(model.predict(test).mean, whole.mean)


# -- bands --------------------------------------------------------------------------------


def test_bands_are_those_of_each_cell_by_itself():
    calibration, test = decays(40, seed=1, shortest=5), decays(6, seed=2, shortest=5)
    base = Decay(factor=0.4, by_params=True).fit(calibration)
    model = frozen(calibration, base)
    before = base.predict(calibration, return_std=True)
    raw = base.predict(test, return_std=True)
    logged = truth(calibration)
    for level in (0.3, 0.8, 0.9):
        lower, upper = model.predict(test, return_std=True).interval(level)
        for h in range(12):
            for j in range(2):
                scores = np.abs(logged - before.mean)[:, h, j] / before.std[:, h, j]
                scores = np.sort(scores[~np.isnan(scores)])
                rank = int(np.ceil((len(scores) + 1) * level))
                factor = scores[rank - 1] if rank <= len(scores) else np.inf
                half = factor * raw.std[:, h, j]
                np.testing.assert_allclose(upper[:, h, j], raw.mean[:, h, j] + half)
                np.testing.assert_allclose(lower[:, h, j], raw.mean[:, h, j] - half)


def test_intervals_are_nested_and_simultaneous_ones_wider():
    ds, test = decays(200, seed=1), decays(5, seed=2)
    widths = {}
    for band in ("marginal", "simultaneous"):
        forecast = frozen(ds, band=band).predict(test, return_std=True)
        found = [np.subtract(*forecast.interval(level)[::-1]) for level in (0.2, 0.5, 0.9, 0.97)]
        assert (np.diff(found, axis=0) >= 0).all()
        widths[band] = found
    assert (np.array(widths["simultaneous"])[1:] > np.array(widths["marginal"])[1:]).all()


def test_a_level_that_few_episodes_cannot_say_is_infinite_and_warns():
    forecast = frozen(decays(8, seed=1)).predict(decays(3, seed=2), return_std=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(forecast.interval(8 / 9)).all()
    with pytest.warns(CalibrationWarning, match="12 of 12 horizons .* need 9 or more"):
        lower, upper = forecast.interval(0.9)
    assert np.isneginf(lower).all()
    assert np.isposinf(upper).all()


def test_beyond_the_calibrated_horizon():
    ds = decays(30, seed=1, shortest=6, longest=6)
    model = frozen(ds)
    with pytest.warns(HorizonWarning, match="beyond step 6"):
        forecast = model.predict(ds[:2], horizon=9, return_std=True, n_samples=3, random_state=0)
    raw = model.estimator_.predict(ds[:2], horizon=9, return_std=True)
    np.testing.assert_allclose(
        forecast.std[:, 6:] / raw.std[:, 6:],
        np.broadcast_to(model.rescaling_.factor[-1], (2, 3, 2)),
    )
    assert np.isfinite(forecast.samples).all()
    with pytest.warns(CalibrationWarning, match=r"3 of 9 horizons \(first 7\)"):
        lower, _ = forecast.interval(0.9)
    assert (np.isfinite(lower) == (np.arange(9) < 6)[None, :, None]).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forecast.at([1, 6]).interval(0.9)


def test_diverged_episodes_count_as_infinitely_wrong():
    ds = decays(40, seed=1)
    states = [episode.states for episode in ds]
    # predicted as 0.9^h * 1e8
    states[0] = np.vstack([np.full((1, 2), 1e8), states[0][1:]])
    odd = TrajectoryDataset.from_arrays(states, params=ds.params, dt=0.1)
    with pytest.warns(DivergenceWarning):
        model = frozen(odd, Decay().fit(ds))
    clean = frozen(ds[1:], Decay().fit(ds))
    np.testing.assert_array_equal(model.rescaling_.factor, clean.rescaling_.factor)
    assert np.isfinite(model.predict(ds, return_std=True, n_samples=2).samples).all()
    forecast = model.predict(ds[:3], return_std=True)
    assert np.isfinite(forecast.interval(0.9)).all()
    # of 41 ranks the last is infinite
    with pytest.warns(CalibrationWarning):
        assert np.isinf(forecast.interval(0.97)).all()


def test_the_method_variance_has_gaussian_intervals():
    ds, test = decays(60, seed=1), decays(4, seed=2)
    model = frozen(ds, Decay(factor=0.2).fit(ds), method="variance")
    assert model.bands_ is None
    forecast = model.predict(test, return_std=True)
    assert forecast.bands is None
    lower, upper = forecast.interval(0.8)
    np.testing.assert_allclose(upper - lower, 2 * norm.ppf(0.9) * forecast.std)
    drawn = model.predict(test, n_samples=500, random_state=0)
    np.testing.assert_allclose(
        drawn.interval(0.8)[0], np.quantile(drawn.samples, 0.1, axis=0, method="weibull")
    )


def test_a_fit_that_fails_leaves_no_calibration_behind():
    ds = decays(30, seed=1)
    model = CalibratedForecaster(Decay(), random_state=0).fit(ds)
    with pytest.raises(ValueError, match="to calibrate on"):
        model.fit(ds[:3])
    with pytest.raises(NotFittedError):
        model.predict(ds[:3], return_std=True)


def test_the_episodes_that_calibrated_are_named():
    ds = decays(30, seed=1)
    model = CalibratedForecaster(Decay(), cv=0.4, random_state=0).fit(ds)
    used = np.isin(ds.ids, model.calibration_ids_)
    assert used.sum() == 12
    same = frozen(ds[used], model.estimator_)
    np.testing.assert_array_equal(np.sort(same.calibration_ids_), np.sort(model.calibration_ids_))
    np.testing.assert_allclose(
        np.ptp(same.predict(ds, return_std=True).interval(0.5), axis=0),
        np.ptp(model.predict(ds, return_std=True).interval(0.5), axis=0),
    )


class Moody(Decay):
    """Fails with another error where it is asked for a standard deviation."""

    def _refuse_uncertainty(self, request):
        if request.return_std:
            raise ValueError("the policy knows no such state")


def test_an_error_that_comes_with_the_std_alone_is_told():
    ds = decays(30, seed=1)
    with pytest.warns(CalibrationWarning, match="knows no such state"):
        model = frozen(ds, Moody(gives_std=False).fit(ds))
    assert not model.has_std_


# -- the standard deviation ---------------------------------------------------------------


def test_the_scale_undoes_a_wrong_std():
    ds = decays(400, seed=1)
    for factor in (0.1, 1.0, 20.0):
        model = frozen(ds, Decay(factor=factor, by_params=True).fit(ds))
        np.testing.assert_allclose(factor * model.rescaling_.factor, 1.0, atol=0.12)


def test_the_crps_is_no_worse_than_raw_and_better_where_raw_is_wrong():
    from scoringrules import crps_normal

    ds, test = decays(200, seed=1), decays(500, seed=2)
    for factor, least, most in ((1.0, 0.97, 1.02), (0.3, 0.0, 0.9)):
        base = Decay(factor=factor, by_params=True).fit(ds)
        raw, new = (
            model.predict(test, return_std=True) for model in (base, frozen(ds[:200], base))
        )
        crps = [crps_normal(truth(test), f.mean, f.std).mean() for f in (raw, new)]
        assert least < crps[1] / crps[0] < most


@pytest.mark.parametrize("band", ["marginal", "simultaneous"])
def test_a_model_without_std_gets_one(band):
    ds, test = decays(200, seed=1), decays(600, seed=2)
    model = frozen(ds, Decay(gives_std=False).fit(ds), band=band)
    assert not model.has_std_
    forecast = model.predict(test, return_std=True)
    spread = truth(test).std(axis=0)
    errors = (truth(test) - forecast.mean).std(axis=0)
    np.testing.assert_allclose(forecast.std[0], errors, rtol=0.2)
    np.testing.assert_array_equal(forecast.std[0], forecast.std[1])
    assert (forecast.std[0] <= spread).all()
    found = inside(model, test, 0.9)
    if band == "marginal":
        assert in_beta_binomial_band(found.sum(axis=0), 600, 200, 0.9, ALPHA / 24).all()
    else:
        assert in_beta_binomial_band(found.all(axis=(1, 2)).sum(), 600, 100, 0.9, ALPHA)


@pytest.mark.parametrize("base", [HoldForecaster(), OneStepRegressor(LinearRegression())])
def test_formulations_without_std(base):
    ds = linear(40, shortest=8, longest=8)
    forecast = CalibratedForecaster(base, random_state=0).fit(ds).predict(ds, return_std=True)
    assert (forecast.std > 0).all()
    # the linear model is exact
    exact = isinstance(base, OneStepRegressor)
    assert (np.nanmax(forecast.std) < 1e-9) == exact


def test_an_std_of_zero_does_no_harm():
    ds, test = decays(200, seed=1), decays(600, seed=2)
    model = frozen(ds, Decay(factor=0.0).fit(ds))
    assert model.has_std_
    assert in_beta_binomial_band(
        inside(model, test, 0.9).sum(axis=0), 600, 200, 0.9, ALPHA / 24
    ).all()
    std = model.predict(test, return_std=True).std
    np.testing.assert_allclose(
        std[0],
        frozen(ds, Decay(gives_std=False).fit(ds)).predict(test, return_std=True).std[0],
        rtol=1e-6,
    )


# -- samples ------------------------------------------------------------------------------


def walks(n, *, seed, steps=20, actions=False):
    """A random walk of two states with correlated noise."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(n, steps, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
    states = np.concatenate([np.zeros((n, 1, 2)), np.cumsum(noise, axis=1)], axis=1)
    fields = {"actions": np.zeros((n, steps, 1))} if actions else {}
    return TrajectoryDataset.from_arrays(states, **fields)


def summed(states):
    return states[..., 0] - 0.5 * states[..., 1]


# the reward of a step is w_0 - w_1 / 2 of the noise, of variance 1 + 1 / 4 - 0.6
STD_OF_MEAN = np.sqrt(0.65 * (np.arange(1, 21) ** 2).sum()) / 20


MODELS = {
    "known": Decay(1.0, factor=0.5),
    "T": TrajectoryRegressor(LinearRegression(), random_state=0),
    "T network": TrajectoryRegressor(random_state=0).set_params(
        **SMALL, estimator__n_members=2, estimator__probabilistic=True
    ),
    "one step": OneStepRegressor(LinearRegression()),
    "one step network": OneStepRegressor(random_state=0).set_params(
        **SMALL, estimator__n_members=2, estimator__probabilistic=True
    ),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("method", ["conformal", "variance"])
def test_the_std_of_a_summed_reward(name, method):
    ds = walks(400, seed=1, actions="one" in name)
    model = CalibratedForecaster(MODELS[name], cv=0.75, method=method, random_state=0).fit(ds)
    test = walks(4, seed=2, actions="one" in name)
    mean, std = model.predict_reward(test, summed, return_std=True, n_samples=1000, random_state=0)
    assert mean.shape == std.shape == (4,)
    np.testing.assert_allclose(std / STD_OF_MEAN, 1.0, atol=0.15)


def test_samples_have_the_moments_of_the_residuals():
    ds = walks(300, seed=1)
    model = frozen(ds, Decay(1.0).fit(ds))
    forecast = model.predict(ds[:2], n_samples=4000, random_state=0)
    assert forecast.samples.shape == (4000, 2, 20, 2)
    drawn = forecast.samples[:, 0] - forecast.mean[0]
    np.testing.assert_allclose(drawn.std(axis=0) / forecast.std[0], 1.0, atol=0.05)
    # of a random walk the correlation of step 4 with step 16 is 1/2, over both states 0.6 of it
    found = np.corrcoef(drawn[:, [3, 15], :].reshape(4000, 4), rowvar=False)
    np.testing.assert_allclose(found[0], [1.0, 0.6, 0.5, 0.3], atol=0.12)
    between = np.corrcoef(forecast.samples[:, 0, 9, 0], forecast.samples[:, 1, 9, 0])[0, 1]
    assert abs(between) < 0.06


def test_samples_bring_their_std_and_follow_the_seed():
    ds = decays(40, seed=1)
    model = frozen(ds)
    first, again, other = (model.predict(ds, n_samples=2, random_state=k) for k in (0, 0, 1))
    np.testing.assert_array_equal(first.samples, again.samples)
    assert (first.samples != other.samples).all()
    np.testing.assert_array_equal(first.std, model.predict(ds, return_std=True).std)
    assert first.bands is not None
    plain = model.predict(ds)
    assert plain.std is None
    assert plain.samples is None
    assert plain.bands is None


# -- episodes of calibration --------------------------------------------------------------


class Recorder(Decay):
    """Remembers how many episodes it saw, by their first state."""

    def fit(self, X, y=None, *, groups=None):
        super().fit(X)
        self.seen_ = set(X.states[X.offsets[:-1], 0])
        return self


def test_groups_are_held_out_together():
    ds = decays(40, seed=1)
    labels = np.repeat(np.arange(8), 5)
    for given in (ds, TrajectoryDataset.from_list(list(ds))):
        model = CalibratedForecaster(Recorder(), cv=0.25, random_state=0).fit(given, groups=labels)
        first = given.states[given.offsets[:-1], 0]
        seen = np.isin(first, list(model.estimator_.seen_)).reshape(8, 5)
        assert seen.all(axis=1).sum() == 6
        assert (~seen).all(axis=1).sum() == 2
        assert model.n_calibration_[0] == 10
    with pytest.raises(ValueError, match=r"groups has shape \(3,\)"):
        model.fit(ds, groups=[0, 1, 2])


def test_the_estimator_gets_the_groups_to_stop_by():
    class Groups(Decay):
        def fit(self, X, y=None, *, groups=None):
            self.groups_ = X.group
            return super().fit(X)

    ds = decays(6, seed=1)
    model = CalibratedForecaster(Groups(), cv=2, random_state=0).fit(ds, groups=list("aabbcc"))
    assert model.estimator_.groups_.tolist() == list("aabbcc")


def test_nothing_of_a_forecast_depends_on_its_truth():
    ds, test = linear(40), linear(6, seed=1)
    base = TrajectoryRegressor(random_state=0).set_params(**SMALL)
    model = CalibratedForecaster(base, random_state=0).fit(ds)
    found = []
    for episodes in (test, _rewritten(test)):
        forecast = model.predict(episodes, return_std=True, n_samples=2, random_state=0)
        found.append((forecast.std, forecast.samples, *forecast.interval(0.8)))
    for first, second in zip(*found):
        np.testing.assert_array_equal(first, second)
    # nor what was learned on episodes that are forecast afterwards
    scale = model.rescaling_.factor.copy()
    model.predict(test, return_std=True)
    np.testing.assert_array_equal(scale, model.rescaling_.factor)


def _rewritten(ds):
    full = TrajectoryDataset.from_arrays(
        [e.states for e in ds],
        actions=[e.actions for e in ds],
        params=ds.params,
        rewards=[np.zeros(e.length) for e in ds],
    )
    return with_garbage(full, np.zeros(len(ds), dtype=int), keep_actions=False)


def test_a_held_out_episode_is_not_fitted_on():
    ds = decays(30, seed=1)
    first = ds.states[ds.offsets[:-1], 0]
    model = CalibratedForecaster(Recorder(), cv=0.3, random_state=0).fit(ds)
    assert len(model.estimator_.seen_) == 21
    assert model.n_calibration_[0] == 9
    again = CalibratedForecaster(Recorder(), cv=0.3, random_state=1).fit(ds)
    assert again.estimator_.seen_ != model.estimator_.seen_
    whole = CalibratedForecaster(Recorder(), cv=GroupKFold(3), random_state=0).fit(
        ds, groups=np.arange(30)
    )
    assert whole.estimator_.seen_ == set(first)


def test_a_frozen_estimator_stays_as_it_is():
    ds = linear(30)
    base = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(ds[:20])
    model = CalibratedForecaster(FrozenEstimator(base)).fit(ds[20:])
    assert model.n_calibration_[0] == 10
    np.testing.assert_array_equal(model.predict(ds).mean, base.predict(ds).mean)
    np.testing.assert_array_equal(model.state_range_, base.state_range_)


@pytest.mark.parametrize(
    ("settings", "n", "message"),
    [
        ({}, 1, "holds out whole episodes, and there is only 1"),
        ({"cv": 0.2}, 3, "only 1 episode is left to calibrate"),
        ({"start": 12}, 20, "no held-out episode goes beyond start = 12"),
        ({"cv": ShuffleSplit(3, test_size=0.5, random_state=0)}, 10, "an episode twice"),
    ],
)
def test_too_few_episodes_are_refused(settings, n, message):
    with pytest.raises(ValueError, match=message):
        CalibratedForecaster(Decay(), random_state=0, **settings).fit(decays(n, seed=1))


def test_one_group_is_refused():
    with pytest.raises(ValueError, match="whole groups, and there is only 1"):
        CalibratedForecaster(Decay()).fit(decays(5, seed=1), groups=["a"] * 5)


def test_short_episodes_do_not_calibrate_a_late_start():
    ds = decays(60, seed=1, shortest=4, longest=12)
    with pytest.warns(CalibrationWarning, match="end at start = 6 or before"):
        model = frozen(ds, start=6)
    assert model.n_calibration_[0] == (ds.lengths > 6).sum()


def test_rows_and_targets_are_refused():
    model = CalibratedForecaster()
    with pytest.raises(TypeError, match=r"whole episodes, and got ndarray.*not rows"):
        model.fit(np.zeros((5, 3)), None)
    with pytest.raises(ValueError, match="y must be omitted"):
        model.fit(decays(5, seed=1), np.zeros(5))
    fitted = frozen(decays(20, seed=1))
    with pytest.raises(TypeError, match="not rows"):
        fitted.predict(np.zeros((5, 3)))
    with pytest.raises(TypeError, match="predicts ndarray, not a Forecast"):
        CalibratedForecaster(NoForecast()).fit(decays(20, seed=1))


class NoForecast(Decay):
    def predict(self, X, return_std=False, **settings):
        return np.zeros(len(X))


def test_errors_of_the_estimator_are_its_own():
    ds = linear(20, params=False)
    with pytest.raises(ValueError, match="params"):
        CalibratedForecaster(OneStepRegressor(inputs="params").set_params(**SMALL)).fit(
            linear(20)
        ).predict(ds)


def test_other_actions_than_in_calibration_warn():
    ds = linear(20)
    model = CalibratedForecaster(OneStepRegressor(LinearRegression()), random_state=0).fit(ds)

    def policy(states, params, times):
        return -(states * params).sum(axis=1, keepdims=True)

    with pytest.warns(CalibrationWarning, match="actions='logged', but this one has .*'policy'"):
        model.predict(ds, return_std=True, actions="policy", policy=policy)


# -- as any other dynamics estimator ------------------------------------------------------

T = TrajectoryRegressor().set_params(**SMALL | {"estimator__max_steps": 10})


ONE_STEP = OneStepRegressor(LinearRegression())


@pytest.mark.parametrize(
    ("estimator", "without"),
    [
        (CalibratedForecaster(T), set()),
        (CalibratedForecaster(ONE_STEP, band="simultaneous", cv=2, start="random"), set()),
        (CalibratedForecaster(HoldForecaster(), method="variance"), {"planning", "grid_search"}),
        (
            CalibratedForecaster(Pipeline([("same", _Identity()), ("model", ONE_STEP)])),
            {"planning"},
        ),
    ],
    ids=["T", "simultaneous", "variance", "pipeline"],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_contract_holds(estimator, without):
    same_bits = estimator.estimator is T
    ran = check_dynamics_estimator(estimator, same_bits=same_bits)
    every = [name for name, _ in checks(Case(estimator, None, same_bits))]
    left_out = set(every) - set(ran)
    # rows are refused
    without = without | {"rows_and_episodes", "bad_rows"}
    assert len(left_out) == len(without), left_out
    assert all(any(word in name for word in without) for name in left_out), left_out


def test_search_reaches_the_estimator_and_the_default():
    ds = linear(20)
    grid = {"estimator__gate": [0.1, 0.5], "method": ["variance"]}
    search = GridSearchCV(CalibratedForecaster(T, random_state=0), grid, cv=2, error_score="raise")
    assert search.fit(ds).best_estimator_.estimator_.gate in (0.1, 0.5)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    model = CalibratedForecaster()
    assert model.estimator is None
    assert "estimator__estimator__max_steps" in model.get_params()
    model.set_params(estimator__estimator__max_steps=7)
    assert model.estimator.estimator.max_steps == 7


def test_the_default_estimator_is_a_trajectory_model():
    model = CalibratedForecaster(random_state=0).set_params(
        **{f"estimator__{name}": value for name, value in SMALL.items()}
    )
    assert isinstance(model.fit(linear(20)).estimator_, TrajectoryRegressor)
    assert CalibratedForecaster().get_params()["estimator"] is None


def test_out_of_fold_forecasts_keep_their_bands():
    ds = decays(60, seed=1, shortest=8)
    model = CalibratedForecaster(Decay(factor=0.2), cv=0.5, random_state=0)
    forecast = cross_val_forecast(model, ds, KFold(3), return_std=True)
    assert len(set(forecast.bands)) == 3
    test = np.arange(20, 40)
    own = clone(model).fit(ds[np.setdiff1d(np.arange(60), test)]).predict(ds[test], return_std=True)
    n_steps = own.mean.shape[1]
    for found, expected in zip(forecast.interval(0.8), own.interval(0.8)):
        np.testing.assert_allclose(found[test][:, :n_steps], expected)
    np.testing.assert_allclose(forecast[test].interval(0.8)[0][:, :n_steps], own.interval(0.8)[0])
    np.testing.assert_allclose(
        forecast.at([2, 5]).interval(0.8)[1], forecast.interval(0.8)[1][:, [1, 4]]
    )


def test_several_starts_an_episode():
    ds = decays(40, seed=1)
    model = frozen(ds)
    both = model.predict(ds[:3], start=[[0, 5], [0, 5], [0, 5]], return_std=True)
    one = model.predict(ds[:3], start=5, return_std=True)
    late = both[both.start == 5]
    np.testing.assert_allclose(late.interval(0.8)[0][:, :7], one.interval(0.8)[0])
    assert len(both.bands) == 6


def test_planning_finds_steps_by_their_time():
    ds = linear(40, shortest=8, longest=8, times=[0.25 * np.arange(9)] * 40)
    model = CalibratedForecaster(T, random_state=0).fit(ds)
    expected = model.predict(ds[:3], return_std=True, n_samples=2, random_state=0)
    found = model.predict_trajectory(
        expected.initial_states,
        params=ds.params[:3],
        horizons=0.25 * np.arange(1, 9),
        return_std=True,
        n_samples=2,
        random_state=0,
    )
    np.testing.assert_allclose(found.std, expected.std, rtol=1e-4)
    np.testing.assert_allclose(found.samples, expected.samples, rtol=1e-3, atol=1e-3)
    for first, second in zip(found.interval(0.5), expected.interval(0.5)):
        np.testing.assert_allclose(first, second, rtol=1e-3, atol=1e-3)
    # between two steps the later one counts
    raw = model.estimator_.predict_trajectory(
        expected.initial_states, params=ds.params[:3], horizons=[0.6], return_std=True
    )
    between = model.predict_trajectory(
        expected.initial_states, params=ds.params[:3], horizons=[0.6], return_std=True
    )
    np.testing.assert_allclose(between.std[:, 0], raw.std[:, 0] * model.rescaling_.factor[2])
    assert not hasattr(CalibratedForecaster(Pipeline([("model", T)])), "predict_trajectory")
    assert hasattr(CalibratedForecaster(), "predict_trajectory")


def test_behind_a_smoother_estimated_velocities_are_not_calibrated():
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(31)
    waves = np.sin(t + rng.uniform(0, 6, size=(30, 1)))[:, :, None]
    ds = TrajectoryDataset.from_arrays(waves + 0.05 * rng.normal(size=waves.shape), dt=0.1)
    smoother = KalmanSmoother("velocity", append_velocities=True, training="filter")
    model = CalibratedForecaster(Pipeline([("smooth", smoother), ("model", T)]), random_state=0)
    forecast = model.fit(ds).predict(ds, return_std=True, n_samples=3, random_state=0)
    logged = [name in ds.state_names for name in forecast.state_names]
    assert logged == [True, False]
    lower, _ = forecast.interval(0.7)
    assert np.isfinite(lower[..., logged]).all()
    assert np.isneginf(lower[..., ~np.array(logged)]).all()
    assert np.isfinite(forecast.samples).all()


def test_pickled_and_saved(tmp_path):
    ds = linear(30)
    model = CalibratedForecaster(T, random_state=0).fit(ds)
    model.save(tmp_path / "model.safetensors")
    settings = {"return_std": True, "n_samples": 2, "random_state": 3}
    expected = model.predict(ds, **settings)
    for again in (pickle.loads(pickle.dumps(model)), load(tmp_path / "model.safetensors")):
        found = again.predict(ds, **settings)
        np.testing.assert_array_equal(found.samples, expected.samples)
        np.testing.assert_array_equal(found.interval(0.6), expected.interval(0.6))
    kept = pickle.loads(pickle.dumps(expected))
    np.testing.assert_array_equal(kept.interval(0.6), expected.interval(0.6))
    assert len({id(one) for one in kept.bands}) == 1
