"""The way into contact: from rest, slowly, clear of all else, and linear about its equilibria."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import stiffopt
from leaning_arm import (
    ROBOT,
    TASK,
    approach_fixture,  # noqa: F401
    solution_fixture,  # noqa: F401
)
from stiffopt.control.friction import Friction
from stiffopt.control.linearised_tip import LeaningTip
from stiffopt.paths.configurations import Unsolved
from stiffopt.paths.leaning import FORCE_RATE, SPEED, approach_to


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
