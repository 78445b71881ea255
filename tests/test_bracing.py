"""An arm that leans on objects, in the loop: the way into contact, the hold, loss and release."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

import stiffopt
from stiffopt import lie
from stiffopt.cli.main import main
from stiffopt.control import planning
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.controller import TipController
from stiffopt.control.friction import Friction
from stiffopt.control.linearised_tip import LeaningTip
from stiffopt.control.sliding import SlideEstimator
from stiffopt.control.state import ControllerStatus
from stiffopt.control.tuning import BracingTuning, SlidingTuning
from stiffopt.errors import FileError, InputError
from stiffopt.optimise import braced
from stiffopt.optimise.settings import BRACE, Effort
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.configurations import Unsolved
from stiffopt.paths.leaning import FORCE_RATE, GRADUAL, SPEED, BraceApproach, approach_to, gradual
from stiffopt.paths.motion_file import read_motion
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant.settings import PlantLoad, PlantSettings, Silicone
from stiffopt.plots import plot_motion
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, slew_of

ROBOT = stiffopt.load_robot("stiff-flop-2")
TASK = stiffopt.load_task("problems/braced/post.yaml")
PERIOD = 0.01
LIMITS = (np.zeros(6), np.full(6, 1.5e5))


@pytest.fixture(scope="module", autouse=True)
def few_starts() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        few = replace(BRACE, effort=Effort(3, 1, 2), screened=256)
        patch.setattr(braced, "BRACE", few)
        yield


@pytest.fixture(scope="module")
def solution() -> PressureSolution:
    found = stiffopt.solve_pressure(ROBOT, TASK)
    assert [each.object for each in found.contacts] == ["post"]
    return found


@pytest.fixture(scope="module")
def approach(solution: PressureSolution) -> BraceApproach:
    return approach_to(ROBOT, solution)


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
    friction = Friction(hold, approach.pressures[-1])
    left = friction.left(np.array([1.0, 0, 0]), hold.forces)
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
    after = samples(course, approach, pushed(approach, share * lifts), 80)
    assert course.contacts == contacts
    kinds = [notice.kind for notice in course.notices()]
    expected = {"held": [], "uncertain": ["brace-uncertain"] * 2, "lost": ["brace-lost"] * 2}
    assert [kind for kind in kinds[1:] if kind != "brace-slips"][-2:] == expected[contacts]
    assert (after is not None) == (contacts == "lost")
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
    """Half of what lifts the contact off becomes the model's error, but the force is less known."""
    course, lifts = held(approach), lift_off(approach)
    samples(course, approach, np.zeros(3), 40)
    assert ramp(course, approach, 0 * lifts, 0.5 * lifts, 80) == 80
    assert samples(course, approach, pushed(approach, 0.5 * lifts), 4800) is None
    whole = approach.hold.forces[0]
    assert not course.push.any()
    assert course.force - 2 * course.deviation < 0.5 * whole
    assert ramp(course, approach, 0.5 * lifts, lifts, 80) < 80
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
    off = pushed(approach, 1.5 * told / count * lifts)
    assert samples(course, approach, off, 2600) == pytest.approx(60.0, abs=2.0)


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


def test_the_doubt_of_a_second_contact_is_told_and_the_alarm_follows(approach):
    """A push along x would lift off the post, and a tenth of it along y a rib."""
    hold, lifts = approach.hold, lift_off(approach)
    rate = float(hold.per_push[0, 0])
    both = replace(
        approach,
        contacts=(approach.contacts[0], approach.contacts[0]._replace(object="rib")),
        hold=hold._replace(
            forces=np.repeat(hold.forces, 2),
            deviations=np.zeros(2),
            per_pressure=np.repeat(hold.per_pressure, 2, axis=0),
            per_push=np.array([[rate, 0.0, 0.0], [0.0, 10 * rate, 0.0]]),
        ),
    )
    course, other = held(both), 0.11 * lifts[[1, 0, 2]]
    samples(course, both, np.zeros(3), 40)
    samples(course, both, pushed(both, 0.9 * lifts), 80)
    samples(course, both, pushed(both, other), 20)
    said = course.notices()
    events = [each.text for each in said if each.kind == "brace-uncertain" and not each.standing]
    assert [("'post'" in text, "'rib'" in text) for text in events] == [(1, 0), (0, 1)]
    assert "'post'" in said[-1].text
    assert "'rib'" in said[-1].text
    samples(course, both, pushed(both, other), 100)
    (alarm,) = course.notices()
    assert alarm.text == events[1]


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


