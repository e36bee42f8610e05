"""Parameters of a detector, and the camera's TOML file that contains them."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..images.pixel_map import PixelMap
from ..optics.curve_file import Curve
from ..optics.light import Light, read_efficiency
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import DetectorError, named
from ..runtime.numbers import number
from ..runtime.toml_file import read_toml
from .stray_light import Kernel, StrayLight

Array = NDArray[np.float64]
Own = TypeVar("Own", bound="DetectorParameters")

# Parameters of a detector, each with an example for messages.
EXAMPLES = {
    "quantum_efficiency": "0.85",
    "dark_current": "1e-3",
    "read_noise": "3.5",
    "full_well": "1e5",
    "gain": "1.6",
    "bias": "500",
    "bits": "16",
    "pixel_pitch": "0.0135",
    "gain_error": "0.05",
    "em_gain": "300",
    "excess_noise": "2",
    "spurious_charge": "2e-3",
    "prnu": "0.005",
    "veiling_glare": "0.01",
}
TABLES = ("detector", "lens")  # of a camera's TOML file; this file reads the first one only
COMMENTS = {
    "quantum_efficiency": "electrons per photon, η of EMVA 1288",
    "dark_current": "e-/px/s",
    "read_noise": "e-, temporal dark noise of EMVA 1288",
    "full_well": "e-, saturation capacity of EMVA 1288",
    "gain": "e-/DN, 1/K of EMVA 1288",
    "bias": "DN",
    "bits": "of the converter",
    "pixel_pitch": "mm, of the pixel of the dark current",
    "gain_error": "relative standard uncertainty common to all pixels",
    "em_gain": "electrons after the multiplying register per electron before it",
    "excess_noise": "F² of the register",
    "spurious_charge": "e-/px/frame, before the register",
    "prnu": "relative standard deviation of the pixels' response",
    "psf": "kernel of the stray light, an image file",
    "veiling_glare": "share of the film's light that is spread evenly over it",
}
FILES = ("quantum_efficiency", "psf")  # that may be names of other files
MAPPED = ("read_noise", "gain", "bias", "dark_current", "prnu")  # a number, or the name of a map
# Names of EMVA 1288 that a TOML may use instead; the overall system gain K is in DN/e-.
EMVA_1288 = {
    "temporal_dark_noise": "read_noise",
    "saturation_capacity": "full_well",
    "overall_system_gain": "gain",
}
# Keys of an exposure's metadata, where `pixel_pitch` is that of the pixels read out.
RECORDED = {name: name for name in EXAMPLES if name not in ("gain_error", "veiling_glare")}
RECORDED["pixel_pitch"] = "detector_pixel_pitch"
MOST_EXCESS = 2.5  # F² of an avalanche of many stages is 2, that of an intensifier up to about 2.5
MOST_PRNU = 0.1  # of a number: far below 1, so that no pixel drawn has a negative response
SUFFIX = re.compile(r"\.[A-Za-z]\w*$")
DEVIATION = 0.5  # median of a map of the response below which it holds deviations from 1
# Rule of each parameter, and whether a value or a map keeps it.
RULES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "quantum_efficiency": ("in (0, 1]", lambda v: (v > 0) & (v <= 1)),
    "dark_current": (">= 0 e-/px/s", lambda v: v >= 0),
    "read_noise": (">= 0 e-", lambda v: v >= 0),
    "full_well": ("in (0, 1e15] e-", lambda v: (v > 0) & (v <= 1e15)),
    "gain": ("> 0 e-/DN", lambda v: v > 0),
    "bias": (">= 0 DN", lambda v: v >= 0),
    "bits": ("a whole number in 1 … 16", lambda v: v in range(1, 17)),
    "pixel_pitch": ("> 0 mm", lambda v: v > 0),
    "gain_error": ("in [0, 1)", lambda v: (v >= 0) & (v < 1)),
    "em_gain": (">= 1 electron out per electron in, 1 without a multiplying register", lambda v: v >= 1),
    "excess_noise": (
        f"in [1, {MOST_EXCESS:g}], 1 for photon counting, 2 for a multiplying register",
        lambda v: (v >= 1) & (v <= MOST_EXCESS),
    ),
    "spurious_charge": (">= 0 e-/px/frame", lambda v: v >= 0),
    "prnu": (f"in [0, {MOST_PRNU:g}]; above that give a map", lambda v: (v >= 0) & (v <= MOST_PRNU)),
    "veiling_glare": ("in [0, 1)", lambda v: (v >= 0) & (v < 1)),
}


class Derived(float):
    """A number that follows from others, unless it is given: `dataclasses.replace` derives it again."""


@dataclass(frozen=True)
class DetectorParameters:
    """Parameters of a detector; see `Detector`, which exposes and reduces with them."""

    quantum_efficiency: float | str
    dark_current: float | str
    read_noise: float | str
    full_well: float
    gain: float | str
    bias: float | str
    bits: int
    pixel_pitch: float | None = None
    name: str = "detector"
    gain_error: float = 0.0
    em_gain: float = 1.0
    excess_noise: float | None = None
    spurious_charge: float = 0.0
    prnu: float | str = 0.0
    psf: str | None = None
    veiling_glare: float = 0.0

    @classmethod
    def from_toml(cls: type[Own], path: str | os.PathLike[str]) -> Own:
        """Detector of a camera's TOML file: its table [detector], whose keys are the parameters of the class.

        Those with a default may be left out. A table [lens] in the same file is not read. Names of maps are relative to
        the folder of the file.

            [detector]
            name = "iKon-M 934, serial 1234"
            quantum_efficiency = 0.9   # electrons per photon, or a CSV of nm, η
            dark_current = 1e-3        # e-/px/s
            read_noise = 3.5           # e-, or a map such as "read_noise.fits"
            full_well = 1e5            # e-
            gain = 1.6                 # e-/DN
            bias = 500                 # DN
            bits = 16
            pixel_pitch = 0.013        # mm, of the pixel of the dark current

        Raises
        ------
        DetectorError : the file cannot be read, has no table [detector], a key is unknown or missing, or a value is of
            the wrong type or outside its range.
        """
        content = read_toml(path, DetectorError)
        table = content.get("detector")
        if not isinstance(table, dict):
            raise DetectorError(f"'{path}': the table [detector] is missing. Give it, with {', '.join(EXAMPLES)}.")
        if unknown := [key for key in content if key not in TABLES]:
            raise DetectorError(
                f"'{path}': '{unknown[0]}' means nothing here. Put it into [detector], or leave it out."
            )
        known = {field.name: field.default for field in fields(cls)}
        table = _own_names(table, path)
        if unknown := [key for key in table if key not in known]:
            raise DetectorError(f"'{path}' [detector]: '{unknown[0]}' means nothing here. Give {', '.join(known)}.")
        if missing := [key for key, default in known.items() if default is MISSING and key not in table]:
            key = missing[0]
            raise DetectorError(f"'{path}' [detector]: '{key}' is missing. Give for example {key} = {EXAMPLES[key]}.")
        if not isinstance(table.get("name", ""), str):
            raise DetectorError(
                f"'{path}' [detector]: 'name' must be a text in quotes, got {table['name']}. Give for example \"CCD\"."
            )
        table |= {key: str(Path(path).parent / table[key]) for key in (*MAPPED, *FILES) if _is_name(table.get(key))}
        try:
            return cls(**table)
        except DetectorError as cause:
            raise DetectorError(f"'{path}' [detector]: {str(cause).removeprefix('detector: ')}") from cause

    def __post_init__(self) -> None:
        maps, curve = dict[str, PixelMap](), None
        for name, example in EXAMPLES.items():
            value = getattr(self, name)
            if value is None and name in ("pixel_pitch", "excess_noise"):
                continue
            if name in MAPPED and _is_name(value):
                maps[name] = _map(name, value)
                object.__setattr__(self, name, os.fspath(value))
                continue
            if name == "quantum_efficiency" and _is_name(value):
                with named("detector"):
                    curve = read_efficiency(value, DetectorError)
                object.__setattr__(self, name, os.fspath(value))
                continue
            rule, holds = RULES[name]
            checked = number(f"detector: '{name}'", value, DetectorError, example)
            if not (math.isfinite(checked) and holds(checked)):
                raise DetectorError(
                    f"detector: '{name}' must be finite and {rule}, for example {example}, got {value}."
                )
            object.__setattr__(self, name, value if isinstance(value, Derived) else checked)
        object.__setattr__(self, "bits", int(self.bits))
        object.__setattr__(self, "_maps", maps)
        object.__setattr__(self, "_efficiency", self.quantum_efficiency if curve is None else curve)
        kernel = None
        if self.psf is not None:
            if not isinstance(self.psf, (str, os.PathLike)):
                raise DetectorError(f"detector: 'psf' must be the name of an image file, got {self.psf!r}.")
            object.__setattr__(self, "psf", os.fspath(self.psf))
            kernel = Kernel.read(self.psf)
        object.__setattr__(self, "_stray_light", StrayLight(kernel, self.veiling_glare))
        self._derive_excess_noise()

    def _derive_excess_noise(self) -> None:
        """F² of the register where none is given: 2, and 1 without multiplication; refuse another one there."""
        given = self.excess_noise
        if given is None or isinstance(given, Derived):
            object.__setattr__(self, "excess_noise", Derived(2.0 if self.em_gain > 1 else 1.0))
        elif self.em_gain == 1 and given != 1:
            raise DetectorError(
                f"detector: 'excess_noise' = {given:g} goes with 'em_gain' > 1, which is 1: without multiplication it "
                "is 1. Give 'em_gain', for example 300, or leave 'excess_noise' out."
            )

    def electrons_per_joule(self, light: Light) -> float:
        """Electrons before the register per joule of light; DetectorError where the curve of η does not cover it."""
        efficiency: float | Curve = self._efficiency  # type: ignore[attr-defined]  # set when the numbers are checked
        if isinstance(efficiency, Curve):
            light.require_cover(efficiency, "quantum_efficiency", DetectorError)
        return light.electrons_per_joule(efficiency)

    @property
    def excess(self) -> float:
        """F², excess noise of the register; 1 without one."""
        return float(self.excess_noise or 1.0)

    @property
    def maps(self) -> dict[str, PixelMap]:
        """Maps by the names of their parameters."""
        return self._maps  # type: ignore[attr-defined]  # set when the numbers are checked

    @property
    def stray_light(self) -> StrayLight:
        """Point-spread function and veiling glare."""
        return self._stray_light  # type: ignore[attr-defined]  # likewise

    def on_pixels(self, name: str, shape: tuple[int, ...]) -> Array | float:
        """Value of a parameter of `MAPPED`: its number, or its map (h, w), which must be of this shape."""
        if name in self.maps:
            return self.maps[name].on(shape, f"detector: '{name}'")
        return float(getattr(self, name))

    def mean(self, name: str) -> float:
        """Value of a parameter of `MAPPED`: its number, or the mean of its map."""
        return float(self.maps[name].values.mean()) if name in self.maps else float(getattr(self, name))

    def response(self, shape: tuple[int, ...]) -> Array | None:
        """Response of each pixel (h, w) relative to the mean one by the map `prnu`; None without a map.

        A map with a median below 1/2 holds deviations of the response from 1.
        """
        if "prnu" not in self.maps:
            return None
        values = self.maps["prnu"].on(shape, "detector: 'prnu'")
        return values + 1 if np.median(values) < DEVIATION else values

    def area(self, pixel_pitch: float | None, binning: int | None) -> float:
        """Number of the detector's own pixels in one that is read out.

        pixel_pitch : of the pixels read out [mm], or None
        binning : pixels along their side, where one of the pitches is unknown; None: 1
        """
        if pixel_pitch is None or self.pixel_pitch is None:
            return float((binning or 1) ** 2)
        return (pixel_pitch / self.pixel_pitch) ** 2

    def to_toml(self, path: str | os.PathLike[str]) -> None:
        """Write a camera's TOML file with the table [detector], which `from_toml` reads.

        Raises DetectorError if the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".toml":
            raise DetectorError(f"output file '{path}' must end in .toml. Give a name such as camera.toml.")
        lines = ["[detector]", f"name = {json.dumps(self.name)}"]
        for name, comment in COMMENTS.items():
            value = getattr(self, name)
            if isinstance(value, str):  # a map or a kernel, relative to another folder as it may be
                lines.append(f"{name} = {json.dumps(str(Path(value).absolute()))}  # {comment}")
            elif value is not None and not isinstance(value, Derived):
                lines.append(f"{name} = {value!r}  # {comment}")
        with atomic_path(path, DetectorError) as temporary:
            temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")


