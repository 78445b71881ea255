"""Checks of the rig before it is armed: its configuration, its vented arm, its commissioning."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.record import (
    CommissioningRecord,
    is_commissioned,
    is_record_of,
    load_record,
    problems_of_record,
)
from stiffopt.control.gauge_watch import GaugeWatch
from stiffopt.control.interface import Controller
from stiffopt.control.tracker_watch import Sight, TrackerWatch
from stiffopt.errors import InputError
from stiffopt.rig.interface import PressureReading, Rig, SupplySettings
from stiffopt.rig.settings import MAX_GUARD_TIMEOUT, CommissioningSettings
from stiffopt.safety.gate import Outlet
from stiffopt.safety.monitors import PressureMonitor

NO_SLEW = (
    "there is no limit to how fast pressures may rise; set safety.max_slew in the rig file, or "
    "pressure.slew in the robot file"
)
"""Why a rig without a limit of slew is not armed."""
_BUSY = 1.0  # load of a processor above which programs wait

# limits of how a vented arm may differ from when it was commissioned
_MAX_MOVED = 0.04  # share of its length; hysteresis and creep take about half of that
_NOISE_FACTOR, _MIN_NOISE = 2.5, 2e-5  # growth of the tracker's noise; lower bound of it, in m
_MAX_DELAY = 0.05  # s, growth of the age of samples
_MAX_GAUGE_CHANGE = 0.3  # share of `Safety.max_pressure_error`

# offset of a vented tip from the model's, as a share of the arm's length, that is told without a
# record: tolerances of the base, 2 mm and 2 degrees, make it 0.046
_UNUSUAL = 0.05


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
        yield f"slew: {NO_SLEW}"
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

    `max_offset` is the greatest offset of the tip, as a share of the arm's length.
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
    modelled = _modelled(now, controller)
    off = float(np.linalg.norm(tracker.position - modelled))
    if not off <= max_offset * rig.robot.length:  # NaN fails too
        seen, model = (", ".join(f"{1e3 * x:.1f}" for x in p) for p in (tracker.position, modelled))
        yield (
            f"calibration: the vented tip is seen at ({seen}) mm, {1e3 * off:.0f} mm from where "
            f"the model has it, ({model}) mm; check the tracker's registration and the robot file "
            "('stiffopt calibrate' makes one)"
        )


def _modelled(now: float, controller: Controller) -> Array:
    """Return where the model has the tip (3,), in m."""
    status = controller.status(now)
    if status.model_position is not None:
        return status.model_position
    return status.tip_position - status.disturbance


def uncommissioned(now: float, rig: Rig, controller: Controller, tracker: TrackerWatch) -> str:
    """Return a warning if no record of a commissioning fits the rig; otherwise an empty text.

    A simulated rig has it only if the vented tip is far from where the model has it.
    """
    settings = rig.settings
    if settings is None or is_commissioned(settings, rig.robot):
        return ""
    off = float(np.linalg.norm(tracker.position - _modelled(now, controller)))
    is_far = off > _UNUSUAL * rig.robot.length
    if settings.supply.simulated and not is_far:
        return ""
    text = (
        "no record of a commissioning fits this rig. The loop cannot tell a turned tracker frame "
        "or a displaced sensor from an offset of the arm: the tip may then miss its target by that "
        "displacement, while the reported error is small"
    )
    if is_far:
        text += f"; the vented tip is seen {1e3 * off:.1f} mm from where the model has it"
    return f"{text}. Run 'stiffopt commission'"


def check_commissioned(
    rig: Rig, gauges: GaugeWatch, tracker: TrackerWatch, reading: PressureReading
) -> Iterator[str]:
    """Yield reasons against arming from the gauges and the record of the commissioning.

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
    """Yield how a vented arm differs from when it was commissioned."""
    then = record.tracker
    if then is None or not tracker.samples:
        return
    off = float(np.linalg.norm(tracker.position - then.position))
    if off > _MAX_MOVED * rig.robot.length:
        yield (
            f"the vented tip is {1e3 * off:.1f} mm from where it was: a push, a load, a slipped "
            "sensor or a moved tracker; look at the arm"
        )
    if tracker.noise > _NOISE_FACTOR * max(then.noise, _MIN_NOISE):
        yield (
            f"the tracker's noise is {1e3 * tracker.noise:.3f} mm and was {1e3 * then.noise:.3f} mm"
        )
    if tracker.usual[1] > then.latency + _MAX_DELAY:
        yield (
            f"the tracker's samples are {1e3 * tracker.usual[1]:.0f} ms old when they come and "
            f"were {1e3 * then.latency:.0f} ms old"
        )
    tolerance = np.broadcast_to(rig.settings.safety.max_pressure_error, rig.supply.n)
    for k, channel in enumerate(record.channels):
        if channel.gauge_offset is None:
            continue
        moved = abs(reading.pressures[k] - channel.gauge_offset)
        if moved > _MAX_GAUGE_CHANGE * tolerance[k] + 6 * (channel.gauge_noise or 0.0):
            yield (
                f"the gauge of channel {k + 1} reads {reading.pressures[k] * 1e-5:.3f} bar of the "
                f"vented arm and read {channel.gauge_offset * 1e-5:.3f} bar"
            )


def late_ticks(lateness: float, guard_timeout: float, load: float = 0.0) -> str:
    """Return advice if the computer is so busy that the guard may vent; otherwise an empty text.

    Parameters
    ----------
    lateness : how late ticks began in the last half minute, in s. If that is half of the guard's
        timeout, it may exceed the timeout within minutes.
    guard_timeout : the guard's timeout, in s.
    load : number of processes that want to run per processor.
    """
    half = 0.5 * guard_timeout
    if lateness < half and load < _BUSY:
        return ""
    what = f"the control loop was repeatedly {1e3 * lateness:.0f} ms late in the last half minute"
    if lateness < half:
        what = f"{load:.1f} processes compete for each processor"
    advice = (
        "close other programs, or grant the real-time rights that 'stiffopt run' reported missing "
        "when it started"
    )
    patience = max(0.1, math.ceil(20 * 2.5 * lateness) / 20)
    if guard_timeout < patience <= MAX_GUARD_TIMEOUT:
        advice += (
            f"; if neither helps, set 'safety.guard_timeout: {1e3 * patience:.0f} ms' in the rig "
            "file"
        )
    return (
        f"timing: this computer is too busy: {what}, and the guard vents the arm after "
        f"{1e3 * guard_timeout:.0f} ms without a command. To mend it, {advice}"
    )
