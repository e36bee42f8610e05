"""Scenes, closed forms and error measures of the stiff cases.

Camera frame: the lens is at the origin, +z points to the object, +x to the left. The film has 24 × 20 pixels, except in
the cases of other films. Lengths in mm, J_n in W/mm², powers in W; errors have no unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..optics.thin_lens import configuration_factor
from ..rendering.render import render

if TYPE_CHECKING:
    import mitsuba as mi

    # A function of the pose that returns a shape, as Mitsuba's `load_dict` takes it.
    SceneObject = Callable[[mi.ScalarTransform4f], Any]

WIDTH, HEIGHT = 24, 20
FOCAL, F_NUMBER, FOCUS, PITCH = 55.0, 8.0, 165.0, 0.4
SIDE = PITCH * (FOCUS - FOCAL) / FOCAL  # edge of a virtual pixel, in the virtual detector plane
PUPIL = FOCAL / F_NUMBER / 2  # radius of the pupil
EXACT = 1e-5  # tolerance, and rtol, where every cone is filled; float32 reaches 4e-7 there

Plane = NDArray[np.float64]


# ---------------------------------------------------------------------- objects and scenes


def scene(
    *objects: SceneObject,
    at: mi.ScalarTransform4f | None = None,
    scale: float = 1.0,
    film: tuple[int, int] = (WIDTH, HEIGHT),
    crop: tuple[int, int, int, int] | None = None,
    **lens: float | str,
) -> mi.Scene:
    """Scene of objects and a lens, with all lengths times `scale`, and rotated and moved as a whole by the pose `at`.

    film : (width, height)
    crop : x, y, width, height of the crop window
    lens : parameters of fspt_lens in place of 55 mm, f/8, u = 165 mm, 0.4 mm pixels
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
    # These ids are part of the messages that `fspt stability` prints.
    shapes = {f"body_{k}": shape_at(at @ mi.ScalarTransform4f().scale(scale)) for k, shape_at in enumerate(objects)}
    sensor = {"type": "fspt_lens", "to_world": at, "film": pixels, **numbers}
    whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, **shapes}
    return mi.load_dict(whole, optimize=False)


def disk(
    z: float, radius: float, x: float = 0.0, y: float = 0.0, tilt: float = 0.0, exitance: float = 1.0
) -> SceneObject:
    """Disk around (x, y, z) that faces the lens, rotated about the vertical by `tilt` degrees."""

    def shape_at(pose: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        own = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 180 + tilt).scale(radius)
        return {"type": "disk", "to_world": pose @ own, "glow": {"type": "fspt_surface", "exitance": exitance}}

    return shape_at


