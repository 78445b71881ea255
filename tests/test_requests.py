"""Requests to the control loop: when they take effect, and that a refused one changes nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import is_long
from fake_control import FakeController
from simulated_loop import TASK, Lab
from stiffopt.control import checks
from stiffopt.control.checks import limited_range
from stiffopt.control.controller import TipController
from stiffopt.control.course import Course
from stiffopt.control.interface import ControlOutput
from stiffopt.control.state import State
from stiffopt.daemon.messages import task_of, trajectory_of
from stiffopt.errors import CommandError, DeviceError, GuardTripped, InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Load, PressureRange, Task
from stiffopt.paths.trajectory import MAX_WAYPOINTS, Trajectory, Waypoint
from stiffopt.rig.interface import PressureLimits
from test_loop_properties import PERIOD, N, World

NONE = np.zeros(N, dtype=bool)
ROBOT = "stiff-flop-1"


# When a request takes effect ---------------------------------------------------------------------


def steered_to(pressures: tuple[float, ...], low: float) -> World:
    """Return an armed loop whose arm has arrived at some pressures."""
    world = World(seed=1, low=low)
    world.loop.configure()
    for _ in range(100):
        world.tick()
    world.loop.arm()
    world.controller.compute = lambda now: ControlOutput(np.array(pressures), True, NONE)  # type: ignore[method-assign]
    for _ in range(200):
        world.tick()
    assert world.loop.snapshot().state is State.ACTIVE
    np.testing.assert_array_equal(world.supply.set_points, pressures)
    return world


@contextmanager
def served_in_the_next_tick(world: World, request: Callable[[], None]) -> Iterator[None]:
    """Have another thread ask for something that the tick in the body serves."""
    requests = world.loop._requests
    requests.begin()
    client = threading.Thread(target=request)
    client.start()
    while not requests._queue:
        pass
    yield
    client.join()
    requests.end()


@pytest.mark.parametrize(
    ("pressures", "low"),
    [
        ((1.5e5, 0.0, 0.0), 0.0),
        ((1.5e5, 0.0, 0.0), -3e4),
        ((0.0, 1.2e5, -3e4), -3e4),
        ((2e4, 2e4, 1.0e5), 2e4),
    ],
)
def test_disarming_at_a_limit_lets_the_pressures_down(
    pressures: tuple[float, ...], low: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request is served, and its ramp begins, some time after the tick has begun."""
    world = steered_to(pressures, low)
    clock = world.clock

    def creeping() -> float:
        clock.t += 1e-5
        return clock.t

    monkeypatch.setattr(clock, "now", creeping)
    with served_in_the_next_tick(world, world.loop.disarm):
        world.tick()
    assert world.loop.snapshot().state is State.HOLDING
    np.testing.assert_array_equal(world.supply.set_points, pressures)
    for _ in range(round(0.1 / PERIOD)):
        world.tick()
    assert world.loop.snapshot().state is State.HOLDING
    halfway, begun = np.abs(world.supply.set_points), np.abs(pressures)
    assert (halfway[begun > 0] < begun[begun > 0]).all()
    assert halfway.any()
    for _ in range(round(0.15 / PERIOD)):
        world.tick()
    snapshot = world.loop.snapshot()
    assert snapshot.state is State.INACTIVE
    assert world.supply.vented
    kinds = [event.kind for event in world.loop.events.since(0)[0]]
    assert "disarming" in kinds
    assert "refused" not in kinds


