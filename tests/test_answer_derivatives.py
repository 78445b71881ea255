"""Derivatives of answers against differences of answers that are solved again."""

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise.derivatives import AnswerDerivatives


def along(*directions, **options):
    measures = [so.StiffnessMeasure(direction=d, **options) for d in directions]
    return so.StiffnessGoal(maximise=measures)


def polished(robot, task, guess):
    """Pressures and stiffness of the optimum next to a guess, as exactly as can be had."""
    solution = so.solve_pressure(robot, task, guess=guess)
    found = AnswerDerivatives(robot, task, solution.pressures)
    return found._point.x * found._problem.unit, float(np.exp(-found._point.terms.max()))


def differences(robot, task_at, guess, h):
    """Derivatives of pressures and stiffness by the parameter of a task."""
    (p0, k0), (p1, k1) = (polished(robot, task_at(s * h), guess) for s in (-1, 1))
    return (p1 - p0) / (2 * h), (k1 - k0) / (2 * h)


def check(found, expected, rel):
    scale = max(np.abs(expected).max(), 1e-12)
    np.testing.assert_allclose(found / scale, expected / scale, atol=rel)


TASKS = [(seed, name) for seed in range(4) for name in ("stiff-flop-1", "stiff-flop-2")]


@pytest.mark.parametrize(("seed", "name"), TASKS)
def test_derivatives_by_target_and_direction(seed, name):
    rng = np.random.default_rng(seed)
    robot = so.load_robot(name)
    T = robot.tip_pose(rng.uniform(0.1e5, 1.4e5, robot.n_pressures))
    target = so.Target(
        position=tuple(T[:3, 3]),
        pointing=tuple(T[:3, 2]) if name.endswith("2") and seed % 2 else None,
        tolerance=so.Tolerance(position=[1e-4, 2e-3][seed // 2]),
    )
    directions = rng.normal(size=(1 + seed % 2, 3))
    task = so.Task(target=target, stiffness=along(*map(tuple, directions)))
    solution = so.solve_pressure(robot, task)
    p = solution.pressures
    by_target = solution.gradient("stiffness", by="target")
    size = 3 if target.pointing is None else 6
    assert by_target.shape == (size,)
    assert solution.weakly_active == ()
    way = rng.normal(size=6) * (np.arange(6) < size)
    expected = differences(
        robot,
        lambda h: task.model_copy(update={"target": target.moved_back(-h * way)}), p, 1e-6,
    )  # fmt: skip
    assert by_target @ way[:size] == pytest.approx(expected[1], rel=1e-5)
    check(solution.gradient("pressures", by="target") @ way[:size], expected[0], 1e-3)
    turn = rng.normal(size=directions.shape)
    expected = differences(
        robot,
        lambda h: task.model_copy(
            update={"stiffness": along(*map(tuple, _units(_units(directions) + h * turn)))}
        ), p, 1e-5,
    )  # fmt: skip
    by_direction = np.atleast_2d(solution.gradient("stiffness", by="direction"))
    assert (by_direction * turn).sum() == pytest.approx(expected[1], rel=1e-4, abs=1e-7)
    of_pressures = solution.gradient("pressures", by="direction").reshape(len(p), -1)
    check(of_pressures @ turn.ravel(), expected[0], 1e-3)


def _units(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_derivatives_by_limits():
    robot = so.load_robot("stiff-flop-2")
    lower, upper = np.array([0.1, 0.05, 0.1, 0.2, 0, 0]) * 1e5, np.full(6, 1.05e5)

    def task_at(low, high):
        limits = so.Task.model_fields["pressure"].annotation(min=tuple(low), max=tuple(high))
        goal = along((1, 0, 0))
        return so.Task(target=so.Target(position=(-0.03, 0.01, 0.19)), stiffness=goal,
                       pressure=limits)  # fmt: skip

    task = task_at(lower, upper)
    solution = so.solve_pressure(robot, task)
    p = solution.pressures
    of_k, of_p = (solution.gradient(of, by="limits") for of in ("stiffness", "pressures"))
    assert of_k.shape == (2, 6)
    assert of_p.shape == (6, 2, 6)
    active = [(s, i) for s in (0, 1) for i in range(6) if abs(p[i] - (lower, upper)[s][i]) < 1e-3]
    assert len(active) >= 2
    for side in (0, 1):
        for i in range(6):
            if (side, i) not in active:
                assert of_k[side, i] == 0
                assert not of_p[:, side, i].any()
                continue
            e = np.eye(6)[i]
            expected = differences(
                robot,
                lambda h, e=e, s=side: task_at(lower + h * e * (s == 0), upper + h * e * (s == 1)),
                p, 20.0,
            )  # fmt: skip
            if (lower, upper)[side][i] > 0:
                assert of_k[side, i] == pytest.approx(expected[1], rel=1e-4, abs=1e-12)
                check(of_p[:, side, i], expected[0], 1e-3)


@pytest.mark.parametrize("code", ["VM", pytest.param("compiled", marks=pytest.mark.long)])
def test_derivatives_of_a_hanging_arm(code, request):
    if code == "compiled":
        request.getfixturevalue("compiled")
    description = so.load_robot("stiff-flop-1").description
    robot = so.load_robot(description.model_copy(update={"gravity": (0.0, 0.0, 9.81)}))
    target = so.Target(position=(0.01, 0.005, None))
    task = so.Task(target=target, stiffness=along((1, 0, 0)))
    solution = so.solve_pressure(robot, task)
    gradient = solution.gradient("stiffness", by="target")
    assert gradient[2] == pytest.approx(0, abs=1e-6)
    h, p = 2e-5, solution.pressures
    for axis in range(2):
        k = [
            polished(robot, task.model_copy(update={"target": target.moved_back(-s * h * e)}), p)[1]
            for s, e in ((-1, np.eye(6)[axis]), (1, np.eye(6)[axis]))
        ]
        assert gradient[axis] == pytest.approx((k[1] - k[0]) / (2 * h), rel=1e-3)


def test_what_has_no_derivatives():
    robot = so.load_robot("stiff-flop-1")
    task = so.Task(target=so.Target(position=(0.01, 0.01, None)))
    solution = so.solve_pressure(robot, task)
    with pytest.raises(so.InputError, match="only a stiffness that is maximised"):
        solution.gradient("stiffness", by="target")
    with pytest.raises(so.InputError, match=r"by .* 'limits' or 'clearance'; got 'load'"):
        solution.gradient("pressures", by="load")
    with pytest.raises(so.InputError, match="of 'stiffness' or 'pressures'; got 'tip'"):
        solution.gradient("tip", by="target")
    away = so.solve_pressure(robot, so.Task(target=so.Target(position=(0, 0, 1))))
    with pytest.raises(so.DerivativeError, match="only a solution that was found"):
        away.gradient("pressures", by="target")
