"""What a fit is free to change: parameters of the robot, where the tracker is, how logs begin.

Every unknown has a coordinate that is zero at what the robot file says, and a standard deviation
that says how far from there it may be expected.  The fit works in *scaled* coordinates, in which
that deviation is one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.parameters import Parameter

__all__ = ["BASE", "SENSOR", "Unknown", "history_unknowns", "placement_unknowns", "shape_unknowns"]

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")
BASE = "base in the tracker's frame"
SENSOR = "sensor on the tip"
_LARGEST_SHARE = 0.9
_SIDE = 0.6  # deviation; all between -1 and 1 are about as likely


@dataclass(frozen=True)
class Unknown:
    """One number that a fit may change.

    Attributes
    ----------
    name : for people.
    unit : SI unit of its coordinate; empty for a ratio or a plain number.
    deviation : how far its coordinate may be expected from zero.
    low, high : bounds of its coordinate.
    parameter : of the robot, if it is one.
    """

    name: str
    unit: str
    deviation: float
    low: float = -math.inf
    high: float = math.inf
    parameter: Parameter | None = None

    def bounded(self, coordinate: float) -> float:
        """Nearest coordinate within the bounds."""
        return min(max(coordinate, self.low), self.high)


def shape_unknowns(
    description: RobotDescription, names: Sequence[str], tolerances: Tolerances
) -> list[Unknown]:
    """Unknowns of all segments that have one of these names, for example ``corrections.gain``."""
    found = []
    for s, segment in enumerate(description.segments):
        for name in names:
            field = name.rpartition(".")[2]
            keys = [f"segments[{s}].{name}"]
            if name.startswith("corrections.") and field != "dead_band":
                keys = [f"{keys[0]}[{c}]" for c in range(segment.n_channels)]
            for key in keys:
                parameter = Parameter(key)
                low, high = -math.inf, math.inf
                if field == "softening":
                    low, high = _between(parameter.value(description), 0.0, 1.0)
                found.append(
                    Unknown(
                        parameter.name,
                        "" if parameter.is_positive else parameter.unit,
                        float(getattr(tolerances, field)),
                        low,
                        high,
                        parameter,
                    )
                )
    return found


def history_unknowns(description: RobotDescription, tolerances: Tolerances) -> list[Unknown]:
    """Unknowns of the histories that a description has."""
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
        for name in names:
            parameter = Parameter(f"segments[{s}].history.{name}")
            value = parameter.value(description)
            low, high = -math.inf, math.inf
            if name == "dead_time":
                deviation, low = tolerances.dead_time, -value
            elif name.startswith("lag"):
                deviation = tolerances.lag
            elif name.startswith("memory"):
                deviation = tolerances.memory
            elif name.startswith("creep"):
                deviation = tolerances.creep_share
                low, high = _between(value, 0.0, _LARGEST_SHARE)
            else:
                deviation, (low, high) = tolerances.share, _between(value, 0.0, _LARGEST_SHARE)
            unit = "" if parameter.is_positive else parameter.unit
            found.append(Unknown(parameter.name, unit, deviation, low, high, parameter))
    return found


def placement_unknowns(name: str, position: Array, angle: Array, turns: bool) -> list[Unknown]:
    """Unknown twist of a frame from deviations (3,), in m and rad; moves alone if not `turns`."""
    moves = [
        Unknown(f"{name}, {axis}", "m", float(d)) for axis, d in zip(_AXES, position, strict=True)
    ]
    if not turns:
        return moves
    return moves + [
        Unknown(f"{name}, about {axis}", "rad", float(d))
        for axis, d in zip(_AXES, angle, strict=True)
    ]


def _between(value: float, low: float, high: float) -> tuple[float, float]:
    """Bounds of the coordinate of a value that lies between two others."""
    return low - value, high - value


def side_unknowns(description: RobotDescription, name: str) -> list[Unknown]:
    """On which side of its plays each channel begins, from -1 after a rise to 1 after a fall."""
    return [
        Unknown(f"{description.channel_name(c)} at the beginning of {name}", "", _SIDE, -1.0, 1.0)
        for c in range(description.n_pressures)
    ]


def zero_unknowns(name: str, tolerances: Tolerances) -> list[Unknown]:
    """By how much the positions of a recording are shifted."""
    return [Unknown(f"zero of {name}, {axis}", "m", tolerances.zero) for axis in _AXES]
