"""Contacts of a braced arm: held, uncertain or lost, by their force and its deviation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from leaning_arm import (
    TASK,
    approach_fixture,  # noqa: F401
    held,
    lift_off,
    pushed,
    samples,
    settled,
)
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.paths.leaning import BraceApproach


def standing(course: Bracing) -> list[str]:
    """Kinds of the alarms that stand."""
    return [notice.kind for notice in course.notices() if notice.standing]


def test_the_deviation_of_a_force_is_that_of_what_it_comes_from(approach):
    """By hand: 30 mN before; 1.0 and 0.5 times 10 mN of push; a tenth of a change of 50 mN."""
    hold = approach.hold._replace(
        forces=np.array([0.1]), deviations=np.array([0.03]), per_push=np.array([[-1.0, 0.5, 0.0]])
    )
    course = held(replace(approach, hold=hold))
    course.covariance = 0.01**2 * np.eye(3)
    (found,) = course._deviations(hold.forces, np.array([-0.05]))
    assert found == pytest.approx(math.sqrt(0.03**2 + 1.25 * 0.01**2 + 0.005**2))
    course._tuning = replace(course._tuning, least_deviation=0.5)
    (found,) = course._deviations(hold.forces, np.array([0.0]))
    assert found == pytest.approx(math.sqrt(0.05**2 + 1.25 * 0.01**2))


def test_a_force_that_is_badly_known_at_rest_is_stated_with_its_deviation(approach):
    own = 0.7 * approach.hold.forces
    unsure = replace(approach, hold=approach.hold._replace(deviations=own))
    course = held(unsure)
    samples(course, unsure, np.zeros(3), 120)
    assert course.contacts == "held"
    assert course.deviation == pytest.approx(own[0])


@pytest.mark.parametrize(
    ("share", "contacts"), [(0.3, "held"), (0.8, "uncertain"), (1.2, "uncertain"), (2.0, "lost")]
)
def test_contacts_are_held_uncertain_or_lost_by_the_force_and_its_deviation(
    approach, share, contacts
):
    course, lifts = settled(approach), lift_off(approach)
    assert course.deviation == pytest.approx(0.2 * approach.hold.forces[0], rel=0.01)
    (contact,) = course.held
    assert (contact.object, contact.state) == ("post", "held")
    assert contact.at == approach.contacts[0].at
    assert (contact.force, contact.deviation) == (course.force, course.deviation)
    after = samples(course, approach, pushed(approach, share * lifts), 80)
    assert course.contacts == contacts
    kinds = [notice.kind for notice in course.notices()]
    expected = {"held": [], "uncertain": ["brace-uncertain"] * 2, "lost": ["brace-lost"] * 2}
    assert [kind for kind in kinds[1:] if kind != "brace-slips"][-2:] == expected[contacts]
    assert (after is not None) == (contacts == "lost")
    assert [each.state for each in course.held] == [contacts]
    assert np.isfinite(course.held[0].force) == (contacts != "lost")
    if contacts != "lost":
        left = (1 - share) * approach.hold.forces[0]
        assert course.force == pytest.approx(left, abs=0.05 * approach.hold.forces[0])
        assert (course.force > 2 * course.deviation) == (contacts == "held")
        assert np.linalg.norm(course.push - share * lifts) < 0.2 * np.linalg.norm(lifts)


def test_contacts_are_judged_at_pressures_that_the_silicone_keeps_off_the_plan(approach):
    """Creep takes up to a tenth of a pressure, for which a supply at its limit has no more."""
    steady = replace(
        approach, hold=approach.hold._replace(per_pressure=0 * approach.hold.per_pressure)
    )
    course, tip = held(steady), steady.tips[-1]
    p = steady.pressures[-1] - np.array([2e4, 0, 0, 0, 0, 0])
    for off in (*[np.zeros(3)] * 40, *[pushed(steady, (1.0, 0, 0))] * 12):
        course.look(0.025, tip.pose[:3, 3] + off, tip, p)
    assert course.phase is BracePhase.RELEASING


# -- uncertain ------------------------------------------------------------------------------------


def test_uncertainty_ends_with_its_push_and_comes_again_with_the_next(approach):
    course, lifts = settled(approach), lift_off(approach)
    for _ in range(2):
        assert samples(course, approach, pushed(approach, 0.9 * lifts), 40) is None
        said = course.notices()
        assert [each.kind for each in said if not each.standing][-1] == "brace-uncertain"
        assert standing(course) == ["brace-uncertain"]
        assert samples(course, approach, np.zeros(3), 100) is None
        assert course.contacts == "held"
        assert standing(course) == []


def test_a_push_about_the_limit_does_not_make_the_alarm_flicker(approach):
    """Contacts are certain again only after two seconds of certainty."""
    course, lifts = settled(approach), lift_off(approach)
    share = 0.0
    while course.contacts == "held":
        share += 0.01
        samples(course, approach, pushed(approach, share * lifts), 10)
    course.notices()
    for change in (-0.1, 0.02, -0.1, 0.02):
        samples(course, approach, pushed(approach, (share + change) * lifts), 60)
        assert course.contacts == "uncertain"
    assert [notice.standing for notice in course.notices()] == [True]
    samples(course, approach, pushed(approach, (share - 0.1) * lifts), 100)
    assert course.contacts == "held"


def test_contacts_that_stay_uncertain_for_a_minute_are_let_go(approach):
    course, lifts = settled(approach), lift_off(approach)
    after = samples(course, approach, pushed(approach, 0.8 * lifts), 3000)
    assert after == pytest.approx(60.0, abs=1.0)
    text = course.notices()[-1].text
    assert "for 60 s it was uncertain: the contact on 'post' may have lifted off" in text


def test_the_arm_does_not_let_go_of_contacts_that_are_certain_again(approach):
    """The push ends shortly before a minute of doubt is over."""
    course, lifts = settled(approach), lift_off(approach)
    assert samples(course, approach, pushed(approach, 0.8 * lifts), 2344) is None
    assert samples(course, approach, np.zeros(3), 200) is None
    assert course.contacts == "held"


# -- lost -----------------------------------------------------------------------------------------


def test_a_lift_off_is_told_within_300_ms_and_the_arm_lets_go_when_it_is_certain(approach):
    """A push grows by a tenth of what lifts the contact off in a second, and then jumps."""
    course, lifts = settled(approach), lift_off(approach)
    said = course.notices()
    for number in range(round(10.3 / 0.025)):
        assert samples(course, approach, pushed(approach, number * 2.5e-3 * lifts), 1) is None
        said += course.notices()
    (told,) = [each for each in said if each.kind == "brace-uncertain" and not each.standing]
    assert "the contact on 'post' may have lifted off: it has 0 to " in told.text
    assert course.contacts == "uncertain"
    after = samples(course, approach, pushed(approach, 2.5 * lifts), 40)
    assert after is not None
    assert after <= 0.3
    lost = [each for each in course.notices() if each.kind == "brace-lost"]
    assert "the contact on 'post' lifts off under a push of" in lost[0].text
    assert [each.standing for each in lost] == [False, True]
    assert course.contacts == "lost"


def test_an_arm_without_contact_is_told_whatever_pushes_it(approach):
    course = held(approach)
    apart = approach.free_tips[-1] - approach.tips[-1].pose[:3, 3]
    assert np.linalg.norm(apart) > 4e-3
    after = samples(course, approach, apart, 40)
    assert after is not None
    assert after <= 0.3
    assert "where an arm without contact has it" in course.notices()[-1].text


@pytest.mark.parametrize("is_rough", [True, False])
def test_an_arm_that_is_neither_where_it_was_planned_nor_free_is_told_why(approach, is_rough):
    hold = approach.hold
    if not is_rough:
        smooth = hold.sticking._replace(
            own=(), across=np.zeros((0, 2, 3)), friction=np.zeros(0),
            per_pressure=np.zeros((0, 6)), per_push=np.zeros((0, 3)), per_slide=np.zeros((0, 0)),
            tip=np.zeros((6, 0)), normals=np.zeros((len(hold.forces), 0)),
        )  # fmt: skip
        own = hold._replace(sticking=smooth, tangential=np.zeros(0))
        approach = replace(approach, hold=own)
    course = held(approach)
    apart = approach.free_tips[-1] - approach.tips[-1].pose[:3, 3]
    aside = np.cross(apart, [0.0, 0.0, 1.0])
    off = 0.8 * apart + 0.9 * aside * np.linalg.norm(apart) / np.linalg.norm(aside)
    assert samples(course, approach, off, 40) is not None
    told = course.notices()[-1].text
    assert f"the tip is {1e3 * np.linalg.norm(off):.0f} mm from where the plan put it" in told
    likely = "friction on 'post' probably holds" if is_rough else "check the place of 'post'"
    assert likely in told
    assert not course.held, "no contact is lost"


# -- two contacts ---------------------------------------------------------------------------------


def with_a_rib(approach: BraceApproach, per_push: np.ndarray) -> BraceApproach:
    """The approach to a post and a rib, with equal forces; `per_push` (2, 3) changes them."""
    hold, contact = approach.hold, approach.contacts[0]
    return replace(
        approach,
        contacts=(contact, contact._replace(object="rib")),
        hold=hold._replace(
            forces=np.repeat(hold.forces, 2),
            deviations=np.zeros(2),
            per_pressure=np.repeat(hold.per_pressure, 2, axis=0),
            per_push=per_push,
        ),
    )


def test_the_doubt_of_a_second_contact_is_told_and_the_alarm_follows(approach):
    """A push along x would lift off the post, and a tenth of it along y a rib."""
    hold, lifts = approach.hold, lift_off(approach)
    rate = float(hold.per_push[0, 0])
    both = with_a_rib(approach, np.array([[rate, 0.0, 0.0], [0.0, 10 * rate, 0.0]]))
    course, other = settled(both), 0.11 * lifts[[1, 0, 2]]
    assert [each.state for each in course.held] == ["held", "held"]
    samples(course, both, pushed(both, 0.9 * lifts), 80)
    post, rib = course.held
    assert (post.object, post.state, rib.object, rib.state) == ("post", "uncertain", "rib", "held")
    assert post.force < 0.2 * hold.forces[0]
    assert rib.force == pytest.approx(hold.forces[0], rel=0.1)
    samples(course, both, pushed(both, other), 20)
    said = course.notices()
    events = [each.text for each in said if each.kind == "brace-uncertain" and not each.standing]
    assert [("'post'" in text, "'rib'" in text) for text in events] == [(1, 0), (0, 1)]
    assert "'post'" in said[-1].text
    assert "'rib'" in said[-1].text
    samples(course, both, pushed(both, other), 100)
    (alarm,) = course.notices()
    assert alarm.text == events[1]
    samples(course, both, pushed(both, 5 * other), 80)
    assert [(each.object, each.state) for each in course.held] == [("rib", "lost")]
    course.release(then=TASK)
    assert course.phase is BracePhase.RELEASING


def test_all_contacts_that_lift_off_together_are_lost(approach):
    both = with_a_rib(approach, np.repeat(approach.hold.per_push, 2, axis=0))
    course = settled(both)
    samples(course, both, pushed(both, 3.5 * lift_off(approach)), 80)
    assert [(each.object, each.state) for each in course.held] == [
        ("post", "lost"),
        ("rib", "lost"),
    ]
