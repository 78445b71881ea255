"""The stiffnesses that a task demands, and whether the arm has them."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from stiffopt.control.formula import Formula
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt


class Demands:
    """The stiffnesses that a task demands with its keys `at_least` and `match`.

    Parameters
    ----------
    task : the task; None, or one that only maximises, demands nothing.
    margin : of a stiffness, as a share, or of a relative distance from one.
    """

    def __init__(self, task: Task | None, margin: float) -> None:
        goal = None if task is None else task.stiffness
        self._measures: tuple[Measure, ...] = ()
        if goal is not None:
            self._measures = (*goal.at_least, *((goal.match,) if goal.match else ()))
        self._margin = margin
        self._values: Formula | None = None

    def __bool__(self) -> bool:
        """Return True if the task demands a stiffness."""
        return bool(self._measures)

    def are_clearly_met(self, tip: TipAt) -> bool:
        """Return whether a tip has what is demanded, with the margin.

        That of a match is at most half of its tolerance.
        """
        return all(
            measure.holds(_changed(measure, value, sign * self._strict(measure)))
            for measure, value in self._at(tip)
            for sign in (-1, 1)
        )

    def are_missed(self, tip: TipAt) -> bool:
        """Return whether a tip is short of what is demanded by more than the margin."""
        return not all(
            any(measure.holds(_changed(measure, value, sign * self._margin)) for sign in (-1, 0, 1))
            for measure, value in self._at(tip)
        )

    def _strict(self, measure: Measure) -> float:
        tolerance = getattr(measure, "tolerance", None)  # of each match
        return self._margin if tolerance is None else min(self._margin, tolerance / 2)

    def _at(self, tip: TipAt) -> list[tuple[Measure, float]]:
        """Return the measures with their values at a tip."""
        if self._values is None:
            self._values = _values(self._measures)
        values = self._values(tip.compliance, tip.pose[:3, :3], tip.pose[:3, 3])
        return [(m, float(value[0])) for m, value in zip(self._measures, values, strict=True)]


def _changed(measure: Measure, value: float, share: float) -> float:
    """Return a stiffness that is changed by a share, or a distance to which it is added."""
    return value * (1 + share) if measure.is_stiffness else value + share


@dataclass(frozen=True)
class _Tip:
    """The symbols of a tip from which measures compute their values."""

    compliance: ca.SX  # (6, 6)
    rotation: ca.SX  # (3, 3)
    position: ca.SX  # (3,)

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        return wrench.T @ self.compliance @ wrench


def _values(measures: tuple[Measure, ...]) -> Formula:
    """Return stiffnesses, or distances from a matrix, of a compliance, rotation and position."""
    C, R, x = ca.SX.sym("C", 6, 6), ca.SX.sym("R", 3, 3), ca.SX.sym("x", 3)
    tip, values = _Tip(C, R, x), []
    for measure in measures:
        value = measure.formula(tip, ca.DM(measure.parameters))
        values.append(ca.exp(value) if measure.is_stiffness else ca.sqrt(value))
    return Formula([C, R, x], values)
