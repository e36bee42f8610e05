"""What it costs to leave a property of a real lens out of the model: total power, J_n, depth and power of a source.

    python scripts/lens_left_out.py [--magnifications 0.1,0.3,0.5] [-o docs/lens_left_out.csv]

A sphere of 10 mm with a point source 4 mm below its surface, whose J_n is known in closed form, stands at the side of
the field of a 50 mm f/1.4 lens on a detector of 13.3 mm; a pixel is 0.4 mm of the object. In each row the images have
one property that the model does not have. All else is the same on both sides, the mesh too, and there is no noise:
every error is that of the property. J_n is found by `invert`, the source by least squares over its place and power.
"""

from __future__ import annotations

import argparse
import csv
import logging
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tests_folder  # noqa: F401
import trimesh
from closed_forms import ball_exitance
from numpy.typing import NDArray
from scipy.optimize import least_squares

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.boundary import haskell_a
from mitsuba_fspt.optics.curve_file import Curve
from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.optics.pixel_etendue import pixel_etendues
from mitsuba_fspt.optics.thin_lens import Lens

ROOT = Path(__file__).resolve().parent.parent
FOCAL, F_NUMBER, DETECTOR, PIXEL, CROP = 50.0, 1.4, 13.3, 0.4, 64  # mm; pixels of the crop window about the body
RADIUS, BELOW, ROOM = 10.0, 4.0, 13.0  # of the body; of the source, below the surface; from the body to the edge [mm]
INDEX = 1.37
TISSUE = {"mua": 0.01, "musp": 1.0, "a": haskell_a(INDEX)}  # 1/mm
MAGNIFIED, K1, BORDER, GLARE = 0.8, -0.5, 40.0, 0.01
FALL, REACH = 0.25, 10.0  # share that the vignetting takes at this image height [mm], as its square
ELECTRONS, READ_NOISE = 4e4, 5.0  # on the brightest pixel; by which the pixels are weighted
PEAK, WIDTH, EDGE = 620.0, 30.0, (600.0, 620.0)  # nm: of the emission and its sd; of the filter's edge
CASES = {
    "nothing": {},
    "pupil magnification": {"pupil_magnification": MAGNIFIED},
    "distortion": {"distortion": f"{K1}, 0"},
    "vignetting": {},
    "flat of the wrong kind": {},
    "spectrum": {},
    "glare": {},
    "aperture (pinhole)": {"model": "pinhole"},
    "diaphragm (HRRT)": {"model": "hrrt", "lens_diameter": BORDER},
    "exit law (Lambert)": {"emission": "fresnel"},
}
SWAPPED = ("aperture (pinhole)", "diaphragm (HRRT)")  # here the model has the listed settings, the images have none
COLUMNS = ("left out", "magnification", "total", "J_n", "depth [mm]", "power", "told")
TOLD = ("residuals have structure", "more than their noise")  # of the warnings of `invert`, that something is left out
SCENE = """<scene version="3.0.0">
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        {lens}
        <film type="hdrfilm"> {film} <string name="pixel_format" value="luminance"/> </film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="{mesh}"/>
        <emitter type="fspt_surface">
            <string name="emission" value="{emission}"/> {index}
            <texture name="exitance" type="mesh_attribute"><string name="name" value="vertex_exitance"/></texture>
        </emitter>
    </shape>
</scene>"""
Array = NDArray[np.float64]


