"""Finite elements of diffusion or SP3 (`light_models`): matrix, load, solution and power balance, by scikit-fem.

With c_f, C_f the optics of the free field φ_f of the sources, the rest w = φ - φ_f satisfies for every test function v
and each component i, where repeated j are summed over,

    ∫ (c_i ∇w_i·∇v + C_ij w_j v) dV + ∮ H_ij w_j v dS
        = -∮ (H_ij φ_fj + c_fi ∂φ_fi/∂n) v dS - ∫ [(c_i - c_fi) ∇φ_fi·∇v + (C_ij - C_fij) φ_fj v] dV,

where the last integral runs over the regions whose optics differ from the source's. For i = 1 the border has also
∮ τ ∇_t w_1·∇_t v dS on the left and -∮ τ ∇_t φ_f1·∇_t v dS on the right. τ, a and b are those of `light_models` times
the share of `border_curvature` that is left near creases.
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

from ..runtime.errors import FluxError
from ..runtime.interrupt import end_if_asked
from .border_curvature import BorderShape
from .elements import SYMMETRIC, Elements
from .free_field import SourceField
from .graded_rule import even_rule, graded_rule, is_wide
from .light_models import Equations
from .sparse_factor import Solve, factor

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Relative residual of the linear system: far from the sources φ is nine decades below its peak and must keep digits.
TOLERANCE = 1e-13
CHANGE_TOLERANCE = 1e-7  # of the system for a small change of the solution, which needs fewer digits
MOST_ITERATIONS = 5000


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


@dataclass(frozen=True, eq=False)
class _Load:
    """Right side (m N,) of the module's equation, and what the free fields have of the numbers of `Solved`.

    lateral, through : ∮ τ ∇_t φ_f1·∇_t v dS and ∮ H_1j φ_fj v dS, (N,) [W]
    """

    right: Array
    lateral: Array
    through: Array
    absorbed: float
    exited: float


class System:
    """Discrete problem of the `equations` of the mesh's regions on its `elements`.

    shape : of the border
    coarse : system of linear elements of these equations or similar ones, whose solutions make iterations fewer: for
        many sources, since its factors take longer than the solution for a few; None without
    """

    def __init__(
        self, elements: Elements, equations: Equations, shape: BorderShape, coarse: System | None = None
    ) -> None:
        self.elements, self.equations = elements, equations
        self._coarse = coarse
        self._shape = shape
        self.outward = self._outward(elements.facet_region)

    def _outward(self, region: Index) -> Array:
        """H at the quadrature points of the boundary facets, (m, m, F, Q)."""
        values = self.elements.on_facets(self._shape.curvature)
        matrix = self.equations.border_at(np.repeat(region, values.shape[1]), values.ravel())
        return np.asarray(np.moveaxis(matrix, 0, 2).reshape(*matrix.shape[1:], *values.shape))

    def solve(self, fields: Sequence[SourceField]) -> Solved:
        """Rest w = φ − φ_f, where φ_f is the sum of the sources' free fields, with the absorbed and the exit power.

        Raises
        ------
        FluxError : no convergence.
        """
        load = self._load(fields)
        rest, iterations = self._conjugate_gradients(load.right[:, None], TOLERANCE)
        return self._solved(load, rest[:, 0], iterations)

    def near(self, solved: Solved, others: Sequence[tuple[System, Sequence[SourceField]]]) -> list[Solved]:
        """Solutions of other systems, of about these equations, for other fields, from the solution `solved` of this.

        To the first order in the change of the equations (M.52): K δw = f' − K' w. K' is not inverted.
        """
        before = solved.rest.ravel()
        loads = [system._load(fields) for system, fields in others]
        right = np.column_stack(
            [load.right - system.image(before) for (system, _), load in zip(others, loads, strict=True)]
        )
        change, iterations = self._conjugate_gradients(right, CHANGE_TOLERANCE)
        each = zip(others, loads, change.T, strict=True)
        return [system._solved(load, before + one, iterations) for (system, _), load, one in each]

    def _load(self, fields: Sequence[SourceField]) -> _Load:
        """Right side for these fields."""
        elements = self.elements
        border, count = elements.border, elements.nodes
        load, exited, absorbed = np.zeros((self.equations.components, count)), 0.0, 0.0
        lateral, through = np.zeros(count), np.zeros(count)
        for field in fields:
            values, flux, outflow, along = self._on_border(field)
            outward = np.einsum("ijfq,jfq->ifq", self.outward, values)
            for i, total in enumerate(outward + flux):
                load[i] -= elements.integrate(border, total)
            if self._has_lateral:
                factor = self.equations.lateral[elements.facet_region, None] * self._share
                lateral += elements.integrate(border, np.zeros_like(outflow), factor * along)
                through += elements.integrate(border, outward[0])
            exited += (outward[0] * border.dx).sum()
            # Σ C_1j φ_fj is the divergence of c_1 ∇φ_f1 + P r/(4πr³), a field without singularity.
            absorbed += ((flux[0] + outflow) * border.dx).sum()
            other, difference = self._in_other_regions(field)
            load -= other
            absorbed += difference
        load[0] -= lateral
        return _Load(load.ravel(), lateral, through, absorbed, exited)

    def _solved(self, load: _Load, rest: Array, iterations: int) -> Solved:
        """Solution with the rest w (m N,)."""
        rest = rest.reshape(self.equations.components, -1)
        absorbed, through = load.absorbed, np.zeros(self.elements.nodes)
        for j, component in enumerate(rest):
            absorbed += float(self._of_regions(self.equations.reaction[:, 0, j]) @ (self.elements.volumes @ component))
            through += self._border[0][j] @ component
        lateral = load.lateral
        if self._has_lateral:
            lateral = self._flow(lateral + self._along(self.equations.lateral) @ rest[0], load.through + through)
        return Solved(rest, lateral, float(absorbed), float(load.exited + through.sum()), iterations)

    @property
    def _has_lateral(self) -> bool:
        return bool(self.equations.lateral.any())

    def _of_regions(self, values: Array) -> Array:
        """Of the regions that the mesh has, (R,)."""
        return values[: self.elements.regions]

    def _on_border(self, field: SourceField) -> tuple[Array, Array, Array, Array]:
        """φ_f and c_f ∂φ_f/∂n (m, F, Q), P n·r/(4πr³) (F, Q) [W/mm²], ∇_t φ_f1 (3, F, Q) at the facets' nodes."""
        normals, shape = self.elements.normals, self.elements.border.dx.shape
        values, gradient, outflow = field.with_gradient(self.elements.points)
        slope = np.einsum("ind,nd->in", gradient, normals)
        flux = field.diffusion[:, None] * slope
        through = (outflow * normals).sum(axis=1)
        along = (gradient[0] - slope[0][:, None] * normals).T
        return values.reshape(-1, *shape), flux.reshape(-1, *shape), through.reshape(shape), along.reshape(3, *shape)

    def _in_other_regions(self, field: SourceField) -> tuple[Array, float]:
        """∫ [(c - c_f) ∇φ_f·∇v + (C - C_f) φ_f v] dV of each test function (m, N), ∫ Σ (C - C_f)_1j φ_fj dV [W]."""
        equations, elements = self.equations, self.elements
        differs = np.array([not equations.same(region, field.region) for region in range(len(equations.diffusion))])
        other = np.flatnonzero(differs[elements.region])
        load, power = np.zeros((equations.components, elements.nodes)), 0.0
        if not other.size:
            return load, power
        for cells, rule in self._rules(other, field):
            if len(cells) == 0:
                continue
            basis = elements.on_cells(cells, **rule)
            points = np.asarray(basis.global_coordinates())
            values, gradient, _ = field.with_gradient(points.reshape(3, -1).T)
            region = elements.region[cells]
            reaction = (equations.reaction - equations.reaction[field.region])[region]
            values = np.einsum("tij,jtq->itq", reaction, values.reshape(-1, *points.shape[1:]))
            diffusion = (equations.diffusion - equations.diffusion[field.region])[region]
            for i, (value, slope) in enumerate(zip(values, gradient, strict=True)):
                load[i] += elements.integrate(basis, value, diffusion[:, i, None] * slope.T.reshape(points.shape))
            power += float((values[0] * basis.dx).sum())
        return load, power

    def _rules(self, cells: Index, field: SourceField) -> list[tuple[Index, dict[str, Any]]]:
        """The cells in groups, each with its quadrature: ∇φ_f is steep near a source, and about 1/r² at it."""
        degree = 2 * self.elements.element.maxdeg
        near = self._near(cells, field.centres)
        mesh, radii = self.elements.basis.mesh, field.modes[0].radii
        corners = mesh.p.T[mesh.t.T[cells[near]]]
        wide = is_wide(corners, field.centres, radii)
        graded = [graded_rule(one, field.centres, radii, degree) for one in corners[wide]]
        return [
            (cells[~near], {"intorder": degree}),
            (cells[near][~wide], {"quadrature": even_rule(degree)}),
            *((one, {"quadrature": rule}) for one, rule in zip(cells[near][wide][:, None], graded, strict=True)),
        ]

    def _near(self, cells: Index, centres: Array) -> NDArray[np.bool_]:
        """True for each of the cells with one of the `centres` within two cell radii of its centroid."""
        from scipy.spatial import cKDTree

        mesh = self.elements.basis.mesh
        corners = mesh.p[:, mesh.t[:, cells]]
        middle = corners.mean(axis=1)
        size = np.linalg.norm(corners - middle[:, None], axis=0).max(axis=0)
        return np.asarray(cKDTree(centres).query(middle.T)[0] < 2 * size)

    def _conjugate_gradients(self, load: Array, tolerance: float) -> tuple[Array, int]:
        """Solutions of the linear system for each column, shape (m N, k), with `_preconditioner`, and the iterations.

        SciPy's conjugate gradients take dot products by threaded BLAS, whose threads wait for each other on a busy
        machine: five times the time.
        """
        precondition, active = self._preconditioner, np.arange(load.shape[1])
        rest, residual = np.zeros_like(load), load.copy()
        direction = precondition(residual)
        product, goal = _dots(residual, direction), tolerance**2 * _dots(load, load)
        for iteration in range(MOST_ITERATIONS):
            end_if_asked()
            going = ~(_dots(residual, residual) <= goal[active])  # also where it is no number
            if not going.all():
                active = active[going]
                residual, direction, product = residual[:, going], direction[:, going], product[going]
            if not active.size:
                return rest, iteration
            image = self._applied(direction)
            step = product / _dots(direction, image)
            rest[:, active] += step * direction
            residual -= step * image
            scaled = precondition(residual)
            product, before = _dots(residual, scaled), product
            direction = scaled + product / before * direction
        raise FluxError(
            f"solve: conjugate gradients did not converge in {MOST_ITERATIONS} iterations. The mesh has very "
            "flat cells or the optics differ by many decades; mesh again or use a larger edge."
        )

    @cached_property
    def _preconditioner(self) -> Callable[[Array], Array]:
        """Inverse of the diagonal; where there is a `coarse` system, the solution of each component by it is added.

        A function that is linear in the cells has the mean of its ends at the middles of edges. With P that map,
        P K₁⁻¹ Pᵀ solves for all that is smooth, and the diagonal for the rest.
        """
        jacobi = 1 / np.concatenate([row[i].diagonal() for i, row in enumerate(self._blocks)])[:, None]
        if self._coarse is None:
            return lambda residual: jacobi * residual
        linear, factors, count = self.elements.from_linear, self._coarse.factors, self.elements.nodes
        transposed = csr_array(linear.T)

        def precondition(residual: Array) -> Array:
            result = jacobi * residual
            for i, solve in enumerate(factors):
                own = slice(i * count, (i + 1) * count)
                result[own] += linear @ solve(transposed @ residual[own])
            return np.asarray(result)

        return precondition

    @cached_property
    def matrix(self) -> Any:
        """Sparse matrix (m N, m N) of the left side of the module's equation [mm], component after component."""
        return csr_array(block_array(self._blocks, format="csr"))

    @cached_property
    def factors(self) -> tuple[Solve, ...]:
        """Solution for each component alone, of linear elements, by factors of its matrix."""
        points = self.elements.basis.mesh.p.T
        return tuple(factor(row[i], points) for i, row in enumerate(self._blocks))

    @cached_property
    def _blocks(self) -> list[list[csr_array]]:
        """Parts (N, N) of the matrix that take component j to equation i; they are symmetric."""
        count = self.equations.components
        half = {(i, j): self._block(i, j) for i in range(count) for j in range(i, count)}
        return [[half[min(i, j), max(i, j)] for j in range(count)] for i in range(count)]

    def _block(self, i: int, j: int) -> csr_array:
        matrix = self._border[i][j]
        for region, mass in enumerate(self.elements.mass):
            matrix = matrix + self.equations.reaction[region, i, j] * mass
        if i == j:
            for region, stiffness in enumerate(self.elements.stiffness):
                matrix = matrix + self.equations.diffusion[region, i] * stiffness
        if i == j == 0 and self._has_lateral:
            matrix = matrix + self._along(self.equations.lateral)
        return csr_array(matrix)

    @cached_property
    def _border(self) -> list[list[csr_array]]:
        """∮ H_ij u v dS, (N, N), of the components."""
        of, components = self.equations.border, range(self.equations.components)
        blocks = [[self._sum(of[:, i, j], self.elements.border_mass) for j in components] for i in components]
        if self.equations.bend.any():  # H_11 depends on the place
            blocks[0][0] = self.elements.on_border(self.outward[0, 0])
        return blocks

    def _along(self, factor: Array) -> csr_array:
        """∮ factor s ∇_t u·∇_t v dS, (N, N), for a factor of each region, s the share that is left near creases."""
        return self._sum(factor, self._border_stiffness)

    @cached_property
    def _border_stiffness(self) -> tuple[csr_array, ...]:
        elements = self.elements
        own = (elements.of_region(region) * self._share for region in range(elements.regions))
        return tuple(elements.along_border(factor) for factor in own)

    @cached_property
    def _share(self) -> Array:
        """(F, Q) at the nodes of the facets."""
        return self.elements.on_facets(self._shape.along)

    def _sum(self, factors: Array, matrices: Sequence[csr_array]) -> csr_array:
        """Σ over the regions."""
        each = [factor * one for factor, one in zip(self._of_regions(factors), matrices, strict=True)]
        return csr_array(sum(each[1:], each[0]))

    def _applied(self, values: Array) -> Array:
        """The matrix times values (m N, k)."""
        parts = np.split(values, self.equations.components)
        return np.concatenate(
            [sum(block @ part for block, part in zip(row, parts, strict=True)) for row in self._blocks]
        )

    def image(self, values: Array) -> Array:
        """The matrix times values (m N,), without the matrix."""
        elements, equations = self.elements, self.equations
        parts = np.split(values, equations.components)
        result = [sum(self._border[i][j] @ part for j, part in enumerate(parts)) for i in range(len(parts))]
        if self._has_lateral:
            result[0] = result[0] + self._along(equations.lateral) @ parts[0]
        for region, (stiffness, mass) in enumerate(zip(elements.stiffness, elements.mass, strict=True)):
            masses = [mass @ part for part in parts]
            for i, part in enumerate(parts):
                result[i] = result[i] + equations.diffusion[region, i] * (stiffness @ part)
                result[i] += sum(equations.reaction[region, i, j] * one for j, one in enumerate(masses))
        return np.concatenate(result)

    @cached_property
    def _flow(self) -> Callable[[Array, Array], Array]:
        """From integrals of -∇_t·(τ ∇_t φ_1) v and of H φ v over the border, (N,) each, to `Solved.lateral`."""
        elements, nodes = self.elements, self.elements.border_nodes
        mass = self._sum(np.ones(elements.regions), elements.border_mass)
        plain, along = elements.border_values, self._along(self.equations.flow)[nodes][:, nodes]
        spread = (mass + self._along(self.equations.spread))[nodes][:, nodes]
        smooth = splu(csc_array(spread), permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC).solve

        def flow(lateral: Array, through: Array) -> Array:
            values = np.zeros_like(lateral)
            flux = plain((lateral + through)[nodes])
            values[nodes] = plain(lateral[nodes]) - smooth(along @ flux)
            return values

        return flow


def _dots(a: Array, b: Array) -> Array:
    """(k,) dot products of the columns."""
    return np.asarray(np.einsum("nk,nk->k", a, b))
