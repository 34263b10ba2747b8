"""The README says what the committed results say."""

import re
from pathlib import Path

import pytest

from benchmarks._results import read_json
from benchmarks.paper._command import read_tables
from benchmarks.paper._reward_page import brief

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


@pytest.mark.parametrize("command", ["make table", "make test"])
def test_the_two_commands_are_there(command):
    assert command in README
    target = command.split()[1]
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
