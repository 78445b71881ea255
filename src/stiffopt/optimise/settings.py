"""Tuning values of the optimiser, grouped by the method that they belong to.

Variables of all methods are the pressures as shares of each channel's range, so that steps and
distances mean the same for a channel of 0.2 bar and for one of 10 bar.  The methods written in C
(folder ``native``) are given the same values.
"""

from dataclasses import dataclass, field
from typing import NamedTuple


@dataclass(frozen=True)
class ReachSettings:
    """Levenberg-Marquardt method that brings pressures to the target (`stiffopt.optimise.reach`).

    Attributes
    ----------
    longest_step : of a pressure, as a share of its range.
    damping : at the start, and the range in which it is adapted.
    least_progress : share of the misfit that a step must promise.
    iterations : of a start that is followed alone, as a guess is.
    iterations_of_many : of each of many starts.
    """

    longest_step: float = 2 / 3
    damping: float = 2.25e-4
    least_damping: float = 2e-10
    most_damping: float = 2e6
    least_progress: float = 1e-9
    iterations: int = 40
    iterations_of_many: int = 20


@dataclass(frozen=True)
class DescentSettings:
    """Feasible-path SQP method (`stiffopt.optimise.local`); steps are shares of a range.

    Attributes
    ----------
    iterations : at most.
    first_radius, largest_radius, last_radius : of the trust region.
    curvature : first guess of the objective's second derivative.
    inside : share of a tolerance that is used, so that rounding stays within it.
    touching : a pressure that near to a limit is meant to be at it.
    next_to : a descent that near to an optimum of the same value is on its way there.
    floor_margin : how far above a stiffness that must be kept the method aims, relatively.
    pull_back_damping : of the corrections back into the tolerances.
    shortest_pull_back : correction that is allowed after however short a step.
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
    screened : samples that are brought to the target and ranked by what they are worth there.
    agreeing : descents in a row that must find nothing new before the search ends.
    most_descents : after which it ends anyway.
    """

    screened: int
    agreeing: int
    most_descents: int


