"""Logs whose frame or tracked body was defined anew are found by what the other logs show."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from made_logs import course, made_log
from recordings import UCL
from stiffopt.errors import FileError
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.correction import put_right
from stiffopt.identify.settings import CalibrationSettings, Finding
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.validation import validate
from stiffopt.logs import Body, Log, read_log
from stiffopt.model.calibration import Calibration
from stiffopt.model.description import Recordings, RobotDescription, TrackedBody
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]
Change = Callable[[Log], Log]

TURN = Rotation.from_rotvec(np.radians(37) * np.array([2.0, 1.0, -2.0]) / 3)
SHIFT = np.array([0.01, -0.015, 0.01])  # m
FAST = {
    "structure": "static", "strain_law": "keep", "rows": 90, "trial_rows": 60, "start_rows": 40,
    "holds_back": False,
}  # fmt: skip
ROBOTS = {"stiff-flop-1": 3, "stiff-flop-2": 6}


@cache
def log_of(name: str = "stiff-flop-1", seed: int = 0, turns: bool = True) -> Log:
    time, pressures = course(ROBOTS[name], 60.0, seed, rate=5.0)
    return made_log(load_description(name), time, pressures, seed=seed, turns=turns)


def rotations(log: Log) -> Rotation:
    return Rotation.from_quat(log.tip_quaternion, scalar_first=True)


def in_frame(turn: Rotation, shift: Array = SHIFT) -> Change:
    """The frame is another one."""

    def changed(log: Log) -> Log:
        quaternion = log.tip_quaternion
        if quaternion is not None:
            quaternion = (turn * rotations(log)).as_quat(scalar_first=True)
        return replace(
            log, tip_position=turn.apply(log.tip_position) + shift, tip_quaternion=quaternion
        )

    return changed


def of_body(log: Log) -> Log:
    """The tip's body has other axes and another origin."""
    body = rotations(log)
    return replace(
        log,
        tip_position=log.tip_position + body.apply(SHIFT),
        tip_quaternion=(body * TURN).as_quat(scalar_first=True),
    )


def of_pressures(factor: float) -> Change:
    """An arm that is softer or stiffer."""
    return lambda log: replace(log, commanded=factor * log.commanded)


def reordered(log: Log) -> Log:
    """Each channel of the first segment has the column of another one."""
    others = range(3, log.commanded.shape[1])
    return replace(log, commanded=log.commanded[:, [1, 2, 0, *others]])


def calibrated(robot: RobotDescription) -> RobotDescription:
    return robot.model_copy(update={"calibration": Calibration(logs=("before.csv",))})


def with_one(logs: list[Log], which: int, change: Change) -> list[Log]:
    return [change(log) if k == which else log for k, log in enumerate(logs)]


def told(robot: RobotDescription, logs: list[Log], keep: tuple[Finding, ...] = ()) -> list[str]:
    """What is told of the set-up before a fit."""
    settings = CalibrationSettings(keep=keep)
    setup = Setup.of(robot, recordings_of(robot, list(logs), settings), (), settings)
    return list(put_right(setup).found)


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize(("name", "which"), [("stiff-flop-1", 0), ("stiff-flop-2", 2)])
def test_a_frame_that_was_defined_anew_is_found(name: str, which: int, turns: bool) -> None:
    robot = load_description(name)
    logs = [log_of(name, seed, turns) for seed in range(3)]
    assert told(robot, logs) == []
    wrong = with_one(logs, which, in_frame(TURN))
    (remark,) = told(robot, wrong)
    assert remark.startswith(f"the frame of log {which + 1} was defined anew")
    assert "deg about (-0.6" in remark  # it is turned back
    assert told(robot, wrong, keep=("axes",)) == []


def test_a_body_that_was_defined_anew_is_found() -> None:
    robot = load_description("stiff-flop-1")
    wrong = with_one([log_of(seed=seed) for seed in range(3)], 1, of_body)
    (remark,) = told(robot, wrong)
    assert remark.startswith("the body 'tip' was defined anew in log 2")
    assert "its orientation by" in remark


def test_a_further_body_that_was_defined_anew_is_told_with_its_own_errors() -> None:
    robot = load_description("stiff-flop-1")
    middle = robot.length / 2
    robot = robot.model_copy(
        update={"recordings": Recordings(bodies={"mid": TrackedBody(at=middle)})}
    )
    logs = []
    for seed in range(3):
        time, pressures = course(3, 60.0, seed, rate=5.0)
        made = made_log(robot, time, pressures, seed=seed, turns=True, bodies=(("mid", middle),))
        if seed == 1:
            body = made.bodies["mid"]
            alone = of_body(Log(time, pressures, body.position, body.quaternion))
            anew = Body(alone.tip_position, alone.tip_quaternion)
            made = replace(made, bodies={"mid": anew})
        logs.append(made)
    (remark,) = told(robot, logs)
    assert remark.startswith("the body 'mid' was defined anew in log 2")
    far = re.search(r"misses 'mid' by ([\d.]+) mm instead of ([\d.]+) mm, its", remark)
    assert far
    assert float(far[1]) < 3
    assert 15 < float(far[2]) < 25


