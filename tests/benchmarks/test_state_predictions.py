"""States over their truth: which episode, which errors, what is said to diverge."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _models, _tasks, state_predictions
from benchmarks.paper._rollouts import N_TEST

LENGTH, TEST_LENGTH, N = 50, 55, 4


@pytest.fixture
def tiny(monkeypatch):
    for task in list(_tasks.TASKS):
        monkeypatch.setitem(_tasks.TASKS, task, _tasks.Task(LENGTH, TEST_LENGTH))
    monkeypatch.setitem(N_TEST, "quick", N)
    monkeypatch.setattr(_tasks, "N_EPISODES", 4)
    monkeypatch.setattr(_models, "QUICK_STEPS", 5)


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [([5.0, 1.0, 3.0], 2), ([4.0, 1.0, 3.0, 2.0], 3), ([np.inf, np.inf, 1.0, 2.0], 3), ([7.0], 0)],
    ids=["odd", "even: the lower", "some diverge", "one"],
)
def test_the_episode_has_the_median_error(errors, chosen):
    table = pd.DataFrame(
        {"task": "cartpole", "seed": 1, "episode": range(len(errors)), "within": errors}
    )
    table = table.sample(frac=1, random_state=0)
    assert state_predictions.median_episodes(table) == {("cartpole", 1): chosen}


def test_a_line_diverges_if_it_stays_off():
    errors = np.array(
        [
            # never, for a while, from step 3 on, always, at the end only, for a while and again
            [0.1, 2.0, 0.1, 2.0, 0.1, 2.0],
            [0.1, 2.0, 0.1, 2.0, 0.1, 0.1],
            [1.0, 0.1, 1.1, 2.0, 0.1, 2.0],
            [0.1, 0.1, np.inf, 2.0, 9.0, 2.0],
        ]
    )
    assert state_predictions.diverges_at(errors).tolist() == [0, 0, 3, 1, 4, 3]


def test_stored_steps_cover_the_horizon():
    assert state_predictions.stored_steps(200).tolist() == list(range(1, 201))
    steps = state_predictions.stored_steps(500)
    assert (steps[0], steps[-1]) == (1, 500)
    assert np.diff(steps).min() >= 1
    assert np.diff(steps).max() <= 12
    assert len(steps) < 60


def test_the_axis_is_cut_for_lines_that_diverge_only():
    lines = {line: [0.0, 1.0] for line in ("truth", *state_predictions.DRAWN)}
    states = pd.DataFrame({"state": "x"} | lines)
    states["D, logged"] = [0.0, 1e9]
    low, high = state_predictions.limits(states, ["x"], {("x", "D, logged")})
    assert (low, high) == pytest.approx((-0.05, 1.05))
    # a line that does not diverge is seen, unless it is far off
    states["T"] = [0.0, 1.8]
    assert state_predictions.limits(states, ["x"], {("x", "D, logged")})[1] > 1.8
    assert state_predictions.limits(states, ["x"], set())[1] == pytest.approx(2.05)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("theta_dot", "theta_dot"),
        ("x", "x"),
        ("cos_base_z", "cos"),
        ("velocity_wrist_x", "velocity"),
    ],
)
def test_every_state_has_a_kind_with_a_unit(name, kind):
    assert state_predictions.kind_of(name) == kind
    assert kind in state_predictions.UNITS


def test_the_whole_command_on_tiny_tasks(tiny, tmp_path, capsys):
    state_predictions.BENCHMARK.main(["--quick", "--n-jobs", "1", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    folder = tmp_path / "state-predictions"
    states, errors = (pd.read_csv(folder / f"{stem}.csv") for stem in ("states", "errors"))
    for task, n_states in (("cartpole", 4), ("reacher", 15)):
        some = states[states["task"] == task]
        assert some["state"].nunique() == n_states
        (episode,) = some["episode"].unique()
        _, test = _tasks.episodes(task, 0, n_test=N, test_length=TEST_LENGTH)
        truth = some.pivot(index="horizon", columns="state", values="truth")
        expected = test[int(episode)].states[truth.index]
        np.testing.assert_allclose(truth[list(test.state_names)], expected, rtol=1e-4, atol=1e-6)
        # the errors are those of the stored predictions
        train, _ = _tasks.episodes(task, 0, n_test=N, test_length=TEST_LENGTH)
        width = np.ptp(train.states, axis=0)
        guess = some.pivot(index="horizon", columns="state", values="T")[list(test.state_names)]
        squared = ((guess.to_numpy() - expected) / width) ** 2
        stored = errors.query("task == @task and model == 'T'")["error"]
        np.testing.assert_allclose(stored, squared.mean(axis=0), rtol=1e-2)
        assert f"Test episodes: {episode} (seed 0)." in printed
        assert (folder / f"state-predictions-{task}.png").stat().st_size > 4_000
    sources = errors.groupby("model")["actions"].unique().map(list).to_dict()
    both = ["logged", "policy"]
    assert sources == {"D": both, "PE": both, "T": ["none"], "T (ours)": ["none"]}


def test_the_forecast_is_that_of_the_model_that_chose_the_episode(tiny, tmp_path):
    run = state_predictions.Run("state-predictions", "quick", [0], tmp_path, 1, {})
    rolled = state_predictions.measure(run, ["cartpole"], [("T", "paper")])["episodes"]
    result = state_predictions.cell("cartpole", "T", "paper", "quick", 0, episode=2)
    again = np.mean(result["actions"]["none"]["error"])
    assert again == pytest.approx(rolled["within"].iloc[2], rel=1e-3)


def test_the_text_counts_divergence_and_wins():
    def lines(model, actions, error, diverges_at):
        key = {"task": "cartpole", "episode": 3, "model": model, "actions": actions}
        return [
            key | {"seed": s, "state": state, "error": e, "diverges_at": d}
            for s, d in enumerate(diverges_at)
            for state, e in zip(("x", "theta"), error)
        ]

    table = lines("D", "logged", (np.inf, 0.1), (5, 0, 9)) + lines(
        "T", "none", (0.2, 0.2), (0,) * 3
    )
    text = state_predictions.report({"states": None, "errors": pd.DataFrame(table)})
    assert "inf (inf to inf), diverges 2 of 3" in text
    assert "Least error, of 2 states: T in 1; D, logged in 1." in text
