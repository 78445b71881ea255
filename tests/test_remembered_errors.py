"""How far an arm answers to what its model has wrong at former pressures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stiffopt.model.description import RobotDescription
from stiffopt.model.remembered_errors import RememberedErrors
from stiffopt.model.robot_files import load_description

PLAY = {"width": 1e4, "share": 0.2}
SPAN = 1e5  # Pa, of which that play keeps a fifth
MORE = 0.07  # of the pressure, which no model remembers


def with_history(**history: Any) -> RobotDescription:
    described = load_description("stiff-flop-1").model_dump(mode="json")
    described["segments"][0]["history"] = history
    return RobotDescription.model_validate(described)


def with_more(share: float) -> float:
    return share + (1 - share) * MORE


def test_without_creep_a_play_may_be_creep() -> None:
    memory = RememberedErrors.of(with_history(play=[PLAY]), SPAN)
    assert memory.kept == pytest.approx([with_more(0.2 / 5)] * 3)
    assert list(memory.forgotten) == [30.0]
    assert memory.forgotten[30.0] == pytest.approx([with_more(0.2)] * 3)


def test_with_creep_plays_follow_and_each_creep_has_its_own_time() -> None:
    creep = [{"time": 2.0, "share": 0.05}, {"time": 20.0, "share": 0.06}]
    robot = with_history(play=[PLAY], creep=creep, memory=[1.0, 1.0, 0.5])
    memory = RememberedErrors.of(robot, SPAN)
    kept = [with_more(0.15), with_more(0.15), with_more(0.075)]
    assert memory.kept == pytest.approx(kept)
    assert memory.forgotten[2.0] == pytest.approx([0.05, 0.05, 0.025])
    assert memory.forgotten[20.0] == pytest.approx([0.06, 0.06, 0.03])
    assert sum(memory.forgotten.values()) == pytest.approx(kept)


def test_what_the_arm_left_fades_in_the_time_of_its_creep() -> None:
    robot = with_history(creep=[{"time": 2.0, "share": 0.5}])
    memory = RememberedErrors.of(robot, SPAN)
    time = np.array([0.0, 5.0, 10.0])
    moves = np.array([[1e-6] * 3, [0.0] * 3, [0.0] * 3])  # wrong at the first pressures alone
    left = memory.before(time, moves)[:, 0]
    rest = 0.5 * MORE  # the remainder fades as with an arm whose creep is not known
    for k, age in enumerate((0.0, 5.0, 10.0)):
        # of the mean square before the row's own interval, which still had the first pressures
        squares = [1e-6 * np.exp(-max(age - 5.0, 0.0) / each) for each in (2.0, 30.0)]
        expected = (0.5 * np.sqrt(squares[0]) + rest * np.sqrt(squares[1])) ** 2
        assert left[k] == pytest.approx(expected)
    variance = memory.even_variance(moves, memory.before(time, moves))
    assert variance[2] == pytest.approx(left[2])


def test_unknown_pressures_count_with_all_that_is_remembered() -> None:
    robot = with_history(play=[PLAY], creep=[{"time": 2.0, "share": 0.1}])
    memory = RememberedErrors.of(robot, SPAN)
    still = np.full((2, 3), 4e-6)
    before = memory.before(np.array([0.0, 1.0]), still)
    assert memory.before_unknown(still[0]) == pytest.approx(before[1])
