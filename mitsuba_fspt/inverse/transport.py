"""`transport`: the transport matrix of a scene for several views."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..integral.rows.sparse_rows import SparseRows
from ..rendering.parameters import texts_of
from ..rendering.provenance import defaults_of, same_mesh, value_of
from ..rendering.render import sensor_of, warnings_of
from ..rendering.scene import load
from ..rendering.scene_source import SceneSource
from ..rendering.scene_xml import is_text
from ..runtime import backend
from ..runtime.deadline import Deadline, required_time
from ..runtime.errors import BackendError, FsptError, SceneError, TransportError
from ..runtime.interrupt import ctrl_c_held
from ..runtime.numbers import whole
from ..runtime.progress_bar import Progress, reported
from ..runtime.versions import version, versions
from .transport_file import FORMAT, PartialFile
from .transport_matrix import TransportMatrix, read_transport
from .view_block import (
    Part,
    block_of,
    glowing_meshes,
    light_left_out_of,
    parts_of,
    required_on,
    required_rtol,
)

if TYPE_CHECKING:
    import mitsuba as mi

DARK = "sees nothing of the meshes"


@dataclass(frozen=True)
class ViewTask:
    """One view to be computed; plain data that can be sent to other processes, but for a loaded scene.

    scene : name of a file, text, dictionary or loaded scene; parameters : texts of given `<default>` values
    values : what `TransportMatrix.views` says of it; fingerprint : of all that the view depends on
    """

    scene: Any
    parameters: dict[str, str]
    sensor: int
    on: str
    rtol: float
    values: dict[str, Any]
    fingerprint: str

    @property
    def label(self) -> str:
        """The values in one line."""
        return " ".join(f"{name}={value}" for name, value in self.values.items()) or "the only view"


@dataclass(frozen=True)
class ViewResult:
    """A computed view: its rows, the columns, the numbers of its lens, `<default>` values of its scene, warnings.

    left_out : share of the power that T leaves out, for J = 1, and the line about it; None where that is too little
    """

    block: SparseRows | None
    parts: list[Part]
    lens: dict[str, Any]
    defaults: dict[str, Any]
    warnings: tuple[str, ...]
    left_out: tuple[float, str] | None


def transport(
    scene: mi.Scene | str | os.PathLike[str] | Mapping[str, object],
    /,
    *,
    on: str = "vertex",
    rtol: float = 1e-3,
    sensor: int | Sequence[int] | None = None,
    file: str | os.PathLike[str] | None = None,
    scheduler: str | None = None,
    max_time: float | None = None,
    progress: Progress | None = None,
    **parameters: object,
) -> TransportMatrix:
    """Transport matrix T of a scene: power on the pixels of several views, P = T @ J, for any J_n on its meshes.

        T = fspt.transport("scenes/nylon_cylinder.xml", view=[0, 90, 180, 270], f_number=2.8)

    Parameters
    ----------
    scene : name of a scene file, text or dictionary of a scene, or a loaded scene; its own J_n has no effect
    on : 'vertex', J_n linear on every face, or 'face'
    rtol : error of T @ J on every pixel, relative to the brightest pixel; a single column is right to some ten times
        that, relative to its own brightest entry
    sensor : number of the sensor, or several, one view each
    file : npz file to which the views are written one at a time; a second call goes on where the first was interrupted
    scheduler : address of a dask.distributed scheduler or 'local', as in `sweep`; the scene must be a file
    max_time : [s], needs `file`: no further view begins that would end later, as the views so far were; at least one is
        computed. A matrix of half its rows would be none: TransportError says how many views are in the file, and a
        second call goes on from there
    progress : called with what is being done and the share done; without it a notebook shows a bar
    parameters : values for `<default>` parameters of the scene; lists are multiplied out, the last one fastest

    As Eq. 9 does, T leaves out the light that surfaces scatter on to the lens; a warning states the largest share of a
    view, for J = 1. The metadata also say in `warnings` on how many pixels `rtol` was not reached, if on any, and what
    is odd about the scene, such as a mesh of inconsistent orientations, and which views are equal, as those for values
    of J_n are; `error` estimates the errors of the pixels.

    Raises
    ------
    TransportError : a scene without a glowing mesh, with a glowing shape that is none, a bitmap as J_n or the exit law
        `last_flight`; a view that sees nothing, views whose meshes differ by more than a rigid motion, too little
        memory, a file that cannot be written.
    SceneError, OpticsError, ExitanceError, BackendError : as `load` and `render`.
    """
    on, rtol = required_on(on), required_rtol(rtol)
    deadline = _required_deadline(max_time, file, scheduler)
    tasks = _tasks(scene, parameters, sensor, on, rtol)
    partial = None if file is None else PartialFile(file)
    with reported(progress) as report:
        try:
            return _joined(tasks, _results(tasks, partial, scheduler, report, deadline), partial)
        except (BackendError, TimeIsUp):  # a later call goes on with the views that are missing
            raise
        except FsptError:  # no later call could go on from there
            if partial is not None:
                partial.discard()
            raise


class TimeIsUp(TransportError):
    """`max_time` has passed; the views that are finished are in the file."""


def _required_deadline(max_time: float | None, file: object, scheduler: str | None) -> Deadline:
    """The deadline; TransportError for a time that no file or this scheduler goes with."""
    seconds = required_time("transport", max_time, TransportError)
    if seconds is not None and file is None:
        raise TransportError(
            f"transport: 'max_time' = {seconds:g} needs 'file', which keeps the views that are finished. Give its name."
        )
    if seconds is not None and scheduler is not None:
        raise TransportError(
            f"transport: 'max_time' = {seconds:g} has no meaning for the scheduler '{scheduler}'. Leave one out."
        )
    return Deadline(seconds)


def _tasks(
    scene: Any, parameters: Mapping[str, object], sensor: int | Sequence[int] | None, on: str, rtol: float
) -> list[ViewTask]:
    """One task for every combination of parameter values, and of sensors last, all checked."""
    sensors = [sensor] if sensor is None or np.ndim(sensor) == 0 else list(sensor)  # type: ignore[arg-type]
    numbers = [None if one is None else whole("transport: 'sensor'", one, SceneError, "0") for one in sensors]
    if not numbers or len(set(numbers)) < len(numbers):
        raise TransportError(f"transport: 'sensor' = {sensor} names no sensor, or one twice. Give each once.")
    loaded = not isinstance(scene, (str, os.PathLike, Mapping))
    if loaded and parameters:
        raise TransportError(
            f"transport: a loaded scene has no parameter '{next(iter(parameters))}' to vary. Give the name of its file."
        )
    texts = {name: texts_of(name, given, "transport") for name, given in parameters.items()}
    combinations = [dict(zip(texts, one, strict=True)) for one in itertools.product(*texts.values())]
    digests: dict[Path, str] = {}
    tasks = []
    for given in combinations:
        origin = _origin(scene, given, digests)
        for number in numbers:
            values: dict[str, Any] = {name: value_of(text) for name, text in given.items()}
            if number is not None or loaded:
                values["sensor"] = number or 0
            settings = [origin, given, number or 0, on, rtol, FORMAT]
            fingerprint = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
            tasks.append(ViewTask(scene, given, number or 0, on, rtol, values, fingerprint))
    return tasks


def _origin(scene: Any, given: dict[str, str], digests: dict[Path, str]) -> str:
    """Text that changes with all that a view's scene depends on; the parameters of a file are checked."""
    versions = f"{version('mitsuba-fspt')} {version('mitsuba')}"
    if isinstance(scene, (str, os.PathLike)) and not is_text(scene):
        source = SceneSource.of(Path(scene), given, digests)
        source.check_numbers()
        return source.fingerprint({}) if given else f"{versions} {source.digests()}"
    if isinstance(scene, (str, Mapping)):
        return f"{versions} {scene}"
    return f"{versions} {scene}"


