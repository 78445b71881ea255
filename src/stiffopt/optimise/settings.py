"""Tuning values of the optimiser, grouped by method.

The variables of all methods are pressures as shares of each channel's range, so that steps and
distances mean the same for a channel of 0.2 bar and for one of 10 bar.  The methods in C (folder
``native``) take the same values.
"""

from dataclasses import dataclass, field
from typing import NamedTuple


@dataclass(frozen=True)
class ReachSettings:
    """Levenberg-Marquardt method that brings pressures to the target (`stiffopt.optimise.reach`).

    Attributes
    ----------
    longest_step : of a pressure, as a share of its range.
    damping, least_damping, most_damping : initial value, and range of its adaptation.
    least_progress : share of the misfit that a step must promise.
    iterations : for a single start, such as a guess.
    iterations_of_many : for each of many starts.
    """

    longest_step: float = 2 / 3
    damping: float = 2.25e-4
    least_damping: float = 2e-10
    most_damping: float = 2e6
    least_progress: float = 1e-9
    iterations: int = 40
    iterations_of_many: int = 20


@dataclass(frozen=True)
class ReachInContactSettings:
    """Method that brings pressures to a target in contact (`stiffopt.optimise.reach_in_contact`).

    Attributes
    ----------
    iterations : to the target, and as many to the contacts' demands.
    first_radius, least_radius : of the trust region, as shares of the pressures' ranges.
    damping : of a step.
    inside : share of tolerances and demands that is aimed at.
    kept : share of the contact force that a step must leave.
    least_progress : share of the misfit that a step must promise.
    """

    iterations: int = 15
    first_radius: float = 2 / 3
    least_radius: float = 1e-5
    damping: float = 1e-4
    inside: float = 0.9
    kept: float = 0.1
    least_progress: float = 1e-3


@dataclass(frozen=True)
class DescentSettings:
    """Feasible-path SQP method (`stiffopt.optimise.local`); steps are shares of a range.

    Attributes
    ----------
    iterations : at most.
    first_radius, largest_radius, last_radius : of the trust region.
    curvature : initial estimate of the objective's second derivative.
    inside : share of a tolerance that is used, so that rounding errors stay within it.
    touching : distance from a limit below which a pressure is put on the limit.
    next_to : distance from a known optimum of the same value at which a descent ends there.
    floor_margin : relative margin above a floor that the method aims at.
    pull_back_damping : of the corrections back into the tolerances.
    shortest_pull_back : correction that is allowed however short the step.
    """

    iterations: int = 80
    first_radius: float = 0.2
    largest_radius: float = 4 / 3
    last_radius: float = 7e-7
    curvature: float = 0.225
    inside: float = 1 - 1e-7
    touching: float = 7e-6
    next_to: float = 1 / 30
    floor_margin: float = 1e-6
    pull_back_damping: float = 2.25e-3
    shortest_pull_back: float = 7e-5


class Effort(NamedTuple):
    """Limits of a global search.

    Attributes
    ----------
    screened : samples that are brought to the target and ranked there by their objective.
    agreeing : descents in a row that must find nothing new before the search ends.
    most_descents : largest number of descents.
    """

    screened: int
    agreeing: int
    most_descents: int


@dataclass(frozen=True)
class SearchSettings:
    """Global search (`stiffopt.optimise.search`).

    Attributes
    ----------
    placed, loose : effort for a target with at least a position, and with less: a loose target is
        reached in very different ways.  `loose` is also the effort for any target whose tolerances
        cover the share `covered` of the sampled configurations.
    loaded_placed, loaded_loose : the same in machine code for an arm under gravity or a load, whose
        evaluations take a hundred times longer.
    covered : share of the configurations, see above; the effort grows with the share up to it.
    same_optimum : difference of two objectives (0.1 % of a stiffness) below which optima are the
        same.
    unlike : spacing of the first starts, as a share of the diagonal of the pressure range.
    price_of_floors : weight of missed stiffness in the ranking of starts.
    price_of_obstacles : weight of missing clearance, over the arm's length, in the ranking of
        starts that are at the target but not clear yet.
    general_starts_loaded : starts of the general method for an arm under gravity or a load.
    """

    placed: Effort = field(default=Effort(64, 4, 32))
    loose: Effort = field(default=Effort(256, 8, 64))
    loaded_placed: Effort = field(default=Effort(16, 3, 10))
    loaded_loose: Effort = field(default=Effort(40, 4, 16))
    covered: float = 0.02
    same_optimum: float = 1e-3
    unlike: float = 0.2
    price_of_floors: float = 10.0
    price_of_obstacles: float = 3.0
    general_starts_loaded: int = 12


