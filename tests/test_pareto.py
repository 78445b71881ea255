"""The trade-off between tip error and stiffness."""

import pytest

import stiffopt as so

TASK = so.Task(
    robot="stiff-flop-2",
    target=so.Target(position=(-0.03, 0.01, 0.19)),
    stiffness=so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=(1, 0, 0))),
)


def test_front_is_monotone_and_starts_at_the_tasks_tolerance():
    robot = so.load_robot("stiff-flop-2")
    front = so.pareto_front(robot, TASK, 5)
    assert front[0].position_error <= 1e-4
    assert front[0].stiffness == pytest.approx(so.solve_pressure(robot, TASK).stiffness, rel=1e-5)
    errors = [solution.position_error for solution in front]
    stiffnesses = [solution.stiffness for solution in front]
    assert errors == sorted(errors)
    assert stiffnesses == sorted(stiffnesses)
    assert errors[-1] <= 0.25 * robot.length
    assert len(front) >= 4


def test_front_of_an_unreachable_target_starts_where_it_can_be_reached():
    robot = so.load_robot("stiff-flop-2")
    far = TASK.model_copy(update={"target": so.Target(position=(-0.03, 0.01, 0.27))})
    front = so.pareto_front(robot, far, 6)
    assert front
    assert front[0].position_error > 1e-3


def test_front_over_the_angle():
    robot = so.load_robot("stiff-flop-1")
    task = so.Task(
        robot="stiff-flop-1",
        target=so.Target(pointing=(0, 1, 1)),
        stiffness=TASK.stiffness,
    )
    front = so.pareto_front(robot, task, 4)
    assert [s.angle_error for s in front] == sorted(s.angle_error for s in front)


@pytest.mark.parametrize(
    ("task", "n", "message"),
    [
        (TASK.model_copy(update={"stiffness": None}), 5, "stiffness to maximise"),
        (TASK, 1, "at least 2"),
    ],
)
def test_bad_input(task, n, message):
    with pytest.raises(so.InputError, match=message):
        so.pareto_front(so.load_robot("stiff-flop-2"), task, n)
