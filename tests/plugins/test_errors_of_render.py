"""Plain `mi.render`: whatever ends it, the last line says what to do."""

from __future__ import annotations

import subprocess
import sys

import pytest
from small_scenes import ball, glow, lens, mi, world_scene

from mitsuba_fspt.runtime.errors import ExitanceError, SceneError

INSIDE = """
import mitsuba_fspt
import mitsuba as mi
for variant in ("llvm_ad_rgb", "llvm_ad_mono"):
    mi.set_variant(variant)
film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance"}
numbers = {"focal_length": 55.0, "f_number": 8.0, "magnification": 0.5, "pixel_pitch": 0.8}
glow = {"type": "fspt_surface", "exitance": 1.0}
mi.render(mi.load_dict({
    "type": "scene", "integrator": {"type": "fspt_integral"}, "camera": {"type": "fspt_lens", "film": film, **numbers},
    "body": {"type": "sphere", "radius": 5.0, "emitter": glow},
}))
"""


def test_the_last_line_is_the_reason():
    """Seen to fail: 'RuntimeError: drjit.custom(…): error while performing … (see above)' stood last."""
    done = subprocess.run([sys.executable, "-c", INSIDE], capture_output=True, text=True)
    *_, last = done.stderr.splitlines()
    assert last.startswith("mitsuba_fspt.runtime.errors.SceneError: fspt_lens: the lens stands inside the phantom")
    assert "drjit.custom" not in done.stderr


def test_errors_of_this_package_can_be_caught_by_their_class(mono):
    with pytest.raises(SceneError, match="inside the phantom") as caught:
        mi.render(world_scene(ball(radius=300.0)))
    assert caught.value.__context__ is None
    with pytest.raises(ExitanceError, match="must be >= 0"):
        mi.render(world_scene(ball(exitance=-1.0)))


def test_errors_of_others_stay_as_they_are(mono):
    class Broken(mi.ad.integrators.common.ADIntegrator):
        def render(self, *_, **__):
            raise KeyError("of its own")

    scene = world_scene({"type": "sphere", "emitter": glow()}, sensor=lens(4))
    with pytest.raises(RuntimeError, match=r"drjit\.custom") as caught:
        mi.render(scene, integrator=Broken(mi.Properties()))
    assert isinstance(caught.value.__cause__, KeyError)


def test_an_image_is_returned_as_before(mono):
    picture = mi.render(world_scene(ball(), sensor=lens(8)), seed=3)
    assert picture.shape == (8, 8, 1)
    assert mi.render.__name__ == "render"
    assert "spp_grad" in mi.render.__doc__