def _results(
    tasks: list[ViewTask],
    partial: PartialFile | None,
    scheduler: str | None,
    report: Progress,
    deadline: Deadline,
) -> Iterator[tuple[int, ViewResult]]:
    """Number and result of every view; with a `partial` file its rows are there, and not in the result.

    Raises TimeIsUp where a further view would not end before the deadline.
    """
    missing = [k for k, task in enumerate(tasks) if partial is None or not partial.has(k, task.fingerprint)]
    done = len(tasks) - len(missing)
    for k in sorted(set(range(len(tasks))) - set(missing)):
        yield k, described(tasks[k])
    longest, began = 0.0, time.monotonic()
    for k, result in _computed(tasks, missing, scheduler, report):
        if partial is not None and result.block is not None:
            with ctrl_c_held():
                partial.put(k, result.block, tasks[k].fingerprint)
            result = replace(result, block=None)
        done += 1
        report(f"{done} of {len(tasks)} views", done / len(tasks))
        yield k, result
        now = time.monotonic()
        longest, began = max(longest, now - began), now
        if done < len(tasks) and deadline.left < longest:
            raise TimeIsUp(
                f"transport: stopped by max_time, as another view takes some {longest:.2g} s; {done} of {len(tasks)} "
                f"views are in {'memory' if partial is None else partial.folder}. Call it again to go on from there."
            )


