"""The numbered faults but for the tracker's, on the simulated rig: each has the stated outcome."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
import pytest

from simulated_loop import PERIOD, TASK, Lab
from stiffopt.control.interface import Notice
from stiffopt.control.state import State
from stiffopt.errors import CommandError, InputError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange
from stiffopt.rig.interface import PressureCommand, PressureReading


def test_8_a_regulator_that_saturates_is_flagged_and_does_not_wind_up() -> None:
    lab = Lab(supply={"driver": "simulated", "saturation": 9e4})
    lab.controller.wanted = np.array([1e5, 5e4, 0.0])
    snapshot = lab.ticks(300)
    assert snapshot.state is State.ACTIVE
    assert snapshot.saturated.tolist() == [True, False, False]
    assert "saturated" in lab.alarms
    assert lab.controller.observed is not None
    assert lab.controller.observed[2].pressures[0] == pytest.approx(9e4, abs=1e3)  # is told so
    np.testing.assert_array_equal(snapshot.commanded, [1e5, 5e4, 0.0])  # nothing has wound up
    lab.controller.wanted = np.array([5e4, 5e4, 0.0])
    snapshot = lab.ticks(100)
    assert not snapshot.saturated.any()
    assert not lab.alarms
    assert lab.world.pressures[0] == pytest.approx(5e4, abs=1e3)


def test_9_leak() -> None:
    lab = Lab().under_pressure(1.4e5, 1.4e5, 0.0)
    lab.world.inject("supply", "leak", channel=1)
    assert lab.until(State.FAULT) < 1.0
    assert "leak" in lab.kinds
    assert "channel 2" in lab.loop.snapshot().reason
    assert lab.is_vented()


def test_9_a_leak_before_arming_is_flagged_first_and_a_fault_when_its_command_changes() -> None:
    lab = Lab(ready=False)
    lab.world.inject("supply", "leak", channel=1)
    lab.arm()
    lab.controller.wanted = np.array([1e5, 1.1e5, 0.0])
    assert lab.ticks(300).saturated.tolist() == [False, True, False]
    assert lab.state is State.ACTIVE
    assert "saturated" in lab.alarms
    lab.controller.wanted = np.array([1e5, 1.3e5, 0.0])
    assert lab.until(State.FAULT) < 1.5
    assert "leak" in lab.kinds
    assert "channel 2" in lab.loop.snapshot().reason
    assert lab.is_vented()


def test_10_a_regulator_that_is_stuck_high_trips_the_dump_line() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("supply", "high", channel=2)
    assert lab.until(State.FAULT) < 0.6
    assert "regulator-stuck" in lab.kinds
    assert "channel 3" in lab.loop.snapshot().reason
    assert lab.world.valve_open
    assert lab.is_vented()
    lab.ticks(500)
    assert lab.state is State.FAULT
    with pytest.raises(CommandError, match="reset"):
        lab.loop.arm()


def test_10_without_a_dump_line_it_cannot_be_reset_before_it_is_repaired() -> None:
    lab = Lab(supply={"driver": "simulated", "dump_valve": False}).under_pressure()
    lab.world.inject("supply", "high", channel=2)
    lab.until(State.FAULT)
    lab.ticks(100)
    with pytest.raises(CommandError, match=r"still there: channel 3 reads 1\.5 bar"):
        lab.loop.reset()
    lab.world.inject("supply", "ok")
    assert lab.is_vented()
    lab.loop.reset()
    assert lab.state is State.INACTIVE


@pytest.mark.parametrize("channel", [None, 1])
def test_11_readings_that_cannot_be(channel: int | None) -> None:
    lab = Lab().under_pressure()
    lab.world.inject("supply", "garbage", channel=channel)
    lab.ticks(2)
    assert lab.state is State.FAULT
    assert "pressure-reading" in lab.kinds
    assert lab.is_vented()
    with pytest.raises(CommandError, match="which cannot be"):
        lab.loop.reset()
    lab.world.inject("supply", "ok")
    lab.ticks(1)
    lab.loop.reset()


def test_12_a_supply_that_is_lost_is_a_fault_and_its_watchdog_vents() -> None:
    lab = Lab(supply={"driver": "simulated", "watchdog": 0.3, "dump_valve": False})
    lab.under_pressure()
    lab.world.inject("supply", "off")
    lab.ticks(1)
    assert lab.state is State.FAULT
    assert "not-vented" in lab.alarms  # it is tried in each tick, and no one answers
    lab.ticks(100)
    assert (lab.world.pressures < 1e3).all()  # which was the watchdog
    with pytest.raises(CommandError, match="does not answer"):
        lab.loop.reset()
    lab.world.inject("supply", "ok")
    lab.ticks(1)
    assert "not-vented" not in lab.alarms
    lab.loop.reset()


def test_12_a_supply_without_watchdog_is_vented_when_it_is_back() -> None:
    lab = Lab(supply={"driver": "simulated", "watchdog": None, "dump_valve": False})
    lab.under_pressure()
    lab.world.inject("supply", "off")
    lab.ticks(200)
    assert (lab.world.pressures[:2] > 1e4).all()
    lab.world.inject("supply", "ok")
    assert lab.is_vented()
    assert lab.state is State.FAULT


def test_13_requests_above_the_limits_are_refused() -> None:
    lab = Lab().under_pressure()
    before = lab.loop.snapshot()
    too_much = TASK.model_copy(update={"pressure": PressureRange(max=2e5)})
    beyond = r"pressure\.max: 2 bar is beyond the limits of channel 1, 0 to 1\.5 bar"
    with pytest.raises(InputError, match=beyond):
        lab.loop.set_task(too_much)
    for_one = TASK.model_copy(update={"pressure": PressureRange(max=(None, 1e5, 1.6e5))})
    with pytest.raises(InputError, match=r"1\.6 bar is beyond the limits of channel 3"):
        lab.loop.set_task(for_one)
    too_low = TASK.model_copy(update={"pressure": PressureRange(min=-1e4)})
    with pytest.raises(InputError, match=r"pressure\.min: -0\.1 bar is beyond"):
        lab.loop.set_task(too_low)
    applied = lab.gate.apply(PressureCommand(np.array([1e4, 2e5, 0.0]), lab.now))
    assert "channel 2: 2 bar is out of range" in applied.refused
    after = lab.tick()
    assert after.state is State.ACTIVE
    np.testing.assert_array_equal(after.commanded, before.commanded)
    assert lab.controller.calls == ["begin", "begin"]


def test_13_a_steering_that_goes_above_the_limits_is_held() -> None:
    lab = Lab().under_pressure()
    before = lab.loop.snapshot().commanded
    lab.controller.override = lambda p: p + 2e5
    lab.ticks(3)
    assert lab.state is State.HOLDING
    assert "out of range" in lab.loop.snapshot().reason
    np.testing.assert_array_equal(lab.ticks(50).commanded, before)
    assert lab.state is State.HOLDING


def test_a_force_that_is_too_great_is_shortened_and_an_alarm_while_it_is() -> None:
    robot = load_description("stiff-flop-1")
    most = float(robot.channel_areas @ np.array([6e4, 3e4, 0.0]))
    lab = Lab(safety={"max_force": most})
    lab.controller.wanted = np.array([8e4, 4e4, 0.0])
    snapshot = lab.ticks(150)
    assert "force-limit" in lab.alarms
    assert lab.kinds.count("force-limit") == 1
    assert robot.channel_areas @ snapshot.commanded == pytest.approx(most)
    assert snapshot.saturated[0]
    assert snapshot.state is State.ACTIVE
    lab.controller.wanted = np.array([5e4, 3e4, 0.0])
    lab.ticks(20)
    assert "force-limit" in lab.alarms  # now and then it is not: the alarm does not flicker
    lab.ticks(60)
    assert not lab.alarms
    lab.controller.wanted = np.array([8e4, 4e4, 0.0])
    lab.ticks(100)
    assert "force-limit" in lab.alarms
    lab.loop.vent()
    assert "force-limit" not in lab.alarms


def test_14_a_slew_beyond_the_limit_is_limited_and_flagged() -> None:
    lab = Lab()
    lab.controller.rate = 1e9
    lab.controller.wanted = np.array([1.4e5, 0.0, 0.0])
    before, slew = 0.0, lab.rig.slew[0]
    flagged = 0
    for _ in range(60):
        snapshot = lab.tick()
        assert snapshot.commanded[0] - before <= slew * PERIOD * (1 + 1e-9)
        before = snapshot.commanded[0]
        flagged += bool(snapshot.saturated[0])
    assert before == 1.4e5
    assert flagged == pytest.approx(1.4e5 / (slew * PERIOD), abs=1)


@pytest.mark.parametrize(
    ("request_", "match"),
    [
        (lambda loop: loop.set_task(None), "expected a Task, not NoneType"),
        (lambda loop: loop.set_task("high"), "expected a Task, not str"),
        (lambda loop: loop.set_target([0, 0, 0.1]), "expected a Target, not list"),
        (
            lambda loop: loop.set_target(Target.model_construct(position=(math.nan, 0.0, 0.1))),
            r"Target\.position\[0\]: nan is not a finite number",
        ),
        (lambda loop: loop.follow_trajectory(TASK), "expected a Trajectory, not Task"),
        (
            lambda loop: loop.set_task(
                TASK.model_copy(update={"pressure": PressureRange(max=(1e5,) * 400)})
            ),
            "expected one value or a list of 3, not 400",
        ),
        (lambda loop: loop.reset(), "there is no fault"),
        (lambda loop: loop.arm(), "disarm first"),
    ],
)
def test_15_malformed_requests_change_nothing(request_: Any, match: str) -> None:
    lab = Lab().under_pressure()
    before, events = lab.loop.snapshot(), lab.kinds
    with pytest.raises(InputError, match=match):
        request_(lab.loop)
    after = lab.tick()
    assert after.state is State.ACTIVE
    np.testing.assert_array_equal(after.commanded, before.commanded)
    assert lab.kinds == events
    assert lab.controller.calls == ["begin", "begin"]


def test_15_a_task_that_the_steering_refuses_changes_nothing() -> None:
    lab = Lab().under_pressure()

    def refuse(call: str) -> None:
        if call == "set_task":
            raise InputError("the robot is another one")

    lab.controller.accident = refuse
    with pytest.raises(InputError, match="the robot is another one"):
        lab.loop.set_task(TASK)
    assert lab.tick().state is State.ACTIVE


@pytest.mark.parametrize("fault", ["ok", "off"])
def test_18_stopping_lets_down_in_bounded_time(fault: str) -> None:
    lab = Lab().under_pressure()
    stop = threading.Event()
    stopped_at, highest = lab.now + 0.1, 0.0

    def at_each_tick(call: str) -> None:
        nonlocal highest
        if call == "notices" and lab.now >= stopped_at and not stop.is_set():
            stop.set()
            lab.world.inject("tracker", fault)
        if call == "observe" and stop.is_set():
            highest = max(highest, float(lab.world.set_point.max()))

    lab.controller.accident = at_each_tick
    lab.loop.run(stop)
    assert lab.state is State.INACTIVE
    assert 0.9 < lab.now - stopped_at < 1.1
    assert highest == pytest.approx(8e4, rel=0.02)
    assert not lab.world.set_point.any()
    assert lab.world.valve_open
    with pytest.raises(CommandError, match="arm first"):
        lab.loop.set_task(TASK)  # at once, as the loop does not run


def test_18_stopping_ends_though_the_supply_is_dead() -> None:
    lab = Lab(supply={"driver": "simulated", "dump_valve": False}).under_pressure()
    lab.world.inject("supply", "off")
    stop = threading.Event()
    stop.set()
    begin = lab.now
    lab.loop.run(stop)
    assert lab.now - begin < 2.0
    assert lab.state is State.FAULT


def test_20_an_alarm_of_somebody_else_does_not_touch_control() -> None:
    lab = Lab().under_pressure()
    lab.loop.add_alarm("disk-full", "nothing is recorded any more: the disk is full")
    for _ in range(50):
        snapshot = lab.tick()
        assert snapshot.state is State.ACTIVE
        assert [alarm.kind for alarm in snapshot.alarms] == ["disk-full"]
    lab.loop.clear_alarm("disk-full")
    assert not lab.tick().alarms
    assert lab.kinds[-2:] == ["disk-full", "disk-full-over"]


def test_21_the_wall_clock_may_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab().under_pressure()
    before = lab.loop.snapshot()
    wall = time.time()
    for jump in (3600.0, -7200.0, 1e9):
        monkeypatch.setattr(time, "time", lambda jump=jump: wall + jump)
        monkeypatch.setattr(time, "time_ns", lambda jump=jump: int((wall + jump) * 1e9))
        snapshot = lab.ticks(30)
        assert snapshot.state is State.ACTIVE
        assert not snapshot.alarms
        np.testing.assert_array_equal(snapshot.commanded, before.commanded)
    assert snapshot.time == pytest.approx(before.time + 90 * PERIOD)


@pytest.mark.parametrize("kind", ["nan", "infinite", "unsound", "short"])
def test_22_no_answer_of_the_solver_means_the_last_one_and_then_hold(kind: str) -> None:
    lab = Lab().under_pressure()
    before = lab.loop.snapshot().commanded
    lab.controller.wanted = np.full(3, 1e5)
    lab.controller.valid = kind != "unsound"
    bad = {"nan": [0, math.nan, 0], "infinite": [math.inf, 0, 0], "short": [1e4]}.get(
        kind, [1e5] * 3
    )
    lab.controller.override = lambda p: np.array(bad)
    for _ in range(2):
        snapshot = lab.tick()
        assert snapshot.state is State.ACTIVE
        np.testing.assert_array_equal(snapshot.commanded, before)
    assert lab.tick().state is State.HOLDING
    assert "solver" in lab.alarms
    np.testing.assert_array_equal(lab.ticks(100).commanded, before)
    lab.controller.valid, lab.controller.override = True, None
    lab.loop.set_task(TASK)
    lab.ticks(100)
    assert lab.state is State.ACTIVE
    assert "solver" not in lab.alarms
    np.testing.assert_array_equal(lab.loop.snapshot().commanded, [1e5] * 3)


def test_22_a_single_answer_that_is_missing_does_not_matter() -> None:
    lab = Lab().under_pressure()
    for _ in range(10):
        lab.controller.valid = False
        lab.ticks(2)
        lab.controller.valid = True
        lab.ticks(1)
        assert lab.state is State.ACTIVE


def slow(lab: Lab, duration: float) -> None:
    """Let each move take some time of the rig's clock."""

    def take_time(call: str) -> None:
        if call == "compute":
            lab.rig.clock.sleep(duration)

    lab.controller.accident = take_time


