"""The rig file: which devices there are, how to reach them, and their limits and settings."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails

from stiffopt.arrays import Array
from stiffopt.errors import FileError, InputError, dotted
from stiffopt.files import line_of, read_file
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.model.scene import SceneOrFile
from stiffopt.registration import Registration
from stiffopt.rig.device import DeviceSettings, MisfitError, RigSection
from stiffopt.rig.interface import PressureLimits
from stiffopt.rig.pressure import SupplySettings
from stiffopt.rig.probing import ProbeSettings
from stiffopt.rig.registry import built_in_drivers, driver_class, driver_names, load, one_of
from stiffopt.rig.settings import (
    CommissioningSettings,
    ControlSettings,
    LogSettings,
    Published,
    RosSettings,
    Safety,
    ServiceSettings,
)
from stiffopt.rig.tracking import TrackerSettings
from stiffopt.schema import BadKeyError, Schema, explain
from stiffopt.units import Frequency, read_from_file

_SECTIONS = {
    "plant": "stiffopt.plant.settings:PlantSettings",
    "lab": "stiffopt.plant.settings:LabSettings",
}
"""Sections of a rig file that other packages define; they are imported when needed."""


def _reader(class_of: Callable[[dict[str, Any]], type[Schema]]) -> BeforeValidator:
    """Return the validator of a section whose class depends on its content."""

    def read(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, dict):
            return value
        model = class_of(value)
        try:
            return model.model_validate(value, context=info.context)
        except ValidationError as error:
            # explained here, where the class is known, with its keys and the nearest of them
            mistakes = []
            for details in error.errors():
                loc, reason = explain(model, details, value if read_from_file(info) else None)
                mistakes.append(
                    InitErrorDetails(
                        type="value_error",
                        loc=loc,
                        input=details["input"],
                        ctx={"error": ValueError(reason)},
                    )
                )
            raise ValidationError.from_exception_data(model.__name__, mistakes) from None

    return BeforeValidator(read)


class _DeviceJsonSchema:
    """The JSON Schema of a device: that of stiffopt's driver, or open for other drivers."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def __get_pydantic_json_schema__(self, _: Any, handler: Any) -> dict[str, Any]:
        names = built_in_drivers(self.kind)
        schemas = (
            handler(driver_class(self.kind, name).__pydantic_core_schema__) for name in names
        )
        own = [
            {"allOf": [schema, {"properties": {"driver": {"const": name}}}]}
            for name, schema in zip(names, schemas, strict=True)
        ]
        other = {"driver": {"type": "string", "not": {"enum": list(names)}}}
        return {"anyOf": [*own, {"type": "object", "properties": other, "required": ["driver"]}]}


def _device(kind: str) -> BeforeValidator:
    """Return the validator of a device; its driver determines the class."""

    def class_of(value: dict[str, Any]) -> type[DeviceSettings]:
        if "driver" not in value:
            names = one_of(driver_names(kind))
            raise ValueError(f"the key 'driver' is missing; expected {names}")
        try:
            return driver_class(kind, value["driver"])
        except InputError as error:
            raise BadKeyError("driver", str(error)) from None

    return _reader(class_of)