def _map(name: str, path: str | os.PathLike[str]) -> PixelMap:
    """Map of a parameter; DetectorError for a value outside its range."""
    found = PixelMap.read(os.fspath(path), f"detector: '{name}'")
    values, (rule, holds) = found.values, RULES[name]
    if name == "prnu":
        values = values + 1 if np.median(values) < DEVIATION else values
        rule, holds = "> 0 on every pixel, about 1 or, as a deviation from 1, about 0", lambda v: v > 0
    if not (good := np.asarray(holds(values))).all():
        raise DetectorError(f"detector: '{name}' = '{path}' must be {rule}, got {found.values[~good][0]:g}.")
    return found


def _is_name(value: object) -> bool:
    """True for the name of a file, which has a suffix."""
    return isinstance(value, os.PathLike) or (isinstance(value, str) and SUFFIX.search(value) is not None)


def _own_names(table: dict[str, Any], path: str | os.PathLike[str]) -> dict[str, Any]:
    """Table [detector] with EMVA 1288's names replaced by this package's; DetectorError for a number given twice."""
    found = dict(table)
    for theirs, ours in EMVA_1288.items():
        if theirs not in found:
            continue
        if ours in found:
            raise DetectorError(f"'{path}' [detector]: '{theirs}' and '{ours}' are the same. Give one of them.")
        value = found.pop(theirs)
        if theirs == "overall_system_gain":
            value = number(f"'{path}' [detector]: '{theirs}'", value, DetectorError, "0.625")
            value = 1 / value if value else math.inf
        found[ours] = value
    return found
