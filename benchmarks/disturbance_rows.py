"""What goes wrong with a simulated arm, or only seems to: the rows of `disturbances.py`.

A `Row` lets its fault, push or payload begin on a rig while the control loop runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.plant.settings import PlantLoad

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Something that goes wrong, or only seems to.

    Attributes
    ----------
    name : for the table.
    begin : lets it begin on a rig.
    at_once : whether it is there from the beginning, as a fault of the set-up.
    shows_in_motion : whether it can be noticed only while the tip is to move.
    is_fault : whether it is to be noticed.
    noise : of the tracker, in m, if not as usual.
    then : lets more begin, or end, at the moment of the second target.
    usual : the part of it that is no fault, with which the tip takes the way to compare with.
    shows_above : command of channel 2 above which it can be noticed, in Pa: an empty channel does
        not leak.
    channels : that an arm needs for it.
    """

    name: str
    begin: Callable[[Any], object]
    at_once: bool = False
    shows_in_motion: bool = False
    is_fault: bool = True
    noise: float = 5e-5
    then: Callable[[Any], object] = lambda rig: None
    usual: Callable[[Any], object] | None = None
    shows_above: float = 0.0
    channels: int = 2


def _tracker(fault: str) -> Callable[[Any], object]:
    return lambda rig: rig.world.inject("tracker", fault)


def _push(*force: float) -> Callable[[Any], object]:
    return lambda rig: rig.world.plant.set_load(PlantLoad(force=force))


def _push_halfway(force: float) -> Callable[[Any], object]:
    def push(rig: Any) -> None:
        at = rig.robot.length / 2
        rig.world.plant.set_load(PlantLoad(force=(force, 0.0, 0.0), at=at))

    return push


def _slow_push(rate: float, most: float) -> Callable[[Any], object]:
    """Push with a force that grows, in N/s, up to `most`, in N."""

    def push(rig: Any) -> None:
        plant = rig.world.plant
        follow, began = plant.follow, plant.time

        def pushed(trace: Array) -> None:
            force = min(most, rate * (plant.time - began))
            plant.set_load(PlantLoad(force=(force, 0.0, 0.0)))
            follow(trace)

        plant.follow = pushed

    return push


def _turned(axis: int, degrees: float) -> Callable[[Any], object]:
    """Turn the tracker's frame about an axis of the base."""

    def turn(rig: Any) -> None:
        camera = rig.world.camera
        see, base = camera.sensor_in_tracker, camera.settings.registration.tracker_in_base
        turned = np.asarray(lie.exp(np.deg2rad(degrees) * np.eye(6)[3 + axis]))
        moved = np.linalg.inv(base.transform()) @ turned @ base.transform()
        camera.sensor_in_tracker = lambda: moved @ see()

    return turn


def _dead_gauges(rig: Any) -> None:
    rig.world.measured = lambda: np.full(len(rig.world.pressures), np.nan)


def _weak(share: float) -> Callable[[Any], object]:
    """Give the chambers a share of their pressures, of which no gauge knows."""

    def weaken(rig: Any) -> None:
        plant = rig.world.plant
        follow = plant.follow
        plant.follow = lambda trace: follow(share * trace)

    return weaken


def _slipped(*way: float) -> Callable[[Any], object]:
    """Move the sensor on the tip, in its own axes."""

    def slip(rig: Any) -> None:
        camera = rig.world.camera
        see = camera.sensor_in_tracker
        moved = np.eye(4)
        moved[:3, 3] = way
        camera.sensor_in_tracker = lambda: see() @ moved

    return slip


def _stuck(rig: Any) -> None:
    rig.world.inject("supply", "stuck", 1)


def _leaking(rig: Any) -> None:
    """A leak by which a regulator of 60 ms lag stays 6 % below its command."""
    rig.world._regulators.leak[1] = 1.0


def _nothing(rig: Any) -> None:
    pass


def _swapped(*order: int) -> Callable[[Any], object]:
    """Feed the chambers from other regulators than the robot file says."""

    def swap(rig: Any) -> None:
        plant = rig.world.plant
        follow, n = plant.follow, len(rig.world.pressures)
        channels = [*order, *range(len(order), n)]
        plant.follow = lambda trace: follow(np.ascontiguousarray(trace[:, channels]))

    return swap


