"""Phantom: an emitting triangle surface [mm] with its exitance J_n [W/mm²] on vertices or faces.

phantom = Phantom(vertices, faces, exitance, "vertex", {"source": "my own code"})
phantom.power
phantom.write("mouse.ply")  # fspt_surface reads it as mesh_attribute vertex_exitance
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import ExitanceError, FluxError
from ..runtime.numbers import require_unmasked
from .formats.ply import attribute_name, read_ply, write_ply
from .formats.raw import Field, RawMesh
from .surface_mesh import Closure, Indices, Points, closure, face_areas

UNIT = "W/mm^2"
OTHER_UNIT = re.compile(r"(?<![a-z])[cnuµ]?m(?![a-z])")  # a length other than mm
# Range of the renderer's 32-bit numbers.
LEAST, LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
# Keys of the report and of the PLY's comments that no provenance may overwrite.
RESERVED = {
    *(
        "bounding_box",
        "area",
        "power",
        "min",
        "max",
        "zeros",
        "negatives",
        "removed_power",
        "removed_percent",
        "quantity",
    ),
    *("unit", "length_unit", "watertight", "outward", "per", "vertices", "faces"),
}


@dataclass(frozen=True, eq=False)
class Phantom:
    """Triangle surface with exitance, ready for a scene.

    Parameters
    ----------
    vertices : array, shape (V, 3) [mm]
    faces : array, shape (F, 3), indices of vertices from 0, counterclockwise seen from outside
    exitance : array, shape (V,) or (F,) as set by `per` [W/mm²], J_n, finite, >= 0; linear between vertices
    per : 'vertex' or 'face'
    provenance : origin of the values for the report and the PLY's comments: texts by keys of a single word
    negatives, removed_power : number of values that were negative and became 0, and their power [W], >= 0
    attribute : name of J_n in the file that it was read from, without the `_x` of the PLY property

    Raises
    ------
    ExitanceError : exitance is not finite, is negative, or lies beyond single precision.
    FluxError : the arrays do not fit each other, a key of the provenance is taken, or the surface has no area or
        vertices beyond single precision.
    """

    vertices: Points
    faces: Indices
    exitance: NDArray[np.float64]
    per: str
    provenance: Mapping[str, str] = field(default_factory=dict)
    negatives: int = 0
    removed_power: float = 0.0
    attribute: str = "exitance"

    def __post_init__(self) -> None:
        for name, kind in (("vertices", np.float64), ("faces", np.int64), ("exitance", np.float64)):
            require_unmasked(f"phantom: '{name}'", getattr(self, name), FluxError, "Fill it, for example with zeros.")
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=kind))
        if self.per not in ("vertex", "face"):
            raise FluxError(f"phantom: 'per' must be vertex or face, got '{self.per}'.")
        count = len(self.vertices if self.per == "vertex" else self.faces)
        if self.vertices.shape[1:] != (3,) or self.faces.shape[1:] != (3,) or self.exitance.shape != (count,):
            raise FluxError(
                f"phantom: vertices (V, 3), faces (F, 3) and exitance per {self.per} must fit, got shapes "
                f"{self.vertices.shape}, {self.faces.shape} and {self.exitance.shape}. Give one value each."
            )
        if len(self.faces) == 0 or self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise FluxError(f"phantom: faces must be numbers of the {len(self.vertices)} vertices. Count from 0.")
        for key in self.provenance:
            if key in RESERVED or key.split() != [key]:
                raise FluxError(f"phantom: '{key}' is taken or no single word. Name the provenance otherwise.")
        require_finite(self.exitance, self.per)
        require_single(self.exitance)
        if self.exitance.min() < 0:
            raise ExitanceError(f"exitance: must be >= 0, the least is {self.exitance.min():.6g} {UNIT}. Clip it.")
        if (far := np.abs(self.vertices[self.faces]).max()) > LARGEST:
            raise FluxError(f"phantom: a vertex lies at {far:.3g} mm, the renderer holds {LARGEST:.2g}. Scale it.")
        if not self.area > 0:
            raise FluxError(f"phantom: the surface has no area ({self.area:g} mm^2). Fix its vertices.")

    @cached_property
    def area(self) -> float:
        """Area of the surface [mm²]."""
        return float(face_areas(self.vertices, self.faces).sum())

    @cached_property
    def power(self) -> float:
        """Power Σ J_n A [W] over the faces; J_n on vertices contributes the mean over the corners of each face."""
        return float(shares(self.vertices, self.faces, self.per) @ self.exitance)

    @cached_property
    def bounds(self) -> tuple[Points, Points]:
        """Lowest and highest corner of the box around the faces, each of shape (3,) [mm]."""
        corners = self.vertices[self.faces].reshape(-1, 3)
        return corners.min(axis=0), corners.max(axis=0)

    @cached_property
    def closure(self) -> Closure:
        """Closure and orientation of the surface."""
        return closure(self.vertices, self.faces)

    def report(self) -> dict[str, object]:
        """Properties to check before use: numbers, booleans and texts by name, ready for JSON.

        bounding_box (its lowest and highest corner, x, y, z [mm]), area [mm²], power [W], min and max [W/mm²], zeros
        and negatives (numbers of values; negative ones have become zeros), watertight, outward (None: open,
        undecided), unit, removed_power [W], per, vertices, faces, and the provenance. `removed_percent` is relative to
        the remaining power, None if nothing remains.
        """
        return {
            "bounding_box": [[float(x) for x in corner] for corner in self.bounds],
            "area": self.area,
            "power": self.power,
            "min": float(self.exitance.min()),
            "max": float(self.exitance.max()),
            "zeros": int(np.count_nonzero(self.exitance == 0)),
            "negatives": self.negatives,
            "watertight": self.closure.watertight,
            "outward": self.closure.outward,
            "unit": UNIT,
            "removed_power": self.removed_power,
            "removed_percent": self._removed_percent(),
            "per": self.per,
            "vertices": len(self.vertices),
            "faces": len(self.faces),
            **self.provenance,
        }

    def _removed_percent(self) -> float | None:
        """Removed over remaining power [%]; None if the latter is 0."""
        if self.removed_power == 0:
            return 0.0
        return 100 * self.removed_power / self.power if self.power > 0 else None

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a binary PLY, completely or not at all, with the exitance as a property for Mitsuba's `ply` plugin.

        The property `exitance_x` becomes the mesh attribute `vertex_exitance` or `face_exitance`. Numbers are
        doubles. Comments state quantity, units, power and provenance.

        Raises
        ------
        FluxError : the suffix is not .ply, or the file cannot be written.
        """
        comments = {
            "quantity": "exitance",
            "unit": UNIT,
            "length_unit": "mm",
            "power": f"{self.power!r} W",
            "negatives": str(self.negatives),
            "removed_power": f"{self.removed_power!r} W",
            **self.provenance,
        }
        write_ply(Path(path), self.vertices, self.faces, {"exitance_x": self.exitance}, self.per, comments)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Phantom:
        """Phantom from a PLY, with bit-identical numbers if `write` wrote it.

        J_n is the property `exitance_x`, or else the only scalar of vertices or faces with a name that Mitsuba reads as
        a mesh attribute, such as `jn_x`, in W/mm².

        Raises
        ------
        FluxError : the file cannot be read, or its comments name other units.
        ExitanceError : the file has no such property, or several; `import_flux` reads others.
        """
        raw, comments = read_ply(Path(path))
        field = _exitance_field(raw, Path(path))
        own = "quantity" in comments  # of the comments that `write` writes; others are free text
        for key, expected in (("quantity", "exitance"), ("unit", UNIT), ("length_unit", "mm")):
            text = comments.pop(key, expected)
            if text != expected if own else OTHER_UNIT.search(text):
                raise FluxError(
                    f"'{path}': the {key} of a phantom must be {expected}, got '{text}'. Import it by fspt flux import."
                )
        try:
            negatives = int(comments.pop("negatives", "0"))
            removed = float(comments.pop("removed_power", "0 W").removesuffix(" W"))
        except ValueError as cause:
            raise FluxError(
                f"'{path}': its comments negatives and removed_power must be numbers. Import it anew."
            ) from cause
        comments = {key: text for key, text in comments.items() if key not in RESERVED}
        per, values = "vertex" if field.on == "vertex" else "face", field.values.astype(np.float64)
        return cls(raw.points, raw.cells, values, per, comments, negatives, removed, attribute_name(field.name))


