"""Bodies of `fans`: intersection with lines of sight, radiance, and the edges that fans of lines meet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .camera import ReferenceCamera, Stops
from .shapes import Array, Cylinder, Disc, Rectangle, Sphere, dot

Indices = NDArray[np.int64]
MOST_SPECULAR = 6  # mirrors and panes that a line meets one after the other
MOST_PAIRS = 1 << 17  # of lines of sight and triangles that are tested at a time
BEYOND = 1e-9  # of a line's length: an intersection nearer than this is with the surface where the line starts


@dataclass(frozen=True)
class Fan:
    """Fans of lines apex + τ (start + s · step), s in [0, 1]; columns (n, 3).

    behind : lines of sight start at τ = −behind
    """

    apex: Array
    start: Array
    step: Array
    behind: float = 0.0

    def some(self, part: slice) -> Fan:
        """Some of the fans."""
        return Fan(self.apex[part], self.start[part], self.step[part], self.behind)

    def lines(self, fan: Indices, s: Array) -> tuple[Array, Array]:
        """Origins and directions of single lines, (n, 3) each, by the numbers of their fans and parameters s, (n,)."""
        direction = self.start[fan] + s[:, None] * self.step[fan]
        return self.apex[fan] - self.behind * direction, direction


class BodyShape(Protocol):
    """What a body's shape gives: first positive parameter on lines and the face met; normal; edges of fans."""

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Indices]: ...

    def meet_face(self, origin: Array, direction: Array, face: Indices) -> Array: ...

    def outward(self, points: Array, face: Indices) -> Array: ...

    def edges(self, fan: Fan) -> Array: ...

    def corners(self) -> Array: ...


@dataclass(frozen=True)
class Body:
    """A surface.

    Parameters
    ----------
    shape : of `BodyShape`
    exitance : (points (n, 3), face (n,)) -> J_n (n,) [W/mm²]; None: dark
    index : n of Fresnel's exit law (Eq. M.15); None: Lambert's
    most : largest J_n [W/mm²]
    role : 'opaque'; 'mirror' (reflects all on the side of the normal); 'pane' (thin, of refractive index `glass`)
    texture : (fan) -> where fans cross the borders of texels, (n, k); None: nowhere
    """

    shape: BodyShape
    exitance: Callable[[Array, Indices], Array] | None = None
    index: float | None = None
    role: Literal["opaque", "mirror", "pane"] = "opaque"
    glass: float = 1.5
    texture: Callable[[Fan], Array] | None = None
    most: float = 0.0

    def edges(self, fan: Fan) -> Array:
        """Parameters s at which fans meet an edge, (n, k); NaN or outside [0, 1] where they do not."""
        own = self.shape.edges(fan)
        return own if self.texture is None else np.concatenate([own, self.texture(fan)], axis=1)

    def radiance(self, points: Array, direction: Array, face: Indices) -> Array:
        """L [W/mm²/sr] at points, opposite to the direction of lines of sight, (n,); 0 on the inward side."""
        if self.exitance is None:
            return np.zeros(len(points))
        cosine = -dot(self.shape.outward(points, face), direction) / np.sqrt(dot(direction, direction))
        exitance = self.exitance(points, face)
        profile = 1 / math.pi if self.index is None else fresnel_profile(np.maximum(cosine, 0), self.index)
        return np.where(cosine > 0, exitance * profile, 0.0)

    def near(self, camera: ReferenceCamera, stops: Stops, centre: Array) -> Body | None:
        """The body's part that lines of sight of the pixel about `centre` [mm] may meet; None if there is none.

        The lines of a pixel lie between cones about the line from the middle of the pupil.
        """
        u, depth = camera.focus_distance, stops.pupil_depth
        corners = self.shape.corners()
        along = (u - corners[:, 2]) / (u - depth)
        width = stops.pupil_radius * np.abs(along) + camera.pixel_side * np.abs(1 - along)
        low = (corners[:, :2] - centre * (1 - along)[:, None] - width[:, None]).min(axis=0)
        high = (corners[:, :2] - centre * (1 - along)[:, None] + width[:, None]).max(axis=0)
        if (low > 0).any() or (high < 0).any():
            return None
        if isinstance(self.shape, Triangles):
            part = self.shape.near(centre, u, depth, stops.pupil_radius, camera.pixel_side)
            return replace(self, shape=part) if len(part.faces) else None
        return self


