"""Accuracy of `invert`: the bounds of its minima, of variances and weight, and of the number of unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field

from .mlem import MlemAccuracy
from .nonnegative import Accuracy


@dataclass(frozen=True)
class Hopeless:
    """When a first fit counts as hopeless: all of the first three hold, or the first and the three from `alone` on.

    chi2 : least Σ (residual/σ)² over free pixels
    share : least residual, root of the sum of squares, over that of the image: pose and order of views leave tenths of
        it, errors of the model with many electrons a few hundredths
    gain : least χ² with some times as many unknowns, over that with few: where the unknowns are too coarse for J_n, χ²
        falls by the fourth power of their distance, to a fourth or less
    alone : largest residual of the four neighbours, on average, over that of a pixel by itself: cosmic rays and hot
        pixels, where light is spread over neighbours by the lens and by the size of the unknowns
    rest, few : most of χ² that is left without those pixels, and the largest share of them among all
    rounds : most rounds of variances and weight of the fit that follows, which no accuracy would help
    """

    chi2: float = 5.0
    share: float = 0.1
    gain: float = 0.5
    alone: float = 0.25
    rest: float = 0.5
    few: float = 0.01
    rounds: int = 10


@dataclass(frozen=True)
class Settings:
    """Accuracy of `invert`.

    accuracy : of the minimum
    mlem : of the maximum likelihood
    drawn : of the minima of random draws, and while variances and weight are sought; a decrement of 0.01 widens an
        interval by at most 0.5 %
    reweighted : relative change of the standard deviations, root mean square, at which they count as converged; it
        changes χ² by as much
    rounds, roughly : most rounds of variances and weight, and of those of a first fit
    averaged : rounds after which variances of Monte Carlo images are means over the rounds since
    weight : change of log(weight) at which it counts as converged: 1/10 of its own uncertainty for 200 determined
        unknowns
    probes : random vectors for the number of determined unknowns, whose relative error is about (2/(probes γ))^½
    responses : fits of `mlem` where the pixels' response has an error, each with that error's share of the light of the
        fit before it
    first : weight to begin with, over that at which data and penalty have the same trace
    darkest : of the reference, the least ρ of the penalty: below it J_n is no better known than its noise
    seen : of the largest sensitivity per area, the least at which a vertex counts as seen
    block : samples that are computed together
    threads : blocks that are computed at the same time
    columns : for each right-hand side, unknowns at 0 up to which their columns of the inverse take less time than
        factors of the matrix without them
    unknowns : most of them to begin with; of a finer mesh, J_n is linear between some of its vertices (Eq. M.30)
    resolved : least number of unknowns for each one that the data determine; with fewer, and a finer mesh, the fit
        begins anew with two to four times as many. What is finer than these unknowns makes up (2/π)/`resolved` of the
        variance of a vertex, which intervals then lack: 8 %, or 4 % of their width.
    hopeless : when the images count as not those of the surface, after a first fit on few unknowns
    fine : standard deviations of a sum of J_n by which a linear J_n on faces may change it, on the edges that a
        warning of a coarse mesh names
    rough : times the bounds of variances and weight, the bounds of the first fit, whose J_n only scales the penalty
    """

    accuracy: Accuracy = field(default_factory=Accuracy)
    mlem: MlemAccuracy = field(default_factory=MlemAccuracy)
    drawn: Accuracy = field(default_factory=lambda: Accuracy(decrement=0.01, inner=0.1))
    reweighted: float = 1e-3
    rounds: int = 20
    roughly: int = 8
    averaged: int = 4
    weight: float = 0.01
    probes: int = 8
    responses: int = 3
    first: float = 100.0
    darkest: float = 0.05
    seen: float = 0.01
    block: int = 25
    threads: int = 2
    columns: int = 100
    unknowns: int = 6000
    resolved: float = 8.0
    hopeless: Hopeless = field(default_factory=Hopeless)
    fine: float = 0.5
    rough: float = 10.0
