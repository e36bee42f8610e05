"""The picture of the pupil form while it is refined, and where in it an edge may hide between lines of sight."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import pixels
from ..quadrature import Quadrature, Solution
from ..shortcuts import Finding
from .window import Window

LANES = 1 << 22  # lines of sight in flight: bounds the memory, not the picture
LEAST_CLAIM = (
    0.05  # rules that agree say little about what all miss: no error is said to be so much below the tolerance
)
FLOAT32_FLOOR = 2e-7  # share of the brightest pixel that float32 rays cannot resolve
# A silhouette can pass between the outermost of a rule's nodes, or of the first four chords, and the rim of the pupil:
# that far in (blur radii). A straight one makes them wrong by at most this share of the light, sharp or blurred, where
# it parts the nodes and where it does not.
GAP = {1: 1.0, 4: 0.6, 12: 0.25, "chords": 0.1}
CUT = {1: (0.5, 0.5), 4: (0.35, 0.35), 12: (0.3, 0.21)}
UNSEEN = {1: (0.5, 0.5), 4: (0.21, 0.2), 12: (0.15, 0.07)}
UNSEEN_BY_CHORDS = 0.0125
SHARP = 0.3  # blur radius [pixels]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.uint32]


class Draft:
    """Of each pixel of the window, shape (h, w): `value`, mean radiance on film [W/mm²/sr], its `error` and `hits`.

    change : by which the last rule moved the value
    nearest : depth of what is nearest [mm], inf where nothing is met
    blur : largest blur radius of what a pixel or a neighbour sees [pixels]; sharp : True where the least one is small
    clipped : a second border of the lens cuts the pupil, whatever is sharp
    stopped, beyond : the border of the image-plane stop cuts the pixel, wherever its light comes from; or leaves it out
    open, known : False where the value is known from elsewhere, and that value
    """

    def __init__(
        self, scene: mi.Scene, lens: mi.Sensor, window: Window, quadrature: Quadrature, known: Solution | None
    ) -> None:
        self.scene, self.lens, self.window, self.quadrature = scene, lens, window, quadrature
        self.area = quadrature.pixel == "area"
        shape = window.shape
        self.value, self.error, self.hits, self.change, self.blur = (np.zeros(shape) for _ in range(5))
        self.sharp = np.zeros(shape, bool)
        self.nearest = np.full(shape, np.inf)
        self.clipped = window.clipped(lens)
        inside, cut = window.stopped(lens)
        self.stopped, self.beyond = cut & self.area, ~(inside | cut)
        self.open, self.known = np.ones(shape, bool), np.zeros(shape)
        if known is not None:
            self.open, self.known = ~window.cut(known.where), window.cut(known.power) / lens.etendue
        self.rays = 0
        self.levels: list[str] = []
        self.findings: list[Finding] = []

    @property
    def tolerance(self) -> float:
        """The error asked for [W/mm²/sr]."""
        return self.quadrature.rtol * float(self.value.max(initial=0.0))

    def solution(self) -> Solution:
        """The picture as it is, on the crop window."""
        floor = max(FLOAT32_FLOOR, LEAST_CLAIM * self.quadrature.rtol)
        error = np.maximum(self.error, floor * self.value.max(initial=0.0))
        error[self.hits == 0] = self.error[self.hits == 0]
        error[self.beyond] = 0
        power, error = (self.window.expand(image) * self.lens.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.hits, 0, 1))
        return Solution(power, error, coverage, self.rays, tuple(self.levels), findings=tuple(self.findings))

    def count(self, what: str, pixels_touched: int, rays: int) -> None:
        """Note a rung of the ladder."""
        self.rays += rays
        self.levels.append(f"{what}: {pixels_touched} pixels")

    # ------------------------------------------------------------------ where an edge may hide

    def set_blur(self, farthest: Image) -> None:
        """From depths: of what is nearest or farthest, for from the sharp plane on blur grows either way."""
        seen = np.isfinite(self.nearest)
        blur, sharp = np.zeros(seen.shape), np.zeros(seen.shape, bool)
        both = self.lens.blur_radius(np.array([self.nearest[seen], farthest[seen]]))
        blur[seen], sharp[seen] = both.max(axis=0), both.min(axis=0) < SHARP
        self.blur = pixels.spread_max(np.minimum(blur, max(seen.shape)))
        self.sharp = pixels.dilate(sharp, 1 + math.ceil(SHARP))

    def reach(self, rule: int | str) -> NDArray[np.int64]:
        """How far from where a rule sees an edge it may hide from it [pixels]."""
        return 1 + np.ceil(GAP[rule] * self.blur).astype(np.int64)

    def grown(self, rough: Mask, nodes: int) -> Mask:
        """`rough` and the surroundings in which what makes it rough may hide; of a silhouette `cut_off` knows."""
        source = rough & (self.error > self.tolerance) & ~pixels.outline(self.hits, 1)
        return rough | pixels.grow(source, self.reach(nodes))

    def cut_off(self, nodes: int) -> Image:
        """What a rule may be wrong by where an edge crosses or hides between its nodes and the pupil's rim.

        A silhouette, a second border of the lens, or the image-plane stop.
        """
        reach = self.reach(nodes)
        cut, unseen = (np.where(self.sharp, *share[nodes]) for share in (CUT, UNSEEN))
        share = np.where(pixels.grow(pixels.outline(self.hits, 1), reach - 1), unseen, 0.0)
        share = np.where(pixels.parted(self.hits) | self.clipped | self.stopped, cut, share)
        return share * self._whole(reach.max())

    def unseen_by_chords(self, split: Mask) -> Image:
        """What four chords may be wrong by near pixels they are `split` on and where they meet no jump themselves."""
        reach = self.reach("chords")
        near = pixels.grow(split, reach) & ~split
        return np.where(near, UNSEEN_BY_CHORDS * self._whole(reach.max()), 0)

    def _whole(self, reach: int) -> Image:
        """Largest value within `reach` pixels, if no line of sight missed."""
        whole = np.divide(self.value, self.hits, out=np.zeros_like(self.value), where=self.hits > pixels.ROUNDING)
        return pixels.spread_max(whole, reach)


def chunks(index: Index, size: int) -> list[Index]:
    """Runs of at most `size` of the listed pixels."""
    return [index[k : k + size] for k in range(0, len(index), size)]
