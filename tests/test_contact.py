"""Arms that lean on objects: closed forms, an independent rod, differences, and what cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from conftest import is_long
from contact_scenes import (
    BENT,
    REST,
    TWO,
    X,
    around,
    flexibilities,
    leaning,
    post,
    push,
    robot,
    scene,
)
from independent.arms import ARMS, FLOP
from independent.sections import rod_section
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.stability import stiffness_left

REFERENCES = json.loads((Path(__file__).parent / "contact_reference.json").read_text())


# -- closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 0.65, 0.8])
def test_small_pushes_on_a_straight_arm_are_those_of_beam_theory(share):
    """``C_tt - C_ts C_ss^-1 C_st`` along the normal; the gap is closed by the first of the push."""
    at, gap, force = share * TWO.length, 1e-5, 1e-4
    tip, between, own = flexibilities(at)
    found = robot().contact_equilibrium(REST, scene(post(at, gap)), load=push(force))
    (contact,) = found.contacts
    expected = (between * force - gap) / own
    assert contact.force == pytest.approx([-expected, 0, 0], abs=1e-3 * expected)
    assert contact.at == pytest.approx(at, abs=1e-5)
    assert contact.position == pytest.approx([0.015 + gap, 0, at], abs=1e-5)
    assert found.tip_pose[0, 3] == pytest.approx(tip * force - between * expected, rel=1e-3)
    assert found.stiffness(X) == pytest.approx(1 / (tip - between**2 / own), rel=1e-3)
    lost = found.lift_off([-1, 0, 0])
    assert (lost.how, lost.object) == ("lifts off", "0")
    assert lost.force == pytest.approx(force - gap / between, rel=2e-3)
    assert lost.stiffness_after == pytest.approx(1 / tip, rel=1e-3)


def test_a_soft_object_is_a_spring():
    at, force, stiffness = 0.12, 1e-4, 20.0
    tip, between, own = flexibilities(at)
    found = robot().contact_equilibrium(
        REST, scene(post(at), stiffness=stiffness), load=push(force)
    )
    own += 1 / stiffness
    assert -found.contacts[0].force[0] == pytest.approx(between * force / own, rel=1e-3)
    assert found.stiffness(X) == pytest.approx(1 / (tip - between**2 / own), rel=1e-3)


def test_leaning_softens_across_the_normal():
    """A sphere's curvature times the force, with the arm's own stiffness where it touches."""
    at, radius = 0.12, 0.005
    tip, between, own = flexibilities(at)
    sphere = {"sphere": {"centre": (0.02, 0.0, at), "radius": radius}}
    found = robot().contact_equilibrium(REST, scene(sphere), load=push(0.01))
    force = np.linalg.norm(found.contacts[0].force)
    curvature = force / (0.015 + radius)
    expected = tip + between**2 * curvature / (1 - own * curvature)
    assert 1 / found.stiffness([0, 1, 0]) == pytest.approx(expected, rel=0.01)
    assert found.stiffness([0, 1, 0]) < 0.95 * robot().stiffness(REST, [0, 1, 0])
    assert found.stable


def test_the_tip_is_a_hemisphere():
    """A wall before the tip, pressed by an arm that lengthens."""
    p = np.full(6, 1.5e4)
    free, C = robot().tip_pose(p)[2, 3], robot().tip_compliance(p)[2, 2]
    wall = {"half_space": {"point": (0, 0, free + 0.015 - 0.1 * C), "normal": (0, 0, -1)}}
    found = robot().contact_equilibrium(p, scene(wall, friction=0.2))
    (contact,) = found.contacts
    # friction at the touched point is a wrench on the tip
    lever = contact.position - found.tip_pose[:3, 3]
    dragged = [
        robot().contact_equilibrium(
            p, scene(wall), load=1e-4 * np.array([*d, *np.cross(lever, d)]), nearby=found
        )
        for d in np.eye(3)[:2]
    ]
    moves = [1e4 * (each.tip_pose - found.tip_pose)[:2, 3] for each in dragged]
    expected = 0.2 * np.linalg.norm(contact.force) * np.linalg.norm(moves, 2)
    assert found.friction.tip == pytest.approx(expected, rel=1e-3)
    assert contact.at == TWO.length
    assert found.tip_pose[2, 3] == pytest.approx(free - 0.1 * C, abs=1e-5)
    assert contact.force == pytest.approx([0, 0, -0.1], abs=1e-3)


# -- no contact -----------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [TWO, ARMS["3 segments, mixed"], TWO.under((0, 0, 9.81), 0.02)])
def test_without_contact_it_is_the_free_arm(arm):
    p = np.random.default_rng(3).uniform(0, 0.8e5, arm.n)
    found = robot(arm).contact_equilibrium(p, scene(post(0.1, gap=0.3)))
    assert found.contacts == ()
    assert found.stable
    assert found.tip_pose == pytest.approx(robot(arm).tip_pose(p), abs=1e-5)
    scale = np.abs(robot(arm).tip_compliance(p)).max()
    assert found.tip_compliance == pytest.approx(robot(arm).tip_compliance(p), abs=1e-4 * scale)
    jacobian = robot(arm).tip_jacobian(p)
    assert found.tip_jacobian == pytest.approx(jacobian, abs=1e-4 * np.abs(jacobian).max())
    line = robot(arm).backbone(p, 20)[:, :3, 3]
    assert found.backbone(20) == pytest.approx(line, abs=2e-4)
    assert found.lift_off(X).how == "holds"


def test_objects_that_allow_no_contact_are_not_leant_on():
    found = robot().contact_equilibrium(REST, scene(post(0.1), allowed=False), load=push(0.01))
    assert found.contacts == ()


# -- an independent rod ---------------------------------------------------------------------------


@pytest.mark.parametrize("case", REFERENCES, ids=[str(case["seed"]) for case in REFERENCES])
def test_against_the_energy_of_a_discrete_rod(case):
    """One to three contacts, with and without weight."""
    arm = ARMS[case["arm"]].under(case["gravity"], case["tip_mass"])
    found = robot(arm).contact_equilibrium(
        np.array(case["pressures"]), scene(*case["objects"]), load=push(1, *case["force"])
    )
    forces = np.zeros(len(case["objects"]))
    for contact in found.contacts:
        forces[int(contact.object)] += np.linalg.norm(contact.force)
    tip = np.linalg.norm(found.tip_pose[:3, 3] - case["tip"])
    assert tip < 1e-3 * arm.length
    assert forces == pytest.approx(case["forces"], rel=0.01, abs=5e-4)
    assert found.stable
    R = found.tip_pose[:3, :3]
    flexibility = np.diag(R @ found.tip_compliance[:3, :3] @ R.T)
    assert flexibility == pytest.approx(case["flexibilities"], rel=0.05)


# -- derivatives ----------------------------------------------------------------------------------


WITH_AND_WITHOUT_WEIGHT = pytest.mark.parametrize("arm", [TWO, TWO.under((0, 0, 9.81), 0.01)])


@WITH_AND_WITHOUT_WEIGHT
def test_derivatives_are_those_of_equilibria_nearby(arm):
    found = leaning(arm)
    assert found.contacts
    step, n = 20.0, robot(arm).n_pressures
    moves, forces, stations = [], [], []
    for e in step * np.eye(n):
        a, b = (
            robot(arm).contact_equilibrium(BENT + sign * e, around(arm), nearby=found)
            for sign in (1, -1)
        )
        moves.append((a.tip_pose - b.tip_pose)[:3, 3] / (2 * step))
        pairs = list(zip(a.contacts, b.contacts, strict=True))
        norms = [[np.linalg.norm(each.force) for each in pair] for pair in pairs]
        forces.append([(x - y) / (2 * step) for x, y in norms])
        stations.append([(x.at - y.at) / (2 * step) for x, y in pairs])
    slope = found.tip_pose[:3, :3] @ found.tip_jacobian[:3]
    assert slope == pytest.approx(np.array(moves).T, abs=1e-6 * np.abs(slope).max())
    for gradients, rows in ((found.force_gradients, forces), (found.station_gradients, stations)):
        expected = np.array(rows).T
        assert gradients == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    gradient = found.stiffness_gradient(X, step=50.0)
    other = found.stiffness_gradient(X, step=200.0)
    assert gradient == pytest.approx(other, abs=1e-3 * np.abs(gradient).max())


@WITH_AND_WITHOUT_WEIGHT
def test_compliance_is_that_of_pushes_and_symmetric(arm):
    found = leaning(arm)
    raw, R = found._arm.tangent[:6], found.tip_pose[:3, :3]
    assert raw == pytest.approx(raw.T, abs=1e-3 * np.abs(raw).max())
    C = R @ found.tip_compliance[:3, :3] @ R.T
    for direction in np.eye(3):
        ends = [
            robot(arm).contact_equilibrium(
                BENT, around(arm), load=push(sign * 1e-5, *direction), nearby=found
            )
            for sign in (1, -1)
        ]
        move = (ends[0].tip_pose - ends[1].tip_pose)[:3, 3] / 2e-5
        assert move == pytest.approx(C @ direction, abs=1e-3 * np.abs(C).max())


def test_the_stiffness_of_the_nodes_has_the_same_compliance():
    """What decides on stability, turned round."""
    found = leaning(TWO)
    K = stiffness_left(found._arm)
    assert np.linalg.eigvalsh((K + K.T) / 2)[0] > 0
    assert pytest.approx(K.T, abs=1e-3 * np.abs(K).max()) == K


def test_the_second_derivative_of_the_gap_includes_the_shear_by_weight():
    model = robot(TWO.under((3.0, 0.0, 0.0)))
    sag = model.contact_equilibrium(REST, scene(post(0.12, gap=0.2))).backbone(181)[120, 0]
    left = model.clearance(REST, scene(post(0.12, gap=sag)))
    found = model.contact_equilibrium(REST, scene(post(0.12, gap=sag - left - 2e-5)))
    assert 0 < found.normal_forces[0] < 0.004
    arm, row, at = found._arm, found._arm.rows[0], found.contacts[0].at
    step = 0.006
    x = found._arm.shape.body(at + step * np.array([-2.0, -1.0, 1.0, 2.0]))[0]
    # differences on both sides, as the force makes a kink between them
    second = (x[0] - x[1] - x[2] + x[3]) / (3 * step**2)
    own = row.mean @ row.point.curvature @ row.mean
    assert arm.bend(0) - own == pytest.approx(row.point.normal @ second, rel=0.03)


# -- approach, and what cannot be -----------------------------------------------------------------


def test_overlaps_of_15_mm_are_reached_by_both_approaches():
    T = robot().pose(BENT, 0.15)
    centre, side = T[:3, 3] - T[:3, 0] * (0.02 - 0.015), 0.05 * T[:3, 1]
    ends = {"from": tuple(centre - side), "to": tuple(centre + side)}
    around = scene({"capsule": {**ends, "radius": 0.005}})
    assert robot().clearance(BENT, around) == pytest.approx(-0.015, abs=2e-4)
    first, second = (
        robot().contact_equilibrium(BENT, around, approach=way) for way in ("pressures", "objects")
    )
    assert first.contacts
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=2e-6)
    assert first.stable


@pytest.mark.parametrize("at", [0.11, 0.14, 0.17])
def test_long_steps_end_where_short_ones_do(at):
    """On a ball that the free arm enters by 8 mm, beside the plane in which it bends."""
    T = robot().pose(BENT, at)
    side = (T[:3, 0] + 0.4 * T[:3, 1]) / np.hypot(1, 0.4)
    ball = scene({"sphere": {"centre": tuple(T[:3, 3] - 0.013 * side), "radius": 0.006}})
    slowly = robot().contact_equilibrium(REST, ball)
    for share in np.linspace(0, 1, 31)[1:]:
        slowly = robot().contact_equilibrium(share * BENT, ball, nearby=slowly)
    found = robot().contact_equilibrium(BENT, ball)
    assert found.contacts
    assert found.tip_pose == pytest.approx(slowly.tip_pose, abs=1e-6)


def test_an_arm_that_is_swept_past_a_post_stays_on_its_side():
    """At the full pressures the free arm is beyond the post and clear of it."""
    p = np.array([1.5e5, 0, 0, 1.5e5, 0, 0])
    line = robot().backbone(0.35 * p, 50)[-8, :3, 3]
    post = {"capsule": {"from": (line[0] - 0.022, -0.08, line[2]), "radius": 0.004,
                        "to": (line[0] - 0.022, 0.08, line[2])}}  # fmt: skip
    assert robot().clearance(REST, scene(post)) > 0
    assert robot().clearance(p, scene(post)) > 0.002
    found = robot().contact_equilibrium(0.6 * p, scene(post))
    assert found.contacts
    assert found.tip_pose[0, 3] > robot().tip_pose(0.6 * p)[0, 3] + 0.005


def test_an_arm_that_is_pressed_on_a_wall_along_its_axis_buckles():
    """At Euler's load of a rod that is clamped at one end, less what shear takes of it."""
    wall = {"half_space": {"point": (0, 0, 0.2), "normal": (0, 0, -1)}}
    message = r"beyond \d+% of its pressures and load, leaning on 0: the arm slips off, snaps"
    with pytest.raises(EquilibriumError, match=message):
        robot().contact_equilibrium(np.full(6, 1.5e5), scene(wall))
    law = rod_section(FLOP, np.full(3, 2e4), TWO.gravity)
    euler = np.pi**2 / (4 * (1.01 * TWO.length) ** 2 * law.compliance[4, 4])
    euler /= 1 + euler * law.compliance[0, 0]
    forces = []
    for p in np.arange(1.9e4, 2.3e4, 200 if is_long() else 400):
        try:
            found = robot().contact_equilibrium(np.full(6, p), scene(wall))
        except EquilibriumError:
            break
        forces.append(float(np.linalg.norm(found.contacts[0].force)))
    assert len(forces) > 2
    assert forces[-1] == pytest.approx(euler, rel=0.1)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="expected a Scene"):
        robot().contact_equilibrium(REST, "post")
    with pytest.raises(InputError, match="approach"):
        robot().contact_equilibrium(REST, scene(post(0.1)), approach="sideways")
    found = robot().contact_equilibrium(REST, scene(post(0.1)))
    with pytest.raises(InputError, match="contacts"):
        found.compliance("glued")
    with pytest.raises(InputError, match="limit"):
        found.lift_off(X, limit=0)


