"""Points all over the surfaces as a camera sees them: along straight lines, and in mirrors.

Flat mirrors and panes show them as the camera's mirror images see them along straight lines, on all courses of Eq. M.19
without refraction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...camera.window import Window, window_of
from ..lines.eq9 import View
from ..lines.mirror import Mirror, MirrorImages, corners_of
from ..lines.visible_window import glowing_boxes
from .narrow import NarrowLight, Points, most_narrow_light, narrow_light, points_on_surfaces

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SeenPoints:
    """Points all over the surfaces of a view's scene, as its camera sees them along `straight` lines and `in_mirrors`.

    The latter, each with the mirror that lines of sight meet first, include points that other bodies hide. anywhere :
    largest light on a pixel of narrow spots that face the camera [W/mm²/sr], where curved mirrors, glass or many
    mirrors may show them in other places, too; else 0.
    """

    view: View
    straight: Points | None
    in_mirrors: tuple[tuple[Points, Mirror], ...] = ()
    anywhere: float = 0.0

    @classmethod
    def of(cls, view: View) -> SeenPoints:
        """Those of a view."""
        scene, camera, specular = view.scene, view.camera, view.specular
        straight = points_on_surfaces(scene, camera, specular)
        if specular is None or straight is None:
            return cls(view, straight)
        mirrors, boxes = [mirror for planes in specular.mirrors for mirror in planes], glowing_boxes(scene)
        found, in_mirrors = MirrorImages.of(mirrors, camera, corners_of(boxes), specular.most), []
        for image, first in found.images:
            if math.prod(window_of(boxes, image).shape) and (points := points_on_surfaces(scene, image, hidden=False)):
                in_mirrors.append((points[(points.area > 0) & (points.cosine > 0)], first))
        anywhere = 0.0
        if not (found.complete and all(specular.mirrors)):
            anywhere = most_narrow_light(points_on_surfaces(scene, camera, hidden=False))
        return cls(view, straight, tuple(in_mirrors), anywhere)

    def narrow_light(self, window: Window) -> tuple[NarrowLight, NarrowLight, Array]:
        """Light of narrow spots on the pixels of a window: along straight lines, in mirrors, and, with places that are
        not known, at the most on each pixel (h, w) [W/mm²/sr].

        That in mirrors has neither `in_focus` nor `brightest`.
        """
        straight, mirrored = narrow_light(self.straight, window), NarrowLight.none(window.shape)
        for points, mirror in self.in_mirrors:
            there = window.seen_in((mirror.box,), self.view.camera)
            mirrored = mirrored.plus(narrow_light(points, window).on(there))
        anywhere = np.zeros(window.shape)
        if self.view.specular and self.anywhere:
            anywhere = self.anywhere * window.seen_in(self.view.specular.bending, self.view.camera)
        return straight, mirrored, anywhere
