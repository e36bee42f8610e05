"""J_n as a bitmap whose bright texels are smaller than pixels."""

from __future__ import annotations

import numpy as np
import pytest
from little_scenes import lens, mi, scene_of

import mitsuba_fspt as fspt
from mitsuba_fspt.plugins.exitance import texels_of


def one_bright_texel(side, tiles=1):
    """A bitmap of side² texels of which one is 1 W/mm², `tiles` times along u and v."""
    data = np.zeros((side, side, 1), np.float32)
    data[side // 8, side // 5] = 1
    to_uv = mi.ScalarTransform4f().scale([tiles, tiles, 1])
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": True, "filter_type": "nearest", "to_uv": to_uv}


SHAPES = {
    "sphere": {"type": "sphere", "radius": 9.0},
    "cylinder": {"type": "cylinder", "p0": [0, 0, -9], "p1": [0, 0, 9], "radius": 9.0},
    "disk": {"type": "disk", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale(9)},
}


@pytest.mark.parametrize("tiles", [3, 8])
@pytest.mark.parametrize("kind", SHAPES)
def test_bright_texels_of_a_tiled_bitmap_keep_their_light(kind, tiles):
    """Expected: the power of the surface form, which begins at the texels.

    Seen to fail where texels are counted once, whatever `to_uv` (black, or a third missing), and where spots on a
    slanted surface are taken for its limb (the cylinder, a third missing).
    """
    emitter = {"type": "fspt_surface", "exitance": one_bright_texel(32, tiles)}
    scene = scene_of(SHAPES[kind] | {"emitter": emitter}, sensor=lens(size=(24, 20), pitch=0.6, f_number=4.0))
    pupil, surface = (fspt.render(scene, domain=domain, rtol=1e-2, max_nodes=4000) for domain in ("pupil", "surface"))
    assert surface.power.sum() > 0
    assert pupil.power.sum() == pytest.approx(surface.power.sum(), rel=1e-2)


def test_texels_are_counted_as_often_as_they_lie_on_the_surface():
    assert texels_of(mi.load_dict(one_bright_texel(32, 3))) == 9 * 32**2
    assert texels_of(mi.load_dict(one_bright_texel(32))) == 32**2
    assert texels_of(mi.load_dict({"type": "uniform", "value": 1.0})) == 1


def test_a_single_texel_of_four_million_is_not_refused():
    """Rationale: points all over the shape may miss it, and J_n passed for zero everywhere."""
    emitter = {"type": "fspt_surface", "exitance": one_bright_texel(1 << 11)}
    scene = scene_of(SHAPES["disk"] | {"emitter": emitter}, sensor=lens(size=8))
    assert np.isfinite(fspt.render(scene, max_nodes=4).power).all()
