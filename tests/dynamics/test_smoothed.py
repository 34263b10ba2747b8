"""Dynamics estimators behind a smoother: scales and scores are those of the measurements."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from trajlearn import MeanEpisodeForecaster, OneStepRegressor, TrajectoryDataset
from trajlearn.trajectories.kalman import KalmanSmoother


@pytest.fixture(scope="module")
def noisy():
    """A double integrator under random accelerations, its position measured with noise."""
    rng = np.random.default_rng(0)
    n, steps, dt = 20, 40, 0.1
    actions = rng.normal(size=(n, steps, 1))
    position, velocity = np.zeros((n, steps + 1, 1)), np.zeros((n, steps + 1, 1))
    velocity[:, 0] = rng.normal(size=(n, 1))
    # or else the position would tell the velocity
    position[:, 0] = 5 * rng.normal(size=(n, 1))
    for t in range(steps):
        velocity[:, t + 1] = velocity[:, t] + dt * actions[:, t]
        position[:, t + 1] = position[:, t] + dt * velocity[:, t] + dt**2 / 2 * actions[:, t]
    measured = position + 0.05 * rng.normal(size=position.shape)
    return TrajectoryDataset.from_arrays(measured, actions=actions, dt=dt, state_names=["x"])


@pytest.mark.parametrize(
    "final", [OneStepRegressor(LinearRegression()), MeanEpisodeForecaster()], ids=["D", "mean"]
)
def test_ranges_are_those_of_the_measurements(noisy, final):
    model = make_pipeline(KalmanSmoother(append_velocities=True), final).fit(noisy)
    forecast = model.predict(noisy, start=10)
    assert forecast.state_names == ("x", "d_x")
    np.testing.assert_array_equal(
        forecast.state_range[:, 0], [noisy.states.min(), noisy.states.max()]
    )


def test_the_score_compares_with_the_measurements(noisy):
    model = make_pipeline(
        KalmanSmoother(append_velocities=True), OneStepRegressor(LinearRegression())
    ).fit(noisy)
    forecast = model.predict(noisy)
    width = np.ptp(noisy.states)
    squared = ((forecast.mean[:, :, 0] - noisy.states.reshape(20, 41)[:, 1:]) / width) ** 2
    assert model.score(noisy) == pytest.approx(-squared.mean())


def test_an_estimated_velocity_makes_a_one_step_model_of_positions_useful(noisy):
    train, test = noisy[:14], noisy[14:]
    raw = OneStepRegressor(LinearRegression()).fit(train)
    smooth = make_pipeline(
        KalmanSmoother(append_velocities=True), OneStepRegressor(LinearRegression())
    ).fit(train)
    errors = [
        np.nanmean(model.predict(test, start=15, horizon=10).squared_errors(test))
        for model in (raw, smooth)
    ]
    assert errors[1] < 0.3 * errors[0]