def first_met(bodies: Sequence[Body], origin: Array, direction: Array) -> tuple[Array, Indices, Indices]:
    """What lines of sight meet first: parameter, number of the body (-1: nothing) and its face, each (n,)."""
    met = [body.shape.meet(origin, direction) for body in bodies]
    nearest, faces = np.stack([s for s, _ in met]), np.stack([face for _, face in met])
    first = np.argmin(nearest, axis=0)
    at = first, np.arange(len(origin))
    return nearest[at], np.where(np.isfinite(nearest[at]), first, -1), faces[at]


def seen_on(bodies: Sequence[Body], met: Indices, origin: Array, direction: Array) -> Array:
    """Radiance [W/mm²/sr] along lines of sight (n,) to opaque bodies.

    met : numbers of the bodies that lines meet first, and of their faces, (2, n)
    """
    value, (first, face) = np.zeros(len(origin)), met
    for number, body in enumerate(bodies):
        (mine,) = np.nonzero(first == number)
        if len(mine) and body.exitance is not None:
            way, own = direction[mine], face[mine]
            s = body.shape.meet_face(origin[mine], way, own)
            hit = np.isfinite(s)  # on an edge, a line may miss by rounding
            mine, way, own = mine[hit], way[hit], own[hit]
            value[mine] = body.radiance(origin[mine] + s[hit, None] * way, way, own)
    return value


def seen_along(bodies: Sequence[Body], origin: Array, direction: Array, specular: int = MOST_SPECULAR) -> Array:
    """Radiance [W/mm²/sr] along lines of sight (n,), through panes and off mirrors (Eq. M.19)."""
    value = np.zeros(len(origin))
    if not len(origin):
        return value
    nearest, first, faces = first_met(bodies, origin, direction)
    for number, body in enumerate(bodies):
        (mine,) = np.nonzero(first == number)
        if not len(mine) or (body.role == "opaque" and body.exitance is None):
            continue
        way, face = direction[mine], faces[mine]
        points = origin[mine] + nearest[mine, None] * way
        if body.role == "opaque":
            value[mine] = body.radiance(points, way, face)
            continue
        if not specular:
            continue
        normal = body.shape.outward(points, face)
        cosine = -dot(normal, way) / np.sqrt(dot(way, way))
        back = way - 2 * dot(way, normal)[:, None] * normal
        if body.role == "mirror":
            mine, points, back = mine[cosine > 0], points[cosine > 0], back[cosine > 0]
            value[mine] = seen_along(bodies, points + BEYOND * back, back, specular - 1)
        else:
            reflectance = fresnel_reflectance(np.abs(cosine), body.glass)
            through = seen_along(bodies, points + BEYOND * way, way, specular - 1)
            off = seen_along(bodies, points + BEYOND * back, back, specular - 1)
            value[mine] = ((1 - reflectance) * through + 2 * reflectance * off) / (1 + reflectance)
    return value


def fresnel_reflectance(cosine: Array, index: float) -> Array:
    """Unpolarised reflectance of a border that light meets from outside at an angle of this `cosine`."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (s**2 + p**2)


def fresnel_profile(cosine: Array, index: float) -> Array:
    """L/J_n [1/sr] of Eq. M.15."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    passed = 1 - fresnel_reflectance(cosine, index)
    return (2 * _boundary_factor(index) + 3 * inside) * passed / (4 * math.pi * index**2)


@cache
def _boundary_factor(index: float) -> float:
    """A = (1 + R_J)/(1 − R_φ), with the moments of the reflectance inside, total reflection included."""
    critical = math.sqrt(1 - 1 / index**2)
    node, weight = np.polynomial.legendre.leggauss(200)
    inside = critical + (1 - critical) * ((node + 1) / 2) ** 2  # R has a root at the critical angle
    share = (1 - critical) * (node + 1) / 2 * weight
    outside = np.sqrt(np.maximum(1 - index**2 * (1 - inside**2), 0))
    reflected = fresnel_reflectance(outside, index)
    phi = critical**2 + float(share @ (2 * inside * reflected))
    current = critical**3 + float(share @ (3 * inside**2 * reflected))
    return (1 + current) / (1 - phi)


# ---------------------------------------------------------------------- edges of fans


