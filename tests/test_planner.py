"""The re-planner: targets moved back, the same plans in a process, and what outlives its death."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import stiffopt as so
from running import wait_for
from stiffopt.control.plan import PlanRequest
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.planning import Planning, model_target
from stiffopt.control.vibration import BentMode
from stiffopt.errors import StiffoptError
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task

ROBOT = "stiff-flop-1"
BAR = 1e5
PRESSURES = np.array([0.9, 0.4, 0.2]) * BAR


@pytest.fixture(scope="module")
def robot():
    return so.load_robot(ROBOT)


def tip(robot, p=PRESSURES):
    pose = robot.tip_pose(p)
    return pose[:3, :3], pose[:3, 3]


def request(robot, serial=1, offset=(0,) * 6, p=PRESSURES, **changes):
    _, position = tip(robot, p)
    target = Target(position=(float(position[0]), float(position[1]), None))
    goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0)))
    task = Task(robot=ROBOT, target=target, stiffness=goal)
    changes.setdefault("pressure_offset", np.zeros(3))
    return PlanRequest(serial, task, target, np.array(offset, dtype=float), **changes)


@pytest.fixture
def in_process(robot):
    planners = []

    def make(**options):
        planners.append(ProcessPlanner(robot, **options))
        return planners[-1]

    yield make
    for planner in planners:
        planner.close()


# -- moved back -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_offset_put_on_what_the_model_reaches_is_the_target(seed):
    rng = np.random.default_rng(seed)
    offset = np.concatenate([rng.normal(size=3) * 5e-3, rng.normal(size=3) * 0.3])
    turn = Rotation.from_rotvec(offset[3:])
    aim = Rotation.random(random_state=seed)
    x, y, z, w = aim.as_quat(canonical=True)
    position = rng.normal(size=3) * 0.1

    target = Target(position=tuple(position), orientation=(w, x, y, z))
    model = model_target(target, offset)
    assert np.array(model.position) + offset[:3] == pytest.approx(position, abs=1e-15)
    w, x, y, z = model.orientation
    assert w >= 0
    arm = turn * Rotation.from_quat([x, y, z, w])
    assert (arm * aim.inv()).magnitude() < 1e-12

    pointing = aim.as_matrix()[:, 2]
    model = model_target(Target(pointing=tuple(pointing)), offset)
    assert model.position is None
    assert turn.apply(model.pointing) == pytest.approx(pointing, abs=1e-12)
    assert np.linalg.norm(model.pointing) == pytest.approx(1.0, abs=1e-12)


def test_free_axes_stay_free_and_nothing_is_changed_in_place():
    target = Target(position=(0.01, None, 0.1))
    model = model_target(target, np.array([1e-3, 2e-3, 3e-3, 0, 0, 0]))
    assert model.position == pytest.approx((0.009, None, 0.097))
    assert target.position == (0.01, None, 0.1)


def test_model_is_asked_to_be_exact():
    target = Target(position=(0, 0, 0.1), tolerance={"position": "5 mm", "angle": "10 deg"})
    assert model_target(target, np.zeros(6)).tolerance.position <= 1e-5


# -- plans ------------------------------------------------------------------------------------


def test_plan_puts_the_arm_on_the_target(robot):
    offset = np.array([2e-3, -1e-3, 0.5e-3, 0, 0, 0])
    asked = request(robot, offset=offset)
    plan = Planning(robot).plan(asked)
    assert plan.reached
    assert plan.message == ""
    assert plan.serial == asked.serial
    assert np.array_equal(plan.offset, offset)
    _, position = tip(robot, plan.pressures)
    assert (position + offset[:3])[:2] == pytest.approx(asked.target.position[:2], abs=2e-5)
    assert np.all((plan.pressures >= 0) & (plan.pressures <= 1.5 * BAR))
    compliance, R = robot.tip_compliance(plan.pressures), tip(robot, plan.pressures)[0]
    d = R.T @ np.array([1.0, 0, 0])
    assert plan.stiffness == pytest.approx(1 / (d @ compliance[:3, :3] @ d), rel=1e-6)


def test_small_changes_of_the_offset_change_the_plan_little(robot):
    planning = Planning(robot)
    first = planning.plan(request(robot))
    for k in range(1, 6):
        again = planning.plan(request(robot, offset=[2e-4 * k, 0, 0, 0, 0, 0]))
        assert again.reached
        assert np.abs(again.pressures - first.pressures).max() < 0.05 * BAR * k


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("off", [-0.4, 0.2])
def test_plans_leave_room_for_the_pressure_offset_within_the_limits(off):
    """Of an arm that creeps, say: what acts is not what is commanded, and only that has limits."""
    arm = so.load_robot("stiff-flop-2-hanging")
    position = arm.tip_pose(0.5 * arm.pressure_max)[:3, 3]
    goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0)))
    task = Task(
        robot="stiff-flop-2-hanging", target=Target(position=tuple(position)), stiffness=goal
    )
    free = Planning(arm).plan(PlanRequest(1, task, task.target, np.zeros(6), np.zeros(6)))
    offset = np.full(6, off * BAR)
    planning = Planning(arm)
    plan = planning.plan(PlanRequest(1, task, task.target, np.zeros(6), offset))
    command = plan.pressures - offset
    assert plan.reached
    assert np.all(command >= arm.pressure_min - 1)
    assert np.all(command <= arm.pressure_max + 1)
    assert np.all(plan.pressures >= arm.pressure_min - 1)
    assert np.all(plan.pressures <= arm.pressure_max + 1)
    # the stiffest within these limits, by a solver that was made for them
    lower = np.maximum(arm.pressure_min, arm.pressure_min + offset)
    upper = np.minimum(arm.pressure_max, arm.pressure_max + offset)
    tighter = task.model_copy(
        update={"pressure": PressureRange(min=tuple(lower), max=tuple(upper))}
    )
    own = so.PressureSolver(arm, tighter).solve()
    assert plan.stiffness == pytest.approx(own.stiffness, rel=5e-3)
    assert plan.stiffness < free.stiffness * (1 - 1e-3)
    # and next to the plan before, as in the loop
    again = planning.plan(PlanRequest(1, task, task.target, np.zeros(6), 1.1 * offset))
    assert np.all(again.pressures - 1.1 * offset <= arm.pressure_max + 1)
    assert np.all(again.pressures - 1.1 * offset >= arm.pressure_min - 1)


def test_the_modes_come_with_a_plan_if_the_arm_is_elsewhere(robot):
    """They are sent once: after 30 mbar, for a new task, and for another model."""
    planning, here = Planning(robot), PRESSURES

    def modes(pressures, serial=1):
        return planning.plan(request(robot, serial, here=pressures)).bent

    assert planning.plan(request(robot)).bent is None
    found, own = modes(here), BentMode.of(robot, here)
    assert found.jacobian == pytest.approx(own.jacobian, rel=1e-6, abs=1e-12)
    assert modes(here + 0.02 * BAR) is None
    assert modes(here + 0.04 * BAR) is not None
    assert modes(here + 0.05 * BAR) is None
    assert modes(here + 0.05 * BAR, serial=2) is not None
    beyond = modes(np.full(3, 100 * BAR), serial=2)  # what acts may be beyond the limits
    limit = BentMode.of(robot, np.array(robot.description.pressure_max))
    assert beyond.jacobian == pytest.approx(limit.jacobian, rel=1e-6, abs=1e-12)


def test_a_plan_that_stays_changes_the_pressures_least(robot):
    """Against a solver that knows nothing of it; the stiffest pressures are elsewhere."""
    planning, first = Planning(robot), request(robot)
    before = replace(planning.plan(first), pressures=PRESSURES)
    offset = np.array([-4e-3, 3e-3, 0, 0, 0, 0])
    moved = replace(first, offset=offset, stay=True, last=before)
    plan = planning.plan(moved)
    _, start = tip(robot, before.pressures)
    wanted = start[:2] - offset[:2]
    scale = 1e5
    least = minimize(
        lambda x: ((x - before.pressures / scale) ** 2).sum(), before.pressures / scale,
        constraints={"type": "eq", "fun": lambda x: 1e3 * (tip(robot, x * scale)[1][:2] - wanted)},
        bounds=[(0, 1.5)] * 3, method="SLSQP", options={"ftol": 1e-12},
    )  # fmt: skip
    assert plan.reached
    here = robot.stiffness(plan.pressures, direction=[1, 0, 0])
    assert plan.stiffness == pytest.approx(here, rel=1e-3)
    np.testing.assert_allclose(tip(robot, plan.pressures)[1][:2], wanted, atol=2e-5)
    np.testing.assert_allclose(plan.pressures, least.x * scale, atol=2e3)
    stiffest = planning.plan(replace(moved, stay=False, last=None))
    assert np.abs(stiffest.pressures - plan.pressures).max() > 1e4
    far = first.target.model_copy(update={"position": (0.2, 0.0, None)})
    assert not planning.plan(replace(moved, target=far)).reached


def test_a_plan_in_small_steps_stays_near_the_last_one(robot):
    planning, first = Planning(robot), request(robot)
    stiffest = planning.plan(first)
    before = replace(stiffest, pressures=PRESSURES)
    assert np.abs(stiffest.pressures - PRESSURES).max() > 1e4
    for _ in range(40):
        plan = planning.plan(replace(first, search=False, step=5e3, last=before))
        assert np.abs(plan.pressures - before.pressures).max() <= 5e3 + 1.0
        before = plan
    np.testing.assert_allclose(plan.pressures, stiffest.pressures, atol=100.0)


def test_target_that_cannot_be_reached_has_a_plan_that_says_why(robot):
    asked = request(robot)
    far = asked.target.model_copy(update={"position": (0.2, 0.0, None)})
    plan = Planning(robot).plan(PlanRequest(1, asked.task, far, np.zeros(6), np.zeros(3)))
    assert not plan.reached
    assert "away" in plan.message
    assert np.isfinite(plan.pressures).all()
    assert np.all((plan.pressures >= -1e-6) & (plan.pressures <= 1.5 * BAR + 1e-6))
    # nearest along the way out
    _, position = tip(robot, plan.pressures)
    edge = max(tip(robot, np.array(p) * BAR)[1][0] for p in [(1.5, 0, 0), (0, 1.5, 1.5)])
    assert position[0] > edge - 3e-3


def test_inline_and_process_have_the_same_plan(robot, in_process):
    inline, process = InlinePlanner(robot), in_process()
    assert inline.latest() is None
    assert process.latest() is None
    for serial in (1, 2):
        p = PRESSURES * (1 - 0.3 * (serial - 1))
        asked = request(robot, serial, p=p, here=np.full(3, 0.3 * BAR))
        inline.request(asked)
        process.request(asked)
        wait_for(lambda s=serial: process.latest() is not None and process.latest().serial == s)
        one, other = inline.latest(), process.latest()
        assert one.pressures == pytest.approx(other.pressures, abs=1.0)
        assert one.stiffness == pytest.approx(other.stiffness, rel=1e-9)
        assert one.tip_first == pytest.approx(other.tip_first, abs=1.0)
        assert len(one.tip_first) == 3
    assert inline.notices() == process.notices() == ()
    inline.close()


def ready(planner):
    """Whether the process is up and has nothing to do."""
    planner.latest()
    return planner._busy_since is None


def test_asking_does_not_wait_and_the_newest_counts(robot, in_process):
    planner = in_process()
    wait_for(lambda: ready(planner))
    os.kill(planner._process.pid, signal.SIGSTOP)
    start = time.monotonic()
    planner.request(request(robot, 1))
    planner.request(request(robot, 2, search=True))
    planner.request(request(robot, 2))
    assert time.monotonic() - start < 10
    assert planner.latest() is None
    assert planner._waiting.search  # not lost with the request that was replaced
    os.kill(planner._process.pid, signal.SIGCONT)
    wait_for(lambda: planner.latest() is not None and planner.latest().serial == 2)


def test_slow_planner_is_an_alarm_until_it_answers(robot, in_process):
    planner = in_process(patience=0.01)
    planner.request(request(robot))
    wait_for(lambda: planner.latest() is not None)
    os.kill(planner._process.pid, signal.SIGSTOP)
    planner.request(request(robot, p=0.9 * PRESSURES))
    wait_for(planner.notices)
    (notice,) = planner.notices()
    assert notice.standing
    assert "slow" in notice.text
    os.kill(planner._process.pid, signal.SIGCONT)
    wait_for(lambda: ready(planner))
    assert planner.notices() == ()


def test_an_answer_that_nobody_takes_does_not_seem_late(robot, in_process):
    """While pressures are held, no plans are asked for."""
    planner = in_process(patience=0.0)
    wait_for(lambda: ready(planner))
    planner.request(request(robot))
    wait_for(planner._end.has_answer)
    assert planner.notices() == ()


def test_a_new_task_that_takes_its_time_is_said_to_do_so(robot, in_process):
    """Nothing is wrong, but the arm does not move, and somebody waits."""
    planner = in_process()
    wait_for(lambda: ready(planner))
    os.kill(planner._process.pid, signal.SIGSTOP)
    planner.request(request(robot))
    assert planner.notices() == ()
    wait_for(planner.notices)
    (notice,) = planner.notices()
    assert notice.kind == "preparing"
    assert notice.standing
    assert "compiled" in notice.text
    os.kill(planner._process.pid, signal.SIGCONT)
    wait_for(lambda: planner.latest() is not None)
    assert planner.notices() == ()


# -- failures ---------------------------------------------------------------------------------


def failing(monkeypatch, error):
    plan = Planning.plan

    def fail(self, asked):
        if asked.serial == 13:
            raise error
        return plan(self, asked)

    monkeypatch.setattr(Planning, "plan", fail)


def test_inline_failure_keeps_the_plan_and_says_so(robot, monkeypatch):
    failing(monkeypatch, StiffoptError("no luck"))
    planner = InlinePlanner(robot)
    planner.request(request(robot, 1))
    before = planner.latest()
    planner.request(request(robot, 13))
    assert planner.latest() is before
    (notice,) = planner.notices()
    assert notice.kind == "planner"
    assert notice.standing
    assert "no luck" in notice.text
    planner.request(request(robot, 14))
    assert planner.latest().serial == 14
    assert planner.notices() == ()


def test_a_failure_keeps_the_plan_and_the_next_request_is_answered(robot, in_process):
    planner = in_process()
    planner.request(request(robot, 1))
    wait_for(lambda: planner.latest() is not None)
    before = planner.latest()
    planner.request(replace(request(robot, 13), target=None))  # nothing that anyone asks
    wait_for(lambda: planner.latest() is before and planner.notices())
    (notice,) = planner.notices()
    assert (notice.kind, notice.standing) == ("planner", True)
    assert "failed" in notice.text
    planner.request(request(robot, 14))
    wait_for(lambda: planner.latest().serial == 14)
    assert planner.notices() == ()


def test_26_planner_that_dies_keeps_the_plan_and_is_started_again(robot, in_process):
    planner = in_process()
    planner.request(request(robot, 1))
    wait_for(lambda: planner.latest() is not None)
    before, process = planner.latest(), planner._process
    process.kill()
    process.wait()

    def told():
        planner.request(request(robot, 13))
        return planner.notices()

    wait_for(told)
    assert planner.latest() is before
    (notice,) = planner.notices()
    assert (notice.kind, notice.standing) == ("planner", True)
    assert "died" in notice.text

    def recovered():
        planner.request(request(robot, 14))
        return planner.latest().serial == 14

    wait_for(recovered)
    assert planner.notices() == ()
    assert planner._process is not process
    assert planner.latest().pressures == pytest.approx(before.pressures, abs=0.02 * BAR)


def test_close_ends_the_process_and_asking_after_that_does_nothing(robot):
    planner = ProcessPlanner(robot)
    planner.close()
    assert planner._process.poll() is not None
    planner.request(request(robot))
    assert planner._process.poll() is not None
    assert planner.latest() is None
    planner.close()
