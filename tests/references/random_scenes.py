"""Random scenes of several families, each for Mitsuba and for `fans`, reproducible from family and seed.

Camera frame: the lens is at the origin and looks along +z. Bodies lie around the virtual detector plane, of which a
film of 24 to 64 pixels a side sees some 30 to 60 mm. Blur discs measure from a hundredth of a pixel to tens of pixels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_fspt.validation.stiff_scenes import mesh

from .bodies import Body, Fan, Simple, Triangles, rectangle_lines
from .camera import ReferenceCamera, Stops
from .fans import FanReference
from .shapes import Array, Cylinder, Disc, Rectangle, Sphere

if TYPE_CHECKING:
    import mitsuba as mi

Indices = NDArray[np.int64]
DARK = {"type": "diffuse"}
APART = 1.02  # least distance of the centres of two bodies, over the sum of their radii, so that they do not intersect
FRESNEL_INDEX = 1.37
BEFORE = -60.0, -20.0  # depths of narrow dark bodies before the virtual detector plane [mm]
TRIES = 60  # random positions tried for a body


@dataclass(frozen=True)
class RandomScene:
    """One scene: dictionaries for `mitsuba.load_dict`, its reference, and the crop window.

    crop : (x, y, width, height) of the crop window on the film
    """

    name: str
    objects: dict[str, Any]
    sensor: dict[str, Any]
    reference: FanReference
    crop: tuple[int, int, int, int]

    def scene(self) -> mi.Scene:
        """Mitsuba's scene."""
        import mitsuba as mi

        whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": self.sensor}
        return mi.load_dict({**whole, **self.objects}, optimize=False)


