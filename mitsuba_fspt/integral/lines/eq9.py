"""Eq. 9: the power P [W] that light of a surface with exitance J_n brings to a pixel.

    P = 1/π ∫_S J_n α β |cosθ_s| |cosθ_d| / |r_vd − r|² dA_vd dS                  (Eq. 9, as the paper prints it)
      = ∫_pixel ∫_pupil L(r, ω) · cos⁴θ/u² dA_a dA_vd                            (Eq. M.5, pupil form)
      = ∫_S ∫_pupil L(r, ω) · cosθ_s cosθ/|r − a|² dA_a dS                       (Eq. M.9, surface form)

Every form sums radiance times étendue over lines of sight, P = Σ L · dG, and each calls `eq9` for it. A line of sight
runs from a point a of the pupil through a point r_vd of the virtual detector plane z = u to the first surface point r;
L(r, ω) [W/mm²/sr] is the exit law's radiance there (Lambert: J_n/π), 0 where α or β is 0. The forms differ in how they
choose the lines, and hence in the element of étendue dG [mm² sr] that each line stands for. docs/model.md derives them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...emission.face_table import FaceTable, shape_number
from ...emission.of_emitter import surfaces_of
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import box_of, face_count
from ...jit.spectra import at_one_wavelength, scalar
from ...runtime.plugin_types import is_surface
from ..shortcuts import Finding
from .courses import follow
from .specular import Specular

if TYPE_CHECKING:
    from ...camera.window import Window


def eq9(radiance: Any, etendue: Any) -> Any:
    """Power [W] that lines of sight with this radiance [W/mm²/sr] and étendue [mm² sr] carry: L · dG (Eq. 9).

    With an étendue relative to the pixel's own, `Camera.etendue`, the mean radiance on film [W/mm²/sr].
    """
    return etendue * radiance


def etendue_from_pixel(cos_theta: mi.Float, passes: mi.Bool, open_share: mi.Float | float = 1.0) -> mi.Float:
    """Étendue of a line of sight of the pupil form over that of its pixel: cos⁴θ times the open share (Eq. M.5).

    cos_theta : cosine of the line to the optical axis
    passes : False where a stop holds the line back
    open_share : share of the pupil that a second border leaves open to the virtual point, times the share of a virtual
        pixel's area that the film's distortion leaves a pixel (`FilmMap.area_share`)
    """
    return open_share * dr.select(passes, dr.square(dr.square(cos_theta)), 0)


def etendue_from_surface(
    cos_s: mi.Float, area: mi.Float, arrival: mi.Float, cell: mi.Float, virtual_pixel: mi.Float
) -> mi.Float:
    """Étendue dS cosθ_s dΩ of a line of sight of the surface form over that of a pixel (Eq. M.9).

    cos_s : cosine of the line to the normal of the surface element
    area : of the element, dS [mm²]
    arrival : solid angle of the pupil over A_pupil/u² (`Camera.arrival`)
    cell : area of the part of the unit disc, all of which is the pupil, that the line stands for
    virtual_pixel : area A_vd of a virtual pixel [mm²]
    """
    return cos_s * arrival * area * cell / (dr.pi * virtual_pixel)


@dataclass(frozen=True)
class Sight:
    """One line of sight.

    integrand : of Eq. 9 in the pupil form [W/mm²/sr], whose mean over pixel and pupil, times the pixel's étendue, is P
    radiance : [W/mm²/sr]
    body : number of the surfaces met, > 0 where the line ends on one; where it changes lies an edge
    covered : True if it reaches a shape with an `fspt_surface`, whatever its J_n there
    depth, front : depth [mm] at which the surface where the line ends and the first surface are seen, inf without one
    lost : share of the radiance along it that is not followed through or off specular surfaces
    """

    integrand: mi.Float
    radiance: mi.Float
    body: mi.Float
    covered: mi.Bool
    depth: mi.Float
    front: mi.Float
    lost: mi.Float


@dataclass(frozen=True)
class View:
    """A scene as a lens sees it along lines of sight, which begin at the depth `start` [mm], before all surfaces.

    Mitsuba moves the limb of a small sphere far from where a ray begins by a share of the distance squared over its
    radius; a late start avoids it.

    detail : triangles of the scene a pixel
    emitting : 1 at the number of each shape with an `fspt_surface`, 0 elsewhere; None where all shapes count
    specular : what lines of sight go through or off; None where they end at the first surface
    """

    scene: mi.Scene
    camera: Camera
    start: mi.Float
    faces: FaceTable | None
    detail: float
    emitting: mi.Float | None
    specular: Specular | None = None

    @classmethod
    def of(
        cls,
        scene: mi.Scene,
        camera: Camera,
        window: Window,
        faces: FaceTable | None = None,
        specular: Specular | None = None,
    ) -> View:
        """The view of a window's pixels through Mitsuba's surface records, or through the scene's face table."""
        shapes = scene.shapes()
        # In packets Embree misses some points of a disk.
        meshes = all(shape.is_mesh() for shape in shapes)
        triangles = sum(map(face_count, shapes)) if meshes else math.inf
        start = dr.opaque(mi.Float, camera.clear_depth(box_of(shapes)))
        return cls(scene, camera, start, faces, triangles / math.prod(window.shape), _emitting(shapes), specular)

    def integrand(self, position: mi.Point2f, pupil: mi.Point2f, together: bool = False) -> Sight:
        """Integrand of Eq. 9 in the pupil form on one line of sight, and the surfaces that the line met.

        position : on the film [pixels]
        pupil : on the unit disc; stands for as large a share of what is open of the pupil
        together : trace the lines of neighbouring array entries as one packet
        """
        pupil, open_share = self.camera.open_pupil(position, pupil)
        ray, cos_theta, passes = self.camera.line_of_sight(position, pupil, self.start)
        at_one_wavelength(ray)
        etendue = etendue_from_pixel(cos_theta, passes, open_share * self.camera.film_map.area_share(position))
        if self.specular:
            found = follow(self.scene, self.specular, ray, cos_theta, self.start, passes, self._radiance, self._covers)
            return Sight(
                eq9(found.radiance, etendue),
                found.radiance,
                dr.select(dr.isfinite(found.depth), mi.Float(found.body), -mi.Float(found.body)),
                found.covered,
                found.depth,
                found.front,
                etendue * found.lost,
            )
        pi = self.scene.ray_intersect_preliminary(ray, coherent=together, active=passes)
        radiance = self._radiance(pi, ray)
        number = mi.UInt32(dr.reinterpret_array(mi.UInt32, pi.shape))
        depth = self.start + pi.t * cos_theta
        integrand = eq9(radiance, etendue)
        return Sight(integrand, radiance, mi.Float(number), self._covers(number), depth, depth, mi.Float(0))

    def _covers(self, number: mi.UInt32) -> mi.Bool:
        """True where the number of a shape, 0 for none, is that of one with an `fspt_surface`."""
        met = number > 0
        if self.emitting is None:
            return met
        return met & (dr.gather(mi.Float, self.emitting, number, met) > 0)

    def findings(self) -> list[Finding]:
        """Whether lines of sight end at the first surface, and are evaluated without Mitsuba's surface records."""
        why = "what glows are meshes, J_n is linear on every face, the radiance the same in all directions"
        record = Finding("record", self.faces is not None, why if self.faces else f"wanted: {why}")
        if self.specular is None:
            return [Finding("specular", True, "no surface leads them on to light"), record]
        names = ", ".join(self.specular.names) or "nothing, as was wanted"
        way = "straight on" if self.specular.straight else "by reflection or refraction"
        return [Finding("specular", False, f"they go on {way} at {names}"), record]

    def _radiance(self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.Float:
        """Exit law's radiance [W/mm²/sr] where a ray ends, by record on any shape and with any law."""
        if self.faces:
            return self.faces.radiance(pi, ray.d)
        glows = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active=glows)
        return dr.select(glows, scalar(si.emitter(self.scene, glows).eval(si, glows)), 0)


def most_radiance(scene: mi.Scene) -> float:
    """Upper bound of the radiance of any surface with an `fspt_surface` [W/mm²/sr].

    J_n/π under Lambert's law; no law sends more than J_n per steradian.
    """
    return max((s.brightest / (math.pi if s.is_isotropic() else 1) for s in surfaces_of(scene)), default=0.0)


def _emitting(shapes: list[mi.Shape]) -> mi.Float | None:
    """The table `View.emitting` of these shapes; None too where none has an `fspt_surface`, as in a scene of tissue."""
    emitting = [is_surface(shape.emitter()) for shape in shapes]
    if all(emitting) or not any(emitting):
        return None
    numbers = [shape_number(shape) for shape in shapes]
    table = np.zeros(max(numbers) + 1, np.float32)
    table[numbers] = emitting
    return from_numpy(mi.Float, table)
