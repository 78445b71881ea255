"""The path file, its points in space, and the rates of its pressures."""

from __future__ import annotations

import math
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stiffopt
from stiffopt.errors import FileError, InputError
from stiffopt.files import save_file
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.paths.geometry import path_axes
from stiffopt.paths.path import MAX_POINTS, Path, load_path
from stiffopt.paths.rates import least_times, step_limits

HEAD = "format: stiffopt-path/1\nrobot: stiff-flop-2\n"
LINE = "path: {line: {from: [-30 mm, -20 mm, 190 mm], to: [-30 mm, 20 mm, 190 mm]}}\n"
SPEED = "points: 5\ntiming: {speed: 10 mm/s}\n"
FASTEST = {"fastest": True}
STRAIGHT = {"line": {"from": (0, 0, 0.18), "to": (0.04, 0, 0.18)}}
RING = {
    "circle": {
        "centre": (0, 0, 0.18),
        "normal": (0, 0, 2),
        "radius": 0.02,
        "start": (0.02, 0, 0.18),
    }
}
TWO = load_description("stiff-flop-2")


def read(folder: FilePath, text: str) -> Path:
    file = folder / "path.yaml"
    file.write_text(HEAD + text, encoding="utf-8")
    return load_path(file)


def made(path: dict[str, Any], **keys: Any) -> Path:
    return Path(**{"path": path, "timing": FASTEST, **keys})


def through(*positions: tuple[float, float, float], **keys: Any) -> Path:
    return made({"through": [{"position": position} for position in positions]}, **keys)


def test_a_path_file_is_read_in_si(tmp_path: FilePath) -> None:
    path = read(
        tmp_path,
        LINE
        + SPEED
        + "pointing: [0, 0, 2]\ntolerance: {position: 0.5 mm}\n"
        + "stiffness: {maximise: {direction: [1, 0, 0], frame: path, over: mean}}\n"
        + "load: {force: [0 N, 0 N, -0.02 N]}\n"
        + "start: {pressures: [0.1 bar, 0 bar, 0 bar, 0 bar, 0 bar, 0 bar]}\n"
        + "pressure: {max: 1.2 bar, slew: 2 bar/s}\n"
        + "scene: {objects: [{name: post, sphere: {centre: [9 cm, 0 m, 0 m], radius: 5 mm}}]}\n",
    )
    assert (path.robot, path.count, path.closed) == ("stiff-flop-2", 5, False)
    assert path.pressure.slew == 2e5
    assert path.source == tmp_path / "path.yaml"
    points = path.points()
    assert len(points) == 5
    assert points.positions == pytest.approx(
        np.column_stack([[-0.03] * 5, np.linspace(-0.02, 0.02, 5), [0.19] * 5])
    )
    assert points.lengths == pytest.approx(np.linspace(0, 0.04, 5))
    assert points.times == pytest.approx(np.linspace(0, 4, 5))
    assert points.tangents == pytest.approx(np.tile([0.0, 1.0, 0.0], (5, 1)))
    assert points.targets[4] == Target(
        position=(-0.03, 0.02, 0.19), pointing=(0, 0, 1), tolerance=Tolerance(position=5e-4)
    )
    along = StiffnessMeasure(direction=(0, 1, 0))
    assert points.goals == (StiffnessGoal(maximise=along),) * 5
    assert path.stiffness is not None
    assert path.stiffness.over == "mean"
    first, last = path.end_pressures(TWO)
    assert first == pytest.approx([1e4, 0, 0, 0, 0, 0])
    assert last is None
    assert repr(path) == (
        "Path(stiff-flop-2, line of 40 mm, 5 points, 4 s, with a load, with pressure limits, "
        "in a scene)"
    )
    task = path.task(points.targets[0], points.goals[0])
    assert (task.load, task.scene, task.pressure.max) == (path.load, path.scene, 1.2e5)


def test_a_path_is_written_as_it_is_read(tmp_path: FilePath) -> None:
    (tmp_path / "points.csv").write_text("x_m,y_m,z_m\n0,0,0.18\n0.01,0,0.18\n")
    measure = {"direction": (1, 0, 0), "frame": "path", "over": "mean"}
    for path in (
        made(STRAIGHT, robot="stiff-flop-2", points=3, stiffness={"maximise": measure}),
        made(RING, robot="stiff-flop-2", spacing=1e-3, end={"pressures": [0.0] * 6}),
        made({"csv": tmp_path / "points.csv"}, robot="stiff-flop-2", pressure={"slew": [1e5] * 6}),
    ):
        save_file(tmp_path / "path.yaml", "path", path)
        again = load_path(tmp_path / "path.yaml")
        assert again.model_copy(update={"source": None}) == path
        assert isinstance(hash(again), int)


