"""Warnings of light that a method leaves out of a scene's image (Eq. 9) or treats differently, one line each."""

from __future__ import annotations

import mitsuba as mi

from ...camera.camera import Camera
from .left_out import scatters
from .mesh_faults import mesh_faults
from .nested_bsdfs import BENDS, blended_parts

VOLUMETRIC = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator"}


def scene_warnings(scene: mi.Scene, camera: Camera, integrator: mi.Integrator) -> list[str]:
    """Warnings about an image of a scene by this integrator."""
    found = [None if treats_media(integrator) else _media(scene, camera), _blends(scene), diffraction(camera)]
    if integrator.class_name() == "PathIntegrator":
        found.append(_glowing_windows(scene))
    return [text for text in found if text] + mesh_faults(scene, camera)


def treats_media(integrator: mi.Integrator) -> bool:
    """True for an integrator that follows light through participating media."""
    return bool({integrator.class_name(), type(integrator).__name__} & VOLUMETRIC)


def diffraction(camera: Camera) -> str | None:
    """Diffraction at the diaphragm (Eq. M.32), which no method contains, if it spreads a point over a pixel or more."""
    pixels = camera.airy_radius / camera.pixel_pitch
    if pixels < 1:
        return None
    return (
        f"diffraction is left out: at f/{camera.lens.f_number:g} the Airy disc has a radius of {pixels:.3g} pixels "
        f"({camera.airy_radius:.3g} mm on the film at {camera.airy_wavelength_nm:g} nm), over which a real camera "
        "spreads each point"
    )


def _media(scene: mi.Scene, camera: Camera) -> str | None:
    """Participating media, which every method but `volpath` treats as vacuum."""
    media = [shape.id() for shape in scene.shapes() if shape.interior_medium() or shape.exterior_medium()]
    if camera.in_medium:
        media.append(camera.in_medium)
    if not media:
        return None
    return (
        f"{', '.join(media)} borders on a participating medium: this method neither absorbs nor scatters light in it. "
        "Give the scene the integrator volpath, and no method, to see what it does"
    )


def _blends(scene: mi.Scene) -> str | None:
    """Blends of specular and scattering parts: Mitsuba's samples lose some of the specular light."""
    mixed = [shape.id() for shape in scene.shapes() if _mixed(shape.bsdf())]
    if not mixed:
        return None
    return (
        f"{', '.join(mixed)} blends a specular and a scattering part: Mitsuba's Monte Carlo loses some of the specular "
        "light, the integral does not, and what is stated of light left out may be too small by as much"
    )


def _mixed(bsdf: mi.BSDF) -> bool:
    """True for a blend with a part that mirrors or refracts and a part that scatters."""
    return bool(bsdf.flags() & BENDS) and blended_parts(bsdf) > 0 and scatters(bsdf)


def _glowing_windows(scene: mi.Scene) -> str | None:
    """Glowing surfaces that let light pass, which Mitsuba's `path` dims by the share that passes."""
    shapes = [e.get_shape() for e in scene.emitters() if mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
    clear = [shape.id() for shape in shapes if mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)]
    if not clear:
        return None
    return (
        f"{', '.join(clear)} glows and lets light pass: Mitsuba's path dims what it emits by that share; J_n is what "
        "leaves the surface, whatever passes it, as the integral and volpath count it"
    )
