"""Windows, mirrors, masks and glass between phantom and lens: closed forms, mirrored phantoms, Mitsuba's `path`.

Two images that are compared differ by one to three times their `rtol` of the brightest pixel at the most.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from small_scenes import (
    FOCUS,
    HEIGHT,
    SCENES,
    SIDE,
    WIDTH,
    camera_scene,
    disk,
    glow,
    look_at_crop,
    mi,
    power,
    sphere,
    write_ply,
)

import mitsuba_fspt as fspt
from mitsuba_fspt.camera.of_sensor import camera_of
from mitsuba_fspt.integral.lines.eq9 import View
from mitsuba_fspt.integral.lines.specular import Specular
from mitsuba_fspt.integral.lines.visible_window import visible_window
from mitsuba_fspt.runtime.errors import SceneError

QUARTER = (12, 9, 8, 7)  # crop window: of a sphere on the axis the upper left quarter, limb and middle
BESIDE = (12, 12, 8, 4)  # the lower half of it
N, THICK = 1.5, 10.0  # refractive index and thickness [mm] of a window
THROUGH = 2 * N / (N * N + 1)  # of a pane, all internal reflections counted, at normal incidence
PERFECT = {"type": "conductor", "material": "none"}
PANE = {"type": "thindielectric", "int_ior": N}
PEAK_MISS = 2e-3  # of the brightest pixel: what is not first order in the angles to the axis


def place(z, size=200.0, x=0.0, tilt=0.0):
    """A square's transform: centre at (x, 0, z) [mm], turned about the vertical from facing the lens by `tilt` [°]."""
    return mi.ScalarTransform4f().translate([x, 0, z]).rotate([0, 1, 0], 180 - tilt).scale(size)


def pane(z, bsdf, **where):
    """A rectangle that does not glow."""
    return {"type": "rectangle", "to_world": place(z, **where), "bsdf": bsdf}


def slab(z, thickness=THICK, n=N, size=200.0):
    """A plate of glass whose middle lies at depth z [mm]."""
    to_world = mi.ScalarTransform4f().translate([0, 0, z]).scale([size, size, thickness / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.0}}


def mirrored(point, z, tilt):
    """A point's mirror image in a pane at depth z [mm] and this tilt [°]."""
    turn = np.radians(tilt)
    normal, centre = np.array([np.sin(turn), 0, -np.cos(turn)]), np.array([0, 0, z])
    return point - 2 * (point - centre) @ normal * normal


def agrees_with_path(scene, spp=1024, seed=3, image=None):
    """True where the `image` of the integral, which is not dark, is that of Mitsuba's path tracer: p > 1e-3.

    The error of rtol = 6e-3 is part of the z-test; half of it takes longer.
    """
    image = image or fspt.render(scene, method="integral", rtol=6e-3)
    p = fspt.compare(image, fspt.render(scene, method="path", spp=spp, seed=seed)).z_test.p_value
    return image.power.max() > 0 and p > 1e-3


