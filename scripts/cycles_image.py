"""Image of a glowing mesh by Blender's Cycles, with the depth of field of its thin lens; runs in Blender's own Python.

    PYTHON scripts/cycles_image.py INPUT.npz OUTPUT.exr

PYTHON has the package bpy (`pip install bpy`), which does not share a process with Mitsuba: scripts/comparisons.py
starts it. INPUT.npz has `vertices` (V, 3) [mm], `faces` (F, 3), `exitance` (V,), and the numbers `focal_length`,
`f_number`, `focus`, `distance` [mm] of a lens on the +x axis that looks at the origin, `side` of the field in the plane
in focus [mm], `pixels` a side, `spp`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

MM = 1e-3  # Blender's lengths are metres; focal length and sensor are in mm


def main() -> None:
    source, target = sys.argv[1:]
    with np.load(source) as given:
        numbers = {name: given[name] for name in given.files}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    glowing_mesh(scene, numbers)
    lens(scene, numbers)
    settings(scene, numbers, Path(target).resolve())
    bpy.ops.render.render(write_still=True)


def glowing_mesh(scene: Any, numbers: dict[str, np.ndarray]) -> None:
    """The mesh, whose emission is its attribute `exitance`."""
    mesh = bpy.data.meshes.new("phantom")
    mesh.from_pydata((numbers["vertices"] * MM).tolist(), [], numbers["faces"].tolist())
    attribute = mesh.attributes.new("exitance", "FLOAT", "POINT")
    attribute.data.foreach_set("value", np.float32(numbers["exitance"] / numbers["exitance"].max()))
    material = bpy.data.materials.new("glow")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    read, glow, out = (nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "Emission", "OutputMaterial"))
    read.attribute_name = "exitance"
    material.node_tree.links.new(read.outputs["Fac"], glow.inputs["Strength"])
    material.node_tree.links.new(glow.outputs["Emission"], out.inputs["Surface"])
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("phantom", mesh))


def lens(scene: Any, numbers: dict[str, np.ndarray]) -> None:
    """A camera with the same field, focus and diaphragm."""
    focal, focus = float(numbers["focal_length"]), float(numbers["focus"])
    camera = bpy.data.cameras.new("camera")
    camera.lens = focal
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = focal * float(numbers["side"]) / focus
    camera.clip_start = 1 * MM
    camera.dof.use_dof = True
    camera.dof.focus_distance = focus * MM
    camera.dof.aperture_fstop = float(numbers["f_number"])
    place = bpy.data.objects.new("camera", camera)
    place.location = (float(numbers["distance"]) * MM, 0, 0)
    place.rotation_euler = (np.pi / 2, 0, np.pi / 2)  # looks along -x, z is up
    scene.collection.objects.link(place)
    scene.camera = place


def settings(scene: Any, numbers: dict[str, np.ndarray], target: Path) -> None:
    """Direct light alone, a box filter, no tone curve; float32 EXR."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples, cycles.max_bounces, cycles.pixel_filter_type = int(numbers["spp"]), 0, "BOX"
    cycles.filter_width = 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    render = scene.render
    render.resolution_x = render.resolution_y = int(numbers["pixels"])
    render.resolution_percentage = 100
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.filepath = str(target)
    scene.view_settings.view_transform = "Raw"


if __name__ == "__main__":
    main()
