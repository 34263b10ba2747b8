"""Trajectory-based models: any horizon at once, within one theta, with honest paths."""

import warnings

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.dummy import DummyRegressor
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, StandardScaler

from tests.dynamics.systems import SMALL, Affine, closed_loop, linear, truth
from trajlearn import (
    BlockScaler,
    MLPEnsembleRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.exceptions import DivergenceWarning, HorizonWarning, MissingFieldError

EVERY_PAIR = SubtrajectoryRelabeler(max_rows=None)


def small(**settings):
    return TrajectoryRegressor(random_state=0).set_params(**SMALL | settings)


def oscillators(n, seed, *, omega=(0.8, 1.2)):
    """x'' = -theta^2 x, sampled at random times."""
    rng = np.random.default_rng(seed)
    states, times, params = [], [], rng.uniform(*omega, size=(n, 1))
    for w in params[:, 0]:
        t = np.cumsum(rng.uniform(0.05, 0.25, size=30))
        a, phase = rng.uniform(0.5, 1.0), rng.uniform(0, 2 * np.pi)
        states.append(np.stack([a * np.cos(w * t + phase), -a * np.sin(w * t + phase)], axis=1))
        times.append(t)
    return TrajectoryDataset.from_arrays(states, params=params, times=times)


def test_oscillators_at_irregular_times_are_learned_to_any_horizon():
    ds, test = oscillators(60, 0), oscillators(10, 1)
    model = TrajectoryRegressor(random_state=0).set_params(
        estimator__hidden_layer_sizes=(32, 32), estimator__max_steps=1200, estimator__batch_size=128
    )
    model.fit(ds)
    assert model.score(test) > -5e-3
    still = -np.nanmean(((test.states[test.offsets[:-1]][:, None] - truth(test)) / 2) ** 2)
    assert still < -0.05
    # horizons between those of any log
    w, (x, v) = 1.1, (0.6, 0.4)
    t = np.array([0.017, 0.5, 1.234, 2.9])
    found = model.predict_trajectory([x, v], params=[w], horizons=t).mean[0]
    expected = [x * np.cos(w * t) + v * np.sin(w * t), v * np.cos(w * t) - x * np.sin(w * t)]
    np.testing.assert_allclose(found, np.transpose(expected), atol=0.1)


def test_the_gate_makes_short_horizons_exact():
    ds = oscillators(10, 0)
    test = oscillators(4, 1)
    start = test.states[test.offsets[:-1]]

    def jump(gate):
        model = small(gate=gate).fit(ds)
        found = model.predict_trajectory(start, params=test.params, horizons=[1e-3]).mean[:, 0]
        return np.abs(found - start).max()

    assert jump(0.05) < 0.01
    assert jump(None) > 5 * jump(0.05)


def test_known_references_of_the_future_are_inputs():
    rng = np.random.default_rng(0)
    references = np.cumsum(rng.normal(size=(6, 9, 2)), axis=1)
    ds = TrajectoryDataset.from_arrays(references @ [[1.0], [2.0]], references=references)
    model = TrajectoryRegressor(
        LinearRegression(), relabeler=EVERY_PAIR, baseline=None, scaler=StandardScaler()
    ).fit(ds)
    assert list(model.layout_) == ["state", "horizon", "references"]
    np.testing.assert_allclose(model.predict(ds), truth(ds), atol=1e-9)
    later = model.predict(ds, start=3)
    np.testing.assert_allclose(later, truth(ds)[:, 3:], atol=1e-9)
    planned = model.predict_trajectory(
        ds.states[::9], references=references[:, [0, 2, 7]], horizons=[2.0, 7.0]
    )
    np.testing.assert_allclose(planned.mean, truth(ds)[:, [1, 6]], atol=1e-9)
    with pytest.raises(MissingFieldError, match="references"):
        model.predict_trajectory(ds.states[:1], horizons=[2.0])
    # what is known ends with the log
    assert (model.predict(ds, start=5, horizon=20).lengths == 3).all()


def test_context_is_an_input_and_an_unseen_category_an_error():
    task = ["up", "down"] * 4
    states = np.arange(6.0)[None, :, None] * np.where(np.array(task) == "up", 1, -1)[:, None, None]
    ds = TrajectoryDataset.from_arrays(states, context={"task": task})
    model = TrajectoryRegressor(
        RandomForestRegressor(1, bootstrap=False), relabeler=EVERY_PAIR, random_state=0
    ).fit(ds)
    assert list(model.layout_.feature_names) == ["s0", "horizon", "task=down", "task=up"]
    np.testing.assert_allclose(model.predict(ds), states[:, 1:], atol=1e-9)
    odd = TrajectoryDataset.from_arrays(states[:1], context={"task": ["left"]})
    with pytest.raises(ValueError, match="'left', which fit did not see"):
        model.predict(odd)
    with pytest.raises(MissingFieldError, match="no context 'task'"):
        model.predict(TrajectoryDataset.from_arrays(states[:1]))


def test_phase_is_an_input_and_its_absence_an_error():
    times = [k + np.arange(8.0) for k in range(6)]
    states = [np.sin(t)[:, None] for t in times]
    ds = TrajectoryDataset.from_arrays(states, times=times, time_origin=np.zeros(6))
    model = TrajectoryRegressor(
        RandomForestRegressor(1, bootstrap=False), relabeler=EVERY_PAIR, random_state=0
    ).fit(ds)
    assert "phase" in model.layout_
    np.testing.assert_allclose(model.predict(ds), truth(ds), atol=1e-9)
    unknown = TrajectoryDataset.from_arrays(states, times=times)
    with pytest.raises(MissingFieldError, match="time_origin"):
        model.predict(unknown)
    with pytest.raises(MissingFieldError, match="time_origin"):
        model.predict_trajectory([0.0], horizons=[1.0])


# -- theta changes inside an episode ------------------------------------------------------


def jumping(n=12, steps=10, switch=4):
    """The state stands still, and is 100 away after theta has changed."""
    rng = np.random.default_rng(0)
    level = rng.normal(size=(n, 1, 1))
    after = np.arange(steps + 1)[None, :, None] > switch
    params = (np.arange(steps) >= switch)[:, None].astype(float)
    return TrajectoryDataset.from_arrays(
        level + 100.0 * after, params=[params + i % 2 for i in range(n)]
    )


@pytest.mark.parametrize(
    "learner", [MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=20), LinearRegression()]
)
def test_training_never_crosses_a_change_of_theta(learner):
    ds = jumping()
    model = TrajectoryRegressor(learner, random_state=0).fit(ds)
    # the jump is the first step of the new theta; the old one's pairs all stand still
    assert model.max_horizon_ == 6.0
    forecast = model.predict(ds)
    assert (forecast.lengths == 4).all()
    assert forecast.mean.shape[1] == 4