@pytest.mark.parametrize("window", [pane(80, PANE), slab(80)], ids=["thin", "solid"])
def test_a_window_transmits_the_share_of_fresnels_equations(window):
    far = disk(FOCUS)
    bare, seen = (power(camera_scene(far, bodies=bodies, f_number=16), rtol=1e-4) for bodies in ((), (window,)))
    middle = slice(HEIGHT // 2 - 2, HEIGHT // 2 + 2), slice(WIDTH // 2 - 2, WIDTH // 2 + 2)
    assert seen[middle] / bare[middle] == pytest.approx(THROUGH, rel=3e-4)


def test_a_plate_of_glass_moves_the_focus():
    """What lies z behind a plate is seen at z - d (1 - 1/n); without the shift the blurred edge is off by 3 %."""
    depth, nearer = 190.0, THICK * (1 - 1 / N)
    rim = {"f_number": 4, "crop": (12, 13, 4, 2)}
    behind = power(camera_scene(disk(depth, radius=6.0), bodies=(slab(80),), **rim), rtol=1e-3)
    in_air = power(camera_scene(disk(depth - nearer, radius=6.0), **rim), rtol=1e-3)
    unmoved = power(camera_scene(disk(depth, radius=6.0), **rim), rtol=1e-3)
    assert abs(behind - THROUGH * in_air).max() < PEAK_MISS * behind.max()
    assert abs(behind - THROUGH * unmoved).max() > 5 * PEAK_MISS * behind.max()


def test_depth_behind_a_plate_is_the_apparent_one():
    """A line of sight on the axis ends at z - d (1 - 1/n), by which the blur is estimated.

    Seen to fail where lengths in the glass count whole.
    """
    scene = camera_scene(disk(190.0, radius=40.0), bodies=(slab(80),))
    camera = scene.sensors()[0].camera
    view = View.of(scene, camera, visible_window(scene, camera), None, Specular.of(scene, camera))
    seen = view.integrand(mi.Point2f(WIDTH / 2, HEIGHT / 2), mi.Point2f(0, 0))
    assert float(seen.depth[0]) == pytest.approx(190.0 - THICK * (1 - 1 / N), abs=1e-3)


def test_a_window_agrees_with_the_path_tracer():
    window = pane(80, PANE, tilt=20)
    assert agrees_with_path(camera_scene(sphere(150, 9, x=3), bodies=(window,), crop=(2, 10, 9, 6)))


def test_a_mirror_shows_the_mirrored_phantom():
    """Two spheres, one of them off the axis, so that an image the wrong way round would be seen.

    The mirror is a rough one of roughness 0; other tests have that of Mitsuba's `conductor`.
    """
    bsdf, depth = {"type": "roughconductor", "alpha": 0.0, "material": "none"}, 150.0
    share, seen = 0.9, [(np.array([0.0, 3.0, depth]), 5.0), (np.array([7.0, -2.0, depth - 4]), 2.0)]
    mirror = pane(80, bsdf | {"specular_reflectance": share}, tilt=45)
    real = [{"type": "sphere", "center": mirrored(p, 80, 45).tolist(), "radius": r} for p, r in seen]
    straight = ({"type": "sphere", "center": p.tolist(), "radius": r} for p, r in seen)
    around = (7, 10, 14, 12)  # the smaller one and the left half of the other
    image, direct = (
        fspt.render(camera_scene(*shapes, bodies=bodies, crop=around), rtol=3e-3)
        for shapes, bodies in ((real, (mirror,)), (straight, ()))
    )
    assert (abs(image.power - share * direct.power) <= image.error + direct.error).mean() > 0.995
    assert abs(image.power - share * direct.power).max() < 6e-3 * direct.power.max()
    assert image.coverage == pytest.approx(direct.coverage, abs=2e-2)


def test_a_mirror_whose_edge_cuts_the_field():
    """A small mirror at 45°, out of focus, hides half of a sphere and shows another one beside it."""
    z = 60.0
    mirror = pane(z, PERFECT, size=4.0, x=-3.0, tilt=45)
    scene = camera_scene(sphere(170, 8), sphere(z, 6, x=30), bodies=(mirror,), crop=(16, 13, 12, 2))
    assert agrees_with_path(scene, spp=4096)


def test_three_views_on_one_detector():
    scene = fspt.load(SCENES / "mirror_rig.xml", width=48, height=16, pixel_pitch=0.54)
    image = fspt.render(scene, method="integral", rtol=6e-3)
    assert agrees_with_path(scene, spp=256, image=image)
    views = image.coverage.sum(axis=0) > 0
    assert np.count_nonzero(np.diff(views.astype(int)) == 1) == 3


def test_two_mirrors_in_turn():
    """A periscope: two parallel mirrors at 45° shift the line of sight sideways by 40 mm."""
    mirrors = (pane(70, PERFECT, size=[18, 18, 1], tilt=45), pane(70, PERFECT, size=[25, 25, 1], x=40, tilt=225))
    quarter = (10, 12, 10, 4)
    shifted = fspt.render(camera_scene(sphere(125, 6, x=40), bodies=mirrors, crop=quarter), rtol=2e-3)
    direct = fspt.render(camera_scene(sphere(FOCUS, 6), crop=quarter), rtol=2e-3)
    assert abs(shifted.power - direct.power).max() < 4e-3 * direct.power.max()


def test_a_mask_of_even_opacity_scales_the_image():
    far, mask = sphere(150, 9), pane(80, {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse"}})
    seen, bare = (fspt.render(camera_scene(far, bodies=b, crop=QUARTER), rtol=1e-3) for b in ((mask,), ()))
    assert abs(seen.power - 0.7 * bare.power).max() < 1e-3 * bare.power.max()
    assert seen.coverage == pytest.approx(bare.coverage, abs=1e-3)


def test_a_mask_as_a_graded_filter():
    """Opacity linear across it: its mean over pixel and pupil is that on the pixel's axis."""
    texels, half, z = 64, 20.0, 90.0
    data = mi.TensorXf(np.linspace(0.1, 0.9, texels, dtype=np.float32)[None, :, None].repeat(2, 0))
    opacity = {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}
    mask = pane(z, {"type": "mask", "opacity": opacity, "nested": {"type": "diffuse"}}, size=half)
    seen, bare = (power(camera_scene(disk(FOCUS), bodies=b, f_number=8), rtol=1e-4) for b in ((mask,), ()))
    x = (WIDTH / 2 - np.arange(WIDTH) - 0.5) * SIDE * z / FOCUS
    # The rectangle is turned by 180° about the vertical: its u runs from +x to -x.
    share = 0.5 - x / (2 * half)
    expected = 1 - (0.1 + 0.8 * (share * texels - 0.5) / (texels - 1))
    assert seen[HEIGHT // 2] / bare[HEIGHT // 2] == pytest.approx(expected, abs=1e-3)


def strips(bsdfs):
    """Upright mirrors of 3 mm, one above the other, that together turn the whole field by 90°."""
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180 - 45).scale([40, 1.5, 1])
    at = (mi.ScalarTransform4f().translate([0, 3 * k - 1.5 * (len(bsdfs) - 1), 80]) for k in range(len(bsdfs)))
    return tuple({"type": "rectangle", "to_world": t @ turn, "bsdf": b} for t, b in zip(at, bsdfs, strict=True))


def test_a_mirror_in_another_bsdf_reflects_its_share():
    """What a mask or a blend leaves of a mirror shows the mirrored phantom as a mirror of that reflectance does.

    Six strips in one scene, out of focus, so that most pixels see them all: a share that is off by 5 % on one strip
    is 8e-3 of the pixel's power.
    """
    inside, bare = [], []
    for share in (1.0, 0.5):
        dim = PERFECT | {"specular_reflectance": 0.2}
        half = {"type": "blendbsdf", "weight": 1 - share, "a": PERFECT, "b": dim}
        inside += [
            {"type": "mask", "opacity": share, "nested": PERFECT},
            {"type": "blendbsdf", "weight": 1 - share, "a": PERFECT, "b": {"type": "null"}},
            {"type": "twosided", "nested": half},
        ]
        bare += [PERFECT | {"specular_reflectance": r} for r in (share, share, share + 0.2 * (1 - share))]
    scenes = (camera_scene(sphere(80, 5, x=70), bodies=strips(bsdfs), crop=(18, 13, 2, 2)) for bsdfs in (inside, bare))
    seen, due = (power(scene, rtol=6e-3) for scene in scenes)
    assert due.max() > 0
    assert abs(seen - due).max() < 6e-3 * due.max()


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "mask", "nested": PANE, "opacity": 0.6},
        {"type": "blendbsdf", "weight": 0.3, "a": PANE, "b": PERFECT},
    ],
    ids=["mask of a pane", "blend of a pane and a mirror"],
)
def test_masks_and_blends_agree_with_the_path_tracer(bsdf):
    """As beam splitters, which show both phantoms: their reflection is no ghost that may be left out."""
    splitter = pane(80, bsdf, size=40, tilt=45)
    assert agrees_with_path(camera_scene(sphere(150, 6), sphere(80, 5, x=70), bodies=(splitter,), crop=BESIDE))


