"""Elements of an emitting surface: small patches of known area and power, for sampling and for integration.

The elements of a mesh are its faces, each divided into k² equal triangles if the mesh has few; those of any other
shape are the cells of a grid in its surface parameters (u, v). Elements map samples to surface points and find the
element that contains a surface point.

Shapes and textures are called directly here, never through Dr.Jit pointers: elements may be built while a kernel is
being recorded. They are then evaluated outside the recording, where a pointer that belongs to it must not be used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit.mesh_buffers import triangles

MIN_ELEMENTS = 1 << 16
# Share of the samples with uniform density, so that light on an area smaller than an element is never excluded.
UNIFORM_SHARE = 1e-3


def elements_of(shape: mi.Shape, minimum: int = MIN_ELEMENTS) -> Elements:
    """Elements of `shape`, at least `minimum` of them."""
    return MeshElements(shape, minimum) if shape.is_mesh() else ParameterElements(shape, minimum)


class Elements:
    """`count` elements of one shape. `place` maps points of the unit square to an element, `locate` finds the element.

    corners : points of the unit square that `place` maps to an element's corners
    middle : point of the unit square that `place` maps to an element's centre
    """

    count: int
    corners: tuple[tuple[int, int], ...]
    middle: tuple[float, float]

    def __init__(self, shape: mi.Shape) -> None:
        # A pointer array holds no reference. Emitters hold elements, and shapes their emitter: a reference from the
        # elements to the shape would close a cycle through C++, which is never freed.
        self._shape = mi.ShapePtr(shape)

    @property
    def shape(self) -> mi.Shape:
        return self._shape[0]

    def place(
        self, index: mi.UInt32, sample: mi.Point2f, cut: int | mi.UInt32 = 1, part: int | mi.UInt32 = 0
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Surface interaction on element `index` at `sample` in [0, 1]², and dA/d(sample) there [mm²].

        With `cut` > 1 the element is divided into cut² equal parts, and the interaction is on part number `part`,
        counted from 0.
        """
        raise NotImplementedError

    def locate(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, mi.Float]:
        """Index of the element that contains `si`, and dA/d(sample) of `place` there [mm²]."""
        raise NotImplementedError

    def weigh(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, tuple[mi.Float, ...]]:
        """Index of the element that contains `si`, and the weights that interpolate values at its corners to `si`."""
        raise NotImplementedError

    def areas(self) -> mi.Float:
        """Area of each element, shape (count,) [mm²]: the mean of dA/d(sample) over five points."""
        index = dr.arange(mi.UInt32, self.count)
        total = dr.zeros(mi.Float, self.count)
        for point in _FIVE_POINTS:
            total += self.place(index, mi.Point2f(*point))[1]
        return total / len(_FIVE_POINTS)


_FIVE_POINTS = ((0.5, 0.5), (0.1, 0.1), (0.1, 0.9), (0.9, 0.1), (0.9, 0.9))


