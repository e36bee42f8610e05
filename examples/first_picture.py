"""
A first picture
===============

The paper's nylon cylinder with a light source inside, from the left at f/2.8, in watts per pixel.
"""

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER  # the scenes of the package

scene = fspt.load(FOLDER / "nylon_cylinder.xml", f_number=2.8, view=90, width=128, height=128, pixel_pitch=0.216)
image = fspt.render(scene, rtol=1e-3)
image.plot(log=True)

# %%
# The error that the integral states is at most `rtol` of the brightest pixel.
largest = image.error.max() / image.power.max()
print(f"{image.total_power:.4g} W on the film; largest error {largest:.1e} of the brightest pixel")
assert largest <= 1.001e-3
