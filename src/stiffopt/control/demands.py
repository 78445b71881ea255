"""The stiffnesses that a task demands, and whether the arm has them."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from stiffopt.control.formula import Formula
from stiffopt.optimise.goal import AtLeast, MatchMatrix, MatchValue
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt


class Demands:
    """What a task demands by `at_least` and `match`.

    Parameters
    ----------
    task : the task; None, or one that only maximises, demands nothing.
    margin : of a stiffness, as a share.
    """

    def __init__(self, task: Task | None, margin: float) -> None:
        goal = None if task is None else task.stiffness
        self._measures: tuple[Measure, ...] = ()
        if goal is not None:
            self._measures = (*goal.at_least, *((goal.match,) if goal.match else ()))
        self._strict = [_with_margin(measure, margin) for measure in self._measures]
        self._lax = [_with_margin(measure, -margin) for measure in self._measures]
        self._values: Formula | None = None

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._measures)

    def are_clearly_met(self, tip: TipAt) -> bool:
        """Return whether a tip has what is demanded, with the margin.

        The tolerance of a match is less by the margin, but at least half of it.
        """
        return self._are_met(self._strict, tip)

    def are_missed(self, tip: TipAt) -> bool:
        """Return whether a tip is short of what is demanded by more than the margin."""
        return not self._are_met(self._lax, tip)

    def _are_met(self, measures: list[Measure], tip: TipAt) -> bool:
        if self._values is None:
            self._values = _values(self._measures)
        values = [float(value[0]) for value in self._values(tip.compliance, tip.pose[:3, :3])]
        return all(m.holds(v) for m, v in zip(measures, values, strict=True))


def _with_margin(measure: Measure, margin: float) -> Measure:
    """Return a stricter measure; a laxer one for a negative margin."""
    if isinstance(measure, AtLeast):
        return measure.model_copy(update={"value": (1 + margin) * measure.value})
    assert isinstance(measure, MatchValue | MatchMatrix)  # there are no others
    tolerance = max(measure.tolerance - margin, measure.tolerance / 2)
    return measure.model_copy(update={"tolerance": tolerance})


@dataclass(frozen=True)
class _Tip:
    """What the formulas of measures need of a tip."""

    compliance: ca.SX  # (6, 6)
    rotation: ca.SX  # (3, 3)

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        return wrench.T @ self.compliance @ wrench


def _values(measures: tuple[Measure, ...]) -> Formula:
    """Return stiffnesses, or distances from a matrix, of a compliance and a rotation."""
    C, R = ca.SX.sym("C", 6, 6), ca.SX.sym("R", 3, 3)
    tip, values = _Tip(C, R), []
    for measure in measures:
        value = measure.formula(tip, ca.DM(measure.parameters))
        values.append(ca.exp(value) if measure.is_stiffness else ca.sqrt(value))
    return Formula([C, R], values)