# -- geometry -------------------------------------------------------------------------------------


def test_a_line_has_equal_steps_and_no_more_than_the_spacing() -> None:
    points = made(STRAIGHT, spacing=3e-3).points()
    assert len(points) == 15  # 40 mm / 14
    assert np.diff(points.lengths) == pytest.approx(np.full(14, 0.04 / 14))
    assert len(made(STRAIGHT, spacing=1e-3).points()) == 41
    assert points.at(0.01) == pytest.approx([0.01, 0, 0.18])
    assert points.at([0.0, 0.04]) == pytest.approx(np.array([[0, 0, 0.18], [0.04, 0, 0.18]]))


def test_an_arc_goes_over_its_middle_point() -> None:
    turn = Rotation.from_rotvec([0.3, -0.7, 1.1])
    centre, angles = np.array([0.01, 0.02, 0.19]), np.array([0.2, 3.0, 4.5])
    ends = centre + 0.03 * turn.apply(
        np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    )
    points = made({"arc": {"from": ends[0], "via": ends[1], "to": ends[2]}}, points=40).points()
    assert points.curve.length == pytest.approx(0.03 * 4.3)
    assert points.positions[[0, -1]] == pytest.approx(ends[[0, 2]])
    assert points.at(0.03 * 2.8) == pytest.approx(ends[1])
    assert np.linalg.norm(points.positions - centre, axis=1) == pytest.approx(np.full(40, 0.03))
    slope = (points.at(points.lengths + 1e-7) - points.at(points.lengths - 1e-7)) / 2e-7
    assert points.tangents == pytest.approx(slope, abs=1e-8)


def test_a_circle_is_closed_and_turns_to_the_left_of_its_normal() -> None:
    path = made(RING, points=5, timing={"speed": 0.01})
    points = path.points()
    assert path.closed
    assert points.positions == pytest.approx(
        np.array([[0.02, 0, 0.18], [0, 0.02, 0.18], [-0.02, 0, 0.18], [0, -0.02, 0.18],
                  [0.02, 0, 0.18]])
    )  # fmt: skip
    assert (points.positions[0] == points.positions[-1]).all()
    assert points.times is not None
    assert points.times[-1] == pytest.approx(0.04 * math.pi / 0.01)
    assert points.tangents[0] == pytest.approx([0, 1, 0])
    assert not made(RING, points=5, closed=False).closed


def test_a_spline_goes_through_its_points_in_equal_steps() -> None:
    knots = [(0.0, 0, 0.18), (0.01, 0.02, 0.18), (0.03, 0.01, 0.19), (0.02, -0.01, 0.2)]
    points = made({"spline": knots}, points=200).points()
    steps = np.linalg.norm(np.diff(points.positions, axis=0), axis=1)
    assert steps == pytest.approx(np.full(199, points.curve.length / 199), rel=2e-3)
    fine = points.at(np.linspace(0, points.curve.length, 20_001))
    assert np.linalg.norm(np.diff(fine, axis=0), axis=1).sum() == pytest.approx(
        points.curve.length, rel=1e-6
    )
    nearest = np.linalg.norm(fine[:, None] - np.array(knots), axis=2).min(axis=0)
    assert (nearest < 3e-6).all()
    slope = (points.at(points.lengths[1:-1] + 1e-6) - points.at(points.lengths[1:-1] - 1e-6)) / 2e-6
    assert points.tangents[1:-1] == pytest.approx(slope, abs=1e-4)


def test_a_closed_spline_leads_smoothly_back_to_its_first_point() -> None:
    angles = 2 * np.pi * np.arange(12) / 12
    knots = np.column_stack([0.02 * np.cos(angles), 0.02 * np.sin(angles), np.full(12, 0.18)])
    for given in (knots, np.vstack([knots, knots[:1]])):
        points = made({"spline": given}, points=100, closed=True).points()
        assert (points.positions[0] == points.positions[-1]).all()
        assert points.tangents[0] == pytest.approx(points.tangents[-1])
        assert points.curve.length == pytest.approx(0.04 * np.pi, rel=1e-3)


