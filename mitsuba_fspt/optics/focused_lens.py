"""Numbers of a thin lens in focus: lens law (M.1), diaphragm (Eq. 3) and borders, checked, whatever the lens model.

Camera frame: lens plane z = 0, optical axis +z towards the object. Lengths in mm, all distances positive magnitudes
from the lens plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..runtime.errors import OpticsError
from ..runtime.numbers import number

LARGEST = 1e30  # largest number of a lens, and largest inverse of one: squares stay finite
LEAST_F_NUMBER = 1e-3  # of the model: no lens in air is below 0.5; far below 1e-3, stated errors are too small
FOCUS = ("focus_distance", "magnification", "image_distance")  # exactly one of them is given
BORDERS = ("lens_diameter", "diaphragm_distance", "image_stop_diameter")
OPTIONAL = (*BORDERS, "pupil_magnification")
NUMBERS = ("focal_length", "f_number", *FOCUS, *OPTIONAL)  # of `Lens.focused`, whatever the model
EXAMPLES = dict(zip(NUMBERS, ("55", "8", "165", "0.5", "82.5", "20", "5", "20", "0.9"), strict=True))


@dataclass(frozen=True)
class FocusedLens:
    """Numbers of a lens that every model has, as `Lens` describes them; `Lens` adds the model.

    Raises
    ------
    OpticsError : the lens cannot exist or forms no real image; the message names the parameter.
    """

    focal_length: float
    f_number: float
    focus_distance: float
    lens_diameter: float | None = None
    diaphragm_distance: float = 0.0
    image_stop_diameter: float | None = None
    pupil_magnification: float = 1.0

    def __post_init__(self) -> None:
        for name in ("focal_length", "f_number", "focus_distance", *OPTIONAL):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, number(f"'{name}'", value, OpticsError, EXAMPLES[name]))
        require_positive("focal_length", self.focal_length, "mm, for example 55")
        require_positive("f_number", self.f_number, "f_number = F/D, for example 8")
        if self.f_number < LEAST_F_NUMBER:
            raise OpticsError(
                f"'f_number' must be at least {LEAST_F_NUMBER:g}, got {self.f_number:g}: the diaphragm would be "
                f"{self.diaphragm_diameter:g} mm wide. f_number = F/D, for example 8."
            )
        require_positive("focus_distance", self.focus_distance, "mm, for example 165")
        if self.focus_distance <= self.focal_length:
            raise OpticsError(
                f"'focus_distance' must be > focal_length = {self.focal_length:g} mm for a real image, "
                f"got {self.focus_distance:g}. Move the camera back or use a shorter lens."
            )
        if not math.isfinite(self.diaphragm_distance):
            raise OpticsError(
                f"'diaphragm_distance' must be finite, got {self.diaphragm_distance:g} mm. Give mm, for example 5."
            )
        if self.image_stop_diameter is not None:
            require_positive("image_stop_diameter", self.image_stop_diameter, "mm on the detector, for example 20")
        if self.lens_diameter is not None:
            require_positive("lens_diameter", self.lens_diameter, "mm, for example 20")
        require_positive("pupil_magnification", self.pupil_magnification, "exit over entrance pupil, for example 0.9")

    @property
    def image_distance(self) -> float:
        """v [mm] from the lens law 1/F = 1/u + 1/v."""
        return self.focal_length * self.focus_distance / (self.focus_distance - self.focal_length)

    @property
    def magnification(self) -> float:
        """t = v/u."""
        return self.focal_length / (self.focus_distance - self.focal_length)

    @property
    def diaphragm_diameter(self) -> float:
        """D = F/f_num [mm] (Eq. 3)."""
        return self.focal_length / self.f_number

    @property
    def pupil_depth(self) -> float:
        """z_p = F (1 − 1/P) [mm], depth of the entrance pupil before the lens plane; < 0 behind it (Eq. M.39)."""
        return self.focal_length * (1 - 1 / self.pupil_magnification)

    @property
    def pupil_distance(self) -> float:
        """ℓ = u − z_p [mm], from the entrance pupil to the virtual detector plane."""
        return self.focus_distance - self.pupil_depth

    @property
    def working_f_number(self) -> float:
        """f_num (1 + t/P): half the image distance from the exit pupil over that pupil's radius (Eq. M.40)."""
        return self.f_number * (1 + self.magnification / self.pupil_magnification)

    @property
    def seen_field(self) -> float:
        """Distance from the axis [mm] up to which virtual points lie inside the image-plane stop; inf without one."""
        return math.inf if self.image_stop_diameter is None else self.image_stop_diameter / 2 / self.magnification


def require_positive(name: str, value: float, example: str) -> float:
    """`value` as a float; OpticsError if it is no number, not positive, or beyond `LARGEST`."""
    value = number(f"'{name}'", value, OpticsError, EXAMPLES[name])
    if not (math.isfinite(value) and value > 0):
        raise OpticsError(f"'{name}' must be > 0 and finite, got {value:g}. Give {example}.")
    if not 1 / LARGEST <= value <= LARGEST:
        raise OpticsError(f"'{name}' must be in 1/{LARGEST:g} … {LARGEST:g}, got {value:g}. Give {example}.")
    return value
