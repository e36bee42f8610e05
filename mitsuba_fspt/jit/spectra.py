"""Values in spectral and polarised variants: J_n, radiance and power are equal at all wavelengths and unpolarised."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

WAVELENGTH_NM = 550.0  # wavelength at which spectral variants evaluate spectrally flat quantities
# ∫ ȳ dλ [nm]: divisor of Mitsuba's spectral variants for light on a film, and integral of Mitsuba's table of ȳ.
CIE_NORM, CIE_TABLE = 106.7502593994140625, 106.85703


def at_one_wavelength(record: mi.Ray3f | mi.SurfaceInteraction3f) -> None:
    """Set the wavelength of a ray or a surface interaction; without one, spectral variants evaluate to 0."""
    if mi.is_spectral:
        record.wavelengths = type(record.wavelengths)(WAVELENGTH_NM)


def scalar(spectrum: mi.Spectrum) -> mi.Float:
    """Value of a spectrally flat, unpolarised quantity, in any variant."""
    flat = mi.unpolarized_spectrum(spectrum) if mi.is_polarized else spectrum
    # `dr.mean` would write the number of array entries into the kernel, and every image size would need a new kernel.
    return dr.sum(flat, axis=0) * (1 / len(flat))


def sample_wavelengths(sample: mi.Float) -> tuple[mi.Wavelength, mi.UnpolarizedSpectrum]:
    """Wavelengths [nm] drawn with a uniform number and the inverse of their density; empty and 1 if not spectral."""
    if not mi.is_spectral:
        return mi.Color0f(), mi.UnpolarizedSpectrum(1)
    return mi.sample_rgb_spectrum(mi.sample_shifted(sample))


def flat_share() -> float:
    """Factor on a spectrally flat radiance with which a film stores its value; 1 in variants that are not spectral."""
    return CIE_NORM / CIE_TABLE if mi.is_spectral else 1.0
