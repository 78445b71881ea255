"""`Program`: a task as symbolic functions: residuals, objective and floors.

A task splits into its *structure* (which axes, which kinds of stiffness), for which functions are
compiled once, and its *parameters* (positions, directions, values), which are arguments of them.
Variables are the pressures.  Stiffnesses enter by their logarithm, so that steps and precision are
relative.
"""

import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.model.shape import Shape
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.obstacles import Obstacles
from stiffopt.optimise.settings import OBSTACLES, PROGRAM
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.term import Term

BAR = 1e5  # Pa

Aim = Literal["maximise", "match", "least pressure"]


def pressure_ranges(description: RobotDescription) -> Array:
    """Return the units (n,) of the optimiser's variables in Pa: the range of each channel.

    A channel without a range takes the largest range of the others.
    """
    ranges = np.array(description.pressure_max) - np.array(description.pressure_min)
    largest = ranges.max()
    return np.where(ranges > 0, ranges, largest if largest > 0 else BAR)


class Constraint(NamedTuple):
    """A bound on the rows first to end - 1 of the residual."""

    name: str  # name of the term
    first: int
    end: int
    # bound on the length of the rows, ``|r| <= radius``; if `one_sided`, bound on the single row,
    # ``r <= radius``
    radius: float
    scale: float  # typical size of the residual far from the target, in its unit
    one_sided: bool


class ProgramStructure(NamedTuple):
    """What compiled functions depend on; tasks with equal structures share them."""

    terms: tuple[Hashable, ...]
    measures: tuple[Hashable, ...]
    aim: Aim
    n_floors: int


