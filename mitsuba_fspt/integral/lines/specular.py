"""Specular surfaces: transmission and reflection of lines of sight.

A BSDF sends light on in single directions by three kinds of lobes: the null lobe (undeviated: `null`, `mask`, a thin
pane), specular transmission (refraction at the border of a solid) and specular reflection (mirrors, and every pane).
Radiance along a line of sight is the sum over all sequences of such lobes of the product of their weights and the
radiance of the surface where each sequence ends (Eq. M.19). The lobe of the largest weight is followed first, the
others after it. Sequences end where their weight is too small or their length too large; the rest counts as error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...emission.face_table import shape_number
from ...emission.of_emitter import surfaces_of
from ...jit.mesh_buffers import box_of, triangles
from ...jit.plugin_objects import made
from ...jit.spectra import at_one_wavelength, scalar
from ..quadrature import Quadrature
from .nested_bsdfs import blended_parts
from .occlusion import hidden, ray_to_lens

SMOOTHEST = 1e-4  # roughness below which Mitsuba's rough conductor has the lobe of this roughness: a mirror's
FLAT = 1e-5  # of its size: how far a flat shape may leave its plane
ROUNDING = 2e-6  # of the largest coordinate: margin of a box
LIFT = 4e-7  # of a shape's largest coordinate: distance at which its sides differ in float32
WHOLE = 0xFFFFFFFF  # Mitsuba's number for all components of a BSDF
CODES = 4095  # numbers for a first surface, and for all later ones, that one float32 can encode
DELTA = {
    "null": mi.BSDFFlags.Null,
    "transmission": mi.BSDFFlags.DeltaTransmission,
    "reflection": mi.BSDFFlags.DeltaReflection,
}

if TYPE_CHECKING:
    Radiance = Callable[[mi.PreliminaryIntersection3f, mi.Ray3f], mi.Float]
    Covers = Callable[[mi.UInt32], mi.Bool]
    Note = Callable[[mi.PreliminaryIntersection3f, mi.Ray3f, mi.Float, mi.Bool], None]

Box = tuple[float, ...]  # x, y, z of the lowest and of the highest corner [mm]


@dataclass(frozen=True)
class Specular:
    """Specular shapes of a scene; tables are indexed by Dr.Jit's number of a shape.

    names : ids of the shapes
    lobes : kinds of lobes that can lead to light, of 'null', 'transmission' and 'reflection'
    bending : boxes of the shapes that deviate lines of sight
    bsdf : Dr.Jit's number of a shape's BSDF; 0 where lines of sight end
    parts : components of a shape's BSDF that are sampled one at a time; 0 for those of no blend
    most_parts : largest of `parts`
    reach : box of all surfaces from which light can reach a shape, six numbers [mm]
    lift : distance from a shape at which the next leg of a line starts [mm]
    most : longest sequence of lobes that is followed
    least : smallest weight with which a sequence is followed
    kept : BSDFs that replace others, referenced so that they stay alive
    """

    names: tuple[str, ...]
    lobes: tuple[str, ...]
    bending: tuple[Box, ...]
    bsdf: mi.UInt32
    parts: mi.UInt32
    most_parts: int
    reach: mi.Float
    lift: mi.Float
    most: int
    least: float
    kept: tuple[mi.BSDF, ...]

    @classmethod
    def of(
        cls, scene: mi.Scene, camera: Camera, quadrature: Quadrature | None = None, even_if_none: bool = False
    ) -> Specular | None:
        """Specular shapes of a scene before a `lens`; None if there is none, unless `even_if_none`."""
        quadrature = quadrature or Quadrature()
        shapes = [(shape, bsdf) for shape in scene.shapes() if (bsdf := specular_bsdf(shape)) is not None]
        if not (shapes or even_if_none):
            return None
        lobes = {name for _, bsdf in shapes for name in lobes_of(bsdf)}
        bent = [(shape, bsdf) for shape, bsdf in shapes if set(lobes_of(bsdf)) - {"null"}]
        glowing = [_box(surface.shape) for surface in surfaces_of(scene)] or [_box(*scene.shapes())]
        if len(bent) == 1 and "transmission" not in lobes and _between(bent[0][0], camera, glowing):
            lobes, bent = lobes - {"reflection"}, []  # what a pane reflects to the lens is dark
        if not (lobes or even_if_none):
            return None
        boxes = [_box(shape) for shape, _ in bent]
        count = 1 + max(map(shape_number, scene.shapes()))
        bsdf, parts = np.zeros((2, count), np.uint32)
        reach, lift = np.zeros((count, 6), np.float32), np.zeros(count, np.float32)
        for shape, its in shapes:
            number = shape_number(shape)
            bsdf[number] = dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(its))[0]
            parts[number] = blended_parts(its)
            others = [
                box for (other, _), box in zip(bent, boxes, strict=True) if other is not shape or not _plane(shape)
            ]
            reach[number] = _around([*glowing, *others])
            lift[number] = LIFT * np.abs(_box(shape)).max()
        return cls(
            tuple(shape.id() for shape, _ in shapes),
            tuple(name for name in DELTA if name in lobes) or ("null",),
            tuple(boxes),
            mi.UInt32(bsdf),
            mi.UInt32(parts),
            int(parts.max()),
            mi.Float(reach.ravel()),
            mi.Float(lift),
            quadrature.max_specular,
            quadrature.least_weight,
            tuple(its for _, its in shapes),
        )

    def state(self) -> tuple[object, ...]:
        """Key of the parameters that light through these shapes depends on, without their poses."""
        values = [mi.traverse(bsdf) for bsdf in self.kept]
        return self.names, self.lobes, tuple(_key(value[name]) for value in values for name in value.keys())

    @property
    def straight(self) -> bool:
        """True if lines of sight that lead to light are not deviated."""
        return not self.bending


def _key(value: object) -> object:
    """A number itself; of an array the index of its data, which is unique while they live."""
    held = getattr(value, "array", value)
    return held.index if dr.is_array_v(held) and dr.width(held) > 1 else str(value)


def specular_bsdf(shape: mi.Shape) -> mi.BSDF | None:
    """BSDF with the specular lobes of the shape's; None if it has none."""
    bsdf = shape.bsdf()
    if bsdf.class_name() == "RoughConductor" and (mirror := _mirror(bsdf)) is not None:
        return mirror
    return bsdf if lobes_of(bsdf) else None