def test_a_forecast_ends_with_the_stretch_of_its_theta():
    ds = closed_loop(6, switch=3)
    model = small().fit(ds)
    assert (model.predict(ds).lengths == 3).all()
    assert (model.predict(ds, start=[0, 1, 2, 3, 4, 8]).lengths == [3, 2, 1, 5, 4, 0]).all()
    assert (model.predict(ds, start=4, horizon=2).lengths == 2).all()
    # the last theta is in force past the log, as it is alone
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HorizonWarning)
        assert (model.predict(ds, start=6, horizon=5).lengths == 5).all()
        mixed = TrajectoryDataset([*closed_loop(2), *ds])
        assert (model.predict(mixed, horizon=20).lengths[:2] == 20).all()


def test_theta_of_the_stretch_is_used():
    class ReadsTheta(Affine):
        def predict(self, X):
            return X[:, -1:]

    ds = closed_loop(5, switch=4)
    identity = FunctionTransformer()
    model = TrajectoryRegressor(ReadsTheta(), scaler=identity, baseline=None, gate=None).fit(ds)
    for start, step in ((0, 0), (3, 3), (4, 4), (6, 6)):
        found = model.predict(ds, start=start, horizon=1).mean[:, 0] / model.target_scale_
        np.testing.assert_allclose(found, [e.params[step] for e in ds])


# -- horizons -----------------------------------------------------------------------------


