"""What friction does at the contacts of a braced arm: its tangential forces, and slides."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize

import stiffopt
from stiffopt import lie
from stiffopt.control.friction import Friction
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.paths.leaning import Hold

ROBOT = stiffopt.load_robot("stiff-flop-2")
PRESSURES = np.array([3e4, 1e4, 0, 0, 2e4, 1e4])
MU = 0.3
CAPSULE = {"from": (0.016, -0.05, 0.06), "to": (0.016, 0.05, 0.06), "radius": 0.005}
SHAPES = {
    "post": {"capsule": CAPSULE},
    "ball": {"sphere": {"centre": (-0.021, -0.013, 0.12), "radius": 0.006}},
}


@cache
def equilibrium(*names: str, friction: float = MU) -> ContactEquilibrium:
    contact = {"allowed": True, "friction": friction}
    objects = [{"name": name, **SHAPES[name], "contact": contact} for name in names]
    eq = ROBOT.contact_equilibrium(PRESSURES, stiffopt.Scene(objects=objects))
    assert [each.object for each in eq.contacts] == list(names)
    return eq


def friction_at(*names: str, friction: float = MU) -> Friction:
    eq, step = equilibrium(*names, friction=friction), 1e-3
    forces = [
        (eq.shifted(push=each).normal_forces - eq.shifted(push=-each).normal_forces) / (2 * step)
        for each in step * np.eye(3)
    ]
    hold = Hold(
        eq.normal_forces, np.zeros(len(names)), eq.force_gradients, np.array(forces).T,
        eq.sticking, np.zeros(len(eq.sticking.per_pressure)),
    )  # fmt: skip
    return Friction(hold, PRESSURES)


def test_contacts_at_almost_the_same_station_stay_within_their_cones():
    """Between two crossing posts: what they hold is the same, and its stiffness is negative."""
    pressures = np.array([26091.9, 0, 0, 32047.7, 13894.5, 46330.3])
    ends = [
        (
            (0.04407147717262898, -0.028982446037186207, 0.07441589014812137),
            (-0.01762749956664817, 0.04971467125008257, 0.07441589014812137),
        ),
        (
            (0.005497362689674181, 0.05262337289443876, 0.0728120717405957),
            (-0.03684971388127545, -0.03796760406184607, 0.0728120717405957),
        ),
    ]
    objects = [
        {
            "name": f"post {i}",
            "capsule": {"from": first, "to": second, "radius": 0.005},
            "contact": {"allowed": True, "friction": 0.2},
        }
        for i, (first, second) in enumerate(ends)
    ]
    eq = ROBOT.contact_equilibrium(pressures, stiffopt.Scene(objects=objects))
    first, second = eq.contacts
    assert abs(first.at - second.at) < 1e-4
    stiffness, sticking = np.linalg.eigvalsh(eq.sticking.per_slide), eq.sticking.softened(1e-4)
    assert stiffness.min() < -1e5
    assert np.linalg.eigvalsh(sticking.per_slide) == pytest.approx(
        [*stiffness[1:] / (1 + 1e-4 * stiffness[1:]), 1e4], rel=0.05
    )
    slopes = eq.force_gradients, np.zeros((2, 3))
    hold = Hold(eq.normal_forces, np.zeros(2), *slopes, sticking, np.zeros(4))
    friction = Friction(hold, pressures)
    for share in np.linspace(0.0, 1.0, 60):
        friction.follow(share * pressures, 0.2, 1e-4)
        most = 0.2 * np.maximum(friction.normals(friction._pressures), 0.0)
        sizes = np.linalg.norm(friction.forces.reshape(2, 2), axis=1)
        assert (sizes <= 1.01 * most + 1e-4).all()
    assert np.isfinite(friction.slid(np.array([0.05, 0.0, 0.0]), eq.normal_forces)).all()


@pytest.mark.parametrize("names", [("post",), ("ball",), ("post", "ball")])
def test_an_arm_that_sticks_is_one_that_slides_with_tangential_forces(names):
    """The forces by a push bend the arm that slides into the one that sticks."""
    eq, friction = equilibrium(*names), friction_at(*names)
    R, held = eq.tip_pose[:3, :3], eq.sticking
    turned = lie.rotate_blocks(R)
    sliding, sticking = (turned @ eq.compliance(g)[:, :3] @ R.T for g in ("sliding", "sticking"))
    found = sliding + friction.tip @ held.per_push
    for rows in (slice(0, 3), slice(3, 6)):  # place and turn
        largest = np.abs(sticking[rows]).max()
        assert found[rows] == pytest.approx(sticking[rows], abs=1e-4 * largest)
        assert np.abs(sliding[rows] - sticking[rows]).max() > 0.05 * largest
    assert held.friction == pytest.approx([MU] * len(names))


@pytest.mark.parametrize("way", np.array([[1, 0, 0], [0, -1, 0], [-0.6, 0.8, 0]]))
def test_a_contact_slips_at_the_push_that_the_model_foretells(way):
    eq, friction = equilibrium("ball"), friction_at("ball")
    normals = friction.normals(PRESSURES)
    loss = eq.lift_off(way, contacts="sticking")
    assert loss.how == "slips"
    left = friction.left(way, normals)
    assert left == pytest.approx(loss.force, rel=0.1)
    assert friction.slid(0.99 * left * way, normals) == pytest.approx([0.0], abs=1e-12)
    assert friction.slid(1.1 * left * way, normals) > 1e-6


def test_contacts_slide_to_the_least_energy():
    """Of the bent arm, and of what friction takes; an optimiser finds the same slides."""
    friction, held = friction_at("post", "ball"), equilibrium("post", "ball").sticking
    normals = np.array([0.05, 0.02])
    friction._sticking = held._replace(normals=0 * held.normals)  # normal forces stay
    trial = np.array([0.04, -0.03, 0.01, 0.02])
    slides = friction._sticking.slid_back(trial, normals)

    def energy(s: np.ndarray) -> float:
        bent = 0.5 * s @ held.per_slide @ s + trial @ s
        return float(1e6 * (bent + MU * normals @ np.linalg.norm(s.reshape(2, 2), axis=1)))

    best = minimize(energy, np.full(4, 1e-6), method="Powell", options={"xtol": 1e-12, "ftol": 0})
    assert energy(slides) <= best.fun + 1e-3 * abs(best.fun)
    assert slides == pytest.approx(best.x, abs=0.02 * np.abs(best.x).max())
    forces = (trial + held.per_slide @ slides).reshape(2, 2)
    assert (np.linalg.norm(forces, axis=1) <= MU * normals * 1.01).all()


def test_the_way_into_contact_leaves_friction_against_the_slide():
    """At the end it holds the body back, with all that it can, and the tip is off by that."""
    friction, held = friction_at("ball"), equilibrium("ball").sticking
    for share in np.linspace(0.0, 1.0, 400):
        friction.follow(share * PRESSURES, 1.0)
    most = MU * friction.normals(PRESSURES)[0]
    assert np.linalg.norm(friction.forces) == pytest.approx(most, rel=0.01)
    withheld = held.slides(friction.forces)
    assert withheld @ friction.forces < 0, "the body would slide on without it"
    small = PRESSURES * (1 - 1e-4)
    before = friction.forces.copy()
    friction.follow(small, 1.0)  # back: it sticks, and the force falls
    change = held.per_pressure @ (small - PRESSURES)
    assert friction.forces == pytest.approx(before + change, abs=1e-6)
    friction.follow(small, 1.0, creep=1e-4)  # as if the pressures had come back
    assert friction.forces == pytest.approx(before, abs=1e-6)


def test_without_friction_nothing_is_withheld():
    smooth = friction_at("ball", friction=0.0)
    for share in (0.0, 0.5, 1.0):
        smooth.follow(share * PRESSURES, 1.0)
    push = np.array([0.01, 0.0, 0.0])
    normals = smooth.normals(PRESSURES)
    assert normals == pytest.approx(equilibrium("ball", friction=0.0).normal_forces)
    assert not (smooth.tip @ smooth.forces).any()
    assert smooth.slid(push, normals).size == 0
    assert smooth.left(push / 0.01, normals) == np.inf
