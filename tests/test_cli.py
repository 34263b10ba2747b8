"""The command line."""

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from trajlearn import cli

RUNNER = CliRunner()


def test_help_names_the_command():
    result = RUNNER.invoke(cli.app, ["--help"])
    assert result.exit_code == 0
    assert "reproduce" in result.output


def test_list_shows_every_benchmark_with_its_first_line():
    result = RUNNER.invoke(cli.app, ["reproduce", "--list"])
    assert result.exit_code == 0
    assert "reward-table" in result.output
    assert "Table I" in result.output


def test_an_unknown_name_is_refused_with_the_known_ones():
    result = RUNNER.invoke(cli.app, ["reproduce", "nonsense"])
    assert result.exit_code == 2
    assert "reward-table" in result.output


def test_no_name_shows_help():
    assert RUNNER.invoke(cli.app, ["reproduce", "--help"]).exit_code == 0
    assert RUNNER.invoke(cli.app, ["reproduce"]).exit_code == 2


def test_options_go_to_the_benchmark_and_its_exit_code_comes_back(monkeypatch):
    ran = []

    def run(command, **settings):
        ran.append((command, settings))
        return subprocess.CompletedProcess(command, 3)

    monkeypatch.setattr(cli.subprocess, "run", run)
    result = RUNNER.invoke(cli.app, ["reproduce", "reward-table", "--seeds", "2", "--help"])
    assert result.exit_code == 3
    [(command, settings)] = ran
    module = "benchmarks.paper.reward_table"
    assert command == [sys.executable, "-m", module, "--seeds", "2", "--help"]
    assert (settings["cwd"] / "benchmarks").is_dir()


def test_outside_a_checkout_it_says_so(monkeypatch, tmp_path):
    package = tmp_path / "site-packages" / "trajlearn"
    package.mkdir(parents=True)
    monkeypatch.setattr(cli, "__file__", str(package / "cli.py"))
    result = RUNNER.invoke(cli.app, ["reproduce", "reward-table"])
    assert result.exit_code == 2
    assert "Clone the source" in result.output


@pytest.mark.parametrize("folder", ["paper"])
def test_every_benchmark_has_a_summary(folder):
    for path in (Path(__file__).parent.parent / "benchmarks" / folder).glob("[a-z]*.py"):
        assert cli._summary(path).endswith((".", "?")), path
