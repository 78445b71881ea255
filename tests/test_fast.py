"""The compiled solver: it answers as the general method does, judged by the model alone."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

import stiffopt as so
from conftest import is_long
from stiffopt.model import compiler as build
from stiffopt.optimise.settings import KEPT

KINDS = {
    "position": {},
    "free axis": {"free": 1},
    "pointing": {"position": False, "pointing": True},
    "position and pointing": {"pointing": True},
    "orientation": {"orientation": True},
    "guided": {"boundary": "guided"},
    "clamped, tip axes": {"boundary": "clamped", "frame": "tip"},
    "rotation": {"kind": "rotation"},
    "clamped rotation": {"kind": "rotation", "boundary": "clamped"},
}


def pose(robot, rng):
    return robot.tip_pose(rng.uniform(0, 1.5e5, robot.n_pressures))


def random_task(robot, rng, position=True, free=None, pointing=False, orientation=False, **options):
    T = pose(robot, rng)
    asked = [None if axis == free else float(x) for axis, x in enumerate(T[:3, 3])]
    target = so.Target(
        position=tuple(asked) if position else None,
        pointing=tuple(T[:3, 2]) if pointing else None,
        orientation=tuple(so.lie.quaternion_from_rotation(T[:3, :3])) if orientation else None,
    )
    direction = tuple(rng.normal(size=3))
    goal = so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=direction, **options))
    return so.Task(robot=robot.description.name, target=target, stiffness=goal)


@cache
def interpreted():
    """Return an arm that only ever solves without a compiler: it keeps its functions."""
    return so.load_robot("stiff-flop-2")


def general(task, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("STIFFOPT_COMPILER", "none")
        solution = so.solve_pressure(interpreted(), task)
    assert "programs" not in solution.counts
    return solution


@pytest.fixture
def robot(compiled):
    return so.load_robot("stiff-flop-2")


@pytest.fixture
def task():
    goal = so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=(1, 0, 0)))
    target = so.Target(position=(-0.03, 0.01, 0.19))
    return so.Task(robot="stiff-flop-2", target=target, stiffness=goal)


@pytest.fixture
def no_general_method(monkeypatch):
    """Fail where the compiled solver does not answer."""

    def refuse(*_):
        raise AssertionError("the general method was needed")

    monkeypatch.setattr(so.PressureSolver, "_general", refuse)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", KINDS)
def test_answers_as_the_general_method_does(kind, robot, monkeypatch):
    rng = np.random.default_rng(sorted(KINDS).index(kind))
    for _ in range(3 if is_long() else 1):
        task = random_task(robot, rng, **KINDS[kind])
        fast, slow = so.solve_pressure(robot, task), general(task, monkeypatch)
        assert fast.found
        assert slow.found
        assert "programs" in fast.counts
        # a looser target has many optima, of which either may find a better one
        loose = kind in ("pointing", "free axis")
        assert fast.stiffness == pytest.approx(slow.stiffness, rel=1e-4) or loose
        assert fast.stiffness > slow.stiffness * (0.995 if not loose else 0.5)


def test_smallest_of_several_and_floors(robot, task, monkeypatch):
    along = so.solve_pressure(robot, task).stiffness
    measures = [so.StiffnessMeasure(direction=d) for d in ((1, 0, 0), (0, 1, 0))]
    floor = so.AtLeast(direction=(1, 0, 0), value=0.9 * along)
    goals = [
        so.StiffnessGoal(maximise=measures),
        so.StiffnessGoal(maximise=measures[1], at_least=floor),
        None,
        so.StiffnessGoal(at_least=floor),
    ]
    for goal in goals if is_long() else goals[:3]:
        other = task.model_copy(update={"stiffness": goal})
        fast, slow = so.solve_pressure(robot, other), general(other, monkeypatch)
        assert fast.found
        assert fast.stiffnesses == pytest.approx(slow.stiffnesses, rel=2e-3)
        if goal is not None and goal.at_least:
            assert fast.stiffnesses[-1] >= 0.9 * along


def test_is_judged_by_the_model(robot, task, no_general_method):
    solution = so.solve_pressure(robot, task)
    p = solution.pressures
    assert (p >= robot.pressure_min).all()
    assert (p <= robot.pressure_max).all()
    T = robot.tip_pose(p)
    error = np.linalg.norm(T[:3, 3] - task.target.position)
    np.testing.assert_allclose(solution.tip_pose, T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.compliance, robot.tip_compliance(p), rtol=1e-9, atol=1e-15)
    assert solution.stiffness == pytest.approx(robot.stiffness(p, (1, 0, 0)), rel=1e-12)
    assert solution.position_error == pytest.approx(error, abs=1e-12)
    assert solution.position_error <= task.target.tolerance.position
    for array in (p, solution.tip_pose, solution.compliance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_explains_itself_when_asked(robot, task, monkeypatch):
    fast, slow = so.solve_pressure(robot, task), general(task, monkeypatch)
    assert fast.message == slow.message
    assert fast.active_bounds == slow.active_bounds
    assert fast.freedom == slow.freedom == 3
    assert fast.sensitivities.per_bound == pytest.approx(slow.sensitivities.per_bound, rel=1e-2)
    assert fast.sensitivities.per_position_tolerance == pytest.approx(
        slow.sensitivities.per_position_tolerance, rel=1e-2
    )
    with pytest.raises(AttributeError, match="no attribute 'pressure'"):
        _ = fast.pressure


def test_several_threads_may_ask_at_once(robot, task):
    for _ in range(5):
        solution = so.solve_pressure(robot, task)
        with ThreadPoolExecutor(8) as pool:
            freedoms = list(pool.map(lambda _, s=solution: s.freedom, range(16)))
        assert freedoms == [3] * 16


def test_an_explanation_that_failed_can_be_asked_for_again(robot, task, monkeypatch):
    solution = so.solve_pressure(robot, task)
    with monkeypatch.context() as patch:
        patch.setattr("stiffopt.optimise.diagnosis.freedom", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            _ = solution.freedom
    assert solution.freedom == 3


def test_can_be_pickled_before_it_was_asked(robot, task):
    solution = so.solve_pressure(robot, task)
    again = pickle.loads(pickle.dumps(solution))
    np.testing.assert_array_equal(again.pressures, solution.pressures)
    assert again.active_bounds == solution.active_bounds
    assert again.sensitivities.per_bound == solution.sensitivities.per_bound


def test_warm_is_local_and_close(robot, task, no_general_method):
    first = so.solve_pressure(robot, task)
    moved = so.Target(position=(-0.0297, 0.0103, 0.1902))
    warm = so.PressureSolver(robot, task).solve(moved, guess=first.pressures)
    cold = so.PressureSolver(robot, task).solve(moved)
    assert warm.found
    assert warm.confidence.starts == 1
    assert warm.counts["points"] < 0.5 * cold.counts["points"]
    assert warm.stiffness == pytest.approx(cold.stiffness, rel=1e-5)


def test_a_guess_from_which_nothing_is_found_is_no_harm(robot, task, no_general_method):
    solution = so.solve_pressure(robot, task, guess=np.full(6, 1e9))
    assert solution.found
    with pytest.raises(so.InputError, match="guess"):
        so.solve_pressure(robot, task, guess=[0.0, np.nan, 0, 0, 0, 0])


def test_one_structure_is_compiled_once(robot, task, monkeypatch):
    so.solve_pressure(robot, task)

    def refuse(*_):
        raise AssertionError("compiled again")

    monkeypatch.setattr(build, "compile_library", refuse)
    rng = np.random.default_rng(1)
    for _ in range(3):
        assert so.solve_pressure(robot, random_task(robot, rng)).found
    limited = task.model_copy(update={"pressure": so.Task.model_fields["pressure"].default})
    assert so.solve_pressure(so.load_robot("stiff-flop-2"), limited).found  # from the cache


def test_preparations_are_forgotten(robot):
    rng = np.random.default_rng(2)
    tasks = [random_task(robot, rng) for _ in range(KEPT.per_arm + 5)]
    first = so.solve_pressure(robot, tasks[0]).pressures
    so.solve_batch(robot, tasks)
    assert len(robot.kept("prepared", dict)) <= KEPT.per_arm
    np.testing.assert_array_equal(so.solve_pressure(robot, tasks[0]).pressures, first)


def test_varying_limits_do_not_fill_the_memory(robot, task):
    first = so.solve_pressure(robot, task).pressures
    for step in range(KEPT.per_arm + 3):
        limits = so.Task.model_fields["pressure"].annotation(max=1.4e5 + step)
        limited = task.model_copy(update={"pressure": limits})
        assert so.solve_pressure(robot, limited, guess=first).found
    for group in ("prepared", "samples", "fast solvers"):
        assert len(robot.kept(group, dict)) <= KEPT.per_arm


def test_many_stiffnesses_are_left_to_the_general_method(compiled):
    robot, rng = so.load_robot("stiff-flop-1"), np.random.default_rng(6)
    task = random_task(robot, rng)
    measures = [so.StiffnessMeasure(direction=tuple(d)) for d in rng.normal(size=(9, 3))]
    many = task.model_copy(update={"stiffness": so.StiffnessGoal(maximise=measures)})
    solution = so.solve_pressure(robot, many)
    assert solution.found
    assert len(solution.stiffnesses) == 9


def test_limits_of_the_task(robot, task, no_general_method):
    tight = so.Task(**{**dict(task), "pressure": {"max": 1.25e5, "min": 0.02e5}})
    solution = so.solve_pressure(robot, tight)
    assert solution.found
    assert solution.pressures.max() <= 1.25e5
    assert solution.pressures.min() >= 0.02e5


def test_unreachable_is_left_to_the_general_method(robot, task, monkeypatch):
    far = task.model_copy(update={"target": so.Target(position=(0.1, 0.0, 0.1))})
    fast, slow = so.solve_pressure(robot, far), general(far, monkeypatch)
    assert fast.status == slow.status == "unreachable"
    assert fast.position_error == pytest.approx(slow.position_error, abs=1e-6)
    assert fast.message == slow.message


# -- batches ------------------------------------------------------------------------------------


def mixed_tasks(robot, task):
    rng = np.random.default_rng(3)
    kinds = list(KINDS.values())[:: 1 if is_long() else 2]  # which others compile too
    tasks = [random_task(robot, rng, **options) for options in kinds]
    tasks += [task, task.model_copy(update={"stiffness": None})]
    tasks.append(task.model_copy(update={"target": so.Target(position=(0.1, 0.0, 0.1))}))
    return tasks


@pytest.mark.parametrize("threads", [None, 1, 3])
def test_batch_is_one_by_one(threads, robot, task):
    tasks = mixed_tasks(robot, task)
    batch = so.solve_batch(robot, tasks, threads=threads)
    for solution, own in zip(batch, tasks, strict=True):
        alone = so.solve_pressure(robot, own)
        assert solution.task is own
        assert solution.status == alone.status
        np.testing.assert_array_equal(solution.pressures, alone.pressures)
        assert solution.stiffnesses == alone.stiffnesses
        assert solution.message == alone.message
        assert solution.timings["total"] > 0


def test_batch_without_a_compiler_is_one_by_one(task, monkeypatch):
    robot = so.load_robot("stiff-flop-2")
    tasks = [task, task.model_copy(update={"stiffness": None})]
    for solution, own in zip(so.solve_batch(robot, tasks), tasks, strict=True):
        alone = so.solve_pressure(robot, own)
        np.testing.assert_array_equal(solution.pressures, alone.pressures)


def test_batch_with_guesses(robot, task):
    first = so.solve_pressure(robot, task)
    warm, cold = so.solve_batch(robot, [task, task], [first.pressures, None])
    assert (warm.confidence.starts, cold.found) == (1, True)
    with pytest.raises(so.InputError, match="a guess or None for each of 2 tasks"):
        so.solve_batch(robot, [task, task], [None])
    with pytest.raises(so.InputError, match="guess"):
        so.solve_batch(robot, [task], [[1.0]])
    with pytest.raises(so.InputError, match="task must be a Task"):
        so.solve_batch(robot, [task, "problem.yaml"])
    assert so.solve_batch(robot, []) == []
    assert so.solve_batch(robot, (own for own in [task]), (None for _ in range(1)))[0].found
    for wrong in ({"threads": 0}, {"threads": 1.5}, {"threads": True}, {"guesses": 5}):
        with pytest.raises(so.InputError, match=next(iter(wrong))):
            so.solve_batch(robot, [task], **wrong)
    for wrong in (None, task):
        with pytest.raises(so.InputError, match="several tasks"):
            so.solve_batch(robot, wrong)


def test_threads_may_share_a_robot(robot, task):
    rng = np.random.default_rng(4)
    tasks = [random_task(robot, rng) for _ in range(40)]
    alone = [so.solve_pressure(robot, own).pressures for own in tasks]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda own: so.solve_pressure(robot, own).pressures, tasks))
    np.testing.assert_array_equal(together, alone)


def test_without_a_compiler_there_is_one_notice(task, monkeypatch, tmp_path):
    monkeypatch.setenv("STIFFOPT_COMPILER", str(tmp_path / "missing"))
    monkeypatch.setattr("stiffopt.model.compiled._notified", set())
    robot = so.load_robot("stiff-flop-2")
    blind = task.model_copy(update={"stiffness": None})
    with pytest.warns(so.SlowWarning, match="was not found") as notices:
        solutions = so.solve_batch(robot, [task, blind])
    assert all(solution.found for solution in solutions)
    assert len(notices) == 1


def test_an_interface_that_changed_is_noticed(robot, task, monkeypatch):
    monkeypatch.setattr("ctypes.sizeof", lambda _: 1)
    with pytest.raises(RuntimeError, match="disagree"):
        so.solve_pressure(robot, task)