def lobes_of(bsdf: mi.BSDF) -> tuple[str, ...]:
    """Kinds of specular lobes of a BSDF, of the names of `DELTA` in their order."""
    return tuple(name for name, flag in DELTA.items() if mi.has_flag(bsdf.flags(), flag))


def _mirror(rough: mi.BSDF) -> mi.BSDF | None:
    """A smooth conductor like a rough one of roughness 0; None where it is rougher."""
    numbers = mi.traverse(rough)
    alphas = [np.ravel(numbers[key]) for key in numbers.keys() if key.startswith("alpha")]
    if not alphas or np.max([np.max(alpha) for alpha in alphas]) > SMOOTHEST:
        return None
    mirror = made("conductor")
    parameters = mi.traverse(mirror)
    for key in parameters.keys():
        if key in numbers:
            parameters[key] = numbers[key]
    parameters.update()
    return mirror


def _box(*shapes: mi.Shape) -> Box:
    box = box_of(shapes)
    return (*map(float, box.min), *map(float, box.max))


def _around(boxes: Sequence[Box]) -> NDArray[np.float64]:
    """The box around all of these, and of the rounding of their coordinates."""
    ends = np.array(boxes, np.float64).reshape(-1, 2, 3)
    margin = ROUNDING * np.abs(ends).max()
    return np.concatenate([ends[:, 0].min(axis=0) - margin, ends[:, 1].max(axis=0) + margin])


