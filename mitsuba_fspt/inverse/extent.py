"""Radii of located sources, as spheres that glow uniformly: profiles of the likelihood (Eq. M.50).

Outside of a sphere of radius a the free field of a component with the decay constant k is that of a point in its centre
times 3 i₁(ka)/(ka) = 1 + (ka)²/10 + …: images show a radius where k differs between bands, or, under SP3, where the
sphere comes within a mean free path or two of the border. Positions and powers are fitted anew for each radius tried.
"""

from __future__ import annotations

from bisect import bisect, bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import InversionError
from ..runtime.progress_bar import Progress
from .common_noise import beyond_independent
from .source_fit import PointSources, SourceFit

Array = NDArray[np.float64]
SHAPES = ("point", "sphere")


@dataclass(frozen=True)
class ExtentSettings:
    """Accuracy of the radii.

    radii : those that are tried first, over the distance of the centre from the border, up to one that is too large
    beyond : rise of -2 ln L above its least value at which the search over radii ends
    even : of -2 ln L, the fall that counts: below it the smaller radius stays, and the search for the least value ends
    steps : most radii that are tried in a search
    rounds : of the radii, where there are several sources, and of the ends of an interval, where a likelier radius is
        found on the way
    close : of the root of the rise of -2 ln L at an end of the interval, the relative distance to interpolate over
    union : number of radii in the interval, even in the square, over which the intervals of the values are joined
    """

    radii: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95)
    beyond: float = 25.0
    even: float = 0.05
    steps: int = 8
    rounds: int = 2
    close: float = 0.1
    union: int = 65


@dataclass(frozen=True, eq=False)
class Extent:
    """Radius of a source [mm] with its interval, and the ends (4,) of the intervals of x, y, z [mm] and power [W].

    The interval starts at 0 where the images do not show that the source is no point. It ends at the distance of the
    centre from the border where they exclude no sphere.
    """

    radius: float
    interval: tuple[float, float]
    low: Array
    high: Array


