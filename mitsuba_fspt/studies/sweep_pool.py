"""A sweep on several processes of this machine, any of which may die without taking more than its point along."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Thread

from ..images.image import Image
from ..runtime.errors import BackendError, FsptError
from .sweep_point import SweepPoint

TRIES = 3  # of a point that ends the process which renders it


def images_of_processes(points: list[SweepPoint], jobs: int) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are done, by at most `jobs` processes that share the cores.

    In place of an image what rendering raised of our own, and BackendError where the point ended its process thrice.
    """
    waiting, deaths = list(points), Counter[str]()
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
                    deaths[point.file] += 1
                    if deaths[point.file] < TRIES:
                        waiting.insert(0, point)
                        continue
                    image = died(point)
                elif waiting:
                    worker.take_from(waiting)
                else:
                    workers.pop(connection).end()
                yield point, image
    finally:
        for worker in workers.values():
            worker.end()


def died(point: SweepPoint) -> BackendError:
    """What to say where a point ended every process that tried it."""
    return BackendError(
        f"sweep: {TRIES} worker processes died at {point.label}. Give it more memory, or fewer jobs at a time."
    )


def share_of_cores(jobs: int) -> int:
    """Threads for each of `jobs` processes, so that together they fill the machine and no more."""
    return max(1, (os.cpu_count() or 1) // jobs)


@contextmanager
def deaf_to_ctrl_c() -> Iterator[None]:
    """What starts here, threads and processes, leaves Ctrl-C to the process at the top, which ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # it starts with the first process, and would open our ears again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """A process that renders one point after the other."""

    point: SweepPoint

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would share Dr.Jit's threads
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, threads), daemon=True)
        with deaf_to_ctrl_c():
            self._process.start()
        theirs.close()

    def take_from(self, waiting: list[SweepPoint]) -> None:
        """Start on the next point, rather one that the scene loaded last serves."""
        geometry = getattr(getattr(self, "point", None), "geometry", None)
        self.point = next((point for point in waiting if point.geometry == geometry), waiting[0])
        waiting.remove(self.point)
        with suppress(OSError):  # a process that died says so when asked for the image
            self.connection.send(self.point)

    def image(self) -> Image | FsptError | None:
        """The image of `point` or why there is none, None if the process died over it; raises what is no refusal."""
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, Exception) and not isinstance(answer, FsptError):
            raise answer
        return answer

    def end(self) -> None:
        self._process.terminate()
        self._process.join()
        self._process.close()
        self.connection.close()


def _end_with_parent() -> None:
    """Where the process at the top was killed and could not end us, nobody waits for the point under way."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(connection: Connection, threads: int) -> None:
    from .scene_cache import SceneCache

    Thread(target=_end_with_parent, daemon=True).start()
    cache = SceneCache(threads=threads, quiet=True)
    with suppress(EOFError, BrokenPipeError):  # the process at the top has gone
        while True:
            point = connection.recv()
            try:
                answer: Image | Exception = cache.image_or_error(point)
            except Exception as error:  # not every exception can travel
                answer = RuntimeError(f"{point.label}: {type(error).__name__}: {error}")
            connection.send(answer)
