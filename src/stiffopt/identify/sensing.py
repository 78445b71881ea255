"""Measurement model of a tracker: the pose of a sensor on the arm, with its Jacobian.

The tracker's frame does not move with the base, so the vertical is known there: a base that turns
by R in it turns the arm's weight by R' in its own axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.codegen import dense


@dataclass(frozen=True, eq=False)
class Readings:
    """What an ideal tracker would measure of a point in N rows.

    The 18 columns of the derivatives are three twists: of the point in its own axes, of the base in
    the tracker's frame (in base axes), and of the sensor on the point (in the point's axes).

    Attributes
    ----------
    position : (N, 3), in m.
    per_twist : (N, 3, 18), of the position.
    turn : (N, 3), rotation from the measured to the ideal orientation, as its axis times the sine
        of its angle, in the axes of the sensor; None if no rotation was measured.
    turn_per_twist : (N, 3, 18).
    """

    position: Array
    per_twist: Array
    turn: Array | None
    turn_per_twist: Array | None


def readings(
    point: Array,
    base_in_tracker: Array,
    base_twist: Array,
    sensor_in_point: Array,
    sensor_twist: Array,
    measured: Array | None,
) -> Readings:
    """Return an ideal tracker's readings of a point on the arm.

    Parameters
    ----------
    point : (N, 4, 4), poses in the base frame.
    base_in_tracker, sensor_in_point : (4, 4)
    base_twist, sensor_twist : (6,)
        Move these frames: ``base_in_tracker exp(base_twist)``, ``exp(sensor_twist) sensor``.
    measured : (N, 3, 3) or None
        Orientations of the sensor in the tracker's frame.
    """
    count = len(point)
    rotation = np.broadcast_to(np.eye(3), (count, 3, 3)) if measured is None else measured
    position, per_twist, turn, turn_per_twist = _function().many(
        _flat(point),
        _flat(rotation),
        _flat(base_in_tracker[np.newaxis])[0],
        base_twist,
        _flat(sensor_in_point[np.newaxis])[0],
        sensor_twist,
    )
    if measured is None:
        return Readings(position[..., 0], per_twist, None, None)
    return Readings(position[..., 0], per_twist, turn[..., 0], turn_per_twist)


def in_frame_anew(position: Array, measured: Array | None) -> tuple[Array, Array]:
    """Return slopes (N, 3, 6) of positions and turns by a small twist of the tracker's frame.

    Parameters
    ----------
    position : (N, 3), from the origin of the twist, in m.
    measured : (N, 3, 3), orientations of the sensor; None if they are not known.
    """
    count = len(position)
    along = np.broadcast_to(np.eye(3), (count, 3, 3))
    crossed = np.cross(np.eye(3), position[:, np.newaxis]).swapaxes(1, 2)
    turn = np.zeros((count, 3, 3)) if measured is None else measured.swapaxes(1, 2)
    return np.dstack([along, crossed]), np.dstack([np.zeros((count, 3, 3)), turn])


def of_body_anew(measured: Array) -> tuple[Array, Array]:
    """Return slopes (N, 3, 6) of positions and turns by a small twist of the sensor in its axes.

    `measured` (N, 3, 3) are its orientations in the tracker's frame.
    """
    none, along = np.zeros_like(measured), np.broadcast_to(np.eye(3), measured.shape)
    return np.dstack([measured, none]), np.dstack([none, along])


def gravity_in_base(gravity: Array, turn: Array) -> tuple[Array, Array]:
    """Return gravity (3,) in the axes of a turned base, ``exp(turn)' gravity``, and slopes (3, 3).

    Parameters
    ----------
    gravity : (3,), in the axes of the base if its unknown twist is zero.
    turn : (3,), the rotation part of that twist, by which the slopes are.
    """
    found, slopes = _gravity_function()(gravity, turn)
    return found[:, 0], slopes


def _flat(matrices: Array) -> Array:
    """Return matrices (N, r, c) in CasADi's column order, (N, r c)."""
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2)).reshape(len(matrices), -1)


@cache
def _function() -> InterpretedFunction:
    point, rotation = ca.SX.sym("T", 16), ca.SX.sym("R", 9)
    base, sensor = ca.SX.sym("B", 16), ca.SX.sym("S", 16)
    moved, base_twist, sensor_twist = (ca.SX.sym(name, 6) for name in ("x", "b", "s"))
    T = (
        ca.reshape(base, 4, 4)
        @ lie.exp(base_twist)
        @ ca.reshape(point, 4, 4)
        @ lie.exp(moved)
        @ lie.exp(sensor_twist)
        @ ca.reshape(sensor, 4, 4)
    )
    difference = ca.reshape(rotation, 3, 3).T @ T[:3, :3]
    twice_sine = difference - difference.T
    turn = ca.vertcat(twice_sine[2, 1], twice_sine[0, 2], twice_sine[1, 0]) / 2
    twists = ca.vertcat(moved, base_twist, sensor_twist)
    inputs = [point, rotation, base, base_twist, sensor, sensor_twist]
    outputs = [T[:3, 3], ca.jacobian(T[:3, 3], twists), turn, ca.jacobian(turn, twists)]
    still = ca.substitute(outputs, [moved], [ca.SX.zeros(6)])
    return InterpretedFunction(dense(ca.Function("readings", inputs, ca.cse(still))))


@cache
def _gravity_function() -> InterpretedFunction:
    gravity, turn = ca.SX.sym("g", 3), ca.SX.sym("w", 3)
    found = lie.exp(ca.vertcat(ca.SX.zeros(3), turn))[:3, :3].T @ gravity
    outputs = [found, ca.jacobian(found, turn)]
    return InterpretedFunction(dense(ca.Function("gravity", [gravity, turn], outputs)))
