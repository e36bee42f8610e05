"""Grids of blocks of pixels: on these pixels as a grid of all of them, where no neighbour is left out."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")

SIDE = 4
BLOCKS = np.random.default_rng(3).random((5, 7)) < 0.6
MARKED = np.kron(BLOCKS, np.ones((SIDE, SIDE))) > 0
IMAGE = np.random.default_rng(4).normal(size=MARKED.shape)


@pytest.fixture
def grids():
    """The grid of some blocks, and that of all pixels."""
    from mitsuba_fspt.jit.block_grid import BlockGrid
    from mitsuba_fspt.jit.pixel_grid import Grid

    return BlockGrid(BLOCKS, SIDE), Grid(MARKED.shape)


def laid(grid, image):
    """Array (h, w) with an image of the grid in its place, 0 elsewhere."""
    array = np.zeros(MARKED.shape)
    grid.lay(image, array)
    return array


def test_images_go_there_and_back(grids):
    some, _ = grids
    np.testing.assert_array_equal(laid(some, some.flat(IMAGE)), np.where(MARKED, IMAGE, 0))
    assert len(some) == MARKED.sum()


def test_places_are_numbers_of_the_whole_image(grids):
    some, every = grids
    number = np.arange(MARKED.size).reshape(MARKED.shape)
    np.testing.assert_array_equal(laid(some, some.flat(number * 1.0)), laid(some, some.place(some.number)))
    np.testing.assert_array_equal(np.array(every.place(every.number)), number.ravel())


def test_the_largest_value_is_that_of_the_pixels_that_are_there(grids):
    some, every = grids
    expected = every.array(every.spread_max(every.flat(np.where(MARKED, IMAGE, -np.inf))))
    np.testing.assert_array_equal(laid(some, some.spread_max(some.flat(IMAGE))), np.where(MARKED, expected, 0))


def test_the_border_has_a_neighbour_that_is_left_out(grids):
    some, _ = grids
    padded = np.pad(MARKED, 1)
    height, width = MARKED.shape
    inside = np.all([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
    np.testing.assert_array_equal(laid(some, some.border()) > 0, MARKED & ~inside)


def test_sums_over_boxes_run_along_rows_then_columns(grids):
    """Where all pixels of a box are there the sum is that of all pixels."""
    some, every = grids
    whole = every.array(every.box_sum(every.flat(MARKED * 1.0), 2)) == every.array(
        every.box_sum(every.flat(np.ones(MARKED.shape)), 2)
    )
    expected = every.array(every.box_sum(every.flat(IMAGE), 2))
    assert (whole & MARKED).any()
    np.testing.assert_allclose(laid(some, some.box_sum(some.flat(IMAGE), 2))[whole & MARKED], expected[whole & MARKED])
