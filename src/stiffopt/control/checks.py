"""What must hold before an arm is put under pressure. Each check returns what is wrong, by name."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stiffopt.control.steering import Steering
from stiffopt.control.tracker_watch import ENOUGH, Sight, TrackerWatch
from stiffopt.errors import InputError
from stiffopt.rig.interface import PressureReading, Rig
from stiffopt.safety.gate import Outlet
from stiffopt.safety.monitors import PressureMonitor

__all__ = ["check_rig", "check_vented_arm"]

_OFF = 0.1  # share of the arm's length by which the vented tip may be seen beside the model's


def check_rig(rig: Rig, outlet: Outlet, steering: Steering) -> Iterator[str]:
    """Yield what is wrong with how a rig is set up."""
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
        steering.check()
    except InputError as error:
        yield f"model: {error}"


def check_vented_arm(
    now: float,
    rig: Rig,
    steering: Steering,
    pressures: PressureMonitor,
    reading: PressureReading,
    tracker: TrackerWatch,
) -> Iterator[str]:
    """Yield what is wrong with what is measured of a vented arm."""
    trouble = pressures.implausible(now, reading)
    if trouble is not None:
        yield f"pressures: {trouble.text}"
    elif left := pressures.under_pressure(reading):
        yield f"pressures: {left}; wait until it has emptied, and check its gauge"
    if tracker.samples < ENOUGH:
        yield (
            f"tracker: it has seen the tip {tracker.samples} times, {ENOUGH} are needed; wait, or "
            "bring the sensor into its field"
        )
        return
    if tracker.sight(now) is not Sight.SEEN:
        yield "tracker: the tip is not seen now; bring the sensor into its field"
        return
    standing = steering.standing(now)
    modelled = standing.model_position
    if modelled is None:
        modelled = standing.tip_position - standing.disturbance
    off = float(np.linalg.norm(tracker.position - modelled))
    if not off <= _OFF * rig.robot.length:  # NaN is too far as well
        seen, model = (", ".join(f"{1e3 * x:.1f}" for x in p) for p in (tracker.position, modelled))
        yield (
            f"calibration: the vented tip is seen at ({seen}) mm, {1e3 * off:.0f} mm from where "
            f"the model has it, ({model}) mm; check the tracker's registration and the robot file "
            "('stiffopt calibrate' makes one)"
        )
