"""Channels that do not follow their commands: shortfalls made up for, lost ones done without."""

from __future__ import annotations

import numpy as np
import pytest

import stiffopt as so
from stiffopt.control.channels import Channels
from stiffopt.control.plan import PlanRequest
from stiffopt.control.planning import Planning
from stiffopt.control.regulators import PressureEstimator
from stiffopt.control.tuning import RegulatorTuning
from stiffopt.errors import InputError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.rig.interface import PressureLimits
from stiffopt.rig.settings import ControlSettings
from test_controller import Bench
from test_monitors import PERIOD, SAFETY, Regulators

BAR = 1e5
HANGING = "stiff-flop-2-hanging"
N = 3
TOLERANCE = SAFETY.max_pressure_error


class Line(Regulators):
    """Three regulators commanded as the controller does; the monitor must not be tripped."""

    def __init__(self) -> None:
        super().__init__(n=N)
        limits = PressureLimits(np.zeros(N), np.full(N, 1.5 * BAR))
        tuning, slew = RegulatorTuning(), np.full(N, 5 * BAR)
        self.channels = Channels(limits, slew, np.full(N, TOLERANCE), tuning)
        robot = load_description("stiff-flop-1")
        self.estimator = PressureEstimator(
            robot, ControlSettings(), PERIOD, slew, tuning, self.channels
        )
        self.held = np.full(N, np.nan)
        self.command = np.zeros(N)
        self.noise = np.random.default_rng(0)

    def to(self, *wanted: float, seconds: float = 4.0, planned: bool = True) -> None:
        """Let the channels go to pressures, as far as they can be had if that is `planned`."""
        for _ in range(round(seconds / PERIOD)):
            stuck = np.isfinite(self.held)
            self.p = np.where(stuck, self.held, self.p)
            assert self.step(self.command) is None
            self.p = np.where(stuck, self.held, self.p)
            reading = self.p + self.noise.normal(0, 150, N)
            self.estimator.advance(1, self.command, reading)
            path = np.clip(wanted, *self.channels.available()) if planned else np.array(wanted)
            low, high = self.channels.commands(path, np.zeros(N), np.full(N, 1.5 * BAR))
            wished = np.clip(path - self.estimator.command_offset, low, high)
            step = 5 * BAR * PERIOD
            self.command = self.command + np.clip(wished - self.command, -step, step)
            assert np.all(self.command >= 0)
            assert np.all(self.command <= 1.5 * BAR)

    @property
    def kinds(self) -> list[str]:
        return [notice.kind for notice in self.channels.notices()]


def test_channels_that_follow_are_left_alone() -> None:
    line = Line()
    line.to(0.9 * BAR, 0.3 * BAR, 0.0)
    assert not line.channels.lost.any()
    assert line.kinds == []
    assert line.p == pytest.approx([0.9 * BAR, 0.3 * BAR, 0.0], abs=500)
    low, high = line.channels.available()
    assert (low.tolist(), high.tolist()) == ([0.0] * N, [1.5 * BAR] * N)


def test_a_leak_that_the_regulator_can_feed_is_fed() -> None:
    line = Line()
    line.leak[1] = 1.2  # 1/s: 7 % of the pressure
    line.to(0.5 * BAR, 1.2 * BAR, 0.2 * BAR, seconds=8.0)
    assert line.p == pytest.approx([0.5 * BAR, 1.2 * BAR, 0.2 * BAR], abs=500)
    assert line.channels.shortfall[1] == pytest.approx(line.command[1] - line.p[1], abs=500)
    assert 6e3 < line.channels.shortfall[1] < TOLERANCE
    assert line.kinds == ["shortfall"]
    assert not line.channels.lost.any()
    line.leak[1] = 0.0
    line.to(0.5 * BAR, 1.2 * BAR, 0.2 * BAR)
    assert line.p[1] == pytest.approx(1.2 * BAR, abs=500)
    assert line.kinds == []


