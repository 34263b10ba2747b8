"""A Dask cluster as a backend of joblib: one that is running, or processes of this machine."""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any

import distributed
from distributed.utils import silence_logging_cmgr

# the class behind parallel_config(backend="dask"), which has no public name
from joblib._dask import DaskDistributedBackend


class ClusterBackend(DaskDistributedBackend):
    """joblib's Dask backend, mended where it would wait for ever or not use the cluster.

    Parameters
    ----------
    client : distributed.Client
    lost : callable
        ``lost(task, error)``: the result of a task that ended without one, because its worker
        died or could not read it. joblib's backend never reports such a task.
    """

    def __init__(self, client: Any, lost: Callable[[tuple[Any, ...], BaseException], Any]) -> None:
        super().__init__(client=client)
        self.lost = lost

    def submit(self, func: Any, callback: Any = None) -> Any:
        future = super().submit(func, callback)

        def report(done: Any) -> None:
            error = done.exception()
            if error is not None:
                callback([self.lost(arguments, error) for _, arguments, _ in func.items])

        future.add_done_callback(report)
        return future

    def effective_n_jobs(self, n_jobs: int) -> int:
        # joblib runs a single job in this process, and not on the cluster's only worker
        return max(2, super().effective_n_jobs(n_jobs))


@contextmanager
def cluster_backend(
    scheduler: str | None,
    local_workers: int | None,
    functions: list[Callable[..., Any]],
    lost: Callable[[tuple[Any, ...], BaseException], Any],
) -> Iterator[ClusterBackend]:
    """Backend on the cluster at an address, or on a new one of worker processes here.

    Raises
    ------
    RuntimeError
        If a worker cannot import the modules of `functions`, which it is to compute.
    """
    with ExitStack() as stack:
        # workers that leave make the others complain; what goes wrong with a task, we report
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))
        address: Any = scheduler
        if scheduler is None:
            address = stack.enter_context(_local(local_workers))
        client = stack.enter_context(distributed.Client(address, set_as_default=False))
        address = client.scheduler.address
        # what is defined in __main__ travels whole
        for module in {function.__module__ for function in functions} - {"__main__"}:
            try:
                client.run(import_module, module)
            except ImportError as error:
                raise RuntimeError(
                    f"a worker of {address} cannot import {module} ({error}). Start the workers in "
                    "the root of the same checkout, with the same Python environment: "
                    f"PYTHONPATH=. dask worker {address} --nthreads 1"
                ) from error
        yield ClusterBackend(client, lost)


def _local(n_workers: int | None) -> Any:
    return distributed.LocalCluster(
        n_workers=n_workers,
        threads_per_worker=1,
        processes=True,
        # no dashboard; and without an address its server would claim a port that may be taken
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )
