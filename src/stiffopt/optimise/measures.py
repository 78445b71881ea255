"""Stiffness measures: scalars of the tip's compliance that a task bounds or optimises.

A measure splits into its *structure*, for which a function is compiled, and its *parameters*,
which are arguments of that function.  To add a measure, subclass `Measure`.
"""

from abc import ABC, abstractmethod
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.model.compliance import held_stiffness, stiffness_block
from stiffopt.model.shape import FreeShape, Shape, stiffness_along
from stiffopt.optimise.goal import MatchMatrix, StiffnessMeasure

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

    def gradient(self, tip: Shape, parameters: Any) -> Any:
        """Symbolic derivative (1, n) of the value by the pressures."""
        return tip.total_jacobian(self.value(tip, parameters))


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
        measure = self._measure
        return ca.log(
            stiffness_along(tip, parameters, measure.frame, measure.kind, measure.boundary)
        )

    def gradient(self, tip: Shape, parameters: Any) -> Any:
        """Derivative of the value; see `Measure.gradient`.

        Where other motions are held, ``k = d' K d`` and W is the wrench that moves the tip by d:
        then ``dk = -W' dC W``, in axes in which d does not turn.  That is the derivative of a
        flexibility, of a third of the operations.
        """
        measure = self._measure
        if measure.boundary == "free" or not isinstance(tip, FreeShape):
            return super().gradient(tip, parameters)
        turn = tip.rotation.T if measure.frame == "base" else ca.SX.eye(3)
        stiffness, wrench = held_stiffness(
            tip.compliance,
            turn @ parameters,
            measure.kind == "rotation",
            measure.boundary == "clamped",
        )
        still = ca.SX.sym("wrench", 6)
        slope = tip.total_jacobian(tip.flexibility(lie.rotate_blocks(turn) @ still))
        return -ca.substitute(slope, still, lie.rotate_blocks(turn.T) @ wrench) / stiffness


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