@pytest.mark.parametrize(("way", "has_turn"), [(0, True), (1, True), (1, False)])
def test_slides_are_known_apart_from_creep_and_pushes(approach, way, has_turn):
    """A push that grows and one that jumps, creep of 0.1 mm per e-fold, and then a slide.

    The position alone does not show slides across this arm.
    """
    friction = Friction(approach.hold, approach.pressures[-1])
    usual, rng, dt = 0.05**2 * np.eye(3), np.random.default_rng(way), 0.025
    sliding = SlideEstimator(approach, friction, usual, SlidingTuning())
    error, creep = rng.normal(0, np.repeat([2e-3, 2e-2], 3)), np.repeat([1e-4, 1e-3], 3)
    wrong, sure, ways = [], [], rng.normal(size=(2, 3))
    for k in range(1, 2001):
        time = k * dt
        push = 0.02 * np.clip(time / 20 - 1, 0, 1) * ways[0] + 0.02 * (time > 35) * ways[1]
        slide = 3e-4 * np.clip((time - 45) / 4, 0, 1) * np.eye(2)[way]
        noise = rng.normal(0, np.repeat([5e-5, 1e-3], 3))
        off = error + creep * np.log(1 + time / 3) + noise
        seen, quaternion = moved_tip(approach, push, slide, off)
        sliding.take(dt, time, seen, quaternion if has_turn else None, approach.pressures[-1])
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


def test_an_arm_that_is_let_down_is_not_told_to_slip(approach):
    """The silicone follows its pressures late, so its tip is off the model's at each of them."""
    course, tip, p = held(approach), approach.tips[-1], approach.pressures[-1]
    samples(course, approach, np.zeros(3), 40)
    course.is_steered = False
    lifting = pushed(approach, (1.0, 0, 0))
    for share in (0.95, 0.9, 0.8):
        for _ in range(8):
            course.look(0.025, tip.pose[:3, 3] + lifting, tip, share * p)
    assert course.phase is BracePhase.HELD
    assert [notice.kind for notice in course.notices()] == ["braced"]
    for _ in range(20):  # held, at the same pressures, a contact that is lost is told
        course.look(0.025, tip.pose[:3, 3] + lifting, tip, p)
    assert course.phase is BracePhase.RELEASING


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


# -- the loop ---------------------------------------------------------------------------------


class Loop:
    """A controller and a simulated arm without inertia, beside the post or without it."""

    def __init__(
        self, scene: stiffopt.Scene | None = TASK.scene, world: stiffopt.Scene | None = None
    ) -> None:
        settings = PlantSettings(
            scene=world,
            dynamics="quasi-static",
            silicone=Silicone(creep=(), hysteresis=()),
            discretisation={
                "step": 0.01,
                "bending_degree": 2,
                "shear_degree": 1,
                "sub_intervals": 3,
            },
        )
        description = RigDescription(
            robot="stiff-flop-2",
            supply={"driver": "simulated"},
            tracker={"driver": "simulated", "noise": 5e-5},
            safety={"max_pressure": 1.5e5, "max_slew": 5e5},
            scene=scene,
            plant=settings,
        )
        self.rig: Any = make_rig(description, ROBOT.description)
        self.controller = TipController(
            ROBOT, limits_of(description, ROBOT.description),
            slew_of(description, ROBOT.description), period=PERIOD, control=description.control,
            safety=description.safety, vibrates=False, scene=scene,
        )  # fmt: skip
        self.controller.check()
        self.command = np.zeros(6)
        self.told: list[str] = []
        self.rig.open()
        self.rig.supply.arm()
        self.controller.begin(self.rig.clock.now())

    def until(self, done: Callable[[ControllerStatus], bool], within: float) -> float:
        """Go on until something is so; how long it took, in s."""
        controller, clock = self.controller, self.rig.clock
        begin = clock.now()
        while clock.now() < begin + within:
            now = clock.now()
            controller.observe(now, self.command, self.rig.supply.read(), self.rig.tracker.read())
            self.command = controller.compute(now).pressures
            self.rig.supply.command(self.command)
            self.told += [each.kind for each in controller.notices() if not each.standing]
            clock.sleep_until(now + PERIOD)
            self.status = controller.status(now)
            if done(self.status):
                return float(clock.now() - begin)
        raise AssertionError(f"{self.status.brace}: {self.told}")

    def wait(self, seconds: float) -> None:
        """Go on for so long."""
        end = self.rig.clock.now() + seconds
        self.until(lambda _: self.rig.clock.now() >= end, seconds + 1.0)

    @property
    def force(self) -> float:
        forces = self.rig.world.plant.object_forces()
        return sum(float(np.linalg.norm(each.force)) for each in forces)


