"""Photons in tissue, one by one: exit power of a cylinder, a sphere or a mesh by bins of its surface, for the scripts.

Absorption and scattering happen at the ends of exponential flights of the mean 1/(µa + µs); a photon's weight falls by
the albedo at each, and photons of small weight end by Russian roulette. At the surface Fresnel's reflectance decides
between reflection and exit. It shares no code with the solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsuba_fspt.jit.mesh_buffers import new_mesh

Array = NDArray[np.float64]
SMALL, SURVIVAL = 0.05, 0.2  # weight below which a photon goes on only with this probability
CLEARANCE = 1e-5  # mm, off the surface after a reflection: a chord along it has a length
BATCHES = 32  # whose scatter gives the standard error


@dataclass(frozen=True)
class Body:
    """Cylinder about z of `radius` and `height`, or a sphere (height 0), centred at the origin [mm]."""

    radius: float
    height: float = 0.0


@dataclass(frozen=True, eq=False)
class Filled:
    """What a closed surface contains; `scene` has its mesh, with outward normals [mm]."""

    scene: mi.Scene

    @classmethod
    def of(cls, vertices: Array, faces: NDArray[np.int64]) -> Filled:
        """Of the vertices (V, 3) [mm] and the faces (F, 3)."""
        mesh = new_mesh("surface", np.float32(vertices).ravel(), np.uint32(faces).ravel())
        return cls(mi.load_dict({"type": "scene", "mesh": mesh}))


@dataclass(frozen=True)
class Optics:
    """µa, µs' [1/mm], index n, and g of the phase function of Henyey and Greenstein; µs = µs'/(1 - g)."""

    mua: float
    musp: float
    n: float
    g: float = 0.0


@dataclass(frozen=True)
class Emitter:
    """Ball of a radius [mm], 0 for a point, that glows uniformly at `centre` [mm]."""

    centre: tuple[float, float, float]
    radius: float = 0.0


def exit_power(
    body: Body | Filled,
    optics: Optics,
    emitter: Emitter,
    bin_of: Callable[[mi.Point3f], mi.UInt32],
    bins: int,
    photons: int,
    seed: int = 0,
) -> Array:
    """Exit power of 1 W by bins, shape (BATCHES, bins) [W]: each batch's estimate, of photons/BATCHES photons.

    bin_of : number of the bin of points of the surface
    """
    sampler = mi.PCG32(photons, initstate=seed, initseq=1)
    batch = dr.arange(mi.UInt32, photons) % BATCHES
    power = dr.zeros(mi.Float64, BATCHES * bins)
    mus = optics.musp / (1 - optics.g)
    # Opaque: other coefficients and places make no other kernel.
    total, albedo = (dr.opaque(mi.Float, value) for value in (optics.mua + mus, mus / (optics.mua + mus)))
    centre = mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in emitter.centre))

    def step(
        p: mi.Point3f, d: mi.Vector3f, weight: mi.Float, active: mi.Bool, sampler: mi.PCG32
    ) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Bool, mi.PCG32]:
        flight = -dr.log(1 - sampler.next_float32()) / total
        reach, normal = _way_out(body, p, d)
        inside = flight < reach
        choice, first, second = sampler.next_float32(), sampler.next_float32(), sampler.next_float32()
        p = p + dr.minimum(flight, reach) * d
        reflectance = 1 - _transmittance(-dr.dot(d, normal), optics.n)
        leaves = ~inside & (choice >= reflectance)
        dr.scatter_reduce(dr.ReduceOp.Add, power, mi.Float64(weight), batch * bins + bin_of(p), active & leaves)
        p = dr.select(inside, p, p + CLEARANCE * normal)
        d = dr.select(inside, _scattered(d, optics.g, first, second), d - 2 * dr.dot(d, normal) * normal)
        weight = dr.select(inside, weight * albedo, weight)
        small = inside & (weight < SMALL)
        active = active & ~leaves & ~(small & (choice >= SURVIVAL))
        return p, d, dr.select(small, weight / SURVIVAL, weight), active, sampler

    start = centre + _in_ball(sampler) * emitter.radius
    state = (start, _on_sphere(sampler), dr.full(mi.Float, 1.0, photons), dr.full(mi.Bool, True, photons), sampler)
    dr.while_loop(state, lambda p, d, weight, active, sampler: active, step)
    return np.array(power).reshape(BATCHES, bins) * (BATCHES / photons)


def _transmittance(cosine: mi.Float, n: float) -> mi.Float:
    """Fresnel's unpolarised transmittance from the index n into 1 at the inner cosine."""
    outer = dr.sqrt(dr.maximum(1 - n * n * (1 - cosine * cosine), 0))
    s = (n * cosine - outer) / (n * cosine + outer)
    p = (n * outer - cosine) / (n * outer + cosine)
    return dr.select(outer > 0, 1 - (s * s + p * p) / 2, 0)


def _way_out(body: Body | Filled, p: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
    """Distance to the surface along d, and the outward normal with its sign turned: inward there."""
    if isinstance(body, Filled):
        hit = body.scene.ray_intersect_preliminary(mi.Ray3f(p, d))
        normal = hit.compute_surface_interaction(mi.Ray3f(p, d), mi.RayFlags.Minimal).n
        return hit.t, dr.mulsign(mi.Vector3f(normal), -dr.dot(d, normal))
    if not body.height:
        b = dr.dot(p, d)
        reach = dr.sqrt(dr.maximum(b * b - dr.dot(p, p) + body.radius**2, 0)) - b
        return dr.maximum(reach, 0), -dr.normalize(mi.Vector3f(p + reach * d))
    across = d.x * d.x + d.y * d.y
    b = p.x * d.x + p.y * d.y
    c = p.x * p.x + p.y * p.y - body.radius**2
    side = dr.select(across > 1e-9, (dr.sqrt(dr.maximum(b * b - across * c, 0)) - b) / across, dr.inf)
    cap = (body.height / 2 - p.z * dr.sign(d.z)) / dr.maximum(dr.abs(d.z), 1e-12)
    on_side = side < cap
    end = p + dr.minimum(side, cap) * d
    normal = dr.select(
        on_side, mi.Vector3f(-end.x / body.radius, -end.y / body.radius, 0), mi.Vector3f(0, 0, -dr.sign(d.z))
    )
    return dr.maximum(dr.minimum(side, cap), 0), dr.normalize(normal)


def _scattered(d: mi.Vector3f, g: float, first: mi.Float, second: mi.Float) -> mi.Vector3f:
    """Direction after scattering."""
    if g == 0:
        cosine = 2 * first - 1
    else:
        ratio = (1 - g * g) / (1 - g + 2 * g * first)
        cosine = (1 + g * g - ratio * ratio) / (2 * g)
    sine = dr.sqrt(dr.maximum(1 - cosine * cosine, 0))
    s, c = dr.sincos(2 * dr.pi * second)
    return dr.normalize(mi.Frame3f(d).to_world(mi.Vector3f(sine * c, sine * s, cosine)))


def _on_sphere(sampler: mi.PCG32) -> mi.Vector3f:
    return mi.warp.square_to_uniform_sphere(mi.Point2f(sampler.next_float32(), sampler.next_float32()))


def _in_ball(sampler: mi.PCG32) -> mi.Vector3f:
    return _on_sphere(sampler) * dr.power(sampler.next_float32(), 1 / 3)
