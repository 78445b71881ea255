"""`stiffopt workspace`: table, JSON, plot, bad input, and a run that is interrupted."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stiffopt.cli.main import main
from stiffopt.model.manipulator import Manipulator
from stiffopt.workspace import open_workspace_map
from workspace_maps import _blocks, robot_fixture  # noqa: F401

COMMAND = Path(sys.executable).with_name("stiffopt")


def command(*arguments: object) -> int:
    return main(["map", "workspace", *map(str, arguments)])


def test_json(tmp_path: Path, capsys: pytest.CaptureFixture[str], robot: Manipulator) -> None:
    path = tmp_path / "map.zarr"
    options = ["stiff-flop-1", "--samples", 500, "--cell", "5 mm", "--direction", "0,3,-4",
               "--direction", "z", "--out", path, "--json"]  # fmt: skip
    assert command(*options) == 0
    said = json.loads(capsys.readouterr().out)
    found = open_workspace_map(path)
    assert said["file"] == str(path)
    assert said["samples"] == said["samples_evaluated"] == 500
    assert said["cells"] == len(found.table)
    assert said["reach_volume_m3"] == found.volume
    assert said["stiffness_unit"] == "N/m"
    tilted = said["stiffnesses"][0]
    assert tilted["direction"] == [0, 0.6, -0.8]
    again = robot.stiffness(tilted["best"]["pressures_pa"], [0, 3, -4])
    assert again == pytest.approx(tilted["best"]["stiffness"], rel=1e-9)
    assert command(*options) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["samples_evaluated"] == 0
    assert "is complete" in printed.err


def test_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "map.png"
    assert command("stiff-flop-1", "--samples", 5000, "--plot", picture) == 0
    printed = capsys.readouterr()
    assert not printed.err
    for part in ("stiff-flop-1", "5,000", "cm^3", "stiffest", "softest", "samples a second"):
        assert part in printed.out
    assert max(map(len, printed.out.splitlines())) <= 80
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_quiet_hanging_and_rotation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "map.svg"
    arguments = ["stiff-flop-2-hanging", "--samples", 20, "--direction", "x", "--plot", picture]
    assert command(*arguments, "--kind", "rotation", "--frame", "tip", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert "<svg" in picture.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["no-such-robot"], "there is no robot 'no-such-robot'"),
        (["stiff-flop-1", "--cell", "5"], "--cell: '5' has no unit"),
        (["stiff-flop-1", "--cell", "5 bar"], "--cell: "),
        (["stiff-flop-1", "--direction", "up"], "--direction: 'up' is no direction"),
        (["stiff-flop-1", "--direction", "nan,0,0"], "direction must be 3 finite numbers"),
        (["stiff-flop-1", "--boundary", "loose"], "unknown boundary 'loose'"),
        (["stiff-flop-1", "--samples", "0"], "--samples"),
        (["stiff-flop-1", "--samples", "10", "--levels", "3"], "not both"),
        (["stiff-flop-1", "--timeout", "5"], "--timeout: '5' has no unit"),
        (["stiff-flop-1", "--timeout", "0 s"], "timeout must be"),
        (["stiff-flop-1", "--plot", "map.txt"], "expected a name that ends in .png"),
        (["stiff-flop-1", "--out", "no/such/map.zarr"], "there is no folder"),
    ],
    ids=lambda value: " ".join(value[1:]) if isinstance(value, list) else "",
)
def test_bad_input(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*arguments) == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert message in " ".join(printed.err.split())
    assert not list(tmp_path.iterdir())


def test_out_of_time_stops_and_the_same_command_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "map.zarr"
    options = ("stiff-flop-1", "--samples", 3000, "--out", path)
    assert command(*options, "--timeout", "1 us") == 130
    printed = capsys.readouterr()
    assert not printed.out
    said = " ".join(printed.err.split())
    assert "out of time; stopped after 0 of 3,000 samples; the same command goes on" in said
    assert command(*options, "--timeout", "1 h", "--quiet") == 0
    assert open_workspace_map(path).table.count.sum() == 3000


def interrupted(path: Path, wait_for: str = "") -> str:
    """Start a long map, press Ctrl-C once it has said something, and return what is on stderr."""
    said = path.with_suffix(".txt")
    with said.open("w") as stream:
        process = subprocess.Popen(
            [
                COMMAND, "map", "workspace", "stiff-flop-2-hanging",
                "--samples", "100000", "--out", path,
            ],
            stdout=subprocess.PIPE, stderr=stream, text=True,
        )  # fmt: skip
        try:
            end = time.monotonic() + 60
            while time.monotonic() < end:
                if path.exists() and wait_for in " ".join(said.read_text().split()):
                    break
                time.sleep(0.01)
            time.sleep(1.0 if not wait_for else 0.2)  # for some samples
            os.kill(process.pid, signal.SIGINT)
            out, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130, said.read_text()
    assert not out
    return " ".join(said.read_text().split())


def test_ctrl_c_stops_and_the_same_command_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    said = interrupted(path)
    stopped = re.search(r"stopped after ([\d,]+) of 100,000 samples; the same command", said)
    assert stopped, said
    assert said.endswith(f"goes on with {path} interrupted")
    going_on = stopped[1] != "0"
    said = interrupted(path, "continues after" if going_on else "")
    if going_on:
        assert f"continues after {stopped[1]} of 100,000 samples" in said
