"""
The matrix in CIL
=================

A TransportMatrix as an operator of CIL, which installs from conda: `conda install -c ccpi cil`.
"""

import numpy as np
from cil.framework import VectorGeometry
from cil.optimisation.algorithms import LSQR
from cil.optimisation.operators import LinearOperator

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER


class Transport(LinearOperator):
    """P = T J between CIL's data containers."""

    def __init__(self, matrix):
        super().__init__(VectorGeometry(matrix.shape[1]), VectorGeometry(matrix.shape[0]))
        self.matrix = matrix

    def direct(self, x, out=None):
        """Power on the pixels."""
        return self._filled(self.range, self.matrix @ x.as_array(), out)

    def adjoint(self, x, out=None):
        """The transpose."""
        return self._filled(self.domain, self.matrix.T @ x.as_array(), out)

    def _filled(self, geometry, values, out):
        out = geometry.allocate(0) if out is None else out
        out.fill(values.astype(np.float32))
        return out


T = fspt.transport(FOLDER / "nylon_cylinder.xml", view=[0, 90, 180, 270], width=32, height=32, pixel_pitch=0.864)
operator = Transport(T)
power = operator.direct(operator.domain.allocate(1e-3))
solver = LSQR(initial=operator.domain.allocate(0), operator=operator, data=power)
solver.run(20)
print(solver.solution.as_array().max())
misfit = float(abs(T @ solver.solution.as_array() - power.as_array()).max() / power.as_array().max())
assert misfit < 0.05
