"""What hides light on its way from the surface to the lens, and bodies that hide nothing of themselves."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..emission.elements import elements_of

GRAZING = 0.01  # rad above the surface; light that leaves it flatter is next to none
LIFT = 1e-6  # of the body's size: what float32 needs to stand clear of the surface
DIRECTIONS = 4  # looked along from each element
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
# Where a ray begins on its way from the surface: so much of the largest coordinate and of the distance [mm/mm], some
# hundred times what float32 can be wrong by.
CLEAR, CLEAR_OF_DISTANCE = 2.0**-16, 2.0**-20


def hidden(scene: mi.Scene, point: mi.Point3f, lens_point: mi.Point3f, active: mi.Bool) -> mi.Bool:
    """True where a surface lies between a surface point and a point of the lens.

    The ray begins a little further on its way. Mitsuba's own would be lifted off along the normal, by 9e-5 of the
    point's distance from the origin, and with them the borders of all shadows: by a hundredth of a pixel.
    """
    way = mi.Vector3f(lens_point - point)
    distance = dr.norm(way)
    direction = way / distance
    clear = CLEAR * dr.max(dr.abs(point), axis=0) + CLEAR_OF_DISTANCE * distance
    ray = mi.Ray3f(point + clear * direction, direction)
    ray.maxt = distance - clear
    return scene.ray_test(ray, active=active)


def hides_nothing(scene: mi.Scene) -> bool:
    """True of one body alone that no grazing line from any of its elements meets again.

    Not asked of the mesh edge by edge: a shallow dent in a fine mesh bends inwards by less than rounding at each.
    """
    shapes = scene.shapes()
    if len(shapes) != 1:
        return False
    elements, box = elements_of(shapes[0]), shapes[0].bbox()
    index = dr.arange(mi.UInt32, elements.count)
    si, area = elements.place(index, mi.Point2f(0.5))
    frame = mi.Frame3f(si.n)
    origin = si.p + LIFT * float(dr.norm(box.extents())) * si.n
    for k in range(DIRECTIONS):
        sine, cosine = dr.sincos(GOLDEN_ANGLE * mi.Float(index) + dr.opaque(mi.Float, 2 * math.pi * k / DIRECTIONS))
        direction = dr.normalize(frame.to_world(mi.Vector3f(cosine, sine, GRAZING)))
        if dr.any(scene.ray_test(mi.Ray3f(origin, direction), active=area > 0)):
            return False
    return True
