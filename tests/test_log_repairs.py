"""Units, clocks, the pressures before a log and drifts: put right where they are clear."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from lagging_arm import AS_RECORDED, arm, driven, log_of
from made_logs import course, made_log
from recordings import UCL, recordings
from stiffopt.errors import FileError
from stiffopt.identify.detection import without_drift
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.setup import recordings_of
from stiffopt.logs import Log, read_log
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

MODULES = recordings("ucl_stiff_flop_*55mm/*.csv")


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
