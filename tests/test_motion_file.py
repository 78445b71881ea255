"""Motions in files: that what `stiffopt path` writes is read back, and what is wrong is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt.cli.path_records import csv_text, solution_quantities
from stiffopt.documents import write_file
from stiffopt.errors import FileError
from stiffopt.paths.motion_file import RESULT_FORMAT, read_motion
from stiffopt.paths.solution import PathSolution

ARM = stiffopt.load_robot("stiff-flop-1")


@pytest.fixture
def solution() -> PathSolution:
    pressures = np.linspace([0.2e5, 0, 0], [1.1e5, 0.4e5, 0.1e5], 5)
    times = np.linspace(0, 2, 5)
    return PathSolution("solved", "", ARM, times, pressures, ARM.tip_pose(pressures))


def written(solution: PathSolution, file: Path) -> Path:
    if file.suffix == ".csv":
        file.write_text(csv_text(solution))
    else:
        results = [solution_quantities(solution)]
        write_file(str(file), {"format": RESULT_FORMAT, "results": results})
    return file


@pytest.mark.parametrize("name", ["motion.csv", "motion.yaml"])
def test_what_path_and_plan_write_is_read(
    name: str, solution: PathSolution, tmp_path: Path
) -> None:
    motion = read_motion(written(solution, tmp_path / name), ARM.description)
    np.testing.assert_allclose(motion.times, solution.times, rtol=1e-6)
    np.testing.assert_allclose(motion.pressures, solution.pressures, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(motion.tips, solution.tip_poses[:, :3, 3], atol=1e-8)
    ranges = ARM.pressure_max - ARM.pressure_min
    mine, own = motion.trajectory(ranges, 2.0), solution.trajectory(2.0)
    assert [each.time for each in mine.waypoints] == pytest.approx(
        [each.time for each in own.waypoints]
    )
    np.testing.assert_allclose(mine.pressures, own.pressures, rtol=1e-6, atol=1e-3)


def test_what_is_no_motion_is_refused(solution: PathSolution, tmp_path: Path) -> None:
    two = stiffopt.load_robot("stiff-flop-2").description
    table, result = (written(solution, tmp_path / f"m.{end}") for end in ("csv", "yaml"))

    def refused(file: Path, text: str | None = None, robot: object = ARM.description) -> str:
        if text is not None:
            file.write_text(text)
        with pytest.raises(FileError) as caught:
            read_motion(file, robot)
        return str(caught.value)

    assert "has 6 channels: there is no column p4_pa" in refused(table, robot=two)
    assert "is for the robot 'stiff-flop-1'" in refused(result, robot=two)
    assert "no such file" in refused(tmp_path / "none.csv")
    text = result.read_text()
    assert "is not solved" in refused(result, text.replace("solved", "unreachable", 1))
    assert "is not a motion" in refused(result, text.replace("path-result", "result"))
    assert "no whole result" in refused(result, text.replace("0.5 s", "soon"))
    lines = table.read_text().splitlines()
    log = "\n".join([lines[0].replace("position_error_m", "tip_qw"), *lines[1:]]) + "\n"
    assert "is not a motion; expected what 'stiffopt path" in refused(tmp_path / "log.csv", log)
    assert "too few points" in refused(table, "\n".join(lines[:2]) + "\n")
    backwards = "\n".join([lines[0], *lines[:0:-1]]) + "\n"
    assert "do not increase" in refused(table, backwards)
