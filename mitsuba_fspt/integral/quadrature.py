"""Accuracy parameters of the integration of Eq. 9."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..runtime.errors import SceneError
from ..runtime.numbers import number, whole
from .estimator import Estimator
from .shortcuts import SHORTCUTS

DOMAINS, PIXELS = ("pupil", "surface"), ("area", "centre")
# Smallest error that is stated, over the tolerance and over the brightest pixel: two rules that agree may have the same
# error, and lines of sight are rounded to float32.
LEAST_STATED, FLOAT32_FLOOR = 0.05, 2e-7
# Lines of sight of a pixel at the most, from this rtol on; below it more: on a pixel with an edge the error of lattices
# falls with their number to the power 3/4. No more than the limit in any case.
MOST_NODES, WORTH_MORE, LINES_ORDER, LIMIT = 1 << 16, 1e-3, 4 / 3, 1 << 22
# Lines of sight that all pixels together may take in any case unless `max_nodes` is given: few pixels cost little. By
# the surface form and by faces one takes up to four times as long as by lattices.
TOGETHER, TOGETHER_BY_SURFACE = 1 << 26, 1 << 24
LEAST_WEIGHT = 0.1  # of rtol: smallest share that is followed through or off specular surfaces; less counts as error
MOST_SPECULAR = 64  # specular surfaces one after the other


@dataclass(frozen=True)
class Quadrature:
    """All accuracy parameters of the deterministic integral, each with the error it bounds.

    rtol : absolute error of every pixel, relative to the brightest pixel; 2e-7 <= rtol < 1 (default 1e-3)
    domain : 'pupil' (lines of sight from the pixel) or 'surface' (power spread from surface elements)
    pixel : 'area' integrates over the pixel, 'centre' takes its centre times its area as the paper does
    max_nodes : largest number of lines of sight of a pixel, four in any case (domain 'surface': on average, 256 …
        65,536 in any case); bounds the time; where it is reached, `error` may exceed rtol. None, the default: 65,536,
        below rtol 1e-3 more, with the power 4/3 of 1/rtol to 2²² at the most; lattices on few pixels also take more,
        as long as all of them take at most 2²⁶ together
    max_specular : largest number of specular surfaces on a line of sight, 0 … 64 (default 8); light beyond is in the
        error
    shortcuts_off : names of `SHORTCUTS` that are not taken; shortcuts change the image by less than rtol
    estimator : thresholds of the pupil form's error estimates
    """

    rtol: float = 1e-3
    domain: str = "pupil"
    pixel: str = "area"
    max_nodes: int | None = None
    max_specular: int = 8
    shortcuts_off: frozenset[str] = frozenset()
    estimator: Estimator = field(default_factory=Estimator)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rtol", number("'rtol'", self.rtol, SceneError, "1e-3"))
        if self.max_nodes is not None:
            object.__setattr__(self, "max_nodes", whole("'max_nodes'", self.max_nodes, SceneError, "65536"))
        if not (math.isfinite(self.rtol) and 0 < self.rtol < 1):
            raise SceneError(f"'rtol' must be in (0, 1), got {self.rtol:g}. Give for example 1e-3.")
        if self.rtol < FLOAT32_FLOOR:
            raise SceneError(
                f"'rtol' = {self.rtol:g} is below {FLOAT32_FLOOR:g}, the rounding of single precision. "
                f"Give {FLOAT32_FLOOR:g} or more."
            )
        if self.domain not in DOMAINS:
            raise SceneError(f"'domain' must be one of {', '.join(DOMAINS)}, got '{self.domain}'.")
        if self.pixel not in PIXELS:
            raise SceneError(f"'pixel' must be one of {', '.join(PIXELS)}, got '{self.pixel}'.")
        if self.max_nodes is not None and self.max_nodes < 1:
            raise SceneError(f"'max_nodes' must be >= 1, got {self.max_nodes}. Give for example 65536.")
        specular = whole("'max_specular'", self.max_specular, SceneError, "8")
        object.__setattr__(self, "max_specular", specular)
        if not 0 <= specular <= MOST_SPECULAR:
            raise SceneError(f"'max_specular' must be in 0 … {MOST_SPECULAR}, got {specular}. Give for example 8.")
        if unknown := set(self.shortcuts_off) - set(SHORTCUTS):
            raise SceneError(f"'shortcuts_off' must be some of {', '.join(SHORTCUTS)}, got {min(unknown)!r}.")

    def metadata(self) -> dict[str, str | float]:
        """The parameters as an image's metadata have them."""
        given = {name: value for name, value in vars(self).items() if name not in ("estimator", "shortcuts_off")}
        given["max_nodes"] = self.most_nodes
        return given | {"shortcuts_off": ", ".join(sorted(self.shortcuts_off)) or "nothing"}

    @property
    def least_error(self) -> float:
        """Smallest error that is stated, over the brightest pixel."""
        return max(FLOAT32_FLOOR, LEAST_STATED * self.rtol)

    @property
    def most_nodes(self) -> int:
        """Largest number of lines of sight of a pixel: `max_nodes`, or what `rtol` is worth."""
        if self.max_nodes is not None:
            return self.max_nodes
        return int(min(MOST_NODES * max(WORTH_MORE / self.rtol, 1) ** LINES_ORDER, LIMIT))

    @property
    def least_weight(self) -> float:
        """Smallest share of a line's radiance that is followed through or off specular surfaces."""
        return LEAST_WEIGHT * self.rtol

    def takes(self, shortcut: str) -> bool:
        """True unless this one of `SHORTCUTS` is switched off."""
        return shortcut not in self.shortcuts_off
