"""One-step models: exact on linear systems, aligned, rolled out as asked."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import FunctionTransformer

from tests.dynamics.systems import (
    SMALL,
    A,
    Affine,
    B,
    closed_loop,
    gain_policy,
    linear,
    quadratic,
    truth,
)
from trajlearn import BlockScaler, OneStepRegressor, TrajectoryDataset, TransitionRelabeler
from trajlearn.exceptions import DivergenceWarning, MissingFieldError, MixedSamplingError

IDENTITY = FunctionTransformer()


def ols(**settings):
    return OneStepRegressor(LinearRegression(), **settings)


def mlp(**settings):
    return OneStepRegressor(random_state=0).set_params(**SMALL | settings)


def test_a_linear_system_is_identified_exactly_from_ragged_episodes():
    model = ols(scaler=IDENTITY, target="state").fit(linear())
    columns = np.vstack([model.estimator_.coef_ * model.target_scale_[:, None]])
    np.testing.assert_allclose(columns, np.hstack([A, B]), atol=1e-12)
    test = linear(5, seed=1)
    np.testing.assert_allclose(model.predict(test), truth(test), atol=1e-10)


def test_actions_that_are_off_by_one_are_noticed():
    ds, test = linear(), linear(5, seed=1)

    def late(ds):
        shifted = [np.roll(episode.actions, 1, axis=0) for episode in ds]
        return TrajectoryDataset.from_arrays([e.states for e in ds], actions=shifted)

    assert ols().fit(ds).score(test) > -1e-20
    assert ols().fit(late(ds)).score(late(test)) < -1e-4


@pytest.mark.parametrize(
    ("constructor", "call", "source"),
    [
        ({}, {}, "logged"),
        ({"policy": gain_policy}, {}, "policy"),
        ({"policy": gain_policy, "rollout_actions": "logged"}, {}, "logged"),
        ({"policy": gain_policy}, {"actions": "logged"}, "logged"),
        ({}, {"policy": gain_policy}, "policy"),
        ({"rollout_actions": "logged"}, {"policy": gain_policy, "actions": "policy"}, "policy"),
    ],
)
def test_the_source_of_actions_is_chosen_and_recorded(constructor, call, source):
    ds = linear(4, seed=2)
    model = ols(**constructor).fit(linear())
    forecast = model.predict(ds, **call)
    assert forecast.actions == source
    state, expected = ds[0].states[0], []
    for t in range(ds[0].length):
        action = ds[0].actions[t] if source == "logged" else -ds[0].params @ state[:, None]
        state = A @ state + B @ action
        expected.append(state)
    np.testing.assert_allclose(forecast.mean[0, : ds[0].length], expected, atol=1e-10)


def test_a_policy_sees_state_theta_and_time_at_the_start_of_the_step():
    times = [2.0 + 0.5 * np.arange(7)] * 3
    base = linear(3, shortest=6, longest=6)
    ds = TrajectoryDataset.from_arrays(
        [e.states for e in base],
        actions=[e.actions for e in base],
        params=base.params,
        times=times,
    )
    seen = []

    def policy(states, params, now):
        seen.append((states.shape, params.copy(), now.copy()))
        return np.zeros((len(states), 1))

    ols().fit(ds).predict(ds, start=[0, 1, 2], policy=policy)
    shape, params, now = seen[0]
    assert shape == (3, 2)
    np.testing.assert_array_equal(params, ds.params)
    np.testing.assert_allclose(now, [2.0, 2.5, 3.0])
    assert len(seen) == 6


def test_without_actions_and_policy_the_error_says_what_to_do():
    bare = TrajectoryDataset.from_arrays([e.states for e in linear(3)])
    model = ols().fit(linear())
    with pytest.raises(MissingFieldError, match="policy="):
        model.predict(bare)
    with pytest.raises(ValueError, match="needs a policy"):
        model.predict(linear(3), actions="policy")
    with pytest.raises(MissingFieldError, match="action"):
        ols().fit(bare)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda s, p, t: np.zeros(len(s)), "shape"),
        (lambda s, p, t: np.full((len(s), 1), np.nan), "NaN or infinite actions"),
    ],
)
def test_a_wrong_policy_is_named(policy, message):
    with pytest.raises(ValueError, match=message):
        ols().fit(linear()).predict(linear(3), policy=policy)


def test_actions_of_another_width_are_refused():
    ds = linear(3)
    wide = TrajectoryDataset.from_arrays(
        [e.states for e in ds], actions=[np.hstack([e.actions] * 2) for e in ds]
    )
    with pytest.raises(ValueError, match="2 actions, the model was fitted on 1"):
        ols().fit(ds).predict(wide)


def test_closed_loop_learns_states_and_theta_exactly():
    ds, test = closed_loop(), closed_loop(4, seed=1, steps=15)
    model = OneStepRegressor(quadratic(), inputs="params").fit(ds)
    forecast = model.predict(test)
    assert forecast.actions == "none"
    np.testing.assert_allclose(forecast.mean, truth(test), atol=1e-9)


def test_theta_that_changes_on_the_way_is_followed():
    ds, test = closed_loop(switch=3), closed_loop(4, seed=1, switch=5)
    model = OneStepRegressor(quadratic(), inputs="params").fit(ds)
    np.testing.assert_allclose(model.predict(test), truth(test), atol=1e-9)
    late = model.predict(test, start=6)
    np.testing.assert_allclose(late.mean, truth(test)[:, 6:], atol=1e-9)
    # past the log the last theta stays in force
    beyond = model.predict(test, start=8, horizon=1).mean[:, 0]
    s, theta = np.array([e.states[-1] for e in test]), np.array([e.params[-1] for e in test])
    np.testing.assert_allclose(beyond, s + theta * (0.3 - 0.2 * s) - 0.1 * s, atol=1e-9)


def irregular(seed):
    """s' = s + dt (a - s) at random time steps."""
    rng = np.random.default_rng(seed)
    states, actions, times = [], [], []
    for _ in range(8):
        dt, a = rng.uniform(0.05, 0.2, size=10), rng.normal(size=(10, 1))
        s = [rng.normal(size=1)]
        for t in range(10):
            s.append(s[-1] + dt[t] * (a[t] - s[-1]))
        states.append(s)
        actions.append(a)
        times.append(np.concatenate([[1.0], 1.0 + np.cumsum(dt)]))
    return TrajectoryDataset.from_arrays(states, actions=actions, times=times)


