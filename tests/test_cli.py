"""The commands: what they print, write and return."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import stiffopt
from stiffopt.cli import batch, exits, solve_run
from stiffopt.cli import main as entry
from stiffopt.cli.console import plain_data
from stiffopt.cli.solve_files import find_tasks
from stiffopt.cli.solve_records import json_record
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.documents import read_document
from stiffopt.errors import EquilibriumError, FileError
from stiffopt.model.calibration import Calibration, FittedParameter
from stiffopt.model.history import History, Play
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.optimise.general_search import GeneralSearch
from stiffopt.optimise.solution import PressureSolution
from stiffopt.units import parse_quantity

ONE = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-20 mm, 5 mm, free], tolerance: {position: 0.5 mm}}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""
TWO = """\
format: stiffopt-task/1
robot: stiff-flop-2
target: {position: [-30 mm, 10 mm, 190 mm]}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""
FAR = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-80 mm, 10 mm, 110 mm]}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""
KEYS = {
    *("task", "status", "pressures_pa", "tip_position_m", "tip_quaternion_wxyz"),
    *("position_error_m", "angle_error_rad", "stiffness", "stiffness_unit", "compliance"),
    *("active_bounds", "solve_time_s", "message"),
}

Write = Callable[..., str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(name: str, text: str) -> str:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


def run(*arguments: str) -> Any:
    """Run `solve-pressure` in this process."""
    return CliRunner().invoke(entry.solve_pressure_app, list(arguments))


def process(*arguments: str, command: str = "solve-pressure", **options: Any) -> Any:
    """Run an installed command as a process of its own."""
    script = Path(sys.executable).with_name(command)
    return subprocess.run(
        [str(script), *arguments], capture_output=True, text=True, check=False, **options
    )


def lines(text: str) -> list[dict[str, Any]]:
    """Read JSON lines strictly."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


# -- answers --------------------------------------------------------------------------------------


def test_table_says_all_that_matters(write: Write) -> None:
    result = run(write("two.yaml", TWO))
    assert result.exit_code == 0
    assert result.stderr == ""
    text = result.stdout
    for part in ("solved", "stiff-flop-2", "segment 2", "1.192 bar", "0.000 bar min", "N/m"):
        assert part in text
    assert "0.100 mm in position, tolerance 0.1 mm" in text
    assert "1.445 N/m  (plain: 1.308, +10 %)\n" in text
    assert "against translation along (1, 0, 0), base axes, free" in text
    assert "N/m per mm of position tolerance" in text
    assert "descents agree" in text


def test_table_says_what_a_limit_is_worth(write: Write) -> None:
    text = run(write("two.yaml", TWO + "pressure: {max: 1 bar}\n")).stdout
    assert re.search(r"N/m per bar by which segment 2 channel \d max is raised", text)


def test_no_vacuum_is_offered(write: Write) -> None:
    both = TWO.replace("{direction: [1, 0, 0]}", "[{direction: [1, 0, 0]}, {direction: [0, 1, 0]}]")
    task = stiffopt.load_task(write("task.yaml", both))
    sensitivities = stiffopt.solve_pressure(stiffopt.load_robot("stiff-flop-2"), task).sensitivities
    assert sensitivities is not None
    lowest = {name: price for name, price in sensitivities.per_bound.items() if "min" in name}
    assert max(lowest.values()) > 0
    assert "lowered" not in run(write("vented.yaml", both)).stdout
    above = run(write("above.yaml", both + "pressure: {min: 0.05 bar}\n")).stdout
    assert "min is lowered" in " ".join(above.split())


def test_table_says_why_a_gain_is_small(write: Write) -> None:
    exact = ONE.replace("-20 mm, 5 mm, free", "-18 mm, -3 mm, 92 mm").replace("0.5", "0.1")
    text = run(write("exact.yaml", exact)).stdout
    assert "gain       below 1 %: no freedom is left, the pose fixes all channels\n" in text
    turning = TWO.replace("[1, 0, 0]", "[0, 1, 0], kind: rotation")
    text = run(write("turning.yaml", turning)).stdout
    assert "gain       below 1 %: the plain pressures are all but the stiffest" in text
    assert "gain " not in run(write("two.yaml", TWO)).stdout


@pytest.fixture
def wide_terminal() -> Iterator[int]:
    """A terminal of 200 columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 200, 0, 0))
    yield theirs
    os.close(ours)
    os.close(theirs)


