"""The reward table, on a few short episodes."""

import json
import sys

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import reward_table


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(reward_table, "N_EPISODES", 10)
    monkeypatch.setattr(reward_table, "LENGTH", {"cartpole": 12})
    monkeypatch.setattr(reward_table, "MAX_STEPS", {"full": 20, "quick": 10})
    monkeypatch.setattr(reward_table, "PAPER_EPOCHS", {"full": {}, "quick": {"T": 1, "D": 1}})


def test_training_and_test_episodes_share_no_start(small):
    train, test = reward_table.episodes("cartpole", 0)
    starts = {tuple(episode.states[0]) for ds in (train, test) for episode in ds}
    assert len(starts) == len(train) + len(test)
    other, _ = reward_table.episodes("cartpole", 1)
    assert not {tuple(episode.states[0]) for episode in other} & starts


def test_mirror_images_obey_the_same_dynamics(small):
    train, _ = reward_table.episodes("cartpole", 0)
    env = reward_table.environment("cartpole")
    both = reward_table.mirrored(train)
    image = both[len(both) - 1]
    again = env.rollout(image.states[:1], image.params[None], image.length)
    np.testing.assert_allclose(again[0].states, image.states, rtol=1e-9, atol=1e-12)


def test_folding_keeps_rewards_and_forgets_the_side(small):
    train, _ = reward_table.episodes("cartpole", 0)
    env = reward_table.environment("cartpole")
    once = reward_table.folded(train)
    assert (once.states[once.offsets[:-1], 2] >= 0).all()
    other = reward_table.folded(reward_table.mirrored(train))
    np.testing.assert_array_equal(other.states[: len(once.states)], once.states)
    rewards = [reward_table.true_rewards(ds, env.reward) for ds in (train, once)]
    np.testing.assert_allclose(*rewards)


def test_every_family_tries_the_same_number_of_configurations():
    counts = {f: len(reward_table.candidates("cartpole", f)) for f in reward_table.CANDIDATES}
    assert len(set(counts.values())) == 1


def test_the_whole_table_comes_out(small, tmp_path, monkeypatch, capsys):
    arguments = ["reward-table", "--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    reward_table.main()
    printed = capsys.readouterr().out
    result = json.loads((tmp_path / "cartpole.json").read_text())
    assert result["mode"] == "quick"
    rows = pd.DataFrame(result["records"])
    paper = rows[rows["settings"] == "paper"]["row"].tolist()
    assert paper == ["GP", "NN", "D, logged actions", "D, predicted actions", "T"]
    assert {"C", "T"} <= set(rows[rows["settings"] == "tuned"]["row"])
    assert (rows["row"] == "constant").sum() == 1
    assert "0.884 ± 1.873" in printed
    assert "quick mode" in printed
    assert (tmp_path / "cartpole.png").stat().st_size > 10_000
    # chosen on training folds only: the configuration is listed
    assert all("symmetry" in r["config"] for r in result["records"] if r["settings"] == "tuned")


def test_the_constant_row_is_the_training_mean(small):
    env = reward_table.environment("cartpole")
    train, test = reward_table.episodes("cartpole", 3)
    [line] = reward_table.cell("cartpole", "-", "constant", "quick", 3)
    guess = np.mean([env.reward(episode.states[1:]).mean() for episode in train])
    truth = np.array([env.reward(episode.states[1:]).mean() for episode in test])
    assert line["mean"] == pytest.approx(np.mean((truth - guess) ** 2))
