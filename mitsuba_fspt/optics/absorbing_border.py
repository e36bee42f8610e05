"""What absorption changes of the border's numbers in the SP3 equations (Eq. M.53), from the transport equation.

A half space as in `half_space`, with absorption; lengths in mean free paths 1/(µa + µs'). Transport gives the share of
the diffusing light that the border reflects and the flux that leaves; the flux of φ₂ per φ₁ and φ₂ is that of Marshak's
condition. H_11 with which the SP3 equations reflect the same share, for light that varies as exp(ikx) along the border,
is H_11(0) + τ k²; the flux that leaves is that of SP3 times 1 - a k²/(1 + b k²). `half_space` gives these numbers
without absorption; here are their changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import eigh

from .half_space import HIGH, LOW, TYPICAL, half_space
from .sp3_boundary import LARGEST, sp3_boundary, sp3_coefficients

STRONG = 0.1  # µa/µs' at which the changes are computed
NONE = 1e-4  # µa/µs' of tissue "without absorption", in which the diffusing light still decays
AXIAL = 1e-3  # k of light that does not vary along the border
LEAST_FLOW = 1e-3  # share of the light: less flows along the border of an index of about 1, and stays as it is


@dataclass(frozen=True)
class Absorbing:
    """Changes at µa/µs' = `STRONG`: `shift` is added to H_11 times the square of µa/µs' over `STRONG`; τ, a and b in
    mean free paths are multiplied by 1 + `lateral`, `flow`, `spread` times µa/µs' over `STRONG`.
    """

    shift: float
    lateral: float
    flow: float
    spread: float

    def at(self, absorption: float) -> tuple[float, float, float, float]:
        """Number that is added to H_11, and the factors of τ, a and b, at µa/µs' = `absorption`."""
        share = min(absorption, LARGEST) / STRONG
        lateral, flow, spread = (1 + share * change for change in (self.lateral, self.flow, self.spread))
        return self.shift * share**2, lateral, flow, spread


@cache
def absorbing(n: float, g: float) -> Absorbing:
    """Changes for the relative index n >= 1 and the anisotropy g; raises FluxError as `sp3_boundary`."""
    before, after = (_numbers(n, g, absorption) for absorption in (NONE, STRONG))
    changes = (new / old - 1 if old > 0 else 0.0 for old, new in zip(before[1:], after[1:], strict=True))
    return Absorbing(after[0] - before[0], *changes)


def _numbers(n: float, g: float, absorption: float) -> tuple[float, float, float, float]:
    """H_11(0), τ, a and b."""
    first, typical = (matched(n, g, absorption, k)[0] for k in (AXIAL, TYPICAL))
    low, high = (1 - matched(n, g, absorption, k)[1] for k in (LOW, HIGH))
    lateral = (typical - first) / TYPICAL**2
    if not LEAST_FLOW < low < high:
        return first, lateral, 0.0, 0.0
    spread = max((low / LOW**2 - high / HIGH**2) / (high - low), 0.0)
    return first, lateral, low / LOW**2 + spread * low, spread


def matched(n: float, g: float, absorption: float, k: float) -> tuple[float, float]:
    """H_11 with which SP3 reflects as much diffusing light as transport, and the flux that leaves over that of SP3."""
    light = half_space(n, g, k, absorption)
    mua, musp = np.array([[absorption], [1.0]]) / (1 + absorption)
    c, reaction = (each[0] for each in sp3_coefficients(mua, musp, np.array([g])))
    squares, modes = eigh(reaction, np.diag(c))
    kept, layer = (mode / (mode @ [1, -2 / 3]) for mode in modes.T)  # of the fluence 1
    rate, decay = np.sqrt(squares + k**2)
    matrix = sp3_boundary(n, g)
    # The second equation gives the amplitude of the light that decays near the border, the first one then H_11.
    rises, both = (1 - light.back) * rate * kept, (1 + light.back) * kept
    amplitude = (c[1] * rises[1] - matrix[1] @ both) / (matrix[1] @ layer + c[1] * decay * layer[1])
    outward = c[0] * (rises[0] - amplitude * decay * layer[0])
    value = both + amplitude * layer
    return float((outward - matrix[0, 1] * value[1]) / value[0]), light.flux / float(outward)
