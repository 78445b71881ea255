"""What every stiffness measure owes, for all that are registered and one that is not."""

import json
from typing import ClassVar, Literal

import casadi as ca
import numpy as np
import pytest
from rich.console import Console

import stiffopt as so
from stiffopt.cli.solve_records import json_record, result_record
from stiffopt.cli.solve_report import block
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.measure import Measure, Role
from stiffopt.optimise.measures import MEASURES
from stiffopt.optimise.problem import PressureProblem
from stiffopt.schema import Items

P2 = 1e5 * np.array([0.5, 1.0, 0.2, 0.9, 0.1, 1.2])
TARGET = so.Target(position=(-0.03, 0.01, 0.19))


class MeanStiffness(Measure):
    """Harmonic mean of the translational stiffness over all directions (docs/extending.md)."""

    key: ClassVar[str] = "mean"
    role: ClassVar[Role] = "maximise"
    mean: Literal["translation"]

    @property
    def unit(self):
        return "N/m"

    @property
    def structure(self):
        return ("mean",)

    @property
    def parameters(self):
        return ()

    def formula(self, tip, parameters):
        return ca.log(3 / ca.trace(tip.compliance[:3, :3]))


class MeanAtLeast(MeanStiffness):
    """The same as a condition, in N/m."""

    role: ClassVar[Role] = "at_least"
    value: float

    def holds(self, value):
        return value >= self.value


class MeanGoal(StiffnessGoal):
    """A goal with these measures."""

    maximise: Items[MeanStiffness]
    at_least: Items[MeanAtLeast] = ()


EXAMPLES = {
    ("maximise", "direction"): {"direction": [1, 2, 0], "frame": "tip", "boundary": "guided"},
    ("at_least", "direction"): {"direction": [1, 2, 0], "value": "0.5 N/m"},
    ("match", "direction"): {"direction": [1, 2, 0], "value": "1.3 N/m", "tolerance": "2 %"},
    ("match", "matrix"): {
        "matrix": [[2, 0.1, 0], [0.1, 1.5, 0], [0, 0, 20]], "unit": "N/m", "tolerance": "90 %",
    },
}  # fmt: skip
each = pytest.mark.parametrize(
    "kind", [*MEASURES, MeanStiffness], ids=lambda kind: f"{kind.role} {kind.key}"
)


def goal_of(kind):
    if kind is MeanStiffness:
        return MeanGoal(maximise=[{"mean": "translation"}])
    example = EXAMPLES[kind.role, kind.key]
    return StiffnessGoal.model_validate({kind.role: example}, context={"from_file": True})


def measure_of(kind):
    goal = goal_of(kind)
    return (*goal.first, *goal.at_least)[0]


def test_all_are_found():
    assert {(kind.role, kind.key) for kind in MEASURES} == set(EXAMPLES)


@pytest.mark.parametrize("kind", MEASURES, ids=lambda kind: f"{kind.role} {kind.key}")
def test_survives_its_file(kind, tmp_path):
    path = tmp_path / "task.yaml"
    head = "format: stiffopt-task/1\nrobot: stiff-flop-2\ntarget: {pointing: [0, 0, 1]}\n"
    path.write_text(f"{head}stiffness: {json.dumps({kind.role: EXAMPLES[kind.role, kind.key]})}\n")
    goal = so.load_task(path).stiffness
    assert type(measure_of(kind)) is kind
    assert goal == goal_of(kind)
    dumped = goal.model_dump(mode="json", exclude_none=True)
    written = {key: value for key, value in dumped.items() if value}
    path.write_text(f"{head}stiffness: {json.dumps(written)}\n")
    assert so.load_task(path).stiffness == goal


@pytest.mark.one_in(2)
@each
@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
def test_gradients_are_those_of_finite_differences(kind, name):
    task = so.Task(robot=name, target=TARGET, stiffness=goal_of(kind))
    problem = PressureProblem(so.load_robot(name), task)
    x, step = P2 / problem.unit, 1e-3

    def values(x):
        point = problem.point(x)
        return point.floors if kind.role == "at_least" else point.terms

    point = problem.point(x)
    gradient = point.floor_gradients if kind.role == "at_least" else point.term_gradients
    expected = np.stack(
        [(values(x + d) - values(x - d)) / (2 * step) for d in step * np.eye(6)], axis=1
    )
    assert gradient == pytest.approx(expected, abs=5e-5 * abs(expected).max())


@each
def test_parameters_are_as_many_for_one_structure(kind):
    measure = measure_of(kind)
    hash(measure.structure)
    assert all(isinstance(value, float) for value in measure.parameters)
    assert measure.words()
    assert isinstance(measure.holds(1.0), bool)


def test_a_measure_outside_of_the_package_is_maximised_and_told():
    robot = so.load_robot("stiff-flop-2")
    target = TARGET.model_copy(update={"tolerance": so.Tolerance(position=2e-3)})
    task = so.Task(robot="stiff-flop-2", target=target, stiffness=goal_of(MeanStiffness))
    solution = so.solve_pressure(robot, task)
    assert solution.found, solution.message
    C = robot.tip_compliance(solution.pressures)
    assert solution.stiffness == pytest.approx(3 / np.trace(C[:3, :3]), rel=1e-9)
    other = so.solve_pressure(robot, task.model_copy(update={"stiffness": None}))
    plain = 3 / np.trace(robot.tip_compliance(other.pressures)[:3, :3])
    assert solution.stiffness > plain
    solved = SolvedTask("a.yaml", robot, solution)
    assert json_record(solved)["stiffness"] == solution.stiffness
    assert result_record(solved)["stiffness"][0]["mean"] == "translation"
    console = Console(width=100)
    with console.capture() as shown:
        console.print(block(solved))
    assert "required" not in shown.get()
    goal = MeanGoal(
        maximise=[{"mean": "translation"}], at_least=[{"mean": "translation", "value": 1.5}]
    )
    wanted = so.solve_pressure(robot, task.model_copy(update={"stiffness": goal}))
    with console.capture() as shown:
        console.print(block(SolvedTask("a.yaml", robot, wanted)))
    assert "required: at least 1.500" in shown.get()
