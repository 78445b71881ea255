"""Poses, Jacobians and compliances of stations as CasADi functions, for users' optimisations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import casadi as ca

from stiffopt import lie
from stiffopt.model.codegen import dense
from stiffopt.model.compliance import carry_compliance
from stiffopt.model.kinematics import body_jacobian
from stiffopt.model.shape import FreeShape

if TYPE_CHECKING:
    from stiffopt.model.arm import Arm

Along = Literal["pose", "body_jacobian", "compliance_between"]


def body_function(arm: Arm, name: Along, at: tuple[float, ...]) -> ca.Function:
    """See `Manipulator.body_function`."""
    return dense(_loaded(arm, name, at) if arm.is_loaded else _free(arm, name, at))


def _free(arm: Arm, name: Along, at: tuple[float, ...]) -> ca.Function:
    shapes = [FreeShape.of(arm.description, arm._actuation, s) for s in at]
    if name == "compliance_between":
        first, nearer = shapes[0], shapes[at.index(min(at))]
        about_base = carry_compliance(nearer.compliance, nearer.transform)
        X_s, X_t = (lie.adjoint(lie.transform(ca.SX.eye(3), -each.position)) for each in shapes)
        value = X_s @ about_base @ X_t.T
    else:
        (first,) = shapes
        value = first.transform if name == "pose" else first.jacobian
    return ca.Function(name, [first.pressures], [value], ["p"], [name])


def _loaded(arm: Arm, name: Along, at: tuple[float, ...]) -> ca.Function:
    """Return the function of pressures and the tip's quaternion, with the residual."""
    chain = arm._equilibrium().shooting.chain(at[-1])
    if name == "compliance_between":
        point = chain.station(at[0])
        twist = body_jacobian(lie.transform(point.rotation, point.position), chain.x)
        per_wrench = chain.per_rest(twist)[:, -6:]
        value = ca.diagcat(point.rotation, point.rotation) @ per_wrench
    else:
        value = chain.transform if name == "pose" else chain.jacobian
    inside = ca.Function("chain", list(chain.inputs), [value, chain.residual])
    p, q = ca.MX.sym("p", arm.n_pressures), ca.MX.sym("q", 4)
    x = ca.vertcat(ca.DM.zeros(3), p, ca.DM.zeros(6))
    found = inside(q / ca.norm_2(q), x, *(ca.DM(each) for each in arm._loads))
    return ca.Function(name, [p, q], list(found), ["p", "q"], [name, "residual"])
