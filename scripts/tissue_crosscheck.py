"""Monte Carlo from the source in the tissue to the CCD against diffusion, the three laws of emission and the integral.

    python scripts/tissue_crosscheck.py [--spp 16384] [--size 32] [--f-number 2.8] [-o tissue_crosscheck]

The phantom is nylon_cylinder.toml, solved once (`fspt flux solve`), and nylon_cylinder_tissue.xml, the same tissue for
Mitsuba's `volpath`. Prints a table, writes it as CSV and a picture (PNG) of the power across the middle, seen from
the front, the left and the back. `ratio` is Σ P/Σ P of Monte Carlo over the picture, `peak` over the pixels above half
of the calculated maximum, `limb` over the outermost pixel that the phantom fills, left and right; each with the
standard error of the Monte Carlo.
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt import backend
from mitsuba_fspt.phantom_file import PhantomFile

SCENES = Path(__file__).resolve().parent.parent / "scenes"
VIEWS = {"front": 0, "left": 90, "back": 180}
LAWS = ("lambert", "fresnel", "last_flight")
CAMERA = 2048 * 0.0135  # mm, the CCD's width

Row = dict[str, Any]


def solve(folder: Path) -> tuple[PhantomFile, float]:
    """The solved phantom as phantom.ply and fluence.vol in a folder; its description and the seconds it took."""
    start = time.perf_counter()
    told = PhantomFile.read(SCENES / "nylon_cylinder.toml")
    solution = told.solve()
    solution.phantom(told.surface_edge).write(folder / "phantom.ply")
    solution.volume(told.voxel).write(folder / "fluence.vol")
    return told, time.perf_counter() - start


def glowing(folder: Path, told: PhantomFile, law: str, view: float, camera: Row) -> Any:
    """The scene of the solved phantom that shines after a law; the camera of nylon_cylinder.xml."""
    import mitsuba as mi

    turn = mi.ScalarTransform4f().rotate([0, 0, 1], view)
    emitter = {"type": "fspt_surface", "exitance": {"type": "mesh_attribute", "name": "vertex_exitance"}}
    if law != "lambert":
        emitter |= {"emission": law, "int_ior": told.medium.n}
    if law == "last_flight":
        volume = {"type": "gridvolume", "filename": str(folder / "fluence.vol"), "use_grid_bbox": True}
        emitter |= {"mua": told.medium.mua, "musp": told.medium.musp}
        emitter |= {"fluence": volume | {"to_world": turn, "accel": False}}
    film = {"type": "hdrfilm", "width": camera["width"], "height": camera["height"], "pixel_format": "luminance"}
    return mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "sensor": {
                "type": "fspt_lens",
                "focal_length": 55.0,
                "f_number": camera["f_number"],
                "magnification": 0.5,
                "pixel_pitch": camera["pixel_pitch"],
                "to_world": mi.ScalarTransform4f().look_at([180, 0, 0], [0, 0, 0], [0, 0, 1]),
                "film": film,
            },
            "phantom": {
                "type": "ply",
                "filename": str(folder / "phantom.ply"),
                "face_normals": True,
                "to_world": turn,
                "emitter": emitter,
            },
        }
    )


def timed(scene: Any, **settings: Any) -> fspt.Image:
    """An image whose `wall_time` has the emitters' tables in it."""
    start = time.perf_counter()
    image = fspt.render(scene, **settings)
    image.metadata["wall_time"] = time.perf_counter() - start
    return image


def ratio(image: fspt.Image, truth: fspt.Image, where: NDArray[np.bool_]) -> tuple[float, float]:
    """Σ P of an image over that of the Monte Carlo on some pixels, and its standard error."""
    monte_carlo = truth.power[where].sum()
    error = math.sqrt((truth.error[where] ** 2).sum())
    value = image.power[where].sum() / monte_carlo
    return value, value * error / monte_carlo


def limb(image: fspt.Image) -> NDArray[np.bool_]:
    """The outermost pixel of each row that the phantom fills, on both sides."""
    full = image.coverage > 0.999
    inside = np.zeros_like(full)
    inside[:, 1:-1] = full[:, :-2] & full[:, 2:]
    return full & ~inside