def test_listed_points_are_the_points() -> None:
    path = through((0, 0, 0.18), (0.01, 0, 0.18), (0.01, 0.02, 0.18), (0.01, 0.02, 0.18))
    points = path.points()
    assert points.lengths == pytest.approx([0, 0.01, 0.03, 0.03])
    half = math.sqrt(0.5)
    assert points.tangents == pytest.approx(
        np.array([[1, 0, 0], [half, half, 0], [0, 1, 0], [0, 1, 0]])
    )
    assert points.at(0.02) == pytest.approx([0.01, 0.01, 0.18])
    assert through((0, 0, 0.18), (0, 0, 0.18)).points().tangents == pytest.approx(np.zeros((2, 3)))
    there_and_back = through((0, 0, 0.18), (0.01, 0, 0.18), (0, 0, 0.18), closed=True)
    assert there_and_back.points().tangents[:, 0] == pytest.approx([1, -1, 1])


def test_listed_targets_keep_what_is_theirs() -> None:
    shape = {
        "through": [
            {"position": (0, 0, 0.18), "tolerance": {"position": 1e-3}},
            {"position": (0.01, 0, 0.18)},
        ]
    }
    first, second = made(shape, tolerance={"position": 2e-3}, pointing=(0, 0, 1)).points().targets
    assert (first.tolerance.position, second.tolerance.position) == (1e-3, 2e-3)
    assert first.pointing == second.pointing == (0, 0, 1)


def test_a_csv_file_has_points_times_and_orientations(tmp_path: FilePath) -> None:
    (tmp_path / "points.csv").write_text(
        "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0.18,1,0,0,0\n0.5,0.01,0,0.18,-1,0,0,0\n"
    )
    path = read(tmp_path, "path: {csv: points.csv}\n")
    points = path.points()
    assert points.times == pytest.approx([0, 0.5])
    assert [target.orientation for target in points.targets] == [(1, 0, 0, 0)] * 2
    assert points.targets[1].position == (0.01, 0, 0.18)


def test_the_axes_of_a_path() -> None:
    tangents = Rotation.random(20, random_state=1).apply([1, 0, 0])
    tangents = np.vstack([tangents, [[0, 0, 1], [0, 0, -1], [0, 1, 0]]])
    axes = path_axes(tangents)
    assert axes.transpose(0, 2, 1) @ axes == pytest.approx(np.tile(np.eye(3), (23, 1, 1)), abs=1e-9)
    assert np.linalg.det(axes) == pytest.approx(np.ones(23))
    assert axes[:, :, 0] == pytest.approx(tangents)
    assert (axes[:20, 2, 2] > 0).all()  # z leans to the base's z
    assert axes[:20, 2, 1] == pytest.approx(np.zeros(20), abs=1e-12)  # y is level
    assert axes[20:22, :, 2] == pytest.approx(np.tile([1.0, 0, 0], (2, 1)))
    assert axes[22] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))


def test_a_direction_turns_with_the_path() -> None:
    measures = [
        {"direction": (0, 1, 0), "frame": "path", "boundary": "guided"},
        {"direction": (0, 0, 1), "frame": "tip"},
    ]
    goals = made(RING, points=5, stiffness={"maximise": measures}).points().goals
    ways = [(-1, 0, 0), (0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0)]  # to the left: inwards
    for goal, way in zip(goals, ways, strict=True):
        assert goal is not None
        across, axial = goal.maximise
        assert across.direction == pytest.approx(way, abs=1e-12)
        assert (across.frame, across.boundary) == ("base", "guided")
        assert axial == StiffnessMeasure(direction=(0, 0, 1), frame="tip")
    fixed = made(RING, points=5, stiffness={"maximise": {"direction": (1, 0, 0)}}).points().goals
    assert len({id(goal) for goal in fixed}) == 1


# -- rates ----------------------------------------------------------------------------------------


def test_the_smaller_rate_holds() -> None:
    unknown = TWO.model_copy(update={"pressure": TWO.pressure.model_copy(update={"slew": None})})
    assert unknown.slew_limits() is None
    assert unknown.slew_limits(2e5) == pytest.approx(np.full(6, 2e5))
    limits = TWO.pressure.model_copy(update={"slew": (1e5, 3e5) * 3})
    robot = TWO.model_copy(update={"pressure": limits})
    assert robot.slew_limits() == pytest.approx([1e5, 3e5] * 3)
    assert robot.slew_limits(2e5) == pytest.approx([1e5, 2e5] * 3)
    assert robot.slew_limits((5e5,) * 6) == pytest.approx([1e5, 3e5] * 3)


