"""Rows of the transport matrix of one view (Eq. M.20), from its columns and, where those are wrong, lines of sight.

The columns come from the surface form, which conserves the light of each. The rows are then scaled to the image of
J_n = 1, an independent computation by the pupil form that finds silhouettes and occluders, where the two differ by more
than the error of that image. Where light reaches the lens through or off specular shapes all rows are found by lines of
sight. `inverse` keeps these rows as the matrix, derivatives of an image by J_n are sums over them.

Entries stay in single precision, ten bytes each; they are scaled some rows at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from ...camera.camera import Camera
from ...emission.of_emitter import surfaces_of
from ...jit.batches import BATCH
from ...jit.mesh_buffers import triangles
from ...runtime.errors import TransportError, named
from ...runtime.memory import available_memory
from ..lines.occlusion import hides_nothing
from ..lines.specular import Specular
from ..lines.visible_window import visible_window
from ..quadrature import Quadrature
from ..solution import Solution
from ..surface.column_canvas import Windows
from ..surface.column_form import MOST_CHANGE, MOST_WORK, Columns, column_windows, columns_of
from ..surface.face_light import FaceLight
from ..surface.pixel_sums import memory_of
from .row_form import rows_of
from .sparse_rows import SparseRows

CERTAIN = 0.35  # largest error of the image of J_n = 1, as a rule, over its estimated error
ROUGH = 1.0  # times rtol of the brightest pixel of that image: rows further from it are computed by lines of sight
UNREACHED = 0.5  # likewise, where the image itself did not reach rtol
ALL_LINES = 2048  # lines of sight a pixel at rtol 1e-3 where all rows are found by them
ROW_LINES = 4096  # of these pixels at rtol 1e-3, more where they are few
LINES_LEFT = 1.5  # error over the change by twice the lines: 1/(2^(3/4) - 1), at an edge in focus
FEWEST_HITS = 64  # lines on a column from which on they give its entry with a smaller error than the surface form
TURNS = 6  # number of times that rows and columns are scaled to their sums
LARGEST_FACTOR = 2.0  # on a row; a larger difference is in the row's error
ENTRY = 36  # bytes of an entry while columns become rows
PIXEL = 120  # bytes of a row: the image of J_n = 1, sums of the row and factors on it, in double precision
WORK = 3 << 29  # bytes beside the entries
SOME = 1 << 22  # entries in double precision at a time
LINES = 1 << 20  # of sight at a time

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[float], None]


def columns_on(mesh: mi.Shape, on: str) -> int:
    """Number of columns of a mesh: of its vertices or of its faces."""
    return len(triangles(mesh)[0 if on == "vertex" else 1]) // 3


def view_rows(
    scene: mi.Scene,
    camera: Camera,
    image: Callable[[], Solution],
    on: Sequence[str],
    quadrature: Quadrature,
    progress: Progress | None = None,
    most_bytes: int | None = None,
    name: str = "transport",
) -> SparseRows:
    """Rows of one view of a scene whose emitters are meshes, each with J_n = 1 now.

    Parameters
    ----------
    image : computes that of J_n = 1, by `quadrature`; called after the check that the memory suffices
    on : of each emitter, 'vertex' or 'face'
    progress : called with the share done
    most_bytes : that may be allocated; None for what the system says
    name : of the caller, for messages

    Raises
    ------
    TransportError : the memory does not suffice.
    """
    specular = Specular.of(scene, camera, quadrature)
    if specular:
        solution = image()
        entries = _by_lines(scene, camera, solution, on, quadrature.rtol, specular)
        sums = np.full(entries.count, np.nan)
    else:
        with named(name):
            laid = _laid_out(scene, camera, on, most_bytes)
        solution = image()
        with named(name):
            entries, sums = _by_faces(scene, camera, solution, laid, on, quadrature.rtol, progress)
    least = quadrature.least_error * float(solution.power.max(initial=0.0))
    return _balanced(entries, sums, solution, np.maximum(solution.error, least), camera.pixel_etendues)


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries in the order of the rows: column, light over that of a filled pixel (T/G, M.20), relative change."""

    count: int
    starts: NDArray[np.integer]
    columns: NDArray[np.int32]
    light: NDArray[np.float32]
    change: NDArray[np.float16]

    @classmethod
    def of(cls, parts: Sequence[Columns], rows: int) -> _Entries:
        """Those of the columns of several meshes, one after the other, on so many pixels."""
        ends = np.cumsum([0, *(len(part.exact) for part in parts)])
        columns, pixels, light, change = (
            np.concatenate([getattr(part, name) for part in parts]) if len(parts) > 1 else getattr(parts[0], name)
            for name in ("columns", "pixels", "light", "change")
        )
        if len(parts) > 1:
            columns += np.repeat(ends[:-1], [len(part.light) for part in parts]).astype(np.int32)
        numbers = np.arange(len(pixels), dtype=np.int32 if len(pixels) < 1 << 31 else np.int64)
        whole = coo_array((numbers, (pixels, columns)), shape=(rows, int(ends[-1])))
        whole.has_canonical_format = True  # no two are the same
        whole = whole.tocsr()
        return cls(int(ends[-1]), whole.indptr, whole.indices, light[whole.data], change[whole.data])

    def parts(self) -> Iterator[tuple[slice, slice, NDArray[np.int64]]]:
        """Some rows at a time, with their entries and the row of each entry, counted from the first of them."""
        first = 0
        while first < len(self.starts) - 1:
            last = max(int(np.searchsorted(self.starts, self.starts[first] + SOME, side="right")) - 1, first + 1)
            row = np.repeat(np.arange(last - first), np.diff(self.starts[first : last + 1]))
            yield slice(first, last), slice(int(self.starts[first]), int(self.starts[last])), row
            first = last

    def row_sums(self, factors: Array | None = None) -> Array:
        """Light of each row, that of a column times its factor."""
        return self._csr(self.light) @ (np.ones(self.count) if factors is None else factors)

    def column_sums(self, factors: Array | None = None) -> Array:
        """Light of each column, that of a row times its factor."""
        return self._csr(self.light).T @ (np.ones(len(self.starts) - 1) if factors is None else factors)

    def coarse_row_sums(self) -> Array:
        """Light of each row by half of the cells, pieces or lines of sight."""
        return self._csr(self.light * (1 - self.change.astype(np.float64))) @ np.ones(self.count)

    def _csr(self, light: NDArray[np.floating]) -> csr_array:
        return csr_array((light, self.columns, self.starts), shape=(len(self.starts) - 1, self.count))

    def where(self, kept: Mask) -> _Entries:
        """Some of the entries."""
        if kept.all():
            return self
        starts = np.concatenate([[0], np.cumsum(kept)])[self.starts].astype(self.starts.dtype)
        return _Entries(self.count, starts, self.columns[kept], self.light[kept], self.change[kept])

    def joined(self, others: Sequence[_Entries], pixels: Sequence[NDArray[np.int64]]) -> _Entries:
        """With others, whose rows are those of these pixels; no entry is in two."""
        here, parts = np.arange(len(self.starts) - 1), [self, *others]
        lengths = np.diff(self.starts).astype(np.int64)
        for other, place in zip(others, pixels, strict=True):
            lengths[place] += np.diff(other.starts)
        starts = np.concatenate([[0], np.cumsum(lengths)])
        free = starts[:-1].copy()
        arrays = [np.empty(starts[-1], getattr(self, name).dtype) for name in ("columns", "light", "change")]
        for part, place in zip(parts, [here, *pixels], strict=True):
            sizes = np.diff(part.starts)
            to = np.repeat(free[place] - part.starts[:-1], sizes) + np.arange(int(part.starts[-1]))
            for array, name in zip(arrays, ("columns", "light", "change"), strict=True):
                array[to] = getattr(part, name)
            free[place] += sizes
        return _Entries(self.count, starts, *arrays)


