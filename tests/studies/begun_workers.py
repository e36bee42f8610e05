"""How worker processes of a sweep begin in the tests, in a module that imports neither Mitsuba nor the tests."""

from __future__ import annotations

import os
import time


def hold_all_but_the_first_point():
    """From here on this process renders other points only once there is a file 'go' in the current folder."""
    from mitsuba_fspt.studies.point_renderer import PointRenderer

    image = PointRenderer.image

    def held(self, point):
        while point.label != "f_number=2.8 distance=165" and not os.path.exists("go"):
            time.sleep(0.01)
        return image(self, point)

    PointRenderer.image = held


def begin_held(threads, main):
    """How a process begins whose points but the first are held."""
    from mitsuba_fspt.studies import sweep_workers

    hold_all_but_the_first_point()
    sweep_workers._begin(threads, main)


def end_at_once(threads, main):
    """How a process begins that ends before it renders a point."""
    os._exit(1)
