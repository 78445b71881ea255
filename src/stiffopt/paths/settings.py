"""Tuning values of the path solver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CandidateSettings:
    """Search for local optima at the points of a path (`stiffopt.paths.candidates`)."""

    knots: int = 24  # number of points at which new local optima are sought
    # starts, starts_loaded: number of samples near the target from which each search starts, for a
    # free and for a loaded arm; half of them where each optimum is found more than once
    starts: int = 24
    starts_loaded: int = 8
    kept: int = 6  # largest number of candidates at a point
    # candidates that differ by less than this share of the range in all channels count as one
    same: float = 0.01


@dataclass(frozen=True)
class LaneSettings:
    """Further configurations along a path (`stiffopt.paths.lanes`)."""

    # knots, last_knots: number of points of a region at which new configurations are spread over
    # all that reach the target; the second in the last attempt
    knots: int = 4
    last_knots: int = 8
    starts: int = 128  # number of samples that are brought to the target at each knot
    kept: int = 40  # largest number of configurations that are followed in either direction
    # largest distance from each at which new ones are sought, as a share of a channel's range
    aside: float = 0.15
    # smallest distance of a new one from the others, as a share of a channel's range
    apart: float = 0.1
    alike: float = 0.02  # distance below which one of two followed configurations is dropped
    # largest number of points of a region at which they are followed, one after another
    marks: int = 32
    every: int = 4  # number of points from one mark to the next, if that makes fewer marks


@dataclass(frozen=True)
class RouteSettings:
    """Search over sequences of candidates (`stiffopt.paths.route`)."""

    # number of points of a path at which a crossing to another branch may begin
    crossings: int = 40
    ends: int = 40  # approximate number of points at which crossings from one of them may end
    # of a crossing, relative to the smallest number of steps that the rates allow
    lengths: tuple[float, ...] = (1.0, 1.5, 2.5)
    nearest: int = 6  # number of candidates to which crossings lead from another, for each length
    # rounds, rounds_in_scene: largest number of rounds in which crossings are computed, without and
    # with a scene
    rounds: int = 300
    rounds_in_scene: int = 100
    few_rounds: int = 16  # the same with a scene if a sequence is known already
    first_rounds: int = 8  # the same before further configurations are added
    # repeats, few_repeats: largest number of searches for a sequence on which the body keeps clear:
    # for the best one, and for any
    repeats: int = 100
    few_repeats: int = 20
    # largest number of further candidates at a point where slower paths are sought
    few_further: int = 30
    refined: int = 2  # largest number of sequences that are refined where there is no scene
    price: float = 1e-3  # small penalty on a crossing, which prevents useless ones
    within: float = 0.98  # share of a rate that crossings use
    sweeps: int = 6  # largest number of times that the points of a sequence are moved one by one
    hardly: float = 2e-3  # gain in the logarithm of stiffness for which no crossing is computed
    hardly_on_average: float = 2e-2  # the same for the mean, where the worst value is maximised
    enough: float = 0.99  # share of the single points' stiffness from which the search stops
    nearly_all: float = 0.999  # the same, from which a sequence is not refined
    # smallest number of points on both sides of a gap between branches, at which further
    # configurations are sought
    margin: int = 8
    widths: tuple[int, ...] = (1, 2, 5, 10)  # of the regions in each attempt, relative to that
    # share of the missing stiffness by which a sequence should become better at once
    better: float = 0.3


@dataclass(frozen=True)
class RefinementSettings:
    """Joint optimisation of neighbouring points (`stiffopt.paths.refinement`)."""

    near: float = 0.9  # share of a rate from which on the rate counts as binding
    margin: int = 8  # number of points added on either side of those where a rate binds
    # iterations, iterations_in_scene: largest number, without and with a scene
    iterations: int = 60
    iterations_in_scene: int = 10
    corrections: int = 2  # largest number for each step
    radius: float = 0.1  # initial radius of the trust region, as a share of a channel's range
    last_radius: float = 1e-3  # radius below which the method stops
    last_gain: float = 1e-4  # gain in the objective below which the method stops
    # penalty per violation of a constraint, as a share of the arm's length or in rad
    price: float = 100.0
    aside: float = 1e-6  # clearance kept beyond the required one, in m
    mean: float = 1e-2  # weight of the mean stiffness where the worst is maximised
    # step of finite differences for second derivatives, as a share of a channel's range
    difference: float = 1e-5
    inside: float = 1 - 1e-4  # share of the rates that is used, so that rounding stays within them
    # share of the tolerances that a step aims at; the rest is for its curvature
    of_tolerance: float = 0.98
    # largest number of times that windows are made, each time three times as long where rates bind
    # at their ends
    passes: int = 4


@dataclass(frozen=True)
class QuickeningSettings:
    """Smaller steps for a path that is too fast (`stiffopt.paths.quickening`)."""

    iterations: int = 40  # largest number
    # radius, last_radius: of the trust region at first, and at which the method stops, as shares of
    # a channel's range
    radius: float = 0.05
    last_radius: float = 1e-3
    last_gain: float = 1e-3  # gain in the share of the steps below which the region shrinks
    enough: float = 0.995  # share of the steps at which the method stops
    corrections: int = 3  # largest number for each step
    damping: float = 1e-4  # weight of the squared change of a pressure, as a share of its range


@dataclass(frozen=True)
class RateSettings:
    """Rates and times."""

    rounding: float = 1e-9  # relative excess over a rate that counts as rounding
    # of a channel between two points, as a share of its range, if rates or times are unknown
    largest_step: float = 0.1
    clearance_between: float = 5e-5  # allowed loss of clearance between two points, in m
    # largest number of points for which the solver does not wait for machine code
    few_points: int = 5
    least_time: float = 1e-3  # shortest time between two points, in s


CANDIDATES = CandidateSettings()
WITHOUT_MACHINE_CODE = CandidateSettings(knots=3, starts=2, starts_loaded=2, kept=2)
LANES = LaneSettings()
ROUTE = RouteSettings()
REFINEMENT = RefinementSettings()
QUICKENING = QuickeningSettings()
RATES = RateSettings()
