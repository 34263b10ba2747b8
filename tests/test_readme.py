"""The README says what the committed results say."""

from pathlib import Path

import pytest

from benchmarks._results import read_json
from benchmarks.paper import reward_table

ROOT = Path(__file__).parent.parent


def test_the_reward_table_is_the_committed_one():
    result = read_json(ROOT / "benchmarks/paper/results/reward-table/cartpole.json")
    assert result["mode"] == "full"
    assert len(result["seeds"]) >= 3
    expected = reward_table.brief("cartpole", result["records"])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert expected in readme, f"README.md needs this table:\n{expected}"


@pytest.mark.parametrize("command", ["make table", "make test"])
def test_the_two_commands_are_there(command):
    assert command in (ROOT / "README.md").read_text(encoding="utf-8")
    target = command.split()[1]
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
