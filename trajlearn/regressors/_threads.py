"""Where one thread is faster than several: small matrix products, and workers side by side."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from joblib import Parallel, delayed, effective_n_jobs
from threadpoolctl import threadpool_limits

# below this many operations a training step is faster on one thread (waiting costs more)
_WORTH_THREADS = 1e9


@contextmanager
def threads_for(flops: float) -> Iterator[None]:
    """Limit torch to one thread while steps are small; restore the setting afterwards."""
    before = torch.get_num_threads()
    # also when torch reports 1: inside an outer limit its MKL may still have more
    limited = flops < _WORTH_THREADS
    if limited:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if limited:
            torch.set_num_threads(before)


def by_workers(
    work: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], n_jobs: int | None
) -> Iterator[Any]:
    """``work(*job)`` of each job, in their order.

    Several workers have one thread each: with more they would wait for one another.

    Parameters
    ----------
    work : callable
    jobs : sequence of tuple
    n_jobs : int or None
        As in joblib.
    """
    parallel = effective_n_jobs(n_jobs) > 1
    # here for workers that are threads, in `_work` for those that are processes
    with _one_thread() if parallel else nullcontext():
        yield from Parallel(n_jobs=n_jobs, return_as="generator")(
            delayed(_work)(parallel, work, job) for job in jobs
        )


def _work(parallel: bool, work: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    with _one_thread() if parallel else nullcontext():
        return work(*job)


@contextmanager
def _one_thread() -> Iterator[None]:
    with threadpool_limits(limits=1), threads_for(0):
        yield