class Setup:
    """The body before the lens at one magnification, and everything that is known of it.

    vertices : of the body, from its middle (V, 3) [mm];  size : of the film;  first : column and row of its crop window
    """

    def __init__(self, magnification: float, folder: Path) -> None:
        self.magnification, self.pitch = magnification, PIXEL * magnification
        self.lens = Lens.focused(FOCAL, F_NUMBER, magnification=magnification)
        mesh = trimesh.creation.icosphere(3, radius=RADIUS)
        self.vertices = np.asarray(mesh.vertices, np.float64)
        u = self.lens.focus_distance
        self.middle = np.array([max(DETECTOR / 2 / magnification - ROOM, 0.0), 0.0, u + RADIUS])
        self.size = round(DETECTOR / self.pitch)
        column = self.size / 2 - self.middle[0] * u / self.middle[2] / PIXEL
        self.side = min(CROP, self.size)
        starts = (round(middle - self.side / 2) for middle in (column, self.size / 2))
        self.first = tuple(int(np.clip(start, 0, self.size - self.side)) for start in starts)
        self.mesh = folder / f"body_{magnification:g}.ply"
        self.source = np.array([0.0, 0.0, BELOW - RADIUS])
        self.true = self.exitance(self.source)
        write_body(self.mesh, self.vertices + self.middle, np.asarray(mesh.faces), self.true)

    def exitance(self, source: Array, power: float = 1.0) -> Array:
        """J_n (V,) [W/mm²] of a source of so many watts at this place from the body's middle [mm]."""
        offset = float(np.linalg.norm(source))
        cosine = self.vertices @ source / (RADIUS * max(offset, 1e-9))
        return power * ball_exitance(RADIUS, offset, TISSUE["mua"], TISSUE["musp"], TISSUE["a"], cosine)

    def matrix(self, emission: str = "lambert", **lens: object) -> fspt.TransportMatrix:
        """Transport matrix of the view with these settings of the lens."""
        numbers = {"focal_length": FOCAL, "f_number": F_NUMBER, "magnification": self.magnification} | lens
        numbers["pixel_pitch"] = self.pitch
        sides = {"width": self.size, "height": self.size, "crop_width": self.side, "crop_height": self.side}
        sides |= dict(zip(("crop_offset_x", "crop_offset_y"), self.first, strict=True))
        text = SCENE.format(
            lens=" ".join(
                f'<{"string" if isinstance(v, str) else "float"} name="{n}" value="{v}"/>' for n, v in numbers.items()
            ),
            film=" ".join(f'<integer name="{name}" value="{value}"/>' for name, value in sides.items()),
            mesh=self.mesh,
            emission=emission,
            index=f'<float name="int_ior" value="{INDEX}"/>' if emission == "fresnel" else "",
        )
        scene = self.mesh.with_suffix(".xml")  # from which `invert` reads the mesh again
        scene.write_text(text)
        return fspt.transport(scene, rtol=3e-3)

    def of_window(self, image: Array) -> Array:
        """The crop window's part of an image of the film."""
        left, top = self.first
        return image[top : top + self.side, left : left + self.side]

    def heights(self) -> Array:
        """Image height of the pixels of the crop window [mm]."""
        place = (np.arange(self.size) + 0.5 - self.size / 2) * self.pitch
        return self.of_window(np.hypot(place[None, :], place[:, None]))

    def screen(self) -> Array:
        """Image of a uniform screen on the crop window, over its mean on the film."""
        place = (np.arange(self.size) + 0.5 - self.size / 2) * PIXEL
        whole = pixel_etendues(self.lens, PIXEL, place, place)
        return self.of_window(whole / whole.mean())


def write_body(path: Path, vertices: Array, faces: NDArray[np.int64], exitance: Array) -> None:
    """PLY of the body with its J_n."""
    fspt.Phantom(vertices, faces, exitance, "vertex").write(path)


def band_factor() -> float:
    """Electrons of the band over those that its peak alone would stand for: ⟨τ η λ⟩ over that at the peak."""
    nm = np.linspace(PEAK - 4 * WIDTH, PEAK + 4 * WIDTH, 481)
    emitted = Curve("emission", nm, np.exp(-0.5 * ((nm - PEAK) / WIDTH) ** 2))
    both = 0.9 * np.clip((nm - EDGE[0]) / (EDGE[1] - EDGE[0]), 0, 1) * np.interp(nm, (500, 700), (0.95, 0.9))
    response = Curve("filter and detector", nm, both)
    return Light(None, emitted).electrons_per_joule(response) / Light(PEAK, None).electrons_per_joule(response)


def image_of(case: str, setup: Setup, images: fspt.TransportMatrix) -> Array:
    """Image (h, w) of the true J_n with the property of a case, as watts of a model without it."""
    power = images.forward(setup.true)[0]
    if case == "vignetting":
        return power * (1 - FALL * (setup.heights() / REACH) ** 2)
    if case == "flat of the wrong kind":
        return power / setup.screen()
    if case == "spectrum":
        return power * band_factor()
    if case == "glare":
        return (1 - GLARE) * power + GLARE * power.sum() / setup.size**2
    return power