GLASSES = {"a": {"type": "dielectric", "int_ior": 1.3}, "b": {"type": "dielectric"}}


@pytest.mark.parametrize(
    ("bsdf", "fault"),
    [
        ({"type": "mask", "nested": {"type": "blendbsdf", "weight": 0.4, "a": PERFECT, "b": PERFECT}}, "and a 'mask'"),
        ({"type": "blendbsdf", "weight": 0.4, **GLASSES}, "two glasses"),
    ],
)
def test_blends_that_lines_of_sight_cannot_follow_are_refused(bsdf, fault):
    scene = camera_scene(sphere(80, 5, x=70), bodies=(pane(80, bsdf, tilt=45),))
    with pytest.raises(SceneError, match=rf"BSDF of shape '.*{fault}.*--method path --max-depth 9") as refused:
        fspt.render(scene)
    assert "\n" not in str(refused.value)


def test_total_reflection_in_a_prism(tmp_path):
    """A right-angled prism turns the line of sight by 90°; Fresnel's loss is that of two faces."""
    n, half = 1.7, 16.0
    corners = np.array([(x, y, z) for y in (-half, half) for x, z in ((-half, -half), (half, -half), (half, half))])
    hull = trimesh.convex.convex_hull(corners + np.array([0, 0, 90.0]))
    mesh = write_ply(tmp_path / "prism.ply", hull.vertices, hull.faces)
    prism = {"type": "ply", "filename": str(mesh)} | {
        "face_normals": True,
        "bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.0},
    }
    scene = camera_scene(sphere(90, 5, x=80), bodies=(prism,), f_number=8, crop=BESIDE)
    assert agrees_with_path(scene)


