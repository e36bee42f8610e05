"""Rows of the transport matrix of one view: sparse entries, what is uncertain of them, and how they are computed."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.sparse import csr_array

from ..integral.quadrature import Quadrature
from ..runtime.errors import SceneError, TransportError, named
from ..runtime.memory import available_memory
from ..runtime.plugin_types import is_surface

if TYPE_CHECKING:
    import mitsuba as mi

    from ..integral.specular import Specular

ON = ("vertex", "face")
CERTAIN = 0.35  # of its estimated error: what the picture of J_n = 1 is wrong by at the most, as a rule
ROUGH = 4.0  # times rtol of the brightest pixel of that picture: rows further from it are computed by lines of sight
UNREACHED = 0.5  # likewise, where the picture itself did not reach rtol
ALL_LINES = 2048  # lines of sight a pixel at rtol 1e-3 where all rows are found by them
ROW_LINES = 4096  # of these pixels at rtol 1e-3, more where they are few
FEWEST_HITS = 64  # of them, on a column whose entry they determine better than the surface form does
TURNS = 6  # in which rows and columns are scaled to their sums
LARGEST_FACTOR = 2.0  # on a row; what this leaves is in its error
SAFETY = 2.0  # half the cells and pieces change an entry by some three times what is left; neighbours may err alike
NEIGHBOURS = 3  # pixels across that share their errors
BYTES = 4 + 4 + 2  # an entry: value, column, change
WORK = 1 << 30  # bytes beside the entries

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Part:
    """Columns of one glowing mesh: id of its shape, their number, and the digest of the mesh in its own frame."""

    name: str
    count: int
    digest: str
    law: str
    areas: Array


@dataclass(frozen=True, eq=False)
class Block:
    """Rows of one view, (h · w, n), row by row from the top left pixel.

    values : entries [mm²], float32
    columns, starts : their columns, and the first entry of each row, as in a csr_array
    change : by how much half the cells and pieces change each entry, over the entry, float16
    row_error : error of each row's sum [mm²], (h · w), float32
    """

    shape: tuple[int, int]
    count: int
    values: NDArray[np.float32]
    columns: NDArray[np.int32]
    starts: NDArray[np.integer]
    change: NDArray[np.float16]
    row_error: NDArray[np.float32]

    @cached_property
    def matrix(self) -> csr_array:
        """The rows in double precision."""
        return self._csr(self.values.astype(np.float64))

    def error(self, exitance: Array) -> Array:
        """Estimated error (h, w) [W] of `matrix @ exitance` (n,) [W/mm²]."""
        power = self.matrix @ exitance
        changed = self._csr(self.values * self.change.astype(np.float64)) @ exitance
        light, sums = self.matrix @ np.abs(exitance), self.matrix.sum(axis=1)
        mean = self._spread(np.divide(light, sums, out=np.zeros_like(light), where=sums > 0))
        least = self.least_error * np.abs(power).max(initial=0.0) * (self._spread(np.abs(power)) > 0)
        return np.maximum(SAFETY * self._spread(np.abs(changed)) + self.row_error * mean, least).reshape(self.shape)

    @property
    def least_error(self) -> float:
        """Smallest error that is stated, over the brightest pixel: the rounding of float32."""
        return 2e-7

    def _spread(self, values: Array) -> Array:
        """The largest value of each pixel and its neighbours, (h · w)."""
        return maximum_filter(values.reshape(self.shape), NEIGHBOURS).ravel()

    def _csr(self, values: Array) -> csr_array:
        return csr_array((values, self.columns, self.starts), shape=(len(self.starts) - 1, self.count))

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(value.nbytes for field in fields(self) if isinstance(value := getattr(self, field.name), np.ndarray))


def glowing_meshes(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene, all of them meshes whose radiance is linear in J_n.

    Raises
    ------
    TransportError : nothing glows, an emitter is no `fspt_surface`, its shape no mesh, J_n a bitmap, or the exit law
        depends on more than J_n; the message names the way out.
    """
    if not scene.emitters():
        raise TransportError("transport: nothing glows. Give a mesh an emitter of type 'fspt_surface'.")
    for emitter in scene.emitters():
        if not is_surface(emitter):
            raise TransportError(
                f"transport: emitter {emitter.class_name()} is no fspt_surface, whose J_n the matrix takes. Leave it "
                "out."
            )
        shape = emitter.get_shape()
        if not shape.is_mesh():
            raise TransportError(
                f"transport: shape '{shape.id()}' is a {shape.class_name().lower()}, J_n needs the vertices or faces "
                "of a mesh. Give a PLY, for example of trimesh.creation."
            )
        if emitter.exitance.class_name().startswith("Bitmap"):
            raise TransportError(
                f"transport: 'exitance' of shape '{shape.id()}' is a bitmap, the columns are vertices or faces. Give "
                "J_n as a mesh attribute or a number."
            )
        if not emitter.law.linear:
            raise TransportError(
                f"transport: emission '{emitter.law.name}' of shape '{shape.id()}' depends on the fluence, not on J_n "
                "alone. Give 'lambert' or 'fresnel'."
            )
    return scene.emitters()


