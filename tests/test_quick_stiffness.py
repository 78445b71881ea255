"""The stiffness against quick small pushes, which creep and hysteresis hold against."""

from __future__ import annotations

import numpy as np
import pytest

from stiffopt import InputError, load_robot
from stiffopt.identify.problem import CalibrationProblem, Noise
from stiffopt.identify.unknowns import Unknowns, history_unknowns, shape_unknowns
from stiffopt.logs import StiffnessTable
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.history import Creep, History, Memory, Play
from stiffopt.model.robot_files import load_description

P = np.array([0.5e5, 1.0e5, 0.2e5])
X = [1.0, 0.0, 0.0]


def robot(name: str, *histories: History) -> RobotDescription:
    description = load_description(name)
    segments = tuple(
        segment.model_copy(update={"history": history})
        for segment, history in zip(description.segments, histories, strict=True)
    )
    return description.model_copy(update={"segments": segments})


SLOW = History(lag=0.1, play=[Play(width=4e3, share=0.2)], creep=[Creep(time=20.0, share=0.1)])
MIXED = History(memory=[0.5, 1.0, 1.5], play=[Play(width=4e3, share=0.2)])


@pytest.mark.parametrize(("history", "share"), [(SLOW, 0.7), (MIXED, 0.8), (History(), 1.0)])
def test_one_segment_is_stiffer_by_what_its_memory_holds(history: History, share: float) -> None:
    arm = load_robot(robot("stiff-flop-1", history))
    assert history.quick_share == pytest.approx(share)
    for direction in np.eye(3):
        slow = arm.stiffness(P, direction)
        assert arm.stiffness(P, direction, quick=True) == pytest.approx(slow / share, rel=1e-12)


def test_a_memory_of_strain_holds_more_where_the_arm_is_soft() -> None:
    given = load_description("stiff-flop-1")
    (segment,) = given.segments
    assert segment.compensation is not None
    slope = segment.compensation.modulus_per_pressure / segment.material.youngs_modulus
    history = SLOW.model_copy(update={"softening": slope, "remembers": "strain"})
    arm, most = load_robot(robot("stiff-flop-1", history)), np.array(given.pressure_max)
    for share, tolerance in ((0.0, 1e-6), (0.5, 0.10), (1.0, 1e-6)):
        left = 1 + slope * float(np.linalg.norm(share * most))
        expected = arm.stiffness(share * most, X) / (1 - 0.3 / left)
        quick = arm.stiffness(share * most, X, quick=True)
        assert quick == pytest.approx(expected, rel=tolerance)


def test_the_quick_share_is_what_a_small_quick_change_of_pressure_does() -> None:
    """On an arm long at a pressure, in the middle of its plays."""
    memory = Memory([SLOW.model_copy(update={"lag": 0.0})])
    memory.settle([5e4])
    before = memory.effective[0]
    after = memory.advance(1e-6, [5e4 + 10.0])[0]
    assert (after - before) / 10.0 == pytest.approx(SLOW.quick_share, rel=1e-6)


def test_segments_count_for_their_own_flexibility() -> None:
    p = np.tile(P, 2)
    arm = load_robot(robot("stiff-flop-2", SLOW, History()))
    other = load_robot(robot("stiff-flop-2", SLOW, SLOW))
    slow = arm.stiffness(p, X)
    assert slow < arm.stiffness(p, X, quick=True) < other.stiffness(p, X, quick=True)
    assert np.array_equal(arm.tip_pose(p), load_robot("stiff-flop-2").tip_pose(p))


def test_loaded_arms_are_refused() -> None:
    arm = load_robot("stiff-flop-1").with_load([0.0, 0.0, -0.01])
    with pytest.raises(InputError, match="without gravity and load"):
        arm.stiffness(P, X, quick=True)


def test_a_table_is_compared_with_the_quick_stiffness_and_knows_its_slopes() -> None:
    """What a probe measures, by finite differences of shares, memories and stiffness."""
    history = History(
        memory=[0.8, 1.0, 1.3],
        play=[Play(width=4e3, share=0.1), Play(width=2e4, share=0.15)],
        creep=[Creep(time=20.0, share=0.05)],
    )
    description = robot("stiff-flop-1", history)
    table = StiffnessTable(
        pressures=np.array([P, 0.5 * P]),
        directions=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        boundaries=("free", "free"),
        stiffness=np.array([20.0, 100.0]),
        sigma=np.array([1.0, 5.0]),
    )
    tolerances = Tolerances()
    parameters = (
        *shape_unknowns(description, ["compensation.stiffness"], tolerances),
        *history_unknowns(description, tolerances),
    )
    problem = CalibrationProblem(
        description, Unknowns(parameters), [], (), np.eye(4), Noise(1e-3, 0.05), [table]
    )
    x = np.zeros(problem.size)
    value, slope = problem.residuals(x)
    arm = load_robot(description)
    for i in range(2):
        k = arm.stiffness(table.pressures[i], table.directions[i], quick=True)
        assert value[i] == pytest.approx((table.stiffness[i] - k) / table.sigma[i], rel=1e-9)
    h = 1e-6
    for j in range(problem.size):
        step = h * np.eye(problem.size)[j]
        moved = problem.residuals(x + step)[0] - problem.residuals(x - step)[0]
        np.testing.assert_allclose(slope[:, j], moved / (2 * h), rtol=1e-5, atol=1e-8)
