"""Tetrahedral mesh of tissue: its regions, and the search for the cell that contains a point."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..optics.shapes import Shape
from ..phantom.surface_mesh import boundary
from ..runtime.errors import FluxError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SPREAD, POINTS = 200_000, (8, 4000)  # points in all cells near a shape, least and most in each
STARTS = 4  # start cells of the search for a point's cell
MOST_STEPS = 200  # of the search from one start cell
ROUND_OFF = 1e-9  # of a barycentric coordinate
OUTSIDE = 1e-6  # a point counts as inside up to this barycentric distance beyond the border
# More would take tens of gigabytes: tetrahedra in the solver, triangles of the surface.
MOST_CELLS = 5_000_000
MOST_FACES = 10_000_000


@dataclass(frozen=True, eq=False)
class Tetrahedra:
    """Tetrahedral mesh.

    Parameters
    ----------
    vertices : array, shape (V, 3) [mm]
    cells : array, shape (T, 4), indices of vertices in either orientation
    region : array, shape (T,), label of each cell; all 0 if left out
    snap : function that moves points (N, 3) [mm] near the border onto the curved border; None if the border is flat

    Raises
    ------
    FluxError : an array has another shape, a vertex is not finite, an index is out of range, or a cell is flat.
    """

    vertices: Array
    cells: Index
    region: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    snap: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        vertices, cells = np.asarray(self.vertices, dtype=np.float64), np.asarray(self.cells, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise FluxError(f"tetrahedra: vertices must be finite, shape (V, 3), got shape {vertices.shape}. Fix them.")
        if cells.ndim != 2 or cells.shape[1] != 4 or len(cells) == 0:
            raise FluxError(
                f"tetrahedra: cells must have shape (T, 4), T > 0, got {cells.shape}. Give four corners each."
            )
        if cells.min() < 0 or cells.max() >= len(vertices):
            raise FluxError(
                f"tetrahedra: cells refer to vertices {cells.min()} to {cells.max()}, there are "
                f"{len(vertices)}, counted from 0. Subtract 1 from indices that count from 1."
            )
        region = np.asarray(self.region, dtype=np.int64) if len(self.region) else np.zeros(len(cells), np.int64)
        if region.shape != (len(cells),):
            raise FluxError(
                f"tetrahedra: {len(cells)} cells need as many region labels, got {region.shape}. Give one each."
            )
        for name, value in (("vertices", vertices), ("cells", cells), ("region", region)):
            object.__setattr__(self, name, value)
        flat = self.volumes <= 1e-12 * np.ptp(vertices, axis=0).max() ** 3 / len(cells)
        if flat.any():
            raise FluxError(
                f"tetrahedra: {np.count_nonzero(flat)} of {len(cells)} cells have no volume, the first is "
                f"cell {np.argmax(flat)}. Mesh again or remove the slivers."
            )

    def without_unused(self) -> Tetrahedra:
        """The same mesh without vertices of no cell, such as those that meshers leave of curves and surfaces."""
        used, cells = np.unique(self.cells, return_inverse=True)
        return replace(self, vertices=self.vertices[used], cells=cells.reshape(self.cells.shape))

    def cuts(self, edge: float) -> int:
        """Number of parts, >= 1, of each border edge for triangles with edges of about `edge` [mm].

        Raises
        ------
        FluxError : the edge is not positive, or there would be more than `MOST_FACES` triangles.
        """
        if not (math.isfinite(edge) and edge > 0):
            raise FluxError(f"surface: 'edge' must be > 0 and finite, got {edge:g}. Give mm.")
        facets = np.count_nonzero(self.neighbours < 0)
        parts = max(1.0, self.edge / edge)
        if parts * parts * facets > MOST_FACES:
            raise FluxError(
                f"surface: edges of {edge:g} mm make {parts * parts * facets:.3g} triangles, at most {MOST_FACES:.0e} "
                f"can be. Give an edge above {self.edge * math.sqrt(facets / MOST_FACES):.2g} mm."
            )
        return math.ceil(parts)

    @property
    def edges(self) -> Array:
        """Edge vectors of each cell from its first vertex, as columns, shape (T, 3, 3) [mm]."""
        corners = self.vertices[self.cells]
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

    @cached_property
    def volumes(self) -> Array:
        """Volume of each cell, shape (T,) [mm³]."""
        return np.asarray(np.abs(np.linalg.det(self.edges)) / 6)

    @cached_property
    def edge(self) -> float:
        """Edge of the regular tetrahedron of mean volume [mm]."""
        return float((6 * np.sqrt(2) * self.volumes.mean()) ** (1 / 3))

    def inside(self, shape: Shape) -> NDArray[np.bool_]:
        """True for each cell whose centroid lies in the shape, shape (T,)."""
        return shape.contains(self.vertices[self.cells].mean(axis=1))

    def volume_in(self, shape: Shape) -> float:
        """Volume [mm³] of the part of a shape that lies in the mesh to some percent, from points in cells near it."""
        border = shape.border()
        reach = 0.1 * np.ptp(border, axis=0)  # points of the border need not be its outermost ones
        corners = self.vertices[self.cells]
        low, high = border.min(axis=0) - reach, border.max(axis=0) + reach
        near = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)
        if not near.any():
            return 0.0
        count = int(np.clip(SPREAD // np.count_nonzero(near), *POINTS))
        weights = np.random.default_rng(0).dirichlet(np.ones(4), count)  # the same points in each cell
        points = np.einsum("pk,ckx->cpx", weights, corners[near])
        inside = shape.contains(points.reshape(-1, 3)).reshape(-1, count)
        return float(inside.mean(axis=1) @ self.volumes[near])

    def locate(self, points: Array) -> tuple[Index, Array]:
        """Cell that contains each of `points` (N, 3) [mm], or a cell close to a point outside the mesh.

        Returns the cells (N,) and the points' local coordinates (N, 3), the barycentric coordinates of the cell's
        second to fourth vertex. If the point is inside, they and their complement to 1 are >= 0 (see `depth`).
        """
        starts = self._centroids.query(points, k=min(STARTS, len(self.cells)))[1].reshape(len(points), -1)
        cells, local = self._walk(points, starts[:, 0])
        for start in starts.T[1:]:
            # The search ended at the border: the point is outside, or behind a concave part. Try another start cell.
            lost = np.flatnonzero(depth(local) < -ROUND_OFF)
            other, there = self._walk(points[lost], start[lost])
            better = depth(there) > depth(local[lost])
            cells[lost[better]], local[lost[better]] = other[better], there[better]
        return cells, local

    def _walk(self, points: Array, start: Index) -> tuple[Index, Array]:
        """Cells (N,) and local coordinates (N, 3) that a search from cell to cell reaches from the cells `start`.

        Each step crosses the facet behind which the point lies farthest, until the point's cell or the border is
        reached.
        """
        cells, local = start.copy(), np.empty((len(points), 3))
        moving = np.arange(len(points))
        for _ in range(MOST_STEPS):
            local[moving] = self.local(points[moving], cells[moving])
            behind = self.behind(cells[moving], local[moving])
            moving, behind = moving[behind >= 0], behind[behind >= 0]
            cells[moving] = behind
            if len(moving) == 0:
                break
        else:
            local[moving] = -np.inf  # the search runs in a cycle
        return cells, local

    def local(self, points: Array, cells: Index) -> Array:
        """Local coordinates (N, 3) of `points` (N, 3) [mm] in one cell each (N,)."""
        return np.einsum("nij,nj->ni", self.inverse[cells], points - self.vertices[self.cells[cells, 0]])

    def behind(self, cells: Index, local: Array) -> Index:
        """Next cell towards each point with these local coordinates, (N,); -1 in its own cell and at the border."""
        weights = np.column_stack([1 - local.sum(axis=1), local])
        weights[self.neighbours[cells] < 0] = 0
        through = np.argmin(weights, axis=1)
        row = np.arange(len(cells))
        return np.where(weights[row, through] < -ROUND_OFF, self.neighbours[cells, through], -1)

    def on_border_at(self, values: Array, cells: Index, local: Array) -> Array:
        """Values (N,) at points of the border with these cells and local coordinates, from those at vertices (V,)."""
        corners = self.cells[cells]
        weights = np.column_stack([1 - local.sum(axis=1), local]) * self.on_border[corners]
        weights /= weights.sum(axis=1, keepdims=True).clip(1e-300)
        return np.asarray((weights * values[corners]).sum(axis=1))

    @cached_property
    def _centroids(self) -> Any:
        """Tree of the cells' centroids."""
        from scipy.spatial import cKDTree

        return cKDTree(self.vertices[self.cells].mean(axis=1))

    @cached_property
    def border(self) -> Index:
        """Faces of the border, outward, (F, 3)."""
        return np.asarray(boundary(self.vertices, self.cells)[0])

    @cached_property
    def on_border(self) -> NDArray[np.bool_]:
        """True for the vertices on the border, (V,)."""
        return np.isin(np.arange(len(self.vertices)), self.border)

    @cached_property
    def inverse(self) -> Array:
        """Inverse of each cell's edge matrix, shape (T, 3, 3) [1/mm]."""
        return np.asarray(np.linalg.inv(self.edges))

    @cached_property
    def neighbours(self) -> Index:
        """Cell behind the facet opposite to each vertex of each cell, shape (T, 4); -1 at the border."""
        facets = np.sort(self.cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
        order = np.lexsort(facets.T)
        pair = np.flatnonzero((facets[order[1:]] == facets[order[:-1]]).all(axis=1))
        neighbours = np.full(len(facets), -1)
        neighbours[order[pair]], neighbours[order[pair + 1]] = order[pair + 1] // 4, order[pair] // 4
        return neighbours.reshape(-1, 4)


def require_few(at_one: float, edge: float) -> None:
    """Raise FluxError if a mesh with edges of `edge` [mm] would have more than `MOST_CELLS` tetrahedra.

    `at_one` : their number with edges of 1 mm
    """
    cells = at_one / edge / edge / edge
    if cells > MOST_CELLS:
        raise FluxError(
            f"geometry: mesh edges of {edge:g} mm make about {cells:.3g} tetrahedra, at most {MOST_CELLS:.0e} can be. "
            f"Give an edge above {(at_one / MOST_CELLS) ** (1 / 3):.2g} mm."
        )


def depth(local: Array) -> Array:
    """Smallest barycentric coordinate of local coordinates (..., 3): negative outside the cell."""
    return np.minimum(local.min(axis=-1), 1 - local.sum(axis=-1))