def test_23_overruns_are_counted_and_in_a_row_a_fault() -> None:
    lab = Lab().under_pressure()
    slow(lab, 0.015)
    lab.ticks(9)
    assert lab.state is State.ACTIVE
    assert lab.loop.snapshot().timing.overruns == 9
    slow(lab, 0.005)
    lab.ticks(1)
    slow(lab, 0.015)
    lab.ticks(9)
    assert lab.state is State.ACTIVE
    lab.ticks(1)
    assert lab.state is State.FAULT
    assert lab.loop.snapshot().timing.overruns == 19
    assert "overruns" in lab.kinds
    assert lab.is_vented()
    lab.loop.reset()


def test_23_a_loop_that_stood_still_is_a_fault() -> None:
    lab = Lab(supply={"driver": "simulated", "watchdog": None}).under_pressure()
    lab.rig.clock.sleep(0.6)
    lab.loop.tick()
    assert lab.state is State.FAULT
    assert "stalled" in lab.kinds
    assert lab.is_vented()


def test_24_after_a_fault_it_is_vented_until_it_is_reset() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("supply", "garbage")
    lab.until(State.FAULT)
    lab.world.inject("supply", "ok")
    lab.ticks(300)
    assert lab.state is State.FAULT
    for request in (lab.loop.arm, lab.loop.hold, lab.loop.disarm, lab.loop.configure):
        with pytest.raises(CommandError, match=r"while fault .* then reset"):
            request()
    with pytest.raises(CommandError, match="while fault"):
        lab.loop.set_task(TASK)
    lab.loop.vent()
    assert lab.state is State.FAULT
    lab.loop.reset()
    assert lab.state is State.INACTIVE
    assert lab.is_vented()
    with pytest.raises(CommandError, match="arm first"):
        lab.loop.set_task(TASK)
    lab.arm()
    lab.under_pressure()


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"tracker": None}, "tracker: this rig has none"),
        ({"plant": {"mismatch": {"registration": {"position": ("2 cm", "0 m", "0 m")}}}}, "cali"),
    ],
)
def test_25_bad_configurations_are_not_armed(changes: dict[str, Any], match: str) -> None:
    lab = Lab(ready=False, **changes)
    with pytest.raises(CommandError, match=match):
        lab.arm()
    assert lab.state in (State.UNCONFIGURED, State.INACTIVE)
    assert not lab.gate.armed