# The guard ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (GuardTripped("no command came for 0.1 s"), "guard", "no command came for 0.1 s"),
        (DeviceError("no answer"), "device", "a device fails: no answer"),
    ],
)
def test_a_guard_that_vented_by_itself_is_no_device_that_fails(
    error: DeviceError, kind: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab().under_pressure()

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(lab.gate, "apply", fail)
    lab.tick()
    snapshot = lab.loop.snapshot()
    assert snapshot.state is State.FAULT
    assert snapshot.reason == text
    assert lab.kinds[-1] == kind
    assert lab.is_vented()


# What is refused changes nothing -----------------------------------------------------------------


class Following(FakeController):
    """Makes a course of a trajectory, as the controller does, and goes nowhere."""

    def follow(self, trajectory: Trajectory, now: float) -> None:
        Course(trajectory, now, self.tip, np.eye(3)).at(now)
        super().follow(trajectory, now)


@pytest.fixture(scope="module")
def armed() -> Lab:
    """An arm under pressure, for many requests."""
    lab = Lab()
    controller = lab.controller
    controller.__class__ = Following
    return lab.under_pressure()


def ask(lab: Lab, request: Callable[[], object]) -> bool:
    """Ask for something; return whether it was accepted. The arm is as before whether or not."""
    before, calls = lab.loop.snapshot(), list(lab.controller.calls)
    accepted = True
    try:
        request()
    except InputError:
        accepted = False
        assert lab.controller.calls == calls
    after = lab.tick()
    assert after.state is State.ACTIVE, after.reason
    np.testing.assert_array_equal(after.commanded, before.commanded)
    return accepted


def apart(*times: Any) -> Trajectory:
    """Return waypoints at these times, which nobody has checked."""
    return Trajectory.model_construct(
        waypoints=tuple(Waypoint.model_construct(time=t, target=TASK.target) for t in times)
    )


@pytest.mark.parametrize(
    "times",
    [
        (0.0, 1e308),
        (1e308,),
        (0.0, 1e-320),
        (1e-320,),
        (1.0, 1.0 + 1e-15),
        (0.0, 86_401.0),
        (0.0, 0.0005),
        (-1.0, 1.0),
        (float("nan"), 1.0),
        (0.0, float("inf")),
        (2.0, 1.0),
        ("soon",),
        (None,),
        (),
        tuple(range(MAX_WAYPOINTS + 1)),
    ],
)
def test_times_at_which_nothing_can_be_are_refused_and_do_not_vent(
    times: tuple[Any, ...], armed: Lab
) -> None:
    with pytest.raises(InputError):
        Trajectory(waypoints=tuple(Waypoint(time=t, target=TASK.target) for t in times))
    json = [{"time_s": t, "target": {"position_m": [0.0, 0.0, 0.1]}} for t in times]
    with pytest.raises(InputError):
        trajectory_of({"waypoints": json})
    assert not ask(armed, lambda: armed.loop.follow_trajectory(apart(*times)))


@pytest.mark.parametrize("times", [(0.0,), (0.001,), (0.001, 0.002, 0.003), (0.0, 86_400.0)])
def test_times_at_the_bounds_are_taken(times: tuple[float, ...], armed: Lab) -> None:
    made = Trajectory(waypoints=tuple(Waypoint(time=t, target=TASK.target) for t in times))
    assert ask(armed, lambda: armed.loop.follow_trajectory(made))


@pytest.mark.parametrize(
    ("times", "tip"),
    [
        ((0.0, 1e308), np.zeros(3)),
        ((1e-320, 1.0), np.zeros(3)),
        ((1.0, 1.0), np.zeros(3)),
        ((1.0, 2.0), np.full(3, np.nan)),
        ((1e-320,), np.full(3, 1e3)),
    ],
)
def test_a_course_that_is_not_finite_is_refused(
    times: tuple[float, ...], tip: np.ndarray[Any, Any]
) -> None:
    with pytest.raises(InputError):
        Course(apart(*times), 0.0, tip, np.eye(3))


def test_a_direction_that_vanishes_on_its_way_is_refused() -> None:
    """No two are opposite, but the spline that is made unit vectors goes through zero."""
    ways = [(-1.0, -1.0, 0.0), (0.0, -1.0, 0.0), (-0.4, -0.9, 0.0), (-0.1, 1.0, 0.0)]
    points = [
        Waypoint(time=t, target=Target(pointing=way))
        for t, way in zip((0.0, 1.0, 2.0, 2.1), ways, strict=True)
    ]
    with pytest.raises(InputError, match="the way between two waypoints is not clear"):
        Course(Trajectory(waypoints=points), 0.0, np.zeros(3), np.eye(3))
    Course(Trajectory(waypoints=points[:3]), 0.0, np.zeros(3), np.eye(3))


NUMBERS = st.one_of(
    st.sampled_from(
        [
            *(0.0, -0.0, 0.1, 1.0, 5e-324, 1e-320, -1e-310, 1e-3, 999.9, 1e3, 1.1e3, 86_400.0),
            *(1e155, 1e308, -1.7e308, float("inf"), -float("inf"), float("nan")),
            *(10**400, -(10**18), 2**53),
        ]
    ),
    st.floats(),
    st.floats(-1.0, 1.0),
    st.integers(),
)
ODD = st.one_of(NUMBERS, NUMBERS, NUMBERS, st.sampled_from([None, True, "1", "1 mm", "", [], {}]))
THREE = st.one_of(st.tuples(ODD, ODD, ODD), st.tuples(NUMBERS, NUMBERS, NUMBERS), ODD)
FOUR = st.one_of(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), st.just((1.0, 0.0, 0.0, 0.0)))
TARGETS = st.one_of(
    st.fixed_dictionaries({"position": THREE}, optional={"pointing": THREE, "orientation": FOUR}),
    st.fixed_dictionaries({"pointing": THREE}),
    st.fixed_dictionaries({"orientation": FOUR}),
)
GOALS = st.one_of(
    st.none(),
    st.fixed_dictionaries({"maximise": st.lists(st.fixed_dictionaries({"direction": THREE}))}),
    st.fixed_dictionaries(
        {"at_least": st.lists(st.fixed_dictionaries({"direction": THREE, "value": ODD}))}
    ),
    st.fixed_dictionaries(
        {"match": st.fixed_dictionaries({"matrix": st.tuples(THREE, THREE, THREE)})}
    ),
)
BOUNDS = st.one_of(st.none(), ODD, st.tuples(ODD, ODD, ODD))


