"""Poses along the unloaded arm from the strains of its sections (eqs 6 and 7).

A segment of constant strain is one exponential.  The paper's product of five exponentials
(eq. 7) is the same motion, but is undefined at zero curvature, where this one is smooth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from stiffopt import lie
from stiffopt.model.actuation import Section, StrainLaw
from stiffopt.model.description import RobotDescription
from stiffopt.model.laws import strain_law


@dataclass(frozen=True)
class Actuation:
    """Sections of an arm's segments as symbolic functions of its pressures."""

    pressures: ca.SX  # all channel pressures (n,), proximal segment first, in Pa
    sections: tuple[Section, ...]  # one per segment, proximal first
    margin: ca.SX  # a number per segment, positive while its strain law holds
    radii: ca.SX  # outer radius of each segment's section, in m

    @classmethod
    def of(
        cls, description: RobotDescription, laws: Sequence[StrainLaw] | None = None
    ) -> "Actuation":
        """Return the actuation of a robot, by the strain laws of its segments or by given ones."""
        pressures = ca.SX.sym("p", description.n_pressures)
        if laws is None:
            laws = [strain_law(segment) for segment in description.segments]
        offset, sections, margins, radii = 0, [], [], []
        for segment, law in zip(description.segments, laws, strict=True):
            own = pressures[offset : offset + segment.n_channels]
            offset += segment.n_channels
            sections.append(law.section(own))
            margins.append(law.margin(own))
            radii.append(law.radius(own))
        return cls(pressures, tuple(sections), ca.vertcat(*margins), ca.vertcat(*radii))


def connector(length: ca.SX | float) -> ca.SX:
    """Return the pose of the far end of a rigid connector in its near end."""
    return lie.transform(ca.SX.eye(3), ca.vertcat(0, 0, ca.SX(length)))


def segment_pose(section: Section, arc_length: ca.SX | float) -> ca.SX:
    """Return the pose (4, 4) at a reference arc length along a segment, in the segment's base."""
    return lie.exp(section.strain * arc_length)


def segment_jacobian(section: Section, arc_length: float, pressures: ca.SX) -> ca.SX:
    """Return the body twist (6, c) of a segment's far end per unit of its pressures (c,).

    The derivative of the exponential in closed form; `body_jacobian` of `segment_pose`
    gives the same at several times the cost.
    """
    twist = section.strain * arc_length
    change = ca.jacobian(section.strain, pressures) * arc_length  # (6, c)
    v, w = twist[:3], twist[3:]
    first, second, third, second_slope, third_slope = _coefficients_and_slopes(ca.sumsqr(w))
    W = lie.hat(w)
    Wv = W @ v
    WWv = W @ Wv
    rotation = ca.SX.eye(3) + first * W + second * (W @ W)
    columns = []
    for k in range(change.shape[1]):
        dv, dw = change[:3, k], change[3:, k]
        growth = 2 * ca.dot(w, dw)  # of the squared angle
        turning = ca.cross(dw, v) + W @ dv  # of W v
        moved = (
            dv
            + second * turning
            + third * (ca.cross(dw, Wv) + W @ turning)
            + growth * (second_slope * Wv + third_slope * WWv)
        )
        Wdw = W @ dw
        columns.append(ca.vertcat(rotation.T @ moved, dw - second * Wdw + third * (W @ Wdw)))
    return ca.horzcat(*columns)


def _coefficients_and_slopes(squared_angle: ca.SX) -> tuple[ca.SX, ...]:
    """Return the exponential's coefficients, and slopes of the last two by the squared angle."""
    x = ca.SX.sym("x")
    first, second, third = lie.exponential_coefficients(x)
    slopes = [ca.jacobian(second, x), ca.jacobian(third, x)]
    outputs = ca.Function("slopes", [x], [first, second, third, *slopes])(squared_angle)
    return tuple(outputs)


def body_jacobian(T: ca.SX, variables: ca.SX) -> ca.SX:
    """Return the body twist (6, n) of a moving frame (4, 4) per unit of variables (n,).

    ``J_i = (T^-1 dT/dx_i)^v``, in the axes of the moving frame, linear part first.
    """
    rotation = T[:3, :3]
    linear = rotation.T @ ca.jacobian(T[:3, 3], variables)
    columns = [ca.jacobian(rotation[:, k], variables) for k in range(3)]  # each (3, n)
    angular = ca.vertcat(  # entries (2, 1), (0, 2), (1, 0) of R^T dR
        rotation[:, 2].T @ columns[1],
        rotation[:, 0].T @ columns[2],
        rotation[:, 1].T @ columns[0],
    )
    return ca.vertcat(linear, angular)
