"""J_n of the nylon cylinder from four images, with a TransportMatrix as an operator of PyLops: `pip install pylops`."""

import numpy as np
import pylops

import mitsuba_fspt as fspt

SCENE, SMALL = "scenes/nylon_cylinder.xml", {"width": 32, "height": 32, "pixel_pitch": 0.864, "f_number": 2.8}

T = fspt.transport(SCENE, view=[0, 90, 180, 270], **SMALL)
images = [fspt.render(fspt.load(SCENE, view=view, **SMALL)) for view in (0, 90, 180, 270)]
power = T.images(images).ravel() * 1e12  # pW
found = pylops.optimization.basic.lsqr(pylops.aslinearoperator(T), power, niter=20)[0] / 1e12
misfit = np.linalg.norm(T @ found - power / 1e12) / np.linalg.norm(power / 1e12)
print(f"{T}: misfit {misfit:.1e} of the pictures")
