"""Friction on the way from rest into contact; ways that ease it; answers off their place."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import stiffopt
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.errors import EquilibriumError
from stiffopt.model.contact import way
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.contact.way import Rubbing, rubbed, rubbings, states_from_rest
from stiffopt.optimise import easing
from stiffopt.optimise.easing import eased
from stiffopt.optimise.leaning import BracedProblem
from stiffopt.paths.leaning import approach_to, least_times_along, way_into_contact

ROBOT = stiffopt.load_robot("stiff-flop-2")
LIMITS = np.zeros(6), np.full(6, 1.5e5)
# an arm that slides along a post while it is pressed against it, and one that hardly slides
SLIDING = (
    {"from": (-0.0076, -0.0496, 0.14), "to": (0.0955, 0.0102, 0.1263), "radius": 0.0079},
    [49237.0, 150000.0, 65553.0, 79276.0, 62592.0, 36861.0],
)
RESTING = (
    {"from": (-0.0373, 0.0626, 0.0732), "to": (-0.048, -0.0569, 0.0694), "radius": 0.0145},
    [109170.0, 0.0, 15636.0, 11363.0, 115865.0, 65304.0],
)


def scene(capsule: dict[str, Any], friction: float) -> stiffopt.Scene:
    contact = {"allowed": True, "max_force": 0.4, "friction": friction}
    return stiffopt.Scene(objects=[{"name": "post", "capsule": capsule, "contact": contact}])


@cache
def states(is_sliding: bool, friction: float) -> list[ContactEquilibrium]:
    capsule, p = SLIDING if is_sliding else RESTING
    return list(states_from_rest(ROBOT, scene(capsule, friction), np.array(p)))


def problem(is_sliding: bool, **brace: Any) -> BracedProblem:
    capsule, _ = SLIDING if is_sliding else RESTING
    task = stiffopt.Task(
        robot="stiff-flop-2",
        target={"position": states(is_sliding, 0.2)[-1].tip_pose[:3, 3].tolist()},
        stiffness={"maximise": {"direction": (1.0, 0.0, 0.0)}},
        scene=scene(capsule, 0.2),
        brace={"objects": ["post"], **brace},
    )
    return BracedProblem(ROBOT, task)


def test_a_body_that_slides_all_the_way_has_all_its_friction_against_the_slide():
    """The stations' centre line is seen to move against the force, and the tip is behind it."""
    found, (*_, before, end) = rubbed(states(True, 0.2)), states(True, 0.2)
    force = found.tangential @ found.sticking.across[0]
    assert np.linalg.norm(force) == pytest.approx(0.2 * end.normal_forces[0], rel=0.02)
    at = np.array([end.contacts[0].at])
    moved = end.line(at)[0] - before.line(at)[0]
    normal = end.contacts[0].normal
    moved = (moved - normal * (moved[0] @ normal))[0]
    assert force @ moved < -0.7 * np.linalg.norm(force) * np.linalg.norm(moved)
    assert np.linalg.norm(found.tip) <= end.friction.tip * 1.02


def test_friction_is_in_proportion_to_its_coefficient_where_all_is_used():
    tips = [rubbed(states(True, mu)).tip for mu in (0.02, 0.01)]
    assert tips[0] == pytest.approx(2 * tips[1], rel=0.05, abs=1e-5)


def test_more_steps_of_the_way_change_little(monkeypatch):
    monkeypatch.setattr(way, "STATES", 241)
    capsule, p = SLIDING
    finer = rubbed(states_from_rest(ROBOT, scene(capsule, 0.2), np.array(p)))
    coarse = rubbed(states(True, 0.2))
    assert coarse.tip == pytest.approx(finer.tip, abs=0.03 * float(np.linalg.norm(finer.tip)))


def test_an_arm_that_touches_nothing_has_no_friction_to_follow():
    high = {"from": (0.3, -0.05, 0.1), "to": (0.3, 0.05, 0.1), "radius": 0.005}
    clear = list(states_from_rest(ROBOT, scene(high, 0.2), np.array(SLIDING[1])))
    assert not any(each.contacts for each in clear)
    assert problem(True, approach="objects").rubbing(states(True, 0.2)[-1]) is None


@pytest.mark.parametrize("is_sliding", [True, False])
def test_an_answer_that_friction_keeps_from_its_place_is_refused(is_sliding):
    own, eq = problem(is_sliding, margin=1e-4), states(is_sliding, 0.2)[-1]
    rubbing = rubbed(states(is_sliding, 0.2))
    assert not [each for each in own.refusals(eq) if "friction" in each]
    told = [each for each in own.refusals(eq, rubbing) if "friction on the way" in each]
    assert len(told) == is_sliding
    if told:
        assert "pressures that are corrected by 0.1 bar leave it" in told[0]


