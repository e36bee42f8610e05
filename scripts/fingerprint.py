"""Digests of some forty renderings, to check that a change of the code does not change results.

    python scripts/fingerprint.py -o before.npz          # render and store every plane
    python scripts/fingerprint.py --against before.npz   # render and compare with the stored planes

Two renderings are the same if power, error and coverage agree bit for bit. Otherwise the largest difference of power is
printed, over the brightest pixel and over the sum of both errors. The exit code is 1 if any rendering differs by more
than `--tolerance` of the peak (default 0: every bit).
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt

SCENES = Path(__file__).parents[1] / "scenes"
FILM = {"width": 64, "height": 64, "pixel_pitch": 0.432}
SIZE, PITCH = (48, 40), 0.4
LAST_FLIGHT = {"emission": "last_flight", "int_ior": 1.37, "mua": 0.0138, "musp": 0.91}
MODELS = {
    "hrrt": {"model": "hrrt", "lens_diameter": 22.0},
    "pinhole": {"model": "pinhole"},
    "ripoll": {"model": "ripoll", "numerical_aperture": 0.1},
    "stop behind": {"lens_diameter": 18.0, "diaphragm_distance": 12.0},
    "stop in front": {"lens_diameter": 18.0, "diaphragm_distance": -12.0},
    "image stop": {"image_stop_diameter": 9.0},
}

Render = Callable[[], "fspt.Image"]


def renders() -> Iterator[tuple[str, Render]]:
    """Name and function of every render of the set."""
    yield from _of_files()
    yield from _of_laws()
    yield from _of_lenses()
    yield from _of_hard_cases()
    yield from _of_variants()


def _of_files() -> Iterator[tuple[str, Render]]:
    for name in ("nylon_cylinder", "two_spheres", "l_shape", "textured_sphere", "uniform_disk"):
        for domain in ("pupil", "surface"):
            accuracy = {"rtol": 1e-2 if domain == "surface" else 1e-3, "domain": domain}
            yield f"{name}, {domain}", _file(name, accuracy, f_number=2.8)
    yield "nylon_cylinder, view 90, rtol 1e-4", _file("nylon_cylinder", {"rtol": 1e-4}, view=90)
    yield "two_spheres, centre", _file("two_spheres", {"pixel": "centre"}, f_number=2.8)
    yield "nylon_cylinder, centre, surface", _file("nylon_cylinder", {"pixel": "centre", "domain": "surface"})
    for name in ("nylon_cylinder", "two_spheres", "textured_sphere"):
        yield f"{name}, no shortcuts", _file(name, {"shortcuts": False})
    yield "l_shape, no shortcuts, surface", _file("l_shape", {"shortcuts": False, "domain": "surface", "rtol": 1e-2})
    yield "l_shape, few nodes", _file("l_shape", {"max_nodes": 100})
    yield "nylon_cylinder, f/1000", _file("nylon_cylinder", {}, f_number=1000)
    for name in ("nylon_cylinder", "textured_sphere"):
        yield f"{name}, path", _file(name, {"method": "path", "spp": 16, "seed": 1})


def _of_laws() -> Iterator[tuple[str, Render]]:
    fresnel = {"emission": "fresnel", "int_ior": 1.37}
    for domain in ("pupil", "surface"):
        accuracy = {"domain": domain, "rtol": 1e-3 if domain == "pupil" else 1e-2}
        yield f"fresnel, {domain}", _shapes(lambda: [_sphere(160, 8, **fresnel)], accuracy)
        yield f"last_flight, {domain}", _shapes(lambda: [_sphere(160, 8, fluence=_fluence(), **LAST_FLIGHT)], accuracy)
    yield "fresnel, path", _shapes(lambda: [_sphere(160, 8, **fresnel)], {"method": "path", "spp": 16, "seed": 2})


def _of_lenses() -> Iterator[tuple[str, Render]]:
    for name, lens in MODELS.items():
        yield name, _shapes(lambda: [_sphere(170, 7), _disk(150, 3, 4)], {}, **lens)
    for name in ("hrrt", "ripoll", "stop behind", "image stop"):
        yield (
            f"{name}, surface",
            _shapes(lambda: [_sphere(170, 7)], {"domain": "surface", "rtol": 1e-2}, **MODELS[name]),
        )
    yield (
        "stop behind, path",
        _shapes(lambda: [_sphere(170, 7)], {"method": "path", "spp": 16, "seed": 3}, **MODELS["stop behind"]),
    )


def _of_hard_cases() -> Iterator[tuple[str, Render]]:
    for domain in ("pupil", "surface"):
        accuracy = {"domain": domain, "rtol": 1e-2}
        yield f"crop, {domain}", _shapes(lambda: [_sphere(165, 8), _sphere(150, 2, 5)], accuracy, crop=(20, 10, 9, 17))
    yield "narrow sphere", _shapes(lambda: [_sphere(160, 8), _sphere(230, 0.08, 12)], {})
    yield "narrow sphere alone", _shapes(lambda: [_sphere(140, 0.2)], {"rtol": 1e-2})
    yield "dark plate", _shapes(lambda: [_sphere(170, 7), _disk(150, 3, 2, dark=True)], {})
    yield "mesh and sphere", _shapes(lambda: [_box(165, 5), _sphere(150, 2, 6)], {})
    yield "mesh far off", _shapes(lambda: [_box(165, 5)], {}, offset=3e4)


def _of_variants() -> Iterator[tuple[str, Render]]:
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
        yield f"two_spheres, {variant}", _file("two_spheres", {}, variant)


def _file(name: str, accuracy: dict, variant: str = "llvm_ad_mono", **parameters: object) -> Render:
    def render() -> fspt.Image:
        _set(variant)
        scene = fspt.load(SCENES / f"{name}.xml", **FILM, **parameters)
        return fspt.render(scene, **({"method": "integral"} | accuracy))

    return render


def _shapes(
    shapes: Callable[[], list], accuracy: dict, crop: tuple | None = None, offset: float = 0.0, **lens
) -> Render:
    def render() -> fspt.Image:
        _set("llvm_ad_mono")
        import mitsuba as mi

        film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "pixel_format": "luminance"}
        if crop:
            film |= dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), crop, strict=True))
        place = mi.ScalarTransform4f().translate([0, 0, offset])
        numbers = {"focal_length": 55.0, "f_number": 2.8, "magnification": 0.5, "pixel_pitch": PITCH} | lens
        sensor = {"type": "fspt_lens", "film": film, "to_world": place, **numbers}
        moved = {}
        for k, shape in enumerate(shapes()):
            shape["to_world"] = place @ shape["to_world"]
            moved[f"shape_{k}"] = shape
        whole = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, **moved}
        return fspt.render(mi.load_dict(whole, optimize=False), **({"method": "integral"} | accuracy))

    return render


def _set(variant: str) -> None:
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)


def _glow(**law: object) -> dict:
    return {"type": "fspt_surface", "exitance": 1.0, **law}


def _sphere(z: float, radius: float, x: float = 0.0, **law: object) -> dict:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, 0, z]).rotate([1, 0, 0], 30).scale(radius)
    return {"type": "sphere", "to_world": place, "glow": _glow(**law)}


def _disk(z: float, radius: float, x: float, dark: bool = False) -> dict:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, 1, z]).rotate([0, 1, 0], 165).scale(radius)
    return {"type": "disk", "to_world": place} | ({} if dark else {"glow": _glow()})


def _box(z: float, half: float) -> dict:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0, z]).rotate([1, 2, 3], 50).scale(half)
    return {"type": "cube", "to_world": place, "glow": _glow()}


def _fluence() -> dict:
    """exp(-d/2) about a point off the middle of the sphere at z = 160."""
    import mitsuba as mi

    z, y, x = np.meshgrid(*3 * [np.linspace(-10, 10, 21)], indexing="ij")
    values = np.exp(-np.sqrt((x - 3) ** 2 + y**2 + z**2) / 2).astype(np.float32)
    box = mi.ScalarTransform4f().translate([-10, -10, 150]).scale(20)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values[..., None]), "to_world": box}


def planes(image: fspt.Image) -> np.ndarray:
    """Power, error and coverage, shape (3, h, w)."""
    return np.array([image.power, image.error, image.coverage], np.float64)


def digest(image: np.ndarray) -> str:
    """The first twelve letters of the SHA-256 of the planes."""
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()[:12]


def difference(new: np.ndarray, old: np.ndarray) -> tuple[float, float]:
    """Largest difference of power over the brightest pixel, and over the sum of both errors where that is not 0."""
    apart, errors = np.abs(new[0] - old[0]), new[1] + old[1]
    share = np.divide(apart, errors, out=np.where(apart > 0, np.inf, 0.0), where=errors > 0)
    return float(apart.max() / old[0].max()), float(share.max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="NPZ file for all planes")
    parser.add_argument("--against", type=Path, help="NPZ file of an earlier run")
    parser.add_argument("--tolerance", type=float, default=0.0, help="difference of power allowed, over the peak")
    parser.add_argument("--only", default="", help="renders whose name holds this text")
    options = parser.parse_args()
    before = np.load(options.against) if options.against else {}
    kept, failed = {}, 0
    for name, render in renders():
        if options.only not in name:
            continue
        kept[name] = new = planes(render())
        line = f"{name:<40} {digest(new)}  total {new[0].sum():.9e} W"
        if name in before:
            old = before[name]
            same = digest(old) == digest(new)
            apart, share = difference(new, old)
            line += "  same" if same else f"  DIFFERS: {apart:.1e} of the peak, {share:.2g} of the errors"
            failed += not same and apart > options.tolerance
        print(line, flush=True)
    if options.output:
        np.savez_compressed(options.output, **kept)
    print(f"{len(kept)} renders, {failed} beyond the tolerance" if before else f"{len(kept)} renders")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
