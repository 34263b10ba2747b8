"""Resumable sweeps: nothing finished is lost or repeated, wherever the cells run."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from joblib import Parallel, delayed

from benchmarks._results import provenance, read_json, write_json
from benchmarks._sweep import _name, run_cells

ROOT = Path(__file__).parent.parent.parent


def square(x, log):
    with open(log, "a") as file:
        file.write(f"{x}\n")
    return {"square": x * x}


def fragile(x, limit, log):
    with open(log, "a") as file:
        file.write(f"{x}\n")
    if x in json.loads(Path(limit).read_text()):
        raise KeyError(f"broken cell {x}")
    return x


def deadly(x, log):
    if x == 1:
        os._exit(1)
    return square(x, log)


def unstorable(x):
    return object() if x else 0


def interrupted(x, log):
    if x == 1:
        raise KeyboardInterrupt
    return square(x, log)


def threads(x):
    import torch
    from threadpoolctl import threadpool_info

    pools = [pool["num_threads"] for pool in threadpool_info()]
    nested = Parallel(n_jobs=2)(delayed(os.getpid)() for _ in range(4))
    return {"threads": [torch.get_num_threads(), *pools], "alone": set(nested) == {os.getpid()}}


def witness(x, folder):
    """Whether the first cell is stored while this one still runs."""
    deadline = time.monotonic() + 20
    while x and not any(Path(folder).glob("0-*.json")) and time.monotonic() < deadline:
        time.sleep(0.01)
    return any(Path(folder).glob("0-*.json"))


def little_fit(seed, folder):
    """A fitted linear system to the last bit, and the process that fitted it.

    It waits for a cell of another process, so that two workers must share the sweep.
    """
    from sklearn.linear_model import Ridge

    from trajlearn import OneStepRegressor, TrajectoryDataset

    rng = np.random.default_rng(seed)
    step = np.array([[0.9, 0.2], [-0.1, 0.8]])
    states, actions = np.empty((6, 13, 2)), rng.normal(size=(6, 12, 1))
    states[:, 0] = rng.normal(size=(6, 2))
    for t in range(12):
        states[:, t + 1] = states[:, t] @ step.T + 0.1 * actions[:, t]
    ds = TrajectoryDataset.from_arrays(list(states), actions=list(actions))
    model = OneStepRegressor(Ridge(1e-3), rollout_actions="logged").fit(ds)
    if folder is not None:
        (Path(folder) / str(os.getpid())).touch()
        deadline = time.monotonic() + 60
        while len(list(Path(folder).iterdir())) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
    predicted = np.asarray(model.predict(ds[:1]))
    return {"bits": [x.hex() for x in predicted.ravel()], "process": os.getpid()}


def test_results_come_in_order_and_are_not_repeated(tmp_path):
    log = str(tmp_path / "log")
    cells = [{"x": x, "log": log} for x in (3, 1, 2)]
    first = run_cells(cells, square, tmp_path / "cells")
    again = run_cells(cells, square, tmp_path / "cells", n_jobs=2)
    assert first == again == [{"square": 9}, {"square": 1}, {"square": 4}]
    assert Path(log).read_text().split() == ["3", "1", "2"]


def test_the_same_cell_twice_is_computed_once(tmp_path):
    log = str(tmp_path / "log")
    cells = [{"x": x, "log": log} for x in (3, 1, 3)]
    assert [r["square"] for r in run_cells(cells, square, tmp_path / "cells")] == [9, 1, 9]
    assert Path(log).read_text().split() == ["3", "1"]


def test_two_processes_give_the_same(tmp_path):
    cells = [{"x": x, "log": str(tmp_path / "log")} for x in range(4)]
    assert run_cells(cells, square, tmp_path / "a", n_jobs=2) == run_cells(
        cells, square, tmp_path / "b"
    )


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_a_failing_cell_neither_stops_nor_loses_the_others(tmp_path, n_jobs):
    limit, log, folder = tmp_path / "limit", tmp_path / "log", tmp_path / "cells"
    limit.write_text("[1, 3]")
    cells = [{"x": x, "limit": str(limit), "log": str(log)} for x in range(5)]
    with pytest.raises(RuntimeError) as caught:
        run_cells(cells, fragile, folder, n_jobs=n_jobs)
    message = str(caught.value)
    assert "2 of 5 cells failed" in message
    assert "'x': 1," in message  # the first in order, not in time
    assert "in fragile" in message  # its traceback
    assert "KeyError: 'broken cell 1'" in message
    assert "repeats only the failed" in message
    assert len(list(folder.iterdir())) == 3
    limit.write_text("[]")
    assert run_cells(cells, fragile, folder, n_jobs=n_jobs) == [0, 1, 2, 3, 4]
    assert sorted(log.read_text().split()) == ["0", "1", "1", "2", "3", "3", "4"]


def test_a_result_is_stored_while_other_cells_still_run(tmp_path):
    cells = [{"x": x, "folder": str(tmp_path)} for x in range(4)]
    assert run_cells(cells, witness, tmp_path, n_jobs=2)[1:] == [True, True, True]


def test_a_result_that_no_file_can_hold_is_a_failure_of_its_cell(tmp_path):
    with pytest.raises(RuntimeError, match=r"1 of 2 cells failed(.|\n)*not JSON serializable"):
        run_cells([{"x": 1}, {"x": 0}], unstorable, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [f"{_name({'x': 0})}.json"]


def test_an_interrupt_stops_at_once_and_keeps_what_is_finished(tmp_path):
    log = tmp_path / "log"
    cells = [{"x": x, "log": str(log)} for x in range(4)]
    with pytest.raises(KeyboardInterrupt):
        run_cells(cells, interrupted, tmp_path / "cells")
    assert log.read_text().split() == ["0"]
    assert len(list((tmp_path / "cells").iterdir())) == 1


@pytest.mark.parametrize("damage", ["", '{"cell": {"x": 3', "\0\0\0", "3", '{"cell": 1}', "\udcff"])
def test_a_damaged_file_is_computed_anew(tmp_path, damage):
    cells = [{"x": x, "log": str(tmp_path / "log")} for x in (3, 1)]
    first = run_cells(cells, square, tmp_path / "cells")
    path = tmp_path / "cells" / f"{_name(cells[0])}.json"
    whole = path.read_bytes()
    path.write_bytes(damage.encode(errors="surrogateescape"))
    assert run_cells(cells, square, tmp_path / "cells") == first
    assert path.read_bytes() == whole
    assert (tmp_path / "log").read_text().split() == ["3", "1", "3"]


def test_fresh_forgets_these_cells_and_no_other(tmp_path):
    log = tmp_path / "log"
    cells = [{"x": x, "log": str(log)} for x in (3, 1)]
    run_cells(cells, square, tmp_path / "cells")
    run_cells(cells[:1], square, tmp_path / "cells", fresh=True)
    run_cells(cells, square, tmp_path / "cells")
    assert log.read_text().split() == ["3", "1", "3"]


def test_another_function_with_the_same_arguments_is_not_mistaken_for_the_first(tmp_path):
    cell = {"x": 0, "log": str(tmp_path / "log")}
    assert run_cells([cell], square, tmp_path / "cells") == [{"square": 0}]
    cell_file = tmp_path / "cells" / f"{_name(cell)}.json"
    assert json.loads(cell_file.read_text())["function"] == "square"
    run_cells([cell], deadly, tmp_path / "cells")
    assert json.loads(cell_file.read_text())["function"] == "deadly"


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_a_cell_has_one_thread_and_one_process(tmp_path, n_jobs):
    for result in run_cells([{"x": x} for x in range(2)], threads, tmp_path, n_jobs=n_jobs):
        assert set(result["threads"]) == {1}
        assert result["alone"]


SLOW = """
import sys
from pathlib import Path
sys.path.insert(0, {root!r})
from benchmarks._sweep import run_cells
import sweep_cells
cells = [{{"x": x, "log": {log!r}}} for x in range({n})]
run_cells(cells, sweep_cells.slow, Path({folder!r}), n_jobs={n_jobs})
"""
CELLS = """
import time
def slow(x, log):
    with open(log, "a") as file:
        file.write(f"{x}\\n")
    time.sleep(0.3)
    return x
