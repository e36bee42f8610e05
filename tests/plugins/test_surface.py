"""`fspt_surface` as an emitter: what is sampled, its density and its radiance tell one story, the true J_n.

The reference of each case is its formula for J_n and for the power of patches, in NumPy; no function of the plugin.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.stats
import trimesh

from mitsuba_fspt.runtime import backend

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from small_scenes import attribute, ball, glow, lens, world_scene, write_ply  # noqa: E402

import mitsuba_fspt as fspt  # noqa: E402
from mitsuba_fspt.emission.elements import UNIFORM_SHARE  # noqa: E402
from mitsuba_fspt.emission.of_emitter import probe_beside  # noqa: E402
from mitsuba_fspt.runtime.errors import SceneError  # noqa: E402

COUNT = 1 << 16
PLACE = mi.ScalarTransform4f().translate([3, -2, 5]).rotate([2 / 3, -1 / 3, 2 / 3], 40)


@dataclass
class Case:
    """A glowing shape and its truth, in the frame before `PLACE`.

    `exitance` J_n of points (n, 3); `bin_of` the number of the patch they lie on; `power`, `area` of each patch.
    """

    scene: Any
    exitance: Callable
    bin_of: Callable
    power: np.ndarray
    area: np.ndarray

    @property
    def emitter(self):
        return self.scene.emitters()[0]

    @property
    def shape(self):
        return self.scene.shapes()[0]


# --- the cases ---


def plastic(shape, exitance, scale=(1, 1, 1), **settings):
    """Scene of one shape at `PLACE`."""
    place = {"to_world": PLACE @ mi.ScalarTransform4f().scale(list(scale))}
    return world_scene({"type": shape, **place, **settings, "emitter": glow(exitance)})


def pebble(per, value_of, folder):
    """A convex mesh of 80 faces with J_n = value_of(point) on vertices, or on faces, of which half may be dark."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.apply_scale([4, 3, 2])
    values = value_of(mesh.vertices if per == "vertex" else mesh.triangles_center)
    path = write_ply(folder / f"{per}.ply", mesh.vertices, mesh.faces, **{per: values})
    scene = plastic("ply", attribute(f"{per}_exitance"), filename=str(path), face_normals=True)
    height = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center)

    def bin_of(p):
        return np.argmax(p @ mesh.face_normals.T - height, axis=1)

    of_face = values[mesh.faces].mean(axis=1) if per == "vertex" else values
    exitance = value_of if per == "vertex" else lambda p: values[bin_of(p)]
    return Case(scene, exitance, bin_of, of_face * mesh.area_faces, mesh.area_faces)


def two_triangles(folder):
    """A rectangle of two triangles whose J_n rises from 0 to 8e-3 along x: all within two faces."""
    vertices = [(-2, -1, 0), (2, -1, 0), (2, 1, 0), (-2, 1, 0)]
    path = write_ply(folder / "two.ply", vertices, [(0, 1, 2), (0, 2, 3)], vertex=[0, 8e-3, 8e-3, 0])
    scene = plastic("ply", attribute(), filename=str(path), face_normals=True)
    middle = (np.arange(8) - 3.5) / 2
    values = np.repeat(8e-3 * (middle + 2) / 4, 4)
    return Case(
        scene,
        lambda p: 8e-3 * (p[:, 0] + 2) / 4,
        lambda p: cells((p[:, 0] + 2) / 4, 8, (p[:, 1] + 1) / 2, 4),
        values * 0.25,
        np.full(32, 0.25),
    )


def rectangle(folder):
    scene = plastic("rectangle", 2e-3, scale=(2, 3, 1))
    area = np.full(24, 24 / 24)
    return Case(scene, uniform(2e-3), lambda p: cells((p[:, 0] + 2) / 4, 4, (p[:, 1] + 3) / 6, 6), 2e-3 * area, area)


def disk(folder):
    scene = plastic("disk", 2e-3, scale=(2, 2, 1))
    area = np.full(32, 4 * np.pi / 32)
    return Case(
        scene, uniform(2e-3), lambda p: cells((p[:, 0] ** 2 + p[:, 1] ** 2) / 4, 4, turn(p), 8), 2e-3 * area, area
    )


