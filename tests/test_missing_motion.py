"""A channel whose motion the tip lacks while the arm becomes stiff: found, and no push is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from stiffopt.control.missing_motion import MissingMotion
from stiffopt.control.noticing_tuning import MissingMotionTuning
from stiffopt.control.plan import Plan
from stiffopt.control.replanning import Pursuit, Replanner
from stiffopt.control.tuning import ReplanningTuning
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from test_controller import BAR, HANGING, Bench

# three channels that move the tip against each other, at 5 mm/s each by 0.1 bar/s
ANGLES = np.deg2rad([0.0, 120.0, 240.0])
J = 0.5e-6 * np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(3)])
RATES = np.full(3, 0.1 * BAR)
TIMES = np.arange(0.0, 4.0, 0.05)


def found(offsets, *, times=TIMES) -> tuple[int, ...]:
    """The channels that are found from offsets (k, 3) of the tip."""
    watch = MissingMotion(MissingMotionTuning())
    for time, offset in zip(times, offsets, strict=True):
        watch.take(time, offset, time * RATES, J)
    return watch.channels


def lacking(shares) -> np.ndarray:
    """Offsets (k, 3) of a tip that lacks shares (3,) of its motion by each channel."""
    return -np.outer(TIMES, J @ (np.array(shares) * RATES))


@pytest.mark.parametrize(
    ("offsets", "channels"),
    [
        (lacking([0.0, 1.0, 0.0]), (1,)),  # kinked
        (lacking([0.0, 0.9, 0.1]), (1,)),
        (lacking([0.4, 0.4, 0.4]), ()),  # weak
        (lacking([0.4, 0.0, 0.0]), ()),
        (lacking([0.0, -1.0, 0.0]), ()),  # it moves farther
        (np.outer(TIMES > 2.0, [0.02, 0.0, 0.0]), ()),  # a push
        (np.outer(TIMES, [0.0, 5e-3, 0.0]), ()),  # it grows, across the motion of a channel
        (np.outer(np.minimum(TIMES, 0.8), 5e-3 * np.array([-1.0, 0.0, 0.0])), ()),  # for a while
    ],
)
def test_a_channel_that_does_not_move_the_tip_is_told_from_a_push(offsets, channels):
    assert found(offsets) == channels


def test_what_happens_in_a_pause_does_not_count():
    assert found(lacking([0.0, 1.0, 0.0])[::12], times=TIMES[::12]) == ()
    watch = MissingMotion(MissingMotionTuning())
    for time, offset in zip(TIMES, lacking([0.0, 1.0, 0.0]), strict=True):
        watch.pause()
        watch.take(time, offset, time * RATES, J)
    assert not watch.channels


def test_a_fast_motion_is_not_judged():
    watch = MissingMotion(MissingMotionTuning())
    for time, offset in zip(TIMES / 5, lacking([0.0, 1.0, 0.0]), strict=True):
        watch.take(time, offset, 5 * time * RATES, J)
    assert not watch.channels


@pytest.mark.parametrize("rises", [True, False])
def test_that_channel_goes_back_until_there_is_another_target(rises):
    """One whose pressure falls is told, and not limited: nothing raises a pressure."""
    asked, seen = [], []
    planner = SimpleNamespace(request=asked.append, latest=lambda: None, notices=tuple)
    replanner = Replanner(planner, ReplanningTuning(), 0.01, 0.0)
    targets = [Target(position=(x, 0.0, 0.1)) for x in (0.0, 0.002, 0.02)]
    task, limits = Task(robot=HANGING, target=targets[0]), (np.zeros(3), np.full(3, BAR))
    tip = SimpleNamespace(pose=np.eye(4), jacobian=np.concatenate([J, np.zeros((3, 3))]))
    sign = 1 if rises else -1
    for begin, target in enumerate(targets):
        now = 10.0 * begin
        replanner.pursue(Pursuit(task=task, target=target))
        replanner.update(now, np.zeros(6), np.zeros(3), 10.0, 0.1, limits)
        seen.append(asked[-1])
        plan = Plan(asked[-1].serial, limits[0], np.zeros(6), target, True, 1.0, "")
        replanner.plan = replace(plan, tip_first=(0.5,))
        for time, offset in zip(TIMES, sign * lacking([0.0, 1.0, 0.0]), strict=True):
            pressures = 0.5 * BAR + sign * time * RATES
            replanner.look(now + time, np.append(offset, np.zeros(3)), pressures, tip)
        (notice,) = replanner.notices()
        assert notice.kind == "missing-motion"
        assert "channel 2 " in notice.text
        replanner.update(now + 5.0, np.zeros(6), np.zeros(3), 10.0, 0.1, limits)
        seen.append(asked[-1])
    # the second target is next to the first, the third one is not
    limited = [rises and index not in (0, 4) for index in range(6)]
    assert [request.high[1] < BAR for request in seen] == limited
    assert all((r.low == 0).all() and r.high[0] == r.high[2] == BAR for r in seen)
    if not rises:
        return
    # the way back is smooth, also where targets arrive in a stream and each is planned for at once
    highest, speed = [], 5e-3 / float(np.linalg.norm(J[:, 1]))
    for tick in range(10):
        replanner.pursue(Pursuit(task=task, target=targets[-1]))
        replanner.update(25.01 + 0.01 * tick, np.zeros(6), np.zeros(3), 10.0, 0.1, limits)
        highest.append(replanner.limited(limits, np.zeros(3))[1][1])
    assert highest[0] == pytest.approx(0.63 * BAR, abs=0.04 * BAR)
    assert np.diff(highest) == pytest.approx(-0.01 * speed)
    for tick in range(50):
        replanner.update(27.0 + tick, np.zeros(6), np.zeros(3), 10.0, 0.1, limits)
    assert asked[-1].high[1] == pytest.approx(0.5 * BAR)  # where the tip has last followed
    _, high = replanner.limited(limits, np.full(3, 0.1 * BAR))
    assert high[1] == pytest.approx(0.4 * BAR)


def test_two_channels_are_found():
    watch = MissingMotion(MissingMotionTuning())
    one, other = lacking([0.0, 1.0, 0.0]), lacking([1.0, 0.0, 0.0])
    half = len(TIMES) // 2
    offsets = np.concatenate([one[:half], one[half] + other[half:] - other[half]])
    for time, offset in zip(TIMES, offsets, strict=True):
        watch.take(time, offset, 0.5 * BAR + time * RATES, J)
    assert watch.channels == (0, 1)
    low, high = watch.limited(np.full(3, 0.7 * BAR), np.full(3, BAR))
    assert (high >= low).all()  # the lowest pressures come first
    _, high = watch.limited(np.zeros(3), np.full(3, BAR))
    assert (high[:2] < BAR).all()
    assert high[2] == BAR


def test_a_stream_of_targets_that_leads_away_and_a_trajectory_give_the_channel_free():
    planner = SimpleNamespace(request=lambda _: None, latest=lambda: None, notices=tuple)
    task = Task(robot=HANGING, target=Target(position=(0.0, 0.0, 0.1)))
    for way in ("stream", "trajectory"):
        replanner = Replanner(planner, ReplanningTuning(), 0.01, 0.0)
        replanner.pursue(Pursuit(task=task, target=task.target))
        replanner._missing._found, replanner._search = {1: None}, False
        if way == "trajectory":
            replanner.pursue(Pursuit(task=task, target=task.target, course=cast(Any, object())))
            assert replanner._missing.channels == ()
            continue
        for x in np.arange(1, 5) * 1e-3:
            replanner.pursue(Pursuit(task=task, target=Target(position=(x, 0.0, 0.1))))
            assert replanner._missing.channels == (1,)
        for x in np.arange(5, 8) * 1e-3:
            replanner.pursue(Pursuit(task=task, target=Target(position=(x, 0.0, 0.1))))
        assert replanner._missing.channels == ()


@pytest.mark.usefixtures("compiled")
def test_the_command_of_a_kinked_line_is_not_raised_on_and_on():
    """The loop would make up for what the chamber lacks, and at the next target the tip goes aside.

    Until its command is below the kink, the chamber does not follow it down.
    """
    bench = Bench(HANGING, "full")
    position = bench.settled((0.8, 0.2, 0.9, 0.5, 0.6, 0.7), duration=2.5)
    plant, kink = bench.rig.world.plant, float(bench.rig.world.pressures[0])
    follow, kinked = plant.follow, np.arange(bench.n) == 0
    plant.follow = lambda trace: follow(np.where(kinked, np.minimum(trace, kink), trace))
    kinds, raised = set(), []
    for _ in range(30):
        off = bench.run(0.1, position).max()
        kinds |= {notice.kind for notice in bench.controller.notices()}
        raised.append(bench.command[0] - kink)
        assert off < 4.5e-3
    assert kinds == {"missing-motion"}
    assert max(raised) < 0.27 * BAR
    assert raised[-1] < 0.05 * BAR
