"""What the watch of the tip's motion doubts, on motions made up here, and what it does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.control.motion_watch import Doubt, MotionWatch
from stiffopt.control.noticing_tuning import MotionTuning
from stiffopt.control.tip_errors import turn_of_a_push
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.tip import TipModel

Array = NDArray[np.float64]

FRAME = 0.025  # s
NOISE = 5e-5  # m
X, Y = np.eye(3)[:2]
ROBOT = load_robot("stiff-flop-2")
P = np.array([4e4, 0.0, 2e4, 0.0, 5e4, 0.0])
TIP = TipModel(ROBOT).at(P)
J = TIP.pose[:3, :3] @ TIP.jacobian[:3]
NONE = np.zeros(6)  # no offset, of a tracker that measures no orientations


def take(
    watch: MotionWatch,
    time: float,
    seen: Array,
    predicted: Array,
    offset: Array,
    swing: float = 0,
    deviation: float = 0,
) -> None:
    """Have a sample watched, at the least pressures that make the model move as predicted."""
    pressures, turned = np.linalg.pinv(J) @ predicted, None if offset is NONE else offset[3:]
    watch.take(
        time, seen, predicted, offset, pressures, TIP,
        turned=turned, swings=(swing, swing / 2), deviation=deviation,
    )  # fmt: skip


def watched(
    duration: float,
    seen: Callable[[float], Array],
    predicted: Callable[[float], Array],
    intended: Callable[[float], Array],
    swing: Callable[[float], float] = lambda _: 0.0,
) -> tuple[float, Doubt | None]:
    """When and what the watch doubts of a tip that is sampled for so many seconds."""
    rng = np.random.default_rng(1)
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, duration, FRAME):
        watch.intend(time, intended(time))
        noise = NOISE * rng.standard_normal(3)
        take(watch, time, seen(time) + noise, predicted(time), NONE, swing(time))
        if watch.doubt is not None:
            return float(time), watch.doubt
    return np.inf, None


def step(size: float, at: float = 1.0, lag: float = 0.1) -> Callable[[float], float]:
    return lambda t: size * (1 - np.exp(-max(t - at, 0.0) / lag))


def still(t: float) -> Array:
    return np.zeros(3)


@pytest.mark.parametrize("wrong", [0.7, 1.0, 1.3])
def test_a_step_that_the_model_has_wrong_by_a_third_is_not_doubted(wrong: float) -> None:
    moved = step(0.04)
    _, doubt = watched(
        4, lambda t: wrong * moved(t) * X, lambda t: moved(t) * X, lambda t: moved(t) * X
    )
    assert doubt is None


def test_a_push_and_what_the_loop_does_about_it_are_not_doubted() -> None:
    push, back = step(0.015), step(0.015, at=1.05, lag=0.2)
    _, doubt = watched(6, lambda t: (push(t) - back(t)) * X, lambda t: -back(t) * X, still)
    assert doubt is None


def test_a_vibration_that_decays_is_not_doubted() -> None:
    def ringing(t: float) -> float:
        return 0.02 * np.exp(-0.06 * 2 * np.pi * 1.7 * t) * np.cos(2 * np.pi * 1.7 * t)

    assert watched(6, lambda t: ringing(t) * X, still, still)[1] is None


def test_the_lag_of_a_fast_periodic_path_is_no_swing() -> None:
    def path(t: float) -> Array:
        return 0.02 * np.array([np.sin(2 * np.pi * t / 3), np.sin(4 * np.pi * t / 3), 0.0])

    assert watched(12, lambda t: path(t - 0.08), lambda t: path(t - 0.08), path)[1] is None


def test_creep_after_a_step_is_no_drift() -> None:
    moved = step(0.04)

    def crept(t: float) -> float:
        return moved(t) + 0.002 * (1 - np.exp(-t / 2)) + 0.002 * (1 - np.exp(-t / 20))

    found = watched(30, lambda t: crept(t) * X, lambda t: moved(t) * X, lambda t: moved(t) * X)
    assert found[1] is None


def test_a_tip_that_does_not_move_when_it_should_is_doubted_after_a_few_millimetres() -> None:
    moved = step(0.04)
    time, doubt = watched(4, still, lambda t: moved(t) * X, lambda t: moved(t) * X)
    assert doubt is not None
    assert doubt.kind == "no-response"
    assert "sensor has come off" in doubt.text
    assert doubt.undo < 1
    assert moved(time) < 0.018


@pytest.mark.parametrize(("along", "aside", "is_doubted"), [(0.6, 0.5, True), (1.6, 0.0, False)])
def test_a_tip_that_misses_half_of_its_way_is_doubted_but_not_if_it_moves_farther(
    along: float, aside: float, is_doubted: bool
) -> None:
    moved = step(0.04)
    _, doubt = watched(
        4, lambda t: moved(t) * (along * X + aside * Y), lambda t: moved(t) * X,
        lambda t: moved(t) * X,
    )  # fmt: skip
    assert (doubt is not None and doubt.kind == "no-response") is is_doubted


@pytest.mark.parametrize(
    ("first", "second", "pause", "is_doubted"),
    [
        (1.0, 0.7, 5.0, True),
        (1.0, 0.7, 1.0, False),  # the first motion may turn out to be a fault yet
        (1.0, 0.9, 5.0, False),
        (0.8, 0.7, 5.0, False),
        (None, 0.7, 5.0, False),
    ],
)
def test_an_arm_that_has_followed_its_model_must_go_on_doing_so(
    first: float | None, second: float, pause: float, is_doubted: bool
) -> None:
    one, other = step(0.0 if first is None else 0.04), step(0.04, at=1 + pause)

    def seen(t: float) -> Array:
        return (first or 0) * one(t) * X + second * other(t) * Y

    def modelled(t: float) -> Array:
        return one(t) * X + other(t) * Y

    assert (watched(pause + 3, seen, modelled, modelled)[1] is not None) is is_doubted


@pytest.mark.parametrize(("push", "is_doubted"), [(0.0, True), (0.001, False)])
def test_a_payload_at_rest_may_change_how_the_arm_responds(push: float, is_doubted: bool) -> None:
    one, other, pushed = step(0.04), step(0.04, at=6.0), step(push, at=4.0)
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 8.0, FRAME):
        modelled = one(time) * X + other(time) * Y
        offset = np.concatenate([pushed(time) * X, np.zeros(3)])
        watch.intend(time, modelled + offset[:3])
        seen = one(time) * X + 0.7 * other(time) * Y + offset[:3]
        take(watch, time, seen, modelled, offset)
    assert (watch.doubt is not None) is is_doubted


def test_a_push_whose_second_mode_turns_the_tip_the_other_way_at_first_is_no_slip() -> None:
    """The turn catches up with the displacement within a few tenths of a second."""
    assert displaced(1.0, turns=step(1.6, lag=0.3)) is None
    assert displaced(0.0, turns=step(1.6, lag=0.3)) is not None


@pytest.mark.parametrize("wrong", [0.0, 1.0])
def test_the_reference_is_slowed_down_before_the_doubt_but_not_for_an_error(wrong: float) -> None:
    """A tip that moves across its way, or a third too little."""
    watch = MotionWatch(ROBOT.description, MotionTuning())
    moved, paces = step(0.04), []
    for time in np.arange(0.0, 3.0, FRAME):
        way = moved(time) * X
        watch.intend(time, way)
        take(watch, time, way * 0.7 * (1 - wrong) + moved(time) * wrong * Y, way, NONE)
        if watch.doubt is not None:
            break
        paces.append(watch.pace)
    assert (watch.doubt is not None) is bool(wrong)
    assert (min(paces) < 0.5) is bool(wrong)
    assert max(paces) == 1.0
    watch.go_on()
    assert watch.pace == 1.0


def test_a_tip_that_moves_along_its_axis_does_not_lie_still() -> None:
    axis, aside, moved = TIP.pose[:3, 2], TIP.pose[:3, 0], step(1.0, lag=0.3)

    def model(t: float) -> Array:
        return moved(t) * (0.06 * axis + 0.008 * aside)

    assert watched(4, lambda t: moved(t) * 0.06 * axis, model, model)[1] is None


def test_the_swing_that_a_motion_excites_does_not_excuse_a_tip_that_lies_still() -> None:
    """The estimator takes the motion that it does not see for a vibration of this size."""
    moved = step(0.04, lag=0.3)
    time, doubt = watched(
        4, still, lambda t: moved(t) * X, lambda t: moved(t) * X, lambda t: 0.8 * moved(t)
    )
    assert doubt is not None
    assert moved(time) < 0.012


def test_feedback_that_moves_the_tip_away_is_doubted() -> None:
    """Swapped channels: r rests, the model's tip is driven back, and the real one goes on."""
    moved = step(0.01, lag=0.2)

    def away(t: float) -> float:
        return 2e-3 * (np.exp(max(t - 1.5, 0) / 0.2) - 1)

    time, doubt = watched(
        4, lambda t: moved(t) * X + away(t) * Y, lambda t: moved(t) * X - away(t) * Y,
        lambda t: moved(t) * X,
    )  # fmt: skip
    assert doubt is not None
    assert doubt.kind == "no-response"
    assert doubt.undo == 1
    assert away(time) < 0.009