def test_table_fits_80_columns_and_has_no_colour_codes_in_a_file(
    write: Write, wide_terminal: int
) -> None:
    files = write("one.yaml", ONE), write("far.yaml", FAR)
    done = process(*files, "--pareto", "3", stdin=wide_terminal)
    assert done.returncode == 3
    assert "\x1b" not in done.stdout + done.stderr
    shown = [line for line in done.stdout.splitlines() if ".yaml" not in line]
    assert max(map(len, shown)) <= 80
    assert not any(line != line.rstrip() for line in done.stdout.splitlines())


def test_json_has_the_keys_of_the_design(write: Write) -> None:
    path = write("two.yaml", TWO)
    result = run("--json", path)
    assert result.exit_code == 0
    (record,) = lines(result.stdout)
    assert set(record) >= KEYS
    assert record["task"] == path
    assert record["status"] == "solved"
    assert record["found"] is True
    assert len(record["pressures_pa"]) == 6
    assert record["angle_error_rad"] is None
    assert record["stiffness_unit"] == "N/m"
    assert [len(row) for row in record["compliance"]] == [6] * 6
    robot = stiffopt.load_robot("stiff-flop-2")
    pose = robot.tip_pose(record["pressures_pa"])
    assert record["tip_position_m"] == pytest.approx(pose[:3, 3].tolist(), abs=1e-12)
    stiffness = robot.stiffness(record["pressures_pa"], [1, 0, 0])
    assert record["stiffness"] == pytest.approx(stiffness, rel=1e-9)
    assert record["stiffnesses_plain"][0] < stiffness
    assert "per_bound_per_pa" in record["sensitivities"]


def test_without_stiffness_the_least_pressure(write: Write) -> None:
    result = run("--json", write("one.yaml", ONE[: ONE.index("stiffness")]))
    (record,) = lines(result.stdout)
    assert result.exit_code == 0
    assert record["stiffness"] is None
    assert record["stiffness_unit"] is None
    assert "N/m" not in run(write("one.yaml", ONE[: ONE.index("stiffness")])).stdout


def test_all_kinds_of_stiffness_are_told_apart(write: Write) -> None:
    goals = """\
stiffness:
  match: {value: 6 N/m, direction: [0, 1, 0], tolerance: 90 %}
  at_least: {value: 0.001 N*m/rad, direction: [0, 0, 1], kind: rotation, boundary: clamped}
"""
    text = run(write("one.yaml", ONE[: ONE.index("stiffness")] + goals)).stdout
    assert "(required: 6.000 to 90 %, plain: " in text
    assert "against rotation about (0, 0, 1), base axes, clamped" in text
    assert "N m/rad  (required: at least 0.001000, plain: " in text


def test_a_matrix_to_match(write: Write) -> None:
    goal = """\
stiffness: {match: {matrix: [[10, 0, 0], [0, 10, 0], [0, 0, 500]], unit: N/m, tolerance: 0.99}}
"""
    path = write("one.yaml", ONE[: ONE.index("stiffness")] + goal)
    assert "from the matrix to match, tolerance 0.99" in " ".join(run(path).stdout.split())
    (record,) = lines(run("--json", path).stdout)
    assert record["matrix_distance"] > 0


