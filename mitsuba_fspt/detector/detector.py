"""Detector behind the lens, in the terms of EMVA 1288: from power on a pixel to electrons and counts.

    photons    μ_p = P t ⟨λ⟩/(h c),  electrons per photon η = ⟨η λ⟩/⟨λ⟩ over the spectrum (Eq. M.43)
    charge     n   = Poisson(Σ (f η μ_p + I_dark t + c)),  over the pixels of a bin
    electrons  x   = G n,  by a multiplying register;  ⟨x⟩ = g n,  σ_x² = g² (F² − 1) n for a charge n
    counts     y   = bias + round((x + normal(σ_read)) / gain)

f is the response of a pixel relative to the mean one (PRNU), c the spurious charge. Without a register g = F² = 1 and
x = n. σ_read, full well and gain are those of the electrons after the register (Eq. M.37).
"""

from __future__ import annotations

import logging
import math
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..images.exposure import Exposure
from ..images.formats import Metadata
from ..images.image import Image
from ..images.noise_model import TYPICAL
from ..images.recorded_number import recorded_positive
from ..optics.light import Light, Spectrum
from ..runtime.errors import DetectorError
from ..runtime.numbers import number, whole
from .parameters import RECORDED, DetectorParameters
from .read_out import binned_pixels
from .reduction import Corrections, Exposed, light_of, reduce_counts
from .stray_light import StrayLight, tell_part

if TYPE_CHECKING:
    from .counts import Frame
    from .flat_field import Scene

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")


@dataclass(frozen=True, eq=False)
class Expectation:
    """Mean [e-] and variance [e-²] of the electrons of each pixel read out, shape (h, w), ignoring the full well."""

    mean: Array
    variance: Array


