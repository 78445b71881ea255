"""The unknowns of a calibration: numbers of the robot, poses of the tracker, states of the arm.

Each unknown has a coordinate, which is zero at the robot file's value, and a prior standard
deviation.  The fit works in *scaled* coordinates: coordinates divided by that deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.identify.settings import FIT, START
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.laws import law_class
from stiffopt.model.parameters import Parameter

_AXES = ("x", "y", "z")
BASE = "base in the tracker's frame"
SENSOR = "sensor on the tip"


@dataclass(frozen=True)
class Unknown:
    """One number that a fit may change.

    Attributes
    ----------
    name : in reports.
    unit : SI unit of its coordinate; empty for a ratio or a plain number.
    deviation : prior standard deviation of its coordinate.
    low, high : bounds of its coordinate.
    parameter : the robot file's number that it stands for, or None.
    """

    name: str
    unit: str
    deviation: float
    low: float = -math.inf
    high: float = math.inf
    parameter: Parameter | None = None


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All unknowns of a problem, in the order of its coordinates.

    Attributes
    ----------
    parameters : numbers of the robot file: of the equilibrium, then of the histories.
    base : twist of the base in the tracker's frame, six or none.
    sensors : twists of the sensors, for each tracked point.
    zeros : offset of each recording's positions, three each, or the twist of a frame or a body that
        was defined anew in it, six each; or none.
    sides : for each recording that begins in an unknown state, each channel's initial state of
        hysteresis, see `side_unknowns`; else none.
    """

    parameters: tuple[Unknown, ...]
    base: tuple[Unknown, ...] = ()
    sensors: tuple[tuple[Unknown, ...], ...] = ()
    zeros: tuple[tuple[Unknown, ...], ...] = ()
    sides: tuple[tuple[Unknown, ...], ...] = ()

    @property
    def all(self) -> tuple[Unknown, ...]:
        """All unknowns, in order."""
        groups = (self.parameters, self.base, *self.sensors, *self.zeros, *self.sides)
        return tuple(unknown for group in groups for unknown in group)

    def slices(self) -> tuple[slice, list[slice], list[slice], list[slice]]:
        """Return slices of `all`: the base's, and those of each sensor, zero and side."""
        begin = len(self.parameters)
        found: list[slice] = []
        for group in (self.base, *self.sensors, *self.zeros, *self.sides):
            found.append(slice(begin, begin + len(group)))
            begin += len(group)
        n, m = len(self.sensors), len(self.zeros)
        return found[0], found[1 : 1 + n], found[1 + n : 1 + n + m], found[1 + n + m :]


def shape_unknowns(
    description: RobotDescription, names: Sequence[str], tolerances: Tolerances
) -> list[Unknown]:
    """Return the unknowns of all segments that affect their equilibrium.

    Parameters
    ----------
    description : the robot from which the fit begins.
    names : keys of a segment without indices, such as ``corrections.gain``. Keys of the material
        and the compensation are skipped unless the segment's strain law can fit them. The law's own
        fitted numbers are appended.
    tolerances : prior uncertainty of the robot file's numbers.
    """
    found = []
    for s, segment in enumerate(description.segments):
        law = law_class(segment.strain_law)
        for name in (*names, *law.fitted_numbers()):
            owner, _, field = name.rpartition(".")
            if owner in ("material", "compensation") and name not in law.fitted_keys:
                continue
            keys = [f"segments[{s}].{name}"]
            if owner == "corrections" and field != "dead_band":
                keys = [f"{keys[0]}[{c}]" for c in range(segment.n_channels)]
            found += [_of_parameter(Parameter(key), description, tolerances) for key in keys]
    return found


def history_unknowns(description: RobotDescription, tolerances: Tolerances) -> list[Unknown]:
    """Return the unknowns of the histories that the segments have."""
    found = []
    for s, segment in enumerate(description.segments):
        history = segment.history
        if history is None:
            continue
        names = ["dead_time"] * (history.dead_time > 0) + ["lag"] * (history.lag > 0)
        names += ["lag_falling"] * (history.lag_falling > 0)
        names += [f"memory[{c}]" for c in range(len(history.memory))]
        names += [f"play[{j}].share" for j in range(len(history.play))]
        names += [f"creep[{j}].share" for j in range(len(history.creep))]
        parameters = [Parameter(f"segments[{s}].history.{name}") for name in names]
        found += [_of_parameter(each, description, tolerances) for each in parameters]
    return found


def _of_parameter(
    parameter: Parameter, description: RobotDescription, tolerances: Tolerances
) -> Unknown:
    number = parameter.number
    tolerance = number.tolerance
    deviation = tolerance if isinstance(tolerance, float) else getattr(tolerances, tolerance)
    if number.positive:
        return Unknown(parameter.name, "", float(deviation), parameter=parameter)
    value = parameter.value(description)
    low, high = number.low - value, number.high - value
    return Unknown(parameter.name, number.unit, float(deviation), low, high, parameter)


def placement_unknowns(name: str, position: Array, angle: Array, turns: bool) -> list[Unknown]:
    """Return the unknown twist of a frame; only its translation unless `turns`.

    `position` and `angle` are the prior standard deviations (3,), in m and rad.
    """
    moves = [
        Unknown(f"{name}, {axis}", "m", float(d)) for axis, d in zip(_AXES, position, strict=True)
    ]
    if not turns:
        return moves
    return moves + [
        Unknown(f"{name}, about {axis}", "rad", float(d))
        for axis, d in zip(_AXES, angle, strict=True)
    ]


def side_unknowns(description: RobotDescription, name: str) -> list[Unknown]:
    """Return each channel's unknown initial hysteresis: -1 after a rise, 1 after a fall."""
    return [
        Unknown(
            f"{description.channel_name(c)} at the beginning of {name}", "", FIT.side, -1.0, 1.0
        )
        for c in range(description.n_pressures)
    ]


def anew_unknowns(name: str, length: float) -> list[Unknown]:
    """Return the unknown twist of a frame or body that was defined anew, and moved to its place.

    `length` is that of the arm, in m.
    """
    position, angle = np.full(3, START.anew_position * length), np.full(3, START.anew_angle)
    return placement_unknowns(name, position, angle, turns=True)


def zero_unknowns(name: str, tolerances: Tolerances) -> list[Unknown]:
    """Return the unknown offset of a recording's positions."""
    return [Unknown(f"zero of {name}, {axis}", "m", tolerances.zero) for axis in _AXES]