class _SectionJsonSchema:
    """The JSON Schema of a section that another package defines."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get_pydantic_json_schema__(self, _: Any, handler: Any) -> Any:
        return handler(load(_SECTIONS[self.name]).__pydantic_core_schema__)


def _section(name: str) -> BeforeValidator:
    """Return the validator of a section that another package defines."""
    return _reader(lambda _: load(_SECTIONS[name]))


class RigDescription(Schema):
    """A rig: the arm, its devices, their limits and settings.

    Attributes
    ----------
    name : for people.
    robot : name of a built-in robot, or path of a robot file, relative to the rig file.
    rate : rate of commands, in Hz.
    supply, tracker, probe : the devices; each has a ``driver``, see `stiffopt.rig.registry`.
    safety : limits and timeouts.
    control : settings of the daemon's control loop.
    service : addresses at which the daemon listens.
    log : recordings.
    ros : the node of `stiffopt ros`.
    commissioning : the record that is required before the arm may be armed.
    published : published results of this arm, for comparison in experiments; None for none.
    scene : objects around the arm, or None; checked against the robot, see `stiffopt.model.scene`.
    plant : the arm behind simulated devices, and in the virtual lab; a
        `stiffopt.plant.settings.PlantSettings`.
    lab : the devices in the virtual lab; a `stiffopt.plant.settings.LabSettings`.
    """

    name: Annotated[str, Field(min_length=1)] = "rig"
    robot: Annotated[str, Field(min_length=1)]
    rate: Annotated[Frequency, Field(gt=0, le=1000)] = 100.0
    supply: Annotated[
        SerializeAsAny[SupplySettings], _device("supply"), _DeviceJsonSchema("supply")
    ]
    tracker: Annotated[
        SerializeAsAny[TrackerSettings] | None, _device("tracker"), _DeviceJsonSchema("tracker")
    ] = None
    probe: Annotated[
        SerializeAsAny[ProbeSettings] | None, _device("probe"), _DeviceJsonSchema("probe")
    ] = None
    safety: Safety = Safety()
    control: ControlSettings = ControlSettings()
    service: ServiceSettings = ServiceSettings()
    log: LogSettings = LogSettings()
    ros: RosSettings = RosSettings()
    commissioning: CommissioningSettings = CommissioningSettings()
    published: Published | None = None
    scene: SceneOrFile | None = None
    plant: Annotated[
        SerializeAsAny[RigSection] | None, _section("plant"), _SectionJsonSchema("plant")
    ] = None
    lab: Annotated[
        SerializeAsAny[RigSection] | None, _section("lab"), _SectionJsonSchema("lab")
    ] = None


def load_rig_description(path: str | os.PathLike[str]) -> RigDescription:
    """Read a rig file and check it against its robot; see `load_rig`."""
    return load_rig(path)[0]


def load_rig(path: str | os.PathLike[str]) -> tuple[RigDescription, RobotDescription]:
    """Read a rig file and the file of its robot; check that they fit.

    Raises `FileError`: the file, or the robot file that it names, cannot be read or is wrong.
    """
    description = read_file(path, "rig", RigDescription)
    try:
        robot = load_description(description.robot, base=Path(path).parent)
        _check_against(description, robot)
        if description.scene is not None:
            description.scene.check_against(robot, path)
    except FileError:
        raise
    except MisfitError as error:
        raise FileError(
            path, str(error), line=line_of(path, *error.place), key=dotted(error.place)
        ) from None
    except InputError as error:
        raise FileError(path, str(error), line=line_of(path, "robot"), key="robot") from None
    if description.commissioning.record is None:
        record = str(Path(path).absolute().with_suffix(".commissioning.yaml"))
        settings = description.commissioning.model_copy(update={"record": record})
        description = description.model_copy(update={"commissioning": settings})
    return description, robot


def _check_against(description: RigDescription, robot: RobotDescription) -> None:
    """Refuse a rig that does not fit its robot.

    Raises `InputError`: the number of channels differs, a limit is above the robot's, or the like.
    """
    n = robot.n_pressures
    supply = description.supply
    channels = getattr(supply, "channels", None)
    if channels is not None and len(channels) != n:
        raise MisfitError(
            f"has {len(channels)} channels; the robot '{robot.name}' has {n}", "supply", "channels"
        )
    for index, channel in enumerate(channels or ()):
        limit = robot.pressure_max[index]
        if channel.max is not None and channel.max > limit * (1 + 1e-9):
            raise MisfitError(
                f"{channel.max * 1e-5:g} bar is above the robot's {limit * 1e-5:g} bar "
                f"({robot.channel_name(index)})",
                *("supply", "channels", index, "max"),
            )
    for key, highest, unit in (
        ("max_pressure", robot.pressure_max, "bar"),
        ("max_slew", robot.pressure_slew, "bar/s"),
    ):
        value = getattr(description.safety, key)
        if value is None:
            continue
        values = value if isinstance(value, tuple) else (value,) * n
        if len(values) != n:
            raise MisfitError(f"has {len(values)} values; expected one, or {n}", "safety", key)
        for index, (given, limit) in enumerate(zip(values, highest or values, strict=True)):
            if given > limit * (1 + 1e-9):
                raise MisfitError(
                    f"{given * 1e-5:g} {unit} is above the robot's {limit * 1e-5:g} {unit} "
                    f"({robot.channel_name(index)})",
                    "safety",
                    key,
                )
    highest_allowed = description.safety.max_pressure
    if highest_allowed is not None:
        for index, given in enumerate(np.broadcast_to(highest_allowed, n)):
            if given < robot.pressure_min[index]:
                raise MisfitError(
                    f"{given * 1e-5:g} bar is below the robot's min of "
                    f"{robot.pressure_min[index] * 1e-5:g} bar ({robot.channel_name(index)})",
                    "safety",
                    "max_pressure",
                )
    speed, plausible = description.control.tip_speed, description.safety.max_tip_speed
    if speed is not None and speed > plausible:
        raise MisfitError(
            f"{1e3 * speed:g} mm/s is above safety.max_tip_speed, {1e3 * plausible:g} mm/s",
            *("control", "tip_speed"),
        )
    tracker = description.tracker
    if tracker is not None:
        try:
            registration_of(tracker, robot)
        except InputError as error:
            raise MisfitError(str(error), "tracker", "calibrated") from None
    for part in (tracker, description.probe, supply, description.plant, description.lab):
        if part is not None:
            part.check_against(description, robot)
    devices = {"supply": supply, "tracker": tracker, "probe": description.probe}
    simulated = [name for name, device in devices.items() if device and device.simulated]
    real = [name for name, device in devices.items() if device and not device.simulated]
    if simulated and real:
        raise MisfitError(
            f"is simulated and the {real[0]} is not; a simulated arm has simulated devices only "
            "('stiffopt lab' puts a simulated arm behind real protocols)",
            simulated[0],
        )


def limits_of(description: RigDescription, robot: RobotDescription) -> PressureLimits:
    """Return the limits of commands: the robot's, tightened by the rig's."""
    high = np.array(robot.pressure_max)
    if description.safety.max_pressure is not None:
        high = np.minimum(high, description.safety.max_pressure)
    return PressureLimits(np.array(robot.pressure_min), high)


def slew_of(description: RigDescription, robot: RobotDescription) -> Array | None:
    """Return the greatest rates of change (n,), in Pa/s, or None if there is no limit."""
    return robot.slew_limits(description.safety.max_slew)


def registration_of(tracker: TrackerSettings, robot: RobotDescription) -> Registration:
    """Return the registration that turns a tracker's readings into tip poses in the base frame.

    Raises `InputError`: the tracker relies on the robot file's correction, but the file has none
    that fits.
    """
    given = tracker.registration
    if not tracker.calibrated:
        return given
    recordings = robot.recordings
    if recordings is None:
        raise InputError(
            f"the robot '{robot.name}' has no 'recordings', which would say how to correct the "
            "tracker's poses; expected a robot file of 'stiffopt calibrate'"
        )
    straight = tuple(range(1, robot.n_pressures + 1))
    if recordings.frame is not None or (recordings.channels or straight) != straight:
        raise InputError(
            f"the 'recordings' of the robot '{robot.name}' are not of a rig, whose channels are "
            "in the robot's order and whose tracker sees the tip alone; calibrate it with logs "
            "of this rig"
        )
    return given.then(recordings.registration)
