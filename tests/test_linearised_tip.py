"""The tip near pressures that were evaluated before, against the model itself."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from stiffopt import load_robot
from stiffopt.control.linearised_tip import LinearisedTip
from stiffopt.errors import EquilibriumError, StiffoptError


@pytest.fixture(scope="module")
def robot():
    return load_robot("stiff-flop-2")


def test_a_walk_of_small_and_large_steps_is_the_models(robot):
    nearby, rng = LinearisedTip(robot), np.random.default_rng(2)
    p = 0.4 * robot.pressure_max
    evaluated = set()
    for k in range(200):
        p = p + rng.normal(size=len(p)) * (300.0 if k % 20 else 5e3)
        tip = nearby.at(p)
        evaluated.add(id(tip.jacobian))
        assert tip.pose[:3, 3] == pytest.approx(robot.tip_pose(p)[:3, 3], abs=6e-6)
        assert tip.pose[:3, :3] == pytest.approx(robot.tip_pose(p)[:3, :3], abs=3e-4)
        assert tip.jacobian == pytest.approx(
            robot.tip_jacobian(p), abs=0.02 * np.abs(tip.jacobian).max()
        )
    assert len(evaluated) < 100


def test_on_a_straight_way_the_model_is_evaluated_ahead(robot):
    nearby, evaluated, motion = LinearisedTip(robot), [], 0.0
    way = np.linspace(0.2, 0.6, 500)[:, None] * robot.pressure_max * np.linspace(1.0, 0.5, 6)
    for before, p in pairwise(way):
        tip = nearby.at(p)
        if not any(tip.jacobian is each for each in evaluated[-1:]):
            evaluated.append(tip.jacobian)
        assert tip.pose[:3, 3] == pytest.approx(robot.tip_pose(p)[:3, 3], abs=6e-6)
        scaled = np.vstack([tip.jacobian[:3] / robot.length, tip.jacobian[3:]])
        motion += np.linalg.norm(p - before) * np.linalg.norm(scaled)
    assert motion > 10 * 0.03
    assert len(evaluated) < motion / (1.5 * 0.03)


def test_where_the_arm_ahead_has_no_equilibrium_it_is_evaluated_here(robot, monkeypatch):
    nearby, p = LinearisedTip(robot), 0.4 * robot.pressure_max
    at = nearby._model.at

    def below(pressures):
        if pressures[0] > most:
            raise EquilibriumError("it buckles")
        return at(pressures)

    monkeypatch.setattr(nearby._model, "at", below)
    most = p[0]
    nearby.at(p)
    for _ in range(60):
        p = p + np.eye(6)[0] * 300.0
        most = p[0] + 200.0  # the next pressures are beyond it
        assert nearby.at(p).pose == pytest.approx(robot.tip_pose(p), abs=3e-4)
    most = p[0]
    with pytest.raises(StiffoptError):
        nearby.at(p + np.eye(6)[0] * 2e4)


def test_the_jacobian_is_nearly_the_same_a_little_further_away(robot):
    """What the class says of itself."""
    rng = np.random.default_rng(4)
    for _ in range(30):
        p = rng.uniform(0.1, 0.9, robot.n_pressures) * robot.pressure_max
        step = rng.normal(size=len(p))
        nearby = LinearisedTip(robot, 0.07)
        here = nearby.at(p)
        scaled = np.vstack([here.jacobian[:3] / robot.length, here.jacobian[3:]])
        step *= 0.069 / np.linalg.norm(scaled) / np.linalg.norm(step)
        there = nearby.at(p + step)
        assert there.jacobian is here.jacobian
        true = robot.tip_jacobian(p + step)
        assert np.abs(there.jacobian - true).max() < 0.05 * np.abs(true).max()
        assert nearby.at(p + 1.02 * step).jacobian is not here.jacobian


def test_what_was_returned_does_not_change(robot):
    nearby, p = LinearisedTip(robot), 0.4 * robot.pressure_max
    tips = [nearby.at(p + 50.0 * k) for k in range(4)]
    kept = [tip.pose.copy() for tip in tips]
    nearby.at(p + 1e4)
    for tip, pose in zip(tips, kept, strict=True):
        assert np.array_equal(tip.pose, pose)


def test_pressures_beyond_the_limits_count_as_those_at_them(robot):
    nearby, p = LinearisedTip(robot), robot.pressure_max.copy()
    assert nearby.at(p + 1e4).pose == pytest.approx(robot.tip_pose(p), abs=1e-9)
    below = robot.pressure_min - 50.0
    assert nearby.at(below).pose == pytest.approx(robot.tip_pose(robot.pressure_min), abs=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_has_no_tip_and_does_no_harm(robot, bad):
    nearby, p = LinearisedTip(robot), 0.4 * robot.pressure_max
    before = nearby.at(p).pose
    spoilt = p.copy()
    spoilt[1] = bad
    with pytest.raises(StiffoptError):
        nearby.at(spoilt)
    assert nearby.at(p).pose == pytest.approx(before, abs=1e-12)


def test_a_compliance_that_is_not_finite_is_no_answer(robot, monkeypatch):
    nearby, p = LinearisedTip(robot), 0.4 * robot.pressure_max
    broken = robot.tip_compliance(p).copy()
    broken[1, 2] = np.nan
    tip = nearby._model.at(p)._replace(compliance=broken)
    monkeypatch.setattr(nearby._model, "at", lambda _: tip)
    with pytest.raises(StiffoptError, match="not finite"):
        nearby.at(p)