@pytest.mark.parametrize("leak", [0.4, 0.8])
def test_a_small_leak_is_told_within_a_second(leak: float) -> None:
    line = Line()
    line.to(0.5 * BAR, 0.6 * BAR, 0.2 * BAR)
    assert line.kinds == []
    line.leak[1] = leak  # 1/s: 2.4 and 4.8 % of the pressure
    line.to(0.5 * BAR, 0.6 * BAR, 0.2 * BAR, seconds=1.0)
    assert line.kinds == ["shortfall"]
    assert f"channel 2 by 0.0{round(3.6 * leak)} bar below" in next(line.channels.notices()).text
    line.to(0.5 * BAR, 0.4 * BAR, 0.2 * BAR)  # told in motion too
    line.leak[1] = 0.0
    line.to(0.5 * BAR, 0.4 * BAR, 0.2 * BAR)
    assert line.kinds == []


def test_a_leak_that_is_there_before_the_motion_is_told_within_a_second() -> None:
    line = Line()
    line.leak[1] = 1.0  # 6 % of the pressure, which ends just above what raises the alarm
    line.to(0.0, 0.66 * BAR, 0.0, seconds=1.0)
    assert line.kinds == ["shortfall"]


def test_a_channel_that_always_differs_is_usual() -> None:
    line = Line()
    line.leak[1] = 0.35  # 2.1 % of the pressure, as a wrong gain
    for pressure in (0.8, 1.2, 0.3, 1.0):
        for _ in range(60):
            line.to(0.2 * BAR, pressure * BAR, 0.0, seconds=0.1)
            assert line.kinds == []


def test_a_leak_beyond_that_stays_a_fault() -> None:
    line = Line()
    line.leak[1] = 3.0  # it loses 15 %
    with pytest.raises(AssertionError, match="leak"):
        line.to(0.5 * BAR, 1.0 * BAR, 0.2 * BAR)


def test_a_sudden_leak_stays_a_fault() -> None:
    line = Line()
    line.to(0.5 * BAR, 1.0 * BAR, 0.2 * BAR, seconds=2.0)
    line.leak[1] = 3.0  # it loses 15 %
    with pytest.raises(AssertionError, match="leak"):
        line.to(0.5 * BAR, 1.0 * BAR, 0.2 * BAR, seconds=1.0)


def test_a_channel_without_more_pressure_bounds_the_plan_until_it_has_more() -> None:
    line = Line()
    line.saturation[0] = 0.8 * BAR
    line.to(0.98 * BAR, 0.5 * BAR, 0.0)
    assert line.channels.limited.tolist() == [True, False, False]
    assert not line.channels.stuck.any()
    assert line.channels.available()[1] == pytest.approx([0.8 * BAR, *[1.5 * BAR] * 2], abs=500)
    assert line.estimator.chamber[0] == pytest.approx(0.8 * BAR, abs=500)
    assert 0 < line.command[0] - line.p[0] < TOLERANCE
    assert "channel 1 has 0.80 bar at most" in next(line.channels.notices()).text
    line.to(0.4 * BAR, 0.5 * BAR, 0.0)  # it follows down
    assert line.p[0] == pytest.approx(0.4 * BAR, abs=500)
    line.to(0.98 * BAR, 0.5 * BAR, 0.0)
    assert line.p[0] == pytest.approx(0.8 * BAR, abs=500)
    line.saturation[0] = np.inf
    line.to(0.98 * BAR, 0.5 * BAR, 0.0, seconds=6.0)
    assert line.p[0] == pytest.approx(0.98 * BAR, abs=500)
    assert not line.channels.lost.any()
    assert line.kinds == []