def test_irregular_sampling_needs_the_time_step_as_an_input():
    ds, test = irregular(0), irregular(1)
    with pytest.raises(MixedSamplingError, match="dt"):
        OneStepRegressor(quadratic()).fit(ds)
    model = OneStepRegressor(quadratic(), inputs=("action", "dt")).fit(ds)
    # time steps are rounded to a millionth
    np.testing.assert_allclose(model.predict(test), truth(test), atol=1e-7)
    ahead = model.predict_trajectory(
        test[0].states[0], actions=test[0].actions, horizons=test[0].times[1:] - 1.0
    )
    np.testing.assert_allclose(ahead.mean[0], test[0].states[1:], atol=1e-7)


def test_another_time_step_than_in_training_is_refused():
    fast = TrajectoryDataset.from_arrays(
        [e.states for e in linear(3)], actions=[e.actions for e in linear(3)], dt=0.5
    )
    with pytest.raises(MixedSamplingError, match="steps of 1"):
        ols().fit(linear()).predict(fast)


def test_references_and_context_are_inputs():
    rng = np.random.default_rng(0)
    task = np.array(["slow", "fast"] * 4)
    references = rng.normal(size=(8, 11, 1))
    states = np.zeros((8, 11, 1))
    for t in range(10):
        pull = references[:, t + 1] - references[:, t]
        states[:, t + 1] = 0.5 * states[:, t] + 2 * pull + (task == "fast")[:, None]
    ds = TrajectoryDataset.from_arrays(
        states, references=references, context={"task": task}, params=np.zeros((8, 1))
    )
    model = ols(inputs="params").fit(ds)
    assert list(model.layout_) == ["state", "params", "context", "references"]
    np.testing.assert_allclose(model.predict(ds), states[:, 1:], atol=1e-10)
    with pytest.raises(MissingFieldError, match="no context 'task'"):
        model.predict_trajectory(
            states[:, 0], params=np.zeros(1), references=references[:, :4], horizons=[3]
        )
    wide = TrajectoryDataset.from_arrays(
        states,
        references=np.concatenate([references] * 2, axis=2),
        context={"task": task},
        params=np.zeros((8, 1)),
    )
    with pytest.raises(ValueError, match="2 references, the model was fitted on 1"):
        model.predict(wide)
    odd = TrajectoryDataset.from_arrays(
        states, references=references, context={"task": ["new"] * 8}, params=np.zeros((8, 1))
    )
    with pytest.raises(ValueError, match="'new'"):
        model.predict(odd)


