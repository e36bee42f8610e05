"""
Mirrors and a window
====================

Two mirrors show three sides of a phantom in one image. A window of glass before the lens lets 2n/(n² + 1) of
the light pass.
"""

import matplotlib.pyplot as plt

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

mirrors = fspt.render(fspt.load(FOLDER / "mirror_rig.xml", width=192, height=64, pixel_pitch=0.135), rtol=1e-2)
_, axes = plt.subplots(figsize=(9, 3.2))
mirrors.plot(axes, log=True)

# %%
# A pane of n = 1.5 between disk and lens. Reflections inside the pane are followed, so that T = 2n/(n² + 1) = 0.923 for
# light along the normal.
PANE = """
    <shape type="rectangle">
        <transform name="to_world">
            <scale value="60"/> <lookat origin="80, 0, 0" target="180, 0, 0" up="0, 0, 1"/>
        </transform>
        <bsdf type="thindielectric"> <float name="int_ior" value="1.5"/> </bsdf>
    </shape>
</scene>"""
text = (FOLDER / "uniform_disk.xml").read_text(encoding="utf-8")
small = {"width": 32, "height": 32, "pixel_pitch": 0.864, "f_number": 8}
free, behind = (
    fspt.render(fspt.load(xml, **small), rtol=1e-3) for xml in (text, text.replace("</scene>", PANE.lstrip("\n")))
)
ratio = behind.power[16, 16] / free.power[16, 16]
print(f"transmittance of the pane {ratio:.4f}, expected {2 * 1.5 / (1.5**2 + 1):.4f}")
assert abs(ratio - 0.92308) < 1e-3
