"""Building blocks of small scenes for the tests of the plugins, the API and the command line."""

from __future__ import annotations

from pathlib import Path

from mitsuba_fspt.runtime import backend

backend.ensure_variant()

import mitsuba as mi  # noqa: E402

SCENES = Path(__file__).resolve().parents[1] / "scenes"


def write_ply(path, vertices, faces, *, vertex=None, face=None):
    """Path of an ASCII PLY with one exitance a vertex or a face, which Mitsuba reads as `vertex_exitance`, …"""
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += ["property float exitance_x"] if vertex is not None else []
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["property float exitance_x"] if face is not None else []
    rows = ["{:.9g} {:.9g} {:.9g}".format(*v) for v in vertices]
    if vertex is not None:
        rows = [f"{row} {value:.9g}" for row, value in zip(rows, vertex, strict=True)]
    corners = [f"3 {a} {b} {c}" for a, b, c in faces]
    if face is not None:
        corners = [f"{row} {value:.9g}" for row, value in zip(corners, face, strict=True)]
    path.write_text("\n".join([*header, "end_header", *rows, *corners, ""]))
    return path


def lens(size=16, pitch=0.8, distance=165.0, **settings):
    """An f/8 lens on the +x axis that looks at the origin; `settings` replace or add parameters, None removes one."""
    width, height = size if isinstance(size, tuple) else (size, size)
    numbers = {
        "type": "fspt_lens",
        "focal_length": 55.0,
        "f_number": 8.0,
        "magnification": 0.5,
        "pixel_pitch": pitch,
        "to_world": mi.ScalarTransform4f().look_at([distance, 0, 0], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"},
    }
    return {name: value for name, value in (numbers | settings).items() if value is not None}


def glow(exitance=1e-3):
    """An emitter with this number or texture."""
    return {"type": "fspt_surface", "exitance": exitance}


def attribute(name="vertex_exitance", **settings):
    """The texture of a mesh attribute."""
    return {"type": "mesh_attribute", "name": name, **settings}


def scene_of(*shapes, sensor=None, integrator=None, robust=True):
    """A loaded scene of these shape dictionaries, `shape_0`, `shape_1`, …, before a lens."""
    return mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": robust,
            "integrator": integrator or {"type": "fspt_integral"},
            "camera": sensor or lens(),
            **{f"shape_{k}": shape for k, shape in enumerate(shapes)},
        }
    )


def ball(exitance=1e-3, radius=5.0, center=(0.0, 0.0, 0.0)):
    """A glowing sphere."""
    return {"type": "sphere", "radius": radius, "center": list(center), "emitter": glow(exitance)}


LENS_XML = """
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/>
        <float name="f_number" value="$f_number"/>
        <float name="magnification" value="0.5"/>
        <float name="pixel_pitch" value="0.8"/>
        <transform name="to_world"><lookat origin="$distance, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/>
            <integer name="height" value="6"/>
            <string name="pixel_format" value="luminance"/>
        </film>
    </sensor>"""

BALL_XML = """
    <shape type="sphere">
        <float name="radius" value="3"/>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""


def write_scene(path, *, sensor=LENS_XML, shapes=BALL_XML, integrator='<integrator type="fspt_integral"/>', more=""):
    """Path of a scene file with the parameters f_number and distance, of these parts."""
    path.write_text(
        f"""<scene version="3.0.0">
    <default name="f_number" value="8"/>
    <default name="distance" value="165"/>
    {integrator}{sensor}{shapes}{more}
</scene>
"""
    )
    return path
