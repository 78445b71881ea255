"""Contacts of a braced arm that slip under a push, and slides that the tip shows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leaning_arm import (
    TUNING,
    approach_fixture,  # noqa: F401
    held,
    lift_off,
    pushed,
    samples,
    settled,
)
from stiffopt import lie
from stiffopt.control.bracing import BracePhase
from stiffopt.control.contact_tuning import SlidingTuning
from stiffopt.control.friction import Friction
from stiffopt.control.sliding import SlideEstimator
from stiffopt.paths.leaning import BraceApproach


def test_a_slip_that_comes_and_goes_is_reported_once(approach):
    course, lifts = settled(approach), lift_off(approach)
    for _ in range(5):
        samples(course, approach, pushed(approach, 0.4 * lifts), 30)
        samples(course, approach, np.zeros(3), 40)
    told = [notice.kind for notice in course.notices()]
    assert told == ["braced", "brace-slips"]


@pytest.mark.parametrize("contacts", ["sliding", "sticking"])
def test_a_slip_by_the_push_alone_is_told_and_does_not_let_go(approach, contacts):
    hold = approach.hold
    approach = replace(approach, hold=hold._replace(tangential=0 * hold.tangential))
    friction = Friction(approach.hold, approach.pressures[-1])
    slips = friction.left(np.array([1.0, 0, 0]), approach.hold.forces)
    course = settled(approach, contacts=contacts)
    push = np.array([1.4 * slips, 0, 0])
    moved = pushed(approach, push)
    if contacts == "sticking":
        moved += friction.tip[:3] @ approach.hold.sticking.per_push @ push
    assert samples(course, approach, moved, 12) is None
    said = course.notices()
    (told,) = [each for each in said if "sli" in each.text and not each.standing]
    if contacts == "sliding":
        assert told.kind == "brace-slips"
        assert course.contacts == "held"
    else:
        assert told.kind == "brace-uncertain"
        assert "the contact on 'post' may slide under a push of" in told.text
        assert course.contacts == "uncertain"
        assert samples(course, approach, moved, 400) is None
        assert course.contacts == "uncertain", "the push does not become creep meanwhile"


def moved_tip(approach: BraceApproach, push: Any, slides: Any, error: Any) -> tuple[Any, Any]:
    """Position and orientation of the tip by a push (3,), slides (2k,) and a displacement (6,)."""
    tip, held = approach.tips[-1], approach.hold.sticking
    R = tip.pose[:3, :3]
    friction = Friction(approach.hold, approach.pressures[-1])
    per_push = lie.rotate_blocks(R) @ tip.compliance[:, :3] @ R.T + friction.tip @ held.per_push
    off = per_push @ push + held.tip @ slides + error
    turn = lie.exp(np.concatenate([np.zeros(3), off[3:]]))[:3, :3]
    return tip.pose[:3, 3] + off[:3], lie.quaternion_from_rotation(turn @ R)


@pytest.mark.parametrize(
    ("way", "has_turn", "share"), [(0, True, 0), (1, True, 0), (1, False, 0), (1, True, 0.03)]
)
def test_slides_are_known_apart_from_creep_and_pushes(approach, way, has_turn, share):
    """A push that grows and one that jumps, creep of 0.1 mm per e-fold, and then a slide.

    It may also creep as if all pressures grew by a share per e-fold. The position alone does not
    show slides across this arm.
    """
    friction = Friction(approach.hold, approach.pressures[-1])
    usual, rng, dt = 0.05**2 * np.eye(3), np.random.default_rng(way), 0.025
    sliding = SlideEstimator(approach, friction, usual, SlidingTuning())
    error, creep = rng.normal(0, np.repeat([2e-3, 2e-2], 3)), np.repeat([1e-4, 1e-3], 3)
    tip, p = approach.tips[-1], approach.pressures[-1]
    by_pressures = lie.rotate_blocks(tip.pose[:3, :3]) @ tip.jacobian
    creep += share * (by_pressures + friction.tip @ approach.hold.sticking.per_pressure) @ p
    wrong, sure, ways = [], [], rng.normal(size=(2, 3))
    for k in range(1, 2001):
        time = k * dt
        push = 0.02 * np.clip(time / 20 - 1, 0, 1) * ways[0] + 0.02 * (time > 35) * ways[1]
        slide = 3e-4 * np.clip((time - 45) / 4, 0, 1) * np.eye(2)[way]
        noise = rng.normal(0, np.repeat([5e-5, 1e-3], 3))
        off = error + creep * np.log(1 + time / 3) + noise
        seen, quaternion = moved_tip(approach, push, slide, off)
        sliding.take(dt, time, seen, quaternion if has_turn else None, p)
        wrong.append(np.linalg.norm(sliding.slides[0] - slide))
        sure.append(sliding.deviations()[0])
    assert max(wrong[400:]) < 2e-4
    assert max(sure[400:1800]) < 1.0 < sure[-1]


@pytest.mark.parametrize("slide", [0.0, 8e-4])
def test_a_slide_that_the_tip_shows_is_told_without_a_push_that_is_felt(approach, slide):
    numb = replace(TUNING, felt=math.inf, least_felt=math.inf)
    course = held(approach, numb, contacts="sticking")
    tip, p = approach.tips[-1], approach.pressures[-1]
    for k in range(800):
        slides = np.array([0.0, slide * np.clip(k / 40 - 15, 0, 1)])
        seen, quaternion = moved_tip(approach, np.zeros(3), slides, np.zeros(6))
        course.look(0.025, seen, tip, p, quaternion)
        if course.phase is BracePhase.RELEASING:
            break
    assert (course.phase is BracePhase.RELEASING) == bool(slide)
    assert "has slid by 0." in course.notices()[-1].text or not slide


@pytest.mark.parametrize("roll", [0.05, 1.0])
def test_a_sensor_that_turns_about_its_own_axis_is_no_slide(approach, roll):
    course, tip, p = held(approach, contacts="sticking"), approach.tips[-1], approach.pressures[-1]
    rolled = tip.pose[:3, :3] @ lie.exp(np.array([0, 0, 0, 0, 0, roll]))[:3, :3]
    for k in range(1600):
        R = rolled if k > 800 else tip.pose[:3, :3]
        course.look(0.025, tip.pose[:3, 3], tip, p, lie.quaternion_from_rotation(R))
    assert course.phase is BracePhase.HELD
    assert np.abs(course._slides.slides).max() < 1e-4