@pytest.mark.parametrize("way", [-X, Y, -0.5 * X + 0.8 * Y])
def test_a_tip_that_moves_another_way_is_doubted(way: Array) -> None:
    moved = step(0.04, lag=0.2)
    time, doubt = watched(
        4, lambda t: moved(t) * way, lambda t: moved(t) * X, lambda t: moved(t) * X
    )
    assert doubt is not None
    assert doubt.kind == "no-response"
    assert "channels are swapped" in doubt.text
    assert moved(time) < 0.014


@pytest.mark.parametrize(("speed", "within"), [(5e-3, 2.0), (2e-3, 6.0), (7e-4, 12.0)])
def test_a_drift_that_the_loop_follows_is_doubted(speed: float, within: float) -> None:
    time, doubt = watched(20, still, lambda t: -speed * max(t - 1, 0.0) * X, still)
    assert doubt is not None
    assert doubt.kind == "drift"
    assert time - 1 < within
    assert speed * (time - 1) < 0.0105


def test_a_tip_that_shakes_is_doubted_within_a_second() -> None:
    time, doubt = watched(3, lambda t: 0.01 * np.sin(6 * np.pi * t) * X, still, still)
    assert doubt is not None
    assert doubt.kind == "swing"
    assert time < 1.0


def test_swings_that_grow_are_doubted_while_they_are_small() -> None:
    def growing(t: float) -> float:
        return 1e-3 * np.exp(0.3 * t) * np.sin(2 * np.pi * t / 1.6)

    time, doubt = watched(30, lambda t: growing(t) * X, still, still)
    assert doubt is not None
    assert doubt.kind == "swing"
    assert 1e-3 * np.exp(0.3 * time) < 7e-3


