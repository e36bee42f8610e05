"""How faces are divided for columns of the transport matrix: which of them the edge of a shadow crosses."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import attribute, glow, lens, world_scene, write_ply

from mitsuba_fspt.integral.surface.face_light import ColumnRule, FaceLight

pytestmark = pytest.mark.usefixtures("mono")

COUNT, SHADE = 13, 0.3  # vertices a side of a sheet with a spacing of 1 mm; an occluder hides what lies beyond y [mm]


def sheet():
    """Vertices and faces of a sheet in the plane x = 0, its normal along +x."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(COUNT) - 6.0, np.arange(COUNT) - 6.0, indexing="ij"))
    first = np.add.outer(np.arange(COUNT - 1) * COUNT, np.arange(COUNT - 1)).ravel()[:, None]
    faces = np.concatenate([first + np.array(other) for other in ((0, COUNT, COUNT + 1), (0, COUNT + 1, 1))])
    return np.stack([0 * y, y, z], -1), faces


def shaded_sheet(folder, narrow=1.0, **optics):
    """The light of a sheet, `narrow` times as wide along z, behind an occluder that all but touches it."""
    import mitsuba as mi

    vertices, faces = sheet()
    vertices[:, 2] *= narrow
    path = write_ply(folder / "sheet.ply", vertices, faces, vertex=np.ones(len(vertices)))
    place = mi.ScalarTransform4f().translate([0.01, SHADE + 20, 0]).rotate([0, 1, 0], 90).scale(20)
    mesh = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute())}
    scene = world_scene(mesh, {"type": "rectangle", "to_world": place}, sensor=lens(24, **optics))
    camera = scene.sensors()[0].camera
    light = FaceLight.seen(scene.emitters()[0].surface, camera, (0, 0), (24, 24)).behind(scene, camera)
    return vertices[faces][..., 1], light


def test_faces_larger_than_their_blur_are_cut_wherever_a_shadow_may_be(tmp_path):
    """Pieces of at most `shadow` pixels in focus, for a shadow may be smaller than what is probed; far out of focus
    fewer, as pieces are cut along the edge of the shadow. Seen to fail with the latter everywhere."""
    rule = ColumnRule.of(1e-3)
    _, light = shaded_sheet(tmp_path, pitch=0.1)
    assert (light.sides[light.mixed] > 2 * light.blur[light.mixed] + 1).all()
    cuts = light.plan(rule, "vertex").cuts[light.mixed]
    assert (cuts >= np.ceil(light.sides[light.mixed] / rule.shadow)[:, None]).all()
    _, light = shaded_sheet(tmp_path, pitch=0.1, distance=400.0, f_number=1.4)
    small = light.mixed & light.small
    assert small.any()
    assert (light.plan(rule, "vertex").cuts[small].max(axis=1) < light.sides[small] / rule.shadow).all()


def test_slender_faces_are_cut_into_longer_pieces(tmp_path):
    """Faces of 1 mm by 0.02 mm in focus: pieces of no larger area than those of other faces, up to four times as long.

    Seen to fail where pieces are as long as others: sixteen times as many.
    """
    rule = ColumnRule.of(1e-3)
    _, light = shaded_sheet(tmp_path, narrow=0.02, pitch=0.05)
    some = light.mixed & ~light.small
    assert some.any()
    sides, heights = light.sides[some], light.heights[some]
    cuts = light.plan(rule, "face").cuts[some, 0]
    assert (sides / cuts <= 4 * rule.shadow).all()
    assert (sides * heights / cuts**2 <= rule.shadow**2 / 2).all()
    assert (cuts <= np.ceil(sides / (4 * rule.shadow))).all()


def test_faces_behind_the_lens_and_in_its_borders_shadow_are_dark(tmp_path):
    """A sheet behind the lens plane, and one aside that a second border hides from all of the pupil.

    Expected: no bright face, which would be cut into pieces without end. Seen to fail without the depth of the faces,
    and without `closed_to`.
    """
    import mitsuba as mi

    vertices, faces = sheet()
    path = write_ply(tmp_path / "sheet.ply", vertices, faces, vertex=np.ones(len(vertices)))
    mesh = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute())}

    def bright(**optics):
        scene = world_scene(mesh, sensor=lens(24, pitch=6.0, **optics))
        surface, camera = scene.emitters()[0].surface, scene.sensors()[0].camera
        return FaceLight.seen(surface, camera, (0, 0), (24, 24)).bright

    aside = mi.ScalarTransform4f().look_at([165, 0, 90], [0, 0, 90], [0, 0, 1])
    away = mi.ScalarTransform4f().look_at([30, 0, 0], [300, 0, 0], [0, 0, 1])
    border = {"lens_diameter": 14.0, "diaphragm_distance": 60.0}
    assert bright(to_world=aside).all()
    assert not bright(to_world=aside, **border).any()
    assert not bright(to_world=away).any()


def test_a_small_occluder_of_a_large_face_is_found(tmp_path):
    """A plate of two faces of 98 pixels each, and a ball of two square pixels before one of them.

    Expected: both count as hidden in part, as they share corners. Seen to fail where 16 lines search for occluders of
    a face, whatever its size.
    """
    corners = np.array([[-20, -14, -14], [-20, 14, -14], [-20, 14, 14], [-20, -14, 14]])
    plate = write_ply(tmp_path / "plate.ply", corners, np.array([[0, 1, 2], [0, 2, 3]]), vertex=np.ones(4))
    body = {"type": "ply", "filename": str(plate), "face_normals": True, "emitter": glow(attribute())}
    small = {"type": "sphere", "center": [-17, 2.5, 6.3], "radius": 1.6}
    scene = world_scene(body, small, sensor=lens(32, 1.0, f_number=2.8))
    camera, surface = scene.sensors()[0].camera, scene.emitters()[0].surface
    assert FaceLight.seen(surface, camera, (0, 0), (32, 32)).behind(scene, camera).mixed.all()