def test_a_channel_that_is_stuck_has_a_fixed_pressure_until_it_moves() -> None:
    line = Line()
    line.to(0.5 * BAR, 0.5 * BAR, 0.0, seconds=1.0)
    line.held[0] = line.p[0]
    line.to(0.8 * BAR, 0.5 * BAR, 0.0)
    assert line.channels.limited[0]
    line.to(0.1 * BAR, 0.5 * BAR, 0.0, seconds=6.0)  # a fault of the monitor without the channels
    assert line.channels.stuck.tolist() == [True, False, False]
    low, high = line.channels.available()
    assert low[0] == high[0] == pytest.approx(0.5 * BAR, abs=500)
    assert 3e3 < line.p[0] - line.command[0] < TOLERANCE
    assert "channel 1 is stuck at 0.50 bar" in next(line.channels.notices()).text
    line.held[0] = np.nan
    line.to(0.1 * BAR, 0.5 * BAR, 0.0)
    assert line.p[0] == pytest.approx(0.1 * BAR, abs=500)
    assert not line.channels.lost.any()


@pytest.mark.parametrize(("to", "stuck"), [(0.1, True), (0.9, False)])
def test_a_channel_that_keeps_its_pressure_is_found_before_the_monitor_faults(
    to: float, stuck: bool
) -> None:
    line = Line()
    line.to(0.9 * BAR, 0.5 * BAR, 0.0, seconds=0.5)
    line.to(0.5 * BAR, 0.5 * BAR, 0.0, seconds=0.5)
    line.held[0] = line.p[0]
    line.to(to * BAR, 0.5 * BAR, 0.0, seconds=0.25)
    assert line.channels.lost.tolist() == [True, False, False]
    assert line.channels.stuck[0] == stuck
    line.to(to * BAR, 0.5 * BAR, 0.0, seconds=2.0)
    assert 3e3 < abs(line.p[0] - line.command[0]) < TOLERANCE / 2


@pytest.mark.parametrize("to", [0.1, 0.9])
def test_a_channel_that_moves_against_its_command_is_told_at_once(to: float) -> None:
    line = Line()
    line.to(0.5 * BAR, 0.5 * BAR, 0.0, seconds=2.0)
    line.held[0] = line.p[0]
    for k in range(round(0.15 / PERIOD)):
        aim = BAR - line.command[0]  # with a lag of 60 ms
        line.held[0] += PERIOD / 0.06 * (aim - line.held[0]) if k else 0.0
        line.to(to * BAR, 0.5 * BAR, 0.0, seconds=PERIOD)
        if line.channels.opposed.any():
            break
    assert line.channels.opposed.tolist() == [True, False, False]
    assert line.channels.last_followed[0] == pytest.approx(0.5 * BAR, abs=3e3)
    notice = next(each for each in line.channels.notices() if each.kind == "channel-opposed")
    assert notice.hold
    assert "channel 1 moves against its command" in notice.text


def test_a_regulator_that_is_slower_than_believed_is_not_lost() -> None:
    line = Line()
    line.rising = line.falling = 0.15  # of believed 0.06 s
    line.to(0.9 * BAR, 0.5 * BAR, 0.0, seconds=1.0)
    line.to(0.2 * BAR, 0.5 * BAR, 0.0, seconds=1.0)
    assert not line.channels.lost.any()
    assert not line.channels.opposed.any()


def test_feedback_leaves_a_slow_channel_alone_for_a_while() -> None:
    line = Line()
    line.to(0.3 * BAR, 0.3 * BAR, 0.3 * BAR)
    line.rising = line.falling = np.array([0.06, 0.6, 0.06])
    line.to(0.6 * BAR, 0.6 * BAR, 0.6 * BAR, seconds=0.3)
    assert line.kinds[0] == "slow-channel"
    goal, low, high = np.full(N, 0.6 * BAR), np.zeros(N), np.full(N, 1.5 * BAR)
    low, high = line.channels.commands(goal, low, high, goal)
    assert low.tolist() == [0.0, 0.6 * BAR, 0.0]
    assert high.tolist() == [1.5 * BAR, 0.6 * BAR, 1.5 * BAR]
    line.to(0.6 * BAR, 0.6 * BAR, 0.6 * BAR, seconds=14)
    assert line.kinds == []


