"""Finite elements of the diffusion equation: matrix, load, solution and power balance, by scikit-fem.

With D_f, µ_f the optics of the free field φ_f of the sources, the rest w = φ - φ_f satisfies for every test
function v

    ∫ (D ∇w·∇v + µa w v) dV + ∮ w v/(2A) dS
        = -∮ (φ_f/(2A) + D_f ∂φ_f/∂n) v dS - ∫ [(D - D_f) ∇φ_f·∇v + (µa - µ_f) φ_f v] dV,

where the last integral runs over the regions whose optics differ from the source's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from ..runtime.errors import BackendError, FluxError
from .free_field import FreeField
from .tetrahedra import Tetrahedra

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Relative residual of the linear system: far from the sources φ is nine decades below its peak and must keep digits.
TOLERANCE = 1e-13
MOST_ITERATIONS = 5000
SYMMETRIC = {"SymmetricMode": True}  # of SuperLU, for a matrix that is symmetric and positive definite
# Degree of the quadrature on the border, where φ_f is no polynomial. Its error is that of the power balance of shallow
# sources (see `balance`).
BORDER_DEGREE = 8


@dataclass(frozen=True, eq=False)
class Solved:
    """Rest w at the nodes [W/mm²], power absorbed inside and power leaving through the border [W]."""

    rest: Array
    absorbed: float
    exited: float
    iterations: int


class System:
    """Discrete problem on one mesh: `basis` of the cells, `border` basis of the boundary facets.

    `diffusion` [mm], `mua` [1/mm] and `factors` A hold one number per region; `order` is 1 or 2. Elements of
    order 2 have a curved border if the mesh has a `snap`. `repeated`: many sources will be solved for, so that factors
    of the matrix of linear elements, once, take less time than iterations without them.

    Raises
    ------
    BackendError : scikit-fem or SciPy is missing.
    """

    def __init__(
        self,
        mesh: Tetrahedra,
        order: int,
        diffusion: Sequence[float],
        mua: Sequence[float],
        factors: Sequence[float],
        repeated: bool = False,
    ) -> None:
        skfem = import_skfem()
        self.element = skfem.ElementTetP2() if order == 2 else skfem.ElementTetP1()
        self.repeated = repeated
        grid = _grid(skfem, mesh, order)
        self.basis = skfem.Basis(grid, self.element, intorder=2 * order)
        self.border = _border_basis(skfem, grid, self.element)
        # One row per cell or facet, to broadcast over its quadrature points.
        self.diffusion = np.asarray(diffusion)[mesh.region][:, None]
        self.mua = np.asarray(mua)[mesh.region][:, None]
        self.factor = np.asarray(factors)[mesh.region[grid.f2t[0, self.border.find]]][:, None]

    def solve(self, fields: Sequence[FreeField]) -> Solved:
        """Rest w = φ − φ_f, where φ_f is the sum of the sources' free fields, with the absorbed and the exit power.

        Raises
        ------
        FluxError : no convergence.
        """
        load, exited, absorbed = np.zeros(self.basis.N), 0.0, 0.0
        for field in fields:
            fluence, flux, outflow = self._on_border(field)
            load -= self._integrate(self.border, fluence / (2 * self.factor) + flux)
            exited += (fluence / (2 * self.factor) * self.border.dx).sum()
            # µ_f φ_f is the divergence of D_f ∇φ_f + P r/(4πr³), a field without singularity.
            absorbed += ((flux + outflow) * self.border.dx).sum()
            other, difference = self._in_other_regions(field)
            load -= other
            absorbed += difference
        rest, iterations = self._conjugate_gradients(load)
        inside, outside = self.basis.interpolate(rest), self.border.interpolate(rest)
        absorbed += (self.mua * inside * self.basis.dx).sum()
        exited += (outside / (2 * self.factor) * self.border.dx).sum()
        return Solved(rest, float(absorbed), float(exited), iterations)

    def _on_border(self, field: FreeField) -> tuple[Array, Array, Array]:
        """φ_f, D_f ∂φ_f/∂n and P n·r/(4πr³) [W/mm²] at the quadrature points of the boundary facets, (F, Q)."""
        points = np.asarray(self.border.global_coordinates())
        normals = np.asarray(self.border.normals).reshape(3, -1).T
        fluence, gradient, outflow = field.with_gradient(points.reshape(3, -1).T)
        flux = field.diffusion * (gradient * normals).sum(axis=1)
        through = (outflow * normals).sum(axis=1)
        shape = points.shape[1:]
        return fluence.reshape(shape), flux.reshape(shape), through.reshape(shape)

    def _in_other_regions(self, field: FreeField) -> tuple[Array, float]:
        """∫ [(D - D_f) ∇φ_f·∇v + (µa - µ_f) φ_f v] dV of every test function, and ∫ (µa - µ_f) φ_f dV [W]."""
        changed = (self.diffusion != field.diffusion) | (self.mua != field.mua)
        other = np.flatnonzero(changed[:, 0])
        load, power = np.zeros(self.basis.N), 0.0
        # ∇φ_f is steep near a source: cells there are integrated by a rule on many small tetrahedra.
        near = self._near(other, field.centres)
        skfem = import_skfem()
        degree = 2 * self.element.maxdeg
        for cells, rule in (
            (other[~near], skfem.quadrature.get_quadrature(self.element, degree)),
            (other[near], _split_rule(degree)),
        ):
            if len(cells) == 0:
                continue
            basis = skfem.Basis(self.basis.mesh, self.element, quadrature=rule, elements=cells)
            points = np.asarray(basis.global_coordinates())
            fluence, gradient, _ = field.with_gradient(points.reshape(3, -1).T)
            fluence = (self.mua[cells] - field.mua) * fluence.reshape(points.shape[1:])
            gradient = (self.diffusion[cells] - field.diffusion) * gradient.T.reshape(points.shape)
            load += self._integrate(basis, fluence, gradient)
            power += float((fluence * basis.dx).sum())
        return load, power

    def _near(self, cells: Index, centres: Array) -> NDArray[np.bool_]:
        """True for each of the cells with one of the `centres` within two cell radii of its centroid."""
        from scipy.spatial import cKDTree

        corners = self.basis.mesh.p[:, self.basis.mesh.t[:, cells]]
        middle = corners.mean(axis=1)
        size = np.linalg.norm(corners - middle[:, None], axis=0).max(axis=0)
        return np.asarray(cKDTree(centres).query(middle.T)[0] < 2 * size)

    def _conjugate_gradients(self, load: Array) -> tuple[Array, int]:
        """Solution of the linear system, shape (N,), with `_preconditioner`, and the number of iterations.

        SciPy's conjugate gradients take dot products by threaded BLAS, whose threads wait for each other on a busy
        machine: five times the time.
        """
        matrix, precondition = self.matrix, self._preconditioner
        rest, residual = np.zeros_like(load), load.copy()
        direction = precondition(residual)
        product, goal = _dot(residual, direction), TOLERANCE**2 * _dot(load, load)
        for iteration in range(MOST_ITERATIONS):
            if _dot(residual, residual) <= goal:
                return rest, iteration
            image = matrix @ direction
            step = product / _dot(direction, image)
            rest += step * direction
            residual -= step * image
            scaled = precondition(residual)
            product, before = _dot(residual, scaled), product
            direction = scaled + product / before * direction
        raise FluxError(
            f"solve: conjugate gradients did not converge in {MOST_ITERATIONS} iterations. The mesh has very "
            "flat cells or the optics differ by many decades; mesh again or use a larger edge."
        )

    @cached_property
    def _preconditioner(self) -> Callable[[Array], Array]:
        """Inverse of the diagonal; for `repeated`, and the solution by linear elements added to it.

        A function that is linear in the cells has the mean of its ends at the middles of edges. With P that map,
        P K₁⁻¹ Pᵀ, K₁ = PᵀKP, solves for all that is smooth, and the diagonal for the rest.
        """
        jacobi = 1 / self.matrix.diagonal()
        if not self.repeated:
            return lambda residual: jacobi * residual
        linear = self._from_linear()
        solve = splu(csc_array(linear.T @ self.matrix @ linear), permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve
        return lambda residual: jacobi * residual + linear @ solve(linear.T @ residual)

    def _from_linear(self) -> Any:
        """(N, V) values at the nodes of functions that are linear in each cell, from those at its vertices."""
        count, basis, mesh = self.basis.mesh.nvertices, self.basis, self.basis.mesh
        rows, columns, values = [basis.nodal_dofs[0]], [np.arange(count)], [np.ones(count)]
        if self.element.maxdeg == 2:
            ends = np.asarray(mesh.edges)
            rows += [basis.edge_dofs[0], basis.edge_dofs[0]]
            columns += [ends[0], ends[1]]
            values += [np.full(ends.shape[1], 0.5)] * 2
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return csr_array(entries, shape=(basis.N, count))

    @cached_property
    def matrix(self) -> Any:
        """Sparse matrix (N, N) of the left side of the module's equation [mm]."""
        skfem = import_skfem()
        volume = skfem.BilinearForm(lambda u, v, w: self.diffusion * (u.grad * v.grad).sum(axis=0) + self.mua * u * v)
        surface = skfem.BilinearForm(lambda u, v, w: u * v / (2 * self.factor))
        return volume.assemble(self.basis) + surface.assemble(self.border)

    @staticmethod
    def _integrate(basis: Any, value: Array, gradient: Array | None = None) -> Array:
        """∫ (value · v + gradient · ∇v) for every test function v; `value` and `gradient` at the quadrature points."""
        skfem = import_skfem()
        if gradient is None:
            form = skfem.LinearForm(lambda v, w: value * v)
        else:
            form = skfem.LinearForm(lambda v, w: value * v + (gradient * v.grad).sum(axis=0))
        return np.asarray(form.assemble(basis))


