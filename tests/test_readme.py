"""The README says what the committed results say."""

import re
from pathlib import Path

import pytest

from benchmarks._results import read_json
from benchmarks.paper._command import read_tables
from benchmarks.paper._iterative_tables import result
from benchmarks.paper._reward_page import brief
from benchmarks.regimes._regimes import FRESH

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
REWARDS = "benchmarks/paper/results/reward-table"
CITED = re.findall(rf"<!-- source: {REWARDS}/(\w+)\.json -->", README)


def test_the_reward_tables_are_there():
    stored = {path.stem for path in (ROOT / REWARDS).glob("*.json")}
    assert "cartpole" in CITED
    assert stored == set(CITED), "README.md cites each committed reward table, and no other"


@pytest.mark.parametrize("task", CITED)
def test_a_reward_table_is_the_committed_one(task):
    facts = read_json(ROOT / REWARDS / f"{task}.json")
    assert facts["mode"] == "full"
    assert len(facts["seeds"]) >= 3
    expected = brief(task, read_tables(ROOT / REWARDS, task)[task])
    assert expected in README, f"README.md needs this table:\n{expected}"
    assert f"{REWARDS}/{task}.png" in README


SEARCHES = {"T, distilled from it": "T, distilled", "T, from the trials alone": "T"}


def test_the_table_of_searches_is_the_committed_one():
    folder = ROOT / "benchmarks/paper/results/iterative-learning"
    assert read_json(folder / "cartpole.json")["mode"] == "full"
    found = result(read_tables(folder, "cartpole"))
    head = "| method | trial 1 | trial 2 | trial 3 | trial 5 | trial 10 |"
    rows = README[README.index(head) :].split("\n\n")[0].splitlines()[2:]
    assert len(rows) >= 5
    for row in rows:
        name, *numbers = [cell.strip() for cell in row.strip("|").split("|")]
        median = found.by_trial(SEARCHES.get(name, name), "best_true").median()
        assert numbers == [f"{median[trial]:.3f}" for trial in (1, 2, 3, 5, 10)], name


def test_the_map_of_regimes_is_the_committed_one():
    folder = ROOT / "benchmarks/regimes/results/regimes"
    facts = read_json(folder / "cartpole.json")
    assert facts["mode"] == "full"
    assert len(set(facts["seeds"]) & set(FRESH)) >= 3
    assert f"({(folder / 'regimes.png').relative_to(ROOT)})" in README
    assert (folder / "regimes.png").is_file()


@pytest.mark.parametrize("command", ["make table", "make test"])
def test_the_two_commands_are_there(command):
    assert command in README
    target = command.split()[1]
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