def judge(view: str, law: str, image: fspt.Image, truth: fspt.Image) -> Row:
    """One line of the table."""
    found = fspt.compare(image, truth)
    row: Row = {"view": view, "law": law, "ME": found.me, "CF": found.cf}
    places = {"ratio": image.power >= 0, "peak": image.power > image.power.max() / 2, "limb": limb(image)}
    for name, where in places.items():
        row[name], row[f"{name}_error"] = ratio(image, truth, where)
    chi2 = found.z_test.chi2 if found.z_test else math.nan
    noise = math.sqrt((truth.error**2).sum()) / truth.power.sum()
    return row | {
        "chi2": chi2,
        "power": image.power.sum(),
        "seconds": image.metadata["wall_time"],
        "lines_of_sight": image.metadata["nodes"],
        "mc_power": truth.power.sum(),
        "mc_error": noise * truth.power.sum(),
        "mc_seconds": truth.metadata["wall_time"],
        "mc_paths": truth.metadata["spp"] * truth.power.size,
    }


def draw(path: Path, pictures: dict[str, dict[str, fspt.Image]], pitch: float) -> None:
    """Power in the middle quarter of the rows, their mean, and each law over the Monte Carlo."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(pictures), figsize=(4.2 * len(pictures), 6), sharex=True, layout="constrained")
    for (view, images), (top, bottom) in zip(pictures.items(), axes.T, strict=True):
        truth = images["volpath"]
        height, width = truth.power.shape
        rows = slice(height // 2 - height // 8, height // 2 + height // 8)
        x = (np.arange(width) + 0.5 - width / 2) * pitch / 0.5
        mean, error = truth.power[rows].mean(axis=0), np.sqrt((truth.error[rows] ** 2).sum(axis=0)) / (height // 4)
        seen = (truth.coverage[rows].min(axis=0) > 0.999) & (mean > 0)
        top.errorbar(x, mean, error, fmt="k.", capsize=2, label="Monte Carlo, source to CCD")
        noise = error[seen] / mean[seen]
        bottom.fill_between(x[seen], 1 - noise, 1 + noise, color="0.85")
        for law in LAWS:
            line = images[law].power[rows].mean(axis=0)
            top.plot(x, line, label=law)
            bottom.plot(x[seen], line[seen] / mean[seen], label=law)
        top.set_title(view)
        bottom.axhline(1, color="k", linewidth=0.6)
        bottom.set_ylim(0.6, 1.8)
        bottom.set_xlim(-18, 18)
        bottom.set_xlabel("mm on the object plane")
    axes[0, 0].set_ylabel("W per pixel per W of source")
    axes[1, 0].set_ylabel("law / Monte Carlo")
    axes[0, 1].legend(fontsize="small", loc="upper left")
    figure.savefig(path, dpi=120)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--spp", type=int, default=16384, help="paths a pixel")
    options.add_argument("--size", type=int, default=32, help="pixels a side")
    options.add_argument("--f-number", type=float, default=2.8)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("-o", "--output", type=Path, default=Path("tissue_crosscheck"), help="without extension")
    given = options.parse_args()
    backend.ensure_variant()
    size, pitch = given.size, CAMERA / given.size
    camera: Row = {"width": size, "height": size, "pixel_pitch": pitch, "f_number": given.f_number}
    rows: list[Row] = []
    pictures: dict[str, dict[str, fspt.Image]] = {}
    with tempfile.TemporaryDirectory() as folder:
        told, seconds = solve(Path(folder))
        print(f"finite elements: {seconds:.1f} s")
        for view, angle in VIEWS.items():
            tissue = fspt.load(SCENES / "nylon_cylinder_tissue.xml", view=angle, **camera)
            truth = timed(tissue, spp=given.spp, seed=given.seed)
            pictures[view] = {"volpath": truth}
            for law in LAWS:
                image = timed(glowing(Path(folder), told, law, angle, camera))
                pictures[view][law] = image
                rows.append(judge(view, law, image, truth))
                print(line(rows[-1]))
    with given.output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    draw(given.output.with_suffix(".png"), pictures, pitch)


def line(row: Row) -> str:
    shares = "  ".join(f"{name} {row[name]:.3f} ± {row[f'{name}_error']:.3f}" for name in ("ratio", "peak", "limb"))
    return (
        f"{row['view']:<6}{row['law']:<12}ME {row['ME']:.4f}  CF {row['CF']:.5f}  {shares}  chi2 {row['chi2']:.2f}  "
        f"{row['lines_of_sight']:.2g} lines {row['seconds']:.1f} s, Monte Carlo {row['mc_paths']:.2g} paths "
        f"{row['mc_seconds']:.1f} s"
    )


if __name__ == "__main__":
    main()
