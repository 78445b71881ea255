"""A push that begins or ends with a motion is told from what is wrong with the pressures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.control.motion_watch import MotionWatch
from stiffopt.control.noticing_tuning import MotionTuning, PushTuning
from stiffopt.control.push_watch import PushWatch
from stiffopt.control.tip_errors import turn_of_a_push
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.tip import TipModel
from stiffopt.plant.settings import PlantLoad
from test_controller import BAR, HANGING, Bench

Array = NDArray[np.float64]

TIP = TipModel(load_robot("stiff-flop-2-hanging")).at(np.full(6, 0.4 * BAR))
J = TIP.pose[:3, :3] @ TIP.jacobian[:3]
TIMES = np.arange(0.0, 0.6, 0.025)
ASIDE = TIP.pose[:3, 0]  # a direction in which the tip is soft


class Samples(NamedTuple):
    """What `PushWatch.take` gets."""

    times: Array
    seen: Array
    away: Array
    turned: Array
    pressures: Array
    swings: Array


def samples(
    way: float,
    channels: float,
    *,
    turn: float = 1.0,
    lies: bool = False,
    rate: float = 0.0,
    swing: float = 0.0,
) -> Samples:
    """A tip that is displaced in the last 0.15 s, while all channels move it by a length in sum.

    `way`, in m, is the displacement; `channels`, in m, the motion by the pressures until 0.1 s ago;
    `turn` the multiple of the turn of a push with that displacement; `lies`: the tip lies still,
    and the model moves instead; `rate`: a steady motion by all channels in sum, in m/s; `swing`:
    the amplitude of the arm's vibration, in m.
    """
    grows = np.clip((TIMES - TIMES[-1]) / 0.15 + 1, 0, 1)[:, None]
    away = way * grows * ASIDE
    seen = np.zeros_like(away) if lies else away
    pushed = away @ turn_of_a_push(TIP).T
    length = np.linalg.norm(J, axis=0).sum()
    moves = np.clip((TIMES - TIMES[-1] + 0.1) / 0.1 + 1, 0, 1)
    pressures = np.outer((channels * moves + rate * TIMES) / length, np.ones(6))
    return Samples(TIMES, seen, away, turn * pushed, pressures, np.full(len(TIMES), swing))


@pytest.mark.parametrize(
    ("displaced", "is_push"),
    [
        (samples(8e-3, 0.0), True),
        (samples(8e-3, 3e-3), True),
        (samples(8e-3, 8e-3), False),  # swapped channels could have done that
        (samples(8e-3, 0.0, turn=0.2), False),  # the sensor slips
        (samples(8e-3, 0.0, turn=-1.0), False),
        (samples(8e-3, 0.0, lies=True), False),  # the sensor has come off
        (samples(1e-3, 0.0), False),
        (samples(8e-3, 0.0, swing=1e-3), True),
        (samples(8e-3, 0.0, swing=4e-3), False),  # the arm swings back
        (samples(8e-3, 0.0, rate=16e-3), True),  # the arm changes its posture all the time
        (samples(8e-3, 0.0, rate=24e-3), True),  # of six channels one may fail at that moment
        (samples(8e-3, 0.0, rate=28e-3), False),  # too fast to become stiff
    ],
)
def test_a_push_displaces_the_tip_before_pressures_can(displaced: Samples, is_push: bool) -> None:
    watch = PushWatch(PushTuning(), vibrates=True)
    assert watch.take(*displaced, J, TIP) is is_push
    now = float(TIMES[-1])
    assert watch.acts(now) is is_push
    assert not watch.acts(now + 1.1)


def test_pressures_move_an_arm_at_once_that_has_no_inertia_or_vibrates_fast() -> None:
    late = samples(8e-3, 0.0)
    late.pressures[-3:] += 8e-3 / np.linalg.norm(J, axis=0).sum()
    assert PushWatch(PushTuning(), vibrates=True).take(*late, J, TIP)
    assert not PushWatch(PushTuning(), vibrates=False).take(*late, J, TIP)
    quick = PushWatch(PushTuning(), vibrates=True)
    quick.omega = 30.0
    assert not quick.take(*late, J, TIP)


@pytest.mark.parametrize("turn", [1.0, 1.5])
def test_the_turn_shows_the_displacement_by_a_push(turn: float) -> None:
    """A moment, or a force below the tip, turns it further."""
    watch = PushWatch(PushTuning(), vibrates=True)
    assert watch.take(*samples(8e-3, 0.0), J, TIP)
    pushed = samples(8e-3, 0.0, turn=turn)
    found = watch.displacements(pushed.away, pushed.turned, TIP)
    soft = np.linalg.pinv(turn_of_a_push(TIP)) @ turn_of_a_push(TIP)
    assert found == pytest.approx((pushed.away[-1] - pushed.away) @ soft.T, abs=1e-9)


def test_a_push_explains_no_more_than_it_was_seen_to_do() -> None:
    """An arm that is caught by a wall meanwhile is turned by it as well."""
    watch = PushWatch(PushTuning(), vibrates=True)
    assert watch.take(*samples(8e-3, 0.0), J, TIP)
    caught = samples(40e-3, 0.0)
    found = watch.displacements(caught.away, caught.turned, TIP)
    assert np.linalg.norm(found[0]) == pytest.approx(1.2 * 8e-3, rel=1e-3)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("ends", [False, True])
def test_a_push_that_begins_or_ends_with_a_new_target_is_not_doubted(ends: bool) -> None:
    bench = Bench(HANGING, "full")
    plant, load = bench.rig.world.plant, PlantLoad(force=(0.0, 0.035, 0.0))
    if ends:
        plant.set_load(load)
    bench.settled(duration=5.0)
    bench.controller._arm.watch.forgive()
    place = bench.pose_at(np.array([0.2, 0.9, 0.6, 0.5, 0.3, 0.2]) * BAR)[:3, 3]
    plant.set_load(PlantLoad() if ends else load)
    bench.controller.set_task(bench.task(position=tuple(map(float, place))))
    bench.run(0.8)
    told = {notice.kind: notice for notice in bench.controller.notices()}
    assert told["motion-waits"].standing
    assert told["motion-waits"].severity == "info"
    bench.run(2.2)
    assert bench.controller._arm.watch.doubt is None
    assert np.linalg.norm(bench.tip[:3, 3] - place) < 2e-3  # the reference has waited, and gone on
    assert "motion-waits" not in {notice.kind for notice in bench.controller.notices()}


@pytest.mark.usefixtures("compiled")
def test_a_line_that_is_kinked_at_the_moment_of_a_push_does_not_hide_behind_it() -> None:
    """The reference waits for the end of the push; in the rest of the motion the line shows."""
    bench = Bench(HANGING, "full")
    bench.settled(duration=5.0)
    watch, plant = bench.controller._arm.watch, bench.rig.world.plant
    watch.forgive()
    place = bench.pose_at(np.array([0.85, 0.48, 0.88, 0.13, 0.6, 0.39]) * BAR)[:3, 3]
    plant.set_load(PlantLoad(force=(-0.023, -0.026, 0.0)))
    highest, follow = np.full(bench.n, np.inf), plant.follow
    highest[2] = bench.rig.world.pressures[2]
    plant.follow = lambda trace: follow(np.minimum(trace, highest))
    bench.controller.set_task(bench.task(position=tuple(map(float, place))))
    bench.run(0.8)
    assert watch.waits
    assert watch.doubt is None
    bench.run(1.2)
    assert watch.doubt is not None
    assert watch.doubt.kind == "no-response"


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(("steers", "is_told"), [(True, True), (False, False)])
def test_only_an_arm_that_would_go_on_tells_that_it_waits(steers: bool, is_told: bool) -> None:
    bench = Bench(HANGING)
    bench.settled(duration=1.0)
    place = bench.pose_at(np.array([0.2, 0.9, 0.6, 0.5, 0.3, 0.2]) * BAR)[:3, 3]
    bench.controller.set_task(bench.task(position=tuple(map(float, place))))
    bench.run(0.1)
    bench.run(0.05, steer=steers)  # otherwise the pressures are held
    bench.controller._arm.watch.waits = True
    kinds = {notice.kind for notice in bench.controller.notices()}
    assert ("motion-waits" in kinds) is is_told


def test_an_arm_that_is_pushed_again_and_again_goes_on(monkeypatch) -> None:
    watch = MotionWatch(load_robot("stiff-flop-2-hanging").description, MotionTuning())
    monkeypatch.setattr(watch._pushes, "acts", lambda now: now >= 1.0)
    place, waits = TIP.pose[:3, 3], []
    for time in np.arange(0.0, 10.0, 0.025):
        watch.intend(time, place)
        watch.take(time, place, place, np.zeros(6), np.full(6, 4e4), TIP, turned=np.zeros(3))
        waits.append(watch.waits)
    assert not any(waits[:39])
    assert all(waits[41:99])
    assert 0.4 < np.mean(waits[40:]) < 0.55


@pytest.mark.parametrize("again", [False, True])
def test_the_swings_before_a_push_do_not_count(monkeypatch, again: bool) -> None:
    """An arm that goes on to be shaken does swing."""
    watch = MotionWatch(load_robot("stiff-flop-2-hanging").description, MotionTuning())
    monkeypatch.setattr(watch._pushes, "acts", lambda _: again)
    monkeypatch.setattr(watch._pushes, "take", lambda *_: True)
    before, place = watch._swings, TIP.pose[:3, 3]
    watch.intend(0.0, place)
    watch.take(0.0, place, place, np.zeros(6), np.full(6, 4e4), TIP, turned=np.zeros(3))
    assert (watch._swings is before) is again


@pytest.mark.parametrize("pause", [0.0, 0.5])
def test_no_push_is_told_after_a_pause_in_which_pressures_may_have_changed(pause: float) -> None:
    watch = MotionWatch(load_robot("stiff-flop-2-hanging").description, MotionTuning())
    pushed, place = samples(8e-3, 0.0), TIP.pose[:3, 3]
    for i, time in enumerate(TIMES - pause * (TIMES < 0.35)):
        watch.intend(time, place)
        seen = place + pushed.away[i]
        watch.take(
            time, seen, place, np.zeros(6), pushed.pressures[i], TIP, turned=pushed.turned[i]
        )
    assert watch._pushes.acts(float(TIMES[-1])) is (pause == 0)
