"""Resumable sweeps: every finished cell is stored at once, so a killed run repeats none."""

import hashlib
import json
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from benchmarks._results import plain, read_json, write_json

Cell = dict[str, Any]


class Outcome(NamedTuple):
    """What became of a cell: its result, or the traceback of its failure."""

    number: int
    result: Any = None
    failure: str | None = None


def run_cells(
    cells: Iterable[Cell],
    function: Callable[..., Any],
    folder: Path,
    *,
    n_jobs: int = 1,
    description: str = "cells",
    scheduler: str | None = None,
    local_workers: int | None = None,
    fresh: bool = False,
) -> list[Any]:
    """Results of ``function(**cell)`` for every cell, in order.

    This process alone writes, each result as it arrives: workers need not share its disk. A
    process that is killed loses the cells in flight, and no other.

    Parameters
    ----------
    cells : iterable of dict
        Arguments that JSON can hold; they alone name the cell's file.
    function : callable
        At module level, so that a worker process can import it.
    folder : Path
        One file a finished cell.
    n_jobs : int
        Processes.
    description : str
        Of the progress bar.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``"tcp://node:8786"``, whose workers compute.
    local_workers : int, optional
        Processes of a Dask cluster of this machine that compute, and end with the sweep.
    fresh : bool
        Whether to forget what earlier sweeps stored of these cells.

    Raises
    ------
    ValueError
        If `scheduler` and `local_workers` are both given.
    ImportError
        If Dask is asked for and missing.
    RuntimeError
        After all cells, if some of them failed: the others are stored.
    """
    if scheduler is not None and local_workers is not None:
        raise ValueError(
            f"scheduler={scheduler!r} and local_workers={local_workers} both say where to "
            "compute: give one of them."
        )
    cells = list(cells)
    paths = [folder / f"{_name(cell)}.json" for cell in cells]
    wanted = dict(zip(paths, cells, strict=True))
    if fresh:
        for path in paths:
            path.unlink(missing_ok=True)
    name = function.__qualname__
    todo = [(path, cell) for path, cell in wanted.items() if not _finished(path, name)]
    failures: dict[int, str] = {}
    bar = tqdm(total=len(wanted), initial=len(wanted) - len(todo), desc=description, unit="cell")
    with bar, _outcomes(todo, function, n_jobs, scheduler, local_workers) as outcomes:
        for number, result, failure in outcomes:
            path, cell = todo[number]
            if failure is None:
                write_json(path, {"function": name, "cell": cell, "result": result})
            else:
                failures[number] = failure
                bar.set_postfix(failed=len(failures))
            bar.update()
    if failures:
        first = min(failures)
        raise RuntimeError(
            f"{len(failures)} of {len(wanted)} cells failed; the others are stored, and starting "
            f"again repeats only the failed ones. The first: {todo[first][1]}\n\n{failures[first]}"
        )
    return [read_json(path)["result"] for path in paths]


def _run(number: int, function: Callable[..., Any], cell: Cell) -> Outcome:
    """Compute one cell, in a worker, on one thread."""
    import torch

    torch.set_num_threads(1)
    with threadpool_limits(1), parallel_config("sequential"):
        try:
            result = plain(function(**cell))
            json.dumps(result)  # what no file can hold fails here, as the cell's own failure
        except Exception:
            return Outcome(number, failure=traceback.format_exc())
    return Outcome(number, result)


def _lost(arguments: tuple[Any, ...], error: BaseException) -> Outcome:
    """Outcome of a `_run` that did not come to its end."""
    return Outcome(arguments[0], failure="".join(traceback.format_exception(error)))


@contextmanager
def _outcomes(
    todo: list[tuple[Path, Cell]],
    function: Callable[..., Any],
    n_jobs: int,
    scheduler: str | None,
    local_workers: int | None,
) -> Iterator[Iterable[Outcome]]:
    """Outcomes of cells as they arrive, from processes of joblib or a Dask cluster."""
    if not todo:
        yield ()
        return
    local = scheduler is None and local_workers is None
    # what is handed out early, the processes of a sweep that was killed would still compute; a
    # cluster forgets it, and can share it with workers that come later
    parallel_as = {"batch_size": 1, "pre_dispatch": "n_jobs" if local else "all"}
    with ExitStack() as stack:
        if local:
            backend = parallel_config("loky", n_jobs=n_jobs, inner_max_num_threads=1)
        else:
            # only here: every worker imports this module
            from trajlearn.trajectories._extras import import_extra

            import_extra("distributed", "dask", by="a sweep on a Dask cluster")
            from benchmarks._cluster import cluster_backend

            cluster = cluster_backend(scheduler, local_workers, [_run, function], _lost)
            backend = parallel_config(stack.enter_context(cluster))
        stack.enter_context(backend)
        work = (delayed(_run)(i, function, cell) for i, (_, cell) in enumerate(todo))
        outcomes = Parallel(return_as="generator_unordered", **parallel_as)(work)
        yield stack.enter_context(closing(outcomes))


def _finished(path: Path, function: str) -> bool:
    """Whether a file holds a result of this function.

    A damaged file (a disk that was full, say) does not.
    """
    try:
        stored = read_json(path)
    except (FileNotFoundError, ValueError):
        return False
    if not isinstance(stored, dict) or "result" not in stored:
        return False
    return stored.get("function", function) == function


def _name(cell: Cell) -> str:
    text = json.dumps(cell, sort_keys=True)
    readable = "-".join(str(value) for value in cell.values() if isinstance(value, (str, int)))
    return f"{readable[:60]}-{hashlib.sha256(text.encode()).hexdigest()[:10]}".replace("/", "_")
