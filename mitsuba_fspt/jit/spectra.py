"""Numbers in spectral and polarised variants: J_n, radiance and power are the same at all wavelengths, unpolarised."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

WAVELENGTH_NM = 550.0  # where spectral variants look at spectrally flat quantities
# ∫ ȳ dλ [nm]: what Mitsuba divides by where spectral variants put light on a film, and what its own table of ȳ gives.
CIE_NORM, CIE_TABLE = 106.7502593994140625, 106.85703


def at_one_wavelength(record: mi.Ray3f | mi.SurfaceInteraction3f) -> None:
    """Give a ray or a surface point a wavelength; without one spectral variants read 0 everywhere."""
    if mi.is_spectral:
        record.wavelengths = type(record.wavelengths)(WAVELENGTH_NM)


def scalar(spectrum: mi.Spectrum) -> mi.Float:
    """The one number of a spectrally flat, unpolarised quantity, whatever the variant stores it in."""
    flat = mi.unpolarized_spectrum(spectrum) if mi.is_polarized else spectrum
    # `dr.mean` would write the number of lanes into the kernel, which then compiles anew for every picture.
    return dr.sum(flat, axis=0) * (1 / len(flat))


def sample_wavelengths(sample: mi.Float) -> tuple[mi.Wavelength, mi.UnpolarizedSpectrum]:
    """Wavelengths [nm] and the inverse of their density, in spectral variants; nothing and 1 elsewhere."""
    if not mi.is_spectral:
        return mi.Color0f(), mi.UnpolarizedSpectrum(1)
    return mi.sample_rgb_spectrum(mi.sample_shifted(sample))


def flat_share() -> float:
    """What a film is to be given of a radiance that is the same at all wavelengths, for it to hold that number."""
    return CIE_NORM / CIE_TABLE if mi.is_spectral else 1.0
