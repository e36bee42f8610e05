"""`locate`: light sources inside a phantom, from images of its surface.

J_n of a point source is the solution of SP3 or of the diffusion equation (see `tissue.diffusion`), its image T J_n.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import NoneType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from ..images.exposure import Exposure
from ..images.image import Image
from ..runtime.errors import InversionError, renamed
from ..runtime.numbers import number, whole
from ..runtime.progress_bar import Progress, reported
from ..tissue.diffusion import Tissue
from ..tissue.phantom_file import PhantomFile, Spread
from .band_images import BandImages
from .location import Location
from .measurement import Measurement, tell_misfit, told
from .optics_fit import Coefficient, OpticsFit, unknowns
from .source_fit import LocationSettings, SourceFit
from .source_grid import SourceGrid
from .surface import Surface
from .transport_matrix import TransportMatrix
from .view_factors import checked_factor

Images: TypeAlias = (
    ArrayLike | Sequence[Image | Exposure | str | os.PathLike[str]] | Image | Exposure | os.PathLike[str]
)
MOST_SOURCES = 20
LOG = logging.getLogger("mitsuba_fspt")


def locate(
    phantom: PhantomFile | str | os.PathLike[str],
    matrix: TransportMatrix | Mapping[str, TransportMatrix],
    images: Images | Mapping[str, Images],
    /,
    *,
    sources: int = 1,
    error: ArrayLike | Mapping[str, ArrayLike] | None = None,
    mask: ArrayLike | Mapping[str, ArrayLike] | None = None,
    gain_error: float | None = None,
    gain_per_view: float = 0.0,
    band_correlation: float = 0.0,
    sampled: bool = False,
    confidence: float = 0.9,
    scene: object = None,
    progress: Progress | None = None,
    settings: LocationSettings | None = None,
) -> Location:
    """Positions and powers of point sources inside a phantom, and a source density, from images of its surface.

        S = fspt.locate("phantom.toml", T, images)
        S.sources[0].position, S.sources[0].position_interval  # mm, in the frame of phantom.toml

    The intervals contain the noise of the images, the numerical error of the matrix, `gain_error`, and errors of
    coefficients that the phantom file states (`mua_sd`, …), which are fitted along; not those of shape, inclusions left
    out, pose, lens, or of SP3 or diffusion itself, of which `warnings` tell what the residuals show (M.34).

    Parameters
    ----------
    phantom : TOML file of `fspt flux solve`, or a PhantomFile: shape, coefficients, mesh; its sources are not used
    matrix : of `transport` or `read_transport`, for the surface of this phantom. The mesh in the scene's PLY file,
        before `to_world`, is in the frame of the phantom file, as `fspt flux solve` writes it.
    images : one Image, Exposure or name of a file of either per view, in the order of the views; or an array of powers
        (views, h, w) [W] together with `error`
    sources : number of point sources, 1 … 20
    error, mask, gain_error, gain_per_view, sampled, scene : as in `invert`
    confidence, settings : of the intervals, in (0, 1); accuracy of the fit
    band_correlation : correlation of the bands' factors (`gain_error`), 0 … 1; 1: one factor common to all bands
    progress : function of the present step (text) and the share done (0 … 1); None: a bar in notebooks

    Images in several bands: `matrix` and `images`, and `error` and `mask` if given, are dictionaries with the names of
    the tables [bands.NAME] of the phantom file. `power` is that of all bands.

    Raises
    ------
    InversionError : an option outside its range, bands that differ, images without light or error, a surface that is
        not the phantom's border, sources that the images do not determine, or one too close to the border for the mesh.
    TransportError, DetectorError, ImageError : as in `invert`.
    FluxError : the phantom file cannot be used, or has no such band.
    BackendError : scikit-fem, or the mesher that the phantom needs, is missing.
    """
    count, confidence, accuracy = _checked(sources, confidence, settings)
    gains = checked_factor("locate", gain_per_view), _checked_correlation(band_correlation)
    given = _given(matrix, images, error, mask)
    described = _described(phantom)
    with reported(progress) as report:
        bands = _band_images(described, given, gain_error, sampled, scene, report)
        return _located(
            bands, [described.band(one.name).spreads for one in given], count, confidence, accuracy, gains, report
        )


@dataclass(frozen=True, eq=False)
class _Given:
    """Arguments for one band; `name` is None where there is only one, without a name."""

    name: str | None
    matrix: TransportMatrix
    images: Images
    error: ArrayLike | None
    mask: ArrayLike | None

    @property
    def label(self) -> str:
        """Beginning of messages."""
        return "locate" if self.name is None else f"locate, band '{self.name}'"


def _checked(sources: int, confidence: float, settings: LocationSettings | None) -> tuple[int, float, LocationSettings]:
    """Number of sources, confidence and accuracy; raises InversionError where one is outside its range."""
    count = whole("locate: 'sources'", sources, InversionError, "1")
    if not 1 <= count <= MOST_SOURCES:
        raise InversionError(f"locate: 'sources' must be in 1 … {MOST_SOURCES}, got {count}. Give their number.")
    confidence = number("locate: 'confidence'", confidence, InversionError, "0.9")
    if not 0 < confidence < 1:
        raise InversionError(f"locate: 'confidence' must be in (0, 1), got {confidence:g}. Give for example 0.9.")
    if not isinstance(settings, (LocationSettings, NoneType)):
        raise InversionError(
            f"locate: 'settings' must be LocationSettings, got {type(settings).__name__}. Leave it out for the usual "
            "accuracy."
        )
    return count, confidence, settings or LocationSettings()


def _checked_correlation(value: object) -> float:
    """The correlation of the bands' factors; InversionError where it is outside [0, 1]."""
    correlation = number("locate: 'band_correlation'", value, InversionError, "0.5")
    if not 0 <= correlation <= 1:
        raise InversionError(f"locate: 'band_correlation' must be in [0, 1], got {correlation:g}. Give for example 1.")
    return correlation


