"""Rewards of predicted trajectories: the mean over the predicted steps."""

import warnings

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import FunctionTransformer

from tests.dynamics.systems import SMALL, Affine, closed_loop, gain_policy, linear
from trajlearn import OneStepRegressor, TrajectoryDataset, TrajectoryRegressor
from trajlearn.exceptions import DivergenceWarning, HorizonWarning, MissingFieldError
from trajlearn.trajectories.rewards import episode_rewards


def first(states):
    return states[..., 0]


@pytest.fixture(scope="module")
def exact():
    """A model that is right, so that rewards by model and by log agree."""
    return OneStepRegressor(LinearRegression()).fit(linear())


def test_the_mean_is_over_each_episode_s_own_steps(exact):
    ds = linear(5, seed=1)
    expected = [e.states[1:, 0].mean() for e in ds]
    np.testing.assert_allclose(exact.predict_reward(ds, first), expected, atol=1e-10)


def test_a_common_horizon_is_a_common_horizon(exact):
    ds = linear(5, seed=1)
    found = exact.predict_reward(ds, first, horizon=4)
    np.testing.assert_allclose(found, episode_rewards(ds, first, horizon=4), atol=1e-10)
    late = exact.predict_reward(ds, first, horizon=2, start=3)
    np.testing.assert_allclose(late, episode_rewards(ds, first, start=3, horizon=2), atol=1e-10)
    # logged actions end with the log
    np.testing.assert_allclose(
        exact.predict_reward(ds, first, horizon=100), exact.predict_reward(ds, first)
    )


def test_actions_times_and_references_are_those_of_the_step(exact):
    base = linear(4, seed=1)
    ds = TrajectoryDataset.from_arrays(
        [e.states for e in base],
        actions=[e.actions for e in base],
        references=[np.arange(e.length + 1.0)[:, None] for e in base],
        params=base.params,
    )

    def reward(states, actions, references, times):
        return states[..., 1] * actions[..., 0] + references[..., 0] + 10 * times

    for settings in ({}, {"horizon": 3}, {"horizon": 50}, {"start": 2}):
        want = [
            np.mean((e.states[1:, 1] * e.actions[:, 0] + 11 * np.arange(1, e.length + 1))[window])
            for e in ds
            for window in [
                slice(settings.get("start", 0), settings.get("horizon")),
            ]
        ]
        np.testing.assert_allclose(exact.predict_reward(ds, reward, **settings), want, atol=1e-9)
    with pytest.raises(MissingFieldError, match=r"\['actions'\]"):
        exact.predict_reward(ds, reward, policy=gain_policy)


def test_several_starts_an_episode(exact):
    base = linear(3, seed=1)
    ds = TrajectoryDataset.from_arrays(
        [e.states for e in base],
        actions=[e.actions for e in base],
        references=[np.full((e.length + 1, 1), float(i)) for i, e in enumerate(base)],
    )
    found = exact.predict_reward(
        ds, lambda states, references: references[..., 0], start=[[0, 2]] * 3
    )
    np.testing.assert_allclose(found, [0, 0, 1, 1, 2, 2])


def test_a_forecast_that_ends_with_its_theta_is_rewarded_up_to_there():
    ds = closed_loop(4, switch=3)
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(ds)
    mean = model.predict(ds).mean
    found = model.predict_reward(ds, lambda states, times: states[..., 0] + times)
    np.testing.assert_allclose(found, mean[:, :, 0].mean(axis=1) + 2.0)


def test_past_the_log_a_policy_goes_on(exact):
    ds = linear(3, seed=1)
    found = exact.predict_reward(ds, first, horizon=30, policy=gain_policy)
    mean = exact.predict(ds, horizon=30, policy=gain_policy).mean
    np.testing.assert_allclose(found, mean[:, :, 0].mean(axis=1))


def test_a_diverged_forecast_is_worth_minus_infinity():
    ds = linear(3)
    far = TrajectoryDataset.from_arrays(
        [e.states * (1e9 if i == 1 else 1) for i, e in enumerate(ds)], params=ds.params
    )
    model = TrajectoryRegressor(Affine(0.0, std=0.1)).fit(ds)
    with pytest.warns(DivergenceWarning):
        mean = model.predict_reward(far, first)
    assert np.isfinite(mean).tolist() == [True, False, True]
    assert mean[1] == -np.inf
    with pytest.warns(DivergenceWarning):
        _, std = model.predict_reward(far, first, return_std=True, random_state=0)
    assert np.isfinite(std).tolist() == [True, False, True]
    assert std[1] == np.inf


@pytest.mark.parametrize(("noise_time", "expected"), [(np.inf, 0.5), (1e-9, 0.5 / np.sqrt(40))])
def test_the_std_of_a_mean_reward_is_that_of_whole_trajectories(noise_time, expected):
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 41, 1)))
    model = TrajectoryRegressor(
        Affine(0.0, std=0.5), scaler=FunctionTransformer(), baseline=None
    ).fit(ds)
    model.target_scale_, model.noise_time_ = np.ones(1), np.array([noise_time])
    _, std = model.predict_reward(ds, first, return_std=True, n_samples=3000, random_state=0)
    np.testing.assert_allclose(std, expected, rtol=0.06)
    again = model.predict_reward(ds, first, return_std=True, n_samples=3000, random_state=0)[1]
    np.testing.assert_array_equal(std, again)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (None, "give reward="),
        (lambda states: states, "one number a state"),
        (lambda states: states[..., 0] * np.nan, "NaN for finite states"),
    ],
)
def test_a_wrong_reward_is_named(exact, reward, message):
    with pytest.raises(ValueError, match=message):
        exact.predict_reward(linear(2), reward)


def test_a_horizon_beyond_training_warns():
    ds = linear(3, shortest=6, longest=6)
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(ds)
    with pytest.warns(HorizonWarning):
        assert np.isfinite(model.predict_reward(ds, first, horizon=9)).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict_reward(ds, first, horizon=6)
