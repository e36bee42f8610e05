"""Images of a phantom in one band of wavelengths, and the images that point sources inside it have there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..optics.media import Source
from ..optics.shapes import Sphere
from ..runtime.errors import FluxError, InversionError
from ..runtime.interrupt import in_threads
from ..runtime.stderr_lines import told
from ..tissue.border_surface import nearest_points
from ..tissue.diffusion import Tissue
from ..tissue.solution import TissueSolution
from .measurement import Measurement
from .model_error import MODEL_ERRORS
from .surface import Surface
from .transport_matrix import TransportMatrix

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Result = TypeVar("Result")
# Distance of the matrix's surface from the tissue's border, over the edge of the tetrahedra: the largest one, and that
# from which on a line reports it. The sources are wrong by about that distance, which intervals do not contain.
OFF_BORDER = 0.25
REPORTED = 0.02
STEP = 1e-4  # relative change of optical coefficients, for slopes
STEPS = 1, -1, 0.1, -0.1, 0.01, -0.01  # of a source's position, over the usual one, by preference
KEPT = 30_000_000  # values of the solutions that a band keeps


@dataclass(frozen=True, eq=False)
class BandImages:
    """Images of one band of wavelengths, over the N pixels that see the surface and are not masked.

    name : of the band; None where there is only one, without a name
    matrix : transport matrix of the band;  surface : its surface, in the frame of the phantom file
    measurement : of all pixels;  rows : (N,) the pixels that are fitted
    tissue : with the optical coefficients of the band;  share : of a source's power that is emitted in the band
    transport : (N, V) power on the pixels from J_n at the surface's vertices [mm²]
    warnings : lines of stderr on a surface that is not quite the border of the tissue, and on its coefficients
    """

    name: str | None
    matrix: TransportMatrix
    surface: Surface
    measurement: Measurement
    tissue: Tissue
    share: float
    rows: Index
    transport: csr_array
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        name: str | None,
        matrix: TransportMatrix,
        surface: Surface,
        measurement: Measurement,
        tissue: Tissue,
        share: float,
    ) -> BandImages:
        """Raises InversionError where no pixel is left, no light is in them, or the surface is not the border."""
        rows = np.flatnonzero((np.diff(matrix.matrix.indptr) > 0) & ~measurement.mask)
        if not len(rows):
            raise InversionError("locate: all pixels that see the surface are masked. Expose for a shorter time.")
        # From J_n at the vertices of the surface, whatever the columns are.
        transport = csr_array(matrix.matrix[rows] @ surface.from_vertices)
        found = cls(name, matrix, surface, measurement, tissue, share, rows, transport)
        if not found.power.sum() > 0:
            raise InversionError(
                f"locate: the pixels that see the surface hold {found.power.sum():.3g} W in total, no light. Check the "
                "images, their background and the order of the views."
            )
        return replace(found, warnings=tuple(told("locate", [*found._off_border(), *tissue.warnings()])))

    @property
    def power(self) -> Array:
        """(N,) measured power [W]."""
        return self.measurement.power[self.rows]

    def flat_sigma(self) -> Array:
        """Noise (N,) [W] if all pixels had the same signal, their mean."""
        mean = np.full(len(self.rows), self.power.mean())
        return self.measurement.sigma(self.rows, mean, np.zeros_like(mean), "locate")

    def sigma(self, exitance: Array) -> Array:
        """Noise (N,) [W] for J_n (V,) [W/mm²], with the numerical error of the matrix (Eq. M.24)."""
        return self.measurement.sigma(self.rows, self.transport @ exitance, self.numerical(exitance), "locate")

    def numerical(self, exitance: Array) -> Array:
        """Numerical error (N,) [W] of the power for J_n (V,) [W/mm²]."""
        return self.matrix.error(self.surface.from_vertices @ exitance).ravel()[self.rows]

    @property
    def view(self) -> Index:
        """(N,) number of the view of each pixel."""
        return self.rows // int(np.prod(self.matrix.image_shape[1:]))

    @cached_property
    def points(self) -> Array:
        """(N, 3) mean point of the surface [mm] that each pixel sees."""
        return np.asarray(self.transport @ self.surface.vertices) / self._seen[:, None]

    @cached_property
    def _seen(self) -> Array:
        """(N,) power on the pixels from J_n = 1 [mm²]."""
        return np.asarray(self.transport.sum(axis=1)).ravel()

    def depth(self, position: Array) -> float:
        """Distance of a position (3,) from the border [mm]."""
        nearest = nearest_points(position[None], self._border)[0]
        return float(np.linalg.norm(nearest - position))

    @cached_property
    def _border(self) -> Array:
        """Corners of the triangles of the border (F, 3, 3) [mm]."""
        mesh = self.tissue.mesh
        return mesh.vertices[mesh.border]

    @cached_property
    def crease_error(self) -> Array:
        """(N,) relative error of J_n near creases by the equation itself, e η of Eq. M.51, a mean over each pixel."""
        return MODEL_ERRORS[self.tissue.model].crease * self._near_creases

    @cached_property
    def _near_creases(self) -> Array:
        """(N,) η: 1 on creases of the border, 0 far away."""
        near = 1 - self.tissue.mesh.on_border_at(self.tissue.border_shape.along, *self._places)
        return np.asarray(self.transport @ near) / self._seen

    def model_error(self, position: Array, radius: float = 0.0) -> Array:
        """(N, 4) relative errors of a source's image by the equation itself, one standard deviation each (Eq. M.51)."""
        mesh = self.tissue.mesh
        distance = np.linalg.norm(self.points - position, axis=1)
        depth = self.depth(position)
        medium = self.tissue.media[int(mesh.region[mesh.locate(position[None])[0]][0])]
        free = (depth - radius) * (medium.mua + medium.musp)
        cosine = np.minimum(depth / distance, 1.0)
        return MODEL_ERRORS[self.tissue.model].columns(cosine, free, medium.mua / medium.musp, self._near_creases)

    def exitance(self, position: Array, radius: float = 0.0) -> Array:
        """(V,) J_n [1/mm²] at the surface's vertices in this band, per watt of a source over all bands.

        radius : of a sphere that glows uniformly [mm]; 0: a point

        Raises FluxError where there is no tissue, or a source is too close to the border.
        """
        return self._exitance(self._solution(position, radius))

    def gradient(self, position: Array, radius: float, step: float) -> Array:
        """(V, 3) change of `exitance` [1/mm³] along x, y and z, by steps [mm], backwards where the tissue ends.

        J_n has a kink where the source passes from one medium to another, and that of the finite elements a small jump:
        steps stay in the medium of the source, whose side of the kink they give.

        Raises FluxError where there is no tissue on either side.
        """
        present, steps = self._solution(position, radius), self._steps(position, step)

        def changes(ways: Array) -> Array:
            others = [(self.tissue, [_sphere(position + way, radius)]) for way in ways]
            near = self.tissue.near(present, others)
            return np.column_stack([self._exitance(one) for one in near]) - self._exitance(present)[:, None]

        try:
            return changes(np.diag(steps)) / steps
        except FluxError:
            columns = []
        for way in np.diag(steps):
            try:
                columns.append(changes(way[None]))
            except FluxError:
                columns.append(-changes(-way[None]))
        return np.column_stack(columns) / steps

    def _steps(self, position: Array, step: float) -> Array:
        """(3,) steps along x, y and z to points in the medium of `position`: ± `step`, or the longest that is there."""
        lengths = step * np.array(STEPS)
        ends = position + lengths[:, None, None] * np.eye(3)
        medium = self.tissue.medium_at(np.vstack([position, *ends]))
        same = (medium[1:] == medium[0]).reshape(-1, 3)
        return np.asarray(lengths[same.argmax(axis=0)])  # the first where there is none

    def _solution(self, position: Array, radius: float) -> TissueSolution:
        """Solution for a source of 1 W; the last ones are kept, since fits begin anew from the same positions."""
        key = (*position.tolist(), float(radius))
        found = self._solutions.pop(key, None) or self.tissue.solve([_sphere(position, radius)])
        self._solutions[key] = found
        while len(self._solutions) > max(2, KEPT // (found.solved.rest.size + found.solved.lateral.size)):
            del self._solutions[next(iter(self._solutions))]
        return found

    @cached_property
    def _solutions(self) -> dict[tuple[float, ...], TissueSolution]:
        return {}

    def _exitance(self, solution: TissueSolution) -> Array:
        """(V,) J_n at the surface's vertices [W/mm²] in this band."""
        return self.share * solution.exitance_at(self.surface.vertices, self._places)

    def changes(self, sources: Sequence[Source], tissues: Sequence[Tissue]) -> Array:
        """(N, P) change of the power on the pixels [W] where other `tissues`, slightly different, take its place.

        The sources have their power over all bands. One more solution for each, by the factors at hand (Eq. M.52).
        """
        present = self.tissue.solve(sources)
        near = self.tissue.near(present, [(tissue, sources) for tissue in tissues])
        change = np.column_stack([self._exitance(one) for one in near]) - self._exitance(present)[:, None]
        return np.asarray(self.transport @ change)

    def slopes(self, sources: Sequence[Source]) -> dict[str, Array]:
        """(N,) change of the power on the pixels [W] by relative changes of the tissue's coefficients.

        'absorption': of all µa, 'scattering': of all µs', for these sources.
        """
        media = self.tissue.media
        others = {
            "absorption": [replace(medium, mua=(1 + STEP) * medium.mua) for medium in media],
            "scattering": [replace(medium, musp=(1 + STEP) * medium.musp) for medium in media],
        }
        changes = self.changes(sources, [self.tissue.of_media(one) for one in others.values()])
        return dict(zip(others, changes.T / STEP, strict=True))

    @cached_property
    def _places(self) -> tuple[Index, Array]:
        """Where the surface's vertices are in the tetrahedra."""
        return self.tissue.places(self.surface.vertices)

    def from_fluence(self) -> csr_array:
        """(N, W) power on the pixels from the fluence at the W vertices of the tetrahedra: J_n = φ/(2A) [mm²]."""
        mesh, points = self.tissue.mesh, self.surface.vertices
        cells, local = mesh.locate(points)
        weights = np.maximum(np.column_stack([1 - local.sum(axis=1), local]), 0)
        weights /= weights.sum(axis=1, keepdims=True)
        weights *= self.tissue.linear.equations.border[mesh.region[cells], 0]
        rows = np.repeat(np.arange(len(points)), 4)
        shape = len(points), len(mesh.vertices)
        return csr_array(self.transport @ csr_array((weights.ravel(), (rows, mesh.cells[cells].ravel())), shape))

    def image(self, values: Array) -> Array:
        """(views, height, width) with `values` (N,) on the pixels that are fitted, NaN elsewhere."""
        image = np.full(self.matrix.shape[0], np.nan)
        image[self.rows] = values
        return image.reshape(self.matrix.image_shape)

    def _off_border(self) -> list[str]:
        """Line on the distance of the matrix's surface from the border of the tissue, if any; InversionError if far."""
        mesh, points = self.tissue.mesh, self.surface.vertices
        nearest = nearest_points(points, self._border)
        if mesh.snap is not None:
            nearest = mesh.snap(nearest)
        away = np.linalg.norm(points - nearest, axis=1).max()
        if away > OFF_BORDER * mesh.edge:
            raise InversionError(
                f"locate: the surface of the matrix is up to {away:.3g} mm away from the phantom's border. Give the "
                "matrix of this phantom's surface; its mesh without to_world is in the frame of the phantom file."
            )
        if away <= REPORTED * mesh.edge:
            return []
        return [
            f"the surface of the matrix is up to {away:.3g} mm away from the phantom's border, which the stated errors "
            "do not contain."
        ]


def of_each(work: Callable[..., Result], *arguments: Sequence[Any]) -> list[Result]:
    """`work` of the arguments of each band, the bands in threads: NumPy and SciPy let others run while they compute."""
    if len(arguments[0]) == 1:
        return [work(*(one[0] for one in arguments))]
    return in_threads(work, *arguments)


def _sphere(position: Array, radius: float) -> Source:
    """Source of 1 W that glows uniformly over a sphere, a point for the radius 0."""
    x, y, z = (float(value) for value in position)
    return Source(Sphere((x, y, z), float(radius)))