def test_the_reference_waits_for_a_channel_that_is_behind_but_not_for_ever() -> None:
    line = Line()
    line.to(0.9 * BAR, 0.5 * BAR, 0.0)
    line.rising = line.falling = 0.1  # of believed 0.06 s
    line.to(0.4 * BAR, 0.5 * BAR, 0.0, seconds=0.15)
    assert line.channels.pace == 1.0
    line.to(0.9 * BAR, 0.5 * BAR, 0.0)
    line.rising = line.falling = 0.6
    line.to(0.4 * BAR, 0.5 * BAR, 0.0, seconds=0.2)
    assert line.channels.pace < 0.3
    paces = []
    for _ in range(round(4.0 / PERIOD)):  # a gauge that reads too much from now on
        line.estimator.advance(1, line.command, line.command + np.array([2e4, 0, 0]))
        paces.append(line.channels.pace)
    assert min(paces) < 0.7
    assert paces[-1] == 1.0


def test_a_channel_with_hardly_any_pressure_is_done_without() -> None:
    line = Line()
    line.saturation[2] = 0.02 * BAR  # its tube is off
    line.to(0.9 * BAR, 0.5 * BAR, 0.6 * BAR, seconds=6.0)
    assert line.channels.available()[1][2] == pytest.approx(0.02 * BAR, abs=500)
    assert line.command[2] < TOLERANCE


def test_a_channel_that_is_taken_out_is_let_down_and_comes_back() -> None:
    line = Line()
    line.to(0.6 * BAR, 0.5 * BAR, 0.3 * BAR, seconds=2.0)
    line.channels.take_out([0])
    line.to(0.6 * BAR, 0.5 * BAR, 0.3 * BAR, seconds=0.5, planned=False)  # by a trajectory, say
    assert 0.2 * BAR < line.p[0] < 0.5 * BAR  # not at once
    line.to(0.6 * BAR, 0.5 * BAR, 0.3 * BAR, seconds=2.0, planned=False)
    assert line.p == pytest.approx([0.0, 0.5 * BAR, 0.3 * BAR], abs=500)
    assert line.kinds == ["lost-channel"]
    line.channels.begin()  # armed again: still out
    assert line.channels.lost.tolist() == [True, False, False]
    line.channels.take_out([])
    line.to(0.6 * BAR, 0.5 * BAR, 0.3 * BAR, seconds=2.0)
    assert line.p[0] == pytest.approx(0.6 * BAR, abs=500)


@pytest.mark.parametrize(
    ("channels", "says"), [([3], "no channel 4"), ([-1], "no channel 0"), ([0, 1, 2], "all")]
)
def test_channels_that_cannot_be_taken_out(channels: list[int], says: str) -> None:
    line = Line()
    with pytest.raises(InputError, match=says):
        line.channels.take_out(channels)
    assert not line.channels.lost.any()


def test_without_gauges_nothing_is_made_up_for() -> None:
    line = Line()
    line.gauge = lambda p: np.full(N, np.nan)
    line.p = np.zeros(N)
    for _ in range(200):
        line.estimator.advance(1, np.full(N, BAR), np.full(N, np.nan))
    assert not line.channels.lost.any()
    assert not line.channels.shortfall.any()


@pytest.mark.usefixtures("compiled")
def test_the_plan_does_without_a_stuck_channel() -> None:
    arm = so.load_robot(HANGING)
    p = np.array([0.5, 0.6, 0.4, 0.3, 0.6, 0.5]) * BAR
    goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0)))
    place = Target(position=tuple(arm.tip_pose(p)[:3, 3]))
    task = Task(robot=HANGING, target=place, stiffness=goal)
    low, high = np.array(arm.pressure_min), np.array(arm.pressure_max)
    low[1] = high[1] = 0.6 * BAR
    high[4] = 0.55 * BAR
    request = PlanRequest(1, task, task.target, np.zeros(6), np.zeros(6), True, low, high)
    planning = Planning(arm)
    for _ in range(2):  # searched, and next to the last
        plan = planning.plan(request)
        assert plan.reached
        assert plan.pressures[1] == pytest.approx(0.6 * BAR, abs=1.0)
        assert plan.pressures[4] <= 0.55 * BAR + 1.0
        request = PlanRequest(1, task, task.target, np.zeros(6), np.zeros(6), False, low, high)
    far = task.target.model_copy(update={"position": (0.15, 0.0, 0.1)})
    plan = planning.plan(PlanRequest(1, task, far, np.zeros(6), np.zeros(6), False, low, high))
    assert not plan.reached
    assert plan.pressures[1] == pytest.approx(0.6 * BAR, abs=1.0)


