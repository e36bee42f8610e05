"""Share of the area of each vertex or face that the pixels see, from the sensitivities of the columns alone.

A vertex on a crease may have faces on one side that no pixel sees. Its sensitivity is the sum over its sectors (see
`creases`), in each of which it is about that of the neighbours off the crease. Mirrors and windows, through which
pixels see a face, are in the sensitivities, too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..phantom.surface_mesh import face_areas
from .surface import Surface

Array = NDArray[np.float64]
# Of the largest sensitivity per area: the least that shows that a sector without neighbours off the creases is seen.
# Its sensitivity is a remainder, wrong by as much as the sensitivity of the other sectors changes over an edge.
REMAINDER = 0.1


def seen_share(surface: Surface, sensitivity: Array, least: float) -> Array:
    """Share (points,) of the area of each point that lies on faces that are seen.

    sensitivity : (points,) [mm²];  least : of the largest sensitivity per area, that at which a corner of a face counts
        as seen. A face is seen if its three corners are.
    """
    areas = surface.point_areas
    per_area = np.divide(sensitivity, areas, out=np.zeros_like(areas), where=areas > 0)
    if surface.on == "face":
        return (per_area >= least * per_area.max()).astype(np.float64)
    sectors, corners = surface.creases.sectors, surface.number[surface.faces]
    face_area = face_areas(surface.vertices, surface.faces)
    third = np.repeat(face_area / 3, 3)
    size = int(sectors.max()) + 1
    area = np.bincount(sectors.ravel(), third, size)
    vertex: NDArray[np.int64] = np.empty(size, np.int64)
    vertex[sectors] = corners
    alone = (np.bincount(vertex, minlength=surface.points) == 1)[vertex]
    found, shown = per_area[vertex], np.full(size, least)
    beside = np.where(alone[sectors], 1.0, 0.0) * face_area[:, None]  # weights of the corners of a face as neighbours
    weight = np.bincount(sectors.ravel(), (beside.sum(axis=1)[:, None] - beside).ravel(), size)
    shining = beside * found[sectors]
    light = np.bincount(sectors.ravel(), (shining.sum(axis=1)[:, None] - shining).ravel(), size)
    near, far = ~alone & (weight > 0), ~alone & ~(weight > 0)
    found[near] = light[near] / weight[near]
    rest = sensitivity - np.bincount(vertex[near], (area * found)[near], surface.points)
    unknown = np.bincount(vertex[far], area[far], surface.points)
    found[far] = rest[vertex[far]] / np.maximum(unknown[vertex[far]], np.finfo(float).tiny)
    shown[far] = REMAINDER
    seen = (found >= shown * per_area.max())[sectors].all(axis=1)
    part = np.bincount(corners.ravel(), third * np.repeat(seen, 3), surface.points)
    return np.divide(part, areas, out=np.zeros_like(areas), where=areas > 0)
