"""Light of one wavelength or of a spectrum: photons and electrons per joule, means of curves (Eq. M.43).

    ⟨c⟩ = ∫ s c dλ / ∫ s dλ,   photons per joule = ⟨λ⟩/(h c),   electrons per joule = ⟨η λ⟩/(h c)

s is the power per nm. Curves are linear between their rows, so that the integrals are exact by Gauss' rule on the
intervals between the rows of all of them.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FsptError, ImageError
from ..runtime.wavelength import LONGEST, SHORTEST, wavelength
from .curve_file import Curve, ascending_curve

Array = NDArray[np.float64]
PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0  # h c [J m], both exact in the SI
METRE = 1e-9  # of one nm
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)  # exact to the fifth power: s · τ · η · λ has the fourth
PRODUCT = 1e-6  # relative error of the integral of a product of curves by a curve of its own
KEYS = ("wavelength_nm", "spectrum")  # of metadata
SURFACE = "surface_wavelength_nm"  # of metadata: mean wavelength of a spectrum before the filters [nm]
Spectrum = str | os.PathLike[str] | Curve


@dataclass(frozen=True, eq=False)
class Light:
    """Light at the detector: of one wavelength, or with a spectrum.

    wavelength_nm : in vacuum [nm]; None for a spectrum
    spectrum : relative power per nm; None for one wavelength
    """

    wavelength_nm: float | None
    spectrum: Curve | None

    @classmethod
    def given(
        cls,
        wavelength_nm: object = None,
        spectrum: Spectrum | None = None,
        error: type[FsptError] = ImageError,
        thing: str = "image",
    ) -> Light | None:
        """Light of one wavelength or of a spectrum; None if neither is given.

        Parameters
        ----------
        wavelength_nm : [nm], 200 … 2500, or None
        spectrum : CSV file of nm, relative power per nm, ascending; or a curve that was read
        error, thing : class and beginning of messages

        Raises
        ------
        error : both are given, or one is outside its range.
        """
        if wavelength_nm is not None and spectrum is not None:
            raise error(f"{thing}: 'wavelength_nm' and 'spectrum' exclude each other. Give one of them.")
        if wavelength_nm is not None:
            return cls(wavelength(f"{thing}: 'wavelength_nm'", wavelength_nm, error), None)
        if spectrum is None:
            return None
        return cls(None, spectrum if isinstance(spectrum, Curve) else read_spectrum(spectrum, error, thing))

    @classmethod
    def of_image(
        cls,
        metadata: Mapping[str, Any],
        given: Light | None,
        error: type[FsptError] = ImageError,
        thing: str = "image",
    ) -> Light:
        """The light of an image with these metadata, or of a lens with these numbers: its own, or else the given one.

        Raises
        ------
        error : there is none, or another one is given than the image has.
        """
        own = cls.recorded(metadata, error, thing)
        if own is None and given is None:
            raise error(
                f"{thing}: photons need a wavelength, the image has none. Give wavelength_nm, say 660, or spectrum, a "
                "CSV of nm, power per nm."
            )
        if own is None or given is None:
            return own or given  # type: ignore[return-value]  # one of them is there
        if not own.same(given):
            raise error(
                f"{thing}: {given.argument}, but the image was rendered for {own}, by its filter's curve. Leave it "
                "out, or render with that light."
            )
        return own

    @classmethod
    def recorded(cls, metadata: Mapping[str, Any], error: type[FsptError], thing: str) -> Light | None:
        """Light in the metadata of an image, or in the numbers of a lens; None if they have none."""
        if "spectrum" in metadata:
            try:
                nm, power = np.asarray(json.loads(str(metadata["spectrum"])), np.float64).T
                if len(nm) < 2 or not ((np.diff(nm) > 0).all() and (power >= 0).all() and power.any()):
                    raise ValueError("no curve")
            except (TypeError, ValueError) as cause:
                raise error(f"{thing}: 'spectrum' of its metadata is damaged. Render or reduce it again.") from cause
            return cls(None, Curve("spectrum of the image", nm, power))
        if "wavelength_nm" not in metadata:
            return None
        return cls(wavelength(f"{thing}: 'wavelength_nm' of its metadata", metadata["wavelength_nm"], error), None)

    def metadata(self) -> dict[str, str | int | float]:
        """Entries of an image's metadata: `wavelength_nm`, or `spectrum` as JSON, rows of nm and power per nm."""
        if self.spectrum is None:
            return {"wavelength_nm": float(self.wavelength_nm or 0.0)}
        return {"spectrum": json.dumps(np.stack([self.spectrum.wavelengths, self.spectrum.values], axis=1).tolist())}

    def same(self, other: Light) -> bool:
        """True for the same wavelength, or for spectra that differ by a factor alone."""
        if self.spectrum is None or other.spectrum is None:
            return self.spectrum is other.spectrum and self.wavelength_nm == other.wavelength_nm
        mine, theirs = (one.values / one.values.max() for one in (self.spectrum, other.spectrum))
        return np.array_equal(self.spectrum.wavelengths, other.spectrum.wavelengths) and np.allclose(
            mine, theirs, rtol=1e-12
        )

    @property
    def photons_per_joule(self) -> float:
        """⟨λ⟩/(h c)."""
        return self.mean_wavelength_nm * METRE / PLANCK_TIMES_LIGHT

    @property
    def mean_wavelength_nm(self) -> float:
        """⟨λ⟩ [nm], weighted by the power."""
        if self.spectrum is None:
            return float(self.wavelength_nm or 0.0)
        return self._mean(lambda nm: nm, np.empty(0))

    def electrons_per_joule(self, efficiency: float | Curve) -> float:
        """⟨η λ⟩/(h c) for a quantum efficiency η, a number or a curve that covers the light (see `require_cover`)."""
        if not isinstance(efficiency, Curve):
            return efficiency * self.photons_per_joule
        if self.spectrum is None:
            return float(efficiency.on(np.array(self.wavelength_nm))) * self.photons_per_joule
        mean = self._mean(lambda nm: nm * efficiency.on(nm), efficiency.wavelengths)
        return mean * METRE / PLANCK_TIMES_LIGHT

    def mean(self, curve: Curve) -> float:
        """Mean of a curve that covers the light, weighted by the power."""
        if self.spectrum is None:
            return float(curve.on(np.array(self.wavelength_nm)))
        return self._mean(curve.on, curve.wavelengths)

    def require_cover(self, curve: Curve, name: str, error: type[FsptError]) -> None:
        """Raise `error` unless the curve, the parameter `name`, is known wherever there is light."""
        first, last = self.ends
        if not curve.covers(first, last):
            raise error(
                f"'{name}' = '{curve.file}' has {curve.wavelengths[0]:g} … {curve.wavelengths[-1]:g} nm, the light "
                f"{first:g} … {last:g} nm. Give a curve that covers the light, 0 where it is known to be."
            )

    @property
    def ends(self) -> tuple[float, float]:
        """Shortest and longest wavelength [nm] with light."""
        if self.spectrum is None:
            return float(self.wavelength_nm or 0.0), float(self.wavelength_nm or 0.0)
        lit = np.flatnonzero(self.spectrum.values)
        nm, last = self.spectrum.wavelengths, len(self.spectrum.wavelengths) - 1
        return float(nm[max(lit[0] - 1, 0)]), float(nm[min(lit[-1] + 1, last)])

    def through(self, filters: Curve) -> Light:
        """The light behind filters of this transmittance, which covers it: power per nm times transmittance.

        Between the rows of both curves the product is a parabola, which further rows follow to `PRODUCT` of the power.
        """
        if self.spectrum is None:
            return self
        nm = _merged(self.spectrum, filters.wavelengths)
        power, passed = (curve.on(nm) for curve in (self.spectrum, filters))
        product = power * passed
        total = float(((product[1:] + product[:-1]) / 2 * np.diff(nm)).sum())
        bend = np.abs(np.diff(power) * np.diff(passed)) * np.diff(nm) / 6  # ∫ by which a straight line is wrong
        parts = np.ceil(np.sqrt(bend * len(bend) / max(PRODUCT * total, 1e-300))).clip(1, 1000).astype(int)
        fine = np.concatenate(
            [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(nm[:-1], nm[1:], parts, strict=True)] + [nm[-1:]]
        )
        found = self.spectrum.on(fine) * filters.on(fine)
        return Light(None, Curve(f"{self.spectrum.file} × {filters.file}", fine, found))

    def _mean(self, function: Any, nodes: Array) -> float:
        """∫ s f dλ / ∫ s dλ of a function that is a polynomial of up to the fourth power between the `nodes` [nm]."""
        spectrum = self.spectrum
        if spectrum is None:
            raise ValueError("one wavelength has no integral")
        nm = _merged(spectrum, nodes)
        half = np.diff(nm) / 2
        points = (nm[:-1] + half)[:, None] + half[:, None] * NODES
        weights = half[:, None] * WEIGHTS * spectrum.on(points)
        return float((weights * function(points)).sum() / weights.sum())

    @property
    def argument(self) -> str:
        """The argument that gives this light, for messages."""
        if self.spectrum is None:
            return f"'wavelength_nm' = {self.wavelength_nm:g}"
        return f"'spectrum' = '{self.spectrum.file}'"

    def __str__(self) -> str:
        if self.spectrum is None:
            return f"{self.wavelength_nm:g} nm"
        return f"a spectrum of {self.ends[0]:g} … {self.ends[1]:g} nm"