@pytest.mark.usefixtures("compiled")
def test_the_tip_arrives_without_a_lost_channel() -> None:
    bench = Bench(HANGING)
    position = bench.settled(duration=1.5)
    channel = int(np.argmax(bench.command))
    bench.rig.world._regulators.saturation[channel] = 0.8 * bench.command[channel]
    assert bench.run(3.0, position)[-30:].mean() < 3e-4  # 7 mm without
    assert [notice.kind for notice in bench.controller.notices()] == ["lost-channel"]
    status = bench.controller.status(bench.rig.clock.now())
    assert np.flatnonzero(status.lost).tolist() == [channel]
    bench.rig.world._regulators.saturation[channel] = np.inf
    bench.controller.set_channels([4])
    assert bench.run(2.0, position)[-30:].mean() < 3e-4
    assert bench.rig.world.pressures[4] < 500


@pytest.mark.usefixtures("compiled")
def test_the_tip_goes_straight_to_its_target_when_a_channel_is_lost_on_the_way() -> None:
    bench = Bench(HANGING)
    start = np.array(bench.settled(duration=1.5))
    way = np.array([-0.02, 0.012, 0.004])
    channel = int(np.argmax(bench.command))
    bench.rig.world._regulators.held[channel] = bench.rig.world.pressures[channel]
    bench.controller.set_target(Target(position=tuple(start + way)))
    aside = []
    for _ in range(round(3.0 / bench.period)):
        bench.run(bench.period)
        moved = bench.tip[:3, 3] - start
        aside.append(np.linalg.norm(moved - way * np.clip(moved @ way / (way @ way), 0, 1)))
    assert max(aside) < 5e-3
    assert np.linalg.norm(moved - way) < 5e-4
    assert [notice.kind for notice in bench.controller.notices()] == ["lost-channel"]


@pytest.mark.usefixtures("compiled")
def test_a_distance_is_that_of_the_tip_itself() -> None:
    """The supply ends far below what the plan needs."""
    bench = Bench(HANGING)
    bench.rig.world._regulators.saturation[:] = 1.1 * BAR
    pose = so.load_robot(HANGING).tip_pose(np.array([0.0, 1.5, 1.5, 0.0, 1.4, 1.4]) * BAR)
    position = tuple(map(float, pose[:3, 3]))
    bench.controller.set_task(bench.task(position=position))
    away = bench.run(2.5, position)[-1]
    (said,) = (n.text for n in bench.controller.notices() if n.kind == "unreachable")
    assert away > 5e-3
    told = 1e-3 * float(said.split(" mm")[0].split()[-1])
    assert told == pytest.approx(away, abs=max(1e-3, 0.1 * away))


@pytest.mark.usefixtures("compiled")
def test_a_distance_is_that_of_the_tip_while_it_is_held_on_its_way() -> None:
    bench = Bench(HANGING)
    position = (0.15, 0.0, 0.1)  # out of reach
    bench.controller.set_task(bench.task(position=position))
    bench.run(0.15)
    (before,) = bench.controller.notices()
    assert before.text.endswith("by the model; the tip is on its way")
    away = bench.run(1.0, position, steer=False)[-1]  # the pressures are held
    (said,) = (notice.text for notice in bench.controller.notices())
    told, modelled = (
        1e-3 * float(text.split(" mm")[0].split()[-1]) for text in (said, before.text)
    )
    assert told == pytest.approx(away, abs=1e-3)
    assert away > modelled + 5e-3
