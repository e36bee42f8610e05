"""Image of a camera: power [W] on every pixel, its error and coverage, and metadata."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..optics.light import Light, Spectrum
from ..runtime.errors import ImageError
from ..runtime.numbers import number
from .crop_window import cropped
from .formats import BESIDE, Metadata, read_planes, write_planes
from .image_data import ImageData
from .image_sum import combined
from .pixel_axes import PixelAxes
from .recorded_number import recorded_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import DataArray, Dataset

    from .exposure import Exposure
    from .regions import Measurement


class Exposes(Protocol):
    """What exposes itself to an image: a `Detector`."""

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
        """One exposure; see `Detector.expose`."""
        ...


class Image(ImageData):
    """Power on the pixels of a detector; row 0 is the top of the upright picture.

    Parameters
    ----------
    power : array, shape (h, w) [W], power on each pixel
    error : array, shape (h, w) [W], estimated absolute error of the power (Monte Carlo: standard error), or None
    coverage : array, shape (h, w), unweighted share in [0, 1] of a pixel's lines of sight that reach a shape with
        `fspt_surface`, or None
    metadata : text and numbers that record the origin of the image; `quantity` and `unit` are added
    mask : bool array, shape (h, w), True for pixels to leave out, such as saturated ones, or None
    flat : array, shape (h, w), > 0: electrons per watt of each pixel relative to `electrons_per_watt`, of an image that
        `Detector.reduce` corrected by a flat field, or None
    flat_error : array, shape (h, w), >= 0: relative standard error of `flat`, or None
    dark_noise : array, shape (h, w), >= 0 [e-]: standard deviation of a pixel without light, of an image whose
        detector has another one on each pixel; None: `read_noise` and `dark_electrons` of the metadata, if it has them

    The arrays are stored as read-only copies with at least 32-bit floats. What a masked array of NumPy hides is masked.

    Raises
    ------
    ImageError : an array is not of shape (h, w), the shapes differ, a value is NaN or infinite, an error negative, an
        array of xarray not upright, or the metadata name another quantity or unit than power in W.
    """

    def __repr__(self) -> str:
        height, width = self.shape
        total = self.total_power
        error = "unknown" if self.error is None else f"at most {self.error.max(initial=0.0):.3g} W a pixel"
        masked = f", {self.masked} masked" if self.masked else ""
        return f"Image({width} x {height} pixels{masked}, {total:.6g} W in all, error {error})"

    @property
    def x(self) -> NDArray[np.float64]:
        """Centres of the columns (w,) [mm] on the virtual detector plane, to the right from the optical axis.

        On the detector if the metadata have no `magnification`. Raises ImageError if they have no `pixel_pitch`.
        """
        return self._axes().x

    @property
    def y(self) -> NDArray[np.float64]:
        """Centres of the rows (h,) [mm], upwards from the optical axis, the top row first; otherwise as `x`."""
        return self._axes().y

    def _axes(self) -> PixelAxes:
        axes = PixelAxes.of(self.shape, self.metadata)
        if axes.side is None:
            raise ImageError(
                "image: x and y are unknown, its metadata have no 'pixel_pitch'. Give it, in mm: "
                "fspt.Image(power, metadata={'pixel_pitch': 0.0135})."
            )
        return axes

    def scaled(self, source_power: float) -> Image:
        """Image of the same scene with a light source of `source_power` [W], if this one is for a source of 1 W.

        Power and error are multiplied by `source_power`; the coverage stays. The metadata record it as `source_power`.
        For a measured image, `electrons_per_watt` is divided by it, so that the electrons do not change.

        Raises
        ------
        ImageError : `source_power` is not finite and > 0, or the metadata hold a `source_power` already.
        """
        watt = required_source_power(source_power)
        if "source_power" in self.metadata:
            raise ImageError(
                f"image: 'source_power' is {self.metadata['source_power']} W already, got {watt:g} W. "
                "Leave it out, or render the image without it."
            )
        error = None if self.error is None else self.error.astype(np.float64) * watt
        metadata = self.metadata | {"source_power": watt}
        if metadata.get("electrons_per_watt") is not None:
            metadata["electrons_per_watt"] = recorded_number(metadata, "electrons_per_watt", math.nan) / watt
        return replace(self, power=self.power.astype(np.float64) * watt, error=error, metadata=metadata)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[np.floating]:
        """The power, shape (h, w) [W], for `np.asarray(image)`; read-only unless it is a copy."""
        return np.array(self.power, dtype=dtype, copy=copy)  # None: if needed

    def __getitem__(self, window: slice | tuple[slice, ...]) -> Image:
        """Part of the image, `image[top:bottom, left:right]`, with all its planes.

        The metadata state it as a crop window of the film (`film_width`, `crop_offset_x`, …), so that `x`, `y` and the
        étendue of its pixels stay those of the whole image. Raises ImageError for steps, single pixels and no pixels.
        """
        return cropped(self, window)

    def __add__(self, other: object) -> Image:
        """Power of both images, pixel by pixel, with its error.

        Standard errors add up in squares, but for noise that two reduced images have in common, by the response of
        their pixels or by one frame subtracted from both, which adds up itself; the integral's, which are bounds, add
        up. Of the metadata, entries remain that both have. The sum of two measured images of one detector with the
        same `electrons_per_watt` keeps it, with the read noise of both. The larger `gain_error` remains, an upper
        bound. What one of them masks is masked.

        Raises
        ------
        ImageError : the images have other pixels.
        """
        return self._combined(other, 1)

    def __sub__(self, other: object) -> Image:
        """Power of this image less that of the other; errors add up and metadata remain as in a sum; noise in
        common cancels, that of the response where both images name the same detector.

        A `gain_error` remains if both images name the same detector and have the same one. Others, times the power of
        their image, are part of the errors.
        """
        return self._combined(other, -1)

    def _combined(self, other: object, sign: int) -> Image:
        return combined(self, other, sign) if isinstance(other, Image) else NotImplemented

    def roi(
        self,
        region: str | os.PathLike[str] | NDArray[np.bool_] | None = None,
        wavelength_nm: float | None = None,
        *,
        spectrum: Spectrum | None = None,
    ) -> Measurement:
        """Radiometric quantities of the light from a region, as `fspt roi` prints them.

        Parameters
        ----------
        region : mask (h, w), or text 'x,y,width,height', 'circle:x,y,radius', '25%' or the name of a TIFF; None: all
        wavelength_nm, spectrum : of the light, see `to_radiance`

        Raises
        ------
        ImageError : there is no such region, all its pixels are masked, or lens or light are unknown.
        """
        from .regions import measure

        return measure(self, region, Light.given(wavelength_nm, spectrum))

    def expose(
        self,
        detector: Exposes,
        exposure_time: float,
        wavelength_nm: float | None = None,
        *,
        spectrum: Spectrum | None = None,
        binning: int = 1,
        seed: int = 0,
    ) -> Exposure:
        """Electrons and counts of one exposure of `detector`, a `Detector`, to this image; see `Detector.expose`."""
        return detector.expose(self, exposure_time, wavelength_nm, spectrum=spectrum, binning=binning, seed=seed)

    def to_radiance(self, wavelength_nm: float | None = None, *, spectrum: Spectrum | None = None) -> DataArray:
        """Apparent radiance [photons/s/cm²/sr] of a surface in focus, a DataArray with dimensions (y, x).

        P/(τ G ⟨cos⁴θ⟩) of every pixel, with its étendue and the transmittance τ of the lens (Eq. M.6); 0 where no light
        passes, NaN on masked pixels. `error` and `coverage` are coordinates, x and y are as of `to_xarray`.

        Parameters
        ----------
        wavelength_nm : of the light [nm]
        spectrum : of the light at the detector in its place, a CSV file of nm, relative power per nm. None of both:
            those of the image, if its lens has a filter

        Raises
        ------
        ImageError : the metadata lack the lens or the light, or both are given.
        BackendError : xarray is not installed.
        """
        from .labelled import radiance_array

        return radiance_array(self, Light.given(wavelength_nm, spectrum))

    def to_xarray(self, wavelength_nm: float | None = None, *, spectrum: Spectrum | None = None) -> Dataset:
        """Dataset of `power`, `error` and `coverage`, dimensions (y, x), with `units` and the metadata as attributes.

        Coordinates are the pixels' centres [mm] on the virtual detector plane, x to the right and y up: the first row
        has the largest y. Masked pixels are NaN. With a wavelength [nm] or a spectrum of the light, see `to_radiance`,
        there is also `photon_rate` [photons/s].

        Raises
        ------
        ImageError : another light than that of the image.
        BackendError : xarray is not installed.
        """
        from .labelled import dataset

        return dataset(self, Light.given(wavelength_nm, spectrum))

    def plot(
        self,
        axes: Axes | None = None,
        *,
        log: bool = False,
        limits: tuple[float, float] | None = None,
        outline: bool = False,
        unit: str = "W",
        wavelength_nm: float | None = None,
        spectrum: Spectrum | None = None,
    ) -> Axes:
        """Draw the picture that `--png` writes, with colour bar and axes in mm; returns matplotlib's axes.

        Parameters
        ----------
        axes : to draw into; None: those of a new figure of pyplot
        log, limits : of the colour scale, limits in the unit that is shown; see `ColourScale.over`
        outline : draw the silhouette of the phantom, where the coverage is 1/2
        unit : 'W', 'photons/s' or 'p/s/cm2/sr'
        wavelength_nm, spectrum : of the light, for the units with photons, see `to_radiance`

        Raises
        ------
        ImageError : the limits are no range, the image has no coverage for the outline, or cannot be shown in this
            unit.
        BackendError : matplotlib is not installed.
        """
        from .picture import plot_image

        light = Light.given(wavelength_nm, spectrum)
        return plot_image(self, axes, log=log, limits=limits, outline=outline, unit=unit, light=light)

    def plot_profile(self, row: int | None = None, column: int | None = None, axes: Axes | None = None) -> Axes:
        """Draw the power along a row or a column, with a band of ± error; returns matplotlib's axes.

        Parameters
        ----------
        row, column : number of one of them, from 0 at the top or left; None: the row through the brightest pixel
        axes : to draw into; None: those of a new figure of pyplot

        Raises
        ------
        ImageError : both are given, or the row or column does not exist.
        BackendError : matplotlib is not installed.
        """
        from .picture import plot_profile

        return plot_profile(self, row, column, axes)

    def _repr_png_(self) -> bytes | None:
        """Picture for notebooks; None without matplotlib."""
        from .notebook import image_png

        return image_png(self)

    def _repr_html_(self) -> str:
        """Numbers and picture for notebooks."""
        from .notebook import image_html

        return image_html(self)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a file of float32 planes and all metadata; its suffix chooses the format, see docs/images.md.

        .exr has the channels `Y`, `error.Y`, `coverage.Y`, `mask.Y`, `flat.Y`, `flat_error.Y` and `dark_noise.Y`, as
        far as the image has them, and metadata under `fspt:`; .tif, .h5, .npz and .fits hold the same.
        The file is written completely or not at all. Pixels below 1e-38 W, the smallest float32, may become 0; an image
        whose brightest pixel lies below it is refused.

        Raises
        ------
        ImageError : no format has the suffix, a value does not fit into float32, or the file cannot be written.
        BackendError : the format needs a package that is not installed.
        """
        peak = max(self.power.max(), -self.power.min())
        if 0 < peak < np.finfo(np.float32).tiny:
            raise ImageError(
                f"image: the brightest pixel has {peak:g} W, below what the file can hold (1.2e-38 W). "
                "Scale the exitance up."
            )
        planes = {name: getattr(self, name) for name in ("power", *BESIDE)}
        planes["mask"] = None if self.mask is None else self.mask.astype(np.float32)
        write_planes(path, {name: p for name, p in planes.items() if p is not None}, self.metadata)