# -- machine code ---------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [TWO, TWO.under((0, 0, 9.81), 0.02), ARMS["3 segments, mixed"]])
def test_machine_code_and_numpy_find_the_same(arm, compiled, monkeypatch):
    p = np.random.default_rng(5).uniform(0, 1e5, arm.n)
    model = stiffopt.Manipulator(stiffopt.RobotDescription(**arm.mapping()))
    T = model.pose(p, 0.7 * arm.length)
    ball = {"sphere": {"centre": tuple(T[:3, 3] - 0.02 * T[:3, 0]), "radius": 0.009}}
    free = model.clearance(p, scene(ball))
    assert free < -0.002
    first = model.contact_equilibrium(p, scene(ball))
    assert first._arm.problem._native is not None
    with monkeypatch.context() as patch:
        patch.setattr(ContactProblem, "_native", None)
        second = model.contact_equilibrium(p, scene(ball))
        assert second.stable == first.stable
        assert second.tip_compliance == pytest.approx(first.tip_compliance, rel=1e-5, abs=1e-6)
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=1e-7)
    for one, other in zip(first.contacts, second.contacts, strict=True):
        assert one.force == pytest.approx(other.force, abs=1e-6)
        assert one.at == pytest.approx(other.at, abs=1e-6)
    for push_by in (0.05, -0.05):
        near = model.contact_equilibrium(p, scene(ball), load=push(push_by))
        K = stiffness_left(near._arm)
        definite = np.linalg.eigvalsh((K + K.T) / 2)[0] > 0
        assert near._arm.is_stable == definite