def errors(setup: Setup, model: fspt.TransportMatrix, image: Array) -> list[object]:
    """Relative errors of the total and of J_n, error of the source's depth [mm], relative error of its power; whether
    `invert` says that the images are not those of the model.
    """
    scale = ELECTRONS / image.max()
    sigma = np.sqrt(np.maximum(image, 0) * scale + READ_NOISE**2) / scale
    found = fspt.invert(model, image[None], error=sigma[None])
    seen, areas = found.seen, model.areas
    off = np.nan_to_num(found.solution) - setup.true
    total = float(areas[seen] @ off[seen] / (areas[seen] @ setup.true[seen]))
    deviation = float(np.sqrt(areas[seen] @ off[seen] ** 2 / (areas[seen] @ setup.true[seen] ** 2)))

    def residuals(unknown: Array) -> Array:
        fitted = model.forward(setup.exitance(unknown[:3], float(np.exp(unknown[3]))))[0]
        return ((fitted - image) / sigma).ravel()

    best = least_squares(residuals, [*(0.9 * setup.source), 0.0], x_scale=[1, 1, 1, 0.1], diff_step=1e-4).x
    depth = RADIUS - float(np.linalg.norm(best[:3])) - BELOW
    told = any(part in text for text in found.warnings for part in TOLD)
    numbers = (total, deviation, depth, float(np.exp(best[3])) - 1)
    return [*(f"{value:.4f}" for value in numbers), "yes" if told else "no"]


def rows_of(magnification: float, folder: Path) -> list[list[object]]:
    """Rows of the table at one magnification."""
    setup, rows = Setup(magnification, folder), []
    plain = setup.matrix()
    for case, settings in CASES.items():
        other = setup.matrix(**settings) if settings else plain
        images, model = (plain, other) if case in SWAPPED else (other, plain)
        found = errors(setup, model, image_of(case, setup, images))
        rows.append([case, magnification, *found])
        print(*rows[-1], sep="\t", flush=True)
    return rows


def draw(rows: list[list[object]], path: Path) -> None:
    """A panel for each quantity: bars of all cases, a colour for each magnification."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.6), layout="constrained")
    panels = figure.subplots(1, 4, sharey=True)
    names, magnifications = list(CASES), sorted({float(str(row[1])) for row in rows})
    for k, (panel, title) in enumerate(zip(panels, ("total", "J_n (rms)", "depth [mm]", "source power"), strict=True)):
        for j, magnification in enumerate(magnifications):
            values = [float(str(row[2 + k])) for row in rows if row[1] == magnification]
            values = values if k == 2 else [100 * value for value in values]
            at = np.arange(len(names)) + 0.26 * (j - 1)
            panel.barh(at, values, 0.24, color=f"C{j}", label=f"m = {magnification:g}")
        panel.set_title(title if k == 2 else f"{title} [%]")
        panel.axvline(0, color="0.3", lw=0.8)
        panel.set_xscale("symlog", linthresh=0.1 if k == 2 else 1)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.grid(alpha=0.3, axis="x")
    panels[0].set_yticks(np.arange(len(names)), names)
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle("error where the model leaves it out, 50 mm f/1.4")
    figure.savefig(path, dpi=120)


def table(rows: list[list[object]]) -> str:
    """The rows as a table of Markdown."""
    lines = ["| left out | t | total | J_n, rms | depth | source power | `invert` says so |", "|---" * 7 + "|"]
    for name, magnification, *values, told in rows:
        total, exitance, depth, power = (float(str(value)) for value in values)
        numbers = f"{100 * total:+.1f} % | {100 * exitance:.1f} % | {depth:+.2f} mm | {100 * power:+.1f} %"
        lines.append(f"| {name} | {magnification} | {numbers} | {told} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--magnifications", default="0.1,0.3,0.5")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/lens_left_out.csv")
    parser.add_argument("--page", type=Path, help="Markdown file whose table is replaced")
    options = parser.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)  # of images without noise, χ² is too small
    with TemporaryDirectory() as folder:
        rows = [row for text in options.magnifications.split(",") for row in rows_of(float(text), Path(folder))]
    with options.output.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    draw(rows, options.output.with_suffix(".png"))
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        head, _, rest = text.partition("<!-- table: lens_left_out -->\n")
        tail = rest.partition("<!-- /table -->")[2]
        filled = f"{head}<!-- table: lens_left_out -->\n{table(rows)}\n<!-- /table -->{tail}"
        options.page.write_text(filled, encoding="utf-8")


if __name__ == "__main__":
    main()
