"""Errors-in-variables training: noise that is told, slopes that are right, honest starts."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

from tests.dynamics.noisy_systems import STD, A, B, noisy_linear
from trajlearn import (
    BlockScaler,
    GPRegressor,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
    TransitionRelabeler,
    load,
)
from trajlearn.dynamics._denoising import errors_in_variables
from trajlearn.dynamics._denoising.errors_in_variables import Smoother
from trajlearn.exceptions import MissingFieldError
from trajlearn.regressors import polynomial

MEASURED, TRUE = noisy_linear()
SMALL_NETWORK = MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=60)


def denoised(learner=None, **settings):
    settings = {"denoise": "em", "random_state": 0} | settings
    return OneStepRegressor(learner or LinearRegression(), **settings)


@pytest.fixture(scope="module")
def model():
    return denoised().fit(MEASURED)


def matrix(model):
    """Slopes of the step in state and action (2, 3)."""
    rows = np.vstack([np.zeros(3), np.eye(3)])
    ahead = model.predict(rows)
    return (ahead[1:] - ahead[0]).T


def off(model):
    return np.abs(matrix(model) - np.hstack([A, B])).max()


def same(forecast, other):
    np.testing.assert_array_equal(np.asarray(forecast), np.asarray(other))


# -- noise --------------------------------------------------------------------------------


def test_noise_and_slopes_of_a_linear_system_are_found(model):
    assert model.noisy_
    np.testing.assert_allclose(model.measurement_noise_, STD, rtol=0.05)
    assert (model.process_noise_ < 0.1 * STD).all()
    assert off(model) < 0.01 < 0.1 < off(denoised(denoise=None).fit(MEASURED))


def test_process_noise_is_told_from_measurement_noise():
    process = np.array([0.15, 0.2])
    model = denoised().fit(noisy_linear(100, process=process)[0])
    np.testing.assert_allclose(model.measurement_noise_, STD, rtol=0.08)
    np.testing.assert_allclose(model.process_noise_, process, rtol=0.12)
    assert off(model) < 0.05


def test_one_noisy_state_is_enough():
    model = denoised().fit(noisy_linear(measurement=(0.3, 0.0))[0])
    assert model.noisy_
    assert model.measurement_noise_[0] == pytest.approx(0.3, rel=0.05)
    assert model.measurement_noise_[1] < 0.02


def test_polynomials_and_networks_find_it_too():
    network = MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=300, n_members=2)
    for learner in (polynomial(2), network):
        model = denoised(learner).fit(MEASURED)
        np.testing.assert_allclose(model.measurement_noise_, STD, rtol=0.06)
    # the rounds are short trainings of one member; what is fitted last is what was asked for
    assert model.estimator_.get_params() == model.estimator_.get_params() | network.get_params() | {
        "random_state": model.estimator_.random_state
    }


def test_closed_loop_models_are_denoised():
    rng = np.random.default_rng(0)
    gains = rng.uniform(0.1, 0.4, size=(40, 1))
    states = np.empty((40, 41, 1))
    states[:, 0, 0] = rng.normal(size=40)
    for t in range(40):
        states[:, t + 1] = states[:, t] - gains * (states[:, t] - 0.5)
    noisy = states + 0.05 * rng.normal(size=states.shape)
    ds = TrajectoryDataset.from_arrays(noisy, params=gains)
    model = denoised(polynomial(2), inputs="params").fit(ds)
    assert model.measurement_noise_[0] == pytest.approx(0.05, rel=0.05)
    raw = denoised(polynomial(2), inputs="params", denoise=None).fit(ds)
    test = TrajectoryDataset.from_arrays(states, params=gains)
    assert model.score(test) > 0.2 * raw.score(test)
    # its filter reads no actions, so none are needed before a start
    assert model.predict(test, start=9).mean.shape == (40, 31, 1)


# -- no noise: nothing is done ------------------------------------------------------------


@pytest.mark.parametrize("process", [0.0, 0.2])
@pytest.mark.parametrize("kind", ["linear", "network"])
def test_without_measurement_noise_it_is_the_same_model_to_the_bit(process, kind):
    quiet, _ = noisy_linear(8, measurement=0.0, process=process)
    learner = LinearRegression()
    if kind == "network":
        learner = MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=80, probabilistic=True)
    with_it, without = (denoised(learner, denoise=d).fit(quiet) for d in ("em", None))
    assert not with_it.noisy_
    assert (with_it.measurement_noise_ == 0).all()
    if process:
        np.testing.assert_allclose(with_it.process_noise_, process, rtol=0.2)
    same(with_it.predict(quiet), without.predict(quiet))
    assert with_it.smooth(quiet) is quiet
    assert not hasattr(without, "noisy_")
    if kind == "network":
        same(
            with_it.predict(quiet, return_std=True, random_state=1).std,
            without.predict(quiet, return_std=True, random_state=1).std,
        )


def test_a_learner_that_misses_something_is_not_noise():
    rng = np.random.default_rng(0)
    states = np.empty((20, 41, 1))
    states[:, 0, 0] = rng.uniform(-2, 2, size=20)
    for t in range(40):
        states[:, t + 1] = states[:, t] - 0.1 * states[:, t] ** 3
    ds = TrajectoryDataset.from_arrays(states, params=np.zeros((20, 1)))
    assert not denoised(polynomial(1), inputs="params").fit(ds).noisy_


# the mean of many 0.1 is not 0.1, so that they seem to vary
@pytest.mark.parametrize("value", [0.0, 1.5, 0.1])
@pytest.mark.parametrize("learner", [None, SMALL_NETWORK], ids=["linear", "network"])
def test_a_state_that_never_changes_does_no_harm(value, learner):
    states = [np.column_stack([e.states, np.full(e.length + 1, value)]) for e in MEASURED]
    ds = TrajectoryDataset.from_arrays(states, actions=[e.actions for e in MEASURED])
    model = denoised(learner).fit(ds)
    np.testing.assert_allclose(model.measurement_noise_[:2], STD, rtol=0.06)
    assert model.measurement_noise_[2] < 1e-6
    assert (model.smooth(ds).states[:, 2] == value).all()
    assert np.isfinite(model.predict(ds[:1], return_std=True, start=5, random_state=0).std).all()
    # elsewhere than in training it is where it was measured
    states = ds[0].states + np.array([0.0, 0.0, 5.0])
    other = TrajectoryDataset.from_arrays([states], actions=[ds[0].actions])
    np.testing.assert_allclose(model.predict(other, start=3).mean[0, :, 2], value + 5.0, atol=1e-3)


def test_another_fit_without_it_forgets_the_noise(model):
    again = clone(model).fit(MEASURED).set_params(denoise=None).fit(MEASURED)
    assert not hasattr(again, "noise_")
    same(again.predict(TRUE), denoised(denoise=None).fit(MEASURED).predict(TRUE))


def test_another_fit_on_rows_forgets_the_noise(model):
    rows, targets = TransitionRelabeler().fit_resample(MEASURED)
    again = clone(model).fit(MEASURED).set_params(denoise=None).fit(rows, targets)
    assert not hasattr(again, "noise_")
    same(again.predict(TRUE), denoised(denoise=None).fit(rows, targets).predict(TRUE))


def test_the_same_seed_gives_the_same_bits(model):
    same(denoised().fit(MEASURED).predict(MEASURED), model.predict(MEASURED))


# -- smoothing ----------------------------------------------------------------------------


def test_smoothed_states_are_near_the_true_ones(model):
    smooth = model.smooth(MEASURED)
    error = np.sqrt(np.mean((smooth.states - TRUE.states) ** 2, axis=0))
    assert (error < 0.35 * STD).all()
    assert smooth.hindsight
    np.testing.assert_array_equal(smooth.observed, MEASURED.states)
    assert model.smooth(smooth) is smooth


def test_smoothed_episodes_keep_their_other_fields(model):
    more = MEASURED.assign(
        rewards=[np.arange(e.length) for e in MEASURED], terminated=np.arange(50) % 3 == 0
    )
    smooth = model.smooth(more)
    np.testing.assert_array_equal(smooth.rewards, more.rewards)
    np.testing.assert_array_equal(smooth.terminated, more.terminated)


def test_units_of_states_do_not_matter(model):
    unit = np.array([1e6, 1e-6])
    scaled = TrajectoryDataset.from_arrays(
        [e.states * unit for e in MEASURED], actions=[e.actions for e in MEASURED]
    )
    other = denoised().fit(scaled)
    np.testing.assert_allclose(other.measurement_noise_ / unit, model.measurement_noise_, rtol=0.01)
    np.testing.assert_allclose(
        other.predict(scaled, start=9).mean / unit, model.predict(MEASURED, start=9).mean, atol=0.01
    )


def test_episodes_are_smoothed_as_if_alone(model):
    smooth = model.smooth(MEASURED)
    for i in (0, 7):
        np.testing.assert_allclose(
            model.smooth(MEASURED[[i]]).states, smooth[i].states, rtol=0, atol=1e-9
        )


def test_long_episodes_are_smoothed_in_stretches(model, monkeypatch):
    whole = model.smooth(MEASURED).states
    monkeypatch.setattr(errors_in_variables, "_STRETCH", 25)
    monkeypatch.setattr(errors_in_variables, "_MARGIN", 40)
    monkeypatch.setattr(errors_in_variables, "_CELLS", 300)
    np.testing.assert_allclose(model.smooth(MEASURED).states, whole, rtol=0, atol=0.05 * STD.min())


def test_the_shortest_episodes_are_taken(model):
    short = MEASURED.truncate(1)
    assert model.smooth(short).states.shape == short.states.shape
    mixed = denoised().fit(MEASURED[:25].concatenate(short[:3]))
    np.testing.assert_allclose(mixed.measurement_noise_, STD, rtol=0.08)
    assert not denoised().fit(short[:3]).noisy_


def test_a_fit_on_smoothed_episodes_needs_no_rounds(model, monkeypatch):
    smoother = Smoother(model, MEASURED, 2)
    calls = []
    monkeypatch.setattr(Smoother, "pass_over", lambda *args: calls.append(1))
    smooth = errors_in_variables.with_states(MEASURED, smoother.ds.states)
    fold = denoised()._fit_smoothed(smooth[:20], model.noise_)
    assert not calls
    assert fold.noise_ is model.noise_
    assert fold.noisy_
    np.testing.assert_array_equal(fold.state_range_[0], MEASURED[:20].states.min(axis=0))
    # the record is used once
    monkeypatch.undo()
    assert fold.fit(MEASURED[:20]).noise_ is not model.noise_


# -- the start of a forecast --------------------------------------------------------------


def kalman(model, episode, start):
    """Filtered mean and covariance by textbook formulae, with the model's own numbers."""
    noise, slopes = model.noise_, matrix(model)
    offset = model.predict(np.zeros((1, 3)))[0]
    f, b, r = slopes[:, :2], slopes[:, 2:], np.diag(noise.measurement)
    mean, covariance = noise.start_mean, noise.start_covariance
    for t in range(start + 1):
        if t:
            mean = f @ mean + b @ episode.actions[t - 1] + offset
            covariance = f @ covariance @ f.T + np.diag(noise.process)
        gain = covariance @ np.linalg.inv(covariance + r)
        mean = mean + gain @ (episode.states[t] - mean)
        covariance = covariance - gain @ covariance
    return mean, covariance, f


