"""Tuning values of the optimiser, grouped by method.

The variables of all methods are pressures as shares of each channel's range, so that steps and
distances mean the same for a channel of 0.2 bar and for one of 10 bar.  The methods in C (folder
``native``) take the same values.
"""

from dataclasses import dataclass, field
from typing import NamedTuple


@dataclass(frozen=True)
class ReachSettings:
    """Levenberg-Marquardt method that brings pressures to the target (`optimise.reach`)."""

    longest_step: float = 2 / 3  # of a pressure, as a share of its range
    # damping, least_damping, most_damping: initial value, and range of its adaptation
    damping: float = 2.25e-4
    least_damping: float = 2e-10
    most_damping: float = 2e6
    least_progress: float = 1e-9  # share of the misfit that a step must promise
    iterations: int = 40  # for a single start, such as a guess
    iterations_of_many: int = 20  # for each of many starts


@dataclass(frozen=True)
class ReachInContactSettings:
    """Method that brings pressures to a target in contact (`optimise.reach_in_contact`)."""

    iterations: int = 15  # to the target, and as many to the contacts' demands
    # first_radius, least_radius: of the trust region, as shares of the pressures' ranges
    first_radius: float = 2 / 3
    least_radius: float = 1e-5
    damping: float = 1e-4  # of a step
    inside: float = 0.9  # share of tolerances and demands that is aimed at
    kept: float = 0.1  # share of the contact force that a step must leave
    least_progress: float = 1e-3  # share of the misfit that a step must promise


@dataclass(frozen=True)
class DescentSettings:
    """Feasible-path SQP method (`stiffopt.optimise.local`); steps are shares of a range."""

    iterations: int = 80  # at most
    # first_radius, largest_radius, last_radius: of the trust region
    first_radius: float = 0.2
    largest_radius: float = 4 / 3
    last_radius: float = 7e-7
    curvature: float = 0.225  # initial estimate of the objective's second derivative
    # share of a tolerance that is used, so that rounding errors stay within it
    inside: float = 1 - 1e-7
    touching: float = 7e-6  # distance from a limit below which a pressure is put on the limit
    # distance from a known optimum of the same value at which a descent ends there
    next_to: float = 1 / 30
    floor_margin: float = 1e-6  # relative margin above a floor that the method aims at
    pull_back_damping: float = 2.25e-3  # of the corrections back into the tolerances
    shortest_pull_back: float = 7e-5  # correction that is allowed however short the step


class Effort(NamedTuple):
    """Limits of a global search."""

    screened: int  # samples that are brought to the target and ranked there by their objective
    agreeing: int  # descents in a row that must find nothing new before the search ends
    most_descents: int  # largest number of descents


@dataclass(frozen=True)
class SearchSettings:
    """Global search (`stiffopt.optimise.search`)."""

    # placed, loose: effort for a target with at least a position, and with less: a loose target is
    # reached in very different ways.  `loose` is also the effort for any target whose tolerances
    # cover the share `covered` of the sampled configurations
    placed: Effort = field(default=Effort(64, 4, 32))
    loose: Effort = field(default=Effort(256, 8, 64))
    # loaded_placed, loaded_loose: the same in machine code for an arm under gravity or a load,
    # whose evaluations take a hundred times longer
    loaded_placed: Effort = field(default=Effort(16, 3, 10))
    loaded_loose: Effort = field(default=Effort(40, 4, 16))
    # share of the configurations, see above; the effort grows with the share up to it
    covered: float = 0.02
    # difference of two objectives (0.1 % of a stiffness) below which optima are the same
    same_optimum: float = 1e-3
    # spacing of the first starts, as a share of the diagonal of the pressure range
    unlike: float = 0.2
    price_of_floors: float = 10.0  # weight of missed stiffness in the ranking of starts
    # weight of missing clearance, over the arm's length, in the ranking of starts that are at the
    # target but not clear yet
    price_of_obstacles: float = 3.0
    # starts of the general method for an arm under gravity or a load
    general_starts_loaded: int = 12