class Detector(DetectorParameters):
    """Detector described by the parameters of EMVA 1288: a CCD, an EMCCD, or with maps of its pixels an sCMOS.

    Parameters
    ----------
    quantum_efficiency : η, electrons per photon, in (0, 1]; or a CSV file of nm, η, ascending
    dark_current : [e-/px/s], >= 0
    read_noise : σ_read [e-] of one read-out, >= 0, after the multiplying register if there is one
    full_well : [e-], in (0, 1e15]; the most electrons that a read-out pixel, binned or not, delivers, after a register
    gain : [e-/DN], > 0, electrons after the register; 1/K in EMVA 1288
    bias : [DN], >= 0
    bits : of the converter, 1 … 16; the largest count is 2^bits − 1
    pixel_pitch : [mm], > 0, of the pixel to which `dark_current` refers; for an image with another `pixel_pitch` in
        its metadata the dark current is scaled by area. None: it refers to the image's pixels, whatever their pitch
    name : label in the files
    gain_error : relative standard uncertainty, in [0, 1), of a factor common to all pixels, such as that of a
        calibration
    em_gain : electrons after the multiplying register of an EMCCD per electron before it, >= 1; 1 without a register
    excess_noise : F² of the register, 1 … 2.5: variance of the electrons over that of a noiseless register; None: 2,
        and 1 where `em_gain` is 1
    spurious_charge : clock-induced charge [e-/px/frame] before the register, >= 0, scaled by area as `dark_current`
    prnu : relative standard deviation of the response of the detector's own pixels, 0 … 0.1. `expose` draws the
        response from it, the same for all exposures of a `name` and size; reduced images without a flat field have it
        in their errors
    psf : image file of a point's light on the film, with its `pixel_pitch`, >= 0; `expose` spreads the light so, with
        the sum of the kernel as 1, and `invert` and `locate` compare with images that are spread so (Eq. M.38)
    veiling_glare : share of the film's light that is spread evenly over the film, in [0, 1); used as `psf` is

    `read_noise`, `gain`, `bias`, `dark_current` and `prnu` may each be the name of a map in place of a number: a FITS,
    TIFF or NPY file with the values on the pixels read out, row 0 at the top. A map for `prnu` is the response of each
    pixel, about 1, or its deviation from 1, about 0; `reduce` divides by it as by a flat field.

    Raises
    ------
    DetectorError : a parameter is no number or outside its range, or a map or the kernel cannot be read.
    """

    @classmethod
    def typical_ccd(cls) -> Detector:
        """Cooled back-illuminated 2048² CCD with 13.5 µm pixels; typical values, not those of a data sheet."""
        return cls(
            quantum_efficiency=0.85,
            dark_current=1e-3,
            read_noise=3.5,
            full_well=1e5,
            gain=1.6,
            bias=500,
            bits=16,
            pixel_pitch=0.0135,
            name=TYPICAL,
        )

    @classmethod
    def typical_emccd(cls) -> Detector:
        """Cooled back-illuminated 1024² EMCCD with 13 µm pixels at a gain of 300; typical values, no data sheet.

        F² = 2 and the gamma law of the register: Robbins and Hadwen, IEEE Trans. Electron Devices 50, 1227 (2003);
        Basden et al., Mon. Not. R. Astron. Soc. 345, 985 (2003). Spurious charge: the range of 1e-3 to 1e-2 e-/px/frame
        in Daigle et al., Publ. Astron. Soc. Pac. 121, 866 (2009). Read noise, of tens of electrons at MHz pixel rates,
        and a register that holds several times the pixel's well are usual for sensors of this kind.
        """
        return cls(
            quantum_efficiency=0.9,
            dark_current=5e-4,
            read_noise=60.0,
            full_well=4e5,
            gain=8.0,
            bias=200,
            bits=16,
            pixel_pitch=0.013,
            name=TYPICAL,
            em_gain=300,
            spurious_charge=2e-3,
        )

    @classmethod
    def typical_scmos(cls) -> Detector:
        """Cooled 2048² sCMOS with 6.5 µm pixels; typical values, no data sheet.

        Read noise, gain, bias and well are of the size that Huang et al., Nat. Methods 10, 653 (2013), found on such a
        camera, where the read noise differs from pixel to pixel: give maps for one. A PRNU below 1 % is what EMVA 1288
        reports of such sensors state.
        """
        return cls(
            quantum_efficiency=0.82,
            dark_current=0.06,
            read_noise=1.6,
            full_well=3e4,
            gain=0.46,
            bias=100,
            bits=16,
            pixel_pitch=0.0065,
            name=TYPICAL,
            prnu=0.005,
        )

    def reduce(
        self,
        counts: Frame,
        *,
        exposure_time: float,
        wavelength_nm: float | None = None,
        spectrum: Spectrum | None = None,
        binning: int | None = None,
        pixel_pitch: float | None = None,
        frames: int | None = None,
        bias: Frame | None = None,
        dark: Frame | float | None = None,
        flat: Frame | None = None,
        flat_kind: str | None = None,
        flat_dark: Frame | float | None = None,
        scene: Scene | None = None,
        bad_pixels: Frame | None = None,
        cosmic_rays: bool = False,
        metadata: Metadata | None = None,
    ) -> Image:
        """Image in W from raw counts, with its standard error and a mask of saturated pixels; see docs/images.md.

        Parameters
        ----------
        counts : (h, w) or (frames, h, w) [DN], or the name of a .tif, .fits, .npy file or of a click folder
        exposure_time : [s] of one frame, > 0
        wavelength_nm, spectrum : of the light at the detector, see `expose`; neither: that in `metadata`, or that
            which the lens of `scene` passes
        binning : side of the square of pixels that was read out as one; None: that of the file, of `metadata`, or 1
        pixel_pitch : of the pixels read out [mm]; with it, `invert` can check that the image fits the scene;
            None: that of the file, if the detector has none of its own, else that of `metadata`
        frames : number of frames that counts (h, w) are the mean of; None: 1; of a stack, its length
        bias, dark : frames or stacks [DN] in place of `bias` and `dark_current`; `dark` contains the bias, and may be a
            number
        flat, flat_kind : frame or stack [DN] of a uniform light, 'lens' through the lens of `scene`, or 'sensor'
            without a lens (Eq. M.36); the noise of a stack, not that of a single frame, enters the errors
        flat_dark : number, frame or stack [DN] to subtract from the flat; None: the bias, from unsigned integers alone
        scene : for 'lens': what `render` takes, with the camera's lens, film and crop window
        bad_pixels : (h, w) or its file, not 0 for pixels to mask
        cosmic_rays : also mask pixels that cosmic rays have hit
        metadata : further entries, such as those of the rendered image; pitch and place become those of the counts

        The image contains its noise as a function of the light (Eq. M.24). The metadata hold, for electrons before the
        register, `electrons_per_watt`, `read_noise` [e-], `dark_electrons` (variance of dark current, spurious charge,
        rounding and subtracted frames [e-²]), `excess_noise`, `prnu` and `gain_error`; of a subtracted frame
        `frame_digest` and its part of the noise without light, `frame_share` or, where that is not the same on all
        pixels, `frame_electrons` [e-²]; of a flat field `flat_digest`. A pixel where `flat` is f has f times
        `electrons_per_watt`. Planes are `flat`, `flat_error` and, with maps, `dark_noise`.

        Raises
        ------
        DetectorError : a parameter outside its range, frames that do not fit, a flat without its kind.
        ImageError : a file cannot be read, or a stack has the shape (h, w, frames).
        SceneError, OpticsError, BackendError : the scene has no usable lens; a package is not installed.
        """
        through = scene if flat is not None and flat_kind == "lens" else None
        light = light_of(metadata or {}, through, wavelength_nm, spectrum)
        exposed = Exposed(exposure_time, light, binning, pixel_pitch)
        corrections = Corrections(bias, dark, flat, flat_kind, flat_dark, scene, bad_pixels, cosmic_rays)
        return reduce_counts(self, counts, exposed, corrections, frames=frames, metadata=metadata)

    def expected(
        self,
        image: Image,
        exposure_time: float,
        wavelength_nm: float | None = None,
        *,
        spectrum: Spectrum | None = None,
        binning: int = 1,
    ) -> Expectation:
        """Mean and variance of the electrons that `expose` draws, after the register, before the full well limits them.

        Parameters and errors as for `expose`.
        """
        light = self._light(image, wavelength_nm, spectrum)
        charge = self._charge(image, _time(exposure_time), light, _whole("binning", binning))
        noise = np.square(self.on_pixels("read_noise", charge.shape))
        return Expectation(self.em_gain * charge, self.em_gain**2 * self.excess * charge + noise)

    def _light(self, image: Image, wavelength_nm: object, spectrum: Spectrum | None) -> Light:
        """The light of an image, given or its own; raises as `expose`."""
        given = Light.given(wavelength_nm, spectrum, DetectorError, "detector")
        if not isinstance(image, Image):
            raise DetectorError(
                f"detector: must be given an image, got {type(image).__name__}. Give fspt.Image(power)."
            )
        return Light.of_image(image.metadata, given)

    def _charge(self, image: Image, exposure_time: float, light: Light, binning: int) -> Array:
        """Mean charge of each pixel read out before the register, (h, w) [e-]."""
        if (darkest := image.power.min()) < 0:
            raise DetectorError(f"detector: power must be >= 0 on every pixel, got {darkest:g} W. Render it again.")
        if image.mask is not None and image.mask.any():
            LOG.warning("fspt: expose: %d masked pixels have no known power; they get no light.", image.mask.sum())
        power = self._with_stray_light(image)
        electrons = _binned(power * (exposure_time * self.electrons_per_joule(light)), binning)
        pitch = _pitch(image)
        area = self.area(None if pitch is None else pitch * binning, binning)
        dark = self.on_pixels("dark_current", electrons.shape) * exposure_time
        return self._drawn_response(electrons.shape, area) * electrons + (dark + self.spurious_charge) * area

    def _with_stray_light(self, image: Image) -> Array:
        """Power on the film (h, w) [W] with the detector's stray light, unless the image has it already (Eq. M.38)."""
        power = image.power.astype(np.float64)
        if not self.stray_light:
            return power
        own = StrayLight.of(image.metadata, image.shape)
        if not own:
            tell_part("expose", image.metadata, image.shape)
            return np.maximum(self.stray_light.on(_pitch(image)).forward(power), 0)
        if not own.same(self.stray_light):
            raise DetectorError(
                "detector: the image has the stray light of another detector already, 'psf' or 'veiling_glare' of its "
                "metadata. Give the image as it was rendered."
            )
        LOG.warning("fspt: expose: the image has the detector's stray light already; it is not applied again.")
        return power

    def _drawn_response(self, shape: tuple[int, ...], area: float) -> Array | float:
        """Response of the pixels read out (h, w), each of `area` own ones: the map, or drawn from the number `prnu`."""
        known = self.response(shape)
        if known is not None:
            return known
        deviation = float(self.prnu) / math.sqrt(max(area, 1.0))
        if not deviation:
            return 1.0
        return 1 + deviation * np.random.default_rng(zlib.crc32(self.name.encode())).standard_normal(shape)

    def _multiplied(self, charge: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """Electrons after the register of a `charge` before it, (h, w) [e-] (Eq. M.37)."""
        surplus = self.excess - 1
        if not surplus:
            return self.em_gain * charge.astype(np.float64)
        return rng.gamma(charge / surplus, self.em_gain * surplus)

    def expose(
        self,
        image: Image,
        exposure_time: float,
        wavelength_nm: float | None = None,
        *,
        spectrum: Spectrum | None = None,
        binning: int = 1,
        seed: int = 0,
    ) -> Exposure:
        """One exposure of the detector to an image; the same seed gives bit-identical results.

        Parameters
        ----------
        image : power [W], shape (h, w); masked pixels get no light, and a line says so
        exposure_time : [s], 0 … 1e12 (0 gives a bias frame)
        wavelength_nm : of the light in vacuum [nm], 200 … 2500
        spectrum : of the light at the detector in its place, a CSV file of nm, relative power per nm, ascending. None
            of both: the light of the image, whose lens has a filter
        binning : side of the square of pixels whose charge is summed before read-out, a divisor of h and w
        seed : of the shot and read noise and of the register, 0 … 2⁵³

        Raises
        ------
        DetectorError : a parameter is outside its range, `wavelength_nm` and `spectrum` are both given, a map is not of
            the pixels read out, the curve of the quantum efficiency does not cover the light, or the binning does not
            divide the image.
        ImageError : the image was rendered for another light, or has none and none is given.
        """
        exposure_time, light = _time(exposure_time), self._light(image, wavelength_nm, spectrum)
        seed, binning = _whole("seed", seed), _whole("binning", binning)
        if not 0 <= seed <= 1 << 53:  # an EXR stores integers as doubles, which hold no larger one exactly
            raise DetectorError(
                f"detector: 'seed' must be finite and >= 0 and at most 2^53, for example 1, got {seed}."
            )
        rng = np.random.default_rng(seed)
        mean = self._charge(image, exposure_time, light, binning)
        # A mean this far above the full well saturates with certainty. NumPy cannot draw Poisson numbers above 9e18.
        charge = self._multiplied(rng.poisson(np.minimum(mean, 2 * self.full_well + 1e6)), rng)
        noise = rng.normal(0.0, self.on_pixels("read_noise", mean.shape), mean.shape)
        electrons = np.minimum(charge + noise, self.full_well)
        full = electrons >= self.full_well
        electrons = electrons.astype(np.float32)  # the counts follow from the values that the EXR holds
        top = 2**self.bits - 1
        levels = self.on_pixels("bias", mean.shape) + electrons / np.float64(self.on_pixels("gain", mean.shape))
        counts = np.clip(np.rint(levels), 0, top)
        metadata = image.metadata | {
            "quantity": "electrons",
            "unit": "e-",
            "detector": self.name,
            "exposure_time": exposure_time,
            "binning": binning,
            "detector_seed": seed,
            "saturated_pixels": int(np.sum(full | (counts >= top))),
        }
        metadata |= light.metadata() | self._recorded(light) | self.stray_light.recorded(counts.shape)
        return Exposure(electrons, counts.astype(np.uint16), metadata | binned_pixels(image.metadata, binning))

    def _recorded(self, light: Light) -> Metadata:
        """Parameters as entries of an exposure's metadata: numbers, of maps the mean with path and digest.

        The quantum efficiency is that for this light: electrons over photons.
        """
        found: Metadata = {}
        for name, key in RECORDED.items():
            if name == "quantum_efficiency":
                found[key] = self.electrons_per_joule(light) / light.photons_per_joule
            elif name in self.maps:
                found |= {key: self.mean(name), **self.maps[name].recorded(key)}
            elif getattr(self, name) is not None:
                found[key] = getattr(self, name)
        register = {} if self.em_gain > 1 else {"em_gain": 1.0, "excess_noise": 1.0}
        unused = register | {"spurious_charge": 0.0, "prnu": 0.0}
        found = {key: value for key, value in found.items() if unused.get(key) != value}
        return found | ({"gain_error": self.gain_error} if self.gain_error else {})


def _binned(charge: NDArray[np.float64], binning: int) -> NDArray[np.float64]:
    """Sums over squares of `binning` × `binning` pixels, shape (h/binning, w/binning)."""
    height, width = charge.shape
    if binning < 1 or height % binning or width % binning:
        raise DetectorError(
            f"detector: 'binning' = {binning} does not divide the image of {width} × {height} pixels. "
            f"Give a divisor of {math.gcd(height, width)}."
        )
    blocks = charge.reshape(height // binning, binning, width // binning, binning)
    return blocks.sum(axis=(1, 3))


def _pitch(image: Image) -> float | None:
    """Side of the image's pixels [mm], None if unknown."""
    return recorded_positive(image.metadata, "pixel_pitch")


def _time(exposure_time: float) -> float:
    """As a float, or DetectorError. The bound keeps photons per watt finite: 0 W times infinity would be NaN."""
    time = number("detector: 'exposure_time'", exposure_time, DetectorError, "60")
    if not 0 <= time <= 1e12:
        raise DetectorError(f"detector: 'exposure_time' must be finite and in 0 … 1e12 s, for example 60, got {time}.")
    return time


def _whole(name: str, value: int) -> int:
    return whole(f"detector: '{name}'", value, DetectorError, "1")
