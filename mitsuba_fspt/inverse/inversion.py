"""Result of `invert`: J_n on the surface with its intervals, its files and its drawing."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..phantom.formats.ply import write_ply
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import BackendError, InversionError
from .surface import Surface
from .transport_matrix import TransportMatrix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
FORMATS = (".ply", ".vtu")
LOG = logging.getLogger("mitsuba_fspt")


@dataclass(frozen=True, eq=False)
class Inversion:
    """Surface flux density J_n from images, on the columns of a transport matrix.

    The intervals contain the noise, the numerical error of the matrix, a common factor, and what J_n leaves out that is
    linear on faces (Eq. M.42). They leave out errors of the model: pose, lens, shape, exit law, flat field, factors of
    single views. `warnings` say what the residuals show of these, by χ² and by structure over the views (Eq. M.34).

    Attributes
    ----------
    matrix, surface : the transport matrix and its mesh
    solution : (n,) J_n [W/mm²] on all columns, also those that are not seen, where it continues the others smoothly
    draws : (n, samples) random draws of it [W/mm²]
    seen : (n,) bool, sensitivity per area at least 1 % of the largest, and pixels see at least half of the area
    left_out : [mm²], area of the vertices that are not `seen` only because pixels see less than half of their area
    confidence : of the intervals
    weight, reference : of the penalty on roughness [mm²], [W/mm²] (Eq. M.23)
    determined : number γ of unknowns that the data determine
    pixels : number of pixels fitted;  chi2_sum : Σ (residual/σ)² over them
    decrement : bound of the squared numerical error of any weighted sum, over its variance; of 'mlem' twice the duality
        gap of the log-likelihood
    converged : False where variances or weight still changed in the last round
    gain_error : relative uncertainty of a common factor, contained in the intervals
    gain_per_view : relative standard deviation of a factor of each view, fitted as well and contained in the intervals
    view_factors : (views,) these factors, which `fitted` contains;  view_factor_draws : (views, samples) draws of them
    measured, fitted, sigma : (views, height, width) [W]; NaN where masked, or outside the surface
    mesh_error : largest change of a weighted sum of J_n by J_n that is curved on faces, over the sum's standard
        deviation without it; contained in the intervals (Eq. M.42)
    warnings : lines of stderr on what the residuals say of the model and of the stated errors, and on a coarse mesh
    """

    matrix: TransportMatrix
    surface: Surface
    solution: Array
    draws: Array
    seen: NDArray[np.bool_]
    left_out: float
    confidence: float
    weight: float
    reference: float
    determined: float
    pixels: int
    decrement: float
    converged: bool
    gain_error: float
    gain_per_view: float
    view_factors: Array
    view_factor_draws: Array
    chi2_sum: float
    measured: Array
    fitted: Array
    sigma: Array
    mesh_error: float = 0.0
    warnings: tuple[str, ...] = ()

    @cached_property
    def exitance(self) -> Array:
        """(n,) J_n [W/mm²]; NaN where the images do not determine it."""
        return np.where(self.seen, self.solution, np.nan)

    @property
    def chi2(self) -> float:
        """Σ (residual/σ)² over (fitted pixels − determined unknowns): about 1 where model and noise are right."""
        return self.chi2_sum / max(self.pixels - self.determined, 1.0)

    @cached_property
    def sd(self) -> Array:
        """(n,) standard deviation of J_n [W/mm²]; NaN where not seen."""
        return np.where(self.seen, self._drawn().std(axis=1, ddof=1), np.nan)

    @cached_property
    def lower(self) -> Array:
        """(n,) lower end of the interval of J_n [W/mm²]; NaN where not seen."""
        return self._ends[0]

    @cached_property
    def upper(self) -> Array:
        """(n,) upper end of the interval of J_n [W/mm²]; NaN where not seen."""
        return self._ends[1]

    @property
    def total(self) -> float:
        """Power [W] that leaves what is seen: Σ areas · J_n there."""
        return float(self.matrix.areas[self.seen] @ self.solution[self.seen])

    @property
    def total_interval(self) -> tuple[float, float]:
        """Interval (low, high) of `total` [W]."""
        return self.interval(np.where(self.seen, self.matrix.areas, 0.0))

    def interval(self, weights: ArrayLike) -> tuple[float, float]:
        """Interval (low, high) of Σ weights · J_n, for example of the power of a region with weights = areas there.

        Parameters
        ----------
        weights : (n,), finite, 0 where J_n is not seen

        Raises
        ------
        InversionError : the weights do not fit, or there are no samples.
        """
        given = np.asarray(weights, np.float64)
        if given.shape != self.seen.shape or not np.isfinite(given).all():
            raise InversionError(
                f"inversion: weights must be {len(self.seen)} finite numbers, one a column, got shape {given.shape}. "
                "Give 0 for what does not count."
            )
        if (given[~self.seen] != 0).any():
            count = int(np.sum(given[~self.seen] != 0))
            raise InversionError(
                f"inversion: weights of {count} columns that no image determines are not 0. Multiply by R.seen."
            )
        low, high = self._between(given @ self._drawn())
        return float(low), float(high)

    @property
    def view_factor_sd(self) -> Array:
        """(views,) standard deviation of the factor of each view; 0 without `gain_per_view`."""
        self._drawn()
        return self.view_factor_draws.std(axis=1, ddof=1)

    def _between(self, draws: Array) -> Array:
        """Ends of the interval of draws (..., samples): the next draw lies within it with the `confidence`.

        Quantiles at k/(samples + 1), k the rank: those at (k − 1)/(samples − 1) hold 89.1 % of 200 draws for 90 %.
        """
        ends = (1 - self.confidence) / 2, (1 + self.confidence) / 2
        return np.asarray(np.quantile(draws, ends, axis=-1, method="weibull"))

    @cached_property
    def _ends(self) -> Array:
        return np.where(self.seen, self._between(self._drawn()), np.nan)

    def _drawn(self) -> Array:
        if self.draws.shape[1] == 0:
            raise InversionError("inversion: intervals need random draws. Invert with samples=200.")
        return self.draws

    def summary(self) -> dict[str, Any]:
        """Numbers about the result by name, ready for JSON."""
        areas = self.matrix.areas
        found: dict[str, Any] = {
            "total": self.total,
            "unit": "W",
            "seen": float(areas[self.seen].sum() / areas.sum()),
            "left_out": float(self.left_out / areas.sum()),
            "peak": float(self.solution[self.seen].max()),
            "chi2": self.chi2,
            "pixels": self.pixels,
            "weight": self.weight,
            "reference": self.reference,
            "gain_error": self.gain_error,
            "determined": self.determined,
            "decrement": self.decrement,
            "converged": self.converged,
            "unknowns": self.surface.unknowns,
            "mesh_error": self.mesh_error,
            "samples": self.draws.shape[1],
            "warnings": list(self.warnings),
        }
        if self.gain_per_view:
            found |= {"gain_per_view": self.gain_per_view, "view_factors": self.view_factors.tolist()}
        if self.draws.shape[1]:
            found |= {"confidence": self.confidence, "total_interval": list(self.total_interval)}
        if self.draws.shape[1] and self.gain_per_view:
            found |= {"view_factor_sd": self.view_factor_sd.tolist()}
        return found

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the mesh with J_n [W/mm²], its sd, lower and upper end, and `seen` (0, 1) to a .ply or .vtu file.

        In a PLY, `exitance_x` is what Mitsuba reads as `vertex_exitance` or `face_exitance`. It and the others are 0
        where J_n is not seen; in a VTU they are NaN there.

        Raises
        ------
        InversionError : another suffix, or the file cannot be written.
        BackendError : meshio is not installed, for a VTU.
        """
        path = Path(path)
        if path.suffix.lower() not in FORMATS:
            raise InversionError(f"output file '{path}' must end in .ply or .vtu. Give a name such as phantom.ply.")
        values = {"exitance": self.exitance}
        if self.draws.shape[1]:
            values |= {"sd": self.sd, "lower": self.lower, "upper": self.upper}
        per = self.matrix.on
        if path.suffix.lower() == ".ply":
            dark = {f"{name}_x": np.where(self.seen, value, 0.0) for name, value in values.items()}
            comments = {"quantity": "exitance", "unit": "W/mm^2", "length_unit": "mm", "power": f"{self.total!r} W"}
            comments |= {"source": "fspt invert", "seen": "1 where the images determine it, else 0"}
            seen = {"seen_x": self.seen.astype(np.float64)}
            write_ply(path, self.surface.vertices, self.surface.faces, dark | seen, per, comments)
            for name, scale in self.surface.scales.items():
                LOG.warning(
                    "fspt: invert: '%s' is in mm, 'to_world' of shape '%s' scales the mesh of its file by %.6g. Leave "
                    "out the scale where the file takes its place.",
                    *(path, name, scale),
                )
            return
        try:
            import meshio
        except ImportError as cause:
            raise BackendError(
                f"inversion: meshio, which writes '{path.name}', is not installed. pip install 'mitsuba-fspt[mesh]'."
            ) from cause
        values = values | {"seen": self.seen.astype(np.float64)}
        data = {"point_data": values} if per == "vertex" else {"cell_data": {k: [v] for k, v in values.items()}}
        with atomic_path(path, InversionError) as temporary:
            meshio.Mesh(self.surface.vertices, [("triangle", self.surface.faces)], **data).write(temporary, "vtu")

    def report(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Figure of the views: measured, fitted, residual/σ, and J_n as each pixel sees it; also a PNG at `path`.

        Raises
        ------
        ImageError : the file cannot be written;  BackendError : matplotlib is not installed.
        """
        from .inversion_picture import draw, write

        if path is not None:
            return write(self, path)
        return draw(self)

    @property
    def residual(self) -> Array:
        """(views, height, width), (measured − fitted)/σ; NaN where masked, or outside the surface."""
        return (self.measured - self.fitted) / self.sigma

    def _repr_png_(self) -> bytes | None:
        """Picture of `report` for notebooks; None without matplotlib."""
        from .notebook import inversion_png

        return inversion_png(self)

    def _repr_html_(self) -> str:
        """Numbers and picture for notebooks."""
        from .notebook import inversion_html

        return inversion_html(self)

    def __repr__(self) -> str:
        return (
            f"Inversion({self.total:.5g} W from {100 * self.summary()['seen']:.3g} % of the surface, "
            f"chi2 {self.chi2:.4g}, {self.draws.shape[1]} samples)"
        )
