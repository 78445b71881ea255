"""What every term of a task owes, for all that are registered, and what some of them do."""

import json
from functools import cache
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
import pytest
from rich.console import Console

import stiffopt as so
from conftest import is_long
from stiffopt.cli.solve_records import json_record, result_record
from stiffopt.cli.solve_report import block
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.term import Term
from stiffopt.optimise.terms import TERMS
from stiffopt.schema import Schema, Vector
from stiffopt.units import Length

P2 = 1e5 * np.array([0.5, 1.0, 0.2, 0.9, 0.1, 1.2])
STIFF_X = so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=(1, 0, 0)))
ROBOTS = ["stiff-flop-2", "stiff-flop-2-hanging"]


class Elbow(Schema):
    """Where a point of the body shall be, in m."""

    at: Length
    position: Vector[Length]
    tolerance: Length = 1e-3


class ElbowTerm(Term):
    """A term of a station, defined outside of the package."""

    key = name = "elbow"
    annotation = Elbow
    example: ClassVar[Any] = {"at": "95 mm", "position": ["-5 mm", "0 mm", "96 mm"],
                              "tolerance": "5 mm"}  # fmt: skip
    size = 3
    has_stations = True

    def __init__(self, value, tolerance):
        super().__init__(value, tolerance)
        self.radius = value.tolerance

    @property
    def variant(self):
        return self.value.at

    @property
    def parameters(self):
        return self.value.position

    def residual(self, tip, parameters):
        return tip.station(self.value.at).position - parameters


class ElbowTarget(so.Target):
    """A target with that term."""

    elbow: Annotated[Elbow | None, ElbowTerm] = None


KINDS = [*TERMS, ElbowTerm]


def by_key(key):
    return next(kind for kind in KINDS if kind.key == key)


each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.key)


@cache
def robot(name="stiff-flop-2"):
    return so.load_robot(name)


def hanging(name):
    return so.load_robot(robot(name).description.model_copy(update={"gravity": (0, 0, 9.81)}))


def read(text, folder):
    """A target as it is read from a task file."""
    path = folder / "task.yaml"
    path.write_text(f"format: stiffopt-task/1\nrobot: stiff-flop-2\ntarget: {text}\n")
    return so.load_task(path)


def target_of(kind):
    if kind is ElbowTerm:
        return ElbowTarget.model_validate({"elbow": kind.example}, context={"from_file": True})
    return so.Target.model_validate({kind.key: kind.example}, context={"from_file": True})


def task_of(kind, name="stiff-flop-2", goal=None):
    return so.Task(robot=name, target=target_of(kind), stiffness=goal)


def residual(term, arm, p):
    """A term's residual, or margins, from the arm's own poses at pressures p."""

    class Body:
        position, rotation = arm.tip_pose(p)[:3, 3], arm.tip_pose(p)[:3, :3]

        @staticmethod
        def station(at):
            class Here:
                position, rotation = arm.pose(p, at)[:3, 3], arm.pose(p, at)[:3, :3]

            return Here

    values = ca.DM(term.residual(Body, ca.DM(term.parameters)))
    return np.array(values.full()[:, 0])


def error(term, arm, p):
    values = residual(term, arm, p)
    return float(values.min() if term.is_inequality else np.linalg.norm(values))


# -- the contract ---------------------------------------------------------------------------


def test_terms_are_found_and_told_apart():
    keys = [kind.key for kind in TERMS]
    assert keys[:3] == ["position", "pointing", "orientation"]
    assert "above" in keys
    assert set(so.Target.model_fields) == {*(kind.key for kind in TERMS), "tolerance"}


@pytest.mark.parametrize("kind", TERMS, ids=lambda kind: kind.key)
def test_survives_its_file(kind, tmp_path):
    task = read(json.dumps({kind.key: kind.example}), tmp_path)
    (term,) = task.target.terms
    assert type(term) is kind
    written = task.target.model_dump(mode="json", exclude_none=True)
    assert read(json.dumps(written), tmp_path).target == task.target
    assert task.target == target_of(kind)


@each_kind
def test_is_described(kind):
    """In the text of its target, and by its margin or error."""
    (term,) = target_of(kind).terms
    assert f"{kind.key} {term.condition()}" in repr(target_of(kind))
    assert "e-" not in term.condition()  # lengths have units
    assert len({term.words(2e-3), term.words(-2e-3), term.words(3e-3)}) == 3


