"""An arm that leans on objects: the way into contact, the hold, loss and release."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import stiffopt
from leaning_arm import (
    LIMITS,
    PERIOD,
    ROBOT,
    TASK,
    approach_fixture,  # noqa: F401
    few_starts_fixture,  # noqa: F401
    solution_fixture,  # noqa: F401
)
from stiffopt import lie
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.friction import Friction
from stiffopt.control.linearised_tip import LeaningTip
from stiffopt.control.sliding import SlideEstimator
from stiffopt.control.tuning import BracingTuning, SlidingTuning
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.configurations import Unsolved
from stiffopt.paths.leaning import FORCE_RATE, SPEED, BraceApproach, approach_to

# -- the way ----------------------------------------------------------------------------------


def test_the_approach_ends_in_the_answer_slowly(solution, approach):
    """Its equilibria are the model's, from rest; speeds and rates of force are as they say."""
    assert not approach.pressures[0].any()
    assert approach.pressures[-1] == pytest.approx(solution.pressures)
    assert approach.tips[-1].pose[:3, 3] == pytest.approx(solution.tip_pose[:3, 3], abs=1e-5)
    middle = len(approach.tips) // 2
    eq = ROBOT.contact_equilibrium(approach.pressures[middle], TASK.scene)
    assert approach.tips[middle].pose == pytest.approx(eq.tip_pose, abs=1e-6)
    assert approach.forces[middle] == pytest.approx(
        max((np.linalg.norm(each.force) for each in eq.contacts), default=0.0), abs=1e-6
    )
    passed = np.diff(approach.times)
    moved = np.linalg.norm(np.diff([tip.pose[:3, 3] for tip in approach.tips], axis=0), axis=1)
    assert (moved <= SPEED * passed * (1 + 1e-9)).all()
    assert (np.abs(np.diff(approach.forces)) <= FORCE_RATE * passed * (1 + 1e-9)).all()
    limited = approach_to(ROBOT, solution, np.full(6, 1e4))
    assert limited.times[-1] == pytest.approx(solution.pressures.max() / 1e4)


def test_what_contacts_hold_is_that_of_the_equilibrium(approach):
    eq = ROBOT.contact_equilibrium(approach.pressures[-1], TASK.scene)
    hold, push = approach.hold, np.array([0.02, 0.01, -0.01])
    pushed = ROBOT.contact_equilibrium(
        approach.pressures[-1], TASK.scene, load=[*push, 0, 0, 0]
    ).normal_forces
    assert hold.forces + hold.per_push @ push == pytest.approx(pushed, abs=3e-3)
    loss = eq.lift_off([1, 0, 0], contacts="sticking")
    assert loss.how == "slips"
    relieved = hold._replace(tangential=0 * hold.tangential)
    left = Friction(relieved, approach.pressures[-1]).left(np.array([1.0, 0, 0]), hold.forces)
    assert left == pytest.approx(loss.force, rel=0.1)


def test_a_way_that_is_not_clear_or_ends_elsewhere_is_refused(solution):
    low = stiffopt.SceneObject(name="rib", sphere={"centre": (-0.045, 0, 0.17), "radius": 0.005})
    scene = TASK.scene.model_copy(update={"objects": (*TASK.scene.objects, low)})
    task = solution.task.model_copy(update={"scene": scene})
    with pytest.raises(Unsolved, match="too near an object"):
        approach_to(ROBOT, replace(solution, task=task))
    elsewhere = solution.tip_pose.copy()
    elsewhere[0, 3] += 0.01
    with pytest.raises(Unsolved, match="another equilibrium: the tip is 10 mm away"):
        approach_to(ROBOT, replace(solution, tip_pose=elsewhere))


def test_the_tip_on_the_way_is_linear_about_equilibria(approach):
    tip = LeaningTip(approach)
    p = 0.97 * approach.pressures[-1] + 300.0
    eq = ROBOT.contact_equilibrium(p, TASK.scene)
    found = tip.at(p)
    assert found.pose[:3, 3] == pytest.approx(eq.tip_pose[:3, 3], abs=5e-5)


# -- the course -------------------------------------------------------------------------------


def held(approach: BraceApproach, **brace: Any) -> Bracing:
    task = TASK.model_copy(update={"brace": TASK.brace.model_copy(update=brace)})
    course = Bracing(task, BracingTuning(settling=0.1, relief=0.0))
    course.begin(approach, np.zeros(6))
    for _ in range(10_000):
        course.advance(PERIOD, True)
        if course.phase is BracePhase.HELD:
            return course
    raise AssertionError(course.phase)


