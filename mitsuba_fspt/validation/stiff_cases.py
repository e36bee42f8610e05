"""The rows of `fspt stability`: stiff scenes, each against a closed form, an invariance or the other domain.

If all lines of sight of a pixel meet a surface of 1 W/mm², its power has a closed form, whatever the shape of the
surface. The tolerance is then 1e-5 of the pixel's own power; float32 reaches 4e-7. In images with a silhouette errors
are relative to the brightest pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from .stability import Case
from .stiff_scenes import (
    EXACT,
    FOCAL,
    FOCUS,
    HEIGHT,
    PITCH,
    WIDTH,
    balance_error,
    ball,
    cone_error,
    crop_error,
    disk,
    domain_error,
    half_dark_error,
    invariance_error,
    mesh,
    moved,
    moved_cone_error,
    pane,
    pinhole_limit_error,
    pinhole_vertex_error,
    pixel_grid,
    plate,
    rotation_error,
    scaled_exitance_error,
    sliver_error,
    small_disk_error,
    small_film_error,
    square,
    square_grid,
    stray_power,
    two_level_error,
    wall_error,
)

# Reference that an image is compared with. A cone is filled if all lines of sight of the pixel meet the surface.
CONE = "filled cone: A_vd times the configuration factor"
BALANCE = "power balance: what the disk sends through the pupil"
SAME = "the same image"
OTHER = "the other domain"
REFUSAL = "a refusal"
# Tolerances: of an image with edges, and of two images, each of which may be wrong by the default rtol of 1e-3.
SHARP, AGREED = 5e-4, 2e-3
# Of an ideal mirror: CUDA's square root is approximate, and Mitsuba's Fresnel formula subtracts equal numbers, which
# gives 0.9995 at some angles; on LLVM it is 1.
MIRROR = 5e-5
QUARTER = (0, 0, WIDTH // 2, HEIGHT // 2)  # crop window that holds the middle of the ball and a part of its limb
ROUNDED = 1e-4  # at the default rtol: float32 rounding changes the position at which the bisection of an edge ends


def cases() -> list[Case]:
    """All rows, the slow ones included. Their scenes are built and rendered when a row is run, not here."""
    return [
        *focus_cases(),
        *lens_cases(),
        *grazing_cases(),
        *exitance_cases(),
        *mesh_cases(),
        *object_cases(),
        *specular_cases(),
        *pose_cases(),
        *film_cases(),
    ]


def focus_cases() -> list[Case]:
    """Surfaces in, through and around the virtual detector plane z = u, and focus from the focal point to far away."""
    rows = []
    for name, share in (("in", 0.0), ("1e-7 before", -1e-7), ("1e-7 behind", 1e-7)):
        z = FOCUS * (1 + share)
        rows += [
            Case(f"surface {name} the plane z = u", CONE, partial(lambda z: cone_error(disk(z, 60)), z), EXACT),
            Case(f"edge {name} the plane z = u", BALANCE, partial(balance_error, z, 4.0), EXACT),
        ]
    tilted = "surface through the plane z = u, 80° tilted"
    rows += [
        Case(tilted, CONE, lambda: cone_error(disk(FOCUS, 600, tilt=80)), EXACT),
        Case(
            "edge in the plane z = u, surface form", BALANCE, partial(balance_error, FOCUS, 4.0, "surface", 4e-3), SHARP
        ),
        Case("sphere through the plane z = u", OTHER, lambda: domain_error(ball(), crop=QUARTER), AGREED),
    ]
    for share, tolerance in ((1e-6, None), (1e-5, EXACT), (1e-4, EXACT), (1e-2, EXACT)):
        run = partial(lambda u: cone_error(disk(u, 60), focus_distance=u, pixel_pitch=10), FOCAL * (1 + share))
        rows.append(Case(f"u = F(1 + {share:g}), pixels of 10 mm", CONE, run, tolerance))
    for u in (1e4, 1e7):
        run = partial(lambda u: cone_error(disk(u, 1e3 * u), focus_distance=u), u)
        radius = 5 * PITCH * (u - FOCAL) / FOCAL
        rows += [
            Case(f"u = {u:g} mm", CONE, run, EXACT),
            Case(f"edge at u = {u:g} mm", BALANCE, partial(balance_error, u, radius, focus_distance=u), EXACT),
        ]
    far = partial(lambda u: cone_error(disk(165, 1e3), focus_distance=u), 1e7)
    return [*rows, Case("focused at 1e7 mm, surface at 165", CONE, far, EXACT)]


def lens_cases() -> list[Case]:
    """Stops, magnifications, pixel sizes, and a lens very close to the surface."""
    rows = []
    for stop in (0.5, 2.8, 64, 1e4, 1e6):
        run = partial(lambda n: cone_error(disk(FOCUS, 200), f_number=n), stop)
        rows += [
            Case(f"f/{stop:g}", CONE, run, 2e-5),
            Case(f"f/{stop:g}, edge out of focus", BALANCE, partial(balance_error, 170.0, 4.0, f_number=stop), SHARP),
        ]
    rows += [
        Case("f/1e6 against the pinhole model", SAME, pinhole_limit_error, 1e-3),
        Case("f/1e6", OTHER, lambda: domain_error(ball(), crop=QUARTER, f_number=1e6), AGREED),
        Case("lens 0.1 mm off the surface", CONE, lambda: cone_error(disk(0.1, 200)), EXACT),
        Case("lens 0.1 mm off the surface, f/0.5", CONE, lambda: cone_error(disk(0.1, 200), f_number=0.5), EXACT),
    ]

    def magnified(t: float, pitch: float) -> float:
        return cone_error(disk(FOCAL * (1 + 1 / t), 2e3 / t), magnification=t, pixel_pitch=pitch)

    for t, pitch in ((1e-4, 0.4), (1e-2, 0.4), (1e2, 0.4), (1e4, 10.0)):
        name = f"magnification {t:g}, pixels of {pitch:g} mm"
        rows.append(Case(name, CONE, partial(magnified, t, pitch), EXACT))
    for pitch, tolerance in ((1e-6, None), (1e-3, EXACT), (10.0, 2e-5)):
        run = partial(lambda p: cone_error(disk(FOCUS, 600), pixel_pitch=p), pitch)
        rows.append(Case(f"pixels of {pitch:g} mm", CONE, run, tolerance))
    edge = partial(balance_error, FOCUS, 0.01, pixel_pitch=1e-3)
    return [*rows, Case("edge, pixels of 0.001 mm", BALANCE, edge, EXACT)]


def grazing_cases() -> list[Case]:
    """A wall beside the axis, which lines of sight meet at grazing angles; the name gives the least slope."""
    return [
        Case(f"grazing incidence {slope:g}", CONE, partial(wall_error, slope), EXACT) for slope in (1e-2, 1e-4, 1e-6)
    ]


def exitance_cases() -> list[Case]:
    """J_n over the whole range of float32."""
    rows = [
        Case(f"J_n {j:g} W/mm²", SAME, partial(scaled_exitance_error, j), ROUNDED if 1e-32 < j < 1e32 else None)
        for j in (1e-37, 1e-30, 1e30, 1e37)
    ]
    dim = disk(FOCUS, 60, exitance=1e-26)
    return [
        *rows,
        Case("J_n of 9 decades in one image", CONE, two_level_error, EXACT),
        Case("J_n 0 on half of the mesh, edge on pixel edges", CONE, partial(half_dark_error, 0.0), SHARP),
        Case("J_n 0 on half of the mesh, edge inside pixels", CONE, partial(half_dark_error, 0.3), SHARP),
        Case("1e-36 W and less on a pixel", REFUSAL, lambda: cone_error(dim, f_number=1e6), None),
    ]


def mesh_cases() -> list[Case]:
    """Triangles of all sizes and kinds."""
    large = ([[-500, -500, FOCUS], [0, 900, FOCUS], [500, -500, FOCUS]], [[0, 1, 2]])

    def no_area() -> float:
        vertices, faces = square_grid(50)
        return cone_error(mesh(vertices, [*faces, *faces[:, [0, 0, 1]], *faces[:, [2, 2, 2]]]))

    def twice() -> float:
        vertices, faces = square_grid(50)
        return cone_error(mesh(vertices, [*faces, *faces]))

    return [
        Case("one triangle as large as the scene", CONE, lambda: cone_error(mesh(*large)), EXACT),
        Case("20 000 triangles", CONE, lambda: cone_error(mesh(*square_grid(100))), EXACT),
        Case("3 million triangles", CONE, lambda: cone_error(mesh(*square_grid(1225))), EXACT, slow=True),
        Case("slivers of aspect 1e6", CONE, sliver_error, EXACT),
        Case("faces without area", CONE, no_area, EXACT),
        Case("every face twice", REFUSAL, twice, None),
        Case("mesh edges on pixel edges", CONE, lambda: cone_error(mesh(*pixel_grid(0.0))), EXACT),
        Case("mesh vertices on pixel centres", CONE, lambda: cone_error(mesh(*pixel_grid(0.5))), EXACT),
        Case("mesh vertices on the pinhole's lines of sight", "cos⁴θ", pinhole_vertex_error, EXACT),
    ]


def object_cases() -> list[Case]:
    """Two surfaces that coincide or nearly do, and an object smaller than its blur."""
    one, two, before = disk(FOCUS, 60), disk(FOCUS, 20, exitance=2.0), disk(FOCUS + 0.01, 60, exitance=2.0)
    return [
        Case("two coincident surfaces", REFUSAL, lambda: cone_error(one, two), None),
        Case("a surface 0.01 mm before another", CONE, lambda: cone_error(before, one), EXACT),
        Case("body smaller than its blur", "overlap of two circles", small_disk_error, 3e-3),
    ]


def specular_cases() -> list[Case]:
    """Panes, plates and mirrors between lens and surface, which have no effect at an index or a reflectance of 1."""
    null, mirror = {"type": "null"}, {"type": "conductor", "material": "none"}
    mask = {"type": "mask", "opacity": 0.75, "nested": {"type": "diffuse"}}
    beside = disk(80, 600, x=300, tilt=90)  # its mirror image faces the lens

    def behind(*bodies: Any, **settings: Any) -> Callable[[], float]:
        return lambda: cone_error(disk(FOCUS, 200), *bodies, **settings)

    return [
        *(
            Case(f"null surface {gap:g} mm before the surface", CONE, behind(pane(FOCUS - gap, null)), EXACT)
            for gap in (1e-3, 1.0, 160.0)
        ),
        Case("six null surfaces", CONE, behind(*(pane(20.0 + 20 * k, null, tilt=8 * k) for k in range(6))), EXACT),
        Case("mask that lets a quarter through", CONE, behind(pane(80, mask), share=0.25), EXACT),
        Case("null surface at grazing incidence", CONE, behind(pane(80, null, tilt=85)), EXACT),
        *(
            Case(f"plate of index 1, {thickness:g} mm thick", CONE, behind(plate(80, thickness, 1.0)), EXACT)
            for thickness in (1e-2, 10.0)
        ),
        Case("mirror at 45°", CONE, lambda: cone_error(beside, pane(80, mirror, tilt=45)), MIRROR),
        Case("lens inside a chamber of index 1", CONE, behind(plate(-50, 150, 1.0)), EXACT),
    ]


def pose_cases() -> list[Case]:
    """The whole scene rotated, moved or scaled: the power stays the same, times the square of the scale."""
    rows = [
        Case(f"camera turned {angle}° about ({axis})", SAME, partial(rotation_error, axis, angle), SHARP)
        for axis, angle in (("0, 1, 0", 90), ("1, 0, 0", -90), ("1, 2, 3", 50), ("-3, 1, 1", 200))
    ]
    rows += [
        Case(f"all lengths × {s:g}", SAME, partial(invariance_error, ball, factor=s * s, scale=s), ROUNDED)
        for s in (1e-6, 1e-3, 1e3, 1e6)
    ]
    # Far from the origin float32 rounds the positions; the vertices of the square at 2^17 mm alone are exact.
    origin = "from the world's origin"
    return [
        *rows,
        Case(f"1.3e5 mm {origin}, mesh", SAME, lambda: invariance_error(square, pose=moved(2.0**17)), SHARP),
        Case(f"1e5 mm {origin}, ball", SAME, lambda: invariance_error(ball, pose=moved(1e5)), 2e-3),
        Case(f"1e5 mm {origin}, turned", SAME, lambda: invariance_error(ball, pose=moved(1e5, 50)), 2e-2),
        Case(f"1e5 mm {origin}, filled", CONE, lambda: moved_cone_error(moved(1e5, 50)), EXACT),
        Case(f"1e7 mm {origin}", REFUSAL, lambda: invariance_error(ball, pose=moved(1e7)), None),
    ]


def film_cases() -> list[Case]:
    """Films of one pixel and one row, crop windows, and objects that no pixel sees."""
    rows = [
        Case(f"film of {w} × {h}", CONE, partial(lambda f: cone_error(disk(FOCUS, 60), film=f), (w, h)), EXACT)
        for w, h in ((1, 1), (1, 20), (24, 1))
    ]
    rows += [
        Case(f"silhouette on a film of {w} × {h}", SAME, partial(small_film_error, w, h), 2e-3)
        for w, h in ((2, 2), (2, HEIGHT), (WIDTH, 2))
    ]
    rows += [
        Case(f"crop window {crop}", SAME, partial(crop_error, crop), 2e-3) for crop in ((5, 3, 11, 9), (4, 7, 3, 6))
    ]
    return [
        *rows,
        Case("everything outside the field", "no light", lambda: stray_power(disk(FOCUS, 4, x=100)), EXACT),
        Case("everything behind the lens", "no light", lambda: stray_power(disk(-FOCUS, 4)), EXACT),
    ]