def test_a_doubt_stands_until_it_begins_anew() -> None:
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for k in range(200):
        time = k * FRAME
        watch.intend(time, np.zeros(3))
        take(watch, time, 0.005 * time * X, -0.005 * time * X, NONE)
    assert watch.doubt is not None
    watch.begin()
    assert watch.doubt is None


def test_nothing_is_doubted_while_nobody_steers() -> None:
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for k in range(400):
        take(watch, k * FRAME, 0.005 * k * FRAME * X, np.zeros(3), NONE)
    assert watch.doubt is None


def test_nothing_is_doubted_after_steering_has_ended() -> None:
    watch = MotionWatch(ROBOT.description, MotionTuning())
    watch.intend(0.0, np.zeros(3))
    for k in range(400):
        take(watch, k * FRAME, 0.02 * np.sin(k) * X, np.zeros(3), NONE)
    assert watch.doubt is None


def displaced(
    turned: float,
    force: float = 1.0,
    grown: Callable[[float], float] | None = None,
    turns: Callable[[float], float] | None = None,
    estimated: float = 1.0,
) -> Doubt | None:
    """Doubt of a tip that is displaced by 10 mm and turned by a share of what a push turns it.

    It begins with 0.6 of that turn the other way if the turn follows a time course of its own. An
    `estimated` share of what has grown is known, the rest counts as a swing.
    """
    push = TIP.pose[:3, :3] @ np.array([0.01, 0.004, 0.0]) * force
    pushed = ROBOT.loaded_tip_pose(P, [*push, 0.0, 0.0, 0.0])
    moved = pushed[:3, 3] - TIP.pose[:3, 3]
    turn = turned * lie.log(pushed @ np.linalg.inv(TIP.pose))[3:]
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 3.0, FRAME):
        course = (grown or step(1.0, lag=0.05))(time)
        offset = np.concatenate([course * moved, course * turn])
        if turns and time > 1.0:
            offset[3:] = turned and (turns(time) - 0.6) * turn
        watch.intend(time, np.zeros(3))
        if grown:  # the loop has not made up for it
            known, still = estimated * offset, np.zeros(3)
            watch.take(time, offset[:3], still, known, np.zeros(6), TIP, turned=offset[3:])
        else:
            take(watch, time, np.zeros(3), -offset[:3], offset)
    assert np.linalg.norm(moved) > 6e-3 * force
    return watch.doubt


