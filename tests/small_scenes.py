"""Small scenes for the tests that render, in the camera frame: lens in the origin, +z to the object, +x to the left.

All on one film of 40 × 32 pixels, whose size is compiled into the kernels: so the tests share them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt

SCENES = Path(__file__).parents[1] / "scenes"
WIDTH, HEIGHT = 40, 32
FOCAL, F_NUMBER, FOCUS, MAGNIFICATION = 55.0, 2.8, 165.0, 0.5
RADIUS = FOCAL / F_NUMBER / 2  # of the pupil [mm]
PITCH = 0.4  # mm
SIDE = PITCH / MAGNIFICATION  # of a virtual pixel [mm]


def load(name, **parameters):
    """A scene of scenes/ with its whole field on the small film."""
    whole = {"width": WIDTH, "height": HEIGHT, "pixel_pitch": 256 * 0.108 / HEIGHT}
    return fspt.load(SCENES / f"{name}.xml", **whole | parameters)


def scene(*shapes, exitance=1.0, crop=None, lamp=None, **lens):
    """Scene of shapes that glow with `exitance` [W/mm²], unless they bring their own 'glow', before the lens.

    `lens`: parameters of fspt_lens, by default 55 mm f/2.8 at magnification 1/2. `crop`: x, y, width, height.
    `lamp`: another emitter.
    """
    import mitsuba as mi

    lens = {"focal_length": FOCAL, "f_number": F_NUMBER, "pixel_pitch": PITCH} | lens
    if not {"magnification", "focus_distance", "image_distance"} & set(lens):
        lens["magnification"] = MAGNIFICATION
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "luminance"}
    if crop:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, crop, strict=True))
    glow = {"type": "fspt_surface", "exitance": exitance}
    bodies = {f"shape_{k}": {"glow": dict(glow), **shape} for k, shape in enumerate(shapes)}
    sensor = {"type": "fspt_lens", "film": film, **lens}
    bodies |= {"lamp": lamp} if lamp else {}
    whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, **bodies}
    return mi.load_dict(whole, optimize=False)


def even_disc(count):
    """Points (2, count) of the unit disc, evenly (sunflower)."""
    number = np.arange(count) + 0.5
    angle = number * np.pi * (3 - np.sqrt(5))
    return np.sqrt(number / count) * np.stack([np.cos(angle), np.sin(angle)])


def disk(z, radius=100.0, x=0.0, y=0.0, tilt=0.0):
    """Disk that faces the lens, turned about the vertical by `tilt` degrees."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 180 + tilt).scale(radius)
    return {"type": "disk", "to_world": place}


def sphere(z, radius, x=0.0, y=0.0):
    return {"type": "sphere", "center": [x, y, z], "radius": radius}


def power(of, **accuracy):
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
    node, weight = np.polynomial.legendre.leggauss(400)
    cosine, weight = -1 + 0.6 * (node + 1), 0.6 * weight  # the cap that looks at the lens, and a little more
    sine = np.sqrt(1 - cosine**2)
    rho, share = np.polynomial.legendre.leggauss(24)
    turn = (np.arange(64) + 0.5) * 2 * np.pi / 64
    rho = pupil * np.sqrt((rho + 1) / 2)[:, None]
    px, py = (rho * np.cos(turn)).ravel(), (rho * np.sin(turn)).ravel()
    part = np.repeat(share / 2, 64) / 64 * np.pi * pupil**2
    x, z = radius * sine[:, None], centre + radius * cosine[:, None]
    dx, d2 = px - x, (px - x) ** 2 + py**2 + z**2
    shine = np.maximum(dx * sine[:, None] - z * cosine[:, None], 0) * z / (np.pi * d2**2)
    return weight @ (shine @ part) * 2 * np.pi * radius**2
