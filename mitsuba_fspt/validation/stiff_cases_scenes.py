"""Scenes, closed forms and measures of the stiff cases.

In the camera frame: lens in the origin, +z to the object, +x to the left. All on films of 24 × 20 pixels unless the
film itself is what is tried. Lengths in mm, J_n in W/mm², powers in W.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..optics.thin_lens import configuration_factor
from ..rendering.render import render

if TYPE_CHECKING:
    import mitsuba as mi

    Body = Callable[[mi.ScalarTransform4f], Any]

WIDTH, HEIGHT = 24, 20
FOCAL, F_NUMBER, FOCUS, PITCH = 55.0, 8.0, 165.0, 0.4
SIDE = PITCH * (FOCUS - FOCAL) / FOCAL  # of a virtual pixel
PUPIL = FOCAL / F_NUMBER / 2  # radius

CONE = "filled cone: A_vd times the configuration factor"
BALANCE = "power balance: what the disk sends through the pupil"
SAME = "the same picture"
OTHER = "the other domain"
REFUSAL = "a refusal"
# Float32 reaches 4e-7 with filled cones; with edges the accuracy asked for, 1e-3, counts.
EXACT, SHARP, AGREED = 1e-5, 5e-4, 2e-3
ROUNDED = 1e-4  # at the usual rtol: float32 that rounds otherwise lets a bisection end beside where it did

Plane = NDArray[np.float64]


def scene(
    *bodies: Body,
    at: mi.ScalarTransform4f | None = None,
    scale: float = 1.0,
    film: tuple[int, int] = (WIDTH, HEIGHT),
    crop: tuple[int, int, int, int] | None = None,
    **lens: float | str,
) -> mi.Scene:
    """Scene of bodies before a lens, all lengths times `scale`, turned and moved as a whole by `at`.

    `lens`: parameters of fspt_lens that replace 55 mm, f/8, u = 165 mm, 0.4 mm pixels; `crop`: x, y, width, height.
    """
    import mitsuba as mi

    at = mi.ScalarTransform4f() if at is None else at
    numbers: dict[str, float | str] = {"focal_length": FOCAL, "f_number": F_NUMBER, "pixel_pitch": PITCH, **lens}
    if not {"magnification", "image_distance"} & set(lens):
        numbers.setdefault("focus_distance", FOCUS)
    lengths = ("focal_length", "pixel_pitch", "focus_distance", "image_distance")
    numbers |= {name: float(numbers[name]) * scale for name in lengths if name in numbers}
    pixels = {"type": "hdrfilm", "width": film[0], "height": film[1]}
    if crop:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        pixels |= dict(zip(names, crop, strict=True))
    placed = {f"body_{k}": body(at @ mi.ScalarTransform4f().scale(scale)) for k, body in enumerate(bodies)}
    sensor = {"type": "fspt_lens", "to_world": at, "film": pixels, **numbers}
    whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, **placed}
    return mi.load_dict(whole, optimize=False)


def disk(z: float, radius: float, x: float = 0.0, y: float = 0.0, tilt: float = 0.0, exitance: float = 1.0) -> Body:
    """Disk that faces the lens, turned about the vertical by `tilt` degrees."""

    def place(at: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        own = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 180 + tilt).scale(radius)
        return {"type": "disk", "to_world": at @ own, "glow": {"type": "fspt_surface", "exitance": exitance}}

    return place


def sphere(z: float, radius: float, x: float = 0.0, y: float = 0.0, exitance: float = 1.0) -> Body:
    """Ball around (x, y, z)."""

    def place(at: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        own = mi.ScalarTransform4f().translate([x, y, z]).scale(radius)
        return {"type": "sphere", "to_world": at @ own, "glow": {"type": "fspt_surface", "exitance": exitance}}

    return place


def mesh(vertices: ArrayLike, faces: ArrayLike, exitance: float | Plane = 1.0) -> Body:
    """Triangles with one J_n or one for every vertex or face (as many values tell which)."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.uint32)

    def place(at: mi.ScalarTransform4f) -> mi.Mesh:
        import mitsuba as mi

        matrix = np.array(at.matrix, np.float64)
        texture: Any = exitance
        kind = "vertex" if np.size(exitance) == len(vertices) else "face"
        if np.ndim(exitance):
            texture = {"type": "mesh_attribute", "name": f"{kind}_exitance"}
        props = mi.Properties()
        props["glow"] = mi.load_dict({"type": "fspt_surface", "exitance": texture})
        built = mi.Mesh("mesh", len(vertices), len(faces), props=props)
        if np.ndim(exitance):
            built.add_attribute(f"{kind}_exitance", 1, np.asarray(exitance, np.float32))
        buffers = mi.traverse(built)
        buffers["vertex_positions"] = (vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32).ravel()
        buffers["faces"] = faces.ravel()
        buffers.update()
        return built

    return place