def test_friction_that_presses_an_object_beyond_its_greatest_force_is_refused():
    own, eq = problem(False, margin=1e-4), states(False, 0.2)[-1]
    found, force = own.rubbing(eq), float(eq.normal_forces[0])
    assert found is not None
    assert found.normals == pytest.approx(found.sticking.bent()[1] @ found.tangential)
    for more, refused in ((0.09, False), (0.11, True), (-0.5, False)):
        rubbing = found._replace(normals=np.array([0.4 * (1 + more) - force]))
        told = [each for each in own.refusals(eq, rubbing) if "presses the arm on 'post'" in each]
        assert bool(told) == refused


def test_an_arm_that_leans_on_nothing_has_not_rubbed():
    with pytest.raises(EquilibriumError, match="lean on nothing"):
        rubbed(states(True, 0.2)[:1])


def test_the_tip_is_corrected_as_far_as_pressures_may_change():
    limits, rng = LIMITS, np.random.default_rng(3)
    for size in (1e-4, 3e-3, 3e-2):
        p = rng.uniform(0, 1.5e5, 6)
        J, off = rng.normal(size=(3, 6)) * 2e-7, size * rng.normal(size=3)
        low = np.maximum(limits[0] - p, -1e4)
        high = np.minimum(limits[1] - p, 1e4)
        best = lsq_linear(1e4 * J, -off, (low / 1e4, high / 1e4), tol=1e-12)
        left = float(np.linalg.norm(best.fun))
        assert easing.corrected(p, limits, off, J) == pytest.approx(left, rel=1e-2, abs=2e-6)


def test_forces_move_on_to_the_nearest_contact_of_their_object():
    """Equilibria that are the same twice carry everything on."""
    *rest, end = states(True, 0.2)
    once, twice = rubbed([*rest, end]), rubbed([*rest, end, end])
    assert isinstance(once, Rubbing)
    assert twice.tangential == pytest.approx(once.tangential, rel=1e-2, abs=1e-6)


def distance(rubbing: Rubbing) -> float:
    return float(np.linalg.norm(rubbing.tip))


def test_a_way_that_goes_past_its_end_and_comes_back_leaves_little_friction():
    own, straight = problem(True), states(True, 0.2)
    way, found = eased(ROBOT, own.task, own.scene, straight)
    assert found.tip == pytest.approx(rubbed(way).tip)
    assert distance(found) < 1e-3 < 5e-3 < distance(rubbed(straight))
    assert way[: len(straight)] == straight
    end, last = straight[-1], way[-1]
    assert last.pressures == pytest.approx(end.pressures)
    assert last.tip_pose == pytest.approx(end.tip_pose, abs=1e-6)
    turn = way[len(straight) - 1 + easing.STATES]
    assert turn.pressures == pytest.approx(end.pressures + found.past)
    for each in way[len(straight) :]:
        assert each.contacts
        assert each.within_limits
        assert (each.pressures >= LIMITS[0]).all()
        assert (each.pressures <= LIMITS[1]).all()


def test_friction_that_is_a_quarter_less_than_stated_is_eased_by_half(monkeypatch):
    own = problem(True)
    way, _ = eased(ROBOT, own.task, own.scene, states(True, 0.2))
    less = [eq.sticking._replace(friction=0.75 * eq.sticking.friction) for eq in way]
    for eq, held in zip(way, less, strict=True):
        monkeypatch.setattr(eq, "sticking", held)
    whole = distance(rubbed(way[: len(states(True, 0.2))]))
    assert distance(rubbed(way)) < 0.6 * whole


def pressing(found: Rubbing | None) -> Rubbing | None:
    return found and found._replace(normals=found.normals + 0.4)


@pytest.mark.parametrize("why", ["little", "limits", "force", "rubs", "opens", "lost", "near"])
def test_a_way_stays_as_it_is_where_it_cannot_be_eased(why, monkeypatch):
    own, straight = problem(why != "little"), states(why != "little", 0.2)
    if why == "limits":
        monkeypatch.setattr(easing, "_going_on", lambda end, *_: 0 * end.pressures)
    if why == "force":
        monkeypatch.setattr(easing, "_LESS", -2.0)
    if why == "rubs":
        monkeypatch.setattr(easing, "rubbings", lambda states: map(pressing, rubbings(states)))
    if why == "opens":
        monkeypatch.setattr(easing, "_LESS", 1.2)
    if why == "lost":

        def is_lost(*_: Any) -> None:
            raise EquilibriumError("lost")

        monkeypatch.setattr(easing, "_past_and_back", is_lost)
    task = own.task
    if why == "near":  # where the tip would be as the way turns
        turn = eased(ROBOT, task, own.scene, straight)[0][len(straight) - 1 + easing.STATES]
        place = tuple((turn.tip_pose[:3, 3] + 0.01 * turn.tip_pose[:3, 2]).tolist())
        ball = {"name": "ball", "sphere": {"centre": place, "radius": 0.005}}
        task = task.model_copy(
            update={"scene": stiffopt.Scene(objects=[*own.task.scene.objects, ball])}
        )
    way, found = eased(ROBOT, task, own.scene, straight)
    assert way == straight
    assert found.past is None
    assert found.tip == pytest.approx(rubbed(straight).tip)