def made(*ways: Callable[[], Any]) -> list[Any]:
    """Return what is made in some of several ways; some refuse."""
    found = []
    for way in ways:
        try:
            found.append(way())
        except InputError:
            continue
    return found


def json_of(target: dict[str, Any]) -> dict[str, Any]:
    names = {"position": "position_m", "orientation": "orientation_wxyz"}
    return {
        names.get(key, key): list(value) if isinstance(value, tuple) else value
        for key, value in target.items()
    }


@settings(max_examples=150 if is_long() else 50, deadline=None)
@given(TARGETS, st.lists(NUMBERS, min_size=1, max_size=4))
def test_any_target_and_trajectory_is_accepted_or_changes_nothing(
    armed: Lab, said: dict[str, Any], times: list[Any]
) -> None:
    message = json_of(said)
    targets = made(
        lambda: Target(**said),
        lambda: Target.model_construct(**said),
        lambda: (
            trajectory_of({"waypoints": [{"time_s": 0.0, "target": message}]}).waypoints[0].target
        ),
    )
    for target in targets:
        ask(armed, lambda target=target: armed.loop.set_target(target))
    trajectories = made(
        lambda: trajectory_of({"waypoints": [{"time_s": t, "target": message} for t in times]}),
        *(
            lambda target=target: Trajectory.model_construct(
                waypoints=tuple(Waypoint.model_construct(time=t, target=target) for t in times)
            )
            for target in targets
        ),
    )
    for trajectory in trajectories:
        ask(armed, lambda trajectory=trajectory: armed.loop.follow_trajectory(trajectory))


@settings(max_examples=150 if is_long() else 50, deadline=None)
@given(TARGETS, GOALS, THREE, BOUNDS, BOUNDS)
def test_any_task_is_accepted_or_changes_nothing(
    armed: Lab, said: dict[str, Any], goal: Any, force: Any, low: Any, high: Any
) -> None:
    tasks = made(
        lambda: Task(
            robot=ROBOT,
            target=Target(**said),
            stiffness=goal,
            load=Load(force=force),
            pressure=PressureRange(min=low, max=high),
        ),
        lambda: Task.model_construct(
            robot=ROBOT,
            target=Target.model_construct(**said),
            stiffness=goal,
            load=Load.model_construct(force=force),
            pressure=PressureRange.model_construct(min=low, max=high),
        ),
        lambda: TASK.model_copy(
            update={"pressure": PressureRange.model_construct(min=low, max=high)}
        ),
        lambda: task_of(
            {
                "target": json_of(said),
                "load": {"force_n": list(force) if isinstance(force, tuple) else force},
                "pressure": {
                    "min_pa": list(low) if isinstance(low, tuple) else low,
                    "max_pa": list(high) if isinstance(high, tuple) else high,
                },
            },
            ROBOT,
        ),
    )
    for task in tasks:
        ask(armed, lambda task=task: armed.loop.set_task(task))