def test_an_inequality_is_described_by_its_name_and_its_margin():
    class Below(by_key("above")):
        name = "below"
        words, condition = Term.words, Term.condition

    term = Below(
        so.Target(above={"point": (0, 0, 0.19), "normal": (0, 0, 1)}).above, so.Tolerance()
    )
    assert term.words(2e-3) == "2 mm to spare in below"
    assert term.words(-2e-3) == "2 mm short in below"
    assert term.condition() == "point (0 mm, 0 mm, 190 mm), normal (0, 0, 1)"


@each_kind
def test_derivatives_are_those_of_finite_differences(kind):
    for name in ROBOTS:
        problem = PressureProblem(robot(name), task_of(kind, name))
        x = P2 / problem.unit
        expected = np.stack(
            [
                (problem.pose(x + d).residual - problem.pose(x - d).residual) / 2e-4
                for d in 1e-4 * np.eye(6)
            ],
            axis=1,
        )
        assert problem.pose(x).jacobian == pytest.approx(expected, abs=2e-6 * abs(expected).max())


@each_kind
def test_is_what_the_arms_poses_say(kind):
    for name in ROBOTS:
        problem = PressureProblem(robot(name), task_of(kind, name))
        (term,) = problem.program.terms
        found = problem.pose(P2 / problem.unit).residual
        values = term.radius - found if term.is_inequality else found
        # under loads an arm's poses on the way are interpolated between steps
        within = 1e-6 if kind.has_stations and robot(name).is_loaded else 1e-8
        assert values == pytest.approx(residual(term, robot(name), P2), abs=within)


@each_kind
def test_one_structure_has_as_many_parameters_and_rows(kind):
    (term,) = target_of(kind).terms
    assert len(term.parameters) == len(kind(term.value, so.Tolerance()).parameters)
    hash(term.structure)
    assert len(term.nearness(0.2).numbers) == 18
    assert term.radius > 0


@each_kind
def test_an_arm_that_is_off_meets_what_its_model_meets(kind):
    """Displacing the tip is undone by moving the target back, to first order."""
    target = target_of(kind)
    offset = 1e-5 * np.array([1.0, -2.0, 3.0, 0.5, -1.0, 0.7])
    (term,), (back,) = target.terms, target.moved_back(offset).terms
    if kind.has_stations:  # feedback is of the tip alone
        assert back.value == term.value
        return
    arm = robot()
    turn = np.eye(4)
    w = offset[3:]
    turn[:3, :3] += np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    pose = arm.tip_pose(P2)

    class Off:
        position, rotation = pose[:3, 3] + offset[:3], turn[:3, :3] @ pose[:3, :3]

    class Model:
        position, rotation = pose[:3, 3], pose[:3, :3]

    off = ca.DM(term.residual(Off, ca.DM(term.parameters))).full()
    model = ca.DM(back.residual(Model, ca.DM(back.parameters))).full()
    assert np.linalg.norm(off) == pytest.approx(np.linalg.norm(model), abs=1e-9)


@each_kind
def test_is_met_by_both_solvers_and_told(kind, compiled, monkeypatch, tmp_path):
    task = task_of(kind, goal=STIFF_X)
    arm = so.load_robot("stiff-flop-2")
    fast = so.solve_pressure(arm, task)
    assert fast.counts  # of the compiled solver
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    slow = so.solve_pressure(robot(), task)
    assert not slow.counts
    (term,) = task.target.terms
    for solution in (fast, slow):
        assert solution.found, solution.message
        assert solution.errors[term.name] == pytest.approx(
            error(term, arm, solution.pressures), abs=1e-9
        )
        assert term.holds(solution.errors[term.name])
    assert fast.stiffness == pytest.approx(slow.stiffness, rel=2e-3)
    solved = SolvedTask("a.yaml", arm, fast)
    said = json_record(solved)
    assert said[f"{term.result_name}_{term.unit}"] == fast.errors[term.name]
    assert term.result_name in result_record(solved)
    console = Console(width=100)
    with console.capture() as shown:
        console.print(block(solved))
    words = term.words(fast.errors[term.name]) if term.is_inequality else f"in {term.name}"
    assert words in shown.get()