def test_the_turn_is_the_least_change_that_adds_the_forces_within_limits():
    end, found = states(True, 0.2)[-1], rubbed(states(True, 0.2))
    T, G = found.sticking.per_pressure, end.force_gradients
    size, whole = float(np.linalg.norm(found.tangential)), float(end.normal_forces.sum())
    n = len(end.pressures)
    rows = np.vstack([1e5 * T / size, 1e5 * G / whole, np.sqrt(easing._LITTLE) * np.eye(n)])
    wanted = np.concatenate([found.tangential / size, [-easing._LESS], np.zeros(n)])
    bounds = (LIMITS[0] - end.pressures) / 1e5 - 1e-12, (LIMITS[1] - end.pressures) / 1e5 + 1e-12
    best = lsq_linear(rows, wanted, bounds, tol=1e-12)
    change = easing._going_on(end, found, *LIMITS)
    assert change == pytest.approx(1e5 * best.x, abs=20.0)
    assert T @ change == pytest.approx(found.tangential, abs=0.1 * size)


def answered(eq: ContactEquilibrium, own: BracedProblem) -> Any:
    """The parts of a solution that a way into contact needs."""
    return SimpleNamespace(
        task=own.task, pressures=eq.pressures, tip_pose=eq.tip_pose, contacts=eq.contacts,
        stiffness=eq.stiffness((1.0, 0.0, 0.0)), stiffness_unit="N/m",
    )  # fmt: skip


def test_what_is_judged_is_what_is_played():
    own, eq = problem(True, margin=1e-4), states(True, 0.2)[-1]
    answer = answered(eq, own)
    way, judged = way_into_contact(ROBOT, answer), own.rubbing(eq)
    assert judged is not None
    assert rubbed(way).tip == pytest.approx(judged.tip, abs=1e-5)
    assert not [each for each in own.refusals(eq, judged) if "friction" in each]
    straight = len(states(True, 0.2))
    times = least_times_along(ROBOT, way, 1e4)
    before = least_times_along(ROBOT, way[:straight], 1e4)
    for turn in (straight - 1, straight - 1 + easing.STATES):
        assert times[turn + 1] - times[turn] > 0.2, "it slows down where it turns"
    middle = straight // 2
    assert np.diff(times)[middle] == pytest.approx(np.diff(before)[middle])


@pytest.mark.parametrize("legs", [2.0, 1.5, 0.5], ids=["held", "coming back", "going past"])
def test_a_release_does_not_go_past_the_end_again(legs):
    """It goes straight to the end of the way, wherever it begins, and down from there."""
    own, eq = problem(True, margin=1e-4), states(True, 0.2)[-1]
    approach = approach_to(ROBOT, answered(eq, own), 2e5)
    brace = Bracing(own.task, BracingTuning())
    brace.begin(approach, np.zeros(6))
    last = len(states(True, 0.2)) - 1
    leg = approach.times[[last, last + easing.STATES, -1]]
    brace.phase, brace._time = BracePhase.APPROACHING, float(np.interp(legs, [0, 1, 2], leg))
    brace._planned.correction.change = np.full(6, 2e3)
    before = brace.pressures
    turn = approach.pressures[last + easing.STATES]
    assert np.abs(turn - approach.pressures[-1]).max() > 1e4
    brace.release(why="contact lost")
    assert brace.pressures == pytest.approx(before, abs=50.0)
    end, taken = approach.pressures[-1], []
    while brace.phase is BracePhase.RELEASING:
        brace.advance(0.01, is_there=True)
        taken.append(brace.pressures)
    assert taken[-1] == pytest.approx(np.zeros(6), abs=1.0)
    away = np.linalg.norm(np.array(taken) - 2e3 - end, axis=1)
    ends = int(np.argmin(away))
    assert (np.diff(away[: ends + 1]) <= 1.0).all()
    assert (np.diff(taken[ends:], axis=0) <= 1.0).all()
