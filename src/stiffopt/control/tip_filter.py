"""The arithmetic of the tip's Kalman filter; `TipEstimator` says what it means."""

from __future__ import annotations

from typing import Any

import casadi as ca

from stiffopt import lie
from stiffopt.control.formula import Formula
from stiffopt.control.vibration import Vibration

__all__ = ["correction", "orientation", "prediction", "transition"]

Symbols = Any  # of casadi


def transition(omega: Symbols, damping: float, duration: Symbols) -> Symbols:
    """What a duration in s, which may be negative, does to a free swing and its speed (2, 2)."""
    fast = omega * (1 - damping**2) ** 0.5
    decay = ca.exp(-damping * omega * duration)
    c, s = decay * ca.cos(fast * duration), decay * ca.sin(fast * duration) / fast
    return ca.blockcat([[c + damping * omega * s, s], [-(omega**2) * s, c - damping * omega * s]])


def prediction(vibration: Vibration | None, n: int, damping: float) -> Formula:
    """A step of the loop.

    Takes the pose (4, 4) and Jacobian (6, n) of the model's tip, the place (3,) where it was, the
    swing that the pressures drive and the free one (2, 3) each, what is soft (3, 3), the change of
    the pressures (n,), and (omega, duration).  Gives the place (3,), both swings, and the ways (2,)
    of place and swing.
    """
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    before, change = ca.SX.sym("before", 3), ca.SX.sym("change", n)
    driven, free = ca.SX.sym("driven", 2, 3), ca.SX.sym("free", 2, 3)
    across, times = ca.SX.sym("across", 3, 3), ca.SX.sym("times", 2)
    place, moved = pose[:3, 3], ca.SX.zeros(3)
    driven_after, free_after = driven, free
    if vibration is not None:
        # half of what the mode is moved by comes before the step, half after
        moved = across @ (
            pose[:3, :3] @ (jacobian[:3, :] @ (ca.DM(vibration.participation) * change))
        )
        half = ca.vertcat(0.5 * moved.T, ca.SX.zeros(1, 3))
        F = transition(times[0], damping, times[1])
        driven_after, free_after = F @ (driven - half) - half, F @ free
    ways = ca.vertcat(ca.norm_2(place - before), ca.norm_2(moved))
    inputs = [pose, jacobian, before, driven, free, across, change, times]
    return Formula(inputs, [place, driven_after, free_after, ways], [jacobian])


def correction(settings: Any, swings: bool) -> Formula:
    """What a sample teaches.

    Takes of the moment of its capture the model's place (3,) and rotation (3, 3) and the driven
    swing (2, 3); of now the free swing (2, 3), offset and turn (3,) each; what is soft and how the
    tip leans (3, 3) each; the covariance (3, 3) of xi, w and d in the soft plane and the variances
    (2,) of d along the stiff axis and of the turn; (age of the sample, time since the one before,
    omega) and the ways since then (2,); the sample's position (3,) and quaternion (4,), and 1 if it
    has one.  Gives free swing, offset, turn, covariance and variances.

    Parameters
    ----------
    settings : EstimatorSettings
    swings : whether the arm does.
    """
    s = settings
    place, rotation = ca.SX.sym("place", 3), ca.SX.sym("rotation", 3, 3)
    driven, free = ca.SX.sym("driven", 2, 3), ca.SX.sym("free", 2, 3)
    offset, turn = ca.SX.sym("offset", 3), ca.SX.sym("turn", 3)
    across, lean = ca.SX.sym("across", 3, 3), ca.SX.sym("lean", 3, 3)
    covariance, variances = ca.SX.sym("covariance", 3, 3), ca.SX.sym("variances", 2)
    times, ways = ca.SX.sym("times", 3), ca.SX.sym("ways", 2)
    position, quaternion = ca.SX.sym("position", 3), ca.SX.sym("quaternion", 4)
    oriented = ca.SX.sym("oriented")
    age, elapsed, omega = times[0], times[1], times[2]

    # certainty fades over the time since the last sample, and the way gone since then
    erred = (s.model_error * ways[0]) ** 2
    drift = s.drift**2 * elapsed + erred
    length = ca.fmax(1e-3, ca.norm_2(place))
    axial = variances[0] + drift
    angular = variances[1] + s.angular_drift**2 * elapsed + erred / length**2 * 4
    swing = driven
    if swings:
        swing = driven + transition(omega, s.damping, -age) @ free
        own = s.model_error * ways[1]
        detuned = s.frequency_error * omega**2 * elapsed * ca.norm_2(swing[0, :])
        grown = [own**2, s.agitation**2 * elapsed + (omega * own) ** 2 + detuned**2, drift]
        F = ca.diagcat(transition(omega, s.damping, elapsed), 1)
        P = F @ covariance @ F.T + ca.diag(ca.vertcat(*grown))
        P = 0.5 * (P + P.T)
    else:
        P = covariance + ca.diagcat(0, 0, drift)

    # in the soft plane: xi, w and d; along the stiff axis: d alone
    surprise = position - (place + swing[0, :].T + offset)
    row = ca.DM([1.0 if swings else 0.0, 0.0, 1.0])
    spread = P @ row
    noise = s.noise**2
    gain = spread / (row.T @ spread + noise)
    axial_gain = axial / (axial + noise)
    soft = across @ surprise if swings else surprise
    free_after = free
    if swings:
        free_after = free + transition(omega, s.damping, age) @ (gain[:2] @ soft.T)
    offset_after = offset + gain[2] * soft + axial_gain * (surprise - soft)

    thought = _turned(turn + lean @ swing[0, :].T) @ rotation
    between = lie.rotation_from_quaternion(quaternion) @ thought.T
    error = lie.rotation_vector_from_quaternion(lie.quaternion_from_rotation(between))
    angular_gain = oriented * angular / (angular + s.angular_noise**2)
    inputs = [
        place, rotation, driven, free, offset, turn, across, lean, covariance, variances, times,
        ways, position, quaternion, oriented,
    ]  # fmt: skip
    variances_after = ca.vertcat((1 - axial_gain) * axial, (1 - angular_gain) * angular)
    outputs = [
        free_after, offset_after, turn + angular_gain * error, P - gain @ spread.T, variances_after,
    ]  # fmt: skip
    return Formula(inputs, outputs)


def orientation() -> Formula:
    """Rotation (3, 3) and quaternion (4,) of a tip.

    Takes its turn (3,), how it leans (3, 3), its swing (3,), and the model's rotation (3, 3).
    """
    turn, lean = ca.SX.sym("turn", 3), ca.SX.sym("lean", 3, 3)
    swing, rotation = ca.SX.sym("swing", 3), ca.SX.sym("rotation", 3, 3)
    turned = _turned(turn + lean @ swing) @ rotation
    outputs = [turned, lie.quaternion_from_rotation(turned)]
    return Formula([turn, lean, swing, rotation], outputs)


def _turned(vector: Symbols) -> Symbols:
    """Rotation (3, 3) about a rotation vector (3,)."""
    return lie.exp(ca.vertcat(ca.SX.zeros(3), vector))[:3, :3]
