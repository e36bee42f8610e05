"""The pinhole model: one line of sight through the middle of the lens (the paper's reference 15)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..discs import Disc
from . import LensModel
from .diaphragm import check_pupil_alone, entrance_pupil

if TYPE_CHECKING:
    from ..focused_lens import FocusedLens


@dataclass(frozen=True)
class Pinhole(LensModel):
    """Every line of sight passes the middle of the pupil; the étendue is that of the diaphragm D = F/f_num."""

    def check(self, lens: FocusedLens) -> None:
        if lens.pupil_magnification != 1:
            check_pupil_alone(lens)

    def discs(self, lens: FocusedLens) -> tuple[Disc, ...]:
        return (entrance_pupil(lens),)

    def pupil_radius(self, lens: FocusedLens) -> float:
        """0, since all lines of sight pass the same lens point."""
        return 0.0
