"""The program of a task: residuals, values and their derivatives against finite differences."""

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise.problem import PressureProblem

P2 = 1e5 * np.array([0.5, 1.0, 0.2, 0.9, 0.1, 1.2])
X2 = P2 / 1.5e5  # shares of the range

TARGETS = {
    "position": so.Target(position=(-0.03, 0.01, 0.19)),
    "free axes": so.Target(position=(None, 0.01, None)),
    "pointing": so.Target(pointing=(0.3, -0.2, 0.9)),
    "pointing the other way": so.Target(pointing=(0.1, 0.0, -1.0)),
    "position and pointing": so.Target(position=(-0.03, 0.01, 0.19), pointing=(0, 1, 1)),
    "orientation": so.Target(orientation=(0.9, 0.1, -0.3, np.sqrt(1 - 0.91))),
}


def measure(**options):
    return so.StiffnessMeasure(direction=(0.3, -0.5, 0.8), **options)


GOALS = {
    "one": so.StiffnessGoal(maximise=measure()),
    "guided, tip axes": so.StiffnessGoal(maximise=measure(boundary="guided", frame="tip")),
    "clamped rotation": so.StiffnessGoal(maximise=measure(boundary="clamped", kind="rotation")),
    "several and a floor": so.StiffnessGoal(
        maximise=(measure(), measure(frame="tip")),
        at_least=so.AtLeast(direction=(0, 0, 1), value=10.0),
    ),
    "match a value": so.StiffnessGoal(match=so.MatchValue(direction=(1, 0, 0), value=1.3)),
    "match a matrix": so.StiffnessGoal(
        match=so.MatchMatrix(matrix=((2, 0.1, 0), (0.1, 1.5, 0), (0, 0, 20)))
    ),
    "match a matrix, clamped, tip axes": so.StiffnessGoal(
        match=so.MatchMatrix(
            matrix=((2, 0.1, 0), (0.1, 1.5, 0), (0, 0, 20)), boundary="clamped", frame="tip"
        )
    ),
}


def problem(target=None, goal=None, robot="stiff-flop-2", **task):
    target = target or so.Target(position=(-0.03, 0.01, 0.19))
    return PressureProblem(
        so.load_robot(robot), so.Task(robot=robot, target=target, stiffness=goal, **task)
    )


def differences(function, x, step=1e-4):
    """Central differences of a vector function, (k, n)."""
    columns = []
    for i in range(len(x)):
        d = step * np.eye(len(x))[i]
        columns.append((function(x + d) - function(x - d)) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", TARGETS)
def test_ball_jacobians(name):
    p = problem(TARGETS[name])
    for k, ball in enumerate(p.pose(X2).balls):
        expected = differences(lambda x, k=k: p.pose(x).balls[k].residual, X2)
        assert ball.jacobian == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


@pytest.mark.one_in(2)
@pytest.mark.parametrize("robot", ["stiff-flop-2", "stiff-flop-2-hanging"])
@pytest.mark.parametrize("name", GOALS)
def test_gradients_of_terms_and_floors(name, robot):
    p = problem(goal=GOALS[name], robot=robot)
    point = p.point(X2)
    expected = differences(lambda x: p.point(x).terms, X2, 1e-3)
    assert point.term_gradients == pytest.approx(expected, abs=2e-5 * np.abs(expected).max())
    if len(point.floors):
        expected = differences(lambda x: p.point(x).floors, X2, 1e-3)
        assert point.floor_gradients == pytest.approx(expected, abs=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["position", "angle"])
def test_gradient_of_the_distance_from_a_target(name):
    p = problem(TARGETS["position and pointing"])
    terms = p.closest(name).terms
    expected = differences(lambda x: terms(p.pose(x))[0], X2, 1e-3)
    assert terms(p.pose(X2))[1] == pytest.approx(expected, abs=2e-5 * np.abs(expected).max())


def test_many_poses_are_those_one_by_one():
    p = problem(TARGETS["position and pointing"])
    x = X2 * np.linspace(0.2, 1.0, 5)[:, np.newaxis]
    residuals, jacobians = p.poses(x)
    for row, residual, jacobian in zip(x, residuals, jacobians, strict=True):
        point = p.pose(row)
        assert (residual == point.residual).all()
        assert (jacobian == point.jacobian).all()


def test_point_and_pose_agree_on_the_balls():
    p = problem(TARGETS["position and pointing"], GOALS["several and a floor"])
    pose, point = p.pose(X2), p.point(X2)
    assert point.residual == pytest.approx(pose.residual, abs=1e-14)
    assert point.jacobian == pytest.approx(pose.jacobian, abs=1e-14)
    assert pose.errors == tuple(ball.error for ball in pose.balls)
    assert not pose.terms.size
    assert not pose.reached


def test_values_are_logarithms_of_the_robots_stiffnesses():
    p = problem(goal=GOALS["several and a floor"])
    robot = so.load_robot("stiff-flop-2")
    expected = [
        robot.stiffness(P2, (0.3, -0.5, 0.8)),
        robot.stiffness(P2, (0.3, -0.5, 0.8), frame="tip"),
        robot.stiffness(P2, (0, 0, 1)),
    ]
    point = p.point(X2)
    assert np.exp([*-point.terms, *point.floors]) == pytest.approx(expected, rel=1e-12)


def test_angle_errors_are_angles():
    robot = so.load_robot("stiff-flop-2")
    T = robot.tip_pose(P2)
    for turn in (1e-6, 0.3, 2.0, 3.1):
        axis = T[:3, 0]
        wanted = np.cos(turn) * T[:3, 2] + np.sin(turn) * np.cross(axis, T[:3, 2])
        p = problem(so.Target(pointing=tuple(wanted)))
        assert p.pose(X2).errors == pytest.approx([turn], rel=1e-6)


def test_opposite_pointing_has_a_finite_residual():
    p = problem(so.Target(pointing=(0, 0, -1)))
    straight = p.pose(np.full(6, 0.5))
    assert straight.errors == pytest.approx([np.pi])
    assert np.isfinite(straight.jacobian).all()


def test_pressure_limits_of_the_task_tighten_the_robots():
    p = problem(pressure={"min": 0.1e5, "max": (1.2e5, 1e5, 1e5, 9e5, 1e5, 1e5)})
    assert p.lower * 1.5 == pytest.approx(np.full(6, 0.1))
    assert p.upper * 1.5 == pytest.approx([1.2, 1.0, 1.0, 1.5, 1.0, 1.0])