def cylinder(folder):
    scene = plastic("cylinder", 2e-3, p0=[0, 0, -3], p1=[0, 0, 3], radius=1.5)
    area = np.full(32, 2 * np.pi * 1.5 * 6 / 32)
    return Case(scene, uniform(2e-3), lambda p: cells((p[:, 2] + 3) / 6, 4, turn(p), 8), 2e-3 * area, area)


def sphere(folder):
    scene = plastic("sphere", 3.5, radius=3.0)
    area = np.full(48, 4 * np.pi * 9 / 48)
    return Case(scene, uniform(3.5), lambda p: cells((p[:, 2] + 3) / 6, 6, turn(p), 8), 3.5 * area, area)


def bitmap(folder):
    """A sphere under a raw picture of 4 × 4 texels, row 0 at the north pole, one texel dark, others far above 1.

    Powers of two, so that no element of the surface lies on two texels.
    """
    texels = np.array([[5, 1, 0, 2], [40, 3, 7, 1], [2, 2, 0.5, 9], [1, 2, 3, 4]], np.float32)
    mi.Bitmap(texels[..., None]).write(str(folder / "texels.exr"))
    picture = {"type": "bitmap", "filename": str(folder / "texels.exr"), "raw": True, "filter_type": "nearest"}
    scene = plastic("sphere", picture, radius=3.0)
    rows = 2 * np.pi * 9 * -np.diff(np.cos(np.linspace(0, np.pi, 5)))
    area = np.repeat(rows / 4, 4)

    def bin_of(p):
        return cells(np.arccos(np.clip(p[:, 2] / 3, -1, 1)) / np.pi, 4, turn(p), 4)

    return Case(scene, lambda p: texels.ravel()[bin_of(p)], bin_of, texels.ravel() * area, area)


def uniform(value):
    return lambda p: np.full(len(p), value)


def turn(p):
    """Longitude as a share of the full turn, in [0, 1)."""
    return np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) % 1


def cells(a, rows, b, columns):
    """Number of the cell of a rows × columns grid that holds (a, b) of [0, 1]²."""
    row = np.clip((a * rows).astype(int), 0, rows - 1)
    return row * columns + np.clip((b * columns).astype(int), 0, columns - 1)


def rising(p):
    return 1e-3 * (2 + p[:, 0] / 4 + p[:, 2] / 3)


def half_dark(p):
    return np.where(p[:, 2] > 0, 1e-3 * (1 + p[:, 2]), 0)


CASES = {
    "vertex attribute": lambda folder: pebble("vertex", rising, folder),
    "face attribute": lambda folder: pebble("face", rising, folder),
    "dark half": lambda folder: pebble("face", half_dark, folder),
    "two triangles": two_triangles,
    "rectangle": rectangle,
    "disk": disk,
    "cylinder": cylinder,
    "sphere": sphere,
    "bitmap": bitmap,
}


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory):
    return CASES[request.param](tmp_path_factory.mktemp("surface"))


# --- helpers ---


def uniform_numbers(seed, count=COUNT):
    """Four rows of uniform numbers of Mitsuba's type."""
    return [mi.Float(row) for row in np.random.default_rng(seed).random((4, count), np.float32)]


def local(p):
    """World points of Dr.Jit as (n, 3) before `PLACE`."""
    return (mi.Transform4f(PLACE).inverse() @ mi.Point3f(p)).numpy().T.astype(float)


def viewpoints():
    """Points all around the shape, 9 to 30 mm from it."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(3, COUNT))
    it = dr.zeros(mi.Interaction3f, COUNT)
    p = direction / np.linalg.norm(direction, axis=0) * rng.uniform(9, 30, COUNT)
    it.p = mi.Transform4f(PLACE) @ mi.Point3f(p.astype(np.float32))
    return it


def assert_mostly_close(actual, desired, rtol, strays=1e-3):
    """Equal but for the few points on the border of two elements, whose density may be either's."""
    actual, desired = np.asarray(actual), np.asarray(desired)
    off = np.abs(actual - desired) > rtol * np.abs(desired)
    assert off.mean() <= strays, f"{off.sum()} of {len(off)}: {actual[off][:4]} instead of {desired[off][:4]}"