def read(path: str | os.PathLike[str]) -> Image:
    """Image from a file that `Image.write` wrote, or from any EXR file with a channel `Y`, which is taken as power [W].

    Planes that the file does not have, such as `error`, `coverage` or `mask`, are None.

    Raises
    ------
    ImageError : the file does not exist, has the suffix of no format, is damaged, is that of another program, has no
        power, or holds values that are not finite or that are not power by its metadata.
    BackendError : the format needs a package that is not installed.
    """
    return image_of(path, *read_planes(path))


def read_image_or_exposure(path: str | os.PathLike[str]) -> Image | Exposure:
    """Image [W] or exposure [e-] from a file that fspt wrote. Raises as `read` and `image_or_exposure`."""
    return image_or_exposure(path, *read_planes(path))


def image_or_exposure(
    path: str | os.PathLike[str], planes: Mapping[str, NDArray], metadata: Metadata
) -> Image | Exposure:
    """What the planes and metadata of a file are: an image in W, or electrons, whose counts follow from the detector.

    Raises
    ------
    ImageError : neither, or values that are not finite.
    DetectorError : the metadata of electrons lack a number of the detector.
    """
    from .exposure import exposure_of

    return exposure_of(path, planes, metadata) if "electrons" in planes else image_of(path, planes, metadata)


def image_of(path: str | os.PathLike[str], planes: Mapping[str, NDArray], metadata: Metadata) -> Image:
    """Image of the planes and metadata in a file; raises ImageError as `read`."""
    quantity = str(metadata.get("quantity", "power"))
    if quantity not in planes:
        raise ImageError(
            f"image file '{path}' has no plane of power in W ('Y' in an EXR), it has {', '.join(planes)}. Give a file "
            "that fspt wrote."
        )
    try:
        beside = {name: planes[name] for name in BESIDE if name in planes}
        if "mask" in beside:
            beside["mask"] = beside["mask"] != 0
        return Image(planes[quantity], metadata=metadata, **beside)
    except ImageError as cause:
        raise ImageError(f"image file '{path}': {cause}") from cause


def required_source_power(watt: float) -> float:
    """Power of a light source [W] as a float; ImageError unless it is finite and > 0."""
    found = number("image: 'source_power'", watt, ImageError, "1e-9")
    if not 0 < found < math.inf:
        raise ImageError(f"image: 'source_power' must be finite and > 0 W, got {found:g}. Give for example 1e-9.")
    return found