class Profile:
    """-2 ln L over the squared radius of source `number`; the radii of the others stay.

    -2 ln L is smooth in the squared radius, about a parabola, and has a slope at 0.
    """

    def __init__(self, fit: SourceFit, found: PointSources, number: int, z: float, settings: ExtentSettings) -> None:
        self._fit, self._found, self._number, self._z, self._settings = fit, found, number, z, settings
        self.limit = fit.bands[0].depth(found.positions[number])
        self._known: list[tuple[float, PointSources]] = []  # by the squared radius
        self._top = False  # True where no larger radius lies inside the tissue
        while self._climb() and self._rise(-1) <= settings.beyond:
            pass
        self._search()
        self._wide, self._ends = self._interval()

    @property
    def best(self) -> PointSources:
        """Sources of the likeliest radius."""
        return self._known[self._least()][1]

    def extent(self) -> Extent:
        """The radius, and intervals of all radii whose -2 ln L rises by at most z², with the values they give.

        z grows by the share of the errors of the equation itself in the variance of the squared radius. The values are
        the union over all these radii, not over the known ones alone: for a parabola, and values b a² with the standard
        deviation s, it ends z (s² + b² var a²)^½ from the best value, at a radius between the best one and an end.
        """
        z, wide, ends = self._z, self._wide, self._ends
        own = slice(4 * self._number, 4 * self._number + 4)
        squares = np.linspace(ends[0], min(ends[1], self._known[-1][0]), self._settings.union)
        values, sd = (each[:, own] for each in self._values(squares))
        rise = np.array([self._rise_at(q) for q in squares])
        half = z * np.sqrt(np.maximum(1 - rise / wide**2, 0.0))[:, None] * sd
        radius = self._known[self._least()][0] ** 0.5
        low, high = (values - half).min(axis=0), (values + half).max(axis=0)
        return Extent(radius, (ends[0] ** 0.5, ends[1] ** 0.5), low, high)

    def _interval(self) -> tuple[float, tuple[float, float]]:
        """Rise at the ends, as its root, and the ends [mm²]; again where one was found that is likelier."""
        for _ in range(self._settings.rounds):
            least, wide = self.best, self._z * (1 + self._by_model()) ** 0.5
            low, high = self._end(wide, -1), self._end(wide, 1)
            if self.best is least:
                break
            self._search()
        return wide, (low or 0.0, self.limit**2 if high is None else high)

    def _climb(self) -> bool:
        """Try the next of the radii; False where there is none inside the tissue."""
        squares = [(share * self.limit) ** 2 for share in self._settings.radii]
        larger = [q for q in squares if not self._known or q > self._known[-1][0]]
        self._top = self._top or not (larger and self._try(larger[0]))
        return not self._top

    def _try(self, square: float) -> bool:
        """Fit with this squared radius; False where there is none inside the tissue."""
        at = bisect([q for q, _ in self._known], square)
        near = self._known[max(at - 1, 0)][1] if self._known else self._found
        radii = self._found.radii.copy()
        radii[self._number] = square**0.5
        try:
            self._known.insert(at, (square, self._fit.minimum(near.positions, radii)))
        except InversionError:
            if not self._known:
                raise
            return False
        return True

    def _least(self) -> int:
        """Number of the known radius of the least -2 ln L, of a smaller one where they differ by too little."""
        values = np.array([one.unlikelihood for _, one in self._known])
        return int(np.flatnonzero(values < values.min() + self._settings.even)[0])

    def _rise(self, index: int) -> float:
        """-2 ln L of a known radius, over the least one."""
        return float(self._known[index][1].unlikelihood - min(one.unlikelihood for _, one in self._known))

    def _rise_at(self, square: float) -> float:
        """The rise at a squared radius, by linear interpolation of its root between known ones."""
        squares = [q for q, _ in self._known]
        return float(np.interp(square, squares, [self._rise(k) ** 0.5 for k in range(len(squares))])) ** 2

    def _search(self) -> None:
        """Try radii at the vertex of the parabola through the three about the least -2 ln L, while it falls."""
        if len(self._known) == 2:  # half the radius
            self._try(self._known[1][0] / 4)
        for _ in range(self._settings.steps):
            middle = min(max(int(np.argmin([one.unlikelihood for _, one in self._known])), 1), len(self._known) - 2)
            if middle < 1:
                return
            q, u = zip(*((q, one.unlikelihood) for q, one in self._known[middle - 1 : middle + 2]), strict=True)
            curve = np.polyfit(np.array(q) - q[1], np.array(u) - min(u), 2)
            if curve[0] <= 0:
                return
            vertex = min(max(-curve[1] / (2 * curve[0]), q[0] - q[1]), q[2] - q[1])
            if -np.polyval(curve, vertex) < self._settings.even or not self._try(float(vertex) + q[1]):
                return

    def _end(self, z: float, way: int) -> float | None:
        """Squared radius below (way -1) or above the best one where -2 ln L has risen by z²; None: there is none."""
        inner = self._least()
        outer = inner
        while self._rise(outer) < z**2:
            outer += way
            if outer < 0 or (outer == len(self._known) and not self._climb()):
                return None
        a, b = self._known[outer - way][0], self._known[outer][0]
        for _ in range(self._settings.steps):
            rise = [self._rise_at(q) ** 0.5 for q in (a, b)]
            square = a + (b - a) * (z - rise[0]) / (rise[1] - rise[0])
            if min(abs(one / z - 1) for one in rise) < self._settings.close or not self._try(square):
                break
            a, b = (square, b) if self._rise_at(square) < z**2 else (a, square)
        return float(square)

    def _values(self, squares: Array) -> tuple[Array, Array]:
        """(N, 4K) values of the sources and their sd for squared radii, linear between known ones."""
        known = np.array([q for q, _ in self._known])
        first = max(bisect(known, squares.min()) - 1, 0)
        near = slice(first, max(bisect_left(known, squares.max()), first) + 1)
        values, sd = list[Array](), list[Array]()
        for _, one in self._known[near]:
            noise = self._fit.covariance(one)
            beyond = self._fit.by_model(one, noise) + self._fit.by_common(one, noise)
            values.append(one.values)
            sd.append(np.sqrt(np.diag(noise + beyond)))
        along = [np.array([np.interp(squares, known[near], x) for x in np.transpose(one)]).T for one in (values, sd)]
        return along[0], along[1]

    def _by_model(self) -> float:
        """Variance of the squared radius by errors of the equation itself, and by noise that images have in common
        beyond that of as much noise without, over that by the images' noise as independent.
        """
        at = self._least()
        other = at - 1 if at else min(at + 1, len(self._known) - 1)
        (q, one), (p, two) = self._known[at], self._known[other]
        errors, common = one.noise.over(self._fit.model_errors(one)), self._fit.in_common(one)
        if p == q or not (errors.size or any(part.deviation.any() for part in common)):
            return 0.0
        along = one.noise.over((two.signal - one.signal) / (p - q))
        beside = np.linalg.qr(one.slopes)[0]
        along -= beside @ (beside.T @ along)
        along /= np.linalg.norm(along)
        extra = float(beyond_independent(common, one.noise.from_pixels(along[:, None]))[0, 0])
        return float(((along @ errors) ** 2).sum()) + extra


def with_radii(
    fit: SourceFit, found: PointSources, z: float, report: Progress, settings: ExtentSettings | None = None
) -> tuple[PointSources, list[Profile]]:
    """The sources as spheres with the likeliest radii, and the profile of each, in the order of `found`.

    Intervals are those of `z` standard deviations.
    """
    settings = settings or ExtentSettings()
    count, profiles = len(found.powers), list[Profile]()
    for turn in range(settings.rounds if count > 1 else 1):
        before, profiles = found.radii, []
        for k in range(count):
            report("radius", (turn + k / count) / settings.rounds)
            profiles.append(Profile(fit, found, k, z, settings))
            found = profiles[-1].best
        if np.allclose(found.radii, before):
            break
    return found, profiles