# --- identities ---


def test_radiance_is_exitance_over_pi_outward_and_nothing_inward(case):
    """Seen to fail without 1/π, and with the two sides swapped."""
    u = uniform_numbers(1)
    ps, _ = case.emitter.sample_position(0.0, mi.Point2f(u[0], u[1]))
    # One normal a point: at rays that share the one of a disk Dr.Jit 1.5 aborts, with Mitsuba's own emitters too.
    n = mi.Vector3f(np.broadcast_to(ps.n.numpy(), (3, COUNT)))
    outward, inward = mi.Ray3f(ps.p + n, -n), mi.Ray3f(ps.p - 1e-2 * n, n)
    seen = [case.scene.ray_intersect(ray) for ray in (outward, inward)]
    radiance = [case.emitter.eval(si)[0].numpy() for si in seen]
    assert_mostly_close(radiance[0], case.exitance(local(seen[0].p)) / np.pi, 1e-3)
    assert np.all(radiance[1] == 0)


def test_rays_carry_the_total_power(case):
    """Seen to fail without the density's 1/pdf and without π."""
    u = uniform_numbers(2)
    _, weight = case.emitter.sample_ray(0.0, u[0], mi.Point2f(u[1], u[2]), mi.Point2f(u[3], u[0]))
    weight = weight[0].numpy().astype(float)
    # Half a percent: the elements of the bitmap and of the mesh are lit evenly to that, so little scatters.
    assert weight.mean() == pytest.approx(case.power.sum(), rel=5e-3)
    assert weight.std() < 0.1 * case.power.sum()


def test_rays_leave_the_surface_outward_by_the_cosine_law(case):
    u = uniform_numbers(3)
    ray, _ = case.emitter.sample_ray(0.0, u[0], mi.Point2f(u[1], u[2]), mi.Point2f(u[3], u[0]))
    back = case.scene.ray_intersect(mi.Ray3f(ray.o + 1e-2 * ray.d, -ray.d))
    assert back.is_valid().numpy().mean() > 0.999
    cosine = dr.dot(back.n, ray.d).numpy()[back.is_valid().numpy()]
    assert cosine.min() > 0
    assert scipy.stats.kstest(cosine**2, "uniform").pvalue > 1e-3  # cos²θ of Lambert's law is uniform


def test_eval_integrates_to_the_total_power(case):
    """∫ L cosθ dA dΩ = ∫ J_n dA, by parallel rays from all around; the flat shapes shine to one side only."""
    sides, grid = 96, 96
    height = (2 * np.arange(sides) + 1) / sides - 1
    angle = np.arange(sides) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    d = np.repeat(np.stack([ring * np.cos(angle), ring * np.sin(angle), height]), grid * grid, axis=1)
    step = ((np.arange(grid) + 0.5) / grid - 0.5) * 10
    x, y = (np.tile(a.ravel(), sides) for a in np.meshgrid(step, step))
    frame = mi.Frame3f(mi.Vector3f(d.astype(np.float32)))
    origin = mi.Point3f(frame.to_world(mi.Vector3f(mi.Float(x), mi.Float(y), 20)))
    rays = mi.Transform4f(PLACE) @ mi.Ray3f(origin, -frame.n)
    si = case.scene.ray_intersect(rays)
    radiance = dr.select(si.is_valid(), si.emitter(case.scene).eval(si)[0], 0).numpy().astype(float)
    power = radiance.mean() * 100 * 4 * np.pi
    assert power == pytest.approx(case.power.sum(), rel=1e-2)


def test_positions_lie_on_the_patches_in_proportion_to_their_power(case):
    """χ² against ∫ J_n dA of the patches, with the small share that goes everywhere alike."""
    u = uniform_numbers(4)
    ps, _ = case.emitter.sample_position(0.0, mi.Point2f(u[0], u[1]))
    counts = np.bincount(case.bin_of(local(ps.p)), minlength=len(case.power))
    share = case.power / case.power.sum() + UNIFORM_SHARE * case.area / case.area.sum()
    expected = COUNT * share / share.sum()
    assert scipy.stats.chisquare(counts, expected).pvalue > 1e-3


