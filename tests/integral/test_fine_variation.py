"""Dark and dim lines and dots of J_n far narrower than a pixel, against the mean of J_n over each pixel."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import FOCAL, MAGNIFICATION, PITCH, attribute, camera_scene, disk, glow, mi

import mitsuba_fspt as fspt

FOCUS = FOCAL * (1 + 1 / MAGNIFICATION)
PIXEL = PITCH / MAGNIFICATION  # at the focus [mm]
PIXELS, TEXELS = 12, 25  # pixels along a plate in the middle of the film, texels along a pixel
CROP = 14, 10, PIXELS, PIXELS  # the pixels of the plate
SIDE = PIXELS * TEXELS
SMOOTH = 1 + 0.3 * np.sin(np.arange(SIDE) / 90)[:, None] * np.cos(np.arange(SIDE) / 70)
LINES, DOTS = (np.zeros((SIDE, SIDE), bool) for _ in range(2))
LINES[:, 37::70] = True
for ROW, COLUMN in np.random.default_rng(3).integers(0, SIDE - 6, (9, 2)):
    DOTS[ROW : ROW + 5, COLUMN : COLUMN + 5] = True


def plate(exitance, filter_type="nearest", half=PIXELS * PIXEL / 2):
    """A square of this half side that faces the lens with the texels (row, column) of J_n, as they are upright in the
    image.
    """
    place = mi.ScalarTransform4f().translate([0, 0, FOCUS]).rotate([0, 1, 0], 180).scale([half, half, 1])
    texels = mi.Bitmap(np.ascontiguousarray(exitance[::-1, :, None], np.float32))
    texture = {"type": "bitmap", "bitmap": texels, "raw": True, "filter_type": filter_type}
    return {"type": "rectangle", "to_world": place, "emitter": glow(texture)}


def means(exitance):
    """Mean of J_n over each pixel."""
    return exitance.reshape(PIXELS, TEXELS, PIXELS, TEXELS).mean(axis=(1, 3))


def off(scene, expected, **accuracy):
    """Deviation of an image from J_n of the pixels, and its error, both over the brightest; the falloff is that of the
    same plate with the J_n of `SMOOTH`."""
    image = fspt.render(scene, **accuracy)
    smooth = fspt.render(camera_scene(plate(SMOOTH), crop=CROP), rtol=1e-4)
    power = image.power * means(SMOOTH) / smooth.power
    return (power - expected) / expected.max(), (image.error + smooth.error) / image.power.max()


@pytest.mark.parametrize(("where", "factor"), [(LINES, 0), (LINES, 1.9), (DOTS, 0.5)], ids=["dark", "dim", "dots"])
def test_fine_texels_take_and_give_their_share(where, factor):
    """A 25th of a pixel, or a fifth of it. Seen to fail: 0.04 of the brightest pixel on all pixels along a line, at
    0.00005 stated.
    """
    exitance = np.where(where, factor, 1) * SMOOTH
    error, stated = off(camera_scene(plate(exitance), crop=CROP), means(exitance))
    assert (np.abs(error) <= stated + 1e-4).all()
    assert stated.max() < 1.5e-3
    assert np.abs(means(exitance) - means(SMOOTH)).max() > 0.015


def test_lines_of_a_bitmap_of_one_row():
    """As a profile is given. Seen to fail: 0.04 missing on some of the pixels, where as many points as texels are laid
    in squares; nor is the middle of a pixel in focus wrong by lines beside it.
    """
    profile = np.ones((1, SIDE))
    profile[:, 37::70] = 0
    scene, expected = camera_scene(plate(profile), crop=CROP), means(np.broadcast_to(profile, (SIDE, SIDE)))
    error, stated = off(scene, expected)
    assert (np.abs(error) <= stated + 1e-4).all()
    assert stated.max() < 1.5e-3
    assert "lattices" not in fspt.render(scene, pixel="centre").metadata["levels"]


def test_a_dark_line_of_vertices(tmp_path):
    """J_n falls to 0 and rises again over a tenth of a pixel, in the middle of pixels: a triangle of light is missing.

    Seen to fail: nothing missing at 0.00005 stated.
    """
    half, middle, width = PIXELS * PIXEL / 2, 0.5 * PIXEL, 0.05 * PIXEL
    across = np.unique([*np.linspace(-half, half, 5), middle - width, middle, middle + width])
    along = np.linspace(-half, half, 25)
    depth = np.full((len(across), len(along)), FOCUS)
    grid = np.stack([*np.meshgrid(across, along, indexing="ij"), depth], axis=-1).reshape(-1, 3)
    number = np.arange(len(grid)).reshape(depth.shape)
    a, b, c, d = (number[i : i - 1 or None, j : j - 1 or None].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    fspt.Phantom(grid, faces, 1.0 - np.isclose(grid[:, 0], middle), "vertex").write(tmp_path / "plate.ply")
    line = {"type": "ply", "filename": str(tmp_path / "plate.ply"), "face_normals": True}
    expected = np.ones((PIXELS, PIXELS))
    expected[:, 5] -= width / PIXEL
    error, stated = off(camera_scene({**line, "emitter": glow(attribute())}, crop=CROP), expected)
    assert (np.abs(error) <= stated + 1e-4).all()
    assert stated.max() < 1.5e-3


def test_dark_lines_within_blocks_of_pixels():
    """Lines of a fifth of a pixel on a square of 40, as bright as what is around it, on 512 x 512 pixels.

    Seen to fail: nothing missing where blocks do not look for them.
    """
    film = {"type": "hdrfilm", "width": 512, "height": 512, "pixel_format": "luminance"}
    optics = {"film": film, "pixel_pitch": PITCH / 16, "f_number": 8.0}
    texels = np.ones((200, 200))
    texels[50:90, [42, 111, 163]] = 0
    image = fspt.render(camera_scene(plate(texels, half=20 * PIXEL / 16), disk(FOCUS + 0.1), **optics))
    assert "blocks" in image.metadata["levels"]
    missing = (image.power[::-1, ::-1] - image.power)[226:256, 226:286]  # the lower half has no lines
    assert missing.sum() / image.power.max() == pytest.approx((texels == 0).sum() / 25, rel=0.02)


def test_the_corner_of_a_plate_just_inside_a_pixel():
    """Both edges leave out 0.035 of the side of their pixels. Expected: the corner lacks as much as two such pixels.

    Seen to fail: as much as these, at 0.0009 stated, as two transects that agree cross one of the edges.
    """
    scene = camera_scene(plate(np.ones((4, 4)), half=(PIXELS / 2 - 0.035) * PIXEL), crop=CROP, f_number=16.0)
    image = fspt.render(scene)
    share = image.power / image.power.max()
    assert share[0, 0] == pytest.approx(share[0, 5] * share[5, 0], abs=2 * image.error.max() / image.power.max())
    assert image.error.max() < 1e-3 * image.power.max()


def test_smooth_and_stepped_exitance_take_no_more_lines_of_sight():
    """Neither a smooth J_n nor a step of it counts as fine variation. Seen to fail where the range is not extended."""
    stepped = np.where(np.add.outer(np.arange(SIDE), np.arange(SIDE)) > SIDE, 2.0, 1.0)
    for exitance, most in ((SMOOTH, 2_000), (stepped, 800_000)):  # on the 100 pixels of the crop window and its rim
        image = fspt.render(camera_scene(plate(exitance, "bilinear"), crop=(16, 12, 8, 8)), rtol=1e-3)
        assert image.metadata["nodes"] < most