def _exitance_field(raw: RawMesh, path: Path) -> Field:
    """The field with J_n, see `Phantom.read`; ExitanceError if none or several may be it."""
    grouped = [field for field in raw.fields if attribute_name(field.name)]
    found = [field for field in grouped if field.name == "exitance_x"] or grouped
    if len(found) != 1:
        names = ", ".join(f"'{f.name}' on {'vertices' if f.on == 'vertex' else 'faces'}" for f in raw.fields) or "none"
        twice = len({f.name for f in found}) < len(found)
        fix = "--field NAME" + " --per vertex (or face)" * twice
        raise ExitanceError(
            f"'{path}' must have one property with J_n, on vertices or on faces, and a name that Mitsuba reads, "
            f"'exitance_x' or 'jn_x'. It has: {names}. Make a phantom of it by fspt flux import {fix}."
        )
    return found[0]


def shares(vertices: Points, faces: Indices, per: str) -> NDArray[np.float64]:
    """Area that belongs to each value of J_n, shape (V,) or (F,) [mm²], so that Σ shares · J_n is the power.

    It is the area of the face, or a third of the areas of all faces at the vertex. The sum is the exact integral of a
    J_n that is linear on the faces.
    """
    areas = face_areas(vertices, faces)
    if per == "face":
        return areas
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), len(vertices)).astype(np.float64)


def require_finite(exitance: NDArray[np.float64], per: str) -> None:
    """Raise ExitanceError if a value is NaN or infinite; the message gives the index of the first."""
    finite = np.isfinite(exitance)
    if not finite.all():
        raise ExitanceError(
            f"exitance: {np.count_nonzero(~finite)} of {len(exitance)} values are NaN or inf, the first on "
            f"{per} {np.argmin(finite)} (counted from 0). Every value must be finite; repair the data."
        )


def require_single(exitance: NDArray[np.float64]) -> None:
    """Raise ExitanceError if the renderer's single precision would turn a value into inf, or all values into 0."""
    largest = float(np.abs(exitance).max(initial=0.0))
    if largest > LARGEST or 0 < largest < LEAST:
        raise ExitanceError(
            f"exitance: the largest value is {largest:.3g} {UNIT}, the renderer holds {LEAST:.2g} to "
            f"{LARGEST:.2g}. Check its unit, or scale it."
        )
