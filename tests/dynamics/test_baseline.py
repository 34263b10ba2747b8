"""Predicting relative to a baseline; exogenous references, phase and context."""

import numpy as np
import pytest
from sklearn.dummy import DummyRegressor
from sklearn.exceptions import NotFittedError
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures

from trajlearn import (
    BlockScaler,
    DivergenceWarning,
    HoldForecaster,
    HorizonWarning,
    LSTMRegressor,
    MeanEpisodeForecaster,
    MissingFieldError,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    TransitionRelabeler,
    load,
)

DT = 0.05


def name(value):
    return value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)


def same(references):
    """A plant of one state whose set-point is the reference itself."""
    return references


def tracking(n=24, *, seed=0, lag=0.0, noise=0.0, shift=True):
    """e' = -k e about the reference r(t) = sin(2 t), logged from some phase on; k is theta."""
    rng = np.random.default_rng(seed)
    fields = {"states": [], "references": [], "params": [], "times": []}
    origins = []
    for i in range(n):
        begin = rng.uniform(-0.3, 0.8) if shift else 0.0
        steps = int(rng.integers(40, 60))
        k = rng.uniform(0.5, 3.0)
        phase = begin + DT * np.arange(steps + 1)
        error = rng.normal() * np.exp(-k * (phase - begin))
        fields["references"].append(np.sin(2 * phase)[:, None])
        fields["states"].append((np.sin(2 * phase) + error + lag)[:, None])
        fields["states"][-1] += noise * rng.normal(size=(steps + 1, 1))
        fields["params"].append([k])
        fields["times"].append(5.0 * i + phase - begin)
        origins.append(5.0 * i - begin)
    return TrajectoryDataset.from_arrays(
        **fields, time_origin=origins, context={"kind": ["a", "b"] * (n // 2)}
    )


def small(**settings):
    model = TrajectoryRegressor(random_state=0, **settings)
    return model.set_params(estimator__hidden_layer_sizes=(32,), estimator__max_steps=400)


def error(model, ds, **settings):
    forecast = model.predict(ds, **settings)
    return float(np.sqrt(np.nanmean(forecast.squared_errors(ds)[:, 9:])))


# -- what a baseline is worth -------------------------------------------------------------


def test_the_tracking_error_is_easier_to_learn_than_the_state():
    train, test = tracking(), tracking(seed=1)
    blind = small(relabeler=SubtrajectoryRelabeler(inputs=["state", "horizon", "params"]))
    plain = error(blind.fit(train), test)
    seeing = error(small().fit(train), test)
    relative = error(small(baseline=same).fit(train), test)
    assert seeing < 0.5 * plain
    assert relative < 0.7 * seeing


def test_short_horizons_keep_the_deviation_of_the_start():
    ds = tracking()
    start = ds.states[ds.offsets[:-1]] - ds.references[ds.offsets[:-1]]
    lost = []
    for gate in (0.5, None):
        model = small(baseline=same, gate=gate).set_params(estimator__max_steps=1).fit(ds)
        kept = model.predict(ds, horizon=1).mean[:, 0] - ds.references[ds.offsets[:-1] + 1]
        lost.append(np.abs(kept - start).mean())
    assert lost[0] < 0.2 * lost[1]


def test_a_baseline_that_is_right_leaves_nothing_to_learn():
    ds = tracking()
    ds = TrajectoryDataset.from_arrays(
        [episode.references + 0.7 for episode in ds],
        references=[episode.references for episode in ds],
    )
    model = small(baseline=lambda references: references + 0.7)
    assert error(model.set_params(estimator__max_steps=1).fit(ds), ds) < 1e-9


def test_one_step_models_of_the_tracking_error():
    """dev' = dev exp(-k dt): of second degree in (dev, k dev) but for the curvature in k."""
    train, test = tracking(), tracking(seed=1)
    learner = make_pipeline(PolynomialFeatures(4), LinearRegression())
    model = OneStepRegressor(
        learner,
        inputs=("state", "params"),
        relabeler=TransitionRelabeler(inputs=("state", "params")),
        baseline=same,
    )
    assert error(model.fit(train), test) < 1e-3
    assert error(model.set_params(baseline=None).fit(train), test) > 0.1


def test_a_policy_gets_the_states_themselves():
    ds = tracking()
    actions = [episode.references[:-1] - episode.states[:-1] for episode in ds]
    ds = ds.assign(actions=actions)
    seen = []

    def policy(states, params, times):
        seen.append(states.copy())
        return np.zeros((len(states), 1))

    inputs = ("action", "references")
    model = OneStepRegressor(LinearRegression(), inputs=inputs, baseline=same, policy=policy)
    model.fit(ds).predict(ds, start=3, horizon=2)
    np.testing.assert_allclose(seen[0], ds.states[ds.state_rows(3)], atol=1e-12)


def test_a_recurrent_model_takes_a_baseline():
    ds = tracking(n=8)
    model = LSTMRegressor(inputs="params", baseline=same, max_steps=5, random_state=0).fit(ds)
    # were the baseline not added back, it would be three times that
    assert error(model, ds, start=2, horizon=12) < 0.1


# -- the kinds of baseline ----------------------------------------------------------------


def test_the_mean_episode_is_that_of_the_context_at_the_phase():
    ds = tracking()
    model = MeanEpisodeForecaster().fit(ds)
    start = 25  # where all episodes are under way
    forecast = model.predict(ds, start=start, horizon=3)
    for i in (0, 1):
        own = ds[[j for j in range(len(ds)) if j % 2 == i]]
        phase = ds.times[ds.offsets[i] + start + 1] - ds.time_origin[i]
        values = []
        for episode, origin in zip(own, own.time_origin):
            t = episode.times - origin
            values.append(np.interp(phase, t, episode.states[:, 0]))
        # curves are linear between the grid of phases and between samples
        assert forecast.mean[i, 0, 0] == pytest.approx(np.mean(values), abs=2e-3)


def test_the_mean_of_equal_episodes_is_the_episode():
    phase = 0.1 * np.arange(31)
    states = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    ds = TrajectoryDataset.from_arrays(
        [states[:20], states[5:], states], dt=0.1, time_origin=[0, -0.5, 0]
    )
    forecast = MeanEpisodeForecaster().fit(ds).predict(ds, start=2)
    assert np.nanmax(forecast.squared_errors(ds)) < 1e-20


def test_without_an_origin_the_phase_is_the_time_since_the_first_sample():
    ds = TrajectoryDataset.from_arrays([[[0.0], [2.0]], [[0.0], [4.0]]], times=[[7.0, 8], [1.0, 2]])
    assert MeanEpisodeForecaster().fit(ds).predict(ds).mean[:, 0, 0].tolist() == [3.0, 3.0]


def test_a_learned_baseline_is_seen_out_of_fold():
    """Episodes are noise about zero: their own mean would make the deviations too small."""
    rng = np.random.default_rng(0)
    level = rng.normal(size=(6, 1, 1))
    ds = TrajectoryDataset.from_arrays(np.tile(level, (1, 9, 1)))
    model = TrajectoryRegressor(LinearRegression(), baseline="mean", random_state=0).fit(ds)
    seen = model.target_scale_[0]
    frozen = FrozenEstimator(MeanEpisodeForecaster().fit(ds))
    in_sample = model.set_params(baseline=frozen).fit(ds).target_scale_[0]
    # n levels: out of fold (two folds of two) the deviation is at least n / (n - 1) times as large
    assert seen > 1.15 * in_sample


def test_another_estimator_as_baseline():
    train, test = tracking(), tracking(seed=1)
    hold = small(baseline=HoldForecaster()).fit(train)
    state = small().fit(train)
    assert error(hold, test) < 2 * error(state, test)
    inner = TrajectoryRegressor(LinearRegression(), random_state=0)
    model = small(baseline=inner).fit(train)
    assert model.baseline_ is not inner
    assert error(model, test) < error(inner.fit(train), test)


@pytest.mark.parametrize("start", [0, 7])
def test_with_nothing_learned_a_forecast_is_that_of_the_baseline(start):
    """From the first state of the episode on, wherever the forecast starts."""
    ds = tracking(n=6)
    inner = OneStepRegressor(LinearRegression(), inputs="params")
    nothing = DummyRegressor(strategy="constant", constant=0.0)
    model = TrajectoryRegressor(nothing, baseline=inner, gate=None, random_state=0).fit(ds)
    from_first = inner.fit(ds).predict(ds).mean
    found = model.predict(ds, start=start, horizon=20).mean
    np.testing.assert_allclose(found, from_first[:, start : start + 20], atol=1e-9)


def test_samples_and_their_spread_are_about_the_mean():
    ds = tracking(n=6, lag=5.0)
    model = small(baseline=same).set_params(estimator__max_steps=50).fit(ds)
    forecast = model.predict(ds, horizon=9, return_std=True, n_samples=300, random_state=0)
    off = np.abs(forecast.samples.mean(axis=0) - forecast.mean)
    assert (off < 0.4 * forecast.std + 1e-9).all()


# -- known signals ------------------------------------------------------------------------


@pytest.mark.parametrize("baseline", ["state", "mean", same, HoldForecaster()], ids=name)
def test_nothing_after_the_start_is_read(baseline):
    ds = tracking(n=6)
    model = small(baseline=baseline).set_params(estimator__max_steps=3).fit(ds)
    start = 20
    garbage = []
    for episode in ds:
        states = episode.states.copy()
        states[start + 1 :] = 1e3
        garbage.append(states)
    other = TrajectoryDataset.from_arrays(
        garbage,
        params=ds.params,
        references=[e.references for e in ds],
        times=[e.times for e in ds],
        time_origin=ds.time_origin,
        context=ds.context,
    )
    a, b = (model.predict(x, start=start).mean for x in (ds, other))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("baseline", ["state", "mean", same], ids=name)
def test_an_episode_alone_gets_the_bits_it_gets_among_others(baseline):
    ds = tracking(n=6)
    model = small(baseline=baseline).set_params(estimator__max_steps=3).fit(ds)
    together = model.predict(ds, start=4, horizon=30).mean
    for i in range(len(ds)):
        np.testing.assert_array_equal(
            together[i], model.predict(ds[[i]], start=4, horizon=30).mean[0]
        )


@pytest.mark.parametrize("baseline", ["state", "mean", same], ids=name)
def test_planning_agrees_with_forecasting(baseline):
    ds = tracking(n=6)
    model = small(baseline=baseline).set_params(estimator__max_steps=20).fit(ds)
    i, start, horizon = 3, 5, 20
    logged = model.predict(ds[[i]], start=start, horizon=horizon).mean[0]
    at = ds[i]
    phase = at.times[start] - ds.time_origin[i]
    known = {
        "params": ds.params[i],
        "context": {"kind": ds.context["kind"][i]},
        "phase": phase,
        "horizons": DT * np.arange(1, horizon + 1),
    }
    path = model.predict_trajectory(
        at.states[start], references=at.references[start : start + horizon + 1], **known
    )
    np.testing.assert_allclose(path.mean[0], logged, atol=1e-6)
    exact = model.predict_trajectory(
        at.states[start], references=lambda t: np.sin(2 * (phase + t))[:, None], **known
    )
    # the log is linear between samples, the function is not
    np.testing.assert_allclose(exact.mean[0], logged, atol=1e-2)
    far = model.predict_trajectory(
        at.states[start],
        references=lambda t: np.sin(2 * (phase + t))[:, None],
        **(known | {"horizons": [DT * horizon]}),
    )
    np.testing.assert_allclose(far.mean[0, 0], exact.mean[0, -1], atol=1e-9)


def test_a_new_reference_and_new_gains_change_the_forecast():
    ds = tracking()
    model = small(baseline=same).fit(ds)
    usual = model.predict(ds).mean
    higher = model.predict(ds.assign(references=[e.references + 1 for e in ds])).mean
    quick = ds.params[:, 0] > 1.5
    assert np.abs((higher - usual)[quick, 39] - 1).max() < 0.25
    slow, fast = (model.predict(ds.assign(params=[k]), horizon=20).mean for k in (0.6, 2.9))
    left = [np.abs(path[:, 19] - ds.references[ds.state_rows(20)]).mean() for path in (slow, fast)]
    assert left[1] < 0.6 * left[0]


def test_missing_signals_are_named():
    ds = tracking(n=4)
    model = small(baseline=same).set_params(estimator__max_steps=2).fit(ds)
    plan = {"params": [1.0], "horizons": [DT]}
    with pytest.raises(MissingFieldError, match="references"):
        model.predict_trajectory([0.0], context={"kind": "a"}, phase=0.0, **plan)
    still = {"references": np.zeros((2, 1)), **plan}
    with pytest.raises(MissingFieldError, match="give phase="):
        model.predict_trajectory([0.0], context={"kind": "a"}, **still)
    with pytest.raises(ValueError, match="must be a number"):
        model.predict_trajectory([0.0], context={"kind": "a"}, phase="early", **still)
    with pytest.raises(MissingFieldError, match="kind"):
        model.predict_trajectory([0.0], phase=0.0, **still)
    with pytest.raises(ValueError, match="did not see"):
        model.predict_trajectory([0.0], phase=0.0, context={"kind": "z"}, **still)
    with pytest.raises(MissingFieldError, match="references"):
        model.predict(ds.assign(references=None))
    with pytest.raises(MissingFieldError, match="references"):
        small(baseline=same).fit(ds.assign(references=None))


def test_baselines_that_make_no_sense_are_refused():
    ds = tracking(n=4)
    with pytest.raises(ValueError, match="two groups"):
        small(baseline="mean").fit(ds, groups=np.zeros(4))
    with pytest.raises(ValueError, match="sample_weight"):
        small(baseline="mean").fit(ds, sample_weight=np.arange(4))
    with pytest.raises(ValueError, match="expected"):
        small(baseline=lambda r: np.zeros((len(r), 3))).fit(ds)
    with pytest.raises(ValueError, match="needs episodes"):
        small(baseline="mean").fit(np.ones((4, 3)), np.ones(4))
    with_actions = ds.assign(actions=[np.zeros((t, 1)) for t in ds.lengths])
    with pytest.raises(ValueError, match="logged actions"):
        small(baseline=OneStepRegressor(LinearRegression())).fit(with_actions)
    with pytest.raises(ValueError, match=r'inputs=\("action", "references"\)'):
        OneStepRegressor(LinearRegression(), baseline=same).fit(with_actions)
    with pytest.raises(NotFittedError):
        small(baseline=FrozenEstimator(MeanEpisodeForecaster())).fit(ds)
    with pytest.raises(ValueError, match=r"context \{'kind': 'b'\}"):
        small(baseline="mean").fit(ds[[0, 1, 2]])
    with pytest.raises(ValueError, match="diverged on training"):
        small(baseline=lambda r: np.full_like(r, np.inf)).fit(ds)
    with pytest.raises(ValueError, match="no training episode"):
        MeanEpisodeForecaster().fit(ds[[0, 2]]).predict(ds)
    with pytest.raises(ValueError, match="uncertainty"):
        HoldForecaster().fit(ds).predict(ds, return_std=True)


@pytest.mark.parametrize("baseline", ["mean", same, HoldForecaster()], ids=name)
def test_saved_and_read_again(baseline, tmp_path):
    ds = tracking(n=6)
    model = small(baseline=baseline).set_params(estimator__max_steps=3).fit(ds)
    model.save(tmp_path / "t.safetensors")
    again = load(tmp_path / "t.safetensors", callables={"same": same})
    np.testing.assert_array_equal(again.predict(ds).mean, model.predict(ds).mean)


def irregular(n=6, seed=0):
    """`tracking` with every step of the log a little shorter or longer."""
    ds, rng = tracking(n, seed=seed), np.random.default_rng(seed)
    times = [e.times + np.r_[0.0, rng.uniform(-0.2, 0.2, len(e)) * DT] for e in ds]
    return ds.assign(times=times)


def test_an_episode_is_as_good_alone_as_among_others_where_times_are_irregular():
    ds = irregular()
    model = TrajectoryRegressor(LinearRegression(), baseline=HoldForecaster(), random_state=0)
    together = model.fit(ds).predict(ds).mean
    alone = model.predict(ds[[2]]).mean[0]
    np.testing.assert_allclose(together[2, : len(alone)], alone, atol=1e-12)


def test_forecasts_end_where_the_baseline_does():
    ds = tracking(n=6)
    blocks = SubtrajectoryRelabeler(inputs=["state", "horizon", "params"])
    model = TrajectoryRegressor(
        LinearRegression(), relabeler=blocks, baseline=same, random_state=0
    ).fit(ds)
    np.testing.assert_array_equal(model.predict(ds, horizon=80).lengths, ds.lengths)
    free = model.set_params(baseline="mean").fit(ds)
    with pytest.warns(HorizonWarning):
        assert (free.predict(ds, horizon=80).lengths == 80).all()


def test_a_baseline_that_diverges_spoils_its_own_episode_alone():
    ds = tracking(n=6)

    def state_of(references):
        return np.where(references > 40, np.inf, references)

    model = TrajectoryRegressor(LinearRegression(), baseline=state_of, random_state=0).fit(ds)
    far = [episode.references.copy() for episode in ds]
    far[1][20:] = 50
    other = ds.assign(references=far)
    np.testing.assert_array_equal(
        model.predict(other, horizon=10).mean, model.predict(ds, horizon=10).mean
    )
    with pytest.warns(DivergenceWarning):
        forecast = model.predict(other)
    assert forecast.diverged_at.tolist() == [0, 20, 0, 0, 0, 0]


def test_planning_relative_to_a_rolled_out_baseline():
    ds = tracking(n=8)
    closed = OneStepRegressor(LinearRegression(), inputs="params")
    model = TrajectoryRegressor(LinearRegression(), baseline=closed, random_state=0).fit(ds)
    i = 2
    phase = ds.times[ds.offsets[i]] - ds.time_origin[i]
    path = model.predict_trajectory(
        ds[i].states[0],
        params=ds.params[i],
        references=lambda t: np.sin(2 * (phase + t))[:, None],
        context={"kind": "a"},
        phase=phase,
        horizons=[4 * DT, 9 * DT],
    )
    logged = model.predict(ds[[i]], horizon=9).mean[0]
    np.testing.assert_allclose(path.mean[0], logged[[3, 8]], atol=1e-9)


def test_one_state_is_meant_for_all_parameters():
    ds = tracking(n=6)
    model = small(baseline="mean").set_params(estimator__max_steps=3).fit(ds)
    known = {"references": np.zeros((3, 1)), "context": {"kind": "a"}, "phase": 0.1}
    rates = [[0.5], [1.0], [2.0]]
    several = model.predict_trajectory([0.3], params=rates, horizons=[DT, 2 * DT], **known).mean
    for rate, path in zip(rates, several):
        one = model.predict_trajectory([0.3], params=rate, horizons=[DT, 2 * DT], **known)
        np.testing.assert_array_equal(path, one.mean[0])


def test_the_phase_of_a_plan_counts_where_no_training_episode_had_an_origin():
    ds = tracking(n=6, shift=False).assign(time_origin=None, context=None)
    model = TrajectoryRegressor(LinearRegression(), baseline="mean", random_state=0).fit(ds)
    plan = {"params": [1.0], "references": np.zeros((2, 1)), "horizons": [DT]}
    early, late = (
        model.predict_trajectory([0.0], phase=phase, **plan).mean[0, 0, 0] for phase in (0.0, 0.7)
    )
    assert abs(late - early) > 0.05


def test_a_fitted_model_goes_by_what_it_was_fitted_with():
    ds = tracking(n=6)
    model = TrajectoryRegressor(LinearRegression(), baseline=same, random_state=0).fit(ds)
    before = model.predict(ds, horizon=9).mean
    np.testing.assert_array_equal(
        model.set_params(baseline=None, gate=None).predict(ds, horizon=9).mean, before
    )


def test_rows_of_a_relative_model_are_refused():
    ds = tracking(n=6)
    model = TrajectoryRegressor(LinearRegression(), baseline=same, random_state=0).fit(ds)
    with pytest.raises(ValueError, match="rows do not say"):
        model.predict(model.relabeler_.fit_resample(ds)[0])


def test_names_of_references_mean_nothing():
    ds = tracking(n=6).assign(reference_names=["baseline r+h"])
    model = TrajectoryRegressor(LinearRegression(), baseline=HoldForecaster(), random_state=0)
    assert np.isfinite(model.fit(ds).predict(ds, horizon=5).mean).all()


def test_forecasters_that_learn_nothing_need_one_episode_and_take_weights():
    ds = tracking(n=2)[[0]]
    for baseline in (HoldForecaster(), same):
        model = TrajectoryRegressor(LinearRegression(), baseline=baseline, random_state=0)
        assert np.isfinite(model.fit(ds, sample_weight=[2.0]).predict(ds).mean).all()
    assert MeanEpisodeForecaster().learns


def test_divergence_is_measured_in_ranges_of_states():
    """Near-perfect tracking in training makes deviations tiny, and an offset no divergence."""
    ds = tracking(n=6)
    perfect = TrajectoryDataset.from_arrays(
        [episode.references + 1e-9 * np.sin(7 * episode.times)[:, None] for episode in ds],
        references=[episode.references for episode in ds],
        params=ds.params,
    )
    model = OneStepRegressor(LinearRegression(), inputs="params", baseline=same).fit(perfect)
    forecast = model.predict(perfect.assign(params=ds.params), horizon=3)
    off = TrajectoryDataset.from_arrays(
        [episode.states + 0.5 for episode in perfect],
        references=[episode.references for episode in ds],
        params=ds.params,
    )
    assert not forecast.diverged_at.any()
    assert not model.predict(off, horizon=3).diverged_at.any()


# -- inputs -------------------------------------------------------------------------------


def test_knots_hold_the_references_between():
    ds = tracking(n=4)
    relabeler = SubtrajectoryRelabeler(
        max_rows=None, n_knots=1, inputs=["state", "horizon", "references"]
    )
    rows, _ = relabeler.fit_resample(ds)
    assert relabeler.get_feature_names_out()[2:].tolist() == ["ref0", "ref0+1/2h", "ref0+h"]
    two = np.isclose(rows[:, 1], 2 * DT)
    begin = np.flatnonzero(two)[0]
    np.testing.assert_allclose(rows[begin, 2:], ds[0].references[:3, 0])
    one = np.isclose(rows[:, 1], DT)
    begin = np.flatnonzero(one)[0]
    assert rows[begin, 3] == pytest.approx(ds[0].references[:2, 0].mean())


def test_knots_follow_the_times_of_an_irregular_log():
    ds = TrajectoryDataset.from_arrays(
        [[[0.0]] * 4], references=[[[0.0], [1.0], [2.0], [9.0]]], times=[[0.0, 1.0, 2.0, 9.0]]
    )
    relabeler = SubtrajectoryRelabeler(
        max_rows=None, n_knots=2, inputs=["state", "horizon", "references"]
    )
    rows, _ = relabeler.fit_resample(ds)
    # the reference is the time
    np.testing.assert_allclose(rows[:, 3] - rows[:, 2], rows[:, 1] / 3, atol=1e-12)
    np.testing.assert_allclose(rows[:, 4] - rows[:, 2], 2 * rows[:, 1] / 3, atol=1e-12)


def test_the_scaler_of_the_phase_changes_the_outcome():
    ds = tracking(n=6)
    model = small().set_params(estimator__max_steps=20)
    default = model.fit(ds).predict(ds).mean
    plain = model.set_params(scaler=BlockScaler()).fit(ds).predict(ds).mean
    assert not np.allclose(default, plain, equal_nan=True)


# -- the previous action ------------------------------------------------------------------


def lagged(n=6, *, seed=0):
    """s' = .8 s + a_{t-1}: an actuator that is one step late."""
    rng = np.random.default_rng(seed)
    actions = rng.normal(size=(n, 20, 1))
    states = np.zeros((n, 21, 1))
    states[:, 0] = rng.normal(size=(n, 1))
    for t in range(20):
        states[:, t + 1] = 0.8 * states[:, t] + actions[:, max(t - 1, 0)]
    return TrajectoryDataset.from_arrays(states, actions=actions)


@pytest.mark.parametrize("start", [0, 4])
def test_a_lagging_actuator_is_identified_with_the_previous_action(start):
    ds = lagged()
    relabeler = TransitionRelabeler(inputs=("state", "action", "previous"))
    model = OneStepRegressor(LinearRegression(), relabeler=relabeler).fit(ds)
    assert model.layout_.columns["previous"] == ("a0-1",)
    assert np.nanmax(model.predict(ds, start=start).squared_errors(ds)) < 1e-20
    blind = OneStepRegressor(LinearRegression()).fit(ds)
    assert np.nanmax(blind.predict(ds, start=start).squared_errors(ds)) > 1e-3


def test_the_previous_action_of_a_policy_is_the_one_it_took():
    ds = lagged()
    relabeler = TransitionRelabeler(inputs=("state", "action", "previous"))
    model = OneStepRegressor(
        LinearRegression(), relabeler=relabeler, policy=lambda s, p, t: 0.5 * s
    ).fit(ds)
    path = model.predict(ds, start=4, horizon=3).mean[:, :, 0]
    s, before = ds.states[ds.state_rows(4)][:, 0], ds.actions.reshape(6, 20)[:, 3]
    for k in range(3):
        s, before = 0.8 * s + before, 0.5 * s
        np.testing.assert_allclose(path[:, k], s, atol=1e-9)


def test_the_previous_action_has_to_be_known():
    with pytest.raises(ValueError, match='"action" is an input'):
        TransitionRelabeler(inputs=("state", "previous")).fit(lagged())
    relabeler = TransitionRelabeler(inputs=("state", "action", "previous"))
    model = OneStepRegressor(
        LinearRegression(), relabeler=relabeler, policy=lambda s, p, t: 0.5 * s
    ).fit(lagged())
    silent = lagged().assign(actions=None)
    assert np.isfinite(model.predict(silent).mean).all()
    with pytest.raises(MissingFieldError, match="before the start"):
        model.predict(silent, start=3)


def test_a_trajectory_model_as_baseline_keeps_the_knots():
    ds = tracking(shift=False)
    inner = small().fit(ds)
    model = small(baseline=FrozenEstimator(inner)).fit(ds)
    asked = []

    def reference(t):
        asked.append(t)
        return np.sin(2 * t)[:, None]

    known = {"params": [1.0], "context": {"kind": "a"}, "phase": 0.0, "horizons": [1.0]}
    model.predict_trajectory([0.5], references=reference, **known)
    # one far horizon, but three times on the way to it
    np.testing.assert_allclose(np.unique(np.concatenate(asked)), [0, 0.25, 0.5, 0.75, 1.0])