@pytest.mark.parametrize(
    ("exitance", "what"),
    [
        ({"type": "rgb", "value": [1, 0, 0]}, "a colour (1, 0, 0)"),
        ({"type": "rgb", "value": 0.5}, "a colour (0.5, 0.5, 0.5)"),
        ({"type": "spectrum", "value": [(400, 1), (700, 2)]}, "a spectrum"),
    ],
)
def test_colours_and_spectra_of_a_dictionary_are_refused(exitance, what):
    """Seen to fail: monochrome variants took the luminance 0.213 of red for J_n in W/mm²."""
    with pytest.raises(RuntimeError) as caught:
        world_scene(ball() | {"emitter": glow(exitance)})
    assert f"ExitanceError: fspt_surface: 'exitance' is {what}, J_n is one number. Give W/mm²" in str(caught.value)
    del caught  # the traceback holds the emitter, which later kernels would record
    gc.collect()
    assert world_scene(ball() | {"emitter": glow({"type": "uniform", "value": 2.0})}).emitters()


@pytest.mark.parametrize(
    ("exitance", "message"),
    [
        ({"type": "d65"}, "'exitance' of an fspt_surface is a colour"),
        ({"type": "checkerboard", "color0": {"type": "rgb", "value": [1, 0, 0]}}, "'color0' of an fspt_surface is a c"),
        ({"type": "checkerboard", "color1": {"type": "d65"}}, "'color1' of an fspt_surface is a colour"),
        ({"type": "blackbody", "temperature": 5000.0}, "'exitance' of an fspt_surface is a spectrum"),
    ],
)
def test_load_refuses_what_the_variant_would_turn_into_a_number(exitance, message):
    """Seen to fail: `d65` and colours within a texture rendered, `d65` as 1 W/mm²."""
    scene = {"type": "scene", "camera": lens(), "ball": ball() | {"emitter": glow(exitance)}}
    with pytest.raises(SceneError, match=f"dictionary: {message}"):
        fspt.load(scene)