def test_light_by_plain_courses_and_by_all_others_adds_up():
    """On every line of sight; both parts are refined by themselves, as reflections in windows are faint."""
    scene = camera_scene(sphere(FOCUS, 8), bodies=(slab(60), pane(100, PANE, tilt=3)))
    camera = camera_of(scene.sensors()[0])
    whole = View.of(scene, camera, visible_window(scene, camera), specular=Specular.of(scene, camera))
    assert whole.specular.branching
    x, y, turn, radius = np.random.default_rng(0).uniform(size=(4, 512)).astype(np.float32)
    film = mi.Point2f(x * WIDTH, y * HEIGHT)
    pupil = mi.Point2f(radius * np.cos(6.28 * turn), radius * np.sin(6.28 * turn))
    views = [replace(whole, specular=replace(whole.specular, part=part)) for part in ("all", "plain", "others")]
    sights = [view.integrand(film, pupil) for view in views]
    light, plain, others = (sight.integrand.numpy().astype(float) for sight in sights)
    assert plain + others == pytest.approx(light, rel=1e-5)
    lost, *parts = (sight.lost.numpy().astype(float) for sight in sights)
    assert sum(parts) == pytest.approx(lost, rel=1e-5)
    # Two reflections between window and plate, of 4 % or 8 % each.
    assert 5e-4 < others.max() / plain.max() < 2e-2
    assert (sights[0].covered == sights[1].covered).numpy().all()