@dataclass(frozen=True)
class ClosestSettings:
    """Search for the configuration closest to an unreachable target (`diagnosis`)."""

    # most_descents, agreeing: as those of `Effort`
    most_descents: int = 16
    agreeing: int = 4
    # compiled_descents, compiled_agreeing: the same in machine code
    compiled_descents: int = 24
    compiled_agreeing: int = 8
    # number of starts that are nearest to the target; twice as many are arbitrary
    samples: int = 16
    # difference of two objectives (half a squared error over a scale) of the same optimum
    same: float = 1e-7
    precision: float = 1e-10  # decrease of an objective that no longer matters


@dataclass(frozen=True)
class ObstacleSettings:
    """Rows for the objects of a scene (`stiffopt.optimise.obstacles`)."""

    margin: float = 1e-3  # width of a row's bound in m, its scale in the method
    # distance beyond the clearance, in m, from which an object does not affect a step
    cutoff: float = 0.005
    # distance beyond the clearance, in m, within which an object holds the arm back
    touching: float = 2e-5
    # turns, closer: refinements of the nearest point without machine code, and stations of each
    turns: int = 5
    closer: int = 9
    # samples among which a clear start is sought if none near the target arrives clear; the
    # clearest of them is shown if none is clear
    clearest: int = 2048
    # parents, children, rounds, spread: search if none is clear: in each round, `children` samples
    # are drawn around each of the `parents` clearest. `spread` gives the standard deviations in the
    # first and the last round, as shares of the range of pressures
    parents: int = 64
    children: int = 16
    rounds: int = 14
    spread: tuple[float, float] = (0.15, 0.003)
    # violation of the clearance that is allowed in an answer, in m: the precision of least
    # distances
    allowed: float = 1e-5


@dataclass(frozen=True)
class BraceSettings:
    """Search for pressures with which the arm leans on objects (`stiffopt.optimise.leaning`)."""

    force: float = 5e-3  # width of a row's bound on a contact force in N, its scale in the method
    scale: float = 1.0  # typical violation of a force far from the target, in N
    step: float = 3e-4  # step of a pressure, as a share of its range, in differences of equilibria
    # decrease of the objective that no longer matters, resolved by these differences
    precision: float = 1e-4
    # spare, more_spare: share of tolerances, forces and margins that is not used; the same for an
    # optimum that misses them by little when it is reached from rest
    spare: float = 1e-3
    more_spare: float = 5e-3
    stations: int = 14  # stations along the body at which samples are tested for contact
    screened: int = 1024  # samples whose contact is estimated
    # starts of a round that are brought to the target in contact, descents in a row that must find
    # nothing new, and most descents
    effort: Effort = field(default=Effort(32, 8, 24))
    best_found: int = 2  # descents that must find the best optimum before a search is complete
    rounds: int = 2  # most rounds; the next one begins if a search is not complete
    tried: int = 8  # local optima that are judged in turn, from rest
    # share by which an optimum that does not hold is stiffer than the answer, to be told
    stiffer: float = 0.01
    # gain from a whole tolerance or limit, as a share of the stiffness, to be reported
    least_price: float = 1e-3
    largest_push: float = 1.0  # largest push that is tested, in N
    # standard deviations of a contact force, by a calibration's errors, that are held back
    sure: float = 2.0
    # least share of a stiffness that one standard deviation of the tip's errors must leave
    robust: float = 0.5
    # largest distance, in m, of the tips of one equilibrium that is reached in two ways
    same: float = 2e-4
    # largest share of a greatest force by which friction on the way may exceed it
    rubbed: float = 0.1
    # corrected, missed: largest change of a pressure, in Pa, by which a loop corrects the tip that
    # friction moves; how far it may then be from its target, in m, if the tolerance is smaller
    corrected: float = 1e4
    missed: float = 1e-3