def _merged(spectrum: Curve, nodes: Array) -> Array:
    """Ascending wavelengths [nm] of the spectrum's rows and of those of another curve between them."""
    inside = nodes[(nodes > spectrum.wavelengths[0]) & (nodes < spectrum.wavelengths[-1])]
    return np.union1d(spectrum.wavelengths, inside)


def read_spectrum(path: object, error: type[FsptError], thing: str = "") -> Curve:
    """Spectrum of a CSV file of nm, relative power per nm, all of it in 200 … 2500 nm; raises `error`."""
    if not isinstance(path, (str, os.PathLike)):
        raise error(f"{thing}: 'spectrum' must be the name of a CSV file, got {type(path).__name__}. Give nm, power.")
    found = ascending_curve(Path(path), "spectrum", error, "power per nm", "660,0.8", math.inf)
    if found.wavelengths[0] < SHORTEST or found.wavelengths[-1] > LONGEST:
        raise error(
            f"'spectrum' = '{path}' must lie in {SHORTEST:g} … {LONGEST:g} nm, got {found.wavelengths[0]:g} … "
            f"{found.wavelengths[-1]:g}. Leave other rows out."
        )
    return found


def read_efficiency(path: str | os.PathLike[str], error: type[FsptError]) -> Curve:
    """Quantum efficiency η of a CSV file of nm, η, in 0 … 1."""
    return ascending_curve(Path(path), "quantum_efficiency", error, "quantum efficiency", "660,0.8", 1.0)