@dataclass(frozen=True)
class Program:
    """A task's terms and stiffness measures."""

    terms: tuple[Term, ...]
    measures: tuple[Measure, ...]  # the maximised or matched ones, then the floors
    # whether the first measures are maximised or matched; without any, pressure is minimised
    aim: Aim
    n_floors: int  # number of stiffnesses with a lower bound
    reference: float = BAR  # pressure in Pa that is one unit of mean square pressure
    # objects around the arm; their rows of the residual follow those of the terms
    obstacles: Obstacles | None = None

    @classmethod
    def of(cls, task: Task, description: RobotDescription) -> "Program":
        """Return the program of a task on a robot."""
        terms, goal = task.target.terms, task.stiffness
        reference = float(pressure_ranges(description).max())
        obstacles = None if task.scene is None else Obstacles(task.scene, description)
        if goal is None:
            return cls(terms, (), "least pressure", 0, reference, obstacles)
        aim: Aim = "maximise" if goal.maximise else "match" if goal.match else "least pressure"
        measures = (*goal.first, *goal.at_least)
        return cls(terms, measures, aim, len(goal.at_least), reference, obstacles)

    @cached_property
    def structure(self) -> ProgramStructure:
        """What the functions depend on."""
        return ProgramStructure(
            tuple(term.structure for term in self.terms),
            tuple(measure.structure for measure in self.measures),
            self.aim,
            self.n_floors,
        )

    @cached_property
    def n_parameters(self) -> int:
        """Number of parameters of all functions."""
        return len(self.target_parameters) + len(self.measure_parameters)

    @cached_property
    def target_parameters(self) -> tuple[float, ...]:
        """Parameters of the terms; they come first."""
        found: tuple[float, ...] = ()
        for term in self.terms:
            found += term.parameters
        return found

    @cached_property
    def measure_parameters(self) -> tuple[float, ...]:
        """Parameters of the measures, then `reference`."""
        return (
            *(float(value) for measure in self.measures for value in measure.parameters),
            self.reference,
        )

    @property
    def parameters(self) -> Array:
        """All parameters, in the order of the functions' arguments."""
        return np.array((*self.target_parameters, *self.measure_parameters))

    @property
    def precision(self) -> float:
        """Decrease of the objective that no longer matters."""
        return float(getattr(PROGRAM, self.aim.replace(" ", "_")))

    @property
    def radii(self) -> list[float]:
        """Radii of all `constraints`, in their order."""
        found: list[float] = []
        for term in self.terms:
            found += [term.radius] * (term.size if term.is_inequality else 1)
        if self.obstacles is not None:
            found += [OBSTACLES.margin] * len(self.obstacles.row_objects)
        return found

    def constraints(self, length: float) -> tuple[Constraint, ...]:
        """Return the bounds on the residual, for an arm of this length in m."""
        found: list[Constraint] = []
        first = 0
        for term in self.terms:
            scale = length if term.unit == "m" else 1.0
            step = 1 if term.is_inequality else term.size
            for row in range(first, first + term.size, step):
                found.append(
                    Constraint(term.name, row, row + step, term.radius, scale, term.is_inequality)
                )
            first += term.size
        for row, name in enumerate(self.obstacles.row_names if self.obstacles else (), start=first):
            found.append(Constraint(name, row, row + 1, OBSTACLES.margin, length, one_sided=True))
        return tuple(found)

    @property
    def in_order_of_approach(self) -> tuple[Term, ...]:
        """The terms in the order in which an unreachable target is approached.

        Inequalities come first and the position last.
        """
        return tuple(sorted(self.terms, key=lambda term: (not term.is_inequality, -term.order)))

    @property
    def n_own_rows(self) -> int:
        """Number of components of the terms' residuals."""
        return sum(term.size for term in self.terms)

    @property
    def n_rows(self) -> int:
        """Number of components m of the residual, obstacles included."""
        return self.n_own_rows + (len(self.obstacles.row_objects) if self.obstacles else 0)

    @property
    def n_equal(self) -> int:
        """Number of rows that must be zero within a tolerance."""
        return sum(term.size for term in self.terms if not term.is_inequality)

    @property
    def has_stations(self) -> bool:
        """Whether a term depends on stations along the body, not on the tip alone."""
        return any(term.has_stations for term in self.terms)

    def errors(self, residuals: list[float]) -> dict[str, float]:
        """Return each term's error, or least margin of an inequality, from residuals (m,)."""
        found, start = {}, 0
        for term in self.terms:
            own = residuals[start : start + term.size]
            found[term.name] = term.radius - max(own) if term.is_inequality else math.hypot(*own)
            start += term.size
        return found

    def intruders(self, residuals: list[float]) -> dict[str, float]:
        """Return the objects nearer than the clearance, with what is missing in m, from (m,)."""
        if self.obstacles is None:
            return {}
        return self.obstacles.intruders(residuals[self.n_own_rows :])

    def touched(self, residuals: list[float]) -> list[str]:
        """Return the objects at the clearance, from residuals (m,)."""
        return self.obstacles.touched(residuals[self.n_own_rows :]) if self.obstacles else []

    def at(self, target: Target) -> "Program":
        """Return the same program for another target."""
        return Program(
            target.terms, self.measures, self.aim, self.n_floors, self.reference, self.obstacles
        )

    @property
    def n_terms(self) -> int:
        """Number t of terms of the objective; it is their maximum."""
        return len(self.measures) - self.n_floors if self.aim == "maximise" else 1

    # -- symbolic outputs, for the tip's shape and the parameters -----------------------------

    def pose(self, tip: Shape, parameters: Any) -> list[Any]:
        """Return the residuals (m,) and the transpose (n, m) of their Jacobian per Pa."""
        residual = self._residuals(tip, parameters)
        return [residual, ca.densify(tip.total_jacobian(residual)).T]

    def point(self, tip: Shape, parameters: Any) -> list[Any]:
        """Return the outputs of `pose`, then objective terms (t,) and floors (f,) with gradients.

        Each gradient follows its values, transposed, per Pa.
        """
        values, gradients = self._values(tip, parameters), self._gradients(tip, parameters)
        first = len(self.measures) - self.n_floors
        terms, slopes = self._terms(values[:first], gradients[:first, :], tip, parameters)
        parts = (terms, slopes.T, values[first:], gradients[first:, :].T)
        return [*self.pose(tip, parameters), *(ca.densify(part) for part in parts)]

    def worth(self, tip: Shape, parameters: Any) -> list[Any]:
        """Return the objective's terms (t,) and the floors (f,) alone."""
        values = self._values(tip, parameters)
        first = len(self.measures) - self.n_floors
        none = type(tip.pressures)(first, tip.pressures.numel())
        terms, _ = self._terms(values[:first], none, tip, parameters)
        return [ca.densify(terms), ca.densify(values[first:])]

    def judge(self, tip: Shape, parameters: Any) -> list[Any]:
        """Return residuals, transposes of pose (4, 4) and compliance (6, 6), and measures (k,)."""
        return [
            self._residuals(tip, parameters),
            ca.densify(tip.transform).T,
            ca.densify(tip.compliance).T,
            ca.densify(self._values(tip, parameters)),
        ]

    def _residuals(self, tip: Shape, parameters: Any) -> Any:
        found, start = [], 0
        for term in self.terms:
            end = start + len(term.parameters)
            residual = term.residual(tip, parameters[start:end])
            # write g >= 0 as r = radius - g <= radius, the form of all constraints
            found.append(term.radius - residual if term.is_inequality else residual)
            start = end
        return ca.densify(ca.vertcat(*found))

    def _values(self, tip: Shape, parameters: Any) -> Any:
        found = [m.formula(tip, own) for m, own in self._own_parameters(parameters)]
        return ca.vertcat(*found) if found else type(tip.pressures)(0, 1)

    def _gradients(self, tip: Shape, parameters: Any) -> Any:
        found = [m.formula_gradient(tip, own) for m, own in self._own_parameters(parameters)]
        return ca.vertcat(*found) if found else type(tip.pressures)(0, tip.pressures.numel())

    def _own_parameters(self, parameters: Any) -> Iterator[tuple[Measure, Any]]:
        start = len(self.target_parameters)
        for measure in self.measures:
            end = start + len(measure.parameters)
            yield measure, parameters[start:end]
            start = end

    def _terms(self, values: Any, gradients: Any, tip: Shape, parameters: Any) -> tuple[Any, Any]:
        """Return the terms of the objective and their gradients."""
        if self.aim == "maximise":
            return -values, -gradients
        reference = parameters[-1]
        x = tip.pressures / reference
        mean_square, slope = ca.sumsqr(x) / x.numel(), 2 / reference / x.numel() * x.T
        if self.aim == "least pressure":
            return mean_square, slope
        measure, own = next(self._own_parameters(parameters))
        mismatch, factor = measure.mismatch(values, own)
        some = PROGRAM.some_pressure
        return mismatch + some * mean_square, factor * gradients + some * slope
