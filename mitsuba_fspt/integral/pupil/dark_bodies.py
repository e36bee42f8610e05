"""Narrow shade of bodies without light, and light through narrow openings in them (Eq. M.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from ...camera.camera import Camera
from ...camera.window import Window
from ..lines.eq9 import View
from .narrow import OUTSHINES, UNCERTAINTY
from .openings import Openings, openings
from .shade import narrow_bodies, shade

PixelArray = NDArray[np.float64]


@dataclass(frozen=True)
class DarkBodies:
    """What dark bodies hide on the pixels of a window (h, w), and what passes between them.

    shade : share of the lines of sight of each pixel that narrow parts of them block, to a factor of two
    light : of these parts themselves on each pixel [W/mm²/sr], as they may glow less than what is behind
    openings : change of the radiance across their borders, as of `openings.openings`
    """

    shade: PixelArray
    light: PixelArray
    openings: Openings = ()

    @classmethod
    def none(cls, shape: tuple[int, int]) -> DarkBodies:
        """Of a scene without such bodies."""
        return cls(np.zeros(shape), np.zeros(shape))

    @classmethod
    def seen(cls, view: View, window: Window, pose: Camera | None = None) -> DarkBodies:
        """Those of a view's scene, as its camera sees them along straight lines, or straight on from another pose."""
        return cls(*shade(narrow_bodies(view, window, pose), window), openings(view, window, pose))

    def taken(self, light: PixelArray) -> PixelArray:
        """Largest light that narrow parts take from each pixel, less their own, of an image `light` [W/mm²/sr]."""
        behind = maximum_filter(light, 3, mode="nearest")
        return np.minimum(UNCERTAINTY * np.maximum(self.shade * behind - self.light, 0), behind)

    def let_through(self, light: PixelArray) -> PixelArray:
        """Largest light through openings too narrow for nodes on each pixel, of an image `light` that lacks it
        [W/mm²/sr].

        Beside a wide opening a pixel has half of the light that passes, at least.
        """
        found = np.zeros(light.shape)
        for reach, change in self.openings:
            side = 2 * reach + 1
            wide = change <= OUTSHINES * maximum_filter(light, side, mode="nearest")
            found = np.maximum(found, maximum_filter(np.where(wide, 0, change), side, mode="nearest"))
        return found

    def plus(self, others: DarkBodies, share: PixelArray) -> DarkBodies:
        """With others that this share (h, w) of the light of each pixel passes; changes of the radiance contain it."""
        hides, light = self.shade + share * others.shade, self.light + share * others.light
        return DarkBodies(hides, light, (*self.openings, *others.openings))