def _computed(
    tasks: list[ViewTask], missing: list[int], scheduler: str | None, report: Progress
) -> Iterator[tuple[int, ViewResult]]:
    """Views as they are finished, by this process or by the workers of a scheduler."""
    if scheduler is None:
        for done, k in enumerate(missing, len(tasks) - len(missing)):

            def within(share: float, done: int = done, k: int = k) -> None:
                report(f"view {k + 1} of {len(tasks)}: {tasks[k].label}", (done + share) / len(tasks))

            within(0.0)
            yield k, computed(tasks[k], within)
        return
    from ..runtime.workers import results_of_cluster

    if missing and (not isinstance(tasks[0].scene, (str, os.PathLike)) or is_text(tasks[0].scene)):
        raise TransportError("transport: 'scheduler' needs a scene file, which its workers load. Give its name.")
    numbers = {tasks[k].fingerprint: k for k in missing}
    if not missing:
        return
    waiting = [_absolute(tasks[k]) for k in missing]
    for task, result in results_of_cluster(waiting, scheduler, None, computed_on_worker, "transport"):
        if isinstance(result, FsptError):
            raise result
        yield numbers[task.fingerprint], result


def _absolute(task: ViewTask) -> ViewTask:
    """The task with the absolute path of its scene, for a process that works in another folder."""
    path = str(Path(task.scene).absolute())
    return ViewTask(path, task.parameters, task.sensor, task.on, task.rtol, task.values, task.fingerprint)


def computed_on_worker(task: ViewTask, threads: int | None) -> ViewResult | FsptError:
    """The view of a task, or the FsptError that it raises, on a worker with so many threads, None for its own."""
    from distributed import get_worker

    backend.ensure_variant()
    backend.quiet_mitsuba()
    backend.set_threads(get_worker().state.nthreads if threads is None else threads)
    try:
        return computed(task)
    except FsptError as error:
        return error


def computed(task: ViewTask, progress: Callable[[float], None] | None = None) -> ViewResult:
    """Rows and description of one view."""
    scene, lens = _scene_of(task)
    found = _described(scene, lens, task)
    block = block_of(scene, lens, task.on, task.rtol, progress)
    if not block.starts[-1]:
        raise TransportError(
            f"transport: {task.label} {DARK}. Check the lens's 'to_world' and that the faces' normals point outwards."
        )
    return replace(found, block=block)


def described(task: ViewTask) -> ViewResult:
    """Description of a view whose rows are there already."""
    return _described(*_scene_of(task), task)


def _scene_of(task: ViewTask) -> tuple[mi.Scene, mi.Sensor]:
    """Loaded scene and lens of a task."""
    backend.ensure_variant()
    scene = task.scene
    if isinstance(scene, (str, os.PathLike, Mapping)):
        scene = load(scene, **task.parameters)
    return scene, sensor_of(scene, task.sensor)


def _described(scene: mi.Scene, lens: mi.Sensor, task: ViewTask) -> ViewResult:
    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_checks import check_film

    glowing_meshes(scene)
    check_film(camera := camera_of(lens))
    film = camera.film
    numbers: dict[str, Any] = {**camera.numbers()}
    numbers["film"] = [*film.crop_size, *film.crop_offset, *film.size]
    numbers["to_world"] = list(camera.placement)
    warnings = tuple(warnings_of(scene, task.sensor))
    left_out = light_left_out_of(scene, lens, task.rtol)
    return ViewResult(None, parts_of(scene, task.on), numbers, defaults_of(lens), warnings, left_out)


