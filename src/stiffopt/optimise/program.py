"""From the structure of a task to the functions that its nonlinear program consists of.

A task splits into its *structure* (which axes, which kinds of stiffness), for which functions are
made once, and its *parameters* (positions, directions, values), which are arguments of them.
Variables are the pressures; all stiffnesses enter by their logarithm, so that a tenth of a newton
per metre weighs the same wherever it is a tenth.
"""

from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.shape import Shape
from stiffopt.optimise.goal import MatchMatrix, StiffnessGoal
from stiffopt.optimise.measures import LogStiffness, MatrixDistance, Measure
from stiffopt.optimise.target import Target
from stiffopt.optimise.terms import PoseTerm, pose_terms

Vector = NDArray[np.float64]

BAR = 1e5
"""Pressure scale of the variables, in Pa."""

_SOME_PRESSURE = 1e-7
"""Weight of the mean square pressure where a stiffness is matched: of all that match as well the
one with less pressure."""

Aim = Literal["maximise", "match value", "match matrix", "least pressure"]


class Structure(NamedTuple):
    """What functions are made for; equal for tasks that share them."""

    terms: tuple[Hashable, ...]
    measures: tuple[Hashable, ...]
    aim: Aim
    n_floors: int


@dataclass(frozen=True)
class Program:
    """A task's pose terms and stiffness measures.

    Attributes
    ----------
    terms : tuple of PoseTerm
    measures : tuple of Measure
        What is maximised, or matched, then the floors.
    aim : what is done with those that are no floors.
    n_floors : int
    wanted : float
        Logarithm of the value to match.
    """

    terms: tuple[PoseTerm, ...]
    measures: tuple[Measure, ...]
    aim: Aim
    n_floors: int
    wanted: float = 0.0

    @classmethod
    def of(cls, target: Target, goal: StiffnessGoal | None) -> "Program":
        """Program of a task."""
        terms = pose_terms(target)
        if goal is None:
            return cls(terms, (), "least pressure", 0)
        floors = tuple(LogStiffness(floor) for floor in goal.at_least)
        if goal.maximise:
            found = tuple(LogStiffness(measure) for measure in goal.maximise)
            return cls(terms, (*found, *floors), "maximise", len(floors))
        if isinstance(goal.match, MatchMatrix):
            distance = MatrixDistance(goal.match)
            return cls(terms, (distance, *floors), "match matrix", len(floors))
        if goal.match is not None:
            wanted = float(np.log(goal.match.value))
            stiffness = LogStiffness(goal.match)
            return cls(terms, (stiffness, *floors), "match value", len(floors), wanted)
        return cls(terms, floors, "least pressure", len(floors))

    @cached_property
    def structure(self) -> Structure:
        """What the functions depend on."""
        return Structure(
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
        """Parameters of the pose terms, which come first."""
        return tuple(value for term in self.terms for value in term.parameters)

    @cached_property
    def measure_parameters(self) -> tuple[float, ...]:
        """Parameters of the measures, then the logarithm of the value to match."""
        return (
            *(float(value) for measure in self.measures for value in measure.parameters),
            self.wanted,
        )

    @property
    def parameters(self) -> Vector:
        """All parameters, as the functions take them."""
        return np.array((*self.target_parameters, *self.measure_parameters))

    @property
    def precision(self) -> float:
        """Decrease of the objective that no longer matters."""
        return {"maximise": 1e-7, "least pressure": 1e-9}.get(self.aim, 1e-10)

    @property
    def steepness(self) -> float:
        """First guess of the objective's curvature, per bar^2."""
        return 0.1

    def at(self, target: Target) -> "Program":
        """The same program for another target."""
        return Program(pose_terms(target), self.measures, self.aim, self.n_floors, self.wanted)

    @property
    def n_terms(self) -> int:
        """Number of terms of the objective, the largest of which is minimised."""
        return len(self.measures) - self.n_floors if self.aim == "maximise" else 1

    # -- symbolic: outputs of functions of the tip's shape and the parameters ---------------

    def pose(self, tip: Shape, parameters: Any) -> list[Any]:
        """Residuals (m,) and, transposed, their Jacobian (n, m) per Pa."""
        residual = self._residuals(tip, parameters)
        return [residual, ca.densify(tip.total_jacobian(residual)).T]

    def point(self, tip: Shape, parameters: Any) -> list[Any]:
        """Those of `pose`, the objective's terms (t,), the floors' values (f,), their gradients.

        Each gradient follows its values, transposed, per Pa.
        """
        values, gradients = self._values(tip, parameters), self._gradients(tip, parameters)
        first = len(self.measures) - self.n_floors
        terms, slopes = self._terms(values[:first], gradients[:first, :], tip, parameters[-1])
        parts = (terms, slopes.T, values[first:], gradients[first:, :].T)
        return [*self.pose(tip, parameters), *(ca.densify(part) for part in parts)]

    def worth(self, tip: Shape, parameters: Any) -> list[Any]:
        """The objective's terms (t,) and the floors' values (f,) alone."""
        values = self._values(tip, parameters)
        first = len(self.measures) - self.n_floors
        none = type(tip.pressures)(first, tip.pressures.numel())
        terms, _ = self._terms(values[:first], none, tip, parameters[-1])
        return [ca.densify(terms), ca.densify(values[first:])]

    def judge(self, tip: Shape, parameters: Any) -> list[Any]:
        """Residuals, pose (4, 4) and compliance (6, 6), transposed, and values of the measures."""
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
            found.append(term.residual(tip.position, tip.rotation, parameters[start:end]))
            start = end
        return ca.densify(ca.vertcat(*found))

    def _values(self, tip: Shape, parameters: Any) -> Any:
        found = [m.value(tip, own) for m, own in self._own_parameters(parameters)]
        return ca.vertcat(*found) if found else type(tip.pressures)(0, 1)

    def _gradients(self, tip: Shape, parameters: Any) -> Any:
        found = [m.gradient(tip, own) for m, own in self._own_parameters(parameters)]
        return ca.vertcat(*found) if found else type(tip.pressures)(0, tip.pressures.numel())

    def _own_parameters(self, parameters: Any) -> Iterator[tuple[Measure, Any]]:
        start = len(self.target_parameters)
        for measure in self.measures:
            end = start + len(measure.parameters)
            yield measure, parameters[start:end]
            start = end

    def _terms(self, values: Any, gradients: Any, tip: Shape, wanted: Any) -> tuple[Any, Any]:
        """Terms of the objective and their gradients."""
        if self.aim == "maximise":
            return -values, -gradients
        x = tip.pressures / BAR
        mean_square, slope = ca.sumsqr(x) / x.numel(), 2 / BAR / x.numel() * x.T
        if self.aim == "least pressure":
            return mean_square, slope
        mismatch, slopes = values, gradients
        if self.aim == "match value":
            mismatch, slopes = (values - wanted) ** 2, 2 * (values - wanted) * gradients
        return mismatch + _SOME_PRESSURE * mean_square, slopes + _SOME_PRESSURE * slope
