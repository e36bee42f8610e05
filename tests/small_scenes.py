"""Small scenes for the tests: objects in the camera frame or around the world's origin, and scene files.

`camera_scene` puts the lens into the origin: +z to the object, +x to the left. All its films are of 40 × 32 pixels; a
crop window is quicker. `world_scene` has its objects around the origin and the `lens` on the +x axis. Importing this
module sets a variant of Mitsuba unless one is set; the fixture `mono` sets the variant of the run.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend

backend.ensure_variant()

import mitsuba as mi  # noqa: E402

SCENES = Path(__file__).resolve().parents[1] / "scenes"


def glow(exitance=1e-3):
    """An emitter with this number or texture."""
    return {"type": "fspt_surface", "exitance": exitance}


def attribute(name="vertex_exitance", **settings):
    """The texture of a mesh attribute."""
    return {"type": "mesh_attribute", "name": name, **settings}


def even_disc(count):
    """Points (2, count) of the unit disc, evenly (sunflower)."""
    number = np.arange(count) + 0.5
    angle = number * np.pi * (3 - np.sqrt(5))
    return np.sqrt(number / count) * np.stack([np.cos(angle), np.sin(angle)])


# --- in the camera frame ---

WIDTH, HEIGHT = 40, 32
FOCAL, F_NUMBER, FOCUS, MAGNIFICATION = 55.0, 2.8, 165.0, 0.5
RADIUS = FOCAL / F_NUMBER / 2  # of the pupil [mm]
PITCH = 0.4  # mm
SIDE = PITCH / MAGNIFICATION  # of a virtual pixel [mm]


def load_scene(name, crop=None, **parameters):
    """A scene of scenes/ with its whole field on the small film, of which `crop` is looked at: x, y, width, height."""
    whole = {"width": WIDTH, "height": HEIGHT, "pixel_pitch": 256 * 0.108 / HEIGHT}
    scene = fspt.load(SCENES / f"{name}.xml", **whole | parameters)
    if crop:
        look_at_crop(scene, *crop)
    return scene


def look_at_crop(scene, x, y, width, height):
    """Give the film of a loaded scene's first sensor this crop window [pixels]."""
    film = mi.traverse(scene.sensors()[0].film())
    film["crop_offset"], film["crop_size"] = [x, y], [width, height]
    film.update()


def by_elements(scene, **accuracy):
    """Image of a scene by the elements of all surfaces, also of meshes: by none of the code of images by faces.

    `accuracy`: of `Quadrature`.
    """
    from mitsuba_fspt.camera.of_sensor import camera_of
    from mitsuba_fspt.integral.quadrature import Quadrature
    from mitsuba_fspt.integral.solver import Solver
    from mitsuba_fspt.integral.surface import surface_form

    camera = camera_of(scene.sensors()[0])
    window = Solver().visible_window(scene, camera, False, ())
    return surface_form.solve(scene, camera, window, Quadrature(**accuracy))


def camera_scene(*shapes, exitance=1.0, crop=None, lamp=None, bodies=(), **optics):
    """Scene of shapes that glow with `exitance` [W/mm²], unless they bring their own 'emitter', before the lens.

    `optics`: parameters of fspt_lens, by default 55 mm f/2.8 at magnification 1/2. `crop`: x, y, width, height.
    `lamp`: another emitter. `bodies`: shapes that do not glow.
    """
    optics = {"focal_length": FOCAL, "f_number": F_NUMBER, "pixel_pitch": PITCH} | optics
    if not {"magnification", "focus_distance", "image_distance"} & set(optics):
        optics["magnification"] = MAGNIFICATION
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "luminance"}
    if crop:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, crop, strict=True))
    objects = {f"shape_{k}": {"emitter": glow(exitance), **shape} for k, shape in enumerate(shapes)}
    sensor = {"type": "fspt_lens", "film": film, **optics}
    objects |= {f"body_{k}": body for k, body in enumerate(bodies)} | ({"lamp": lamp} if lamp else {})
    whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, **objects}
    return mi.load_dict(whole, optimize=False)


def disk(z, radius=100.0, x=0.0, y=0.0, tilt=0.0):
    """Disk that faces the lens, turned about the vertical by `tilt` degrees."""
    place = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 180 + tilt).scale(radius)
    return {"type": "disk", "to_world": place}


def sphere(z, radius, x=0.0, y=0.0):
    """Sphere without an emitter of its own."""
    return {"type": "sphere", "center": [x, y, z], "radius": radius}


def power(of, **accuracy):
    """Image of a scene by the integral, (h, w) [W]."""
    return fspt.render(of, method="integral", **accuracy).power


