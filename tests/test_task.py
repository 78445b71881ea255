"""The task file and the task in code."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stiffopt.errors import FileError, InputError
from stiffopt.files import save_file
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.goal import AtLeast, MatchMatrix, MatchValue, StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, PressureRange, Task, load_task

TASK = """\
format: stiffopt-task/1
robot: stiff-flop-2
target:
  position: [-30 mm, 10 mm, 190 mm]
  pointing: [0, 0, 2]
  tolerance: {position: 0.2 mm, angle: 2 deg}
stiffness:
  maximise: {direction: [3, 0, 4], frame: base, kind: translation, boundary: free}
load: {force: [0 N, 0 N, -0.02 N], moment: [0 N*m, 0 N*m, 1 mN*m], frame: tip}
pressure: {max: 1.2 bar}
"""
HEAD = "format: stiffopt-task/1\nrobot: stiff-flop-2\n"
X = StiffnessMeasure(direction=(1, 0, 0))
TURN = StiffnessMeasure(direction=(1, 0, 0), kind="rotation")
SOMEWHERE = Target(position=(0, 0, 0.18))


def read(folder: Path, text: str) -> Task:
    path = folder / "task.yaml"
    path.write_text(text, encoding="utf-8")
    return load_task(path)


def with_target(folder: Path, target: str) -> Target:
    return read(folder, f"{HEAD}target: {target}\n").target


def with_goal(folder: Path, goal: str) -> StiffnessGoal | None:
    text = f"{HEAD}target: {{position: [0 m, 0 m, 180 mm]}}\nstiffness: {goal}\n"
    return read(folder, text).stiffness


def test_a_task_file_is_read_in_si(tmp_path: Path) -> None:
    task = read(tmp_path, TASK)
    assert task == Task(
        robot="stiff-flop-2",
        target=Target(
            position=(-0.03, 0.01, 0.19),
            pointing=(0, 0, 1),
            tolerance=Tolerance(position=2e-4, angle=math.radians(2)),
        ),
        stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=np.array([0.6, 0.0, 0.8]))),
        load=Load(force=(0, 0, -0.02), moment=(0, 0, 1e-3), frame="tip"),
        pressure=PressureRange(max=1.2e5),
        source=tmp_path / "task.yaml",
    )
    assert isinstance(hash(task), int)


def test_defaults(tmp_path: Path) -> None:
    task = read(tmp_path, HEAD + "target: {position: [0 m, free, 180 mm]}\n")
    assert (task.stiffness, task.load) == (None, None)
    assert task.pressure == PressureRange(min=None, max=None)
    assert task.target.position == (0.0, None, 0.18)
    assert task.target.tolerance == Tolerance(position=1e-4, angle=math.radians(1))
    assert (X.frame, X.kind, X.boundary, X.unit) == ("base", "translation", "free", "N/m")
    assert TURN.unit == "N*m/rad"
    assert MatchMatrix(matrix=np.eye(3)).boundary == "guided"
    assert MatchMatrix(matrix=np.eye(3)).tolerance == 0.01
    assert Load() == Load(force=(0, 0, 0), moment=(0, 0, 0), frame="base")


def test_directions_are_normalised(tmp_path: Path) -> None:
    assert with_target(tmp_path, "{pointing: [0, 3, 4]}").pointing == (0.0, 0.6, 0.8)
    assert with_target(tmp_path, "{pointing: [0, 3.0e-320, 0]}").pointing == (0.0, 1.0, 0.0)
    assert Target(pointing=[1e308, 0, 1e308]).pointing == pytest.approx((0.5**0.5, 0, 0.5**0.5))
    target = with_target(tmp_path, "{orientation: [-1.0005, 0, 0, 0]}")
    assert target.orientation == (1.0, 0.0, 0.0, 0.0)
    assert target.position is None


vectors = st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda v: math.hypot(*v) > 1e-6)


@given(vectors)
def test_normalising_twice_is_normalising_once(vector: tuple[float, float, float]) -> None:
    once = Target(pointing=vector).pointing
    assert once is not None
    assert math.hypot(*once) == pytest.approx(1, abs=1e-15)
    assert np.cross(once, vector) == pytest.approx(np.zeros(3), abs=1e-13)
    assert Target(pointing=once).pointing == once


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_quaternions_have_a_positive_scalar_part(quaternion: tuple[float, ...]) -> None:
    unit = np.array(quaternion) / math.hypot(*quaternion)
    read = Target(orientation=unit).orientation
    assert read is not None
    assert read[0] >= 0
    assert abs(np.dot(read, unit)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("{}", "target: asks for nothing; expected a position, pointing or orientation"),
        ("{position: [free, free, free]}", "target: asks for nothing"),
        ("{tolerance: {angle: 1 deg}}", "target: asks for nothing"),
        ("{pointing: [0, 0, 1], orientation: [1, 0, 0, 0]}", "cannot be combined with pointing"),
        ("{pointing: [0, 0, 0]}", "target.pointing: is zero; expected a direction"),
        ("{pointing: [0, 0]}", "target.pointing: expected 3 items, not 2"),
        ("{pointing: [0, 0, 1 mm]}", "target.pointing[2]: '1 mm' is not a number"),
        ("{pointing: [0, 0, .nan]}", "target.pointing[2]: nan is not a finite number"),
        ("{pointing: up}", "target.pointing: expected a list, not 'up'"),
        ("{orientation: [1, 0, 0]}", "target.orientation: expected 4 items, not 3"),
        ("{orientation: [1, 1, 0, 0]}", "target.orientation: has norm 1.414; expected a unit"),
        ("{orientation: [1.0011, 0, 0, 0]}", "has norm 1.001; expected a unit quaternion"),
        ("{position: [90, 0 m, 0 m]}", "target.position[0]: bare number 90 has no unit; expected"),
        ("{position: ['90', 0 m, 0 m]}", "target.position[0]: '90' has no unit; expected a length"),
        ("{position: [fre, 0 m, 0 m]}", "target.position[0]: 'fre' is not a number with a unit"),
        ("{position: [~, 0 m, 0 m]}", "target.position[0]: has no value"),
        ("{position: free}", "target.position: expected a list, not 'free'"),
        ("{positon: [0 m, 0 m, 0 m]}", "target.positon: unknown key; did you mean 'position'?"),
        ("{pointing: [0, 0, 1], tolerance: {angle: 0 deg}}", "must be greater than 0, not '0 deg'"),
        ("{pointing: [0, 0, 1], tolerance: {position: 1 deg}}", "'deg' is not a unit of length"),
        ("{pointing: [0, 0, 1], tolerance: {angle: 1}}", "expected an angle such as '30 deg'"),
        ("5", "target: expected a mapping, not 5"),
    ],
)
def test_a_mistake_in_the_target(tmp_path: Path, target: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        with_target(tmp_path, target)
    assert message in str(caught.value)
    assert caught.value.line == 3


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("{}", "stiffness: asks for nothing; expected maximise, at_least or match"),
        ("{maximise: []}", "stiffness.maximise: is empty; expected at least one mapping"),
        ("{maximise: 5}", "stiffness.maximise: expected a list, not 5"),
        ("{maximise: {}}", "stiffness.maximise: the key 'direction' is missing"),
        ("{maximise: {direction: [0, 0, 0]}}", "stiffness.maximise.direction: is zero"),
        (
            "{maximise: {direction: [1, 0, 0], frame: world}}",
            "stiffness.maximise.frame: 'world' is not one of 'base' or 'tip'",
        ),
        (
            "{maximise: [{direction: [1, 0, 0]}, {direction: [1, 0, 0], kind: bending}]}",
            "stiffness.maximise[1].kind: 'bending' is not one of 'translation' or 'rotation'",
        ),
        (
            "{maximise: {direction: [1, 0, 0], boundry: free}}",
            "stiffness.maximise.boundry: unknown key; did you mean 'boundary'?",
        ),
        (
            "{maximise: {direction: [1, 0, 0], value: 1 N/m}}",
            "stiffness.maximise.value: unknown key; the keys here are direction, frame, kind",
        ),
        (
            "{maximize: {direction: [1, 0, 0]}}",
            "stiffness.maximize: unknown key; did you mean 'maximise'?",
        ),
        (
            "{maximise: [{direction: [1, 0, 0]}, {direction: [1, 0, 0], kind: rotation}]}",
            "stiffness.maximise: mixes translation (N/m) and rotation (N*m/rad)",
        ),
        ("{at_least: {direction: [1, 0, 0]}}", "at_least: the key 'value' is missing"),
        (
            "{at_least: {value: 1, direction: [1, 0, 0]}}",
            "stiffness.at_least.value: bare number 1 has no unit; expected a stiffness against "
            "translation such as '1.3 N/m'",
        ),
        (
            "{at_least: {value: 1 N/m, direction: [1, 0, 0], kind: rotation}}",
            "'N/m' is not a unit of stiffness against rotation; expected a stiffness against "
            "rotation such as '0.2 N*m/rad'",
        ),
        (
            "{at_least: [{value: 1 N*m/rad, direction: [1, 0, 0]}]}",
            "stiffness.at_least[0].value: '1 N*m/rad': 'N*m/rad' is not a unit of stiffness",
        ),
        (
            "{at_least: {value: 0 N/m, direction: [1, 0, 0]}}",
            "stiffness.at_least.value: must be greater than 0, not '0 N/m'",
        ),
        (
            "{maximise: {direction: [1, 0, 0]}, match: {value: 1 N/m, direction: [1, 0, 0]}}",
            "stiffness.match: cannot be combined with maximise",
        ),
        ("{match: {direction: [1, 0, 0]}}", "stiffness.match: the key 'value' is missing"),
        ("{match: [{direction: [1, 0, 0]}]}", "stiffness.match: expected a mapping, not a list"),
        (
            "{match: {value: 1 N/m, direction: [1, 0, 0], tolerance: 1}}",
            "stiffness.match.tolerance: must be less than 1, not 1",
        ),
        (
            "{match: {value: 1 N/m, direction: [1, 0, 0], tolerance: 0 %}}",
            "stiffness.match.tolerance: must be greater than 0, not '0 %'",
        ),
        ("{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]]}}", "match: the key 'unit' is missing"),
        (
            "{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]], unit: N*m/rad}}",
            "stiffness.match.unit: 'N*m/rad' is not a unit of stiffness; expected one such as",
        ),
        (
            "{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]], unit: 3}}",
            "stiffness.match.unit: '3' is not a unit of stiffness",
        ),
        (
            "{match: {matrix: [[1,0.1,0],[0,1,0],[0,0,1]], unit: N/m}}",
            "stiffness.match.matrix: is not symmetric",
        ),
        (
            "{match: {matrix: [[1,0,0],[0,-1,0],[0,0,1]], unit: N/m}}",
            "stiffness.match.matrix: is not positive definite",
        ),
        ("{match: {matrix: [[1,0],[0,1]], unit: N/m}}", "match.matrix: expected 3 items, not 2"),
        ("{match: {matrix: 5, unit: N/m}}", "stiffness.match.matrix: expected a list, not 5"),
        (
            "{match: {matrix: [[1 N/m,0,0],[0,1,0],[0,0,1]], unit: N/cm}}",
            "stiffness.match.matrix[0][0]: '1 N/m' is not a number",
        ),
        (
            "{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]], unit: N/m, boundary: free}}",
            "stiffness.match.boundary: 'free' is not one of 'guided' or 'clamped'",
        ),
        (
            "{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]], unit: N/m, kind: rotation}}",
            "stiffness.match.kind: unknown key",
        ),
        (
            "{match: {matrix: [[1,0,0],[0,1,0],[0,0,1]], unit: N/m, value: 1 N/m}}",
            "stiffness.match.value: cannot be combined with matrix",
        ),
    ],
)
def test_a_mistake_in_the_stiffness(tmp_path: Path, goal: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        with_goal(tmp_path, goal)
    assert message in str(caught.value)
    assert caught.value.line == 4


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("robot: stiff-flop-2", "robot: ''", 2, "robot: must not be empty"),
        ("robot: stiff-flop-2", "robot: 2", 2, "robot: expected text, not 2"),
        ("robot: stiff", "robto: stiff", 1, "the key 'robot' is missing"),
        ("0 N, -0.02 N", "0 N, -0.02", 9, "load.force[2]: bare number -0.02"),
        ("0 N, -0.02 N", "-0.02 N", 9, "load.force: expected 3 items, not 2"),
        ("1 mN*m", "1 mJ", 9, "load.moment[2]: '1 mJ': 'mJ' is a unit of energy, not of moment"),
        ("frame: tip", "frame: hip", 9, "load.frame: 'hip' is not one of 'base' or 'tip'"),
        ("max: 1.2 bar", "max: 1.2", 10, "pressure.max: bare number 1.2 has no unit"),
        ("max: 1.2 bar", "max: [1 bar, 2]", 10, "pressure.max[1]: bare number 2 has no unit"),
        ("max: 1.2 bar", "slew: 1 bar/s", 10, "pressure.slew: unknown key; the keys here are min"),
        ("pressure:", "source: here\npressure:", 10, "source: unknown key; the keys here are"),
        ("pressure:", "presure:", 10, "presure: unknown key; did you mean 'pressure'?"),
    ],
)
def test_a_mistake_elsewhere(tmp_path: Path, old: str, new: str, line: int, message: str) -> None:
    assert old in TASK
    with pytest.raises(FileError) as caught:
        read(tmp_path, TASK.replace(old, new, 1))
    assert message in str(caught.value)
    assert caught.value.line == line


def test_the_target_is_required(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="the key 'target' is missing"):
        read(tmp_path, HEAD)


def test_goals(tmp_path: Path) -> None:
    one = with_goal(tmp_path, "{maximise: {direction: [1, 0, 0]}}")
    assert one == StiffnessGoal(maximise=(X,)) == StiffnessGoal(maximise=[X])
    goal = with_goal(
        tmp_path,
        "{maximise: [{direction: [1, 0, 0]}, {direction: [1, 0, 0], frame: tip}],"
        " at_least: {value: 0.012 N/cm, direction: [0, 1, 0]}}",
    )
    assert goal == StiffnessGoal(
        maximise=(X, StiffnessMeasure(direction=(1, 0, 0), frame="tip")),
        at_least=(AtLeast(value=1.2, direction=(0, 1, 0)),),
    )
    goal = with_goal(
        tmp_path,
        "{at_least: [{value: 0.2 N*m/rad, direction: [0, 1, 0], kind: rotation}],"
        " match: {value: 1.3 N/m, direction: [1, 0, 0], boundary: clamped, tolerance: 5 %}}",
    )
    assert goal == StiffnessGoal(
        at_least=[AtLeast(value="0.2 N*m/rad", direction=(0, 1, 0), kind="rotation")],
        match=MatchValue(value=1.3, direction=(1, 0, 0), boundary="clamped", tolerance=0.05),
    )


def test_a_matrix_is_kept_in_si(tmp_path: Path) -> None:
    matrix = [[0.02, 0.001, 0], [0.001, 0.03, 0], [0, 0, 1]]
    goal = with_goal(tmp_path, f"{{match: {{matrix: {matrix}, unit: N/cm, boundary: clamped}}}}")
    assert goal is not None
    match = goal.match
    assert isinstance(match, MatchMatrix)
    np.testing.assert_allclose(match.matrix, np.array(matrix) * 100, rtol=1e-15)
    assert (match.unit, match.frame, match.boundary) == ("N/m", "base", "clamped")
    in_code = StiffnessGoal(match={"matrix": np.array(matrix) * 100, "boundary": "clamped"}).match
    assert isinstance(in_code, MatchMatrix)
    np.testing.assert_allclose(in_code.matrix, match.matrix, rtol=1e-15)
    assert MatchMatrix(matrix=np.array(matrix), unit="N/cm", boundary="clamped") == match


def test_mistakes_in_code_are_input_errors() -> None:
    with pytest.raises(InputError, match="StiffnessGoal: asks for nothing"):
        StiffnessGoal()
    with pytest.raises(InputError, match=r"StiffnessMeasure\.direction: is zero"):
        StiffnessMeasure(direction=(0, 0, 0))
    with pytest.raises(InputError, match=r"StiffnessGoal\.match: cannot be combined"):
        StiffnessGoal(maximise=X, match=MatchValue(value=1, direction=(1, 0, 0)))
    with pytest.raises(InputError, match=r"AtLeast\.value: True is not a number"):
        AtLeast(value=True, direction=(1, 0, 0))
    with pytest.raises(InputError, match="mixes translation"):
        StiffnessGoal(maximise=[X, TURN])
    with pytest.raises(InputError, match=r"Target\.position\[0\]: nan is not a finite number"):
        Target(position=(math.nan, 0, 0))
    with pytest.raises(InputError, match=r"Task: the key 'target' is missing"):
        Task(robot="stiff-flop-2")
    with pytest.raises(InputError, match=r"MatchMatrix\.matrix: is not symmetric"):
        MatchMatrix(matrix=[[1, 1, 0], [0, 1, 0], [0, 0, 1]])


def test_the_robot_of_a_task(tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    save_file(tmp_path / "robots" / "arm.yaml", "robot", load_description("stiff-flop-1"))
    task = read(tmp_path, TASK.replace("stiff-flop-2", "robots/arm.yaml"))
    assert task.resolve_robot() == load_description("stiff-flop-1")
    assert read(tmp_path, TASK).resolve_robot() == load_description("stiff-flop-2")
    by_path = Task(robot=tmp_path / "robots" / "arm.yaml", target=SOMEWHERE)
    assert by_path.resolve_robot() == load_description("stiff-flop-1")
    in_code = Task(robot="stiff-flop-3", target=SOMEWHERE)
    assert in_code.resolve_robot().n_segments == 3


def test_a_task_for_no_robot(tmp_path: Path) -> None:
    task = read(tmp_path, TASK.replace("stiff-flop-2", "stiff-flop-4"))
    with pytest.raises(FileError, match=r"task\.yaml:2: robot: there is no robot 'stiff-flop-4'"):
        task.resolve_robot()
    task = read(tmp_path, TASK.replace("stiff-flop-2", "none.yaml"))
    with pytest.raises(FileError, match=r"task\.yaml:2: robot: there is no file '.*none\.yaml'"):
        task.resolve_robot()
    task = read(tmp_path, TASK.replace("stiff-flop-2", "task.yaml"))
    with pytest.raises(FileError, match="this is a task file, expected a robot file"):
        task.resolve_robot()
    with pytest.raises(InputError, match=r"Task\.robot: there is no robot 'x'"):
        Task(robot="x", target=SOMEWHERE).resolve_robot()


@pytest.mark.parametrize(
    ("limits", "lower", "upper"),
    [
        ({}, [0] * 6, [1.5e5] * 6),
        ({"max": 1.2e5}, [0] * 6, [1.2e5] * 6),
        ({"min": 1e4, "max": 9e5}, [1e4] * 6, [1.5e5] * 6),
        ({"min": -1e4, "max": 0}, [0] * 6, [0] * 6),
        ({"max": [1e5, None, 3e4, 9e5, 0, 1]}, [0] * 6, [1e5, 1.5e5, 3e4, 1.5e5, 0, 1]),
        ({"min": ["0.1 bar"] + [None] * 5}, [1e4, 0, 0, 0, 0, 0], [1.5e5] * 6),
    ],
)
def test_limits_are_tightened(limits: Any, lower: list[float], upper: list[float]) -> None:
    task = Task(robot="stiff-flop-2", target=SOMEWHERE, pressure=limits)
    low, high = task.pressure_bounds(load_description("stiff-flop-2"))
    assert low.dtype == high.dtype == np.float64
    np.testing.assert_array_equal(low, lower)
    np.testing.assert_array_equal(high, upper)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"max": [1e5] * 3}, r"pressure\.max: has 3 values; expected one value or a list of 6"),
        ({"min": 1e5, "max": 9e4}, r"pressure\.max: leaves segment 1 channel 1 no pressure"),
        ({"min": [0] * 4 + [2e5, 0]}, r"pressure\.min: leaves segment 2 channel 2 no pressure"),
        ({"max": -1e4}, r"its min is 0 bar and its max -0\.1 bar with the robot's own limits"),
    ],
)
def test_limits_that_cannot_be(limits: Any, message: str) -> None:
    task = Task(robot="stiff-flop-2", target=SOMEWHERE, pressure=limits)
    with pytest.raises(InputError, match=message):
        task.pressure_bounds(load_description("stiff-flop-2"))


def test_limits_that_cannot_be_name_the_file(tmp_path: Path) -> None:
    task = read(tmp_path, TASK.replace("max: 1.2 bar", "max: [1.2 bar, 1 bar]"))
    with pytest.raises(FileError, match=r"task\.yaml:10: pressure\.max: has 2 values"):
        task.pressure_bounds(load_description("stiff-flop-2"))


def test_a_task_survives_its_file(tmp_path: Path) -> None:
    task = read(tmp_path, TASK.replace("10 mm", "free"))
    save_file(tmp_path / "task.yaml", "task", task)
    assert load_task(tmp_path / "task.yaml") == task
    matched = Task(
        robot="stiff-flop-2",
        target=Target(orientation=(1, 0, 0, 0)),
        stiffness={
            "at_least": {"value": 1 / 3, "direction": (1, 2, 3), "kind": "rotation"},
            "match": {"matrix": np.diag([1.0, 2.0, 3.0])},
        },
        source=tmp_path / "other.yaml",
    )
    save_file(tmp_path / "other.yaml", "task", matched)
    assert load_task(tmp_path / "other.yaml") == matched
