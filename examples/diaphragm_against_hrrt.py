"""
With and without a diaphragm
============================

The HRRT model has no diaphragm: the whole lens collects light. At f/8, a lens of 30 mm collects
(30/6.875)² = 19 times the power of the paper's model, and the blur is 4.4 times wider.
"""

import matplotlib.pyplot as plt

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

text = (FOLDER / "nylon_cylinder.xml").read_text(encoding="utf-8")
text = text.replace('"nylon_cylinder.ply"', f'"{FOLDER / "nylon_cylinder.ply"}"')
marker = '<float name="focal_length" value="$focal_length"/>'
model = '<string name="model" value="hrrt"/> <float name="lens_diameter" value="30"/>'
small = {"width": 64, "height": 64, "pixel_pitch": 0.432, "f_number": 8, "view": 90}
diaphragm = fspt.render(fspt.load(text, **small), rtol=1e-2)
hrrt = fspt.render(fspt.load(text.replace(marker, f"{marker} {model}"), **small), rtol=1e-2)

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
diaphragm.plot(left, log=True)
left.set_title("diaphragm, f/8")
hrrt.plot(right, log=True)
right.set_title("HRRT, 30 mm")

# %%
# The ratio of the powers is that of the areas, but for the angles of the lines of sight (cos⁴θ).
ratio = hrrt.total_power / diaphragm.total_power
areas = (30 / (55 / 8)) ** 2
print(f"power {ratio:.2f} times, areas {areas:.2f} times")
assert abs(ratio / areas - 1) < 0.03
