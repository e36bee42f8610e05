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
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from ..images.exposure import Exposure
from ..images.image import Image
from ..runtime.errors import InversionError, renamed
from ..runtime.numbers import number, whole
from ..runtime.progress_bar import Progress, reported
from ..runtime.stderr_lines import told
from ..tissue.diffusion import Tissue
from ..tissue.elements import Elements
from ..tissue.phantom_file import PhantomFile, Spread
from .band_images import BandImages
from .band_light import tell_bands
from .extent import SHAPES, Profile, with_radii
from .location import Intervals, Location
from .measurement import Measurement, tell_misfit
from .optics_fit import OpticsFit, unknowns
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
    shape: str = "point",
    sampled: bool = False,
    confidence: float = 0.9,
    scene: object = None,
    progress: Progress | None = None,
    settings: LocationSettings | None = None,
) -> Location:
    """Positions and powers of sources inside a phantom, and a source density, from images of its surface.

        S = fspt.locate("phantom.toml", T, images)
        S.sources[0].position, S.sources[0].position_interval  # mm, in the frame of phantom.toml

    The intervals contain the noise of the images, errors of the matrix and of SP3 or diffusion itself (M.51),
    `gain_error`, and errors of coefficients that the phantom file states (`mua_sd`, …), which are fitted along; not
    those of shape, inclusions left out, pose, lens, of which `warnings` tell what the residuals show (M.34).

    Parameters
    ----------
    phantom : TOML file of `fspt flux solve`, or a PhantomFile: shape, coefficients, mesh; its sources are not used
    matrix : of `transport` or `read_transport`, for the surface of this phantom. The mesh in the scene's PLY file,
        before `to_world`, is in the frame of the phantom file, as `fspt flux solve` writes it.
    images : one Image, Exposure or name of a file of either per view, in the order of the views; or an array of powers
        (views, h, w) [W] together with `error`
    sources : number of sources, 1 … 20
    shape : "point", or "sphere": they glow uniformly, with a fitted `radius`, whose interval starts at 0 where the
        images show an upper limit only
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
    FluxError, BackendError : the phantom file cannot be used, or lacks the band; scikit-fem or the mesher is missing.
    """
    options = _checked(sources, shape, confidence, settings, gain_per_view, band_correlation)
    given = _given(matrix, images, error, mask)
    described = _described(phantom)
    with reported(progress) as report:
        bands = _band_images(described, given, gain_error, sampled, scene, report)
        fit = SourceFit(bands, options.settings, report, *options.gains)
        return _located(fit, [described.band(one.name).spreads for one in given], options, report)


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


@dataclass(frozen=True)
class _Options:
    """Number of sources, whether they are spheres, confidence, accuracy, `gain_per_view` and `band_correlation`."""

    count: int
    spheres: bool
    confidence: float
    settings: LocationSettings
    gains: tuple[float, float]

    @property
    def numbers(self) -> int:
        """Of a source."""
        return 5 if self.spheres else 4


def _checked(
    sources: int,
    shape: object,
    confidence: float,
    settings: LocationSettings | None,
    gain_per_view: float,
    band_correlation: float,
) -> _Options:
    """The options; raises InversionError where one is outside its range."""
    count = whole("locate: 'sources'", sources, InversionError, "1")
    if not 1 <= count <= MOST_SOURCES:
        raise InversionError(f"locate: 'sources' must be in 1 … {MOST_SOURCES}, got {count}. Give their number.")
    if shape not in SHAPES:
        raise InversionError(
            f"locate: 'shape' must be one of {', '.join(SHAPES)}, got {shape!r}. Give \"sphere\" to fit a radius."
        )
    confidence = number("locate: 'confidence'", confidence, InversionError, "0.9")
    if not 0 < confidence < 1:
        raise InversionError(f"locate: 'confidence' must be in (0, 1), got {confidence:g}. Give for example 0.9.")
    if not isinstance(settings, (LocationSettings, NoneType)):
        raise InversionError(
            f"locate: 'settings' must be LocationSettings, got {type(settings).__name__}. Leave it out for the usual "
            "accuracy."
        )
    gains = checked_factor("locate", gain_per_view), _checked_correlation(band_correlation)
    return _Options(count, shape == "sphere", confidence, settings or LocationSettings(), gains)


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


