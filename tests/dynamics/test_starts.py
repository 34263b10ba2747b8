"""Several starts an episode, also of unequal number."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import LinearRegression

from tests.dynamics.systems import linear
from trajlearn import LSTMRegressor, OneStepRegressor, TrajectoryRegressor

RAGGED = [np.array([0, 3]), np.array([2]), np.array([1, 2, 4])]

MODELS = {
    "trajectory": lambda: TrajectoryRegressor(LinearRegression(), random_state=0),
    "one step": lambda: OneStepRegressor(LinearRegression()),
    "recurrent": lambda: LSTMRegressor(hidden_size=4, max_steps=5, random_state=0),
}


@pytest.fixture(scope="module")
def ds():
    return linear(3, seed=2)


@pytest.fixture(scope="module", params=MODELS)
def model(request, ds):
    return MODELS[request.param]().fit(ds)


@pytest.fixture(scope="module")
def one_step(ds):
    return MODELS["one step"]().fit(ds)


def same(found, expected):
    for name in ("mean", "times", "lengths", "start", "episode", "initial_states"):
        assert_array_equal(getattr(found, name), getattr(expected, name))


def test_each_start_is_forecast_as_if_it_were_alone(model, ds):
    found = model.predict(ds, start=RAGGED)
    assert found.episode.tolist() == [0, 0, 1, 2, 2, 2]
    assert found.start.tolist() == [0, 3, 2, 1, 2, 4]
    for i, (episode, start) in enumerate(zip(found.episode, found.start)):
        alone = model.predict(ds[[episode]], start=int(start))
        steps = alone.lengths[0]
        assert found.lengths[i] == steps == ds.lengths[episode] - start
        assert_allclose(found.mean[i, :steps], alone.mean[0], rtol=1e-9, atol=1e-12)
        assert np.isnan(found.mean[i, steps:]).all()


def test_equal_numbers_are_a_matrix(one_step, ds):
    rows = [np.array([0, 2]), np.array([1, 3]), np.array([0, 4])]
    same(one_step.predict(ds, start=rows), one_step.predict(ds, start=np.array(rows)))


@pytest.mark.parametrize(
    "wrap",
    [
        lambda rows: [row.tolist() for row in rows],
        tuple,
        lambda rows: np.array(rows, dtype=object),
        pd.Series,
    ],
    ids=["lists", "tuple", "object array", "series"],
)
def test_any_sequence_will_do(one_step, ds, wrap):
    same(one_step.predict(ds, start=wrap(RAGGED)), one_step.predict(ds, start=RAGGED))


@pytest.mark.parametrize("empty", [[], np.array([])], ids=["list", "array"])
def test_an_episode_may_have_no_start(one_step, ds, empty):
    found = one_step.predict(ds, start=[[0, 3], empty, [1]])
    assert found.episode.tolist() == [0, 0, 2]
    assert found.start.tolist() == [0, 3, 1]
    same(found, one_step.predict(ds, start=[[0, 3], [0], [1]])[[0, 1, 3]])


def test_rewards_follow_the_starts(one_step, ds):
    found = one_step.predict_reward(ds, lambda states: states[..., 0], start=RAGGED, horizon=1)
    forecast = one_step.predict(ds, start=RAGGED, horizon=1)
    assert_array_equal(found, forecast.mean[:, 0, 0])


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([[0, 1], [2]], r"shape \(2,\) for 3 episodes.*n arrays of unequal length"),
        ([[0, 1], [2], 3], "one per episode"),
        ([[0.0, 1.0], [2], [3]], "whole numbers of steps, got float64"),
        ([[0, 1], ["2"], [3]], "whole numbers of steps, got <U1"),
        ([[], [], []], "no index in any episode"),
        ([[[0]], [[1, 2]], [[3]]], "several per episode"),
    ],
    ids=str,
)
def test_bad_starts_are_refused(one_step, ds, start, message):
    with pytest.raises(ValueError, match=message):
        one_step.predict(ds, start=start)


def test_a_start_outside_its_episode_is_named(one_step, ds):
    late = int(ds.lengths[1]) + 1
    with pytest.raises(IndexError, match=f"start {late} is outside episode"):
        one_step.predict(ds, start=[[0, 1], [late], [0]])
