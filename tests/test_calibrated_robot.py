"""The robot file of a calibrated arm: it survives writing, and mistakes in it are named."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import stiffopt
from stiffopt.errors import FileError, InputError
from stiffopt.model.calibration import Calibration
from stiffopt.model.description import Recordings, RobotDescription
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.registration import Placement, Registration

KEYS = (
    *("segments[0].length", "segments[0].material.youngs_modulus", "segments[1].length"),
    *("segments[1].corrections.gain[2]", "segments[1].corrections.azimuth[0]"),
)
DATA: dict[str, Any] = {
    "recordings": {
        "channels": [4, 5, 6, 1, 2, 3],
        "frame": "base",
        "registration": {"tracker_in_base": {"position": [0.0, 0.0012345678901234, -0.0372]}},
        "bodies": {"mid": {"at": 0.09}},
    },
    "calibration": {
        "logs": ["a.csv", "b.csv"],
        "parameters": [{"key": key, "deviation": 0.0123456, "prior": 0.1} for key in KEYS],
        "correlation": np.round(np.eye(5) * 0.7 + 0.3, 4).tolist(),
        "position_residual": 0.00040037876310107,
        "angle_residual": 0.0123,
        "pressure_min": [0.0] * 6,
        "pressure_max": [99549.0, 82996.0, 96362.0, 1e5, 1e5 / 3, 1e5],
        "pressure_norm": [136899.0092038653, 150000.0],
    },
}


def robot(data: dict[str, Any] = DATA) -> RobotDescription:
    plain = load_description("stiff-flop-2")
    values = {Parameter(key): Parameter(key).value(plain) * 1.01 for key in KEYS}
    changed = with_values(plain, values)
    return RobotDescription.model_validate({**changed.model_dump(), **data})


def changed(path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    """Return the data with another value at a place, written as a user of the file would."""
    data = copy.deepcopy(DATA)
    place: Any = data
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    return data


def test_a_calibrated_robot_survives_its_file(tmp_path: Path) -> None:
    arm = robot()
    save_robot(tmp_path / "arm.yaml", arm)
    again = load_description(tmp_path / "arm.yaml")
    assert again == arm
    assert again.calibration is not None
    assert arm.calibration is not None
    np.testing.assert_array_equal(again.calibration.covariance, arm.calibration.covariance)
    save_robot(tmp_path / "again.yaml", again)
    assert (tmp_path / "again.yaml").read_text() == (tmp_path / "arm.yaml").read_text()


MISTAKES: list[tuple[tuple[str | int, ...], Any, str]] = [
    (
        ("recordings", "channels"),
        [1, 2, 3],
        r"recordings\.channels: has 3 columns; expected 6, one for each channel of the robot",
    ),
    (
        ("recordings", "channels"),
        [1, 2, 3, 4, 5, 2],
        r"recordings\.channels\[5\]: column 2 appears twice; expected a different",
    ),
    (
        ("recordings", "bodies", "mid", "at"),
        0.3,
        r"recordings\.bodies\.mid\.at: 300 mm is beyond the tip; expected at most .* 181\.8 mm",
    ),
    (
        ("calibration", "parameters", 3, "key"),
        "segments[1].corrections.gain[3]",
        r"calibration\.parameters\[3\]\.key: 'segments\[1\]\.corrections\.gain\[3\]' is no number",
    ),
    (
        ("calibration", "parameters", 0, "key"),
        "segments[2].length",
        r"calibration\.parameters\[0\]\.key: 'segments\[2\]\.length' is no number",
    ),
    (
        ("calibration", "parameters", 0, "key"),
        "tip_mass",
        r"'tip_mass' is no number of a segment of this robot; expected a key such as 'segments",
    ),
    (
        ("calibration", "parameters", 4, "key"),
        KEYS[0],
        r"calibration\.parameters\[4\]\.key: 'segments\[0\]\.length' appears twice",
    ),
    (
        ("calibration", "pressure_min"),
        [0.0] * 5,
        r"calibration\.pressure_min: has 5 values; expected 6, one for each channel",
    ),
    (
        ("calibration", "pressure_max"),
        [1e5],
        r"calibration\.pressure_max: has 1 values; expected 6, one for each channel",
    ),
    (
        ("calibration", "pressure_norm"),
        [1e5] * 6,
        r"calibration\.pressure_norm: has 6 values; expected 2, one for each segment",
    ),
    (
        ("calibration", "correlation"),
        np.eye(4).tolist(),
        r"calibration\.correlation: expected 5 rows of 5 numbers",
    ),
]


@pytest.mark.parametrize(("path", "value", "message"), MISTAKES)
def test_a_mistake_in_a_calibrated_robot_is_named(
    tmp_path: Path, path: tuple[str | int, ...], value: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        RobotDescription(**{**dict(robot()), **changed(path, value)})
    file = tmp_path / "arm.yaml"
    save_robot(file, robot())
    document = yaml.safe_load(file.read_text())
    place = document
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = written(path[-1], value)
    file.write_text(yaml.safe_dump(document))
    with pytest.raises(FileError, match=message) as caught:
        load_description(file)
    lines = file.read_text().splitlines()
    assert caught.value.line is not None
    key = next(step for step in reversed(path) if isinstance(step, str))
    assert f"{key}:" in "".join(lines[max(caught.value.line - 7, 0) : caught.value.line])


def written(key: str | int, value: Any) -> Any:
    """Return a value as a file has it, with its unit."""
    if key == "at":
        return f"{value} m"
    return [f"{each} Pa" for each in value] if str(key).startswith("pressure") else value


@pytest.mark.parametrize("key", ["n_channels", "channels", "material", "channels[0][0]", "no"])
def test_what_is_no_number_of_the_file_is_no_parameter(key: str) -> None:
    with pytest.raises(InputError, match="is no number of a segment"):
        RobotDescription(
            **{
                **dict(robot()),
                **changed(("calibration", "parameters", 0, "key"), f"segments[0].{key}"),
            }
        )


def test_a_body_may_be_at_the_tip() -> None:
    arm = robot()
    at_tip = changed(("recordings", "bodies", "mid", "at"), arm.length)
    assert robot(at_tip).recordings is not None


def test_a_calibration_may_be_of_stiffness_alone_or_of_nothing() -> None:
    empty = robot({"calibration": Calibration(), "recordings": Recordings()})
    known = stiffopt.Manipulator(empty).tip_uncertainty([1e4] * 6)
    assert known.inside
    assert known.semi_axes.max() == 0


# One registration after another ------------------------------------------------------------------


def test_a_registration_and_its_correction_are_one_registration() -> None:
    first = Registration(
        tracker_in_base=Placement(position=(0.1, -0.2, 0.3), orientation=(0.5, -0.5, 0.5, 0.5)),
        tip_in_sensor=Placement(position=(0.0, 0.002, -0.005), orientation=(0.6, 0.0, 0.8, 0.0)),
    )
    second = Registration(
        tracker_in_base=Placement(position=(-0.01, 0.02, 0.0), orientation=(0.8, 0.6, 0.0, 0.0)),
        tip_in_sensor=Placement(position=(0.001, 0.0, 0.002), orientation=(0.0, 1.0, 0.0, 0.0)),
    )
    position, quaternion = np.array([0.02, 0.03, 0.25]), np.array([0.1, 0.7, -0.5, 0.5])
    quaternion /= np.linalg.norm(quaternion)
    found = first.then(second).tip_in_base(position, quaternion)
    expected = second.tip_in_base(*first.tip_in_base(position, quaternion))
    for value, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(value, wanted, atol=1e-12)
    alone, _ = first.then(second).tip_in_base(position, None)
    np.testing.assert_allclose(
        alone, second.tip_in_base(first.tip_in_base(position, None)[0], None)[0], atol=1e-12
    )


# Calibrate and validate by names and paths -------------------------------------------------------


@pytest.fixture
def log_files(tmp_path: Path) -> list[Path]:
    """Logs of an arm that is softer than stiff-flop-1, in two folders under the same name."""
    soft = with_values(
        load_description("stiff-flop-1"), {Parameter("segments[0].material.youngs_modulus"): 8e4}
    )
    arm = stiffopt.Manipulator(soft)
    found = []
    for day in (1, 2):
        rng = np.random.default_rng(day)
        time = np.arange(0, 60.0, 0.5)
        phases = np.outer(time, rng.uniform(0.2, 0.6, 3))
        pressures = 0.5e5 * (1 - np.cos(phases))
        pose = arm.tip_pose(pressures)
        path = tmp_path / f"day{day}" / "log.csv"
        path.parent.mkdir()
        stiffopt.logs.write_log(
            path, stiffopt.Log(time=time, commanded=pressures, tip_position=pose[:, :3, 3])
        )
        found.append(path)
    return found


def test_robots_and_logs_may_be_named(log_files: list[Path], tmp_path: Path) -> None:
    settings = stiffopt.CalibrationSettings(
        structure="static", strain_law="keep", rows=100, trial_rows=60
    )
    result = stiffopt.calibrate("stiff-flop-1", log_files, settings=settings)
    assert result.robot.segments[0].material.youngs_modulus == pytest.approx(8e4, rel=0.15)
    assert [each.name for each in result.calibrated] == [str(path) for path in log_files]
    stiffopt.save_robot(tmp_path / "mine.yaml", result.robot)
    day1, day2 = (stiffopt.read_log(path) for path in log_files)
    for source in (tmp_path / "mine.yaml", result.robot, stiffopt.load_robot(result.robot)):
        first, second = stiffopt.validate(source, [log_files[0], ("noon", day2)], settings)
        assert (first.name, second.name) == ("log.csv", "noon")
        assert max(first.errors.max, second.errors.max) < 0.5e-3
    (alone,) = stiffopt.validate("stiff-flop-1", [day1], settings)
    assert alone.name == "log 1"
    assert alone.errors.mean > 1e-3  # the arm that it is not


def test_names_of_logs_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="there is no such file"):
        stiffopt.validate("stiff-flop-1", [tmp_path / "none.csv"])
    with pytest.raises(InputError, match="there is no robot 'flop'"):
        stiffopt.calibrate("flop", [])
    with pytest.raises(InputError, match="expected a list of logs, not one path"):
        stiffopt.calibrate("stiff-flop-1", "log.csv")
