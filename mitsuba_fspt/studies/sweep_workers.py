"""Rendering the points of a sweep in other processes of this machine, or on a dask.distributed cluster.

If a process ends while it renders a point (out of memory, killed), only this point is rendered again.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import TYPE_CHECKING, Any

from ..images.image import Image
from ..runtime.errors import BackendError, FsptError
from .sweep_point import SweepPoint

if TYPE_CHECKING:
    from distributed import Client

TRIES = 3  # a point fails if this many processes have ended while they rendered it
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


def _lost_workers(point: Any, verb: str = "sweep") -> BackendError:
    """Error for a point during whose rendering `TRIES` processes have ended."""
    return BackendError(
        f"{verb}: {TRIES} worker processes died at {point.label}. Give it more memory, or fewer jobs at a time."
    )


# ---------------------------------------------------------------------- processes of this machine


def images_of_processes(points: list[SweepPoint], jobs: int) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are finished, from at most `jobs` processes that share the cores.

    In place of an image: the FsptError that the rendering raised, or BackendError if `TRIES` processes have ended.
    """
    waiting, ended = list(points), Counter[str]()
    jobs = min(jobs, len(points))
    workers: dict[object, _Worker] = {}
    try:
        while waiting or workers:
            while waiting and len(workers) < jobs:
                worker = _Worker(share_of_cores(jobs))
                workers[worker.connection] = worker
                worker.take_from(waiting)
            for connection in wait([worker.connection for worker in workers.values()]):
                worker = workers[connection]
                point, image = worker.point, worker.image()
                if image is None:
                    workers.pop(connection).end()
                    ended[point.file] += 1
                    if ended[point.file] < TRIES:
                        waiting.insert(0, point)
                        continue
                    image = _lost_workers(point)
                elif waiting:
                    worker.take_from(waiting)
                else:
                    workers.pop(connection).end()
                yield point, image
    finally:
        for worker in workers.values():
            worker.end()


class _Worker:
    """A process that renders one point after the other; `point` is the present one."""

    point: SweepPoint

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would share Dr.Jit's threads
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, threads), daemon=True)
        with ctrl_c_blocked():
            self._process.start()
        theirs.close()

    def take_from(self, waiting: list[SweepPoint]) -> None:
        """Remove a point from `waiting` and start it, preferably one for which the process has loaded the scene."""
        geometry = getattr(getattr(self, "point", None), "geometry", None)
        self.point = next((point for point in waiting if point.geometry == geometry), waiting[0])
        waiting.remove(self.point)
        with suppress(OSError):  # the process has ended; `image` returns None then
            self.connection.send(self.point)

    def image(self) -> Image | FsptError | None:
        """Wait for the image of `point` or its FsptError; None if the process has ended.

        Raises any other exception of the process.
        """
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, Exception) and not isinstance(answer, FsptError):
            raise answer
        return answer

    def end(self) -> None:
        """Terminate the process, wait for its end and free its resources."""
        self._process.terminate()
        self._process.join()
        self._process.close()
        self.connection.close()


def _work(connection: Connection, threads: int) -> None:
    """The main function of a worker process: receives points, sends back images or errors."""
    from .scene_cache import SceneCache

    Thread(target=_end_with_parent, daemon=True).start()
    cache = SceneCache(threads=threads, quiet=True)
    with suppress(EOFError, BrokenPipeError):  # the main process has ended
        while True:
            point = connection.recv()
            try:
                answer: Image | Exception = cache.image_or_error(point)
            except Exception as error:  # not every exception can be pickled
                answer = RuntimeError(f"{point.label}: {type(error).__name__}: {error}")
            connection.send(answer)


def _end_with_parent() -> None:
    """End this process as soon as the main process has ended, which cannot do it itself if it was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# ---------------------------------------------------------------------- a cluster


def images_of_cluster(
    points: list[SweepPoint], scheduler: str, jobs: int | None
) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are finished; parameters and errors as of `results_of_cluster`."""
    yield from results_of_cluster(points, scheduler, jobs, _image)


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
                result = _lost_workers(point, verb)
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


def _image(point: SweepPoint, threads: int | None) -> Image | FsptError:
    """The image of a point or its error. Runs on a worker, which keeps its scene cache from point to point."""
    from distributed import get_worker

    from .scene_cache import SceneCache

    worker = get_worker()
    threads = worker.state.nthreads if threads is None else threads
    return vars(worker).setdefault("fspt_scene_cache", SceneCache(threads=threads, quiet=True)).image_or_error(point)
