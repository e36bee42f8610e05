"""
From counts to J_n with intervals, and back to the images
=========================================================

    python examples/counts_to_exitance.py [FOLDER]

The phantom is a glowing sphere. Its images are exposed by a simulated detector, which gives counts; the further steps
are the same for counts of a real camera. Prints the total power with its 90 % interval, and the agreement between an
image that is rendered from the result and the original one.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh

import mitsuba_fspt as fspt

VIEWS = [0, 90, 180, 270]
CAMERA = {"focal_length": 55, "f_number": 2.8, "magnification": 0.5, "width": 48, "height": 48, "pixel_pitch": 0.25}
EXPOSURE = {"exposure_time": 60.0, "wavelength_nm": 660.0}  # s, nm


def write_phantom(folder: Path) -> fspt.Phantom:
    """Write phantom.ply, a sphere of radius 8 mm with its largest J_n, 1e-14 W/mm², in front; returns the phantom."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=8)
    distance = np.linalg.norm(sphere.vertices - [2, 0, 1], axis=1)
    phantom = fspt.Phantom(sphere.vertices, sphere.faces, 1e-14 * np.exp(1.5 - distance / 4), "vertex")
    phantom.write(folder / "phantom.ply")
    return phantom


def main(folder: Path) -> dict[str, float]:
    """Run all steps; returns the printed numbers by name: powers in W, `cf` and `chi2` without unit."""
    folder.mkdir(exist_ok=True)
    phantom = write_phantom(folder)
    scene = folder / "phantom.xml"
    scene.write_text(fspt.scene_xml(folder / "phantom.ply", **CAMERA))

    # 1. Counts of four views. Here they are simulated; those of a camera are read from TIFF or FITS files.
    detector = fspt.Detector.typical_ccd()
    pictures = [fspt.render(fspt.load(scene, view=view), rtol=1e-3) for view in VIEWS]
    counts = [detector.expose(p, **EXPOSURE, seed=k).counts for k, p in enumerate(pictures)]

    # 2. From counts to the power on the pixels [W], with its error.
    images = [detector.reduce(c, **EXPOSURE, pixel_pitch=CAMERA["pixel_pitch"]) for c in counts]

    # 3. The matrix from J_n on the mesh to the power on all pixels; then J_n from the images.
    matrix = fspt.transport(scene, view=VIEWS, rtol=1e-3)
    found = fspt.invert(matrix, images, samples=100, seed=1)
    found.write(folder / "found.ply")
    low, high = found.total_interval

    # 4. An image rendered from the result, compared with the original one.
    again = folder / "found.xml"
    again.write_text(scene.read_text().replace("phantom.ply", "found.ply"))
    rendered = fspt.render(fspt.load(again, view=0), rtol=1e-3)
    agreement = fspt.compare(rendered, pictures[0])

    _, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    pictures[0].plot(left)
    left.set_title("rendered from the phantom")
    rendered.plot(right)
    right.set_title("rendered from J_n of the counts")

    seen_power = float(matrix.areas[found.seen] @ phantom.exitance[found.seen])
    print(f"power of what is seen: {found.total:.4g} W, 90 %: {low:.4g} to {high:.4g} W")
    print(f"that of the phantom there: {seen_power:.4g} W")
    print(f"chi2 {found.chi2:.3f}; rendered against first picture: CF {agreement.cf:.5f}, ME {agreement.me:.5f}")
    return {"total": found.total, "low": low, "high": high, "true": seen_power, "cf": agreement.cf, "chi2": found.chi2}


# %%
# The power of the surface lies in its interval.
if __name__ == "__main__":
    numbers = main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()))
    assert numbers["low"] < numbers["true"] < numbers["high"]
