"""Checks of requests before they reach the control thread, and of the rig before it is armed.

They apply to all requests: of a program in Python, a client of the daemon or the command line. The
`InputError` of a refusal names the key and, for a pressure, the channel; nothing has changed then.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from stiffopt.commissioning.record import (
    CommissioningRecord,
    is_record_of,
    load_record,
    problems_of_record,
)
from stiffopt.control.gauge_watch import GaugeWatch
from stiffopt.control.interface import Controller
from stiffopt.control.tracker_watch import Sight, TrackerWatch
from stiffopt.errors import CommandError, InputError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.interface import PressureLimits, PressureReading, Rig, SupplySettings
from stiffopt.rig.settings import CommissioningSettings
from stiffopt.safety.gate import Outlet
from stiffopt.safety.monitors import PressureMonitor
from stiffopt.schema import Schema

Array = NDArray[np.float64]
ModelT = TypeVar("ModelT", bound=Schema)

_NOT_CONTENT = frozenset({"source"})  # the file that a description was read from
_ROUNDING = 1e-6  # of a rate
_LISTED = 5  # keys that an error names
_BUSY = 1.0  # load of a processor from which on it keeps a program waiting

# how far a vented arm may be from how it was commissioned
_MOVED = 0.04  # of its length; hysteresis and creep leave about half of that
_NOISIER, _LEAST_NOISE = 2.5, 2e-5  # factor on the tracker's noise, and the least of it, in m
_LATER = 0.05  # s
_GAUGE = 0.3  # of `Safety.max_pressure_error`


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Context that checks or prepares a thing; any error in it becomes an `InputError`.

    Such a refusal means that nothing has changed.
    """
    try:
        yield
    except InputError:
        raise
    except StiffoptError as error:
        raise CommandError(str(error)) from error
    except Exception as error:
        raise CommandError(
            f"the {what} is refused and nothing has changed: unexpected "
            f"{type(error).__name__} while it was prepared: {error}"
        ) from error


def check_task(task: Task, limits: PressureLimits) -> None:
    """Refuse a task that is not valid or needs pressures beyond the limits."""
    with refusing("task"):
        limited_range(validated(task, Task).pressure, limits)


def check_target(target: Target) -> None:
    """Refuse a target that is not valid."""
    with refusing("target"):
        validated(target, Target)


def check_trajectory(trajectory: Trajectory, limits: PressureLimits, slew: Array) -> None:
    """Refuse a trajectory that is not valid, or whose pressures break limits or slew (n,)."""
    with refusing("trajectory"):
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"expected a Trajectory, not {type(trajectory).__name__}")
        # one by one: all at once would hold Python's lock, and so the control thread, for too long
        waypoints = tuple(validated(waypoint, Waypoint) for waypoint in trajectory.waypoints)
        validated(trajectory.model_copy(update={"waypoints": waypoints[:1]}), Trajectory)
        checked = Trajectory(waypoints=waypoints)
        if checked.pressures is not None:
            times = np.array([waypoint.time for waypoint in waypoints])
            _check_pressures(checked.pressures, limits)
            check_rates(times, checked.pressures, slew)


def _check_pressures(pressures: Array, limits: PressureLimits) -> None:
    """Refuse pressures (k, n) of waypoints that are not of this arm, or beyond its limits."""
    n = pressures.shape[1]
    if n != limits.n:
        raise InputError(
            f"waypoints[0].pressures: expected {limits.n}, one for each channel, not {n}"
        )
    beyond = (pressures < limits.low - limits.slack) | (pressures > limits.high + limits.slack)
    for index, channel in np.argwhere(beyond):
        raise InputError(
            f"waypoints[{index}].pressures: {pressures[index, channel] * 1e-5:g} bar is beyond the "
            f"limits of channel {channel + 1}, {limits.low[channel] * 1e-5:g} to "
            f"{limits.high[channel] * 1e-5:g} bar"
        )


