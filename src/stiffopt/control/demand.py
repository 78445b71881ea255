"""What a tick asks of the tip: rows of a linear system in the pressures.

Beside the reference r, the tip shall move by what the offset that is found is more than the one
that the reference counts with.  An arm that swings is damped too: with sigma the part of the static
motion that the mode has, and y the tip, both less where they shall be, the feedback is ::

    v = -(K_1 sigma + K_2 y + K_3 y')

Channels of different segments excite the swing differently for the same motion of the tip; at the
limits, a motion of the tip alone may do so the wrong way round.  So the mode's own motion is asked
for in rows of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.closest import LEVER
from stiffopt.control.tip_filter import transition
from stiffopt.control.vibration import Vibration
from stiffopt.optimise.target import Target

__all__ = ["Demand", "demand", "parts_asked"]

Array = NDArray[np.float64]
Symbols = Any  # of casadi

_DAMPED = 3.0  # weight of what the swing has of the tip's motion, against the motion itself


@dataclass(frozen=True)
class Demand:
    """Rows J and values v, in m, of a system J (p - r) = v in pressures p beside the reference's r.

    In symbols, of which `Allocation` makes one formula with its own.

    Attributes
    ----------
    inputs : list
        Symbols; see `demand`.
    matrices : list
        Those of them that have a column for each channel.
    rows, values : J (t, n), v (t,)
    task_rows : int
        How many of the first rows are the task's.
    linear : the tip's Jacobian (3, n), base axes, in m/Pa.
    """

    inputs: list[Symbols]
    matrices: list[Symbols]
    rows: Symbols
    values: Symbols
    linear: Symbols
    task_rows: int


def parts_asked(target: Target) -> Array:
    """1 for what a target asks for, 0 for the rest: x, y, z, pointing, orientation (5,)."""
    position = target.position or (None, None, None)
    asked = [*position, target.pointing, target.orientation]
    return np.array([float(part is not None) for part in asked])


def demand(
    n: int, vibration: Vibration | None, damping: float = 0.0, dead_time: float = 0.0
) -> Demand:
    """Return what is asked of the tip of an arm with n channels.

    Its inputs are pose (4, 4) and Jacobian (6, n) of the tip on the reference's path, as `TipModel`
    gives them; what is asked for, see `parts_asked`; and by what the tip shall move (6,) for it,
    base axes, in m and as a rotation vector.  Turns count as motions at the end of
    `closest.LEVER`.

    If the arm swings, they are besides: its swing and the speed of it (2, 3); what is soft (3, 3);
    omega, in rad/s; K (3,), see `Gains`; pressures (n,) that act a dead time from now, that the
    reference has in the chambers, and that it has act; and how fast the latter change (n,).

    Parameters
    ----------
    n :
        Number of channels.
    vibration :
        The arm's first bending mode; None for an arm that does not swing.
    damping, dead_time :
        Share of critical damping of the mode; of the regulators, in s.
    """
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    asked, correction = ca.SX.sym("asked", 5), ca.SX.sym("correction", 6)
    rotation, shift, turn = pose[:3, :3], correction[:3], correction[3:]
    linear, angular = rotation @ jacobian[:3, :], rotation @ jacobian[3:, :]
    inputs, modal, damped = [pose, jacobian, asked, correction], [], []
    if vibration is not None:
        swing, across = ca.SX.sym("swing", 2, 3), ca.SX.sym("across", 3, 3)
        omega, gains = ca.SX.sym("omega"), ca.SX.sym("gains", 3)
        ahead, chamber = ca.SX.sym("ahead", n), ca.SX.sym("chamber", n)
        path, rate = ca.SX.sym("path", n), ca.SX.sym("rate", n)
        inputs += [swing, across, omega, gains, ahead, chamber, path, rate]
        M = across @ (linear @ ca.diag(ca.DM(vibration.participation)))
        later = transition(omega, damping, dead_time) @ swing
        home = float(np.mean(vibration.participation)) * (across @ shift)
        static = M @ (ahead - chamber) - home
        tip = M @ (ahead - path) + later[0, :].T - home
        speed = later[1, :].T - M @ rate
        feedback = -(gains[0] * static + gains[1] * tip + gains[2] * speed)
        shift = shift + feedback
        modal, damped = [_DAMPED * M], [_DAMPED * (home + feedback)]
    axis = rotation[:, 2]
    sideways = ca.SX.eye(3) - axis @ axis.T
    position, pointing, orientation = ca.diag(asked[:3]), LEVER * asked[3], LEVER * asked[4]
    task = [position @ linear, pointing * (sideways @ angular), orientation * angular]
    values = [position @ shift, pointing * (sideways @ turn), orientation * turn]
    rows = ca.vertcat(*task, *modal)
    return Demand(inputs, [jacobian], rows, ca.vertcat(*values, *damped), linear, 9)
