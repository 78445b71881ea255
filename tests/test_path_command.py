"""The command `stiffopt path` and its figure, with a simple solver in the place of the real one."""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from typer.testing import CliRunner

import stiffopt
from stiffopt import plots
from stiffopt.cli import main as entry
from stiffopt.cli.path_records import rate_margins
from stiffopt.documents import read_document
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.paths import path as description
from stiffopt.paths.rates import least_times
from stiffopt.paths.solution import PathSolution
from stiffopt.units import parse_quantity

LINE = """\
format: stiffopt-path/1
robot: stiff-flop-2
path: {line: {from: [-30 mm, -10 mm, 190 mm], to: [-30 mm, 10 mm, 190 mm]}}
points: 11
timing: {speed: 10 mm/s}
stiffness: {maximise: {direction: [1, 0, 0], over: worst}}
"""
SCENE = "scene: {clearance: 2 mm, objects: [{name: post, sphere: {centre: [60 mm, 0 mm, 90 mm], radius: 5 mm}}]}\n"  # noqa: E501
ROOT = Path(__file__).parents[1]
PROBLEMS = ROOT / "problems" / "paths"
KEYS = {
    *("path", "status", "times_s", "pressures_pa", "tip_position_m", "position_error_m"),
    *("stiffness", "stiffness_unit", "clearance_m", "worst_index", "solve_time_s", "message"),
}

Write = Callable[..., str]


def follow(robot: Any, path: Any, *, seed: int = 0) -> PathSolution:
    return followed(path.model_copy(update={"source": None}))


@cache
def followed(path: Any) -> PathSolution:
    """Answer each point next to the answer before it; the rates are looked at, not kept."""
    robot = stiffopt.load_robot(path.resolve_robot())
    points = path.points()
    task = path.task(points.targets[0], points.goals[0]).model_copy(update={"scene": None})
    solver = stiffopt.PressureSolver(robot, task)
    found = [solver.solve()]
    for target in points.targets[1:]:
        found.append(solver.solve(target, guess=found[-1].pressures))
    pressures = np.array([each.pressures for each in found])
    slew = robot.description.slew_limits(path.pressure.slew)
    times = points.times
    if times is None and slew is not None:
        times = np.concatenate([[0.0], np.cumsum(least_times(pressures, slew))])
    failures = [k for k, each in enumerate(found) if not each.found]
    stiffness = np.array([each.stiffness for each in found], dtype=float)
    return PathSolution(
        status="unreachable" if failures else "solved",
        message=f"point {failures[0] + 1} is out of reach" if failures else "",
        robot=solver.robot,
        times=np.asarray(times),
        pressures=pressures,
        tip_poses=np.array([each.tip_pose for each in found]),
        slew=slew,
        stiffness=None if path.stiffness is None else stiffness,
        stiffness_unit=found[0].stiffness_unit,
        alone=None if path.stiffness is None else stiffness * 1.02,
        position_errors=np.array([each.position_error for each in found]),
        clearance=None if path.scene is None else robot.clearance(pressures, path.scene),
        first_failure=failures[0] if failures else None,
        confidence="2 branches were searched",
        timings={"total": 0.25},
    )


@pytest.fixture(autouse=True)
def _solver(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("stiffopt.paths.solver")
    module.solve_path = follow  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "stiffopt.paths.solver", module)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(name: str, text: str) -> str:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return str(tmp_path / name)

    return write


def run(*arguments: str) -> Any:
    return CliRunner().invoke(entry.app, ["path", *arguments])


def test_the_table_says_all_that_matters(write: Write) -> None:
    result = run(write("line.yaml", LINE + SCENE))
    assert result.exit_code == 0, result.stderr
    text = result.stdout
    words = " ".join(text.split())  # the name of a long folder wraps
    for part in (
        "solved 0.25 s",
        "line of 20 mm, 11 points in 2 s",
        "N/m at its worst, point 1, 98.0% of that alone (maximised)",
        "against translation along (1, 0, 0), base axes, free",
        "of 5 bar/s at most, by segment",
        "required: at least 2 mm",
        "2 branches were searched",
        "of alone: share of what the point could have by itself",
    ):
        assert part in words
    rows = re.findall(r"^ +(\d+) +([\d.]+) .*%", text, re.M)
    assert [int(point) for point, _ in rows] == list(range(1, 12))
    assert [float(time) for _, time in rows] == pytest.approx(np.linspace(0, 2, 11))
    shown = [line for line in text.splitlines() if ".yaml" not in line]
    assert max(map(len, shown)) <= 80