@pytest.mark.parametrize("junk", [None, 1, "task", [], {}, object(), TASK.target, TASK, TASK.load])
def test_junk_is_refused(junk: Any, armed: Lab) -> None:
    loop = armed.loop
    for request, kind in (
        (loop.set_task, Task),
        (loop.set_target, Target),
        (loop.follow_trajectory, Trajectory),
        (loop.hold, str),
    ):
        if not isinstance(junk, kind):
            assert not ask(armed, lambda request=request: request(junk))


@pytest.mark.parametrize(
    ("request_for", "given_"),
    [
        ("set_task", TASK),
        ("set_target", TASK.target),
        ("follow_trajectory", Trajectory(waypoints=(Waypoint(time=1.0, target=TASK.target),))),
    ],
)
def test_an_accident_while_a_request_is_checked_is_a_refusal(
    request_for: str, given_: Any, armed: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(checks, "validated", fail)
    with pytest.raises(CommandError, match="nothing has changed: unexpected ZeroDivisionError"):
        getattr(armed.loop, request_for)(given_)
    assert not ask(armed, lambda: getattr(armed.loop, request_for)(given_))


@pytest.mark.parametrize("state", ["unconfigured", "inactive"])
def test_an_accident_while_it_is_armed_or_configured_is_a_refusal(state: str) -> None:
    lab = Lab(ready=False)
    if state == "inactive":
        lab.loop.configure()
        lab.ticks(60)

    def fail(name: str) -> None:
        if name == "check":
            raise ZeroDivisionError("oh")

    lab.controller.accident = fail
    request = lab.loop.arm if state == "inactive" else lab.loop.configure
    with pytest.raises(CommandError, match="nothing has changed: unexpected ZeroDivisionError"):
        request()
    assert lab.state == state
    lab.controller.accident = lambda name: None
    request()


def test_what_goes_wrong_when_a_task_is_pursued_already_is_a_fault() -> None:
    lab = Lab().under_pressure()
    lab.loop.hold()

    def fail(name: str) -> None:
        if name == "resume":
            raise InputError("oh")

    lab.controller.accident = fail
    with pytest.raises(CommandError, match="unexpected InputError: oh"):
        lab.loop.set_task(TASK)
    assert lab.state is State.FAULT
    assert lab.is_vented()


class Turning(StiffnessMeasure):
    """Fails when it is looked at, as a mistake in the code would."""

    @property
    def unit(self) -> Any:
        raise ZeroDivisionError("oh")


@pytest.fixture(scope="module")
def controller() -> TipController:
    description = load_description(ROBOT)
    n = description.n_pressures
    limits = PressureLimits(np.zeros(n), np.full(n, 1.5e5))
    return TipController(Manipulator(description), limits, 2e5, period=0.01)


def held(controller: TipController) -> list[Any]:
    """Return all that a request may change."""
    replanner = controller.replanner
    named = ("_serial", "_requested_at", "_search", "pursuit")
    inside = [getattr(replanner, name) for name in named]
    parts = [vars(replanner.pursuit)[name] for name in ("task", "target", "course", "unit")]
    prescribed = replanner.pursuit.prescribed.tolist()
    return [*inside, *parts, prescribed, controller._permitted[1].tolist()]


def test_a_controller_that_refuses_is_as_before(controller: TipController) -> None:
    controller.set_task(TASK)
    before = held(controller)
    turning = Turning(direction=(1.0, 0.0, 0.0))
    goal = StiffnessGoal.model_construct(maximise=(turning,), at_least=(), match=None)
    low = TASK.model_copy(update={"pressure": PressureRange(min=2e5)})
    for task in (TASK.model_copy(update={"stiffness": goal}), low, None):
        with pytest.raises(InputError):
            controller.set_task(task)  # type: ignore[arg-type]
        assert held(controller) == before
    for trajectory in (apart(0.0, 1e308), apart(1e-320), apart(2.0, 1.0), apart(None), None):
        with pytest.raises(InputError):
            controller.follow(trajectory, 0.0)  # type: ignore[arg-type]
        assert held(controller) == before
    for target in (None, Target.model_construct(position="abc"), TASK):
        with pytest.raises(InputError):
            controller.set_target(target)  # type: ignore[arg-type]
        assert held(controller) == before


# Limits of the pressures -------------------------------------------------------------------------

LIMITS = PressureLimits(np.array([-2e4, 0.0, 1e4]), np.array([1.5e5, 1.2e5, 1.0e5]))


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (None, 2e5, "pressure.max: 2 bar is beyond the limits of channel 1, -0.2 to 1.5 bar"),
        (None, (None, 1.3e5, None), "pressure.max: 1.3 bar is beyond the limits of channel 2"),
        (None, (None, None, 5e3), "pressure.max: 0.05 bar is beyond the limits of channel 3"),
        (None, (None, None, 0.0), "pressure.max: 0 bar is beyond the limits of channel 3"),
        ((-3e4, None, None), None, "pressure.min: -0.3 bar is beyond the limits of channel 1"),
        ((None, None, 1.1e5), None, "pressure.min: 1.1 bar is beyond the limits of channel 3"),
        ((None, None, 0.0), None, "pressure.min: 0 bar is beyond the limits of channel 3"),
        ((5e4, None, None), (4e4, None, None), "channel 1 is left no pressure: its min is 0.5 bar"),
        (2e4, (None, 1e4, None), "channel 2 is left no pressure"),
        (None, (1e5, 1e5), "pressure.max: expected one value or a list of 3, not 2"),
        ((1e4,), None, "pressure.min: expected one value or a list of 3, not 1"),
        (None, float("inf"), "pressure.max: inf bar is beyond"),
    ],
)
def test_limits_beyond_those_of_the_rig_are_refused(low: Any, high: Any, words: str) -> None:
    with pytest.raises(InputError) as caught:
        limited_range(PressureRange.model_construct(min=low, max=high), LIMITS)
    assert words in str(caught.value)