def check_rates(times: Array, pressures: Array, slew: Array, *, before_first: int = 0) -> None:
    """Refuse waypoints at times (k,), in s, with pressures (k, n) that change faster than slew.

    `before_first` of them are no waypoints: there the arm is before.
    """
    rates = np.abs(np.diff(pressures, axis=0)) / np.diff(times)[:, None]
    for index, channel in np.argwhere(rates > slew * (1 + _ROUNDING)):
        since, until = index + 1 - before_first, index + 2 - before_first
        way = f"from waypoint {since} to {until}" if since else f"on the way to waypoint {until}"
        raise InputError(
            f"{way}, channel {channel + 1} would change by "
            f"{rates[index, channel] * 1e-5:.4g} bar/s; at most {slew[channel] * 1e-5:g} bar/s"
        )


def highest_pressures(task: Task, limits: PressureLimits) -> Array:
    """Return the highest pressures (n,) that a task permits on a rig, in Pa."""
    return np.array(limited_range(task.pressure, limits).max, dtype=float)


def check_press(robot: Manipulator, limits: PressureLimits, task: Task) -> None:
    """Refuse a press that the arm cannot hold within the rig's limits, or cannot feel.

    Raises
    ------
    InputError
        It says why.
    """
    if task.press is None:
        return
    pressure = limited_range(task.pressure, limits)
    solution = PressureSolver(robot, task.model_copy(update={"pressure": pressure})).solve()
    if not solution.found:
        raise task.error_at("press", f"the arm cannot press like that there: {solution.message}")


def limited_range(pressure: PressureRange, limits: PressureLimits) -> PressureRange:
    """Return a task's limits of pressure for each channel, completed by those of a rig.

    A limit beyond the rig's by no more than `PressureLimits.slack`, by rounding, becomes the rig's;
    one that is farther beyond, and a channel that is left no pressure, is an `InputError`.
    """
    lower = _bound("min", pressure.min, limits.low, limits)
    upper = _bound("max", pressure.max, limits.high, limits)
    for index in np.flatnonzero(lower > upper):
        raise InputError(
            f"pressure: channel {index + 1} is left no pressure: its min is "
            f"{lower[index] * 1e-5:g} bar, its max {upper[index] * 1e-5:g} bar"
        )
    return PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))


def _bound(
    key: str, given: float | tuple[float | None, ...] | None, default: Array, limits: PressureLimits
) -> Array:
    """Return one of a task's limits for each channel (n,), within those of the rig."""
    values = np.array(given, dtype=float)  # None, no limit, becomes NaN
    if values.shape not in ((), (limits.n,)):
        raise InputError(
            f"pressure.{key}: expected one value or a list of {limits.n}, not {values.size}"
        )
    values = np.where(np.isnan(values), default, values)
    beyond = (values < limits.low - limits.slack) | (values > limits.high + limits.slack)
    for index in np.flatnonzero(beyond):
        raise InputError(
            f"pressure.{key}: {values[index] * 1e-5:g} bar is beyond the limits of channel "
            f"{index + 1}, {limits.low[index] * 1e-5:g} to {limits.high[index] * 1e-5:g} bar"
        )
    return np.asarray(np.clip(values, limits.low, limits.high))


def check_rig(rig: Rig, outlet: Outlet, controller: Controller) -> Iterator[str]:
    """Yield the problems of a rig's configuration; each begins with the name of its check."""
    robot, limits = rig.robot, outlet.limits
    if rig.tracker is None:
        yield "tracker: this rig has none, and the loop cannot steer without; add one"
    if not robot.n_pressures == limits.n == rig.supply.n:
        yield (
            f"channels: the robot '{robot.name}' has {robot.n_pressures}, the supply "
            f"{rig.supply.n} and its gate {limits.n}; take the robot file of this arm"
        )
        return
    same = np.array_equal(limits.low, rig.supply.limits.low) and np.array_equal(
        limits.high, rig.supply.limits.high
    )
    if not same:
        yield (
            "limits: those of the gate before the supply are not the supply's; set "
            "safety.max_pressure in the rig file for both"
        )
    slack = 1e-9 * (limits.high - limits.low)
    if (limits.high > np.array(robot.pressure_max) + slack).any():
        yield "limits: the supply may go above the robot's pressure.max; lower safety.max_pressure"
    if (limits.low < np.array(robot.pressure_min) - slack).any():
        yield "limits: the supply may go below the robot's pressure.min; take this arm's robot file"
    if not (np.isfinite(rig.slew) & (rig.slew > 0)).all():
        yield (
            "slew: there is no limit to how fast pressures may rise; set safety.max_slew in the "
            "rig file, or pressure.slew in the robot file"
        )
    try:
        controller.check()
    except InputError as error:
        yield f"model: {error}"