@pytest.mark.parametrize("turned", [0.67, 1.0, 1.35, 1.9])
def test_a_push_at_the_tip_or_along_the_body_is_no_slip(turned: float) -> None:
    assert displaced(turned) is None


@pytest.mark.parametrize("turned", [0.0, -1.0])
def test_a_displacement_that_turns_nothing_is_a_slip(turned: float) -> None:
    doubt = displaced(turned)
    assert doubt is not None
    assert doubt.kind == "slip"
    assert "sensor has slipped" in doubt.text


@pytest.mark.parametrize("measured", [0.0, 0.9])
def test_a_push_whose_estimated_turn_comes_late_is_no_slip(measured: float) -> None:
    """The arm is becoming stiff; but the tip is measured to turn by a share of a push's turn."""
    pushed = ROBOT.loaded_tip_pose(P, [*TIP.pose[:3, :3] @ [0.01, 0.004, 0.0], 0.0, 0.0, 0.0])
    moved = pushed[:3, 3] - TIP.pose[:3, 3]
    turn = lie.log(pushed @ np.linalg.inv(TIP.pose))[3:]
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 2.5, FRAME):
        offset = np.concatenate([step(1.0)(time) * moved, step(0.9, at=1.2, lag=0.4)(time) * turn])
        watch.intend(time, np.zeros(3))
        seen = step(1.0, lag=0.05)(time)
        watch.take(
            time, seen * moved, np.zeros(3), offset, np.zeros(6), TIP, turned=seen * measured * turn
        )
    assert (watch.doubt is None) is (measured > 0)


@pytest.mark.parametrize(("known_after", "is_doubted"), [(0.1, True), (0.4, False)])
def test_an_offset_that_the_estimator_does_not_know_yet_is_no_slip(
    known_after: float, is_doubted: bool
) -> None:
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 1.0, FRAME):
        found = (time > 0.25) * 0.008 * X  # at first it counts as a vibration
        deviation = 1e-4 if time > known_after else 2e-3
        watch.intend(time, np.zeros(3))
        offset = np.concatenate([found, np.zeros(3)])
        take(watch, time, 0.008 * X, np.zeros(3), offset, 0, deviation)
    assert (watch.doubt is not None) is is_doubted


@pytest.mark.parametrize(("response", "words"), [(0.5, "too low"), (1.6, "too high")])
def test_an_arm_that_moves_less_or_farther_than_modelled_is_no_slipped_sensor(
    response: float, words: str
) -> None:
    moved, watch = step(0.06, lag=0.3), MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 4.0, FRAME):
        way = moved(time) * X
        offset = np.concatenate([(response - 1) * way, np.zeros(3)])
        watch.intend(time, way)
        take(watch, time, response * way, way, offset)
    assert watch.doubt is not None
    assert watch.doubt.kind == "weak"
    assert watch.doubt.is_of_arm
    assert f"{response:.2f} times as far" in watch.doubt.text
    assert words in watch.doubt.text


@pytest.mark.parametrize(
    ("turned", "swings_at", "is_doubted"), [(0.0, 1.0, True), (0.6, 1.0, False), (0.0, 0.7, False)]
)
def test_a_sensor_that_shakes_is_doubted_before_it_has_swung_once(
    turned: float, swings_at: float, is_doubted: bool
) -> None:
    """The estimator takes all of it for a vibration. One that goes on is judged by its swings."""
    watch, way = MotionWatch(ROBOT.description, MotionTuning()), TIP.pose[:3, :3] @ X
    turn = turned * turn_of_a_push(TIP) @ way
    for time in np.arange(0.0, 1.3, FRAME):
        shaken = 0.01 * np.sin(2 * np.pi * 3 * (time - 1)) * (time > 1)
        watch.intend(time, np.zeros(3))
        watch.take(
            time, shaken * way, np.zeros(3), NONE, np.zeros(6), TIP,
            turned=shaken * turn, swings=(0.0, 0.01 * (time > swings_at)),
        )  # fmt: skip
        if watch.doubt is not None:
            break
    assert (watch.doubt is not None) is is_doubted
    if is_doubted:
        assert watch.doubt.kind == "slip"
        assert time < 1.15