def calibrated(tmp_path: Path, *, recorded: float) -> str:
    """Write a calibrated robot that was recorded up to a pressure in Pa, and return a task."""
    keys = ("segments[0].material.youngs_modulus", "segments[0].compensation.stiffness")
    robot = load_description("stiff-flop-1")
    segment = robot.segments[0].model_copy(
        update={"history": History(play=[Play(width=1e4, share=0.1)])}
    )
    calibration = Calibration(
        logs=["day.csv"],
        parameters=[FittedParameter(key=key, deviation=0.05, prior=0.3) for key in keys],
        correlation=[[1, 0], [0, 1]],
        position_residual=3e-4,
        pressure_min=[0, 0, 0],
        pressure_max=[recorded] * 3,
        pressure_norm=[2 * recorded],
    )
    update = {"segments": (segment,), "calibration": calibration, "name": "mine"}
    save_robot(tmp_path / "mine.yaml", robot.model_copy(update=update))
    goal = ONE.replace("stiff-flop-1", "mine.yaml")
    goal = goal.replace("0]}}", "0]}, at_least: {direction: [0, 1, 0], value: 0.1 N/m}}")
    (tmp_path / "calibrated.yaml").write_text(goal)
    return str(tmp_path / "calibrated.yaml")


def test_a_calibrated_robot_says_how_well_it_is_known(tmp_path: Path) -> None:
    path = calibrated(tmp_path, recorded=1.5e5)
    result = run("--json", path)
    (record,) = lines(result.stdout)
    assert result.exit_code == 0
    p = record["pressures_pa"]
    known = stiffopt.load_robot(tmp_path / "mine.yaml").tip_uncertainty(p)
    assert record["tip_uncertainty_m"] == pytest.approx(known.semi_axes.tolist())
    assert record["inside_recorded_range"] is True
    low, high = record["stiffness_interval"]
    assert (low, high) == pytest.approx(known.stiffness_interval((1, 0, 0)))
    assert low < record["stiffness"] < high
    text = run(path).stdout
    axes = " x ".join(f"{value * 1e3:.2f}" for value in known.semi_axes)
    assert f"known to   {axes} mm, semi-axes of the tip's 95 % ellipsoid\n" in text
    assert "mostly for the errors of the calibrated parameters\n" in text
    assert f"(95 %: {low:.4g}" in text
    assert "(required: at least 0.1000, 95 %: " in text
    assert "warning" not in text
    assert max(map(len, text.splitlines()[1:])) <= 80


def test_pressures_that_no_calibration_saw_are_told(tmp_path: Path) -> None:
    path = calibrated(tmp_path, recorded=0.4e5)
    (record,) = lines(run("--json", path).stdout)
    assert record["inside_recorded_range"] is False
    text = " ".join(run(path).stdout.split())
    assert "warning the calibration saw no such pressures: the model extrapolates" in text


def test_a_result_file_has_the_uncertainty(tmp_path: Path) -> None:
    path = calibrated(tmp_path, recorded=1.5e5)
    assert run(path, "--quiet", "--out", str(tmp_path / "out.yaml")).exit_code == 0
    (entry,) = read_document(tmp_path / "out.yaml").data["results"]
    (record,) = lines(run("--json", path).stdout)
    axes = [parse_quantity(text, "m") for text in entry["uncertainty"]["tip_semi_axes"]]
    assert axes == pytest.approx(record["tip_uncertainty_m"])
    assert entry["uncertainty"]["inside_recorded_range"] is True
    interval = [parse_quantity(text, "N/m") for text in entry["stiffness"][0]["interval"]]
    assert interval == pytest.approx(record["stiffness_interval"])


def test_without_a_stiffness_there_is_no_interval(tmp_path: Path) -> None:
    path = Path(calibrated(tmp_path, recorded=1.5e5))
    path.write_text(path.read_text()[: path.read_text().index("stiffness")])
    (record,) = lines(run("--json", str(path)).stdout)
    assert record["stiffness_interval"] is None
    assert len(record["tip_uncertainty_m"]) == 3


def test_nothing_is_told_of_a_robot_that_was_not_calibrated(write: Write) -> None:
    path = write("one.yaml", ONE)
    (record,) = lines(run("--json", path).stdout)
    for key in ("tip_uncertainty_m", "stiffness_interval", "inside_recorded_range"):
        assert record[key] is None
    text = run(path).stdout
    assert not [word for word in ("known to", "95 %", "warning") if word in text]


def test_a_key_that_cannot_be_calibrated_is_bad_input(tmp_path: Path) -> None:
    path = calibrated(tmp_path, recorded=1.5e5)
    robot = tmp_path / "mine.yaml"
    text = robot.read_text()
    robot.write_text(
        text.replace("key: segments[0].compensation.stiffness", "key: segments[0].connector")
    )
    result = run(path)
    assert result.exit_code == 2
    assert "'segments[0].connector' cannot be a parameter" in " ".join(result.stderr.split())


