"""Result of `locate`: sources with their intervals, a density, and files of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.atomic_files import atomic_path
from ..runtime.errors import BackendError, InversionError
from ..tissue.tetrahedra import Tetrahedra
from .extent import Extent
from .optics_fit import Coefficient
from .source_fit import PointSources, SourceFit

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LocatedSource:
    """Point source, or sphere, that fits the images.

    Attributes
    ----------
    position : (3,) [mm], in the frame of the phantom file;  position_sd : (3,) standard deviations [mm]
    position_interval : (low, high), each (3,) [mm]
    power : [W];  power_sd : [W];  power_interval : (low, high) [W]
    p_value : probability, at most, that noise alone makes a source fit as well anywhere in the tissue
    radius : [mm] of a sphere; None where points were asked for
    radius_interval : (low, high) [mm]: low is 0 where the images show only the upper limit `high`, and `high` is the
        distance of the centre from the border where they exclude no sphere

    Intervals of a sphere contain all radii of the interval, and are not symmetric; the standard deviations are those of
    normal intervals of the same width.
    """

    position: Array
    position_sd: Array
    position_interval: tuple[Array, Array]
    power: float
    power_sd: float
    power_interval: tuple[float, float]
    p_value: float
    radius: float | None = None
    radius_interval: tuple[float, float] | None = None

    @classmethod
    def of(cls, values: Array, sd: Array, z: float, p_value: float, extent: Extent | None = None) -> LocatedSource:
        """Source of x, y, z and power (4,) and their sd (4,), with intervals of z sd to both sides, or of a sphere."""
        low, high = values - z * sd, values + z * sd
        if extent:
            low, high = np.minimum(low, extent.low), np.maximum(high, extent.high)
            sd = (high - low) / (2 * z)
        interval = (max(float(low[3]), 0.0), float(high[3]))
        found = cls(values[:3], sd[:3], (low[:3], high[:3]), float(values[3]), float(sd[3]), interval, float(p_value))
        return replace(found, radius=extent.radius, radius_interval=extent.interval) if extent else found

    def summary(self) -> dict[str, Any]:
        """All numbers by name, ready for JSON."""
        extent = {"radius": self.radius, "radius_interval": self.radius_interval and list(self.radius_interval)}
        return (extent if self.radius is not None else {}) | {
            "position": self.position.tolist(),
            "position_sd": self.position_sd.tolist(),
            "position_interval": [end.tolist() for end in self.position_interval],
            "power": self.power,
            "power_sd": self.power_sd,
            "power_interval": list(self.power_interval),
            "p_value": self.p_value,
        }


@dataclass(frozen=True, eq=False)
class Intervals:
    """What intervals of sources follow from: covariance (4K, 4K), standard deviations z to both sides, and notes.

    confidence, linear : as in `Location`;  p_values : (K,);  extents : of spheres, None of points
    """

    covariance: Array
    z: float
    confidence: float
    linear: bool
    p_values: Array
    extents: Sequence[Extent] | None = None


@dataclass(frozen=True, eq=False)
class Location:
    """Light sources inside a phantom, from images of its surface.

    Attributes
    ----------
    sources : point sources or spheres, the one of the largest power first
    covariance : (4K, 4K) of x, y, z [mm] and power [W] of the sources, in their order, for their radii (Eq. M.26)
    density : (V,) source density >= 0 [W/mm³] at the vertices of `mesh`
    mesh : tetrahedra of the phantom
    chi2 : Σ (residual/σ)² over the pixels less the parameters, 4 or 5 a source: about 1 where model and noise are right
    pixels : number of pixels fitted
    confidence : of the intervals
    linear : False where the intervals may be too narrow, since the images do not change linearly within them
    gain_error : relative uncertainty of a factor common to the images of a band, contained in the intervals
    measured, fitted, sigma : (views, height, width) [W], NaN where masked or outside the surface; by the names of the
        bands where the images were given so
    residual : (measured − fitted)/sigma, in the same form
    gain_per_view : relative standard deviation of a factor of each view, fitted as well and contained in the intervals
    view_factors : (views,) these factors, of all bands one after the other; `fitted` contains them
    optics : uncertain coefficients by name, such as "mua", "red.mua", "regions.0.mua", with `value` and `sd`
    warnings : lines of stderr on what the residuals say of the model and of the stated errors
    """

    sources: tuple[LocatedSource, ...]
    covariance: Array
    density: Array
    mesh: Tetrahedra
    chi2: float
    pixels: int
    confidence: float
    linear: bool
    gain_error: float
    measured: Array | dict[str, Array]
    fitted: Array | dict[str, Array]
    sigma: Array | dict[str, Array]
    residual: Array | dict[str, Array]
    gain_per_view: float
    view_factors: Array
    warnings: tuple[str, ...] = ()
    optics: Mapping[str, Coefficient] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        fit: SourceFit,
        found: PointSources,
        intervals: Intervals,
        density: Array,
        warnings: Sequence[str] = (),
        optics: Mapping[str, Coefficient] | None = None,
    ) -> Location:
        """Result of a fit."""
        sd = np.sqrt(np.diag(intervals.covariance)).reshape(-1, 4)
        extents: Sequence[Extent | None] = intervals.extents or [None] * len(sd)
        each = zip(found.values.reshape(-1, 4), sd, intervals.p_values, extents, strict=True)
        numbers = found.values.size + (len(sd) if intervals.extents else 0)
        return cls(
            sources=tuple(LocatedSource.of(v, one, intervals.z, p, extent) for v, one, p, extent in each),
            covariance=intervals.covariance,
            density=density,
            mesh=fit.bands[0].tissue.mesh,
            chi2=found.cost / max(len(fit.power) - numbers, 1),
            pixels=len(fit.power),
            confidence=intervals.confidence,
            linear=intervals.linear,
            gain_error=max(band.measurement.gain_error for band in fit.bands),
            measured=fit.images(fit.power),
            fitted=fit.images(fit.fitted(found)),
            sigma=fit.images(found.sigma),
            residual=fit.images((fit.power - fit.fitted(found)) / found.sigma),
            gain_per_view=fit.gain_per_view,
            view_factors=fit.factors(found),
            warnings=tuple(warnings),
            optics=optics or {},
        )

    def summary(self) -> dict[str, Any]:
        """Numbers about the result by name, ready for JSON."""
        return {
            "sources": [source.summary() for source in self.sources],
            "length_unit": "mm",
            "power_unit": "W",
            "confidence": self.confidence,
            "linear": self.linear,
            "chi2": self.chi2,
            "pixels": self.pixels,
            "gain_error": self.gain_error,
            "gain_per_view": self.gain_per_view,
            "view_factors": self.view_factors.tolist(),
            "optics": {name: {"value": one.value, "sd": one.sd} for name, one in self.optics.items()},
            "warnings": list(self.warnings),
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the tetrahedra with `density` [W/mm³], and the sources with their `power` [W], to a .vtu file.

        A source is a cell of one vertex, its centre, with its `radius` [mm]. On vertices of the mesh `power` and
        `radius` are 0, on sources `density`.

        Raises
        ------
        InversionError : another suffix, or the file cannot be written.
        BackendError : meshio is not installed.
        """
        path = Path(path)
        if path.suffix.lower() != ".vtu":
            raise InversionError(f"output file '{path}' must end in .vtu. Give a name such as source.vtu.")
        try:
            import meshio
        except ImportError as cause:
            raise BackendError(
                f"location: meshio, which writes '{path.name}', is not installed. pip install 'mitsuba-fspt[mesh]'."
            ) from cause
        count, vertices = len(self.sources), self.mesh.vertices
        points = np.concatenate([vertices, [source.position for source in self.sources]])
        cells = [("tetra", self.mesh.cells), ("vertex", np.arange(count)[:, None] + len(vertices))]
        values = {
            "density": np.concatenate([self.density, np.zeros(count)]),
            "power": np.concatenate([np.zeros(len(vertices)), [source.power for source in self.sources]]),
            "radius": np.concatenate([np.zeros(len(vertices)), [source.radius or 0.0 for source in self.sources]]),
        }
        with atomic_path(path, InversionError) as temporary:
            meshio.Mesh(points, cells, point_data=values).write(temporary, "vtu")

    def __repr__(self) -> str:
        found = "; ".join(
            f"{source.power:.4g} W at ({', '.join(f'{x:.4g}' for x in source.position)}) mm" for source in self.sources
        )
        return f"Location({found}, chi2 {self.chi2:.4g})"
