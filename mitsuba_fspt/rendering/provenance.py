"""Origin of a scene: its source, the values of its `<default>` parameters, and digests of its glowing meshes."""

from __future__ import annotations

import hashlib
import json
from base64 import b64decode, b64encode
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import polar

from ..runtime.plugin_types import is_lens, is_surface
from .scene_rules import is_number

if TYPE_CHECKING:
    import mitsuba as mi

Array = NDArray[np.float64]
BLOCKS = 15  # number of sums of weighted edge lengths in a digest, each over the same number of consecutive edges
TOLERANCE = 2e-5  # relative change of such a sum that float32 may cause when a mesh is moved


def remember_defaults(scene: mi.Scene, values: Mapping[str, str]) -> None:
    """Store the values of a scene's `<default>` parameters with its lenses, in place of those stored before."""
    for sensor in scene.sensors():
        if is_lens(sensor):
            sensor.defaults = getattr(sensor, "defaults", {}) | dict(values)


def remember_source(scene: mi.Scene, source: object, parameters: Mapping[str, object]) -> None:
    """Store the source of a scene, a file's name or XML text, and the given values with the scene's lenses."""
    for sensor in scene.sensors():
        if is_lens(sensor):
            sensor.source = source, dict(parameters)


def remember_placements(scene: mi.Scene, placements: Mapping[str, Array]) -> None:
    """Store `to_world` (4, 4) of the shapes, by their ids, with the scene's lenses."""
    for sensor in scene.sensors():
        if is_lens(sensor):
            sensor.placements = dict(placements)


def own_frame(scene: mi.Scene, shape: mi.Shape, vertices: Array) -> Array:
    """Vertices (V, 3) [mm] of a mesh of the scene before the rigid motion of its `to_world`, as in the mesh's file.

    Unchanged where the shape has no `to_world`, where that mirrors, and in scenes that `load` did not make.
    """
    to_world = _placement(scene, shape)
    rotation, _ = polar(to_world[:3, :3])  # without a scale, which is that of the file's unit of length
    return (vertices - to_world[:3, 3]) @ rotation if np.linalg.det(rotation) > 0 else vertices


def scale_of(scene: mi.Scene, shape: mi.Shape) -> float:
    """Factor by which `to_world` of a shape scales lengths; 1 without one, and in scenes that `load` did not make."""
    return float(np.cbrt(np.abs(np.linalg.det(_placement(scene, shape)[:3, :3]))))


def _placement(scene: mi.Scene, shape: mi.Shape) -> Array:
    """`to_world` (4, 4) of a shape; the identity where it has none, and in scenes that `load` did not make."""
    kept = (getattr(sensor, "placements", {}).get(shape.id()) for sensor in scene.sensors())
    return next((one for one in kept if one is not None), np.eye(4))


def source_of(scene: mi.Scene) -> tuple[Any, dict[str, object]] | None:
    """Source and values that `remember_source` has stored; None for a scene from another loader or a dictionary."""
    kept = (getattr(sensor, "source", None) for sensor in scene.sensors())
    return next((one for one in kept if one is not None), None)


def defaults_of(sensor: mi.Sensor) -> dict[str, float | str]:
    """Values of the `<default>` parameters of the lens's scene, as numbers where possible; empty if none are known.

    `load` stores them; a scene from Mitsuba's own loader has none.
    """
    return {name: value_of(text) for name, text in getattr(sensor, "defaults", {}).items()}


def value_of(text: str) -> float | str:
    """Number that a text represents, an int if it is written as one; any other text unchanged."""
    if not is_number(text):
        return text
    number = float(text)
    return int(number) if number.is_integer() and text.strip().lstrip("+-").isdigit() else number


def origin_of(scene: mi.Scene, sensor: mi.Sensor) -> dict[str, str]:
    """Metadata of an image: `scene`, `parameters` (JSON of the scene's `<default>` values) and `mesh_digest`."""
    found = {"scene": scene.id()}
    if defaults := defaults_of(sensor):
        found["parameters"] = json.dumps(defaults)
    if digest := scene_digest(scene):
        found["mesh_digest"] = digest
    return found


def scene_digest(scene: mi.Scene) -> str:
    """Digests of all glowing meshes of a scene, in the order of its emitters; empty if there is none."""
    shapes = [(emitter, emitter.get_shape()) for emitter in scene.emitters()]
    return " ".join(digest_of(emitter, shape) for emitter, shape in shapes if shape is not None and shape.is_mesh())


def digest_of(emitter: Any, mesh: mi.Shape) -> str:
    """Digest of the mesh of an emitter, computed once for each state of the mesh."""
    from ..jit.mesh_buffers import triangles

    buffers = triangles(mesh)
    known = getattr(emitter, "digest", None)
    if known and [buffer.index for buffer in known[0]] == [buffer.index for buffer in buffers]:
        return known[1]
    positions, faces = (buffer.numpy() for buffer in buffers)
    digest = mesh_digest(positions.reshape(-1, 3), faces.reshape(-1, 3))
    if is_surface(emitter):
        emitter.digest = buffers, digest
    return digest


def mesh_digest(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> str:
    """Digest of a mesh, the same before and after any rigid motion but for rounding; `same_mesh` compares two of them.

    It consists of a hash of the faces (F, 3) and of float32 numbers: sums of edge lengths with weights 1 … 2, and the
    volume between the faces and their middle point, which has the opposite sign for a mirror image.
    """
    corners = vertices.astype(np.float64)[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    lengths = np.sqrt((edges * edges).sum(axis=-1)).ravel()
    weights = 1 + np.random.default_rng(1).random(len(lengths))
    sums = np.array([part.sum() for part in np.array_split(weights * lengths, BLOCKS)])
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    numbers = np.append(sums, volume).astype("<f4")
    hashed = hashlib.sha256(np.ascontiguousarray(faces, "<u4").tobytes()).hexdigest()[:16]
    return f"{hashed}:{b64encode(numbers.tobytes()).decode()}"


def same_mesh(one: str, other: str) -> bool:
    """True if two texts of digests belong to the same meshes in the same order, each possibly moved rigidly."""
    first, second = one.split(), other.split()
    return len(first) == len(second) and all(map(_alike, first, second))


def _alike(one: str, other: str) -> bool:
    (hash_a, _, text_a), (hash_b, _, text_b) = one.partition(":"), other.partition(":")
    if hash_a != hash_b:
        return False
    a, b = (np.frombuffer(b64decode(text), "<f4").astype(np.float64) for text in (text_a, text_b))
    # The volume of a flat or open mesh may be near 0, so its difference is compared with the cube of the mean edge sum.
    scale = np.append(np.abs(a[:-1]), max(abs(a[-1]), 1e-3 * np.abs(a[:-1]).max() ** 3 / max(len(a), 1) ** 3))
    return bool((np.abs(a - b) <= TOLERANCE * scale).all())
