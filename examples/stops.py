"""
Full stops
==========

Each full stop halves the area of the diaphragm, and with it the power on the film. Parts out of focus become sharper.
"""

from itertools import pairwise

import matplotlib.pyplot as plt

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

STOPS = [2.8, 2.8 * 2**0.5, 5.6, 5.6 * 2**0.5]
small = {"width": 64, "height": 64, "pixel_pitch": 0.432, "view": 90}
images = [fspt.render(fspt.load(FOLDER / "nylon_cylinder.xml", f_number=n, **small), rtol=1e-2) for n in STOPS]

_, panels = plt.subplots(1, len(STOPS), figsize=(14, 3.2))
for panel, image, stop in zip(panels, images, STOPS, strict=True):
    image.plot(panel, log=True)
    panel.set_title(f"f/{stop:.1f}")

# %%
# Ratio of the total power from stop to stop.
ratios = [after.total_power / before.total_power for before, after in pairwise(images)]
print("power per full stop:", ", ".join(f"{ratio:.3f}" for ratio in ratios))
assert all(abs(ratio - 0.5) < 0.01 for ratio in ratios)
