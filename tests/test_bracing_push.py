"""What a braced arm takes for a push, and what for creep, friction or an error of the model."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leaning_arm import (
    ROBOT,
    approach_fixture,  # noqa: F401
    held,
    lift_off,
    pushed,
    samples,
    settled,
    stiff,
)
from stiffopt.control.bracing import Bracing
from stiffopt.control.friction import Friction
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.leaning import BraceApproach

# -- what is felt ---------------------------------------------------------------------------------


def test_a_push_that_grows_slowly_is_felt(approach):
    course = settled(approach)
    most = 0.7 * lift_off(approach)
    rate = 2.5e-4 / np.linalg.norm(pushed(approach, most))  # 0.25 mm/s
    for number in range(int(1 / (0.025 * rate))):
        assert samples(course, approach, 0.025 * number * rate * pushed(approach, most), 1) is None
    assert np.linalg.norm(course.push - most) < 0.5 * np.linalg.norm(most)
    assert course.force < 0.7 * approach.hold.forces[0]


def test_a_tip_that_goes_along_an_arc_is_no_push_along_the_arm(approach):
    """A push across moves it by 30 mm, and 3 mm along the arm, which is stiff."""
    course, tip, p = held(approach), approach.tips[-1], approach.pressures[-1]
    length = ROBOT.tip_pose(np.zeros(6))[2, 3]
    along = -(0.03**2) / (2 * length)
    pose = tip.pose.copy()
    pose[:3, :3] = np.eye(3)
    bent = TipAt(pose, tip.jacobian, np.diag([0.25, 0.25, 4e-3, 1.0, 1.0, 1.0]))
    for off in (*[np.zeros(3)] * 40, *[np.array([0.0, 0.03, along])] * 40):
        course.look(0.025, pose[:3, 3] + off, bent, p)
    across, apparent = course.push[1], abs(along) / 4e-3
    assert across == pytest.approx(0.12, rel=0.05)
    assert abs(course.push[2]) < 0.03 < 0.6 < apparent
    assert abs(course.push[2]) < math.sqrt(course.covariance[2, 2])


def test_a_push_along_which_the_tip_does_not_move_may_be_any(approach):
    """Its deviation there is that of all pushes, and by hand where the tip moves by 0.1 m/N."""
    course, tip = held(approach), approach.tips[-1]
    pose = tip.pose.copy()
    pose[:3, :3] = np.eye(3)
    still = TipAt(pose, tip.jacobian, np.diag([0.1, 1e-6, 1e-6, 1.0, 1.0, 1.0]))
    for off in (*[np.zeros(3)] * 40, *[np.array([3e-3, 0.0, 0.0])] * 40):
        course.look(0.025, pose[:3, 3] + off, still, approach.pressures[-1])
    assert course.push == pytest.approx([0.03, 0.0, 0.0], abs=1e-3)
    assert np.sqrt(np.diag(course.covariance)) == pytest.approx([2e-4 / 0.1, 0.1, 0.1], rel=0.05)


def test_a_sample_that_is_not_finite_does_not_count(approach):
    course, lifts = settled(approach), lift_off(approach)
    samples(course, approach, np.full(3, math.nan), 1)
    assert course.force == pytest.approx(approach.hold.forces[0])
    assert samples(course, approach, pushed(approach, 2.5 * lifts), 40) is not None


# -- what is no push ------------------------------------------------------------------------------


def test_the_friction_that_the_plan_followed_is_no_push_and_no_loss(approach):
    """The tip is where friction leaves it, and then where the arm without friction is."""
    friction = Friction(approach.hold, approach.pressures[-1])
    off = friction.tip[:3] @ friction.forces
    assert np.linalg.norm(off) > 1e-3
    course = held(approach, contacts="sticking")
    assert samples(course, approach, off, 400) is None
    assert course.contacts == "held"
    assert not course.push.any()


def test_an_error_of_the_model_and_creep_are_no_push(approach):
    course = held(approach)
    across = np.cross(approach.free_tips[-1] - approach.tips[-1].pose[:3, 3], [0.0, 0.0, 1.0])
    across *= 3e-3 / np.linalg.norm(across)
    for step in range(400):  # 0.1 mm/s
        assert samples(course, approach, across * (1 + step * 0.025 / 30), 1) is None
    assert not course.push.any()
    assert math.isnan(course.margin)
    assert course.force == pytest.approx(approach.hold.forces.min())


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_creep_of_a_hold_is_no_push(approach, way):
    """It moves the tip by 1 % of what the pressures do, per e-fold, either way along the push."""
    course, tip = held(approach), approach.tips[-1]
    moves = float(np.linalg.norm(tip.jacobian[:3] @ approach.pressures[-1]))
    off = pushed(approach, way * lift_off(approach))
    off *= 0.01 * moves / np.linalg.norm(off)
    for number in range(1200):
        assert samples(course, approach, off * math.log(1 + number * 0.025 / 3), 1) is None
        assert course.contacts == "held"
    assert course.deviation == pytest.approx(0.2 * approach.hold.forces[0], rel=0.01)


# -- pushes that are slow, last or are corrected --------------------------------------------------


def ramp(course: Bracing, approach: BraceApproach, start: Any, end: Any, count: int) -> int:
    """Look at samples of a push that grows; how many it took until it is not `held` any more."""
    for number in range(count):
        push = start + (end - start) * number / count
        samples(course, approach, pushed(approach, push), 1)
        if course.contacts != "held":
            return number
    return count


def test_a_push_that_lasts_for_minutes_is_not_forgotten(approach):
    """0.4 of what lifts the contact off becomes the model's error, but the force is less known."""
    course, lifts = settled(approach), lift_off(approach)
    assert ramp(course, approach, 0 * lifts, 0.4 * lifts, 80) == 80
    assert samples(course, approach, pushed(approach, 0.4 * lifts), 4800) is None
    whole = approach.hold.forces[0]
    assert not course.push.any()
    assert course.force - 2 * course.deviation < 0.5 * whole
    assert ramp(course, approach, 0.4 * lifts, lifts, 80) < 80
    assert course.contacts == "uncertain"
    assert samples(course, approach, pushed(approach, lifts), 40) is None
    assert course.force < 2 * course.deviation
    assert samples(course, approach, pushed(approach, lifts), 2500) is not None


