"""Tuning values of the path solver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CandidateSettings:
    """Local optima at the points of a path (`stiffopt.paths.candidates`).

    Attributes
    ----------
    knots : points at which new local optima are looked for.
    starts, starts_loaded : samples near the target that are tried at each of them.
    kept : most candidates at a point, the best ones.
    same : candidates are the same that differ in no channel by more than this share of its range.
    general_knots, general_starts, general_kept : where there is no machine code.
    """

    knots: int = 24
    starts: int = 24
    starts_loaded: int = 8
    kept: int = 6
    same: float = 0.01
    general_knots: int = 3
    general_starts: int = 2
    general_kept: int = 2


@dataclass(frozen=True)
class LaneSettings:
    """Further configurations along a path (`stiffopt.paths.candidates.lanes`).

    Attributes
    ----------
    knots : points at which they are spread over all that reach the target.
    starts : samples that are brought to the target at each of them.
    kept : most of them that are followed, in either direction.
    marks : points from one to the next of which they are followed.
    iterations : to bring them to a target.
    apart : least distance of a new one from the others, as a share of a channel's range.
    alike : where they are nearer to each other than this, one is enough.
    """

    knots: int = 8
    starts: int = 128
    kept: int = 40
    apart: float = 0.1
    alike: float = 0.02
    marks: int = 48
    iterations: int = 4


@dataclass(frozen=True)
class RouteSettings:
    """Search over sequences of candidates (`stiffopt.paths.route`).

    Attributes
    ----------
    crossings : points of a path at which a crossing to another branch may begin.
    ends : points at which crossings from one of them may end, about.
    lengths : of a crossing, times the least number of steps that the rates allow.
    nearest : candidates to which crossings lead from another, for each length.
    rounds, first_rounds : in which crossings are computed; and before anything else is tried.
    price : by which a crossing counts as worse than it is: small, so that none is idle.
    within : share of a rate that crossings use.
    hardly : gain of the logarithm of stiffness for which no crossing is computed; and of its mean
    hardly_on_average : where the worst is maximised.
    enough : share of what the points alone could have, from which on nothing else is tried.
    """

    crossings: int = 40
    ends: int = 40
    lengths: tuple[float, ...] = (1.0, 1.5, 2.5)
    nearest: int = 6
    rounds: int = 100
    first_rounds: int = 8
    price: float = 1e-3
    within: float = 0.98
    hardly: float = 2e-3
    hardly_on_average: float = 2e-2
    enough: float = 0.99


@dataclass(frozen=True)
class RefinementSettings:
    """Joint optimisation of neighbouring points (`stiffopt.paths.refinement`).

    Attributes
    ----------
    near : share of a rate from which on it counts as holding back.
    margin : points on either side of those that a rate holds back.
    iterations : at most.
    radius : of the trust region, as a share of a channel's range.
    last_radius : at which the method ends.
    last_gain : of the objective, below which it ends.
    price : of what a constraint lacks, as a share of the arm's length or in rad.
    aside : of obstacles, more than the clearance that is asked, in m.
    mean : weight of the mean stiffness where the worst is maximised.
    difference : of pressures, for second derivatives.
    inside : share of the tolerances and rates that is used, so that rounding stays within them.
    """

    near: float = 0.9
    margin: int = 8
    iterations: int = 12
    radius: float = 0.1
    last_radius: float = 1e-3
    last_gain: float = 1e-4
    price: float = 100.0
    aside: float = 1e-6
    mean: float = 1e-2
    difference: float = 1e-5
    inside: float = 1 - 1e-4


@dataclass(frozen=True)
class RateSettings:
    """Rates and times.

    Attributes
    ----------
    rounding : relative excess over a rate that is rounding.
    largest_step : of a channel between two points, as a share of its range, where no rate or no
        time says more.
    slowest : times slower that a path is tried that is too fast.
    clearance_between : by how much the body may be nearer between two points before the message
        says so, in m.
    few_points : up to which a path does not wait for machine code.
    least_time : between two points, in s.
    """

    rounding: float = 1e-9
    largest_step: float = 0.1
    slowest: float = 64.0
    clearance_between: float = 5e-5
    few_points: int = 5
    least_time: float = 1e-3


CANDIDATES = CandidateSettings()
LANES = LaneSettings()
ROUTE = RouteSettings()
REFINEMENT = RefinementSettings()
RATES = RateSettings()