def test_other_courses_than_plain_ones_take_few_lines_of_sight():
    """Their light, some thousandths, is smooth enough for nodes; one image of all courses has transects alike."""
    scene = camera_scene(sphere(FOCUS, 8), bodies=(slab(60), pane(100, PANE, tilt=3)), crop=QUARTER)
    levels = [level.split(": ") for level in fspt.render(scene, rtol=3e-2).metadata["levels"].split("; ")]
    pixels = {name: int(count.split()[0]) for name, count in levels}
    assert pixels["2 transects"] > 60
    assert pixels["other courses, 4 nodes"] == pixels["4 nodes"]
    assert pixels.get("other courses, 2 transects", 0) < 10


def test_what_is_cut_off_is_in_the_error():
    """Between two facing mirrors the light goes to and fro; one reflection misses the images of two."""
    mirrors = tuple(pane(200, PERFECT, size=95, x=x, tilt=tilt) for x, tilt in ((8, -90), (-8, 90)))
    scene = camera_scene(sphere(300, 3, x=2), bodies=mirrors, magnification=0.2, crop=(0, 14, WIDTH, 2))
    few, many = (fspt.render(scene, rtol=1e-2, max_specular=most) for most in (1, 12))
    missing = abs(many.power - few.power)
    assert missing.max() > 0.1 * many.power.max()
    assert (missing <= few.error + many.error).all()


@pytest.mark.parametrize("most", [8, 10])
def test_too_few_surfaces_for_light_between_two_plates_are_told(most):
    """Light that plates reflect twice meets each of four borders three times, but for the two that reflect."""
    scene = camera_scene(sphere(FOCUS, 8), bodies=(slab(60), slab(90)), crop=(18, 14, 2, 2))
    image = fspt.render(scene, rtol=2e-3, max_specular=most)
    beyond = (image.error > 2e-3 * image.power.max()).any()
    assert beyond == (most < 10)
    hint = "up to 10 specular surfaces, of which 'max_specular' follows 8: a larger one may lower the error"
    assert (hint in image.metadata.get("warnings", "")) == beyond


def test_coverage_counts_glowing_surfaces_behind_windows():
    plate = {"type": "rectangle", "to_world": place(100, size=2.0), "bsdf": {"type": "diffuse"}}
    cases = {"bare": (), "pane": (pane(80, PANE),), "plate": (plate,), "both": (plate, pane(80, PANE))}
    scenes = {k: camera_scene(disk(FOCUS, 6), bodies=b, crop=(20, 14, 10, 2)) for k, b in cases.items()}
    total = {k: fspt.render(scene, rtol=1e-1).coverage.sum() for k, scene in scenes.items()}
    assert total["pane"] == pytest.approx(total["bare"], rel=1e-3)
    assert total["both"] == pytest.approx(total["plate"], rel=1e-3)
    assert total["plate"] < 0.99 * total["bare"]


def test_narrow_light_behind_a_window():
    """A sphere of 0.06 pixels takes the surface form, through a window, too."""
    tiny = sphere(150, 0.05, x=3.1, y=1.3)
    around = (11, 10, 10, 9)
    scenes = (camera_scene(tiny, bodies=bodies, crop=around) for bodies in ((), (pane(80, PANE),)))
    bare, seen = (fspt.render(scene, rtol=1e-2) for scene in scenes)
    assert seen.power.sum() / bare.power.sum() == pytest.approx(THROUGH, rel=2e-3)


def test_narrow_light_behind_two_plates_of_glass_is_in_the_error():
    """A sphere of 0.05 pixels, as much nearer as the glass makes it, for paraxial light.

    Four borders with the share R of the light let (1 - R)/(1 + 3 R) through.

    Seen to fail, with a thousandth of the light and no more error, where glass hides what lies behind it, and with
    twice the light in the error of all pixels where its place is not known.
    """
    tiny, around = sphere(FOCUS + THICK * (1 - 1 / N), 0.02, x=0.4, y=1.4 * SIDE), (17, 13, 8, 2)
    plates, share = (slab(80, THICK / 2), slab(100, THICK / 2)), ((N - 1) / (N + 1)) ** 2
    image = fspt.render(camera_scene(tiny, bodies=plates, crop=around), rtol=2e-3, max_specular=16, max_nodes=4096)
    bare = fspt.render(camera_scene(sphere(FOCUS, 0.02, x=0.4, y=1.4 * SIDE), crop=around), rtol=1e-2)
    through = (1 - share) / (1 + 3 * share)
    assert (abs(image.power - through * bare.power) <= image.error + bare.error).all()
    far = np.s_[:, 6:]  # of 8 pixels; the sphere is on the second
    assert image.error[far].max() < 0.1 * bare.power.max()


