"""Solving tasks: what is found holds, and what cannot be had is said."""

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise.solver import PressureSolver, stiffness_blind

REACHABLE = so.Target(position=(-0.03, 0.01, 0.19))


@pytest.fixture(scope="module")
def robot():
    return so.load_robot("stiff-flop-2")


def along(*direction, **options):
    return so.StiffnessMeasure(direction=direction, **options)


def maximise(*measures):
    return so.StiffnessGoal(maximise=measures)


def two_segment_task(target=REACHABLE, stiffness=None, **options):
    return so.Task(robot="stiff-flop-2", target=target, stiffness=stiffness, **options)


KINDS = {
    "position": (REACHABLE, maximise(along(1, 0, 0))),
    "free axis": (so.Target(position=(None, 0.02, 0.17)), maximise(along(0, 1, 0))),
    "pointing": (
        so.Target(position=(-0.05, 0.01, 0.19), pointing=(0, 1, 1)),
        maximise(along(0, 0, 1, frame="tip")),
    ),
    "pointing alone": (so.Target(pointing=(0, 1, 1)), maximise(along(0, 0, 1))),
    "orientation": (
        so.Target(position=(-0.01, 0, 0.185), orientation=(1, 0, 0, 0)),
        maximise(along(1, 0, 0)),
    ),
    "guided": (REACHABLE, maximise(along(0, 1, 0, boundary="guided"))),
    "clamped": (REACHABLE, maximise(along(0, 0, 1, boundary="clamped"))),
    "rotation": (REACHABLE, maximise(along(0, 0, 1, kind="rotation"))),
    "several": (REACHABLE, maximise(along(1, 0, 0), along(0, 1, 0))),
    "no stiffness": (REACHABLE, None),
    "at least": (REACHABLE, so.StiffnessGoal(at_least=so.AtLeast(direction=(1, 0, 0), value=1.42))),
    "maximise one, at least another": (
        REACHABLE,
        so.StiffnessGoal(
            maximise=along(0, 1, 0), at_least=so.AtLeast(direction=(1, 0, 0), value=1.4)
        ),
    ),
    "match a value": (
        REACHABLE,
        so.StiffnessGoal(match=so.MatchValue(direction=(1, 0, 0), value=1.25)),
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_task_is_solved_and_holds(robot, kind):
    target, goal = KINDS[kind]
    task = two_segment_task(target, goal)
    solution = so.solve_pressure(robot, task)
    assert solution.found, solution.message
    p = solution.pressures
    assert (p >= 0).all()
    assert (p <= 1.5e5).all()
    T = robot.tip_pose(p)
    if target.position is not None:
        asked = [i for i in range(3) if target.position[i] is not None]
        error = np.linalg.norm([T[i, 3] - target.position[i] for i in asked])
        assert error <= target.tolerance.position
        assert solution.position_error == pytest.approx(error, abs=1e-12)
    if target.pointing is not None:
        assert np.arccos(T[:3, 2] @ target.pointing) <= target.tolerance.angle * (1 + 1e-9)
    if goal is not None and goal.maximise:
        first = goal.maximise[0]
        k = robot.stiffness(p, first.direction, first.kind, first.boundary, first.frame)
        assert solution.stiffness == pytest.approx(k, rel=1e-12)
        # no worse than the stiffness-blind pose
        solver = PressureSolver(robot, task)
        blind = stiffness_blind(solver, solution)
        assert blind.found
        if len(goal.maximise) == 1 and not goal.at_least:
            k_blind = robot.stiffness(
                blind.pressures, first.direction, first.kind, first.boundary, first.frame
            )
            assert solution.stiffness >= k_blind * (1 - 1e-6)
    for floor, value in zip(
        goal.at_least if goal else (), solution.stiffnesses[::-1], strict=False
    ):
        assert value >= floor.value


def test_tolerance_is_used_where_it_buys_stiffness(robot):
    tight = so.solve_pressure(robot, two_segment_task(stiffness=maximise(along(1, 0, 0))))
    wide = so.solve_pressure(
        robot,
        two_segment_task(
            so.Target(position=REACHABLE.position, tolerance=so.Tolerance(position=0.005)),
            maximise(along(1, 0, 0)),
        ),
    )
    assert tight.position_error == pytest.approx(1e-4, rel=1e-4)
    assert wide.position_error == pytest.approx(5e-3, rel=1e-4)
    assert wide.stiffness > 1.05 * tight.stiffness


def test_price_of_tolerance_predicts_what_a_larger_one_buys(robot):
    def solve(tolerance):
        target = so.Target(position=REACHABLE.position, tolerance=so.Tolerance(position=tolerance))
        return so.solve_pressure(robot, two_segment_task(target, maximise(along(1, 0, 0))))

    here, there = solve(1e-3), solve(1.1e-3)
    bought = (there.stiffness - here.stiffness) / 1e-4
    assert here.sensitivities.per_position_tolerance == pytest.approx(bought, rel=0.02)


def test_price_of_a_limit_predicts_what_relaxing_it_buys(robot):
    def solve(limit):
        task = two_segment_task(stiffness=maximise(along(1, 0, 0)), pressure={"max": limit})
        return so.solve_pressure(robot, task)

    here, there = solve(1.0e5), solve(1.005e5)
    prices = here.sensitivities.per_bound
    assert set(prices) == set(here.active_bounds)
    bought = (there.stiffness - here.stiffness) / 500.0
    at_max = sum(price for name, price in prices.items() if name.endswith("max"))
    assert at_max > 0
    assert at_max == pytest.approx(bought, rel=0.05)


def test_stiffness_gradient_is_reported(robot):
    solution = so.solve_pressure(robot, two_segment_task(stiffness=maximise(along(1, 0, 0))))
    expected = robot.stiffness_gradient(solution.pressures, (1, 0, 0))
    assert solution.sensitivities.stiffness_gradient == pytest.approx(expected)
    assert solution.sensitivities.tip_jacobian.shape == (6, 6)
    assert solution.sensitivities.objective_unit == "N/m"


def test_one_segment_has_no_freedom():
    robot = so.load_robot("stiff-flop-1")
    target = robot.tip_pose(np.array([0.8e5, 0.3e5, 0.1e5]))[:3, 3]
    task = so.Task(
        robot="stiff-flop-1",
        target=so.Target(position=tuple(target)),
        stiffness=maximise(along(1, 0, 0)),
    )
    solution = so.solve_pressure(robot, task)
    assert solution.found
    assert solution.freedom == 0
    assert "no freedom" in solution.message
    assert "per mm" in solution.message


def test_unreachable_target_gives_the_closest_configuration(robot):
    far = so.Target(position=(-0.03, 0.01, 0.29))
    solution = so.solve_pressure(robot, two_segment_task(far, maximise(along(1, 0, 0))))
    assert solution.status == "unreachable"
    assert not solution.found
    rng = np.random.default_rng(0)
    tips = robot.tip_pose(rng.uniform(0, 1.5e5, (20000, 6)))[:, :3, 3]
    assert solution.position_error <= np.linalg.norm(tips - far.position, axis=1).min()
    assert "mm away" in solution.message
    assert "segment 2 channel 1 max" in solution.message


def test_unreachable_pointing_keeps_the_angle_and_minimises_the_distance(robot):
    target = so.Target(position=(-0.03, 0.01, 0.18), pointing=(0, 0, 1))
    solution = so.solve_pressure(robot, two_segment_task(target))
    assert solution.status == "unreachable"
    assert solution.angle_error <= target.tolerance.angle * (1 + 1e-6)
    assert 0.001 < solution.position_error < 0.01


def test_unreachable_angle_is_minimised_first(robot):
    target = so.Target(position=(0, 0, 0.15), pointing=(0, 0, -1))
    limited = two_segment_task(target, pressure={"max": 0.5e5})
    solution = so.solve_pressure(robot, limited)
    alone = two_segment_task(so.Target(pointing=(0, 0, -1)), pressure={"max": 0.5e5})
    least = so.solve_pressure(robot, alone)
    assert least.status == "unreachable"
    assert solution.angle_error == pytest.approx(least.angle_error, rel=1e-4)


def test_stiffness_that_cannot_be_had(robot):
    goal = so.StiffnessGoal(at_least=so.AtLeast(direction=(1, 0, 0), value=9.0))
    solution = so.solve_pressure(robot, two_segment_task(stiffness=goal))
    best = so.solve_pressure(robot, two_segment_task(stiffness=maximise(along(1, 0, 0))))
    assert solution.status == "unreachable"
    assert solution.position_error <= 1e-4
    assert solution.stiffness == pytest.approx(best.stiffness, rel=1e-4)
    assert "9 N/m" in solution.message


def test_contradiction(robot):
    goal = so.StiffnessGoal(
        at_least=so.AtLeast(direction=(1, 0, 0), value=1.4),
        match=so.MatchValue(direction=(1, 0, 0), value=1.2),
    )
    solution = so.solve_pressure(robot, two_segment_task(stiffness=goal))
    assert solution.status == "unreachable"
    assert "not this stiffness" in solution.message


def test_matrix_of_known_pressures_is_matched(robot):
    p = np.array([0.4, 0.7, 0.3, 0.6, 0.2, 0.8]) * 1e5
    T, C = robot.tip_pose(p), robot.tip_compliance(p)
    K = T[:3, :3] @ np.linalg.inv(C[:3, :3]) @ T[:3, :3].T
    K = (K + K.T) / 2
    goal = so.StiffnessGoal(match=so.MatchMatrix(matrix=tuple(map(tuple, K))))
    target = so.Target(position=tuple(T[:3, 3]))
    solution = so.solve_pressure(robot, two_segment_task(target, goal))
    assert solution.found
    assert solution.matrix_distance < 0.01


def test_same_seed_same_answer(robot):
    task = two_segment_task(stiffness=maximise(along(0, 1, 0)))
    first, second = (so.solve_pressure(robot, task, seed=3) for _ in range(2))
    assert (first.pressures == second.pressures).all()
    assert first.confidence == second.confidence


def test_guess_gives_the_answer_next_to_it(robot):
    task = two_segment_task(stiffness=maximise(along(1, 0, 0)))
    solver = PressureSolver(robot, task)
    first = solver.solve()
    moved = so.Target(position=(-0.0303, 0.0104, 0.19))
    again = solver.solve(moved, guess=first.pressures)
    assert again.found
    assert again.confidence.starts == 1
    assert again.stiffness == pytest.approx(solver.solve(moved).stiffness, rel=1e-4)


@pytest.mark.parametrize("guess", [[1, 2], [np.nan] * 6, [1e5] * 7])
def test_bad_guess(robot, guess):
    with pytest.raises(so.InputError, match="guess must be 6"):
        so.solve_pressure(robot, two_segment_task(), guess=guess)


def test_task_for_another_number_of_channels(robot):
    task = two_segment_task(pressure={"max": (1e5, 1e5, 1e5)})
    with pytest.raises(so.InputError, match="6"):
        so.solve_pressure(robot, task)


def test_hanging_arm_under_load():
    free = so.load_robot("stiff-flop-1").description
    robot = so.Manipulator(free.model_copy(update={"gravity": (0, 0, 9.81), "tip_mass": 0.02}))
    task = so.Task(
        robot="hanging",
        target=so.Target(position=(-0.01, 0.005, None)),
        stiffness=maximise(along(1, 0, 0)),
        load=so.Load(force=(0.02, 0, 0)),
    )
    solution = so.solve_pressure(robot, task)
    assert solution.found
    tip = robot.with_load((0.02, 0, 0)).tip_pose(solution.pressures)[:3, 3]
    assert np.linalg.norm(tip[:2] - task.target.position[:2]) <= 1e-4
    # the load matters: without it the tip is elsewhere
    assert np.linalg.norm(robot.tip_pose(solution.pressures)[:3, 3] - tip) > 1e-3


def test_arm_that_falls_over_is_a_failure_and_not_an_exception():
    description = so.load_robot("stiff-flop-2-hanging").description
    standing = so.Manipulator(description.model_copy(update={"gravity": (0.0, 0.0, -9.81)}))
    task = so.Task(robot="standing", target=REACHABLE)
    solution = so.solve_pressure(standing, task)
    assert solution.status == "failed"
    assert "falls over" in solution.message
    assert solution.pressures is None


def test_price_of_a_limit_at_an_unreachable_target_is_a_distance(robot):
    far = so.Target(position=(-0.03, 0.01, 0.29))

    def solve(limit):
        return so.solve_pressure(robot, two_segment_task(far, pressure={"max": limit}))

    here, there = solve(1.2e5), solve(1.205e5)
    assert here.sensitivities.objective_unit == "m"
    gained = (here.position_error - there.position_error) / 500.0
    assert sum(here.sensitivities.per_bound.values()) == pytest.approx(gained, rel=0.05)
    assert "none of" in str(here.confidence)
