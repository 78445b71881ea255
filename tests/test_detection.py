"""Which channels, lines and axes of recordings are wrong: found if it is clear, else left alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from lagging_arm import AS_RECORDED, arm, calibrated, driven, log_of, turned
from made_logs import course, made_log
from recordings import ASU, UCL, recordings
from stiffopt.identify import correction
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.correction import put_right
from stiffopt.identify.detection import idle_channels, on_one_clock, without_drift
from stiffopt.identify.hypotheses import Comparer, Found, found_wrong, of_channels
from stiffopt.identify.recording import Recording
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.identify.validation import validate
from stiffopt.logs import Body, Log, read_log
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History
from stiffopt.model.robot_files import load_description
from stiffopt.model.segment import Corrections

Array = NDArray[np.float64]

FAST = {
    "structure": "static", "strain_law": "keep", "rows": 60, "trial_rows": 60, "start_rows": 40,
    "holds_back": False,
}  # fmt: skip
MODULES = recordings("ucl_stiff_flop_*55mm/*.csv")


def found_in(robot: RobotDescription, logs: list[Log]) -> Found | None:
    """What is wrong with all of these logs."""
    return of_recordings(robot, recordings_of(robot, list(logs), AS_RECORDED))


def corrected(robot: RobotDescription, logs: list[Log]) -> Setup:
    recordings = recordings_of(robot, list(logs), AS_RECORDED)
    return put_right(Setup.of(robot, recordings, (), AS_RECORDED))


def of_recordings(robot: RobotDescription, read: list[Recording]) -> Found | None:
    setup = Setup.of(robot, read, (), AS_RECORDED)
    stations = [robot.length if each.at is None else each.at for each in setup.points]
    return found_wrong(Comparer(robot, setup.base, stations, read), robot, ())


# -- channels, lines and axes ----------------------------------------------------------------------


def test_of_a_log_as_it_should_be_nothing_is_said() -> None:
    assert not found_in(load_description("stiff-flop-1"), [log_of()])
    assert not found_in(load_description("stiff-flop-2"), [log_of("stiff-flop-2", 6)])


def test_channels_that_were_exchanged_are_found_and_kept_in_the_file() -> None:
    robot, log = load_description("stiff-flop-1"), log_of()
    order = [2, 0, 1]  # column of the log that channel 1, 2, 3 has
    wrong = replace(log, commanded=log.commanded[:, np.argsort(order)])
    result = calibrate(robot, [wrong], settings=CalibrationSettings(**FAST))
    assert result.robot.recordings is not None
    assert result.robot.recordings.channels == tuple(k + 1 for k in order)
    assert "the channels are in another order" in result.remarks[0]
    assert "--keep channels" in result.remarks[0]
    assert not result.unfit
    (again,) = validate(result.robot, [wrong])
    assert again.errors.mean < 5e-3
    kept = calibrate(robot, [wrong], settings=CalibrationSettings(keep=("channels",), **FAST))
    assert kept.robot.recordings is None or not kept.robot.recordings.channels
    assert not any("another order" in remark for remark in kept.remarks)


def test_exchanged_segments_are_found() -> None:
    log = log_of("stiff-flop-2", 6)
    wrong = replace(log, commanded=np.roll(log.commanded, 3, axis=1))
    found = found_in(load_description("stiff-flop-2"), [wrong])
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.sources) == ("channels", (3, 4, 5, 0, 1, 2))


@pytest.mark.parametrize("order", [(1, 2, 0, 3, 4, 5), (0, 1, 2, 5, 3, 4)])
def test_a_cycle_of_channels_within_one_segment_is_found(order: tuple[int, ...]) -> None:
    log = log_of("stiff-flop-2", 6)
    wrong = replace(log, commanded=log.commanded[:, np.argsort(order)])
    found = found_in(load_description("stiff-flop-2"), [wrong])
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.sources) == ("channels", order)
    (again,) = validate(calibrated(arm("stiff-flop-2")), [wrong])
    assert "the channels are in another order" in again.remarks[-1]
    assert again.errors.mean < 2e-3


@pytest.mark.parametrize("order", [(1, 2, 0, 4, 3, 5), (0, 2, 1, 5, 3, 4)])
def test_an_order_in_each_of_two_segments_is_found(order: tuple[int, ...]) -> None:
    log = log_of("stiff-flop-2", 6)
    wrong = replace(log, commanded=log.commanded[:, np.argsort(order)])
    setup = corrected(load_description("stiff-flop-2"), [wrong])
    assert setup.description.recordings is not None
    assert setup.description.recordings.channels == tuple(k + 1 for k in order)


def test_two_wrong_lines_are_found_of_which_each_alone_leaves_much() -> None:
    time, pressures = course(6, 60.0, rate=5.0)
    real = pressures.copy()
    real[:, 3], real[:, 5] = 0.0, pressures[:, 2]
    wrong = replace(driven(real, time, "stiff-flop-2"), commanded=pressures)
    robot = load_description("stiff-flop-2")
    found = found_in(robot, [wrong])
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.sources) == ("lines", (0, 1, 2, -1, 4, 2))
    told = found.hypothesis.told(robot, ["a log"])
    assert "the line of segment 2 channel 1 is dead" in told
    assert ", and segment 2 channel 3 has" in told or ", and the line" in told


def test_a_pair_that_is_hardly_better_than_one_line_is_not_taken() -> None:
    """A circle of an arm whose channels differ: some pair of lines leaves 36 % of the misfit."""
    robot = load_description("stiff-flop-2")
    gains, lags = ((1.2, 1.4, 0.8), (1.0, 0.7, 0.9)), (0.4, 0.2)
    segments = [
        each.model_copy(update={"corrections": Corrections(gain=g), "history": History(lag=lag)})
        for each, g, lag in zip(robot.segments, gains, lags, strict=True)
    ]
    time = np.arange(0.0, 60.0, 0.2)
    angles = np.array([0.0, 2.09, 4.19, -0.9, 1.79, 3.39])
    pressures = 2.1e4 * (1 + np.cos(2 * np.pi * time[:, None] / 20 - angles))
    pressures *= np.minimum(1, time[:, None] / 5)
    right = robot.model_copy(update={"segments": tuple(segments)})
    assert not found_in(robot, [made_log(right, time, pressures)])


def test_after_a_correction_the_logs_are_looked_at_again() -> None:
    time, pressures = course(3, 60.0, rate=5.0)
    real = pressures * [1.0, 1.0, 0.0]
    wrong = turned(replace(driven(real, time), commanded=pressures), CUBE_ROTATIONS[9])
    axes, line = corrected(load_description("stiff-flop-1"), [wrong]).found
    assert "axes are turned" in axes
    assert line.startswith("with that corrected, the line of segment 1 channel 3 is dead")


def test_a_line_that_was_corrected_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its column is constant then, and does not show in the tip either."""
    idle = {1: "the second does nothing", 2: "the third does nothing"}
    monkeypatch.setattr(correction, "idle_channels", lambda *_: idle)
    time, pressures = course(3, 60.0, rate=5.0)
    wrong = replace(driven(pressures * [1.0, 1.0, 0.0], time), commanded=pressures)
    setup = corrected(load_description("stiff-flop-1"), [wrong])
    np.testing.assert_array_equal(setup.recordings[0].pressures[:, 2], 0.0)
    line, other = setup.found
    assert line.startswith("the line of segment 1 channel 3 is dead")
    assert other.startswith("the second does nothing")


