"""Parameters of an arm: named numbers of its robot file that can be varied, also symbolically.

A parameter is named by its key in the robot file, ``segments[0].material.youngs_modulus``.  Its
*coordinate* is zero at the description's value: the difference for an angle or an offset, the
logarithm of the ratio for a positive number.  Derivatives and covariances are in coordinates.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import casadi as ca

from stiffopt.errors import InputError, shown
from stiffopt.model.actuation import Section
from stiffopt.model.calibration import FittedNumber
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History
from stiffopt.model.kinematics import Actuation
from stiffopt.model.laws import law_class, strain_laws
from stiffopt.model.segment import Compensation, Corrections, Segment
from stiffopt.schema import Schema

_SchemaT = TypeVar("_SchemaT", bound=Schema)
_Path = tuple[str | int, ...]

_STEP = re.compile(r"([a-z_]+)|\[(\d{1,4})\]")


_LARGEST_SHARE = 0.9  # bound of a fit on the share of one operator of a history
_ALONE = "each channel alone, to its highest pressure"
_PUSHED = "'stiffopt experiment stiffness', whose table is fitted too"
_STEPS = "steps of pressure, logged at 10 Hz or more"
_BOTH_WAYS = "the same pressures reached from below and from above"
_NUMBERS = {
    "length": FittedNumber(
        "rest length", "m", "length", positive=True,
        experiment="a calliper, or the tip's orientation recorded while it bends far",
    ),
    "material.youngs_modulus": FittedNumber(
        "Young's modulus", "Pa", "youngs_modulus", positive=True, experiment=_PUSHED
    ),
    "compensation.modulus_per_pressure": FittedNumber(
        "change of modulus with pressure", "", "modulus_per_pressure",
        experiment="several channels at once, to high pressures",
    ),
    "compensation.area": FittedNumber(
        "factor on the area", "", "area", positive=True,
        experiment="all channels of the segment at the same pressure, in steps",
    ),
    "compensation.inertia": FittedNumber("factor on the second moment of area", "", "area", True),
    "compensation.stiffness": FittedNumber(
        "factor on the stiffness", "", "stiffness", positive=True, experiment=_PUSHED
    ),
    "compensation.softening": FittedNumber(
        "share of softening", "", "softening", low=0.0, high=1.0
    ),
    "compensation.bending_radius": FittedNumber(
        "least bending radius", "m", "bending_radius", positive=True, experiment=_ALONE
    ),
    "compensation.lengthening": FittedNumber(
        "lengthening by bending", "", "lengthening", experiment=_ALONE
    ),
    "corrections.dead_band": FittedNumber(
        "dead band", "Pa", "dead_band", positive=True,
        experiment="small pressures, near zero, in slow ramps",
    ),
    "corrections.gain": FittedNumber("gain", "", "gain", positive=True, experiment=_ALONE),
    "corrections.offset": FittedNumber(
        "offset", "Pa", "offset", experiment="small pressures, near zero"
    ),
    "corrections.azimuth": FittedNumber(
        "azimuth", "rad", "azimuth",
        experiment="each channel alone, with the tip's orientation recorded",
    ),
    "history.dead_time": FittedNumber(
        "dead time", "s", "dead_time", low=0.0, experiment=_STEPS
    ),
    "history.lag": FittedNumber("lag", "s", "lag", positive=True, experiment=_STEPS),
    "history.lag_falling": FittedNumber(
        "lag when falling", "s", "lag", positive=True, experiment=_STEPS
    ),
    "history.memory": FittedNumber("memory", "", "memory", positive=True),
    "history.play.share": FittedNumber(
        "share of play", "", "share", low=0.0, high=_LARGEST_SHARE, experiment=_BOTH_WAYS
    ),
    "history.creep.share": FittedNumber(
        "share of creep", "", "creep_share", low=0.0, high=_LARGEST_SHARE
    ),
}  # fmt: skip
"""Keys of a segment that can be parameters, without their indices; laws add their own."""


def fitted_numbers() -> dict[str, FittedNumber]:
    """Return every key of a segment that can be a parameter, without indices."""
    found = dict(_NUMBERS)
    for law in strain_laws().values():
        found |= law.fitted_numbers()
    return found


@dataclass(frozen=True)
class Parameter:
    """A number of a robot file.

    `key`: its place in the file, for example ``segments[0].corrections.gain[2]``.
    """

    key: str

    @cached_property
    def _path(self) -> _Path:
        steps: list[str | int] = []
        place = 0
        for found in _STEP.finditer(self.key):
            if self.key[place : found.start()] not in ("", "."):
                break
            steps.append(found[1] if found[2] is None else int(found[2]))
            place = found.end()
        if place != len(self.key) or len(steps) < 3 or steps[0] != "segments":
            raise InputError(f"{shown(self.key)} is not the key of a parameter of a robot")
        return tuple(steps)

    @property
    def number(self) -> FittedNumber:
        """Properties of this kind of number for calibration."""
        name = ".".join(step for step in self._path[2:] if isinstance(step, str))
        numbers = fitted_numbers() if name.startswith("law.") else _NUMBERS
        if name not in numbers:
            raise InputError(
                f"{shown(self.key)} cannot be a parameter; of a segment, "
                f"{', '.join(fitted_numbers())} can"
            )
        return numbers[name]

    @property
    def segment(self) -> int:
        """Index of the segment that it belongs to, from 0."""
        index = self._path[1]
        assert isinstance(index, int)
        return index

    @property
    def is_history(self) -> bool:
        """Whether it affects only the way to an equilibrium."""
        return self._path[2] == "history"

    @property
    def name(self) -> str:
        """Readable name: ``gain, segment 1 channel 3``."""
        place = f"segment {self.segment + 1}"
        last = self._path[-1]
        if isinstance(last, int):
            place += f" channel {last + 1}"
        elif isinstance(self._path[-2], int) and len(self._path) > 3:
            place += f" number {self._path[-2] + 1}"
        return f"{self.number.words}, {place}"

    def value(self, description: RobotDescription) -> float:
        """Return its value in SI. Raises `InputError`: the robot has no such number."""
        return self._read(explicit(description))

    def _read(self, robot: RobotDescription) -> float:
        """Return the value in a robot whose defaults are written out."""
        found: Any = robot
        for step in self._path:
            try:
                found = found[step] if isinstance(step, int) else getattr(found, step)
            except (AttributeError, IndexError, TypeError):
                found = None
        if not isinstance(found, int | float):
            raise InputError(f"robot '{robot.name}' has no parameter {shown(self.key)}")
        return float(found)

    def at(self, nominal: float, coordinate: Any) -> Any:
        """Return the value at a coordinate, number or symbol."""
        if self.number.positive:
            factor = ca.exp(coordinate) if isinstance(coordinate, ca.SX) else math.exp(coordinate)
            return nominal * factor
        return nominal + coordinate

    def coordinate(self, nominal: float, value: float) -> float:
        """Return the coordinate of a value.

        Raises `InputError` if a value whose coordinate is a logarithm is not positive.
        """
        if not self.number.positive:
            return value - nominal
        return math.log(self._checked(value) / self._checked(nominal))

    def _checked(self, value: float) -> float:
        if not 0 < value < math.inf:
            raise InputError(
                f"{self.key} is {value:g}; only from a positive value can it be varied, "
                "since that is done by a factor"
            )
        return value

    def per_coordinate(self, value: float) -> float:
        """Return the change of the value per change of the coordinate."""
        return value if self.number.positive else 1.0


def explicit(description: RobotDescription) -> RobotDescription:
    """Return the same robot with every default that can be a parameter written out."""

    def spelled(segment: Segment) -> Segment:
        count = segment.n_channels
        given = segment.corrections or Corrections()
        corrections = Corrections(
            gain=given.gain or (1.0,) * count,
            offset=given.offset or (0.0,) * count,
            dead_band=given.dead_band,
            azimuth=given.azimuth or (0.0,) * count,
        )
        update: dict[str, Any] = {
            "compensation": segment.compensation or Compensation(),
            "corrections": corrections,
            "history": segment.history or History(),
        }
        keys = law_class(segment.strain_law).Keys
        if keys is not None:
            update["law"] = segment.law or keys()
        return segment.model_copy(update=update)

    segments = tuple(spelled(segment) for segment in description.segments)
    return description.model_copy(update={"segments": segments})


def with_values(
    description: RobotDescription, values: Mapping[Parameter, float]
) -> RobotDescription:
    """Return the robot with other values of some parameters, validated like a file.

    Raises `InputError`: the robot has no such number, or the value is not allowed.
    """
    changed = _replaced(explicit(description), {p._path: value for p, value in values.items()})
    return RobotDescription(**changed.model_dump())


def varied(
    description: RobotDescription, parameters: Sequence[Parameter], coordinates: Any
) -> RobotDescription:
    """Return the robot, not validated, with parameters at coordinates (k,), numbers or symbols.

    Raises `InputError`: the robot has no such number, or one that is zero where it must be positive
    to be varied.
    """
    robot = explicit(description)
    changes: dict[_Path, Any] = {}
    for index, parameter in enumerate(parameters):
        nominal = parameter._read(robot)
        if parameter.number.positive:
            parameter._checked(nominal)
        changes[parameter._path] = parameter.at(nominal, coordinates[index])
    return _replaced(robot, changes)


def parametric(
    description: RobotDescription, parameters: Sequence[Parameter]
) -> tuple[Actuation, ca.SX]:
    """Return the actuation of a robot with variable parameters, and their coordinates (k,).

    A variable rest length stretches the section instead, which is equivalent: lengths and the
    segment's mass stay per length at rest *in the description*.
    """
    coordinates = ca.SX.sym("coordinates", len(parameters))
    robot = varied(description, parameters, coordinates)
    drawn = [
        segment.model_copy(update={"length": nominal.length})
        for segment, nominal in zip(robot.segments, description.segments, strict=True)
    ]
    actuation = Actuation.of(robot.model_copy(update={"segments": tuple(drawn)}))
    sections = []
    for section, segment, nominal in zip(
        actuation.sections, robot.segments, description.segments, strict=True
    ):
        if isinstance(segment.length, ca.SX):
            stretch = segment.length / nominal.length
            section = Section(section.strain * stretch, section.compliance * stretch)
        sections.append(section)
    return replace(actuation, sections=tuple(sections)), coordinates


def _replaced(schema: _SchemaT, changes: Mapping[_Path, Any]) -> _SchemaT:
    """Copy with other values at some paths, unchecked: they may be symbols."""
    result = _with(schema, dict(changes))
    assert isinstance(result, type(schema))
    return result


def _with(node: Any, changes: dict[_Path, Any]) -> Any:
    if () in changes:
        return changes[()]
    inner: dict[str | int, dict[_Path, Any]] = {}
    for path, value in changes.items():
        inner.setdefault(path[0], {})[path[1:]] = value
    if isinstance(node, tuple):
        return tuple(_with(item, inner[i]) if i in inner else item for i, item in enumerate(node))
    update = {str(key): _with(getattr(node, str(key)), rest) for key, rest in inner.items()}
    return node.model_copy(update=update)
