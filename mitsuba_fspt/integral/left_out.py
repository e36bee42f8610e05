"""Light that Eq. 9 leaves out: what reaches the lens after a scattering reflection, or from points and beams.

Eq. 9 sums what surfaces send to the lens themselves, and specular surfaces lead on. A white table, a second phantom or
a dent of the phantom itself reflects some of the light once more; a short Monte Carlo run estimates how much.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit.plugin_objects import made
from ..jit.spectra import at_one_wavelength, scalar
from .eq9 import View, etendue_from_pixel
from .occlusion import hides_nothing
from .quadrature import Quadrature

PATHS = 1 << 14  # standard error of a share of 5 %: about 0.1 %
BOUNCES = 2  # scattering reflections that are counted: further ones are weaker by the albedo each
SURE = 2.0  # standard errors above which a share is significant


@dataclass
class LeftOut:
    """Share of a picture's power that Eq. 9 leaves out, its standard error, and ids of the shapes that scatter."""

    share: float
    error: float
    bodies: tuple[str, ...]

    def warning(self, rtol: float) -> str | None:
        """One line about it; None where it is below `rtol` or not significant."""
        if not self.share > max(rtol, SURE * self.error):
            return None
        named = f"{', '.join(self.bodies)} scatters light" if self.bodies else "emitters other than surfaces shine"
        return (
            f"{named}: about {100 * self.share:.2g} % (± {100 * self.error:.1g} %) of the power reaches the lens after "
            "a further reflection, which Eq. 9 leaves out. Render with method path and max_depth 3 to see it"
        )


def light_left_out(view: View, quadrature: Quadrature) -> LeftOut | None:
    """Share of the power on the crop window that the integral leaves out; None where nothing can be."""
    scene = view.scene
    bodies = scattering_shapes(scene)
    others = [e for e in scene.emitters() if not mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
    if not (bodies or others) or (not others and hides_nothing(scene)):
        return None
    depth = 1 + BOUNCES + (quadrature.max_specular if view.specular else 0)
    path = made("path", max_depth=depth, rr_depth=depth)
    sampler = made("independent")
    sampler.seed(0, PATHS)
    lens, film = view.lens, view.lens.film()
    position = sampler.next_2d() * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())
    pupil = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
    on_open, open_share = lens.open_pupil(position, pupil)
    ray, cos_theta, passes = lens.line_of_sight(position, on_open, view.start)
    at_one_wavelength(ray)
    radiance = scalar(path.sample(scene, sampler, mi.RayDifferential3f(ray), None, passes)[0])
    etendue = etendue_from_pixel(cos_theta, passes, open_share)
    counted = view.integrand(position, pupil).integrand
    dr.eval(radiance, etendue, counted)
    total, counted = (column.numpy().astype(np.float64) for column in (radiance * etendue, counted))
    missing, whole = total - counted, total.sum()
    if not whole > 0:
        return LeftOut(0.0, 0.0, tuple(bodies))
    error = float(missing.std() * np.sqrt(len(missing)) / whole)
    return LeftOut(max(0.0, float(missing.sum() / whole)), error, tuple(bodies))


def scattering_shapes(scene: mi.Scene) -> list[str]:
    """Ids of the shapes whose BSDF scatters light, those apart that Mitsuba gives to emitters without one: black."""
    return [shape.id() for shape in scene.shapes() if scatters(shape.bsdf())]


def scatters(bsdf: mi.BSDF) -> bool:
    """True for a BSDF with a lobe that is not specular, unless its reflectance is 0 everywhere."""
    if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth):
        return False
    if bsdf.class_name() != "SmoothDiffuse":
        return True
    values = mi.traverse(bsdf)
    return any(np.any(np.asarray(values[key]) > 0) for key in values.keys() if key.startswith("reflectance."))
