"""
Noise of a camera
=================

Electrons of a cooled CCD at growing exposure times. Without read noise the variance of a pixel is its mean.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

scene = fspt.load(FOLDER / "uniform_disk.xml", width=64, height=64, pixel_pitch=0.432)
image = fspt.render(scene, rtol=1e-3).scaled(1e-13)
detector = fspt.Detector.typical_ccd()
TIMES = [1, 3, 10, 30, 100]  # s

means, variances = [], []
lit = image.power > 0.5 * image.power.max()
for time in TIMES:
    first, second = (
        detector.expose(image, exposure_time=time, wavelength_nm=660, seed=seed).electrons for seed in (1, 2)
    )
    means.append(np.mean(first[lit] + second[lit]) / 2)
    variances.append(np.mean((first[lit] - second[lit]) ** 2) / 2)

_, axes = plt.subplots(figsize=(5, 3.6))
axes.loglog(means, variances, "o", label="pairs of exposures")
axes.loglog(means, np.array(means) + detector.read_noise**2, label="mean + read noise²")
axes.set(xlabel="mean [e⁻]", ylabel="variance [e⁻²]")
axes.legend()

# %%
# Photon transfer: variance − read noise² over the mean is 1.
slope = (variances[-1] - detector.read_noise**2) / means[-1]
print(f"variance over mean at {means[-1]:.0f} electrons: {slope:.3f}")
assert abs(slope - 1) < 0.1
