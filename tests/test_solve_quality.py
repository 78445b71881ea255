"""Quality of the answers on random tasks, against a reference that shares no optimiser.

The tasks are those of ``benchmarks/quality.py``.  The short form compares with values that the
reference found before (``quality_reference.json``, written by ``benchmarks/quality.py --record``);
the long form runs the reference, on other tasks.
"""

import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from conftest import is_long
from stiffopt import Manipulator, load_robot, solve_pressure

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "benchmarks"))

from quality import NEAR_BEST, case, measure  # noqa: E402
from reference import Reference, pose_errors  # noqa: E402

RECORDED = json.loads((HERE / "quality_reference.json").read_text())


@cache
def robot(name: str) -> Manipulator:
    return load_robot(name)


def recorded_cases() -> list[tuple[str, str, int, int, float]]:
    """Robot, kind, seed, number and the best value known."""
    return [
        (*key.split(" "), known["seed"], number, best)
        for key, known in RECORDED.items()
        for number, best in enumerate(known["best"])
    ]


def test_enough_is_recorded():
    assert len(RECORDED["stiff-flop-2 position"]["best"]) >= 25
    assert len(RECORDED["stiff-flop-3 position"]["best"]) >= 5


@pytest.mark.one_in(3, "name")
@pytest.mark.parametrize(("name", "kind", "seed", "number", "best"), recorded_cases())
def test_answer_reaches_the_pose_and_is_as_good_as_the_reference(name, kind, seed, number, best):
    arm = robot(name)
    task = case(arm, kind, seed, number)
    solution = solve_pressure(arm, task)
    assert solution.found, solution.message
    p = solution.pressures
    assert p is not None
    lower, upper = task.pressure_bounds(arm.description)
    assert (p >= lower - 0.1).all()
    assert (p <= upper + 0.1).all()
    position, angle = pose_errors(task, arm.tip_pose(p))
    tolerance = task.target.tolerance
    assert position is None or position <= tolerance.position * (1 + 1e-9)
    assert angle is None or angle <= tolerance.angle * (1 + 1e-9) + 1e-12
    value = Reference(arm, task).value(p / 1e5)
    if task.stiffness is None:
        assert value <= (1 + NEAR_BEST) * best
    elif task.stiffness.match is not None:
        assert value <= task.stiffness.match.tolerance
    else:
        assert value >= (1 - NEAR_BEST) * best
        floors = task.stiffness.at_least
        have = solution.stiffnesses[len(task.stiffness.maximise) :]
        assert all(there >= floor.value for there, floor in zip(have, floors, strict=True))


@pytest.mark.one_in(2, "name")
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("stiff-flop-1", "unreachable"),
        ("stiff-flop-2", "unreachable"),
        ("stiff-flop-2", "unreachable-limited"),
        ("stiff-flop-2", "unreachable-pose-5"),
        ("stiff-flop-3", "unreachable"),
    ],
)
def test_closest_configuration_is_the_closest(name, kind):
    outcomes = measure(robot(name), kind, tasks=4 if is_long() else 2, starts=8, seed=3)
    assert any(outcome.counts for outcome in outcomes)
    assert all(outcome.found and outcome.best for outcome in outcomes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "share"), [("stiff-flop-2", 0.99), ("stiff-flop-3", 0.98)], ids=["two", "three"]
)
def test_bars_of_reachable_tasks(name, share):
    outcomes = measure(robot(name), "position", tasks=200, starts=60, seed=11)
    assert np.mean([outcome.found for outcome in outcomes]) >= 0.995
    assert all(outcome.holds for outcome in outcomes if outcome.found)
    assert np.mean([outcome.best for outcome in outcomes]) >= share


@pytest.mark.long
@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-2", "stiff-flop-3"])
@pytest.mark.parametrize("kind", ["unreachable", "unreachable-limited", "unreachable-pose-5"])
def test_bars_of_unreachable_tasks(name, kind):
    outcomes = measure(robot(name), kind, tasks=50, starts=30, seed=12)
    assert all(outcome.found and outcome.best for outcome in outcomes)


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    ["free-axis", "pointing", "orientation", "pose-5", "guided", "clamped", "rotation", "several",
     "tip-frame", "limited", "floor", "least-pressure", "match", "match-matrix"],
)  # fmt: skip
def test_bars_of_other_kinds(kind):
    outcomes = measure(robot("stiff-flop-2"), kind, tasks=50, starts=40, seed=13)
    assert np.mean([outcome.found for outcome in outcomes]) >= 0.98
    assert all(outcome.holds for outcome in outcomes if outcome.found)
    assert np.mean([outcome.best for outcome in outcomes]) >= 0.98