@dataclass(frozen=True)
class SampleSettings:
    """Table of sampled configurations (`stiffopt.optimise.samples`)."""

    free: int = 4096  # number for an arm without loads
    # number under gravity or a load, where equilibria take a thousand times longer
    loaded: int = 128
    compiled: int = 64  # the same in machine code; each load has its own samples
    leaning: int = 1024  # the same to find where to lean
    # if none of the first samples up to this number has an equilibrium, the arm has none
    hopeless: int = 16


@dataclass(frozen=True)
class PriceSettings:
    """Prices of the constraints at a solution (`stiffopt.optimise.prices`)."""

    near: float = 0.01  # relative distance from its bound up to which a constraint is considered
    # penalty on constraints away from their bound, so that the price of an active one is not lost
    # to the solution's inexactness
    slack: float = 10.0
    # distance outside a pressure limit at which its price is taken, as a share of the range
    beyond: float = 7e-4
    least: float = 1e-9  # price below which it is rounding error


@dataclass(frozen=True)
class DerivativeSettings:
    """Derivatives of an answer (`stiffopt.optimise.derivatives`)."""

    step: float = 1e-4  # of a pressure, as a share of its range, in differences of gradients
    step_of_parameters: float = 1e-5  # of a target (m, rad) or a direction, in differences
    least: float = 1e-6  # multiplier below which a constraint is inactive
    # near, touching: relative distance from a tolerance, and distance from a limit, within which a
    # constraint is first assumed to be active: the answer is only nearly the optimum
    near: float = 0.1
    touching: float = 1e-4
    rounds: int = 6  # updates of the active constraints
    # iterations, longest_step, small_step: of Newton's method to the optimum
    iterations: int = 20
    longest_step: float = 0.02
    small_step: float = 1e-9
    # relative violation, or multiplier of the wrong sign, that is rounding error
    tiny: float = 1e-7
    # multiplier, or relative distance, below which a constraint is weakly active
    weak: float = 1e-6
    largest_condition: float = 1e11  # condition number above which the answer is not isolated
    # relative difference between the two one-sided derivatives of a distance's slope
    edge: float = 0.05


@dataclass(frozen=True)
class ProgramSettings:
    """Objectives of the nonlinear program (`stiffopt.optimise.program`).

    `maximise`, `match`, `least_pressure`: decrease of each objective that no longer matters.
    `some_pressure`: weight of the mean square pressure where a stiffness is matched, to choose the
    lowest of the pressures that match equally well.
    """

    maximise: float = 1e-7
    match: float = 1e-10
    least_pressure: float = 4e-10
    some_pressure: float = 2.25e-7


@dataclass(frozen=True)
class AnswerSettings:
    """Answers and their reports."""

    tried: int = 5  # local optima that are judged in turn if the best is not reached from rest
    at_limit: float = 1e-3  # distance from a limit, in Pa, within which a pressure is at the limit
    # of the trade-off between error and stiffness, as a share of the arm
    largest_tolerance: float = 0.25


@dataclass(frozen=True)
class KeptSettings:
    """Limits of caches and compilation, and the division of work."""

    # stiffnesses of a task on a free arm; with more, compilation takes too long
    most_measures: int = 6
    per_arm: int = 64  # cached items of each kind that varies from task to task
    in_vm: int = 256  # functions in the CasADi VM, of all arms
    chunk: int = 8  # tasks, or equilibria, that a thread takes at a time


REACH = ReachSettings()
REACH_IN_CONTACT = ReachInContactSettings()
DESCENT = DescentSettings()
SEARCH = SearchSettings()
CLOSEST = ClosestSettings()
OBSTACLES = ObstacleSettings()
BRACE = BraceSettings()
SAMPLES = SampleSettings()
PRICES = PriceSettings()
DERIVATIVES = DerivativeSettings()
PROGRAM = ProgramSettings()
ANSWER = AnswerSettings()
KEPT = KeptSettings()