def test_nothing_is_corrected_where_the_arm_bears_none_of_the_pressures() -> None:
    log = log_of()
    beyond = replace(log, commanded=log.commanded * 20)
    assert found_in(load_description("stiff-flop-1"), [beyond]) is None


def test_orders_of_many_channels_are_few() -> None:
    robot = load_description("stiff-flop-1")
    for count, orders in ((4, 23), (8, 28)):  # all; each two exchanged
        angles = tuple((2 * np.pi * np.arange(count) / count).tolist())
        chambers = robot.segments[0].chambers.model_copy(update={"angles": angles, "radius": 1e-3})
        channels = tuple((k + 1,) for k in range(count))
        changes = {"chambers": chambers, "channels": channels, "corrections": None}
        segment = robot.segments[0].model_copy(update=changes)
        wide = robot.model_copy(update={"segments": (segment,)})
        kinds = [each.kind for each in of_channels(wide, 1)]
        assert kinds.count("channels") == orders


def test_a_dead_line_near_the_tip_of_an_arm_under_its_weight_is_found() -> None:
    time, pressures = course(6, 60.0, highest=6e4, rate=1.0)
    real = pressures * [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    wrong = replace(driven(real, time, "stiff-flop-2-hanging"), commanded=pressures)
    found = found_in(load_description("stiff-flop-2-hanging"), [wrong])
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.sources) == ("lines", (0, 1, 2, 3, 4, -1))


@pytest.mark.parametrize(("source", "words"), [(-1, "is dead"), (2, "as if they shared a line")])
def test_a_line_that_does_not_do_what_was_commanded_is_found(source: int, words: str) -> None:
    time, pressures = course(3, 60.0, rate=5.0)
    real = pressures.copy()
    real[:, 1] = 0.0 if source < 0 else pressures[:, source]
    wrong = replace(driven(real, time), commanded=pressures)
    result = calibrate("stiff-flop-1", [wrong], settings=CalibrationSettings(**FAST))
    assert "segment 1 channel 2" in result.remarks[0]
    assert words in result.remarks[0]
    assert result.calibrated[0].errors.mean < 4e-3


@cache
def with_a_dead_line() -> Log:
    """A log in which channel 2 does nothing, of a sensor that sits elsewhere than the file says."""
    time, pressures = course(3, 120.0, rate=5.0)
    sensor = np.eye(4)
    sensor[:3, 3] = [0.1, 0.05, 0.0]
    log = made_log(arm(), time, pressures * [1.0, 0.0, 1.0], sensor=sensor)
    return replace(log, commanded=pressures)


