"""Rendering the points of a sweep in other processes of this machine, or on a dask.distributed cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from threading import Thread

from ..images.image import Image
from ..runtime.errors import FsptError
from ..runtime.workers import TRIES, ctrl_c_blocked, lost_workers, results_of_cluster, share_of_cores
from .point_renderer import PointRenderer
from .sweep_point import SweepPoint

SPAWN = multiprocessing.get_context("spawn")  # a fork would share Dr.Jit's threads


def images_of_processes(points: list[SweepPoint], jobs: int) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are finished, from at most `jobs` processes that share the cores.

    In place of an image: the FsptError that the rendering raised, or BackendError if `TRIES` processes have ended.
    Each process has an executor of its own, so that it gets points of the scene that it has loaded, and that one that
    ends takes only its own point with it.
    """
    waiting, ended = list(points), Counter[str]()
    jobs = min(jobs, len(points))
    running: dict[Future[Image | FsptError], tuple[ProcessPoolExecutor, SweepPoint]] = {}
    ours, theirs = SPAWN.Pipe()

    def start(executor: ProcessPoolExecutor, geometry: str | None = None) -> None:
        """Give an executor its next point, preferably one of this geometry."""
        point = next((point for point in waiting if point.geometry == geometry), waiting[0])
        waiting.remove(point)
        with ctrl_c_blocked():  # the process is started now
            running[executor.submit(_image_of_process, point)] = executor, point

    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                start(ProcessPoolExecutor(1, SPAWN, _begin, (share_of_cores(jobs), theirs)))
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                executor, point = running.pop(future)
                image: Image | FsptError
                try:
                    image = future.result()
                except BrokenProcessPool:
                    executor.shutdown()
                    ended[point.file] += 1
                    if ended[point.file] < TRIES:
                        waiting.insert(0, point)
                        continue
                    image = lost_workers(point)
                else:
                    if waiting:
                        start(executor, point.geometry)
                    else:
                        executor.shutdown()
                yield point, image
    finally:
        ours.close()  # ends the processes that still work
        for executor, _ in running.values():
            executor.shutdown()


_renderer: PointRenderer  # of a worker process


def _begin(threads: int, main: Connection) -> None:
    """Begin a worker process that uses so many threads; it ends when the main process closes its end of `main`."""
    global _renderer
    _renderer = PointRenderer(threads=threads, quiet=True)
    Thread(target=_end_with, args=(main,), daemon=True).start()


def _image_of_process(point: SweepPoint) -> Image | FsptError:
    """The image of a point or its error, in a worker process."""
    return _renderer.image_or_error(point)


def _end_with(main: Connection) -> None:
    """End this process as soon as the main process has ended or has closed its end of the pipe."""
    main.poll(None)
    os._exit(1)


def images_of_cluster(
    points: list[SweepPoint], scheduler: str, jobs: int | None
) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are finished; parameters and errors as of `results_of_cluster`."""
    yield from results_of_cluster(points, scheduler, jobs, _image_of_cluster)


def _image_of_cluster(point: SweepPoint, threads: int | None) -> Image | FsptError:
    """The image of a point or its error. Runs on a worker, which keeps its last scene from point to point."""
    from distributed import get_worker

    worker = get_worker()
    threads = worker.state.nthreads if threads is None else threads
    renderer = vars(worker).setdefault("fspt_point_renderer", PointRenderer(threads=threads, quiet=True))
    return renderer.image_or_error(point)
