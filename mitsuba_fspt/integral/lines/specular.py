"""Specular surfaces: transmission and reflection of lines of sight.

A BSDF sends light on in single directions by three kinds of lobes: the null lobe (undeviated: `null`, `mask`, a thin
pane), specular transmission (refraction at the border of a solid) and specular reflection (mirrors, and every pane).
Radiance along a line of sight is the sum over all sequences of such lobes of the product of their weights and the
radiance of the surface where each sequence ends (Eq. M.19).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Box, corners_of
from ...emission.face_table import shape_number
from ...emission.of_emitter import surface_of, surfaces_of
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import box_of, is_shaded_smoothly, shading_normals
from ...jit.plugin_objects import made
from ...jit.spectra import at_one_wavelength, scalar
from ..quadrature import MOST_SPECULAR, Quadrature
from .glass import Glass
from .mirror import Mirror, Untraced, index_of
from .nested_bsdfs import blended_parts
from .occlusion import RESOLVED, hidden, ray_to_lens
from .plane import FLAT, Plane
from .poses import Deviating

Array = NDArray[np.float64]
SMOOTHEST = 1e-4  # roughness below which Mitsuba's rough conductor has the lobe of this roughness: a mirror's
ROUNDING = 2e-6  # of the largest coordinate: margin of a box
FAINTER = 0.1  # least weight of courses with weaker lobes, where they are followed apart, over that of others
DELTA = {
    "null": mi.BSDFFlags.Null,
    "transmission": mi.BSDFFlags.DeltaTransmission,
    "reflection": mi.BSDFFlags.DeltaReflection,
}


@dataclass(frozen=True)
class Specular:
    """Specular shapes of a scene; tables are indexed by Dr.Jit's number of a shape.

    names : ids of the shapes
    lobes : kinds of lobes that can lead to light, of 'null', 'transmission' and 'reflection'
    bending : boxes of the shapes that deviate lines of sight
    deviating : the same shapes, with the poses from which a camera looks straight at what they show
    bsdf : Dr.Jit's number of a shape's BSDF; 0 where lines of sight end
    parts : components of a shape's BSDF that are sampled one at a time; 0 for those of no blend
    most_parts : largest of `parts`
    reach : box of all surfaces from which light can reach a shape, six numbers [mm]
    lift : distance from a shape at which the next leg of a line starts [mm]
    most : longest sequence of lobes that is followed
    least : smallest weight with which a sequence is followed
    kept : BSDFs that replace others, referenced so that they stay alive
    part : of the light that is summed: 'all'; 'plain', of courses on which every lobe is the strongest of its surface
        or leads straight on; 'others'
    """

    names: tuple[str, ...]
    lobes: tuple[str, ...]
    bending: tuple[Box, ...]
    deviating: tuple[Deviating, ...]
    bsdf: mi.UInt32
    parts: mi.UInt32
    most_parts: int
    reach: mi.Float
    lift: mi.Float
    most: int
    least: float
    kept: tuple[mi.BSDF, ...]
    part: str = "all"

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
        planes = [Plane.of(shape) for shape, _ in bent]
        if len(bent) == 1 and "transmission" not in lobes and _separate(planes[0], camera, glowing):
            lobes, bent, planes = lobes - {"reflection"}, [], []  # what a pane reflects to the lens is dark
        if not (lobes or even_if_none):
            return None
        boxes = [_box(shape) for shape, _ in bent]
        corners = [
            np.concatenate([plane.corners for plane in sides]) if sides else corners_of([box])
            for sides, box in zip(planes, boxes, strict=True)
        ]
        count = 1 + max(map(shape_number, scene.shapes()))
        bsdf, parts = np.zeros((2, count), np.uint32)
        reach, lift = np.zeros((count, 6), np.float32), np.zeros(count, np.float32)
        for shape, its in shapes:
            number = shape_number(shape)
            bsdf[number] = dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(its))[0]
            parts[number] = blended_parts(its)
            # Of a flat shape no light reaches itself.
            beside = zip(bent, boxes, planes, strict=True)
            others = [box for (other, _), box, plane in beside if other is not shape or len(plane) != 1]
            reach[number] = _around([*glowing, *others])
            lift[number] = RESOLVED * np.abs(_box(shape)).max()
        return cls(
            tuple(shape.id() for shape, _ in shapes),
            tuple(name for name in DELTA if name in lobes) or ("null",),
            tuple(boxes),
            tuple(
                _deviating(
                    *pair, plane, corners[k], [corners_of([box]) for box in glowing] + corners[:k] + corners[k + 1 :]
                )
                for k, (pair, plane) in enumerate(zip(bent, planes, strict=True))
            ),
            from_numpy(mi.UInt32, bsdf),
            from_numpy(mi.UInt32, parts),
            int(parts.max()),
            from_numpy(mi.Float, reach),
            from_numpy(mi.Float, lift),
            quadrature.max_specular,
            quadrature.least_weight,
            tuple(its for _, its in shapes),
        )

    def state(self) -> tuple[object, ...]:
        """Key of the parameters that light through these shapes depends on, without their poses."""
        values = [mi.traverse(bsdf) for bsdf in self.kept]
        return self.names, self.lobes, tuple(_key(value[name]) for value in values for name in value.keys())

    @property
    def faintest(self) -> float:
        """Smallest weight with which any sequence of lobes is followed."""
        return FAINTER * self.least

    @property
    def straight(self) -> bool:
        """True if lines of sight that lead to light are not deviated."""
        return not self.bending

    @property
    def branching(self) -> bool:
        """True if courses with weaker lobes than the strongest of a surface may lead to light, too."""
        return any(len({*lobes_of(bsdf)}.intersection(self.lobes)) > 1 for bsdf in self.kept)

    @property
    def branches(self) -> int:
        """Largest number of lobes beside the strongest one that are followed from one surface."""
        others = len(self.lobes) - 1
        return min(others, int("null" in self.lobes)) if self.part == "plain" else others


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


def only_hides(shape: mi.Shape) -> bool:
    """True for a shape that neither glows nor lets light through."""
    if set(lobes_of(shape.bsdf())) - {"reflection"}:
        return False
    return not shape.is_emitter() or ((surface := surface_of(shape.emitter())) is not None and surface.brightest <= 0)


def longest_course(scene: mi.Scene) -> int:
    """Surfaces on the longest course that glass turns back and on again: every border three times, but for the two that
    reflect, every mirror once; 0 without glass. More reflections by glass have the weight R⁴ of its borders, or less.
    """
    kinds = [set(lobes_of(bsdf)) for shape in scene.shapes() if (bsdf := specular_bsdf(shape)) is not None]
    borders = sum(2 if "transmission" in lobes else 1 for lobes in kinds if len(lobes) > 1)
    return min(3 * borders - 2 + sum(lobes == {"reflection"} for lobes in kinds), MOST_SPECULAR) if borders else 0


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


def _deviating(
    shape: mi.Shape, bsdf: mi.BSDF, planes: tuple[Plane, ...], corners: Array, others: Sequence[Array]
) -> Deviating:
    """A shape with these planes that lies between `corners` (n, 3) and deviates lines of sight.

    others : points between which what may lie inside of it does
    """
    if "transmission" in lobes_of(bsdf):
        return Glass.of(shape, bsdf, planes, others) or Untraced(corners)
    if not planes or _is_shaded_otherwise(shape, planes):
        return Untraced(corners)
    index = index_of(bsdf) if bsdf.class_name() == "ThinDielectric" else None
    return Mirror(planes, index, "null" in lobes_of(bsdf))


def _is_shaded_otherwise(shape: mi.Shape, planes: tuple[Plane, ...]) -> bool:
    """True if a shape reflects with other normals than those of its planes."""
    if not shape.is_mesh() or not is_shaded_smoothly(shape):
        return False
    across = np.cross(shading_normals(shape), planes[0].normal)
    return len(planes) > 1 or bool((np.linalg.norm(across, axis=-1) > FLAT).any())


def _separate(planes: tuple[Plane, ...], camera: Camera, glowing: Sequence[Box]) -> bool:
    """True if a shape is flat and lies between the whole pupil and everything that glows."""
    return len(planes) == 1 and planes[0].separates(camera, corners_of(glowing))


def transmission(
    scene: mi.Scene,
    specular: Specular | None,
    point: mi.Point3f,
    normal: mi.Normal3f,
    lens_point: mi.Point3f,
    active: mi.Bool,
) -> mi.Float:
    """Share of the light of a surface point that reaches a point of the lens undeviated; 0 where it is occluded.

    Through null lobes alone: a surface that deviates light counts as an occluder.
    """
    if specular is None:
        return dr.select(hidden(scene, point, normal, lens_point, active), 0, mi.Float(1))
    ray = ray_to_lens(scene, point, normal, lens_point, active)
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
        origin = off_surface(si, ray.d, dr.gather(mi.Float, specular.lift, number, goes_on))
        ray = mi.Ray3f(origin, ray.d, ray.maxt - pi.t, ray.time, ray.wavelengths)
        return share, ray, count + 1, goes_on & (share > 0) & (ray.maxt > 0)

    state = (mi.Float(1), ray, mi.UInt32(0), mi.Bool(active))
    return dr.while_loop(state, lambda share, ray, count, alive: alive, surface)[0]


def off_surface(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, lift: mi.Float) -> mi.Point3f:
    """Start of a ray from a surface in this direction, above it by a little more than coordinates are rounded."""
    return mi.Point3f(si.p + dr.mulsign(lift, dr.dot(si.n, direction)) * si.n)
