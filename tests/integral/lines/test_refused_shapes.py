"""Shapes and BSDFs that Mitsuba cannot evaluate are refused in one line."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from small_scenes import ball, glow, lens, mi, world_scene, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import SceneError

METHODS = ({}, {"method": "path", "spp": 4})
CURVE = "0 -8 -5 1.5\n0 0 0 2\n0 8 5 1\n0 9 0 1\n"


@pytest.mark.parametrize("settings", METHODS)
def test_a_glowing_linear_curve_is_refused(tmp_path, settings):
    """Seen to fail: 'Shape::eval_parameterization(): not implemented!'; a B-spline renders."""
    (tmp_path / "curve.txt").write_text(CURVE)
    scene, other = (
        world_scene({"type": kind, "filename": str(tmp_path / "curve.txt"), "emitter": glow()}, sensor=lens(size=8))
        for kind in ("linearcurve", "bsplinecurve")
    )
    with pytest.raises(SceneError, match=r"shape 'shape_0' is a linearcurve, .* Give a bsplinecurve") as refused:
        fspt.render(scene, **settings)
    assert "\n" not in str(refused.value)
    assert fspt.render(other, **settings).power.max() > 0


def test_a_glowing_linear_curve_is_refused_on_the_command_line(run, tmp_path):
    (tmp_path / "curve.txt").write_text(CURVE)
    curve = """
    <shape type="linearcurve" id="wire">
        <string name="filename" value="curve.txt"/>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""
    code, _, err = run("render", write_scene(tmp_path / "s.xml", shapes=curve), "-o", tmp_path / "o.exr")
    assert code == 2
    assert "scene: shape 'wire' is a linearcurve" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "o.exr").exists()


@pytest.mark.parametrize("settings", METHODS)
@pytest.mark.parametrize("coat", [None, {"type": "mask", "opacity": 0.5}])
def test_a_bump_map_without_a_gradient_is_refused(coat, settings):
    """Seen to fail: 'dr.while_loop(): encountered an exception'; a bitmap has a gradient.

    Of the bitmap two pairs are rendered: by the integral without a coat, by `path` with one.
    """
    heights = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((4, 4, 1), 0.5, np.float32))}

    def scene(texture):
        bumps = {"type": "bumpmap", "texture": texture, "nested": {"type": "conductor"}}
        bsdf = coat | {"nested": bumps} if coat else bumps
        mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([-9, 0, 0]).rotate([0, 1, 0], 90)}
        return world_scene(ball(), mirror | {"bsdf": bsdf}, sensor=lens(size=8))

    gc.collect()  # Dr.Jit also traces the BSDFs of scenes that wait to be deleted
    if bool(coat) == bool(settings):
        assert fspt.render(scene(heights), **settings).power.max() > 0
    with pytest.raises(SceneError, match=r"bumpmap of shape 'shape_1' has a Checkerboard, .* Give it a bitmap"):
        fspt.render(scene({"type": "checkerboard"}), **settings)
