"""What simpler projectors leave out, and what that costs: docs/comparisons.csv and the table of docs/comparisons.md.

    python scripts/comparisons.py [--cycles PYTHON] [--readme docs/comparisons.md] [-o docs/comparisons.csv]

Nylon cylinder from the left, 128² pixels of 0.216 mm, magnification 1/2, focused on the front, for several stops:
images by the models `pinhole` and `hrrt` (a lens of 27.5 mm), by Mitsuba's sensor `thinlens` and by Blender's Cycles
against the integral with a diaphragm. Cycles runs in another PYTHON, which has the package bpy (cycles_image.py).
Each image is scaled to the total power of the reference, as the models define no unit in common; `rms` is then the
root of the mean squared difference over the brightest pixel, and `power` the ratio of the totals before that, where the
image is in watts. `corner`: a uniform disk that fills the field, power in the corner over that in the middle.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import tempfile
from pathlib import Path

import markdown_tables
import numpy as np

import mitsuba_fspt as fspt  # before Mitsuba
from mitsuba_fspt.phantom.phantom import Phantom
from mitsuba_fspt.phantom.shipped_scenes import FOLDER
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.runtime.backend import ensure_variant

SIZE, PITCH, LENS = 128, 0.216, 27.5  # pixels, mm, mm
MARKER = '<float name="focal_length" value="$focal_length"/>'
HEAD = ("scene", "f_number", "projector", "rms", "power", "corner")


def text_of(scene: str, model: str = "") -> str:
    """Text of a scene of the package, with further parameters of its lens."""
    text = (FOLDER / f"{scene}.xml").read_text(encoding="utf-8")
    text = text.replace('value="nylon_cylinder.ply"', f'value="{FOLDER / "nylon_cylinder.ply"}"')
    return text.replace(MARKER, f"{MARKER} {model}")


def image_of(scene: str, f_number: float, model: str = "") -> np.ndarray:
    """Power on the pixels [W] by the integral."""
    film = {"width": SIZE, "height": SIZE, "pixel_pitch": PITCH}
    numbers = film | ({"view": 90} if scene == "nylon_cylinder" else {}) | {"f_number": f_number}
    return np.float64(fspt.render(fspt.load(text_of(scene, model), **numbers), rtol=1e-3).power)


def by_thinlens(scene: str, f_number: float, distance: float, spp: int) -> np.ndarray:
    """Image of Mitsuba's own `thinlens` with the same focus, field and diaphragm, in its unit [W/mm²/sr]."""
    import mitsuba as mi

    loaded = fspt.load(text_of(scene), f_number=f_number, **({"view": 90} if scene == "nylon_cylinder" else {}))
    side = SIZE * PITCH / 0.5  # of the field in the plane in focus
    sensor = mi.load_dict(
        {
            "type": "thinlens",
            "fov": math.degrees(2 * math.atan(side / 2 / 165)),
            "aperture_radius": 55 / f_number / 2,
            "focus_distance": 165.0,
            "to_world": mi.ScalarTransform4f().look_at([distance, 0, 0], [0, 0, 0], [0, 0, 1]),
            "film": {
                "type": "hdrfilm",
                "width": SIZE,
                "height": SIZE,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        }
    )
    path = mi.load_dict({"type": "path", "max_depth": 2})
    return np.float64(np.array(mi.render(loaded, sensor=sensor, integrator=path, spp=spp, seed=1))[..., 0])


def by_cycles(python: Path, scene: str, f_number: float, distance: float, spp: int) -> np.ndarray:
    """Image of Cycles with the same focus, field and diaphragm, in a unit of its own."""
    import OpenEXR

    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "scene.npz", Path(folder) / "image.exr"
        lens = {"focal_length": 55.0, "f_number": f_number, "focus": 165.0, "distance": distance}
        film = {"side": SIZE * PITCH / 0.5, "pixels": SIZE, "spp": spp}
        np.savez(source, **mesh_of(scene), **lens, **film)
        script = Path(__file__).with_name("cycles_image.py")
        subprocess.run([python, script, source, target], check=True, stdout=subprocess.DEVNULL)
        return np.float64(OpenEXR.File(str(target)).channels()["RGBA"].pixels[..., 0])


def mesh_of(scene: str) -> dict[str, np.ndarray]:
    """Mesh of a scene and its J_n, turned as the scene turns it; a square that fills the field for the uniform disk."""
    if scene == "uniform_disk":
        corners = np.array([[0, y, z] for y, z in ((-60, -60), (60, -60), (60, 60), (-60, 60))], float)
        return {"vertices": corners, "faces": np.array([[0, 1, 2], [0, 2, 3]]), "exitance": np.ones(4)}
    phantom = Phantom.read(FOLDER / f"{scene}.ply")
    x, y, z = phantom.vertices.T  # view=90 turns the phantom by 90 degrees about z
    return {"vertices": np.stack([-y, x, z], -1), "faces": phantom.faces, "exitance": phantom.exitance}


def rms(image: np.ndarray, reference: np.ndarray) -> float:
    """RMS difference over the brightest pixel of the reference, at equal total."""
    scaled = image * reference.sum() / image.sum()
    return float(np.sqrt(np.mean((scaled - reference) ** 2)) / reference.max())


def corner(image: np.ndarray) -> float:
    """Mean of the outermost 8 × 8 pixels over that of the middle ones."""
    middle = SIZE // 2
    return float(image[:8, :8].mean() / image[middle - 4 : middle + 4, middle - 4 : middle + 4].mean())


def measured(spp: int, cycles: Path | None) -> list[dict[str, object]]:
    """Rows of the table."""
    rows: list[dict[str, object]] = []
    hrrt = f'<string name="model" value="hrrt"/> <float name="lens_diameter" value="{LENS}"/>'
    for f_number in (2.8, 8.0):
        reference = image_of("nylon_cylinder", f_number)
        pinhole = image_of("nylon_cylinder", f_number, '<string name="model" value="pinhole"/>')
        without = image_of("nylon_cylinder", f_number, hrrt)
        images = [
            ("pinhole", pinhole, True),
            ("HRRT, lens of 27.5 mm", without, True),
            ("Mitsuba's thinlens", by_thinlens("nylon_cylinder", f_number, 180, spp), False),
        ]
        if cycles:
            images.append(("Blender's Cycles", by_cycles(cycles, "nylon_cylinder", f_number, 180, spp), False))
        for name, image, watts in images:
            ratio = f"{image.sum() / reference.sum():.4f}" if watts else ""
            row = dict.fromkeys(HEAD, "") | {"scene": "nylon_cylinder", "f_number": f_number, "projector": name}
            rows.append(row | {"rms": f"{rms(image, reference):.2e}", "power": ratio})
    disks = [
        ("this package", image_of("uniform_disk", 8.0)),
        ("Mitsuba's thinlens", by_thinlens("uniform_disk", 8.0, 165, spp)),
    ]
    if cycles:
        disks.append(("Blender's Cycles", by_cycles(cycles, "uniform_disk", 8.0, 165, spp)))
    for name, image in disks:
        row = dict.fromkeys(HEAD, "") | {"scene": "uniform_disk", "f_number": 8.0, "projector": name}
        rows.append(row | {"corner": f"{corner(image):.4f}"})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/comparisons.csv"))
    parser.add_argument("--readme", type=Path, help="page whose table 'comparisons' is replaced")
    parser.add_argument("--spp", type=int, default=1024, help="samples a pixel of thinlens and Cycles")
    parser.add_argument("--cycles", type=Path, metavar="PYTHON", help="interpreter with bpy; without it no Cycles")
    given = parser.parse_args()
    ensure_variant()
    rows = measured(given.spp, given.cycles)
    with atomic_path(given.output) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, HEAD, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(str(row[name]) or "–" for name in HEAD) + " |" for row in rows]
    table = "\n".join(["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD), *lines])
    print(table)
    if given.readme:
        markdown_tables.write(given.readme, "comparisons", table)


if __name__ == "__main__":
    main()
