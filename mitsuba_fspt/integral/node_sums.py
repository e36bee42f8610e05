"""Lines of sight as kernels: the integrand of Eq. 9, and rules over pixel and pupil.

Every function here is one loop of one kernel, over as many lines of sight as the arrays are wide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..emission.face_table import Faces
from ..jit.loops import repeat
from ..jit.spectra import at_one_wavelength, scalar
from . import node_rules
from .shortcuts import Finding

if TYPE_CHECKING:
    from .window import Window

# Triangles a pixel up to which neighbouring lines of sight meet the same ones and are the faster traced together:
# nodes of pixels in a square, transects of one pixel.
NODES_TOGETHER, TRANSECTS_TOGETHER = 4.0, 0.5

# ---------------------------------------------------------------------- one line of sight


@dataclass(frozen=True)
class View:
    """What a lens sees of a scene along lines of sight that begin at the depth `start` [mm], before all there is.

    To Mitsuba a small round body far from where a ray begins has a fuzzy limb: rounding moves it by a share of the
    distance squared over its radius. Of its triangles there are `detail` a pixel.
    """

    scene: mi.Scene
    lens: mi.Sensor
    start: mi.Float
    faces: Faces | None
    detail: float

    @classmethod
    def of(cls, scene: mi.Scene, lens: mi.Sensor, window: Window, faces: Faces | None = None) -> View:
        """As seen in a window through Mitsuba's surface records or, where the scene has them, its `faces`."""
        shapes = scene.shapes()
        # In packets Embree passes by some points of a disk.
        meshes = all(shape.is_mesh() for shape in shapes)
        triangles = sum(shape.face_count() for shape in shapes) if meshes else math.inf
        start = dr.opaque(mi.Float, lens.clear_depth(scene.bbox()))
        return cls(scene, lens, start, faces, triangles / math.prod(window.shape))

    def radiance_on_film(
        self, position: mi.Point2f, pupil: mi.Point2f, together: bool = False
    ) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        """Integrand of Eq. 9, cos⁴θ · L [W/mm²/sr]; L; number of the body met, 0 for none or no passage; its depth
        [mm].

        `pupil`, on the unit disc, stands for as large a share of what is open; the integrand for all of the pupil.
        Lines of neighbouring lanes are traced `together`, as one packet, or each on its own.
        """
        pupil, share = self.lens.open_pupil(position, pupil)
        ray, weight, cos_theta = self.lens.line_of_sight(position, pupil, self.start)
        at_one_wavelength(ray)
        pi = self.scene.ray_intersect_preliminary(ray, coherent=together, active=weight > 0)
        radiance = self.faces.radiance(pi, ray.d) if self.faces else self._by_record(pi, ray)
        body = mi.Float(dr.reinterpret_array(mi.UInt32, pi.shape))
        return share * weight * radiance, radiance, body, self.start + pi.t * cos_theta

    def finding(self) -> Finding:
        """Whether lines of sight do without Mitsuba's surface records."""
        why = "meshes alone, J_n linear on every face, the same radiance in all directions"
        return Finding("record", self.faces is not None, why if self.faces else f"wanted: {why}")

    def _by_record(self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.Float:
        """Radiance [W/mm²/sr] where a ray ends, whatever the shape and however it glows."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        return scalar(si.emitter(self.scene).eval(si))


# ---------------------------------------------------------------------- rules on every pixel


@dataclass
class Sums:
    """What the nodes of a rule see from a pixel, or from each of many.

    value, x, y : integrand of Eq. 9 [W/mm²/sr], and times the place on the pupil, weighted and summed
    contrast : how far the integrand bends, see `rules.Rule`
    coverage : share of the lines of sight that meet something
    nearest, farthest : depths of what is met [mm]; inf and 0 where nothing is
    """

    value: mi.Float
    contrast: mi.Float
    x: mi.Float
    y: mi.Float
    coverage: mi.Float
    nearest: mi.Float
    farthest: mi.Float


NOTHING_SEEN = (0, 0, 0, 0, 0, math.inf, 0)


def apply_rule(view: View, centre: mi.Point2f, rule: node_rules.Rule) -> Sums:
    """What one rule sees from every pixel."""
    table = [mi.Float(column) for column in (*rule.pupil.T, *rule.pixel.T, rule.weight, rule.contrast)]
    together = view.detail <= NODES_TOGETHER

    def node(k: mi.UInt32, sums: Sums) -> tuple[Sums]:
        ax, ay, dx, dy, weight, null = (dr.gather(mi.Float, column, k) for column in table)
        f, _, body, depth = view.radiance_on_film(centre + mi.Point2f(dx, dy), mi.Point2f(ax, ay), together)
        hit = body > 0
        seen = Sums(
            value=sums.value + weight * f,
            contrast=sums.contrast + null * f,
            x=sums.x + weight * f * ax,
            y=sums.y + weight * f * ay,
            coverage=sums.coverage + dr.select(hit, weight, 0),
            nearest=dr.select(hit, dr.minimum(sums.nearest, depth), sums.nearest),
            farthest=dr.select(hit, dr.maximum(sums.farthest, depth), sums.farthest),
        )
        return (seen,)

    start = Sums(*map(mi.Float, NOTHING_SEEN))
    return repeat(dr.opaque(mi.UInt32, len(rule)), node, start)[0]
