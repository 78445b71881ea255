"""The compiled solver of arms under gravity and loads against the model and the general method."""

from dataclasses import replace

import numpy as np
import pytest

import stiffopt as so
from conftest import is_long
from independent.arms import ARMS, FLOP, LOPSIDED, Arm, neo_hookean
from stiffopt.optimise import samples
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.solver import PressureSolver

HANGING = (0.0, 0.0, 9.81)


@pytest.fixture(autouse=True)
def _machine_code(compiled):
    """All tests here are of compiled code, in a cache of their own."""


def robot(arm):
    return so.Manipulator(so.RobotDescription(**arm.mapping()))


def along(*direction, **options):
    return so.StiffnessMeasure(direction=direction, **options)


def maximise(*measures):
    return so.StiffnessGoal(maximise=measures)


POSITION = so.Target(position=(-0.03, 0.01, 0.19))
POSE = so.Target(position=(-0.03, 0.01, 0.19), orientation=(0.8, 0.0, 0.6, 0.0))
POINTING = so.Target(position=(None, 0.01, 0.19), pointing=(0.1, 0.2, 0.9))
MATRIX = so.MatchMatrix(matrix=((5.0, 0.1, 0), (0.1, 6.0, 0), (0, 0, 90.0)), tolerance=0.2)

CASES = {
    "hanging": (Arm((FLOP, FLOP)).under(HANGING, 0.02), None, POSITION, maximise(along(1, 2, 3))),
    "dead wrench": (
        Arm((FLOP, FLOP)),
        so.Load(force=(0.02, -0.03, 0.05), moment=(1e-3, 0, 5e-4)),
        POSE,
        so.StiffnessGoal(
            maximise=(along(1, 2, 3, boundary="clamped"), along(0, 1, 0, frame="tip")),
            at_least=so.AtLeast(direction=(0, 1, 1), value=1e-3, kind="rotation"),
        ),
    ),
    "neo-Hookean": (
        Arm((neo_hookean(FLOP), neo_hookean(LOPSIDED))).under(HANGING, 0.01),
        None,
        POSITION,
        so.StiffnessGoal(match=MATRIX),
    ),
    "follower": (
        Arm((FLOP,)).under((3, 0, 9), 0.01),
        so.Load(force=(0.02, -0.03, 0.05), moment=(1e-3, 0, 5e-4), frame="tip"),
        POINTING,
        so.StiffnessGoal(
            maximise=along(1, 2, 3, frame="tip"),
            at_least=so.AtLeast(direction=(0, 1, 0), value=1.0, boundary="guided"),
        ),
    ),
    "off axis, connectors, weight": (
        ARMS["3 segments, mixed"].under((2, 1, 9), 0.01),
        so.Load(force=(0.01, 0.01, 0.0), frame="tip"),
        POSITION,
        maximise(along(1, 0, 0, boundary="guided")),
    ),
    "no stiffness": (Arm((FLOP, FLOP)).under(HANGING, 0.02), None, POSITION, None),
}


def compiled_point(solver, program, pressures):
    """What the compiled solver evaluates: residuals, Jacobian, terms, floors and gradients."""
    radii = np.array([constraint.radius for constraint in program.constraints(1.0)])
    parameters = np.concatenate([solver._numbers, program.parameters])
    found = solver.point(parameters, radii, pressures)
    assert found is not None
    return found


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", CASES)
def test_evaluation_is_that_of_the_model(name):
    arm, load, target, goal = CASES[name]
    task = so.Task(robot="any", target=target, stiffness=goal, load=load)
    kept = prepared(robot(arm), task, 0)
    program = kept.program(target)
    solver, _ = kept.fast(program)
    pressures = np.random.default_rng(5).uniform(0, 0.6e5, arm.n)
    found = compiled_point(solver, program, pressures)
    problem = PressureProblem(kept.robot, task)
    point = problem.point(pressures / problem.unit)
    expected = [
        np.concatenate([ball.residual for ball in point.balls]),
        np.concatenate([ball.jacobian for ball in point.balls]),
        point.terms,
        point.term_gradients,
        point.floors,
        point.floor_gradients,
    ]
    for k, (got, wanted) in enumerate(zip(found, expected, strict=True)):
        if wanted.size:
            size = np.abs(wanted).max()
            assert got == pytest.approx(wanted.reshape(got.shape), rel=1e-7, abs=1e-8 * size), k


# -- whole solves ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hanging():
    return so.load_robot("stiff-flop-2-hanging")


def reaching(model, pressures, goal, **options):
    """A task whose target certain pressures reach."""
    position = tuple(model.tip_pose(np.array(pressures) * 1e5)[:3, 3])
    return so.Task(robot="any", target=so.Target(position=position), stiffness=goal, **options)


