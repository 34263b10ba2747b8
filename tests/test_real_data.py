"""Tests on real data: skipped with a reason where there are none, and nowhere else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

@pytest.mark.data
@pytest.mark.parametrize("i", range(3))
def test_reads(data_folder, i):
    assert data_folder("flights").name == "flights"

def test_uses_the_fixture_only(data_folder):
    data_folder("flights")

@pytest.mark.data
def test_gives_up(data_folder):
    data_folder("flights")
    pytest.skip("for a reason of its own")

def test_other():
    pytest.skip("has nothing to do with data")
"""


@pytest.fixture
def run(tmp_path):
    """Run the tests above in a repository of their own with this repository's conftest."""
    folder = tmp_path / "repository" / "tests"
    folder.mkdir(parents=True)
    (folder / "conftest.py").write_bytes((Path(__file__).parent / "conftest.py").read_bytes())
    (folder / "test_some.py").write_text(TESTS)
    # The real one, which the conftest imports, takes seconds in every process.
    (folder.parent / "torch.py").write_text("def set_num_threads(n): ...")

    def run(*options, **given):
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "TRAJL"))}
        command = [sys.executable, "-m", "pytest", "--strict-markers", "-ra", *options]
        return subprocess.run(
            [*command, "-p", "no:cacheprovider", f"--rootdir={folder.parent}", str(folder)],
            env=environment | given,
            cwd=folder.parent,
            capture_output=True,
            text=True,
            timeout=120,
        )

    return run


def test_without_data_they_are_skipped_and_the_run_says_why(run, tmp_path):
    done = run("-n", "2")
    assert done.returncode == 0, done.stdout
    reason = f"no folder {tmp_path / 'shared' / 'data'}"
    assert f"data tests: 0 ran, 5 skipped ({reason})" in done.stdout.splitlines()


def test_with_data_a_skip_is_a_failure(run, tmp_path):
    (tmp_path / "shared" / "data" / "flights").mkdir(parents=True)
    done = run("-n", "2")
    assert done.returncode == 1
    assert "data tests: 5 ran, 0 skipped" in done.stdout.splitlines()
    assert "1 failed, 4 passed, 1 skipped" in done.stdout
    assert "test_gives_up was skipped although its data are in" in done.stdout


def test_a_run_without_any_says_so(run):
    done = run("-k", "test_other")
    assert done.returncode == 0
    assert "data tests: none selected" in done.stdout.splitlines()


def test_a_folder_that_was_named_must_be_there(run, tmp_path):
    done = run(TRAJLEARN_TEST_DATA=str(tmp_path / "nowhere"))
    assert done.returncode == 1
    assert "5 failed, 1 skipped" in done.stdout
    assert "nowhere is to hold the data of the tests" in done.stdout