def grid(x: ArrayLike, y: ArrayLike, z: float) -> tuple[Plane, NDArray[np.int64]]:
    """Vertices and faces of a plane at z that faces the lens, two triangles a cell of the lines `x` and `y`."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    vertices = np.stack([*(lines.ravel() for lines in np.meshgrid(x, y)), np.full(x.size * y.size, z)], axis=1)
    number = np.arange(x.size * y.size).reshape(y.size, x.size)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return vertices, np.concatenate([np.stack([a, d, c], axis=1), np.stack([a, c, b], axis=1)])


# ---------------------------------------------------------------------- pictures and what they should be


def power(of: mi.Scene, **accuracy: Any) -> Plane:
    """Power on every pixel [W] by the integral; NaN everywhere where its own error is not finite."""
    image = render(of, method="integral", **accuracy)
    return np.asarray(image.power if np.isfinite(image.error).all() else np.full(image.shape, np.nan), np.float64)


def filled(focus: float = FOCUS, side: float = SIDE, radius: float = PUPIL, nodes: int = 4, film: Any = None) -> Plane:
    """Power on every pixel whose cone is filled by 1 W/mm²: A_vd times the mean configuration factor of the pupil."""
    factor = np.vectorize(configuration_factor)
    return side**2 * over_pixels(lambda x, y: factor(radius, focus, np.hypot(x, y)), side, nodes, film)


def over_pixels(of: Callable[[Plane, Plane], Plane], side: float = SIDE, nodes: int = 4, film: Any = None) -> Plane:
    """Mean of a function of (x, y) over every virtual pixel, (h, w), by nodes² Gauss nodes."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    width, height = film or (WIDTH, HEIGHT)
    x, y = ((size / 2 - np.arange(size)[:, None] - 0.5 - node / 2) * side for size in (width, height))
    values = of(*np.broadcast_arrays(x[None, :, None, :], y[:, None, :, None]))
    return np.einsum("hwij,i,j->hw", values, weight / 2, weight / 2)


def through_pupil(radius: float, z: float, pupil: float = PUPIL) -> float:
    """What a disk of 1 W/mm² on the axis, parallel to the lens, sends through the pupil."""
    node, weight = np.polynomial.legendre.leggauss(12)
    a = radius * (node + 1) / 2
    factor = np.vectorize(configuration_factor)(pupil, z, a)
    return float(np.pi * radius * (weight @ (factor * a)))


def off(picture: Plane, truth: Plane) -> float:
    """Largest error of any pixel over the brightest pixel of the truth."""
    return float(np.abs(picture - truth).max() / truth.max())


def off_anywhere(picture: Plane, truth: Plane) -> float:
    """Largest error of any pixel over the truth of that pixel; where that is 0, so must the picture be."""
    away = np.where(truth == 0, np.where(picture == 0, 0, np.inf), np.abs(picture / np.where(truth == 0, 1, truth) - 1))
    return float(away.max())


# ---------------------------------------------------------------------- what rows measure


def cone(*bodies: Body, nodes: int = 4, film: tuple[int, int] | None = None, **lens: float) -> float:
    """Error of a picture all of whose cones are filled."""
    focal, stop = lens.get("focal_length", FOCAL), lens.get("f_number", F_NUMBER)
    t = lens.get("magnification") or focal / (lens.get("focus_distance", FOCUS) - focal)
    side, focus = lens.get("pixel_pitch", PITCH) / t, focal * (1 + 1 / t)
    picture = power(scene(*bodies, film=film or (WIDTH, HEIGHT), **lens), rtol=EXACT)
    return off_anywhere(picture, filled(focus, side, focal / stop / 2, nodes, film))


def balance(z: float, radius: float, domain: str = "pupil", rtol: float = 10 * EXACT, **lens: float) -> float:
    """Error of all power of a disk whose whole picture is on the film, relative to that power."""
    expected = through_pupil(radius, z, FOCAL / lens.get("f_number", F_NUMBER) / 2)
    return abs(float(power(scene(disk(z, radius), **lens), domain=domain, rtol=rtol).sum()) / expected - 1)


def ball() -> Body:
    """A ball through the sharp plane, off the axis."""
    return sphere(168.0, 6.0, 1.5, -1.0)


def square() -> Body:
    """A sharp square of 8 × 8 mm in the sharp plane, its edges in the middle of pixels; float32 holds its vertices."""
    lines = np.linspace(-4, 4, 9)
    return mesh(*grid(lines, lines, FOCUS))


def same(*bodies: Callable[[], Body], factor: float = 1.0, place: Any = None, **changed: Any) -> float:
    """Difference between the scene as it is and as it is changed, whose watts are `factor` times as many."""
    of = scene(*(body() for body in bodies), at=place() if place else None, **changed)
    return off(power(of) / factor, usual(*bodies))


@cache
def usual(*bodies: Callable[[], Body]) -> Plane:
    """Picture [W] of these bodies by the usual lens on the usual film; kept, as many rows compare with it."""
    return power(scene(*(body() for body in bodies)))


def moved(distance: float = 0.0, angle: float = 0.0, axis: str = "1, 2, 3") -> Callable[[], mi.ScalarTransform4f]:
    """What turns a scene by `angle` degrees and moves it along a slanted line by `distance` [mm] along x."""

    def place() -> mi.ScalarTransform4f:
        import mitsuba as mi

        direction = np.array([float(n) for n in axis.split(",")])
        far = mi.ScalarTransform4f().translate([distance, -distance / 4, distance / 8])
        return far.rotate(list(direction / np.linalg.norm(direction)), angle)

    return place


def domains(*bodies: Body, **lens: float) -> float:
    """Difference between the two ways of writing the integral."""
    of = scene(*bodies, **lens)
    return off(power(of, domain="pupil"), power(of, domain="surface"))
