"""Files of `solve-pressure`: several tasks, bad input, results that are written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import stiffopt
from cli_tasks import (
    FAR,
    ONE,
    TWO,
    Write,
    lines,
    run,
    write_fixture,  # noqa: F401
)
from stiffopt.cli import exits
from stiffopt.cli.solve_files import find_tasks
from stiffopt.documents import read_document
from stiffopt.units import parse_quantity


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
