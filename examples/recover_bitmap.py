"""J_n of a textured sphere as a bitmap, from one image, by gradients of plain `mi.render` in an optimisation loop."""

import sys

import mitsuba_fspt as fspt  # first: it finds the LLVM that Dr.Jit needs  # isort: skip
import drjit as dr
import mitsuba as mi
import numpy as np

size, steps = (int(n) for n in (*sys.argv[1:], 64, 100)[:2])
scene = fspt.load("scenes/textured_sphere.xml", width=size, height=size, pixel_pitch=256 * 0.108 / size)
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

misfit = float(np.linalg.norm(np.array(mi.render(scene)) - np.array(picture)) / np.linalg.norm(picture))
print(f"misfit {misfit:.1e} of the picture; brightest {np.max(parameters[key]):.3g} of {truth.max():.3g} W/mm²")
