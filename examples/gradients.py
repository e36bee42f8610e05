"""
Gradients with `mi.ad`
======================

`mi.render` is differentiable in every number behind `exitance`. Power is linear in J_n, so that J_n · dP/dJ_n = P.
"""

import mitsuba_fspt as fspt  # first: it finds the LLVM that Dr.Jit needs  # isort: skip
import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

from mitsuba_fspt.phantom.shipped_scenes import FOLDER

size = 48
scene = fspt.load(FOLDER / "nylon_cylinder.xml", width=size, height=size, pixel_pitch=256 * 0.108 / size)
parameters = mi.traverse(scene)
key = "phantom.vertex_exitance"
dr.enable_grad(parameters[key])
parameters.update()
image = mi.render(scene, parameters)
total = dr.sum(image, axis=None)
dr.backward(total)

# %%
# The gradient is the power on the film per J_n of a vertex [mm²]: how much each vertex contributes.
gradient = np.array(dr.grad(parameters[key]))
exitance = np.array(dr.detach(parameters[key]))
vertices = np.array(dr.detach(parameters["phantom.vertex_positions"])).reshape(-1, 3)
_, axes = plt.subplots(figsize=(5, 4))
dots = axes.scatter(vertices[:, 1], vertices[:, 2], c=gradient, s=1, cmap="viridis")
axes.set(xlabel="y [mm]", ylabel="z [mm]", aspect="equal")
axes.figure.colorbar(dots, label="dP/dJ_n [mm²]")

power = float(np.sum(np.array(dr.detach(image))))
print(f"sum of J_n dP/dJ_n {gradient @ exitance:.6g} W, power {power:.6g} W")
assert abs(gradient @ exitance / power - 1) < 1e-3
