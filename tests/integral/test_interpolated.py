"""Large pictures by blocks: power of blocks kept, errors that hold, edges found."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import camera_scene, disk, filled, sphere

from mitsuba_fspt.integral.interpolated import Blocks, means_of_parts, part_weights
from mitsuba_fspt.integral.quadrature import Quadrature
from mitsuba_fspt.integral.window import visible_window

FINER = 16  # times as many pixels along each side as the films of `small_scenes`


def finer_scene(*shapes, **optics):
    """`camera_scene` on 640 x 512 pixels."""
    import mitsuba as mi

    scene = camera_scene(*shapes, pixel_pitch=0.4 / FINER, **optics)
    film = mi.traverse(scene.sensors()[0].film())
    film["size"] = [40 * FINER, 32 * FINER]
    film["crop_size"], film["crop_offset"] = [40 * FINER, 32 * FINER], [0, 0]
    film.update()
    lens = mi.traverse(scene.sensors()[0])
    lens["pixel_pitch"] = 0.4 / FINER
    lens.update()
    return scene


def solved(scene, without=(), rtol=1e-2):
    """Picture by the pupil form, without some of the shortcuts."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "fspt_integral"})
    return integrator.solve(scene, scene.sensors()[0], Quadrature(rtol=rtol, shortcuts_off=frozenset(without)))


@pytest.mark.parametrize("side", [4, 8])
def test_polynomials_keep_the_power_of_blocks_and_are_exact_to_degree_four(side):
    """Seen to fail with values at the middles of parts in place of means over them."""
    weights = part_weights(side, 2)
    cells = np.random.default_rng(0).normal(size=(7, 9))
    parts = means_of_parts(cells, weights).reshape(7, side, 9, side)
    assert parts.mean(axis=(1, 3)) == pytest.approx(cells, abs=1e-12)
    edge = np.arange(5 * side + 1) / side - 2.5
    means = np.diff(edge**5 / 5) * side  # of x⁴ over parts
    assert weights @ means.reshape(5, side).mean(axis=1) == pytest.approx(means.reshape(5, side)[2], abs=1e-12)


def test_blocks_have_the_optical_axis_in_the_middle():
    """A film whose sides are no whole number of blocks: 4 pixels of the first and of the last block lie beyond it."""
    scene = finer_scene(disk(165.0))
    lens = scene.sensors()[0]
    window = visible_window(scene, lens)
    blocks = Blocks.of(window, lens, 1e-2)
    assert blocks.side == 4
    first = np.array(blocks.fine.corner) - np.array(lens.film().size()) / 2
    coarse = np.array(blocks.coarse.corner) - np.array(blocks.lens.film().size()) / 2
    assert first == pytest.approx(4 * coarse, abs=0)
    assert Blocks.of(window, lens, 1e-2).fine.shape == tuple(4 * n for n in blocks.coarse.shape)


def test_a_uniform_field_is_the_closed_form():
    """All cones are filled: the power on a pixel is A_vd times the configuration factor."""
    scene = finer_scene(disk(150.0, 200.0))
    found = solved(scene)
    assert "blocks" in found.levels[0]
    assert found.rays < found.power.size  # four times as many take four lines of sight each
    coarse = found.power.reshape(32, FINER, 40, FINER).sum(axis=(1, 3))
    assert coarse == pytest.approx(filled(nodes=3), rel=5e-6, abs=0)


@pytest.mark.parametrize("f_number", [5.6, 22.0])
def test_interpolated_pixels_are_within_their_errors(f_number):
    """A sphere before a disk, both blurred by some pixels or nearly sharp, by blocks and pixel by pixel.

    Seen to fail with a `BEND_GAIN` of 0.
    """
    scene = finer_scene(sphere(150.0, 8.0), disk(190.0, 13.0, x=4.0), f_number=f_number)
    found, exact = solved(scene), solved(scene, ["smooth blocks"])
    assert "blocks" in found.levels[0]
    assert "blocks" not in exact.levels[0]
    off = np.abs(found.power - exact.power)
    peak = found.power.max()
    assert (off <= found.error + exact.error).mean() > 1 - 1e-4
    assert off.max() <= 2e-2 * peak  # each of the two pictures is within 1e-2
    assert found.error.max() <= 1.001e-2 * peak
