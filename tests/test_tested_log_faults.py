"""What is wrong with a log on which a model is tested: found where it is clear, else left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lagging_arm import arm, calibrated, driven, log_of, turned
from made_logs import course, made_log
from stiffopt.identify.settings import CalibrationSettings, Finding
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.identify.validation import validate
from stiffopt.logs import Log
from stiffopt.model.calibration import Calibration, ErrorModel
from stiffopt.model.description import RobotDescription

Array = NDArray[np.float64]

AWAY = np.array([0.3, -0.1, 0.2])


def test_a_frame_that_was_defined_anew_is_found_when_a_model_is_validated() -> None:
    robot, log = calibrated(arm()), log_of()
    rotation = CUBE_ROTATIONS[9]
    (found,) = validate(robot, [turned(log, rotation)])
    assert found.errors.mean < 1e-3
    assert "defined anew" in found.remarks[-1]
    assert "turned by" in found.remarks[-1]
    (kept,) = validate(robot, [turned(log, rotation)], CalibrationSettings(keep=("axes",)))
    assert kept.errors.mean > 0.05
    anywhere = replace(log, tip_position=turned(log, rotation).tip_position + AWAY)
    (found,) = validate(robot, [anywhere])
    assert found.errors.mean < 1e-3
    assert "moved by" in found.remarks[-1]


def held(rest: int, rise: int = 1, rows: int = 300) -> Log:
    """The log of an arm that is at rest for some rows, rises, then holds one pose."""
    share = np.clip((np.arange(rows) - rest + 1) / rise, 0, 1)
    pressures = share[:, np.newaxis] * [1e5, 0.5e5, 0.0]
    return driven(pressures, np.linspace(0.0, 0.2 * rows, rows))


@pytest.mark.parametrize("log", [log_of(), held(rest=1), held(rest=30), held(rest=1, rise=200)])
def test_a_model_that_is_wrong_is_not_excused_by_its_frame(log: Log) -> None:
    stiff = calibrated(arm())
    material = stiff.segments[0].material.model_copy(update={"youngs_modulus": 400e3})
    segment = stiff.segments[0].model_copy(update={"material": material})
    (found,) = validate(stiff.model_copy(update={"segments": (segment,)}), [log])
    assert found.errors.mean > 9e-3
    assert "whether the log is of the arm of this calibration" in found.remarks[-1]
    assert not any("defined anew" in remark for remark in found.remarks)


def test_exchanged_channels_in_one_rise_are_not_a_frame_that_was_moved() -> None:
    log = held(rest=1, rise=200)
    wrong = replace(log, commanded=np.roll(log.commanded, 1, axis=1))
    (found,) = validate(calibrated(arm()), [wrong])
    assert found.errors.mean < 1e-3
    assert "--keep channels" in found.remarks[-1]
    assert not any("defined anew" in remark for remark in found.remarks)


def test_other_channels_whose_pressures_the_arm_does_not_bear_are_not_suspected() -> None:
    """Two channels at 4 bar, as on a shared line, would soften this arm to nothing."""
    share = np.minimum(np.arange(300) / 200, 1)[:, np.newaxis]
    log = driven(share * [4e5, 0.0, 0.0], np.linspace(0.0, 60.0, 300))
    stiff = calibrated(arm())
    wrong = replace(log, tip_position=log.tip_position * [-1.0, -1.0, 1.0])
    (found,) = validate(stiff, [wrong])
    assert found.errors.mean > 0.1 * stiff.length
    assert "look at whether" in found.remarks[-1]


def judged(robot: RobotDescription) -> RobotDescription:
    """A calibrated robot that knows how far it is off: by half a millimetre."""
    errors = ErrorModel(
        residual=5e-4,
        discrepancy=300.0,
        reach=2e4,
        gain=0.0,
        degrees_of_freedom=6.0,
        moving=(2e3,) * 3,
        settled=(2e3,) * 3,
        recorded=tuple(map(tuple, log_of().commanded[::10].tolist())),
        spacing=1e4,
    )
    return robot.model_copy(update={"calibration": Calibration(errors=errors)})


def turn_about_z(angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def test_a_frame_turned_about_the_tip_at_rest_is_found_by_poses_in_many_directions() -> None:
    log = log_of()
    noise = np.random.default_rng(0).normal(scale=6e-4, size=log.tip_position.shape)
    moved = turned(log, turn_about_z(np.radians(25))).tip_position + noise
    moved[:, 0] += 2e-3
    (found,) = validate(judged(arm()), [replace(log, tip_position=moved)])
    assert "defined anew: its poses are turned by 25 deg about" in found.remarks[-1]
    assert "moved by" in found.remarks[-1]


def test_a_log_outside_its_regions_has_a_remark() -> None:
    robot, log = judged(arm()), log_of()
    (found,) = validate(robot, [turned(log, turn_about_z(np.radians(8)))])
    assert 3e-3 < found.errors.mean < 0.1 * robot.length
    assert "of the tips lie within the regions of 99 %; look at" in found.remarks[-1]
    (right,) = validate(robot, [log])
    assert not right.remarks


def test_a_dead_line_that_moves_the_tip_a_little_is_found_outside_the_regions() -> None:
    robot, pressures = judged(arm()), log_of().commanded * [1.0, 1.0, 0.12]
    log = driven(pressures, log_of().time)
    real = driven(pressures * [1.0, 1.0, 0.0], log.time)
    (found,) = validate(robot, [replace(log, tip_position=real.tip_position)])
    assert "the line of segment 1 channel 3 is dead" in found.remarks[-1]
    assert found.errors.mean < 1e-3
    before = np.linalg.norm(log.tip_position - real.tip_position, axis=1).mean()
    assert 1e-3 < before < 0.1 * robot.length
    (right,) = validate(robot, [log])
    assert not right.remarks


def test_one_pose_that_moves_a_little_shows_no_moved_frame() -> None:
    stiff = calibrated(arm())
    material = stiff.segments[0].material.model_copy(update={"youngs_modulus": 400e3})
    segment = stiff.segments[0].model_copy(update={"material": material})
    pressures = log_of().commanded * 0.1 + [9e4, 3e4, 1e4]
    log = driven(pressures, log_of().time)
    (found,) = validate(stiff.model_copy(update={"segments": (segment,)}), [log])
    assert found.errors.mean > 0.1 * stiff.length
    assert not any("defined anew" in remark for remark in found.remarks)


def test_a_sensor_that_sits_elsewhere_is_no_moved_frame() -> None:
    sensor = np.eye(4)
    sensor[0, 3] = 0.02
    log = log_of()
    aside = made_log(arm(), log.time, log.commanded, sensor=sensor, turns=True)
    (found,) = validate(calibrated(arm()), [aside])
    assert found.errors.mean > 0.01
    assert not any("defined anew" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("sources", "words", "kind"),
    [
        ([1, 0, 2], "channel 1 has the column of segment 1 channel 2", "channels"),
        ([0, 1, 0], "channel 3 has the pressure of segment 1 channel 1, as if", "lines"),
    ],
)
def test_wrong_channels_are_found_when_a_model_is_validated(
    sources: list[int], words: str, kind: Finding
) -> None:
    robot, log = calibrated(arm()), log_of()
    driven_by = np.argsort(sources) if kind == "channels" else sources
    moved = driven(log.commanded[:, driven_by], log.time)
    wrong = replace(log, tip_position=moved.tip_position)
    (found,) = validate(robot, [wrong])
    assert words in found.remarks[-1]
    assert found.errors.mean < 1e-3
    (kept,) = validate(robot, [wrong], CalibrationSettings(keep=(kind,)))
    assert words not in " ".join(kept.remarks)


@pytest.mark.parametrize(
    ("sources", "words"),
    [
        ([0, -1, 2, 3, 4, 3], ["segment 1 channel 2 is dead", "segment 2 channel 3 has the press"]),
        ([1, 2, 0, 3, 5, 4], ["channel 1 has the column of segment 1 channel 2", "segment 2 chan"]),
    ],
)
def test_two_wrong_lines_or_orders_are_found_when_a_model_is_validated(
    sources: list[int], words: list[str]
) -> None:
    robot, log = calibrated(arm("stiff-flop-2")), log_of("stiff-flop-2", 6)
    every = np.column_stack([log.commanded, np.zeros(len(log.time))])
    if -1 in sources:
        tip = driven(every[:, sources], log.time, "stiff-flop-2").tip_position
        wrong = replace(log, tip_position=tip)
    else:
        wrong = replace(log, commanded=log.commanded[:, np.argsort(sources)])
    (found,) = validate(robot, [wrong])
    assert all(each in found.remarks[-1] for each in words)
    assert found.errors.mean < 1e-3


def test_an_order_that_shows_in_less_than_half_of_a_log_is_found_with_another_one() -> None:
    time, pressures = course(6, 60.0, 6, rate=5.0, hold=6.0)
    pressures[:, 3:] *= (time > 0.6 * time[-1])[:, np.newaxis]  # the second segment moves late
    log = driven(pressures, time, "stiff-flop-2")
    wrong = replace(log, commanded=log.commanded[:, np.argsort([1, 2, 0, 3, 5, 4])])
    (found,) = validate(calibrated(arm("stiff-flop-2")), [wrong])
    assert "segment 1 channel 1 has the column of segment 1 channel 2" in found.remarks[-1]
    assert "segment 2 channel 2 has the column of segment 2 channel 3" in found.remarks[-1]
    assert found.errors.mean < 1e-3
