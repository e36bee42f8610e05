"""The HRRT model: no diaphragm, only the border of the lens limits the light (the paper's reference 16)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...runtime.errors import OpticsError
from ..discs import Disc
from . import LensModel

if TYPE_CHECKING:
    from ..focused_lens import FocusedLens


@dataclass(frozen=True)
class Hrrt(LensModel):
    """Lines of sight pass the border of the lens, D = `lens_diameter`."""

    def check(self, lens: FocusedLens) -> None:
        self.refuse_pupil_magnification(lens, "has no diaphragm, so no pupil to magnify")
        if lens.lens_diameter is None:
            raise OpticsError("model 'hrrt' needs 'lens_diameter', the border that stops its light. Give mm, say 20.")

    def discs(self, lens: FocusedLens) -> tuple[Disc, ...]:
        """The border of the lens, which `check` requires."""
        return (Disc(0.0, (lens.lens_diameter or 0.0) / 2),)