def _plane(shape: mi.Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """A point [mm] and the normal of the plane that a shape lies in; None for a shape that is not flat."""
    if shape.class_name() == "Disk":
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
        normal = np.cross(matrix[:3, 0], matrix[:3, 1])
        return matrix[:3, 3], normal / np.linalg.norm(normal)
    if not shape.is_mesh():
        return None
    points = triangles(shape)[0].numpy().reshape(-1, 3).astype(np.float64)
    middle = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    return (middle, axes[2]) if size[2] <= FLAT * size[0] else None


def _between(shape: mi.Shape, camera: Camera, glowing: Sequence[Box]) -> bool:
    """True if a shape is flat and its plane lies between the whole pupil and everything that glows."""
    if (plane := _plane(shape)) is None:
        return False
    point, normal = plane
    ends = np.array(glowing, np.float64).reshape(-1, 2, 3)
    corners = ends[:, (np.arange(8)[:, None] >> np.arange(3)) & 1, range(3)].reshape(-1, 3)
    heights = (corners - point) @ normal
    own = float((np.array(camera.centre) - point) @ normal)
    side = math.copysign(1.0, own)
    return abs(own) > camera.lens.pupil_radius and bool((side * heights < 0).all())


def transmission(
    scene: mi.Scene, specular: Specular | None, point: mi.Point3f, lens_point: mi.Point3f, active: mi.Bool
) -> mi.Float:
    """Share of the light of a surface point that reaches a point of the lens undeviated; 0 where it is occluded.

    Through null lobes alone: a surface that deviates light counts as an occluder.
    """
    if specular is None:
        return dr.select(hidden(scene, point, lens_point, active), 0, mi.Float(1))
    ray = ray_to_lens(point, lens_point)
    most = dr.opaque(mi.UInt32, specular.most)

    def surface(share: mi.Float, ray: mi.Ray3f, count: mi.UInt32, alive: mi.Bool) -> tuple:
        at_one_wavelength(ray)
        pi = scene.ray_intersect_preliminary(ray, active=alive)
        met = alive & pi.is_valid()
        number = mi.UInt32(dr.reinterpret_array(mi.UInt32, pi.shape))
        index = dr.gather(mi.UInt32, specular.bsdf, number, met)
        goes_on = met & (index > 0) & (count < most)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active=goes_on)
        through = scalar(dr.reinterpret_array(mi.BSDFPtr, index).eval_null_transmission(si, goes_on))
        share = dr.select(met, dr.select(goes_on, share * through, 0), share)
        origin = _off(si, ray.d, dr.gather(mi.Float, specular.lift, number, goes_on))
        ray = mi.Ray3f(origin, ray.d, ray.maxt - pi.t, ray.time, ray.wavelengths)
        return share, ray, count + 1, goes_on & (share > 0) & (ray.maxt > 0)

    state = (mi.Float(1), ray, mi.UInt32(0), mi.Bool(active))
    return dr.while_loop(state, lambda share, ray, count, alive: alive, surface)[0]


# ---------------------------------------------------------------------- along one line of sight


@dataclass
class Course:
    """State of a line of sight after a sequence of lobes.

    origin, direction : of its last leg [mm]
    weight : product of the lobes' weights
    depth : apparent depth of its origin along the optical axis [mm]: lengths in a medium are divided by its index
    index : of refraction of the medium, relative to that at the lens
    plain : 1 if every lobe was the strongest of its surface, or led straight on; else 0 (Dr.Jit 1.5 generates invalid
        code for truth values in local memory)
    length : number of lobes
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float
    depth: mi.Float
    index: mi.Float
    plain: mi.UInt32
    length: mi.UInt32

    @classmethod
    def begun(cls, ray: mi.Ray3f, start: mi.Float) -> Course:
        """The course of a ray that begins at the depth `start` [mm]."""
        one, number = mi.Float(1), mi.UInt32
        return cls(mi.Point3f(ray.o), mi.Vector3f(ray.d), one, mi.Float(start), mi.Float(1), number(1), number(0))

    def carries(self) -> mi.Float:
        """Share of the light along the line: refraction conserves radiance over the squared index."""
        return self.weight * dr.square(self.index)


@dataclass
class Found:
    """Result of a line of sight over all its courses.

    radiance : Σ weight × radiance [W/mm²/sr]
    covered : True if it meets a shape with an `fspt_surface` on a plain course
    body : code of all surfaces on the course of the strongest lobes, the first one in its last 12 bits; 0 without one
    depth, front : apparent depth [mm] of the surface at the end of that course and of the first one, inf without one
    lost : share of the light that is not followed
    """

    radiance: mi.Float
    covered: mi.Bool
    body: mi.UInt32
    depth: mi.Float
    front: mi.Float
    lost: mi.Float


@dataclass
class _Lobe:
    """A lobe where a line of sight meets a surface: its `direction`, `weight` and ratio of refractive `indices`.

    origin : start of the next leg [mm]
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float
    indices: mi.Float
    straight: mi.Bool


