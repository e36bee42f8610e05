"""What a scene that failed to load leaves behind must not touch the next one; each trial in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest
from small_scenes import BALL_XML, LENS_XML, write_scene

FAILING = {
    "a shape": {"shapes": BALL_XML.replace("<emitter", '<float name="colour" value="1"/><emitter')},
    "a lens": {"sensor": LENS_XML.replace("$f_number", "0")},
    "another shape": {"more": '<shape type="ply"><string name="filename" value="gone.ply"/></shape>'},
    "its own light": {"shapes": BALL_XML.replace("1e-3", "-1e-3")},
}
TRIAL = """
import gc, sys
import mitsuba_fspt as fspt
gc.disable()  # what is left over stays until it is collected, which may be much later
kept = []
for _ in range(3):
    try:
        fspt.render("bad.xml")
    except fspt.FsptError as error:
        kept.append(error)
assert len(kept) == 3
settings = {"method": "path", "spp": 4} if sys.argv[1] == "path" else {}
print(fspt.render(fspt.load("good.xml"), **settings).power.max())
"""


@pytest.mark.parametrize(
    ("what", "method"),
    [("a shape", "integral"), ("a lens", "path"), ("another shape", "integral"), ("its own light", "path")],
)
def test_a_scene_that_failed_leaves_the_next_one_alone(tmp_path, what, method):
    """Its emitter may outlive its shape, which Dr.Jit has it look for; seen to crash the process."""
    write_scene(tmp_path / "good.xml")
    write_scene(tmp_path / "bad.xml", **FAILING[what])
    trial = [sys.executable, "-c", TRIAL, method]
    done = subprocess.run(trial, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout) > 0