def test_a_horizon_beyond_training_warns_and_answers():
    ds = linear(shortest=10, longest=10)
    model = small().fit(ds)
    assert model.max_horizon_ == 10.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(ds, horizon=10)
    with pytest.warns(HorizonWarning, match="12 ahead, the longest horizon in training was 10"):
        forecast = model.predict(ds, horizon=12)
    assert np.isfinite(forecast.mean).all()
    np.testing.assert_allclose(forecast.times[0], np.arange(1, 13))
    with pytest.warns(HorizonWarning):
        model.predict_trajectory([0.0, 0.0], params=[0.1, 0.1], horizons=[25.0])


def test_a_shorter_training_horizon_counts():
    ds = linear(shortest=10, longest=10)
    model = small(relabeler__max_horizon=4).fit(ds)
    assert model.max_horizon_ == 4.0
    with pytest.warns(HorizonWarning):
        model.predict(ds)
    times = np.array([[0, 1, 2, 4, 9, 10.0]])
    irregular = TrajectoryDataset.from_arrays(np.zeros((1, 6, 1)), times=times)
    assert small(relabeler__max_horizon=2).fit(irregular).max_horizon_ == 7.0


def test_past_an_irregular_log_there_are_no_times():
    ds = oscillators(5, 0)
    with pytest.raises(ValueError, match=r"varies in episode 0.*predict_trajectory"):
        small().fit(ds).predict(ds, start=28, horizon=5)


def test_planning_is_forecasting_at_any_times():
    ds = oscillators(12, 0)
    model = small(estimator__n_members=2).fit(ds)
    forecast = model.predict(ds, return_std=True)
    for i in (0, 3):
        horizons = forecast.times[i] - forecast.initial_times[i]
        found = model.predict_trajectory(
            ds[i].states[0], params=ds[i].params, horizons=horizons, return_std=True
        )
        np.testing.assert_allclose(found.mean[0], forecast.mean[i], atol=1e-6)
        np.testing.assert_allclose(found.std[0], forecast.std[i], atol=1e-6)
        np.testing.assert_array_equal(found.horizons, horizons)


# -- uncertainty --------------------------------------------------------------------------


def noisy_constant(std, n_steps, gate=0.05):
    ds = TrajectoryDataset.from_arrays(np.zeros((3, n_steps + 1, 1)))
    learner = Affine(0.0, std=std)
    model = TrajectoryRegressor(learner, scaler=FunctionTransformer(), gate=gate).fit(ds)
    model.target_scale_ = np.ones(1)
    return model, ds


@pytest.mark.parametrize(("noise_time", "power"), [(np.inf, 1.0), (1e-9, 0.5)])
def test_the_std_of_a_sum_over_a_sampled_path(noise_time, power):
    # n steps of std s: the sum has n s if they go together, sqrt(n) s if they do not
    model, ds = noisy_constant(0.5, 25)
    model.noise_time_ = np.array([noise_time])
    step = model.predict(ds, return_std=True).std
    gate = 1 - np.exp(-np.arange(1, 26) / (0.05 * 25))
    np.testing.assert_allclose(step[0, :, 0], 0.5 * gate)
    samples = model.predict(ds, n_samples=4000, random_state=0).samples
    np.testing.assert_allclose(samples.std(axis=0), step, rtol=0.06)
    last = samples[:, :, 10:].sum(axis=2).std(axis=0)
    np.testing.assert_allclose(last, 0.5 * 15**power, rtol=0.06)


def test_correlated_noise_keeps_its_variance():
    model, ds = noisy_constant(0.5, 25, gate=None)
    rho = 0.8
    model.noise_time_ = np.array([-1 / np.log(rho)])
    samples = model.predict(ds, n_samples=4000, random_state=0).samples
    np.testing.assert_allclose(samples.std(axis=0), 0.5, rtol=0.06)
    lag = np.abs(np.subtract.outer(np.arange(25), np.arange(25)))
    expected = 0.5 * np.sqrt((rho**lag).sum())
    np.testing.assert_allclose(samples.sum(axis=2).std(axis=0), expected, rtol=0.06)