def _laid_out(
    scene: mi.Scene, camera: Camera, on: Sequence[str], most_bytes: int | None
) -> list[tuple[FaceLight, Windows]]:
    """Faces of each mesh with the windows of its columns; TransportError if the memory is too small for the entries."""
    alone, shape = hides_nothing(scene), camera.film.shape
    offset = camera.film.crop_offset
    laid = []
    for surface, kind in zip(surfaces_of(scene), on, strict=True):
        faces = FaceLight.seen(surface, camera, offset, shape)
        faces = faces if alone else faces.behind(scene, camera)
        laid.append((faces, column_windows(faces, columns_on(surface.shape, kind), kind, shape)))
    _require_memory(sum(windows.pixels for _, windows in laid), math.prod(shape), most_bytes)
    return laid


def _by_faces(
    scene: mi.Scene,
    camera: Camera,
    image: Solution,
    laid: list[tuple[FaceLight, Windows]],
    on: Sequence[str],
    rtol: float,
    progress: Progress | None,
) -> tuple[_Entries, Array]:
    """Entries from the faces of the meshes and, on rough pixels, from lines of sight; sums of the columns."""
    columns = []
    for number, ((faces, windows), kind) in enumerate(zip(laid, on, strict=True)):
        report = None
        if progress:

            def report(share: float, first: float = number / len(on)) -> None:
                progress(first + share / len(on))

        columns.append(columns_of(scene, camera, faces, windows, kind, rtol, report))
    exact = np.concatenate([part.exact for part in columns])
    entries = _Entries.of(columns, math.prod(camera.film.shape))
    del columns
    laid.clear()  # the work that follows needs the memory
    rough, cut, outside, off = _rough(scene, camera, entries, image, rtol)
    sums = entries.column_sums()
    sums[~exact | (sums <= 0)] = np.nan  # lines of sight may meet light through an opening too narrow for faces
    if outside.any() or cut.any():
        sizes = np.diff(entries.starts)
        sums[entries.columns[np.repeat(outside | cut, sizes)]] = np.nan  # the stop takes some of their light
        entries = entries.where(~np.repeat(outside, sizes))
    if rough.any():
        entries = _refined(scene, camera, entries, on, rough, np.where(cut, np.inf, off), rtol)
    return entries, sums


