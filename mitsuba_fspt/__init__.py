"""Free-space photon transport as a Mitsuba 3 plugin package: calibrated CCD images of glowing tissue.

    import mitsuba_fspt as fspt
    scene = fspt.load("scenes/nylon_cylinder.xml", f_number=8)
    image = fspt.render(scene, rtol=1e-4)
    image.write("front.exr")

Units: mm, W, sr, rad, s; one scene unit is 1 mm. `exitance` J_n [W/mm²], `radiance` J_n/π [W/mm²/sr], `power` [W] on
one pixel. Importing sets no Mitsuba variant and loads no Mitsuba; the plugins `fspt_surface`, `fspt_lens` and
`fspt_integral` register with whatever JIT variant is set, before or after.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from . import backend

if TYPE_CHECKING:
    from .comparison import Comparison as Comparison
    from .comparison import compare as compare
    from .convergence import Convergence as Convergence
    from .converging import converge as converge
    from .detector import Detector as Detector
    from .detector import Exposure as Exposure
    from .errors import FsptError as FsptError
    from .explanation import explain as explain
    from .flux_import import import_flux as import_flux
    from .image import Image as Image
    from .image import read as read
    from .phantom import Phantom as Phantom
    from .rendering import render as render
    from .scene import load as load
    from .sweeping import sweep as sweep

_HOMES = {
    "load": "scene",
    "render": "rendering",
    "Image": "image",
    "read": "image",
    "compare": "comparison",
    "Comparison": "comparison",
    "converge": "converging",
    "Convergence": "convergence",
    "Detector": "detector",
    "Exposure": "detector",
    "Phantom": "phantom",
    "import_flux": "flux_import",
    "sweep": "sweeping",
    "explain": "explanation",
    "FsptError": "errors",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    """Public names on first use: an import alone stays under a tenth of a second."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


backend.prepare()
