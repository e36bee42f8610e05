"""Points all over the surfaces as a camera sees them: along straight lines, and in mirrors.

Flat mirrors and panes show them as the camera's mirror images see them along straight lines, on all courses of Eq. M.19
without refraction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...camera.window import Window, window_of
from ..lines.eq9 import View
from ..lines.mirror import corners_of, images_in
from ..lines.visible_window import glowing_boxes
from .narrow import NarrowLight, Points, narrow_light, points_on_surfaces


@dataclass(frozen=True)
class SeenPoints:
    """Points all over the surfaces of a view's scene, as its camera sees them along `straight` lines and `in_mirrors`.

    The latter include points that other bodies hide. anywhere : points that curved mirrors, glass or many mirrors may
    show in other places, as if nothing stood before them; None without such shapes.
    """

    view: View
    straight: Points | None
    in_mirrors: tuple[Points, ...]
    anywhere: Points | None

    @classmethod
    def of(cls, view: View) -> SeenPoints:
        """Those of a view."""
        scene, camera, specular = view.scene, view.camera, view.specular
        straight = points_on_surfaces(scene, camera, specular)
        if specular is None or straight is None:
            return cls(view, straight, (), None)
        mirrors, boxes = [mirror for planes in specular.mirrors for mirror in planes], glowing_boxes(scene)
        images = images_in(mirrors, camera, corners_of(boxes), specular.most)
        shown = (image for image in images or () if math.prod(window_of(boxes, image).shape))
        seen = (points_on_surfaces(scene, image, hidden=False) for image in shown)
        anywhere = None
        if images is None or not all(specular.mirrors):
            anywhere = points_on_surfaces(scene, camera, hidden=False)
        return cls(view, straight, tuple(points for points in seen if points), anywhere)

    @classmethod
    def none(cls, view: View) -> SeenPoints:
        """No points, where narrow light is not searched for."""
        return cls(view, None, (), None)

    def narrow_light(self, window: Window) -> tuple[NarrowLight, NarrowLight]:
        """Light of narrow spots on the pixels of a window: along straight lines, and in mirrors.

        The latter has neither `in_focus` nor `brightest`.
        """
        straight, mirrored = narrow_light(self.straight, window), NarrowLight.none(window.shape)
        for points in self.in_mirrors:
            mirrored = mirrored.plus(narrow_light(points, window))
        if self.anywhere and self.view.specular:
            there = window.seen_in(self.view.specular.bending, self.view.camera)
            mirrored = mirrored.anywhere_on(there, narrow_light(self.anywhere, window))
        return straight, mirrored
