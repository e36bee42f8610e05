"""Occlusion between surface and camera (α of Eq. 4), and shapes that cannot occlude themselves."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ...emission.elements import Elements, elements_of

GRAZING = 0.01  # rad above the surface; less light than this leaves it at flatter angles
LIFT = 1e-6  # of the shape's size: distance from the surface that float32 resolves
DIRECTIONS = 4  # rays from each element
ELEMENTS = 1 << 14  # rays leave so many elements at least
SLIVERS = 1e-6  # of the shape's area: elements that float32 gives no direction, whose rays may meet anything
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
# Start of a ray that leaves the surface: these shares of the largest coordinate and of the distance [mm/mm], some
# hundred times the rounding of float32.
CLEAR, CLEAR_OF_DISTANCE = 2.0**-16, 2.0**-20
RESOLVED = 4e-7  # of the largest coordinate: a ray that starts so high above a surface does not meet it by rounding
PARALLEL = 0.99  # cosine of the angle between the normals of a surface and of one that a ray may meet by rounding


def hidden(scene: mi.Scene, point: mi.Point3f, normal: mi.Normal3f, lens_point: mi.Point3f, active: mi.Bool) -> mi.Bool:
    """True where a surface lies between a surface point and a point of the lens.

    Neighbouring lines, mostly of one piece of a surface, are traced as one packet in scenes of meshes alone: in packets
    Embree misses some points of a disk.
    """
    together = all(shape.is_mesh() for shape in scene.shapes())
    ray = ray_to_lens(scene, point, normal, lens_point, active)
    return scene.ray_test(ray, coherent=together, active=active)


def ray_to_lens(
    scene: mi.Scene, point: mi.Point3f, normal: mi.Normal3f, lens_point: mi.Point3f, active: mi.Bool
) -> mi.Ray3f:
    """Ray from a surface point that ends at a point of the lens.

    It starts a little further along its own direction. Mitsuba's `spawn_ray` would move the start along the normal by
    9e-5 of the point's distance from the origin, and with it the borders of shadows by a hundredth of a pixel.

    Rounding lets a ray that leaves at a flat angle meet the surface that it leaves, as long as it is not `RESOLVED`
    above. There it starts beyond any surface that it meets and that is parallel to its own.
    """
    way = mi.Vector3f(lens_point - point)
    distance = dr.norm(way)
    direction = way / distance
    clear = clear_of(point) + CLEAR_OF_DISTANCE * distance
    rise = dr.dot(normal, direction)
    resolved = RESOLVED * dr.max(dr.abs(point), axis=0)
    above = dr.select(rise * distance > 2 * resolved, resolved / rise, 0)  # distance at which it is

    def beyond(start: mi.Float, alive: mi.Bool) -> tuple[mi.Float, mi.Bool]:
        ray = mi.Ray3f(point + start * direction, direction)
        ray.maxt = above - start
        pi = scene.ray_intersect_preliminary(ray, active=alive)
        met = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active=alive)
        own = alive & pi.is_valid() & (dr.abs(dr.dot(met.n, normal)) > PARALLEL)
        start = dr.select(own, 2 * (start + pi.t), start)
        return start, own & (start < above)

    state = (clear, active & (clear < above))
    clear = dr.while_loop(state, lambda start, alive: alive, beyond)[0]
    ray = mi.Ray3f(point + clear * direction, direction)
    ray.maxt = distance - clear
    return ray


def clear_of(point: mi.Point3f) -> mi.Float:
    """Distance [mm] from a surface point at which a ray that leaves it starts, above the rounding of coordinates."""
    return CLEAR * dr.max(dr.abs(point), axis=0)


def hides_nothing(scene: mi.Scene) -> bool:
    """True for a scene of one shape that no grazing ray from any of its elements meets again.

    A test of the mesh edge by edge would miss a shallow dent in a fine mesh, where each edge bends by less than
    rounding. Rays from elements too narrow for float32 to give them a normal, such as those at the poles of a sphere,
    do not count if the area of these elements is negligible.
    """
    shapes = scene.shapes()
    if len(shapes) != 1:
        return False
    elements, box = elements_of(shapes[0], ELEMENTS), shapes[0].bbox()
    index = dr.arange(mi.UInt32, elements.count)
    si, area = elements.place(index, mi.Point2f(0.5))
    frame = mi.Frame3f(si.n)
    origin = si.p + LIFT * float(dr.norm(box.extents())) * si.n
    directed = area > clear_of(si.p) * _longest_side(elements, index)
    met = dr.zeros(mi.Bool, elements.count)
    for k in range(DIRECTIONS):
        sine, cosine = dr.sincos(GOLDEN_ANGLE * mi.Float(index) + dr.opaque(mi.Float, 2 * math.pi * k / DIRECTIONS))
        direction = dr.normalize(frame.to_world(mi.Vector3f(cosine, sine, GRAZING)))
        met |= scene.ray_test(mi.Ray3f(origin, direction), active=area > 0)
        if dr.any(met & directed):
            return False
    return float(dr.sum(dr.select(met, area, 0))[0]) <= SLIVERS * float(dr.sum(area)[0])


def _longest_side(elements: Elements, index: mi.UInt32) -> mi.Float:
    """Largest distance between neighbouring corners of each element [mm]."""
    corners = [elements.place(index, mi.Point2f(*at))[0].p for at in elements.corners]
    longest = mi.Float(0)
    for k, corner in enumerate(corners):
        longest = dr.maximum(longest, dr.norm(corner - corners[k - 1]))
    return longest
