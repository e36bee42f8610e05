"""Free-space photon transport as a Mitsuba 3 plugin package: calibrated CCD images of glowing tissue.

    import mitsuba_fspt as fspt
    scene = fspt.load("scenes/nylon_cylinder.xml", f_number=8)
    image = fspt.render(scene, rtol=1e-4)
    image.write("front.exr")

Units: mm, W, sr, rad, s; one scene unit is 1 mm. `exitance` J_n [W/mm²], `radiance` J_n/π [W/mm²/sr], `power` [W] on
one pixel. Importing sets no Mitsuba variant and loads no Mitsuba; the plugins `fspt_surface`, `fspt_lens` and
`fspt_integral` register with whatever JIT variant is set, before or after. The public names, which `__init__.pyi`
lists, load on first use.
"""

import lazy_loader

from .runtime import backend as _backend


def _register_plugins() -> None:
    from . import plugins

    plugins.register()


_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """A public name, imported on first use, or the version of the installed package."""
    if name != "__version__":
        return _public(name)
    from importlib.metadata import version

    return version("mitsuba-fspt")


_backend.prepare(_register_plugins)
