"""Courses of a line of sight through and off specular surfaces (Eq. M.19), one sequence of lobes after the other.

The lobe of the largest weight is followed first, the others after it. Sequences end where their weight is too small or
their length too large; the rest counts as error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ...jit.spectra import at_one_wavelength, scalar
from .specular import DELTA, Specular, off_surface

WHOLE = 0xFFFFFFFF  # Mitsuba's number for all components of a BSDF
CODES = 4095  # numbers for a first surface, and for all later ones, that one float32 can encode

if TYPE_CHECKING:
    Radiance = Callable[[mi.PreliminaryIntersection3f, mi.Ray3f], mi.Float]
    Covers = Callable[[mi.UInt32], mi.Bool]
    Note = Callable[[mi.PreliminaryIntersection3f, mi.Ray3f, mi.Float, mi.Bool], None]


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
    followed = partial(_followed, specular, dr.opaque(mi.UInt32, specular.most), dr.opaque(mi.Float, specular.least))
    branches = specular.branches
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
        light = dr.select(met & _counts(specular, course), radiance(pi, ray), 0)
        found = _noted(found, course, foremost, met, number, depth, light, glows)
        nexts = [_onward(course, lobe, depth) for lobe in _lobes(specular, pi, ray, number, met)]
        best, others = _strongest_first(nexts)
        best.plain = course.plain
        # A surface with a null lobe is not the end of the leg.
        found.depth = dr.select(foremost & (best.weight > 0) & ~glows, dr.inf, found.depth)
        on, lost = followed(number, best)
        found.lost += lost
        if not branches:
            return best, foremost & on, found, alive & on, pending, stack
        for other in others if specular.part != "plain" else [_straight(others)]:
            push, lost = followed(number, other)
            found.lost += lost
            stack.write(other, pending, push)
            pending = pending + dr.select(push, mi.UInt32(1), 0)
        pop = ~on & (pending > 0)
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
    if specular.part == "plain":
        leads &= course.plain > 0
    on = leads & (course.carries() > least) & (course.length <= most)
    return on, dr.select(leads & ~on & _counts(specular, course), course.carries(), 0)


def _counts(specular: Specular, course: Course) -> mi.Bool:
    """True where the light of a course belongs to the part of the light that is summed."""
    if specular.part == "all":
        return mi.Bool(True)
    return (course.plain > 0) if specular.part == "plain" else (course.plain == 0)


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
            lobes.append(_Lobe(off_surface(si, ray.d, lift), mi.Vector3f(ray.d), weight, mi.Float(1), mi.Bool(True)))
            continue
        towards, weight, indices = _deviated(specular, name, bsdf, si, number, goes_on)
        direction = si.to_world(towards)
        lobes.append(_Lobe(off_surface(si, direction, lift), direction, weight, indices, mi.Bool(False)))
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


def _straight(courses: list[Course]) -> Course:
    """Of some courses with one more lobe each the one that leads straight on; any of them if there is none."""
    found = courses[0]
    for course in courses[1:]:
        found = dr.select(course.plain > 0, course, found)
    return found


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
