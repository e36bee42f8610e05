"""
Exit laws against Monte Carlo
=============================

By Fresnel's law, less light leaves tissue of n = 1.37 at grazing angles than by Lambert's. Integral and Monte Carlo
agree.
"""

import matplotlib.pyplot as plt

import mitsuba_fspt as fspt

SPHERE = """
    <shape type="sphere"> <float name="radius" value="8"/>
        <emitter type="fspt_surface"> <float name="exitance" value="1e-4"/> {law} </emitter>
    </shape>"""
SCENE = """
<scene version="3.0.0">
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/> <float name="f_number" value="4"/>
        <float name="magnification" value="0.5"/> <float name="pixel_pitch" value="0.2"/>
        <transform name="to_world"> <lookat origin="173, 0, 0" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="48"/> <integer name="height" value="48"/> </film>
    </sensor> {sphere}
</scene>"""
LAWS = {
    "Lambert": "",
    "Fresnel, n = 1.37": '<string name="emission" value="fresnel"/> <float name="int_ior" value="1.37"/>',
}

_, axes = plt.subplots(figsize=(6, 3.6))
for name, law in LAWS.items():
    scene = fspt.load(SCENE.format(sphere=SPHERE.format(law=law)))
    image = fspt.render(scene, method="integral", rtol=1e-3)
    monte_carlo = fspt.render(scene, method="path", spp=256, seed=1)
    image.plot_profile(row=24, axes=axes)
    ratio = monte_carlo.total_power / image.total_power
    print(f"{name}: Monte Carlo over integral {ratio:.4f}")
    assert abs(ratio - 1) < 2e-3, name
axes.legend([line for line in axes.lines], list(LAWS))
