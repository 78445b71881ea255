"""What `solve-pressure` prints: tables, JSON, trade-offs, exit codes."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import stiffopt
from cli_tasks import FAR, ONE, TWO, Write, lines, process, run
from cli_tasks import write_fixture as write_fixture
from stiffopt.cli.console import plain_data
from stiffopt.cli.solve_records import json_record
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.documents import read_document
from stiffopt.errors import EquilibriumError
from stiffopt.model.calibration import Calibration, FittedParameter
from stiffopt.model.history import History, Play
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.optimise.general_search import GeneralSearch
from stiffopt.optimise.solution import PressureSolution
from stiffopt.units import parse_quantity

KEYS = {
    *("task", "status", "pressures_pa", "tip_position_m", "tip_quaternion_wxyz"),
    *("position_error_m", "angle_error_rad", "stiffness", "stiffness_unit", "compliance"),
    *("active_bounds", "solve_time_s", "message"),
}


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
