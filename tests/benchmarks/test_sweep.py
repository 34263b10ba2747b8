"""Resumable sweeps: nothing finished is lost or repeated."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks._results import provenance, read_json, write_json
from benchmarks._sweep import run_cells

ROOT = Path(__file__).parent.parent.parent


def square(x, log):
    with open(log, "a") as file:
        file.write(f"{x}\n")
    return {"square": x * x}


def fragile(x, limit):
    if x > limit:
        raise RuntimeError("broken cell")
    return x


def test_results_come_in_order_and_are_not_repeated(tmp_path):
    log = str(tmp_path / "log")
    cells = [{"x": x, "log": log} for x in (3, 1, 2)]
    first = run_cells(cells, square, tmp_path / "cells")
    again = run_cells(cells, square, tmp_path / "cells", n_jobs=2)
    assert first == again == [{"square": 9}, {"square": 1}, {"square": 4}]
    assert Path(log).read_text().split() == ["3", "1", "2"]


def test_two_processes_give_the_same(tmp_path):
    cells = [{"x": x, "log": str(tmp_path / "log")} for x in range(4)]
    assert run_cells(cells, square, tmp_path / "a", n_jobs=2) == run_cells(
        cells, square, tmp_path / "b"
    )


def test_a_failing_cell_keeps_the_finished_ones(tmp_path):
    cells = [{"x": x, "limit": 1} for x in range(3)]
    with pytest.raises(RuntimeError, match="broken cell"):
        run_cells(cells, fragile, tmp_path)
    assert len(list(tmp_path.glob("*.json"))) == 2


SLOW = """
import sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
from benchmarks._sweep import run_cells
import sweep_cells
run_cells([{{"x": x, "log": {log!r}}} for x in range(4)], sweep_cells.slow, Path({folder!r}))
"""
CELLS = """
import time
def slow(x, log):
    with open(log, "a") as file:
        file.write(f"{x}\\n")
    time.sleep(0.3)
    return x
"""


def test_killed_at_any_moment_it_repeats_only_the_cell_in_flight(tmp_path):
    (tmp_path / "sweep_cells.py").write_text(CELLS)
    log, folder = tmp_path / "log", tmp_path / "cells"
    code = SLOW.format(root=str(ROOT), log=str(log), folder=str(folder))
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment)
    deadline = time.monotonic() + 60
    while len(list(folder.glob("*.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    for path in folder.glob("*.json"):
        json.loads(path.read_text())
    done = len(list(folder.glob("*.json")))
    assert 2 <= done < 4
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    runs = [int(line) for line in log.read_text().split()]
    assert sorted(set(runs)) == [0, 1, 2, 3]
    assert len(runs) <= 5
    assert all(runs.count(x) == 1 for x in range(done))


def test_json_keeps_infinities_and_is_written_whole(tmp_path):
    path = tmp_path / "deep" / "file.json"
    write_json(path, {"a": np.inf, "b": [np.float64(1 / 3), np.int64(2)], "c": -np.inf})
    assert read_json(path) == {"a": np.inf, "b": [0.33333, 2], "c": -np.inf}
    assert [p.name for p in path.parent.iterdir()] == ["file.json"]


def test_provenance_names_versions_and_mode():
    facts = provenance("quick", [0], steps=3)
    assert facts["mode"] == "quick"
    assert facts["settings"] == {"steps": 3}
    assert {"numpy", "torch", "trajlearn"} <= set(facts["packages"])
