"""Large films in tiles: the same image as in one piece, to one tolerance, in memory that is bounded and stated."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_scenes import ball, glow, lens, load_scene, mi, world_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.camera.window import Window
from mitsuba_fspt.integral import tiles
from mitsuba_fspt.integral.lines.visible_window import visible_window
from mitsuba_fspt.integral.tiles import Mosaic, tiles_of
from mitsuba_fspt.runtime import memory
from mitsuba_fspt.runtime.errors import SceneError

pytestmark = pytest.mark.usefixtures("mono")
FIELD = 256 * 0.108  # mm
SIDE = 110  # of a tile


def scene_of(name, side=256):
    return load_scene(name, width=side, height=side, pixel_pitch=FIELD / side, f_number=2.8)


def both(scene, monkeypatch, side=SIDE, **accuracy):
    """Images in one piece and in tiles of this side."""
    whole = fspt.render(scene, **accuracy)
    monkeypatch.setattr(tiles, "SIDE", side)
    return whole, fspt.render(scene, **accuracy)


@pytest.mark.parametrize(
    ("name", "film", "side", "accuracy"),
    [
        ("nylon_cylinder", 160, 68, {"rtol": 3e-3, "pixel": "centre"}),
        ("two_spheres", 64, 30, {"rtol": 0.1, "domain": "surface"}),
    ],
)
def test_tiles_and_one_piece_agree_within_the_errors_of_both(name, film, side, accuracy, monkeypatch):
    """Seams that are smaller, by the pupil form of two bodies: `test_there_are_no_seams`."""
    scene = scene_of(name, film)
    whole, tiled = both(scene, monkeypatch, side, **accuracy)
    assert len(tiles_of(visible_window(scene, scene.sensors()[0].camera))) > 3
    apart, errors = np.abs(tiled.power - whole.power), tiled.error + whole.error
    assert (apart <= errors).all()
    assert apart.max() > 0  # that they are tiles at all
    assert ((whole.error > 0) == (tiled.error > 0)).mean() > 0.999
    np.testing.assert_allclose(tiled.coverage, whole.coverage, atol=0.05)
    assert tiled.metadata["nodes"] < 1.3 * whole.metadata["nodes"]
    # What a step did is reported once, for all tiles together.
    steps = [level.partition(":")[0] for level in tiled.metadata["levels"].split("; ")]
    assert len(steps) == len(set(steps))


def test_there_are_no_seams(monkeypatch):
    """Pixels along the borders of tiles differ from those of one piece by a hundredth of rtol on average.

    The bound is 3e-5, as rtol is 3e-3: three times both, with the same ratio, take less time.
    Seen to fail with tiles without a rim.
    """
    scene = scene_of("two_spheres", 160)
    whole, tiled = both(scene, monkeypatch, 68, rtol=3e-3)
    assert (np.abs(tiled.power - whole.power) <= tiled.error + whole.error).all()
    apart = np.abs(tiled.power - whole.power) / whole.power.max()
    seam = np.zeros(apart.shape, bool)
    for tile in tiles_of(visible_window(scene, scene.sensors()[0].camera)):
        left, top = tile.crop_offset
        for row, column in ((top, left), (top + tile.full[0] - 1, left + tile.full[1] - 1)):
            seam[row, left : left + tile.full[1]] = True
            seam[top : top + tile.full[0], column] = True
    lit = whole.power > 0
    assert apart[seam & lit].mean() < 3e-5


def test_a_dim_tile_takes_no_more_lines_than_the_bright_one_asks_for(monkeypatch):
    """Seen to fail with each tile refined to its own brightest pixel."""
    shapes = ball(1.0, 4.0, (0, -14, 0)), ball(1e-5, 4.0, (0, 14, 0))
    scene = world_scene(*shapes, sensor=lens(256, pitch=FIELD / 256))
    whole, tiled = both(scene, monkeypatch, SIDE // 2, rtol=1e-3, max_nodes=1 << 16)
    assert tiled.metadata["nodes"] < 1.05 * whole.metadata["nodes"]
    # And states the same least error, of the brightest pixel of all.
    least = 0.05 * 1e-3 * tiled.power.max()
    assert tiled.error[tiled.coverage > 0].min() == pytest.approx(least, rel=1e-6)


def test_one_bright_point_between_the_first_evaluated_pixels_counts(monkeypatch):
    """Seen to fail with the brightest pixel sought by lines of sight alone: a sphere of 0.02 mm is on none."""
    shapes = ball(1e-3, 8.0, (0, -10, 0)), ball(100.0, 0.02, (0, 10.013, 3.017))
    scene = world_scene(*shapes, sensor=lens(512, pitch=FIELD / 512))
    monkeypatch.setattr("mitsuba_fspt.integral.pupil.pupil_form.FEW", 64)
    whole, tiled = both(scene, monkeypatch, rtol=1e-2)
    assert (np.abs(tiled.power - whole.power) <= tiled.error + whole.error).all()
    assert tiled.metadata["nodes"] < 1.3 * whole.metadata["nodes"]


def window(full, left=0, top=0, shape=None, blur=0.3):
    return Window(top, left, shape or full, full, (7, 11), blur)


def test_tiles_show_every_pixel_of_the_window_once(monkeypatch):
    monkeypatch.setattr(tiles, "SIDE", 32)
    whole = window((100, 130), left=20, top=-2, shape=(90, 112))
    count = np.zeros(whole.full, int)
    for tile in tiles_of(whole):
        left, top = tile.crop_offset[0] - 7, tile.crop_offset[1] - 11
        count[top : top + tile.full[0], left : left + tile.full[1]] += 1
        assert max(tile.shape) <= 32
        assert tile.count == math.prod(tile.full)
        assert tile.corner[0] >= whole.corner[0]
        assert tile.corner[1] >= whole.corner[1]
    expected = np.zeros(whole.full, int)
    expected[0:88, 20:130] = 1
    np.testing.assert_array_equal(count, expected)


def test_a_small_image_is_one_tile_and_an_empty_window_none():
    whole = window((2048, 2048), left=-1, top=-1, shape=(2050, 2050))
    assert tiles_of(whole) == [whole]
    assert tiles_of(window((64, 64), shape=(0, 0))) == []


def test_planes_of_large_images_have_32_bits(monkeypatch):
    scene = world_scene(ball(), sensor=lens(24))
    assert fspt.render(scene, rtol=1e-2).power.dtype == np.float64
    monkeypatch.setattr(tiles, "LARGE", 24 * 24 - 1)
    assert fspt.render(scene, rtol=1e-2).power.dtype == np.float32


def test_a_displacement_counts_the_same_at_the_borders_of_tiles(monkeypatch):
    """Seen to fail with the gradient of each tile taken by itself."""
    errors = []
    for side, least in ((2048, 1), (32, 4)):
        monkeypatch.setattr(tiles, "SIDE", side)
        mosaic = Mosaic(window((60, 80)))
        assert len(mosaic.tiles) >= least
        mosaic.power[:] = np.random.default_rng(1).random((60, 80))
        errors.append(mosaic.solution(0.0, 0.01).error)
    np.testing.assert_array_equal(*errors)


def test_a_film_beyond_the_memory_is_refused_before_the_work(monkeypatch):
    """Seen to fail with the memory not asked for."""
    monkeypatch.setattr(tiles, "available_memory", lambda: 3 << 30)
    monkeypatch.setattr(tiles, "memory_of", lambda pixels: 0)  # depends on the number of threads
    scene = load_scene("uniform_disk", width=20000, height=20000, pixel_pitch=FIELD / 20000)
    needs = r"a film of 20000 x 20000 pixels needs 5873741824 bytes \(5\.5 GiB\) of memory, 3221225472 are free\. Give "
    with pytest.raises(SceneError, match=needs):
        fspt.render(scene)
    monkeypatch.setattr(tiles, "available_memory", lambda: 1)
    fspt.render(load_scene("uniform_disk"), rtol=1e-2)  # what fits one tile is not asked about


def test_available_memory_is_the_least_that_a_file_states(tmp_path, monkeypatch):
    state, most, used = (tmp_path / name for name in ("meminfo", "max", "current"))
    monkeypatch.setattr(memory, "MEMINFO", state)
    monkeypatch.setattr(memory, "LIMITS", ((most, used),))
    assert memory.available_memory() is None
    state.write_text("MemTotal:  8 kB\nMemAvailable:       4 kB\n")
    assert memory.available_memory() == 4096
    used.write_text("1000\n")
    most.write_text("max\n")
    assert memory.available_memory() == 4096
    most.write_text("3000\n")
    assert memory.available_memory() == 2000


def test_progress_is_reported_tile_by_tile(monkeypatch):
    monkeypatch.setattr(tiles, "SIDE", 32)
    told = []
    scene = world_scene(ball(radius=12.0), sensor=lens(64, pitch=0.4))
    fspt.render(scene, rtol=1e-2, progress=lambda stage, share: told.append((stage, share)))
    shares = [share for _, share in told]
    count = len(tiles_of(visible_window(scene, scene.sensors()[0].camera)))
    assert {stage for stage, _ in told} == {"integrating"}
    assert set(np.arange(count + 1) / count) <= {round(share, 9) for share in shares}
    assert len(shares) > 2 * count
    assert shares == sorted(shares)


@pytest.mark.parametrize("accuracy", [{}, {"domain": "surface"}])
def test_progress_is_reported_level_by_level(accuracy):
    """From 0 to 1, also where narrow light takes the surface form first. Seen to fail: 0 once."""
    shares = []
    narrow = ball(1.0, 0.05, (0, 12, 9))
    scene = world_scene(ball(radius=8.0), narrow, sensor=lens(32, pitch=0.8))
    image = fspt.render(scene, **{"rtol": 1e-3} | accuracy, progress=lambda _, share: shares.append(share))
    assert (shares[0], shares[-1]) == (0, 1)
    assert shares == sorted(shares)
    assert len(set(shares)) > 4
    assert "lines a pixel" in image.metadata["levels"]
    assert "domain" in accuracy or "transects" in image.metadata["levels"]


def test_a_film_of_one_tile_states_no_larger_displacement_at_its_border():
    """Far from the world's origin float32 displaces lines of sight. What lies beyond a uniform disk's film is not 0 W.

    Seen to fail: 186 times the error inside.
    """
    place = mi.ScalarTransform4f().translate([1e5, 0, 0]).rotate([0, 1, 0], 90).scale(60)
    disk = {"type": "disk", "to_world": place, "emitter": glow()}
    eye = mi.ScalarTransform4f().look_at([1e5 + 165, 0, 0], [1e5, 0, 0], [0, 0, 1])
    image = fspt.render(world_scene(disk, sensor=lens(16, pitch=0.4, to_world=eye)), rtol=1e-3)
    assert image.coverage.min() == 1
    middle = image.error[4:-4, 4:-4]
    assert middle.min() > 0
    assert image.error.max() < 3 * middle.max()