def test_new_exitance_leaves_the_probe_in_its_place_and_a_new_shape_does_not(tmp_path):
    """On CUDA one that was set up beside the scene would be lost, and light with it."""
    path = write_ply(tmp_path / "one.ply", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    scene = plastic("ply", 1e-3, filename=str(path))
    surface = scene.emitters()[0].surface
    surface.trace_beside(scene)
    probe = surface._probe
    parameters = mi.traverse(scene)
    exitance = next(name for name in parameters.keys() if "exitance" in name)
    positions = next(name for name in parameters.keys() if name.endswith("vertex_positions"))
    parameters[exitance] = 2 * parameters[exitance]
    parameters.update()
    assert probe is not None
    assert surface._probe is probe
    parameters[positions] = 2 * parameters[positions]
    parameters.update()
    assert surface._probe is None


def test_position_density_and_weight(case):
    u = uniform_numbers(6)
    ps, weight = case.emitter.sample_position(0.25, mi.Point2f(u[0], u[1]))
    pdf = ps.pdf.numpy()
    assert pdf.min() > 0
    np.testing.assert_allclose(weight.numpy() * pdf, 1, rtol=1e-5)
    assert_mostly_close(case.emitter.pdf_position(ps).numpy(), pdf, 1e-3)
    case.emitter.surface.trace_beside(case.scene)
    assert_mostly_close(case.emitter.pdf_position(ps).numpy(), pdf, 1e-3)
    assert np.all(ps.time.numpy() == 0.25)
    share = case.exitance(local(ps.p)) / case.power.sum() + UNIFORM_SHARE / case.area.sum()
    assert_mostly_close(pdf, share / (1 + UNIFORM_SHARE), 2e-2, strays=2e-2)


def test_direction_density_weight_and_radiance_agree(case):
    """weight · pdf = eval_direction and pdf = pdf_direction; seen to fail without cosθ in the density."""
    it, u = viewpoints(), uniform_numbers(7)
    ds, weight = case.emitter.sample_direction(it, mi.Point2f(u[0], u[1]))
    weight, pdf = weight[0].numpy(), ds.pdf.numpy()
    front = dr.dot(ds.d, ds.n).numpy() < 0
    assert 0.2 < front.mean() < 1
    assert np.all(pdf[front] > 0)
    assert np.all(pdf[~front] == 0)
    assert np.all(weight[~front] == 0)
    assert_mostly_close(case.emitter.eval_direction(it, ds)[0].numpy(), weight * pdf, 1e-3)
    assert_mostly_close(case.emitter.pdf_direction(it, ds).numpy(), pdf, 1e-3)
    assert_mostly_close(weight * pdf, front * case.exitance(local(ds.p)) / np.pi, 1e-3)
    np.testing.assert_allclose((it.p + ds.dist * ds.d).numpy(), ds.p.numpy(), atol=1e-4)


# Flat ones: where a surface turns away from view the density grows without bound, and it is Mitsuba's quadrature of
# the density that fails then.
@pytest.mark.parametrize("name", ["two triangles", "rectangle", "disk"])
def test_directions_follow_their_density(name, tmp_path):
    """Mitsuba's own χ² test over the sphere of directions."""
    case = CASES[name](tmp_path)
    probe_beside(case.scene)
    it = mi.Interaction3f(0.0, 0.0, mi.Color0f(), mi.Transform4f(PLACE) @ mi.Point3f(0.5, 0.3, 2.5))

    def sample(sample):
        ds, _ = case.emitter.sample_direction(it, sample)
        return ds.d, dr.select(ds.pdf > 0, 1.0, 0.0)

    def density(d):
        si = case.scene.ray_intersect(mi.Ray3f(it.p, d))
        ds = mi.DirectionSample3f(case.scene, si, it)
        return dr.select(si.is_valid(), case.emitter.pdf_direction(it, ds, si.is_valid()), 0)

    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=density,
        sample_dim=2,
        sample_count=50_000,
        res=31,
        ires=64,
    )
    assert test.run(significance_level=1e-3), test.messages


def test_the_scene_samples_it_like_any_emitter(case):
    """Through Mitsuba's scene: the irradiance at a point by sampling directions is that by tracing rays at random."""
    scene, u = case.scene, uniform_numbers(8)
    it = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    it.p = mi.Transform4f(PLACE) @ mi.Point3f(1, 2, 9)
    _, weight = scene.sample_emitter_direction(it, mi.Point2f(u[0], u[1]), test_visibility=True)
    by_emitter = weight[0].numpy().astype(float)
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[2], u[3]))
    si = scene.ray_intersect(mi.Ray3f(it.p, d))
    by_rays = 4 * np.pi * si.emitter(scene).eval(si)[0].numpy().astype(float)
    error = np.hypot(by_emitter.std(), by_rays.std()) / np.sqrt(COUNT)
    assert abs(by_emitter.mean() - by_rays.mean()) < 4 * error
    assert error < 0.15 * by_rays.mean()


# --- J_n as scenes give it ---


def test_exitance_far_above_one_passes_unscaled():
    """A reflectance would be refused or cut above 1."""
    scene = world_scene({"type": "sphere", "radius": 3.0, "emitter": glow(4e7)})
    si = scene.ray_intersect(mi.Ray3f([0, 0, 9], [0, 0, -1]))
    assert scene.emitters()[0].eval(si)[0].numpy() == pytest.approx(4e7 / np.pi, rel=1e-6)


def test_a_scaled_attribute_is_scaled(tmp_path):
    path = write_ply(tmp_path / "a.ply", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], vertex=[1, 1, 1])
    shape = {"type": "ply", "filename": str(path), "emitter": glow(attribute(scale=3.0))}
    emitter = (scene := world_scene(shape)).emitters()[0]
    _, weight = emitter.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.4), mi.Point2f(0.2, 0.1))
    assert weight[0].numpy() == pytest.approx(3 * 0.5, rel=1e-4)
    assert len(scene.shapes()) == 1