def samples(course: Bracing, approach: BraceApproach, off: Any, count: int) -> float | None:
    """Look at samples of a tip that is off the braced one; when it was let go, in s."""
    tip, p = approach.tips[-1], approach.pressures[-1]
    for number in range(1, count + 1):
        course.look(0.025, tip.pose[:3, 3] + off, tip, p)
        if course.phase is BracePhase.RELEASING:
            return 0.025 * number
    return None


def pushed(approach: BraceApproach, force: Any) -> Any:
    """Displacement of the braced tip by a force."""
    tip = approach.tips[-1]
    R = tip.pose[:3, :3]
    return R @ tip.compliance[:3, :3] @ R.T @ np.asarray(force)


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
        assert course._friction.forces == pytest.approx(forces)
        course.look(0.025, tip.pose[:3, 3], tip, p)
    assert course.phase is BracePhase.HELD


def test_the_friction_that_the_plan_followed_is_no_push_and_no_loss(approach):
    """The tip is where friction leaves it, and then where the arm without friction is."""
    friction = Friction(approach.hold, approach.pressures[-1])
    off = friction.tip[:3] @ friction.forces
    assert np.linalg.norm(off) > 1e-3
    course = held(approach, contacts="sticking")
    assert samples(course, approach, off, 400) is None
    assert course.contacts == "held"
    assert not course.push.any()


def test_a_push_that_grows_slowly_is_felt(approach):
    course = held(approach)
    samples(course, approach, np.zeros(3), 40)
    most = 0.7 * lift_off(approach)
    rate = 2.5e-4 / np.linalg.norm(pushed(approach, most))  # 0.25 mm/s
    for number in range(int(1 / (0.025 * rate))):
        assert samples(course, approach, 0.025 * number * rate * pushed(approach, most), 1) is None
    assert np.linalg.norm(course.push - most) < 0.5 * np.linalg.norm(most)
    assert course.force < 0.7 * approach.hold.forces[0]


def lift_off(approach: BraceApproach) -> Any:
    """The push along x that lifts the contact off, in N."""
    lifts = float(-approach.hold.forces[0] / approach.hold.per_push[0, 0])
    assert lifts > 0
    return lifts * np.array([1.0, 0.0, 0.0])


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


@pytest.mark.parametrize(
    ("share", "contacts"), [(0.3, "held"), (0.8, "uncertain"), (1.2, "uncertain"), (2.0, "lost")]
)
def test_contacts_are_held_uncertain_or_lost_by_the_force_and_its_deviation(
    approach, share, contacts
):
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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


def test_a_lift_off_is_told_within_300_ms_and_the_arm_lets_go_when_it_is_certain(approach):
    """A push grows by a tenth of what lifts the contact off in a second, and then jumps."""
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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


def test_uncertainty_ends_with_its_push_and_comes_again_with_the_next(approach):
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
    after = samples(course, approach, pushed(approach, 0.8 * lifts), 3000)
    assert after == pytest.approx(60.0, abs=1.0)
    text = course.notices()[-1].text
    assert "for 60 s it was uncertain: the contact on 'post' may have lifted off" in text


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
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
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
    course, off = held(light), pushed(light, lift_off(light))
    samples(course, light, np.zeros(3), 40)
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


def test_a_force_that_is_badly_known_at_rest_is_stated_with_its_deviation(approach):
    own = 0.7 * approach.hold.forces
    unsure = replace(approach, hold=approach.hold._replace(deviations=own))
    course = held(unsure)
    samples(course, unsure, np.zeros(3), 120)
    assert course.contacts == "held"
    assert course.deviation == pytest.approx(own[0])


def test_the_arm_does_not_let_go_of_contacts_that_are_certain_again(approach):
    """The push ends shortly before a minute of doubt is over."""
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
    assert samples(course, approach, pushed(approach, 0.8 * lifts), 2344) is None
    assert samples(course, approach, np.zeros(3), 200) is None
    assert course.contacts == "held"


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
    course, other = held(both), 0.11 * lifts[[1, 0, 2]]
    samples(course, both, np.zeros(3), 40)
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