def follow(
    scene: mi.Scene,
    specular: Specular,
    ray: mi.Ray3f,
    cosine: mi.Float,
    start: mi.Float,
    passes: mi.Bool,
    radiance: Radiance,
    covers: Covers,
    note: Note | None = None,
) -> Found:
    """Result of the line of sight that begins with a `ray` at the depth `start` [mm].

    cosine : of the ray to the optical axis
    passes : False for lines that are not followed
    radiance : of the surface at an intersection, towards its ray [W/mm²/sr]
    covers : True for the numbers of shapes with an `fspt_surface`
    note : called at the end of every leg with the intersection, its ray, the weight of the course until there, and
        True where the leg ends on a surface
    """
    most, least = dr.opaque(mi.UInt32, specular.most), dr.opaque(mi.Float, specular.least)
    followed = partial(_followed, specular, most, least)
    branches = len(specular.lobes) - 1
    stack = dr.alloc_local(Course, max(1, branches * specular.most))

    def leg(
        course: Course, foremost: mi.Bool, found: Found, alive: mi.Bool, pending: mi.UInt32, stack: dr.Local
    ) -> tuple:
        ray = mi.Ray3f(course.origin, course.direction)
        at_one_wavelength(ray)
        pi = scene.ray_intersect_preliminary(ray, active=alive)
        met = alive & pi.is_valid()
        number = mi.UInt32(dr.reinterpret_array(mi.UInt32, pi.shape))
        depth = course.depth + dr.select(met, pi.t, 0) * cosine / course.index
        glows = met & covers(number)
        if note:
            note(pi, ray, course.weight, met)
        found = _noted(found, course, foremost, met, number, depth, dr.select(met, radiance(pi, ray), 0), glows)
        lobes = _lobes(specular, pi, ray, number, met)
        nexts = [_onward(course, lobe, depth) for lobe in lobes]
        best, others = _strongest_first(nexts)
        best.plain = course.plain
        # A surface with a null lobe is not the end of the leg.
        found.depth = dr.select(foremost & (best.weight > 0) & ~glows, dr.inf, found.depth)
        on, lost = followed(number, best)
        found.lost += lost
        for other in others:
            push, lost = followed(number, other)
            found.lost += lost
            stack.write(other, pending, push)
            pending = pending + dr.select(push, mi.UInt32(1), 0)
        pop = ~on & (pending > 0)
        if branches:
            pending = pending - dr.select(pop, mi.UInt32(1), 0)
            best = dr.select(pop, stack.read(pending, pop), best)
        return best, foremost & on, found, alive & (on | pop), pending, stack

    none = Found(mi.Float(0), mi.Bool(False), mi.UInt32(0), *(mi.Float(dr.inf),) * 2, mi.Float(0))
    state = (Course.begun(ray, start), mi.Bool(True), none, mi.Bool(passes), mi.UInt32(0), stack)
    return dr.while_loop(state, lambda course, foremost, found, alive, *_: alive, leg)[2]


def strongest_course(
    scene: mi.Scene, specular: Specular, ray: mi.Ray3f, cosine: mi.Float, start: mi.Float
) -> Iterator[tuple[mi.SurfaceInteraction3f, mi.Float]]:
    """Surfaces on the course of the strongest lobes of one line of sight, and the apparent depth [mm] of each.

    Parameters as of `follow`, for one line. The line ends on the last surface, or leaves it and meets none.
    """
    course = Course.begun(ray, start)
    most, least = mi.UInt32(specular.most), mi.Float(specular.least)
    while True:
        ray = mi.Ray3f(course.origin, course.direction)
        at_one_wavelength(ray)
        pi = scene.ray_intersect_preliminary(ray)
        met = pi.is_valid()
        if not met[0]:
            return
        depth = course.depth + pi.t * cosine / course.index
        yield pi.compute_surface_interaction(ray), depth
        number = mi.UInt32(dr.reinterpret_array(mi.UInt32, pi.shape))
        nexts = [_onward(course, lobe, depth) for lobe in _lobes(specular, pi, ray, number, met)]
        course, _ = _strongest_first(nexts)
        if not _followed(specular, most, least, number, course)[0][0]:
            return


def first_met(body: mi.Float) -> mi.UInt32:
    """Number of the first surface met, 0 for none, from the code of all surfaces that a line met (`Sight.body`)."""
    return mi.UInt32(dr.abs(body)) & CODES


def _followed(
    specular: Specular, most: mi.UInt32, least: mi.Float, number: mi.UInt32, course: Course
) -> tuple[mi.Bool, mi.Float]:
    """True where a course from a shape of this number is followed; its share of the light where it is not."""
    leads = _leads_to_light(specular, number, course)
    on = leads & (course.carries() > least) & (course.length <= most)
    return on, dr.select(leads & ~on, course.carries(), 0)


def _noted(
    found: Found,
    course: Course,
    foremost: mi.Bool,
    met: mi.Bool,
    number: mi.UInt32,
    depth: mi.Float,
    radiance: mi.Float,
    covered: mi.Bool,
) -> Found:
    """`found` with the surface at the end of one leg added."""
    foremost = met & foremost
    first = foremost & (found.body == 0)
    entry, rest = found.body & CODES, found.body // (CODES + 1)
    later = entry + (CODES + 1) * ((31 * rest + number + 1) % CODES)
    code = dr.select(first, 1 + number % CODES, later)
    return Found(
        radiance=found.radiance + course.weight * radiance,
        covered=found.covered | ((course.plain > 0) & covered),
        body=dr.select(foremost, code, found.body),
        depth=dr.select(foremost, depth, found.depth),
        front=dr.select(first, depth, found.front),
        lost=found.lost,
    )