def test_narrow_light_in_a_mirror_is_in_the_error():
    """A sphere of a quarter of a pixel. Seen to fail with 5 % less light by mirrors."""
    where = mirrored(np.array([0.0, 1.0, 160.0]), 80, 45)
    tiny = {"type": "sphere", "center": where.tolist(), "radius": 0.1}
    around = (16, 11, 8, 8)
    scene = camera_scene(tiny, disk(300, 3.0, x=60), bodies=(pane(80, PERFECT, tilt=45),), crop=around)
    direct = fspt.render(camera_scene(sphere(160, 0.1, y=1.0), crop=around), rtol=1e-2)
    assert direct.power.max() > 0
    image = fspt.render(scene, rtol=2e-2)
    assert (abs(image.power - direct.power) <= image.error + direct.error).all()


@pytest.mark.parametrize("bounces", [1, 2])
def test_narrow_light_that_mirrors_alone_show_is_met(bounces):
    """A sphere of a quarter of a pixel behind a plate, in one mirror or in two.

    Expected: its image at its mirror image's place. Seen to fail, with an image of 0 and an error of 0, with the light
    of narrow spots along straight lines alone, with 5 % less light by mirrors, and with 19 million lines of sight where
    rtol is that of the brightest pixel before any is met.
    """
    seen = np.array([0.4, 1.4 * SIDE, FOCUS])
    mirrors, where = [pane(80, PERFECT, tilt=45, size=20)], mirrored(seen, 80, 45)
    if bounces == 2:  # the second one, beside the axis, sends the light on along it
        turned = mi.ScalarTransform4f().translate([40, 0, 80]).rotate([0, 1, 0], -45).scale(20)
        mirrors.append({"type": "rectangle", "to_world": turned, "bsdf": PERFECT})
        normal = np.array([-1, 0, 1]) / np.sqrt(2)
        where -= 2 * (where - [40, 0, 80]) @ normal * normal
    towards = mi.ScalarTransform4f().look_at(origin=(where * 0.9).tolist(), target=[0, 0, 0], up=[0, 1, 0])
    plate = {"type": "rectangle", "to_world": towards.scale(2.0), "bsdf": {"type": "diffuse"}}
    tiny = {"type": "sphere", "center": where.tolist(), "radius": 0.1}
    around = (16, 11, 8, 8)
    direct = fspt.render(camera_scene({**tiny, "center": seen.tolist()}, crop=around), rtol=1e-2)
    image = fspt.render(camera_scene(tiny, bodies=(*mirrors, plate), crop=around), rtol=4e-3)
    assert direct.power.max() > 0
    assert image.metadata["nodes"] < 3e6
    assert (abs(image.power - direct.power) <= image.error + direct.error).all()
    assert image.error.max() < 0.5 * direct.power.max()


@pytest.mark.parametrize("crop", [(4, 4, 22, 18), (12, 8, 14, 14)], ids=["None", "crop1"])
def test_narrow_light_in_a_curved_mirror_is_in_the_error(crop):
    """A sphere of 0.02 mm beside a convex mirror that shows it; a crop window does not contain its straight image."""
    tiny = {"type": "sphere", "center": [10.0, 7.0, 150.0], "radius": 0.02}
    ball = {"type": "sphere", "center": [0.0, 0.0, FOCUS], "radius": 9.0, "bsdf": PERFECT}
    image = fspt.render(camera_scene(tiny, bodies=(ball,), crop=crop), rtol=1e-2, max_nodes=1 << 14)
    middle = np.s_[-14:, -14:]  # the second of the windows
    assert (image.power + image.error)[middle].sum() > 3e-7  # the light in the ball, by a film twice as fine


