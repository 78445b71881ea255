"""The linear feedback law at the tip, as rows of a linear system in the pressures.

Relative to the reference, the tip is to move by the correction: the offset that the plan accounts
for minus the offset estimated now. Feedback also damps the arm's vibration. In each axis of the
soft plane, relative to the reference, it obeys ::

    tau sigma' = u - sigma                       the mode's static displacement, behind regulators
    epsilon'' = -2 zeta omega epsilon' - omega^2 (epsilon - sigma)                        the tip

and the linear-quadratic regulator ``v = -K (sigma, epsilon, epsilon')`` that minimises
``int epsilon^2 + effort u^2`` brings it to rest.

Channels of different segments excite the mode differently for the same motion of the tip. At the
limits of pressure, rows for the tip alone could excite the mode instead of damping it, so the mode
has rows of its own.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from stiffopt.arrays import Array
from stiffopt.control.tuning import FeedbackTuning
from stiffopt.control.vibration import transition
from stiffopt.optimise.target import Target

Symbols = Any  # of CasADi

_FREQUENCIES = np.geomspace(2.0, 200.0, 60).tolist()  # rad/s, of the table of gains


@dataclass(frozen=True)
class TrackingRows:
    """Rows J and values v, in m, of a system J (p - r) = v in pressures p near the reference r.

    They are symbolic: `Allocation` combines them with its own terms in one formula.
    """

    inputs: list[Symbols]  # see `tracking_rows`
    matrices: list[Symbols]  # the inputs that have one column per channel
    rows: Symbols  # J (t, n)
    values: Symbols  # v (t,)
    linear: Symbols  # Jacobian (3, n) of the tip's position, base axes, in m/Pa
    task_rows: int  # number of rows of the task; they come first


def prescribed_components(target: Target) -> Array:
    """Return 1 for each component (5,) that a target prescribes, 0 for others.

    The components are x, y, z, pointing and orientation.
    """
    position = target.position or (None, None, None)
    components = [*position, target.pointing, target.orientation]
    return np.array([float(component is not None) for component in components])


def tracking_rows(
    n: int,
    vibrates: bool,
    damping: float = 0.0,
    dead_time: float = 0.0,
    tuning: FeedbackTuning | None = None,
) -> TrackingRows:
    """Return the feedback law of an arm with n channels.

    Its inputs are pose (4, 4) and Jacobian (6, n) of the tip on the reference, as `TipModel` gives
    them; the components that the target prescribes (5,), see `prescribed_components`; and the
    correction of the tip (6,) in base axes, in m and as a rotation vector. `FeedbackTuning.lever`
    converts angles to displacements.

    For an arm that vibrates there are also: its vibration and the vibration's speed (2, 3); the
    plane (3, 3) in which it moves the tip, and the Jacobian (3, n) of the tip's displacement in it,
    see `BentMode`; omega, in rad/s; gains K (3,), see `GainSchedule`; the effective pressures
    (n,) a dead time from now; those that the shape has followed then; those that the reference has
    in the chambers then; those on the reference's path; the rate of the latter (n,); and the
    vibration intended, as the first (2, 3).

    Parameters
    ----------
    n : number of channels.
    vibrates : whether the arm vibrates.
    damping, dead_time : damping ratio of the mode; dead time of the regulators, in s.
    tuning : weights of the rows.
    """
    tuning = tuning or FeedbackTuning()
    lever, mode_weight = tuning.lever, tuning.mode_weight
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    prescribed, correction = ca.SX.sym("prescribed", 5), ca.SX.sym("correction", 6)
    rotation, shift, turn = pose[:3, :3], correction[:3], correction[3:]
    linear, angular = rotation @ jacobian[:3, :], jacobian[3:, :]  # base axes, tip axes
    inputs, mode_rows, mode_values = [pose, jacobian, prescribed, correction], [], []
    matrices = [jacobian]
    if vibrates:
        vibration, plane = ca.SX.sym("vibration", 2, 3), ca.SX.sym("plane", 3, 3)
        M = ca.SX.sym("mode", 3, n)  # Jacobian of the mode
        intended = ca.SX.sym("intended", 2, 3)
        omega, gains = ca.SX.sym("omega"), ca.SX.sym("gains", 3)
        ahead, chamber = ca.SX.sym("ahead", n), ca.SX.sym("chamber", n)
        strained = ca.SX.sym("strained", n)
        path, rate = ca.SX.sym("path", n), ca.SX.sym("rate", n)
        inputs += [vibration, plane, M, omega, gains, ahead, strained, chamber, path, rate]
        inputs += [intended]
        matrices.append(M)
        later = transition(omega, damping, dead_time) @ vibration
        goal = plane @ shift
        reached = intended @ plane
        sigma = M @ (ahead - chamber) - goal
        epsilon = M @ (strained - path) + later[0, :].T - reached[0, :].T
        speed = later[1, :].T - M @ rate - reached[1, :].T
        feedback = -(gains[0] * sigma + gains[1] * epsilon + gains[2] * speed)
        shift = shift + feedback
        mode_rows, mode_values = [mode_weight * M], [mode_weight * (goal + feedback)]
    turn = rotation.T @ turn
    position = ca.diag(prescribed[:3])
    pointing, orientation = lever * prescribed[3], lever * prescribed[4]
    # turning about the tip's own axis leaves its direction as it is
    task = [position @ linear, pointing * angular[:2, :], orientation * angular]
    values = [position @ shift, pointing * turn[:2], orientation * turn]
    rows = ca.vertcat(*task, *mode_rows)
    return TrackingRows(inputs, matrices, rows, ca.vertcat(*values, *mode_values), linear, 8)


def with_offsets(law: TrackingRows) -> TrackingRows:
    """Return a feedback law that finds the correction of the tip itself.

    The correction is what the plan accounts for minus what feedback corrects now: the offset,
    averaged over a vibration, except along a stiff axis, and except for the part that is known to
    grow with the motion. The regulators delay that part.

    In place of the correction, the last inputs are: the offset (6,) that the plan accounts for;
    the present estimate (6,); the average (9,) of offset and position of the tip on the reference;
    the slope (3, 3) and the stiff axis (3, 3), see `MotionErrorEstimator` and `TipEstimator`; the
    rate (n,) of the reference's path; the regulators' delay, in s; and the greatest correction of
    the position, in m.
    """
    pose, jacobian, prescribed, correction, *others = law.inputs
    accounted, offset = ca.SX.sym("accounted", 6), ca.SX.sym("offset", 6)
    average, slope = ca.SX.sym("average", 9), ca.SX.sym("slope", 3, 3)
    stiff_axis, rate = ca.SX.sym("stiff_axis", 3, 3), ca.SX.sym("rate", jacobian.shape[1])
    delay, most = ca.SX.sym("delay"), ca.SX.sym("most")
    grown = slope @ (pose[:3, 3] - average[6:])
    behind = offset[:3] - average[:3] - grown
    ahead = slope @ (pose[:3, :3] @ (jacobian[:3, :] @ rate)) * delay
    corrected = average[:3] + grown + ahead + stiff_axis @ behind
    found = accounted - ca.vertcat(corrected, average[3:6])
    size = ca.norm_2(found[:3])
    found *= ca.if_else(size > most, most / size, 1)
    own = [accounted, offset, average, slope, stiff_axis, rate, delay, most]
    return replace(
        law,
        inputs=[pose, jacobian, prescribed, *others, *own],
        values=ca.substitute(law.values, correction, found),
    )


def with_reference(law: TrackingRows) -> TrackingRows:
    """Return a feedback law that takes what it needs from the reference and from averages of it.

    `law` is one of `with_offsets`. In place of the inputs on the reference's path and rate (n,),
    the vibration intended, the offset accounted for and the average, the last inputs are: the path
    with its derivatives (4, n + 6), see `Reference.motion`, and the averages (3, 9), see
    `VibrationFilter.averages`.
    """
    *others, accounted, offset, average, slope, stiff_axis, rate, delay, most = law.inputs
    n = rate.shape[0]
    motion, averages = ca.SX.sym("motion", 4, n + 6), ca.SX.sym("averages", 3, 9)
    path, derivative = motion[0, :].T, motion[1, :].T
    given = [(accounted, path[n:]), (average, averages[0, :].T), (rate, derivative[:n])]
    if len(others) > 3:  # it vibrates
        *others, on_path, path_rate, intended = others
        reached = motion[:2, n : n + 3] - averages[1:, :3]
        given += [(on_path, path[:n]), (path_rate, derivative[:n]), (intended, reached)]
    replaced, by = zip(*given, strict=True)
    return replace(
        law,
        inputs=[*others, offset, slope, stiff_axis, delay, most, motion, averages],
        values=ca.substitute([law.values], list(replaced), list(by))[0],
    )


def with_excess(law: TrackingRows, participation: Array) -> TrackingRows:
    """Return a feedback law that finds the Jacobian of the mode itself.

    It is that of the tip's position in the plane, by the shares (n,) with which a straight arm's
    channels take part, plus an excess (3, n), see `BentMode`, which replaces it as an input.
    """
    pose, jacobian, prescribed, correction, vibration, plane, mode, *others = law.inputs
    excess = ca.SX.sym("excess", *mode.shape)
    found = plane @ law.linear @ ca.diag(ca.DM(participation)) + excess
    return replace(
        law,
        inputs=[pose, jacobian, prescribed, correction, vibration, plane, excess, *others],
        matrices=[jacobian, excess],
        rows=ca.substitute(law.rows, mode, found),
        values=ca.substitute(law.values, mode, found),
    )


class GainSchedule:
    """Gains K (3,) of the linear-quadratic regulator over the frequency of the vibration.

    The parameters are those of `lqr_gains`.
    """

    def __init__(self, period: float, lag: float, damping: float, effort: float) -> None:
        self._table = np.array(
            [lqr_gains(omega, damping, max(lag, 1e-3), period, effort) for omega in _FREQUENCIES]
        )
        self._last: tuple[float, Array] = (-1.0, np.zeros(3))

    def at(self, omega: float) -> Array:
        """Return gains (3,) at an angular frequency in rad/s; the last gain is in s."""
        if omega != self._last[0]:
            above = min(max(bisect(_FREQUENCIES, omega), 1), len(_FREQUENCIES) - 1)
            low, high = _FREQUENCIES[above - 1 : above + 1]
            share = min(max((omega - low) / (high - low), 0.0), 1.0)
            self._last = omega, (1 - share) * self._table[above - 1] + share * self._table[above]
        return self._last[1]


def lqr_gains(omega: float, damping: float, lag: float, period: float, effort: float) -> Array:
    """Return gains (3,) of the linear-quadratic regulator, sampled at the loop's period.

    `omega` is the vibration's angular frequency, in rad/s, `damping` its damping ratio; `lag` is
    that of the regulators, in s, and `period` the loop's, in s.
    """
    A = np.array(
        [[-1 / lag, 0, 0], [0, 0, 1], [omega**2, -(omega**2), -2 * damping * omega]], dtype=float
    )
    B = np.array([[1 / lag], [0], [0]])
    sampled = expm(period * np.block([[A, B], [np.zeros((1, 4))]]))
    F, G = sampled[:3, :3], sampled[:3, 3:]
    Q, R = np.diag([0.0, 1.0, 0.0]), np.array([[effort]])
    S = solve_discrete_are(F, G, Q, R)
    return np.asarray(np.linalg.solve(R + G.T @ S @ G, G.T @ S @ F)[0])