def test_25_without_a_slew_it_is_not_armed() -> None:
    lab = Lab(ready=False)
    lab.rig.slew = np.full(3, np.inf)
    with pytest.raises(CommandError, match=r"slew: .*set safety\.max_slew"):
        lab.loop.configure()
    assert lab.state is State.UNCONFIGURED


def test_25_other_limits_at_the_gate_than_at_the_supply_are_not_armed() -> None:
    lab = Lab(ready=False)
    lab.gate.limits = type(lab.gate.limits)(np.zeros(3), np.full(3, 1e5))
    with pytest.raises(CommandError, match="limits: those of the gate"):
        lab.loop.configure()


def test_25_a_model_that_does_not_serve_is_not_armed() -> None:
    lab = Lab(ready=False)
    lab.controller.problem = "the robot file has no density"
    with pytest.raises(CommandError, match="model: the robot file has no density"):
        lab.loop.configure()


def test_25_devices_that_do_not_answer_are_not_armed() -> None:
    lab = Lab(ready=False)
    lab.world.inject("supply", "off")
    with pytest.raises(CommandError, match=r"devices: .*does not answer"):
        lab.loop.configure()
    lab.world.inject("supply", "ok")
    lab.world.inject("tracker", "off")
    with pytest.raises(CommandError, match="tracker: it has seen the tip 0 times"):
        lab.arm()
    lab.world.inject("tracker", "ok")
    lab.ticks(40)
    lab.world.inject("tracker", "off")
    lab.ticks(30)
    with pytest.raises(CommandError, match="tracker: the tip is not seen now"):
        lab.loop.arm()
    lab.world.inject("tracker", "ok")
    lab.arm()


def test_25_a_vented_arm_that_is_under_pressure_is_not_armed() -> None:
    lab = Lab(ready=False)
    lab.loop.configure()
    lab.ticks(40)
    honest = lab.rig.supply.read
    lab.gate.read = lambda: PressureReading(lab.now, honest().pressures + 3e4)  # type: ignore[method-assign]
    with pytest.raises(CommandError, match=r"pressures: channel 1 reads 0\.3\d* bar, though"):
        lab.loop.arm()


def test_26_what_the_steering_says_becomes_an_alarm_until_it_is_over() -> None:
    lab = Lab().under_pressure()
    lab.controller.said = (
        Notice("planner-died", "the planner has died; the last plan stays", standing=True),
        Notice("planner-restarted", "the planner is started again"),
    )
    lab.tick()
    assert lab.alarms == {"planner-died"}
    assert {"planner-died", "planner-restarted"} <= set(lab.kinds)
    lab.controller.said = lab.controller.said[:1]
    lab.ticks(5)
    assert lab.state is State.ACTIVE
    assert lab.kinds.count("planner-died") == 1
    lab.controller.said = ()
    lab.tick()
    assert not lab.alarms
    assert lab.kinds[-1] == "planner-died-over"