def test_limits_are_tightened_and_rounding_is_no_mistake() -> None:
    found = limited_range(PressureRange(max=(None, 5e4, None), min=(1e4, None, None)), LIMITS)
    assert found == PressureRange(min=(1e4, 0.0, 1e4), max=(1.5e5, 5e4, 1.0e5))
    off = 0.9 * LIMITS.slack
    rounded = PressureRange(
        min=tuple((LIMITS.low - off).tolist()), max=tuple((LIMITS.high + off).tolist())
    )
    assert limited_range(rounded, LIMITS) == limited_range(PressureRange(), LIMITS)
    LIMITS.check(LIMITS.high + off)  # a command has the same slack
    for sign in (-1, 1):
        values = (LIMITS.low if sign < 0 else LIMITS.high) + sign * 1.1 * LIMITS.slack
        with pytest.raises(CommandError):
            LIMITS.check(values)
        with pytest.raises(InputError):
            limited_range(PressureRange(min=tuple(values.tolist())), LIMITS)
        with pytest.raises(InputError):
            limited_range(PressureRange(max=tuple(values.tolist())), LIMITS)


def test_a_controller_takes_a_task_at_the_limits_but_for_rounding(
    controller: TipController,
) -> None:
    off = 0.1  # Pa
    asked = PressureRange(min=-off, max=1.5e5 + off)
    controller.set_task(TASK.model_copy(update={"pressure": asked}))
    np.testing.assert_array_equal(controller._permitted[1], 1.5e5)
    np.testing.assert_array_equal(controller._permitted[0], 0.0)
    above = PressureRange(min=1.5e5 + off)
    controller.set_task(TASK.model_copy(update={"pressure": above}))
    np.testing.assert_array_equal(controller._permitted[0], 1.5e5)