def _joined(
    tasks: list[ViewTask], results: Iterable[tuple[int, ViewResult]], partial: PartialFile | None
) -> TransportMatrix:
    """The matrix of all views, in memory or in its file."""
    found: dict[int, ViewResult] = {}
    for k, result in results:
        first = next(iter(found.values()), result)
        _require_alike(tasks[k], result, first)
        found[k] = result
    ordered = [found[k] for k in range(len(tasks))]
    height_width = ordered[0].lens["film"][1], ordered[0].lens["film"][0]
    parts = ordered[0].parts
    ends = np.cumsum([0, *(part.count for part in parts)]).tolist()
    blocks: Any = [result.block for result in ordered]
    if partial is not None:
        partial.views = len(tasks)
        blocks = partial
    sensitivity, rtol, unreached, largest = np.zeros(ends[-1]), tasks[0].rtol, 0, 0.0
    digests = []
    for block in blocks:
        digests.append(_digest(block))
        sensitivity += np.bincount(block.columns, block.values.astype(np.float64), minlength=ends[-1])
        off = block.relative_row_error
        unreached, largest = unreached + int(np.count_nonzero(off > rtol * (1 + rtol))), max(largest, float(off.max()))
    areas = np.concatenate([part.areas for part in parts])
    meta = {
        "format": FORMAT,
        "scene": _name_of(tasks[0].scene),
        "on": tasks[0].on,
        "rtol": rtol,
        "image_shape": [len(tasks), *height_width],
        "columns": ends[-1],
        "views": [task.values for task in tasks],
        "parameters": [result.defaults for result in ordered],
        "lenses": [result.lens for result in ordered],
        "parts": {part.name: pair for part, pair in zip(parts, itertools.pairwise(ends), strict=True)},
        "laws": [part.law for part in parts],
        "mesh_digest": " ".join(part.digest for part in parts),
        "versions": versions(),
        "fingerprints": [task.fingerprint for task in tasks],
    }
    off = f"rtol {rtol:g} not reached on {unreached} pixels (largest error {largest:.1e} of the peak for J = 1)"
    told = dict.fromkeys(text for result in ordered for text in result.warnings)
    if of_views := [result.left_out for result in ordered if result.left_out]:
        told[f"{max(of_views)[1]} (for J = 1)"] = None
    if warnings := [*([off] if unreached else []), *_equal_views(tasks, digests), *told]:
        meta["warnings"] = "; ".join(warnings)
    if partial is None:
        return TransportMatrix(blocks, meta, areas, sensitivity)
    partial.finish(meta, areas, sensitivity)
    return read_transport(partial.path)


def _digest(block: SparseRows) -> bytes:
    """Digest of the entries of a view."""
    found = hashlib.sha256()
    for entries in (block.starts, block.columns, block.values):
        found.update(entries.tobytes())
    return found.digest()


def _equal_views(tasks: list[ViewTask], digests: list[bytes]) -> list[str]:
    """A line about views whose rows are equal, none where all differ."""
    first: dict[bytes, int] = {}
    pairs = [(first.setdefault(digest, k), k) for k, digest in enumerate(digests)]
    equal = [pair for pair in pairs if pair[0] < pair[1]]
    if not equal:
        return []
    one, other = (tasks[k].label for k in equal[0])
    return [
        f"{len(equal)} of {len(tasks)} views are equal to one before, such as '{other}' to '{one}': what differs "
        "between them has no effect on the matrix"
    ]


def _name_of(scene: Any) -> str:
    if isinstance(scene, (str, os.PathLike)):
        return "XML text" if is_text(scene) else str(scene)
    return "dictionary" if isinstance(scene, Mapping) else str(scene.id())


def _require_alike(task: ViewTask, result: ViewResult, first: ViewResult) -> None:
    """Raise TransportError where a view has other meshes, exit laws or another size of the film than the first."""
    if result is first:
        return
    size, first_size = result.lens["film"][:2], first.lens["film"][:2]
    if size != first_size:
        raise TransportError(
            f"transport: {task.label} has {size[0]} x {size[1]} pixels, another view {first_size[0]} x "
            f"{first_size[1]}. Make a matrix for each size."
        )
    one, other = (" ".join(part.digest for part in of.parts) for of in (result, first))
    if not same_mesh(one, other) or [p.name for p in result.parts] != [p.name for p in first.parts]:
        raise TransportError(
            f"transport: {task.label} has other meshes than another view; views may differ by a rigid motion of the "
            "same meshes. Make a matrix for each mesh."
        )
    if [part.law for part in result.parts] != [part.law for part in first.parts]:
        raise TransportError(f"transport: {task.label} has another exit law than another view. Give all views one.")
