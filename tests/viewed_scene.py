"""The small scene of the viewer's tests, and the command that serves it."""

from __future__ import annotations

import signal
import subprocess
import sys

SCENE = """<scene version="3.0.0">
    <default name="f_number" value="4"/> <default name="turn" value="0"/> <default name="rtol" value="1e-3"/>
    <integrator type="fspt_integral"><float name="rtol" value="$rtol"/></integrator>
    <sensor type="fspt_lens">
        <float name="focal_length" value="50"/> <float name="f_number" value="$f_number"/>
        <float name="focus_distance" value="150"/> <float name="pixel_pitch" value="0.25"/>
        <float name="lens_diameter" value="40"/>
        <transform name="to_world"><lookat origin="160, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="40"/></film>
    </sensor>
    <shape type="rectangle" id="sheet">
        <transform name="to_world">
            <scale x="4" y="6"/><rotate y="1" angle="90"/><rotate z="1" angle="$turn"/>
        </transform>
        <emitter type="fspt_surface"><float name="exitance" value="2"/></emitter>
    </shape>
</scene>"""


def serve(scene, *more):
    """Process of `fspt view`, and the address that it prints."""
    command = [sys.executable, "-m", "mitsuba_fspt", "view", str(scene), "--no-browser", *more]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    address = process.stdout.readline().split()
    if not address:
        raise RuntimeError(process.stderr.read())
    return process, address[0]


def interrupt(process):
    """Ctrl-C: exit code and stderr."""
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    return process.returncode, errors
