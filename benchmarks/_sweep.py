"""Resumable sweeps: every finished cell is stored at once, so a killed run repeats none."""

import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed, parallel_config
from tqdm import tqdm

from benchmarks._results import read_json, write_json

Cell = dict[str, Any]


def run_cells(
    cells: Iterable[Cell],
    function: Callable[..., Any],
    folder: Path,
    *,
    n_jobs: int = 1,
    description: str = "cells",
    scheduler: str | None = None,
    local_workers: int | None = None,
) -> list[Any]:
    """Results of ``function(**cell)`` for every cell, in order.

    Parameters
    ----------
    cells : iterable of dict
        Arguments that JSON can hold; they name the cell's file.
    function : callable
        At module level, so that a worker process can import it.
    folder : Path
        One file a finished cell; delete it to start afresh.
    n_jobs : int
        Processes.
    description : str
        Of the progress bar.
    """
    cells = list(cells)
    paths = [folder / f"{_name(cell)}.json" for cell in cells]
    todo = [(cell, path) for cell, path in zip(cells, paths, strict=True) if not path.exists()]
    bar = tqdm(total=len(cells), initial=len(cells) - len(todo), desc=description, unit="cell")
    with bar, parallel_config("loky", inner_max_num_threads=1):
        work = (delayed(_run)(function, cell, path) for cell, path in todo)
        for _ in Parallel(n_jobs=n_jobs, return_as="generator_unordered")(work):
            bar.update()
    return [read_json(path)["result"] for path in paths]


def _run(function: Callable[..., Any], cell: Cell, path: Path) -> None:
    import torch

    torch.set_num_threads(1)
    write_json(path, {"cell": cell, "result": function(**cell)})


def _name(cell: Cell) -> str:
    text = json.dumps(cell, sort_keys=True)
    readable = "-".join(str(value) for value in cell.values() if isinstance(value, (str, int)))
    return f"{readable[:60]}-{hashlib.sha256(text.encode()).hexdigest()[:10]}".replace("/", "_")
