"""The thin lens: lens law, diaphragm (Eq. 3), and the discs of the lens plane through which light may pass.

Camera frame: lens plane z = 0, optical axis +z towards the object. Lengths in mm, all distances positive magnitudes
from the lens plane. Pure Python floats in double precision; nothing here imports Mitsuba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..runtime.errors import OpticsError
from .discs import Disc
from .distortion import Distortion
from .focused_lens import FOCUS, NUMBERS, OPTIONAL, FocusedLens, require_positive
from .models import LensModel, model_named, model_names
from .models.diaphragm import Diaphragm

MM_PER_NM = 1e-6


@dataclass(frozen=True)
class Lens(FocusedLens):
    """Thin lens with a diaphragm, focused on the virtual detector plane z = u (paper, section 2.C).

    Parameters
    ----------
    focal_length : F [mm], > 0
    f_number : f_num = F/D (Eq. 3), >= 0.001 (`LEAST_F_NUMBER`)
    focus_distance : u [mm], > F, from the lens plane to the virtual detector plane
    lens_diameter : the lens border [mm]; None leaves the diaphragm as the only border
    diaphragm_distance : from the lens plane to the diaphragm [mm]; > 0 behind the lens (detector side), < 0 in front
    image_stop_diameter : circular stop on the detector, centred on the optical axis [mm]; None leaves the film's border
    pupil_magnification : P, diameter of the exit pupil over that of the entrance pupil, > 0; unless it is 1, the lens
        plane is the front principal plane of a compound lens with the entrance pupil F/f_num at F (1 − 1/P) (Eq. M.39)
    model : which lines of sight pass, see `mitsuba_fspt.optics.models`
    distortion : of the image by OpenCV's model, without a diaphragm apart from the lens; None for an undistorted one

    Raises
    ------
    OpticsError : the lens cannot exist or forms no real image; the message names the parameter.
    """

    model: LensModel = field(default_factory=Diaphragm)
    distortion: Distortion | None = None

    @classmethod
    def focused(
        cls,
        focal_length: float,
        f_number: float,
        *,
        focus_distance: float | None = None,
        magnification: float | None = None,
        image_distance: float | None = None,
        model: str = "diaphragm",
        distortion: object = None,
        **numbers: object,
    ) -> Lens:
        """Lens focused by exactly one of u (`focus_distance`), t (`magnification`) or v (`image_distance`).

        Lens law: 1/F = 1/u + 1/v, t = v/u. `model`: its name; `distortion`: as
        `Distortion.of` takes it; `numbers`: borders of the lens and the model's own
        parameters. Raises OpticsError where none or several set the focus, and for a number that belongs to no lens or
        to another model.
        """
        focal_length = require_positive("focal_length", focal_length, "mm, for example 55")
        focus = zip(FOCUS, (focus_distance, magnification, image_distance), strict=True)
        given = {name: value for name, value in focus if value is not None}
        if len(given) != 1:
            raise OpticsError(
                f"exactly one of {', '.join(map(repr, FOCUS))} sets the focus, got "
                f"{' and '.join(map(repr, given)) or 'none'}. Give one, for example magnification = 0.5."
            )
        ((name, value),) = given.items()
        value = require_positive(name, value, "for example magnification = 0.5")
        if name == "magnification":
            focus_distance = focal_length * (1 + 1 / value)
        elif name == "image_distance":
            if value <= focal_length:
                raise OpticsError(
                    f"'image_distance' must be > focal_length = {focal_length:g} mm for a real image, "
                    f"got {value:g}. Give a larger one, or 'magnification'."
                )
            focus_distance = focal_length * value / (value - focal_length)
        else:
            focus_distance = value
        bent = distortion if distortion is None or isinstance(distortion, Distortion) else Distortion.of(distortion)
        optional = {name: value for name, value in numbers.items() if name in OPTIONAL}
        rest = {name: value for name, value in numbers.items() if name not in OPTIONAL and value is not None}
        return cls(focal_length, f_number, focus_distance, **optional, model=_model(model, rest), distortion=bent)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.model.check(self)
        if self.distortion and self.diaphragm_distance != 0:
            raise OpticsError(
                f"'distortion' and 'diaphragm_distance' = {self.diaphragm_distance:g} mm exclude each other: slopes "
                "count from the entrance pupil. Place that with 'pupil_magnification'."
            )

    @property
    def pupil_radius(self) -> float:
        """Radius [mm] of the disc that contains the lens points of all lines of sight; 0 for a pinhole."""
        return self.model.pupil_radius(self)

    @property
    def discs(self) -> tuple[Disc, ...]:
        """The one or two discs of the lens plane that a line of sight has to pass; their overlap is the open pupil."""
        return self.model.discs(self)

    def airy_radius(self, wavelength_nm: float) -> float:
        """Radius [mm] of the Airy disc on the detector, of light of this wavelength from a point in focus (Eq. M.32).

        1.22 λ N (1 + t/P), with P = 1 where the diaphragm is in the lens: the first dark ring of the diffraction at the
        pupil, which lines of sight leave out. It is that on the axis, of the narrower one of two borders.
        """
        radius = min(disc.radius for disc in self.discs)
        return 0.61 * wavelength_nm * MM_PER_NM * self.image_distance / radius

    def numbers(self) -> dict[str, float | str]:
        """By name: the model, all numbers that are given or follow from the lens law, and D; lengths in mm."""
        own = {name: getattr(self.model, name) for name in self.model.parameters()}
        common = {name: getattr(self, name) for name in (*NUMBERS, "diaphragm_diameter")}
        bent = {} if self.distortion is None else {"distortion": str(self.distortion)}
        found = {"model": self.model.name} | common | own | bent
        return {name: value for name, value in found.items() if value is not None}


def number_names() -> tuple[str, ...]:
    """Names of all numbers that a lens of any model may have."""
    return (*NUMBERS, *(name for model in model_names() for name in model_named(model).parameters()))


def _model(name: str, own: dict[str, object]) -> LensModel:
    """Model with this name and its own parameters; OpticsError for a parameter of another model."""
    kind = model_named(name)
    for wrong in (parameter for parameter in own if parameter not in kind.parameters()):
        home = next((other for other in model_names() if wrong in model_named(other).parameters()), None)
        if home is None:
            raise OpticsError(f"no model has a number '{wrong}'. Leave it out or correct its name.")
        raise OpticsError(
            f"'{wrong}' = {own[wrong]} belongs to model '{home}', this is '{name}'. Leave it out or set "
            f"model to '{home}'."
        )
    return kind(**own)


def configuration_factor(radius: float, distance: float, offset: float) -> float:
    """Share of the power of a Lambertian surface element that a disc parallel to it receives (Eq. M.17), no unit.

    f = ½ (1 − (Z − 2R²)/√(Z² − 4R²a²)), Z = u² + R² + a², with the disc's R = `radius`, u = `distance` and
    a = `offset` from the element's normal, all in mm. It is evaluated without the cancellation at small R.
    """
    z = distance**2 + radius**2 + offset**2
    s = math.sqrt((z - 2 * radius * offset) * (z + 2 * radius * offset))
    return 2 * radius**2 * distance**2 / (s * (s + z - 2 * radius**2))
