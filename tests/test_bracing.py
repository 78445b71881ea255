"""The course of a brace: to rest, into contact, held, corrected, let go and let down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from leaning_arm import (
    LIMITS,
    PERIOD,
    TASK,
    approach_fixture,  # noqa: F401
    held,
    lift_off,
    pushed,
    samples,
    settled,
)
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.friction import Friction
from stiffopt.control.linearised_tip import LeaningTip


def test_it_goes_to_rest_leans_holds_and_goes_back(approach):
    course = Bracing(TASK, BracingTuning())
    assert course.phase is BracePhase.PLANNING
    start = np.full(6, 2e4)
    course.begin(approach, start)
    course.advance(1.0, False)
    assert course.pressures == pytest.approx(start * (1 - 1 / BracingTuning().to_rest))
    course.advance(5.0, False)
    assert course.phase is BracePhase.TO_REST, "the arm is not there yet"
    course.advance(0.0, True)
    assert course.leans
    course.advance(approach.times[30], True)
    assert course.pressures == pytest.approx(approach.pressures[30])
    course.release(then=TASK)
    assert course.phase is BracePhase.RELEASING
    course.advance(approach.times[30] - approach.times[10], True)
    assert course.pressures == pytest.approx(approach.pressures[10])
    course.advance(100.0, True)
    assert course.phase is BracePhase.RELEASED
    assert course.next is TASK
    assert not course.pressures.any()
    assert [notice.kind for notice in course.notices()] == ["release"]


def test_the_way_begins_and_ends_gradually(approach):
    """Its pace changes by no more than a second's worth, both ways, and it arrives."""
    course = Bracing(TASK, BracingTuning())
    course.begin(approach, np.zeros(6))
    course.advance(0.0, True)
    for end in ("held", "released"):
        shares = [course.pressures @ approach.pressures[-1]]
        while course.phase.value != end:
            course.advance(PERIOD, True)
            shares.append(course.pressures @ approach.pressures[-1])
            assert len(shares) * PERIOD < approach.times[-1] + 4.0
        full = approach.pressures[-1] @ approach.pressures[-1]
        at = np.interp(shares, np.linspace(0, full, len(approach.times)), approach.times)
        pace = np.abs(np.diff(at)) / PERIOD
        assert pace.max() > 0.8
        assert pace[0] < 0.05
        moving = pace[: np.flatnonzero(pace > 1e-6)[-1] + 1]
        assert moving[-3] < 0.25
        assert np.abs(np.diff(moving[:-2])).max() < 0.06
        course.release()


def test_friction_that_is_known_at_the_end_of_the_way_loses_no_contact_on_it(approach):
    """It moves the tip there by more than a free arm's, and does not count before."""
    hold, most = approach.hold, approach.pressures[-1]
    bends = Friction(hold, most).tip[:3]
    forces = np.linalg.lstsq(bends, np.array([0.03, 0, 0]), rcond=None)[0]
    off = bends @ forces
    assert np.linalg.norm(off) > 0.012
    tips = np.array([tip.pose[:3, 3] for tip in approach.tips])
    far = replace(
        approach,
        hold=hold._replace(tangential=forces),
        free_tips=tips - 0.02 * off / np.linalg.norm(off),
    )
    brace = TASK.brace.model_copy(update={"contacts": "sticking"})
    course = Bracing(TASK.model_copy(update={"brace": brace}), BracingTuning())
    model = LeaningTip(far)
    course.begin(far, np.zeros(6))
    course.advance(0.0, True)
    while course.phase is BracePhase.APPROACHING:
        course.advance(0.025, True)
        p = course.pressures
        tip = model.at(p)
        assert course._planned.friction.forces == pytest.approx(forces)
        course.look(0.025, tip.pose[:3, 3], tip, p)
    assert course.phase is BracePhase.HELD


def test_the_tip_goes_to_its_target_with_the_contact_force_as_it_is(approach):
    course, tip = held(approach), approach.tips[-1]
    linear = tip.pose[:3, :3] @ tip.jacobian[:3]
    error = np.array([0.0, 1e-3, 0.0])
    for _ in range(2000):
        left = error - linear @ (course.pressures - approach.pressures[-1])
        course.correct(PERIOD, left, linear, LIMITS)
    assert np.linalg.norm(left) < 0.3 * np.linalg.norm(error)
    change = approach.hold.per_pressure @ (course.pressures - approach.pressures[-1])
    assert np.abs(change).max() < 0.1 * approach.hold.forces.min()


def test_an_arm_that_is_let_down_is_not_told_to_slip(approach):
    """The silicone follows its pressures late, so its tip is off the model's at each of them."""
    course, tip, p = settled(approach), approach.tips[-1], approach.pressures[-1]
    lifting = pushed(approach, (1.0, 0, 0))
    for share in (0.95, 0.9, 0.8):
        for _ in range(8):
            course.follow(False, share * p)
            course.look(0.025, tip.pose[:3, 3] + lifting, tip, share * p)
    assert course.phase is BracePhase.HELD
    assert [notice.kind for notice in course.notices()] == ["braced"]
    course.follow(False, p)
    for _ in range(20):  # held, at the same pressures, a contact that is lost is told
        course.look(0.025, tip.pose[:3, 3] + lifting, tip, p)
    assert course.phase is BracePhase.RELEASING


def test_an_arm_that_is_let_down_has_no_contacts_and_no_alarm(approach):
    course = settled(approach)
    samples(course, approach, pushed(approach, 0.9 * lift_off(approach)), 40)
    assert course.contacts == "uncertain"
    assert course.held
    assert any(notice.standing for notice in course.notices())
    course.follow(False, approach.pressures[-1])  # held by others, still in contact
    assert course.contacts == "uncertain"
    course.follow(False, np.zeros_like(approach.pressures[-1]))
    assert (course.contacts, course.held) == ("", ())
    assert np.isnan([course.force, course.deviation, course.margin]).all()
    assert not any(notice.standing for notice in course.notices())
