"""Free-space photon transport as a Mitsuba 3 plugin package: calibrated CCD images, in W on each pixel."""

from . import backend

backend.prepare()