def check_vented_arm(
    now: float,
    rig: Rig,
    controller: Controller,
    pressures: PressureMonitor,
    reading: PressureReading,
    tracker: TrackerWatch,
    max_offset: float,
) -> Iterator[str]:
    """Yield the problems of a vented arm's measurements; each begins with the name of its check.

    `max_offset` of the tip is a share of the arm's length.
    """
    trouble = pressures.implausible(now, reading)
    if trouble is not None:
        yield f"pressures: {trouble.text}"
    elif left := pressures.under_pressure(reading):
        yield f"pressures: {left}; wait until it has emptied, and check its gauge"
    if tracker.samples < (enough := tracker.tuning.enough):
        yield (
            f"tracker: it has seen the tip {tracker.samples} times, {enough} are needed; wait, or "
            "bring the sensor into its field"
        )
        return
    if tracker.sight(now) is not Sight.SEEN:
        yield "tracker: the tip is not seen now; bring the sensor into its field"
        return
    status = controller.status(now)
    modelled = status.model_position
    if modelled is None:
        modelled = status.tip_position - status.disturbance
    off = float(np.linalg.norm(tracker.position - modelled))
    if not off <= max_offset * rig.robot.length:  # NaN is too far as well
        seen, model = (", ".join(f"{1e3 * x:.1f}" for x in p) for p in (tracker.position, modelled))
        yield (
            f"calibration: the vented tip is seen at ({seen}) mm, {1e3 * off:.0f} mm from where "
            f"the model has it, ({model}) mm; check the tracker's registration and the robot file "
            "('stiffopt calibrate' makes one)"
        )


def check_commissioned(
    rig: Rig, gauges: GaugeWatch, tracker: TrackerWatch, reading: PressureReading
) -> Iterator[str]:
    """Yield why the record of its commissioning, or its gauges, do not permit to arm a vented arm.

    A rig that was not made from a rig file is not checked.
    """
    if rig.settings is None:
        return
    settings: CommissioningSettings = rig.settings.commissioning
    supply: SupplySettings = rig.settings.supply
    required = not supply.simulated if settings.required is None else settings.required
    command = "run 'stiffopt commission' on this rig"
    path, record = settings.record, None
    if path is not None and os.path.exists(path):
        try:
            record = load_record(path)
        except InputError as error:
            yield f"commissioning: its record cannot be read, {command}: {error}"
    elif required:
        yield f"commissioning: there is no record '{path}'; {command}"
    noisy = [False] * rig.supply.n
    if record is not None:
        problems = list(problems_of_record(record, rig.robot, rig.settings, settings.max_age))
        is_of_this = is_record_of(record, rig.robot, rig.settings)
        if not problems:
            noisy = [bool(channel.gauge_noise) for channel in record.channels]
            problems = list(_changed(record, rig, tracker, reading))
        if required or is_of_this:
            yield from (f"commissioning: {problem}; {command}" for problem in problems)
    measured = [supply.measures(k) for k in range(rig.supply.n)]
    yield from (f"gauges: {problem}" for problem in gauges.dead(measured, noisy))


