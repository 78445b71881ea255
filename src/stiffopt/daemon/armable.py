"""Check from its file alone whether a rig can ever be armed and move its arm."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from stiffopt.control.arming import NO_SLEW
from stiffopt.errors import CommandError, InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.rig.config import RigDescription, limits_of, slew_of
from stiffopt.rig.device import MisfitError
from stiffopt.rig.pressure import SupplySettings
from stiffopt.safety.gate import check_protection

_NO_PRESSURE = "leaves every channel at one pressure: the arm could never move"
_FASTEST = 500.0  # Hz
_OVERLAP = 5e-4  # m; computed clearances from meshes and bent tubes may be too small by as much


def too_fast(rate: float) -> str:
    """Return why the loop cannot run at a rate in Hz; empty if it can."""
    return f"{rate:g} Hz is too fast; at most {_FASTEST:g} Hz" if rate > _FASTEST else ""


def check_description(settings: RigDescription, robot: RobotDescription) -> Iterator[MisfitError]:
    """Yield why the loop could never arm or move the rig of a file, whatever its devices say.

    A rig without a tracker is for scripts, and no mistake.
    """
    safety, supply, period = settings.safety, settings.supply, 1 / settings.rate
    limits = limits_of(settings, robot)
    if slew_of(settings, robot) is None:
        yield MisfitError(NO_SLEW, "safety", "max_slew")
    if immobile := np.array_equal(limits.low, limits.high):
        yield MisfitError(_NO_PRESSURE, "safety", "max_pressure")
    if not supply.simulated:
        try:
            device = supply.device(limits)
            check_protection(device, safety)
            if not immobile and np.array_equal(device.limits.low, device.limits.high):
                yield MisfitError(_NO_PRESSURE, "supply", "channels")
        except (CommandError, InputError) as error:
            yield MisfitError(str(error), "supply")
    if why := too_fast(settings.rate):
        yield MisfitError(why, "rate")
    between = f"the {1e3 * period:g} ms between two commands at a rate of {settings.rate:g} Hz"
    for key, effect in (
        ("guard_timeout", "the guard would vent every time"),
        ("command_timeout", "each command would expire before the next"),
    ):
        if (timeout := getattr(safety, key)) <= period:
            reason = f"{1e3 * timeout:g} ms is not longer than {between}: {effect}"
            yield MisfitError(reason, "safety", key)
    yield from _impatient(supply, period, between)
    yield from _patient(supply, safety.command_timeout)
    frames = getattr(settings.tracker, "rate", None)
    if frames is not None and 1 / frames > safety.tracker_timeout:
        yield MisfitError(
            f"{1e3 * safety.tracker_timeout:g} ms is shorter than the {1e3 / frames:g} ms between "
            "two frames of the tracker: the tip would never count as seen",
            *("safety", "tracker_timeout"),
        )
    if settings.scene is not None:
        yield from _inside_at_rest(settings.scene, robot)


def _inside_at_rest(scene: Scene, robot: RobotDescription) -> Iterator[MisfitError]:
    """Yield which objects the arm is inside without pressures, under its weight."""
    found = Manipulator(robot).clearances(np.zeros(robot.n_pressures), scene)
    for index, (name, distance) in enumerate(zip(found.names, found.distances, strict=True)):
        if distance < -_OVERLAP:
            yield MisfitError(
                f"without pressures the arm is {-1e3 * distance:.3g} mm inside '{name}', and the "
                "loop would hold it there; correct the place or the size of the object",
                *(("scene",) if scene.source else ("scene", "objects", index)),
            )


def _watchdog(supply: SupplySettings) -> tuple[float | None, tuple[str, ...]]:
    """Return the time of the device's own watchdog, in s or None, and its key in the supply."""
    watchdog = getattr(supply, "watchdog", None)  # a time in s, or a block that has one
    timeout = getattr(watchdog, "timeout", watchdog)
    place = ("watchdog",) if timeout is watchdog else ("watchdog", "timeout")
    return (timeout if isinstance(timeout, float) else None), place


def _patient(supply: SupplySettings, command_timeout: float) -> Iterator[MisfitError]:
    """Yield why a device that does not answer keeps its pressures for longer than a command lasts.

    The guard can do nothing while the driver waits, but a watchdog in the device vents meanwhile.
    """
    timeout, watchdog = getattr(supply, "timeout", None) or 0.0, _watchdog(supply)[0]
    vents = min(supply.vents_within, math.inf if watchdog is None else watchdog)
    if timeout > command_timeout and vents > command_timeout:
        by_default = "" if "timeout" in supply.model_fields_set else ", its default,"
        yield MisfitError(
            f"{1e3 * timeout:g} ms{by_default} is longer than safety.command_timeout, "
            f"{1e3 * command_timeout:g} ms: an arm whose device does not answer would keep its "
            "pressures until then; shorten it, or give the device a watchdog that vents within "
            "safety.command_timeout",
            *("supply", "timeout"),
        )


def _impatient(supply: SupplySettings, period: float, between: str) -> Iterator[MisfitError]:
    """Yield why the device's own watchdog would vent between two commands, `period` s apart."""
    timeout, place = _watchdog(supply)
    if timeout is None:
        return
    if supply.exchange_time > period:
        period = supply.exchange_time
        between = f"the {1e3 * period:.3g} ms that a command takes on the serial line"
    if timeout <= period:
        yield MisfitError(
            f"{1e3 * timeout:g} ms is not longer than {between}: the device would vent every time",
            *("supply", *place),
        )
