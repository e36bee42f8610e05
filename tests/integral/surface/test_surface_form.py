"""The surface form of Eq. 9: the same image as by the pupil form, from elements of the surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from references.sampled import lattice
from references.shapes import unit_disc
from small_scenes import (
    FOCUS,
    HEIGHT,
    MAGNIFICATION,
    PITCH,
    RADIUS,
    SIDE,
    WIDTH,
    by_elements,
    camera_scene,
    collected,
    disk,
    even_disc,
    filled,
    glow,
    lens,
    load_scene,
    look_at_crop,
    mi,
    sphere,
    world_scene,
    write_ply,
)

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import SceneError

pytestmark = pytest.mark.usefixtures("mono")

RTOL = 1e-2
QUARTER = (6, 8, 11, 10)  # crop window: the upper left quarter of a sphere of 8 mm at 180 mm, 3 mm left, 2 mm down
CASES = [
    ("nylon_cylinder", 2.8, None),
    ("two_spheres", 2.8, (14, 8, 12, 8)),
    ("l_shape", 2.8, (14, 6, 8, 12)),
]


def both(of, rtol=RTOL, **accuracy):
    """Images by elements of the surface, at `rtol`, and by the pupil form, four times finer."""
    return by_elements(of, rtol=rtol, **accuracy), fspt.render(of, rtol=rtol / 4, **accuracy)


def test_the_centre_of_a_disk_is_within_the_error():
    """A disk in focus, whose innermost elements are triangles that the midpoint rule does not hit in their centroids.

    Expected: the pupil form within both errors. Seen to fail on 12 pixels, 0.7 rtol off at 0.2 stated, where the error
    that the number of elements leaves is not stated.
    """
    scene = camera_scene(disk(FOCUS, 5.0, x=8.0), crop=(8, 14, 4, 4))
    image = fspt.render(scene, method="integral", rtol=3e-3, domain="surface")
    truth = fspt.render(scene, method="integral", rtol=1e-3)
    assert (np.abs(image.power - truth.power) <= image.error + truth.error).all()
    assert image.error.max() < 3e-3 * image.power.max()


@pytest.mark.parametrize("case", CASES, ids=str)
def test_both_forms_are_one_integral(case):
    """Expected: the accuracy asked for at every pixel, a bound on 99 of 100.

    Seen to fail with the cosine at the surface dropped, and on the cylinder with blur discs of half the radius.
    """
    name, f_number, crop = case
    surface, pupil = both(load_scene(name, f_number=f_number, crop=crop))
    off, peak = np.abs(surface.power - pupil.power), pupil.power.max()
    assert off.max() < RTOL * peak
    assert np.mean(off <= surface.error + pupil.error) >= 0.99


def test_the_rim_of_a_disk_aslant_sends_light():
    """Expected: the accuracy asked for. Seen to fail (7e-2) with a third of the rim not found."""
    aslant = camera_scene(disk(FOCUS, 6.0, 7.0, -3.0, tilt=60), crop=(2, 11, 12, 9))
    surface, pupil = both(aslant, rtol=1e-2)
    np.testing.assert_allclose(surface.power, pupil.power, atol=1e-2 * pupil.power.max())


def test_a_mesh_sends_light_from_its_faces_however_smoothly_it_is_shaded(tmp_path):
    """A sphere of 80 faces, its normals interpolated. Expected: the accuracy asked for, the sum to 1e-3.

    Seen to fail, by 9e-2 and 5e-3, with directions given in the shading frame.
    """
    body = trimesh.creation.icosphere(1, radius=8.0)
    path = write_ply(tmp_path / "ball.ply", body.vertices + np.array([0, 0, 180.0]), body.faces)
    surface, pupil = both(camera_scene({"type": "ply", "filename": str(path)}, crop=(8, 5, 12, 10)))
    np.testing.assert_allclose(surface.power, pupil.power, atol=RTOL * pupil.power.max())
    np.testing.assert_allclose(surface.power.sum(), pupil.power.sum(), rtol=1e-3)


def test_a_shadows_border_lies_where_lines_of_sight_find_it():
    """A sphere before a disk, 2 m from the world's origin. Expected: the accuracy asked for, the sum to 1e-3.

    Seen to fail, by 5e-2 and 2e-3, with the renderer's rays, which begin 9e-5 of that distance off the surface.
    """
    import mitsuba as mi

    far = 2000.0
    ball = sphere(150.0, 4.0, far + 3) | {"emitter": glow(0.01)}
    place = mi.ScalarTransform4f().translate([far, 0, 0])
    crop = (12, 9, 4, 5)  # of the disk's upper half, and the border on it
    surface, pupil = both(camera_scene(disk(175.0, 9.0, far, tilt=30), ball, to_world=place, crop=crop), rtol=2e-2)
    np.testing.assert_allclose(surface.power, pupil.power, atol=2e-2 * pupil.power.max())
    np.testing.assert_allclose(surface.power.sum(), pupil.power.sum(), rtol=1e-3)


@pytest.mark.parametrize("focus", [140.0, 200.0])
def test_all_power_arrives_at_every_focus(focus):
    """Rationale: images are shared out exactly among pixels, whatever is in focus. Expected: ∫ J_n f dS to 2e-3.

    Seen to fail with the cosine at the surface dropped.
    """
    pitch = 1.6 * 55 / (focus - 55)
    sharp = camera_scene(sphere(180.0, 8.0), focus_distance=focus, pixel_pitch=pitch, crop=(10, 6, 20, 20))
    power = fspt.render(sharp, domain="surface", rtol=0.1).power
    assert power[[0, -1]].max() == power[:, [0, -1]].max() == 0
    assert power.sum() == pytest.approx(collected(8.0, 180.0), rel=2e-3)


@pytest.mark.parametrize("f_number", [2.8, 22.0])
def test_no_pixel_is_left_out_in_focus_nor_stopped_down(f_number):
    """Rationale: points summed into their nearest pixel leave gaps there ('sparse'); images that tile do not.

    Expected: the closed form of the filled cone at every pixel, from two triangles and pixels far smaller.
    """
    picture = fspt.render(camera_scene(disk(FOCUS), f_number=f_number), domain="surface", rtol=RTOL)
    np.testing.assert_allclose(picture.power, filled(nodes=2, radius=55 / f_number / 2), rtol=2e-3)


def test_same_bits_in_every_run():
    body = camera_scene(sphere(180.0, 8.0, 3.0), sphere(150.0, 3.0), crop=(10, 8, 12, 8))
    first, second = (fspt.render(body, domain="surface", rtol=0.1) for _ in range(2))
    for plane in ("power", "error", "coverage"):
        np.testing.assert_array_equal(getattr(first, plane), getattr(second, plane))


@pytest.mark.parametrize(
    "lens",
    [
        {"model": "pinhole", "f_number": 8.0},
        {"model": "ripoll", "numerical_aperture": 0.06},
        {"f_number": 8.0, "lens_diameter": 20.0, "diaphragm_distance": 20.0},
        {"model": "hrrt", "lens_diameter": 12.0},
    ],
    ids=lambda lens: lens.get("model", "diaphragm off the lens"),
)
def test_every_model_of_the_lens(lens):
    surface, pupil = both(camera_scene(sphere(180.0, 8.0, 3.0, -2.0), crop=(6, 12, 11, 3), **lens))  # limb and middle
    np.testing.assert_allclose(surface.power, pupil.power, atol=RTOL * pupil.power.max())


def test_pixel_centres():
    body = camera_scene(sphere(180.0, 8.0, 3.0, -2.0), crop=QUARTER)
    surface, pupil = both(body, rtol=3e-2, pixel="centre", max_nodes=4096)
    np.testing.assert_allclose(surface.power, pupil.power, atol=3e-2 * pupil.power.max())


def test_crop_window_is_a_part_of_the_whole_image():
    """Expected: the accuracy asked for, the brightest pixel of either image in the part."""
    x, y, width, height = crop = (15, 9, 12, 10)
    whole, part = (
        fspt.render(camera_scene(sphere(180.0, 8.0), crop=c), domain="surface", rtol=3e-2) for c in (None, crop)
    )
    inside = whole.power[y : y + height, x : x + width]
    np.testing.assert_allclose(part.power, inside, atol=3e-2 * whole.power.max())
    assert part.coverage.shape == (height, width)


@pytest.mark.parametrize("domain", ["surface", "pupil"])
def test_a_spot_much_smaller_than_its_blur_keeps_its_power(domain):
    """Rationale: light from a spot of 0.05 mm, blurred over millimetres, is missed by any dozen nodes of a pupil; there
    the integral takes the surface form by itself.

    Expected: ∫ J_n f dS to 2e-3, spread evenly over the blur disc. Seen to fail, in the pupil, without that.
    """
    radius, depth = 0.025, 110.0
    picture = fspt.render(camera_scene(disk(depth, radius)), domain=domain, rtol=RTOL).power
    solid = RADIUS**2 / (RADIUS**2 + depth**2)  # of the flux density, from the spot to the pupil
    assert picture.sum() == pytest.approx(np.pi * radius**2 * solid, rel=2e-3)
    blur = RADIUS * abs(FOCUS - depth) / depth * MAGNIFICATION / PITCH  # pixels
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    inside = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) < blur - 1.5
    assert inside.any()
    assert np.ptp(picture[inside]) < 0.03 * picture.max()


# Width and length of a bar, and the radius of its blur disc, all in pixels.
BARS = [(0.03, 12.0, 0.0), (0.9, 9.0, 8.0)]


@pytest.mark.parametrize("bar", BARS, ids=str)
def test_a_bar_thinner_than_a_pixel_or_than_its_blur_is_seen_all_along(bar):
    """Rationale: lines of sight from the pixels meet it by chance; here its two triangles are long, and only thin.

    Expected: the accuracy asked for on every pixel, against a million points or more of bar × pupil summed into the
    pixels, and a bound. Seen to fail, by the whole peak, where one point stands for each triangle; and in the sharp
    plane with the cells' corners on the rings, where polygons hold less than the disc.
    """
    width, length, blur = bar
    depth = FOCUS * RADIUS / (RADIUS + blur * SIDE)
    size = np.array([length, width]) * SIDE * depth / FOCUS
    picture = fspt.render(camera_scene(rectangle(depth, *size, angle=27.0)), rtol=RTOL)
    expected = summed_points(depth, *size, angle=27.0, n=1 << (21 if blur > 4 else 20))
    off = np.abs(picture.power - expected) / expected.max()
    assert off.max() < RTOL
    assert np.mean(off <= picture.error / expected.max() + 5e-3) >= 0.99


def test_light_that_only_grazes_the_pupil_is_seen():
    """Rationale: of a tube along the axis the pupil's rim sees the outside, as strips far thinner than a pixel.

    Expected: all power, ∫∫ J_n cosθ_s cosθ / (π d²) dA dS, to 1e-3. Seen to fail (only 0.4 of it) where surfaces were
    judged by what the middle of the pupil sees of them.
    """
    depth, radius, off_axis = 180.0, 3.0, 1.0
    ends = {"p0": [off_axis, off_axis, depth], "p1": [off_axis, off_axis, depth + 1]}
    picture = fspt.render(camera_scene({"type": "cylinder", **ends, "radius": radius}), rtol=0.05)
    turn = np.linspace(0, 2 * np.pi, 180, endpoint=False)[:, None]
    ax, ay = RADIUS * even_disc(3000)
    dx, dy = ax - off_axis - radius * np.cos(turn), ay - off_axis - radius * np.sin(turn)
    z = depth + 0.5
    seen = np.maximum(dx * np.cos(turn) + dy * np.sin(turn), 0) * z / (dx**2 + dy**2 + z**2) ** 2
    assert picture.power.sum() == pytest.approx(2 * np.pi * radius * RADIUS**2 * seen.mean(), rel=1e-3)


@pytest.mark.parametrize(("rtol", "most"), [(0.5, 4e-3), (3e-3, 1e-3)])
def test_a_blur_disc_is_even_from_its_middle_to_its_rim(rtol, most):
    """Expected: cos⁴θ of the spot's angle to the pupil and nothing else, the more even the more cells.

    Seen to fail with cells of equal weight.
    """
    blur = 8.0
    depth = FOCUS * RADIUS / (RADIUS + blur * SIDE)
    side = 0.3 * SIDE * depth / FOCUS
    picture = by_elements(camera_scene(rectangle(depth, side, side, angle=27.0)), rtol=rtol).power
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    off_middle = np.hypot(x - WIDTH / 2, y - HEIGHT / 2)
    inside = off_middle < blur - 1.5
    cos4 = (1 + (off_middle / blur * RADIUS / depth) ** 2) ** -2
    even = picture[inside] / cos4[inside]
    assert np.ptp(even) < most * even.max()


def rectangle(depth, width, height, angle):
    """Rectangle that faces the lens from the axis, turned about it by `angle` degrees."""
    import mitsuba as mi

    turn = mi.ScalarTransform4f().translate([0, 0, depth]).rotate([0, 0, 1], angle).rotate([0, 1, 0], 180)
    return {"type": "rectangle", "to_world": turn.scale([width / 2, height / 2, 1])}


def summed_points(depth, width, height, angle, n):
    """Power of a rectangle on every pixel [W] at 1 W/mm²: points of it and of the pupil, each pair on its pixel."""
    nodes = lattice(n, (0.1, 0.2, 0.3, 0.4))
    along, across = ((nodes[:, :2] - 0.5) * (width, height)).T
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x, y = c * along - s * across, s * along + c * across
    a, b = RADIUS * unit_disc(nodes[:, 2:]).T
    pairs = depth**2 / (depth**2 + (x - a) ** 2 + (y - b) ** 2) ** 2 / np.pi
    column = WIDTH / 2 - (a + (x - a) * FOCUS / depth) / SIDE
    row = HEIGHT / 2 - (b + (y - b) * FOCUS / depth) / SIDE
    row, column = (np.floor(place).astype(int) for place in (row, column))
    on = (row >= 0) & (row < HEIGHT) & (column >= 0) & (column < WIDTH)
    power = np.bincount(row[on] * WIDTH + column[on], pairs[on], HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    return power * (width * height * np.pi * RADIUS**2 / n)


def test_a_spot_before_a_body_adds_its_power_where_it_is_blurred():
    """Rationale: most pixels keep the pupil form, those in the spot's blur disc take the surface form.

    Expected: pixel by pixel the sum of each alone, to the accuracy asked for.
    """
    body, spot = disk(FOCUS, 8.0), {**disk(110.0, 0.02), "emitter": glow(3e4)}
    both_shine = fspt.render(camera_scene(body, spot), rtol=0.1)
    alone = [fspt.render(camera_scene(shape), rtol=3e-2).power for shape in (body, spot)]
    assert alone[1].max() > 0.5 * alone[0].max()
    np.testing.assert_allclose(both_shine.power, sum(alone), atol=0.1 * both_shine.power.max())
    assert "lines a pixel" in both_shine.metadata["levels"]
    assert "nodes" in both_shine.metadata["levels"]


def test_a_light_without_a_surface_is_refused():
    lamp = {"type": "point", "position": [0.0, 0.0, 150.0], "intensity": 1.0}
    lit = camera_scene(sphere(180.0, 8.0), lamp=lamp)
    with pytest.raises(SceneError, match="needs surfaces"):
        fspt.render(lit, domain="surface")


@pytest.mark.parametrize("domain", ["surface", "pupil"])
def test_light_from_beyond_all_surfaces_is_refused(domain):
    """Rationale: pixels beside the objects would not see it."""
    sky = camera_scene(sphere(180.0, 8.0), lamp={"type": "constant"})
    with pytest.raises(SceneError, match=r"shines from beyond all surfaces.* Leave it out, or render with method path"):
        fspt.render(sky, domain=domain)


def test_a_small_sphere_far_out_of_focus():
    """Rationale: the radiance on film is J_n/π times the mean of cos⁴θ over the lines of sight that meet the sphere.

    Expected: rtol on every pixel, and no more claimed. Fails (5e-3 at rtol 1e-3) where cosines are those of spots that
    differ from line to line, instead of those of a piece's middle.
    """
    depth, radius, x, y = 120.0, 0.4, 1.0, -2.0
    quarter = (12, 13, 8, 6)
    picture = fspt.render(camera_scene(sphere(depth, radius, x, y), crop=quarter), domain="surface", rtol=2e-3)
    rows, columns = np.nonzero(picture.power > 0)
    pick = slice(None, None, 3)
    expected = [
        power_of_ball(quarter[1] + row, quarter[0] + column, depth, radius, x, y)
        for row, column in zip(rows[pick], columns[pick], strict=True)
    ]
    np.testing.assert_allclose(picture.power[rows, columns][pick], expected, atol=2e-3 * picture.power.max())
    assert picture.error.max() <= 2e-3 * picture.power.max()


def power_of_ball(row, column, depth, radius, x, y, sub=12, points=3000):
    """Power on a pixel of a sphere, by sub² points of the pixel, each through points of its image on the pupil [W]."""
    place = (np.arange(sub) + 0.5) / sub
    across, down = (np.ravel(n) for n in np.meshgrid(place, place))
    virtual = (((WIDTH / 2 - column - across) + 1j * (HEIGHT / 2 - row - down)) * SIDE)[:, None]
    centre = x + 1j * y
    stretch = FOCUS / (FOCUS - depth)  # from the sphere to the lens, seen from the virtual detector plane
    seen = 1.1 * radius * stretch
    a = virtual + stretch * (centre - virtual) + seen * (even_disc(points).T @ [1, 1j])
    c, d = centre - a, virtual - a
    length = np.sqrt(np.abs(d) ** 2 + FOCUS**2)
    along = ((c * d.conj()).real + depth * FOCUS) / length
    meets = (np.abs(c) ** 2 + depth**2 - along**2 <= radius**2) & (np.abs(a) <= RADIUS)
    return np.mean(meets * (FOCUS / length) ** 4) * seen**2 * (SIDE / FOCUS) ** 2


def test_a_thin_tube_far_away():
    """Rationale: Mitsuba's limb of a cylinder is off by a share of its distance squared over its radius, so lines of
    sight begin just before what there is. Expected: one image by both forms. Fails (1.3e-2) from the lens on.
    """
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([-4, 0, FOCUS])
    tube = {"type": "cylinder", "p0": [0, -3, 0], "p1": [0, 3, 0], "radius": 0.2, "to_world": place}
    of = camera_scene(tube, f_number=8.0, pixel_pitch=0.2, crop=(26, 6, 8, 10))
    surface, pupil = (fspt.render(of, domain=domain, rtol=2e-3).power for domain in ("surface", "pupil"))
    np.testing.assert_allclose(surface, pupil, atol=2e-3 * surface.max())


def test_no_pixel_is_dark_because_the_first_lines_of_sight_pass_it_by(tmp_path):
    """Pixels' centres behind a lens whose border passes a hundredth of the cone of its telecentric diaphragm.

    Stripes a pixel high, near the virtual detector plane. Expected at a pixel that sees but a stripe: A_vd times the
    configuration factor of the border's disc seen from the pixel's virtual point. Seen to fail (0 W, error 0) where a
    pixel counts as converged because no line of sight of the first two levels meets light there.
    """
    heights = [(-1.95, -0.601), (0.2465, 1.5955), (4.639, 5.988), (6.835, 8.184), (9.03, 10.379)]
    corners = [
        (x, y, 181.212) for low, high in heights for x, y in ((-7.55, low), (5.63, low), (5.63, high), (-7.55, high))
    ]
    faces = [tuple(4 * k + i for i in face) for k in range(len(heights)) for face in ((0, 2, 1), (0, 3, 2))]
    mesh = {"type": "ply", "filename": str(write_ply(tmp_path / "stripes.ply", corners, faces)), "face_normals": True}
    border, pitch, u = 3.028, 0.70377, 180.0
    optics = {"f_number": 6.1255, "magnification": None, "focus_distance": u, "to_world": None}
    telecentric = {"diaphragm_distance": 55.0, "lens_diameter": border}
    of = world_scene(mesh | {"emitter": glow(1.0)}, sensor=lens(size=(12, 10), pitch=pitch, **optics, **telecentric))
    side, radius = pitch * 125 / 55, border / 2
    squared = (1.5**2 + 0.5**2) * side**2
    z = u**2 + radius**2 + squared
    expected = side**2 * 0.5 * (1 - (z - 2 * radius**2) / np.sqrt(z**2 - 4 * radius**2 * squared))
    look_at_crop(of, 6, 3, 4, 4)
    for domain in ("surface", "pupil"):
        image = fspt.render(of, domain=domain, pixel="centre", rtol=1e-3, max_nodes=20000)
        assert image.power[2, 1] > 0
        assert abs(image.power[2, 1] - expected) <= image.error[2, 1] + 1e-3 * image.power.max()


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_a_spot_on_a_wall_of_two_faces_adds_its_light(domain):
    """Disks of a tenth of a pixel's width, three times as bright as the wall in focus behind them.

    Expected: half of rtol against what they cover and what they add. Seen to fail, by 3.6e-3 of the brightest pixel,
    where a face that is wider than the image counts as if all its light fell on one pixel, which rtol then is counted
    from.
    """
    pitch = 0.5
    wall = {"type": "rectangle", "to_world": mi_turned(0, 0, 180.0, 6.0)}
    spots = [(-0.25, 0.75), (1.75, -1.25)]
    disks = [{"type": "disk", "to_world": mi_turned(x, y, 179.99, 0.1 * pitch)} for x, y in spots]
    shapes = [wall | {"emitter": glow(1.0)}, *(disk | {"emitter": glow(3.0)} for disk in disks)]
    optics = {"f_number": 4.0, "magnification": None, "focus_distance": 180.0, "to_world": None}
    of = world_scene(*shapes, sensor=lens(size=(8, 6), pitch=pitch * 55 / 125, **optics))
    expected = filled(side=pitch, nodes=2, radius=55 / 8, distance=180.0)[13:19, 16:24]
    for x, y in spots:
        expected[int(3 - y / pitch), int(4 - x / pitch)] *= 1 + 2 * np.pi * 0.1**2
    image = fspt.render(of, domain=domain, rtol=4e-3)
    assert np.abs(image.power - expected).max() < 2e-3 * expected.max()


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_a_bright_vertex_of_small_faces_lies_where_it_is(tmp_path, domain):
    """One vertex of a fine mesh outshines the others a thousandfold, beside the corner of a pixel; faces of 0.1 pixel.

    Expected: on each pixel what it has of the cone over the six faces, counted. Seen to fail, by 0.1 of the brightest
    pixel and ten times the error stated, where faces much below a pixel are not cut, however bright.
    """
    side, steps, off = 0.5, 0.05, np.array([0.012, 0.018])
    x, y = (c.ravel() for c in np.meshgrid(*2 * [steps * np.arange(-20, 21)], indexing="ij"))
    number = np.arange(41 * 41).reshape(41, 41)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    corners = np.stack([x + off[0], y + off[1], np.full(x.size, 180.0)], 1)
    values = np.where((x == 0) & (y == 0), 1.0, 1e-3)
    path = write_ply(tmp_path / "plate.ply", corners, faces, vertex=values)
    glowing = glow({"type": "mesh_attribute", "name": "vertex_exitance"})
    optics = {"f_number": 8.0, "magnification": None, "focus_distance": 180.0, "to_world": None}
    camera = lens(size=(12, 10), pitch=side * 55 / 125, **optics)
    of = world_scene({"type": "ply", "filename": str(path), "face_normals": True, "emitter": glowing}, sensor=camera)
    image = fspt.render(of, domain=domain, rtol=1e-2)
    u, v = (c.ravel() for c in np.meshgrid(*2 * [(np.arange(800) + 0.5) / 400 - 1]))
    cone = (1 - np.maximum(np.maximum(np.abs(u), np.abs(v)), np.abs(u - v))).clip(0) * (steps / 400 / side) ** 2
    column, row = (size / 2 - (n * steps + o) / side for n, o, size in ((u, off[0], 12), (v, off[1], 10)))
    expected = np.full((10, 12), 1e-3)
    np.add.at(expected, (row.astype(int), column.astype(int)), 0.999 * cone)
    found = image.power / of.sensors()[0].camera.etendue * np.pi
    here = slice(4, 6), slice(5, 7)
    assert np.abs(found - expected)[here].max() < 1e-2 * expected.max()


def mi_turned(x, y, z, scale):
    """A place on the axis of a lens that looks along +z, turned towards it."""
    import mitsuba as mi

    return mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 180).scale(scale)


def test_a_plate_nearly_edge_on_is_not_in_its_own_shadow():
    """The power of Eq. M.9 by a sum in float64: rays leave the plate at up to 3e-4 rad, with a body beside it.

    Seen to lose 12 % where rays of all angles start at the same distance along them.
    """
    centre, focal, f_number, half = np.array([-8.3, 6.7, 240.0]), 55.0, 400.0, 0.7
    away = centre / np.linalg.norm(centre)
    across = np.cross(away, [0.6, -0.8, 0.1])
    across /= np.linalg.norm(across)
    normal = np.cross(away, across) - 2e-5 * away
    normal /= np.linalg.norm(normal)
    matrix = np.eye(4)
    matrix[:3] = np.stack([half * np.cross(across, normal), half * across, normal, centre], axis=1)
    matrix = matrix.astype(np.float32).astype(np.float64)
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix)}
    whole = camera_scene(
        plate,
        bodies=[disk(240.0, 1.0, x=30.0)],
        focal_length=focal,
        f_number=f_number,
        focus_distance=225.0,
        pixel_pitch=0.2,
    )
    place = (np.arange(16) + 0.5) / 8 - 1
    x, y = np.meshgrid(place, place)
    points = np.stack([x.ravel(), y.ravel()], axis=1) @ matrix[:3, :2].T + matrix[:3, 3]
    lens = np.pad(focal / f_number / 2 * even_disc(4000).T, ((0, 0), (0, 1)))
    way = lens - points[:, None]
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    cosines = np.maximum(way @ normal, 0) / np.linalg.norm(normal) * -way[..., 2]
    pupil = np.pi * (focal / f_number / 2) ** 2
    expected = (cosines / (way**2).sum(axis=-1) ** 2).mean() * 4 * half**2 * pupil / np.pi
    image = fspt.render(whole, method="integral", rtol=1e-3)
    assert image.power.sum() == pytest.approx(expected, rel=1e-2, abs=0)