def test_weight_two_is_an_episode_twice_and_weight_zero_none():
    noisy = linear(6).add_noise(0.1, random_state=0)
    test = linear(3, seed=1)
    weight = np.array([2.0, 1, 0, 1, 3, 1])
    repeated = noisy[np.repeat(np.arange(6), weight.astype(int))]
    weighted = ols().fit(noisy, sample_weight=weight).predict(test)
    np.testing.assert_allclose(weighted, ols().fit(repeated).predict(test), atol=1e-10)
    plain = np.asarray(ols().fit(noisy).predict(test))
    assert np.nanmax(np.abs(plain - np.asarray(weighted))) > 1e-4


@pytest.mark.parametrize(
    ("weight", "message"),
    [([1.0, 1], "one finite weight"), (np.zeros(8), "zero everywhere"), (-np.ones(8), ">= 0")],
)
def test_bad_weights_are_refused(weight, message):
    with pytest.raises(ValueError, match=message):
        ols().fit(linear(), sample_weight=weight)


def test_planning_is_forecasting():
    ds = linear(4, seed=3, shortest=8, longest=8)
    model = ols().fit(linear())
    expected = np.asarray(model.predict(ds))
    actions = np.stack([e.actions for e in ds])
    found = model.predict_trajectory(ds.states[::9], actions=actions, horizons=[2, 5, 8])
    np.testing.assert_allclose(found.mean, expected[:, [1, 4, 7]], atol=1e-12)
    assert found.horizons.tolist() == [2, 5, 8]
    by_policy = model.predict_trajectory(
        ds.states[::9], params=ds.params, policy=gain_policy, horizons=[3]
    )
    want = model.predict(ds, policy=gain_policy).mean[:, [2]]
    np.testing.assert_allclose(by_policy.mean, want, atol=1e-12)
    one = model.predict_trajectory(ds[0].states[0], actions=ds[0].actions[:4], horizons=4)
    np.testing.assert_allclose(one.mean, expected[:1, [3]], atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizons": [1.5]}, "multiples of the time step"),
        ({"horizons": [2, 1]}, "strictly increasing"),
        ({"horizons": [0]}, "positive"),
        ({"horizons": [2], "actions": np.zeros((5, 1))}, "actions has shape"),
        ({"horizons": [2], "actions": np.full((2, 1), np.nan)}, "NaN"),
        ({"horizons": [2]}, "needs actions"),
        ({"initial_states": np.zeros((3, 5)), "horizons": [1]}, "initial_states has shape"),
        ({"initial_states": [np.nan, 0], "horizons": [1]}, "NaN"),
    ],
)
def test_bad_plans_are_refused(settings, message):
    settings = {"initial_states": np.zeros(2)} | settings
    with pytest.raises(ValueError, match=message):
        ols().fit(linear()).predict_trajectory(**settings)


