"""Stiffness measures: scalars of the tip's compliance that a task bounds or optimises.

A measure splits into its *structure*, for which a function is compiled, and its *parameters*,
which are arguments of that function.  To add a measure, subclass `Measure`.
"""

from abc import ABC, abstractmethod
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.compliance import directional_stiffness, stiffness_block
from stiffopt.model.shape import Shape
from stiffopt.optimise.goal import MatchMatrix, StiffnessMeasure
from stiffopt.optimise.task import Task

Vector = NDArray[np.float64]


class Measure(ABC):
    """A scalar of the tip's shape."""

    @property
    @abstractmethod
    def structure(self) -> tuple[str, ...]:
        """What the compiled function depends on."""

    @property
    @abstractmethod
    def parameters(self) -> Vector:
        """Its arguments (k,), always as many for one structure."""

    @abstractmethod
    def value(self, tip: Shape, parameters: Any) -> Any:
        """Symbolic value for symbolic parameters (k,)."""


class LogStiffness(Measure):
    """Logarithm of a directional stiffness, in N/m or N m/rad before it is taken."""

    def __init__(self, measure: StiffnessMeasure) -> None:
        self._measure = measure

    @property
    def structure(self) -> tuple[str, ...]:
        """Kind, frame and boundary."""
        return ("direction", self._measure.kind, self._measure.frame, self._measure.boundary)

    @property
    def parameters(self) -> Vector:
        """The unit direction (3,)."""
        return np.array(self._measure.direction)

    def value(self, tip: Shape, parameters: Any) -> Any:
        """``log k``; see `stiffopt.model.compliance.directional_stiffness`."""
        return ca.log(
            directional_stiffness(
                tip.compliance,
                tip.rotation,
                parameters,
                frame=self._measure.frame,
                kind=self._measure.kind,
                boundary=self._measure.boundary,
            )
        )


class MatrixDistance(Measure):
    """Squared relative Frobenius distance of the translational stiffness from a matrix."""

    def __init__(self, match: MatchMatrix) -> None:
        self._match = match

    @property
    def structure(self) -> tuple[str, ...]:
        """Frame and boundary."""
        return ("matrix", self._match.frame, self._match.boundary)

    @property
    def parameters(self) -> Vector:
        """Entries of the wanted matrix (9,)."""
        return np.array(self._match.matrix).ravel()

    def value(self, tip: Shape, parameters: Any) -> Any:
        """``|K - K_wanted|^2 / |K_wanted|^2``."""
        K = stiffness_block(tip.compliance, "translation", self._match.boundary)
        if self._match.frame == "base":
            K = tip.rotation @ K @ tip.rotation.T
        return ca.sumsqr(ca.vec(K) - parameters) / ca.sumsqr(parameters)


def measures(task: Task) -> tuple[Measure, ...]:
    """All that a task names: what is maximised, then what is matched, then the floors."""
    goal = task.stiffness
    if goal is None:
        return ()
    found: list[Measure] = [LogStiffness(measure) for measure in goal.maximise]
    if isinstance(goal.match, MatchMatrix):
        found.append(MatrixDistance(goal.match))
    elif goal.match is not None:
        found.append(LogStiffness(goal.match))
    return (*found, *(LogStiffness(floor) for floor in goal.at_least))
