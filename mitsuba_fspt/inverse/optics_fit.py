"""Uncertain optical coefficients of the tissue, fitted along with the sources (Eq. M.49).

Each coefficient is its nominal value times 1 + s x, with its stated relative standard deviation s and x normal, of the
mean 0 and the variance 1. The images are linear in x about the last values; the fit of the sources takes x for noise
that pixels have in common, and gives x; the tissue is then made with it, and all is done again until x stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..optics.media import Medium
from ..runtime.progress_bar import Progress
from ..tissue.diffusion import Tissue
from ..tissue.phantom_file import COEFFICIENTS, Spread
from .band_images import BandImages, of_each
from .source_fit import PointSources, SourceFit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OpticsSettings:
    """Accuracy of the fit of coefficients.

    rounds : largest number of fits, each with the last coefficients;  change : of every x, at which they end
    step : relative change of a coefficient, for slopes
    least : least factor of a coefficient, whatever the images ask for
    """

    rounds: int = 6
    change: float = 0.05
    step: float = 1e-4
    least: float = 0.1


@dataclass(frozen=True)
class Coefficient:
    """Coefficient of the tissue that images were fitted with: `value` and `sd`, in 1/mm for mua and musp.

    sd : with the errors of the equation itself (Eq. M.51), which may make it larger than the stated one
    """

    value: float
    sd: float


@dataclass(frozen=True)
class Unknown:
    """Uncertain coefficient: number of its band, number of its region, its key (mua, musp, n), its relative sd."""

    band: int
    region: int
    key: str
    sd: float

    def name(self, bands: Sequence[BandImages]) -> str:
        """Name in the result, such as "mua", "red.mua", "regions.0.mua", "red.regions.0.mua"."""
        band = bands[self.band].name
        region = f"regions.{self.region - 1}." if self.region else ""
        return ("" if band is None else f"{band}.") + region + self.key


def unknowns(spreads: Sequence[Sequence[Spread]]) -> list[Unknown]:
    """The uncertain coefficients, of `spreads` of each band's regions."""
    return [
        Unknown(band, region, key, getattr(spread, key))
        for band, regions in enumerate(spreads)
        for region, spread in enumerate(regions)
        for key in COEFFICIENTS
        if getattr(spread, key) > 0
    ]


class OpticsFit:
    """Fit of uncertain coefficients around a fit of sources, whose tissues it replaces."""

    def __init__(
        self, fit: SourceFit, uncertain: Sequence[Unknown], report: Progress, settings: OpticsSettings | None = None
    ) -> None:
        self._fit, self._uncertain, self._report = fit, list(uncertain), report
        self._settings = settings or OpticsSettings()
        self._nominal = [band.tissue.media for band in fit.bands]
        self.x = np.zeros(len(self._uncertain))

    def refined(self, found: PointSources) -> PointSources:
        """The sources with the coefficients that fit best, from the sources for the nominal ones."""
        for turn in range(self._settings.rounds):
            self._report("optics", turn / self._settings.rounds)
            changes = self._changes(found)
            self._fit.uncertain, self._fit.offset = changes, changes @ self.x
            found = self._fit.minimum(found.positions, found.radii)
            before, self.x = self.x, self._fit.common(found)[-len(self.x) :]
            if np.abs(self.x - before).max() < self._settings.change:
                break
            self._fit.bands = self._bands(self.x)
            self._fit.offset = changes @ self.x
        return self._fit.minimum(found.positions, found.radii).sorted()

    def coefficients(self, found: PointSources) -> dict[str, Coefficient]:
        """The coefficients by their names, with standard deviations that contain those of the sources."""
        count = len(self._uncertain)
        sd = self._fit.joint_sd(found)[-count:]
        result = {}
        for one, x, s in zip(self._uncertain, self._fit.common(found)[-count:], sd, strict=True):
            nominal = self._of(one)
            result[one.name(self._fit.bands)] = Coefficient(nominal * self._factor(one, x), nominal * one.sd * float(s))
        return result

    def _of(self, one: Unknown) -> float:
        return float(getattr(self._nominal[one.band][one.region], one.key))

    def _factor(self, one: Unknown, x: float) -> float:
        """Factor of a coefficient; n stays >= 1."""
        least = 1 / self._of(one) if one.key == "n" else self._settings.least
        return max(1 + one.sd * float(x), least)

    def _media(self, x: Array) -> list[list[Medium]]:
        """Media of each band for these x."""
        media = [list(of_band) for of_band in self._nominal]
        for one, value in zip(self._uncertain, x, strict=True):
            own = media[one.band]
            own[one.region] = replace(own[one.region], **{one.key: self._of(one) * self._factor(one, value)})
        return media

    def _bands(self, x: Array) -> list[BandImages]:
        """The bands with tissues for these x."""
        each = zip(self._fit.bands, self._media(x), strict=True)
        return [replace(band, tissue=band.tissue.of_media(media)) for band, media in each]

    def _changes(self, found: PointSources) -> Array:
        """(N, P) change of the power on the pixels [W] with each x, for these sources: one more solution for each."""
        changes = np.zeros((len(found.signal), len(self._uncertain)))
        bands = self._fit.bands
        columns = [[column for column, one in enumerate(self._uncertain) if one.band == k] for k in range(len(bands))]

        def of_band(band: BandImages, own: list[int]) -> Array:
            uncertain = [self._uncertain[column] for column in own]
            if not uncertain:
                return np.empty((len(band.rows), 0))
            change = band.changes(found.sources, [self._other(band, one) for one in uncertain])
            return change * [one.sd for one in uncertain] / self._settings.step

        for own, part, change in zip(columns, self._fit.parts, of_each(of_band, bands, columns), strict=True):
            changes[part, own] = change
        return changes

    def _other(self, band: BandImages, one: Unknown) -> Tissue:
        """Tissue of a band with one coefficient changed by `step` of its nominal value."""
        media = list(band.tissue.media)
        medium = media[one.region]
        value = getattr(medium, one.key) + self._settings.step * self._of(one)
        media[one.region] = replace(medium, **{one.key: value})
        return band.tissue.of_media(media)