def test_a_frame_that_was_defined_anew_for_a_whole_day_is_found() -> None:
    logs = [log_of(seed=seed) for seed in range(5)]
    wrong = with_one(with_one(logs, 3, in_frame(TURN)), 4, in_frame(TURN))
    (remark,) = told(load_description("stiff-flop-1"), wrong)
    assert remark.startswith("the frame of log 4, log 5 was defined anew")


def test_a_frame_and_a_body_that_differ_in_other_logs_are_both_found() -> None:
    robot = load_description("stiff-flop-1")
    logs = [log_of(seed=seed) for seed in range(5)]
    wrong = with_one(with_one(logs, 1, in_frame(TURN)), 4, of_body)
    frame, body = told(robot, wrong)
    assert frame.startswith("the frame of log 2 was defined anew")
    assert "the body 'tip' was defined anew in log 5" in body
    frames = with_one(with_one(logs, 1, in_frame(TURN)), 3, in_frame(TURN.inv(), -SHIFT))
    both = " ".join(told(robot, frames))
    assert "the frame of log 2 was" in both
    assert "the frame of log 4 was" in both


def test_of_different_frames_none_is_told_where_no_logs_agree() -> None:
    logs = [log_of(seed=seed) for seed in range(3)]
    wrong = with_one(with_one(logs, 1, in_frame(TURN)), 2, in_frame(TURN.inv(), -SHIFT))
    assert told(load_description("stiff-flop-1"), wrong) == []


@pytest.mark.parametrize("degrees", [20.0, 52.0, 90.0])
def test_a_frame_and_a_body_that_differ_in_one_log_are_not_told_as_one(degrees: float) -> None:
    """Not even as a quarter turn; only that the log does not fit."""
    logs = [log_of(seed=seed) for seed in range(3)]
    turn = Rotation.from_rotvec([0.0, np.radians(degrees), 0.0])

    def both(log: Log) -> Log:
        return of_body(in_frame(turn)(log))

    (remark,) = told(load_description("stiff-flop-1"), with_one(logs, 1, both))
    assert remark.startswith("log 2 does not fit the other logs")
    of_two = told(load_description("stiff-flop-1"), [logs[0], both(logs[1])])
    assert all("does not fit the other logs" in each for each in of_two)


def test_a_frame_that_leaves_little_is_told_although_the_body_sits_a_little_elsewhere() -> None:
    log = log_of()
    along = rotations(log).apply([0.0, 0.0, 2e-3])
    aside = replace(log, tip_position=log.tip_position + along)
    (found,) = validate(calibrated(load_description("stiff-flop-1")), [in_frame(TURN)(aside)])
    assert found.remarks[-1].startswith("the frame of log 1 was defined anew")


def with_factors(factors: Array) -> list[Log]:
    """Three logs without orientations; the positions of the second one are times factors (3,)."""
    logs = [log_of(seed=seed, turns=False) for seed in range(3)]
    return with_one(logs, 1, lambda log: replace(log, tip_position=log.tip_position * factors))


def test_mirrored_positions_are_no_other_frame() -> None:
    robot = load_description("stiff-flop-1")
    wrong = with_factors(np.array([1.0, 1.0, -1.0]))
    words = "are mirrored: z has the other sign"
    (remark,) = told(robot, wrong)
    assert remark.startswith(f"the positions of log 2 {words}")
    (found,) = validate(calibrated(robot), wrong[1:2])
    assert found.remarks[-1].startswith(f"the positions of log 1 {words}")
    assert found.errors.mean < 3e-3


@pytest.mark.parametrize("turns", [True, False])
def test_positions_of_a_left_handed_frame_are_no_other_frame(turns: bool) -> None:
    """With orientations, ``M R M'``, nothing explains them; without, the mirror does."""
    robot = load_description("stiff-flop-1")
    mirror = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])

    def left_handed(log: Log) -> Log:
        found = replace(log, tip_position=log.tip_position @ mirror)
        if not turns:
            return found
        turned = Rotation.from_matrix(mirror @ rotations(log).as_matrix() @ mirror)
        return replace(found, tip_quaternion=turned.as_quat(scalar_first=True))

    wrong = with_one([log_of(seed=seed, turns=turns) for seed in range(3)], 1, left_handed)
    (remark,) = told(robot, wrong)
    if turns:
        assert remark.startswith("log 2 does not fit the other logs")
    else:
        assert remark.startswith(
            "the positions of log 2 are mirrored: (x, y, z) should be (z, y, x)"
        )


@pytest.mark.parametrize("scale", [0.6, 1.3])
def test_another_scale_of_positions_is_left_as_another_arm_would_look_the_same(
    scale: float,
) -> None:
    robot = load_description("stiff-flop-1")
    wrong = with_factors(np.full(3, scale))
    assert all("does not fit the other logs" in remark for remark in told(robot, wrong))
    (found,) = validate(calibrated(robot), wrong[1:2])
    assert "look at whether" in found.remarks[-1]