@dataclass(frozen=True)
class SearchSettings:
    """Global search (`stiffopt.optimise.search`).

    Attributes
    ----------
    placed, loose : effort for a target of at least a position, and of less than that: what is
        loosely asked for is reached in very different ways.  `loose` is also the effort for any
        target whose tolerances cover the share `covered` of the sampled configurations.
    loaded_placed, loaded_loose : the same in machine code for an arm under gravity or a load, of
        which an evaluation takes a hundred times longer.
    covered : share of the configurations, see above; the effort grows with the share up to it.
    same_optimum : difference of two objectives (0.1 % of a stiffness) that count as one optimum.
    unlike : share of the diagonal of the pressure range that first starts lie apart.
    price_of_floors : weight of a stiffness that is missed, when starts are ranked.
    price_of_obstacles : weight of what a body lacks of its clearance, over the arm's length, when
        starts that are at the target but not clear yet are ranked.
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
    """Search for the configuration closest to what cannot be reached (`diagnosis`).

    Attributes
    ----------
    most_descents, agreeing : as those of `Effort`.
    compiled_descents, compiled_agreeing : the same in machine code.
    samples : that descents start from, the nearest to the target; twice as many are any.
    same : difference of two objectives (half a squared error over a scale) that count as one.
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
    margin : width of a row's bound in m, the scale on which the method sees it.
    cutoff : distance beyond the clearance, in m, from which an object has no part in a step.
    touching : how near to the clearance an object counts as one that holds the arm back, in m.
    turns, closer : without machine code, how often it is looked closer, and at how many stations.
    clearest : samples of which a clear one is sought to start from, where none near the target
        comes clear, and of which the clearest is shown where nothing is.
    starts : of the clearest of them, from which descents start in turn where none is clear.
    allowed : by how much an answer may be nearer than the clearance, in m: the precision of least
        distances.
    """

    margin: float = 1e-3
    cutoff: float = 0.005
    touching: float = 2e-5
    turns: int = 5
    closer: int = 9
    clearest: int = 2048
    starts: int = 8
    allowed: float = 1e-5


@dataclass(frozen=True)
class BraceSettings:
    """Search for pressures with which the arm leans on objects (`stiffopt.optimise.leaning`).

    Attributes
    ----------
    force : width of a row's bound on a contact force in N, the scale on which the method sees it.
    scale : what a force is compared with while the target is far, in N.
    step : of a pressure, as a share of its range, in differences of equilibria.
    precision : decrease of the objective that no longer matters, which differences can tell.
    spare : share of tolerances, forces and margins that is left.
    stations : along the body, at which samples are looked at for what they would lean on.
    screened : samples whose contact is estimated.
    effort : starts that are brought to the target in contact, descents in a row that must find
        nothing new, and most descents.
    iterations : of a start, to the target and to what contacts have to hold.
    tried : local optima that are judged in turn, from rest.
    least_price : of a whole tolerance or limit, as a share of the stiffness, that is worth telling.
    largest_push : up to which pushes are looked at, in N.
    """

    force: float = 5e-3
    scale: float = 1.0
    step: float = 3e-4
    precision: float = 1e-4
    spare: float = 5e-3
    stations: int = 14
    screened: int = 1024
    effort: Effort = field(default=Effort(32, 4, 12))
    iterations: int = 15
    tried: int = 8
    least_price: float = 1e-3
    largest_push: float = 1.0


@dataclass(frozen=True)
class SampleSettings:
    """Table of sampled configurations (`stiffopt.optimise.samples`).

    Attributes
    ----------
    free : number for an arm without loads.
    loaded : for one under gravity or a load, whose equilibria take a thousand times longer.
    compiled : the same in machine code; each load has its own.
    hopeless : if none of so many first ones has an equilibrium, the arm has none.
    """

    free: int = 4096
    loaded: int = 128
    compiled: int = 64
    hopeless: int = 16


@dataclass(frozen=True)
class PriceSettings:
    """Prices of the constraints at a solution (`stiffopt.optimise.prices`).

    Attributes
    ----------
    near : how nearly, relatively, a constraint must hold to be weighed at all.
    slack : how much less a constraint that is off by a share of itself explains: the price of one
        that binds is not found to be zero since the solution is not exact.
    beyond : how far outside a pressure limit its price is taken, as a share of the range.
    least : below which a price is rounding.
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
    step_of_parameters : of a target (m, rad) or a direction.
    least : multiplier below which a constraint does not bind.
    near, touching : error, as a share less than the tolerance, and distance from a limit at which a
        constraint is taken to bind at first: the answer is only nearly the optimum.
    rounds : in which what binds is found out.
    iterations, longest_step, small_step : of Newton's method to the optimum.
    tiny : relative violation, or wrong push, that is rounding.
    weak : multiplier, or relative distance, below which a constraint is about to let go, or bind.
    largest_condition : of the system, above which an answer is not alone.
    edge : share by which the change of a distance's slope may differ between two sides.
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

    Attributes
    ----------
    maximise, match, least_pressure : decrease of each objective that no longer matters.
    some_pressure : weight of the mean square pressure where a stiffness is matched: of all
        pressures that match as well, the least are wanted.
    """

    maximise: float = 1e-7
    match: float = 1e-10
    least_pressure: float = 4e-10
    some_pressure: float = 2.25e-7


@dataclass(frozen=True)
class AnswerSettings:
    """Answers and what is reported of them.

    Attributes
    ----------
    tried : local optima that are judged in turn if the best is not reached from rest.
    at_limit : how far from a limit a pressure still counts as at it, in Pa.
    largest_tolerance : of the trade-off between error and stiffness, as a share of the arm.
    """

    tried: int = 5
    at_limit: float = 1e-3
    largest_tolerance: float = 0.25


@dataclass(frozen=True)
class KeptSettings:
    """What is compiled and kept for later tasks, and how work is shared out.

    Attributes
    ----------
    most_measures : stiffnesses of a task on a free arm; of more, code takes too long to compile.
    per_arm : of each kind of thing that varies from task to task.
    in_vm : functions in the CasADi VM, of all arms.
    chunk : tasks, or equilibria, that a thread takes at a time.
    """

    most_measures: int = 6
    per_arm: int = 64
    in_vm: int = 256
    chunk: int = 8


REACH = ReachSettings()
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