def test_a_slip_that_comes_and_goes_is_reported_once(approach):
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
    for _ in range(5):
        samples(course, approach, pushed(approach, 0.4 * lifts), 30)
        samples(course, approach, np.zeros(3), 40)
    told = [notice.kind for notice in course.notices()]
    assert told == ["braced", "brace-slips"]


def test_a_sample_that_is_not_finite_does_not_count(approach):
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
    samples(course, approach, np.full(3, math.nan), 1)
    assert course.force == pytest.approx(approach.hold.forces[0])
    assert samples(course, approach, pushed(approach, 2.5 * lifts), 40) is not None


def stiff(approach: BraceApproach, moved: float) -> tuple[BraceApproach, Any]:
    """The same approach with a tip that moves by so much until it lifts off, and that push."""
    lifts, tip = lift_off(approach), approach.tips[-1]
    compliance = tip.compliance * moved / np.linalg.norm(pushed(approach, lifts))
    tips = (*approach.tips[:-1], tip._replace(compliance=compliance))
    return replace(approach, tips=tips), lifts


def test_a_slow_push_that_hardly_moves_a_stiff_arm_is_told_in_time(approach):
    """It lifts off in five seconds, when the tip has moved by 0.8 mm."""
    very_stiff, lifts = stiff(approach, 8e-4)
    course = held(very_stiff)
    samples(course, very_stiff, np.zeros(3), 40)
    for number in range(1, 300):
        samples(course, very_stiff, pushed(very_stiff, number * 0.025 / 5.0 * lifts), 1)
        if course.contacts == "uncertain":
            break
    assert 0.3 * 5.0 < number * 0.025 < 5.0 + 0.3


def test_a_push_below_the_loss_is_held_and_becomes_the_models_error_in_the_end(approach):
    very_stiff, lifts = stiff(approach, 8e-4)
    course = held(very_stiff)
    samples(course, very_stiff, np.zeros(3), 40)
    off = pushed(very_stiff, 0.35 * lifts)
    assert samples(course, very_stiff, off, 800) is None
    assert course.force == pytest.approx(0.65 * approach.hold.forces[0], rel=0.2)
    assert samples(course, very_stiff, off, 2400) is None
    for _ in range(20):
        assert samples(course, very_stiff, off, 1) is None
        assert not course.push.any()
    assert course.force == pytest.approx(approach.hold.forces[0])


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


@pytest.mark.parametrize("contacts", ["sliding", "sticking"])
def test_a_slip_by_the_push_alone_is_told_and_does_not_let_go(approach, contacts):
    hold = approach.hold
    approach = replace(approach, hold=hold._replace(tangential=0 * hold.tangential))
    friction = Friction(approach.hold, approach.pressures[-1])
    slips = friction.left(np.array([1.0, 0, 0]), approach.hold.forces)
    course = held(approach, contacts=contacts)
    samples(course, approach, np.zeros(3), 40)
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
    course, tip, p = held(approach, contacts="sticking"), approach.tips[-1], approach.pressures[-1]
    course._tuning = replace(course._tuning, felt=math.inf, least_felt=math.inf)
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


def test_an_arm_that_is_let_down_is_not_told_to_slip(approach):
    """The silicone follows its pressures late, so its tip is off the model's at each of them."""
    course, tip, p = held(approach), approach.tips[-1], approach.pressures[-1]
    samples(course, approach, np.zeros(3), 40)
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
    course = held(approach)
    samples(course, approach, np.zeros(3), 40)
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


def test_all_contacts_that_lift_off_together_are_lost(approach):
    both = with_a_rib(approach, np.repeat(approach.hold.per_push, 2, axis=0))
    course = held(both)
    samples(course, both, np.zeros(3), 40)
    samples(course, both, pushed(both, 3.5 * lift_off(approach)), 80)
    assert [(each.object, each.state) for each in course.held] == [
        ("post", "lost"),
        ("rib", "lost"),
    ]


def test_an_error_of_the_model_and_creep_are_no_push(approach):
    course = held(approach)
    across = np.cross(approach.free_tips[-1] - approach.tips[-1].pose[:3, 3], [0.0, 0.0, 1.0])
    across *= 3e-3 / np.linalg.norm(across)
    for step in range(400):  # 0.1 mm/s
        assert samples(course, approach, across * (1 + step * 0.025 / 30), 1) is None
    assert not course.push.any()
    assert math.isnan(course.margin)
    assert course.force == pytest.approx(approach.hold.forces.min())


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
