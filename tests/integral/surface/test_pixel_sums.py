"""Sums on pixels that all threads add to: sizes that share a kernel, and when threads take copies of their own."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")


def test_few_sizes_and_little_room_to_spare():
    """Expected: at most a quarter more than is needed, beyond the least, and eight sizes an octave.

    A kernel that adds to copies is another one for each size: with the exact size the poses of a body never shared one.
    """
    from mitsuba_fspt.integral.surface.pixel_sums import LEAST, room

    pixels = np.arange(1, 1 << 16)
    rooms = np.array([room(int(n)) for n in pixels])
    assert (rooms >= pixels).all()
    assert (rooms[LEAST:] <= 1.25 * pixels[LEAST:]).all()
    assert room(0) == LEAST
    assert len(set(rooms)) <= 1 + 4 * 4


def test_copies_only_where_they_are_worth_their_time_and_fit(monkeypatch):
    """Expected: of a small film always, of a large one for many polygons, never of more bytes than allowed."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_fspt.integral.surface import pixel_sums

    if not mi.variant().startswith("llvm"):
        pytest.skip("copies are made on LLVM alone")
    monkeypatch.setattr(dr, "thread_count", lambda: 4)
    small, large = pixel_sums.PixelSums(1000), pixel_sums.PixelSums(1 << 20)
    assert small.mode(1) == dr.ReduceMode.Expand
    assert large.mode(1000) == dr.ReduceMode.Direct
    assert large.mode(1 << 20) == dr.ReduceMode.Expand
    assert pixel_sums.most_pixels() == 1 << 22
    # Of more pixels than have copies, too, as fewer ones are among those that memory is asked for.
    for pixels in (1 << 20, 1 << 22, 1 << 24):
        assert pixel_sums.memory_of(pixels) >= 32 * pixels + 2 * min(4 * 32 * pixels, 1 << 29)
    monkeypatch.setattr(pixel_sums, "COPIES", 1 << 25)
    assert large.mode(1 << 20) == dr.ReduceMode.Direct


@pytest.mark.parametrize("mode", ["Expand", "Direct"])
def test_whole_numbers_of_any_size_are_added_exactly(mode):
    """Two kernels of 3000 additions to 7 pixels. Expected: the sums of NumPy, also of numbers beyond 2⁵³."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_fspt.integral.surface.pixel_sums import PACKET, PixelSums

    if mode == "Expand" and not mi.variant().startswith("llvm"):
        pytest.skip("copies are made on LLVM alone")
    random = np.random.default_rng(1)
    sums, expected = PixelSums(7), np.zeros((7, PACKET), np.int64)
    for _ in range(2):
        pixel, on = random.integers(7, size=3000), random.random(3000) < 0.8
        amounts = random.integers(-(1 << 50), 1 << 50, (PACKET, 3000))
        np.add.at(expected, pixel[on], amounts.T[on])
        sums.add(mi.UInt32(pixel), [mi.Int64(a) for a in amounts], mi.Bool(on), getattr(dr.ReduceMode, mode))
        sums.evaluate()
    np.testing.assert_array_equal(sums.array(), expected)
