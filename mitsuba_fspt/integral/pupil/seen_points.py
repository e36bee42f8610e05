"""Points all over the surfaces as a camera sees them: along straight lines, in mirrors, and through plates of glass.

The camera sees them straight on in other poses, one for each course over specular surfaces (Eq. M.19).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...camera.window import Region, Window, corners_of
from ..lines.eq9 import View
from ..lines.pose import Pose, Unlocated
from ..lines.poses import Poses
from ..lines.visible_window import glowing_boxes
from .dark_bodies import DarkBodies
from .fine_variation import fine_variation
from .narrow import NarrowLight, Points, most_narrow_light, narrow_light, points_on_surfaces

LEAST_SHARE = 0.25  # of the light, that courses have in which dark bodies and fine variation are searched for
SEEMING = 1e-4  # of the brightest pixel: less light of points that are hidden may count as an error
MOST_BOXES = 8  # of what glows, one by one; the box around more of them counts in their place

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Unseen:
    """Light and shade on the pixels of a window that lines of sight may miss.

    straight, elsewhere : light of narrow spots along straight lines and by specular surfaces; that elsewhere has
        neither `in_focus` nor `brightest`
    anywhere : that in poses that are not known, at the most on each pixel (h, w) [W/mm²/sr]
    dark : shade and openings of dark bodies
    """

    straight: NarrowLight
    elsewhere: NarrowLight
    anywhere: Array
    dark: DarkBodies


@dataclass(frozen=True)
class SeenPoints:
    """Points all over the surfaces of a view's scene, as its camera sees them along `straight` lines and `elsewhere`.

    elsewhere : as it sees them by specular surfaces, from other poses, each with the courses that lead there; they
        include points that other bodies hide
    unlocated : lines of sight in poses that are not known, which may see narrow spots, and the largest light of spots
        that face the camera [W/mm²/sr]
    """

    view: View
    straight: Points | None
    elsewhere: tuple[tuple[Points, tuple[Pose, ...]], ...] = ()
    unlocated: tuple[tuple[Unlocated, ...], float] = ((), 0.0)

    @classmethod
    def of(cls, view: View) -> SeenPoints:
        """Those of a view."""
        scene, camera, specular = view.scene, view.camera, view.specular
        straight = points_on_surfaces(scene, camera, specular)
        if specular is None or straight is None:
            return cls(view, straight)
        boxes = glowing_boxes(scene)
        if len(boxes) > MOST_BOXES:
            ends = corners_of(boxes)
            boxes = ((*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist()),)
        poses = Poses.of(specular.deviating, camera, corners_of(boxes), specular.most, specular.faintest)
        seen, courses = list[tuple[Points, tuple[Pose, ...]]](), dict[tuple[float, ...], list[Pose]]()
        for pose in poses.found:
            courses.setdefault(pose.where, []).append(pose)
        for same in courses.values():
            if (points := points_on_surfaces(scene, same[0].camera, hidden=False)) is not None:
                seen.append((points[(points.area > 0) & (points.cosine > 0)], tuple(same)))
        most = most_narrow_light(points_on_surfaces(scene, camera, hidden=False)) if poses.unlocated else 0.0
        return cls(view, straight, tuple(seen), (poses.unlocated, most))

    def unseen(self, window: Window) -> Unseen:
        """What lines of sight may miss on the pixels of a window."""
        elsewhere = NarrowLight.none(window.shape)
        for points, courses in self.elsewhere:
            share = _share(courses, window).clip(max=1)
            light = _light if share.max(initial=0.0) >= LEAST_SHARE else narrow_light
            elsewhere = elsewhere.plus(light(points, window).times(share))
        lines, most = self.unlocated
        anywhere = most * _share(lines, window).clip(max=1)
        return Unseen(self._straight_light(window), elsewhere, anywhere, self._dark_bodies(window))

    def _straight_light(self, window: Window) -> NarrowLight:
        """Light along straight lines. Where a single shape seems to have some, points that it hides itself are dark."""
        light = _light(self.straight, window)
        most = max(float(image.max(initial=0.0)) for image in (light.on_pixels, light.variation))
        if len(self.view.scene.shapes()) > 1 or most <= SEEMING * light.brightest:
            return light
        return _light(self._in_sight, window)

    @cached_property
    def _in_sight(self) -> Points | None:
        """`straight` of a single shape, without the points that it hides itself."""
        return points_on_surfaces(self.view.scene, self.view.camera, self.view.specular, itself=True)

    def _dark_bodies(self, window: Window) -> DarkBodies:
        """What bodies without light hide, and what passes between them, along straight lines and elsewhere."""
        if self.straight is None:
            return DarkBodies.none(window.shape)
        found = DarkBodies.seen(self.view, window)
        for _, courses in self.elsewhere:
            share = _share(courses, window).clip(max=1)
            if share.max(initial=0.0) >= LEAST_SHARE:
                found = found.plus(DarkBodies.seen(self.view, window, courses[0].camera), share)
        return found


def _light(points: Points | None, window: Window) -> NarrowLight:
    """Narrow light of points on a window, with fine variation of J_n."""
    return replace(narrow_light(points, window), variation=fine_variation(points, window))


def _share(courses: Sequence[Pose | Unlocated], window: Window) -> Array:
    """Sum of the shares of courses on each pixel of a window, (h, w)."""
    shares: dict[Region, float] = defaultdict(float)
    share = np.zeros(window.shape)
    for course in courses:
        shares[course.region] += course.share
    for region, its in shares.items():
        share += its * window.within(region)
    return share
