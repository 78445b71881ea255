"""Formulas that stand in more than one place, each for a reason, agree where they mean the same.

The docstrings of `stiffopt.control.regulators` and `stiffopt.control.allocation` say why. Stiffness
is a formula of symbols for its derivatives, and of numbers for contacts and for many pressures.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from fake_supply import HIGH, SLEW, FakeSupply, HandClock
from stiffopt import lie
from stiffopt.control.allocation import Allocation
from stiffopt.control.feedback import TrackingRows, prescribed_components, tracking_rows
from stiffopt.control.formula import Formula
from stiffopt.control.reference import Reference
from stiffopt.control.regulators import RegulatorModel
from stiffopt.control.tip_errors import TipErrors
from stiffopt.control.tuning import FeedbackTuning
from stiffopt.model.compliance import directional_stiffness, stiffness_of
from stiffopt.model.history import History, Memory, lagged
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.motion import _least_stiffness
from stiffopt.rig.interface import PressureCommand
from stiffopt.rig.settings import Safety
from stiffopt.safety.expected_pressure import ExpectedPressure, Regulation
from stiffopt.safety.gate import SafetyGate

STEP = 2.0**-7  # s; sums of it are exact, and so is what has acted after a dead time


def plant_regulators(lag, slew, dead_steps):
    """The regulators of the simulated arm: returns what takes a step."""
    pytest.importorskip("numba")
    from stiffopt.plant.hardware import Regulators, regulate

    n = len(lag)
    law = Regulators(STEP, lag, slew, np.full(n, np.inf), np.zeros(n), np.full(n, np.nan), False)
    delayed, pressure, first = np.zeros((dead_steps, n)), np.zeros(n), 0

    def step(command):
        nonlocal first
        ripple, trace = np.zeros((1, n)), np.zeros((1, n))
        first = getattr(regulate, "py_func", regulate)(
            law, delayed, first, command, pressure, ripple, trace
        )
        return pressure.copy()

    return step


@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize("dead_steps", [0, 1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_four_models_of_a_regulator(seed, dead_steps, limited):
    """While commands rise, the estimator's, the bound of safety, the plant's, and a history."""
    rng, n = np.random.default_rng(seed), 3
    lag = rng.uniform(0.02, 0.2, n)
    slew = rng.uniform(1e5, 4e5, n) if limited else np.full(n, 1e9)
    dead_time = dead_steps * STEP
    commands = np.repeat(np.cumsum(rng.uniform(0, 3e4, (8, n)), axis=0), 5, axis=0)
    estimated = RegulatorModel(STEP, lag, dead_time, slew)
    bound = ExpectedPressure(Regulation(lag, lag, dead_time), slew)
    simulated = plant_regulators(lag, slew, dead_steps)
    history = Memory([History(lag=float(tau), dead_time=dead_time) for tau in lag])
    bound.follow(0.0)
    for k, command in enumerate(commands):
        pressures = estimated.advance(command, np.full(n, np.nan))
        bound.tell(k * STEP, command)
        bound.follow((k + 1) * STEP)
        assert bound.lowest == pytest.approx(pressures, rel=1e-9, abs=1e-6)
        assert simulated(command) == pytest.approx(pressures, rel=1e-9, abs=1e-6)
        effective = history.advance(STEP, command)
        if not limited:  # a history knows of no slew
            assert effective == pytest.approx(pressures, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_lag_of_recorded_pressures(seed):
    """What calibration and commissioning use on rows of any spacing is the lag of a history."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(1e-3, 0.2, 30))
    inputs, lag = rng.uniform(0, 1e5, (30, 2)), rng.uniform(0.02, 0.5)
    history = Memory([History(lag=lag), History(lag=lag)])
    history.advance(10.0, inputs[0])
    exact = [history.advance(step, row) for step, row in zip(np.diff(time), inputs, strict=False)]
    assert lagged(time, inputs, lag, inputs[0])[1:] == pytest.approx(np.array(exact), rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_three_limits_of_slew(seed):
    """Allocation, reference and gate: the gate has nothing left to limit, and all go as fast."""
    rng, clock, period, n = np.random.default_rng(seed), HandClock(), 0.01, 3
    gate = SafetyGate(
        FakeSupply(clock), slew=SLEW, safety=Safety(), force_per_pressure=None, clock=clock
    )
    gate.open()
    gate.arm()
    J, v, G = ca.SX.sym("J", 0, n), ca.SX.sym("v", 0), ca.SX.sym("G", 3, n)
    allocation = Allocation(
        TrackingRows([G], [G], J, v, G, 0), np.zeros(n), HIGH, SLEW * period, 1.0
    )
    reference = Reference(period, SLEW, 0.06, slew_share=1.0)
    reference.rate = 1e6  # its lags follow at once
    last, path = np.zeros(n), np.zeros(n)
    for k in range(100):
        if k % 20 == 0:
            goal = rng.uniform(-0.2, 1.2, n) * HIGH
        command, *_ = allocation.solve((np.zeros((3, n)),), goal, last)
        nearest = np.clip(np.clip(goal, 0, HIGH), last - SLEW * period, last + SLEW * period)
        assert command == pytest.approx(nearest, abs=1e-3)
        clock.t += period
        applied = gate.apply(PressureCommand(command, clock.t))
        assert not applied.refused
        assert applied.pressures == pytest.approx(command, abs=1e-6)
        last = command
        reference.advance(goal)
        # the slowest channel is at its limit, and all of them are on the straight way
        share = np.abs(reference.path - path) / (SLEW * period)
        assert share.max() == pytest.approx(min(1.0, np.max(np.abs(goal - path) / (SLEW * period))))
        path = reference.path.copy()


TARGETS = {
    "position": {"position": (0.01, None, 0.2)},
    "pointing": {"position": (0.01, 0.0, 0.2), "pointing": (0.0, 0.6, 0.8)},
    "orientation": {"orientation": (0.8, 0.0, 0.6, 0.0)},
}


def drawn_tip(seed, n=6):
    rng = np.random.default_rng(seed)
    pose = np.array(lie.exp(np.concatenate([rng.normal(size=3) * 0.1, rng.normal(size=3)])))
    jacobian = rng.normal(size=(6, n)) * np.repeat([3e-7, 3e-6], 3)[:, None]
    return TipAt(pose, jacobian, np.eye(6))


@pytest.mark.parametrize("name", list(TARGETS))
@pytest.mark.parametrize("seed", range(4))
def test_pose_errors_are_those_of_geometry_and_their_derivative_is_right(name, seed):
    target, tip, errors, lever = Target(**TARGETS[name]), drawn_tip(seed), TipErrors(), 0.05
    R, position = tip.pose[:3, :3], tip.pose[:3, 3]
    distance, angle = errors.at(target, position, R)
    if target.position is None:
        assert math.isnan(distance)
    else:
        goals = np.array([np.nan if goal is None else goal for goal in target.position])
        away = (position - goals)[np.isfinite(goals)]
        assert distance == pytest.approx(np.linalg.norm(away), rel=1e-9)
    if target.pointing is not None:
        assert angle == pytest.approx(np.arccos(R[:, 2] @ np.array(target.pointing)), rel=1e-7)
    if target.orientation is not None:
        goal = lie.rotation_from_quaternion(np.array(target.orientation))
        assert angle == pytest.approx(np.arccos((np.trace(R.T @ goal) - 1) / 2), rel=1e-7)
    assert math.isnan(angle) == (target.pointing is None and target.orientation is None)
    error, jacobian, *lengths = errors.weighted(target, tip, lever)
    weighted = np.hypot(*np.nan_to_num([distance, lever * angle]))
    assert np.linalg.norm(error) == pytest.approx(weighted, rel=1e-9)
    assert lengths == pytest.approx(np.nan_to_num([distance, angle]), rel=1e-9)
    for channel in range(tip.jacobian.shape[1]):
        moved = []
        for step in (-1.0, 1.0):  # Pa
            pose = tip.pose @ np.array(lie.exp(step * tip.jacobian[:, channel]))
            moved.append(errors.weighted(target, tip._replace(pose=pose), lever)[0])
        slope = (moved[1] - moved[0]) / 2
        assert jacobian[:, channel] == pytest.approx(slope, rel=1e-4, abs=1e-12)


@pytest.mark.parametrize("name", list(TARGETS))
def test_rows_of_feedback_are_the_errors_derivative_at_the_target(name):
    """Feedback, linear at a tip that is near its target, weighs it as the search for it does."""
    tip, lever = drawn_tip(1), FeedbackTuning().lever
    R, position = tip.pose[:3, :3], tip.pose[:3, 3]
    given = dict(TARGETS[name])
    if "position" in given:
        given["position"] = tuple(
            None if goal is None else float(x)
            for x, goal in zip(position, given["position"], strict=True)
        )
    if "pointing" in given:
        given["pointing"] = tuple(map(float, R[:, 2]))
    if "orientation" in given:
        q = lie.quaternion_from_rotation(R)
        given["orientation"] = tuple(map(float, q * np.sign(q[0])))
    target = Target(**given)
    law = tracking_rows(6, None)
    formula = Formula(law.inputs, [law.rows], [*law.matrices, law.rows])
    (rows,) = formula(tip.pose, tip.jacobian, prescribed_components(target), np.zeros(6))
    _, jacobian, *_ = TipErrors().weighted(target, tip, lever)
    # the same quadratic form, though a pointing has three rows there and two here
    assert rows.T @ rows == pytest.approx(jacobian.T @ jacobian, rel=1e-6, abs=1e-18)


@pytest.mark.parametrize("boundary", ["free", "guided", "clamped"])
@pytest.mark.parametrize("kind", ["translation", "rotation"])
@pytest.mark.parametrize("frame", ["base", "tip"])
def test_routes_of_directional_stiffness(frame, kind, boundary):
    """In symbols, in numbers, along a motion, and of an arm as the optimiser evaluates it."""
    rng = np.random.default_rng([len(frame), len(kind), len(boundary)])
    arm, p = load_robot("stiff-flop-2"), rng.uniform(0, 1.2e5, (4, 6))
    C, R = arm.tip_compliance(p), arm.tip_pose(p)[:, :3, :3]
    d = rng.normal(size=3)
    d /= np.linalg.norm(d)
    symbols = [ca.SX.sym("C", 6, 6), ca.SX.sym("R", 3, 3)]
    formula = Formula(symbols, [directional_stiffness(*symbols, ca.DM(d), frame, kind, boundary)])
    expected = [float(formula(*row)[0][0]) for row in zip(C, R, strict=True)]
    directions = np.swapaxes(R, 1, 2) @ d if frame == "base" else np.broadcast_to(d, (4, 3))
    assert stiffness_of(C, directions, kind, boundary) == pytest.approx(expected, rel=1e-9)
    measure = StiffnessMeasure(direction=d, frame=frame, kind=kind, boundary=boundary)
    assert _least_stiffness(arm, p, [measure]) == pytest.approx(expected, rel=1e-6)
    found = arm.stiffness(p, direction=d, frame=frame, kind=kind, boundary=boundary)
    assert found == pytest.approx(expected, rel=1e-9)