@pytest.mark.parametrize("start", [0, 1, 25])
def test_forecasts_start_from_the_filtered_state(model, start):
    forecast = model.predict(MEASURED, start=start, horizon=1, actions="logged")
    for i in (0, 11):
        mean, _, _ = kalman(model, MEASURED[i], start)
        row = np.concatenate([mean, MEASURED[i].actions[start]])
        np.testing.assert_allclose(forecast.mean[i, 0], model.predict([row])[0], atol=1e-9)
    # what is told of the start is what was measured
    np.testing.assert_array_equal(forecast.initial_states[0], MEASURED[0].states[start])


def test_starts_of_one_episode_are_filtered_each(model):
    several = model.predict(MEASURED[:2], start=[[3, 9], [4, 0]], horizon=5)
    for k, (episode, start) in enumerate([(0, 3), (0, 9), (1, 4), (1, 0)]):
        one = model.predict(MEASURED[[episode]], start=start, horizon=5)
        np.testing.assert_allclose(several.mean[k], one.mean[0], rtol=1e-12)


@pytest.mark.parametrize("learner", [None, SMALL_NETWORK], ids=["linear", "network"])
def test_what_comes_after_the_start_changes_nothing(learner):
    def policy(states, params, times):
        return -0.1 * states[:, :1]

    model = denoised(learner, policy=policy).fit(MEASURED)
    garbage = [e.states.copy() for e in MEASURED], [e.actions.copy() for e in MEASURED]
    for states, actions in zip(*garbage):
        states[11:], actions[10:] = 1e30, -1e30
    spoilt = TrajectoryDataset.from_arrays(garbage[0], actions=garbage[1])
    settings = {"start": 10, "return_std": True, "n_samples": 3, "random_state": 0}
    clean, after = (model.predict(ds, **settings) for ds in (MEASURED, spoilt))
    same(clean, after)
    np.testing.assert_array_equal(clean.std, after.std)
    np.testing.assert_array_equal(clean.samples, after.samples)


