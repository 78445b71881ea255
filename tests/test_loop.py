"""The loop: its states, what may be asked for in each, its threads, its time, and accidents."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest

from fake_control import Hang
from simulated_loop import PERIOD, TASK, Lab
from stiffopt.control.interface import Notice
from stiffopt.control.lifecycle import Alarms, EventBuffer, Lifecycle
from stiffopt.control.loop import ControlLoop, TickTiming
from stiffopt.control.request_queue import Requester, requested_by
from stiffopt.control.state import Severity, State
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.settings import Safety

WAY = Trajectory(waypoints=(Waypoint(time=0.0, target=TASK.target),))


# States ------------------------------------------------------------------------------------------


def test_it_begins_unconfigured_and_vented() -> None:
    lab = Lab(ready=False)
    assert lab.state is State.UNCONFIGURED
    lab.ticks(5)
    for request in (lab.loop.arm, lab.loop.hold, lab.loop.reset):
        with pytest.raises(
            CommandError, match=r"while unconfigured: (configure first|there is no)"
        ):
            request()
    lab.loop.disarm()
    with pytest.raises(CommandError, match="not open"):
        lab.loop.vent()
    assert lab.state is State.UNCONFIGURED
    assert np.isnan(lab.loop.snapshot().measured).all()


def test_from_configuration_to_pressure_and_back() -> None:
    lab = Lab(ready=False)
    lab.loop.configure()
    assert lab.state is State.INACTIVE
    assert not lab.gate.armed
    with pytest.raises(CommandError, match="tracker: it has seen the tip 0 times"):
        lab.loop.arm()
    lab.ticks(60)
    lab.loop.configure()  # again, to check again
    lab.loop.arm()
    assert lab.state is State.ACTIVE
    assert not lab.ticks(20).commanded.any()  # there is no task yet
    lab.loop.set_task(TASK)
    lab.loop.set_target(TASK.target)
    lab.loop.follow_trajectory(WAY)
    assert lab.controller.calls == ["begin", "begin", "set_task", "set_target", "follow"]
    lab.under_pressure()
    lab.loop.disarm()
    assert lab.state is State.HOLDING
    lab.loop.disarm()  # once is enough
    assert lab.until(State.INACTIVE) == pytest.approx(1.0, abs=0.03)
    assert lab.loop.snapshot().reason == "disarmed"
    assert lab.is_vented()
    lab.loop.disarm()  # it is already
    lab.arm()
    lab.under_pressure()


def test_hold_keeps_the_pressures_until_there_is_something_to_do() -> None:
    lab = Lab()
    lab.controller.wanted = np.full(3, 1e5)
    lab.ticks(20)
    lab.loop.hold("lunch")
    held = lab.ticks(3)  # back to what the chambers have, which lag behind the commands
    assert (held.state, held.reason) == (State.HOLDING, "lunch")
    assert 1e3 < held.commanded.max() < 9e4
    assert np.abs(held.commanded - lab.world.pressures).max() < 2e4
    np.testing.assert_array_equal(lab.ticks(100).commanded, held.commanded)
    lab.loop.set_target(TASK.target)
    assert lab.state is State.ACTIVE
    assert lab.controller.calls[-2:] == ["set_target", "resume"]
    first = lab.tick().commanded
    assert (first - held.commanded).max() <= lab.controller.rate * PERIOD + 1e-6  # without a jump
    np.testing.assert_allclose(lab.ticks(100).commanded, 1e5)


def test_a_hold_stops_falling_pressures_where_the_chambers_are() -> None:
    lab = Lab()
    lab.controller.wanted = np.full(3, 1e5)
    lab.ticks(100)
    lab.controller.wanted = np.zeros(3)
    before = lab.ticks(10).commanded
    chambers = lab.world.pressures.copy()
    assert (chambers - before).min() > 1e4  # on their way down
    lab.loop.hold("lunch")
    held = lab.ticks(100).commanded
    assert np.abs(held - chambers).max() < 1e4
    assert np.abs(lab.world.pressures - chambers).max() < 1e4


def test_a_hold_never_exceeds_the_latest_commands_whatever_the_gauges_read() -> None:
    lab = Lab()
    lab.controller.wanted = np.full(3, 0.5e5)
    lab.ticks(100)
    commanded = lab.loop.snapshot().commanded
    measured = lab.world.measured
    lab.world.measured = lambda: measured() + 1e4  # within the monitor's tolerance
    lab.ticks(20)
    lab.loop.hold("lunch")
    np.testing.assert_array_equal(lab.ticks(3).commanded, commanded)


def test_a_hold_that_was_asked_for_outlasts_that_of_the_tracker() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "off")
    lab.until(State.HOLDING)
    lab.loop.hold("asked to")
    lab.world.inject("tracker", "ok")
    lab.ticks(30)
    assert (lab.state, lab.loop.snapshot().reason) == (State.HOLDING, "asked to")
    lab.loop.set_task(TASK)
    assert lab.state is State.ACTIVE


def test_a_task_does_not_end_the_hold_of_the_tracker() -> None:
    lab = Lab().under_pressure()
    lab.loop.hold("asked to")
    lab.world.inject("tracker", "off")
    lab.ticks(20)
    lab.loop.set_task(TASK)
    assert lab.state is State.HOLDING
    lab.world.inject("tracker", "ok")
    lab.until(State.ACTIVE)


@pytest.mark.parametrize("state", ["active", "holding", "letting down", "inactive"])
def test_vent_at_once_from_anywhere(state: str) -> None:
    lab = Lab().under_pressure()
    if state == "holding":
        lab.loop.hold()
    elif state == "letting down":
        lab.loop.disarm()
        lab.ticks(10)
    elif state == "inactive":
        lab.loop.vent()
    lab.loop.vent("smoke")
    assert lab.state is State.INACTIVE
    assert lab.world.valve_open
    assert not lab.world.set_point.any()
    lab.tick()
    assert lab.is_vented()
    assert lab.state is State.INACTIVE


def test_a_vent_that_fails_is_a_fault_that_goes_on_trying() -> None:
    lab = Lab(supply={"driver": "simulated", "dump_valve": False}).under_pressure()
    lab.world.inject("supply", "off")
    with pytest.raises(CommandError, match="does not accept the command to vent"):
        lab.loop.vent()
    assert lab.state is State.FAULT
    lab.world.inject("supply", "ok")
    assert lab.is_vented()


def test_no_state_follows_any_other() -> None:
    life = Lifecycle()
    with pytest.raises(CommandError, match="active cannot follow unconfigured"):
        life.change(State.ACTIVE)
    life.change(State.FAULT, "fire")
    with pytest.raises(CommandError, match=r"cannot arm while fault \(fire\): it is vented; find"):
        life.permit("arm")


def test_close_vents_and_ends_everything() -> None:
    lab = Lab().under_pressure()
    lab.loop.close()
    assert not lab.world.set_point.any()
    assert not lab.rig.supply.is_open
    assert lab.rig.tracker is not None
    assert not lab.rig.tracker.is_open
    assert lab.controller.closed


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), float("inf")])
def test_a_period_is_a_positive_time(period: float) -> None:
    lab = Lab(ready=False)
    with pytest.raises(InputError, match="period must be above 0 s"):
        ControlLoop(lab.rig, lab.controller, lab.gate, safety=Safety(), period=period)


# Accidents ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("call", ["observe", "compute", "notices", "status", "resume"])
def test_an_exception_of_the_steering_is_a_fault_and_vents(call: str) -> None:
    lab = Lab().under_pressure()
    if call == "resume":
        lab.world.inject("tracker", "off")
        lab.until(State.HOLDING)
        lab.world.inject("tracker", "ok")
    broken = True

    def fail(name: str) -> None:
        if broken and name == call:
            raise ZeroDivisionError("oh")

    lab.controller.accident = fail
    lab.until(State.FAULT, within=0.4)
    assert lab.loop.snapshot().reason == "unexpected ZeroDivisionError: oh"
    assert lab.is_vented()
    assert lab.kinds.count("internal") == 1
    broken = False
    lab.loop.reset()


def test_an_exception_in_a_request_is_a_fault_and_told() -> None:
    lab = Lab().under_pressure()

    def fail(name: str) -> None:
        if name == "set_task":
            raise ZeroDivisionError("oh")

    lab.controller.accident = fail
    with pytest.raises(CommandError, match="unexpected ZeroDivisionError: oh"):
        lab.loop.set_task(TASK)
    assert lab.state is State.FAULT
    assert lab.is_vented()


def test_an_exception_of_the_tracker_is_a_fault() -> None:
    lab = Lab().under_pressure()
    assert lab.rig.tracker is not None
    lab.rig.tracker.close()
    lab.tick()
    assert lab.state is State.FAULT
    assert "a device fails: SimulatedTracker is not open" in lab.loop.snapshot().reason
    assert lab.is_vented()
    with pytest.raises(CommandError, match="still there: SimulatedTracker is not open"):
        lab.loop.reset()


@pytest.mark.parametrize("failing", ["arm", "begin"])
def test_an_arming_that_fails_leaves_it_vented(failing: str) -> None:
    lab = Lab(ready=False)
    lab.loop.configure()
    lab.ticks(60)

    def fail(name: str = "begin") -> None:
        if name == "begin":
            raise DeviceError("no answer")

    if failing == "arm":
        lab.rig.supply.arm = fail  # type: ignore[method-assign]
    else:
        lab.controller.accident = fail
    with pytest.raises(CommandError, match="no answer"):
        lab.loop.arm()
    assert lab.state is State.INACTIVE
    assert not lab.gate.armed
    assert not lab.rig.supply.armed


def test_a_supply_that_was_vented_behind_its_back_is_a_fault() -> None:
    lab = Lab().under_pressure()
    lab.rig.supply.vent()
    lab.until(State.FAULT, within=0.1)
    assert "a command was refused" in lab.loop.snapshot().reason


def test_channels_without_gauge_are_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(ready=False)
    measure = lab.world.measured
    lab.world.measured = lambda: measure() * [1.0, np.nan, 1.0]  # type: ignore[method-assign]
    with pytest.raises(InputError, match="gauges of channels 2 read nothing"):
        lab.arm()
    monkeypatch.setattr(type(lab.rig.settings.supply), "measures", lambda self, k: k != 1)
    lab.arm()
    lab.under_pressure()
    assert lab.alarms == {"unsupervised"}
    assert lab.loop.snapshot().alarms[0].text.startswith("channel 2 has no gauge")


def test_pressure_that_comes_back_in_a_vented_arm_is_a_fault() -> None:
    lab = Lab(supply={"driver": "simulated", "dump_valve": False})
    lab.loop.vent()
    lab.ticks(10)
    lab.world.inject("supply", "high", channel=0)
    lab.until(State.FAULT, within=1.0)
    assert "regulator-stuck" in lab.kinds
    lab.ticks(50)
    assert "regulator-stuck" in lab.alarms


# Threads and time --------------------------------------------------------------------------------


@contextmanager
def running(lab: Lab) -> Iterator[threading.Thread]:
    """Run the loop in a thread; its simulated time runs as fast as it can."""
    stop = threading.Event()
    thread = threading.Thread(target=lab.loop.run, args=(stop,))
    thread.start()
    try:
        yield thread
    finally:
        stop.set()
        thread.join(60)
        assert not thread.is_alive()


def test_requests_of_other_threads_are_carried_out_by_the_loop() -> None:
    lab = Lab()
    threads: list[threading.Thread] = []

    def note(name: str) -> None:
        if name == "set_task":
            threads.append(threading.current_thread())
        if name == "set_target":
            raise InputError("too far")

    lab.controller.accident = note
    with running(lab) as thread:
        while lab.loop.snapshot().timing.ticks < 5:
            pass
        for _ in range(20):
            lab.loop.set_task(TASK)
        with pytest.raises(InputError, match="too far"):
            lab.loop.set_target(TASK.target)
        with pytest.raises(CommandError, match="runs already"):
            lab.loop.run(threading.Event())
        lab.loop.hold("enough")
        assert lab.state is State.HOLDING
    assert set(threads) == {thread}
    assert len(threads) == 20
    assert lab.state is State.INACTIVE
    assert lab.kinds[-1] == "vented"


def test_requests_that_wait_when_the_loop_ends_are_refused() -> None:
    lab = Lab()
    refused: list[str] = []
    stop = threading.Event()

    def ask() -> None:
        for _ in itertools.count():
            try:
                lab.loop.set_target(TASK.target)
            except CommandError as error:
                refused.append(str(error))
                return

    asking = [threading.Thread(target=ask) for _ in range(4)]
    thread = threading.Thread(target=lab.loop.run, args=(stop,))
    thread.start()
    for one in asking:
        one.start()
    stop.set()
    for one in (*asking, thread):
        one.join(60)
        assert not one.is_alive()
    assert len(refused) == 4


@pytest.mark.parametrize("served", [True, False])
def test_while_it_is_configured_nothing_waits_and_a_vent_is_done(served: bool) -> None:
    lab = Lab(ready=False)
    lab.controller.accident = compiling = Hang("check")
    with running(lab) if served else nullcontext():
        while served and lab.loop.snapshot().timing.ticks < 5:
            pass
        starting = threading.Thread(target=lab.loop.configure)
        starting.start()
        assert compiling.begun.wait(30)
        told: list[str] = []
        for request in (
            lab.loop.arm,
            lab.loop.disarm,
            lab.loop.reset,
            lab.loop.hold,
            lambda: lab.loop.set_task(TASK),
            lab.loop.configure,
        ):
            told.append(refusal(request))
        lab.world.inject("supply", "off")
        assert "cannot be told to vent now (the simulated supply" in refusal(lab.loop.vent)
        lab.world.inject("supply", "ok")
        lab.loop.vent()
        assert starting.is_alive()
        compiling.go_on.set()
        starting.join(30)
        assert lab.state is State.INACTIVE
        assert all("while unconfigured: it is still starting" in text for text in told)
    assert "armed" not in lab.kinds
    assert lab.controller.calls == ["begin"]


def test_a_vent_before_the_supply_is_connected_says_so() -> None:
    lab = Lab(ready=False)
    assert lab.rig.tracker is not None
    connect, told = lab.rig.tracker.open, []

    def slowly() -> None:
        told.append(refusal(lab.loop.vent))
        connect()

    lab.rig.tracker.open = slowly  # type: ignore[method-assign]
    lab.loop.configure()
    assert lab.state is State.INACTIVE
    assert told[0].endswith("is not open); it is vented when it is connected")


def refusal(request: Callable[[], None]) -> str:
    with pytest.raises(CommandError) as refused:
        request()
    return str(refused.value)


@pytest.mark.parametrize("served", [True, False])
def test_what_was_given_up_is_not_done_later(served: bool) -> None:
    lab = Lab()
    lab.controller.accident = busy = Hang("set_task")
    with running(lab) if served else nullcontext():
        while served and lab.loop.snapshot().timing.ticks < 5:
            pass
        first, second, patient = Requester(), Requester(), Requester()
        told: dict[Requester, str] = {}

        def ask(asker: Requester, request: Callable[[], None]) -> None:
            with requested_by(asker):
                try:
                    request()
                except CommandError as error:
                    told[asker] = str(error)

        threads = [threading.Thread(target=ask, args=(first, lambda: lab.loop.set_task(TASK)))]
        threads[0].start()
        assert busy.begun.wait(30)
        for asker, request in (
            (second, lambda: lab.loop.set_target(TASK.target)),
            (patient, lambda: lab.loop.hold("late")),
        ):
            threads.append(threading.Thread(target=ask, args=(asker, request)))
            threads[-1].start()
        assert not first.give_up()  # it was begun
        assert second.give_up()
        threads[1].join(10)
        assert not threads[1].is_alive()  # nor does anything wait for it
        busy.go_on.set()
        for thread in threads:
            thread.join(30)
        assert told == {second: "nobody waits for this any more; it is not done"}
        assert lab.loop.snapshot().reason == "late"
    assert lab.controller.calls.count("set_task") == 1
    assert "set_target" not in lab.controller.calls


def test_nothing_is_begun_by_one_who_gave_up_before() -> None:
    lab, asker = Lab(), Requester()
    assert asker.give_up()
    with requested_by(asker), pytest.raises(CommandError, match="it is not done"):
        lab.loop.set_target(TASK.target)
    assert "set_target" not in lab.controller.calls
    lab.loop.set_target(TASK.target)  # of somebody else


def test_an_arming_whose_checks_take_too_long_moves_nothing() -> None:
    lab, asker = Lab(ready=False), Requester()
    lab.loop.configure()
    lab.ticks(60)

    def give_up(call: str) -> None:
        if call == "check":
            asker.give_up()

    lab.controller.accident = give_up
    with requested_by(asker), pytest.raises(CommandError, match="longer than the client waited"):
        lab.loop.arm()
    assert lab.state is State.INACTIVE
    assert not lab.gate.armed
    lab.loop.arm()
    assert lab.gate.armed


def test_ticks_come_at_absolute_times_and_missed_ones_are_left_out() -> None:
    lab = Lab()
    begin = lab.now
    stop, times = threading.Event(), []

    def at_each_tick(call: str) -> None:
        if call != "observe":
            return
        times.append(lab.now)
        if len(times) == 50:
            lab.rig.clock.sleep(0.034)
        if len(times) == 100:
            stop.set()

    lab.controller.accident = at_each_tick
    lab.loop.run(stop)
    ticks = (np.array(times) - begin) / PERIOD
    np.testing.assert_allclose(ticks[:50], np.arange(50), atol=1e-6)
    np.testing.assert_allclose(ticks[50:100], np.arange(53, 103), atol=1e-6)
    timing = lab.loop.snapshot().timing
    assert timing.overruns == 1
    edges, counts = timing.lateness
    assert len(counts) == len(edges) + 1
    assert sum(counts) == len(times)


def test_an_exception_of_the_clock_vents_and_does_not_end_the_loop() -> None:
    lab = Lab().under_pressure()
    stop, sleep, left = threading.Event(), lab.rig.clock.sleep_until, [0]

    def fail(moment: float) -> None:
        left[0] += 1
        if 20 <= left[0] < 23:
            raise ArithmeticError("the arm cannot be followed")
        if left[0] == 60:
            stop.set()
        sleep(moment)

    lab.rig.clock.sleep_until = fail  # type: ignore[method-assign]
    lab.loop.run(stop)
    assert left[0] >= 60
    assert lab.state is State.FAULT
    assert not lab.world.set_point.any()


def test_an_interrupt_vents_on_its_way_out() -> None:
    lab = Lab().under_pressure()

    def interrupt(call: str) -> None:
        if call == "compute":
            raise KeyboardInterrupt

    lab.controller.accident = interrupt
    with pytest.raises(KeyboardInterrupt):
        lab.loop.run(threading.Event())
    assert lab.state is State.INACTIVE
    assert not lab.world.set_point.any()


def test_lateness_is_counted_by_size() -> None:
    timing = TickTiming(0.01)
    for lateness in (-1.0, 0.0, 1e-6, 1.5e-6, 3e-4, 0.5, 0.6, 100.0):
        timing.begin(0.0, lateness)
    edges, counts = timing.statistics().lateness
    counted = dict(zip((*edges, np.inf), counts, strict=True))
    assert {edge: n for edge, n in counted.items() if n} == {
        1e-6: 3,
        2e-6: 1,
        5e-4: 1,
        0.5: 1,
        np.inf: 2,
    }


def test_due_times_are_never_in_the_past() -> None:
    timing = TickTiming(0.01)
    assert timing.next_due(1.0, 1.005) == pytest.approx(1.01)
    assert timing.missed == 0
    assert timing.next_due(1.0, 1.034) == pytest.approx(1.04)
    assert timing.missed == 3


# What it tells -----------------------------------------------------------------------------------


def test_events_are_told_once_and_the_oldest_go_first() -> None:
    log = EventBuffer(size=3)
    assert log.since(0) == ([], 0)
    for number in range(5):
        log.add(float(number), "tick", str(number))
    events, after = log.since(0)
    assert [e.text for e in events] == ["2", "3", "4"]
    assert log.since(4)[0] == events[2:]
    assert log.since(after) == ([], 5)
    assert log.since(99) == ([], 5)


def test_an_alarm_is_an_event_when_it_comes_and_when_it_goes() -> None:
    log = EventBuffer()
    alarms = Alarms(log)
    alarms.set(1.0, "wet", "it rains", Severity.ERROR)
    alarms.set(2.0, "wet", "it pours")
    assert [(a.text, a.since) for a in alarms.now] == [("it pours", 1.0)]
    alarms.clear(3.0, "wet")
    alarms.clear(4.0, "wet")
    assert alarms.now == ()
    assert [(e.time, e.kind, e.severity) for e in log.since(0)[0]] == [
        (1.0, "wet", Severity.ERROR),
        (3.0, "wet-over", Severity.INFO),
    ]


def test_an_alarm_that_comes_with_its_own_event_is_reported_once() -> None:
    arm = Lab().under_pressure()
    text = "the contact is lost; the arm goes back"
    alarm = Notice("brace-lost", "the contact is lost", Severity.ERROR, standing=True)
    arm.controller.said = (Notice("brace-lost", text, Severity.ERROR), alarm)
    arm.tick()
    arm.controller.said = (alarm,)
    arm.ticks(5)
    assert arm.alarms == {"brace-lost"}
    events = [event for event in arm.loop.events.since(0)[0] if event.kind == "brace-lost"]
    assert [event.text for event in events] == [text]
    arm.controller.said = ()
    arm.tick()
    assert not arm.alarms
    assert arm.kinds[-1] == "brace-lost-over"


def test_a_snapshot_tells_how_things_stand() -> None:
    lab = Lab().under_pressure()
    snapshot = lab.loop.snapshot()
    assert snapshot.time == lab.now
    np.testing.assert_array_equal(snapshot.commanded, [8e4, 4e4, 0])
    np.testing.assert_allclose(snapshot.measured, [8e4, 4e4, 0], atol=1e3)
    assert snapshot.measured_time == pytest.approx(lab.now - PERIOD)
    np.testing.assert_array_equal(snapshot.high, lab.gate.limits.high)
    assert 0.025 <= snapshot.seen_age <= 0.06
    assert snapshot.timing.ticks > 200
    assert snapshot.timing.tick_time > 0
    arrived = sum(len(lab.tick().samples) for _ in range(100))
    assert arrived == pytest.approx(40, abs=1)
