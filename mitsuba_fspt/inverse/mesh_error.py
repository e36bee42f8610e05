"""What J_n between the vertices adds to the images: the mean error of the linear interpolation on faces (Eq. M.42).

J_n is linear on faces, that of a body is curved. Where second derivatives do not change over a triangle, J_n exceeds
the linear function of its values at the corners by −(1/24) Σ eᵀ∇∇J e on average, over the three edges e. Pixels see
little of how this is distributed within a triangle: it shifts J_n of the fit as a change of J_n at the vertices does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..phantom.surface_mesh import face_areas
from .surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeshError:
    """Mean error of J_n on the faces.

    columns : (n,) [W/mm²], as a change of J_n on the columns of the matrix
    edge : [mm], mean length of the edges, those of the faces with the largest errors counting most
    """

    columns: Array
    edge: float

    @classmethod
    def of(cls, surface: Surface, exitance: Array) -> MeshError:
        """Error for J_n (n,) [W/mm²] on the columns."""
        points = surface.vertices[surface.faces]
        edges = np.roll(points, -1, axis=1) - points
        square = np.einsum("fki,fki->f", edges, edges)
        area = face_areas(surface.vertices, surface.faces)
        if surface.on == "face":
            face = columns = _of_constants(surface, exitance, square)
        else:
            face = -_second_differences(surface, exitance, points, edges, area) / 24
            corners = surface.number[surface.faces]
            sums = np.bincount(corners.ravel(), np.repeat(area * face / 3, 3), surface.points)
            areas = surface.point_areas
            columns = np.divide(sums, areas, out=np.zeros_like(areas), where=areas > 0)[surface.number]
        weight = area * np.abs(face)
        edge = float(np.sqrt(weight @ square / max(3 * weight.sum(), np.finfo(float).tiny)))
        return cls(columns, edge)


def _second_differences(surface: Surface, exitance: Array, points: Array, edges: Array, area: Array) -> Array:
    """(F,) Σ eᵀ∇∇J e over the edges e of each face: differences of the slopes at both ends, along the edge.

    The slope at a corner is the mean of ∇J over the faces around it, on the same side of the creases.
    """
    normal = np.cross(edges[:, 0], edges[:, 1])
    double = np.maximum(np.einsum("fi,fi->f", normal, normal), np.finfo(float).tiny)
    opposite = np.roll(edges, -1, axis=1)  # of corner k: from k + 1 to k + 2
    slope = np.einsum("fk,fki->fi", exitance[surface.faces], np.cross(normal[:, None], opposite)) / double[:, None]
    sectors = surface.creases.sectors
    weight, size = np.repeat(area, 3), int(sectors.max()) + 1
    total = np.maximum(np.bincount(sectors.ravel(), weight, size), np.finfo(float).tiny)
    sums = [np.bincount(sectors.ravel(), weight * np.repeat(slope[:, k], 3), size) for k in range(3)]
    corner = (np.stack(sums, axis=1) / total[:, None])[sectors]
    return np.asarray(np.einsum("fki,fki->f", np.roll(corner, -1, axis=1) - corner, edges))


def _of_constants(surface: Surface, exitance: Array, square: Array) -> Array:
    """(F,) the same for J_n constant on faces, of which `square` is Σ |e|²: −(Σ|e|²/72) ΔJ.

    The light of a face lies off its centre by the slope of J_n; over all faces, that is a change by the divergence.
    """
    whole = replace(surface, basis=None, kinds=None, chosen=None, nodes=None)
    operator, measure = whole.roughness
    return np.asarray(square / 72 * (operator @ exitance) / measure)