@dataclass(frozen=True)
class ClosestSettings:
    """Search for the configuration closest to an unreachable target (`diagnosis`).

    Attributes
    ----------
    most_descents, agreeing : as those of `Effort`.
    compiled_descents, compiled_agreeing : the same in machine code.
    samples : number of starts that are nearest to the target; twice as many are arbitrary.
    same : difference of two objectives (half a squared error over a scale) of the same optimum.
    precision : decrease of an objective that no longer matters.
    """

    most_descents: int = 16
    agreeing: int = 4
    compiled_descents: int = 24
    compiled_agreeing: int = 8
    samples: int = 16
    same: float = 1e-7
    precision: float = 1e-10


@dataclass(frozen=True)
class ObstacleSettings:
    """Rows for the objects of a scene (`stiffopt.optimise.obstacles`).

    Attributes
    ----------
    margin : width of a row's bound in m, its scale in the method.
    cutoff : distance beyond the clearance, in m, from which an object does not affect a step.
    touching : distance beyond the clearance, in m, within which an object holds the arm back.
    turns, closer : refinements of the nearest point without machine code, and stations of each.
    clearest : samples among which a clear start is sought if none near the target arrives clear;
        the clearest of them is shown if none is clear.
    parents, children, rounds, spread : search if none is clear: in each round, `children` samples
        are drawn around each of the `parents` clearest. `spread` gives the standard deviations in
        the first and the last round, as shares of the range of pressures.
    allowed : violation of the clearance that is allowed in an answer, in m: the precision of least
        distances.
    """

    margin: float = 1e-3
    cutoff: float = 0.005
    touching: float = 2e-5
    turns: int = 5
    closer: int = 9
    clearest: int = 2048
    parents: int = 64
    children: int = 16
    rounds: int = 14
    spread: tuple[float, float] = (0.15, 0.003)
    allowed: float = 1e-5


@dataclass(frozen=True)
class BraceSettings:
    """Search for pressures with which the arm leans on objects (`stiffopt.optimise.leaning`).

    Attributes
    ----------
    force : width of a row's bound on a contact force in N, its scale in the method.
    scale : typical violation of a force far from the target, in N.
    step : step of a pressure, as a share of its range, in differences of equilibria.
    precision : decrease of the objective that no longer matters, resolved by these differences.
    spare, more_spare : share of tolerances, forces and margins that is not used; the same for an
        optimum that misses them by little when it is reached from rest.
    stations : stations along the body at which samples are tested for contact.
    screened : samples whose contact is estimated.
    effort : starts of a round that are brought to the target in contact, descents in a row that
        must find nothing new, and most descents.
    best_found : descents that must find the best optimum before a search is complete.
    rounds : most rounds; the next one begins if a search is not complete.
    tried : local optima that are judged in turn, from rest.
    stiffer : share by which an optimum that does not hold is stiffer than the answer, to be told.
    least_price : gain from a whole tolerance or limit, as a share of the stiffness, to be reported.
    largest_push : largest push that is tested, in N.
    sure : standard deviations of a contact force, by a calibration's errors, that are held back.
    robust : least share of a stiffness that one standard deviation of the tip's errors must leave.
    same : largest distance, in m, of the tips of one equilibrium that is reached in two ways.
    rubbed : largest share of a greatest force by which friction on the way may exceed it.
    corrected, missed : largest change of a pressure, in Pa, by which a loop corrects the tip that
        friction moves; how far it may then be from its target, in m, if the tolerance is smaller.
    """

    force: float = 5e-3
    scale: float = 1.0
    step: float = 3e-4
    precision: float = 1e-4
    spare: float = 1e-3
    more_spare: float = 5e-3
    stations: int = 14
    screened: int = 1024
    effort: Effort = field(default=Effort(32, 8, 24))
    best_found: int = 2
    rounds: int = 2
    tried: int = 8
    stiffer: float = 0.01
    least_price: float = 1e-3
    largest_push: float = 1.0
    sure: float = 2.0
    robust: float = 0.5
    same: float = 2e-4
    rubbed: float = 0.1
    corrected: float = 1e4
    missed: float = 1e-3


