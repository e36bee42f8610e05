"""Light that a method leaves out: what reaches the lens after a scattering reflection, or from points and beams.

Eq. 9 sums the light that surfaces emit towards the lens, directly or by way of specular surfaces. A white table, a
second phantom or a dent of the phantom itself scatters some of the light once more; Monte Carlo follows it as far as
its `max_depth`. A short Monte Carlo run estimates how much of the power is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...jit.plugin_objects import made
from ...jit.recording import recording
from ...jit.spectra import at_one_wavelength, scalar
from ..quadrature import Quadrature
from .eq9 import View, etendue_from_pixel
from .occlusion import hides_nothing
from .specular import Specular
from .visible_window import visible_window

PATHS = 1 << 14  # standard error of a share of 5 %: about 0.1 %
BOUNCES = 2  # scattering reflections that are counted: further ones are weaker by the albedo each
SURE = 2.0  # standard errors above which a share is significant


@dataclass
class LeftOut:
    """Share of an image's power that a method leaves out, its standard error, and ids of the shapes that scatter it.

    depth : segments of light paths that the method follows; None: the integral
    needed : segments of the longest paths that are counted
    """

    share: float
    error: float
    bodies: tuple[str, ...]
    depth: int | None
    needed: int

    def warning(self, least: float) -> str | None:
        """One line that states the share; None if it is below `least`, such as rtol, or not significant."""
        if not self.share > max(least, SURE * self.error):
            return None
        sends = "scatters light" if self.depth is None else "scatters or leads light on"
        named = f"{', '.join(self.bodies)} {sends}" if self.bodies else "emitters other than surfaces shine"
        power = f"about {100 * self.share:.2g} % (± {100 * self.error:.1g} %) of the power reaches the lens after"
        if self.depth is None:
            fix = f"Render with method path and max_depth {self.needed} to see it"
            return f"{named}: {power} a further reflection, which Eq. 9 leaves out. {fix}"
        return (
            f"{named}: {power} more than max_depth = {self.depth} segments, which are left out. Give max_depth = "
            f"{self.needed} to see it"
        )


def light_left_out(scene: mi.Scene, camera: Camera, quadrature: Quadrature, depth: int | None = None) -> LeftOut | None:
    """Share of the power on the crop window that a method leaves out; None if no shape can scatter light.

    depth : segments of the paths that a Monte Carlo follows; None: the integral
    """
    with recording(), dr.suspend_grad():
        window = visible_window(scene, camera)
        if 0 in window.shape:  # no emitter is in the image, but what it shines on may be
            window = visible_window(scene, camera, everywhere=True)
        if 0 in window.shape:
            return None
        view = View.of(scene, camera, window, None, Specular.of(scene, camera, quadrature))
        return _left_out_of(view, quadrature, depth)


def _left_out_of(view: View, quadrature: Quadrature, depth: int | None) -> LeftOut | None:
    scene, leads_on = view.scene, view.specular.names if view.specular else ()
    bodies = scattering_shapes(scene)
    others = [e for e in scene.emitters() if not mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
    scattered = others or (bodies and not hides_nothing(scene))
    needed = 1 + (BOUNCES if scattered else 0) + (quadrature.max_specular if leads_on else 0)
    if not scattered and (depth is None or depth >= needed):
        return None
    if depth is not None:
        bodies += [name for name in leads_on if name not in bodies]
        if depth >= needed:
            return LeftOut(0.0, 0.0, tuple(bodies), depth, needed)
    total, counted = _sampled(view, needed, depth)
    missing, whole = total - counted, total.sum()
    if not whole > 0:
        return LeftOut(0.0, 0.0, tuple(bodies), depth, needed)
    error = float(missing.std() * np.sqrt(len(missing)) / whole)
    return LeftOut(max(0.0, float(missing.sum() / whole)), error, tuple(bodies), depth, needed)


def _sampled(view: View, needed: int, depth: int | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power on `PATHS` random lines of sight over paths of `needed` segments, and what the method counts of it.

    Both paths of a line use the same random numbers, so that their first segments are the same.
    """

    def radiance(segments: int) -> tuple[mi.Float, mi.Float, mi.Point2f, mi.Point2f]:
        path = made("path", max_depth=segments, rr_depth=needed)
        sampler = made("independent")
        sampler.seed(0, PATHS)
        camera, film = view.camera, view.camera.film
        position = sampler.next_2d() * mi.Vector2f(film.crop_size) + mi.Vector2f(film.crop_offset)
        pupil = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        on_open, open_share = camera.open_pupil(position, pupil)
        ray, cos_theta, passes = camera.line_of_sight(position, on_open, view.start)
        at_one_wavelength(ray)
        found = scalar(path.sample(view.scene, sampler, mi.RayDifferential3f(ray), None, passes)[0])
        etendue = etendue_from_pixel(cos_theta, passes, open_share * camera.film_map.area_share(position))
        etendue *= camera.share_at(position)
        dr.eval(found, etendue)
        return found, etendue, position, pupil

    total, etendue, position, pupil = radiance(needed)
    if depth is None:
        counted = view.integrand(position, pupil).integrand * view.camera.share_at(position)
    else:
        counted = radiance(depth)[0] * etendue
    return tuple(column.numpy().astype(np.float64) for column in (total * etendue, counted))


def scattering_shapes(scene: mi.Scene) -> list[str]:
    """Ids of the shapes whose BSDF scatters light; the one that Mitsuba gives to emitters without BSDF is black."""
    return [shape.id() for shape in scene.shapes() if scatters(shape.bsdf())]


def scatters(bsdf: mi.BSDF) -> bool:
    """True for a BSDF with a lobe that is not specular, unless its reflectance is 0 everywhere."""
    if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth):
        return False
    if bsdf.class_name() != "SmoothDiffuse":
        return True
    values = mi.traverse(bsdf)
    return any(np.any(np.asarray(values[key]) > 0) for key in values.keys() if key.startswith("reflectance."))