def test_unreachable_is_3_and_reports_the_closest(write: Write) -> None:
    path = write("far.yaml", FAR)
    result = run(path)
    assert result.exit_code == 3
    assert "the closest configuration is 33.83 mm away" in result.stdout
    assert "segment 1 channel 1 max" in " ".join(result.stdout.split())
    assert "more than the tolerance" in result.stdout
    (record,) = lines(run("--json", path).stdout)
    assert record["status"] == "unreachable"
    assert record["pressures_pa"] is not None
    assert "per_bound_per_pa" not in record["sensitivities"]  # no price in stiffness there


def test_solver_failure_is_4(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    def falls_over(self: Any, *args: Any) -> None:
        raise EquilibriumError("the arm falls over")

    monkeypatch.setattr(GeneralSearch, "_solve", falls_over)
    result = run(write("one.yaml", ONE))
    assert result.exit_code == 4
    assert "the arm falls over" in result.stdout
    result = run("--json", write("one.yaml", ONE))
    (record,) = lines(result.stdout)
    assert result.exit_code == 4
    assert set(record) >= KEYS
    assert record["pressures_pa"] is None
    assert record["message"] == "the arm falls over"


def test_a_bug_is_one_sentence_and_leaves_the_other_files_solved(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = stiffopt.PressureSolver.solve

    def stumble(self: Any, *args: Any, **options: Any) -> Any:
        if "broken" in str(self.task.source):
            raise ZeroDivisionError("oops")
        return solve(self, *args, **options)

    monkeypatch.setattr(stiffopt.PressureSolver, "solve", stumble)
    result = run(write("broken.yaml", ONE), write("one.yaml", ONE))
    assert result.exit_code == 4
    assert "ZeroDivisionError in stumble" in result.stderr
    assert "Traceback" not in result.output
    assert "1 solved, 1 failed" in result.stdout


def test_nothing_that_is_not_finite_comes_out() -> None:
    task = stiffopt.Task(robot="stiff-flop-1", target={"position": (0, 0, 0.09)})
    solution = PressureSolution("failed", "", task, stiffness=float("nan"))
    answer = SolvedTask("a.yaml", stiffopt.load_robot("stiff-flop-1"), solution, (float("inf"),))
    (record,) = lines(json.dumps(plain_data(json_record(answer)), allow_nan=False))
    assert record["stiffness"] is None
    assert record["stiffnesses_plain"] == [None]


def test_the_same_seed_gives_the_same_answer(write: Write) -> None:
    path = write("two.yaml", TWO)
    first, second = (
        lines(run("--json", "--seed", "7", path).stdout)[0]["pressures_pa"] for _ in range(2)
    )
    assert first == second


def test_quiet_prints_nothing_but_errors(write: Write) -> None:
    result = run("--quiet", write("one.yaml", ONE), "missing.yaml")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr == "error: missing.yaml: there is no such file\n"


# -- trade-off ------------------------------------------------------------------------------------


def test_pareto(write: Write) -> None:
    path = write("two.yaml", TWO)
    result = run("--pareto", "4", path)
    assert result.exit_code == 0
    assert "trade-off" in result.stdout
    assert "45.00 mm" in result.stdout
    (record,) = lines(run("--pareto", "4", "--json", path).stdout)
    front = record["pareto"]
    assert {"position_error_m", "angle_error_rad", "stiffness", "pressures_pa"} == set(front[0])
    stiffnesses = [point["stiffness"] for point in front]
    assert stiffnesses == sorted(stiffnesses)
    assert len(front) > 1


def test_pareto_needs_something_to_maximise(write: Write) -> None:
    path = write("one.yaml", ONE[: ONE.index("stiffness")])
    result = run("--pareto", "3", path)
    assert result.exit_code == 2
    assert "needs a stiffness to maximise" in result.stderr
    assert "pressures" in result.stdout  # the answer itself is still given


def test_pareto_needs_two_points(write: Write) -> None:
    result = run("--pareto", "1", write("one.yaml", ONE))
    assert result.exit_code == 2
    assert "--pareto" in result.stderr


# -- several files, folders -----------------------------------------------------------------------


def test_a_bad_file_in_the_middle_does_not_stop_the_others(write: Write) -> None:
    first, last = write("a.yaml", ONE), write("c.yaml", FAR)
    bad = write("b.yaml", ONE.replace("20 mm", "20"))
    result = run(first, bad, last)
    assert result.exit_code == 2
    assert f"{bad}:3: target.position[0]" in result.stderr
    assert "3 tasks: 1 solved, 1 unreachable, 1 bad input" in result.stdout
    records = lines(run("--json", first, bad, last).stdout)
    assert [record["task"] for record in records] == [first, last]


@pytest.mark.parametrize(
    ("codes", "expected"),
    [([], 0), ([0, 0], 0), ([0, 3], 3), ([3, 4, 0], 4), ([3, 4, 2, 0], 2), ([4, 3], 4)],
)
def test_the_most_serious_code_wins(codes: list[int], expected: int) -> None:
    assert exits.most_serious(codes) == expected


def test_a_folder_is_its_task_files_by_name(tmp_path: Path, write: Write) -> None:
    write("b.yaml", FAR)
    write("a.yaml", ONE)
    write("arm.yaml", "format: stiffopt-robot/1\n")
    write("note.txt", "no task")
    write(".hidden.yaml", ONE)
    (tmp_path / "golden").mkdir()
    (tmp_path / "golden" / "c.yaml").write_text("format: stiffopt-result/1\n")
    result = run("--json", str(tmp_path))
    assert result.exit_code == 3
    names = [Path(record["task"]).name for record in lines(result.stdout)]
    assert names == ["a.yaml", "b.yaml"]
    assert "arm.yaml: skipped, a robot file" in result.stderr


def test_a_broken_file_in_a_folder_is_not_skipped(tmp_path: Path, write: Write) -> None:
    write("a.yaml", "format: [")
    write("b.yaml", "robot: stiff-flop-1\n")
    assert len(find_tasks([str(tmp_path)]).paths) == 2
    result = run(str(tmp_path))
    assert result.exit_code == 2
    assert "has no 'format'" in result.stderr


def test_a_folder_without_tasks(tmp_path: Path) -> None:
    result = run(str(tmp_path))
    assert result.exit_code == 2
    assert "has no task files" in result.stderr


# -- bad input ------------------------------------------------------------------------------------

TARGET = "target: {position: [-20 mm, 5 mm, free]}\n"
HEAD = "format: stiffopt-task/1\nrobot: stiff-flop-1\n"
MAXIMISE = "stiffness: {maximise: {direction: [1, 0, 0]}}\n"

BAD = {
    "broken YAML": (HEAD + "target: {position: [1 mm\n", "is not valid YAML"),
    "empty": ("", "is empty"),
    "not a mapping": ("- a\n", "expected a mapping"),
    "binary": ("\x00\x01", "is not valid YAML"),
    "duplicate key": (HEAD + TARGET + TARGET, "duplicate key, first given on line 3"),
    "unknown key": (HEAD + TARGET + "stifness: {}\n", "did you mean 'stiffness'?"),
    "unknown nested key": (
        HEAD + TARGET + MAXIMISE.replace("direction", "directon"),
        "did you mean 'direction'?",
    ),
    "bare number": (HEAD + TARGET.replace("20 mm", "20"), "has no unit"),
    "wrong dimension": (HEAD + TARGET.replace("20 mm", "20 bar"), "not a unit of length"),
    "NaN": (HEAD + TARGET.replace("-20 mm", ".nan"), "not a finite number"),
    "NaN in text": (HEAD + TARGET.replace("-20 mm", "nan mm"), "expected a length"),
    "infinite": (HEAD + TARGET + MAXIMISE.replace("[1,", "[.inf,"), "not a finite number"),
    "zero direction": (HEAD + TARGET + MAXIMISE.replace("[1,", "[0,"), "is zero"),
    "quaternion": (HEAD + "target: {orientation: [1, 1, 0, 0]}\n", "has norm 1.414"),
    "too many values": (HEAD + TARGET.replace("free]", "free, 1 mm]"), "expected 3 items, not 4"),
    "no such robot": (
        (HEAD + TARGET).replace("flop-1", "flop-7"),
        "The built-in robots are asu-two-segment, stiff-flop-1",
    ),
    "no robot file": (
        (HEAD + TARGET).replace("stiff-flop-1", "[arm].yaml").replace("[arm]", "'[arm]'"),
        "is not valid YAML",
    ),
    "no such robot file": (
        (HEAD + TARGET).replace("stiff-flop-1", "arms/mine.yaml"),
        "there is no file",
    ),
    "other number of channels": (
        HEAD + TARGET + "pressure: {max: [1 bar, 1 bar]}\n",
        "has 2 values; expected one value or a list of 3",
    ),
    "limits that leave nothing": (
        HEAD + TARGET + "pressure: {min: 1.2 bar, max: 1 bar}\n",
        "leaves segment 1 channel 1 no pressure",
    ),
    "other kind of file": (
        "format: stiffopt-robot/1\n",
        "this is a robot file, expected a task file",
    ),
    "other version": ("format: stiffopt-task/9\n" + HEAD[24:] + TARGET, "version 9"),
    "huge": ("# " + "x" * 1_100_000 + "\n" + HEAD + TARGET, "is larger than 1 MB"),
    "deep": ("a: " + "[" * 5000, "nested"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_readable_message(case: str, write: Write) -> None:
    text, expected = BAD[case]
    path = write("[bold]task[red].yaml", text)
    result = run(path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert expected in result.stderr
    assert result.stderr.startswith(f"error: {path}")  # brackets and all
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr


def test_a_robot_file_that_breaks_the_strain_law_names_the_task(write: Write) -> None:
    arm = stiffopt.model.robot_files.files("stiffopt").joinpath("robots", "stiff-flop-1.yaml")
    write("arm.yaml", arm.read_text().replace("max: 1.5 bar", "max: 9 bar"))
    path = write("task.yaml", ONE.replace("stiff-flop-1", "arm.yaml"))
    result = run(path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {path}: segment 1 of robot")


def test_missing_file_and_unreadable_names(tmp_path: Path) -> None:
    for name in ("missing.yaml", "no/such/folder.yaml", "\x00.yaml", "line\nbreak.yaml"):
        result = run(str(tmp_path / name))
        assert result.exit_code == 2
        assert result.stderr.startswith("error: ")
        assert "Traceback" not in result.output


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_without_permission(write: Write) -> None:
    path = write("secret.yaml", ONE)
    Path(path).chmod(0)
    assert run(path).exit_code == 2


def test_a_quaternion_that_is_nearly_one_is_normalised(write: Write) -> None:
    text = HEAD + "target: {orientation: [1.0004, 0, 0, 0], tolerance: {angle: 5 deg}}\n"
    assert run("-q", write("task.yaml", text)).exit_code == 0


# -- result file ----------------------------------------------------------------------------------


def test_out_is_read_back(tmp_path: Path, write: Write) -> None:
    out = tmp_path / "out.yaml"
    result = run(
        write("a.yaml", TWO), write("b.yaml", FAR), "--out", str(out), "--pareto", "2", "--json"
    )
    assert result.exit_code == 3
    data = read_document(out).data
    assert data["format"] == "stiffopt-result/1"
    solved, far = data["results"]
    printed = lines(result.stdout)[0]
    pressures = [parse_quantity(text, "Pa") for text in solved["pressures"]]
    assert pressures == printed["pressures_pa"]
    position = [parse_quantity(text, "m") for text in solved["tip"]["position"]]
    assert position == printed["tip_position_m"]
    stiffness = solved["stiffness"][0]
    assert parse_quantity(stiffness["value"], "N/m") == printed["stiffness"]
    assert parse_quantity(stiffness["plain"], "N/m") == printed["stiffnesses_plain"][0]
    assert parse_quantity(solved["worth"]["position_tolerance"], "N/m/m") > 0
    compliance = solved["compliance"]
    assert compliance["rotation_per_moment"]["unit"] == "rad/(N*m)"
    assert compliance["translation_per_force"]["matrix"][0] == printed["compliance"][0][:3]
    assert len(solved["pareto"]) == 2
    assert far["status"] == "unreachable"
    assert "worth" not in far


def test_out_overwrites_a_result_file_only(tmp_path: Path, write: Write) -> None:
    task, other = write("a.yaml", ONE), write("other.yaml", FAR)
    out = str(tmp_path / "out.yaml")
    assert run("-q", task, "--out", out).exit_code == 0
    assert run("-q", task, "--out", out).exit_code == 0
    for precious in (other, task):
        before = Path(precious).read_text()
        result = run(task, "--out", precious)
        assert result.exit_code == 2
        assert result.stdout == ""  # told before the work
        assert Path(precious).read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.yaml", "other.yaml", "out.yaml"]


@pytest.mark.parametrize(
    ("option", "name", "expected"),
    [
        ("--out", "no/folder/out.yaml", "there is no folder"),
        ("--out", "out.txt", "ends in .yaml"),
        ("--out", ".", "is a folder"),
        ("--plot", "no/folder/out.png", "there is no folder"),
        ("--plot", "out.yaml", "ends in .png"),
        ("--plot", "out.jpeg2", "ends in .png"),
    ],
)
def test_where_nothing_can_be_written(
    option: str, name: str, expected: str, tmp_path: Path, write: Write
) -> None:
    result = run(write("a.yaml", ONE), option, str(tmp_path / name))
    assert result.exit_code == 2
    assert expected in result.stderr
    assert result.stdout == ""


def test_out_to_a_device(write: Write) -> None:
    assert run("-q", write("a.yaml", ONE), "--out", "/dev/null").exit_code == 0


# -- pictures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["20 deg", "120 deg, 0 deg", "1 mm, 2 mm"])
def test_no_view(view: str, write: Write) -> None:
    result = run(write("a.yaml", ONE), "--view", view)
    assert result.exit_code == 2
    assert result.stderr.startswith("error: --view: ")
    assert result.stdout == ""


def test_plot_of_one_and_of_several(tmp_path: Path, write: Write) -> None:
    (tmp_path / "sub").mkdir()
    one, far = write("one.yaml", ONE), write("far.yaml", FAR)
    view = ("--view", "10 deg, -0.5 rad")
    assert run("-q", one, "--plot", str(tmp_path / "p.png"), *view).exit_code == 0
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    again = write("sub/one.yaml", ONE)
    assert run("-q", one, far, again, "--plot", str(tmp_path / "q.png")).exit_code == 3
    for name in ("q-one.png", "q-far.png", "q-one-2.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_plot_of_a_failure_is_no_second_failure(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    def falls_over(self: Any, *args: Any) -> None:
        raise EquilibriumError("the arm falls over")

    monkeypatch.setattr(GeneralSearch, "_solve", falls_over)
    result = run(write("one.yaml", ONE), "--plot", str(tmp_path / "p.png"))
    assert result.exit_code == 4
    assert "no picture of" in result.stderr
    assert not (tmp_path / "p.png").exists()


def test_without_matplotlib_a_helpful_error(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = run(write("one.yaml", ONE), "--plot", str(tmp_path / "p.png"))
    assert result.exit_code == 2
    assert "pip install 'stiffopt[plot]'" in result.stderr
    assert result.stdout == ""


# -- the commands as processes --------------------------------------------------------------------


def test_no_file_is_2_and_the_usage() -> None:
    done = process()
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Usage: solve-pressure" in done.stderr


def test_unknown_option_is_2() -> None:
    done = process("--jason")
    assert done.returncode == 2
    assert "--json" in done.stderr


def test_help_shows_examples_and_exit_codes() -> None:
    text = process("--help").stdout
    assert text.count("\n    solve-pressure ") >= 5
    for option in (
        "--json",
        "--out",
        "--plot",
        "--view",
        "--pareto",
        "--seed",
        "--quiet",
        "--version",
    ):
        assert option in text
    assert "Exit codes" in text
    assert "  format: stiffopt-task/1" in text
    assert max(map(len, text.splitlines())) <= 80


def test_version() -> None:
    for command in ("stiffopt", "solve-pressure"):
        done = process("--version", command=command)
        assert done.stdout == f"stiffopt {stiffopt.__version__}\n"
        assert done.returncode == 0


def test_stiffopt_solve_is_solve_pressure(write: Write) -> None:
    path = write("one.yaml", ONE)
    both = [
        lines(process(*words, "--json", path, command=command).stdout)[0]
        for command, words in (("stiffopt", ["solve"]), ("solve-pressure", []))
    ]
    for record in both:
        record.pop("solve_time_s")
    assert both[0] == both[1]


def test_robots_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["robots"]) == 0
    text = capsys.readouterr().out
    for name in stiffopt.builtin_robots():
        assert name in text
    assert "270 mm" in text


def test_entry_points_return_the_code(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.solve_pressure_main(["-q", write("one.yaml", ONE)]) == 0
    assert entry.main(["solve", "-q", write("far.yaml", FAR)]) == 3
    assert entry.main([]) == 2
    assert "Usage: stiffopt" in capsys.readouterr().err


def test_json_and_help_load_no_matplotlib_and_no_scipy(write: Write) -> None:
    script = (
        "import sys\n"
        "from stiffopt.cli.main import solve_pressure_main\n"
        "code = solve_pressure_main(sys.argv[1:])\n"
        "found = {'matplotlib', 'scipy.optimize', 'scipy.sparse'} & set(sys.modules)\n"
        "sys.exit(f'loads {found}' if found else code)\n"
    )
    for arguments in (["--help"], ["--json", write("one.yaml", ONE)]):
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_a_reader_that_leaves_is_no_error(tmp_path: Path, write: Write) -> None:
    script = Path(sys.executable).with_name("solve-pressure")
    paths = [write("a.yaml", ONE), write("b.yaml", ONE)]
    out = tmp_path / "out.yaml"
    for extra in ([], ["--out", str(out)]):
        with subprocess.Popen(
            [script, *paths, *extra], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            child.stdout.close()
            assert child.stderr is not None
            assert child.stderr.read() == ""
            assert child.wait() == exits.CLOSED_PIPE
    assert len(read_document(out).data["results"]) == 2  # the files are written all the same


def test_no_error_is_written_into_the_progress_bar(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []  # what the bar says now
    errors = []

    class Bar(batch.ProgressBar):
        def report(self, done: float, total: float | None, text: str) -> None:
            shown[:] = [text]

        def hide(self) -> None:
            shown.clear()

    def report_error(message: str) -> None:
        assert not shown
        errors.append(message)

    def fail(*_: object) -> None:
        assert "drawing" in shown[0]
        raise FileError("one.png", "cannot be written")

    monkeypatch.setattr(batch, "ProgressBar", Bar)
    monkeypatch.setattr(batch, "report_error", report_error)
    monkeypatch.setattr(solve_run.solve_files, "draw", fail)
    paths = [write("bad.yaml", "format: stiffopt-task/1"), write("one.yaml", ONE)]
    assert entry.main(["solve", *paths, "--plot", str(tmp_path / "x.png")]) == exits.BAD_INPUT
    assert len(errors) == 2


def test_ctrl_c_is_130(write: Write) -> None:
    script = Path(sys.executable).with_name("solve-pressure")
    paths = [write("a.yaml", ONE)] + [write(f"b{k}.yaml", TWO) for k in range(60)]
    with subprocess.Popen(
        [script, "--json", *paths],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # as in a terminal
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()  # it is at work
        time.sleep(0.1)
        child.send_signal(signal.SIGINT)
        _, error = child.communicate(timeout=30)
    assert child.returncode == exits.INTERRUPTED
    assert error == "interrupted\n"


def test_a_terminal_without_unicode(write: Write) -> None:
    path = write("größe.yaml", ONE)
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = process(path, path, env=environment)
    assert done.returncode == 0
    assert "gr\\xf6\\xdfe.yaml" in done.stdout
