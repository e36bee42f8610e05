"""Stated errors on every pixel of ordinary images, against the transport matrix, which takes light face by face.

    python scripts/every_pixel.py [--body torus,box] [--view 0,90,200] [--f-number 1.8,8] [--rtol 1e-2,1e-3]
                                  [-o docs/every_pixel.csv]

The images are those of `ordinary_scenes.py`. The matrix, at an `rtol` of 3e-4, traces no line of sight but where
surfaces may hide each other. Columns: pixels with an error above 0; pixels on which the power differs from T J,
apart from the error of T J, by more than `rtol` times the brightest pixel, and by more than the stated error; pixels
whose stated error is above `rtol`; the largest of the differences over the error stated, but for pixels with an error
of 0, whose number is `beyond_zero`; lines of sight in millions.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np
from csv_table import write_rows
from ordinary_scenes import SIDE, bodies

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend

MATRIX_RTOL = 3e-4


def counts(image: fspt.Image, power: np.ndarray, own: np.ndarray, rtol: float) -> dict[str, object]:
    """Numbers of an image (h, w) that should have this `power` [W] but for its `own` error [W]."""
    peak, stated = power.max(), np.asarray(image.error)
    off = np.maximum(np.abs(image.power - power) - own, 0)
    beyond = off > stated
    some = beyond & (stated > 0)
    return {
        "pixels": int((stated > 0).sum()),
        "beyond_rtol": int((off > rtol * peak).sum()),
        "beyond_error": int(beyond.sum()),
        "stated": int((stated > rtol * peak).sum()),
        "beyond_zero": int((beyond & ~some).sum()),
        "largest_ratio": float(f"{(off[some] / stated[some]).max(initial=0.0):.3g}"),
        "lines": float(f"{image.metadata['nodes'] / 1e6:.3g}"),
    }


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--body", default="")
    parser.add_argument("--view", default="0,90,200")
    parser.add_argument("--f-number", default="1.8,8")
    parser.add_argument("--rtol", default="1e-2,1e-3")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    backend.ensure_variant()
    wanted, rows = [name for name in options.body.split(",") if name], list[dict[str, object]]()
    views, tolerances = ([float(text) for text in given.split(",")] for given in (options.view, options.rtol))
    with tempfile.TemporaryDirectory() as folder:
        for name, (mesh, exitance) in bodies():
            if wanted and name not in wanted:
                continue
            path, values = Path(folder) / f"{name}.ply", exitance(np.asarray(mesh.vertices))
            fspt.Phantom(mesh.vertices, mesh.faces, values, "vertex").write(path)
            for f_number, view in itertools.product(options.f_number.split(","), views):
                scene = path.with_suffix(".xml")
                scene.write_text(fspt.scene_xml(path, f_number=float(f_number), width=SIDE, height=SIDE))
                matrix = fspt.transport(scene, view=[view], rtol=MATRIX_RTOL)
                expected = np.asarray(matrix.forward(values)).reshape(SIDE, SIDE)
                own = np.asarray(matrix.error(values)).reshape(SIDE, SIDE)
                for rtol in tolerances:
                    image = fspt.render(fspt.load(scene, view=view), rtol=rtol)
                    where = {"body": name, "view": view, "f_number": f_number, "rtol": rtol}
                    rows.append(where | counts(image, expected, own, rtol))
                    print(*rows[-1].values(), sep="\t", flush=True)
    for rtol in tolerances:
        own_rows = [row for row in rows if row["rtol"] == rtol]
        names = ("pixels", "beyond_rtol", "beyond_error", "stated", "lines")
        print(f"rtol {rtol:g}:", *(f"{name} {sum(float(str(row[name])) for row in own_rows):g}" for name in names))
    if options.output:
        write_rows(options.output, rows)


if __name__ == "__main__":
    main()
