"""Work in other processes: a dask.distributed cluster, and what all worker processes share.

If a process ends while it works on a point (out of memory, killed), only this point is computed again.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from .errors import BackendError

if TYPE_CHECKING:
    from distributed import Client

TRIES = 3  # a point fails if this many processes have ended while they worked on it
SCHEDULER_TIMEOUT = 10  # s, for a scheduler to answer, and for its first worker to be available
# Options of a cluster on this machine. Its scheduler opens an HTTP port even without a dashboard. Port 0 stands for any
# free port; the default 8787 causes a warning on stderr if another cluster uses it.
LOCAL_CLUSTER: dict[str, Any] = {
    "threads_per_worker": 1,
    "memory_limit": 0,
    "dashboard_address": "127.0.0.1:0",
    "scheduler_kwargs": {"dashboard": False},
}


def share_of_cores(jobs: int) -> int:
    """Number of threads, >= 1, for each of `jobs` processes, so that together they use every core once."""
    return max(1, (os.cpu_count() or 1) // jobs)


@contextmanager
def ctrl_c_blocked() -> Iterator[None]:
    """Context manager: processes and threads started in the block ignore Ctrl-C; the main process ends them instead."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # if it started with the first process, it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def lost_workers(point: Any, verb: str = "sweep") -> BackendError:
    """Error for a point during whose rendering `TRIES` processes have ended."""
    return BackendError(
        f"{verb}: {TRIES} worker processes died at {point.label}. Give it more memory, or fewer jobs at a time."
    )


def results_of_cluster(
    points: list[Any], scheduler: str, jobs: int | None, work: Callable[[Any, int | None], Any], verb: str = "sweep"
) -> Iterator[tuple[Any, Any]]:
    """Points and their results from `work`, in the order they are finished, computed by workers of a dask scheduler.

    Parameters
    ----------
    points : each with a `label`
    scheduler : its address; 'local' starts a scheduler and `jobs` workers on this machine
    jobs : number of workers, for 'local' only
    work : function of a point and a number of threads, None for that of the worker
    verb : first word of messages

    If a worker ends, its points are computed again. In place of a result: the FsptError that `work` returned, or
    BackendError if every worker that tried the point has ended.

    Raises
    ------
    BackendError : dask.distributed is not installed, the scheduler does not answer or has no workers.
    """
    require_dask(verb)
    from distributed import KilledWorker, as_completed

    with _local(jobs or os.cpu_count() or 1) if scheduler == "local" else _remote(scheduler, verb) as (client, threads):
        futures = {client.submit(work, point, threads, pure=False): point for point in points}
        for future in as_completed(list(futures)):
            point = futures.pop(future)
            try:
                result = future.result()
            except KilledWorker:
                result = lost_workers(point, verb)
            except CancelledError as error:
                raise BackendError(
                    f"{verb}: the scheduler '{scheduler}' has gone. Start it and its workers again, and then the same "
                    "command: it goes on with what is missing."
                ) from error
            future.release()
            yield point, result


def require_dask(verb: str = "sweep") -> None:
    """Raise BackendError where dask.distributed is missing."""
    try:
        import distributed  # noqa: F401
    except ImportError as cause:
        raise BackendError(
            f"{verb}: a scheduler needs dask.distributed, which is not installed. pip install 'mitsuba-fspt[cluster]'."
        ) from cause


@contextmanager
def _local(jobs: int) -> Iterator[tuple[Client, int | None]]:
    """A client of a new cluster on this machine, and the number of threads for each of its `jobs` workers."""
    from distributed import Client, LocalCluster

    with ctrl_c_blocked():
        cluster = LocalCluster(n_workers=jobs, **LOCAL_CLUSTER, silence_logs=logging.CRITICAL)
    with cluster, Client(cluster) as client:
        yield client, share_of_cores(jobs)


@contextmanager
def _remote(address: str, verb: str) -> Iterator[tuple[Client, None]]:
    """A client of the scheduler at this address; each worker renders with the threads that it was started with."""
    from distributed import Client

    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT)
    except (OSError, ValueError) as cause:
        raise BackendError(
            f"{verb}: no dask scheduler answers at '{address}'. Start one with 'dask scheduler', or give "
            "--scheduler local."
        ) from cause
    with client, _quiet("distributed.client"):  # a lost connection is reported once, by this package's error
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError as cause:
            raise BackendError(
                f"{verb}: the scheduler '{address}' has no workers. Start some with 'dask worker {address}'."
            ) from cause
        yield client, None


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Context manager that silences the logger of this name, except for critical messages."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
