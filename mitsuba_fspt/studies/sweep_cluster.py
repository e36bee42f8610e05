"""A sweep on the workers of a dask.distributed cluster, elsewhere or started here."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..images.image import Image
from ..runtime.errors import BackendError, FsptError
from .sweep_point import SweepPoint
from .sweep_pool import deaf_to_ctrl_c, died, share_of_cores

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = 10  # seconds for a scheduler to answer, and for it to have a worker


def images_of_cluster(
    points: list[SweepPoint], scheduler: str, jobs: int | None
) -> Iterator[tuple[SweepPoint, Image | FsptError]]:
    """Points and their images in the order they are done, by the workers of the scheduler at this address.

    'local' starts a scheduler and `jobs` workers here. A worker that dies costs its points another try.

    In place of an image what rendering raised of our own, and BackendError where the point ended every worker that
    tried it. Raises BackendError without dask, scheduler or workers.
    """
    require_dask()
    from distributed import KilledWorker, as_completed

    with _local(jobs or os.cpu_count() or 1) if scheduler == "local" else _remote(scheduler) as (client, threads):
        futures = {client.submit(_image, point, threads, pure=False): point for point in points}
        for future in as_completed(list(futures)):
            point = futures.pop(future)
            try:
                image = future.result()
            except KilledWorker:
                image = died(point)
            except CancelledError as error:
                raise BackendError(
                    f"sweep: the scheduler '{scheduler}' has gone. Start it and its workers again, and then the sweep."
                ) from error
            future.release()
            yield point, image


def require_dask() -> None:
    """Raise BackendError where dask.distributed is missing."""
    try:
        import distributed  # noqa: F401
    except ImportError as cause:
        raise BackendError(
            "sweep: a scheduler needs dask.distributed, which is not installed. pip install 'mitsuba-fspt[cluster]'."
        ) from cause


@contextmanager
def _local(jobs: int) -> Iterator[tuple[Client, int | None]]:
    from distributed import Client, LocalCluster

    options = {"n_workers": jobs, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None}
    with deaf_to_ctrl_c():
        cluster = LocalCluster(**options, silence_logs=logging.CRITICAL)
    with cluster, Client(cluster) as client:
        yield client, share_of_cores(jobs)


@contextmanager
def _remote(address: str) -> Iterator[tuple[Client, None]]:
    from distributed import Client

    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as cause:
        raise BackendError(
            f"sweep: no dask scheduler answers at '{address}'. Start one with 'dask scheduler', or give "
            "--scheduler local."
        ) from cause
    with client, _mute("distributed.client"):  # a lost connection is one line, ours
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as cause:
            raise BackendError(
                f"sweep: the scheduler '{address}' has no workers. Start some with 'dask worker {address}'."
            ) from cause
        yield client, None


@contextmanager
def _mute(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _image(point: SweepPoint, threads: int | None) -> Image | FsptError:
    """Runs on a worker, which keeps its cache from point to point and renders one at a time."""
    from distributed import get_worker

    from .scene_cache import SceneCache

    worker = get_worker()
    threads = worker.state.nthreads if threads is None else threads
    return vars(worker).setdefault("fspt_scene_cache", SceneCache(threads=threads, quiet=True)).image_or_error(point)