@pytest.mark.parametrize("rows", [0.0, 0.1])
def test_a_frame_is_found_where_most_orientations_are_missing(rows: float) -> None:
    log = in_frame(TURN)(log_of())
    quaternion = np.array(log.tip_quaternion)
    quaternion[round(rows * len(quaternion)) :] = np.nan
    robot = calibrated(load_description("stiff-flop-1"))
    (found,) = validate(robot, [replace(log, tip_quaternion=quaternion)])
    assert found.remarks[-1].startswith("the frame of log 1 was defined anew")
    assert found.errors.mean < 3e-3


def test_a_body_that_was_defined_anew_is_found_when_a_model_is_validated() -> None:
    robot = calibrated(load_description("stiff-flop-1"))
    (found,) = validate(robot, [of_body(log_of())])
    assert found.remarks[-1].startswith("the body 'tip' was defined anew in log 1")
    assert found.errors.mean < 3e-3
    (found,) = validate(robot, [in_frame(TURN)(log_of())])
    assert found.remarks[-1].startswith("the frame of log 1 was defined anew")
    assert "another arm" not in found.remarks[-1]  # which orientations rule out
    (found,) = validate(robot, [of_body(in_frame(TURN)(log_of()))])
    assert "look at whether" in found.remarks[-1]


def test_of_two_logs_the_one_that_the_robot_file_does_not_expect_is_moved() -> None:
    logs = [log_of(seed=seed) for seed in range(2)]
    (remark,) = told(load_description("stiff-flop-1"), with_one(logs, 0, in_frame(TURN)))
    assert remark.startswith("the frame of log 1 was defined anew")


def test_a_turn_that_is_no_quarter_turn_is_not_told_as_one() -> None:
    near = Rotation.from_rotvec([0, 0, np.radians(90)]) * Rotation.from_rotvec([0.3, 0, 0])
    logs = [log_of(seed=seed, turns=False) for seed in range(3)]
    (remark,) = told(load_description("stiff-flop-1"), with_one(logs, 1, in_frame(near)))
    assert "was defined anew" in remark
    quarter = in_frame(Rotation.from_rotvec([0, 0, np.radians(90)]), np.zeros(3))
    (remark,) = told(load_description("stiff-flop-1"), with_one(logs, 1, quarter))
    assert remark.startswith("the axes of the frame are turned")


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("change", [of_pressures(0.5), of_pressures(1.8), reordered])
def test_a_log_of_another_arm_is_not_excused_by_its_frame(change: Change, turns: bool) -> None:
    logs = [log_of(seed=seed, turns=turns) for seed in range(3)]
    wrong = with_one(logs, 1, change)
    found = told(load_description("stiff-flop-1"), wrong)
    assert not any("was defined anew" in each for each in found)


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_channels_in_another_order_in_one_log_are_told(name: str, turns: bool) -> None:
    robot = load_description(name)
    wrong = with_one([log_of(name, seed, turns) for seed in range(3)], 1, reordered)
    (remark,) = told(robot, wrong)
    assert remark.startswith("log 2 differs from the other logs, as if the channels are in another")
    assert "segment 1 channel 1 has the column of segment 1 channel 3" in remark
    assert "This is not corrected" in remark
    assert told(robot, wrong, keep=("axes",)) == [remark]
    assert not any("differs" in each for each in told(robot, wrong, keep=("channels",)))


def test_a_body_that_is_lost_in_a_log_is_told() -> None:
    robot = load_description("stiff-flop-1")
    bodies = Recordings(bodies={"mid": TrackedBody(at=robot.length / 2)})
    logs = [
        replace(each, bodies={"mid": Body(0.5 * each.tip_position)})
        for each in (log_of(seed=seed, turns=False) for seed in range(2))
    ]
    nowhere = Body(np.full_like(logs[1].tip_position, np.nan))
    logs[1] = replace(logs[1], bodies={"mid": nowhere})
    with pytest.raises(FileError, match=r"log 2: no row has readings of all .*tip, mid"):
        told(robot.model_copy(update={"recordings": bodies}), logs)


def test_the_fit_finds_the_rest_of_the_motion() -> None:
    # the arm that finds a motion is less exact than the model that is then fitted
    robot = load_description("stiff-flop-1")
    wrong = with_one([log_of(seed=seed) for seed in range(3)], 1, in_frame(TURN))
    result = calibrate(robot, wrong, settings=CalibrationSettings(**FAST))
    assert "was defined anew" in result.remarks[0]
    named = {each.name for each in result.estimates}
    assert "frame of log 2, about x" in named
    (found,) = validate(result.robot, [log_of(seed=7)])
    assert found.errors.mean < 1e-3


@pytest.mark.skipif(not UCL, reason="the recordings are not there")
def test_a_frame_of_a_real_arm_that_was_defined_anew_is_found() -> None:
    robot = load_description("ucl-stiff-flop")
    logs = [read_log(path) for path in UCL]
    assert told(robot, logs) == []
    (remark,) = told(robot, with_one(logs, 1, in_frame(TURN)))
    assert "was defined anew" in remark