def test_rows_fit_a_model_that_rolls_out():
    ds = linear()
    rows, targets = TransitionRelabeler().fit_resample(ds)
    by_rows, by_episodes = ols().fit(rows, targets), ols().fit(ds)
    test = linear(4, seed=1)
    np.testing.assert_allclose(by_rows.predict(test), by_episodes.predict(test), atol=1e-9)
    np.testing.assert_allclose(by_rows.predict(rows), targets, atol=1e-10)
    one = ols().fit(rows, targets[:, 0])
    assert one.predict(rows).shape == (len(rows),)


def test_clipped_states_stay_in_a_multiple_of_the_training_range():
    grow = Affine(slope=0.0, offset=1.0)  # every step adds one standard deviation of the change
    ds = linear(shortest=12)
    with_clip = OneStepRegressor(grow, clip_states=1.5).fit(ds)
    low, high = with_clip.state_range_
    centre, half = (low + high) / 2, 0.75 * (high - low)
    mean = with_clip.predict(ds, horizon=12).mean
    assert (mean <= centre + half + 1e-12).all()
    assert np.isclose(mean.max(axis=(0, 1)), centre + half).all()
    free = OneStepRegressor(grow).fit(ds).predict(ds, horizon=12).mean
    assert (free.max(axis=(0, 1)) > centre + half).all()


def test_an_exploding_model_scores_below_a_poor_but_stable_one():
    class Exploding(Affine):
        """Good for two steps, then beyond all numbers."""

        calls = 0

        def predict(self, X):
            type(self).calls += 1
            return super().predict(X) * (1e300 if type(self).calls == 3 else 1.0)

    ds = linear(6, shortest=8)
    poor = OneStepRegressor(Affine(slope=0.0, offset=2.0)).fit(ds)
    exploding = OneStepRegressor(Exploding(slope=1.0)).fit(ds)
    Exploding.calls = 0
    with pytest.warns(DivergenceWarning) as caught:
        forecast = exploding.predict(ds)
    assert len(caught) == 1
    assert (forecast.diverged_at == 3).all()
    assert np.isfinite(forecast.mean[:, :2]).all()
    known = np.arange(forecast.mean.shape[1]) < forecast.lengths[:, None]
    assert np.isposinf(forecast.mean[:, 2:][known[:, 2:]]).all()
    assert np.isnan(forecast.mean[~known]).all()
    Exploding.calls = 0
    with pytest.warns(DivergenceWarning):
        assert exploding.score(ds) == -1e12
    assert -1e12 < poor.score(ds) < -0.01


def test_error_score_is_what_a_diverged_episode_counts():
    ds = linear(4)
    far = TrajectoryDataset.from_arrays(
        [e.states * (1e9 if i == 0 else 1) for i, e in enumerate(ds)],
        actions=[e.actions for e in ds],
    )
    with pytest.warns(DivergenceWarning):
        assert np.isclose(ols(error_score=-40.0).fit(ds).score(far), -10.0)


@pytest.mark.parametrize("std", [0.5, 0.0])
@pytest.mark.parametrize("propagation", ["tsinf", "ts1", "expectation"])
def test_std_of_a_linear_gaussian_system_is_the_closed_form(std, propagation):
    # s' = 0.8 s + noise: the change is learned as -0.2 s, in units of target_scale_
    ds = TrajectoryDataset.from_arrays(
        [0.8 ** np.arange(12)[:, None] * s for s in (1.0, 2.0, -1.5)], actions=np.zeros((3, 11, 1))
    )
    model = OneStepRegressor(
        Affine(std=std), scaler=IDENTITY, propagation=propagation, n_particles=4000
    ).fit(ds)
    model.estimator_.slope = -0.2 / model.target_scale_[0]
    noise = std * model.target_scale_[0]
    forecast = model.predict(ds, return_std=True, random_state=0)
    np.testing.assert_allclose(forecast.mean, truth(ds), atol=1e-12)
    expected = noise * np.sqrt(np.cumsum(0.8 ** (2 * np.arange(11))))
    np.testing.assert_allclose(
        forecast.std[:, :, 0], np.tile(expected, (3, 1)), rtol=0.05, atol=1e-12
    )