def test_the_surface_form_goes_through_panes_alone():
    scene = camera_scene(sphere(150, 9), bodies=(pane(80, PANE),), crop=(9, 7, 6, 6))
    pupil, surface = (fspt.render(scene, rtol=2e-2, domain=domain) for domain in ("pupil", "surface"))
    assert abs(pupil.power - surface.power).max() <= 2e-2 * pupil.power.max()
    assert pupil.power.sum() == pytest.approx(surface.power.sum(), rel=2e-3)
    with pytest.raises(SceneError, match=r"'domain' = surface .* Set it to pupil"):
        fspt.render(camera_scene(sphere(150, 9), bodies=(pane(200, PERFECT),)), domain="surface")


def test_a_scene_without_specular_shapes_ends_lines_of_sight_at_the_first_surface():
    scene = camera_scene(sphere(150, 9), bodies=(pane(80, {"type": "diffuse"}, size=3.0),), crop=(8, 14, 4, 2))
    image, other = (fspt.render(scene, shortcuts=shortcuts, rtol=6e-3) for shortcuts in (True, False))
    assert "lines of sight beyond the first surface: left out" in image.metadata["left_out"]
    assert abs(image.power - other.power).max() <= 6e-3 * image.power.max()


def test_panes_merged_by_mitsuba_are_not_passed_by():
    """Merged rectangles have no bounding box; lines of sight began behind them, and the phantom shone through."""
    plates = {f"p{k}": pane(100 + k, {"type": "diffuse", "reflectance": 0.0}, size=5.0, x=7.0 * k) for k in range(2)}
    crop = (10, 14, 14, 1)  # from limb to limb, with both plates
    scene = camera_scene(sphere(150, 9), bodies=tuple(plates.values()), crop=crop)
    parts = {"type": "scene", "s": sphere(150, 9) | {"emitter": glow(1.0)}, **plates}
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "luminance"}
    lens = {"type": "fspt_lens", "focal_length": 55.0, "f_number": 2.8, "pixel_pitch": 0.4, "magnification": 0.5}
    merged = mi.load_dict(parts | {"sensor": lens | {"film": film}})
    look_at_crop(merged, *crop)
    assert len(merged.shapes()) < len(scene.shapes())
    seen, due = power(merged, rtol=2e-2), power(scene, rtol=2e-2)
    assert abs(seen - due).max() < 2e-2 * due.max()


def test_a_lens_in_a_glass_chamber_is_not_inside_the_phantom():
    chamber = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(60), "bsdf": {"type": "thindielectric"}}
    assert power(camera_scene(sphere(150, 9), bodies=(chamber,), crop=(18, 14, 2, 2)), rtol=1e-1).max() > 0


def test_monte_carlo_gets_the_depth_that_it_needs():
    window = camera_scene(sphere(150, 9), bodies=(pane(80, PANE),))
    assert fspt.render(window, method="path", spp=16).power.max() > 0
    with pytest.raises(SceneError, match=r"ptracer cannot connect .* Give method path"):
        fspt.render(window, method="ptracer")
    for depth in (0, 1.5, True):
        with pytest.raises(SceneError, match="'max_depth'"):
            fspt.render(window, method="path", max_depth=depth)
    with pytest.raises(SceneError, match="'max_depth' = 3 has no meaning"):
        fspt.render(window, max_depth=3)
    with pytest.raises(SceneError, match=r"'max_specular' must be in 0 … 64"):
        fspt.render(window, max_specular=65)