def test_json_has_the_keys_of_the_design(write: Write) -> None:
    file = write("line.yaml", LINE)
    (line,) = run("--json", file).stdout.splitlines()
    record = json.loads(line)
    assert set(record) >= KEYS
    page = (ROOT / "docs" / "command.md").read_text(encoding="utf-8")
    assert {key for key in record if f"`{key}`" not in page.partition("## Path")[2]} == set()
    assert (record["path"], record["status"], record["found"]) == (file, "solved", True)
    assert record["times_s"] == pytest.approx(np.linspace(0, 2, 11).tolist())
    assert np.shape(record["pressures_pa"]) == (11, 6)
    poses = stiffopt.load_robot("stiff-flop-2").tip_pose(np.array(record["pressures_pa"]))
    assert np.array(record["tip_position_m"]) == pytest.approx(poses[:, :3, 3])
    assert max(record["position_error_m"]) <= 1e-4 * (1 + 1e-6)
    assert record["stiffness_unit"] == "N/m"
    assert record["worst_index"] == int(np.argmin(record["stiffness"]))
    assert record["clearance_m"] is None
    assert record["solve_time_s"] == 0.25


def test_answers_are_written_as_yaml_and_csv(tmp_path: Path, write: Write) -> None:
    out = [str(tmp_path / "answer.yaml"), str(tmp_path / "answer.csv")]
    file = write("line.yaml", LINE)
    for _ in range(2):  # results are overwritten
        assert run(file, "--out", out[0], "--out", out[1], "-q").exit_code == 0
    document = read_document(out[0]).data
    assert document["format"] == "stiffopt-path-result/1"
    (result,) = document["results"]
    assert (result["robot"], result["status"]) == ("stiff-flop-2", "solved")
    with open(out[1], newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == [
        "time_s", *(f"p{k}_pa" for k in range(1, 7)), "tip_x_m", "tip_y_m", "tip_z_m",
        "position_error_m", "stiffness_n_per_m",
    ]  # fmt: skip
    assert len(rows) == 11
    pressures = result["pressures"]
    assert list(pressures)[4] == "segment 2 channel 2"
    for k, name in enumerate(pressures):
        read = [parse_quantity(text, "Pa") for text in pressures[name]]
        assert [float(row[f"p{k + 1}_pa"]) for row in rows] == pytest.approx(read, abs=0.06)
    assert [float(row["stiffness_n_per_m"]) for row in rows] == pytest.approx(
        [parse_quantity(text, "N/m") for text in result["stiffness"]], rel=1e-6
    )
    assert parse_quantity(result["times"][-1], "s") == 2
    assert parse_quantity(result["tip"]["x"][0], "m") == pytest.approx(-0.03, abs=1e-4)


def test_only_results_are_overwritten(tmp_path: Path, write: Write) -> None:
    file = write("line.yaml", LINE)
    log = write("log.csv", "time_s,p1_pa,tip_x_m,tip_y_m,tip_z_m\n")
    for out, message in (
        (file, "is one of the files to solve"),
        (write("task.yaml", "format: stiffopt-task/1\n"), "exists and is no result file"),
        (log, "exists and is no CSV of a path's solution"),
        (str(tmp_path / "answer.txt"), "expected a name that ends in .yaml or .yml"),
    ):
        result = run(file, "--out", out)
        assert result.exit_code == 2
        assert message in result.stderr
    assert Path(log).read_text().startswith("time_s")


def test_several_files_are_each_answered(tmp_path: Path, write: Write) -> None:
    files = [
        write("bad.yaml", LINE.replace("10 mm/s", "0 mm/s")),
        write("far.yaml", LINE.replace("-30 mm", "-150 mm").replace("11", "3")),
        write("good.yaml", LINE.replace("11", "3").replace("speed: 10 mm/s", "fastest: true")),
    ]
    out = str(tmp_path / "out.csv")
    result = run(*files, "--out", out)
    assert result.exit_code == 2
    assert "bad.yaml:5: timing.speed: must be greater than 0" in result.stderr
    assert "3 paths: 1 solved, 1 unreachable, 1 bad input" in result.stdout
    assert "point 1 is out of reach" in result.stdout
    assert "first failure" in result.stdout
    assert run(files[1], "-q").exit_code == 3
    written = sorted(each.name for each in tmp_path.glob("*.csv"))
    assert written == ["out-far.csv", "out-good.csv"]


def test_what_the_solver_cannot_do(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write("line.yaml", LINE)

    def failing(robot: Any, path: Any, *, seed: int) -> PathSolution:
        empty = np.empty((0, 6))
        return PathSolution("failed", "no way", robot, empty[:, 0], empty, np.empty((0, 4, 4)))

    monkeypatch.setattr(sys.modules["stiffopt.paths.solver"], "solve_path", failing)
    result = run(file, "--plot", file.replace(".yaml", ".png"))
    assert result.exit_code == 4
    assert "failed" in result.stdout
    assert "there is nothing to draw" in result.stderr
    assert json.loads(run("--json", file).stdout)["times_s"] == []

    def unstable(*_: Any, **__: Any) -> PathSolution:
        raise EquilibriumError("the arm buckles")

    monkeypatch.setattr(sys.modules["stiffopt.paths.solver"], "solve_path", unstable)
    result = run(file)
    assert result.exit_code == 4
    assert "the arm buckles" in result.stdout


def test_margins_to_the_rates() -> None:
    solution = PathSolution(
        "solved", "", stiffopt.load_robot("stiff-flop-1"), np.array([0.0, 1.0, 2.0]),
        np.array([[0, 0, 0], [1e5, 0, 0], [1e5, 3e4, 0]]), np.tile(np.eye(4), (3, 1, 1)),
        slew=np.array([1e5, 1e5, 1e5]),
    )  # fmt: skip
    assert rate_margins(solution) == pytest.approx([1.0, 0.0, 0.7])


def test_the_figure_shows_arm_stiffness_clearance_and_pressures(
    tmp_path: Path, write: Write
) -> None:
    file = write("line.yaml", LINE + SCENE)
    picture = tmp_path / "answer.png"
    assert run(file, "-q", "--plot", str(picture)).exit_code == 0
    height, width = imread(picture).shape[:2]
    assert 600 < height < 2000
    assert 1000 < width < 3000
    path = stiffopt.load_path(file)
    solution = followed(path)
    figure = plots.plot_path(path, solution)
    figure.canvas.draw()
    found = figure.findobj(lambda artist: hasattr(artist, "get_text"))
    text = "\n".join(artist.get_text() for artist in found)
    for part in (
        "line", "solved", "11 points in 2 s", "worst stiffness", "(98% of that alone)", "post",
        "each point alone", "on the path", "least stiff", "required", "segment 2\n(bar)", "start",
        "channel 3", "time (s)", "stiffness\n(N/m)", "clearance\n(mm)", "path that is asked for",
    ):  # fmt: skip
        assert part in text
    with pytest.raises(InputError, match="there is nothing to draw"):
        plots.plot_path(path, PathSolution("failed", "", solution.robot, *[np.empty(0)] * 3))


@pytest.mark.parametrize(("begin", "end"), [(1, 8), (4, 5), (0, 11)])
def test_where_an_object_holds_the_tip_the_stiffness_is_shaded(
    begin: int, end: int, write: Write
) -> None:
    path = stiffopt.load_path(write("line.yaml", LINE))
    solution = followed(path)
    assert solution.stiffness is not None
    values = np.full(len(solution.times), np.inf)
    values[begin:end] = solution.stiffness[begin:end]
    held = replace(solution, stiffness=values)
    axes = Figure().add_subplot()
    plots.draw_stiffness_along(axes, held)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert ("without limit: an object holds the tip" in labels) == (end - begin < 11)
    shaded = [patch.get_extents() for patch in axes.patches]
    across = axes.transData.transform([(t, 1.0) for t in solution.times])[:, 0]
    for x, value in zip(across, values, strict=True):
        assert any(each.x0 <= x <= each.x1 for each in shaded) == np.isinf(value)


@pytest.mark.parametrize("file", sorted(PROBLEMS.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_problems_are_listed_and_in_reach(file: Path) -> None:
    assert f"`{file.stem}`" in (ROOT / "problems" / "README.md").read_text(encoding="utf-8")
    path = description.load_path(file)
    robot = stiffopt.load_robot(path.resolve_robot())
    path.end_pressures(robot.description)
    path.check_scene(robot.description)
    points = path.points()
    task = path.task(points.targets[0], points.goals[0])
    if path.scene is None:
        assert stiffopt.PressureSolver(robot, task).reachable()
