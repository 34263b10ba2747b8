"""The gradient of a predicted return, and the climb along it."""

import warnings

import numpy as np
import pytest
import torch
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from trajlearn import (
    DirectRewardGP,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.control._gradient import ascend, value_and_gradient
from trajlearn.control._optimizers import maximise
from trajlearn.control.objective import PredictedReturn

DT = 0.1
LENGTH = 20
BOUNDS = np.array([[0.5, 3.0], [-1.0, 2.0]])
CANDIDATES = np.array([[1.0, 0.5], [2.0, 1.0], [2.5, -0.5]])
STARTS = np.array([[0.0], [0.4], [-0.5]])


def exact(theta, starts, times):
    """s' = -theta_0 s + theta_1: states (n, k)."""
    end = theta[:, 1:] / theta[:, :1]
    return end + (starts - end) * np.exp(-theta[:, :1] * times)


def episodes(n=100, seed=0):
    rng = np.random.default_rng(seed)
    theta = rng.uniform(*BOUNDS.T, size=(n, 2))
    states = exact(theta, rng.uniform(-1, 1, size=(n, 1)), DT * np.arange(LENGTH + 1))
    return TrajectoryDataset.from_arrays(states[..., None], params=theta, dt=DT)


@pytest.fixture(scope="module")
def model():
    return (
        TrajectoryRegressor(random_state=0)
        .set_params(
            estimator__hidden_layer_sizes=(24, 24),
            estimator__n_members=2,
            estimator__max_steps=1500,
            estimator__batch_size=128,
        )
        .fit(episodes())
    )


def near(target):
    def reward(states):
        return -((states[..., 0] - target) ** 2)

    return reward


def objective_of(model, reward=None, **settings):
    defaults = {"horizon": LENGTH, "dt": DT, "initial_states": STARTS}
    return PredictedReturn(model, reward=reward or near(0.4), **defaults | settings)


def slopes_of(objective, params, step=1e-2):
    """Central differences of what the objective predicts."""
    ends = [
        [objective(params + sign * step * unit).value for unit in np.eye(params.shape[1])]
        for sign in (1, -1)
    ]
    return (np.array(ends[0]) - np.array(ends[1])).T / (2 * step)


def two_hills(states):
    """The greater one where a trial that is attracted by the other does not come."""
    s = states[..., 0]
    return np.exp(-(((s - 0.8) / 0.3) ** 2)) + 0.4 * np.exp(-(((s + 1.0) / 0.3) ** 2))


def with_times(states, times):
    return states[..., 0] * np.cos(times)


ENDS = {"is_terminal": lambda s: s[..., 0] > 0.45, "terminal_reward": -0.7}
OBJECTIVES = {
    "every step": {},
    "each third step and the last": {"every": 3},
    "a kink": {"reward": lambda s: -np.abs(s[..., 0] - 0.21)},
    "a reward of times": {"reward": with_times},
    "trials that end": ENDS,
    "trials that end, each third step": {**ENDS, "every": 3},
    "one start": {"initial_states": [0.2]},
}


@pytest.mark.parametrize("name", OBJECTIVES)
def test_it_is_the_derivative_of_what_the_objective_predicts(model, name):
    objective = objective_of(model, **OBJECTIVES[name])
    values, gradients = value_and_gradient(objective, CANDIDATES)
    np.testing.assert_allclose(values, objective(CANDIDATES).value, rtol=0, atol=2e-5)
    expected = slopes_of(objective, CANDIDATES, 1e-3 if "end" in name or "kink" in name else 1e-2)
    np.testing.assert_allclose(gradients, expected, rtol=0, atol=2e-2)
    assert np.abs(expected).max() > 0.5


def test_ends_matter_and_are_constant_for_the_gradient(model):
    whole, ended = (
        value_and_gradient(objective_of(model, **settings), CANDIDATES) for settings in ({}, ENDS)
    )
    assert (whole[0] != ended[0]).tolist() == [True, True, False]
    # a trial that ends at once has nothing to gain by changing theta a little
    at_once = {"is_terminal": lambda s: s[..., 0] > -9.0, "terminal_reward": -1.0}
    values, gradients = value_and_gradient(objective_of(model, **at_once), CANDIDATES)
    first = {"is_terminal": None, "horizon": 1}
    one_step = value_and_gradient(objective_of(model, **first), CANDIDATES)
    np.testing.assert_allclose(values, one_step[0] - (LENGTH - 1), rtol=0, atol=1e-6)
    np.testing.assert_allclose(gradients, one_step[1], rtol=0, atol=1e-6)


def test_it_is_near_the_true_gradient_of_the_system(model):
    def true_return(theta):
        times = DT * np.arange(1, LENGTH + 1)
        return np.mean([-((exact(theta, s, times) - 0.4) ** 2).sum(axis=1) for s in STARTS], axis=0)

    truth = [
        (true_return(CANDIDATES + 1e-4 * unit) - true_return(CANDIDATES - 1e-4 * unit)) / 2e-4
        for unit in np.eye(2)
    ]
    _, gradients = value_and_gradient(objective_of(model), CANDIDATES)
    truth = np.transpose(truth)
    sizes = np.linalg.norm(gradients, axis=1), np.linalg.norm(truth, axis=1)
    assert ((gradients * truth).sum(axis=1) / np.prod(sizes, axis=0)).min() > 0.98
    np.testing.assert_allclose(*sizes, rtol=0.15)


def test_the_size_of_chunks_does_not_matter(model, monkeypatch):
    objective = objective_of(model)
    rng = np.random.default_rng(0)
    many = rng.uniform(*BOUNDS.T, size=(30, 2))
    whole = value_and_gradient(objective, many)
    monkeypatch.setattr("trajlearn.control._gradient._CHUNK_STATES", 4 * LENGTH * len(STARTS) * 2)
    for a, b in zip(whole, value_and_gradient(objective, many)):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_what_diverges_has_no_slope(model):
    def steep(states):
        # infinite where the first two candidates go
        return np.where(states[..., 0] > 0.45, -np.inf, states[..., 0])

    values, gradients = value_and_gradient(objective_of(model, steep), CANDIDATES)
    assert np.isfinite(values).tolist() == [False, False, True]
    assert np.isfinite(gradients).all()
    assert not gradients[~np.isfinite(values)].any()
    # far beyond the states of training a forecast counts as diverged, here as there
    model.state_range_, kept = model.state_range_ * 1e-9, model.state_range_
    try:
        for lost in (None, -2.0):
            objective = objective_of(model, terminal_reward=lost)
            values, gradients = value_and_gradient(objective, CANDIDATES)
            np.testing.assert_allclose(values, objective(CANDIDATES).value)
            assert not gradients.any()
    finally:
        model.state_range_ = kept


@pytest.mark.parametrize("target", [0.3, 5.0], ids=["inside", "at a bound"])
def test_ascending_finds_the_known_optimum_sooner_than_random_search(model, target):
    objective = objective_of(model, near(target))
    n_evaluations = 100
    gaps = {"ascend": [], "random": []}
    grid = np.stack(np.meshgrid(*(np.linspace(*b, 41) for b in BOUNDS)), axis=-1).reshape(-1, 2)
    best = objective(grid).value.max()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = ascend(objective, BOUNDS, n_evaluations=n_evaluations, rng=rng)
        assert found.n_evaluations <= n_evaluations
        assert (found.params >= BOUNDS[:, 0]).all()
        assert (found.params <= BOUNDS[:, 1]).all()
        np.testing.assert_allclose(found.value, objective(found.params[None]).value[0], atol=1e-5)
        if target == 5.0:
            # as far up as possible, which is theta_1 / theta_0 = 4
            np.testing.assert_allclose(found.params, [0.5, 2.0], atol=1e-6)
        gaps["ascend"].append(best - found.value)
        rng = np.random.default_rng(seed)
        random = maximise(
            lambda params: objective(params).value,
            BOUNDS,
            method="random",
            n_evaluations=4 * n_evaluations,
            rng=rng,
        )
        gaps["random"].append(best - random.value)
    assert max(gaps["ascend"]) < 1e-3
    # although it had four times the budget
    assert max(gaps["ascend"]) < min(gaps["random"])


def test_a_poor_start_is_left_and_a_good_one_kept(model):
    objective = objective_of(model, near(0.3))
    start = np.array([[3.0, -1.0], [1.0, 0.31]])
    seen = []
    found = ascend(
        objective,
        BOUNDS,
        n_evaluations=40,
        rng=np.random.default_rng(0),
        start=start,
        n_restarts=2,
        on_batch=lambda params, values: seen.append((params, values)),
    )
    np.testing.assert_allclose(seen[0][0], start, rtol=1e-12)
    assert found.value > seen[0][1].max()
    assert sum(len(values) for _, values in seen) == found.n_evaluations <= 40
    assert found.value == max(values.max() for _, values in seen)
    one = ascend(objective, BOUNDS, n_evaluations=1, rng=np.random.default_rng(0), start=start[1])
    np.testing.assert_allclose(one.params, start[1])
    assert one.n_evaluations == 1
    # restarts reach what a single poor start does not
    bumpy = objective_of(model, two_hills)
    few, many = (
        ascend(
            bumpy,
            BOUNDS,
            n_evaluations=200,
            rng=np.random.default_rng(1),
            start=[0.8, -0.9],
            n_restarts=n,
        ).value
        for n in (1, 16)
    )
    assert many > few + 1.0


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(model):
    found = []
    for threads, seed in ((1, 0), (2, 0), (1, 1)):
        torch.set_num_threads(threads)
        try:
            rng = np.random.default_rng(seed)
            found.append(ascend(objective_of(model), BOUNDS, n_evaluations=60, rng=rng))
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(1)
    np.testing.assert_array_equal(found[0].params, found[1].params)
    assert found[0].value == found[1].value
    assert (found[0].params != found[2].params).any()


def test_where_nothing_is_finite_nothing_is_found(model):
    objective = objective_of(model, lambda states: np.full(states.shape[:-1], -np.inf))
    found = ascend(objective, BOUNDS, n_evaluations=50, rng=np.random.default_rng(0))
    assert np.isneginf(found.value)
    assert found.n_evaluations <= 50
    assert np.isfinite(found.params).all()


def with_actions(states, actions):
    return states[..., 0] - actions[..., 0] ** 2


def proportional(states, params, times):
    return -params[:, :1] * states


def test_what_has_no_gradient_says_so_and_what_to_do(model):
    rows = episodes(6)
    acting = TrajectoryDataset.from_arrays(
        [e.states for e in rows],
        actions=[np.zeros((LENGTH, 1))] * 6,
        params=rows.params,
        dt=DT,
    )
    one_step = OneStepRegressor(LinearRegression(), policy=proportional).fit(acting)
    direct = DirectRewardGP(reward=near(0.4)).set_params(estimator__max_iter=3).fit(rows)
    pipeline = make_pipeline(FunctionTransformer(), model)
    cases = {
        "OneStepRegressor is no Traj": lambda: objective_of(one_step),
        "DirectRewardGP is no Traj": lambda: objective_of(direct),
        "Pipeline is no Traj": lambda: objective_of(pipeline),
        "risk='lcb'": lambda: objective_of(model, risk="lcb"),
        "decision='actions'": lambda: objective_of(one_step, decision="actions"),
        "names actions": lambda: objective_of(model, with_actions, policy=proportional),
    }
    for said, make in cases.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            objective = make()
        with pytest.raises(ValueError, match=said) as error:
            value_and_gradient(objective, CANDIDATES)
        assert "optimizer='cma'" in str(error.value)


def test_bad_input_is_named(model):
    objective, rng = objective_of(model), np.random.default_rng(0)
    with pytest.raises(ValueError, match="lower bound"):
        ascend(objective, BOUNDS[:, ::-1], n_evaluations=10, rng=rng)
    with pytest.raises(ValueError, match="n_evaluations = 0"):
        ascend(objective, BOUNDS, n_evaluations=0, rng=rng)
    with pytest.raises(ValueError, match="start"):
        ascend(objective, BOUNDS, n_evaluations=10, rng=rng, start=[9.0, 9.0])
    with pytest.raises(ValueError, match=r"params of shape \(1, 3\) must"):
        value_and_gradient(objective, [[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="must be finite"):
        value_and_gradient(objective, [[1.0, np.nan]])
    with pytest.raises(ValueError, match="bounds has 1 rows"):
        ascend(objective, BOUNDS[:1], n_evaluations=10, rng=rng)
    nan = objective_of(model, lambda states: np.where(states[..., 0] > 0.1, np.nan, 0.0))
    with pytest.raises(ValueError, match="NaN"):
        ascend(nan, BOUNDS, n_evaluations=10, rng=rng)
