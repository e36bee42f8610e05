"""The emitting surfaces of a scene's emitters: the only place that asks an `fspt_surface` for its own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..runtime.plugin_types import is_surface
from .emitting_surface import EmittingSurface


def surface_of(emitter: mi.Emitter | None) -> EmittingSurface | None:
    """The emitting surface of an `fspt_surface`; None for no emitter or one of another kind."""
    return emitter.surface if is_surface(emitter) else None


def surfaces_of(scene: mi.Scene) -> list[EmittingSurface]:
    """The emitting surfaces of a scene, in the order of its emitters, among which there may be others."""
    return [surface for emitter in scene.emitters() if (surface := surface_of(emitter)) is not None]


def mark_of(emitter: mi.Emitter | None) -> object:
    """Key that identifies an emitter and is stored in place of it."""
    surface = surface_of(emitter)
    return surface.mark if surface else dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0]


def edition_of(emitter: mi.Emitter | None) -> tuple[object, int]:
    """Key of an emitter with its J_n: its mark and the number of changes of J_n."""
    surface = surface_of(emitter)
    return mark_of(emitter), surface.edition if surface else 0


def probe_beside(scene: mi.Scene) -> None:
    """Set up the probes of a scene's meshes for kernels that trace rays in the scene; needed on CUDA only."""
    if mi.variant().startswith("cuda"):
        for surface in surfaces_of(scene):
            surface.trace_beside(scene)
