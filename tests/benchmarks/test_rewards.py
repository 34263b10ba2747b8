"""One model of the reward table: what is predicted, chosen and recorded."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression

from benchmarks.paper import _reward_models, _rewards, _tasks
from benchmarks.paper._reward_models import SETTINGS, candidates, for_training, make
from benchmarks.paper._rewards import cell, choose, own_goals, own_rewards, predict, states_of
from benchmarks.paper._tasks import Task, environment
from trajlearn import DirectRewardGP, OneStepRegressor, Reacher
from trajlearn.exceptions import DivergenceWarning

TASKS = ["cartpole", "reacher"]


def few(task, seed):
    env = environment(task)
    return tuple(env.collect(10, 12, random_state=2 * seed + k) for k in (0, 1))


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_rewards, "flown", few)
    monkeypatch.setattr(_reward_models, "QUICK_STEPS", 10)


@pytest.mark.parametrize("task", TASKS)
def test_every_model_tries_four_different_configurations(task):
    for model in SETTINGS[task]:
        tried = candidates(task, model)
        assert len(tried) == len({str(config) for config in tried}) == 4
        assert sum(config["symmetry"] for config in tried) == 2


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("model", list(SETTINGS["cartpole"]))
def test_configurations_are_parameters_of_the_model(task, model):
    env = environment(task)
    for config in candidates(task, model):
        estimator = make(task, model, "tuned", config, "full", 7)
        parameters = estimator.get_params()
        assert parameters["random_state"] == 7
        for name, value in config.items():
            if name != "symmetry":
                assert estimator.get_params()[name] == value
    if model.startswith("D"):
        assert estimator.policy == env.policy
    if model in ("GP", "NN"):
        assert estimator.reward.__self__ == env


@pytest.mark.parametrize("task", TASKS)
def test_a_direct_model_learns_the_rewards_of_the_images(task):
    train, _ = few(task, 0)
    reward = environment(task).reward
    images = for_training(task, train, "GP", {"symmetry": True})
    model = DirectRewardGP(reward=reward, random_state=0).fit(images)
    expected = [reward(episode.states[1:]).mean() for episode in images]
    assert len(images) == {"cartpole": 10, "reacher": 40}[task]
    np.testing.assert_allclose(model.relabeler_.targets(images), expected)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("actions", ["logged", "policy"])
def test_predicted_rewards_are_those_of_predict_reward(task, actions):
    train, test = few(task, 0)
    env = environment(task)
    model = OneStepRegressor(LinearRegression(), policy=env.policy).fit(train)
    shown = predict(model, test, env.reward, actions, None)
    np.testing.assert_allclose(
        shown.rewards, model.predict_reward(test, env.reward, actions=actions)
    )
    assert shown.own is None
    assert shown.far == 0


class Growing(LinearRegression):
    """The first state grows a thousandfold at each step where it is positive."""

    def predict(self, X):
        return np.where(X[:, :1] > 0, 1e3 * X[:, :1], 0.0) * [1, 0, 0, 0]


def test_lost_and_diverged_forecasts_are_counted():
    train, test = few("cartpole", 0)
    reward = environment("cartpole").reward
    model = OneStepRegressor(Growing(), scaler=None).fit(train)
    right = np.array([episode.states[0, 0] for episode in test]) > train.states[:, 0].mean()
    shown = predict(model, test, reward, "logged", None)
    with pytest.warns(DivergenceWarning):
        expected = model.predict_reward(test, reward, actions="logged")
    np.testing.assert_array_equal(np.isinf(shown.rewards), right)
    np.testing.assert_allclose(shown.rewards, expected)
    assert 0 < shown.far == right.sum() < len(test)
    # two steps take it far, and not yet beyond all bounds
    brief = predict(model, test.truncate(1), reward, "logged", None)
    assert np.isfinite(brief.rewards).all()
    assert brief.far == right.sum()


def test_rewards_with_own_goals_are_the_environments():
    _, test = few("reacher", 0)
    goals = own_goals(len(test), 0)
    assert (np.abs(goals) <= 0.5).all()
    np.testing.assert_array_equal(goals, own_goals(len(test), 0))
    assert not np.isin(goals, own_goals(len(test), 1)).any()
    expected = [
        Reacher(goal=tuple(goal)).reward(episode.states[1:]).mean()
        for goal, episode in zip(goals, test, strict=True)
    ]
    np.testing.assert_allclose(own_rewards(states_of(test), goals), expected)


@pytest.mark.parametrize("task", TASKS)
def test_the_constant_row_is_the_training_mean(small, task):
    env = environment(task)
    train, test = few(task, 3)
    [line] = cell(task, "constant", "-", "quick", 3)
    guess = np.mean([env.reward(episode.states[1:]).mean() for episode in train])
    truth = np.array([env.reward(episode.states[1:]).mean() for episode in test])
    assert line["mean"] == pytest.approx(np.mean((truth - guess) ** 2))
    assert line["n_episodes"] == 10
    if task == "cartpole":
        assert line["own_goal"] is None
        return
    errors = []
    for goal, episode in zip(own_goals(10, 3), test, strict=True):
        reward = Reacher(goal=tuple(goal)).reward
        mean = np.mean([reward(other.states[1:]).mean() for other in train])
        errors.append((reward(episode.states[1:]).mean() - mean) ** 2)
    assert line["own_goal"] == pytest.approx(np.mean(errors))


def test_the_best_configuration_on_held_out_episodes_is_chosen(small, monkeypatch):
    seen = []

    def made(task, model, settings, config, mode, seed):
        reward = environment(task).reward

        class Guess:
            def fit(self, ds):
                seen.append(set(map(float, ds.states[ds.offsets[:-1], 0])))

            def predict(self, ds):
                seen.append(set(map(float, ds.states[ds.offsets[:-1], 0])))
                return reward(states_of(ds)).mean(axis=1) + config["off"]

        return Guess()

    monkeypatch.setattr(_rewards, "make", made)
    monkeypatch.setattr(
        _rewards, "candidates", lambda task, model: [{"off": x} for x in (np.inf, 0.3, -0.1, 2.0)]
    )
    train, _ = few("cartpole", 0)
    chosen, seconds = choose("cartpole", "GP", "tuned", "quick", 0, train)
    assert chosen == {"GP": {"off": -0.1}}
    assert seconds > 0
    kept, held = seen[:2]
    assert not kept & held
    assert (len(kept), len(held)) == (8, 2)
    assert choose("cartpole", "GP", "default", "quick", 0, train) == ({"GP": {}}, 0.0)


def test_a_cell_has_a_record_for_each_source_of_actions(small):
    records = cell("reacher", "D", "default", "quick", 0)
    assert [record["row"] for record in records] == ["D, logged actions", "D, predicted actions"]
    for record in records:
        assert record["own_goal"] > 0
        assert record["n_far"] == 0
        assert record["seconds"] > 0
    assert records[0]["mean"] != records[1]["mean"]


def test_a_tuned_row_is_the_chosen_configuration_fitted_on_all(small, monkeypatch):
    tried = [{"target": target, "symmetry": True} for target in ("change", "state")]
    monkeypatch.setattr(_rewards, "candidates", lambda task, model: tried)
    [record] = cell("reacher", "C", "tuned", "quick", 0)
    assert record["config"] in tried
    train, test = few("reacher", 0)
    reward = environment("reacher").reward
    model = make("reacher", "C", "tuned", record["config"], "quick", 0)
    model.fit(for_training("reacher", train, "C", record["config"]))
    errors = model.predict_reward(test, reward) - reward(states_of(test)).mean(axis=1)
    assert record["mean"] == pytest.approx(np.mean(errors**2))


def test_direct_models_know_nothing_of_goals(small):
    [record] = cell("reacher", "GP", "default", "quick", 0)
    assert record["own_goal"] is None
    assert record["n_far"] is None
    assert np.isfinite(record["mean"])


@pytest.mark.parametrize("task", TASKS)
def test_training_and_test_episodes_share_no_start(task, monkeypatch):
    monkeypatch.setattr(_tasks, "N_EPISODES", 5)
    monkeypatch.setitem(_tasks.TASKS, task, Task(3, 6))
    starts = [
        tuple(episode.states[0])
        for seed in (0, 1)
        for ds in _rewards.episodes(task, seed, n_test=5)
        for episode in ds
    ]
    assert len(set(starts)) == len(starts) == 20
