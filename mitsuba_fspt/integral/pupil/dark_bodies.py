"""Narrow shade of bodies without light, and light through narrow openings in them (Eq. M.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...camera.window import Window
from ..lines.eq9 import View
from .openings import Openings, openings
from .shade import narrow_bodies, shade

PixelArray = NDArray[np.float64]


@dataclass(frozen=True)
class DarkBodies:
    """What bodies without light hide on the pixels of a window (h, w), and what passes between them.

    shade : share of the lines of sight of each pixel that narrow parts of them block, to a factor of two
    openings : change of the radiance across their borders, as of `openings.openings`
    """

    shade: PixelArray
    openings: Openings = ()

    @classmethod
    def none(cls, shape: tuple[int, int]) -> DarkBodies:
        """Of a scene without such bodies."""
        return cls(np.zeros(shape))

    @classmethod
    def seen(cls, view: View, window: Window) -> DarkBodies:
        """Those of a view's scene, as its camera sees them along straight lines."""
        return cls(shade(narrow_bodies(view), window), openings(view, window))