@pytest.mark.parametrize("seconds", [300, 900])
def test_a_push_too_slow_to_be_felt_makes_contacts_uncertain(approach, seconds):
    course, lifts = settled(approach), lift_off(approach)
    count = 40 * seconds
    told = ramp(course, approach, 0 * lifts, 1.5 * lifts, count)
    assert 0.3 < 1.5 * told / count < 0.8
    assert not course.push.any()
    (alarm,) = [notice for notice in course.notices() if notice.standing]
    assert "since the tip has moved away as by a slow push" in alarm.text
    off = pushed(approach, 1.6 * told / count * lifts)
    assert samples(course, approach, off, 2600) == pytest.approx(60.0, abs=2.0)


def test_a_push_that_the_loop_corrects_makes_a_light_contact_uncertain(approach):
    """It lifts off where the tip has moved by 0.4 mm, as far as a correction that is withheld."""
    share = 4e-4 / np.linalg.norm(pushed(approach, lift_off(approach)))
    light = replace(approach, hold=approach.hold._replace(forces=share * approach.hold.forces))
    course, off = settled(light), pushed(light, lift_off(light))
    tip, change = light.tips[-1], course.pressures
    jacobian = tip.pose[:3, :3] @ tip.jacobian[:3]
    for number in range(800):
        at = off * number / 800
        samples(course, light, at, 1)
        error = -at - jacobian @ (course.pressures - change)
        course.correct(0.025, error, jacobian, (np.full(6, -1e6), np.full(6, 1e6)))
        if course.contacts != "held":
            break
    assert not course.push.any()
    assert course.contacts == "uncertain"
    assert number < 600


def test_a_slow_push_that_hardly_moves_a_stiff_arm_is_told_in_time(approach):
    """It lifts off in five seconds, when the tip has moved by 0.8 mm."""
    very_stiff, lifts = stiff(approach, 8e-4)
    course = settled(very_stiff)
    for number in range(1, 300):
        samples(course, very_stiff, pushed(very_stiff, number * 0.025 / 5.0 * lifts), 1)
        if course.contacts == "uncertain":
            break
    assert 0.3 * 5.0 < number * 0.025 < 5.0 + 0.3


def test_a_push_below_the_loss_is_held_and_becomes_the_models_error_in_the_end(approach):
    very_stiff, lifts = stiff(approach, 8e-4)
    course = settled(very_stiff)
    off = pushed(very_stiff, 0.35 * lifts)
    assert samples(course, very_stiff, off, 800) is None
    assert course.force == pytest.approx(0.65 * approach.hold.forces[0], rel=0.2)
    assert samples(course, very_stiff, off, 2400) is None
    for _ in range(20):
        assert samples(course, very_stiff, off, 1) is None
        assert not course.push.any()
    assert course.force == pytest.approx(approach.hold.forces[0])