class MeshElements(Elements):
    """Faces of a triangle mesh, each divided into k² congruent triangles."""

    corners = ((0, 0), (1, 0), (0, 1))
    middle = (5 / 9, 1 / 2)  # `place` maps it to the centroid

    def __init__(self, shape: mi.Shape, minimum: int) -> None:
        super().__init__(shape)
        self._positions, self._faces = triangles(shape)
        faces = dr.width(self._faces) // 3
        self.k = math.ceil(math.sqrt(minimum / max(1, faces)))
        self.count = faces * self.k**2

    def place(
        self, index: mi.UInt32, sample: mi.Point2f, cut: int | mi.UInt32 = 1, part: int | mi.UInt32 = 0
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        face, own = index // (self.k * self.k), index % (self.k * self.k)
        within = of_part(mi.UInt32(part), mi.UInt32(cut), mi.warp.square_to_uniform_triangle(sample))
        si, area = self._interaction(face, of_part(own, mi.UInt32(self.k), within))
        return si, area / dr.square(mi.Float(cut))

    def locate(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, mi.Float]:
        p0, e1, e2 = self._corners(si.prim_index)
        return self._part(si.prim_index, _barycentric(si.p - p0, e1, e2))[0], self._area(e1, e2)

    def weigh(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, tuple[mi.Float, ...]]:
        p0, e1, e2 = self._corners(si.prim_index)
        index, b = self._part(si.prim_index, _barycentric(si.p - p0, e1, e2))
        return index, (1 - b.x - b.y, b.x, b.y)

    def _part(self, face: mi.UInt32, b: mi.Point2f) -> tuple[mi.UInt32, mi.Point2f]:
        """Element of a face at its barycentric coordinates (b1, b2), and the coordinates in that element."""
        k = self.k
        x, y = k * (b.x + b.y), k * b.y
        row, half = dr.clip(dr.floor(x), 0, k - 1), dr.floor(y)
        upside_down = y - half > x - row
        column = dr.clip(2 * half + dr.select(upside_down, 1, 0), 0, 2 * row)
        x, y = x - row, y - half
        within = dr.select(upside_down, mi.Point2f(x, y - x), mi.Point2f(x - y, y))
        return face * (k * k) + mi.UInt32(row * row + column), within

    def _interaction(self, face: mi.UInt32, uv: mi.Point2f) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Surface interaction at the barycentric coordinates `uv` of a face, and the area of its elements [mm²]."""
        p0, e1, e2 = self._corners(face)
        pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(face))
        pi.valid, pi.t, pi.prim_index, pi.prim_uv = True, 1.0, face, uv
        si = self.shape.compute_surface_interaction(mi.Ray3f(p0, dr.cross(e2, e1)), pi, mi.RayFlags.All)
        return si, self._area(e1, e2)

    def _corners(self, face: mi.UInt32) -> tuple[mi.Point3f, mi.Vector3f, mi.Vector3f]:
        """First corner of a face, and its edges to the second and third corner [mm]."""
        f = dr.gather(mi.Point3u, self._faces, face)
        p0, p1, p2 = (dr.gather(mi.Point3f, self._positions, f[n]) for n in range(3))
        return p0, mi.Vector3f(p1 - p0), mi.Vector3f(p2 - p0)

    def _area(self, e1: mi.Vector3f, e2: mi.Vector3f) -> mi.Float:
        """Area of an element of the face with these edges [mm²]."""
        return dr.norm(dr.cross(e1, e2)) / (2 * self.k**2)


class ParameterElements(Elements):
    """Grid of equal cells in the surface parameters (u, v) of an analytic shape."""

    corners = ((0, 0), (1, 0), (0, 1), (1, 1))
    middle = (1 / 2, 1 / 2)

    def __init__(self, shape: mi.Shape, minimum: int) -> None:
        super().__init__(shape)
        self.side = math.ceil(math.sqrt(minimum))
        self.count = self.side**2
        # Opaque: one kernel for elements of any size.
        self._across, self._columns = dr.opaque(mi.Float, self.side), dr.opaque(mi.UInt32, self.side)
        self._unit_shape = _UNIT_SHAPES.get(shape.class_name())
        if self._unit_shape:
            self._to_world = mi.Transform4f(mi.traverse(shape)["to_world"])
            axes = np.array(self._to_world.matrix, np.float64).reshape(4, 4)[:3, :3]
            self._scales = [dr.opaque(mi.Float, length) for length in np.linalg.norm(axes, axis=0)]

    def place(
        self, index: mi.UInt32, sample: mi.Point2f, cut: int | mi.UInt32 = 1, part: int | mi.UInt32 = 0
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        row = index // dr.maximum(self._columns, 1)  # 0 where a recorded call is masked, and the CPU would refuse
        cell = mi.Point2f(mi.Point2u(index - row * self._columns, row))
        number, cut = mi.UInt32(part), mi.UInt32(cut)
        within = (mi.Point2f(mi.Point2u(number % cut, number // cut)) + sample) / mi.Float(cut)
        # Slightly inside: at the ends of their parameters some shapes do not find their own points.
        uv = dr.clip((cell + within) / self._across, 2.0**-21, 1 - 2.0**-21)
        si = self.at(uv)
        return si, self._area(si) / dr.square(mi.Float(cut))

    def locate(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, mi.Float]:
        cell = self._cell(si)
        return cell.x + cell.y * self._columns, self._area(si)

    def weigh(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, tuple[mi.Float, ...]]:
        cell = self._cell(si)
        x = si.uv * self._across - mi.Point2f(cell)
        weights = ((1 - x.x) * (1 - x.y), x.x * (1 - x.y), (1 - x.x) * x.y, x.x * x.y)
        return cell.x + cell.y * self._columns, weights

    def at(self, uv: mi.Point2f) -> mi.SurfaceInteraction3f:
        """Surface interaction at (u, v) in [0, 1]².

        Mitsuba's spheres, cylinders and disks search for their own points along a ray. If rotated by 90°, the first
        two miss some of them, since the ray follows the normal of the unrotated shape; a tilted disk misses a third of
        its rim.
        """
        if not self._unit_shape:
            return self.shape.eval_parameterization(uv)
        local, normal = self._unit_shape.at(uv)
        p, n = self._to_world @ local, dr.normalize(self._to_world @ normal)
        pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(uv))
        pi.valid, pi.t, pi.prim_uv = True, 1.0, mi.Point2f(local.x, local.y)
        si = self.shape.compute_surface_interaction(mi.Ray3f(p + n, -n), pi, mi.RayFlags.All)
        # Mitsuba derives these from the rounded point, which has few correct digits on a small shape far from the
        # origin.
        si.n = dr.select(dr.dot(si.n, n) < 0, -n, n)
        si.sh_frame.n, si.uv = si.n, uv
        return si

    def _cell(self, si: mi.SurfaceInteraction3f) -> mi.Point2u:
        """Column and row of the cell that contains `si`."""
        return mi.Point2u(dr.clip(si.uv * self._across, 0, self._across - 1))

    def _area(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """dA/d(sample) of the cell at `si` [mm²]: in closed form for round shapes, whose derivatives Mitsuba rounds."""
        if self._unit_shape:
            return self._unit_shape.area(si.uv, *self._scales) / dr.square(self._across)
        return dr.norm(dr.cross(si.dp_du, si.dp_dv)) / dr.square(self._across)


def _on_sphere(uv: mi.Point2f) -> tuple[mi.Point3f, mi.Normal3f]:
    """Point and normal of the unit sphere at its parameters: longitude/2π from +x, polar angle/π from +z."""
    sin_phi, cos_phi = dr.sincos(dr.two_pi * uv.x)
    sin_theta, cos_theta = dr.sincos(dr.pi * uv.y)
    local = mi.Vector3f(cos_phi * sin_theta, sin_phi * sin_theta, cos_theta)
    return mi.Point3f(local), mi.Normal3f(local)


def _on_cylinder(uv: mi.Point2f) -> tuple[mi.Point3f, mi.Normal3f]:
    """Point and normal of the unit cylinder from z = 0 to 1 at its parameters: longitude/2π from +x, height."""
    sin_phi, cos_phi = dr.sincos(dr.two_pi * uv.x)
    return mi.Point3f(cos_phi, sin_phi, uv.y), mi.Normal3f(cos_phi, sin_phi, 0)


def _on_disk(uv: mi.Point2f) -> tuple[mi.Point3f, mi.Normal3f]:
    """Point and normal of the unit disk at its parameters: radius, longitude/2π from +x."""
    sin_phi, cos_phi = dr.sincos(dr.two_pi * uv.y)
    return mi.Point3f(uv.x * cos_phi, uv.x * sin_phi, 0), mi.Normal3f(0, 0, 1)


@dataclass(frozen=True)
class _UnitShape:
    """A round shape of unit size: point and normal `at` its parameters (u, v), and dA/(du dv) once it is scaled.

    `area` takes (u, v) and the lengths [mm] of the axes of `to_world`.
    """

    at: Callable[[mi.Point2f], tuple[mi.Point3f, mi.Normal3f]]
    area: Callable[..., mi.Float]


_UNIT_SHAPES = {
    "Sphere": _UnitShape(_on_sphere, lambda uv, a, b, c: 2 * dr.pi**2 * a * b * dr.sin(dr.pi * uv.y)),
    "Cylinder": _UnitShape(_on_cylinder, lambda uv, a, b, c: dr.two_pi * a * c),
    "Disk": _UnitShape(_on_disk, lambda uv, a, b, c: dr.two_pi * a * b * uv.x),
}


def of_part(part: mi.UInt32, k: mi.UInt32, b: mi.Point2f) -> mi.Point2f:
    """Barycentric coordinates (b1, b2) in a triangle, of the point with coordinates `b` in part number `part` of k².

    Part r² + c lies in row r of k rows; triangles with odd c are inverted.
    """
    row = mi.UInt32(dr.sqrt(mi.Float(part) + 0.5))
    column = part - row * row
    i, j, upright = mi.Float(row), mi.Float(column // 2), (column % 2) == 0
    x = i + dr.select(upright, b.x + b.y, b.x)
    y = j + dr.select(upright, b.y, b.x + b.y)
    return mi.Point2f(x - y, y) / mi.Float(k)


def _barycentric(d: mi.Vector3f, e1: mi.Vector3f, e2: mi.Vector3f) -> mi.Point2f:
    """Barycentric coordinates (b1, b2) with d = b1 e1 + b2 e2 in the plane of the two edges."""
    n = dr.cross(e1, e2)
    scale = dr.rcp(dr.squared_norm(n))
    return mi.Point2f(dr.dot(dr.cross(d, e2), n) * scale, dr.dot(dr.cross(e1, d), n) * scale)


class ElementDistribution:
    """Distribution of surface points whose density [1/mm²] is ∝ the mean exitance of their element.

    If J_n is 0 on all elements, the density is uniform.
    """

    def __init__(self, elements: Elements, exitance: Callable[[mi.SurfaceInteraction3f], mi.Float]) -> None:
        self.elements = elements
        index = dr.arange(mi.UInt32, elements.count)
        power = dr.zeros(mi.Float, elements.count)
        for point in _FIVE_POINTS:
            si, area = elements.place(index, mi.Point2f(*point))
            power += area * dr.maximum(exitance(si), 0)
        if not dr.any(power > 0):  # a dark surface: points must still be drawn, with any density > 0
            power = elements.areas()
        share = power + (UNIFORM_SHARE * dr.mean(power) / dr.mean(elements.areas())) * elements.areas()
        # Two random numbers choose first a row of elements, then an element of the row. The 24 bits of a single number
        # are too few for 10⁵ elements: the power of each would be wrong by 1 %.
        self._side = math.ceil(math.sqrt(elements.count))
        table = np.zeros(self._side**2, np.float32)
        table[: elements.count] = share.numpy()
        self._choice = mi.DiscreteDistribution2D(table.reshape(self._side, self._side))

    def sample(self, sample: mi.Point2f, active: mi.Bool) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Surface interaction drawn with two uniform numbers, and its density [1/mm²]."""
        cell, chance, within = self._choice.sample(sample, active)
        si, area = self.elements.place(cell.x + cell.y * self._side, within)
        return si, dr.select(area > 0, chance / area, 0)

    def pdf(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Density of `sample` at `si` [1/mm²]."""
        index, area = self.elements.locate(si)
        chance = self._choice.pdf(mi.Point2u(index % self._side, index // self._side), active)
        return dr.select(active & si.is_valid() & (area > 0), chance / area, 0)
