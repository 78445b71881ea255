"""The rig file: which devices there are, how to reach them and what they may do."""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Discriminator, Field, Tag

from stiffopt.errors import FileError, InputError, dotted, shown
from stiffopt.files import line_of, read_file
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.plant.mismatch import check_mismatch
from stiffopt.plant.settings import (
    PlantSettings,
    SimulatedProbeSettings,
    SimulatedSupplySettings,
    SimulatedTrackerSettings,
)
from stiffopt.registration import Registration
from stiffopt.rig.drivers.aurora import AuroraSettings
from stiffopt.rig.drivers.modbus import ModbusSettings
from stiffopt.rig.drivers.nidaq import NidaqSettings
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings
from stiffopt.rig.drivers.probe import ProbeSettings
from stiffopt.rig.interface import PressureLimits
from stiffopt.rig.settings import ControlSettings, LogSettings, Safety, ServiceSettings
from stiffopt.schema import BadKeyError, Schema
from stiffopt.units import Frequency

__all__ = [
    "LabSettings",
    "LogSettings",
    "RigDescription",
    "Safety",
    "limits_of",
    "load_rig_description",
    "registration_of",
    "slew_of",
]


def _known(*drivers: str) -> BeforeValidator:
    """Return the validator that refuses a block without a driver or with an unknown one."""

    def check(value: Any) -> Any:
        if isinstance(value, dict):
            if "driver" not in value:
                raise ValueError(f"the key 'driver' is missing; expected {_one_of(drivers)}")
            driver = value["driver"]
            if driver not in drivers:
                near = difflib.get_close_matches(str(driver), drivers, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                raise BadKeyError(
                    "driver",
                    f"there is no driver {shown(driver)} for this; {hint}"
                    f"expected {_one_of(drivers)}",
                )
        return value

    return BeforeValidator(check)


def _one_of(words: tuple[str, ...]) -> str:
    return ", ".join(words[:-1]) + f" or {words[-1]}"


def _driver_of(value: Any) -> str:
    driver = value.get("driver") if isinstance(value, dict) else getattr(value, "driver", None)
    return f"<{driver}>"


_BY_DRIVER = Discriminator(_driver_of)

SupplyBlock = Annotated[
    Annotated[SimulatedSupplySettings, Tag("<simulated>")]
    | Annotated[ModbusSettings, Tag("<modbus>")]
    | Annotated[NidaqSettings, Tag("<nidaq>")],
    _BY_DRIVER,
    _known("simulated", "modbus", "nidaq"),
]
TrackerBlock = Annotated[
    Annotated[SimulatedTrackerSettings, Tag("<simulated>")]
    | Annotated[AuroraSettings, Tag("<aurora>")]
    | Annotated[OpenIGTLinkSettings, Tag("<openigtlink>")],
    _BY_DRIVER,
    _known("simulated", "aurora", "openigtlink"),
]
ProbeBlock = Annotated[
    Annotated[SimulatedProbeSettings, Tag("<simulated>")]
    | Annotated[ProbeSettings, Tag("<probe>")],
    _BY_DRIVER,
    _known("simulated", "probe"),
]


class LabSettings(Schema):
    """What stands behind the protocols of the virtual lab (`stiffopt lab`).

    Attributes
    ----------
    supply : the regulators.
    tracker : its registration is that of the rig's own tracker.
    probe : stage and force sensor.
    """

    supply: SimulatedSupplySettings = SimulatedSupplySettings()
    tracker: SimulatedTrackerSettings = SimulatedTrackerSettings()
    probe: SimulatedProbeSettings = SimulatedProbeSettings()


class RigDescription(Schema):
    """A rig: the arm, its devices and what they may do.

    Attributes
    ----------
    name : for people.
    robot : name of a built-in robot, or path of a robot file, relative to the rig file.
    rate : of the loop that commands, in Hz.
    supply, tracker, probe : the devices; each has a ``driver``.
    safety : limits.
    control : how the daemon's loop steers.
    service : where the daemon listens.
    log : recordings.
    plant : the arm behind simulated devices, and in the virtual lab.
    lab : the devices in the virtual lab.
    """

    name: Annotated[str, Field(min_length=1)] = "rig"
    robot: Annotated[str, Field(min_length=1)]
    rate: Annotated[Frequency, Field(gt=0, le=1000)] = 100.0
    supply: SupplyBlock
    tracker: TrackerBlock | None = None
    probe: ProbeBlock | None = None
    safety: Safety = Safety()
    control: ControlSettings = ControlSettings()
    service: ServiceSettings = ServiceSettings()
    log: LogSettings = LogSettings()
    plant: PlantSettings | None = None
    lab: LabSettings | None = None


def load_rig_description(path: str | os.PathLike[str]) -> RigDescription:
    """Read a rig file and check it against its robot.

    Raises
    ------
    FileError
        The file, or the robot file that it names, cannot be read or is wrong.
    """
    description = read_file(path, "rig", RigDescription)
    try:
        robot = load_description(description.robot, base=Path(path).parent)
        _check_against(description, robot)
    except FileError:
        raise
    except _MisfitError as error:
        raise FileError(
            path, str(error), line=line_of(path, *error.place), key=dotted(error.place)
        ) from None
    except InputError as error:
        raise FileError(path, str(error), line=line_of(path, "robot"), key="robot") from None
    return description


class _MisfitError(InputError):
    """A part of the rig file does not fit the robot."""

    def __init__(self, reason: str, *place: str | int) -> None:
        super().__init__(reason)
        self.place = place


def _check_against(description: RigDescription, robot: RobotDescription) -> None:
    """Refuse a rig that does not fit its robot.

    Raises
    ------
    InputError
        The number of channels differs, a limit is above the robot's, or the like.
    """
    n = robot.n_pressures
    supply = description.supply
    channels = getattr(supply, "channels", None)
    if channels is not None and len(channels) != n:
        raise _MisfitError(
            f"has {len(channels)} channels; the robot '{robot.name}' has {n}", "supply", "channels"
        )
    for index, channel in enumerate(channels or ()):
        limit = robot.pressure_max[index]
        if channel.max is not None and channel.max > limit * (1 + 1e-9):
            raise _MisfitError(
                f"{channel.max * 1e-5:g} bar is above the robot's {limit * 1e-5:g} bar "
                f"({robot.channel_name(index)})",
                *("supply", "channels", index, "max"),
            )
    for key, highest, unit, factor in (
        ("max_pressure", robot.pressure_max, "bar", 1e-5),
        ("max_slew", robot.pressure_slew, "bar/s", 1e-5),
    ):
        value = getattr(description.safety, key)
        if value is None:
            continue
        values = value if isinstance(value, tuple) else (value,) * n
        if len(values) != n:
            raise _MisfitError(f"has {len(values)} values; expected one, or {n}", "safety", key)
        for index, (given, limit) in enumerate(zip(values, highest or values, strict=True)):
            if given > limit * (1 + 1e-9):
                raise _MisfitError(
                    f"{given * factor:g} {unit} is above the robot's {limit * factor:g} {unit} "
                    f"({robot.channel_name(index)})",
                    "safety",
                    key,
                )
    highest_allowed = description.safety.max_pressure
    if highest_allowed is not None:
        for index, given in enumerate(np.broadcast_to(highest_allowed, n)):
            if given < robot.pressure_min[index]:
                raise _MisfitError(
                    f"{given * 1e-5:g} bar is below the robot's min of "
                    f"{robot.pressure_min[index] * 1e-5:g} bar ({robot.channel_name(index)})",
                    "safety",
                    "max_pressure",
                )
    plant, tracker = description.plant or PlantSettings(), description.tracker
    if tracker is not None:
        try:
            registration_of(tracker, robot)
        except InputError as error:
            raise _MisfitError(str(error), "tracker", "calibrated") from None
    if isinstance(tracker, SimulatedTrackerSettings):
        fastest = 1 / plant.discretisation.step
        if tracker.rate > fastest * (1 + 1e-9):
            raise _MisfitError(
                f"{tracker.rate:g} Hz is faster than the steps of the simulation, {fastest:g} Hz",
                "tracker",
                "rate",
            )
    simulated = [
        name
        for name in ("supply", "tracker", "probe")
        if getattr(getattr(description, name), "driver", None) == "simulated"
    ]
    real = [
        name
        for name in ("supply", "tracker", "probe")
        if getattr(description, name) is not None and name not in simulated
    ]
    if simulated and real:
        raise _MisfitError(
            f"is simulated and the {real[0]} is not; a simulated arm has simulated devices only "
            "('stiffopt lab' puts a simulated arm behind real protocols)",
            simulated[0],
        )
    if description.plant is not None:
        try:
            check_mismatch(description.plant.mismatch, robot)
        except InputError as error:
            raise _MisfitError(str(error), "plant") from None


def limits_of(description: RigDescription, robot: RobotDescription) -> PressureLimits:
    """Return what may be commanded: the robot's limits, tightened by the rig's."""
    high = np.array(robot.pressure_max)
    if description.safety.max_pressure is not None:
        high = np.minimum(high, description.safety.max_pressure)
    return PressureLimits(np.array(robot.pressure_min), high)


def slew_of(description: RigDescription, robot: RobotDescription) -> NDArray[np.float64] | None:
    """Return the greatest rates of change (n,), in Pa/s, or None where there is no limit."""
    rates = [r for r in (robot.pressure_slew, description.safety.max_slew) if r is not None]
    if not rates:
        return None
    broadcast = [np.broadcast_to(rate, robot.n_pressures).astype(float) for rate in rates]
    slew: NDArray[np.float64] = np.minimum.reduce(broadcast)
    return slew


def registration_of(tracker: Any, robot: RobotDescription) -> Registration:
    """What makes a tracker's readings poses of the tip in the base frame.

    Raises
    ------
    InputError
        The robot file shall correct the poses, and cannot.
    """
    given: Registration = tracker.registration
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
