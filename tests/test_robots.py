"""The robots that come with stiffopt: each loads, solves, and says what it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import stiffopt
from recordings import ASU, UCL, needs_asu, needs_ucl
from stiffopt.cli import main as entry
from stiffopt.model.robot_files import builtin_robots

PSI = 6894.757  # Pa


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", builtin_robots())
def test_solve_pressure_finds_back_where_pressures_have_the_tip(
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    robot = stiffopt.load_robot(name)
    if robot.is_loaded:
        request.getfixturevalue("compiled")
    assert robot.description.name == name
    some = np.random.default_rng(5).uniform(0.1, 0.6, robot.n_pressures)
    position = robot.tip_pose(some * robot.description.pressure_max)[:3, 3]
    task = {
        "format": "stiffopt-task/1",
        "robot": name,
        "target": {"position": [f"{1e3 * x:.6f} mm" for x in position]},
        "stiffness": {"maximise": {"direction": [1, 0, 0]}},
    }
    path = tmp_path / "task.yaml"
    path.write_text(yaml.safe_dump(task), encoding="utf-8")
    assert entry.solve_pressure_main(["--json", str(path)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "solved"
    p = np.array(answer["pressures_pa"])
    assert (p >= 0).all()
    assert (p <= np.array(robot.description.pressure_max) * (1 + 1e-9)).all()
    assert np.linalg.norm(robot.tip_pose(p)[:3, 3] - position) <= 1.001e-4
    assert robot.stiffness(p, [1, 0, 0]) == pytest.approx(answer["stiffness"], rel=1e-6)


def tips_in_base(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Commanded pressures (N, n) in a robot's order, and the tip (N, 3) where its file has it."""
    data = np.genfromtxt(path, delimiter=",", names=True)
    assert data.dtype.names is not None
    robot = stiffopt.load_robot(name).description
    given = robot.recordings

    def columns(*names: str) -> np.ndarray:
        return np.stack([data[each] for each in names], axis=1)

    numbers = (given and given.channels) or range(1, robot.n_pressures + 1)
    pressures = columns(*(f"p{k}_pa" for k in numbers))
    tip = columns("tip_x_m", "tip_y_m", "tip_z_m")
    if given and given.frame:
        turn = columns(*(f"{given.frame}_q{axis}" for axis in "xyzw"))
        origin = columns(*(f"{given.frame}_{axis}_m" for axis in "xyz"))
        tip = Rotation.from_quat(turn).inv().apply(tip - origin)
    if given:
        place = given.registration.tracker_in_base
        w, x, y, z = place.orientation
        tip = Rotation.from_quat([x, y, z, w]).apply(tip) + place.position
    return pressures, tip


@needs_ucl
def test_the_ucl_arm_is_where_its_recordings_begin() -> None:
    robot = stiffopt.load_robot("ucl-stiff-flop")
    for path in UCL:
        pressures, tip = tips_in_base(path, "ucl-stiff-flop")
        assert np.linalg.norm(robot.tip_pose(pressures[0])[:3, 3] - tip[0]) < 3e-3


@needs_asu
def test_the_asu_arm_hangs_where_it_was_recorded_and_bends_that_way() -> None:
    robot = stiffopt.load_robot("asu-two-segment")
    rest = robot.tip_pose(np.full(6, PSI))[:3, 3]
    for path in ASU:
        pressures, tip = tips_in_base(path, "asu-two-segment")
        if path == ASU[0]:  # before the first inflation
            assert abs(rest[2] - tip[0, 2]) < 6e-3
            assert np.linalg.norm(rest - tip[0]) < 20e-3  # the base body is tilted
        most = pressures[pressures.sum(axis=1).argmax()]
        held = np.flatnonzero((pressures == most).all(axis=1))[-1]
        moved, predicted = tip[held] - tip[0], robot.tip_pose(most)[:3, 3] - rest
        lengths = np.linalg.norm(moved), np.linalg.norm(predicted)
        assert moved @ predicted > 0.9 * np.prod(lengths)
        assert 0.5 < lengths[1] / lengths[0] < 1.5
