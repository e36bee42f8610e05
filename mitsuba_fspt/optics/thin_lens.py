"""The lens: lens law, diaphragm (Eq. 3), and the discs of the lens plane through which light may pass.

Camera frame: lens plane z = 0, optical axis +z towards the object. Lengths in mm, all distances positive magnitudes
from the lens plane. Pure Python floats in double precision; nothing here knows Mitsuba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..runtime.errors import OpticsError
from ..runtime.numbers import number

LARGEST = 1e30  # of a lens's numbers and of their inverses: squares stay finite
MODELS = ("diaphragm", "hrrt", "pinhole", "ripoll")
FOCUS = ("focus_distance", "magnification", "image_distance")  # exactly one of them is given
BORDERS = ("lens_diameter", "diaphragm_distance", "numerical_aperture", "image_stop_diameter")
NUMBERS = ("focal_length", "f_number", *FOCUS, *BORDERS)  # of `Lens.focused`
EXAMPLES = dict(zip(NUMBERS, ("55", "8", "165", "0.5", "82.5", "20", "5", "0.5", "20"), strict=True))


@dataclass(frozen=True)
class Disc:
    """Disc of the lens plane open to a virtual point at (x, y, u): centre `shift`·(x, y), radius `radius` [mm].

    `shift` is 0 for a border that lies in the lens plane and 1 for a cone that moves along with the virtual point.
    """

    shift: float
    radius: float


@dataclass(frozen=True)
class Lens:
    """Thin lens with a diaphragm, focused on the virtual detector plane z = u (paper, section 2.C).

    Parameters
    ----------
    focal_length : F [mm], > 0
    f_number : f_num = F/D (Eq. 3), > 0
    focus_distance : u [mm], > F, from the lens plane to the virtual detector plane
    lens_diameter : the lens border [mm]; None leaves the diaphragm as the only border
    diaphragm_distance : from the lens plane to the diaphragm [mm]; > 0 behind the lens (detector side), < 0 in front
    image_stop_diameter : circular stop on the detector, centred on the optical axis [mm]; None leaves the film's border
    model : 'diaphragm' (this paper), 'hrrt' (lens border only), 'pinhole' (one line of sight a point), 'ripoll'
        (acceptance cone of `numerical_aperture` about the detector normal)
    numerical_aperture : sine of the half angle of that cone, in (0, 1); only for 'ripoll'

    Raises
    ------
    OpticsError : the lens cannot exist or forms no real image; the message names the parameter.
    """

    focal_length: float
    f_number: float
    focus_distance: float
    lens_diameter: float | None = None
    diaphragm_distance: float = 0.0
    model: str = "diaphragm"
    numerical_aperture: float | None = None
    image_stop_diameter: float | None = None

    @classmethod
    def focused(
        cls,
        focal_length: float,
        f_number: float,
        *,
        focus_distance: float | None = None,
        magnification: float | None = None,
        image_distance: float | None = None,
        **borders: object,
    ) -> Lens:
        """Lens focused by exactly one of u (`focus_distance`), t (`magnification`) or v (`image_distance`).

        Lens law: 1/F = 1/u + 1/v, t = v/u. Raises OpticsError where none or several are given.
        """
        focal_length = _require_positive("focal_length", focal_length, "mm, for example 55")
        focus = zip(FOCUS, (focus_distance, magnification, image_distance), strict=True)
        given = {name: value for name, value in focus if value is not None}
        if len(given) != 1:
            raise OpticsError(
                f"fspt_lens: exactly one of {', '.join(map(repr, FOCUS))} sets the focus, got "
                f"{' and '.join(map(repr, given)) or 'none'}. Give one, for example magnification = 0.5."
            )
        ((name, value),) = given.items()
        value = _require_positive(name, value, "for example magnification = 0.5")
        if name == "magnification":
            focus_distance = focal_length * (1 + 1 / value)
        elif name == "image_distance":
            if value <= focal_length:
                raise OpticsError(
                    f"fspt_lens: 'image_distance' must be > focal_length = {focal_length:g} mm for a real image, "
                    f"got {value:g}. Give a larger one, or 'magnification'."
                )
            focus_distance = focal_length * value / (value - focal_length)
        else:
            focus_distance = value
        return cls(focal_length, f_number, focus_distance, **borders)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        for name in ("focal_length", "f_number", "focus_distance", *BORDERS):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, number(f"fspt_lens: '{name}'", value, OpticsError, EXAMPLES[name]))
        _require_positive("focal_length", self.focal_length, "mm, for example 55")
        _require_positive("f_number", self.f_number, "f_number = F/D, for example 8")
        _require_positive("focus_distance", self.focus_distance, "mm, for example 165")
        if self.focus_distance <= self.focal_length:
            raise OpticsError(
                f"fspt_lens: 'focus_distance' must be > focal_length = {self.focal_length:g} mm for a real image, "
                f"got {self.focus_distance:g}. Move the camera back or use a shorter lens."
            )
        if self.model not in MODELS:
            raise OpticsError(
                f"fspt_lens: 'model' must be one of {', '.join(MODELS)}, got '{self.model}'. Give one of these."
            )
        if not math.isfinite(self.diaphragm_distance):
            raise OpticsError(
                f"fspt_lens: 'diaphragm_distance' must be finite, got {self.diaphragm_distance:g} mm. Give mm, for "
                "example 5."
            )
        self._check_borders()

    def _check_borders(self) -> None:
        if self.model == "ripoll":
            if self.numerical_aperture is None or not 0 < self.numerical_aperture < 1:
                raise OpticsError(
                    f"fspt_lens: model 'ripoll' needs 'numerical_aperture' in (0, 1), got {self.numerical_aperture}. "
                    "Give for example 0.5."
                )
        elif self.numerical_aperture is not None:
            raise OpticsError(
                f"fspt_lens: 'numerical_aperture' = {self.numerical_aperture:g} belongs to model 'ripoll', this is "
                f"'{self.model}'. Leave it out or set model to 'ripoll'."
            )
        if self.model == "hrrt" and self.lens_diameter is None:
            raise OpticsError(
                "fspt_lens: model 'hrrt' needs 'lens_diameter', the border that stops its light. Give mm, say 20."
            )
        if self.image_stop_diameter is not None:
            _require_positive("image_stop_diameter", self.image_stop_diameter, "mm on the detector, for example 20")
        if self.lens_diameter is not None:
            _require_positive("lens_diameter", self.lens_diameter, "mm, for example 20")
            # Float32 parameters pass through here: D = F/f_num computed twice may differ by its last bit.
            if self.model == "diaphragm" and self.diaphragm_distance == 0:
                if self.lens_diameter < self.diaphragm_diameter * (1 - 1e-6):
                    raise OpticsError(
                        f"fspt_lens: 'lens_diameter' = {self.lens_diameter:g} mm is smaller than the diaphragm "
                        f"D = focal_length/f_number = {self.diaphragm_diameter:g} mm. Give a larger lens or "
                        f"f_number >= {self.focal_length / self.lens_diameter:.4g}."
                    )
        if self.model == "diaphragm" and self.diaphragm_distance != 0:
            if self.lens_diameter is None:
                raise OpticsError(
                    f"fspt_lens: 'diaphragm_distance' = {self.diaphragm_distance:g} mm needs 'lens_diameter', the "
                    "second border a line of sight has to pass. Give mm, for example 20."
                )
            if self.diaphragm_distance >= self.image_distance:
                raise OpticsError(
                    f"fspt_lens: 'diaphragm_distance' = {self.diaphragm_distance:g} mm must be smaller than the image "
                    f"distance {self.image_distance:g} mm: the diaphragm stands between lens and detector. Give less."
                )
            if -self.diaphragm_distance >= self.focus_distance:
                raise OpticsError(
                    f"fspt_lens: 'diaphragm_distance' = {self.diaphragm_distance:g} mm must be above -focus_distance = "
                    f"{-self.focus_distance:g} mm: the diaphragm stands between lens and virtual detector plane. Give "
                    "more."
                )

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
    def seen_field(self) -> float:
        """How far [mm] off the axis virtual points lie inside the image-plane stop; inf without one."""
        return math.inf if self.image_stop_diameter is None else self.image_stop_diameter / 2 / self.magnification

    @property
    def pupil_radius(self) -> float:
        """Radius [mm] over which lens points of lines of sight spread: the first disc's, of a pinhole 0."""
        return 0.0 if self.model == "pinhole" else self.discs[0].radius

    @property
    def discs(self) -> tuple[Disc, ...]:
        """The one or two discs of the lens plane a line of sight has to pass; their overlap is the open pupil.

        Eq. 5's β, generalised: the first disc is the one to integrate over, a second one clips it.
        """
        u, radius = self.focus_distance, self.diaphragm_diameter / 2
        if self.model == "ripoll" and self.numerical_aperture is not None:
            return (Disc(1.0, u * math.tan(math.asin(self.numerical_aperture))),)
        if self.model == "hrrt" and self.lens_diameter is not None:
            return (Disc(0.0, self.lens_diameter / 2),)
        if self.model == "pinhole" or self.diaphragm_distance == 0 or self.lens_diameter is None:
            return (Disc(0.0, radius),)
        pupil = self._entrance_pupil_disc(radius)
        lens = Disc(0.0, self.lens_diameter / 2)
        return (lens,) if pupil is None else (pupil, lens)

    def _entrance_pupil_disc(self, radius: float) -> Disc | None:
        """The diaphragm's image through the lens, projected from the virtual detector plane onto the lens plane.

        A diaphragm at s behind the lens has its image at s F/(s - F), magnified F/(F - s), seen from the object
        side; one in front is its own image. A virtual point at (x, u) sees a circle of radius R_p at depth z_p as
        the disc of the lens plane with radius R_p u/(u - z_p) about -x z_p/(u - z_p).
        """
        s, focal, u = self.diaphragm_distance, self.focal_length, self.focus_distance
        if s < 0:
            depth, pupil_radius = -s, radius
        elif s == focal:
            # The image lies at infinity: the diaphragm stops directions, |slope| <= radius / F, a cone about the axis.
            return Disc(1.0, u * radius / focal)
        else:
            depth, pupil_radius = s * focal / (s - focal), abs(radius * focal / (focal - s))
        if depth == u:
            return None  # the diaphragm lies on the detector: a field stop, not a pupil
        return Disc(-depth / (u - depth), abs(pupil_radius * u / (u - depth)))


def configuration_factor(radius: float, distance: float, offset: float) -> float:
    """Share of a Lambertian point's power that a parallel coaxial-or-offset disc receives (no unit).

    f = ½ (1 − (Z − 2R²)/√(Z² − 4R²a²)), Z = u² + R² + a², with R `radius`, u `distance`, a `offset` [mm], written
    without the cancellation at small R.
    """
    z = distance**2 + radius**2 + offset**2
    s = math.sqrt((z - 2 * radius * offset) * (z + 2 * radius * offset))
    return 2 * radius**2 * distance**2 / (s * (s + z - 2 * radius**2))


def _require_positive(name: str, value: float, example: str) -> float:
    """`value` as a plain number; OpticsError where it is none, not positive or beyond `LARGEST`."""
    value = number(f"fspt_lens: '{name}'", value, OpticsError, EXAMPLES[name])
    if not (math.isfinite(value) and value > 0):
        raise OpticsError(f"fspt_lens: '{name}' must be > 0 and finite, got {value:g}. Give {example}.")
    if not 1 / LARGEST <= value <= LARGEST:
        raise OpticsError(f"fspt_lens: '{name}' must be in 1/{LARGEST:g} … {LARGEST:g}, got {value:g}. Give {example}.")
    return value
