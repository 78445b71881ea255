"""Checks of requests before they reach the control thread.

They apply to all requests: from Python, a client of the daemon or the command line. A refusal is an
`InputError` that names the key and, for a pressure, the channel; it changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

from stiffopt.arrays import Array
from stiffopt.errors import CommandError, InputError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene, SceneObject
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.interface import PressureLimits
from stiffopt.schema import BadKeyError, Schema

ModelT = TypeVar("ModelT", bound=Schema)

_IGNORED_FIELDS = frozenset({"source"})  # the file that a description was read from
_ROUNDING = 1e-6  # relative, of a rate
_EQUAL = 1e-9  # difference of numbers by rounding, relative, and in SI
_MAX_LISTED = 5  # keys that an error names


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Turn any error in the body into an `InputError`: a refusal, after which nothing has changed.

    `what` names the request in the message.
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
    """Refuse a task that is invalid or needs pressures beyond the limits."""
    with refusing("task"):
        limited_range(validated(task, Task).pressure, limits)


def check_scene(task: Task, scene: Scene | None) -> None:
    """Refuse a task that does not suit the rig's scene, which is the one that counts on a rig.

    A scene of the task's own may not ask for more than the rig's: no other shapes, under whatever
    name, no smaller `max_force`, no greater clearance. The objects of a brace must allow contact.
    """
    if task.brace is not None:
        if scene is None:
            raise task.error_at("brace", "the rig file has no scene with objects to lean on")
        try:
            task.brace.check_objects(scene)
        except BadKeyError as error:
            key = ".".join(map(str, ("brace", *error.loc)))
            raise task.error_at(key, f"{error} (in the rig's scene)") from None
    if task.scene is not None:
        _check_own_scene(task, task.scene, scene)


def _check_own_scene(task: Task, own: Scene, scene: Scene | None) -> None:
    """Refuse a scene of the task's `own` that asks for more than the rig's scene."""
    rigs = {} if scene is None else {item.name: item for item in scene.objects}
    remedy = "on a rig the scene of the rig file counts: write it there"
    for item in own.objects:
        alike = (each for each in rigs.values() if _is_alike(item, each))
        there = rigs[item.name] if item.name in rigs else next(alike, None)
        if there is None:
            where = f"the rig has no object '{item.name}', nor one of its shape there"
            raise task.error_at("scene", f"{where}; {remedy}")
        if not _is_alike(item, there):
            where = f"'{item.name}' has another place or shape in the rig's scene"
            raise task.error_at("scene", f"{where}; {remedy}")
        force = None if item.contact is None else item.contact.max_force
        if force is None or there.contact is None or not there.contact.allowed:
            continue
        most = there.contact.max_force
        if most is None or most > force * (1 + _EQUAL):
            where = f"'{item.name}' may be pressed with more than 'max_force' in the rig's scene"
            raise task.error_at("scene", f"{where}; {remedy}")
    if scene is not None and own.clearance > scene.clearance * (1 + _EQUAL):
        where = "its clearance is greater than that of the rig's scene"
        raise task.error_at("scene", f"{where}; {remedy}")


def _is_alike(one: SceneObject, other: SceneObject) -> bool:
    """Return whether two objects have one shape at one place, whatever their names."""
    shapes = one.shape, other.shape
    return type(shapes[0]) is type(shapes[1]) and _is_same(*(s.model_dump() for s in shapes))


def _is_same(one: Any, other: Any) -> bool:
    """Return whether two dumped shapes are equal, but for rounding."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_is_same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(_is_same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_EQUAL, abs_tol=_EQUAL)
    return bool(one == other)


def check_target(target: Target) -> None:
    """Refuse a target that is invalid."""
    with refusing("target"):
        validated(target, Target)


def check_trajectory(trajectory: Trajectory, limits: PressureLimits, slew: Array) -> None:
    """Refuse a trajectory that is invalid, or whose pressures break limits or slew (n,)."""
    with refusing("trajectory"):
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"expected a Trajectory, not {type(trajectory).__name__}")
        # one by one: all at once would keep Python's lock from the control thread for too long
        waypoints = tuple(validated(waypoint, Waypoint) for waypoint in trajectory.waypoints)
        validated(trajectory.model_copy(update={"waypoints": waypoints[:1]}), Trajectory)
        checked = Trajectory(waypoints=waypoints)
        if checked.pressures is not None:
            times = np.array([waypoint.time for waypoint in waypoints])
            _check_pressures(checked.pressures, limits)
            check_rates(times, checked.pressures, slew)


def _check_pressures(pressures: Array, limits: PressureLimits) -> None:
    """Refuse waypoints' pressures (k, n) of another number of channels or beyond the limits."""
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
    """Refuse waypoints at times (k,), in s, whose pressures (k, n) change faster than slew.

    The first `before_first` rows are no waypoints but states of the arm before the first one.
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
    """Return the highest pressures (n,) that a task permits within the rig's limits, in Pa."""
    return np.array(limited_range(task.pressure, limits).max, dtype=float)


def check_press(robot: Manipulator, limits: PressureLimits, task: Task) -> None:
    """Refuse a press that the arm cannot exert within the rig's limits, or cannot feel.

    Raises `InputError` with the reason.
    """
    if task.press is None:
        return
    pressure = limited_range(task.pressure, limits)
    solution = PressureSolver(robot, task.model_copy(update={"pressure": pressure})).solve()
    if not solution.found:
        raise task.error_at("press", f"the arm cannot press like that there: {solution.message}")


def limited_range(pressure: PressureRange, limits: PressureLimits) -> PressureRange:
    """Return a task's limits of pressure for each channel, completed by those of a rig.

    Limits beyond the rig's by at most `PressureLimits.slack`, as by rounding, become the rig's.
    `InputError`: a limit is farther beyond, or a channel has no pressure left.
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
    """Return one of a task's limits for each channel (n,), completed by those of the rig."""
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


def contents(value: Any) -> Any:
    """Return a schema's fields, a subclass's as well, as plain data without those that are None."""
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        fields |= value.model_extra or {}
        given = {name: field for name, field in fields.items() if field is not None}
        return {
            name: contents(field) for name, field in given.items() if name not in _IGNORED_FIELDS
        }
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    return value


def differences(one: Any, other: Any, place: str = "") -> list[str]:
    """Return the dotted keys at which two contents differ."""
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
    """Return keys for an error message, the first few of them."""
    more = f" and {len(places) - _MAX_LISTED} more" if len(places) > _MAX_LISTED else ""
    return ", ".join(places[:_MAX_LISTED]) + more


def validated(given: object, model: type[ModelT]) -> ModelT:
    """Return a description as an instance of exactly this model.

    `InputError`: it is of another type, a value is invalid, or the model would lose a key.
    """
    if not isinstance(given, model):
        raise InputError(f"expected a {model.__name__}, not {type(given).__name__}")
    plain = contents(given)
    made = model(**plain)
    if different := differences(plain, contents(made)):
        raise InputError(f"{model.__name__}: {listed(different)}: not a valid value")
    return made
