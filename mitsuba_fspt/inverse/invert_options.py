"""Arguments of `invert` that are numbers and names, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..runtime.errors import InversionError
from ..runtime.numbers import number, whole
from .smoothness import Prior
from .surface import CREASE_ANGLE
from .transport_matrix import TransportMatrix
from .view_factors import checked_factor

CONFIDENCE = 0.9
# Options without an effect on 'mlem', and the values that they may have there.
UNUSED: dict[str, tuple[object, ...]] = {
    "weight": (None, 0.0),
    "prior": (None,),
    "crease_angle": (CREASE_ANGLE,),
    "samples": (0,),
    "seed": (0,),
    "confidence": (CONFIDENCE,),
    "gain_per_view": (0.0,),
}
MOST_SAMPLES = 1_000_000
ROUNDING = 1e-6  # by which 2/(1 - confidence) may be too large: 1 - 0.9 in binary is less than 0.1


@dataclass(frozen=True)
class Options:
    """Checked arguments of `invert`; InversionError for one outside its range."""

    weight: float | None
    samples: int
    seed: int
    confidence: float
    method: str = "smooth"
    crease_angle: float = CREASE_ANGLE
    gain_per_view: float = 0.0
    prior: Prior | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain_per_view", checked_factor("invert", self.gain_per_view))
        angle = number("invert: 'crease_angle'", self.crease_angle, InversionError, "45")
        if not 0 <= angle <= 180:
            raise InversionError(
                f"invert: 'crease_angle' must be in 0 … 180 degrees, got {angle:g}. Give 45, or 180 to smooth across "
                "all edges."
            )
        object.__setattr__(self, "crease_angle", angle)
        if self.method not in ("smooth", "mlem"):
            raise InversionError(f"invert: 'method' must be 'smooth' or 'mlem', got {self.method!r}. Give one of them.")
        if self.weight is not None:
            weight = number("invert: 'weight'", self.weight, InversionError, "1.0")
            if not 0 <= weight < np.inf:
                raise InversionError(
                    f"invert: 'weight' must be finite and >= 0 mm², got {weight:g}. Give 1.0, or None."
                )
            object.__setattr__(self, "weight", weight)
        confidence = number("invert: 'confidence'", self.confidence, InversionError, "0.9")
        if not 0 < confidence < 1:
            raise InversionError(f"invert: 'confidence' must be in (0, 1), got {confidence:g}. Give for example 0.9.")
        object.__setattr__(self, "confidence", confidence)
        for name, most in (("samples", MOST_SAMPLES), ("seed", 1 << 53)):
            value = whole(f"invert: '{name}'", getattr(self, name), InversionError, "200")
            if not 0 <= value <= most:
                raise InversionError(f"invert: '{name}' must be in 0 … {most}, got {value}. Give for example 200.")
            object.__setattr__(self, name, value)
        self._require_effect()
        self._require_samples()

    def _require_samples(self) -> None:
        """Raise InversionError for fewer draws than intervals of the confidence need; seed, confidence without draws.

        The next draw lies between the least and the largest of n with the probability (n - 1)/(n + 1).
        """
        least = max(2, math.ceil(2 / (1 - self.confidence) - 1 - ROUNDING))
        if 0 < self.samples < least:
            most = 100 * (self.samples - 1) / (self.samples + 1)
            raise InversionError(
                f"invert: with 'samples' = {self.samples} intervals hold {most:.3g} % at most, 'confidence' is "
                f"{100 * self.confidence:.9g} %. Give samples = {least} or more, a lower confidence, or 0 for no "
                "intervals."
            )
        for name, usual in (("seed", 0), ("confidence", CONFIDENCE)):
            if (given := getattr(self, name)) != usual and not self.samples:
                raise InversionError(
                    f"invert: '{name}' = {given:g} has no effect without 'samples'. Give both, or leave it out."
                )

    def _require_effect(self) -> None:
        """Raise InversionError for an option that has no effect on the method 'mlem'."""
        if self.method == "mlem":
            for name, allowed in UNUSED.items():
                if (given := getattr(self, name)) not in allowed:
                    raise InversionError(
                        f"invert: '{name}' = {given} has no effect on method 'mlem', which has no penalty, creases, "
                        "intervals and factors of views. Leave it out."
                    )


def require_matrix(matrix: object) -> None:
    """Raise InversionError where it is no transport matrix."""
    if not isinstance(matrix, TransportMatrix):
        raise InversionError(
            f"invert: the first argument must be a transport matrix, got {type(matrix).__name__}. Make one with "
            "fspt.transport, or read one with fspt.read_transport."
        )