def parts_of(scene: mi.Scene, on: str) -> list[Part]:
    """The columns of each glowing mesh of a scene, in the order of its emitters."""
    from ..jit.mesh_buffers import triangles
    from ..rendering.provenance import digest_of

    found = []
    for emitter in glowing_meshes(scene):
        mesh = emitter.get_shape()
        positions, faces = (buffer.numpy() for buffer in triangles(mesh))
        vertices, corners = positions.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
        a, b, c = (vertices[corners[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if on == "vertex":
            area = np.bincount(corners.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))
        found.append(Part(mesh.id(), len(area), digest_of(emitter, mesh), str(emitter.law), area))
    return found


def block_of(
    scene: mi.Scene,
    lens: mi.Sensor,
    on: str,
    rtol: float,
    progress: Callable[[float], None] | None = None,
    *,
    most_bytes: int | None = None,
) -> Block:
    """Rows of one view of a scene, whatever J_n it has.

    Where light reaches the lens through or off specular shapes all rows are found by lines of sight. Else the columns
    come from the surface form, which conserves the light of each. Their sums over a row are then made those
    of the picture of J_n = 1, an independent computation by the pupil form that finds silhouettes and occluders, as far
    as the two differ by more than the picture's own error.

    Raises
    ------
    TransportError : as `glowing_meshes`, or the memory does not suffice.
    SceneError, OpticsError, ExitanceError : as `render`.
    """
    import drjit as dr

    from ..integral.specular import Specular
    from ..jit.recording import recording
    from ..rendering.render import integrator_of

    emitters = glowing_meshes(scene)
    with ExitStack() as stack:
        for emitter in emitters:
            stack.enter_context(emitter.shining(1.0))
        with named("fspt_integral"):
            quadrature = Quadrature(rtol=rtol)
        solution = integrator_of(scene, "integral").solve(scene, lens, quadrature)
        with recording(), dr.suspend_grad():
            specular = Specular.of(scene, lens, quadrature)
            if specular:
                entries, sums = _by_lines(scene, lens, emitters, solution, on, rtol, specular)
            else:
                entries, sums = _by_faces(scene, lens, emitters, solution, on, rtol, progress, most_bytes)
    least = quadrature.least_error * float(solution.power.max(initial=0.0))
    return _block(entries, sums, solution.power.ravel(), np.maximum(solution.error, least), lens.etendue)


def _by_faces(
    scene: mi.Scene,
    lens: mi.Sensor,
    emitters: Any,
    solution: Any,
    on: str,
    rtol: float,
    progress: Callable[[float], None] | None,
    most_bytes: int | None,
) -> tuple[_Entries, Array]:
    """Entries from the faces of the meshes and, on rough pixels, from lines of sight; sums of the columns."""
    from ..integral.column_form import ColumnRule
    from ..integral.occlusion import hides_nothing
    from ..jit.batches import BATCH

    alone = hides_nothing(scene)
    counts, columns = [], []
    for number, emitter in enumerate(emitters):
        report = None
        if progress:

            def report(share: float, first: float = number / len(emitters)) -> None:
                progress(first + share / len(emitters))

        part = _columns(scene, lens, emitter, on, ColumnRule.of(rtol, on), alone, report, most_bytes)
        counts.append(len(part.counts))
        columns.append(part)
    entries = _Entries.of(columns)
    rough, cut, outside = _rough(scene, lens, entries, solution, rtol)
    bound = np.concatenate([part.exact for part in columns])
    bound[entries.columns[outside[entries.pixels]]] = False
    sums = np.bincount(entries.columns, entries.light, minlength=len(bound))
    sums = np.where(bound, sums, np.nan)
    entries = entries.where(~outside[entries.pixels])
    if rough.any():
        pixels = np.flatnonzero(rough)
        lines = int(np.clip(BATCH / len(pixels), ROW_LINES * (1e-3 / rtol) ** 0.5, 1 << 16)) // 2 * 2
        entries = entries.refined(_rows(scene, lens, emitters, counts, pixels, on, lines), rough, cut)
    return entries, sums


def _by_lines(
    scene: mi.Scene, lens: mi.Sensor, emitters: Any, solution: Any, on: str, rtol: float, specular: Specular
) -> tuple[_Entries, Array]:
    """Entries of all pixels by lines of sight; sums of the columns, which are not known: NaN."""
    from ..jit.batches import BATCH

    counts = [part.count for part in parts_of(scene, on)]
    pixels = np.flatnonzero(solution.power.ravel() > 0)
    lines = int(ALL_LINES * (1e-3 / rtol) ** 0.5) // 2 * 2
    some = max(1, BATCH // lines)
    rows = [
        _rows(scene, lens, emitters, counts, pixels[first : first + some], on, lines, specular).entries
        for first in range(0, len(pixels), some)
    ]
    names = ("pixels", "columns", "light", "change")
    empty = _Entries(*(np.zeros(0, kind) for kind in (np.int64, np.int64, np.float64, np.float64)))
    entries = _Entries(*(np.concatenate([getattr(row, name) for row in (empty, *rows)]) for name in names))
    return entries, np.full(sum(counts), np.nan)


@dataclass(frozen=True)
class _Entries:
    """Entries of one view in any order: pixel, column, light over that of a filled pixel, and its change."""

    pixels: NDArray[np.int64]
    columns: NDArray[np.int64]
    light: Array
    change: Array

    @classmethod
    def of(cls, parts: list[Any]) -> _Entries:
        """Those of the columns of several meshes, one after the other."""
        counts = np.concatenate([part.counts for part in parts])
        pixels, light, change = (np.concatenate([getattr(p, n) for p in parts]) for n in ("pixels", "light", "change"))
        return cls(pixels, np.repeat(np.arange(len(counts)), counts), light, change)

    def where(self, kept: NDArray[np.bool_]) -> _Entries:
        """Some of the entries."""
        return _Entries(self.pixels[kept], self.columns[kept], self.light[kept], self.change[kept])

    def refined(self, rows: _Rows, rough: NDArray[np.bool_], cut: NDArray[np.bool_]) -> _Entries:
        """The same with entries of rough pixels as lines of sight find them, where enough of these meet the column.

        On pixels that a stop has `cut` in any case, for there the surface form does not know where.
        """
        threshold = np.where(cut, 0, FEWEST_HITS / (math.pi * rows.lines))
        here = self.where(rough[self.pixels])
        count = int(max(here.columns.max(initial=0), rows.entries.columns.max(initial=0))) + 1
        keys = [e.pixels.astype(np.int64) * count + e.columns for e in (here, rows.entries)]
        many = rows.entries.light >= threshold[rows.entries.pixels]
        # Kept from the surface form: faint columns, but for those that the lines have found to be bright.
        kept = (here.light < threshold[here.pixels]) & ~np.isin(keys[0], keys[1][many])
        parts = (self.where(~rough[self.pixels]), here.where(kept), rows.entries.where(many))
        return _Entries(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("pixels", "columns", "light", "change"))
        )


@dataclass(frozen=True)
class _Rows:
    """Entries of some pixels by so many lines of sight each."""

    entries: _Entries
    lines: int


def _rough(
    scene: mi.Scene, lens: mi.Sensor, entries: _Entries, solution: Any, rtol: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels (h · w) whose row the surface form gives wrongly, those that the stop cuts, and those beyond it.

    The first include the second, and those whose sum is far from the picture, or off where that is uncertain.
    """
    from ..integral.window import visible_window

    window = visible_window(scene, lens, everywhere=True)
    inside, cut = (window.expand(flags.astype(np.float64)).ravel() > 0 for flags in window.field_stop(lens))
    inside |= math.isinf(lens.optics.seen_field)
    picture = solution.power.ravel() / lens.etendue
    sums = np.bincount(entries.pixels, entries.light, minlength=picture.size)
    off, uncertain = np.abs(picture - sums), solution.error.ravel() / lens.etendue
    unit = rtol * picture.max(initial=0.0)
    far = inside & ((off > ROUGH * unit) | (off > UNREACHED * unit) & (uncertain > unit))
    cut &= ~inside
    return far | (cut & (picture > 0)), cut, ~(inside | cut)


def _rows(
    scene: mi.Scene,
    lens: mi.Sensor,
    emitters: Any,
    counts: list[int],
    pixels: NDArray[np.int64],
    on: str,
    lines: int,
    specular: Specular | None = None,
) -> _Rows:
    """Rows of these pixels by lines of sight; the change is what half of the lines make of them."""
    from ..integral.row_form import rows_of
    from ..jit.mesh_buffers import triangles

    found: list[tuple[Any, ...]] = []
    first = 0
    for emitter, count, row in zip(
        emitters, counts, rows_of(scene, lens, emitters, pixels, lines, specular), strict=True
    ):
        light, half = row.light / lines, np.where(row.line < lines // 2, 2 * row.light / lines, 0)
        if on == "face":
            found.append((row.place, first + row.face, light, half))
        else:
            corners = triangles(emitter.get_shape())[1].numpy().reshape(-1, 3)[row.face]
            found += [
                (row.place, first + corners[:, k].astype(np.int64), light * row.corners[:, k], half * row.corners[:, k])
                for k in range(3)
            ]
        first += count
    place, column, light, half = (np.concatenate(values) for values in zip(*found, strict=True))
    whole, halves = (csr_array((v, (place, column)), shape=(len(pixels), first)) for v in (light, half))
    whole.eliminate_zeros()
    entries = whole.tocoo()
    of_half = np.asarray(halves[entries.coords[0], entries.coords[1]]).ravel()
    found_entries = _Entries(pixels[entries.coords[0]], entries.coords[1], entries.data, entries.data - of_half)
    return _Rows(found_entries, lines)


def _columns(
    scene: mi.Scene,
    lens: mi.Sensor,
    emitter: mi.Emitter,
    on: str,
    rule: Any,
    alone: bool,
    progress: Callable[[float], None] | None,
    most_bytes: int | None,
) -> Any:
    """Columns of one mesh on the crop window."""
    from ..integral.column_form import FaceLight, column_windows, columns_of
    from ..jit.mesh_buffers import triangles

    film = lens.film()
    shape = (int(film.crop_size()[1]), int(film.crop_size()[0]))
    offset = (int(film.crop_offset()[0]), int(film.crop_offset()[1]))
    faces = FaceLight.seen(emitter, lens, offset, shape)
    if not alone:
        faces = faces.behind(scene, lens)
    positions, corners = triangles(emitter.get_shape())
    windows = column_windows(faces, len(positions if on == "vertex" else corners) // 3, on, shape)
    _require_memory(int(windows.areas.sum()), most_bytes)
    return columns_of(scene, lens, faces, windows, on, rule, progress)


def _require_memory(entries: int, most_bytes: int | None) -> None:
    """Raise TransportError where the entries of one view, at the most so many, do not fit into memory."""
    # Beside the result the values in double precision of both computations and their places.
    needed = entries * (BYTES + 32) + WORK
    free = available_memory() if most_bytes is None else most_bytes
    if free is not None and needed > free:
        raise TransportError(
            f"transport: one view has up to {entries} entries and needs {needed} bytes ({needed / 2**30:.1f} GiB) of "
            f"memory, {free} are free. Give fewer pixels, a crop window, a smaller aperture or a coarser mesh."
        )


def _balanced(found: _Entries, rows: Array, columns: Array) -> Array:
    """Light of the entries, scaled to these sums of the rows and of the columns, where they are not NaN.

    By turns, rows last: both sums are those of one matrix, so that the turns converge.
    """
    light = found.light
    for turn in range(TURNS):
        light = light * _factor(rows, np.bincount(found.pixels, light, minlength=len(rows)))[found.pixels]
        if turn < TURNS - 1:
            factor = _factor(columns, np.bincount(found.columns, light, minlength=len(columns)))
            light *= np.where(np.isnan(columns), 1, factor)[found.columns]
    return light


def _factor(wanted: Array, sums: Array) -> Array:
    """By what sums are to be multiplied, at most so much."""
    return np.clip(np.divide(wanted, sums, out=np.ones(len(sums)), where=sums > 0), 0, LARGEST_FACTOR)


def _block(found: _Entries, columns: Array, power: Array, error: Array, etendue: float) -> Block:
    """The rows of one view: from its entries, sums of its columns (NaN: not known) and the picture of J_n = 1.

    power (h · w) and error (h, w) [W] of that picture.
    """
    shape, count = error.shape, len(columns)
    picture, uncertain = power / etendue, error.ravel() / etendue
    before = np.bincount(found.pixels, found.light, minlength=len(picture))
    rows = np.where(np.abs(picture - before) > CERTAIN * uncertain, picture, before)
    light = _balanced(found, rows, columns)
    sums = np.bincount(found.pixels, light, minlength=len(picture))
    left = np.maximum(np.abs(picture - sums), uncertain) * etendue
    coarse = found.light - found.change
    coarse = coarse * _factor(sums, np.bincount(found.pixels, coarse, minlength=len(picture)))[found.pixels]
    entries, change = light * etendue, (light - coarse) * etendue
    numbers = np.arange(1, len(entries) + 1)
    whole = csr_array((numbers, (found.pixels, found.columns)), shape=(len(picture), count))
    order = whole.data - 1
    entries, change = entries[order], change[order]
    relative = np.divide(change, entries, out=np.zeros_like(entries), where=entries > 0)
    return _without_zeros(
        Block(
            shape,
            count,
            entries.astype(np.float32),
            whole.indices.astype(np.int32),
            whole.indptr,
            np.clip(relative, -6e4, 6e4).astype(np.float16),
            left.astype(np.float32),
        )
    )


def _without_zeros(block: Block) -> Block:
    """The same without entries that are 0, as behind an image-plane stop."""
    kept = block.values > 0
    if kept.all():
        return block
    starts = np.concatenate([[0], np.cumsum(kept)])[block.starts].astype(block.starts.dtype)
    return replace(
        block, values=block.values[kept], columns=block.columns[kept], change=block.change[kept], starts=starts
    )


def required_on(on: object) -> str:
    """`on` as one of `ON`; TransportError for anything else."""
    if on not in ON:
        raise TransportError(f"transport: 'on' must be 'vertex' or 'face', got {on!r}.")
    return str(on)


def required_rtol(rtol: object) -> float:
    """`rtol` as a float in the range of `Quadrature`; TransportError for anything else."""
    try:
        return Quadrature(rtol=rtol).rtol  # type: ignore[arg-type]
    except SceneError as error:
        raise TransportError(f"transport: {error}") from error