@each_kind
def test_is_met_by_a_loaded_arm(kind):
    arm = robot("stiff-flop-2-hanging")
    target = target_of(kind)
    if kind is ElbowTerm:  # where the hanging arm can have it
        here = arm.pose(0.8 * P2, 0.095)[:3, 3]
        target = ElbowTarget(elbow=Elbow(at=0.095, position=tuple(here), tolerance=2e-3))
    solver = PressureSolver(arm, so.Task(robot="x", target=target, stiffness=None))
    guess = 0.8 * P2
    solution = solver.solve(guess=guess)
    assert solution.found, solution.message
    (term,) = target.terms
    assert solution.errors[term.name] == pytest.approx(
        error(term, arm, solution.pressures), abs=1e-7
    )


# -- above a plane --------------------------------------------------------------------------

WIDE = so.Target(position=(-0.03, 0.01, 0.19), tolerance=so.Tolerance(position=5e-3))


def above(height, **options):
    plane = {"point": (0.0, 0.0, height), "normal": (0, 0, 1)}
    return WIDE.model_copy(update={**options, "above": so.Target(above=plane).above})


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ROBOTS)
def test_the_tip_stays_above_the_plane_where_that_costs(name, compiled):
    arm = so.load_robot(name)
    free = so.solve_pressure(arm, so.Task(robot="x", target=WIDE, stiffness=STIFF_X))
    height = float(free.tip_position[2]) + 1e-3
    task = so.Task(robot="x", target=above(height), stiffness=STIFF_X)
    kept = so.solve_pressure(arm, task)
    assert kept.found, kept.message
    assert kept.counts
    assert 0 <= kept.errors["above"] < 1e-6
    assert height <= arm.tip_pose(kept.pressures)[2, 3] < height + 1e-5
    assert kept.stiffness < free.stiffness
    higher = so.solve_pressure(
        arm, task.model_copy(update={"target": above(height + 1e-5)}), guess=kept.pressures
    )
    worth = (kept.stiffness - higher.stiffness) / 1e-5
    assert kept.sensitivities.per_tolerance["above"] == pytest.approx(worth, rel=0.05)


def test_what_is_below_everything_reachable_is_named():
    solution = so.solve_pressure(robot(), so.Task(robot="x", target=above(0.40), stiffness=STIFF_X))
    assert solution.status == "unreachable"
    assert "below the plane" in solution.message
    assert "mm away" in solution.message
    assert "max" in solution.message  # the limits that hold it back
    assert solution.errors["above"] < 0


def test_an_arm_that_need_not_move_has_no_prices():
    """Least pressure is none: the objective has no slope against which to weigh the limits."""
    task = so.Task(robot="x", target=so.Target(above=above(0.05).above), stiffness=None)
    arm = robot("stiff-flop-2-hanging") if is_long() else hanging("stiff-flop-1")
    solution = PressureSolver(arm, task).solve()
    assert solution.found
    assert not solution.pressures.any()
    assert not any(solution.sensitivities.per_bound.values())


def test_many_terms_at_once(compiled):
    """Five terms with eleven rows: position, pointing, plane and two stations."""

    class Two(ElbowTarget):
        shoulder: Annotated[Elbow | None, Shoulder] = None

    arm = so.load_robot("stiff-flop-2")
    pose = arm.tip_pose(P2)
    target = Two(
        position=tuple(pose[:3, 3]),
        pointing=tuple(pose[:3, 2]),
        above={"point": tuple(pose[:3, 3] - 1e-3), "normal": (0, 0, 1)},
        elbow=Elbow(at=0.1, position=tuple(arm.pose(P2, 0.1)[:3, 3]), tolerance=2e-3),
        shoulder=Elbow(at=0.05, position=tuple(arm.pose(P2, 0.05)[:3, 3]), tolerance=2e-3),
        tolerance=so.Tolerance(position=2e-3, angle=0.1),
    )
    solution = so.solve_pressure(arm, so.Task(robot="x", target=target, stiffness=STIFF_X))
    assert solution.found, solution.message
    assert solution.counts
    assert set(solution.errors) == {"position", "angle", "above", "elbow", "shoulder"}
    for term in target.terms:
        assert term.holds(error(term, arm, solution.pressures))


class Shoulder(ElbowTerm):
    """The same elsewhere."""

    key = name = "shoulder"
