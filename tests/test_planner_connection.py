"""The connection to the planner's process: all that is sent arrives, and only once."""

from __future__ import annotations

import math
import os
import pickle
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import stiffopt as so
from stiffopt.control import planner as planner_module
from stiffopt.control.adaptation import Learning, Window
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.planner import PlannerEnd, PlanningEnd, ProcessPlanner
from stiffopt.control.tuning import AdaptationTuning
from stiffopt.control.vibration import BentMode
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

ROBOT = "stiff-flop-1"
OFFSET = np.array([1e-3, -2e-3, 0.1 + 0.2, -0.0, 5e-324, 1 / 3])
BESIDE = np.array([1e3, -2e3, 0.1])


def task(x: float = 0.01) -> Task:
    goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0)))
    return Task(robot=ROBOT, target=Target(position=(x, 0.0, None)), stiffness=goal)


class Ends:
    def __init__(self) -> None:
        one, other = socket.socketpair()
        self.ours, self.theirs = PlannerEnd(one.detach()), PlanningEnd(other.detach())

    def passes(self, request: PlanRequest) -> PlanRequest:
        self.ours.send(request)
        return self.theirs.request()

    def close(self) -> None:
        self.ours.connection.close()
        self.theirs.connection.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    ends = Ends()
    yield ends
    ends.close()


def assert_same(one: PlanRequest, other: PlanRequest) -> None:
    assert (one.serial, one.task, one.target, one.search, one.stay) == (
        other.serial, other.task, other.target, other.search, other.stay,
    )  # fmt: skip
    assert one.offset.dtype == other.offset.dtype == np.float64
    assert one.offset.tobytes() == other.offset.tobytes()
    assert one.pressure_offset.tobytes() == other.pressure_offset.tobytes()
    assert (one.low.tolist(), one.high.tolist()) == (other.low.tolist(), other.high.tolist())
    assert one.here.tolist() == other.here.tolist()


def test_requests_arrive_as_they_were_whatever_changes(ends: Ends) -> None:
    first, second = task(), task(0.02)
    asked = PlanRequest(1, first, first.target, OFFSET, BESIDE)
    elsewhere: dict[str, Any] = {"target": Target(pointing=(0.0, 0.0, 1.0))}
    for changes in (
        {},
        {},
        {"search": True},
        {"offset": 2 * OFFSET},
        {"pressure_offset": 2 * BESIDE},
        {"low": BESIDE, "high": 3 * BESIDE},
        {"here": BESIDE},
        {"search": False},
        {"stay": True},
        elsewhere,
        {"serial": 2, "task": second},
        {"task": first},  # under the same number
        {"target": None},  # nothing that anyone asks
        {"serial": 10**12, "target": first.target},
    ):
        asked = replace(asked, **changes)
        assert_same(ends.passes(asked), asked)


def test_an_offset_that_was_changed_in_place_is_sent(ends: Ends) -> None:
    the_task, offset = task(), OFFSET.copy()
    asked = PlanRequest(1, the_task, the_task.target, offset, BESIDE)
    ends.passes(asked)
    offset += 1.0
    assert ends.passes(asked).offset.tolist() == (OFFSET + 1.0).tolist()


def test_a_task_is_sent_once_and_again_on_a_new_line(ends: Ends) -> None:
    the_task = task()
    first = PlanRequest(1, the_task, the_task.target, OFFSET, BESIDE)
    sent: list[bytes] = []

    def news(line: PlannerEnd, request: PlanRequest) -> set[str]:
        send = line.connection.send_bytes
        line.connection.send_bytes = lambda data: (sent.append(data), send(data))  # type: ignore[method-assign, assignment, func-returns-value]
        line.send(request)
        del line.connection.send_bytes
        return set(pickle.loads(sent.pop()))

    arrays = {"offset", "pressure_offset", "low", "high", "way", "here"}
    objects = {"serial", "task", "target", "search", "stay", "last", "windows", "adapted"}
    everything = objects | arrays
    assert news(ends.ours, first) == everything
    assert news(ends.ours, replace(first, offset=0 * OFFSET)) == arrays
    other = Ends()
    assert news(other.ours, first) == everything
    other.close()