def roots(a: Array, b: Array, c: Array) -> Array:
    """Real roots of a s² + b s + c, (n, 2); nan where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        q = -0.5 * (b + np.copysign(np.sqrt(b * b - 4 * a * c), b))
        return np.stack([q / a, c / q], axis=1)


def reflected(fan: Fan, shape: BodyShape) -> Fan:
    """The fan mirrored in the plane of a flat `shape`; straight on, it meets what `fan` meets after the reflection."""
    point = shape.corners()[0]
    normal = shape.outward(point[None], np.zeros(1, int))[0]

    def turned(vector: Array) -> Array:
        return vector - 2 * (vector @ normal)[:, None] * normal

    return Fan(turned(fan.apex - point) + point, turned(fan.start), turned(fan.step), fan.behind)


def _crossing(fan: Fan, normal: Array) -> Array:
    """Parameters s at which the directions of fans are perpendicular to a normal, (n, 1)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return (-dot(fan.start, normal) / dot(fan.step, normal))[:, None]


def _circle(fan: Fan, centre: Array, normal: Array, radius: float) -> Array:
    """Parameters s at which fans meet the rim of a disc, and at which they are parallel to its plane, (n, 3)."""
    w = fan.apex - centre
    height = (w @ normal)[:, None]
    at, along = (w * (d @ normal)[:, None] - d * height for d in (fan.start, fan.step))
    n0, n1 = fan.start @ normal, fan.step @ normal
    a, b, c = dot(along, along), 2 * dot(at, along), dot(at, at)
    rim = roots(a - (radius * n1) ** 2, b - 2 * radius**2 * n0 * n1, c - (radius * n0) ** 2)
    return np.concatenate([rim, _crossing(fan, normal)], axis=1)


def _limb(w: Array, start: Array, step: Array, radius: float) -> Array:
    """Parameters s at which lines from w are tangent to a sphere, or projected along an axis to a circle, (n, 2)."""
    out = dot(w, w) - radius**2
    p, q = dot(w, start), dot(w, step)
    return roots(out * dot(step, step) - q * q, 2 * (out * dot(start, step) - p * q), out * dot(start, start) - p * p)


@dataclass(frozen=True)
class Simple:
    """A sphere, disc, rectangle or closed cylinder of `shapes`."""

    shape: Sphere | Disc | Rectangle | Cylinder

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Indices]:
        """First positive parameters (n,), inf for none; the face is always 0."""
        return self.shape.meet(origin, direction), np.zeros(len(origin), int)

    def meet_face(self, origin: Array, direction: Array, face: Indices) -> Array:
        """First positive parameters (n,), inf for none."""
        return self.shape.meet(origin, direction)

    def outward(self, points: Array, face: Indices) -> Array:
        """Unit normals, (n, 3)."""
        return self.shape.outward(points)

    def edges(self, fan: Fan) -> Array:
        """Where fans meet an edge, (n, k)."""
        shape = self.shape
        if isinstance(shape, Sphere):
            return _limb(fan.apex - np.asarray(shape.centre), fan.start, fan.step, shape.radius)
        if isinstance(shape, Disc):
            return _circle(fan, np.asarray(shape.centre), _unit(shape.normal), shape.radius)
        if isinstance(shape, Rectangle):
            return rectangle_lines(fan, shape, (-1.0, 1.0), (-1.0, 1.0))
        axis, centre = _unit(shape.axis), np.asarray(shape.centre)
        w, start, step = (
            vector - (vector @ axis)[:, None] * axis for vector in (fan.apex - centre, fan.start, fan.step)
        )
        caps = [_circle(fan, centre + k * shape.height / 2 * axis, axis, shape.radius) for k in (-1, 1)]
        return np.concatenate([_limb(w, start, step, shape.radius), *caps], axis=1)

    def corners(self) -> Array:
        """Points whose convex hull holds the shape, (n, 3)."""
        shape = self.shape
        centre = np.asarray(shape.centre, np.float64)
        if isinstance(shape, Rectangle):
            a, b = np.asarray(shape.half_width), np.asarray(shape.half_height)
            return centre + np.array([a + b, a - b, -a + b, -a - b])
        size = shape.radius + (shape.height / 2 if isinstance(shape, Cylinder) else 0)
        return centre + size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def rectangle_lines(fan: Fan, shape: Rectangle, columns: Sequence[float], rows: Sequence[float]) -> Array:
    """Parameters s at which fans cross grid lines of a rectangle, or are parallel to its plane.

    columns, rows : of the grid lines, as shares of the half width and the half height
    """
    a, b = np.asarray(shape.half_width, np.float64), np.asarray(shape.half_height, np.float64)
    normal = _unit(np.cross(a, b))
    w = fan.apex - np.asarray(shape.centre)
    height = (w @ normal)[:, None]
    at, along = (w * (d @ normal)[:, None] - d * height for d in (fan.start, fan.step))
    n0, n1 = fan.start @ normal, fan.step @ normal
    found = [_crossing(fan, normal)]
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, shares in ((a, columns), (b, rows)):
            far = (axis @ axis) * np.asarray(shares)
            found.append(-((at @ axis)[:, None] - far * n0[:, None]) / ((along @ axis)[:, None] - far * n1[:, None]))
    return np.concatenate(found, axis=1)