def _seen_as(change: Callable[[Any, float, Array], Array]) -> Callable[[Any], object]:
    """Replace the pose (4, 4) that the tracker sees by one of generator, elapsed time and pose."""

    def begin(rig: Any) -> None:
        camera, plant, rng = rig.world.camera, rig.world.plant, np.random.default_rng(20)
        see, began = camera.sensor_in_tracker, plant.time
        camera.sensor_in_tracker = lambda: change(rng, plant.time - began, see())

    return begin


def _moved(pose: Array, *way: float) -> Array:
    moved = pose.copy()
    moved[:3, 3] += way
    return moved


def _freezes_then_jumps(rig: Any) -> None:
    """Repeat one pose for a second, with new times; then show the tip 8 mm aside."""
    kept: list[Array] = []

    def change(rng: Any, elapsed: float, pose: Array) -> Array:
        kept.append(pose)
        return kept[0] if elapsed < 1.0 else _moved(pose, 0.008, 0.0, 0.0)

    _seen_as(change)(rig)


def _outliers(rng: Any, elapsed: float, pose: Array) -> Array:
    aside = rng.standard_normal(3)
    return _moved(pose, *(0.02 * aside / np.linalg.norm(aside))) if rng.random() < 0.03 else pose


def _jitter(most: float) -> Callable[[Any], object]:
    """Show poses that are up to so much older than their times say, in s, at random."""

    def begin(rig: Any) -> None:
        poses: list[Array] = []

        def change(rng: Any, elapsed: float, pose: Array) -> Array:
            poses.append(pose)
            age = int(rng.uniform(0, most) * rig.world.camera.settings.rate + 0.5)
            return poses[max(-1 - age, -len(poses))]

        _seen_as(change)(rig)

    return begin


def _shaken(rng: Any, elapsed: float, pose: Array) -> Array:
    return _moved(pose, 0.0, 0.006 * np.sin(2 * np.pi * 5.0 * elapsed), 0.0)


def _gauge(channel: int, read: Callable[[float, float], float]) -> Callable[[Any], object]:
    """Make a gauge read a function of its reading, and of that before the fault, in Pa."""

    def begin(rig: Any) -> None:
        measure = rig.world.measured
        before = measure()[channel]

        def measured() -> Array:
            readings = measure()
            readings[channel] = read(readings[channel], before)
            return readings

        rig.world.measured = measured

    return begin


def _reversed(rig: Any) -> None:
    """Turn the sign of a regulator's changes from where it is now."""
    command, at, high = rig.world.command, rig.world.set_point[1], rig.supply.limits.high[1]

    def reverse(pressures: Array) -> None:
        p = np.array(pressures, dtype=float)
        p[1] = np.clip(2 * at - p[1], 0.0, high) if p.any() else 0.0
        command(p)

    rig.world.command = reverse


def _behind_gauge(change: Callable[[Array, float, dict[str, float]], Array]) -> Any:
    """Change the pressures (k,) of a chamber behind its gauge, by step in s and a memory."""

    def begin(rig: Any) -> None:
        plant, memory = rig.world.plant, {"p": rig.world.pressures[1]}
        follow = plant.follow

        def changed(trace: Array) -> None:
            trace = trace.copy()
            trace[:, 1] = change(trace[:, 1], plant.step, memory)
            follow(trace)

        plant.follow = changed

    return begin


def _narrow(pressures: Array, step: float, memory: dict[str, float]) -> Array:
    """A line that lets a chamber follow with a time constant of 1 s."""
    slow = np.empty_like(pressures)
    for k, p in enumerate(pressures):
        memory["p"] += step * (p - memory["p"])
        slow[k] = memory["p"]
    return slow


def _kinked(pressures: Array, step: float, memory: dict[str, float]) -> Array:
    """A line that lets no more through than now, behind the gauge."""
    return np.minimum(pressures, memory["p"])


def _slow(rig: Any) -> None:
    rig.world._regulators.lag[1] = 0.6


def _saturates(rig: Any) -> None:
    rig.world._regulators.saturation[1] = rig.world.pressures[1]


def _burst(rig: Any) -> None:
    rig.world._regulators.held[1] = 0.0


def _caught(rig: Any) -> None:
    """Put a wall of 2 kN/m just in the way of the tip's next motion."""
    way = rig.next_goal - rig.world.plant.tip_pose()[:3, 3]
    rig.world.stage.mount(-way)