def test_steps_and_their_times() -> None:
    pressures = np.array([[0, 0], [1e5, -1e5], [1e5, -1e5]])
    assert least_times(pressures, [1e5, 4e5]) == pytest.approx([1.0, 0.0])
    assert step_limits([0, 0.5, 2.0], [1e5, 4e5]) == pytest.approx(
        np.array([[5e4, 2e5], [1.5e5, 6e5]])
    )


# -- mistakes -------------------------------------------------------------------------------------

POINTS = "path: {through: [{position: [0 m, 0 m, 180 mm]}, {position: [9 mm, 0 m, 180 mm]}%s]}\n"
CIRCLE = (
    "path: {circle: {centre: [0 m, 0 m, 180 mm], normal: [0, 0, 1], radius: 20 mm, start: %s}}\n"
)


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (3, "path: {}\n" + SPEED, "path: is empty; expected the key line, arc, circle,"),
        (3, LINE.replace("{line", "{spline: [], line") + SPEED, "cannot be combined with line"),
        (3, LINE.replace("to: [-30 mm, 20", "to: [-30 mm, -20") + SPEED, "is where the line"),
        (3, LINE.replace("line", "lnie") + SPEED, "path.lnie: unknown key; did you mean 'line'?"),
        (3, LINE.replace("190 mm]}", ".nan]}") + SPEED, "nan is not a finite number"),
        (3, "path: {arc: {from: [0 m, 0 m, 1 m], via: [0 m, 0 m, 2 m], to: [0 m, 0 m, 3 m]}}\n"
         + SPEED, "path.arc.via: is on one line with the other two points"),
        (3, CIRCLE % "[20 mm, 0 m, 181 mm]" + SPEED,
         "path.circle.start: is 1 mm off the circle's plane; expected a point on the circle"),
        (3, CIRCLE % "[21 mm, 0 m, 180 mm]" + SPEED,
         "path.circle.start: is 21 mm from the centre; expected the radius of 20 mm"),
        (3, "path: {spline: [[0 m, 0 m, 0 m]]}\n" + SPEED, "path.spline: expected at least 2"),
        (3, "path: {spline: [[0 m, 0 m, 0 m], [0 m, 0 m, 0 m]]}\n" + SPEED,
         "path.spline[1]: is the point before it again"),
        (3, "path: {spline: [[0 m, 0 m, 0 m], [9 mm, 0 m, 0 m]]}\nclosed: true\n" + SPEED,
         "path.spline: expected at least 3 points, as the path is closed"),
        (3, POINTS % ", {position: [free, 0 m, 0 m]}" + "timing: {fastest: true}\n",
         "path.through[2]: needs all three coordinates of its position"),
        (3, POINTS % ", {position: [1 mm, 0 m, 0 m], pointing: [0, 0, 1]}"
         + "timing: {fastest: true}\n", "path.through[2]: asks for other parts of the pose"),
        (3, "path: {csv: none.csv}\n" + SPEED, "none.csv: there is no such file"),
        (4, LINE + SPEED.replace("5", "1"), "points: must be at least 2, not 1"),
        (4, LINE + SPEED.replace("5", "5001"), "points: must be at most 5000, not"),
        (4, LINE + SPEED.replace("5", "2.5"), "points: expected a whole number, not 2.5"),
        (1, LINE + "timing: {speed: 1 mm/s}\n", "needs the key points or spacing, and not both"),
        (4, LINE + SPEED.replace("points: 5", "spacing: 1 um"), "spacing: makes 40001 points of"),
        (4, LINE + SPEED.replace("points: 5", "spacing: 1.0e-300 mm"), "at most 5000 are allowed"),
        (4, CIRCLE % "[20 mm, 0 m, 180 mm]" + SPEED.replace("5", "2"),
         "points: must be at least 3 on a path that is closed"),
        (5, LINE + SPEED.replace("10 mm/s", "1.0e-9 mm/s"), "takes 4e+10 s; expected a day"),
        (5, LINE + SPEED.replace("10 mm/s", "1.0e-310 mm/s"), "takes inf s; expected a day"),
        (4, LINE + SPEED.replace("points: 5", "spacing: 0 mm"), "spacing: must be greater than 0"),
        (4, POINTS % "" + SPEED, "points: cannot be chosen: path.through is the points"),
        (4, POINTS % "" + "spacing: 1 mm\ntiming: {fastest: true}\n",
         "spacing: is 1 mm, but points 1 and 2 of path.through are 9 mm apart"),
        (1, LINE + "points: 5\n", "the key 'timing' is missing; expected a speed, times or"),
        (5, LINE + "points: 5\ntiming: {}\n", "timing: is empty; expected the key speed"),
        (5, LINE + "points: 5\ntiming: {speed: 0 mm/s}\n", "timing.speed: must be greater than"),
        (5, LINE + "points: 5\ntiming: {speed: -1 mm/s}\n", "timing.speed: must be greater than"),
        (5, LINE + "points: 5\ntiming: {speed: 10 mm}\n", "'mm' is not a unit of speed"),
        (5, LINE + "points: 5\ntiming: {fastest: false}\n", "timing.fastest: False is not one"),
        (5, LINE + "points: 5\ntiming: {speed: 1 mm/s, fastest: true}\n", "cannot be combined"),
        (5, LINE + "points: 5\ntiming: {times: [0 s, 1 s]}\n",
         "timing.times: has 2 values; expected 5, one a point"),
        (5, LINE + "points: 2\ntiming: {times: [1 s, 2 s]}\n",
         "timing.times[0]: begins at 1 s; expected 0 s"),
        (5, LINE + "points: 3\ntiming: {times: [0 s, 2 s, 2 s]}\n",
         "timing.times[2]: is 2 s after 2 s; it must increase"),
        (4, POINTS % ", {position: [9 mm, 0 m, 180 mm]}" + "timing: {speed: 1 mm/s}\n",
         "timing.speed: leaves no time between points 2 and 3, which are at the same position"),
        (3, LINE + SPEED + "closed: true\n", "path.line: has two ends; only a circle, a spline"),
        (3, POINTS % "" + "timing: {fastest: true}\nclosed: true\n",
         "path.through: ends 9 mm from where it begins; a closed path ends there again"),
        (5, "path: {through: [{position: [0 m, 0 m, 1 m], pointing: [0, 0, 1]}, {position: "
         "[1 m, 0 m, 1 m], pointing: [0, 0, 1]}, {position: "
         "[0 m, 0 m, 1 m], pointing: [0, 1, 1]}]}\n"
         "timing: {fastest: true}\nclosed: true\n",
         "closed: cannot be: the last point has another pointing than the first"),
        (7, LINE + SPEED + "pointing: [0, 0, 1]\norientation: [1, 0, 0, 0]\n",
         "orientation: cannot be combined with pointing"),
        (6, LINE + SPEED + "stiffness: {maximise: {direction: [1, 0, 0], frame: trail}}\n",
         "stiffness.maximise.frame: 'trail' is not one of 'base', 'tip' or 'path'"),
        (6, LINE + SPEED + "stiffness: {maximise: []}\n", "is empty; expected at least one"),
        (6, LINE + SPEED + "stiffness: {at_least: 1 N/m}\n", "stiffness: the key 'maximise' is"),
        (6, LINE + SPEED + "stiffness: {maximise: [{direction: [1, 0, 0]}, {direction: [1, 0, 0], "
         "kind: rotation}]}\n", "stiffness.maximise: mixes translation (N/m) and rotation"),
        (6, LINE + SPEED + "stiffness: {maximise: [{direction: [1, 0, 0]}, {direction: [0, 1, 0], "
         "over: mean}]}\n", "stiffness.maximise: mixes the worst and the mean"),
        (6, LINE + SPEED + "pressure: {slew: 0 bar/s}\n", "pressure.slew: must be greater than 0"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_path_file(tmp_path: FilePath, line: int, text: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value)
    assert caught.value.line == line
    assert caught.value.path.endswith("path.yaml")


@pytest.mark.parametrize(
    ("line", "table", "message"),
    [
        (1, "x_m,y_m\n0,0\n0,1\n", "the column 'z_m' is missing; expected time_s (or none)"),
        (1, "x_m,y_m,z_m,w\n0,0,0,0\n0,0,1,0\n", "the column 'w' is unknown"),
        (1, "x_m,y_m,z_m,x_m\n0,0,0,0\n0,0,1,0\n", "the column 'x_m' appears twice"),
        (1, "x_m,y_m,z_m,qw\n0,0,0,1\n0,0,1,1\n", "the column 'qx' is missing"),
        (3, "x_m,y_m,z_m\n0,0,0.18\n0,,0.18\n", "y_m is missing"),
        (3, "x_m,y_m,z_m\n0,0,0.18\n0,nan,0.18\n", "'nan' is not a finite number"),
        (3, "x_m,y_m,z_m\n0,0,0.18\n0,0.18\n", "expected 3 fields, found 2"),
        (3, "x_m,y_m,z_m\n0,0,0.18\n0,1e300,0\n", "is more than 1000 m from the base"),
        (0, "x_m,y_m,z_m\n0,0,0.18\n", "has 1 points; expected at least 2"),
        (2, "time_s,x_m,y_m,z_m\n1,0,0,0.18\n2,0,0,0.19\n", "time_s begins at 1 s; expected 0 s"),
        (3, "time_s,x_m,y_m,z_m\n0,0,0,0.18\n0,0,0,0.19\n", "time_s is 0 s after 0 s"),
        (3, "x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0.18,1,0,0,0\n0,0,0.2,1,1,0,0\n",
         "the quaternion has norm 1.414"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_csv_file(tmp_path: FilePath, line: int, table: str, message: str) -> None:
    (tmp_path / "points.csv").write_text(table)
    with pytest.raises(FileError) as caught:
        read(tmp_path, "path: {csv: points.csv}\ntiming: {fastest: true}\n")
    where = f"points.csv:{line}: " if line else "points.csv: "
    assert f"path.csv: {tmp_path / where}" in str(caught.value)
    assert message in str(caught.value)
    assert caught.value.line == 3


def test_what_a_csv_file_says_is_not_said_twice(tmp_path: FilePath) -> None:
    (tmp_path / "points.csv").write_text(
        "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0.18,1,0,0,0\n0.5,0.01,0,0.18,-1,0,0,0\n"
    )
    csv = "path: {csv: points.csv}\n"
    with pytest.raises(FileError, match="timing: is given by the column time_s too"):
        read(tmp_path, csv + "timing: {fastest: true}\n")
    with pytest.raises(FileError, match=r"pointing: is given by path.csv too"):
        read(tmp_path, csv + "pointing: [0, 0, 1]\n")


def test_too_many_points() -> None:
    with pytest.raises(InputError, match="has 5001 points; at most 5000 are allowed"):
        through(*((1e-5 * k, 0.0, 0.18) for k in range(MAX_POINTS + 1)))


def test_a_path_that_stays_has_no_axes() -> None:
    measure = {"direction": (1, 0, 0), "frame": "path"}
    with pytest.raises(
        InputError, match="frame: path has no axes at point 1, where the path has no"
    ):
        through((0, 0, 0.18), (0, 0, 0.18), stiffness={"maximise": measure})


def test_pressures_at_the_ends(tmp_path: FilePath) -> None:
    def ends(text: str) -> Path:
        return read(tmp_path, LINE + SPEED + text)

    with pytest.raises(FileError, match="has 2 values; expected 6, one for each channel") as caught:
        ends("end: {pressures: [0 bar, 1 bar]}\n").end_pressures(TWO)
    assert (caught.value.key, caught.value.line) == ("end.pressures", 6)
    beyond = "start: {pressures: [0 bar, 1.4 bar, 0 bar, 0 bar, 0 bar, 0 bar]}\n"
    message = "segment 1 channel 2 is at 1.4 bar; expected 0 bar to 1.2 bar"
    with pytest.raises(FileError, match=message):
        ends(beyond + "pressure: {max: 1.2 bar}\n").end_pressures(TWO)
    with pytest.raises(InputError, match=r"Path.end.pressures: differ from those at the start"):
        made(RING, points=9, start={"pressures": [0.0] * 6}, end={"pressures": [1.0] * 6})
    both = made(RING, points=9, end={"pressures": [2e4] * 6}).end_pressures(TWO)
    assert both[0] == pytest.approx([2e4] * 6) == both[1]
    with pytest.raises(FileError, match=r"pressure.slew: has 2 values; expected one value or a"):
        ends("pressure: {slew: [1 bar/s, 2 bar/s]}\n").pressure_bounds(TWO)


def test_the_robot_of_a_path(tmp_path: FilePath) -> None:
    assert read(tmp_path, LINE + SPEED).resolve_robot() == TWO
    with pytest.raises(InputError, match=r"Path.robot: the path names no robot"):
        made(STRAIGHT, points=3).resolve_robot()
    assert stiffopt.load_path is load_path
    assert stiffopt.Path is Path
