"""Velocities that nobody logged: found with the step, and with it forecasts of positions."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone

from tests.dynamics.noisy_systems import oscillators
from trajlearn import KalmanSmoother, OneStepRegressor, TrajectoryDataset
from trajlearn.dynamics._denoising.latent_velocities import guessed_velocities, with_velocities
from trajlearn.dynamics._denoising.start_filter import filtered_starts
from trajlearn.dynamics._query import make_query
from trajlearn.exceptions import MissingFieldError
from trajlearn.regressors import polynomial

POSITIONS, TRUE = oscillators()
NOISE = 0.02


def feedback(states, params, times):
    return -(states * params).sum(axis=1, keepdims=True)


def latent(**settings):
    settings = {"latent_velocities": True, "random_state": 0, "policy": feedback} | settings
    return OneStepRegressor(polynomial(3), **settings)


@pytest.fixture(scope="module")
def model():
    return latent().fit(POSITIONS)


@pytest.fixture(scope="module")
def noisy_model():
    return latent().fit(oscillators(40, noise=NOISE)[0])


def error(model, ds, true, **settings):
    """Root mean square error of forecasts of positions."""
    start = settings.get("start", 0)
    mean = model.predict(ds, **settings).mean[..., 0]
    truth = np.stack([episode.states[start + 1 :, 0] for episode in true])
    return np.sqrt(np.mean((mean - truth) ** 2))


def test_velocities_are_found_without_noise(model):
    smooth = model.smooth(POSITIONS)
    assert smooth.state_names == ("x", "d_x")
    np.testing.assert_array_equal(smooth.observed, POSITIONS.states)
    np.testing.assert_allclose(smooth.states[:, 0], TRUE.states[:, 0], atol=1e-6)
    assert np.sqrt(np.mean((smooth.states[:, 1] - TRUE.states[:, 1]) ** 2)) < 0.01
    assert not model.noisy_
    assert model.measurement_noise_.shape == (1,)
    assert model.process_noise_.shape == (2,)


def test_forecasts_are_of_positions_and_good(model):
    test, true = oscillators(20, seed=1)
    forecast = model.predict(test, return_std=True, n_samples=3, random_state=0)
    assert forecast.mean.shape == forecast.std.shape == (20, 60, 1)
    assert forecast.samples.shape == (3, 20, 60, 1)
    assert forecast.state_names == ("x",)
    # of the first velocity nothing but its spread of 0.1 is known; after a few steps it is
    late = error(model, test, true, start=5)
    assert late < 0.01
    assert late < 0.5 * error(model, test, true)
    without = OneStepRegressor(polynomial(3), inputs="params", clip_states=1.2).fit(POSITIONS)
    assert error(model, test, true) < 0.5 * error(without, test, true)


def test_std_is_that_of_the_unknown_velocity(model):
    test, true = oscillators(60, seed=2)
    forecast = model.predict(test, return_std=True, horizon=8, random_state=0)
    truth = np.stack([episode.states[1:9, 0] for episode in true])
    z = (forecast.mean[..., 0] - truth) / forecast.std[..., 0]
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3


def test_the_policy_is_cloned_on_the_whole_state():
    model = latent(policy="clone").fit(POSITIONS)
    test, true = oscillators(20, seed=1)
    assert error(model, test, true, start=5) < 0.01
    states = np.array([[0.3, -0.2]])
    np.testing.assert_allclose(model.policy_(states, [[2.0, 1.0]], [0.0]), [[-0.4]], atol=0.02)


def test_noise_and_velocities_together(noisy_model):
    assert noisy_model.noisy_
    assert noisy_model.measurement_noise_[0] == pytest.approx(NOISE, rel=0.1)
    ds, true = oscillators(40, noise=NOISE)
    smooth = noisy_model.smooth(ds)
    off = np.sqrt(np.mean((smooth.states - true.states) ** 2, axis=0))
    assert off[0] < 0.6 * NOISE
    # differences of noisy positions are off by 0.28
    assert off[1] < 0.08
    test, true = oscillators(20, seed=1, noise=NOISE)
    assert error(noisy_model, test, true, start=10) < 0.06


def test_what_comes_after_the_start_changes_nothing(noisy_model):
    test, _ = oscillators(5, seed=1, noise=NOISE)
    states = np.stack([episode.states for episode in test])
    actions = np.stack([episode.actions for episode in test])
    states[:, 8:], actions[:, 7:] = 1e20, -1e20
    spoilt = TrajectoryDataset.from_arrays(
        states, actions=actions, params=test.params, dt=0.1, state_names=["x"]
    )
    settings = {"start": 7, "return_std": True, "random_state": 0}
    clean, after = (noisy_model.predict(ds, **settings) for ds in (test, spoilt))
    np.testing.assert_array_equal(clean.mean, after.mean)
    np.testing.assert_array_equal(clean.std, after.std)


def test_divergence_is_told_by_the_whole_state(model):
    unstable = clone(model).set_params(policy=lambda s, p, t: 30.0 * s[:, 1:]).fit(POSITIONS)
    with pytest.warns(match="diverged"):
        forecast = unstable.predict(POSITIONS)
    assert np.isinf(forecast.mean[:, -1]).all()


def test_a_fit_on_smoothed_episodes_is_of_positions_too(model):
    fold = latent()._fit_smoothed(model.smooth(POSITIONS)[:15], model.noise_)
    assert fold.state_names_ == ("x",)
    assert fold.state_range_.shape == (2, 1)
    np.testing.assert_allclose(
        fold.predict(POSITIONS[15:]).mean, model.predict(POSITIONS[15:]).mean, atol=0.05
    )


def test_positions_that_were_smoothed_before_get_velocities_too(model):
    smoothed = KalmanSmoother().fit_transform(oscillators(noise=NOISE)[0])
    assert smoothed.hindsight
    assert model.smooth(smoothed).state_names == ("x", "d_x")
    cloned = latent(policy="clone").fit(smoothed)
    # the velocity counts, which a clone of positions would not know
    ahead = cloned.policy_(np.array([[0.3, 0.0], [0.3, -0.2]]), [[2.0, 1.0]] * 2, [0.0, 0.0])
    assert ahead[1, 0] - ahead[0, 0] == pytest.approx(0.2, abs=0.1)


def test_a_position_that_never_changes_does_no_harm():
    ds, _ = oscillators(10, noise=NOISE)
    still = TrajectoryDataset.from_arrays(
        [np.column_stack([e.states, np.ones(e.length + 1)]) for e in ds],
        actions=[e.actions for e in ds],
        dt=0.1,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        model = latent(rollout_actions="logged", policy=None).fit(still)
    assert model.noisy_
    assert model.measurement_noise_[0] == pytest.approx(NOISE, rel=0.2)
    np.testing.assert_allclose(model.smooth(still).states[:, [1, 3]], [[1.0, 0.0]] * 610, atol=1e-9)
    np.testing.assert_allclose(model.predict(still, start=5).mean[..., 1], 1.0, atol=1e-3)


def test_a_position_that_never_changes_is_not_noisy():
    still = TrajectoryDataset.from_arrays(
        [np.column_stack([e.states, np.full(e.length + 1, 0.1)]) for e in POSITIONS],
        actions=[e.actions for e in POSITIONS],
        dt=0.1,
    )
    model = latent(rollout_actions="logged", policy=None).fit(still)
    assert not model.noisy_
    assert (model.measurement_noise_ < 1e-4).all()


def test_of_two_positions_both_are_forecast_from_filtered_starts():
    rng = np.random.default_rng(0)
    pushes = rng.normal(size=(20, 30, 2))
    x, v = np.empty((20, 31, 2)), np.zeros((20, 2))
    x[:, 0] = rng.normal(size=(20, 2))
    for t in range(30):
        x[:, t + 1] = x[:, t] + 0.1 * v
        # a spring between them, and one to the wall
        v = v + 0.1 * (pushes[:, t] - 2.0 * x[:, t] + x[:, t, ::-1])
    ds = TrajectoryDataset.from_arrays(x, actions=pushes, dt=0.1)
    model = OneStepRegressor(polynomial(1), latent_velocities=True, random_state=0).fit(ds[:15])
    ahead = model.predict(ds[15:], start=5).mean
    np.testing.assert_allclose(ahead, x[15:, 6:], atol=0.01)
    # read in a fit
    model.set_params(latent_velocities=False)
    np.testing.assert_array_equal(model.predict(ds[15:], start=5).mean, ahead)


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_velocities_of_an_exactly_sampled_plant_are_found(noise):
    # differences of its positions are not its velocities, as they are after a step of Euler's
    frequency, dt, rng = 2.0, 0.1, np.random.default_rng(0)
    c, s = np.cos(frequency * dt), np.sin(frequency * dt)
    step = np.array([[c, s / frequency], [-frequency * s, c]])
    pushed = np.array([(1 - c) / frequency**2, s / frequency])
    actions = rng.normal(size=(40, 60, 1))
    states = np.empty((40, 61, 2))
    states[:, 0] = rng.normal(size=(40, 2))
    for t in range(60):
        states[:, t + 1] = states[:, t] @ step.T + pushed * actions[:, t]
    seen = states[..., :1] + noise * rng.normal(size=(40, 61, 1))
    ds = TrajectoryDataset.from_arrays(seen, actions=actions, dt=dt)
    model = OneStepRegressor(polynomial(1), latent_velocities=True, random_state=0).fit(ds[:20])
    assert model.noisy_ == bool(noise)
    found = model.smooth(ds[:20]).states[:, 1]
    # from noisy positions its scale is not known as well as the rest
    assert np.corrcoef(found, states[:20, :, 1].ravel())[0, 1] > (0.995 if noise else 0.9999)
    ahead = model.predict(ds[20:], start=10, horizon=20, actions="logged").mean[..., 0]
    error = np.sqrt(np.mean((ahead - states[20:, 11:31, 0]) ** 2))
    assert error < (0.03 if noise else 0.01)  # of 0.6


def test_what_is_set_after_a_fit_changes_no_fitted_step(model):
    again = clone(model).fit(POSITIONS[:10]).set_params(latent_velocities=False)
    assert again.predict(POSITIONS[:2], start=3).mean.shape == (2, 57, 1)
    assert again.smooth(POSITIONS[:2]).state_names == ("x", "d_x")
    without = OneStepRegressor(polynomial(1)).fit(POSITIONS[:10])
    before = without.predict(POSITIONS[:2], start=3).mean
    without.set_params(latent_velocities=True)
    np.testing.assert_array_equal(without.predict(POSITIONS[:2], start=3).mean, before)


@pytest.mark.parametrize(("surprise", "elsewhere"), [(14.0, False), (16.5, True)])
def test_a_start_is_judged_by_what_is_measured(noisy_model, surprise, elsewhere):
    # a chi-squared number of one degree of freedom is above 15.1 once in 10,000
    noise = noisy_model.noise_
    total = noise.start_covariance[0, 0] + noise.measurement[0]
    x = noise.start_mean[0] + np.sqrt(surprise * total)
    ds = TrajectoryDataset.from_arrays([[[x], [x]]], actions=[[[0.0]]], dt=0.1)
    query, _ = make_query(with_velocities(ds), 0, 1, within_log=True, within_stretch=False)
    _, covariance = filtered_starts(noisy_model, query, noise)
    known = noise.spread[1] if elsewhere else noise.start_covariance[1, 1]
    assert covariance[0, 1, 1] == pytest.approx(known, rel=0.3)


def test_guesses_are_differences_within_episodes():
    ds = TrajectoryDataset.from_arrays(
        [[[0.0], [1.0], [4.0]], [[5.0], [3.0]]], times=[[0.0, 1.0, 2.0], [0.0, 0.5]]
    )
    rates = with_velocities(ds).states[:, 1]
    np.testing.assert_allclose(rates, [1.0, 3.0, 3.0, -4.0, -4.0])
    guesses, variance = guessed_velocities(POSITIONS)
    forward, central = (guess.states[:61, 1] for guess in guesses)
    x = POSITIONS.states[:61, 0]
    np.testing.assert_allclose(forward[:-1], np.diff(x) / 0.1, atol=1e-4)
    np.testing.assert_allclose(central[1:-1], (x[2:] - x[:-2]) / 0.2, atol=1e-4)
    assert variance.shape == (1,)


@pytest.mark.parametrize(
    ("settings", "fit", "message"),
    [
        ({"latent_velocities": "yes"}, {}, "latent_velocities"),
        ({"baseline": "mean", "inputs": "params"}, {}, "knows no velocities"),
        ({"history": 3}, {}, "history=3"),
        ({}, {"sample_weight": np.ones(20)}, "latent_velocities=True takes all"),
        # the log does not tell which velocities the controller acted on
        ({"policy_sees": "measurements"}, {}, "which velocities the controller acted on"),
    ],
)
def test_what_cannot_be_is_refused(settings, fit, message):
    with pytest.raises(ValueError, match=message):
        latent(**settings).fit(POSITIONS, **fit)


def test_velocities_among_the_states_are_refused():
    with pytest.raises(ValueError, match="the states have d_x beside x"):
        latent().fit(latent().fit(POSITIONS[:10]).smooth(POSITIONS[:10]))


def test_single_steps_are_refused():
    with pytest.raises(ValueError, match="two steps or more"):
        latent().fit(POSITIONS.truncate(1))


def test_rows_are_refused_and_actions_are_needed():
    with pytest.raises(ValueError, match="needs episodes"):
        latent().fit(np.zeros((9, 3)), np.zeros((9, 1)))
    with pytest.raises(MissingFieldError):
        latent().fit(TrajectoryDataset.from_arrays([e.states for e in POSITIONS]))
