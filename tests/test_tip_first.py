"""The tip goes to its target first, then the arm becomes stiff: speed, corrections, the way."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stiffopt.control.correction_bound import CorrectionBound
from stiffopt.control.plan import Plan
from stiffopt.control.planning import Planning
from stiffopt.control.pressing import Phase
from stiffopt.control.replanning import Pursuit, Replanner
from stiffopt.control.tuning import ControlTuning, CorrectionTuning, ReplanningTuning
from stiffopt.control.way_to_target import WayToTarget
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.press import Press
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.plant.settings import PlantLoad
from test_controller import BAR, HANGING, Bench, moving

pytestmark = pytest.mark.usefixtures("compiled")


def test_the_tip_takes_its_time_to_a_new_target():
    """Half a period of the vibration; what follows is not bounded."""
    bench = moving(rested=3.0, moved=0.0)
    controller = bench.controller
    reference, goals, shares = controller._reference, [], []
    begin = reference.goal[: bench.n]
    for _ in range(round(1.0 / bench.period)):
        bench.run(bench.period)
        goals.append(reference.goal[: bench.n])
        shares.append(np.min(reference.slew_share))
    first = np.array(controller.replanner.plan.tip_first)
    way = (np.abs(first - begin) / bench.slew).max()
    gone = (np.abs(np.array(goals) - begin) / bench.slew).max(axis=1)
    half = np.pi / controller._arm.tip.omega
    assert way < 0.5 * half
    assert bench.period * np.argmax(gone > 0.95 * way) == pytest.approx(0.95 * half, rel=0.15)
    assert shares[0] < 0.5
    assert shares[-1] == 0.9


def test_the_tip_stays_while_the_arm_becomes_stiff_in_another_direction():
    """Also if it is held for a while and goes on."""
    bench = Bench(HANGING, "full")
    position = bench.settled(duration=4.0)
    task, before = bench.task(position=position), bench.command
    axial = StiffnessGoal(maximise=StiffnessMeasure(direction=(0.0, 0.0, 1.0)))
    bench.controller.set_task(task.model_copy(update={"stiffness": axial}))
    errors = [bench.run(1.0, position), bench.run(0.3, position, steer=False)]
    assert bench.controller.replanner.plan.tip_first
    bench.controller.resume(bench.rig.clock.now())
    errors.append(bench.run(8.0, position))
    assert np.concatenate(errors).max() < 1.5e-3
    assert np.abs(bench.command - before).max() > 0.3 * BAR
    assert not bench.controller.replanner.plan.tip_first
    standing = bench.controller.status(bench.rig.clock.now())
    assert standing.stiffness == pytest.approx(standing.best_stiffness, rel=0.05)


def test_no_channel_moves_the_tip_faster_than_is_noticed():
    """On the way to a target: three seconds for 0.24 m by one channel, half a period for less."""
    slew, times = np.full(2, 1e6), []
    for metres_per_pascal, demands in ((2.4e-6, False), (2.4e-6, True), (1e-8, False)):
        jacobian = np.zeros((6, 2))
        jacobian[0] = metres_per_pascal, metres_per_pascal / 2
        arm = SimpleNamespace(
            on_path=lambda path, J=jacobian: SimpleNamespace(jacobian=J),
            tip=SimpleNamespace(omega=2 * np.pi),
        )
        way = WayToTarget(SimpleNamespace(tuning=ControlTuning(), slew=slew), arm)
        plan = SimpleNamespace(tip_first=(1e5, 5e4), pressures=np.array([1e5, 5e4]))
        reference = SimpleNamespace(path=np.zeros(8), goal=np.zeros(8))
        times.append(0.1 / way.slew_share(plan, reference, demands=demands))
        reference.path = np.full(8, 2e5)
        assert way.slew_share(plan, reference, demands=demands) == math.inf
    assert times == pytest.approx([3.0, 4.8, 0.5])


def test_corrections_are_bounded_by_the_latest_motion_and_released_slowly():
    bound = CorrectionBound(CorrectionTuning(), 0.01, vibrates=True)
    bound.take(np.zeros(3), applies=False)
    assert bound.largest == math.inf
    bound.take(np.zeros(3), applies=True)
    assert bound.largest == 3e-3
    bound.take(np.array([0.005, 0.0, 0.0]), applies=True)
    assert bound.largest == pytest.approx(4e-3)
    bound.take(np.array([0.025, 0.0, 0.0]), applies=True)
    assert bound.largest == pytest.approx(5e-3)
    bound.take(np.array([0.09, 0.0, 0.0]), applies=True)
    assert bound.largest == pytest.approx(15e-3, rel=0.03)
    for _ in range(100):
        bound.take(np.array([0.09, 0.0, 0.0]), applies=True)
    assert bound.largest == pytest.approx(9.6e-3, rel=0.03)  # 0.37 of the motion is left
    for _ in range(600):
        bound.take(np.array([0.09, 0.0, 0.0]), applies=True)
    assert bound.largest == pytest.approx(3e-3, rel=0.03)
    for _ in range(100):
        bound.take(np.array([0.09, 0.0, 0.0]), applies=False)
    assert bound.largest == pytest.approx(13e-3, rel=0.02)
    bound.begin()
    assert bound.largest == math.inf


def test_plans_follow_no_more_of_an_offset_than_is_permitted():
    asked = []
    planner = SimpleNamespace(request=asked.append, latest=lambda: None)
    tuning = ReplanningTuning()
    replanner = Replanner(planner, tuning, 0.01, 0.0)
    target = Target(position=(0.0, 0.0, 0.1))
    replanner.pursue(Pursuit(task=Task(robot=HANGING, target=target), target=target))
    limits = np.zeros(6), np.full(6, BAR)
    replanner.update(0.0, np.zeros(6), np.zeros(6), 10.0, 0.1, limits)
    offset = np.array([0.0, 8e-3, 0.0, 0.1, 0.0, 0.0])
    for number, most in ((1, 2e-3), (2, math.inf)):
        now = number * tuning.interval
        replanner.update(now, offset, np.zeros(6), 10.0, 0.1, limits, most=most)
    moved = np.diff([request.offset for request in asked], axis=0)
    assert not asked[1].search
    share = -math.expm1(-tuning.interval / tuning.offset_time)
    assert moved[0] == pytest.approx(share * offset / 4)
    assert moved[1] == pytest.approx(share * (offset - moved[0]))


@pytest.mark.parametrize("stiffens", [True, False])
def test_while_the_reference_waits_the_arm_becomes_no_stiffer(stiffens):
    asked = []
    planner = SimpleNamespace(request=asked.append, latest=lambda: None)
    replanner = Replanner(planner, ReplanningTuning(), 0.01, 0.0)
    targets = Target(position=(0.0, 0.0, 0.1)), Target(position=(0.02, 0.0, 0.1))
    limits = np.zeros(6), np.full(6, BAR)
    for begin, target in enumerate(targets):
        replanner.pursue(Pursuit(task=Task(robot=HANGING, target=target), target=target))
        for tick in range(50):
            now = begin + 0.01 * tick
            replanner.update(now, np.zeros(6), np.zeros(6), 10.0, 0.1, limits, waits=True)
            tip_first = (0.5,) if stiffens else ()
            plan = Plan(asked[-1].serial, limits[0], np.zeros(6), target, True, 1.0, "")
            replanner.plan = replace(plan, tip_first=tip_first)
    assert len(asked) == (2 if stiffens else 20)  # the new target is planned at once


@pytest.mark.parametrize("changes", [True, False])
def test_a_push_is_met_slowly_only_while_the_arm_becomes_stiff(changes):
    bench = Bench(HANGING, "full")
    position = bench.settled(duration=9.0)  # it is stiff
    arm, replanner = bench.controller._arm, bench.controller.replanner
    if changes:
        axial = StiffnessGoal(maximise=StiffnessMeasure(direction=(0.0, 0.0, 1.0)))
        task = bench.task(position=position)
        bench.controller.set_task(task.model_copy(update={"stiffness": axial}))
    bench.run(1.0)
    assert bool(replanner.plan.tip_first) is changes
    before = arm.at_waypoint(bench.command).pose[:3, 3]
    bench.rig.world.plant.set_load(PlantLoad(force=(0.04, 0.0, 0.0)))
    bench.run(0.6)
    way = np.linalg.norm(arm.at_waypoint(bench.command).pose[:3, 3] - before)
    assert way < 5.5e-3 if changes else way > 7e-3


def test_a_press_begins_when_the_arm_is_as_stiff_as_planned():
    """Its force is told by the stiffness that the arm has; its way takes as long as any other."""
    bench = Bench(HANGING, "full")
    position = bench.settled(duration=4.0)
    controller, axial = bench.controller, StiffnessMeasure(direction=(0.0, 0.0, 1.0))
    press = Press(force=0.03, direction=(1.0, 0.0, 0.0))
    task, goal = bench.task(position=position), StiffnessGoal(maximise=axial)
    controller.set_task(task.model_copy(update={"stiffness": goal, "press": press}))
    course, ticks = controller.replanner.pursuit.course, 0
    course._tuning = replace(course._tuning, longest_rest=0.5)  # nothing else is waited for
    while course.phase is Phase.GOING:
        bench.run(0.1)
        ticks += 1
        assert ticks < 150
    assert ticks > 20
    assert controller._way_to_target._tip_first  # its way took its time
    assert not controller.replanner.plan.tip_first
    standing = controller.status(bench.rig.clock.now())
    assert standing.stiffness == pytest.approx(standing.best_stiffness, rel=0.03)
    assert not [n for n in controller.notices() if n.kind == "press-failed"]


def test_an_arm_without_inertia_makes_up_for_a_late_tracker_only_by_some_millimetres():
    """What is seen late looks like an offset; it is bounded in motion, and met in full at rest."""
    bench = Bench(HANGING, "quasi-static")
    bench.settled(duration=3.0)
    arm, controller, ways = bench.controller._arm, bench.controller, []
    bench.rig.world.inject("tracker", "lagging")
    bench.run(4.0)
    place = bench.pose_at(np.array([0.2, 0.9, 0.6, 0.5, 0.3, 0.2]) * BAR)[:3, 3]
    controller._arm.watch.begin()
    controller.set_task(bench.task(position=tuple(map(float, place))))
    for _ in range(40):
        bench.run(bench.period)
        meant = arm.at_waypoint(controller._reference.path[: bench.n]).pose[:3, 3]
        ways.append(np.linalg.norm(arm.at_waypoint(bench.command).pose[:3, 3] - meant))
    assert max(ways) < 12e-3
    bench.run(2.0, steer=False)
    controller.set_task(bench.task(position=tuple(map(float, bench.tip[:3, 3]))))
    bench.run(1.0)
    assert controller._correction.largest > 15e-3


def test_a_push_is_met_in_full_where_the_way_to_stiffness_is_blocked(monkeypatch):
    """No plan follows the offset there, so the bound would leave the tip off for good."""
    bench = Bench(HANGING, "full")
    position = bench.settled(duration=1.0)
    monkeypatch.setattr(Planning, "_blocked", lambda *_: "a made-up post is in the way")
    bench.run(0.2)
    assert bench.controller.replanner.plan.tip_first
    assert [notice.kind for notice in bench.controller.notices()] == ["blocked"]
    bench.rig.world.plant.set_load(PlantLoad(force=(0.05, 0.0, 0.0)))
    assert bench.run(3.0, position)[-1] < 1e-3
