"""The paper's model: a diaphragm D = F/f_num in the lens, behind it or in front of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...runtime.errors import OpticsError
from ..discs import Disc
from . import LensModel

if TYPE_CHECKING:
    from ..focused_lens import FocusedLens

ROUNDING = 1e-6  # share by which D = F/f_num of float32 numbers may exceed a lens border of the same size


@dataclass(frozen=True)
class Diaphragm(LensModel):
    """Lines of sight pass the diaphragm, and also the border of the lens if the diaphragm is apart from it (Fig. 2)."""

    def check(self, lens: FocusedLens) -> None:
        if lens.diaphragm_distance != 0:
            self._check_distance(lens)
        elif lens.lens_diameter is not None and lens.lens_diameter < lens.diaphragm_diameter * (1 - ROUNDING):
            raise OpticsError(
                f"'lens_diameter' = {lens.lens_diameter:g} mm is smaller than the diaphragm "
                f"D = focal_length/f_number = {lens.diaphragm_diameter:g} mm. Give a larger lens or "
                f"f_number >= {lens.focal_length / lens.lens_diameter:.4g}."
            )

    def _check_distance(self, lens: FocusedLens) -> None:
        distance = lens.diaphragm_distance
        if lens.lens_diameter is None:
            raise OpticsError(
                f"'diaphragm_distance' = {distance:g} mm needs 'lens_diameter', the "
                "second border a line of sight has to pass. Give mm, for example 20."
            )
        if distance >= lens.image_distance:
            raise OpticsError(
                f"'diaphragm_distance' = {distance:g} mm must be smaller than the image "
                f"distance {lens.image_distance:g} mm: the diaphragm stands between lens and detector. Give less."
            )
        if -distance >= lens.focus_distance:
            raise OpticsError(
                f"'diaphragm_distance' = {distance:g} mm must be above -focus_distance = "
                f"{-lens.focus_distance:g} mm: the diaphragm stands between lens and virtual detector plane. Give "
                "more."
            )

    def discs(self, lens: FocusedLens) -> tuple[Disc, ...]:
        """A diaphragm in the lens itself; otherwise its entrance pupil and the border of the lens."""
        if lens.diaphragm_distance == 0 or lens.lens_diameter is None:
            return (Disc(0.0, lens.diaphragm_diameter / 2),)
        pupil = _entrance_pupil(lens)
        border = Disc(0.0, lens.lens_diameter / 2)
        return (border,) if pupil is None else (pupil, border)


def _entrance_pupil(lens: FocusedLens) -> Disc | None:
    """Entrance pupil, projected from the virtual point onto the lens plane (Eqs. M.11, M.12); None on the detector.

    The image of a diaphragm at the distance s behind the lens, seen from the object side, is at s F/(s - F) and
    magnified by F/(F - s); a diaphragm in front of the lens is its own image. From the virtual point (x, u) a circle of
    radius R_p at depth z_p projects onto the disc of the lens plane with radius R_p u/(u - z_p) about -x z_p/(u - z_p).
    """
    s, focal, u, radius = lens.diaphragm_distance, lens.focal_length, lens.focus_distance, lens.diaphragm_diameter / 2
    if s < 0:
        depth, pupil_radius = -s, radius
    elif s == focal:
        # The image is at infinity: the diaphragm passes directions with |slope| <= radius / F, a cone about the axis.
        return Disc(1.0, u * radius / focal)
    else:
        depth, pupil_radius = s * focal / (s - focal), abs(radius * focal / (focal - s))
    if depth == u:
        return None  # the diaphragm lies on the detector: a field stop, not a pupil
    return Disc(-depth / (u - depth), abs(pupil_radius * u / (u - depth)))