def _changed(
    record: CommissioningRecord, rig: Rig, tracker: TrackerWatch, reading: PressureReading
) -> Iterator[str]:
    """Yield how a vented arm differs from what it was when it was commissioned."""
    then = record.tracker
    if then is None or not tracker.samples:
        return
    off = float(np.linalg.norm(tracker.position - then.position))
    if off > _MOVED * rig.robot.length:
        yield (
            f"the vented tip is {1e3 * off:.1f} mm from where it was: a push, a load, a slipped "
            "sensor or a moved tracker; look at the arm"
        )
    if tracker.noise > _NOISIER * max(then.noise, _LEAST_NOISE):
        yield (
            f"the tracker's noise is {1e3 * tracker.noise:.3f} mm and was {1e3 * then.noise:.3f} mm"
        )
    if tracker.usual[1] > then.latency + _LATER:
        yield (
            f"the tracker's samples are {1e3 * tracker.usual[1]:.0f} ms old when they come and "
            f"were {1e3 * then.latency:.0f} ms old"
        )
    tolerance = np.broadcast_to(rig.settings.safety.max_pressure_error, rig.supply.n)
    for k, channel in enumerate(record.channels):
        if channel.gauge_offset is None:
            continue
        moved = abs(reading.pressures[k] - channel.gauge_offset)
        if moved > _GAUGE * tolerance[k] + 6 * (channel.gauge_noise or 0.0):
            yield (
                f"the gauge of channel {k + 1} reads {reading.pressures[k] * 1e-5:.3f} bar of the "
                f"vented arm and read {channel.gauge_offset * 1e-5:.3f} bar"
            )


def late_ticks(lateness: float, guard_timeout: float, load: float = 0.0) -> str:
    """What to change where the guard may vent because the computer is busy; empty if it is not.

    Parameters
    ----------
    lateness :
        How late ticks began in the last half minute, in s. By half of the guard's patience within
        that time, they may exceed it within minutes.
    guard_timeout :
        The guard's patience, in s.
    load :
        Processes that want to run, over the processors that they have.
    """
    half = 0.5 * guard_timeout
    if lateness < half and load < _BUSY:
        return ""
    what = f"ticks began {1e3 * lateness:.0f} ms late in the last half minute"
    if lateness < half:
        what = f"{load:.1f} processes want each processor of this computer"
    patience = max(0.1, math.ceil(20 * 2.5 * lateness) / 20)
    return (
        f"timing: {what}, and the guard vents after {1e3 * guard_timeout:.0f} ms; give the "
        "computer less to do, this program real-time rights ('stiffopt run' says how when it "
        f"starts), or set safety.guard_timeout: {1e3 * patience:.0f} ms"
    )


# what a request holds ---------------------------------------------------------------------------


def contents(value: Any) -> Any:
    """Return a schema's fields as plain data, also those of a subclass, but for those of None."""
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        fields |= value.model_extra or {}
        given = {name: field for name, field in fields.items() if field is not None}
        return {name: contents(field) for name, field in given.items() if name not in _NOT_CONTENT}
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    return value


def differences(one: Any, other: Any, place: str = "") -> list[str]:
    """Return the keys at which two contents differ, dotted."""
    if isinstance(one, dict) and isinstance(other, dict):
        return [
            found
            for key in {**one, **other}
            for found in differences(one.get(key), other.get(key), f"{place}.{key}".lstrip("."))
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            found
            for index, (a, b) in enumerate(zip(one, other, strict=True))
            for found in differences(a, b, f"{place}[{index}]")
        ]
    return [] if one is other or bool(one == other) else [place]


def listed(places: list[str]) -> str:
    """Return keys as an error names them, a few of them at most."""
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return ", ".join(places[:_LISTED]) + more


def validated(given: object, model: type[ModelT]) -> ModelT:
    """Return a description as an instance of exactly this model.

    It is refused if it is no such description, a value is not valid, or a key would be lost.
    """
    if not isinstance(given, model):
        raise InputError(f"expected a {model.__name__}, not {type(given).__name__}")
    plain = contents(given)
    made = model(**plain)
    if different := differences(plain, contents(made)):
        raise InputError(f"{model.__name__}: {listed(different)}: not a value that can be had")
    return made