def test_an_episode_that_starts_elsewhere_is_believed(model):
    far = TrajectoryDataset.from_arrays([[[40.0, -30.0]] * 2], actions=[[[0.0]]])
    want = model.predict([[40.0, -30.0, 0.0]])[0]
    np.testing.assert_allclose(model.predict(far).mean[0, 0], want, atol=0.05)


def test_forecasts_from_noisy_starts_are_better():
    test, truth = noisy_linear(30, seed=1)
    errors = [
        denoised(denoise=d).fit(MEASURED).predict(test).squared_errors(truth) for d in (None, "em")
    ]
    raw, ours = (np.nanmean(error) for error in errors)
    assert ours < 0.7 * raw


# -- uncertainty --------------------------------------------------------------------------


def test_std_is_that_of_the_start_and_of_the_process(model):
    wide = clone(model).set_params(n_particles=4000).fit(MEASURED)
    forecast = wide.predict(MEASURED[:1], return_std=True, horizon=1, random_state=0)
    _, covariance, f = kalman(wide, MEASURED[0], 0)
    want = np.sqrt(np.diag(f @ covariance @ f.T) + wide.noise_.process)
    np.testing.assert_allclose(forecast.std[0, 0], want, rtol=0.05)
    moment = wide.set_params(propagation="moment").predict(
        MEASURED[:1], return_std=True, n_samples=4000, horizon=1, random_state=0
    )
    np.testing.assert_allclose(moment.std[0, 0], want, rtol=1e-4)
    np.testing.assert_allclose(moment.samples[:, 0, 0].std(axis=0), want, rtol=0.05)


