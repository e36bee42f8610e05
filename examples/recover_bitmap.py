"""
A bitmap recovered
==================

J_n of a textured sphere as a bitmap, from one image, by gradients of plain `mi.render` in an optimisation loop.

    python examples/recover_bitmap.py [PIXELS [STEPS]]
"""

import sys

import mitsuba_fspt as fspt  # first: it finds the LLVM that Dr.Jit needs  # isort: skip
import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

from mitsuba_fspt.phantom.shipped_scenes import FOLDER

given = [int(word) for word in sys.argv[1:]]
size, steps = given + [16, 25][len(given) :]
scene = fspt.load(FOLDER / "textured_sphere.xml", width=size, height=size, pixel_pitch=256 * 0.108 / size)
picture = mi.render(scene)
unit = float(np.max(picture))

key = "sphere.emitter.exitance.data"
parameters = mi.traverse(scene)
truth = np.array(parameters[key])
parameters[key] = mi.TensorXf(np.zeros((32, 64, 1), np.float32))  # dark
parameters.update()
optimiser = mi.ad.Adam(lr=1.0, params={key: parameters[key]})  # of the order of J_n [W/mm²]
for _ in range(steps):
    optimiser[key] = dr.maximum(optimiser[key], 0)  # J_n >= 0
    parameters.update(optimiser)
    dr.backward(dr.mean(dr.square((mi.render(scene, parameters) - picture) / unit), axis=None))
    optimiser.step()

# %%
# The image of the bitmap that was found, against the given one.
_, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4))
left.imshow(np.array(picture)[..., 0], cmap="inferno")
left.set_title("given")
right.imshow(np.array(mi.render(scene))[..., 0], cmap="inferno")
right.set_title("found")

misfit = float(np.linalg.norm(np.array(mi.render(scene)) - np.array(picture)) / np.linalg.norm(picture))
print(f"misfit {misfit:.1e} of the picture; brightest {np.max(parameters[key]):.3g} of {truth.max():.3g} W/mm²")
assert misfit < 0.3
