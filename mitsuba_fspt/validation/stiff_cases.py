"""The rows of `fspt stability`: stiff scenes, each against a closed form, an invariance or the other domain.

Where a cone is filled by 1 W/mm², every pixel is the closed form whatever the shape, to 1e-5 of its own power: the
floor of float32 is 4e-7 there. Where a silhouette is in the picture, errors are relative to the brightest pixel.
"""

from __future__ import annotations

from functools import partial

from .stability import Case
from .stiff_cases_bodies import body_cases, light_cases, mesh_cases
from .stiff_cases_places import film_cases, place_cases
from .stiff_cases_scenes import (
    AGREED,
    BALANCE,
    CONE,
    EXACT,
    FOCAL,
    FOCUS,
    OTHER,
    PITCH,
    SAME,
    SHARP,
    WIDTH,
    balance,
    ball,
    cone,
    disk,
    domains,
    filled,
    mesh,
    off,
    off_anywhere,
    power,
    scene,
)


def cases() -> list[Case]:
    """All rows, the slow ones too; nothing is built or rendered before a row runs."""
    return [
        *focus_cases(),
        *lens_cases(),
        *grazing_cases(),
        *light_cases(),
        *mesh_cases(),
        *body_cases(),
        *place_cases(),
        *film_cases(),
    ]


def focus_cases() -> list[Case]:
    """In, through and around the sharp plane, from the focal point to far away."""
    rows = []
    for name, share in (("in", 0.0), ("1e-7 before", -1e-7), ("1e-7 behind", 1e-7)):
        z = FOCUS * (1 + share)
        rows += [
            Case(f"surface {name} the sharp plane", CONE, partial(lambda z: cone(disk(z, 60)), z), EXACT),
            Case(f"edge {name} the sharp plane", BALANCE, partial(balance, z, 4.0), EXACT),
        ]
    rows += [
        Case("surface through the sharp plane, 80° tilted", CONE, lambda: cone(disk(FOCUS, 600, tilt=80)), EXACT),
        Case("edge in the sharp plane, surface form", BALANCE, partial(balance, FOCUS, 4.0, "surface", 1e-3), SHARP),
        Case("ball through the sharp plane", OTHER, lambda: domains(ball()), AGREED),
    ]
    for share, tolerance in ((1e-6, None), (1e-5, EXACT), (1e-4, EXACT), (1e-2, EXACT)):
        run = partial(lambda u: cone(disk(u, 60), focus_distance=u, pixel_pitch=10), FOCAL * (1 + share))
        rows.append(Case(f"u = F(1 + {share:g}), pixels of 10 mm", CONE, run, tolerance))
    for u in (1e4, 1e7):
        run = partial(lambda u: cone(disk(u, 1e3 * u), focus_distance=u), u)
        radius = 5 * PITCH * (u - FOCAL) / FOCAL
        rows += [
            Case(f"u = {u:g} mm", CONE, run, EXACT),
            Case(f"edge at u = {u:g} mm", BALANCE, partial(balance, u, radius, focus_distance=u), EXACT),
        ]
    rows.append(
        Case("focused at 1e7 mm, surface at 165", CONE, lambda: cone(disk(165, 1e3), focus_distance=1e7), EXACT)
    )
    return rows


def lens_cases() -> list[Case]:
    """Stops, magnifications, pixels, and a lens that nearly touches."""
    rows = []
    for stop in (0.5, 2.8, 64, 1e4, 1e6):
        cone_of = partial(lambda n: cone(disk(FOCUS, 200), f_number=n), stop)
        rows += [
            Case(f"f/{stop:g}", CONE, cone_of, 2e-5),
            Case(f"f/{stop:g}, edge out of focus", BALANCE, partial(balance, 170.0, 4.0, f_number=stop), SHARP),
        ]
    rows += [
        Case("f/1e6 against the pinhole model", SAME, _towards_pinhole, 1e-3),
        Case("f/1e6", OTHER, lambda: domains(ball(), f_number=1e6), AGREED),
        Case("lens 0.1 mm off the surface", CONE, lambda: cone(disk(0.1, 200)), EXACT),
        Case("lens 0.1 mm off the surface, f/0.5", CONE, lambda: cone(disk(0.1, 200), f_number=0.5), EXACT),
    ]
    for t, pitch in ((1e-4, 0.4), (1e-2, 0.4), (1e2, 0.4), (1e4, 10.0)):
        run = partial(lambda t, p: cone(disk(FOCAL * (1 + 1 / t), 2e3 / t), magnification=t, pixel_pitch=p), t, pitch)
        rows.append(Case(f"magnification {t:g}, pixels of {pitch:g} mm", CONE, run, EXACT))
    for pitch, tolerance in ((1e-6, None), (1e-3, EXACT), (10.0, 2e-5)):
        run = partial(lambda p: cone(disk(FOCUS, 600), pixel_pitch=p), pitch)
        rows.append(Case(f"pixels of {pitch:g} mm", CONE, run, tolerance))
    rows.append(Case("edge, pixels of 0.001 mm", BALANCE, partial(balance, FOCUS, 0.01, pixel_pitch=1e-3), EXACT))
    return rows


def _towards_pinhole() -> float:
    stopped, pinhole = (power(scene(ball(), f_number=1e6, model=model)) for model in ("diaphragm", "pinhole"))
    return off(stopped, pinhole)


def grazing_cases() -> list[Case]:
    """A wall beside the axis, which lines of sight meet at slopes down to the one named."""
    return [
        Case(f"grazing incidence {slope:g}", CONE, partial(_along_wall, slope), EXACT) for slope in (1e-2, 1e-4, 1e-6)
    ]


def _along_wall(slope: float) -> float:
    """A wall 1 mm beside the axis; half of the film sees it, through its pixels' centres, and half sees past it."""
    length = 100 / slope
    corners = [[-1, -1e3, 0], [-1, 1e3, 0], [-1, 1e3, length], [-1, -1e3, length]]
    side = 2 * slope * FOCUS
    pitch = side * FOCAL / (FOCUS - FOCAL)
    wall = scene(mesh(corners, [[0, 1, 2], [0, 2, 3]]), f_number=1e6, pixel_pitch=pitch)
    expected = filled(FOCUS, side, FOCAL / 2e6, nodes=1)
    expected[:, : WIDTH // 2] = 0
    return off_anywhere(power(wall, pixel="centre"), expected)