def virtual_pixels(side=SIDE, nodes=1):
    """x (WIDTH, nodes) and y (HEIGHT, nodes) of Gauss nodes on the virtual pixels, and their weights [mm]."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    x, y = ((size / 2 - np.arange(size)[:, None] - 0.5 - node / 2) * side for size in (WIDTH, HEIGHT))
    return x, y, weight / 2


def over_pixels(function, side=SIDE, nodes=1):
    """Mean of function(x, y) over every virtual pixel, (HEIGHT, WIDTH), by nodes² Gauss nodes."""
    x, y, weight = virtual_pixels(side, nodes)
    values = function(x[None, :, None, :], y[:, None, :, None])
    return np.einsum("hwij,i,j->hw", values, weight, weight)


gauss_rule = cache(np.polynomial.legendre.leggauss)  # nodes and weights on -1 … 1; 400 of them take 0.1 s


def configuration_factor(radius, distance, off_axis):
    """From a point to a parallel disc at `distance` whose centre is `off_axis` from its normal."""
    z = distance**2 + radius**2 + off_axis**2
    s = np.sqrt((z - 2 * radius * off_axis) * (z + 2 * radius * off_axis))
    return 2 * radius**2 * distance**2 / (s * (s + z - 2 * radius**2))


def filled(side=SIDE, nodes=1, radius=RADIUS, distance=FOCUS):
    """Power on every pixel whose cone is filled by 1 W/mm²: A_vd times the configuration factor."""
    factor = over_pixels(lambda x, y: configuration_factor(radius, distance, np.hypot(x, y)), side, nodes)
    return side**2 * factor


def collected(radius, centre, pupil=RADIUS):
    """∫ J_n f dS [W]: what a uniform sphere on the axis (1 W/mm²) sends through the pupil.

    Gauss rules over the polar angle of the sphere and over the pupil; only what faces a pupil point shines at it.
    """
    node, weight = gauss_rule(400)
    cosine, weight = -1 + 0.6 * (node + 1), 0.6 * weight  # the cap that looks at the lens, and a little more
    sine = np.sqrt(1 - cosine**2)
    rho, share = gauss_rule(24)
    turn = (np.arange(64) + 0.5) * 2 * np.pi / 64
    rho = pupil * np.sqrt((rho + 1) / 2)[:, None]
    px, py = (rho * np.cos(turn)).ravel(), (rho * np.sin(turn)).ravel()
    part = np.repeat(share / 2, 64) / 64 * np.pi * pupil**2
    x, z = radius * sine[:, None], centre + radius * cosine[:, None]
    dx, d2 = px - x, (px - x) ** 2 + py**2 + z**2
    shine = np.maximum(dx * sine[:, None] - z * cosine[:, None], 0) * z / (np.pi * d2**2)
    return weight @ (shine @ part) * 2 * np.pi * radius**2


# --- around the world's origin ---


def write_ply(path, vertices, faces, *, vertex=None, face=None):
    """Path of an ASCII PLY with one exitance a vertex or a face, which Mitsuba reads as `vertex_exitance`, …"""
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += ["property float exitance_x"] if vertex is not None else []
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["property float exitance_x"] if face is not None else []
    rows = ["{:.9g} {:.9g} {:.9g}".format(*v) for v in vertices]
    if vertex is not None:
        rows = [f"{row} {value:.9g}" for row, value in zip(rows, vertex, strict=True)]
    corners = [f"3 {a} {b} {c}" for a, b, c in faces]
    if face is not None:
        corners = [f"{row} {value:.9g}" for row, value in zip(corners, face, strict=True)]
    path.write_text("\n".join([*header, "end_header", *rows, *corners, ""]))
    return path


def lens(size=16, pitch=0.8, distance=165.0, **settings):
    """An f/8 lens on the +x axis that looks at the origin; `settings` replace or add parameters, None removes one."""
    width, height = size if isinstance(size, tuple) else (size, size)
    numbers = {
        "type": "fspt_lens",
        "focal_length": 55.0,
        "f_number": 8.0,
        "magnification": 0.5,
        "pixel_pitch": pitch,
        "to_world": mi.ScalarTransform4f().look_at([distance, 0, 0], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"},
    }
    return {name: value for name, value in (numbers | settings).items() if value is not None}


def world_scene(*shapes, sensor=None, integrator=None, robust=True):
    """A loaded scene of these shape dictionaries, `shape_0`, `shape_1`, …, before a lens."""
    return mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": robust,
            "integrator": integrator or {"type": "fspt_integral"},
            "camera": sensor or lens(),
            **{f"shape_{k}": shape for k, shape in enumerate(shapes)},
        }
    )


def ball(exitance=1e-3, radius=5.0, center=(0.0, 0.0, 0.0)):
    """A glowing sphere about the world's origin."""
    return {"type": "sphere", "radius": radius, "center": list(center), "emitter": glow(exitance)}


LENS_XML = """
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/>
        <float name="f_number" value="$f_number"/>
        <float name="magnification" value="0.5"/>
        <float name="pixel_pitch" value="0.8"/>
        <transform name="to_world"><lookat origin="$distance, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/>
            <integer name="height" value="6"/>
            <string name="pixel_format" value="luminance"/>
        </film>
    </sensor>"""

BALL_XML = """
    <shape type="sphere">
        <float name="radius" value="3"/>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""


def write_scene(path, *, sensor=LENS_XML, shapes=BALL_XML, integrator='<integrator type="fspt_integral"/>', more=""):
    """Path of a scene file with the parameters f_number and distance, of these parts."""
    path.write_text(
        f"""<scene version="3.0.0">
    <default name="f_number" value="8"/>
    <default name="distance" value="165"/>
    {integrator}{sensor}{shapes}{more}
</scene>
"""
    )
    return path