def test_a_payload_that_lengthens_a_bent_arm_turns_it_more_than_its_soft_directions_tell() -> None:
    robot, bent = load_robot("stiff-flop-2-hanging"), np.array([1.2e5, 0.0, 0.0, 0.0, 1.2e5, 0.0])
    tip = TipModel(robot).at(bent)
    loaded = robot.loaded_tip_pose(bent, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    moved, turn = loaded[:3, 3] - tip.pose[:3, 3], lie.log(loaded @ np.linalg.inv(tip.pose))[3:]
    whole = turn_of_a_push(tip, along_stiff_axis=True) @ moved
    assert np.linalg.norm(whole - turn) < 0.3 * np.linalg.norm(turn)
    assert np.linalg.norm(turn_of_a_push(tip) @ moved - turn) > 0.5 * np.linalg.norm(turn)


def slowly(t: float) -> float:
    return min(max(t - 1.0, 0.0) / 2.0, 1.0)


@pytest.mark.parametrize(("turned", "force"), [(0.0, 0.7), (0.67, 2.0)])
def test_a_displacement_that_grows_as_no_usual_push_is_doubted(turned: float, force: float) -> None:
    assert displaced(turned, force, slowly) is not None


def test_a_drift_that_turns_nothing_is_doubted_though_the_posture_follows_it() -> None:
    """The plan moves the segments against each other while feedback makes up for the drift."""
    proximal = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    way = np.linalg.pinv(J * proximal) @ X - np.linalg.pinv(J * (1 - proximal)) @ X
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 4.0, FRAME):
        drift = 5e-3 * max(time - 1.0, 0.0)
        offset = np.concatenate([drift * Y, [0.0, 0.0, 1e-9]])
        pressures = np.linalg.pinv(J) @ -offset[:3] + way * 0.8 * drift
        watch.intend(time, np.zeros(3))
        watch.take(time, np.zeros(3), -offset[:3], offset, pressures, TIP, turned=offset[3:])
        if watch.doubt is not None:
            break
    assert watch.doubt is not None
    assert watch.doubt.kind == "slip"
    assert time < 2.0


@pytest.mark.parametrize("estimated", [1.0, 0.05])
@pytest.mark.parametrize("force", [0.7, 2.0])
def test_a_push_that_grows_slowly_is_no_drift(force: float, estimated: float) -> None:
    assert displaced(1.0, force, slowly, estimated=estimated) is None


def test_a_drift_in_a_slow_swing_is_doubted() -> None:
    assert displaced(0.0, 0.7, slowly, estimated=0.05) is not None


def begun(turned: Callable[[float], float]) -> tuple[float, Doubt | None]:
    """When and what is doubted of a displaced tip that turns by such a share over time."""
    moved = TIP.pose[:3, :3] @ np.array([0.01, 0.004, 0.0])
    turn = turn_of_a_push(TIP) @ moved
    watch = MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 3.0, FRAME):
        share = step(1.0, lag=0.05)(time)
        offset = share * np.concatenate([moved, turned(time) * turn])
        watch.intend(time, np.zeros(3))
        take(watch, time, np.zeros(3), -offset[:3], offset)
        if watch.doubt is not None:
            return float(time), watch.doubt
    return np.inf, None


def test_a_push_that_excites_a_higher_mode_is_no_slip() -> None:
    """The tip turns as by a push at first, and then swings about that turn for a while."""
    found = begun(lambda t: 1 + 1.2 * np.sin(15 * (t - 1)) * np.exp(-2 * max(t - 1, 0)))
    assert found[1] is None


def test_a_slip_that_the_loop_follows_into_a_turn_is_a_slip() -> None:
    """The model is wrong about the turn of the motion that makes up for the slip."""
    time, doubt = begun(lambda t: 0.4 * min(max(t - 1.2, 0.0) / 0.2, 1.0))
    assert doubt is not None
    assert doubt.kind == "slip"
    assert time < 1.3


def test_segments_that_move_the_tip_against_each_other_may_miss_by_more() -> None:
    """A new posture at nearly the same tip: each segment moves it by far more than both do."""
    watch = MotionWatch(ROBOT.description, MotionTuning())
    proximal = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    way = np.linalg.pinv(J * proximal) * 0.03 @ X - np.linalg.pinv(J * (1 - proximal)) @ (0.022 * X)
    moved = step(1.0)
    for time in np.arange(0.0, 4.0, FRAME):
        share = moved(time)
        watch.intend(time, 0.008 * share * X)
        seen = share * (0.008 * X + 0.008 * Y - 0.006 * X)
        watch.take(time, seen, 0.008 * share * X, NONE, share * way, TIP, turned=None)
    assert watch.doubt is None