def _given(matrix: TransportMatrix | Mapping[str, TransportMatrix], images: Any, error: Any, mask: Any) -> list[_Given]:
    """Arguments of each band; raises InversionError where dictionaries and bands do not fit together."""
    others = {"images": images, "error": error, "mask": mask}
    if not isinstance(matrix, Mapping):
        for name, value in others.items():
            if isinstance(value, Mapping):
                raise InversionError(
                    f"locate: '{name}' is a dictionary, the matrix is not. Give the matrices as a dictionary by the "
                    "same names."
                )
        bands: dict[str | None, Any] = {None: matrix}
        others = {name: {None: value} for name, value in others.items()}
    else:
        bands = {name: one for name, one in matrix.items()}
        if not bands:
            raise InversionError("locate: no band is given. Give one matrix a band.")
        for name, value in others.items():
            if value is None and name != "images":
                others[name] = dict.fromkeys(bands)
            elif not isinstance(value, Mapping) or set(value) != set(bands):
                raise InversionError(
                    f"locate: '{name}' must be a dictionary of the bands {', '.join(map(str, bands))}, as the matrices "
                    f"are, got {', '.join(map(str, value)) if isinstance(value, Mapping) else type(value).__name__}."
                )
    for one in bands.values():
        if not isinstance(one, TransportMatrix):
            raise InversionError(
                f"locate: the second argument must be a transport matrix, got {type(one).__name__}. Make one with "
                "fspt.transport, or read one with fspt.read_transport."
            )
    return [_Given(name, one, *(value[name] for value in others.values())) for name, one in bands.items()]


def _located(
    bands: Sequence[BandImages],
    spreads: Sequence[Sequence[Spread]],
    count: int,
    confidence: float,
    settings: LocationSettings,
    gains: tuple[float, float],
    report: Progress,
) -> Location:
    """Sources and density that fit the images of all bands; `gains`: gain_per_view and band_correlation."""
    fit = SourceFit(bands, settings, report, gains[0])
    if len(fit.power) <= 4 * count:
        raise InversionError(
            f"locate: {len(fit.power)} pixels do not determine the {4 * count} numbers of {count} sources. Give more "
            "pixels, or fewer sources."
        )
    report("first positions", 0.0)
    grid = SourceGrid.of(bands)
    found, optics = fit.best(grid, count), dict[str, Coefficient]()
    if uncertain := unknowns(spreads):
        own = OpticsFit(fit, uncertain, report)
        found = own.refined(found)
        optics = own.coefficients(found)
    noise = fit.covariance(found)
    covariance, z = noise + fit.by_factors(found, noise, gains[1]), float(norm.ppf((1 + confidence) / 2))
    linear = fit.is_linear(found, noise, z)
    if not linear:
        LOG.warning(
            "fspt: locate: the intervals are those of a linear approximation, which does not hold for changes as "
            "large; they may be too narrow. Give fewer sources, or images with less noise."
        )
    p_values = fit.p_values(found, len(grid.inner))
    for k in np.flatnonzero(p_values > settings.chance):
        LOG.warning(
            "fspt: locate: the images do not show that source %d is there, noise alone may look like it (p = %.2g). "
            "%s images with less noise.",
            k + 1,
            p_values[k],
            "Give fewer sources, or" if count > 1 else "Give",
        )
    power = fit.power / fit.factors(found)[fit.view]
    density = replace(grid, sigma=found.sigma, power=power).density(report)
    warnings = tell_misfit("locate", found.cost, len(fit.power), 4 * count, fit.noise(found))
    warnings += told("locate", fit.structure(found).lines())
    return Location.of(fit, found, covariance, z, p_values, linear, density, confidence, warnings, optics)


def _described(phantom: object) -> PhantomFile:
    """The phantom; InversionError where it is neither a PhantomFile nor the name of a file."""
    if isinstance(phantom, PhantomFile):
        return phantom
    if not isinstance(phantom, (str, os.PathLike)):
        raise InversionError(
            f"locate: the phantom must be the name of a TOML file or a PhantomFile, got {type(phantom).__name__}. "
            "Give for example 'phantom.toml'."
        )
    return PhantomFile.read(phantom)


def _band_images(
    described: PhantomFile,
    given: Sequence[_Given],
    gain_error: float | None,
    sampled: bool,
    scene: object,
    report: Progress,
) -> list[BandImages]:
    """Images and tissue of each band, on the same tetrahedra."""
    report("images", 0.0)
    read = []
    for one in given:
        with renamed("invert", one.label):
            surface = Surface.of(one.matrix, scene)
            measurement = Measurement.of(one.matrix, one.images, one.error, one.mask, gain_error, sampled)
        read.append((surface, measurement, described.band(one.name)))
    report("tissue", 0.0)
    mesh = described.checked_mesh()
    if described.bands and any(one.name is None for one in given):
        LOG.warning(
            "fspt: locate: no band is given, of the phantom file's %s: the powers are those in these images, with the "
            "coefficients of [optical]. Give the band, where images are of one.",
            ", ".join(described.bands),
        )
    bands = []
    for one, (surface, measurement, optics) in zip(given, read, strict=True):
        tissue = Tissue(mesh, optics.media, model=described.model, a=described.a, order=described.order, repeated=True)
        with renamed("locate", one.label):
            bands.append(BandImages.of(one.name, measurement.matrix, surface, measurement, tissue, optics.share))
    return bands
