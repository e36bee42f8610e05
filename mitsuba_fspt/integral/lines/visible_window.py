"""The effective virtual space (Eq. 4) of a scene: the pixels whose lines of sight can meet an emitting surface."""

from __future__ import annotations

import mitsuba as mi

from ...camera.camera import Camera
from ...camera.window import Boxes, Window, window_of
from ...emission.of_emitter import surfaces_of
from ...jit.mesh_buffers import box_of
from .specular import Specular


def visible_window(scene: mi.Scene, camera: Camera, everywhere: bool = False) -> Window:
    """Window of the pixels with a line of sight into the bounding box of emitting surfaces; all if the lens is in it.

    `everywhere`: all pixels. Emitters other than `fspt_surface` count with the bounding box of the scene; mirrors and
    glass, in which light is seen, count, too.
    """
    specular = Specular.of(scene, camera)
    return window_of(glowing_boxes(scene), camera, everywhere, specular.bending if specular else ())


def glowing_boxes(scene: mi.Scene) -> Boxes:
    """Bounding boxes of emitting surfaces, each as (x, y, z) of its lowest and of its highest corner [mm]."""
    emitters = scene.emitters()
    direct = len(surfaces_of(scene)) == len(emitters)
    boxes = [emitter.bbox() for emitter in emitters] if direct else [box_of(scene.shapes())]
    return tuple((*map(float, box.min), *map(float, box.max)) for box in boxes)
