"""The transport matrix against closed forms, quadrature in double precision, and renders by the pupil form."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh
from references.random_scenes import random_scene
from small_scenes import (
    F_NUMBER,
    FOCUS,
    HEIGHT,
    PITCH,
    RADIUS,
    WIDTH,
    attribute,
    by_elements,
    filled,
    glow,
    lens,
    look_at_crop,
    mi,
    world_scene,
    write_ply,
)

import mitsuba_fspt as fspt

pytestmark = pytest.mark.usefixtures("mono")

RTOL = 1e-3
BODY = trimesh.creation.icosphere(2, radius=8.0)  # 162 vertices, 320 faces; a face covers a pixel
TURN = trimesh.transformations.rotation_matrix(0.4, [1, 2, 0.5])[:3, :3]


def body_scene(
    folder, on="vertex", depth=FOCUS, mesh=None, extra=(), emission=None, size=(20, 16), pitch=0.8, **optics
):
    """Scene of a mesh about the origin, this far in front of a lens on the +x axis that is focused to 165 mm.

    It has the attribute `vertex_exitance` or `face_exitance`. `extra`: further shapes; `emission`: of the exit law.
    """
    vertices, faces = mesh or (BODY.vertices @ TURN.T, BODY.faces)
    count = len(vertices) if on == "vertex" else len(faces)
    path = write_ply(folder / f"body_{on}.ply", vertices, faces, **{on: np.ones(count)})
    emitter = glow(attribute(f"{on}_exitance")) | (emission or {})
    body = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": emitter}
    sensor = lens(size, pitch, depth, **{"f_number": F_NUMBER} | optics)
    return world_scene(body, *extra, sensor=sensor)


def before_the_lens(vertices, depth):
    """Vertices of `body_scene` in a frame with the lens at the origin and its axis along +z."""
    return np.stack([vertices[:, 2], vertices[:, 1], depth - vertices[:, 0]], axis=1)


def shape_exitance(emitter):
    """J_n on the vertices of an emitting mesh."""
    import mitsuba as mi

    return np.array(mi.traverse(emitter.get_shape())["vertex_exitance"], np.float64)


def shine(scene, on, exitance):
    """Give the only glowing mesh of a scene this J_n."""
    import mitsuba as mi

    mesh = next(shape for shape in scene.shapes() if shape.emitter() is not None)
    values = mi.traverse(mesh)
    values[f"{on}_exitance"] = mi.Float(np.asarray(exitance, np.float32))
    values.update()


def exitances(on):
    """J_n over four decades, smooth, and one as of a Monte Carlo with zeros, on the body."""
    centres = (BODY.vertices @ TURN.T)[BODY.faces].mean(axis=1) if on == "face" else BODY.vertices @ TURN.T
    smooth = np.exp(-((centres - [8, 2, 1]) ** 2).sum(axis=1) / 50)
    decades = 10 ** (-4 * (centres[:, 1] - centres[:, 1].min()) / np.ptp(centres[:, 1]))
    noisy = np.random.default_rng(1).poisson(100 * smooth) / 100
    return {"smooth": smooth, "decades": decades, "noisy": noisy}


def disc_nodes(radius, rings=8, spokes=24):
    """Points (n, 2) of a disc and their areas (n,)."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    rho, turn = radius * np.sqrt((node + 1) / 2), (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    points = np.stack([np.outer(rho, np.cos(turn)), np.outer(rho, np.sin(turn))], -1).reshape(-1, 2)
    return points, np.repeat(weight / 2, spokes) / spokes * np.pi * radius**2


