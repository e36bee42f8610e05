"""Stiff cases of where things are: the scene turned, moved and scaled as a whole; films and crop windows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from .stability import Case
from .stiff_cases_scenes import (
    CONE,
    EXACT,
    FOCUS,
    HEIGHT,
    REFUSAL,
    ROUNDED,
    SAME,
    SHARP,
    WIDTH,
    ball,
    cone,
    disk,
    filled,
    moved,
    off_anywhere,
    power,
    same,
    scene,
    sphere,
    square,
    usual,
)

if TYPE_CHECKING:
    from .stiff_cases_scenes import Body


def place_cases() -> list[Case]:
    """The scene as a whole turned, moved and scaled: the same watts, times scale²."""
    rows = [
        Case(f"camera turned {angle}° about ({axis})", SAME, partial(_turned, axis, angle), SHARP)
        for axis, angle in (("0, 1, 0", 90), ("1, 0, 0", -90), ("1, 2, 3", 50), ("-3, 1, 1", 200))
    ]
    rows += [
        Case(f"all lengths × {s:g}", SAME, partial(same, ball, factor=s * s, scale=s), ROUNDED)
        for s in (1e-6, 1e-3, 1e3, 1e6)
    ]
    # A mesh whose vertices float32 holds out there loses nothing; any other is off by the rounding of its places.
    return [
        *rows,
        Case("1.3e5 mm from the world's origin, mesh", SAME, lambda: same(square, place=moved(2.0**17)), SHARP),
        Case("1e5 mm from the world's origin, ball", SAME, lambda: same(ball, place=moved(1e5)), 2e-3),
        Case("1e5 mm from the world's origin, turned", SAME, lambda: same(ball, place=moved(1e5, 50)), 2e-2),
        Case("1e5 mm from the world's origin, filled", CONE, lambda: cone_at(moved(1e5, 50)), EXACT),
        Case("1e7 mm from the world's origin", REFUSAL, lambda: same(ball, place=moved(1e7)), None),
    ]


def cone_at(place: Callable[[], Any]) -> float:
    """Error of a filled cone in a scene that is turned and moved as a whole."""
    return off_anywhere(power(scene(disk(FOCUS, 60), at=place()), rtol=EXACT), filled())


def _turned(axis: str, angle: float) -> float:
    return max(same(body, place=moved(0, angle, axis)) for body in (ball, square))


def film_cases() -> list[Case]:
    """Films of one pixel and one row, crop windows, and nothing on them."""
    rows = [
        Case(f"film of {w} × {h}", CONE, partial(lambda f: cone(disk(FOCUS, 60), film=f), (w, h)), EXACT)
        for w, h in ((1, 1), (1, 20), (24, 1))
    ]
    rows += [
        Case(f"silhouette on a film of {w} × {h}", SAME, partial(_middle_of_film, w, h), 2e-3)
        for w, h in ((2, 2), (2, HEIGHT), (WIDTH, 2))
    ]
    rows += [Case(f"crop window {crop}", SAME, partial(_cropped, crop), 2e-3) for crop in ((5, 3, 11, 9), (4, 7, 3, 6))]
    return [
        *rows,
        Case("everything outside the field", "no light", lambda: _light_of(disk(FOCUS, 4, x=100)), EXACT),
        Case("everything behind the lens", "no light", lambda: _light_of(disk(-FOCUS, 4)), EXACT),
    ]


def _middle_of_film(width: int, height: int) -> float:
    """A smaller film against the middle of the usual one; even sizes, so that the pixels lie alike."""
    whole = usual(_on_axis)
    top, left = (HEIGHT - height) // 2, (WIDTH - width) // 2
    part = power(scene(_on_axis(), film=(width, height)))
    return float(np.abs(part - whole[top : top + height, left : left + width]).max() / whole.max())


def _on_axis() -> Body:
    """A ball with its limb on the axis."""
    return sphere(168.0, 6.0, 6.0)


def _cropped(crop: tuple[int, int, int, int]) -> float:
    x, y, width, height = crop
    whole, part = usual(ball), power(scene(ball(), crop=crop))
    return float(np.abs(part - whole[y : y + height, x : x + width]).max() / whole.max())


def _light_of(body: Body) -> float:
    """All power over that of a pixel filled by 1 W/mm²."""
    return float(np.abs(power(scene(body))).sum() / filled().max())
