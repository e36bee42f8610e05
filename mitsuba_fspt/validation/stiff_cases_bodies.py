"""Stiff cases of what glows: J_n over all decades, meshes of all sizes and kinds, surfaces in one place."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from .stability import Case
from .stiff_cases_scenes import (
    CONE,
    EXACT,
    FOCAL,
    FOCUS,
    PUPIL,
    REFUSAL,
    ROUNDED,
    SAME,
    SHARP,
    SIDE,
    WIDTH,
    Plane,
    ball,
    cone,
    disk,
    filled,
    grid,
    mesh,
    off,
    off_anywhere,
    over_pixels,
    power,
    scene,
    sphere,
    usual,
)

if TYPE_CHECKING:
    from .stiff_cases_scenes import Body


def light_cases() -> list[Case]:
    """J_n over all that float32 holds."""
    rows = [
        Case(f"J_n {j:g} W/mm²", SAME, partial(_times, j), ROUNDED if 1e-32 < j < 1e32 else None)
        for j in (1e-37, 1e-30, 1e30, 1e37)
    ]
    return [
        *rows,
        Case("J_n of 9 decades in one picture", CONE, _nine_decades, EXACT),
        Case("J_n 0 on half of the mesh, edge on pixel edges", CONE, partial(_half_dark, 0.0), SHARP),
        Case("J_n 0 on half of the mesh, edge inside pixels", CONE, partial(_half_dark, 0.3), SHARP),
        Case("1e-36 W and less on a pixel", REFUSAL, lambda: cone(_dim(1e-26), f_number=1e6), None),
    ]


def _times(exitance: float) -> float:
    dim = power(scene(sphere(168.0, 6.0, 1.5, -1.0, exitance=exitance)))
    return off(dim / exitance, usual(ball))


def _dim(exitance: float) -> Body:
    return disk(FOCUS, 60, exitance=exitance)


def _nine_decades() -> float:
    """Two sharp halves, 1 and 1e-9 W/mm²: the dark one to 1e-5 of its own light, columns off the border."""
    lines = np.linspace(-40, 40, 3)
    vertices, faces = grid(lines, lines, FOCUS)
    bright = vertices[faces].mean(axis=1)[:, 0] > 0
    picture = power(scene(mesh(vertices, faces, np.where(bright, 1.0, 1e-9))), rtol=EXACT)
    steps = np.where(np.arange(WIDTH) < WIDTH // 2, 1.0, 1e-9)
    away = np.abs(np.arange(WIDTH) - WIDTH / 2 + 0.5) > 1
    return off_anywhere(picture[:, away], (filled() * steps)[:, away])


def _half_dark(border: float) -> float:
    """A plane in focus that is dark up to x = border [mm], against the lit share of every pixel."""
    vertices, faces = grid(np.unique([*np.linspace(-40, 40, 81), border]), np.linspace(-40, 40, 81), FOCUS)
    lit = vertices[faces].mean(axis=1)[:, 0] > border
    x = (WIDTH / 2 - np.arange(WIDTH)) * SIDE
    return off(power(scene(mesh(vertices, faces, lit.astype(float)))), filled() * np.clip((x - border) / SIDE, 0, 1))


def mesh_cases() -> list[Case]:
    """Triangles of all sizes and kinds."""
    large = ([[-500, -500, FOCUS], [0, 900, FOCUS], [500, -500, FOCUS]], [[0, 1, 2]])
    return [
        Case("one triangle as large as the scene", CONE, lambda: cone(mesh(*large)), EXACT),
        Case("20 000 triangles", CONE, lambda: cone(mesh(*_plane(101))), EXACT),
        Case("3 million triangles", CONE, lambda: cone(mesh(*_plane(1226))), EXACT, slow=True),
        Case("slivers of aspect 1e6", CONE, _slivers, EXACT),
        Case("faces without area", CONE, lambda: cone(mesh(*_with_degenerate())), EXACT),
        Case("every face twice", REFUSAL, lambda: cone(mesh(*_twice())), None),
        Case("mesh edges on pixel edges", CONE, lambda: cone(mesh(*_aligned(0.0))), EXACT),
        Case("mesh vertices on pixel centres", CONE, lambda: cone(mesh(*_aligned(0.5))), EXACT),
        Case("mesh vertices on the pinhole's lines of sight", "cos⁴θ", _pinhole_on_vertices, EXACT),
    ]


def _plane(lines: int) -> tuple[Any, Any]:
    return grid(np.linspace(-30, 30, lines), np.linspace(-30, 30, lines), FOCUS)


def _with_degenerate() -> tuple[Any, Any]:
    vertices, faces = _plane(51)
    return vertices, np.concatenate([faces, faces[:, [0, 0, 1]], faces[:, [2, 2, 2]]])


def _twice() -> tuple[Any, Any]:
    vertices, faces = _plane(51)
    return vertices, np.concatenate([faces, faces])


def _aligned(shift: float) -> tuple[Any, Any]:
    lines = (np.arange(-WIDTH, WIDTH + 1) + shift) * SIDE
    return grid(lines, lines, FOCUS)


def _slivers() -> float:
    """1000 cells of 240 mm × 0.24 µm … 240 mm, turned about the axis so that they run oblique to the pixels."""
    vertices, faces = grid(np.linspace(-0.12, 0.12, 1001), [-120, 120], FOCUS)
    cos, sin = np.cos(0.5), np.sin(0.5)
    turned = vertices @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return cone(mesh(turned, faces), pixel_pitch=2.5e-3)


def _pinhole_on_vertices() -> float:
    picture = power(scene(mesh(*_aligned(0.5)), model="pinhole"), pixel="centre")
    falloff = over_pixels(lambda x, y: FOCUS**4 / (FOCUS**2 + x**2 + y**2) ** 2, nodes=1)
    return off_anywhere(picture, (PUPIL * SIDE / FOCUS) ** 2 * falloff)


def body_cases() -> list[Case]:
    """Two surfaces in one place, or nearly."""
    one, two = disk(FOCUS, 60), disk(FOCUS, 20, exitance=2.0)
    return [
        Case("two coincident surfaces", REFUSAL, lambda: cone(one, two), None),
        Case("a surface 0.01 mm before another", CONE, lambda: cone(disk(FOCUS + 0.01, 60, exitance=2.0), one), EXACT),
        Case("body smaller than its blur", "overlap of two circles", _two_circles, 3e-3),
    ]


def _two_circles() -> float:
    """A disk of radius r at z is seen from h off the axis through r u/|u − z| of the pupil, h z/|u − z| off its middle.

    P = J_n/π · A_vd · (what the circles share) cos⁴θ/u².
    """
    z, radius, pitch = 110.0, 0.8, 0.1
    side = pitch * (FOCUS - FOCAL) / FOCAL

    def seen(x: Plane, y: Plane) -> Plane:
        h = np.hypot(x, y)
        return _shared(PUPIL, radius * FOCUS / (FOCUS - z), h * z / (FOCUS - z)) / (1 + (h / (FOCUS - z)) ** 2) ** 2

    expected = side**2 / (np.pi * FOCUS**2) * over_pixels(seen, side, 30)
    return off(power(scene(disk(z, radius), pixel_pitch=pitch)), expected)


def _shared(r: float, s: float, apart: Plane) -> Plane:
    """Area that two circles of radii r and s share, `apart` between their centres."""
    apart = np.clip(apart, abs(r - s) + 1e-12, r + s)
    a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
    b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    return r**2 * (a - np.sin(2 * a) / 2) + s**2 * (b - np.sin(2 * b) / 2)