def test_moments_of_a_gp_have_the_process_noise_on_top(model):
    noise = replace(model.noise_, process=np.array([1.0, 4.0]))
    smooth = model.smooth(MEASURED[:3].truncate(15))
    gp = denoised(GPRegressor(), propagation="moment")._fit_smoothed(smooth, noise)
    std = gp.predict(MEASURED[:2], return_std=True, horizon=1).std
    assert (std[:, 0] >= [1.0, 2.0]).all()


def test_learners_without_variance_have_that_of_the_process():
    process = np.array([0.15, 0.2])
    ds, _ = noisy_linear(100, process=process)
    model = denoised(n_particles=600).fit(ds)
    # the start matters no more, and the process noise adds up to a stationary spread
    spread = np.diag(process**2)
    for _ in range(200):
        spread = A @ spread @ A.T + np.diag(process**2)
    for propagation in ("tsinf", "ts1", "expectation", "unscented"):
        model.set_params(propagation=propagation)
        std = model.predict(ds[:3], return_std=True, random_state=0, horizon=30).std
        late = np.nanmean(std[:, 20:], axis=(0, 1))
        np.testing.assert_allclose(late, np.sqrt(np.diag(spread)), rtol=0.25, err_msg=propagation)


# -- with other settings ------------------------------------------------------------------


def test_with_a_baseline_of_the_references():
    references = [np.full((e.length + 1, 2), 5.0) for e in MEASURED]
    far = TrajectoryDataset.from_arrays(
        [e.states + 5.0 for e in MEASURED],
        actions=[e.actions for e in MEASURED],
        references=references,
    )
    model = denoised(baseline=lambda r: r, inputs=("action", "references")).fit(far)
    np.testing.assert_allclose(model.measurement_noise_, STD, rtol=0.05)
    error = model.smooth(far).states - 5.0 - TRUE.states
    assert (np.sqrt(np.mean(error**2, axis=0)) < 0.35 * STD).all()


def test_saved_models_come_back(model, tmp_path):
    path = tmp_path / "model.safetensors"
    network = denoised(SMALL_NETWORK, scaler=BlockScaler())
    network.fit(MEASURED).save(path)
    again = load(path)
    same(again.predict(MEASURED, start=3), network.predict(MEASURED, start=3))
    np.testing.assert_array_equal(again.measurement_noise_, network.measurement_noise_)


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.HorizonWarning")
@pytest.mark.parametrize(
    ("settings", "fit", "message"),
    [
        ({"denoise": "noise"}, {}, "denoise"),
        ({}, {"sample_weight": np.ones(50)}, "equally noisy"),
        ({"history": 2}, {}, "history=2"),
        (
            {
                "baseline": TrajectoryRegressor(LinearRegression()),
                "inputs": ("action", "references"),
            },
            {},
            "baseline=TrajectoryRegressor",
        ),
    ],
)
def test_what_cannot_be_denoised_is_refused(settings, fit, message):
    with pytest.raises(ValueError, match=message):
        denoised(**settings).fit(MEASURED, **fit)


def test_rows_are_refused():
    with pytest.raises(ValueError, match="needs episodes"):
        denoised().fit(np.zeros((9, 3)), np.zeros((9, 2)))


def test_history_without_actions_is_refused(model):
    silent = TrajectoryDataset.from_arrays([e.states for e in MEASURED])
    with pytest.raises(MissingFieldError, match="actions before it"):
        model.predict(silent, start=5, policy=lambda s, p, t: s[:, :1])
    wide = TrajectoryDataset.from_arrays(
        [e.states for e in MEASURED], actions=[np.tile(e.actions, 2) for e in MEASURED]
    )
    with pytest.raises(ValueError, match="have 2 actions, the model was fitted on 1"):
        model.predict(wide, start=5, policy=lambda s, p, t: s[:, :1])