def test_a_channel_that_does_nothing_is_told_where_no_model_fits() -> None:
    wrong = with_a_dead_line()
    assert not found_in(load_description("stiff-flop-1"), [wrong])
    result = calibrate("stiff-flop-1", [wrong], settings=CalibrationSettings(**FAST))
    told = "the pressure of segment 1 channel 2 does not show in the tip"
    (remark,) = (each for each in result.remarks if told in each)
    assert "% if the line of segment 1 channel 2 is dead" in remark
    (found,) = validate(calibrated(arm()), [wrong])
    assert any(told in remark for remark in found.remarks)
    keep = CalibrationSettings(keep=("lines",), **FAST)
    kept = calibrate("stiff-flop-1", [wrong], settings=keep)
    (also,) = validate(calibrated(arm()), [wrong], keep)
    assert not any(told in remark for remark in (*kept.remarks, *also.remarks))


def test_a_channel_that_follows_others_is_not_told_to_do_nothing() -> None:
    time, pressures = course(3, 120.0, rate=5.0)
    following = pressures.copy()
    following[:, 1] = pressures[:, [0, 2]].mean(axis=1)
    for real in (following, following * [1.0, 0.0, 1.0]):
        log = replace(driven(real, time), commanded=following)
        read = recordings_of(load_description("stiff-flop-1"), [log], AS_RECORDED)
        assert not idle_channels(load_description("stiff-flop-1"), read)


def test_channels_of_right_logs_do_something() -> None:
    for name, n in (("stiff-flop-1", 3), ("stiff-flop-2", 6)):
        robot = load_description(name)
        for log in (log_of(name, n, 60.0), log_of(name, n, 20.0, seed=1)):
            assert not idle_channels(robot, recordings_of(robot, [log], AS_RECORDED))


@pytest.mark.parametrize("turn", range(0, 24, 5))
def test_the_axes_of_the_tracker_are_found_for_each_log(turn: int) -> None:
    robot, rotation = load_description("stiff-flop-1"), CUBE_ROTATIONS[turn]
    logs = [log_of(seed=0), turned(log_of(seed=1), rotation)]
    found = found_in(robot, logs)
    if turn == 0:
        assert found is None
        return
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.turns) == ("axes", (0, turn))


def test_axes_that_all_logs_share_go_into_the_registration() -> None:
    rotation = CUBE_ROTATIONS[7]
    logs = [turned(log_of(seed=k), rotation) for k in (0, 1)]
    result = calibrate("stiff-flop-1", logs, settings=CalibrationSettings(**FAST))
    assert "the tracker's axes are turned in all logs" in result.remarks[0]
    other = turned(log_of(seed=2), rotation)
    (found,) = validate(result.robot, [other], CalibrationSettings(keep=("axes",)))
    assert found.errors.mean < 3e-3


# -- real arms -------------------------------------------------------------------------------------


@pytest.mark.skipif(not (UCL and ASU and MODULES), reason="the recordings are not there")
def test_recordings_of_real_arms_are_left_as_they_are() -> None:
    one = load_description("ucl-stiff-flop")
    for path in [*UCL, *MODULES]:
        log = read_log(path)
        if log.n != 3:
            continue
        (read,) = recordings_of(one, [log], AS_RECORDED)
        np.testing.assert_array_equal(read.pressures, np.nan_to_num(log.commanded))
        assert not of_recordings(one, [read])
        assert not idle_channels(one, [read])
        assert (without_drift(read) is read) == (path.name != "run_2022-10-20-ol-p2p.csv")
    robot = load_description("asu-two-segment")
    read = recordings_of(robot, list(ASU), AS_RECORDED)
    span = np.subtract(robot.pressure_max, robot.pressure_min)
    assert all(without_drift(on_one_clock(each, span)) is each for each in read)
    assert not of_recordings(robot, read)
    assert not idle_channels(robot, read)
    assert not any(idle_channels(robot, [each]) for each in read)


@pytest.mark.skipif(not ASU, reason="the recordings are not there")
def test_a_body_of_a_real_arm_that_was_defined_anew_is_found() -> None:
    robot = load_description("asu-two-segment")
    logs = [read_log(path) for path in ASU]
    turns = (0, 0, 0, 6, 0, 0, 0)  # the base body of one of seven logs
    wrong = [with_base_turned(log, turn) for log, turn in zip(logs, turns, strict=True)]
    found = found_in(robot, wrong)
    assert found is not None
    assert (found.hypothesis.kind, found.hypothesis.turns) == ("axes", turns)


def with_base_turned(log: Log, turn: int) -> Log:
    """A log whose body "base" has other axes."""
    from scipy.spatial.transform import Rotation

    body = log.bodies["base"]
    assert body.quaternion is not None
    known = np.isfinite(body.quaternion).all(axis=1)
    quaternion = body.quaternion.copy()
    other = Rotation.from_quat(quaternion[known], scalar_first=True)
    quaternion[known] = (other * Rotation.from_matrix(CUBE_ROTATIONS[turn])).as_quat(
        scalar_first=True
    )
    return replace(log, bodies={**log.bodies, "base": Body(body.position, quaternion)})
