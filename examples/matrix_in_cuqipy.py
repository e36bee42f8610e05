"""
The matrix in CUQIpy
====================

A TransportMatrix as the linear model of a Bayesian problem, as CUQIpy takes it: `pip install cuqipy`.
"""

import numpy as np
from cuqi.model import LinearModel

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

T = fspt.transport(FOLDER / "nylon_cylinder.xml", view=[0, 180], width=32, height=32, pixel_pitch=0.864, f_number=2.8)
model = LinearModel(lambda x: T @ x, adjoint=lambda y: T.T @ y, range_geometry=T.shape[0], domain_geometry=T.shape[1])
exitance = np.full(T.shape[1], 1e-3)
power = np.asarray(model.forward(exitance))
print(f"{power.sum():.3e} W, transpose {np.asarray(model.adjoint(power)).max():.3e}")
assert abs(power.sum() / (T.sensitivity @ exitance) - 1) < 1e-9  # column sums
