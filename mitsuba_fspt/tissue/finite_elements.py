"""Finite elements of diffusion or SP3 (`light_models`): matrix, load, solution and power balance, by scikit-fem.

With c_f, C_f the optics of the free field φ_f of the sources, the rest w = φ - φ_f satisfies for every test function v
and each component i, where repeated j are summed over,

    ∫ (c_i ∇w_i·∇v + C_ij w_j v) dV + ∮ H_ij w_j v dS
        = -∮ (H_ij φ_fj + c_fi ∂φ_fi/∂n) v dS - ∫ [(c_i - c_fi) ∇φ_fi·∇v + (C_ij - C_fij) φ_fj v] dV,

where the last integral runs over the regions whose optics differ from the source's. For i = 1 the border has also
∮ τ ∇_t w_1·∇_t v dS on the left and -∮ τ ∇_t φ_f1·∇_t v dS on the right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csr_array
from scipy.sparse.linalg import splu

from ..runtime.errors import BackendError, FluxError
from .free_field import SourceField
from .light_models import Equations
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
    """Rest w at the nodes, (m, N) [W/mm²], power absorbed inside and power leaving through the border [W].

    lateral : at the nodes of the border, (N,) [W/mm²], what J_n has beyond H φ: -∇_t·(τ ∇_t φ_1), and the flow along
        the border, f
    """

    rest: Array
    lateral: Array
    absorbed: float
    exited: float
    iterations: int


class System:
    """Discrete problem on one mesh: `basis` of the cells, `border` basis of the boundary facets.

    `equations` of the mesh's regions; `curvature` of the border at the vertices [1/mm]; `order` is 1 or 2. Elements of
    order 2 have a curved border if the mesh has a `snap`. `repeated`: many sources will be solved for, so that factors
    of the matrix of linear elements, once, take less time than iterations without them.

    Raises
    ------
    BackendError : scikit-fem or SciPy is missing.
    """

    def __init__(
        self, mesh: Tetrahedra, order: int, equations: Equations, curvature: Array, repeated: bool = False
    ) -> None:
        skfem = import_skfem()
        self.element = skfem.ElementTetP2() if order == 2 else skfem.ElementTetP1()
        self.equations, self.repeated = equations, repeated
        grid = _grid(skfem, mesh, order)
        self.basis = skfem.Basis(grid, self.element, intorder=2 * order)
        self.border = _border_basis(skfem, grid, self.element)
        self.region = mesh.region  # of each cell
        region = mesh.region[grid.f2t[0, self.border.find]]
        self.outward = self._outward(region, curvature)
        self.lateral = equations.lateral[region, None]  # τ of the facets
        self._flows = equations.flow[region, None], equations.spread[region, None]  # a, b

    def _outward(self, region: Index, curvature: Array) -> Array:
        """H at the quadrature points of the boundary facets, (m, m, F, Q)."""
        x, y = self.border.X
        corners = curvature[self.border.mesh.facets[:, self.border.find]]
        values = np.einsum("kf,kq->fq", corners, np.stack([1 - x - y, x, y]))
        matrix = self.equations.border_at(np.repeat(region, len(x)), values.ravel())
        return np.asarray(np.moveaxis(matrix, 0, 2).reshape(*matrix.shape[1:], *values.shape))

    def solve(self, fields: Sequence[SourceField]) -> Solved:
        """Rest w = φ − φ_f, where φ_f is the sum of the sources' free fields, with the absorbed and the exit power.

        Raises
        ------
        FluxError : no convergence.
        """
        load, exited, absorbed = np.zeros((self.equations.components, self.basis.N)), 0.0, 0.0
        lateral, through = np.zeros(self.basis.N), np.zeros(self.basis.N)
        for field in fields:
            values, flux, outflow, along = self._on_border(field)
            outward = np.einsum("ijfq,jfq->ifq", self.outward, values)
            for i, total in enumerate(outward + flux):
                load[i] -= self._integrate(self.border, total)
            if self.lateral.any():
                lateral += self._integrate(self.border, np.zeros_like(outflow), self.lateral * along)
                through += self._integrate(self.border, outward[0])
            exited += (outward[0] * self.border.dx).sum()
            # Σ C_1j φ_fj is the divergence of c_1 ∇φ_f1 + P r/(4πr³), a field without singularity.
            absorbed += ((flux[0] + outflow) * self.border.dx).sum()
            other, difference = self._in_other_regions(field)
            load -= other
            absorbed += difference
        load[0] -= lateral
        rest, iterations = self._conjugate_gradients(load.ravel())
        rest = rest.reshape(load.shape)
        for j, component in enumerate(rest):
            inside, outside = self.basis.interpolate(component), self.border.interpolate(component)
            absorbed += (self._reaction(0, j) * inside * self.basis.dx).sum()
            flux = self.outward[0, j] * outside
            exited += (flux * self.border.dx).sum()
            if self.lateral.any():
                through += self._integrate(self.border, flux)
        if self.lateral.any():
            lateral = self._flow(lateral + self._along(self.lateral) @ rest[0], through)
        return Solved(rest, lateral, float(absorbed), float(exited), iterations)

    def _reaction(self, i: int, j: int) -> Array:
        """C_ij [1/mm] of each cell, (T, 1), to broadcast over its quadrature points."""
        return np.asarray(self.equations.reaction[self.region, i, j, None])

    def _on_border(self, field: SourceField) -> tuple[Array, Array, Array, Array]:
        """φ_f and c_f ∂φ_f/∂n (m, F, Q), P n·r/(4πr³) (F, Q) [W/mm²], ∇_t φ_f1 (3, F, Q) at the facets' nodes."""
        points = np.asarray(self.border.global_coordinates())
        normals = np.asarray(self.border.normals).reshape(3, -1).T
        values, gradient, outflow = field.with_gradient(points.reshape(3, -1).T)
        slope = np.einsum("ind,nd->in", gradient, normals)
        flux = field.diffusion[:, None] * slope
        through = (outflow * normals).sum(axis=1)
        along = (gradient[0] - slope[0][:, None] * normals).T
        shape = points.shape[1:]
        return values.reshape(-1, *shape), flux.reshape(-1, *shape), through.reshape(shape), along.reshape(3, *shape)

    def _in_other_regions(self, field: SourceField) -> tuple[Array, float]:
        """∫ [(c - c_f) ∇φ_f·∇v + (C - C_f) φ_f v] dV of each test function (m, N), ∫ Σ (C - C_f)_1j φ_fj dV [W]."""
        equations = self.equations
        differs = np.array([not equations.same(region, field.region) for region in range(len(equations.diffusion))])
        other = np.flatnonzero(differs[self.region])
        load, power = np.zeros((equations.components, self.basis.N)), 0.0
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
            values, gradient, _ = field.with_gradient(points.reshape(3, -1).T)
            reaction = (equations.reaction - equations.reaction[field.region])[self.region[cells]]
            values = np.einsum("tij,jtq->itq", reaction, values.reshape(-1, *points.shape[1:]))
            diffusion = (equations.diffusion - equations.diffusion[field.region])[self.region[cells]]
            for i, (value, slope) in enumerate(zip(values, gradient, strict=True)):
                load[i] += self._integrate(basis, value, diffusion[:, i, None] * slope.T.reshape(points.shape))
            power += float((values[0] * basis.dx).sum())
        return load, power

    def _near(self, cells: Index, centres: Array) -> NDArray[np.bool_]:
        """True for each of the cells with one of the `centres` within two cell radii of its centroid."""
        from scipy.spatial import cKDTree

        corners = self.basis.mesh.p[:, self.basis.mesh.t[:, cells]]
        middle = corners.mean(axis=1)
        size = np.linalg.norm(corners - middle[:, None], axis=0).max(axis=0)
        return np.asarray(cKDTree(centres).query(middle.T)[0] < 2 * size)

    def _conjugate_gradients(self, load: Array) -> tuple[Array, int]:
        """Solution of the linear system, shape (m N,), with `_preconditioner`, and the number of iterations.

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
        P K₁⁻¹ Pᵀ, K₁ = PᵀKP, solves for all that is smooth, and the diagonal for the rest. Only φ₁ has such a part:
        φ₂ decays within a mean free path, and its matrix is close to one of masses.
        """
        jacobi = 1 / self.matrix.diagonal()
        if not self.repeated:
            return lambda residual: jacobi * residual
        linear, count = self._from_linear(), self.basis.N
        first = linear.T @ self.matrix[:count, :count] @ linear
        solve = splu(csc_array(first), permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve

        def precondition(residual: Array) -> Array:
            result = jacobi * residual
            result[:count] += linear @ solve(linear.T @ residual[:count])
            return result

        return precondition

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
        """Sparse matrix (m N, m N) of the left side of the module's equation [mm], component after component."""
        count = self.equations.components
        blocks = [[None] * count for _ in range(count)]
        for i in range(count):
            for j in range(i, count):
                blocks[i][j] = blocks[j][i] = self._block(i, j)
        return csr_array(block_array(blocks, format="csr"))

    def _block(self, i: int, j: int) -> Any:
        """Part (N, N) of the matrix that takes component j to equation i; it is symmetric."""
        skfem = import_skfem()
        reaction, diffusion = self._reaction(i, j), self.equations.diffusion[self.region, i, None]
        border = self.outward[i, j]
        surface = skfem.BilinearForm(lambda u, v, w: border * u * v)
        if i == j:
            volume = skfem.BilinearForm(lambda u, v, w: diffusion * (u.grad * v.grad).sum(axis=0) + reaction * u * v)
        else:
            volume = skfem.BilinearForm(lambda u, v, w: reaction * u * v)
        matrix = volume.assemble(self.basis) + surface.assemble(self.border)
        return matrix + self._along(self.lateral) if i == j == 0 and self.lateral.any() else matrix

    def _along(self, factor: Array) -> Any:
        """∮ factor ∇_t u·∇_t v dS, (N, N)."""
        skfem = import_skfem()

        def form(u: Any, v: Any, w: Any) -> Any:
            across = (u.grad * w.n).sum(axis=0) * (v.grad * w.n).sum(axis=0)
            return factor * ((u.grad * v.grad).sum(axis=0) - across)

        return skfem.BilinearForm(form).assemble(self.border)

    @cached_property
    def _flow(self) -> Callable[[Array, Array], Array]:
        """From integrals of -∇_t·(τ ∇_t φ_1) v and of H φ v over the border, (N,) each, to `Solved.lateral`."""
        skfem = import_skfem()
        nodes = self.basis.get_dofs(self.basis.mesh.boundary_facets()).flatten()
        mass = skfem.BilinearForm(lambda u, v, w: u * v).assemble(self.border)[nodes][:, nodes]
        along, spread = (self._along(factor)[nodes][:, nodes] for factor in self._flows)
        plain, smooth = (
            splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve
            for matrix in (mass, mass + spread)
        )

        def flow(lateral: Array, through: Array) -> Array:
            values = np.zeros_like(lateral)
            flux = plain((lateral + through)[nodes])
            values[nodes] = plain(lateral[nodes]) - smooth(along @ flux)
            return values

        return flow

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
