"""Errors of the tip relative to its target, and its stiffness, for every tick.

The formulas are those of the optimiser: the residuals of `stiffopt.optimise.terms` and
`directional_stiffness` of `stiffopt.model.compliance`, compiled once per kind of target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.formula import Formula
from stiffopt.model.compliance import directional_stiffness
from stiffopt.model.shape import PointOfArm
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.term import Term
from stiffopt.optimise.tip import TipAt

_INEQUALITY_WEIGHT = 30.0
"""Weight of an inequality in least squares; it may be violated by a thousandth of the error."""

_ERROR_PER_FORCE = 0.01  # error of the model's tip, over the force of a usual push, in m/N


class TipErrors:
    """Position and angle errors of a tip, and their derivatives by the pressures."""

    def __init__(self) -> None:
        self._norms: dict[Hashable, Formula] = {}
        self._weighted: dict[Hashable, Formula] = {}

    def at(self, target: Target | None, position: Array, rotation: Array) -> tuple[float, float]:
        """Return position error, in m, and angle error, in rad, of a tip (3,) with axes (3, 3).

        NaN for what the target leaves free.
        """
        if target is None:
            return math.nan, math.nan
        terms = _terms_of_tip(target)
        key = tuple(term.structure for term in terms)
        if key not in self._norms:
            self._norms[key] = _norms(terms)
        errors = self._norms[key](position, rotation, *(term.parameters for term in terms))
        found = {term.name: float(error[0]) for term, error in zip(terms, errors, strict=True)}
        return found.get("position", math.nan), found.get("angle", math.nan)

    def weighted(
        self, target: Target, tip: TipAt, lever: float
    ) -> tuple[Array, Array, float, float]:
        """Return the error of the model's tip as one vector of lengths (t,), for least squares.

        `lever`, in m/rad, converts angles. Return the error, in m, its Jacobian (t, n), in m/Pa,
        and the position and angle errors, in m and rad; 0 for what the target leaves free.
        """
        terms, n = _terms_of_tip(target), tip.jacobian.shape[1]
        key = (n, lever, *(term.structure for term in terms))
        if key not in self._weighted:
            self._weighted[key] = _weighted(terms, n, lever)
        error, jacobian, *norms = self._weighted[key](
            tip.pose, tip.jacobian, *(term.parameters for term in terms)
        )
        found = {term.name: float(norm[0]) for term, norm in zip(terms, norms, strict=True)}
        return error, jacobian, found.get("position", 0.0), found.get("angle", 0.0)


def _norms(terms: tuple[Term, ...]) -> Formula:
    """Return norms of residuals; inputs: position (3,), rotation (3, 3), each term's parameters."""
    position, rotation = ca.SX.sym("position", 3), ca.SX.sym("rotation", 3, 3)
    parameters = [ca.SX.sym("parameters", len(term.parameters)) for term in terms]
    residuals = _residuals(terms, position, rotation, parameters)
    return Formula([position, rotation, *parameters], [ca.norm_2(r) for r in residuals])


def _weighted(terms: tuple[Term, ...], n: int, lever: float) -> Formula:
    """Return the formula of the error (t,), its Jacobian (t, n) and the norms of residuals.

    Inputs: pose (4, 4) and Jacobian (6, n) of the tip, parameters of each term. The residuals are
    differentiated by a twist xi of the tip, ``pose exp(xi)``, at xi = 0.
    """
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    parameters = [ca.SX.sym("parameters", len(term.parameters)) for term in terms]
    twist, rotation = ca.SX.sym("twist", 6), pose[:3, :3]
    position = pose[:3, 3] + rotation @ twist[:3]
    turned = rotation @ (ca.SX.eye(3) + lie.hat(twist[3:]))
    residuals = _residuals(terms, position, turned, parameters)
    weights = [lever if term.name == "angle" else 1.0 for term in terms]
    error = ca.vertcat(*(w * r for w, r in zip(weights, residuals, strict=True)))
    outputs = [error, ca.jacobian(error, twist) @ jacobian, *map(ca.norm_2, residuals)]
    at_tip = [ca.substitute(output, twist, ca.SX.zeros(6)) for output in outputs]
    return Formula([pose, jacobian, *parameters], at_tip, [jacobian, at_tip[1]])


def _residuals(
    terms: tuple[Term, ...], position: ca.SX, rotation: ca.SX, parameters: list[ca.SX]
) -> list[ca.SX]:
    tip = PointOfArm(position, rotation)
    found = []
    for term, values in zip(terms, parameters, strict=True):
        residual = term.residual(tip, values)
        found.append(_INEQUALITY_WEIGHT * ca.fmin(residual, 0) if term.is_inequality else residual)
    return found


def _terms_of_tip(target: Target) -> tuple[Term, ...]:
    return tuple(term for term in target.terms if not term.has_stations)


def stiffness_function(task: Task) -> Callable[[Array, Array], float] | None:
    """Return a function from compliance (6, 6) and rotation (3, 3) to the task's stiffness.

    The stiffness is along the task's first direction; None if there is none.
    """
    if not task.measures:
        return None
    measure = task.measures[0]
    if not isinstance(measure, StiffnessMeasure):
        return None
    C, R = ca.SX.sym("C", 6, 6), ca.SX.sym("R", 3, 3)
    value = directional_stiffness(
        C, R, ca.DM(measure.direction),
        frame=measure.frame, kind=measure.kind, boundary=measure.boundary,
    )  # fmt: skip
    formula = Formula([C, R], [value])

    def stiffness(compliance: Array, rotation: Array) -> float:
        return float(formula(compliance, rotation)[0][0])

    return stiffness


def turn_of_a_push(tip: TipAt, *, along_stiff_axis: bool = False) -> Array:
    """Return the turn of the tip (3, 3) per displacement by a force at it, base axes, in rad/m.

    It covers the tip's two softest directions; a displacement along the third turns nothing, as it
    is mostly an error of the model, not a force. `along_stiff_axis` counts it as a force as far as
    the compliance c of that axis is more than that of an error of 1 mm by 0.1 N: with the weight
    ``c / (c^2 + (1 mm / 0.1 N)^2)`` instead of ``1 / c``.
    """
    rotation = tip.pose[:3, :3]
    compliances, axes = np.linalg.eigh(tip.compliance[:3, :3])
    stiff, *soft = compliances
    along = stiff / (stiff**2 + _ERROR_PER_FORCE**2) if along_stiff_axis else 0.0
    stiffnesses = np.array([along, *(1 / c for c in soft)])
    turn: Array = tip.compliance[3:, :3] @ axes * stiffnesses @ axes.T
    return rotation @ turn @ rotation.T


def missed_turn(bent: Array, turned: Array, further: float) -> float:
    """Return by how much a turn (3,) differs from that of a push, in rad.

    A force at the tip would cause the turn `bent` (3,). A moment, another posture than the model's
    or a higher mode may turn the tip further the same way, up to a multiple of it.
    """
    share = float(bent @ turned) / max(float(bent @ bent), 1e-12)
    share = min(max(share, 1.0), further)
    return float(np.linalg.norm(turned - share * bent))


def target_arrays(target: Target | None) -> tuple[Array | None, Array | None, Array | None]:
    """Return position (3,), NaN for free axes, pointing (3,) and quaternion (4,) of a target."""
    if target is None:
        return None, None, None
    position = None
    if target.position is not None:
        position = np.array([np.nan if axis is None else axis for axis in target.position])
    pointing = None if target.pointing is None else np.array(target.pointing)
    return position, pointing, None if target.orientation is None else np.array(target.orientation)
