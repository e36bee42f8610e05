"""
The matrix in PyLops
====================

J_n of the nylon cylinder from four images, with a TransportMatrix as an operator of PyLops: `pip install pylops`.
"""

import matplotlib.pyplot as plt
import numpy as np
import pylops

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

SCENE = FOLDER / "nylon_cylinder.xml"
SMALL = {"width": 24, "height": 24, "pixel_pitch": 1.152, "f_number": 2.8, "rtol": 1e-2}

T = fspt.transport(SCENE, view=[0, 90, 180, 270], **SMALL)
images = [fspt.render(fspt.load(SCENE, view=view, **SMALL)) for view in (0, 90, 180, 270)]
power = T.images(images).ravel() * 1e12  # pW
found = pylops.optimization.basic.lsqr(pylops.aslinearoperator(T), power, niter=20)[0] / 1e12

_, panels = plt.subplots(2, 4, figsize=(11, 5))
for k, (given, fitted) in enumerate(zip(power.reshape(T.image_shape), T.forward(found) * 1e12, strict=True)):
    panels[0, k].imshow(given, cmap="inferno")
    panels[1, k].imshow(fitted, cmap="inferno", vmax=given.max())
panels[0, 0].set_ylabel("given")
panels[1, 0].set_ylabel("fitted")

# %%
# The fit reproduces the images.
misfit = np.linalg.norm(T @ found - power / 1e12) / np.linalg.norm(power / 1e12)
print(f"{T}: misfit {misfit:.1e} of the images")
assert misfit < 0.01