@pytest.mark.parametrize(("dt", "correlation"), [(1.0, 0.9), (0.02, 0.9), (1.0, 0.0)])
def test_the_noise_time_is_that_of_the_residuals(dt, correlation):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(30, 200, 1))
    for t in range(1, 200):
        fresh = np.sqrt(1 - correlation**2) * states[:, t]
        states[:, t] = correlation * states[:, t - 1] + fresh
    ds = TrajectoryDataset.from_arrays(states, dt=dt)
    model = TrajectoryRegressor(DummyRegressor(), baseline=None, relabeler=EVERY_PAIR).fit(ds)
    if correlation:
        np.testing.assert_allclose(model.noise_time_, -dt / np.log(correlation), rtol=0.15)
    else:
        assert (model.noise_time_ < 0.4 * dt).all()


def test_every_sample_is_one_member():
    members = {"estimator__n_members": 2, "estimator__probabilistic": False}
    model = small(estimator__max_steps=100, **members).fit(linear(20))
    model.estimator_.residual_std_ *= 0
    ds = linear(3, seed=1)
    samples = model.predict(ds, n_samples=6, random_state=0).samples
    paths = np.unique(np.nan_to_num(samples).reshape(6, -1).round(9), axis=0)
    assert len(paths) == 2
    np.testing.assert_allclose(
        samples.mean(axis=0), model.predict(ds).mean, atol=1e-9
    )  # three samples of each


def test_std_is_that_of_rows():
    model = small(estimator__n_members=3, estimator__probabilistic=True).fit(linear(20))
    ds = linear(2, seed=1, shortest=6, longest=6)
    rows = [[*ds[0].states[0], h, *ds[0].params] for h in range(1, 7)]
    mean, std = model.predict(np.array(rows), return_std=True)
    forecast = model.predict(ds, return_std=True)
    np.testing.assert_allclose(forecast.mean[0], mean, atol=1e-6)
    np.testing.assert_allclose(forecast.std[0], std, rtol=1e-5)


def test_the_default_learns_how_wide_to_be_at_every_horizon():
    ds = oscillators(30, 11).add_noise(0.1, random_state=1)
    test = oscillators(30, 21).add_noise(0.1, random_state=51)
    settings = {"estimator__hidden_layer_sizes": (32, 32), "estimator__batch_size": 128}

    def gap_and_crps(**kind):
        model = TrajectoryRegressor(random_state=0)
        model.set_params(estimator__max_steps=400, **settings, **kind)
        forecast = model.fit(ds).predict(test, return_std=True)
        z = (truth(test) - forecast.mean) / forecast.std
        inside = (np.abs(z) < 1.645).mean(axis=(0, 2))
        coverage = [part.mean() for part in np.split(inside, [2, 6, 15])]
        score = z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - np.pi**-0.5
        return np.abs(np.subtract(coverage, 0.9)).mean(), (forecast.std * score).mean()

    gap, crps = gap_and_crps()
    one_for_all = gap_and_crps(estimator__probabilistic=False)
    assert gap < 0.08
    assert gap < 0.6 * one_for_all[0]
    assert crps < 0.98 * one_for_all[1]


@pytest.mark.parametrize("settings", [{}, {"fresh_batches": False}, {"scaler": StandardScaler()}])
def test_the_mean_of_the_default_is_to_the_bit_that_of_a_plain_learner(settings):
    ds, test = linear(10), linear(4, seed=1, longest=8)
    default, plain = small(**settings), small(estimator__probabilistic=False, **settings)
    mean = default.fit(ds).predict(test).mean
    assert default.estimator_.probabilistic == "separate"
    np.testing.assert_array_equal(mean, plain.fit(ds).predict(test).mean)
    # whether or not the variances are computed with it
    np.testing.assert_array_equal(mean, default.predict(test, return_std=True).mean)
    some = {"params": ds.params[:2], "horizons": [1.0, 2.5]}
    found = default.predict_trajectory(np.zeros((2, 2)), **some).mean
    expected = plain.predict_trajectory(np.zeros((2, 2)), return_std=True, **some).mean
    np.testing.assert_array_equal(found, expected)


def test_means_alone_take_no_network_of_variances(monkeypatch):
    ds = linear(10)
    model = small().fit(ds)
    asked = []
    predictor = MLPEnsembleRegressor.predictor

    def spy(self, *, means_only=False):
        asked.append(means_only)
        return predictor(self, means_only=means_only)

    monkeypatch.setattr(MLPEnsembleRegressor, "predictor", spy)
    for arguments in ({}, {"return_std": True}, {"n_samples": 2}):
        model.predict(ds, **arguments)
    assert asked == [True, False, False]


