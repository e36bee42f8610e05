"""Rows of the derivative of an image by J_n: P is linear in J_n, so that they do not depend on it (Eq. M.20).

Where all that glows are meshes and J_n is a number or an attribute, the rows are those of the transport matrix
(`view_rows`): forward mode is its product with the tangent of J_n, reverse mode that of its transpose.

Else they are a fixed set of lines of sight for each pixel: P_i = Σ_l w_il J_n(r_il) · profile, with one point r_il
where each line of sight ends. Forward mode sums the tangent of J_n over the same lines whose weights reverse mode hands
to the numbers behind J_n: the two are transposes of each other. The weights of a pixel are scaled to the integral's
image of J_n = 1, so that silhouettes have the errors of that image.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...emission.emitting_surface import EmittingSurface
from ...emission.exitance import attribute_name, function_on, texels_of, values_on
from ...emission.of_emitter import surface_of, surfaces_of
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import triangles
from ..lines.eq9 import View, eq9, etendue_from_pixel
from ..pupil.lattices import VECTOR
from ..quadrature import Quadrature
from .sparse_rows import SparseRows
from .view_rows import CERTAIN, LARGEST_FACTOR, columns_on, view_rows

if TYPE_CHECKING:
    from ..solution import Solution

# A column, the derivative by one value behind J_n, that N lines meet is right to 1/N where J_n is continuous, and to
# N^(-3/4) where it steps from face to face.
FEWEST, MOST = 1 << 6, 1 << 14  # lines of a pixel
# Fewest and most lines of an image at rtol 1e-3, for some 0.05 and 2 s. Columns smaller than a pixel, which even the
# most lines may meet too rarely, have larger errors.
LEAST_LINES, MOST_LINES = 1 << 19, 1 << 24
FINER = 4  # times as many lines where their sum is off the image of J_n = 1 by rtol, as often as `MOST_LINES` allow
BATCH = 1 << 21  # lines of sight in one kernel: float32 adds no more of them than this to one number

Array = NDArray[np.float64]
Sizes = tuple[int, int]
Kinds = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RowGroup:
    """Pixels (n,) of the crop window with equally many `lines` of sight each, and factors (n,) on their rows."""

    lines: int
    pixels: NDArray[np.uint32]
    factors: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of all pixels of a crop window that see anything; `shape` (h, w).

    groups : by lines of sight. matrix : of the transport matrix, with the columns of each emitter by its mark
    kept : arrays whose indices show whether the rows are still valid
    """

    shape: tuple[int, int]
    groups: tuple[RowGroup, ...] = ()
    matrix: SparseRows | None = None
    columns: Mapping[object, slice] = field(default_factory=dict)
    kept: tuple[Any, ...] = ()

    @classmethod
    def on_meshes(cls, scene: mi.Scene, camera: Camera, quadrature: Quadrature, image: Solution, kinds: Kinds) -> Rows:
        """Rows of the transport matrix for columns of these `kinds_of`, from the `image` of J_n = 1, which it must be.

        Raises TransportError where the memory does not suffice.
        """
        surfaces = surfaces_of(scene)
        counts = [columns_on(surface.shape, kind) for surface, kind in zip(surfaces, kinds, strict=True)]
        ends = itertools.pairwise(itertools.accumulate(counts, initial=0))
        columns = {surface.mark: slice(*pair) for surface, pair in zip(surfaces, ends, strict=True)}
        found = view_rows(scene, camera, lambda: image, kinds, quadrature, name="fspt_integral")
        return cls(image.power.shape, matrix=found, columns=columns)

    @classmethod
    def by_lines(
        cls, view: View, quadrature: Quadrature, image: Solution, window: NDArray[np.bool_], sizes: Sizes
    ) -> Rows:
        """Rows of the pixels in `window` (h, w), from the `image` of J_n = 1, which all surfaces must now have.

        sizes : number of values behind J_n, see `sizes_of`
        """
        power, uncertain = (plane.ravel() / view.camera.pixel_etendues for plane in (image.power, image.error))
        tolerance = quadrature.rtol * power.max(initial=0.0)
        pixels = np.flatnonzero(window.ravel() & ((power > 0) | (uncertain > tolerance)))
        lines, groups = _lines_for(quadrature, sizes, len(pixels)), []
        while len(pixels):
            sums = _sums(view, quadrature, RowGroup(lines, pixels.astype(np.uint32), np.ones(len(pixels), np.float32)))
            off = np.abs(power[pixels] - sums)
            finer, rough = FINER * lines, off > tolerance
            if finer > min(FINER * MOST, quadrature.most_nodes) or finer * np.count_nonzero(rough) > MOST_LINES // 2:
                rough[:] = False
            wanted = np.where(off > CERTAIN * uncertain[pixels], power[pixels], sums)
            factors = np.divide(wanted, sums, out=np.ones(len(pixels)), where=sums > 0)
            converged = ~rough & (sums > 0)
            groups.append(
                RowGroup(
                    lines,
                    pixels[converged].astype(np.uint32),
                    np.clip(factors[converged], 0, LARGEST_FACTOR).astype(np.float32),
                )
            )
            pixels, lines = pixels[rough], finer
        return cls(image.power.shape, tuple(group for group in groups if len(group.pixels)))

    def forward(self, view: View, quadrature: Quadrature, surfaces: Sequence[EmittingSurface]) -> Array:
        """Tangent (h, w) [W] of the image for the tangents of the numbers behind J_n of these surfaces."""
        if self.matrix is not None:
            change = np.zeros(self.matrix.count)
            with dr.resume_grad():
                for surface in surfaces:
                    values = values_on(surface.shape, surface.exitance)
                    dr.forward_to(values, flags=dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
                    change[self.columns[surface.mark]] = dr.grad(values).numpy()
            return (self.matrix.matrix @ change).reshape(self.shape)
        tangent = np.zeros(math.prod(self.shape))
        for part in self._parts(view, quadrature):
            with dr.resume_grad():
                radiance = part.radiance(surfaces)
                if not dr.grad_enabled(radiance):
                    continue
                dr.forward_to(radiance, flags=dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
                change = dr.grad(radiance)
            light = eq9(mi.Float64(change), mi.Float64(part.etendue))
            tangent[part.pixels] = (dr.block_sum(light, part.lines)).numpy() * part.factors
        return (tangent * view.camera.pixel_etendues).reshape(self.shape)

    def backward(
        self, view: View, quadrature: Quadrature, surfaces: Sequence[EmittingSurface], gradient: Array
    ) -> None:
        """Add the transpose of `forward` of a `gradient` (h, w) [1/W] to the gradients of the numbers behind J_n."""
        if self.matrix is not None:
            weights = self.matrix.matrix.T @ gradient.ravel()
            with dr.resume_grad():
                for surface in surfaces:
                    values = values_on(surface.shape, surface.exitance)
                    dr.backward_from(values * from_numpy(mi.Float, weights[self.columns[surface.mark]]))
            dr.eval()
            return
        of_pixels = gradient.ravel() * view.camera.pixel_etendues
        for part in self._parts(view, quadrature):
            of_row = from_numpy(mi.Float, of_pixels[part.pixels] * part.factors)
            weight = eq9(dr.gather(mi.Float, of_row, part.row), part.etendue)
            with dr.resume_grad():
                radiance = part.radiance(surfaces)
                if dr.grad_enabled(radiance):
                    dr.backward_from(radiance * weight)
            dr.eval()

    def _parts(self, view: View, quadrature: Quadrature) -> Iterator[_Part]:
        for group in self.groups:
            yield from _parts(view, quadrature, group)


def kinds_of(scene: mi.Scene, asked: Sequence[EmittingSurface], quadrature: Quadrature) -> Kinds | None:
    """Of each emitter of a scene 'vertex' or 'face', the columns on which its J_n is linear; None where rows of the
    transport matrix do not give the derivative by the numbers behind J_n of the emitters that are `asked` for."""
    marks, kinds = {surface.mark for surface in asked}, []
    for emitter in scene.emitters():
        surface = surface_of(emitter)
        if not (surface and surface.law.linear and surface.shape.is_mesh()):
            return None
        name = attribute_name(surface.exitance)
        if name is None and surface.mark in marks and not surface.is_uniform():
            return None
        kinds.append("face" if (name or "").startswith("face") else "vertex")
    return tuple(kinds) if quadrature.pixel == "area" else None


def sizes_of(surfaces: Sequence[EmittingSurface]) -> Sizes:
    """Number of values behind J_n of these surfaces, between which J_n is continuous and between which it steps."""
    smooth = stepped = 0
    for surface in surfaces:
        name, texture = attribute_name(surface.exitance), surface.exitance
        if name is None:
            smooth += texels_of(texture)
        elif name.startswith("face"):
            stepped += dr.width(triangles(surface.shape)[1]) // 3
        else:
            smooth += dr.width(triangles(surface.shape)[0]) // 3
    return smooth, stepped


def _lines_for(quadrature: Quadrature, sizes: Sizes, pixels: int) -> int:
    """Lines of sight of each of so many pixels, a power of two."""
    smooth, stepped = sizes
    hits = smooth / quadrature.rtol + stepped / quadrature.rtol ** (4 / 3)
    scale = math.sqrt(1e-3 / quadrature.rtol)
    wanted = float(np.clip(hits, LEAST_LINES * scale, MOST_LINES * scale)) / max(pixels, 1)
    most = math.log2(min(MOST, max(FEWEST, quadrature.most_nodes)))
    return 1 << int(np.clip(round(math.log2(max(wanted, 1))), math.log2(FEWEST), most))


@dataclass(frozen=True, eq=False)
class _Part:
    """Lines of sight of some pixels, those of a pixel one after the other.

    pixels, factors : of the group. row : of each line, its pixel's place in `pixels`
    etendue : of each line over that of its pixel
    """

    pixels: NDArray[np.uint32]
    factors: NDArray[np.float32]
    lines: int
    row: mi.UInt32
    etendue: mi.Float
    si: mi.SurfaceInteraction3f
    towards: mi.Vector3f

    def radiance(self, surfaces: Sequence[EmittingSurface]) -> mi.Float:
        """Radiance [W/mm²/sr] of these surfaces along each line, attached to the numbers behind their J_n."""
        total = mi.Float(0)
        for surface in surfaces:
            shape = surface.shape
            value = function_on(shape, surface.exitance)
            with dr.suspend_grad():
                outward = self.si.is_valid() & (dr.dot(self.si.n, self.towards) > 0)
                met = outward & (self.si.shape == mi.ShapePtr(shape))
                profile = surface.law.profile(self.si, self.towards, met)
                # On a sliver, where interpolation in single precision fails, J_n is NaN.
                met &= dr.isfinite(profile * value(self.si, met))
                profile = dr.select(met, profile, 0)
            total = total + value(self.si, met) * profile
        return total


def _parts(view: View, quadrature: Quadrature, group: RowGroup) -> Iterator[_Part]:
    """The lines of sight of a group's pixels, in batches of at most `BATCH`."""
    size = max(1, BATCH // group.lines)
    for first in range(0, len(group.pixels), size):
        chosen = slice(first, first + size)
        position, pupil, row = _places(view, quadrature, group.pixels[chosen], group.lines)
        pupil, open_share = view.camera.open_pupil(position, pupil)
        ray, cos_theta, passes = view.camera.line_of_sight(position, pupil, view.start)
        share = open_share * view.camera.film_map.area_share(position)
        etendue = etendue_from_pixel(cos_theta, passes, share) * dr.opaque(mi.Float, 1 / group.lines)
        si = view.scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=passes)
        yield _Part(group.pixels[chosen], group.factors[chosen], group.lines, row, etendue, si, -ray.d)


def _sums(view: View, quadrature: Quadrature, group: RowGroup) -> Array:
    """Mean of the integrand of Eq. 9 [W/mm²/sr] over the lines of each pixel of a group, of the present J_n."""
    found = []
    size = max(1, BATCH // group.lines)
    for first in range(0, len(group.pixels), size):
        position, pupil, _ = _places(view, quadrature, group.pixels[first : first + size], group.lines)
        light = view.integrand(position, pupil, together=True).integrand
        found.append(dr.block_sum(mi.Float64(light), group.lines).numpy() / group.lines)
    return np.concatenate(found)


def _places(
    view: View, quadrature: Quadrature, pixels: NDArray[np.uint32], lines: int
) -> tuple[mi.Point2f, mi.Point2f, mi.UInt32]:
    """Film position [pixels] and pupil point [unit disc] of each line of sight, and the place of its pixel in `pixels`.

    A rank-1 lattice, the same in every pixel: on the film it continues from pixel to pixel.
    """
    film = view.camera.film
    width = dr.opaque(mi.UInt32, film.crop_size[0])
    left, top = (dr.opaque(mi.Float, float(n)) for n in film.crop_offset)
    lane, each = dr.arange(mi.UInt32, len(pixels) * lines), dr.opaque(mi.UInt32, lines)
    row = lane // each
    k = lane - row * each
    pixel = dr.gather(mi.UInt32, from_numpy(mi.UInt32, pixels), row)
    step = dr.opaque(mi.UInt32, (1 << 32) // lines)
    # In units of 2⁻³², where whole numbers wrap around as a lattice does; the points are middles of their steps.
    places = (k * dr.opaque(mi.UInt32, generator) * step + (step >> 1) for generator in VECTOR)
    x, y, u, v = (mi.Float(place >> 8) * 2.0**-24 for place in places)
    area = dr.opaque(mi.Float, float(quadrature.pixel == "area"))
    within = 0.5 + area * (mi.Point2f(x, y) - 0.5)
    position = mi.Point2f(left + mi.Float(pixel % width), top + mi.Float(pixel // width)) + mi.Vector2f(within)
    return position, mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u, v)), row
