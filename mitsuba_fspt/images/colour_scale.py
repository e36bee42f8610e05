"""Colour scale of pictures: its ends, linear or logarithmic, and the quantity and unit at the colour bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import ImageError

if TYPE_CHECKING:
    from matplotlib.colors import Normalize

DIM = 20.0  # ratio of peaks, or of limits, above which the scale is logarithmic; on a linear one 1/20 is nearly black
DECADES = 3  # of a logarithmic scale below the peak of the dimmest image


@dataclass(frozen=True)
class ColourScale:
    """Values at the ends of a colour bar.

    low, high : [unit], low < high
    log : logarithmic scale, low > 0
    quantity, unit : what the values are
    """

    low: float
    high: float
    log: bool = False
    quantity: str = "power"
    unit: str = "W/pixel"

    @classmethod
    def over(
        cls,
        powers: Sequence[NDArray],
        *,
        log: bool = False,
        limits: tuple[float, float] | None = None,
        quantity: str = "power",
        unit: str = "W/pixel",
    ) -> ColourScale:
        """Scale that shows all `powers`, arrays of any shape [unit].

        log : True asks for a logarithmic scale; it is chosen as well where the peaks of the images, or the `limits`,
            differ by more than a factor of `DIM`, unless all images are dark
        limits : (low, high) [unit]; None: 0, or `DECADES` below the peak of the dimmest image, to the largest power

        Raises
        ------
        ImageError : limits that are not finite and increasing, or not > 0 on a logarithmic scale.
        """
        named = (quantity, unit)
        peaks = [float(power.max()) for power in powers if power.max() > 0]
        if limits is not None:
            low, high = limits
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ImageError(f"picture: the range must be A < B in {unit}, got {low:g},{high:g}. Give 0,1e-9.")
            if log and low <= 0:
                raise ImageError(
                    f"picture: the range of a log scale must begin above 0 {unit}, got {low:g}. Give 1e-12,1e-9."
                )
            return cls(low, high, log or (low > 0 and high > DIM * low), *named)
        if not peaks:
            return cls(0.0, 1.0, False, *named)
        if not (log or max(peaks) > DIM * min(peaks)):
            return cls(0.0, max(peaks), False, *named)
        least = min(float(power[power > 0].min()) for power in powers if power.max() > 0)
        low = max(least, min(peaks) / 10**DECADES)
        return cls(low if low < max(peaks) else max(peaks) / 10, max(peaks), True, *named)

    @property
    def factor(self) -> float:
        """Value [unit] that corresponds to 1 on the colour bar: a power of 1000, and 1 on a logarithmic scale."""
        return 1.0 if self.log else scale_and_unit(np.array([self.low, self.high]))[0]

    @property
    def label(self) -> str:
        """Quantity and unit, for the colour bar."""
        if self.log:
            return f"{self.quantity} [{self.unit}], log scale"
        return f"{self.quantity} [{scale_and_unit(np.array([self.high]), self.unit)[1]}]"

    def values(self, power: NDArray) -> NDArray:
        """Values in units of `factor`; on a logarithmic scale at least a tenth of the lower end, also for zeros."""
        return (np.maximum(power, self.low / 10) if self.log else power) / self.factor

    def norm(self) -> Normalize:
        """Matplotlib's norm of the scaled values."""
        from matplotlib.colors import LogNorm, Normalize

        return (LogNorm if self.log else Normalize)(self.low / self.factor, self.high / self.factor)


def scale_and_unit(values: NDArray, unit: str = "W/pixel") -> tuple[float, str]:
    """Power of 1000 that scales the largest of `values` [unit] to 1 … 1000, and the unit with that factor."""
    peak = float(np.abs(values).max())
    exponent = 3 * math.floor(math.log10(peak) / 3) if peak > 0 else 0
    return 10.0**exponent, unit if exponent == 0 else rf"$10^{{{exponent}}}$ {unit}"