@dataclass
class _Maker:
    """Scene under construction: lens, bodies for Mitsuba and the reference, and the spheres that contain the bodies."""

    random: np.random.Generator
    lens: dict[str, Any] = field(default_factory=dict)
    objects: dict[str, Any] = field(default_factory=dict)
    bodies: list[Body] = field(default_factory=list)
    taken: list[tuple[Array, float]] = field(default_factory=list)
    size: tuple[int, int] = (32, 32)
    field_width: float = 40.0
    stops: dict[str, float] = field(default_factory=dict)
    index: float | None = None
    centre: bool = False
    crops: bool = False
    edge_on: bool = False

    def __post_init__(self) -> None:
        r = self.random
        focal, focus = float(r.choice([25, 50, 85])), float(r.uniform(160, 350))
        self.lens = {"focal_length": focal, "f_number": float(np.exp(r.uniform(np.log(0.9), np.log(32))))}
        self.lens["focus_distance"] = focus
        self.size = int(r.integers(24, 65)), int(r.integers(24, 65))
        self.field_width = float(r.uniform(30, 60))
        side = self.field_width / max(self.size)
        self.lens["pixel_pitch"] = side * focal / (focus - focal)

    @property
    def focus(self) -> float:
        return self.lens["focus_distance"]

    def place(self, radius: float, depth: tuple[float, float] = (-40, 40)) -> Array | None:
        """Centre for a body within a sphere of this `radius` that meets no other one; None if none is found."""
        for _ in range(TRIES):
            z = self.focus + self.random.uniform(*depth)
            xy = self.random.uniform(-0.5, 0.5, 2) * self.field_width * z / self.focus
            centre = np.array([*xy, z])
            if all(np.linalg.norm(centre - c) > APART * (radius + r) for c, r in self.taken):
                self.taken.append((centre, radius))
                return centre
        return None

    def turn(self, centre: Array | None, facing: bool = True, end: float = 0.0) -> Array:
        """Random rotation (3, 3) of a body about its centre; every third time by multiples of a right angle.

        facing : +z turned to the lens
        end : distance of a flat end from the centre [mm], along +z, whose plane passes the pupil or its surroundings if
            bodies are `edge_on`
        """
        if self.edge_on and centre is not None:
            return self._edge_on(centre, end)
        if self.random.random() < 0.3:
            matrix = np.diag([-1.0, 1.0, -1.0])
        else:
            q, upper = np.linalg.qr(self.random.normal(size=(3, 3)))
            matrix = q * np.sign(np.diag(upper))
            matrix[:, 0] *= np.sign(np.linalg.det(matrix))
        if facing and matrix[2, 2] > 0:
            matrix[:, [0, 2]] *= -1
        return matrix

    def _edge_on(self, centre: Array, end: float) -> Array:
        """Rotation (3, 3) about `centre` that puts the end in a plane within 1.2 radii of the lens centre."""
        r, far = self.random, float(np.linalg.norm(centre))
        across, other = (np.cross(centre / far, axis) for axis in np.linalg.qr(r.normal(size=(3, 3)))[0][:2])
        across = across / np.linalg.norm(across)
        radius = self.lens["focal_length"] / self.lens["f_number"] / 2
        sine = (end + radius * r.uniform(-1.2, 1.2)) / far
        normal = math.sqrt(1 - sine**2) * across - sine * centre / far
        side = np.cross(normal, other)
        side /= np.linalg.norm(side)
        return np.stack([side, np.cross(normal, side), normal], axis=1)

    @property
    def law(self) -> dict[str, Any]:
        """Parameters of the exit law."""
        return {} if self.index is None else {"emission": "fresnel", "int_ior": self.index}

    def exitance(self) -> float:
        """Random J_n [W/mm²], from two decades."""
        return float(10 ** self.random.uniform(-2, 0))

    def add(self, what: dict[str, Any] | mi.Mesh, body: Body, glow: Any = None) -> None:
        """Add a body for Mitsuba and for the reference; `glow`: parameters of its emitter."""
        if isinstance(what, dict):
            if glow is not None:
                what = {**what, "emitter": {"type": "fspt_surface", "exitance": glow, **self.law}}
            else:
                what = {"bsdf": DARK, **what}
        self.objects[f"body_{len(self.objects)}"] = what
        self.bodies.append(body)

    def glowing(self, shape: Any, what: dict[str, Any], dark: bool = False) -> None:
        """Add a body with uniform J_n, or a dark one."""
        if dark:
            self.add(what, Body(shape))
            return
        level = self.exitance()
        self.add(what, Body(shape, lambda p, f: np.full(len(p), level), self.index, most=level), level)

    # ------------------------------------------------------------------ bodies

    def sphere(self, dark: bool = False, **place: Any) -> None:
        radius = float(np.exp(self.random.uniform(np.log(0.3), np.log(12))))
        centre = self.place(radius, **place)
        if centre is not None:
            self.glowing(
                Simple(Sphere(centre, radius)),
                {"type": "sphere", "center": centre.tolist(), "radius": radius},
                dark,
            )

    def plate(self, dark: bool = False, **place: Any) -> None:
        half = np.exp(self.random.uniform(np.log(0.5), np.log(12), 2))
        centre = self.place(float(np.hypot(*half)), **place)
        turn = self.turn(centre)
        if centre is not None:
            shape = Simple(Rectangle(centre, turn[:, 0] * half[0], turn[:, 1] * half[1]))
            self.glowing(shape, {"type": "rectangle", "to_world": _matrix(turn * [*half, 1], centre)}, dark)

    def disk(self, dark: bool = False, **place: Any) -> None:
        radius = float(np.exp(self.random.uniform(np.log(0.4), np.log(12))))
        centre = self.place(radius, **place)
        turn = self.turn(centre)
        if centre is not None:
            shape = Simple(Disc(centre, turn[:, 2], radius))
            self.glowing(shape, {"type": "disk", "to_world": _matrix(turn * radius, centre)}, dark)

    def backdrop(self) -> None:
        """A glowing plate that fills the field, behind the bodies in the middle."""
        half = 0.8 * self.field_width
        centre = np.array([0.0, 0.0, self.focus + float(self.random.uniform(60, 80))])
        turn = np.diag([-1.0, 1.0, -1.0])
        shape = Simple(Rectangle(centre, turn[:, 0] * half, turn[:, 1] * half))
        self.glowing(shape, {"type": "rectangle", "to_world": _matrix(turn * [half, half, 1], centre)})

    def _far_below_a_pixel(self, most: float) -> float:
        """Random length between a fiftieth and `most` of a pixel at the virtual detector plane [mm]."""
        pixel = self.field_width / max(self.size)
        return float(pixel * np.exp(self.random.uniform(np.log(0.02), np.log(most))))

    def grain(self) -> None:
        """A dark ball narrower than a pixel."""
        radius = self._far_below_a_pixel(0.4)
        centre = self.place(radius, BEFORE)
        if centre is not None:
            ball = {"type": "sphere", "center": centre.tolist(), "radius": radius}
            self.glowing(Simple(Sphere(centre, radius)), ball, dark=True)

    def wire(self) -> None:
        """A dark cylinder thinner than a pixel, open at its ends."""
        radius, height = self._far_below_a_pixel(0.2), float(self.random.uniform(4, 25))
        centre = self.place(height / 2, BEFORE)
        turn = self.turn(centre)
        if centre is None:
            return
        ends = [centre - height / 2 * turn[:, 0], centre + height / 2 * turn[:, 0]]
        tube = {"type": "cylinder", "p0": ends[0].tolist(), "p1": ends[1].tolist(), "radius": radius}
        self.glowing(Simple(Cylinder(centre, turn[:, 0], radius, height)), tube, dark=True)

    def slit(self) -> None:
        """Two dark plates side by side in one plane, with less than a pixel between them."""
        half, gap = self.random.uniform(4, 12, 2), self._far_below_a_pixel(0.6)
        middle = self.place(float(np.hypot(*half)), BEFORE)
        turn = self.turn(middle)
        if middle is None:
            return
        for side in (-1, 1):
            centre = middle + side * (half[0] + gap) / 2 * turn[:, 0]
            shape = Simple(Rectangle(centre, turn[:, 0] * half[0] / 2, turn[:, 1] * half[1]))
            plate = {"type": "rectangle", "to_world": _matrix(turn * [half[0] / 2, half[1], 1], centre)}
            self.glowing(shape, plate, dark=True)

    def cylinder(self) -> None:
        radius, height = self.random.uniform(1, 8), self.random.uniform(2, 25)
        centre = self.place(math.hypot(radius, height / 2))
        turn = self.turn(centre, False, height / 2)
        if centre is None:
            return
        axis, level = turn[:, 2], self.exitance()
        ends = [centre - height / 2 * axis, centre + height / 2 * axis]
        tube = {"type": "cylinder", "p0": ends[0].tolist(), "p1": ends[1].tolist(), "radius": float(radius)}
        shape = Simple(Cylinder(centre, axis, float(radius), float(height)))
        self.add(tube, Body(shape, lambda p, f: np.full(len(p), level), self.index, most=level), level)
        for k, end in enumerate(ends):
            cap = _matrix(turn * np.array([1, 1 if k else -1, 1 if k else -1]) * radius, end)
            emitter = {"type": "fspt_surface", "exitance": level, **self.law}
            self.objects[f"cap_{len(self.objects)}"] = {"type": "disk", "to_world": cap, "emitter": emitter}

    def mesh(self, box: bool) -> None:
        """A box with one J_n, or the convex hull of random points with J_n on its vertices."""
        import trimesh

        if box:
            half = self.random.uniform(1, 10, 3)
            solid = trimesh.creation.box(2 * half)
        else:
            points = self.random.normal(size=(int(self.random.integers(6, 30)), 3))
            points /= np.linalg.norm(points, axis=1)[:, None]
            solid = trimesh.convex.convex_hull(points * self.random.uniform(2, 12, 3))
        self.solid(solid, even=box)

    def ellipsoid(self) -> None:
        """An ellipsoid of 80 to 1280 faces with J_n on its vertices."""
        import trimesh

        solid = trimesh.creation.icosphere(int(self.random.integers(1, 4)))
        solid.apply_scale(self.random.uniform(2, 12, 3))
        self.solid(solid, even=False)

    def solid(self, solid: Any, even: bool) -> None:
        """A mesh of trimesh at a random place, with one J_n if that is `even`, else with J_n on its vertices."""
        import mitsuba as mi

        radius = float(np.linalg.norm(solid.vertices, axis=1).max())
        centre = self.place(radius)
        turn = self.turn(centre, False, float(solid.vertices[:, 2].max()))
        if centre is None:
            return
        vertices = (np.asarray(solid.vertices) @ turn.T + centre).astype(np.float32).astype(np.float64)
        faces = np.asarray(solid.faces, np.int64)
        level = np.full(len(vertices), self.exitance()) if even else 10 ** self.random.uniform(-2, 0, len(vertices))
        level = level.astype(np.float32).astype(np.float64)
        shape = Triangles(vertices, faces, np.arange(len(faces)))
        built = mesh(vertices, faces, level, self.law)(mi.ScalarTransform4f())
        self.add(built, Body(shape, linear_on(vertices, faces, level[faces]), self.index, most=float(level.max())))

    def bitmap(self) -> None:
        """A plate with random texels, nearest or bilinear."""
        import mitsuba as mi

        half = self.random.uniform(2, 14, 2)
        centre = self.place(float(np.hypot(*half)))
        turn = self.turn(centre)
        if centre is None:
            return
        rows, columns = (int(n) for n in self.random.integers(2, 17, 2))
        texels = (10 ** self.random.uniform(-2, 0, (rows, columns))).astype(np.float32)
        nearest = bool(self.random.random() < 0.5)
        plate = Rectangle(centre, turn[:, 0] * half[0], turn[:, 1] * half[1])
        texture = {
            "type": "bitmap",
            "bitmap": mi.Bitmap(texels[..., None]),
            "raw": True,
            "filter_type": "nearest" if nearest else "bilinear",
            "wrap_mode": "clamp",
        }
        offset = 0.0 if nearest else 0.5
        across, along = (2 * (np.arange(n + 1) + offset) / n - 1 for n in (columns, rows))

        def borders(fan: Fan) -> Array:
            return rectangle_lines(fan, plate, across.tolist(), along.tolist())

        most = float(texels.max())
        body = Body(Simple(plate), _texels_on(plate, texels, nearest), self.index, texture=borders, most=most)
        self.add({"type": "rectangle", "to_world": _matrix(turn * [*half, 1], centre)}, body, texture)

    def pane(self, mirror: bool) -> None:
        """A flat mirror beside or behind the glowing bodies, or a thin pane in front of them."""
        half = self.random.uniform(10, 40, 2)
        angle = self.random.uniform(-0.6, 0.6, 2) + ([0.9, 0] if mirror else [0, 0])
        (cx, cy), (sx, sy) = np.cos(angle), np.sin(angle)
        turn = np.array([[cx, 0, sx], [0, 1, 0], [-sx, 0, cx]]) @ np.array([[1, 0, 0], [0, cy, -sy], [0, sy, cy]])
        turn = turn @ np.diag([-1.0, 1.0, -1.0])
        z = self.focus + (self.random.uniform(45, 80) if mirror else self.random.uniform(-110, -70))
        centre = np.array([*self.random.uniform(-15, 15, 2), z])
        shape = Simple(Rectangle(centre, turn[:, 0] * half[0], turn[:, 1] * half[1]))
        index = float(self.random.uniform(1.3, 1.8))
        bsdf: dict[str, Any] = {"type": "conductor", "material": "none"}
        if not mirror:
            bsdf = {"type": "thindielectric", "int_ior": index, "ext_ior": 1.0}
        self.add(
            {"type": "rectangle", "to_world": _matrix(turn * [*half, 1], centre), "bsdf": bsdf},
            Body(shape, role="mirror" if mirror else "pane", glass=index),
        )

    # ------------------------------------------------------------------ all together

    def finish(self, name: str) -> RandomScene:
        """The scene with its lens."""
        width, height = self.size
        crop = (0, 0, width, height)
        if self.crops:
            w, h = (int(self.random.integers(side // 3, side + 1)) for side in self.size)
            crop = (int(self.random.integers(0, width - w + 1)), int(self.random.integers(0, height - h + 1)), w, h)
        camera = ReferenceCamera(**self.lens, width=width, height=height)
        stops = Stops.of(
            camera,
            self.stops.get("lens_diameter", math.inf),
            self.stops.get("diaphragm_distance", 0.0),
            self.stops.get("image_stop_diameter", math.inf),
        )
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film = {"type": "hdrfilm", "width": width, "height": height, **dict(zip(names, crop, strict=True))}
        sensor = {"type": "fspt_lens", "film": film, **self.lens, **self.stops}
        reference = FanReference(camera, stops, tuple(self.bodies), "centre" if self.centre else "area")
        return RandomScene(name, self.objects, sensor, reference, crop)


def _several(*kinds: str, most: int = 5, **how: Any) -> Callable[[_Maker], None]:
    """A family of one to `most` bodies of these kinds."""

    def fill(maker: _Maker) -> None:
        for _ in range(int(maker.random.integers(1, most + 1))):
            getattr(maker, str(maker.random.choice(kinds)))(**how)

    return fill


def _in_turn(*steps: Callable[[_Maker], None]) -> Callable[[_Maker], None]:
    """A family made by several steps."""

    def fill(maker: _Maker) -> None:
        for step in steps:
            step(maker)

    return fill


def _behind(maker: _Maker) -> None:
    """Glowing bodies behind the virtual detector plane."""
    for _ in range(int(maker.random.integers(1, 4))):
        getattr(maker, str(maker.random.choice(["sphere", "plate", "disk"])))(depth=(0, 40))


def _occluders(maker: _Maker) -> None:
    """Dark bodies in front of it."""
    for _ in range(int(maker.random.integers(1, 4))):
        getattr(maker, str(maker.random.choice(["sphere", "plate", "disk"])))(dark=True, depth=(-80, -20))


def _narrow(maker: _Maker) -> None:
    """Wires, grains of dust and slits far narrower than a pixel before a wide plate."""
    maker.backdrop()
    for _ in range(int(maker.random.integers(1, 5))):
        getattr(maker, str(maker.random.choice(["grain", "wire", "slit"])))()


def _stops(maker: _Maker) -> None:
    """Lens border and diaphragm apart, or an image-plane stop."""
    r = maker.random
    diameter = maker.lens["focal_length"] / maker.lens["f_number"]
    kind = int(r.integers(3))
    if kind != 1:
        distance = float(r.choice([-1, 1]) * r.uniform(0.05, 0.5) * maker.lens["focal_length"])
        maker.stops |= {"lens_diameter": float(diameter * r.uniform(0.8, 1.6)), "diaphragm_distance": distance}
    if kind:
        side = maker.lens["pixel_pitch"] * min(maker.size)
        maker.stops["image_stop_diameter"] = float(side * r.uniform(0.3, 1.2))


def _fresnel(maker: _Maker) -> None:
    maker.index = FRESNEL_INDEX


def _centre(maker: _Maker) -> None:
    maker.centre = True


def _edge_on(maker: _Maker) -> None:
    maker.edge_on = True


def _crop(maker: _Maker) -> None:
    maker.crops = True


def _pane(maker: _Maker) -> None:
    maker.pane(mirror=bool(maker.random.random() < 0.5))


_FOUR = _several("sphere", "plate", "disk", "cylinder", most=4)
_ELLIPSOIDS = _several("ellipsoid", most=2)

FAMILIES: dict[str, Callable[[_Maker], None]] = {
    "spheres": _several("sphere"),
    "plates": _several("plate", "disk"),
    "cylinders": _several("cylinder", most=3),
    "boxes": _several("mesh", box=True, most=3),
    "meshes": _several("mesh", box=False, most=2),
    "occluders": _in_turn(_behind, _occluders),
    "bitmaps": _several("bitmap", most=2),
    "exit laws": _in_turn(_fresnel, _FOUR),
    "stops": _in_turn(_stops, _FOUR),
    "centre": _in_turn(_centre, _FOUR),
    "crops": _in_turn(_crop, _several("sphere", "plate", "disk", "cylinder")),
    "panes and mirrors": _in_turn(_pane, _several("sphere", "plate", "disk", most=3)),
}
# Families all of whose glowing bodies are meshes, for the transport matrix.
MESH_FAMILIES: dict[str, Callable[[_Maker], None]] = {
    "boxes": FAMILIES["boxes"],
    "meshes": FAMILIES["meshes"],
    "ellipsoids": _ELLIPSOIDS,
    "hidden ellipsoids": _in_turn(_occluders, _ELLIPSOIDS),
    "Fresnel ellipsoids": _in_turn(_fresnel, _ELLIPSOIDS),
    "stopped ellipsoids": _in_turn(_stops, _ELLIPSOIDS),
    "cropped ellipsoids": _in_turn(_crop, _ELLIPSOIDS),
    "boxes edge-on": _in_turn(_edge_on, FAMILIES["boxes"]),
}
# Bodies with a flat end that the lens sees edge-on: the planes of ends cross the pupil or pass close to it.
EDGE_ON_FAMILIES: dict[str, Callable[[_Maker], None]] = {
    f"{name} edge-on": _in_turn(_edge_on, FAMILIES[name])
    for name in ("cylinders", "plates", "bitmaps", "exit laws", "stops", "centre", "crops", "panes and mirrors")
}
NARROW_FAMILIES: dict[str, Callable[[_Maker], None]] = {
    "narrow dark bodies": _narrow,
    "narrow before boxes": _in_turn(_narrow, FAMILIES["boxes"]),
}
ALL_FAMILIES = {**FAMILIES, **MESH_FAMILIES, **EDGE_ON_FAMILIES, **NARROW_FAMILIES}


def random_scene(family: str, seed: int, finer: int = 1) -> RandomScene:
    """The scene of a family of `ALL_FAMILIES` with this seed, on a film of `finer` times as many pixels
    along each side.
    """
    for attempt in itertools.count():
        maker = _Maker(np.random.default_rng([seed, list(ALL_FAMILIES).index(family), attempt]))
        maker.size = finer * maker.size[0], finer * maker.size[1]
        maker.lens["pixel_pitch"] /= finer
        ALL_FAMILIES[family](maker)
        if any(body.exitance is not None for body in maker.bodies):
            return maker.finish(f"{family} {seed}")
    raise AssertionError


def _matrix(linear: Array, centre: Array) -> mi.ScalarTransform4f:
    import mitsuba as mi

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, centre
    return mi.ScalarTransform4f(matrix.tolist())


def linear_on(vertices: Array, faces: Indices, level: Array) -> Callable[[Array, Indices], Array]:
    """J_n that is linear on faces, from its values `level` (F, 3) at their corners."""

    def exitance(points: Array, face: Indices) -> Array:
        a, b, c = (vertices[faces[face, k]] for k in range(3))
        e1, e2, w = b - a, c - a, points - a
        g11, g12, g22 = (np.einsum("nk,nk->n", x, y) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
        d1, d2 = np.einsum("nk,nk->n", w, e1), np.einsum("nk,nk->n", w, e2)
        share = g11 * g22 - g12**2
        p, q = (g22 * d1 - g12 * d2) / share, (g11 * d2 - g12 * d1) / share
        own = level[face]
        return own[:, 0] * (1 - p - q) + own[:, 1] * p + own[:, 2] * q

    return exitance


def _texels_on(plate: Rectangle, texels: NDArray[np.float32], nearest: bool) -> Callable[[Array, Indices], Array]:
    """J_n of texels (rows, columns) spread over a rectangle; row 0 at -half_height."""
    a, b = np.asarray(plate.half_width), np.asarray(plate.half_height)
    rows, columns = texels.shape

    def exitance(points: Array, face: Indices) -> Array:
        w = points - np.asarray(plate.centre)
        x, y = ((w @ axis / (axis @ axis) + 1) / 2 for axis in (a, b))
        x, y = x * columns, y * rows
        if nearest:
            return texels[np.clip(y.astype(int), 0, rows - 1), np.clip(x.astype(int), 0, columns - 1)]
        x, y = x - 0.5, y - 0.5
        i, j = np.floor(y).astype(int), np.floor(x).astype(int)
        p, q = y - i, x - j
        top, bottom = np.clip(i, 0, rows - 1), np.clip(i + 1, 0, rows - 1)
        left, right = np.clip(j, 0, columns - 1), np.clip(j + 1, 0, columns - 1)
        upper = texels[top, left] * (1 - q) + texels[top, right] * q
        return upper * (1 - p) + (texels[bottom, left] * (1 - q) + texels[bottom, right] * q) * p

    return exitance
