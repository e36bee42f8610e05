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
        if lens.pupil_magnification != 1:
            check_pupil_alone(lens)
        elif lens.diaphragm_distance != 0:
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
        """A diaphragm in the lens itself; otherwise its entrance pupil and the border of the lens, if it is given."""
        if lens.pupil_magnification != 1:
            return (entrance_pupil(lens),)
        if lens.diaphragm_distance == 0 or lens.lens_diameter is None:
            return (Disc(0.0, lens.diaphragm_diameter / 2),)
        pupil = _image_of_diaphragm(lens)
        border = Disc(0.0, lens.lens_diameter / 2)
        return (border,) if pupil is None else (pupil, border)


def entrance_pupil(lens: FocusedLens) -> Disc:
    """Entrance pupil of a compound lens, D = F/f_num at the `pupil_depth`, on the lens plane (Eqs. M.39, M.12)."""
    if lens.pupil_depth == 0:
        return Disc(0.0, lens.diaphragm_diameter / 2)
    return _on_lens_plane(lens.pupil_depth, lens.diaphragm_diameter / 2, lens.focus_distance)


def check_pupil_alone(lens: FocusedLens) -> None:
    """Raise OpticsError for a number that contradicts `pupil_magnification` ≠ 1, which alone places the pupil."""
    for name, absent in (("diaphragm_distance", 0.0), ("lens_diameter", None)):
        if (value := getattr(lens, name)) != absent:
            raise OpticsError(
                f"'pupil_magnification' = {lens.pupil_magnification:g} and '{name}' = {value:g} mm exclude each other: "
                "the first places the entrance pupil, the only border of such a lens. Give one."
            )


def _on_lens_plane(depth: float, radius: float, focus_distance: float) -> Disc:
    """Disc of the lens plane through which virtual points see a circle of this radius [mm] at `depth` (Eq. M.12).

    From the virtual point (x, u) it projects onto the disc of radius R_p u/|u - z_p| about -x z_p/(u - z_p).
    """
    return Disc(-depth / (focus_distance - depth), abs(radius * focus_distance / (focus_distance - depth)))


def _image_of_diaphragm(lens: FocusedLens) -> Disc | None:
    """Entrance pupil, projected from the virtual point onto the lens plane (Eqs. M.11, M.12); None on the detector.

    The image of a diaphragm at the distance s behind the lens, seen from the object side, is at s F/(s - F) and
    magnified by F/(F - s); a diaphragm in front of the lens is its own image.
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
    return _on_lens_plane(depth, pupil_radius, u)
