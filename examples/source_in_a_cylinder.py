"""
A source inside a cylinder
==========================

Position and power of a point source in a cylinder of tissue, from images of its surface. Needs the extra `tissue`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.tissue.phantom_file import PhantomFile

PHANTOM = """
[geometry]
shape = "cylinder"
radius = 6
height = 14
[optical]
mua = 0.03
musp = 1.0
n = 1.37
[[sources]]
shape = "point"
centre = [2.5, 1.0, -1.0]
power = 2e-9
[mesh]
edge = 1.3
order = 2
[output]
edge = 0.9
"""
TRUE = np.array([2.5, 1.0, -1.0])  # mm
VIEWS = [0, 90, 180, 270]
folder = Path(tempfile.mkdtemp())
(folder / "phantom.toml").write_text(PHANTOM, encoding="utf-8")
described = PhantomFile.read(folder / "phantom.toml")
described.solve().phantom(described.surface_edge).write(folder / "phantom.ply")

# %%
# Images of four views and their electrons; then position and power from the electrons.
camera = {"focal_length": 55, "f_number": 2.8, "width": 32, "height": 32, "pixel_pitch": 0.25}
scene = folder / "phantom.xml"
scene.write_text(fspt.scene_xml(folder / "phantom.ply", **camera), encoding="utf-8")
detector = fspt.Detector.typical_ccd()
images = [fspt.render(fspt.load(scene, view=view), rtol=1e-3) for view in VIEWS]
exposures = [detector.expose(image, exposure_time=0.5, wavelength_nm=660, seed=1) for image in images]
matrix = fspt.transport(scene, view=VIEWS, rtol=1e-2)
found = fspt.locate(described, matrix, exposures)

_, panels = plt.subplots(1, 4, figsize=(12, 3))
for panel, exposure, view in zip(panels, exposures, VIEWS, strict=True):
    panel.imshow(exposure.electrons, cmap="inferno")
    panel.set_title(f"view {view}°")

# %%
# The distance to the true position; the images were computed with the same finite elements, on a mesh of its own.
distance = float(np.linalg.norm(found.sources[0].position - TRUE))
print(
    f"{found.sources[0].position.round(3)} mm, {distance:.3f} mm from the source; power {found.sources[0].power:.3g} W"
)
assert distance < 0.1