def _lobes(
    specular: Specular, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, number: mi.UInt32, met: mi.Bool
) -> list[_Lobe]:
    """Lobes of the scene's kinds where a ray meets a surface; of weight 0 where a surface lacks them."""
    index = dr.gather(mi.UInt32, specular.bsdf, number, met)
    goes_on = met & (index > 0)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active=goes_on)
    bsdf, lift = dr.reinterpret_array(mi.BSDFPtr, index), dr.gather(mi.Float, specular.lift, number, goes_on)
    lobes = []
    for name in specular.lobes:
        if name == "null":
            weight = dr.select(goes_on, scalar(bsdf.eval_null_transmission(si, goes_on)), 0)
            lobes.append(_Lobe(_off(si, ray.d, lift), mi.Vector3f(ray.d), weight, mi.Float(1), mi.Bool(True)))
            continue
        towards, weight, indices = _deviated(specular, name, bsdf, si, number, goes_on)
        direction = si.to_world(towards)
        lobes.append(_Lobe(_off(si, direction, lift), direction, weight, indices, mi.Bool(False)))
    return lobes


def _deviated(
    specular: Specular, name: str, bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, number: mi.UInt32, goes_on: mi.Bool
) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """Direction in the shading frame, weight and ratio of indices of the lobe `name`, summed over a blend's parts."""
    context = mi.BSDFContext()
    context.type_mask = DELTA[name] | mi.BSDFFlags.Null  # without null lobes a mask's nested BSDF is not sampled
    towards, weight, indices = mi.Vector3f(0), mi.Float(0), mi.Float(1)
    parts = dr.gather(mi.UInt32, specular.parts, number, goes_on) if specular.most_parts else mi.UInt32(0)
    for part in (WHOLE, *range(specular.most_parts)):
        context.component = part
        active = goes_on & (parts == 0) if part == WHOLE else goes_on & (part < parts)
        # 0: of a mask its nested BSDF, whose density is its opacity.
        sample, value = bsdf.sample(context, si, 0.0, mi.Point2f(0.5), active)
        of_kind = active & mi.has_flag(sample.sampled_type, DELTA[name])
        weight += dr.select(of_kind, scalar(value) * sample.pdf, 0)
        towards, indices = dr.select(of_kind, sample.wo, towards), dr.select(of_kind, sample.eta, indices)
    return towards, weight, indices


def _off(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, lift: mi.Float) -> mi.Point3f:
    """Start of a ray from a surface in this direction, above it by a little more than coordinates are rounded."""
    return mi.Point3f(si.p + dr.mulsign(lift, dr.dot(si.n, direction)) * si.n)


def _onward(course: Course, lobe: _Lobe, depth: mi.Float) -> Course:
    """`course` with one more lobe."""
    return replace(
        course,
        origin=lobe.origin,
        direction=mi.Vector3f(lobe.direction),
        weight=course.weight * lobe.weight,
        depth=depth,
        index=course.index * lobe.indices,
        plain=dr.select(lobe.straight, course.plain, 0),
        length=course.length + 1,
    )


def _strongest_first(courses: list[Course]) -> tuple[Course, list[Course]]:
    """The course with the largest share of the light, the first of equal ones, and the others."""
    best, others = courses[0], []
    for course in courses[1:]:
        stronger = course.carries() > best.carries()
        others.append(dr.select(stronger, best, course))
        best = dr.select(stronger, course, best)
    return best, others


def _leads_to_light(specular: Specular, number: mi.UInt32, course: Course) -> mi.Bool:
    """True where the weight is positive and the last leg meets the box of the surfaces from which light can come."""
    low, high = (
        mi.Vector3f(*(dr.gather(mi.Float, specular.reach, 6 * number + k, course.weight > 0) for k in of))
        for of in (range(3), range(3, 6))
    )
    inverse = dr.rcp(course.direction)
    a, b = (low - course.origin) * inverse, (high - course.origin) * inverse
    enters, leaves = dr.max(dr.minimum(a, b), axis=0), dr.min(dr.maximum(a, b), axis=0)
    return (course.weight > 0) & ~(leaves < dr.maximum(enters, 0))  # True also where 0/0 leaves it open