def test_the_loop_leans_holds_tells_a_lift_off_and_lets_go(solution, approach, monkeypatch):
    def solver(robot: Any, task: stiffopt.Task) -> Any:
        """What was found before stands for the search."""
        known = SimpleNamespace(solve=lambda: solution)
        return known if task.brace is not None else PressureSolver(robot, task)

    monkeypatch.setattr(planning, "PressureSolver", solver)
    loop = Loop()
    loop.wait(1.0)
    loop.controller.check_ahead(TASK)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "held", 20.0)
    assert loop.status.task == "brace"
    assert loop.told == ["braced"]
    missed = loop.status.position_error
    loop.wait(8.0)  # in which it goes to the target
    assert loop.status.position_error < 0.7 * missed
    assert loop.force == pytest.approx(approach.hold.forces[0], rel=0.15)
    assert loop.status.brace_force == pytest.approx(loop.force, rel=0.15)
    assert loop.status.brace_force_deviation == pytest.approx(0.2 * loop.status.brace_force)
    assert loop.status.brace_contacts == "held"
    assert not loop.status.touches
    plant = loop.rig.world.plant
    for push in (0.05, 0.09):
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.5)
        assert loop.status.wrench[0] == pytest.approx(push, rel=0.25)
        assert loop.status.brace_force == pytest.approx(loop.force, abs=0.03)
    pushes = iter(np.linspace(0.09, 0.6, 100))
    for push in pushes:
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.05)
        if loop.force == 0:
            break
    loop.until(lambda s: s.brace_contacts != "held", 0.3)
    assert "brace-uncertain" in loop.told
    for push in pushes:
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.05)
        if loop.status.brace == "releasing":
            break
    assert loop.status.brace_contacts == "lost"
    assert loop.told[-1] == "brace-lost"
    plant.set_load(None)
    loop.until(lambda s: s.brace == "released", 20.0)
    assert loop.force == 0
    loop.controller.set_task(TASK)  # again, and then to a target elsewhere: it lets go first
    loop.until(lambda s: s.brace == "held", 20.0)
    waypoint = Waypoint(time=1.0, target=TASK.target)
    with pytest.raises(InputError, match="give it a task without 'brace' first"):
        loop.controller.follow(Trajectory(waypoints=[waypoint]), loop.rig.clock.now())
    free = TASK.unbraced.model_copy(update={"scene": None})
    loop.controller.set_task(free)
    assert loop.status.brace == "held"
    loop.until(lambda s: s.task == "target", 20.0)
    assert "release" in loop.told
    assert loop.force == 0
    loop.controller.close()


def test_an_arm_that_better_keeps_clear_is_told_of(solution, monkeypatch):
    """The search finds no posture that leans, so that the task is pursued without its brace."""

    def solver(robot: Any, task: stiffopt.Task) -> Any:
        known = SimpleNamespace(solve=lambda: replace(solution, contacts=()))
        return known if task.brace is not None else PressureSolver(robot, task)

    monkeypatch.setattr(planning, "PressureSolver", solver)
    loop = Loop()
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.wait(3.0)
    assert loop.told == ["brace-clear"]
    assert (loop.status.task, loop.status.brace) == ("target", "")
    assert loop.force == 0
    loop.controller.close()