def test_equal_emitters_stand_on_both_their_shapes():
    """`mi.load_dict` merges equal plugins; two shapes that glow alike must keep an emitter each."""
    shapes = [{"type": "sphere", "center": [0, 0, z], "emitter": glow(1e-3)} for z in (-2, 2)]
    scene = world_scene(*shapes)
    assert [emitter.get_shape() is not None for emitter in scene.emitters()] == [True, True]
    assert {float(emitter.get_shape().bbox().min.z) for emitter in scene.emitters()} == {-3.0, 1.0}


def test_the_power_is_differentiable_in_the_exitance():
    """d(power)/dJ_n = area, through the emitter's rays."""
    scene = world_scene({"type": "rectangle", "emitter": glow(2e-3)})
    parameters = mi.traverse(scene)
    key = "shape_0.emitter.exitance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    u = uniform_numbers(9, 1024)
    _, weight = scene.emitters()[0].sample_ray(0.0, u[0], mi.Point2f(u[1], u[2]), mi.Point2f(u[3], u[0]))
    dr.backward(dr.mean(weight[0]))
    assert dr.grad(parameters[key]).numpy() == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_slivers_without_surface_points_have_no_effect(domain, tmp_path):
    """Seen to fail, refused, with every NaN between vertices taken for bad data."""
    square = [(0, -5, -5), (0, 5, -5), (0, 5, 5), (0, -5, 5), (0, 0, 5), (0, 1e-15, 0), (0, 0, 0)]
    faces = [(0, 1, 2), (0, 2, 3)]

    def power(faces):
        mesh = {"type": "ply", "filename": str(write_ply(tmp_path / "sheet.ply", square, faces, vertex=[1e-3] * 7))}
        scene = world_scene(
            mesh | {"emitter": glow(attribute())}, integrator={"type": "fspt_integral", "domain": domain}
        )
        return np.array(mi.render(scene))

    assert power([*faces, (4, 5, 6)]) == pytest.approx(power(faces), rel=1e-3, abs=0)


@pytest.mark.parametrize("integrator", ["fspt_integral", "path", "ptracer"])
def test_a_rendered_scene_can_be_freed_and_keeps_its_names(integrator, tmp_path):
    """Each scene once stayed in memory for good after its first image, and its shapes were renamed."""
    vertices = [(0, -3, -3), (0, 3, -3), (0, 3, 3), (0, -3, 3)]
    path = write_ply(tmp_path / "sheet.ply", vertices, [(0, 1, 2), (0, 2, 3)], vertex=[1, 2, 3, 4])
    gc.collect()
    kept = sum(type(thing).__name__ == "FsptSurface" for thing in gc.get_objects())
    depth = {} if integrator == "fspt_integral" else {"max_depth": 1}
    scene = world_scene(
        {"type": "ply", "filename": str(path), "emitter": glow(attribute())}, integrator={"type": integrator, **depth}
    )
    image = mi.render(scene, spp=4)
    assert image.numpy().max() > 0
    assert [shape.id() for shape in scene.shapes()] == ["shape_0"]
    del scene, image
    gc.collect()
    assert sum(type(thing).__name__ == "FsptSurface" for thing in gc.get_objects()) == kept


def test_an_integrator_of_its_own_keeps_no_emitter(tmp_path):
    """Rationale: an emitter that outlives its shape is recorded with the next scene's, and the process ended."""
    vertices = [(0, -3, -3), (0, 3, -3), (0, 3, 3), (0, -3, 3)]
    path = write_ply(tmp_path / "sheet.ply", vertices, [(0, 1, 2), (0, 2, 3)], vertex=[1, 2, 3, 4])
    integrator = mi.load_dict({"type": "fspt_integral", "rtol": 1e-2})
    gc.collect()
    kept = sum(type(thing).__name__ == "FsptSurface" for thing in gc.get_objects())
    for shape in ({"type": "ply", "filename": str(path), "emitter": glow(attribute())}, ball()):
        scene = world_scene(shape)
        assert integrator.solve(scene, scene.sensors()[0]).power.max() > 0
        del scene
        gc.collect()
        assert sum(type(thing).__name__ == "FsptSurface" for thing in gc.get_objects()) == kept


