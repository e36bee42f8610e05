"""
J_n from a VTU
==============

Another code wrote J_n on a surface as a VTU. It becomes a phantom, a scene framed on it, and an image. Needs
the extra `mesh`.
"""

import tempfile
from pathlib import Path

import meshio
import numpy as np
import trimesh

import mitsuba_fspt as fspt

folder = Path(tempfile.mkdtemp())
sphere = trimesh.creation.icosphere(subdivisions=4, radius=8)
jn = 1e-4 * (1.2 + sphere.vertices[:, 0] / 8)  # W/mm², brightest towards the camera on +x
meshio.Mesh(sphere.vertices, [("triangle", sphere.faces)], point_data={"jn": jn}).write(folder / "other_code.vtu")

# %%
# The import checks orientation, unit and sign. On the command line:
# `fspt flux import other_code.vtu --field jn -o phantom.ply`.
phantom = fspt.import_flux(folder / "other_code.vtu", field="jn")
phantom.write(folder / "phantom.ply")
camera = {"focal_length": 50, "f_number": 1.8, "width": 96, "height": 96, "pixel_pitch": 0.1}
image = fspt.render(fspt.load(fspt.scene_xml(folder / "phantom.ply", **camera)), rtol=1e-2)
image.plot()

# %%
# The power of the surface is ∫ J_n dS: by symmetry that of the mean 1.2e-4 W/mm² on 4π R².
found = float(sphere.area_faces @ phantom.exitance[sphere.faces].mean(axis=1))
expected = 1.2e-4 * 4 * np.pi * 8**2
print(f"{found:.5g} W on the mesh, {expected:.5g} W on the sphere")
assert abs(found / expected - 1) < 0.005