@dataclass(frozen=True)
class SampleSettings:
    """Table of sampled configurations (`stiffopt.optimise.samples`).

    Attributes
    ----------
    free : number for an arm without loads.
    loaded : number under gravity or a load, where equilibria take a thousand times longer.
    compiled : the same in machine code; each load has its own samples.
    leaning : the same to find where to lean.
    hopeless : if none of the first samples up to this number has an equilibrium, the arm has none.
    """

    free: int = 4096
    loaded: int = 128
    compiled: int = 64
    leaning: int = 1024
    hopeless: int = 16


@dataclass(frozen=True)
class PriceSettings:
    """Prices of the constraints at a solution (`stiffopt.optimise.prices`).

    Attributes
    ----------
    near : relative distance from its bound up to which a constraint is considered.
    slack : penalty on constraints away from their bound, so that the price of an active one is not
        lost to the solution's inexactness.
    beyond : distance outside a pressure limit at which its price is taken, as a share of the range.
    least : price below which it is rounding error.
    """

    near: float = 0.01
    slack: float = 10.0
    beyond: float = 7e-4
    least: float = 1e-9


@dataclass(frozen=True)
class DerivativeSettings:
    """Derivatives of an answer (`stiffopt.optimise.derivatives`).

    Attributes
    ----------
    step : of a pressure, as a share of its range, in differences of gradients.
    step_of_parameters : of a target (m, rad) or a direction, in differences.
    least : multiplier below which a constraint is inactive.
    near, touching : relative distance from a tolerance, and distance from a limit, within which a
        constraint is first assumed to be active: the answer is only nearly the optimum.
    rounds : updates of the active constraints.
    iterations, longest_step, small_step : of Newton's method to the optimum.
    tiny : relative violation, or multiplier of the wrong sign, that is rounding error.
    weak : multiplier, or relative distance, below which a constraint is weakly active.
    largest_condition : condition number above which the answer is not isolated.
    edge : relative difference between the two one-sided derivatives of a distance's slope.
    """

    step: float = 1e-4
    step_of_parameters: float = 1e-5
    least: float = 1e-6
    near: float = 0.1
    touching: float = 1e-4
    rounds: int = 6
    iterations: int = 20
    longest_step: float = 0.02
    small_step: float = 1e-9
    tiny: float = 1e-7
    weak: float = 1e-6
    largest_condition: float = 1e11
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
    """Answers and their reports.

    Attributes
    ----------
    tried : local optima that are judged in turn if the best is not reached from rest.
    at_limit : distance from a limit, in Pa, within which a pressure is at the limit.
    largest_tolerance : of the trade-off between error and stiffness, as a share of the arm.
    """

    tried: int = 5
    at_limit: float = 1e-3
    largest_tolerance: float = 0.25


@dataclass(frozen=True)
class KeptSettings:
    """Limits of caches and compilation, and the division of work.

    Attributes
    ----------
    most_measures : stiffnesses of a task on a free arm; with more, compilation takes too long.
    per_arm : cached items of each kind that varies from task to task.
    in_vm : functions in the CasADi VM, of all arms.
    chunk : tasks, or equilibria, that a thread takes at a time.
    """

    most_measures: int = 6
    per_arm: int = 64
    in_vm: int = 256
    chunk: int = 8


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
