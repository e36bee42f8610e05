"""Points all over the surfaces as a camera sees them: along straight lines, in mirrors, and through a plate of glass.

Flat mirrors and panes show them as the camera's mirror images see them along straight lines, on all courses of Eq. M.19
without refraction; a plate of glass as the camera does at another place (Eq. M.56).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window, window_of
from ..lines.eq9 import View
from ..lines.mirror import Box, Mirror, MirrorImages, corners_of
from ..lines.visible_window import glowing_boxes
from .narrow import NarrowLight, Points, most_narrow_light, narrow_light, points_on_surfaces

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SeenPoints:
    """Points all over the surfaces of a view's scene, as its camera sees them along `straight` lines and `elsewhere`.

    The latter, each with the plane that lines of sight meet first, in mirrors and through a plate of glass; they
    include points that other bodies hide. anywhere : where curved mirrors, glass or many mirrors may show narrow spots
    in other places, too: boxes of what shows them, and the largest light of spots that face the camera [W/mm²/sr]
    """

    view: View
    straight: Points | None
    elsewhere: tuple[tuple[Points, Mirror], ...] = ()
    anywhere: tuple[tuple[tuple[Box, ...], float], ...] = ()

    @classmethod
    def of(cls, view: View) -> SeenPoints:
        """Those of a view."""
        scene, camera, specular = view.scene, view.camera, view.specular
        straight = points_on_surfaces(scene, camera, specular)
        if specular is None or straight is None:
            return cls(view, straight)
        boxes = glowing_boxes(scene)
        most = partial(_most_narrow_light, scene, camera)
        if specular.plate and (images := specular.plate.images(camera, boxes)):
            first, left = specular.plate.towards, specular.plate.reflected_more(camera, boxes)
            seen, bound = cls._from(scene, [(image, first) for image in images], boxes), most()
            anywhere = ((specular.bending, left * bound), (specular.plate.rim_boxes, bound))
            return cls(view, straight, seen, anywhere)
        mirrors = [mirror for planes in specular.mirrors for mirror in planes]
        found = MirrorImages.of(mirrors, camera, corners_of(boxes), specular.most)
        complete = found.complete and all(specular.mirrors)
        seen = cls._from(scene, found.images, boxes)
        return cls(view, straight, seen, () if complete else ((specular.bending, most()),))

    @staticmethod
    def _from(
        scene: mi.Scene, images: Sequence[tuple[Camera, Mirror]], boxes: Sequence[Box]
    ) -> tuple[tuple[Points, Mirror], ...]:
        """The points as a camera sees them from other places, each of which comes with the plane that shows them."""
        found = []
        for image, first in images:
            if math.prod(window_of(boxes, image).shape) and (points := points_on_surfaces(scene, image, hidden=False)):
                found.append((points[(points.area > 0) & (points.cosine > 0)], first))
        return tuple(found)

    def narrow_light(self, window: Window) -> tuple[NarrowLight, NarrowLight, Array]:
        """Light of narrow spots on the pixels of a window: along straight lines, elsewhere, and, with places that are
        not known, at the most on each pixel (h, w) [W/mm²/sr].

        That elsewhere has neither `in_focus` nor `brightest`.
        """
        camera = self.view.camera
        straight, elsewhere = narrow_light(self.straight, window), NarrowLight.none(window.shape)
        for points, plane in self.elsewhere:
            there = window.seen_in((plane.box,), camera)
            elsewhere = elsewhere.plus(narrow_light(points, window).on(there))
        anywhere = np.zeros(window.shape)
        for boxes, most in self.anywhere:
            if boxes and most:
                anywhere = np.maximum(anywhere, most * window.seen_in(boxes, camera))
        return straight, elsewhere, anywhere


def _most_narrow_light(scene: mi.Scene, camera: Camera) -> float:
    """Largest light on a pixel of narrow spots that face a camera, whatever hides them [W/mm²/sr]."""
    return most_narrow_light(points_on_surfaces(scene, camera, hidden=False))