"""


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_killed_at_any_moment_it_repeats_only_the_cells_in_flight(tmp_path, n_jobs):
    (tmp_path / "sweep_cells.py").write_text(CELLS)
    # the real one takes each process seconds to import, and this is about files
    (tmp_path / "torch.py").write_text("def set_num_threads(n): ...\n")
    log, folder, n = tmp_path / "log", tmp_path / "cells", 6 * n_jobs
    code = SLOW.format(root=str(ROOT), log=str(log), folder=str(folder), n=n, n_jobs=n_jobs)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=environment, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while len(list(folder.glob("*.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    # orphans finish the cells they had begun, and begin no other
    time.sleep(1.0)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    done = {json.loads(path.read_text())["result"] for path in folder.glob("*.json")}
    assert 2 <= len(done) < n
    # in flight: running, or on the way from the worker to the disk
    in_flight = 2 * n_jobs
    assert len(log.read_text().split()) <= len(done) + in_flight
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    runs = [int(line) for line in log.read_text().split()]
    assert sorted(set(runs)) == list(range(n))
    assert len(runs) <= n + in_flight
    assert all(runs.count(x) == 1 for x in done)


def test_two_places_to_compute_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"tcp://nowhere:1.*local_workers=2.*give one"):
        run_cells([], square, tmp_path, scheduler="tcp://nowhere:1", local_workers=2)


def test_without_dask_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r'pip install "trajlearn\[dask\]"'):
        run_cells([{"x": 1}], square, tmp_path, local_workers=2)


@pytest.fixture(scope="module")
def cluster():
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    quick_to_give_up = {"distributed.scheduler.allowed-failures": 0}
    quiet = {
        "dashboard_address": "127.0.0.1:0",
        "silence_logs": logging.CRITICAL,
        "memory_limit": 0,
    }
    with (
        dask.config.set(quick_to_give_up),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, **quiet) as cluster,
    ):
        yield cluster


def serial_bits(folder):
    cells = [{"seed": seed, "folder": None} for seed in range(4)]
    return [result["bits"] for result in run_cells(cells, little_fit, folder)]


def meeting(tmp_path):
    """Cells that come to an end only in two processes."""
    (tmp_path / "meeting").mkdir()
    return [{"seed": seed, "folder": str(tmp_path / "meeting")} for seed in range(4)]


def test_local_dask_workers_give_the_bits_of_the_serial_run(tmp_path, capfd):
    pytest.importorskip("distributed")
    results = run_cells(meeting(tmp_path), little_fit, tmp_path / "dask", local_workers=2)
    assert [result["bits"] for result in results] == serial_bits(tmp_path / "serial")
    processes = {result["process"] for result in results}
    assert len(processes) == 2
    assert os.getpid() not in processes
    for process in processes:  # they end with the sweep
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    chatter = capfd.readouterr().err
    assert "4/4" in chatter
    assert "distributed" not in chatter
    assert "arning" not in chatter


def test_a_dask_scheduler_gives_the_bits_of_the_serial_run(tmp_path, cluster):
    address = cluster.scheduler_address
    cells = meeting(tmp_path)
    results = run_cells(cells, little_fit, tmp_path / "dask", scheduler=address)
    assert [result["bits"] for result in results] == serial_bits(tmp_path / "serial")
    assert len({result["process"] for result in results} - {os.getpid()}) == 2
    stored = sorted(path.name for path in (tmp_path / "dask").iterdir())
    assert stored == sorted(f"{_name(cell)}.json" for cell in cells)
    # the cluster outlives the sweep
    assert len(cluster.scheduler_info["workers"]) == 2


def test_on_a_cluster_too_a_failing_cell_stops_no_other(tmp_path, cluster):
    limit, log = tmp_path / "limit", tmp_path / "log"
    limit.write_text("[1]")
    cells = [{"x": x, "limit": str(limit), "log": str(log)} for x in range(4)]
    where = {"scheduler": cluster.scheduler_address}
    with pytest.raises(RuntimeError, match=r"1 of 4 cells(.|\n)*KeyError: 'broken cell 1'"):
        run_cells(cells, fragile, tmp_path / "cells", **where)
    limit.write_text("[]")
    assert run_cells(cells, fragile, tmp_path / "cells", **where) == [0, 1, 2, 3]


def test_a_worker_that_dies_fails_its_cell_instead_of_waiting_for_ever(tmp_path, cluster):
    cells = [{"x": x, "log": str(tmp_path / "log")} for x in range(3)]
    where = {"scheduler": cluster.scheduler_address}
    # with it may fail the cell that stood next in the worker's queue
    with pytest.raises(RuntimeError, match=r"[12] of 3 cells failed(.|\n)*KilledWorker"):
        run_cells(cells, deadly, tmp_path / "cells", **where)
    others = [cells[0], cells[2]]
    assert run_cells(others, deadly, tmp_path / "cells", **where) == [{"square": 0}, {"square": 4}]


def test_workers_without_the_checkout_are_told_where_to_start(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(square, "__module__", "not_on_any_worker")
    cell = {"x": 1, "log": str(tmp_path / "log")}
    with pytest.raises(RuntimeError, match=r"cannot import not_on_any_worker.*same checkout"):
        run_cells([cell], square, tmp_path, scheduler=cluster.scheduler_address)


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