# -- parameters ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"estimator": Affine(0.1)},
        {"estimator__activation": "tanh"},
        {"estimator__n_members": 2},
        {"relabeler": SubtrajectoryRelabeler()},
        {"relabeler__starts": "uniform"},
        {"relabeler__horizons": "uniform"},
        {"relabeler__max_horizon": 3},
        {"relabeler__inputs": ("state", "horizon")},
        {"scaler": StandardScaler()},
        {"scaler": BlockScaler()},
        {"scaler__horizon": MinMaxScaler()},
        {"scaler__horizon__n_scales": 2},
        {"baseline": None},
        {"gate": None},
        {"gate": 0.5},
        {"fresh_batches": False},
        {"random_state": 1},
    ],
    ids=str,
)
def test_every_parameter_changes_the_forecast(change):
    test = linear(5, seed=1, longest=5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HorizonWarning)
        plain, changed = (
            np.asarray(model.fit(linear(10)).predict(test))
            for model in (
                small(),
                TrajectoryRegressor(random_state=0).set_params(
                    **({} if "estimator" in change else SMALL) | change
                ),
            )
        )
    assert not np.array_equal(plain, changed)


def test_error_score_is_what_a_diverged_episode_counts():
    ds = linear(4)
    far = TrajectoryDataset.from_arrays(
        [e.states * (1e9 if i == 0 else 1) for i, e in enumerate(ds)], params=ds.params
    )
    with pytest.warns(DivergenceWarning) as caught:
        score = small(error_score=-80.0).fit(ds).score(far)
    assert len(caught) == 1
    assert -30 < score < -20


def test_rows_of_a_draw_decide_where_batches_are_not_fresh():
    ds = linear(10)
    few, many = (
        small(fresh_batches=False, relabeler__max_rows=rows).fit(ds).relabeler_.sample_indices_
        for rows in (7, 90)
    )
    assert (len(few), len(many)) == (7, 90)


