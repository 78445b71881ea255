"""What is wrong with how an arm was recorded: found where it is clear, else left alone."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from made_logs import course, made_log
from recordings import ASU, UCL, recordings
from stiffopt.errors import FileError
from stiffopt.identify import correction
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.correction import put_right
from stiffopt.identify.detection import idle_channels, on_one_clock, without_drift
from stiffopt.identify.hypotheses import Comparer, Found, found_wrong, of_channels
from stiffopt.identify.recording import Recording
from stiffopt.identify.settings import CalibrationSettings, Finding
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.identify.validation import validate
from stiffopt.logs import Body, Log, read_log
from stiffopt.model.calibration import Calibration, ErrorModel
from stiffopt.model.description import Corrections, RobotDescription
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

AS_RECORDED = CalibrationSettings()
AWAY = np.array([0.3, -0.1, 0.2])
FAST = {
    "structure": "static", "strain_law": "keep", "rows": 60, "trial_rows": 60, "start_rows": 40,
    "holds_back": False,
}  # fmt: skip
MODULES = recordings("ucl_stiff_flop_*55mm/*.csv")


def arm(name: str = "stiff-flop-1") -> RobotDescription:
    """An arm that lags a little."""
    robot = load_description(name)
    segments = [each.model_copy(update={"history": History(lag=0.2)}) for each in robot.segments]
    return robot.model_copy(update={"segments": tuple(segments)})


def calibrated(robot: RobotDescription) -> RobotDescription:
    return robot.model_copy(update={"calibration": Calibration(logs=("before.csv",))})


def driven(pressures: Array, time: Array, name: str = "stiff-flop-1") -> Log:
    return made_log(arm(name), time, pressures)


@cache
def log_of(name: str = "stiff-flop-1", n: int = 3, duration: float = 60.0, seed: int = 0) -> Log:
    time, pressures = course(n, duration, seed, rate=5.0)
    return driven(pressures, time, name)


def turned(log: Log, rotation: Array) -> Log:
    """The log of a tracker whose axes are turned."""
    return replace(log, tip_position=log.tip_position @ rotation)


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


# -- frames that were defined anew -----------------------------------------------------------------


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


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "factor"), [("kPa", 1e3), ("psi", 6894.757), ("bar", 1e5), ("MPa", 1e6)]
)
def test_pressures_in_other_units_are_found(unit: str, factor: float) -> None:
    log, robot = log_of(), load_description("stiff-flop-1")
    wrong = replace(log, commanded=log.commanded / factor)
    (read,) = recordings_of(robot, [wrong], AS_RECORDED)
    np.testing.assert_allclose(read.pressures, log.commanded, atol=1e-6)
    assert f"the pressures are in {unit}, not Pa" in read.remarks[0]
    with pytest.raises(FileError, match="expected Pa"):
        recordings_of(robot, [wrong], CalibrationSettings(keep=("units",)))


def test_other_units_are_found_of_an_arm_that_its_weight_straightens() -> None:
    time, pressures = course(6, 60.0, highest=6e4, rate=1.0)
    log = driven(pressures, time, "stiff-flop-2-hanging")
    robot = load_description("stiff-flop-2-hanging")
    (read,) = recordings_of(robot, [replace(log, commanded=pressures / 1e3)], AS_RECORDED)
    np.testing.assert_allclose(read.pressures, pressures, atol=1e-6)


def test_a_unit_that_is_not_clear_is_refused() -> None:
    log = log_of()
    wrong = replace(log, commanded=log.commanded / 2.5e3)  # between kPa and psi
    with pytest.raises(FileError, match="expected Pa"):
        recordings_of(load_description("stiff-flop-1"), [wrong], AS_RECORDED)


# -- clocks ----------------------------------------------------------------------------------------


def shifted(log: Log, by: float) -> Log:
    """The log of a tracker whose clock is late."""
    columns = [np.interp(log.time - by, log.time, column) for column in log.tip_position.T]
    return replace(log, tip_position=np.column_stack(columns))


@pytest.mark.parametrize("by", [-6.0, -1.5, 5.0])
def test_two_clocks_are_made_one(by: float) -> None:
    robot, log = load_description("stiff-flop-1"), log_of(duration=80.0)
    (read,) = recordings_of(robot, [shifted(log, by)], AS_RECORDED)
    assert "as if they had two clocks" in read.remarks[-1]
    late = np.column_stack([np.interp(log.time - by, log.time, c) for c in log.commanded.T])
    assert np.abs(read.pressures - late).mean() < 0.05 * log.commanded.max()
    (kept,) = recordings_of(robot, [shifted(log, by)], CalibrationSettings(keep=("clock",)))
    np.testing.assert_array_equal(kept.pressures, log.commanded)


@pytest.mark.parametrize(
    ("begins", "late"),
    [
        ([0, 20, 40, 60], []),
        ([0, 60, 20, 40], [2]),  # as a shell sorts 1, 10, 2, 3
        ([60, 0, 20, 40], [1]),
        ([0, 20, 0, 20], []),  # two days
        ([0, 0, 0, 0], []),
    ],
)
def test_logs_of_a_sequence_that_are_given_out_of_order_are_told(
    begins: list[float], late: list[int]
) -> None:
    log, robot = log_of(duration=15.0), arm()
    logs = [(str(begin), replace(log, time=log.time + begin)) for begin in begins]
    for settings, expected in ((CalibrationSettings(sequence=True), late), (AS_RECORDED, [])):
        found = recordings_of(robot, logs, settings)
        told = [
            i
            for i, each in enumerate(found)
            if "in the order of their times" in " ".join(each.remarks)
        ]
        assert told == expected
        assert all(f"before {found[i - 1].name} begins" in found[i].remarks[-1] for i in told)


@pytest.mark.skipif(not (UCL and MODULES), reason="the recordings are not there")
@pytest.mark.parametrize("by", [-12.0, -5.0])
def test_two_clocks_of_real_arms_are_made_one(by: float) -> None:
    one = load_description("ucl-stiff-flop")
    for log in map(read_log, [*UCL, *MODULES]):
        if log.n != 3:
            continue
        late = [np.interp(log.time + by, log.time, each) for each in log.commanded.T]
        (read,) = recordings_of(one, [replace(log, commanded=np.column_stack(late))], AS_RECORDED)
        said = re.search(r"the tip moves (.*) s (after|before) its pressures", read.remarks[-1])
        assert said
        assert float(said[1]) == pytest.approx(abs(by), abs=1.0)
        assert said[2] == "before"


def test_an_arm_that_lags_has_one_clock() -> None:
    robot, log = load_description("stiff-flop-1"), log_of(duration=80.0)
    for by in (0.0, 0.5, 1.0):
        (read,) = recordings_of(robot, [shifted(log, by)], AS_RECORDED)
        np.testing.assert_array_equal(read.pressures, log.commanded)


# -- the beginning ---------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [(9e4, 3e4, 0.0), (1.2e4, 0.0, 0.0)])
def test_a_log_that_begins_with_a_step_begins_at_rest(step: tuple[float, float, float]) -> None:
    robot, log = load_description("stiff-flop-1"), log_of()
    stepped = replace(log, commanded=np.vstack([[step], log.commanded[1:]]))
    (read,) = recordings_of(robot, [stepped], AS_RECORDED)
    np.testing.assert_array_equal(read.before, 0.0)
    (read,) = recordings_of(robot, [replace(stepped, measured=stepped.commanded)], AS_RECORDED)
    np.testing.assert_array_equal(read.before, stepped.commanded[0])


def test_a_log_of_an_arm_under_pressure_begins_there() -> None:
    log = log_of(duration=80.0)
    begin = int(np.argmax(log.commanded.min(axis=1)))
    late = Log(log.time[begin:], log.commanded[begin:], log.tip_position[begin:])
    (read,) = recordings_of(load_description("stiff-flop-1"), [late], AS_RECORDED)
    np.testing.assert_array_equal(read.before, late.commanded[0])


# -- a drift ---------------------------------------------------------------------------------------


@cache
def laps() -> Log:
    """A log of an arm with hysteresis and creep that repeats its course eleven times."""
    pressures = course(3, 20.0, 1, rate=5.0)[1]
    robot = arm()
    history = History(
        lag=0.2, play=(Play(width=2e4, share=0.3),), creep=(Creep(time=20.0, share=0.1),)
    )
    segments = [each.model_copy(update={"history": history}) for each in robot.segments]
    robot = robot.model_copy(update={"segments": tuple(segments)})
    repeated = np.tile(pressures, (11, 1))
    return made_log(robot, np.arange(len(repeated)) / 5.0, repeated)


def test_a_drift_is_removed() -> None:
    log = laps()
    drift = np.outer((log.time / log.time[-1]) ** 3, [4e-3, -5e-3, 1e-3])
    off = replace(log, tip_position=log.tip_position + drift)
    (read,) = recordings_of(load_description("stiff-flop-1"), [off], AS_RECORDED)
    found = without_drift(read)
    assert "the tip's positions drift by up to 5.2 mm" in found.remarks[-1]
    left = (found.tracks[0].position - log.tip_position)[: len(log.time) * 15 // 16]
    np.testing.assert_allclose(left - left.mean(axis=0), 0.0, atol=6e-4)


def test_hysteresis_and_creep_are_no_drift() -> None:
    robot = load_description("stiff-flop-1")
    (read,) = recordings_of(robot, [laps()], AS_RECORDED)
    assert without_drift(read) is read


def test_only_a_log_that_returns_to_its_pressures_tells_a_drift() -> None:
    log = log_of(duration=160.0)
    drift = np.outer((log.time / log.time[-1]) ** 3, [4e-3, -5e-3, 1e-3])
    off = replace(log, tip_position=log.tip_position + drift)
    (read,) = recordings_of(load_description("stiff-flop-1"), [off], AS_RECORDED)
    assert without_drift(read) is read


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
