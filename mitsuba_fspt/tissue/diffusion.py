"""Light in tissue by the SP3 equations or the diffusion equation (`light_models`), solved by finite elements.

The solution is split, φ = φ_f + w. φ_f is the closed-form field of the sources in infinite tissue that has the optical
coefficients at the source everywhere; it contains the singularity of point sources. The finite elements solve for the
smooth rest w only. Elements of both orders therefore converge at their full rate, and the mesh does not depend on the
positions of the sources.

    mesh = cylinder_tetrahedra(radius=15, height=30, edge=1.5)
    solution = solve(mesh, [Medium(0.0138, 0.91, 1.37)], [Source(Sphere((8, 0, 0)))], model="diffusion")
    solution.solved.exited                                # 0.3128 W of 1 W
    solution.phantom(edge=0.35).write("phantom.ply")
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..optics.media import Medium, Source, scattering_warning
from ..runtime.errors import FluxError
from .border_curvature import BorderShape
from .elements import Elements
from .finite_elements import Solved, System
from .free_field import SourceField
from .light_models import DEFAULT, Equations, equations
from .solution import TissueSolution
from .tetrahedra import OUTSIDE, Tetrahedra, depth

Progress = Callable[[str], None]
Array = NDArray[np.float64]
Index = NDArray[np.int64]

LOG = logging.getLogger("mitsuba_fspt")
LARGEST_IMBALANCE = 1e-5
SAME_INDEX = 0.035  # largest relative change of n inside the tissue that is not told: of water in tissue, 1.33 in 1.37
SMOOTHED = 1.0  # mean free paths over which the radiance at the border follows its curvature and creases


def solve(
    mesh: Tetrahedra,
    media: Sequence[Medium],
    sources: Sequence[Source],
    *,
    model: str = DEFAULT,
    a: str | float = "robin",
    order: int = 2,
    progress: Progress | None = None,
) -> TissueSolution:
    """Light in tissue on a mesh, with its power balance.

    Parameters
    ----------
    mesh : tetrahedra of the tissue; `media[label]` fills its region `label`
    media : absorption, reduced scattering and refractive index of each region; lines on stderr tell of a scattering
        that no soft tissue has, as of numbers in 1/cm, and of an index that changes inside the tissue
    sources : at least one; their shapes must lie inside the mesh
    model : "sp3" or "diffusion"
    a : boundary factor A of diffusion: 'robin' or 'haskell' (from the n of each region, see `optics.boundary`), or a
        number
    order : 1 or 2, of the tetrahedra
    progress : called with the name of each stage

    Raises
    ------
    FluxError : no source, a source outside the mesh or too close to its border, a region without medium, another
        order or model, a boundary factor beside "sp3", or no convergence.
    BackendError : scikit-fem or SciPy is missing.
    """
    report = progress or (lambda stage: None)
    report("assemble")
    tissue = Tissue(mesh, media, model=model, a=a, order=order)
    for warning in tissue.warnings():
        LOG.warning("fspt: solve: %s", warning)
    report("solve")
    return tissue.solve(sources)


class Tissue:
    """Tissue without sources: mesh, media, equations and the finite elements, which serve any sources.

    Arguments as of `solve`; `repeated`: it will be solved for many sources; `elements`: of the mesh, where they are
    known; `coarse`: as of `System`, where not `repeated`.

    Raises
    ------
    FluxError : a region without medium, another order or model, or a boundary factor beside "sp3".
    BackendError : scikit-fem or SciPy is missing.
    """

    def __init__(
        self,
        mesh: Tetrahedra,
        media: Sequence[Medium],
        *,
        model: str = DEFAULT,
        a: str | float = "robin",
        order: int = 2,
        repeated: bool = False,
        elements: Elements | None = None,
        coarse: System | None = None,
    ) -> None:
        if order not in (1, 2):
            raise FluxError(f"solve: 'order' must be 1 or 2, got {order}.")
        if mesh.region.min() < 0 or mesh.region.max() >= len(media):
            raise FluxError(
                f"solve: the mesh has regions {mesh.region.min()} to {mesh.region.max()}, media are given for 0 "
                f"to {len(media) - 1}. Give one a region."
            )
        self.mesh, self.media, self.model, self._a, self._order = mesh, tuple(media), model, a, order
        self.equations = equations(model, self.media, a)
        self.elements = elements or Elements(mesh, order)
        if not self.elements.are_of(mesh, order):
            raise FluxError(
                "solve: 'elements' are of another mesh or order. Leave them out, or give those of this mesh."
            )
        self._shape = self.border_shape if self.equations.bend.any() else BorderShape.flat(mesh)
        self._coarse = coarse
        if repeated:
            self._coarse = (self.linear if model == "diffusion" else self._of_order_1(model)).system
        self.system: System = System(self.elements, self.equations, self._shape, self._coarse)

    def warnings(self) -> list[str]:
        """Lines on a scattering that no soft tissue has, and on the largest change of n inside the tissue."""
        scattering = scattering_warning(self.media)
        lines = [scattering] if scattering else []
        n = np.array([medium.n for medium in self.media])[self.mesh.region]
        change = np.where(self.mesh.neighbours < 0, 1.0, n[self.mesh.neighbours] / n[:, None])
        cell, side = np.unravel_index(np.argmax(change), change.shape)
        if change[cell, side] > 1 + SAME_INDEX:
            lines.append(
                f"'n' changes from {n[cell]:g} to {n[self.mesh.neighbours[cell, side]]:g} inside the tissue. "
                "Reflection and refraction at such a border are left out, as only the n at the surface counts: between "
                "1 and 1.37 the computed power behind it is some 10 % too small or too large."
            )
        return lines

    @cached_property
    def border_shape(self) -> BorderShape:
        """Curvature and creases of the border, over the longest mean free path."""
        return BorderShape.of(self.mesh, SMOOTHED * max(1 / (medium.mua + medium.musp) for medium in self.media))

    @cached_property
    def linear(self) -> Tissue:
        """The same tissue with finite elements of order 1 under the diffusion equation: coarse, and fast."""
        return self._of_order_1("diffusion")

    def _of_order_1(self, model: str) -> Tissue:
        return Tissue(self.mesh, self.media, model=model, a=self._a, order=1, elements=self.elements.linear)

    def of_media(self, media: Sequence[Medium]) -> Tissue:
        """The same tissue and elements with other media; the coarse solution, if there is one, stays."""
        return Tissue(
            self.mesh,
            media,
            model=self.model,
            a=self._a,
            order=self._order,
            elements=self.elements,
            coarse=self._coarse,
        )

    def places(self, points: Array) -> tuple[Index, Array]:
        """Cells (N,) and local coordinates (N, 3) of `points` (N, 3) [mm], for `exitance_at` of any solution."""
        count = self.elements.nodes
        nothing = Solved(np.zeros((self.equations.components, count)), np.zeros(count), 0.0, 0.0, 0)
        return self._solution((), 0.0, nothing).places(points)

    def medium_at(self, points: Array) -> Index:
        """(N,) number of the first region with the equations of the tissue at `points` (N, 3) [mm]; -1 outside."""
        count = len(self.media)
        first = [next(k for k in range(count) if self.equations.same(k, label)) for label in range(count)]
        cells, local = self.mesh.locate(points)
        return np.where(depth(local) < -OUTSIDE, -1, np.array(first)[self.mesh.region[cells]])

    def solve(self, sources: Sequence[Source]) -> TissueSolution:
        """Solution for these sources; raises FluxError as `solve`."""
        fields = _free_fields(self.mesh, self.equations, sources)
        return self._balanced(fields, sources, self.system.solve(fields))

    def near(self, solution: TissueSolution, others: Sequence[tuple[Tissue, Sequence[Source]]]) -> list[TissueSolution]:
        """Solutions for slightly other media and sources, from one of this tissue, to the first order in the media.

        Raises FluxError as `solve`.
        """
        if any(tissue.elements is not self.elements or tissue.model != self.model for tissue, _ in others):
            raise FluxError("solve: a tissue near this one has other elements or another model. Make it by 'of_media'.")
        fields = [_free_fields(self.mesh, tissue.equations, sources) for tissue, sources in others]
        systems = [(tissue.system, own) for (tissue, _), own in zip(others, fields, strict=True)]
        each = zip(others, fields, self.system.near(solution.solved, systems), strict=True)
        return [tissue._balanced(own, sources, solved) for (tissue, sources), own, solved in each]

    def _balanced(self, fields: tuple[SourceField, ...], sources: Sequence[Source], solved: Solved) -> TissueSolution:
        """The solution; FluxError where its powers are not in balance."""
        solution = self._solution(fields, math.fsum(source.power for source in sources), solved)
        if not abs(solution.balance) <= LARGEST_IMBALANCE:
            raise FluxError(
                f"solve: absorbed + exited power is {1 + solution.balance:.6g} of the source's. A source is too close "
                f"to the border for mesh edges of {self.mesh.edge:.3g} mm; make them shorter than its depth."
            )
        return solution

    def _solution(self, fields: tuple[SourceField, ...], power: float, solved: Solved) -> TissueSolution:
        basis = self.elements.basis
        return TissueSolution(self.mesh, basis, self.media, self.equations, self._shape, fields, power, solved)


def _free_fields(mesh: Tetrahedra, equations: Equations, sources: Sequence[Source]) -> tuple[SourceField, ...]:
    """Free field of the sources of each region; every node of a source belongs to the region that contains it."""
    if not sources:
        raise FluxError("solve: there is no source. Give at least one.")
    parts = []
    for index, source in enumerate(sources, start=1):
        outside = depth(mesh.locate(source.shape.border())[1]) < -OUTSIDE
        if outside.any():
            raise FluxError(
                f"source {index}: {source.shape} reaches out of the tissue. Its power would be lost; move it inside."
            )
        nodes = source.shape.nodes(mesh.edge)
        label = mesh.region[mesh.locate(nodes.centres)[0]]
        parts.append((nodes.centres, nodes.radii, nodes.shares * source.power, label))
    centres, radii, powers, labels = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    fields = []
    for label in np.unique(labels):
        own = labels == label
        fields.append(SourceField.of(equations, int(label), centres[own], radii[own], powers[own]))
    return tuple(fields)