def test_early_stopping_needs_fixed_rows_and_keeps_groups_together():
    ds = linear(10)
    settings = {"estimator__early_stopping": True, "relabeler__max_rows": 200}
    with pytest.raises(ValueError, match="fresh_batches=False"):
        small(**settings).fit(ds)
    model = small(fresh_batches=False, **settings)
    by_episode = np.asarray(model.fit(ds).predict(ds))
    by_group = np.asarray(model.fit(ds, groups=np.arange(10) // 5).predict(ds))
    assert not np.array_equal(by_episode, by_group, equal_nan=True)
    same = TrajectoryDataset.from_arrays(
        [e.states for e in ds], params=ds.params, group=(np.arange(10) // 5).tolist()
    )
    np.testing.assert_array_equal(np.asarray(model.fit(same).predict(ds)), by_group)
    with pytest.raises(ValueError, match="one label an episode"):
        model.fit(ds, groups=[0, 1])


@pytest.mark.parametrize("fresh", [True, False])
def test_an_episode_of_weight_zero_is_left_out(fresh):
    ds, test = linear(8), linear(3, seed=1)
    weight = np.array([1.0, 1, 0, 1, 1, 0, 1, 1])
    model = small(fresh_batches=fresh, relabeler__max_rows=2000)
    kept = np.asarray(model.fit(ds[weight > 0]).predict(test))
    weighted = np.asarray(model.fit(ds, sample_weight=weight).predict(test))
    np.testing.assert_allclose(weighted, kept, atol=0.05 * np.ptp(ds.states))
    heavy = np.asarray(model.fit(ds, sample_weight=1 + 50.0 * (np.arange(8) == 0)).predict(test))
    assert np.nanmax(np.abs(heavy - kept)) > np.nanmax(np.abs(weighted - kept))


@pytest.mark.parametrize("fresh", [True, False])
def test_scalers_and_scale_are_those_of_the_weighted_rows(fresh):
    ds = TrajectoryDataset.from_arrays([np.linspace(0, 1, 30)[:, None], np.full((30, 1), 9.0)])
    model = small(fresh_batches=fresh).fit(ds, sample_weight=[1.0, 3.0])
    state = next(part for columns, part in model.scaler_.parts_ if columns.tolist() == [0])
    np.testing.assert_allclose(state.mean_, 0.75 * 9.0 + 0.25 * 0.25, rtol=0.05)
    alone = small(fresh_batches=fresh).fit(ds[:1])
    # three quarters of the changes are zero
    assert 0.4 < model.target_scale_[0] / alone.target_scale_[0] < 0.9


@pytest.mark.parametrize("fresh", [True, False])
def test_weights_decide_between_episodes_that_disagree(fresh):
    up = np.arange(9.0)[:, None]
    ds = TrajectoryDataset.from_arrays([up, -up])
    model = TrajectoryRegressor(
        MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=300, batch_size=64),
        fresh_batches=fresh,
        random_state=0,
    )
    found = model.fit(ds, sample_weight=[3.0, 1.0]).predict(ds[:1]).mean[0, :, 0]
    np.testing.assert_allclose(found[4:], 0.5 * up[5:, 0], rtol=0.15)


def test_the_squared_error_of_the_state_is_minimised_not_that_of_its_gated_change():
    # the best constant f in s + g(h) f
    ds = linear(10)
    rows, targets = SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    model = TrajectoryRegressor(DummyRegressor(), relabeler=EVERY_PAIR, gate=0.3).fit(ds)
    g = 1 - np.exp(-rows[:, [2]] / (0.3 * model.max_horizon_))
    change = targets - rows[:, :2]
    best = (g * change).sum(axis=0) / (g**2).sum(axis=0)
    np.testing.assert_allclose(model.predict(rows), rows[:, :2] + g * best, atol=1e-9)


def test_a_forecast_that_is_not_finite_once_has_diverged_from_there_on():
    class Broken(Affine):
        def predict(self, X):
            return np.where(X[:, [1]] == 3.0, np.inf, 0.0)

    ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(2, 7, 1)))
    with np.errstate(invalid="ignore"):
        model = TrajectoryRegressor(Broken(), scaler=FunctionTransformer()).fit(ds)
    with pytest.warns(DivergenceWarning, match=r"2 of 2 forecasts diverged \(first at step 3\)"):
        forecast = model.predict(ds)
    assert forecast.diverged_at.tolist() == [3, 3]
    assert np.isfinite(forecast.mean[:, :2]).all()
    assert np.isposinf(forecast.mean[:, 2:]).all()


def test_learners_without_weights_refuse_weights():
    from sklearn.neighbors import KNeighborsRegressor

    with pytest.raises(TypeError, match="KNeighborsRegressor does not take weights"):
        TrajectoryRegressor(KNeighborsRegressor()).fit(linear(), sample_weight=np.ones(8))


def test_single_output_learners_get_a_copy_a_state():
    from sklearn.svm import SVR

    ds = linear(5)
    model = TrajectoryRegressor(SVR(), relabeler=SubtrajectoryRelabeler(max_rows=60)).fit(ds)
    assert len(model.estimator_.estimators_) == 2
    assert model.predict(ds).mean.shape[2] == 2


def test_seeds_reach_learners_inside_learners():
    from sklearn.pipeline import make_pipeline

    inner = MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=10)
    model = TrajectoryRegressor(make_pipeline(StandardScaler(), inner), random_state=0)
    model.set_params(relabeler__max_rows=100)
    ds = linear(4)
    first, second = (np.asarray(model.fit(ds).predict(ds)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert inner.random_state is None


def test_dt_is_the_median_step_of_training():
    times = [np.array([0, 3, 4, 5.0]), np.array([0, 1, 5.0])]
    ds = TrajectoryDataset.from_arrays([np.ones((4, 1)), np.ones((3, 1))], times=times)
    assert small().fit(ds).dt_ == 1.0
    rows = np.random.default_rng(0).normal(size=(9, 2)) ** 2
    assert small().fit(rows, rows[:, 0]).dt_ is None


def test_dt_has_no_round_off():
    ds = TrajectoryDataset.from_arrays(np.ones((1, 500, 1)), dt=0.02)
    assert small().fit(ds).dt_ == 0.02
