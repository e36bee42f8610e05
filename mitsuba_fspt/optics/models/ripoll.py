"""Ripoll's detector: every point of it accepts a cone of directions about its normal (the paper's reference 14)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...runtime.errors import OpticsError
from ..discs import Disc
from . import LensModel

if TYPE_CHECKING:
    from ..focused_lens import FocusedLens


@dataclass(frozen=True)
class Ripoll(LensModel):
    """Lines of sight within a cone about the normal of the virtual detector plane.

    numerical_aperture : sine of the cone's half angle, in (0, 1)
    """

    numerical_aperture: float | None = None
    EXAMPLES: ClassVar[dict[str, str]] = {"numerical_aperture": "0.5"}

    def check(self, lens: FocusedLens) -> None:
        self.refuse_pupil_magnification(lens, "accepts directions, not a pupil")
        if self.numerical_aperture is None or not 0 < self.numerical_aperture < 1:
            raise OpticsError(
                f"model 'ripoll' needs 'numerical_aperture' in (0, 1), got {self.numerical_aperture}. "
                "Give for example 0.5."
            )

    def discs(self, lens: FocusedLens) -> tuple[Disc, ...]:
        """The disc in which the cone meets the lens plane; its centre is opposite the virtual point (κ = 1)."""
        return (Disc(1.0, lens.focus_distance * math.tan(math.asin(self.numerical_aperture or 0.0))),)