def _located(fit: SourceFit, spreads: Sequence[Sequence[Spread]], options: _Options, report: Progress) -> Location:
    """Sources and density that fit the images of all bands."""
    count, numbers = options.count, options.numbers
    if len(fit.power) <= numbers * count:
        raise InversionError(
            f"locate: {len(fit.power)} pixels do not determine the {numbers * count} numbers of {count} sources. Give "
            "more pixels, or fewer sources."
        )
    report("first positions", 0.0)
    grid = SourceGrid.of(fit.bands)
    found, z = fit.best(grid, count), float(norm.ppf((1 + options.confidence) / 2))
    own = OpticsFit(fit, uncertain, report) if (uncertain := unknowns(spreads)) else None
    found = own.refined(found) if own else found
    profiles = list[Profile]()
    if options.spheres:
        found, profiles = with_radii(fit, found, z, report)
        if own:
            found, profiles = with_radii(fit, own.refined(found), z, report)
    order = np.argsort(-found.powers, kind="stable")
    found, extents = found.sorted(), [profiles[k].extent() for k in order] if profiles else None
    noise = fit.covariance(found)
    covariance = noise + fit.by_model(found, noise) + fit.by_common(found, noise)
    linear = fit.is_linear(found, noise, z)
    p_values = fit.p_values(found, len(grid.inner), numbers)
    _tell(linear, p_values, count, options.settings)
    power = fit.power / fit.factors(found)[fit.view]
    density = replace(grid, sigma=found.sigma, power=power).density(report)
    warnings = list(dict.fromkeys(line for band in fit.bands for line in band.warnings))
    warnings += tell_misfit("locate", found.cost, len(fit.power), numbers * count, fit.noise(found))
    warnings += told("locate", fit.structure(found).lines())
    optics = own.coefficients(found) if own else {}
    intervals = Intervals(covariance, z, options.confidence, linear, p_values, extents)
    return Location.of(fit, found, intervals, density, warnings, optics)


def _tell(linear: bool, p_values: NDArray[np.float64], count: int, settings: LocationSettings) -> None:
    """Say in a line each where intervals may be too narrow, and which sources the images do not show."""
    if not linear:
        LOG.warning(
            "fspt: locate: the intervals are those of a linear approximation, which does not hold for changes as "
            "large; they may be too narrow. Give fewer sources, or images with less noise."
        )
    for k in np.flatnonzero(p_values > settings.chance):
        LOG.warning(
            "fspt: locate: the images do not show that source %d is there, noise alone may look like it (p = %.2g). "
            "%s images with less noise.",
            k + 1,
            p_values[k],
            "Give fewer sources, or" if count > 1 else "Give",
        )


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
    tell_bands(
        "locate",
        {one.name: measurement.light_nm for one, (_, measurement, _) in zip(given, read, strict=True)},
        {name: band.wavelength_nm for name, band in described.bands.items()},
    )
    report("tissue", 0.0)
    mesh = described.checked_mesh()
    if described.bands and any(one.name is None for one in given):
        LOG.warning(
            "fspt: locate: no band is given, of the phantom file's %s: the powers are those in these images, with the "
            "coefficients of [optical]. Give the band, where images are of one.",
            ", ".join(described.bands),
        )
    bands, elements = [], Elements(mesh, described.order).assembled()
    for one, (surface, measurement, optics) in zip(given, read, strict=True):
        tissue = Tissue(
            mesh,
            optics.media,
            model=described.model,
            a=described.a,
            order=described.order,
            repeated=True,
            elements=elements,
        )
        with renamed("locate", one.label):
            bands.append(BandImages.of(one.name, measurement.matrix, surface, measurement, tissue, optics.share))
    return bands