def _dot(a: Array, b: Array) -> float:
    return float(np.einsum("i,i->", a, b))


def import_skfem() -> Any:
    """The module skfem.

    Raises
    ------
    BackendError : it is not installed.
    """
    try:
        import skfem
    except ImportError as cause:
        raise BackendError(
            f"flux solve: scikit-fem cannot be imported ({cause}). pip install 'mitsuba-fspt[tissue]'."
        ) from cause
    return skfem


def _split_rule(degree: int) -> tuple[Array, Array]:
    """Points (3, Q) and weights (Q,) on the reference tetrahedron: a rule of `degree` on each of its 64 equal parts."""
    skfem = import_skfem()
    parts = skfem.Basis(skfem.MeshTet1.init_refdom().refined(2), skfem.ElementTetP1(), intorder=degree)
    return np.asarray(parts.global_coordinates()).reshape(3, -1), parts.dx.ravel()


def _grid(skfem: Any, mesh: Tetrahedra, order: int) -> Any:
    """Mesh of scikit-fem; for order 2 and a curved border, with the midpoints of border edges on the true border."""
    straight = skfem.MeshTet1(np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.cells.T))
    if order == 1 or mesh.snap is None:
        return straight
    curved = skfem.MeshTet2.from_mesh(straight)
    middle = curved.dofs.edge_dofs[0, np.unique(curved.f2e[:, curved.boundary_facets()])]
    before = curved.doflocs[:, middle]
    curved.doflocs[:, middle] = mesh.snap(before.T).T
    # A flat cell can be inverted, or nearly; all its edges stay straight.
    points = skfem.ElementTetP2.doflocs.T
    bent = skfem.MappingIsoparametric(curved, skfem.ElementTetP2()).detDF(points)
    turned = (bent / straight.mapping().detDF(points)).min(axis=1) < 0.5
    back = np.isin(middle, curved.dofs.element_dofs[:, turned])
    curved.doflocs[:, middle[back]] = before[:, back]
    return curved


def _border_basis(skfem: Any, grid: Any, element: Any) -> Any:
    """Basis of the boundary facets, with exact local coordinates of their quadrature points in the cells.

    scikit-fem computes those of curved cells by Newton's method, which fails for flat cells and, by round-off, far
    from the origin.
    """
    if grid.affine:
        return skfem.FacetBasis(grid, element, intorder=BORDER_DEGREE)
    points, weights = skfem.quadrature.get_quadrature(skfem.ElementTriP1(), BORDER_DEGREE)
    facets = grid.boundary_facets()
    mapping = grid.mapping()

    def local_coordinates(_: Array, tind: Index) -> Array:
        corners = np.argmax(grid.t[:, None, tind] == grid.facets[:, facets], axis=0)
        reference = skfem.refdom.RefTet.p[:, corners]
        return np.einsum("dkf,kq->dfq", reference, np.stack([1 - points[0] - points[1], *points]))

    mapping.invF = local_coordinates
    return skfem.FacetBasis(grid, element, mapping, quadrature=(points, weights), facets=facets)
