"""Code common to the parts of scripts/paper.py: the phantom in front of the camera, tables, figures.

Units: mm, W; images hold W on each pixel per W of source.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import markdown_tables
import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.tissue.phantom_file import PhantomFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCENES = Path(__file__).resolve().parent.parent / "scenes"
FOCAL, MAGNIFICATION, DISTANCE = 55.0, 0.5, 180.0  # mm, 1, mm from the lens to the phantom's axis
FOCUS = FOCAL * (1 + 1 / MAGNIFICATION)  # mm, from the lens to the virtual detector plane: the phantom's front
WHOLE_CONE = 0.999  # least coverage of pixels all of whose lines of sight count as meeting the phantom
SIZE, PITCH = 256, 0.108  # pixels a side, mm: the 2048² CCD of 13.5 µm, binned 8 × 8
INDEX, MUA, MUSP = 1.37, 0.0138, 0.91  # of nylon_cylinder.toml: 1, 1/mm, 1/mm

Array = NDArray[np.float64]
Value = str | float | None


@dataclass(frozen=True)
class Table:
    """Rows of values under `columns`: a name with its unit to the format of its values. The first one names the row."""

    name: str
    columns: dict[str, str]
    rows: Sequence[Sequence[Value]]

    def markdown(self) -> str:
        """The table in Markdown; a dash where there is no value."""
        lines = ["| " + " | ".join(self.columns) + " |", "|" + "---|" * len(self.columns)]
        for row in self.rows:
            cells = (show(value, form) for value, form in zip(row, self.columns.values(), strict=True))
            lines.append("| " + " | ".join(cells) + " |")
        return "\n".join(lines)


def show(value: Value, form: str) -> str:
    """A cell's text."""
    if value is None:
        return "–"
    return value if isinstance(value, str) else format(value, form)


def write_csv(tables: Sequence[Table], path: Path) -> None:
    """All values, one a line: table, case, quantity, value. Tables that the file has and that are not given stay."""
    new = {table.name for table in tables}
    kept: list[list[str]] = []
    if path.exists():
        with open(path, newline="", encoding="utf-8") as file:
            kept = [line for line in csv.reader(file) if line[0] not in new | {"table"}]
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(["table", "case", "quantity", "value"])
        lines.writerows(kept)
        for table in tables:
            lines.writerows(_values(table))


def _values(table: Table) -> Iterator[tuple[str, str, str, str]]:
    """The lines of a table in the CSV file."""
    for case, *values in table.rows:
        for quantity, value in zip(list(table.columns)[1:], values, strict=True):
            if value is not None:
                yield table.name, show(case, "g"), quantity, value if isinstance(value, str) else f"{value:.6g}"


def fill(path: Path, tables: Sequence[Table]) -> None:
    """Put each table that a Markdown file marks into the file, see `markdown_tables`."""
    text = path.read_text(encoding="utf-8")
    marked = markdown_tables.names(text)
    for table in tables:
        if table.name in marked:
            text = markdown_tables.replace(text, table.name, table.markdown())
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def solve(name: str, folder: Path, **finer: Any) -> Path:
    """PLY file, in a folder, of the phantom of scenes/NAME.toml with J_n by finite elements.

    `finer` replaces fields of the description, for example surface_edge [mm].
    """
    description = replace(PhantomFile.read(SCENES / f"{name}.toml"), **finer)
    path = folder / f"{name}{'_fine' if finer else ''}.ply"
    description.solve().phantom(description.surface_edge).write(path)
    return path


def photograph(
    phantom: Path, view: float, lens: dict[str, Any], *, law: str = "lambert", **settings: Any
) -> fspt.Image:
    """Image of `stage`; `settings` of it, and of fspt.render."""
    own = {name: settings.pop(name) for name in ("size", "pitch") if name in settings}
    return fspt.render(stage(phantom, view, lens, law=law, **own), **settings)


def stage(
    phantom: Path,
    view: float,
    lens: dict[str, Any],
    *,
    law: str = "lambert",
    size: int = SIZE,
    pitch: float = PITCH,
) -> Any:
    """Scene of a phantom turned by `view` degrees, as scenes/nylon_cylinder.xml sees it.

    `lens`: parameters of fspt_lens beside the focal length, the focus and the pixel pitch; `law`: its emission.
    """
    import mitsuba as mi

    emitter = {"type": "fspt_surface", "exitance": {"type": "mesh_attribute", "name": "vertex_exitance"}}
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], view)
    if law != "lambert":
        emitter |= {"emission": law, "int_ior": INDEX}
    if law == "last_flight":
        volume = {"type": "gridvolume", "filename": str(phantom.with_name("fluence.vol")), "use_grid_bbox": True}
        emitter |= {"mua": MUA, "musp": MUSP, "fluence": volume | {"to_world": turn, "accel": False}}
    body = {"type": "ply", "filename": str(phantom), "face_normals": True, "emitter": emitter, "to_world": turn}
    return camera(body, lens, (size, size), pitch)


def camera(body: dict[str, Any], lens: dict[str, Any], size: tuple[int, int], pitch: float) -> Any:
    """Scene of a body before the lens, on the +x axis DISTANCE from the origin; `size`: (width, height) in pixels."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at([DISTANCE, 0, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "luminance"}
    sensor = {"type": "fspt_lens", "focal_length": FOCAL, "pixel_pitch": pitch, "to_world": place, "film": film}
    if "focus_distance" not in lens:
        sensor["magnification"] = MAGNIFICATION
    scene = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor | lens, "body": body}
    return mi.load_dict(scene)


def binned(image: fspt.Image, side: int) -> fspt.Image:
    """The image with squares of `side` × `side` pixels summed; no error: it is deterministic."""
    height, width = (n // side for n in image.shape)
    squares = image.power.reshape(height, side, width, side)
    pitch = float(image.metadata["pixel_pitch"]) * side
    return fspt.Image(squares.sum(axis=(1, 3)), metadata=image.metadata | {"pixel_pitch": pitch})


def places(image: fspt.Image) -> Array:
    """Middle of each column [mm on the virtual detector plane], from the middle of the image."""
    side = float(image.metadata["pixel_pitch"]) / float(image.metadata["magnification"])
    return (np.arange(image.shape[1]) + 0.5 - image.shape[1] / 2) * side


def figure(width: float, height: float) -> Figure:
    """An empty figure [inches]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def panel(axes: Axes, image: fspt.Image, title: str, reach: float, high: float | None = None) -> None:
    """Draw an image with its colour bar.

    reach : half of the side that is shown [mm on the virtual detector plane]
    high : upper end of the colour bar [W/pixel]
    """
    from mitsuba_fspt.images.picture import draw_picture, scale_and_unit

    high = float(image.power.max()) if high is None else high
    scale, unit = scale_and_unit(np.array([high]))
    draw_picture(axes, image.power / scale, image, unit, (0.0, high / scale))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_title(title, fontsize="medium")


def save(drawn: Figure, path: Path, dpi: int = 100) -> None:
    """Write a PNG file, whole or not at all."""
    with atomic_path(path) as temporary:
        drawn.savefig(temporary, dpi=dpi)