def test_an_object_that_is_not_there_is_told_on_the_way(solution, monkeypatch):
    """The object of the scene stands elsewhere on the rig, so that nothing is touched."""
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    away = {"sphere": {"centre": (0.2, 0.2, 0.2), "radius": 0.01}, "contact": {"allowed": True}}
    loop = Loop(world=stiffopt.Scene(objects=[{"name": "far", **away}]))
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "releasing", 20.0)
    assert loop.told == ["brace-lost"]
    assert loop.command.max() < 0.9 * solution.pressures.max(), "long before the end of the way"
    loop.until(lambda s: s.brace == "released", 20.0)
    loop.controller.close()


def test_a_contact_that_friction_holds_is_brought_to_the_target(solution, monkeypatch):
    """Friction withholds corrections at first; that is no push, so they go on."""
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    rough = TASK.scene.objects[0].model_copy(
        update={"contact": TASK.scene.objects[0].contact.model_copy(update={"friction": 0.4})}
    )
    loop = Loop(world=stiffopt.Scene(objects=[rough]))
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "held", 20.0)
    missed = loop.status.position_error
    loop.wait(40.0)
    assert missed > 2e-3
    assert loop.status.position_error < 0.3 * missed
    assert set(loop.told) <= {"braced", "brace-off-target"}
    loop.controller.close()


@pytest.mark.parametrize("is_placed", [True, False])
def test_contacts_that_are_to_stick_are_relieved_of_friction(is_placed, solution, monkeypatch):
    """The plant's own friction: all that it can after the way into contact, little after a while.

    So it holds a push either way, along the direction of stiffness, and tells when it does not. The
    same if the target has no position, and the tip just stays.
    """
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    brace = TASK.brace.model_copy(update={"contacts": "sticking"})
    loop = Loop(world=TASK.scene)
    normal = solution.contacts[0].normal

    def share() -> float:
        """Tangential over normal force of the plant's contact."""
        (contact,) = loop.rig.world.plant.object_forces()
        along = float(normal @ contact.force)
        return float(np.linalg.norm(contact.force - along * normal)) / along

    loop.wait(1.0)
    target = TASK.target
    if not is_placed:
        pointing = tuple(map(float, solution.tip_pose[:3, 2]))
        target = target.model_copy(update={"position": None, "pointing": pointing})
    loop.controller.set_task(TASK.model_copy(update={"brace": brace, "target": target}))
    loop.until(lambda s: s.brace == "held", 20.0)
    loop.wait(8.0)
    assert share() > 0.15
    loop.wait(12.0)
    assert share() < (0.08 if is_placed else 0.12)
    assert loop.status.position_error < 1e-3 or not is_placed
    assert loop.status.brace == "held"
    loop.controller.close()


def test_the_loop_tells_that_there_is_nothing_to_lean_on():
    away = {"sphere": {"centre": (0.2, 0.2, 0.2), "radius": 0.01}}
    nothing = stiffopt.Scene(objects=[{"name": "far", **away}])
    loop = Loop(scene=nothing)
    with pytest.raises(InputError, match=r"no object 'post' in the scene.*the rig's scene"):
        loop.controller.check_ahead(TASK)
    loop = Loop(scene=None)
    with pytest.raises(InputError, match="the rig file has no scene"):
        loop.controller.set_task(TASK)
    loop.controller.close()


# -- motions ----------------------------------------------------------------------------------


def test_a_motion_goes_to_rest_and_then_into_contact(solution, approach):
    start = np.array([0.0, 0, 2e4, 0, 1e4, 0])
    found = stiffopt.plan_motion(ROBOT, start, [TASK], slew=2e5)
    assert found.found
    assert "into contact: at the end it leans on 'post' with 0." in found.message
    assert found.pressures[0] == pytest.approx(start)
    assert (np.abs(found.pressures).max(axis=1) < 1e-6).any()
    assert found.pressures[-1] == pytest.approx(solution.pressures)
    assert found.tip_poses[-1][:3, 3] == pytest.approx(approach.tips[-1].pose[:3, 3], abs=1e-5)
    assert (np.abs(np.diff(found.pressures, axis=0)).max(axis=1)
            <= 2e5 * np.diff(found.times) * (1 + 1e-6)).all()  # fmt: skip
    assert found.equilibrium(0) is None
    assert found.equilibrium(len(found.times) - 1) is found.equilibria[-1]
    (contact,) = found.equilibria[-1].contacts
    assert np.linalg.norm(contact.force) == pytest.approx(approach.forces[-1], rel=1e-4)
    assert found.stiffness[0] == pytest.approx(ROBOT.stiffness(start, [1, 0, 0]))
    assert found.stiffness[-1] == pytest.approx(solution.stiffness, rel=1e-3)
    assert found.stiffness[-1] > 4 * found.stiffness[0]
    with pytest.raises(InputError, match="the only goal of a motion"):
        stiffopt.plan_motion(ROBOT, TASK, start, slew=2e5)
    given_up = stiffopt.plan_motion(ROBOT, start, TASK, slew=2e5, cancel=lambda: True)
    assert given_up.status == "failed"
    assert "cancelled" in given_up.message


