"""Finite elements on a mesh, by scikit-fem, and their integrals, which serve all media and models of light."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from ..runtime.errors import BackendError
from .tetrahedra import Tetrahedra

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Degree of the quadrature on the border, where φ_f is no polynomial. Its error is that of the power balance of shallow
# sources (see `finite_elements`).
BORDER_DEGREE = 8
CELLS_AT_ONCE = 20_000  # of an assembly
CENTRE = np.full((3, 1), 0.25), np.array([1 / 6])  # quadrature of one point
SYMMETRIC = {"SymmetricMode": True}  # of SuperLU, for a matrix that is symmetric and positive definite


class Elements:
    """Elements of order 1 or 2 on a mesh: `basis` numbers the nodes, `border` has the quadrature of the border.

    Elements of order 2 have a curved border if the mesh has a `snap`.

    region : of each cell;  facet_region : of each facet of the border

    Raises
    ------
    BackendError : scikit-fem is missing.
    """

    def __init__(self, mesh: Tetrahedra, order: int) -> None:
        skfem = import_skfem()
        self._mesh = mesh
        self.element = skfem.ElementTetP2() if order == 2 else skfem.ElementTetP1()
        grid = _grid(skfem, mesh, order)
        self.basis = skfem.Basis(grid, self.element, quadrature=CENTRE, disable_doflocs=True)
        self.border = _border_basis(skfem, grid, self.element, self.basis.dofs)
        self.region = mesh.region
        self.facet_region = mesh.region[grid.f2t[0, self.border.find]]
        self.points = np.asarray(self.border.global_coordinates()).reshape(3, -1).T
        self.normals = np.asarray(self.border.normals).reshape(3, -1).T

    @property
    def nodes(self) -> int:
        """Their number N."""
        return int(self.basis.N)

    @property
    def regions(self) -> int:
        """Number of the regions of the mesh, R."""
        return int(self.region.max()) + 1

    @cached_property
    def linear(self) -> Elements:
        """Elements of order 1 on the same mesh."""
        return self if self.element.maxdeg == 1 else Elements(self._mesh, 1)

    @cached_property
    def _integrals(self) -> tuple[tuple[csr_array, ...], tuple[csr_array, ...]]:
        """∫ ∇u·∇v dV [mm] and ∫ u v dV [mm³] over each region, (N, N)."""
        each = [self._assembled(np.flatnonzero(self.region == region)) for region in range(self.regions)]
        stiffness, mass = zip(*each, strict=True)
        return stiffness, mass

    def _assembled(self, cells: Index) -> tuple[csr_array, csr_array]:
        """∫ ∇u·∇v dV and ∫ u v dV over some cells, by parts: the basis functions of all would take much memory."""
        stiffness, mass = (csr_array((self.nodes, self.nodes)) for _ in range(2))
        for start in range(0, len(cells), CELLS_AT_ONCE):
            basis = self.on_cells(cells[start : start + CELLS_AT_ONCE], intorder=2 * self.element.maxdeg)
            values = np.array([np.broadcast_to(np.asarray(one[0]), basis.dx.shape) for one in basis.basis])
            gradient = np.array([one[0].grad for one in basis.basis])  # (n, 3, T, Q)
            first = np.einsum("idtq,tq->tidq", gradient, basis.dx).reshape(len(basis.dx), len(values), -1)
            second = np.moveaxis(gradient, 2, 0).reshape(len(basis.dx), len(values), -1)
            dofs = basis.element_dofs
            stiffness += self._from_cells(dofs, first @ second.swapaxes(1, 2))
            local = np.einsum("itq,tq->tiq", values, basis.dx) @ np.moveaxis(values, 1, 0).swapaxes(1, 2)
            mass += self._from_cells(dofs, local)
        return stiffness, mass

    def _from_cells(self, dofs: Index, local: Array) -> csr_array:
        """Matrix (N, N) from those of cells (T, n, n), whose nodes are `dofs` (n, T)."""
        nodes = dofs.T.astype(np.int32)
        rows, columns = (np.broadcast_to(one, local.shape).ravel() for one in (nodes[:, :, None], nodes[:, None]))
        return csr_array((local.ravel(), (rows, columns)), shape=(self.nodes, self.nodes))

    def on_cells(self, cells: Index, **quadrature: Any) -> Any:
        """Basis on some cells, with their own quadrature."""
        return import_skfem().Basis(
            self.basis.mesh, self.element, elements=cells, dofs=self.basis.dofs, disable_doflocs=True, **quadrature
        )

    def assembled(self) -> Elements:
        """The same, once all is there that threads with the same elements would each make."""
        for one in (self, self.linear):
            one._integrals, one.border_mass, one.border_values  # noqa: B018
        self.from_linear  # noqa: B018
        return self

    def are_of(self, mesh: Tetrahedra, order: int) -> bool:
        """Whether these are the elements of this order on this mesh."""
        return self._mesh is mesh and self.element.maxdeg == order

    @property
    def stiffness(self) -> tuple[csr_array, ...]:
        """∫ ∇u·∇v dV [mm] over each region, (N, N)."""
        return self._integrals[0]

    @property
    def mass(self) -> tuple[csr_array, ...]:
        """∫ u v dV [mm³] over each region, (N, N)."""
        return self._integrals[1]

    @cached_property
    def volumes(self) -> Array:
        """(R, N) ∫ v dV [mm³] over each region."""
        return np.array([np.asarray(one.sum(axis=0)).ravel() for one in self.mass])

    def on_border(self, factor: Array) -> csr_array:
        """∮ factor u v dS, (N, N), for a `factor` at the facets' quadrature points, (F, Q) or (F, 1)."""
        skfem = import_skfem()
        return csr_array(skfem.BilinearForm(lambda u, v, w: factor * u * v).assemble(self.border))

    def along_border(self, factor: Array) -> csr_array:
        """∮ factor ∇_t u·∇_t v dS, (N, N), with the gradient ∇_t along the border; `factor` as for `on_border`."""
        border, normals = self.border, np.asarray(self.border.normals)
        along = np.array([one[0].grad - (one[0].grad * normals).sum(axis=0) * normals for one in border.basis])
        first, second = (np.moveaxis(each, 2, 0) for each in (along * (factor * border.dx), along))
        shape = len(first), len(along), -1
        return self._from_cells(border.element_dofs, first.reshape(shape) @ second.reshape(shape).swapaxes(1, 2))

    def on_facets(self, values: Array) -> Array:
        """(F, Q) at the quadrature points of the border's facets, linear between `values` (V,) at the vertices."""
        x, y = self.border.X
        corners = values[self.border.mesh.facets[:, self.border.find]]
        return np.einsum("kf,kq->fq", corners, np.stack([1 - x - y, x, y]))

    @cached_property
    def border_mass(self) -> tuple[csr_array, ...]:
        """∮ u v dS [mm²] over the border of each region, (N, N)."""
        return tuple(self.on_border(self.of_region(region)) for region in range(self.regions))

    def of_region(self, region: int) -> Array:
        """1 on the facets of a region, (F, 1)."""
        return (self.facet_region == region).astype(np.float64)[:, None]

    @cached_property
    def border_nodes(self) -> Index:
        """Nodes on the border."""
        return np.asarray(self.basis.dofs.get_facet_dofs(self.basis.mesh.boundary_facets()).flatten())

    @cached_property
    def border_values(self) -> Any:
        """Function that gives the values at the border's nodes of a function with these integrals ∮ f v dS."""
        nodes = self.border_nodes
        mass = sum(self.border_mass[1:], self.border_mass[0])[nodes][:, nodes]
        return splu(csc_array(mass), permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve

    @cached_property
    def from_linear(self) -> csr_array:
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

    @staticmethod
    def integrate(basis: Any, value: Array, gradient: Array | None = None) -> Array:
        """∫ (value · v + gradient · ∇v) for every test function v; `value` and `gradient` at the quadrature points."""
        skfem = import_skfem()
        if gradient is None:
            form = skfem.LinearForm(lambda v, w: value * v)
        else:
            form = skfem.LinearForm(lambda v, w: value * v + (gradient * v.grad).sum(axis=0))
        return np.asarray(form.assemble(basis))


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


def _border_basis(skfem: Any, grid: Any, element: Any, dofs: Any) -> Any:
    """Basis of the boundary facets, with exact local coordinates of their quadrature points in the cells.

    scikit-fem computes those of curved cells by Newton's method, which fails for flat cells and, by round-off, far
    from the origin.
    """
    if grid.affine:
        return skfem.FacetBasis(grid, element, intorder=BORDER_DEGREE, dofs=dofs, disable_doflocs=True)
    points, weights = skfem.quadrature.get_quadrature(skfem.ElementTriP1(), BORDER_DEGREE)
    facets = grid.boundary_facets()
    mapping = grid.mapping()

    def local_coordinates(_: Array, tind: Index) -> Array:
        corners = np.argmax(grid.t[:, None, tind] == grid.facets[:, facets], axis=0)
        reference = skfem.refdom.RefTet.p[:, corners]
        return np.einsum("dkf,kq->dfq", reference, np.stack([1 - points[0] - points[1], *points]))

    mapping.invF = local_coordinates
    return skfem.FacetBasis(
        grid, element, mapping, quadrature=(points, weights), facets=facets, dofs=dofs, disable_doflocs=True
    )