def was_compiled(solution):
    """Whether the compiled solver gave an answer: the general method counts nothing."""
    return bool(solution.counts)


def test_agrees_with_the_general_method(hanging, monkeypatch):
    goal = maximise(along(1, 0.5, 0))
    task = reaching(hanging, (0.4, 0.9, 0.1, 0.8, 0.1, 0.5), goal)
    solution = so.solve_pressure(hanging, task)
    assert solution.found
    assert was_compiled(solution)
    solver = PressureSolver(hanging, task)
    monkeypatch.setattr(solver._search, "solve", lambda *_: None)
    general = solver.solve(guess=solution.pressures)
    assert not was_compiled(general)
    assert general.stiffness == pytest.approx(solution.stiffness, rel=1e-4)
    assert general.pressures == pytest.approx(solution.pressures, abs=200)


def test_answers_are_what_the_model_says(hanging):
    goal = maximise(along(0, 1, 0.2))
    task = reaching(hanging, (1.0, 0.2, 0.3, 0.2, 0.9, 0.6), goal)
    solution = so.solve_pressure(hanging, task)
    p = solution.pressures
    T = hanging.tip_pose(p)
    assert pytest.approx(solution.tip_pose, abs=1e-9) == T
    assert np.linalg.norm(T[:3, 3] - task.target.position) <= task.target.tolerance.position
    C = hanging.tip_compliance(p)
    assert pytest.approx(solution.compliance, abs=1e-5 * np.abs(C).max()) == C
    assert hanging.stiffness(p, (0, 1, 0.2)) == pytest.approx(solution.stiffness, rel=1e-6)


def test_warm_answer_is_the_cold_one(hanging):
    goal = maximise(along(1, 0.5, 0))
    task = reaching(hanging, (0.4, 0.9, 0.1, 0.8, 0.1, 0.5), goal)
    before = so.solve_pressure(hanging, task)
    moved = tuple(np.array(task.target.position) + np.array((3e-4, -3e-4, 2e-4)))
    near = task.model_copy(update={"target": so.Target(position=moved)})
    warm = so.solve_pressure(hanging, near, guess=before.pressures)
    cold = so.solve_pressure(hanging, near)
    assert warm.confidence.starts == 1
    assert warm.stiffness == pytest.approx(cold.stiffness, rel=1e-4)


def test_each_load_has_its_own_answer():
    model = so.load_robot("stiff-flop-2")
    goal = maximise(along(1, 0, 0))
    for force in ((0.03, 0, 0), (0, 0, 0.1)):
        load = so.Load(force=force)
        carrying = model.with_load(force)
        task = reaching(carrying, (0.4, 0.9, 0.1, 0.8, 0.1, 0.5), goal, load=load)
        solution = so.solve_pressure(model, task)
        assert solution.found
        assert was_compiled(solution)
        T = carrying.tip_pose(solution.pressures)
        assert np.linalg.norm(T[:3, 3] - task.target.position) <= task.target.tolerance.position


def test_what_cannot_be_reached_is_left_to_the_general_method():
    model = so.load_robot("stiff-flop-1")
    load = so.Load(force=(0.0, 0.0, 0.05))
    target = so.Target(position=(0.0, 0.0, 0.3))
    solution = so.solve_pressure(model, so.Task(robot="any", target=target, load=load))
    assert solution.status == "unreachable"
    assert solution.position_error > 0.1


def test_a_load_that_buckles_the_arm_is_said(monkeypatch):
    if not is_long():
        monkeypatch.setattr(samples, "SAMPLES", replace(samples.SAMPLES, loaded=8))
    model = so.load_robot("stiff-flop-1")
    load = so.Load(force=(0.0, 0.0, -6.0))
    target = so.Target(position=(0.0, 0.0, 0.09))
    solution = so.solve_pressure(model, so.Task(robot="any", target=target, load=load))
    assert solution.status == "failed"
    assert "buckles" in solution.message


def test_a_target_that_few_samples_reach_is_searched_well(hanging):
    goal = maximise(along(-0.217, 0.571, -0.792))
    target = so.Target(position=(-0.01727, -0.02155, 0.18724))
    task = so.Task(robot="any", target=target, stiffness=goal)
    found = so.solve_pressure(hanging, task)
    elsewhere = 1e5 * np.array([0.897, 0, 0, 0.287, 1.449, 0.089])
    other = so.solve_pressure(hanging, task, guess=elsewhere)
    assert found.confidence.complete
    assert found.stiffness >= 0.995 * other.stiffness