def test_plans_arrive_as_they_were(ends: Ends) -> None:
    the_task = task()
    request = PlanRequest(4, the_task, the_task.target, OFFSET, BESIDE)
    for reached, stiffness, message in ((True, 123.4, ""), (False, math.nan, "it is far")):
        known = ends.passes(request)
        pressures = np.array([1e5 / 3, 0.0, -0.0])
        bent = BentMode(np.ones((3, 3)), np.full((3, 3), 2.0), np.eye(3)) if reached else None
        plan = Plan(
            4, pressures, known.offset, known.target, reached, stiffness, message, bent=bent,
            short=(0.0, 0.1 / 3, -1e-3),
        )  # fmt: skip
        ends.theirs.answer(plan)
        found = ends.ours.receive()
        assert isinstance(found, Plan)
        assert found.pressures.tobytes() == pressures.tobytes()
        assert found.offset.tobytes() == OFFSET.tobytes()
        assert found.target is request.target
        assert (found.serial, found.reached, found.message) == (4, reached, message)
        assert found.stiffness == pytest.approx(stiffness, abs=0, nan_ok=True)
        assert found.short == plan.short
        if bent is None or found.bent is None:
            assert found.bent is bent
        else:
            assert found.bent.jacobian.tolist() == bent.jacobian.tolist()
            assert found.bent.linear.tolist() == bent.linear.tolist()
            assert found.bent.plane.tolist() == bent.plane.tolist()


def test_it_says_whether_there_is_an_answer() -> None:
    ends = Ends()
    assert not ends.ours.has_answer()
    ends.theirs.answer(None)
    ends.theirs.answer("no luck")
    assert ends.ours.has_answer()
    assert ends.ours.receive() is None
    assert ends.ours.has_answer()
    assert ends.ours.receive() == "no luck"
    assert not ends.ours.has_answer()
    ends.theirs.connection.close()
    assert ends.ours.has_answer()
    with pytest.raises((EOFError, ConnectionError)):
        ends.ours.receive()
    with pytest.raises(OSError, match=r"."):
        ends.ours.send(PlanRequest(1, task(), task().target, OFFSET, BESIDE))
    ends.ours.connection.close()


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="the system has no SCHED_BATCH")
@pytest.mark.parametrize("real_time", [False, True])
def test_the_process_yields_whoever_starts_it(real_time: bool) -> None:
    robot = so.load_robot(ROBOT)
    policies: list[int] = []

    def start() -> None:
        if real_time:
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            except PermissionError:
                return
        planner = ProcessPlanner(robot)
        policies.append(os.sched_getscheduler(planner._process.pid))
        planner.close()

    thread = threading.Thread(target=start)  # its policy ends with it
    thread.start()
    thread.join(60)
    if not policies:
        pytest.skip("real-time priorities are not permitted")
    assert policies == [os.SCHED_BATCH]


def test_a_system_that_cannot_be_told_to_yield_is_no_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    planner_module._set_batch_policy(os.getpid())
    monkeypatch.delattr(os, "sched_setscheduler")
    planner_module._set_batch_policy(os.getpid())


def test_windows_and_what_is_learned_from_them_arrive(ends: Ends) -> None:
    """And both sides then speak of the same arm, which a later request does not send again."""
    the_task, robot = task(), so.load_robot(ROBOT)
    pose = robot.tip_pose(np.array([0.3e5, 0.2e5, 0.0]))
    seen = Window(1.0, np.array([0.3e5, 0.2e5, 0.0]), 1.05 * pose[:3, 3], None)
    asked = PlanRequest(1, the_task, the_task.target, OFFSET, BESIDE, windows=(seen,))
    got = ends.passes(asked)
    assert got.windows[0].position.tolist() == seen.position.tolist()
    learning = Learning(robot.description, AdaptationTuning(least_step=1e-6))
    estimate = learning.estimate(got.windows, got.adapted)
    assert estimate is not None
    ends.theirs.answer(
        Plan(1, BESIDE, got.offset, got.target, True, 1.0, "", deviation=0.1, estimate=estimate)
    )
    plan = ends.ours.receive()
    assert isinstance(plan, Plan)
    assert plan.deviation == 0.1
    assert plan.adapted is asked.adapted is None
    assert plan.estimate is not None
    assert plan.estimate.numbers == estimate.numbers
    proposal = plan.estimate.proposal
    assert proposal is not None
    assert estimate.proposal is not None
    assert proposal.applied.tolist() == estimate.proposal.applied.tolist()
    there = ends.passes(replace(asked, adapted=proposal))
    assert there.adapted is not None
    assert there.adapted.description == proposal.description
    again = learning.estimate(there.windows, there.adapted)
    assert again is not None
    assert again.proposal is None  # it is there already
    assert ends.passes(replace(asked, adapted=proposal)).adapted is there.adapted
    assert learning.estimate(there.windows, there.adapted) is None
