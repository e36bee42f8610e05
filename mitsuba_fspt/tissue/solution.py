"""Solution for a phantom: fluence and exitance at any point, the border as a phantom, the fluence as a volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..optics.media import Medium
from ..phantom.phantom import Phantom
from ..phantom.surface_mesh import face_areas
from ..runtime.errors import FluxError
from .border_curvature import BorderShape
from .border_surface import nearest_points, refined_border
from .finite_elements import Solved
from .fluence_volume import Volume, voxel_box
from .free_field import SourceField
from .light_models import Equations
from .tetrahedra import OUTSIDE, Tetrahedra, depth

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Largest share of the exit power that may be removed with the values below 0, which are errors of the mesh.
LARGEST_REMOVED = 1e-4
# Iterations of the search in curved cells; each one divides the error by about 8 radii of curvature over an edge.
CURVED_STEPS = 6
NEARBY = 0.5  # barycentric distance from a cell beyond which straight edges are accurate enough for the search


@dataclass(frozen=True, eq=False)
class TissueSolution:
    """Solution φ: sum of the free `fields` of the sources and the rest `solved.rest` in the `basis` on `mesh`.

    `media` and `equations` of the regions of the mesh; `shape` of its border; `source_power` [W].
    """

    mesh: Tetrahedra
    basis: Any
    media: tuple[Medium, ...]
    equations: Equations
    shape: BorderShape
    fields: tuple[SourceField, ...]
    source_power: float
    solved: Solved

    @property
    def balance(self) -> float:
        """(absorbed + exit power)/source power - 1, no unit: error of the sources' field integrated on the border."""
        return (self.solved.absorbed + self.solved.exited) / self.source_power - 1

    def report(self) -> dict[str, float | int]:
        """Power balance and size, ready for JSON.

        source_power, absorbed_power, exit_power [W]; exit_fraction; balance (see there); nodes (unknowns), cells,
        iterations.
        """
        absorbed, leaving = self.solved.absorbed, self.solved.exited
        return {
            "source_power": self.source_power,
            "absorbed_power": absorbed,
            "exit_power": leaving,
            "exit_fraction": leaving / self.source_power,
            "balance": self.balance,
            "nodes": int(self.basis.N),
            "cells": len(self.mesh.cells),
            "iterations": self.solved.iterations,
        }

    def fluence_at(self, points: Array, core: float = 0.0) -> Array:
        """Fluence [W/mm²] at `points` (N, 3) [mm] in the tissue, shape (N,).

        For points just outside, w is that of a nearby point of the border. Closer than `core` [mm] to a point source φ
        is set constant; with core 0 it is infinite at the source.
        """
        cells, local = self.places(points)
        return np.asarray(self.equations.source @ self._components(points, cells, local, core))

    def exitance_at(self, points: Array, places: tuple[Index, Array] | None = None) -> Array:
        """J_n = -c_1 ∂φ_1/∂n by the boundary condition [W/mm²], φ/(2A) for diffusion, shape (N,).

        points : (N, 3) [mm] of the border;  places : of them, where known
        """
        cells, local = places or self.places(points)
        outward = self._outward(cells, local, self._components(points, cells, local, 0.0))[0]
        if not self.equations.lateral.any():
            return outward
        return outward + self._interpolated(self.solved.lateral, cells, local)

    def phantom(self, edge: float) -> Phantom:
        """Border as a phantom with J_n on its vertices; triangle edges are about `edge` [mm] > 0 or shorter.

        All values are multiplied by one factor near 1, so that the sum over triangles of area times mean value is the
        finite elements' exit power; the provenance gives it as `scale`. Values below 0 become 0 and are counted.

        Raises
        ------
        FluxError : the edge is not positive or far too short, no light leaves, or the values below 0 remove too much
            power: the mesh is too coarse.
        """
        if not self.solved.exited > 0:
            raise FluxError(
                f"solve: the exit power is {self.solved.exited:g} W of {self.source_power:g} W, the phantom would be "
                "black. Give smaller mua and musp, or a source closer to the border."
            )
        vertices, faces = self._border(edge)
        exitance = self.exitance_at(vertices)
        areas = face_areas(vertices, faces)
        removed = float(areas @ np.maximum(-exitance, 0)[faces].mean(axis=1))
        if removed > LARGEST_REMOVED * self.solved.exited:
            raise FluxError(
                f"solve: exitance below 0 takes away {removed:.3g} W of {self.solved.exited:.3g} W. The mesh "
                f"is too coarse for these optics; give an edge below {self.mesh.edge:.3g} mm."
            )
        clipped = np.maximum(exitance, 0)
        scale = self.solved.exited / float(areas @ clipped[faces].mean(axis=1))
        provenance = {
            "source": f"{self.equations.title} by finite elements",
            "boundary": "; ".join(" ".join(f"{h:.6g}" for h in border[0]) for border in self.equations.border),
            "media": "; ".join(
                f"mua {m.mua:g}/mm, musp {m.musp:g}/mm, n {m.n:g}" + (f", g {m.g:g}" if m.g else "") for m in self.media
            ),
            "source_power": f"{self.source_power!r} W",
            "scale": f"{scale!r}",
        }
        negatives = int(np.count_nonzero(exitance < 0))
        return Phantom(vertices, faces, clipped * scale, "vertex", provenance, negatives, removed)

    def volume(self, voxel: float) -> Volume:
        """φ [W/mm²] at the centres of cubes of edge `voxel` [mm], in a box wider than the tissue by a cube or more.

        Outside, φ is continued from the nearest point of the border exponentially with the slope of the boundary
        condition there, so that trilinear interpolation up to the surface meets no jump.

        Raises
        ------
        FluxError : the voxel's edge is not positive, or there would be too many voxels.
        """
        # Too many voxels are refused before the border is refined to the same edge.
        voxel_box(self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0), voxel)
        border, faces = self._border(voxel)
        low, high, axes = voxel_box(border.min(axis=0), border.max(axis=0), voxel)
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        cells, local = self._curved(points, *self.mesh.locate(points))
        inside = depth(local) > -OUTSIDE
        fluence = np.empty(len(points))
        # The mean of 1/r over a cube about its centre is 1/(0.42 edge): the value of a voxel with a point source.
        fluence[inside] = self.equations.source @ self._components(
            points[inside], cells[inside], local[inside], 0.42 * voxel
        )
        nearest = self._snap(nearest_points(points[~inside], border[faces]))
        fluence[~inside] = self._continued(points[~inside], nearest)
        return Volume(fluence.reshape(x.shape).astype(np.float32), low, high)

    def _continued(self, points: Array, nearest: Array) -> Array:
        """φ [W/mm²] at `points` outside the tissue, from the `nearest` points of the border."""
        cells, local = self.places(nearest)
        components = self._components(nearest, cells, local, 0.0)
        fluence = self.equations.source @ components
        slope = self.equations.source @ (
            self._outward(cells, local, components) / self.equations.diffusion[self.mesh.region[cells]].T
        )
        rate = np.maximum(slope / np.where(fluence > 0, fluence, np.inf), 0)
        return np.asarray(fluence * np.exp(-rate * np.linalg.norm(points - nearest, axis=1)))

    def _outward(self, cells: Index, local: Array, components: Array) -> Array:
        """H φ [W/mm²], the outward flux of each component, (m, N), from the components on the border."""
        curvature = self.mesh.on_border_at(self.shape.curvature, cells, local)
        return np.einsum("nij,jn->in", self.equations.border_at(self.mesh.region[cells], curvature), components)

    def _border(self, edge: float) -> tuple[Array, Index]:
        """Vertices and faces of the border, with edges of about `edge` [mm] or less, on the true surface."""
        vertices, faces = refined_border(self.basis.mesh, self.mesh.cuts(edge))
        return self._snap(vertices), faces

    def _snap(self, points: Array) -> Array:
        """Points near the border, moved onto the true border if the mesh has a `snap`."""
        return points if self.mesh.snap is None else self.mesh.snap(points)

    def _components(self, points: Array, cells: Index, local: Array, core: float) -> Array:
        """φ_i [W/mm²], (m, N), at `points` with known cells and local coordinates; `core` as in `fluence_at`."""
        rest = self._interpolated(self.solved.rest, cells, local)
        return np.asarray(rest + sum(field.components(points, core) for field in self.fields))

    def _interpolated(self, nodes: Array, cells: Index, local: Array) -> Array:
        """Values (…, n) at points in cells of a function with values (…, N) at the nodes."""
        dofs = self.basis.element_dofs[:, cells]
        return np.asarray(sum(nodes[..., dof] * shape for dof, shape in zip(dofs, self._shapes(local), strict=True)))

    def _shapes(self, local: Array) -> list[Array]:
        """Basis functions of a cell at local coordinates (N, 3), each of shape (N,)."""
        return [self.basis.elem.lbasis(local.T, i)[0] for i in range(self.basis.Nbfun)]

    def places(self, points: Array) -> tuple[Index, Array]:
        """Cells and local coordinates of points, the coordinates clamped to the cell."""
        cells, local = self._curved(points, *self.mesh.locate(points))
        rest = np.maximum(1 - local.sum(axis=1, keepdims=True), 0)
        local = np.maximum(local, 0)
        return cells, local / (local.sum(axis=1, keepdims=True) + rest)

    def _curved(self, points: Array, cells: Index, local: Array) -> tuple[Index, Array]:
        """Cells and local coordinates of points in the curved mesh, from those in the straight mesh."""
        near = np.flatnonzero(depth(local) > -NEARBY)
        if self.basis.mesh.affine or len(near) == 0:
            return cells, local
        there = self._curved_local(points[near], cells[near])
        converged = depth(there) > -NEARBY
        near = near[converged]
        local[near] = there[converged]
        for _ in range(CURVED_STEPS):
            # A facet with a curved edge is curved too: the point can be in the next cell.
            behind = self.mesh.behind(cells[near], local[near])
            near, behind = near[behind >= 0], behind[behind >= 0]
            there = self._curved_local(points[near], behind)
            better = depth(there) > depth(local[near])
            near = near[better]
            cells[near], local[near] = behind[better], there[better]
        return cells, local

    def _curved_local(self, points: Array, cells: Index) -> Array:
        """Local coordinates of points in curved cells, by fixed-point iteration from those in the straight cells."""
        nodes = self.basis.mesh.doflocs[:, self.basis.element_dofs[:, cells]].swapaxes(0, 1)
        local = self.mesh.local(points, cells)
        for _ in range(CURVED_STEPS):
            mapped = sum(node * shape for node, shape in zip(nodes, self._shapes(local), strict=True))
            local += np.einsum("nij,nj->ni", self.mesh.inverse[cells], points - np.asarray(mapped).T)
        return local