def test_the_picture_of_a_motion_shows_the_arm_in_contact(solution):
    """The drawn centre line at the end is the braced one, and its force is labelled."""
    found = stiffopt.plan_motion(ROBOT, np.zeros(6), [TASK], slew=2e5)
    figure = plot_motion(found, TASK.scene)
    space = figure.axes[0]
    ends = [np.array(line.get_data_3d()).T[-1] for line in space.lines if len(line.get_xdata())]
    near = 1e-3 * np.array(ends) - found.equilibria[-1].tip_pose[:3, 3]
    assert (np.linalg.norm(near, axis=1) < 1e-6).sum() >= 2  # the tip's way, and the arm
    free = 1e-3 * np.array(ends) - ROBOT.tip_pose(found.pressures[-1])[:3, 3]
    assert np.linalg.norm(free, axis=1).min() > 2e-3
    (contact,) = found.equilibria[-1].contacts
    assert f"{np.linalg.norm(contact.force):.3g} N" in [
        text.get_text() for text in figure.findobj(Text)
    ]


@pytest.mark.parametrize("name", ["motion.csv", "motion.yaml"])
def test_a_written_motion_that_leans_is_not_played(tmp_path, name):
    out, begin = tmp_path / name, "0,0,0,0,0,0 bar"
    arguments = ["--to", "problems/braced/post.yaml", "--slew", "2 bar/s", "--quiet"]
    assert main(["plan", "--from", begin, *arguments, "--out", str(out)]) == 0
    with pytest.raises(FileError, match=r"leans on objects.*give the rig its task"):
        read_motion(out, ROBOT.description)
    found = stiffopt.plan_motion(ROBOT, np.zeros(6), [TASK], slew=2e5)
    assert found.leans[-1]
    assert not found.leans[0]
    with pytest.raises(InputError, match="leans on objects"):
        found.trajectory()


def test_the_json_of_a_motion_names_its_contacts(capsys):
    file = "problems/braced/post.yaml"
    assert (
        main(["plan", "--from", "0,0,0,0,0,0 bar", "--to", file, "--slew", "2 bar/s", "--json"])
        == 0
    )
    said = json.loads(capsys.readouterr().out)
    (contact,) = said["contacts"]
    assert contact["object"] == "post"
    assert said["stiffness"][-1] > 4 * said["stiffness"][0]


def test_the_way_of_a_motion_begins_and_ends_gradually(approach):
    """The points are passed in order, at the given speed but for a second at each end."""
    for way in (approach.times, 0.1 * approach.times):  # the second one is too short to reach it
        times, duration = gradual(way), way[-1]
        pace = np.diff(way) / np.diff(times)
        assert (pace > 0).all()
        assert pace.max() <= 1 + 1e-9
        assert np.abs(pace - pace[::-1]).max() < 0.35  # points are not spaced alike at both ends
        middle = (times[1:] + times[:-1]) / 2
        left = np.minimum(middle, times[-1] - middle)
        assert (pace <= left / GRADUAL + 0.05).all() or duration > GRADUAL
        assert (pace[left < GRADUAL] <= left[left < GRADUAL] / GRADUAL + 0.2).all()
        extra = GRADUAL if duration > GRADUAL else 2 * np.sqrt(GRADUAL * duration) - duration
        assert times[-1] == pytest.approx(duration + extra)