def sphere(z: float, radius: float, x: float = 0.0, y: float = 0.0, exitance: float = 1.0) -> SceneObject:
    """Sphere around (x, y, z)."""

    def shape_at(pose: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        own = mi.ScalarTransform4f().translate([x, y, z]).scale(radius)
        return {"type": "sphere", "to_world": pose @ own, "glow": {"type": "fspt_surface", "exitance": exitance}}

    return shape_at


def pane(z: float, bsdf: dict[str, Any], tilt: float = 0.0, size: float = 400.0) -> SceneObject:
    """Square without J_n around (0, 0, z) that faces the lens, rotated about the vertical by `tilt` degrees."""

    def shape_at(pose: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        own = mi.ScalarTransform4f().translate([0, 0, z]).rotate([0, 1, 0], 180 - tilt).scale(size)
        return {"type": "rectangle", "to_world": pose @ own, "bsdf": bsdf}

    return shape_at


def plate(z: float, thickness: float, index: float) -> SceneObject:
    """Plate of glass whose front lies at depth z."""

    def shape_at(pose: mi.ScalarTransform4f) -> dict[str, Any]:
        import mitsuba as mi

        half = thickness / 2
        own = mi.ScalarTransform4f().translate([0, 0, z + half]).scale([400, 400, half])
        return {
            "type": "cube",
            "to_world": pose @ own,
            "bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0},
        }

    return shape_at


def mesh(
    vertices: ArrayLike, faces: ArrayLike, exitance: float | Plane = 1.0, law: Mapping[str, Any] | None = None
) -> SceneObject:
    """Triangles with vertices (V, 3) and faces (F, 3); `exitance` is one number, or of shape (V,) or (F,).

    law : parameters of the emitter's exit law
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.uint32)

    def shape_at(pose: mi.ScalarTransform4f) -> mi.Mesh:
        import mitsuba as mi

        from ..jit.from_numpy import from_numpy
        from ..jit.mesh_buffers import add_attribute, new_mesh

        matrix = np.array(pose.matrix, np.float64)
        texture: Any = exitance
        kind = "vertex" if np.size(exitance) == len(vertices) else "face"
        if np.ndim(exitance):
            texture = {"type": "mesh_attribute", "name": f"{kind}_exitance"}
        props = mi.Properties()
        props["glow"] = mi.load_dict({"type": "fspt_surface", "exitance": texture, **(law or {})})
        positions = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        built = new_mesh("mesh", from_numpy(mi.Float, positions), from_numpy(mi.UInt32, faces), props)
        if np.ndim(exitance):
            add_attribute(built, f"{kind}_exitance", from_numpy(mi.Float, exitance))
        return built

    return shape_at


def grid(x: ArrayLike, y: ArrayLike, z: float) -> tuple[Plane, NDArray[np.int64]]:
    """Vertices and faces of a plane at z that faces the lens, with two triangles a cell of the grid lines x and y."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    vertices = np.stack([*(lines.ravel() for lines in np.meshgrid(x, y)), np.full(x.size * y.size, z)], axis=1)
    number = np.arange(x.size * y.size).reshape(y.size, x.size)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return vertices, np.concatenate([np.stack([a, d, c], axis=1), np.stack([a, c, b], axis=1)])


def square_grid(cells: int) -> tuple[Plane, NDArray[np.int64]]:
    """Vertices and faces of a square of 60 × 60 mm in the virtual detector plane, of `cells`² cells."""
    lines = np.linspace(-30, 30, cells + 1)
    return grid(lines, lines, FOCUS)


def pixel_grid(shift: float) -> tuple[Plane, NDArray[np.int64]]:
    """Vertices and faces of a plane whose grid lines are `shift` virtual pixels beside the edges of the pixels."""
    lines = (np.arange(-WIDTH, WIDTH + 1) + shift) * SIDE
    return grid(lines, lines, FOCUS)


def ball() -> SceneObject:
    """A sphere through the virtual detector plane, off the axis."""
    return sphere(168.0, 6.0, 1.5, -1.0)


def limb_on_axis() -> SceneObject:
    """A sphere whose silhouette passes through the axis."""
    return sphere(168.0, 6.0, 6.0)


def square() -> SceneObject:
    """A square of 8 × 8 mm in the plane z = u, with edges at pixel centres and vertices that are exact in float32."""
    lines = np.linspace(-4, 4, 9)
    return mesh(*grid(lines, lines, FOCUS))


def moved(distance: float = 0.0, angle: float = 0.0, axis: str = "1, 2, 3") -> Callable[[], mi.ScalarTransform4f]:
    """A function that returns a pose: a rotation by `angle` degrees, then a shift by `distance` [mm] along x.

    The shift also has -1/4 and 1/8 of `distance` along y and z.
    """

    def pose() -> mi.ScalarTransform4f:
        import mitsuba as mi

        direction = np.array([float(n) for n in axis.split(",")])
        far = mi.ScalarTransform4f().translate([distance, -distance / 4, distance / 8])
        return far.rotate(list(direction / np.linalg.norm(direction)), angle)

    return pose


# ---------------------------------------------------------------------- images and closed forms


def power(of: mi.Scene, **accuracy: Any) -> Plane:
    """Power on every pixel by the integral, shape (h, w) [W]; all NaN where its error estimate is not finite."""
    image = render(of, method="integral", **accuracy)
    return np.asarray(
        image.power if np.isfinite(np.asarray(image.error)).all() else np.full(image.shape, np.nan), np.float64
    )


@cache
def standard_image(*objects: Callable[[], SceneObject]) -> Plane:
    """Power, shape (h, w) [W], of these objects with the standard lens and film; computed once, used by many cases."""
    return power(scene(*(make() for make in objects)))


def filled_cones(
    focus: float = FOCUS, side: float = SIDE, radius: float = PUPIL, nodes: int = 4, film: Any = None
) -> Plane:
    """Power, shape (h, w) [W], where 1 W/mm² fills every cone: A_vd times the mean configuration factor of the pupil.

    `side`: edge of a virtual pixel; `radius`: of the pupil; `nodes`² Gauss nodes a pixel.
    """
    factor = np.vectorize(configuration_factor)
    return side**2 * over_pixels(lambda x, y: factor(radius, focus, np.hypot(x, y)), side, nodes, film)


def over_pixels(of: Callable[[Plane, Plane], Plane], side: float = SIDE, nodes: int = 4, film: Any = None) -> Plane:
    """Mean of a function of (x, y) over every virtual pixel, shape (h, w), by nodes² Gauss nodes."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    width, height = film or (WIDTH, HEIGHT)
    x, y = ((size / 2 - np.arange(size)[:, None] - 0.5 - node / 2) * side for size in (width, height))
    values = of(*np.broadcast_arrays(x[None, :, None, :], y[:, None, :, None]))
    return np.einsum("hwij,i,j->hw", values, weight / 2, weight / 2)


def power_through_pupil(radius: float, z: float, pupil: float = PUPIL) -> float:
    """Power [W] that a disk of 1 W/mm² on the axis, parallel to the lens, sends through a pupil of radius `pupil`."""
    node, weight = np.polynomial.legendre.leggauss(12)
    a = radius * (node + 1) / 2
    factor = np.vectorize(configuration_factor)(pupil, z, a)
    return float(np.pi * radius * (weight @ (factor * a)))


def shared_area(r: float, s: float, apart: Plane) -> Plane:
    """Area of the overlap of two circles of radii r and s, `apart` being the distance of their centres."""
    apart = np.clip(apart, abs(r - s) + 1e-12, r + s)
    a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
    b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    return r**2 * (a - np.sin(2 * a) / 2) + s**2 * (b - np.sin(2 * b) / 2)


# ---------------------------------------------------------------------- error measures of many cases


def peak_error(image: Plane, truth: Plane) -> float:
    """Largest error of a pixel, relative to the brightest pixel of the reference `truth`."""
    return float(np.abs(image - truth).max() / truth.max())


def pixel_error(image: Plane, truth: Plane) -> float:
    """Largest error of a pixel, relative to the reference there; infinite if a pixel that should be 0 is not."""
    error = np.where(truth == 0, np.where(image == 0, 0, np.inf), np.abs(image / np.where(truth == 0, 1, truth) - 1))
    return float(error.max())


def cone_error(
    *objects: SceneObject, nodes: int = 4, film: tuple[int, int] | None = None, share: float = 1.0, **lens: Any
) -> float:
    """Pixel error of an image in which 1 W/mm² fills every cone, against `share` times the closed form."""
    focal, stop = lens.get("focal_length", FOCAL), lens.get("f_number", F_NUMBER)
    t = lens.get("magnification") or focal / (lens.get("focus_distance", FOCUS) - focal)
    side, focus = lens.get("pixel_pitch", PITCH) / t, focal * (1 + 1 / t)
    image = power(scene(*objects, film=film or (WIDTH, HEIGHT), **lens), rtol=EXACT)
    return pixel_error(image, share * filled_cones(focus, side, focal / stop / 2, nodes, film))


def balance_error(z: float, radius: float, domain: str = "pupil", rtol: float = 10 * EXACT, **lens: Any) -> float:
    """Relative error of the total power on all pixels, for a disk whose whole image is on the film."""
    expected = power_through_pupil(radius, z, FOCAL / lens.get("f_number", F_NUMBER) / 2)
    return abs(float(power(scene(disk(z, radius), **lens), domain=domain, rtol=rtol).sum()) / expected - 1)


def invariance_error(
    *objects: Callable[[], SceneObject], factor: float = 1.0, pose: Any = None, **changed: Any
) -> float:
    """Peak error between the standard image and that of a changed scene, whose power is `factor` times as large."""
    of = scene(*(make() for make in objects), at=pose() if pose else None, **changed)
    return peak_error(power(of) / factor, standard_image(*objects))


def domain_error(*objects: SceneObject, **changed: Any) -> float:
    """Peak error between the pupil form and the surface form of the integral; `changed`: arguments of `scene`."""
    of = scene(*objects, **changed)
    return peak_error(power(of, domain="pupil"), power(of, domain="surface"))


# ---------------------------------------------------------------------- error measures of single cases


def pinhole_limit_error() -> float:
    """Peak error between f/1e6 and the pinhole model."""
    stopped, pinhole = (power(scene(ball(), f_number=1e6, model=model)) for model in ("diaphragm", "pinhole"))
    return peak_error(stopped, pinhole)


def wall_error(slope: float) -> float:
    """Pixel error of a wall 1 mm beside the axis, which lines of sight meet at grazing angles, of slope >= `slope`.

    The lines through the pixels' centres meet the wall on one half of the film and miss it on the other.
    """
    length = 100 / slope
    corners = [[-1, -1e3, 0], [-1, 1e3, 0], [-1, 1e3, length], [-1, -1e3, length]]
    side = 2 * slope * FOCUS
    pitch = side * FOCAL / (FOCUS - FOCAL)
    wall = scene(mesh(corners, [[0, 1, 2], [0, 2, 3]]), f_number=1e6, pixel_pitch=pitch)
    expected = filled_cones(FOCUS, side, FOCAL / 2e6, nodes=1)
    expected[:, : WIDTH // 2] = 0
    return pixel_error(power(wall, pixel="centre"), expected)


def scaled_exitance_error(exitance: float) -> float:
    """Peak error of a sphere of this J_n, against the sphere of 1 W/mm²."""
    scaled = power(scene(sphere(168.0, 6.0, 1.5, -1.0, exitance=exitance)))
    return peak_error(scaled / exitance, standard_image(ball))


def two_level_error() -> float:
    """Pixel error of a plane in focus with 1 W/mm² on one half and 1e-9 W/mm² on the other.

    The columns beside the border are left out, so that the dark half counts relative to its own power.
    """
    lines = np.linspace(-40, 40, 3)
    vertices, faces = grid(lines, lines, FOCUS)
    bright = vertices[faces].mean(axis=1)[:, 0] > 0
    image = power(scene(mesh(vertices, faces, np.where(bright, 1.0, 1e-9))), rtol=EXACT)
    steps = np.where(np.arange(WIDTH) < WIDTH // 2, 1.0, 1e-9)
    away = np.abs(np.arange(WIDTH) - WIDTH / 2 + 0.5) > 1
    return pixel_error(image[:, away], (filled_cones() * steps)[:, away])


def half_dark_error(border: float) -> float:
    """Peak error of a plane in focus that is dark up to x = `border` [mm], against the lit share of every pixel."""
    vertices, faces = grid(np.unique([*np.linspace(-40, 40, 81), border]), np.linspace(-40, 40, 81), FOCUS)
    lit = vertices[faces].mean(axis=1)[:, 0] > border
    x = (WIDTH / 2 - np.arange(WIDTH)) * SIDE
    expected = filled_cones() * np.clip((x - border) / SIDE, 0, 1)
    return peak_error(power(scene(mesh(vertices, faces, lit.astype(float)))), expected)


def sliver_error() -> float:
    """Cone error of 1000 cells of 240 mm × 0.24 µm, rotated about the axis so that they run oblique to the pixels."""
    vertices, faces = grid(np.linspace(-0.12, 0.12, 1001), [-120, 120], FOCUS)
    cos, sin = np.cos(0.5), np.sin(0.5)
    rotated = vertices @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return cone_error(mesh(rotated, faces), pixel_pitch=2.5e-3)


def pinhole_vertex_error() -> float:
    """Pixel error of a pinhole camera whose lines of sight meet the vertices of a mesh, against cos⁴θ."""
    image = power(scene(mesh(*pixel_grid(0.5)), model="pinhole"), pixel="centre")
    falloff = over_pixels(lambda x, y: FOCUS**4 / (FOCUS**2 + x**2 + y**2) ** 2, nodes=1)
    return pixel_error(image, (PUPIL * SIDE / FOCUS) ** 2 * falloff)


def small_disk_error() -> float:
    """Peak error of a disk out of focus that is smaller than its blur, against the overlap of two circles.

    From the point h off the axis in the virtual detector plane, a disk of radius r at z covers a circle of the pupil,
    of radius r u/|u − z|, its centre h z/|u − z| off the pupil's. P = J_n/π · A_vd · (area of the overlap) cos⁴θ/u²,
    with θ at the centre of the disk, which is right to 4e-4 of the peak.
    """
    z, radius, pitch = 110.0, 0.8, 0.1
    side = pitch * (FOCUS - FOCAL) / FOCAL

    def covered(x: Plane, y: Plane) -> Plane:
        h = np.hypot(x, y)
        overlap = shared_area(PUPIL, radius * FOCUS / (FOCUS - z), h * z / (FOCUS - z))
        return overlap / (1 + (h / (FOCUS - z)) ** 2) ** 2

    expected = side**2 / (np.pi * FOCUS**2) * over_pixels(covered, side, 30)
    return peak_error(power(scene(disk(z, radius), pixel_pitch=pitch)), expected)


def rotation_error(axis: str, angle: float) -> float:
    """Larger one of the invariance errors of the ball and the square, for a scene rotated by `angle` degrees."""
    return max(invariance_error(make, pose=moved(0, angle, axis)) for make in (ball, square))


def moved_cone_error(pose: Callable[[], Any]) -> float:
    """Pixel error of filled cones in a scene that is rotated and moved as a whole."""
    return pixel_error(power(scene(disk(FOCUS, 60), at=pose()), rtol=EXACT), filled_cones())


def small_film_error(width: int, height: int) -> float:
    """Peak error between a small film and the middle of the standard one; sizes are even, so that pixels coincide."""
    whole = standard_image(limb_on_axis)
    top, left = (HEIGHT - height) // 2, (WIDTH - width) // 2
    part = power(scene(limb_on_axis(), film=(width, height)))
    return float(np.abs(part - whole[top : top + height, left : left + width]).max() / whole.max())


def crop_error(crop: tuple[int, int, int, int]) -> float:
    """Peak error between a crop window (x, y, width, height) and the same pixels of the whole image."""
    x, y, width, height = crop
    whole, part = standard_image(ball), power(scene(ball(), crop=crop))
    return float(np.abs(part - whole[y : y + height, x : x + width]).max() / whole.max())


def stray_power(made: SceneObject) -> float:
    """Power on all pixels of an object that no pixel sees, relative to a pixel filled by 1 W/mm²."""
    return float(np.abs(power(scene(made))).sum() / filled_cones().max())