@pytest.mark.parametrize(("kind", "scale"), [("sphere", (3, 3, 6)), ("cylinder", (3, 3.01, 3))])
def test_round_shapes_that_are_stretched_are_refused(kind, scale):
    """Rationale: Mitsuba traces them round, its parameters are stretched; methods disagreed by a factor of two."""
    import mitsuba_fspt as fspt

    place = mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale(scale)
    scene = world_scene({"type": kind, "to_world": place, "emitter": glow()})
    with pytest.raises(SceneError, match=rf"'to_world' of {kind} .* stretches or shears it.* Give a rotation \(about"):
        fspt.render(scene)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk"])
def test_a_rotation_about_an_axis_not_of_length_1_is_refused(kind):
    """Rationale: its inverse in Mitsuba is none; a disk was traced a fifth smaller than its parameters say."""
    import mitsuba_fspt as fspt

    place = mi.ScalarTransform4f().rotate([1, 0.5, 0], 40).scale(3)
    scene = world_scene({"type": kind, "to_world": place, "emitter": glow()})
    with pytest.raises(SceneError, match=r"Give (every rotation an axis|a rotation \(about an axis) of length 1"):
        fspt.render(scene)


def test_a_disk_may_be_an_ellipse():
    import mitsuba_fspt as fspt

    place = mi.ScalarTransform4f().rotate([0.48, 0.64, 0.6], 30).rotate([0, 1, 0], 90).scale([1e-2, 10, 1])
    assert fspt.render(world_scene({"type": "disk", "to_world": place, "emitter": glow()})).power.max() > 0


def test_a_cylinder_may_be_as_long_as_it_likes():
    import mitsuba_fspt as fspt

    place = mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 30).scale([1, 1, 9])
    assert fspt.render(world_scene({"type": "cylinder", "to_world": place, "emitter": glow()})).power.max() > 0


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk", "rectangle", "cube"])
def test_corners_of_all_elements_are_found(kind):
    """Seen to fail for a third of a disk's rim, which a ray to where it should be missed by rounding."""
    import drjit as dr

    from mitsuba_fspt.emission.elements import elements_of

    place = mi.ScalarTransform4f().translate([7, -3, 165]).rotate([0, 1, 0], 210).scale(6)
    shape = mi.load_dict({"type": kind, "to_world": place})
    elements = elements_of(shape)
    for corner in elements.corners:
        si, area = elements.place(dr.arange(mi.UInt32, elements.count), mi.Point2f(*corner))
        assert dr.all(si.is_valid() & dr.isfinite(area))
        assert float(dr.max(dr.norm(si.p - mi.Point3f(7, -3, 165)))[0]) < 6 * np.sqrt(3) + 1e-4


@pytest.mark.parametrize(("kind", "angle"), [("sphere", 90), ("cylinder", 90), ("cylinder", 180)])
def test_elements_of_turned_shapes_lie_where_their_parameters_say(kind, angle):
    """Rationale: shapes turned by 90° do not find some of their own points when asked for them by (u, v).

    Expected: every element's own (u, v), and light tracing that brings all power. Seen to fail with Mitsuba's answer.
    """
    import drjit as dr

    import mitsuba_fspt as fspt
    from mitsuba_fspt.emission.elements import ParameterElements

    shape = {"type": kind, "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], angle).scale(5), "emitter": glow()}
    scene = world_scene(shape)
    elements = ParameterElements(scene.shapes()[0], 10_000)
    number = np.arange(elements.count)
    si, _ = elements.place(dr.arange(mi.UInt32, elements.count), mi.Point2f(0.3, 0.6))
    u, v = (number % elements.side + 0.3) / elements.side, (number // elements.side + 0.6) / elements.side
    np.testing.assert_allclose(si.uv.numpy(), [u, v], atol=1e-5)
    traced, integral = fspt.render(scene, method="ptracer", spp=128, seed=1), fspt.render(scene, rtol=1e-3)
    noise = np.sqrt((traced.error**2).sum())
    assert traced.power.sum() == pytest.approx(integral.power.sum(), abs=4 * noise + 1e-3 * integral.power.sum())