def _both(*begins: Callable[[Any], object]) -> Callable[[Any], object]:
    return lambda rig: [begin(rig) for begin in begins]


ROWS = (
    Row("channels 1 and 2 swapped", _swapped(1, 0), at_once=True),
    Row("channels 1 and 4 swapped", _swapped(3, 1, 2, 0), at_once=True, channels=4),
    Row("tracker's frame turned by 10 deg about z", _turned(2, 10.0), at_once=True),
    Row("tracker's frame turned by 5 deg about x", _turned(0, 5.0), at_once=True),
    Row("sensor 10 mm further along", _slipped(0.0, 0.0, 0.01), at_once=True),
    Row("all gauges dead", _dead_gauges, at_once=True),
    Row("arm with 0.6 of its strength", _weak(0.6), at_once=True),
    Row("sensor has come off, lies still", _tracker("loose"), shows_in_motion=True),
    Row("tracker drifts by 5 mm/s", _tracker("drifting")),
    Row("sensor slips by 10 mm", _slipped(0.006, -0.008, 0.0)),
    Row("tracker's frame turns by 3 deg/s", _tracker("turning")),
    Row("tracker is 0.1 s later every second", _tracker("lagging"), shows_in_motion=True),
    Row("tip shakes by 10 mm at 3 Hz", _tracker("shaking")),
    Row("a regulator keeps its pressure", _stuck, shows_in_motion=True),
    Row("a leak that the regulator feeds", _leaking, shows_above=2e4),
    Row("tracker freezes for 1 s, then jumps by 8 mm", _freezes_then_jumps),
    Row("a gauge reads 0.12 bar too much", _gauge(1, lambda p, _: p + 1.2e4)),
    Row("a gauge keeps its reading", _gauge(1, lambda _, p: p), shows_in_motion=True),
    Row("a regulator turns its sign", _reversed, shows_in_motion=True),
    Row("a narrow line behind a gauge", _behind_gauge(_narrow), shows_in_motion=True),
    Row("a kinked line behind a gauge", _behind_gauge(_kinked), shows_in_motion=True),
    Row("a regulator of ten times the lag", _slow, shows_in_motion=True),
    Row("a regulator without more pressure", _saturates, shows_in_motion=True),
    Row("a chamber bursts", _burst, shows_above=3e3),
    Row("tip is shaken by 6 mm at 5 Hz", _seen_as(_shaken)),
    Row("tracker drifts, and a leak", _both(_tracker("drifting"), _leaking)),
    Row(
        "a regulator keeps its pressure, and a push of 30 mN",
        _both(_stuck, _push(0.03, 0.0, 0.0)),
        shows_in_motion=True,
        usual=_push(0.03, 0.0, 0.0),
    ),
    Row("a wall in the way of the tip", _caught, shows_in_motion=True),
    Row("tracker is late by 0 to 20 ms at random", _jitter(0.02), is_fault=False),
    Row("tracker is late by 0 to 60 ms at random", _jitter(0.06), shows_in_motion=True),
    Row("3 % of the samples are 20 mm off", _seen_as(_outliers), is_fault=False),
    Row("a push of 20 mN", _push(0.02, 0.0, 0.0), is_fault=False),
    Row("a push of 30 mN halfway along", _push_halfway(0.03), is_fault=False),
    Row("a push of 50 mN", _push(0.0, -0.05, 0.0), is_fault=False),
    Row("a push that grows by 20 mN/s to 60 mN", _slow_push(0.02, 0.06), is_fault=False),
    Row(
        "a push of 30 mN at the moment of a target",
        _nothing,
        is_fault=False,
        shows_in_motion=True,
        then=_push(0.03, 0.0, 0.0),
    ),
    Row(
        "a push of 30 mN until the moment of a target",
        _push(0.03, 0.0, 0.0),
        is_fault=False,
        shows_in_motion=True,
        then=_push(0.0, 0.0, 0.0),
    ),
    Row("a payload of 10 g", _push(0.0, 0.0, 0.0981), is_fault=False),
    Row("tracker noise of 0.15 mm", _nothing, is_fault=False, noise=1.5e-4),
    Row("nothing", _nothing, is_fault=False),
)