def test_feedback_damps_the_noise_of_every_particle():
    # open loop s' = s + a + noise; a = -0.5 s makes it s' = 0.5 s + noise
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(4, 20, 1))
    states = np.concatenate([np.zeros((4, 1, 1)), np.cumsum(actions, axis=1)], axis=1)
    ds = TrajectoryDataset.from_arrays(states, actions=actions)

    class Integrator(Affine):
        def predict(self, X, return_std=False):
            return (X[:, 1:], np.full((len(X), 1), self.std)) if return_std else X[:, 1:]

    model = OneStepRegressor(Integrator(std=0.3), scaler=IDENTITY, n_particles=3000).fit(ds)
    model.target_scale_ = np.ones(1)
    settings = {"return_std": True, "random_state": 0, "horizon": 15}
    open_loop = model.predict(ds, **settings).std[0, :, 0]
    closed = model.predict(ds, policy=lambda s, p, t: -0.5 * s, **settings).std[0, :, 0]
    np.testing.assert_allclose(open_loop, 0.3 * np.sqrt(np.arange(1, 16)), rtol=0.06)
    expected = 0.3 * np.sqrt(np.cumsum(0.25 ** np.arange(15)))
    np.testing.assert_allclose(closed, expected, rtol=0.06)


def test_learners_without_std_have_no_uncertainty():
    with pytest.raises(ValueError, match="no standard deviation"):
        ols().fit(linear()).predict(linear(), return_std=True)


def _forecast(model, **settings):
    test = linear(5, seed=1)
    fitted = model.fit(linear(10))
    forecast = fitted.predict(test, return_std=True, random_state=0, **settings)
    return np.concatenate([forecast.mean, forecast.std])


@pytest.mark.parametrize(
    "change",
    [
        {"estimator": Affine(0.1, std=0.1)},
        {"estimator__activation": "tanh"},
        {"relabeler": TransitionRelabeler(max_rows=20)},
        {"relabeler__max_rows": 20},
        {"scaler": BlockScaler(state="passthrough")},
        {"scaler__state": "passthrough"},
        {"inputs": "params"},
        {"target": "state"},
        {"policy": gain_policy},
        {"policy": gain_policy, "rollout_actions": "policy"},
        {"clip_states": 0.2},
        {"propagation": "ts1"},
        {"propagation": "expectation"},
        {"propagation": "moment"},
        {"propagation": "unscented"},
        {"n_particles": 20},
        {"random_state": 1},
    ],
    ids=lambda change: "+".join(f"{k}={v}" if k == "propagation" else k for k, v in change.items()),
)
def test_every_parameter_changes_the_forecast(change):
    members = {"estimator__n_members": 3}
    if "estimator" in change:
        changed = OneStepRegressor(random_state=0).set_params(**change)
    else:
        changed = mlp(**members | change)
    assert not np.array_equal(_forecast(mlp(**members)), _forecast(changed), equal_nan=True)


def test_rollout_actions_can_overrule_a_policy():
    both = mlp(policy=gain_policy, rollout_actions="logged")
    np.testing.assert_array_equal(_forecast(mlp()), _forecast(both))


def test_own_parameters_are_set_before_those_of_the_defaults_that_use_them():
    model = OneStepRegressor().set_params(relabeler__max_rows=30, inputs="params")
    assert model.relabeler.inputs == "params"
    assert model.relabeler.max_rows == 30
    assert OneStepRegressor().get_params()["relabeler__inputs"] == "action"


def test_members_differ_in_the_std_and_the_mean_averages_them_at_every_step():
    ds = linear(10)
    model = mlp(estimator__n_members=3).fit(ds)
    rows, _ = model.relabeler_.fit_resample(ds)
    first = rows[ds.offsets[:-1] - np.arange(len(ds))]
    mean, std = model.predict(first, return_std=True)
    forecast = model.predict(ds, return_std=True, random_state=0)
    np.testing.assert_allclose(forecast.mean[:, 0], mean, atol=1e-9)
    # 50 particles estimate one step's std to a tenth
    assert 0.7 < np.median(forecast.std[:, 0] / std) < 1.3
