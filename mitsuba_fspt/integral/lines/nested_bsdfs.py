"""BSDFs inside a mask, a blend or a bump map, and whether lines of sight can follow their lobes (Eq. M.19).

Mitsuba samples the parts of a `blendbsdf` one at a time by the number of their component. A `mask` passes that number
on to no BSDF inside it.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from ...runtime.errors import SceneError

BENDS = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
TURNS = ("BumpMap", "NormalMap")  # each turns the normal, so that lobes of one kind lead in several directions


def nested(thing: mi.Object) -> Iterator[mi.Object]:
    """A BSDF itself and all BSDFs and textures inside it, outermost first."""
    yield thing
    for child in _children(thing):
        yield from nested(child)


def _children(thing: mi.Object) -> list[mi.Object]:
    """BSDFs and textures that an object refers to itself."""
    found: list[mi.Object] = []

    class Children(mi.TraversalCallback):
        def put(self, name: str, value: object, flags: object, cpptype: object = None) -> None:
            if isinstance(value, (mi.BSDF, mi.Texture)):
                found.append(value)

    thing.traverse(Children())
    return found


def blended_parts(bsdf: mi.BSDF) -> int:
    """Number of components of a blend, whose lobes are those of its parts; 0 for a BSDF that is no blend."""
    blend = any(part.class_name() == "BlendBSDF" for part in nested(bsdf))
    return bsdf.component_count() if blend else 0


def check_followed(scene: mi.Scene) -> None:
    """Raise SceneError for a shape with specular lobes in a blend that lines of sight cannot tell apart."""
    for shape in scene.shapes():
        if fault := _fault(shape.bsdf()):
            raise SceneError(
                f"fspt_integral: the BSDF of shape '{shape.id()}' is {fault}, whose specular parts lines of sight "
                "cannot tell apart. Take it apart, or render with method path and a max_depth (--method path "
                "--max-depth 9)."
            )


def _fault(bsdf: mi.BSDF) -> str | None:
    """The reason why lines of sight cannot follow the specular lobes of a BSDF; None without one."""
    if not (bsdf.flags() & BENDS and blended_parts(bsdf)):
        return None
    kinds = {part.class_name() for part in nested(bsdf)}
    if "MaskBSDF" in kinds:
        return "a 'blendbsdf' and a 'mask' in one"
    if kinds & set(TURNS):
        return "a 'blendbsdf' with a bump or normal map"
    through = [k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.DeltaTransmission)]
    return "a 'blendbsdf' of two glasses" if len(through) > 1 else None


def check_textures(scene: mi.Scene) -> None:
    """Raise SceneError for a bump map of a texture without a gradient, at which Mitsuba fails when light meets it."""
    for shape in scene.shapes():
        for part in nested(shape.bsdf()):
            if part.class_name() == "BumpMap":
                _check_bumps(shape, part)


def _check_bumps(shape: mi.Shape, bumps: mi.BSDF) -> None:
    """Raise SceneError if the texture of a bump map has no gradient."""
    for texture in _children(bumps):
        if not isinstance(texture, mi.Texture):
            continue
        try:
            texture.eval_1_grad(dr.zeros(mi.SurfaceInteraction3f))
        except RuntimeError as error:
            raise SceneError(
                f"scene: the bumpmap of shape '{shape.id()}' has a {texture.class_name()}, of which Mitsuba computes "
                "no gradient. Give it a bitmap, or leave it out."
            ) from error