def _by_lines(
    scene: mi.Scene, camera: Camera, image: Solution, on: Sequence[str], rtol: float, specular: Specular
) -> _Entries:
    """Entries of all pixels by lines of sight."""
    pixels = np.flatnonzero(image.power.ravel() > 0)
    count = sum(columns_on(surface.shape, kind) for surface, kind in zip(surfaces_of(scene), on, strict=True))
    lines = int(ALL_LINES * (1e-3 / rtol) ** 0.5) // 2 * 2
    places = np.array_split(pixels, -(-len(pixels) * lines // LINES)) if pixels.size else []
    rows = [_rows(scene, camera, some, on, lines, specular) for some in places]
    none = np.zeros(image.power.size + 1, np.int64)
    empty = _Entries(count, none, *(np.zeros(0, kind) for kind in (np.int32, np.float32, np.float16)))
    return empty.joined(rows, places)


def _refined(
    scene: mi.Scene, camera: Camera, entries: _Entries, on: Sequence[str], rough: Mask, off: Array, rtol: float
) -> _Entries:
    """The entries, on rough pixels those by lines of sight where they are bright.

    off : (h · w) error of the rows by the surface form; inf where the border of a stop crosses the pixel, which the
        surface form counts whole

    A row by lines of sight is taken if √Σ (error of an entry)², its error for J_n = 1 where errors of entries are
    independent, is smaller than `off`. An entry of it is bright if the surface form or the lines of sight put it above
    a threshold; so each entry comes from one of the two, also where one puts it just above and the other just below.
    Across the border of a stop all entries are bright.
    """
    pixels = np.flatnonzero(rough)
    lines = int(np.clip(BATCH / len(pixels), ROW_LINES * (1e-3 / rtol) ** 0.5, 1 << 16)) // 2 * 2
    places = np.array_split(pixels, max(1, -(-len(pixels) * lines // LINES)))
    kept, found = np.ones(len(entries.light), bool), []
    for some in places:
        rows = _rows(scene, camera, some, on, lines)
        sizes = np.diff(entries.starts)[some]
        row, met = (np.repeat(np.arange(len(some)), counts) for counts in (sizes, np.diff(rows.starts)))
        error = np.sqrt(np.bincount(met, (rows.light * rows.change.astype(np.float64)) ** 2, len(some)))
        threshold = np.where(error < off[some], FEWEST_HITS / (math.pi * lines), np.inf)
        threshold[np.isinf(off[some])] = 0
        here = np.repeat(entries.starts[some] - np.cumsum(sizes) + sizes, sizes) + np.arange(len(row))
        bright, bright_met = entries.light[here] >= threshold[row], rows.light >= threshold[met]
        number_here = row * entries.count + entries.columns[here]
        number_met = met * entries.count + rows.columns
        kept[here] = ~bright & ~np.isin(number_here, number_met[bright_met])
        found.append(rows.where(bright_met | np.isin(number_met, number_here[bright])))
    return entries.where(kept).joined(found, places)


def _rough(
    scene: mi.Scene, camera: Camera, entries: _Entries, solution: Solution, rtol: float
) -> tuple[Mask, Mask, Mask, Array]:
    """Pixels (h · w) on which the surface form is wrong, those that the stop cuts, those beyond it, and their error.

    The first include the second, rows whose sum is far from the image, and rows that differ from an uncertain image.
    """
    window = visible_window(scene, camera, everywhere=True)
    inside, cut = (window.expand(flags.astype(np.float64)).ravel() > 0 for flags in window.field_stop(camera))
    inside |= math.isinf(camera.lens.seen_field)
    etendue = camera.pixel_etendues
    power = solution.power.ravel() / etendue
    off, uncertain = np.abs(power - entries.row_sums()), solution.error.ravel() / etendue
    unit = rtol * float(solution.power.max(initial=0.0)) / etendue
    far = inside & ((off > ROUGH * unit) | (off > UNREACHED * unit) & (uncertain > unit))
    cut &= ~inside
    return far | (cut & (power > 0)), cut, ~(inside | cut), off


def _rows(
    scene: mi.Scene,
    camera: Camera,
    pixels: NDArray[np.int64],
    on: Sequence[str],
    lines: int,
    specular: Specular | None = None,
) -> _Entries:
    """Rows of these pixels by lines of sight; their change follows from half of the lines."""
    found: list[tuple[Any, ...]] = []
    first, surfaces = 0, surfaces_of(scene)
    for surface, kind, row in zip(surfaces, on, rows_of(scene, camera, surfaces, pixels, lines, specular), strict=True):
        light, half = row.light / lines, np.where(row.line < lines // 2, 2 * row.light / lines, 0)
        if kind == "face":
            found.append((row.place, first + row.face, light, half))
        else:
            corners = triangles(surface.shape)[1].numpy().reshape(-1, 3)[row.face]
            found += [
                (row.place, first + corners[:, k].astype(np.int64), light * row.corners[:, k], half * row.corners[:, k])
                for k in range(3)
            ]
        first += columns_on(surface.shape, kind)
    place, column, light, half = (np.concatenate(values) for values in zip(*found, strict=True))
    both = csr_array((light + 1j * half, (place, column)), shape=(len(pixels), first))  # sums both at once
    both.eliminate_zeros()
    relative = LINES_LEFT * (
        1 - np.divide(both.data.imag, both.data.real, out=np.ones(both.nnz), where=both.data.real > 0)
    )
    return _Entries(
        first,
        both.indptr,
        both.indices.astype(np.int32),
        both.data.real.astype(np.float32),
        np.clip(relative, -MOST_CHANGE, MOST_CHANGE).astype(np.float16),
    )


def _require_memory(entries: int, pixels: int, most_bytes: int | None) -> None:
    """Raise TransportError where one view, with at the most so many entries, does not fit into memory."""
    needed = entries * ENTRY + pixels * PIXEL + WORK + memory_of(min(entries, MOST_WORK))
    free = available_memory() if most_bytes is None else most_bytes
    if free is not None and needed > free:
        raise TransportError(
            f"one view has up to {entries} entries and needs {needed} bytes ({needed / 2**30:.1f} GiB) of "
            f"memory, {free} are free. Give fewer pixels, a crop window, a smaller aperture or a coarser mesh."
        )


def _balanced(found: _Entries, columns: Array, image: Solution, error: Array, etendue: float | Array) -> SparseRows:
    """Rows scaled to the `image` of J_n = 1, with this `error` (h, w) [W], and to the given sums of the columns.

    etendue : of all pixels, or of each (h · w,) [mm² sr]

    Rows and columns are scaled in turn, rows last; this converges, as one matrix has both sums. NaN: an unknown sum.
    """
    etendue = np.broadcast_to(etendue, error.size)
    power, uncertain = image.power.ravel() / etendue, error.ravel() / etendue
    before = found.row_sums()
    wanted = np.where(np.abs(power - before) > CERTAIN * uncertain, power, before)
    by_row, by_column = np.ones(len(power)), np.ones(found.count)
    for turn in range(TURNS):
        by_row *= _factor(wanted, by_row * found.row_sums(by_column))
        if turn < TURNS - 1:
            factor = _factor(columns, by_column * found.column_sums(by_row))
            by_column *= np.where(np.isnan(columns), 1, factor)
    sums = by_row * found.row_sums(by_column)
    coarse = _factor(sums, found.coarse_row_sums())
    values, change = np.empty_like(found.light), np.empty_like(found.change)
    for rows, some, row in found.parts():
        factor = by_row[rows][row] * by_column[found.columns[some]]
        values[some] = found.light[some] * factor * etendue[rows][row]
        scaled = (1 - found.change[some].astype(np.float64)) * coarse[rows][row]
        relative = 1 - np.divide(scaled, factor, out=np.ones_like(factor), where=factor > 0)
        change[some] = np.clip(relative, -MOST_CHANGE, MOST_CHANGE)
    left = np.maximum.reduce([np.abs(power - sums), np.abs(wanted - before), uncertain]) * etendue
    entries = replace(found, light=values, change=change)
    entries = entries.where(values > 0)  # behind an image-plane stop
    return SparseRows(
        error.shape,
        entries.count,
        entries.light,
        entries.columns.astype(np.int32, copy=False),
        entries.starts,
        entries.change,
        left.astype(np.float32),
    )


def _factor(wanted: Array, sums: Array) -> Array:
    """Factors (n,) from the sums to the `wanted` ones, at most `LARGEST_FACTOR`."""
    return np.clip(np.divide(wanted, sums, out=np.ones(len(sums)), where=sums > 0), 0, LARGEST_FACTOR)
