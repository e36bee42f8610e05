"""Images of light sources at the vertices of the tetrahedra: a linear map, coarse and fast.

    P = B K⁻¹ p,   B = share · T S/(2A)

p: power of the vertices [W]; K: matrix of the diffusion equation, under SP3 too, in finite elements of order 1; S:
values at the points of the surface from those at the vertices; T: transport matrix. K has one sparse factor for all
sources, so that a thousand of them take seconds. A point source is known to about the length of an edge in it: what
needs more accuracy takes the solution with the source's own free field (see `tissue.diffusion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize, nnls
from scipy.sparse import csr_array

from ..runtime.errors import InversionError
from ..runtime.progress_bar import Progress
from ..tissue.sparse_factor import Solve
from ..tissue.tetrahedra import Tetrahedra
from .band_images import BandImages, of_each

Array = NDArray[np.float64]
Index = NDArray[np.int64]
LEAST_LENGTH = 1e-9  # of an image, over the longest; sources with shorter ones are not seen


@dataclass(frozen=True)
class GridSettings:
    """Accuracy of the first positions and of the density.

    probes : random vectors for the length of each vertex's image, known to (2 · probes)^-½: 9 %
    tried : vertices of the largest estimated fit whose images are computed, so that the error of the estimate does
        not decide which one is best
    exchanges : most times that each source is chosen again
    iterations : most iterations of the density
    """

    probes: int = 64
    tried: int = 64
    exchanges: int = 5
    iterations: int = 300


@dataclass(frozen=True, eq=False)
class SourceGrid:
    """Images of sources at the vertices of the tetrahedra, all bands one after the other, (N,) pixels.

    mesh : tetrahedra;  inner : (k,) vertices off the border, where sources may be
    solve : K⁻¹ for each band;  pixels : of each band, power from the fluence at the vertices [mm²]
    power : (N,) measured [W];  sigma : (N,) its noise [W], in units of which images are given here
    """

    mesh: Tetrahedra
    inner: Index
    solve: tuple[Solve, ...]
    pixels: tuple[csr_array, ...]
    power: Array
    sigma: Array
    settings: GridSettings = GridSettings()

    @classmethod
    def of(cls, bands: Sequence[BandImages]) -> SourceGrid:
        """Grid of the bands, with the noise of flat images; raises InversionError where no vertex is inside."""
        mesh = bands[0].tissue.mesh
        inner = np.setdiff1d(np.unique(mesh.cells), mesh.border)
        if not inner.size:
            raise InversionError(
                "locate: all vertices of the tetrahedra are on the border. Give a shorter 'edge' in [mesh] of the "
                "phantom file, or tetrahedra with vertices inside."
            )
        return cls(
            mesh,
            inner,
            tuple(band.tissue.linear.system.factors[0] for band in bands),
            tuple(csr_array(band.share * band.from_fluence()) for band in bands),
            np.concatenate([band.power for band in bands]),
            np.concatenate([band.flat_sigma() for band in bands]),
        )

    @cached_property
    def volumes(self) -> Array:
        """(W,) volume of each vertex [mm³]: a quarter of those of its tetrahedra."""
        share = np.repeat(self.mesh.volumes / 4, 4)
        return np.bincount(self.mesh.cells.ravel(), share, len(self.mesh.vertices)).astype(np.float64)

    @cached_property
    def lengths(self) -> Array:
        """(k,) estimated length of each inner vertex's image [1/W]; > 0 for vertices that no pixel sees, too."""
        probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(self.power), self.settings.probes))
        lengths = np.sqrt(np.mean(self.backward(probes) ** 2, axis=1))
        return lengths.clip(LEAST_LENGTH * lengths.max())

    def backward(self, values: Array) -> Array:
        """(k, …) transpose of `forward` applied to `values` (N, …)."""
        ends = np.cumsum([pixels.shape[0] for pixels in self.pixels])[:-1]
        parts = np.split((values.T / self.sigma).T, ends)
        fields = of_each(lambda solve, pixels, part: solve(np.asarray(pixels.T @ part)), self.solve, self.pixels, parts)
        return np.asarray(sum(fields))[self.inner]

    def forward(self, power: Array) -> Array:
        """(N, …) image over the noise of `power` (k, …) [W] of the inner vertices."""
        load = np.zeros((len(self.mesh.vertices), *power.shape[1:]))
        load[self.inner] = power
        image = np.concatenate(of_each(lambda solve, pixels: pixels @ solve(load), self.solve, self.pixels))
        return np.asarray((image.T / self.sigma).T)

    def positions(self, count: int) -> list[Array]:
        """Two sets of positions (count, 3) [mm] of point sources that fit well, by orthogonal matching pursuit.

        The first set is chosen one source after the other. For the second each in turn is chosen again with the others
        in their places, until none changes. Raises InversionError where a source more would not lower Σ (residual/σ)².
        """
        chosen, columns = list[int](), np.empty((len(self.power), 0))
        for _ in range(count):
            best, image = self._best(columns)
            chosen, columns = [*chosen, best], np.column_stack([columns, image])
        first, kept = list(chosen), 0
        for _ in range(count * self.settings.exchanges):
            best, image = self._best(columns[:, 1:])
            kept = kept + 1 if best == chosen[0] else 0
            chosen, columns = [*chosen[1:], best], np.column_stack([columns[:, 1:], image])
            if kept == count:
                break
        return [self.mesh.vertices[self.inner[vertices]] for vertices in (first, chosen)]

    def _best(self, columns: Array) -> tuple[int, Array]:
        """Inner vertex whose source, beside those with the images `columns` (N, …), fits best, and its image (N,)."""
        measured = self.power / self.sigma
        residual = measured - columns @ nnls(columns, measured)[0] if columns.size else measured
        basis = np.linalg.qr(columns)[0]
        gain = np.maximum(self.backward(residual), 0) / self.lengths
        best = np.argsort(gain)[-self.settings.tried :]
        ones = np.zeros((len(self.inner), len(best)))
        ones[best, np.arange(len(best))] = 1
        tried = self.forward(ones)
        beside = tried - basis @ (basis.T @ tried)
        fit = residual @ beside / np.linalg.norm(beside, axis=0).clip(LEAST_LENGTH * self.lengths.max())
        if not fit.max() > 0:
            raise InversionError(
                f"locate: {columns.shape[1]} point sources fit all light of the images. Give fewer as 'sources'."
            )
        return int(best[np.argmax(fit)]), tried[:, np.argmax(fit)]

    def density(self, report: Progress) -> Array:
        """(W,) source density >= 0 [W/mm³] at the vertices, 0 on the border.

        The unknowns are the powers of the vertices times the lengths of their images, so that deep vertices count as
        much as shallow ones. Quasi-Newton iterations begin with none and end where Σ (residual/σ)² falls to the number
        of pixels: a fit within the noise (discrepancy principle); or where it no longer falls, since the linear
        elements are not accurate enough for so little noise.
        """
        scale, measured = self.lengths, self.power / self.sigma
        turn = 0

        def cost(x: Array) -> tuple[float, Array]:
            residual = self.forward(x / scale) - measured
            return float(residual @ residual) / 2, self.backward(residual) / scale

        def ended(intermediate_result: OptimizeResult) -> None:
            nonlocal turn
            turn += 1
            report("density", turn / self.settings.iterations)
            if 2 * intermediate_result.fun <= len(measured):
                raise StopIteration

        found = minimize(
            cost,
            np.zeros(len(scale)),
            jac=True,
            method="L-BFGS-B",
            bounds=[(0, None)] * len(scale),
            callback=ended,
            options={"maxiter": self.settings.iterations, "ftol": 1e-9},
        )
        density = np.zeros(len(self.mesh.vertices))
        density[self.inner] = found.x / scale / self.volumes[self.inner]
        return density
