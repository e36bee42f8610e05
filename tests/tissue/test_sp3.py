"""The SP3 equations: against transport, exact series, published formulas and photons one by one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from closed_forms import coupled_ball_exitance
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq
from test_diffusion import ball_mesh, circle

from mitsuba_fspt.optics.absorbing_border import absorbing, matched
from mitsuba_fspt.optics.half_space import border, diffusing, half_space, operator
from mitsuba_fspt.optics.hemisphere import hemisphere
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.optics.sp3_boundary import (
    LAYER,
    curvature_effect,
    marshak_boundary,
    shortened,
    sp3_boundary,
)
from mitsuba_fspt.runtime.errors import FluxError
from mitsuba_fspt.tissue import diffusion
from mitsuba_fspt.tissue.border_curvature import BorderShape
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.free_field import FreeField, SourceField
from mitsuba_fspt.tissue.light_models import equations
from mitsuba_fspt.tissue.tetrahedra import Tetrahedra

pytest.importorskip("skfem")

Array = NDArray[np.float64]
solve = partial(diffusion.solve, model="sp3")
NYLON = Medium(0.0138, 0.91, 1.37)
POINT = Source(Sphere((8.0, 0.0, 0.0)))
RINGS = (0, 12, 36, 60, 96, 132, 180)  # degrees
# W of 1 W through the rings, by g: standard errors of 0.06 to 0.2 %, for 0.9 of 0.1 to 0.4 %.
PHOTONS = {
    0.0: (0.054633, 0.201827, 0.118485, 0.071465, 0.023479, 0.007475),
    0.9: (0.051991, 0.198397, 0.119903, 0.070980, 0.023291, 0.007455),
}


def transport_fluence(mua: float, musp: float, r: float) -> float:
    """Fluence [1/mm²] at r of a point source of 1 W in endless tissue with isotropic scattering, exactly.

    The pole and the cut of the Fourier transform A/(1 - µs' A), A = arctan(k/µt)/k.
    """
    total = mua + musp
    kappa = brentq(lambda x: musp / x * math.atanh(x / total) - 1, 1e-6, total * (1 - 1e-13))
    slope = total / (kappa * (total**2 - kappa**2)) - math.atanh(kappa / total) / kappa**2
    pole = 2 * math.atanh(kappa / total) / (musp * slope) * math.exp(-kappa * r)

    def cut(t: float) -> float:
        inner = (math.log((t + total) / (t - total)) / 2 + 0.5j * math.pi) / t
        return float(2 / math.pi * t * math.exp(-t * r) * (inner / (1 - musp * inner)).imag)

    near, far = quad(cut, total, 1.001 * total)[0], quad(cut, 1.001 * total, total + 60, limit=500)[0]
    return float((pole + near + far) / (4 * math.pi * r))


@pytest.mark.parametrize(
    ("mua", "musp", "bound"), [(0.0138, 0.91, 1.4e-3), (0.03, 1.1, 2.0e-3), (0.1, 1.0, 6e-3)], ids=str
)
def test_endless_tissue(mua: float, musp: float, bound: float) -> None:
    """Rationale: the fluence 3 … 8 mm from a point source is that of transport, where diffusion is 1.2 to 8 % off.

    Seen to fail with φ_1 alone as the fluence, and with 1/5 for 1/7.
    """
    r = np.linspace(3, 8, 6)
    points = np.column_stack([r, 0 * r, 0 * r])
    exact = np.array([transport_fluence(mua, musp, one) for one in r])
    errors = {}
    for model in ("sp3", "diffusion"):
        found = equations(model, [Medium(mua, musp)])
        field = SourceField.of(found, 0, np.zeros((1, 3)), np.zeros(1), np.ones(1))
        errors[model] = np.abs(found.source @ field.components(points) / exact - 1).max()
    assert errors["sp3"] < bound
    assert errors["diffusion"] > 4 * errors["sp3"]


def moment(power: int, n: float) -> float:
    """∫ R(µ) µ^power dµ over (0, 1) for Fresnel's unpolarised reflectance from the index n into 1."""
    critical = math.sqrt(1 - 1 / n**2)

    def reflectance(cosine: float) -> float:
        outer = math.sqrt(1 - n**2 * (1 - cosine**2))
        s, p = (n * cosine - outer) / (n * cosine + outer), (n * outer - cosine) / (n * outer + cosine)
        return (s * s + p * p) / 2

    return quad(lambda c: reflectance(c) * c**power, critical + 1e-15, 1, epsabs=1e-12)[0] + critical ** (power + 1) / (
        power + 1
    )


@pytest.mark.parametrize("n", [1.1, 1.37, 1.5])
def test_moments_of_klose_and_larsen(n: float) -> None:
    """Rationale: Marshak's condition has the coefficients A … D of Klose and Larsen (2006), eqs. (27) to (30)."""
    r = {k: moment(k, n) for k in range(1, 7)}
    a1, b1, c, d = -r[1], 3 * r[2], -1.5 * r[1] + 2.5 * r[3], 1.5 * r[2] - 2.5 * r[4]
    a2 = -2.25 * r[1] + 7.5 * r[3] - 6.25 * r[5]
    b2 = 15.75 * r[2] - 52.5 * r[4] + 43.75 * r[6]
    flux = np.array([[1 + b1, -7 * d], [-3 * d, 1 + b2]])
    value = np.array([[0.5 + a1, -(1 / 8 + c)], [-(1 / 8 + c), 7 / 24 + a2]])
    np.testing.assert_allclose(flux @ marshak_boundary(n), value, atol=1e-8)


def milne_length(n: float) -> float:
    """Depth outside of the border where the fluence of a half space, continued linearly, is 0, in mean free paths.

    Milne's problem of transport with isotropic scattering, without absorption, and Fresnel's reflectance, by discrete
    ordinates: 0.71045 at n = 1, 1.73855 at n = 1.37.
    """
    cosine, weight, reflectance = hemisphere(n)
    # Sum e and difference o of the radiance at µ and -µ: µ² e'' = e - Σ w e, o = -µ e'. The modes are eigenvectors.
    root = np.sqrt(weight)
    rates, vectors = np.linalg.eigh((np.eye(len(root)) - np.outer(root, root)) / np.outer(cosine, cosine))
    even = vectors[:, 1:] / (root * cosine)[:, None]
    odd = cosine[:, None] * even * np.sqrt(rates[1:])
    # e = z + length far from the border; ψ(µ) = R ψ(-µ) on it for the unknown length and amplitudes of the modes.
    enters = (1 - reflectance)[:, None] * even + (1 + reflectance)[:, None] * odd
    found = np.linalg.solve(np.column_stack([1 - reflectance, enters]), (1 + reflectance) * cosine)
    return float(found[0])


def test_extrapolation_length() -> None:
    """Rationale: Milne's 0.710446 mean free paths; Marshak's SP3 has 0.7051; with a jump of the index, too.

    The SP3 half space without absorption: φ_1 linear, φ_2 decaying with κ = √(35/9).
    """

    def length(border: Array) -> float:
        return float(1 / (3 * (border[0, 0] - border[0, 1] * border[1, 0] / (border[1, 1] + LAYER))))

    assert border(1.0, 0.0).length == pytest.approx(0.710446, abs=2e-6)
    for n in (1.0, 1.2, 1.37, 1.7):
        assert border(n, 0.0).length == pytest.approx(milne_length(n), rel=5e-5)
    assert length(marshak_boundary(1.0)) == pytest.approx(0.7051, abs=1e-4)
    assert length(sp3_boundary(1.37)) == pytest.approx(border(1.37, 0.0).length, rel=1e-12)
    assert length(sp3_boundary(1.37)) == pytest.approx(1.73855, abs=5e-5)
    assert length(marshak_boundary(1.37)) < 0.975 * 1.73855


def test_border_of_a_half_space() -> None:
    """Rationale: exp(ikx ± kz) has no source and no divergence, and solves transport without absorption.

    Without reflection isotropic scattering has J_n of the diffusing light exactly, for every k; with it, light flows
    along the border. The other numbers are those of finer nodes. Seen to fail with the other sign of the flow along the
    border, and with a missing factor 2 of the first mode of the azimuth.
    """
    for k in (0.2, 0.6):
        assert diffusing(1.0, 0.0, k)[1] == pytest.approx(1, abs=1e-4)
        assert diffusing(1.37, 0.0, k)[1] < 1 - 0.25 * k**2
    for n, g in ((1.37, 0.0), (1.37, 0.9)):
        cosine, weight, _ = hemisphere(n, 10)
        both = np.concatenate([cosine, -cosine])
        matrix = operator(both, np.tile(weight, 2), g, 0.4)
        rates = np.linalg.eigvals(-matrix / np.tile(both, len(matrix) // len(both))[:, None])
        np.testing.assert_allclose(np.sort(np.abs(rates))[:2], 0.4, rtol=1e-4)
    known = {0.0: (1.73858, 2.9412, 0.4921, 1.665), 0.9: (1.75709, 1.1998, 0.1989, 0.3194)}
    for g, numbers in known.items():
        found = border(1.37, g)
        assert (found.length, found.lateral, found.flow, found.spread) == pytest.approx(numbers, rel=0.01)


@pytest.mark.parametrize("g", [0.0, 0.9])
def test_border_of_an_absorbing_half_space(g: float) -> None:
    """Rationale: with absorption, too, the diffusing light decays as in endless tissue, by the root of transport.

    H_11 of the equations is the one with which SP3 reflects the share of the diffusing light that transport does, at
    µa/µs' = 0.1 and between, to 3e-4 (0.2 %); τ is the flat one's times its change. Seen to fail with the numbers
    without absorption.
    """
    if g == 0:
        kappa = brentq(lambda x: math.atanh(x) / 1.1 / x - 1, 1e-3, 1 - 1e-12)
        assert half_space(1.37, 0.0, 1e-3, 0.1).rate == pytest.approx(kappa, rel=1e-3)
    numbers, change = border(1.5, g), absorbing(1.5, g)
    for absorption in (0.05, 0.1):
        shift, lateral, *_ = change.at(absorption)
        found = equations("sp3", [Medium(absorption / (1 + absorption), 1 / (1 + absorption), 1.5, g)])
        assert found.border[0, 0, 0] == pytest.approx(sp3_boundary(1.5, g)[0, 0] + shift, rel=1e-12)
        assert found.lateral[0] == pytest.approx(lateral * numbers.lateral / (3 * numbers.length**2), rel=1e-12)
        assert found.border[0, 0, 0] == pytest.approx(matched(1.5, g, absorption, 1e-3)[0], abs=3e-4)


def test_photons_in_absorbing_tissue() -> None:
    """Rationale: exit power of 4e6 photons, 0.08498 ± 0.00007, from a sphere of 8 mm, source 5 mm deep, µa/µs' = 0.1.

    Expected behaviour: the total within 0.5 %, rings of 12° around the source within 1.3 %. Without absorption in the
    numbers of the border the total is 1.4 % too low and the first ring 2.7 %: seen to fail; without it in the effect of
    the curvature alone, 0.9 %: seen to fail.
    """
    photons = np.array([5.3617, 13.3615, 15.9626, 14.3977, 11.2498]) * 1e-3
    solution = solve(ball_mesh(8, 3), [Medium(0.1, 1.0, 1.5)], [Source(Sphere((0.0, 0.0, 3.0)))])
    assert solution.solved.exited == pytest.approx(0.08498, rel=5e-3)
    x, weight = np.polynomial.legendre.leggauss(5)
    bounds = np.cos(np.radians(12.0 * np.arange(6)))
    middle, half = (bounds[:-1] + bounds[1:]) / 2, (bounds[:-1] - bounds[1:]) / 2
    values = solution.exitance_at(8 * circle(1, (middle[:, None] + half[:, None] * x).ravel())).reshape(5, 5)
    np.testing.assert_allclose(2 * np.pi * 64 * half * (values @ weight), photons, rtol=0.013)


def test_order_of_convergence_on_a_sphere() -> None:
    """Rationale: a point source 2 mm off the middle of a sphere is exact by a Legendre series of both components.

    Expected behaviour: the error of J_n falls as edge^1.2 (φ_2 has a layer of half a millimetre at the border), that of
    the exit power as edge^2.5; each with its slope and a ceiling for the finest mesh, 1.5 times what was measured.
    Seen to fail with τ dropped from the matrix, the load or J_n, without the flow along the border or the curvature.
    """
    cosine, medium = np.linspace(-1, 1, 101), Medium(0.03, 1.0, 1.37)
    found = equations("sp3", [medium])
    matrix, numbers, change = sp3_boundary(1.37).copy(), border(1.37, 0.0), absorbing(1.37, 0.0)
    matrix[0, 0] += change.shift * 0.3**2
    z, bend = 1 / (1 / numbers.length + 3 * change.shift * 0.3**2), curvature_effect(1.37, 0.0, 0.03) / 1.03 / 6
    matrix[0, 0] += (1 / (z - bend) - 1 / z) / 3
    tau = numbers.lateral * (1 + 0.3 * change.lateral) / (3 * numbers.length**2 * 1.03**2)
    flow = numbers.flow * (1 + 0.3 * change.flow) / 1.03**2, numbers.spread * (1 + 0.3 * change.spread) / 1.03**2
    series = partial(coupled_ball_exitance, 6, 2, found.diffusion[0], found.reaction[0], found.source, matrix, tau)
    exact, mean = series(cosine, flow=flow), series(np.zeros(1), orders=1)[0]
    assert exact.max() > 2 * exact.min() > 0
    edges, errors = [], []
    for refinements in (1, 2, 3):
        solution = solve(ball_mesh(6, refinements), [medium], [Source(Sphere((0.0, 0.0, 2.0)))])
        difference = solution.exitance_at(circle(6, cosine)) - exact
        power = solution.solved.exited / (4 * np.pi * 36 * mean) - 1
        edges.append(solution.mesh.edge)
        errors.append([np.sqrt((difference**2).mean()) / exact.max(), abs(power)])
    slopes = np.polyfit(np.log(edges), np.log(errors), 1)[0]
    assert slopes[0] > 1.1
    assert slopes[1] > 2
    assert errors[-1][0] < 1.5e-3
    assert errors[-1][1] < 8e-4


@pytest.mark.parametrize(("model", "g"), [("sp3", 0.0), ("sp3", 0.9), ("diffusion", 0.0)])
def test_photons_one_by_one(model: str, g: float) -> None:
    """Rationale: photons in a sphere of 8 mm, source 3 mm deep (scripts/photon_walk.py): total and rings.

    Expected behaviour: SP3 is within 1 % everywhere but for g = 0 on the brightest ring, of 1.7 mm (1.6 %: light that
    comes straight from the source); diffusion misses that by 7 %. Seen to fail without τ, without the flow along the
    border, and for g = 0.9 with the equations, or the border, of g = 0.
    """
    solution = solve(ball_mesh(8, 3), [Medium(0.03, 1.0, 1.37, g)], [Source(Sphere((0.0, 0.0, 5.0)))], model=model)
    x, weight = np.polynomial.legendre.leggauss(5)
    rings = []
    for low, high in pairwise(RINGS):
        top, bottom = math.cos(math.radians(low)), math.cos(math.radians(high))
        points = 8 * circle(1, (top + bottom) / 2 + (top - bottom) / 2 * x)
        rings.append(2 * np.pi * 64 * (top - bottom) / 2 * weight @ solution.exitance_at(points))
    if model == "sp3":
        assert solution.solved.exited == pytest.approx(sum(PHOTONS[g]), rel=5e-3)
        assert rings[0] == pytest.approx(PHOTONS[g][0], rel=0.01 if g else 0.02)
        np.testing.assert_allclose(rings[1:], PHOTONS[g][1:], rtol=0.01)
    else:
        assert rings[0] < 0.95 * PHOTONS[g][0]


def test_nylon_cylinder() -> None:
    """Rationale: exit power of the nylon cylinder by 4e6 photons, 0.3133 ± 0.0001, and the power balance.

    Seen to fail without the curvature (0.3103).
    """
    solution = solve(cylinder_tetrahedra(15, 30, 3), [NYLON], [POINT])
    assert solution.solved.exited == pytest.approx(0.3133, rel=3e-3)
    assert solution.balance == pytest.approx(0, abs=1e-5)
    phantom = solution.phantom(1)
    assert phantom.provenance["source"] == "SP3 equations by finite elements"
    assert phantom.power == pytest.approx(solution.solved.exited, rel=1e-12)
    assert float(phantom.provenance["scale"]) == pytest.approx(1, abs=2e-3)
    volume = solution.volume(1)
    assert volume.values.min() > 0
    assert np.isfinite(volume.values).all()


def test_regions() -> None:
    """Rationale: a label alone changes nothing; across a darker region light goes both ways alike (reciprocity).

    The fluence at b of 1 W at a is that at a of 1 W at b. Seen to fail with C_12 of one region in the other's load.
    """
    plain = cylinder_tetrahedra(8, 12, 2)
    mesh = Tetrahedra(plain.vertices, plain.cells, plain.inside(Sphere((0, 0, 0), 4)), plain.snap)
    a, b = (-5.0, 0.0, 0.5), (1.0, 1.0, -0.5)
    alone, same = (solve(m, [NYLON] * k, [Source(Sphere(a))]) for m, k in ((plain, 1), (mesh, 2)))
    assert same.solved.exited == pytest.approx(alone.solved.exited, rel=1e-11)
    media = [NYLON, Medium(0.1, 1.5, 1.37)]
    there, back = (solve(mesh, media, [Source(Sphere(at))]) for at in (a, b))
    assert there.balance == pytest.approx(0, abs=1e-5)
    assert there.solved.exited < 0.95 * alone.solved.exited
    assert there.fluence_at(np.array([b]))[0] == pytest.approx(back.fluence_at(np.array([a]))[0], rel=0.01)


def test_ball_in_endless_tissue() -> None:
    """Rationale: in a ball of light -c_i ∇²φ_i + Σ C_ij φ_j = s_i q, by differences; outside it is 0."""
    found = equations("sp3", [Medium(0.05, 0.9)])
    field = SourceField.of(found, 0, np.zeros((1, 3)), np.array([2.0]), np.ones(1))
    h = 1e-2
    steps = h * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    for at, density in ((0.6, 3 / (4 * np.pi * 8)), (2.0, 0.0)):
        values = field.components(steps + at)
        laplacian = (values[:, 1:].sum(axis=1) - 6 * values[:, 0]) / h**2
        left = -found.diffusion[0] * laplacian + found.reaction[0] @ values[:, 0]
        np.testing.assert_allclose(left, found.source * density, atol=2e-6)


def test_a_ball_of_many_decay_lengths() -> None:
    """Rationale: exp(ka) and exp(-kr) left double precision for ka > 700, which φ_2 reaches in 300 mean free paths."""
    ball = FreeField(np.zeros((1, 3)), np.array([30.0]), np.ones(1), 1.0, 40.0**2)
    fluence, gradient, _ = ball.with_gradient(np.array([[1.0, 0, 0], [29.99, 0, 0], [30.01, 0, 0], [31.0, 0, 0]]))
    assert np.isfinite(gradient).all()
    # Inside φ is q/k² far from the border, half of it on it.
    np.testing.assert_allclose(fluence[0], 3 / (4 * np.pi * 30**3) / 1600, rtol=1e-12)
    assert fluence[1] > 0.5 * fluence[0] > fluence[2] > 0.3 * fluence[0] > fluence[3] > 0


def test_curvature_of_a_border() -> None:
    """Rationale: 1/R of a sphere, half of it of a cylinder's side, 0 of its caps; ∫ κ dS by Steiner's formula."""
    ball = BorderShape.of(ball_mesh(10, 3), 1.0).curvature
    np.testing.assert_allclose(ball[ball != 0], 0.1, rtol=0.25)
    assert ball[ball != 0].mean() == pytest.approx(0.1, rel=0.02)
    mesh = cylinder_tetrahedra(15, 30, 1.5)
    across, height = np.hypot(*mesh.vertices[:, :2].T), np.abs(mesh.vertices[:, 2])
    curvature = BorderShape.of(mesh, 1.0).curvature
    np.testing.assert_allclose(curvature[(across > 14.9) & (height < 6)], 1 / 30, rtol=5e-3)
    np.testing.assert_allclose(curvature[(across < 8) & (height > 14.9)], 0, atol=1e-3)
    assert curvature[(across > 14.9) & (height > 14.9)].min() > 0.2
    assert curvature[(across < 14) & (height < 14)].max() == 0


def test_creases_of_a_border() -> None:
    """Rationale: along flat faces (M + ℓ² L) η = 0 is η'' = η/ℓ², so η = exp(-d/ℓ) off a crease, and s = 1 - η.

    A sphere has no creases. Seen to fail with M left out.
    """
    mesh = cylinder_tetrahedra(15, 30, 0.75)
    across, height = np.hypot(*mesh.vertices[:, :2].T), np.abs(mesh.vertices[:, 2])
    share = BorderShape.of(mesh, 2.0).along
    side = (across > 14.9) & (height > 8)
    np.testing.assert_allclose(share[side], 1 - np.exp((height[side] - 15) / 2), atol=0.02)
    assert share[(across > 14.9) & (height > 14.9)].max() == 0
    assert share[(across < 14) & (height < 14)].min() == 1
    assert (BorderShape.of(ball_mesh(10, 2), 2.0).along == 1).all()


def test_rim_of_a_cylinder() -> None:
    """Rationale: exit power of 1.6e7 photons in strips of 0.5 mm on both sides of a cylinder's rim, within 0.3 %.

    The total of SP3 is 0.24 % too high on this mesh, 0.19 % on one of half the edge: near the rim z falls with the
    curvature by another law than in spheres.

    Expected behaviour: SP3 is 9 % too low on the strip of the side at the rim, within 5 % on the others. With the flow
    along the border as on a flat one, which takes light away from the rim on both sides, the strips at the rim are 26 %
    too low, the next ones 9 and 10 % too high, and the exit power is 0.3 % too high: seen to fail.
    """
    side_photons, cap_photons = np.array([5.4589, 6.3114, 7.5261, 8.9792]), np.array([4.9785, 5.5380, 6.3539, 7.3259])
    source = Source(Sphere((4.0, 0.0, 4.0)))
    solution = solve(cylinder_tetrahedra(8, 16, 1.5), [Medium(0.05, 1.0, 1.37)], [source])
    x, weight = np.polynomial.legendre.leggauss(3)
    turn, depth = (np.arange(96) + 0.5) * np.pi / 48, 0.5 * np.arange(4)[:, None] + 0.25 * (1 + x)

    def power(points: Callable[[Array, Array], list[Array]], radius: Array | float) -> Array:
        d, angle = np.meshgrid(depth.ravel(), turn, indexing="ij")
        values = solution.exitance_at(np.stack(points(d, angle), axis=-1).reshape(-1, 3)).reshape(4, 3, -1)
        return np.einsum("skt,k,sk->s", values, weight / 4, np.broadcast_to(radius, depth.shape)) * np.pi / 48

    side = 1e3 * power(lambda d, angle: [8 * np.cos(angle), 8 * np.sin(angle), 8 - d], 8.0)
    cap = 1e3 * power(lambda d, angle: [(8 - d) * np.cos(angle), (8 - d) * np.sin(angle), 8 + 0 * d], 8 - depth)
    np.testing.assert_allclose(side, side_photons, rtol=0.1)
    np.testing.assert_allclose(cap, cap_photons, rtol=0.05)
    np.testing.assert_allclose(side[1:], side_photons[1:], rtol=0.05)
    assert solution.solved.exited == pytest.approx(0.27930, rel=3e-3)


def test_shortened_length() -> None:
    """Rationale: linear for small curvature, > 0 and falling for any, at most doubled in a hollow; no kink."""
    fall = np.linspace(-2, 5, 701)
    length = shortened(np.full(701, 1.7), fall)
    np.testing.assert_allclose(length[np.abs(fall) < 0.8], 1.7 - fall[np.abs(fall) < 0.8])
    assert length.min() > 0
    assert length.max() == pytest.approx(3.4)
    assert np.abs(np.diff(length, 2))[fall[1:-1] > -1.6].max() < 3e-4


def test_refused() -> None:
    mesh = cylinder_tetrahedra(15, 30, 5)
    with pytest.raises(FluxError, match=r"'model' must be one of sp3, diffusion, got 'p1'\. Give"):
        solve(mesh, [NYLON], [POINT], model="p1")
    with pytest.raises(FluxError, match=r"'a' is of the diffusion equation, got 'haskell' .* sp3\. Leave 'a'"):
        solve(mesh, [NYLON], [POINT], a="haskell")
    with pytest.raises(FluxError, match="index n must be >= 1 and at most 100, got 200"):
        solve(mesh, [Medium(0.01, 1, 200)], [POINT])