def collected_by_vertices(vertices, faces, cut=4):
    """∫ φ_j f_S→pupil dS [mm²] of every vertex of a convex body: midpoints of cut² parts of a face × the pupil."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    normal = cross / (2 * area[:, None])
    points, weights = disc_nodes(RADIUS)
    pupil = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    total = np.zeros(len(vertices))
    for i in range(cut):
        for j in range(cut - i):
            for up in (True, False)[: 2 if i + j < cut - 1 else 1]:
                third = 1 / 3 if up else 2 / 3
                shares = np.array([0, (i + third) / cut, (j + third) / cut])
                shares[0] = 1 - shares.sum()
                r = shares[0] * a + shares[1] * b + shares[2] * c
                way = pupil[None] - r[:, None]
                squared = (way**2).sum(axis=-1)
                cosines = np.maximum(np.einsum("fpi,fi->fp", way, normal), 0) * -way[..., 2]
                factor = (cosines / squared**2 / np.pi) @ weights
                for k in range(3):
                    total += np.bincount(faces[:, k], shares[k] * factor * area / cut**2, minlength=len(vertices))
    return total


def test_sums_of_columns_are_form_factors_whatever_the_focus(tmp_path):
    """Expected out of focus: ∫ φ_j f_S→pupil dS, to 1e-3 at rtol 1e-3 of each column that sends light.

    A column seen by a rim of the pupil alone has so little light that it is compared with a percent of the largest.
    Seen to fail with cos⁴θ or cosθ_s dropped from the columns, 1/π twice, and u² replaced by a constant.
    """
    depth, bound = 150.0, 1e-3
    matrix = fspt.transport(body_scene(tmp_path, depth=depth), rtol=RTOL)
    expected = collected_by_vertices(before_the_lens(BODY.vertices @ TURN.T, depth), BODY.faces)
    np.testing.assert_allclose(matrix.sensitivity, expected, rtol=bound, atol=bound * 0.01 * expected.max())
    assert expected.max() > 1e-3
    assert not matrix.sensitivity[expected == 0].any()


def test_sums_of_rows_are_the_image_of_one_in_closed_form(tmp_path):
    """A plane that fills every cone: A_vd times the configuration factor, to 1e-5; out of focus too.

    Seen to fail with cos⁴θ dropped from the columns, 1/π twice, and u² replaced by a constant.
    """
    corners = 200.0 * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
    film = {"size": (WIDTH, HEIGHT), "pitch": PITCH}
    scene = body_scene(tmp_path, depth=175.0, mesh=(corners, np.array([[0, 1, 2], [0, 2, 3]])), **film)
    matrix = fspt.transport(scene, rtol=RTOL)
    np.testing.assert_allclose(matrix.forward(np.ones(4))[0], filled(nodes=4), rtol=1e-5)
    assert matrix.areas.sum() == pytest.approx(400.0**2)


@pytest.mark.parametrize(("on", "depth"), [("face", 165.0), ("vertex", 205.0)])
def test_products_are_rendered_images(tmp_path, on, depth):
    """Expected: rtol of the brightest pixel beside the error of a render twice as fine; within `error` on 99 %.

    Seen to fail with two columns swapped, and with cosθ_s dropped.
    """
    scene = body_scene(tmp_path, on, depth)
    look_at_crop(scene, 9, 2, 4, 6)  # an eighth of the body, with the limb and the middle
    matrix = fspt.transport(scene, on=on, rtol=RTOL)
    for name in ("decades", "noisy"):
        exitance = exitances(on)[name]
        shine(scene, on, exitance)
        image = fspt.render(scene, method="integral", rtol=RTOL / 2)
        off = np.abs(matrix.forward(exitance)[0] - image.power)
        beyond = off - image.error
        assert beyond.max() <= RTOL * image.power.max(), name
        assert (off <= matrix.error(exitance)[0] + image.error).mean() > 0.99, name
        assert matrix.error(exitance).max() < 30 * RTOL * image.power.max()


def test_faces_of_many_pixels_far_out_of_focus(tmp_path):
    """Blur discs of ten pixels' radius, faces as large: what is sampled of the pupil must not show.

    Expected: rtol of the brightest pixel beside the error of the surface form with as many elements as it takes.
    Seen to fail with a quarter of the cells of the pupil, and with columns that take those of the face.
    """
    ball = trimesh.creation.icosphere(1, radius=3.0)
    mesh = ball.vertices @ TURN.T, ball.faces
    scene = body_scene(tmp_path, "vertex", 200.0, mesh=mesh, size=(48, 48), pitch=0.1)
    look_at_crop(scene, 24, 6, 7, 18)  # an eighth of the ball, with the limb and the middle
    matrix = fspt.transport(scene, rtol=RTOL)
    exitance = 0.1 + np.random.default_rng(3).random(matrix.shape[1])
    shine(scene, "vertex", exitance)
    image = by_elements(scene, rtol=RTOL / 10, max_nodes=1 << 13)
    off = np.abs(matrix.forward(exitance)[0] - image.power)
    assert (off - image.error).max() <= RTOL * image.power.max()
    assert (off <= matrix.error(exitance)[0] + image.error).mean() > 0.99


def test_noise_on_faces_smaller_than_a_pixel(tmp_path):
    """J_n of one value in five, 0 else, on faces of a third of a pixel, blurred by a quarter of one.

    Expected: rtol of the brightest pixel beside the error of a render. Seen to fail with faces up to half a pixel taken
    as points, whatever the blur.
    """

    ball = trimesh.creation.icosphere(4, radius=8.0)
    mesh = ball.vertices @ TURN.T, ball.faces
    scene = body_scene(tmp_path, "face", FOCUS + 12.0, mesh=mesh)
    look_at_crop(scene, 7, 7, 3, 2)
    matrix = fspt.transport(scene, on="face", rtol=RTOL)
    exitance = 1.0 * (np.random.default_rng(4).random(matrix.shape[1]) < 0.2)
    shine(scene, "face", exitance)
    image = fspt.render(scene, method="integral", rtol=RTOL / 2, max_nodes=1 << 22)
    off = np.abs(matrix.forward(exitance)[0] - image.power)
    assert image.error.max() <= RTOL / 2 * image.power.max()
    assert (off - image.error).max() <= RTOL * image.power.max()


def test_no_entry_is_lost_between_the_surface_form_and_lines_of_sight(tmp_path):
    """The limb of an ellipsoid in focus: an entry that one of the two puts just above the threshold for lines of sight,
    the other just below it.

    Expected: a share of a row above 0.3 % is in the matrix at another rtol as well; the power of the rows is that of
    `render` within both errors, and to 0.1 % of the brightest pixel. Seen to fail, with 0.5 % of a row lost and its
    image 3 times `error` too dark, where such an entry was in neither of the two; and with 0.4 % of the brightest
    pixel where rows came by lines of sight whose error exceeds that of the surface form.
    """
    body = trimesh.creation.icosphere(4)
    body.apply_scale([10, 15, 8])
    exitance = 1e-3 * np.exp(-((body.vertices - [9, 3, 0]) ** 2).sum(axis=1) / 20) + 1e-6
    path = write_ply(tmp_path / "ellipsoid.ply", body.vertices, body.faces, vertex=exitance)
    text = fspt.scene_xml(path, focal_length=50, f_number=1.8, width=192, height=192)
    scene = fspt.load(text, view=90)
    look_at_crop(scene, 148, 82, 10, 5)
    one, other = (fspt.transport(scene, rtol=rtol) for rtol in (1e-4, 3e-4))
    rows = [matrix.matrix.toarray() for matrix in (one, other)]
    lit = rows[0].sum(axis=1) > 0.1 * rows[0].sum(axis=1).max()
    shares = [row[lit] / row[lit].sum(axis=1)[:, None] for row in rows]
    for mine, its in (shares, shares[::-1]):
        assert not ((mine > 3e-3) & (its == 0)).any()
    image = fspt.render(scene, rtol=2 * RTOL)
    off = np.abs(one.forward(exitance)[0] - image.power)
    assert (off <= one.error(exitance)[0] + image.error).all()
    assert (off - image.error).max() <= RTOL * image.power.max()


def test_an_occluder_hides_the_same_faces_as_in_a_rendering(tmp_path):
    """A dark wall just before half of the body. Expected: the image of a render, on smooth J_n.

    Seen to fail without rows by lines of sight, and without shadow rays and the image of J_n = 1.
    """
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([8.5, 5, 0]).rotate([0, 1, 0], 90).scale([20, 5, 1])
    scenes = [body_scene(tmp_path, extra=extra) for extra in ([{"type": "rectangle", "to_world": place}], [])]
    for scene in scenes:
        look_at_crop(scene, 5, 6, 10, 4)  # both limbs, and the wall's edge in the middle
    scene, bare = scenes
    matrix, exitance = fspt.transport(scene, rtol=RTOL), exitances("vertex")["smooth"]
    shine(scene, "vertex", exitance)
    image = fspt.render(scene, method="integral", rtol=RTOL / 2)
    off = np.abs(matrix.forward(exitance)[0] - image.power)
    assert (off - image.error).max() <= RTOL * image.power.max()
    assert matrix.sensitivity.sum() < 0.8 * fspt.transport(bare, rtol=RTOL).sensitivity.sum()


def test_faces_are_cut_along_the_edge_of_a_shadow():
    """An ellipsoid behind small bodies, J_n over two decades from vertex to vertex. Expected: the image of a render.

    Seen to fail, by 1.9 rtol with ten times as much stated, where pieces of faces are lit or dark as a whole.
    """
    scene = random_scene("hidden ellipsoids", 6).scene()
    look_at_crop(scene, 8, 48, 6, 6)
    exitance = np.concatenate([shape_exitance(emitter) for emitter in scene.emitters()])
    image = fspt.render(scene, method="integral", rtol=RTOL / 2)
    matrix, peak = fspt.transport(scene, rtol=RTOL), image.power.max()
    assert np.abs(matrix.forward(exitance)[0] - image.power).max() <= 0.6 * RTOL * peak
    assert matrix.error(exitance).max() <= 3 * RTOL * peak


def test_perspective_within_large_faces_is_in_the_error():
    """An ellipsoid of large faces, J_n over two decades from vertex to vertex, against a finer matrix.

    Expected: T J within both errors. Seen to fail on 18 pixels, by up to 9e-4 of the brightest, where perspective may
    misplace 2 rtol of the change of J_n on a face, which half of the pieces do not show where a face is one.
    """
    scene = random_scene("cropped ellipsoids", 0).scene()
    look_at_crop(scene, 36, 36, 8, 8)
    matrix, finer = (fspt.transport(scene, rtol=rtol) for rtol in (RTOL, RTOL / 10))
    exitance = 10 ** np.random.default_rng([2, 0]).uniform(-2, 0, matrix.shape[1])
    off = np.abs(matrix.forward(exitance) - finer.forward(exitance))
    assert (off <= matrix.error(exitance) + finer.error(exitance)).all()


def test_a_column_alone_is_the_image_of_one_vertex(tmp_path):
    """Vertices in the middle, at the limb and of faces far below a pixel, each rendered alone.

    Expected out of focus: 10 % of the column's own brightest entry at rtol 1e-3. In focus, columns of faces and of
    vertices together are `test_products_are_rendered_images`.
    """
    depth, rtol, bound = 200.0, 1e-3, 0.1
    small = trimesh.creation.icosphere(1, radius=0.2)
    fine = np.concatenate([BODY.vertices @ TURN.T, small.vertices + np.array([9.0, 0.0, 0.0])])
    scene = body_scene(
        tmp_path, depth=depth, mesh=(fine, np.concatenate([BODY.faces, small.faces + len(BODY.vertices)]))
    )
    look_at_crop(scene, 6, 1, 8, 11)  # the images of the three
    matrix = fspt.transport(scene, rtol=rtol)
    middle, limb = np.argmax(fine[:162, 0]), np.argmin(np.abs(fine[:162, 0] - 0.8))
    tip = 162 + np.argmax(small.vertices[:, 0])
    for vertex in (middle, limb, tip):
        exitance = np.zeros(len(fine))
        exitance[vertex] = 1
        shine(scene, "vertex", exitance)
        image = by_elements(scene, rtol=2e-2, max_nodes=1 << 14)
        column = matrix.forward(exitance)[0]
        peak = image.power.max()
        assert 0 < image.error.max() <= bound / 2 * peak, vertex
        assert (np.abs(column - image.power) - image.error).max() <= bound * peak, vertex


@pytest.mark.parametrize(
    "optics",
    [
        {"model": "pinhole"},
        {"model": "hrrt", "lens_diameter": 25.0},
        {"model": "ripoll", "numerical_aperture": 0.05},
        {"image_stop_diameter": 6.0},
        {"lens_diameter": 22.0, "diaphragm_distance": 15.0, "f_number": 4.0},
        {"emission": {"emission": "fresnel", "int_ior": 1.37}},
    ],
    ids=str,
)
def test_every_lens_and_exit_law(tmp_path, optics):
    """Expected: as of a render. Seen to fail, by 4e-2, with rows of the image-plane stop's border scaled only."""
    scene = body_scene(tmp_path, **optics)
    look_at_crop(scene, 10, 2, 3, 6)  # with the limb, the middle and the border of the stop
    matrix, exitance = fspt.transport(scene, rtol=RTOL), exitances("vertex")["decades"]
    shine(scene, "vertex", exitance)
    image = fspt.render(scene, method="integral", rtol=RTOL / 2)
    off = np.abs(matrix.forward(exitance)[0] - image.power)
    assert (off - image.error).max() <= RTOL * image.power.max()


