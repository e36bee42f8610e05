"""Lambert's law: equal radiance in all outward directions (Eq. 1)."""

from __future__ import annotations

from typing import ClassVar

import drjit as dr
import mitsuba as mi

from . import ExitLaw


class Lambert(ExitLaw):
    """Radiance L = J_n/π in all outward directions (Eq. 1), since ∫ cosθ dΩ over the hemisphere is π."""

    isotropic: ClassVar[bool] = True

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """1/π [1/sr]."""
        return mi.Float(dr.inv_pi)
