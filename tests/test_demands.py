"""What a task demands, and whether a tip has it, with and without a margin."""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

import stiffopt as so
from stiffopt.control.demands import Demands
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.measure import Measure, Role
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipModel

ROBOT = so.load_robot("stiff-flop-2")
PRESSURES = np.array([0.9, 0.4, 0.2, 0.1, 0.7, 0.3]) * 1e5
TIP = TipModel(ROBOT).at(PRESSURES)
MARGIN = 0.02
TURN = {"direction": (0, 1, 0), "kind": "rotation", "boundary": "clamped", "frame": "tip"}
PUSH = {"direction": (1, 0, 0)}


def demands(**goal):
    task = Task(target=Target(position=(0, 0, 0.2)), stiffness=StiffnessGoal.model_validate(goal))
    return Demands(task, MARGIN)


@pytest.mark.parametrize("measure", [PUSH, TURN])
@pytest.mark.parametrize("share", [0.97, 0.99, 1.01, 1.03])
def test_a_stiffness_is_at_least_a_value(measure, share):
    value = share * ROBOT.stiffness(PRESSURES, **measure)
    asked = demands(at_least=measure | {"value": value})
    assert asked.are_clearly_met(TIP) is (share < 0.98)
    assert asked.are_missed(TIP) is (share > 1.02)


def test_all_of_several_stiffnesses_are_demanded():
    values = [ROBOT.stiffness(PRESSURES, **measure) for measure in (PUSH, TURN)]
    for shares in ((0.9, 0.9), (0.9, 1.1), (1.1, 0.9)):
        pairs = zip((PUSH, TURN), shares, values, strict=True)
        asked = demands(at_least=[each | {"value": share * k} for each, share, k in pairs])
        assert asked.are_clearly_met(TIP) is (max(shares) < 1)
        assert asked.are_missed(TIP) is (max(shares) > 1)


@pytest.mark.parametrize("share", [0.93, 0.95, 0.985, 1.0, 1.03, 1.07])
def test_a_stiffness_matches_a_value(share):
    value = {"value": ROBOT.stiffness(PRESSURES, **PUSH) / share, "tolerance": 0.04}
    asked = demands(match=PUSH | value)
    assert asked.are_clearly_met(TIP) is (abs(share - 1) < 0.02)
    assert asked.are_missed(TIP) is (abs(share - 1) > 0.06)


@pytest.mark.parametrize("off", [0.002, 0.02, 0.05])
def test_a_stiffness_matches_a_matrix(off):
    C = np.linalg.inv(TIP.compliance[:3, :3])
    K = TIP.pose[:3, :3] @ C @ TIP.pose[:3, :3].T * (1 + off)
    matrix = {"matrix": (0.5 * (K + K.T)).tolist(), "unit": "N/m", "tolerance": 0.01}
    asked = demands(match=matrix)
    assert asked.are_clearly_met(TIP) is (off < 0.004)
    assert asked.are_missed(TIP) is (off > 0.04)


def test_what_is_only_maximised_is_no_demand():
    assert not demands(maximise=PUSH)
    assert not Demands(None, MARGIN)
    assert demands(maximise=PUSH, at_least=TURN | {"value": 0.1})


class _Reach(Measure):
    """A measure of somebody else's, which depends on where the tip is."""

    key: ClassVar[str] = "reach"
    role: ClassVar[Role] = "at_least"
    unit: ClassVar[str] = "N/m"
    structure: ClassVar[tuple[str, ...]] = ("reach",)
    parameters: ClassVar[tuple[float, ...]] = ()
    value: float

    def formula(self, tip, parameters):
        return ca.log(ca.norm_2(tip.position) / ca.trace(tip.compliance[:3, :3]))

    def holds(self, value):
        return value >= self.value


@pytest.mark.parametrize("share", [0.97, 1.03])
def test_any_measure_may_be_demanded(share):
    value = np.linalg.norm(TIP.pose[:3, 3]) / np.trace(TIP.compliance[:3, :3])
    goal = SimpleNamespace(at_least=(_Reach(value=share * value),), match=None)
    asked = Demands(SimpleNamespace(stiffness=goal), MARGIN)
    assert asked.are_clearly_met(TIP) is (share < 1)
    assert asked.are_missed(TIP) is (share > 1)