def test_a_crop_window_is_a_part_of_the_film(tmp_path):
    """Expected: the rows of these pixels, to rtol, whatever lies beyond."""

    scene, exitance = body_scene(tmp_path), exitances("vertex")["smooth"]
    whole = fspt.transport(scene).forward(exitance)[0]
    look_at_crop(scene, 3, 4, 12, 7)
    matrix = fspt.transport(scene)
    assert matrix.image_shape == (1, 7, 12)
    np.testing.assert_allclose(matrix.forward(exitance)[0], whole[4:11, 3:15], atol=RTOL * whole.max())


# ---------------------------------------------------------------------- windows and mirrors


def square_at(x, y, turn, bsdf, size=60.0):
    """A square that does not glow; its normal, +x, is turned about +z [degrees]."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, y, 0]).rotate([0, 0, 1], turn).rotate([0, 1, 0], 90).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def test_light_from_a_white_wall_is_reported(tmp_path):
    """The largest share of any view, once, for J = 1; the same as that of an image of J_n = 1."""
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -9]).scale(30),
        "bsdf": {"type": "diffuse", "reflectance": 0.8},
    }
    scene = body_scene(tmp_path, extra=[wall])
    told = fspt.transport(scene, rtol=1e-2).metadata["warnings"]
    assert re.fullmatch(r"shape_1 scatters light: about .* to see it \(for J = 1\)", told)
    assert told.startswith(fspt.render(scene, rtol=1e-2).metadata["warnings"])
    assert "warnings" not in fspt.transport(body_scene(tmp_path), rtol=1e-2).metadata


SILVERED = {"type": "conductor", "material": "none", "specular_reflectance": 0.9}


@pytest.mark.parametrize(
    ("where", "crop"),
    [((30, 0, 0, {"type": "thindielectric"}), (9, 2, 6, 6)), ((-4, 14, -50, SILVERED, 20.0), (12, 3, 8, 5))],
)
def test_rows_go_on_through_windows_and_off_mirrors(tmp_path, where, crop):
    """Seen to fail with lines that end at the first surface: rows of the window are dark."""
    scene = body_scene(tmp_path, extra=[square_at(*where)])
    look_at_crop(scene, *crop)
    matrix = fspt.transport(scene, rtol=RTOL)
    body = BODY.vertices @ TURN.T
    exitance = 1 + 0.9 * np.sin(body[:, 1] / 3) * np.cos(body[:, 2] / 4)
    shine(scene, "vertex", exitance)
    image = fspt.render(scene, rtol=RTOL / 2)
    off = abs(matrix.forward(exitance)[0] - image.power)
    assert (off <= matrix.error(exitance)[0] + image.error).mean() > 0.995
    assert off.max() < 3 * RTOL * image.power.max()
    assert matrix.forward(exitance).sum() == pytest.approx(image.power.sum(), rel=RTOL)


def test_lines_of_sight_tell_meshes_of_different_sizes_apart(tmp_path):
    """Seen to end the process: faces of the larger mesh were looked up in the smaller one."""
    small = trimesh.creation.icosphere(1, radius=1.0)
    path = write_ply(tmp_path / "small.ply", small.vertices + np.array([12, 0, 0]), small.faces, vertex=np.ones(42))
    extra = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute("vertex_exitance"))}
    scene = body_scene(tmp_path, extra=[extra, square_at(30, 0, 0, {"type": "thindielectric"})])
    look_at_crop(scene, 8, 5, 6, 6)
    matrix = fspt.transport(scene, rtol=RTOL)
    assert matrix.seen[matrix.parts["shape_1"]].any()
    picture = fspt.render(scene, rtol=RTOL).power
    assert matrix.forward(np.ones(matrix.shape[1]))[0] == pytest.approx(picture, abs=2 * RTOL * picture.max())