@dataclass(frozen=True)
class Triangles:
    """Opaque triangles, corners anticlockwise when seen from outside.

    Parameters
    ----------
    vertices : (V, 3) [mm]
    faces : (F, 3) vertex numbers
    number : (F,) of each face in the whole mesh
    closed : backs are never seen
    """

    vertices: Array
    faces: Indices
    number: Indices
    closed: bool = True

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Indices]:
        """First positive parameters (n,), inf for none, and numbers of the faces in the whole mesh.

        A line passes a triangle where it passes all three sides on the same side (products of Plücker coordinates).
        """
        best, face = np.full(len(origin), np.inf), np.zeros(len(origin), int)
        if not len(self.faces):
            return best, face
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        sides = [np.concatenate([np.cross(p, q), q - p], axis=1).T for p, q in ((a, b), (b, c), (c, a))]
        for first in range(0, len(origin), some := max(MOST_PAIRS // len(self.faces), 1)):
            part = slice(first, first + some)
            line = np.concatenate([direction[part], np.cross(origin[part], direction[part])], axis=1)
            turns = [line @ side for side in sides]
            hit = np.logical_and.reduce([t >= 0 for t in turns]) | np.logical_and.reduce([t <= 0 for t in turns])
            row, column = np.nonzero(hit)
            with np.errstate(divide="ignore", invalid="ignore"):
                s = dot(a[column] - origin[part][row], normal[column]) / dot(direction[part][row], normal[column])
            ahead = np.full(hit.shape, np.inf)
            ahead[row, column] = np.where(s > 0, s, np.inf)
            nearest = ahead.argmin(axis=1)
            best[part] = ahead[np.arange(len(nearest)), nearest]
            face[part] = self.number[nearest]
        return best, face

    def meet_face(self, origin: Array, direction: Array, face: Indices) -> Array:
        """Parameters (n,) at which lines meet the planes of faces; `face` in the whole mesh."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normal, own = np.cross(b - a, c - a), np.searchsorted(self.number, face)
        return dot(a[own] - origin, normal[own]) / dot(direction, normal[own])

    def outward(self, points: Array, face: Indices) -> Array:
        """Unit normals, (n, 3); `face` in the whole mesh."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        return normal[np.searchsorted(self.number, face)]

    def edges(self, fan: Fan) -> Array:
        """Where fans meet the sides of triangles, (n, k)."""
        sides = np.unique(np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        p, q = self.vertices[sides[:, 0]], self.vertices[sides[:, 1]]
        normal = np.cross(p - fan.apex[:, None], q - fan.apex[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return -np.einsum("nkc,nc->nk", normal, fan.start) / np.einsum("nkc,nc->nk", normal, fan.step)

    def corners(self) -> Array:
        """All vertices of the faces, (n, 3)."""
        return self.vertices[np.unique(self.faces)]

    def near(self, centre: Array, u: float, depth: float, radius: float, side: float) -> Triangles:
        """The triangles that lines of sight of a pixel may meet first."""
        corners = self.vertices[self.faces]
        along = (u - corners[..., 2]) / (u - depth)
        width = (radius * np.abs(along) + side * np.abs(1 - along))[..., None]
        off = corners[..., :2] - centre * (1 - along)[..., None]
        met = ((off - width).min(axis=1) <= 0).all(axis=1) & ((off + width).max(axis=1) >= 0).all(axis=1)
        if self.closed:
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            size = np.linalg.norm(normal, axis=1)
            met &= dot(normal, corners[:, 0] - np.array([0, 0, depth])) < radius * size
        return replace(self, faces=self.faces[met], number=self.number[met])


def _unit(vector: object) -> Array:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)
