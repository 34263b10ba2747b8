"""The paper's protocol taken apart, on systems whose answers are known."""

import json

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression

from benchmarks.paper import _ablations
from trajlearn import OneStepRegressor, TrajectoryDataset


def linear_system(n_episodes=4, n_steps=30, seed=0):
    """s' = 0.9 s + 0.5 a under random actions."""
    actions = np.random.default_rng(seed).normal(size=(n_episodes, n_steps, 1))
    states = np.zeros((n_episodes, n_steps + 1, 1))
    for t in range(n_steps):
        states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    return TrajectoryDataset.from_arrays(states, actions=actions)


def test_late_actions_hide_the_action_that_matters():
    ds = linear_system()
    late = _ablations.late(ds)
    assert late.lengths.tolist() == [29] * 4
    np.testing.assert_array_equal(late[0].states, ds[0].states[1:])
    np.testing.assert_array_equal(late[0].actions, ds[0].actions[:-1])
    errors = [
        np.abs(OneStepRegressor(LinearRegression()).fit(some).predict(some, horizon=1)).mean()
        - np.abs([episode.states[1] for episode in some]).mean()
        for some in (ds, late)
    ]
    assert abs(errors[0]) < 1e-12
    assert abs(errors[1]) > 1e-3


def test_all_pairs_error_is_that_of_the_broadcast_difference():
    rng = np.random.default_rng(0)
    truth, estimate = rng.normal(size=50), rng.normal(size=50)
    expected = truth.var() + estimate.var() + (truth.mean() - estimate.mean()) ** 2
    assert _ablations.all_pairs_error(estimate, truth) == pytest.approx(expected)
    # perfect predictions still have an error of twice the variance
    assert _ablations.all_pairs_error(truth, truth) == pytest.approx(2 * truth.var())


@pytest.fixture
def small(monkeypatch):
    from benchmarks.paper import _tasks

    tasks = {"cartpole": _tasks.Task(8, 60), "reacher": _tasks.Task(60, 70)}
    monkeypatch.setattr(_tasks, "N_EPISODES", 10)
    for module in (_tasks, _ablations):
        monkeypatch.setattr(module, "TASKS", tasks)
    monkeypatch.setattr(_ablations, "N_TEST", {"quick": 3, "full": 3})


@pytest.mark.parametrize("method", ["GP", "NN", "D", "D late", "T"])
def test_reward_cells_hold_truth_and_estimate_of_both_sets(small, method):
    result = _ablations.reward_cell("cartpole", method, "quick", 0)
    sources = ["logged", "policy"] if method.startswith("D") else ["none"]
    assert list(result) == [f"{n}, {s}" for n in ("train", "test") for s in sources]
    for name, some in result.items():
        assert len(some["truth"]) == len(some["estimate"]) == (10 if "train" in name else 3)
        assert np.isfinite(some["truth"]).all()


def test_the_weak_controller_changes_recomputed_actions(small):
    right = _ablations.reward_cell("reacher", "D", "quick", 0)["test, policy"]
    weak = _ablations.reward_cell("reacher", "D weak", "quick", 0)["test, policy"]
    np.testing.assert_array_equal(right["truth"], weak["truth"])
    assert np.abs(np.subtract(right["estimate"], weak["estimate"])).max() > 1e-3


def test_the_gp_sees_four_fifths_of_what_it_is_scored_on(small, monkeypatch):
    seen = []
    fit = _ablations.paper.model("GP").__class__.fit

    def watched(self, X, *args, **kwargs):
        seen.append(len(X))
        return fit(self, X, *args, **kwargs)

    monkeypatch.setattr(_ablations.paper.model("GP").__class__, "fit", watched)
    _ablations.reward_cell("cartpole", "GP", "quick", 0)
    assert seen == [8]


def test_a_budget_of_t_is_the_steps_rate_and_batch_of_t(small, monkeypatch):
    fitted = {}
    build = _ablations.build

    def unfitted(*args, **kwargs):
        fitted["model"] = build(*args, **kwargs)
        monkeypatch.setattr(type(fitted["model"]), "fit", lambda *_: None)
        return fitted["model"]

    monkeypatch.setattr(_ablations, "build", unfitted)
    monkeypatch.setattr(_ablations, "assess", lambda *args, **kwargs: {"windows": {}})
    _ablations.budget_cell("reacher", "D", 4, 60, "of T", "full", 0)
    learner = fitted["model"].get_params()
    assert learner["estimator__learning_rate"] == 8e-4
    assert learner["estimator__batch_size"] == 64
    assert learner["estimator__max_steps"] == 8 * 80_000 // 64


def test_planning_counts_the_same_work_for_each_way():
    taken = _ablations.planning_cell(3, "quick", 0)
    assert list(taken) == ["T", "T, every 10th horizon", "one-step"]
    assert all(seconds > 0 for seconds in taken.values())
    # one batched evaluation of 600 rows beats 200 sequential ones of 3 on any machine
    assert taken["T, every 10th horizon"] < taken["one-step"]


def test_a_plan_is_json_and_names_every_seed():
    for cells in _ablations.plan("quick", [0, 1]).values():
        assert {cell["seed"] for cell in cells} == {0, 1}
        json.dumps(cells)
