"""The paper's experiments, on a rig that is where it is told and as stiff as it is told."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy import stats

import stiffopt
from conftest import is_long
from fake_rig import CLEARANCE, PERIOD, FakeSupply, FakeWorld, fake_rig, straight, world_of
from stiffopt.cli import experiment_run
from stiffopt.cli.main import main
from stiffopt.cli.quantities import directions, pressures
from stiffopt.errors import DeviceError, FileError, InputError, StiffoptError
from stiffopt.experiments import (
    KinematicsSettings,
    PressureSequence,
    StiffnessSettings,
    evaluate_coverage,
    evaluate_kinematics,
    evaluate_stiffness,
    run_kinematics,
    run_stiffness,
)
from stiffopt.experiments import folder as folder_module
from stiffopt.experiments.conductor import CONDUCTOR, Conductor
from stiffopt.experiments.coverage import coverage_for, spread_pressures
from stiffopt.experiments.folder import alone_in, create_folder
from stiffopt.experiments.kinematics_result import read_recordings, read_rounds
from stiffopt.experiments.probing import PointsFile
from stiffopt.experiments.slope import LineFit, combine, fit_line, fit_lines, student_t
from stiffopt.logs import Log, LogRow, McapLogWriter, read_log, read_mcap_log, read_stiffness_table
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import effective_slew
from stiffopt.safety.rigs import rig_for_programs
from stiffopt.safety.settings import COMMANDS

GOLDEN = {  # bar: stiffness along x, y, z in N/m; reference/paper-notes.md
    0.0: (14.03, 14.03, 730.42),
    0.4: (12.67, 12.13, 222.38),
    1.0: (13.91, 9.33, 31.89),
    1.5: (28.23, 7.24, 11.63),
}


SIM = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"


def golden(p: np.ndarray, direction: np.ndarray) -> float:
    """Stiffness at the nearest pressure of the table: it is constant while the arm rests."""
    bar = min(GOLDEN, key=lambda level: abs(level * 1e5 - p[0]))
    return float(GOLDEN[bar][int(np.argmax(np.abs(direction)))])


def short(**given: object) -> KinematicsSettings:
    values = {
        "channels": 3, "pressures": (0.5e5,), "period": 1.0, "repetitions": 2, "poses": 0, **given,
    }  # fmt: skip
    return KinematicsSettings(**values)


def quick(**given: object) -> StiffnessSettings:
    steps = 4 if is_long() else 2
    values = {
        "channels": 3, "pressures": (0.4e5,), "repetitions": 1, "steps": steps, **given,
    }  # fmt: skip
    return StiffnessSettings(**values)


def model() -> stiffopt.Manipulator:
    return stiffopt.load_robot("stiff-flop-1")


class FirstRowAlone(McapLogWriter):
    """Writes one row: most tests look at the recordings in CSV files only."""

    def append(self, row: LogRow) -> None:
        if self._last_time is None:
            super().append(row)


@pytest.fixture
def whole_mcap() -> None:
    """MCAP files get all rows."""


@pytest.fixture(autouse=True)
def _mcap(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "whole_mcap" not in request.fixturenames:
        monkeypatch.setattr(folder_module, "McapLogWriter", FirstRowAlone)


# -- the sequence of pressures --------------------------------------------------------------------


def test_the_papers_sequence_is_nine_teeth_in_forty_seconds() -> None:
    settings = KinematicsSettings(channels=3)
    sequence = PressureSequence.sawtooth(np.zeros(3), settings.pressures, settings.period, 1e9)
    assert sequence.duration == pytest.approx(40)
    peaks = sequence.at((np.arange(9) + 0.5) * 40 / 9)
    expected = np.zeros((9, 3))
    for channel in range(3):
        expected[3 * channel : 3 * channel + 3, channel] = (0.4e5, 0.8e5, 1e5)
    np.testing.assert_allclose(peaks, expected, atol=1e-6)
    np.testing.assert_allclose(sequence.at(np.arange(10) * 40 / 9), 0, atol=1e-6)
    np.testing.assert_allclose(sequence.at(40 / 36), [0.2e5, 0, 0])  # half way up the first
    assert sequence.at(99.0).tolist() == [0, 0, 0]


def test_a_tooth_is_stretched_where_the_rig_is_slow() -> None:
    sequence = PressureSequence.sawtooth([0.0, 0.0], [1e5], 2.0, [1e9, 0.2e5])
    assert sequence.times.tolist() == [0, 1, 2, 7, 12]


# -- kinematics -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("whole_mcap")
def test_a_recording_holds_what_was_so_at_each_frame(tmp_path: Path) -> None:
    rig = fake_rig(slew=3e5)
    with rig:
        assert run_kinematics(rig, tmp_path, short(), rate=100.0) == []
    for repetition in (1, 2):
        log = read_log(tmp_path / f"kinematics_{repetition}.csv")
        other = read_mcap_log(tmp_path / f"kinematics_{repetition}.mcap")
        np.testing.assert_allclose(other.tip_position, log.tip_position, atol=1e-7)
        assert log.time[0] < 0.03
        assert log.time[-1] > 3.1
        np.testing.assert_allclose(np.diff(log.time), 0.025, atol=2e-6)
        assert log.tip_quaternion is not None
        assert log.measured is not None
        # the tip is where the true pressure of that moment puts it, so the measured pressure that
        # stands beside it must be that of the same moment: 10 ms at 1 bar/s are 1000 Pa
        truth = (log.tip_position - [0, 0, 0.09]) / 2e-7
        np.testing.assert_allclose(log.measured, truth, atol=700)
        ramp = np.interp(log.time, np.arange(7) * 0.5, [0, 0.5e5, 0, 0, 0, 0, 0])
        np.testing.assert_allclose(log.commanded[:, 0], ramp, atol=1100)
        np.testing.assert_allclose(log.commanded.max(axis=0), 0.5e5, rtol=0.02)
    assert not list(tmp_path.glob("*.part.*"))


def assert_gentle(rig: Rig, slew: float, high: float) -> None:
    """All that was ever written: in range, no faster than the slew but for the vents, 0 at last."""
    times = np.array([time for time, _ in world_of(rig).writes])
    values = np.array([value for _, value in world_of(rig).writes])
    assert values.min() >= 0
    assert values.max() <= high
    assert not values[-1].any()
    rise = np.diff(values, axis=0).max(axis=1)
    assert (rise <= slew * np.diff(times) + 1e-6).all()
    ramps = np.diff(values, axis=0)[:-1]
    assert (-ramps <= slew * np.diff(times)[:-1, np.newaxis] + 1e-6).all()


def test_commands_keep_slew_and_limits(tmp_path: Path) -> None:
    rig = fake_rig(slew=0.3e5, high=0.5e5)
    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1), rate=50.0)
    assert_gentle(rig, 0.3e5, 0.5e5)
    assert read_log(tmp_path / "kinematics_1.csv").time[-1] > 10  # 6 ramps of 0.5 bar at 0.3 bar/s


def test_channels_that_cannot_be_low_are_brought_up_and_down(tmp_path: Path) -> None:
    rig = fake_rig(slew=1e5, low=0.1e5, high=1e5)
    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1), rate=50.0)
    log = read_log(tmp_path / "kinematics_1.csv")
    assert log.commanded.min() == 0.1e5
    assert not world_of(rig).commanded.any()


def test_the_error_is_that_of_the_model_and_not_of_the_regulators(tmp_path: Path) -> None:
    arm, shift = model(), np.array([0.0, 0.002, 0.0])
    rig = fake_rig(lambda p: arm.tip_pose(p)[:3, 3] + shift, slew=3e5)
    settings = short(pressures=(1e5,), period=4.0, repetitions=2)
    with rig:
        run_kinematics(rig, tmp_path, settings, rate=100.0)
    result = evaluate_kinematics(read_recordings(tmp_path, settings), arm)
    assert result.repetitions == 2
    assert result.mean == pytest.approx(0.002, rel=0.03)
    assert result.worst < 0.0026  # 5 ms of 0.5 bar/s; with commanded pressures it would be 0.004
    np.testing.assert_allclose(np.nanmean(result.component_error, axis=0), -shift, atol=1e-4)
    assert result.repeatability < 3e-4
    assert result.error.shape == result.time.shape


def test_the_band_holds_all_repetitions_and_gaps_stay_gaps(tmp_path: Path) -> None:
    head = "time_s,p1_pa,p2_pa,p3_pa,tip_x_m,tip_y_m,tip_z_m\n"
    for number, x in ((1, 0.001), (2, 0.003)):
        rows = "".join(
            f"{0.1 * k:.1f},0,0,0,{x if not 30 < k < 50 or number == 1 else ''},0,0.09\n"
            for k in range(100)
        )
        (tmp_path / f"kinematics_{number}.csv").write_text(head + rows)
    result = evaluate_kinematics(read_recordings(tmp_path, short()), model())
    early, gap = np.searchsorted(result.time, [1.0, 4.0])
    assert (result.low[early, 0], result.high[early, 0]) == pytest.approx((0.001, 0.003))
    assert (result.low[gap, 0], result.high[gap, 0]) == pytest.approx((0.001, 0.001))
    assert len(result.errors) == 181
    assert result.worst == pytest.approx(0.003)


def test_nothing_moves_beyond_the_limits(tmp_path: Path) -> None:
    rig = fake_rig(high=0.6e5)
    with rig, pytest.raises(InputError, match=r"channel 1 cannot have 0.7 bar.* 0 to 0.6 bar"):
        run_kinematics(rig, tmp_path, short(pressures=(0.7e5,)), rate=100.0)
    assert not any(value.any() for _, value in world_of(rig).writes)


def test_a_tracker_that_goes_blind_ends_the_experiment(tmp_path: Path) -> None:
    rig = fake_rig()
    world_of(rig).at.append((5.0, lambda: setattr(world_of(rig), "seen", False)))
    with rig, pytest.raises(DeviceError, match=r"has not seen the tip for 0\.5 s"):
        run_kinematics(rig, tmp_path, short(period=4.0), rate=100.0)
    assert world_of(rig).t < 100 + 5 + 0.7
    assert not world_of(rig).commanded.any()
    assert len(read_log(tmp_path / "kinematics_1.part.csv")) > 50


def test_a_tracker_that_sees_nothing_at_all(tmp_path: Path) -> None:
    rig = fake_rig()
    world_of(rig).seen = False
    with rig, pytest.raises(DeviceError, match="has not seen the tip for 5 s"):
        run_kinematics(rig, tmp_path, short(), rate=100.0)
    assert not any(value.any() for _, value in world_of(rig).writes)


def stop_at(moment: float, rig: Rig) -> Callable[[], None]:
    def check() -> None:
        if world_of(rig).t - 100 > moment:
            raise KeyboardInterrupt

    return check


def test_what_was_complete_is_not_repeated(tmp_path: Path) -> None:
    rig = fake_rig(slew=3e5)
    settings = short(repetitions=3)
    with rig, pytest.raises(KeyboardInterrupt):
        run_kinematics(rig, tmp_path, settings, rate=100.0, check=stop_at(7.0, rig))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["kinematics_1.csv", "kinematics_1.mcap"] + [
        f"kinematics_2.part.{ending}" for ending in ("csv", "mcap")
    ]
    assert len(read_log(tmp_path / "kinematics_2.part.csv")) > 20
    first = (tmp_path / "kinematics_1.csv").stat().st_mtime_ns
    rig = fake_rig(slew=3e5)
    with rig:
        run_kinematics(rig, tmp_path, settings, rate=100.0)
    assert (tmp_path / "kinematics_1.csv").stat().st_mtime_ns == first
    assert {path.name for path in tmp_path.glob("*.csv")} == {
        f"kinematics_{k}.csv" for k in (1, 2, 3)
    }


# -- combined poses -------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3, 6, 9])
@pytest.mark.parametrize("count", [2, 7, 24, 48])
def test_combined_poses_reach_all_ends_of_all_channels(channels: int, count: int) -> None:
    low, high = np.linspace(-0.2e5, 0.1e5, channels), np.linspace(1e5, 1.5e5, channels)
    poses = spread_pressures(count, low, high)
    assert poses.shape == (count, channels)
    even = low + (high - low) * np.linspace(0, 1, count)[:, np.newaxis]
    np.testing.assert_allclose(np.sort(poses, axis=0), even, atol=1e-6)
    assert (poses >= low).all()
    assert (poses <= high).all()
    np.testing.assert_array_equal(poses, spread_pressures(count, low, high))


@pytest.mark.parametrize("channels", [2, 3, 6])
def test_combined_poses_are_spread_better_than_by_chance(channels: int) -> None:
    poses = spread_pressures(24, np.zeros(channels), np.ones(channels))
    random = np.random.default_rng(0)
    chance = [stats.qmc.discrepancy(random.uniform(size=(24, channels))) for _ in range(200)]
    assert stats.qmc.discrepancy(poses) < min(chance)
    related = np.abs(np.corrcoef(poses.T) - np.eye(channels))
    assert related.max() < 0.35
    for one in range(channels):
        for other in range(one):
            pair = poses[:, [one, other]] > 0.5
            assert {tuple(row) for row in pair.tolist()} == {
                (False, False), (False, True), (True, False), (True, True)
            }  # fmt: skip
    rises = (np.diff(poses, axis=0) > 0).mean(axis=0)
    assert ((rises > 0.35) & (rises < 0.65)).all()  # loaded and unloaded about as often


def test_many_channels_do_not_rise_together() -> None:
    related = np.corrcoef(spread_pressures(24, np.zeros(9), np.ones(9)).T) - np.eye(9)
    assert np.abs(related).max() < 0.45


def test_few_poses_and_none() -> None:
    assert spread_pressures(1, [0, -1e4], [1e5, 2e5]).tolist() == [[1e5, 2e5]]
    assert spread_pressures(0, [0, 0], [1, 1]).shape == (0, 2)
    assert coverage_for(fake_rig(), 0, 1.0).rounds == []


@pytest.mark.parametrize("count", [1, 6, 7, 13, 24])
def test_rounds_are_short_and_hold_all_poses(count: int) -> None:
    coverage = coverage_for(fake_rig(), count, 1.0)
    sizes = [len(poses) for poses in coverage.rounds]
    assert len(sizes) == math.ceil(count / 6)
    assert max(sizes) - min(sizes) <= 1
    assert max(sizes) <= 6
    np.testing.assert_array_equal(np.vstack(coverage.rounds), coverage.poses)


def plateaus(log: Log, least: float = 0.9) -> list[list[float]]:
    """Commands that stay the same for so many seconds, one after the other."""
    found, begin = [], 0
    for row in range(1, len(log) + 1):
        if row == len(log) or (log.commanded[row] != log.commanded[begin]).any():
            if log.time[row - 1] - log.time[begin] >= least:
                found.append(log.commanded[begin].tolist())
            begin = row
    return found


@pytest.mark.usefixtures("whole_mcap")
@pytest.mark.one_in(2, "robot")
@pytest.mark.parametrize(
    ("robot", "slew", "low", "high", "highest"),
    [
        ("stiff-flop-1", 3e5, 0.0, 1.5e5, None),
        ("stiff-flop-1", 0.3e5, 0.0, 0.7e5, 2e5),
        ("stiff-flop-1", None, 0.0, 1.5e5, 0.6e5),
        ("stiff-flop-2", 3e5, 0.0, 1.5e5, None),
    ],
)
def test_every_combined_pose_is_held_and_gently_reached(
    tmp_path: Path, robot: str, slew: float | None, low: float, high: float, highest: float | None
) -> None:
    rig = fake_rig(robot=robot, slew=slew, low=low, high=high)
    n = rig.supply.n
    settings = short(channels=n, repetitions=1, period=4.0, poses=8, max=highest)
    with rig:
        assert run_kinematics(rig, tmp_path, settings, rate=50.0) == []
    most = high if highest is None else min(high, highest)
    rate = CONDUCTOR.gentle if slew is None else min(slew, CONDUCTOR.gentle)
    assert_gentle(rig, rate, high)  # the teeth are slower than that
    logs = read_rounds(tmp_path, 2)
    assert len(logs) == 2
    held = []
    for log in logs:
        assert log.commanded.max() <= most
        assert np.abs(log.commanded[0]).max() <= rate * 0.1  # from nothing
        found = plateaus(log)
        assert found[-1] == [0.0] * n  # and back, which is held too
        held += found[:-1]
        assert log.measured is not None
        assert not np.abs(log.measured[-1]).max() > 10
    np.testing.assert_allclose(held, spread_pressures(8, np.zeros(n), np.full(n, most)), atol=0.1)
    assert np.max(held, axis=0) == pytest.approx(most)
    assert [path.name for path in sorted(tmp_path.glob("*.csv"))] == [
        "kinematics_1.csv", "kinematics_poses_1.csv", "kinematics_poses_2.csv",
    ]  # fmt: skip
    others = read_mcap_log(tmp_path / "kinematics_poses_2.mcap")
    np.testing.assert_allclose(others.tip_position, logs[1].tip_position, atol=1e-7)


def test_combined_poses_of_channels_that_cannot_be_low(tmp_path: Path) -> None:
    rig = fake_rig(slew=1e5, low=[0.1e5, -0.5e5, 0.0], high=[1e5, 0.5e5, 1e5])
    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1, poses=3), rate=50.0)
        with pytest.raises(InputError, match=r"at most 0.05 bar: channel 1 has 0.1 to 1 bar"):
            run_kinematics(rig, tmp_path, short(repetitions=1, poses=3, max=0.05e5), rate=50.0)
    (log,) = read_rounds(tmp_path, 1)
    assert log.commanded.min(axis=0).tolist() == [0.1e5, -0.5e5, 0]
    assert log.commanded.max(axis=0).tolist() == [1e5, 0.5e5, 1e5]
    assert log.commanded[-1].tolist() == [0.1e5, 0, 0]


def test_without_combined_poses_all_is_as_in_the_paper(tmp_path: Path) -> None:
    written = []
    for poses in (0, 2):
        folder = tmp_path / str(poses)
        folder.mkdir()
        rig = fake_rig(slew=3e5)
        with rig:
            run_kinematics(rig, folder, short(poses=poses), rate=50.0)
        written.append(world_of(rig).writes[:-1])  # the last one vents
    alone, more = written
    assert len(alone) < len(more)
    for (time_then, then), (time_now, now) in zip(alone, more, strict=False):
        assert time_then == time_now
        assert then.tolist() == now.tolist()
    assert {path.name for path in (tmp_path / "0").glob("*.csv")} == {
        "kinematics_1.csv", "kinematics_2.csv"
    }  # fmt: skip
    for name in ("kinematics_1.csv", "kinematics_2.csv"):
        assert (tmp_path / "0" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_rounds_that_were_complete_are_not_repeated(tmp_path: Path) -> None:
    settings = short(repetitions=1, poses=8)
    told: list[tuple[float, float, str]] = []

    def check() -> None:
        if told and told[-1][2] == "combined pose 6 of 8":
            raise KeyboardInterrupt

    rig = fake_rig(slew=3e5)
    with rig, pytest.raises(KeyboardInterrupt):
        run_kinematics(
            rig, tmp_path, settings, rate=50.0, check=check,
            progress=lambda *what: told.append(what),
        )  # fmt: skip
    assert not world_of(rig).commanded.any()
    assert {path.name for path in tmp_path.glob("*.csv")} == {
        "kinematics_1.csv", "kinematics_poses_1.csv", "kinematics_poses_2.part.csv"
    }  # fmt: skip
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*_1.csv")}
    told.clear()
    rig = fake_rig(slew=3e5)
    with rig:
        run_kinematics(rig, tmp_path, settings, rate=50.0, progress=lambda *what: told.append(what))
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not list(tmp_path.glob("*.part.*"))
    done, totals, texts = zip(*told, strict=True)
    assert list(done) == sorted(done)
    assert len(set(totals)) == 1
    assert done[-1] < totals[0]
    assert [text for text in dict.fromkeys(texts) if text.startswith("combined")] == [
        f"combined pose {number} of 8" for number in (5, 6, 7, 8)
    ]
    held = [pose for log in read_rounds(tmp_path, 2) for pose in plateaus(log)[:-1]]
    np.testing.assert_allclose(held, spread_pressures(8, np.zeros(3), np.full(3, 1.5e5)), atol=0.1)
    (tmp_path / "kinematics_poses_1.mcap").unlink()  # it is torn: once more
    rig = fake_rig(slew=3e5)
    with rig:
        run_kinematics(rig, tmp_path, settings, rate=50.0)
    assert (tmp_path / "kinematics_poses_1.mcap").exists()


def test_an_arm_that_does_not_come_to_rest_is_not_waited_for(tmp_path: Path) -> None:
    world: list[FakeWorld] = []

    def creeping(p: np.ndarray) -> np.ndarray:
        return straight(p) + np.array([2e-4 * (world[0].t - 100), 0, 0])

    rig = fake_rig(creeping, slew=3e5)
    world.append(world_of(rig))
    settings = short(repetitions=1, poses=3, settle=2.0)
    with rig:
        notes = run_kinematics(rig, tmp_path, settings, rate=50.0)
    assert notes[-1] == "in 3 combined poses the arm was not at rest within 2 s (--settle)"
    (log,) = read_rounds(tmp_path, 1)
    assert len(plateaus(log, 1.9)) == 4
    assert len(plateaus(log, 2.1)) == 0
    foreseen = coverage_for(rig, 3, 2.0).duration(1) - 3  # s for the rest before it
    assert log.time[-1] - log.time[0] == pytest.approx(foreseen, rel=0.05)
    found = evaluate_coverage([log], model())
    assert found is not None
    np.testing.assert_allclose(found.speed, 2e-4, rtol=0.02)


def test_the_error_of_combined_poses_is_that_at_their_end(tmp_path: Path) -> None:
    """Ramps do not count, and neither do regulators that are off."""
    arm, shift = model(), np.array([0.0, 0.002, 0.0])
    rig = fake_rig(lambda p: arm.tip_pose(p)[:3, 3] + shift * p.max() / 1.5e5, slew=3e5)
    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1, poses=9), rate=100.0)
    result = evaluate_coverage(read_rounds(tmp_path, 2), arm)
    assert result is not None
    poses = spread_pressures(9, np.zeros(3), np.full(3, 1.5e5))
    np.testing.assert_allclose(result.pressures, poses, atol=20)
    np.testing.assert_allclose(result.errors, 0.002 * poses.max(axis=1) / 1.5e5, rtol=1e-3)
    assert result.mean == pytest.approx(np.mean(0.002 * poses.max(axis=1) / 1.5e5), rel=1e-3)
    assert result.worst == pytest.approx(0.002, rel=1e-3)
    assert result.mean < result.p95 <= result.worst
    assert result.doubts == ()
    with pytest.raises(InputError, match="has 6 channels, the recordings have 3"):
        evaluate_coverage(read_rounds(tmp_path, 2), stiffopt.load_robot("stiff-flop-2"))
    assert evaluate_coverage([], arm) is None


def test_a_command_that_was_held_for_a_moment_is_no_pose() -> None:
    """A supply that has vented by itself comes back up: what it passes does not count."""
    time = np.arange(0, 10, 0.05)
    commanded = np.zeros((200, 3))
    commanded[20:34] = 0.5e5  # 0.65 s
    commanded[40:100] = 1e5
    commanded[110:150, 1] = 0.3e5  # the tip is out of sight
    tip = np.full((200, 3), 0.05)
    tip[60:80] = 0.01
    tip[80:100] = [0.0, 0.0, 0.1]
    tip[110:150] = np.nan
    found = evaluate_coverage([Log(time, commanded, tip)], model())
    assert found is not None
    assert found.pressures.tolist() == [[1e5] * 3]
    np.testing.assert_allclose(found.tip, [[0.0, 0.0, 0.1]], atol=1e-12)
    assert found.speed == pytest.approx(0, abs=1e-9)
    expected = model().tip_pose(np.full(3, 1e5))[2, 3] - 0.1
    assert found.errors == pytest.approx(abs(expected), abs=1e-9)
    assert found.doubts  # of the gap


def test_the_figure_of_combined_poses_shows_pressures_and_errors(tmp_path: Path) -> None:
    from stiffopt.experiments import CoverageResult
    from stiffopt.plots.experiments import plot_coverage

    random = np.random.default_rng(0)
    pressures, tip = random.uniform(0, 1.5e5, (5, 6)), random.normal(size=(5, 3)) * 1e-3
    result = CoverageResult(pressures, tip, np.zeros((5, 3)), np.zeros(5), 0.18)
    figure = plot_coverage(result, title="a $rig$")
    shades, bars = figure.axes[0].collections[0], figure.axes[1].patches
    np.testing.assert_allclose(shades.get_array(), pressures.T * 1e-5)
    np.testing.assert_allclose(
        [bar.get_height() for bar in bars], np.linalg.norm(tip, axis=1) * 1e3
    )
    figure.savefig(tmp_path / "poses.png")


# -- stiffness ------------------------------------------------------------------------------------


def test_the_slope_is_the_stiffness_of_the_arm(tmp_path: Path) -> None:
    """Known stiffness, from the golden table, comes back; and it is that of the model."""
    rig = fake_rig(stiffness=golden)
    settings = quick(pressures=(0.0, 1.5e5))
    with rig:
        notes = run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    assert notes == []
    result = evaluate_stiffness(tmp_path, settings, model())
    assert len(result.cells) == 6
    for cell in result.cells:
        truth = golden(np.array([cell.pressure]), np.array(cell.direction))
        assert cell.estimate is not None
        assert cell.by_stage is not None
        assert cell.estimate.value == pytest.approx(truth, rel=1e-4)
        assert cell.model == pytest.approx(truth, rel=2e-3)
        series = 1 / (1 / truth + 1 / 5000)  # the stage also compresses the contact
        assert cell.by_stage.value == pytest.approx(series, rel=1e-3)
        assert cell.points == 2 * settings.steps + 1
    assert world_of(rig).swept == 0
    for series in PointsFile(tmp_path, 3).read():  # tared: no displacement, no force
        truth = golden(np.array([series.key.pressure]), np.array(series.key.direction))
        np.testing.assert_allclose(series.force, truth * series.displacement, rtol=1e-3, atol=1e-4)
    # each pressure, each direction, once, with the arm at rest at that pressure
    done = [(p[0], tuple(axis)) for axis, p in world_of(rig).alignments]
    wanted = [(p, d) for p in settings.pressures for d in settings.directions]
    assert [d for _, d in done] == [d for _, d in wanted]
    np.testing.assert_allclose([p for p, _ in done], [p for p, _ in wanted], atol=20)
    assert_gentle(rig, 0.5e5, 1.5e5)


def test_noise_is_covered_by_the_interval(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=lambda p, d: 12.4, noise=3e-5, force_noise=5e-4, seed=3)
    settings = quick(repetitions=3, directions=((1.0, 0.0, 0.0),), steps=4)
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    (cell,) = evaluate_stiffness(tmp_path, settings, model()).cells
    assert cell.estimate is not None
    assert len(cell.slopes) == 3
    assert abs(cell.estimate.value - 12.4) < cell.estimate.half_width < 1.5


def test_creep_is_not_taken_for_stiffness(tmp_path: Path) -> None:
    """There and back, a steady drift of the arm can be told from what the probe does."""
    world: list[FakeWorld] = []

    def creeping(p: np.ndarray) -> np.ndarray:
        return straight(p) + np.array([1e-5 * (world[0].t - 100), 0, 0])  # 10 um/s

    rig = fake_rig(creeping, lambda p, d: 12.67)
    world.append(world_of(rig))
    settings = quick(directions=((1.0, 0.0, 0.0),), settle=5.0, steps=4)
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    (cell,) = evaluate_stiffness(tmp_path, settings, model()).cells
    assert cell.estimate is not None
    assert cell.estimate.value == pytest.approx(12.67, rel=2e-3)
    (series,) = PointsFile(tmp_path, 3).read()
    blind = fit_line(series.displacement[:5], series.force[:5])  # there, and not back
    assert blind is not None
    assert abs(blind.slope - 12.67) > 0.2


def test_only_points_in_contact_count(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=golden)
    settings = quick(directions=((1.0, 0.0, 0.0),), steps=4)
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    path = tmp_path / "points.csv"
    lines = path.read_text().splitlines()
    fields = [line.split(",") for line in lines]
    force, touching = lines[0].split(",").index("force_n"), lines[0].split(",").index("touching")
    for row in fields[1:4]:  # three points that felt something else, and no contact
        row[force], row[touching] = "5", "0"
    path.write_text("\n".join(map(",".join, fields)) + "\n")
    (cell,) = evaluate_stiffness(tmp_path, settings, model()).cells
    assert cell.estimate is not None
    assert cell.points == 6
    assert cell.estimate.value == pytest.approx(12.67, rel=1e-4)


def test_a_stiff_direction_is_displaced_less(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=golden)
    settings = quick(pressures=(0.0,), directions=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    soft, stiff = PointsFile(tmp_path, 3).read()
    assert soft.displacement.max() == pytest.approx(0.003, rel=0.1)
    assert 0.15 < stiff.force.max() < 0.26


def test_an_arm_that_is_stiffer_than_thought_is_not_crushed(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=lambda p, d: 2000.0)
    felt: list[float] = []
    world = world_of(rig)
    tick = world.sleep_until
    world.sleep_until = lambda moment: (tick(moment), felt.append(world.force()))[0]  # type: ignore[method-assign, func-returns-value]
    settings = quick(directions=((1.0, 0.0, 0.0),))
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    assert 0.9 < max(felt) < 1.5  # five times 0.2 N, and what one small move adds
    assert world.stage == 0


@pytest.mark.usefixtures("whole_mcap")
def test_raw_recordings_hold_force_and_stage(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=golden)
    settings = quick(directions=((1.0, 0.0, 0.0),), repetitions=2)
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    for repetition in (1, 2):
        log = read_log(tmp_path / f"stiffness_{repetition}.csv")
        assert log.force is not None
        assert log.stage is not None
        probing = np.isfinite(log.force)
        assert 0.3 < probing.mean() < 0.95
        assert log.stage[probing].max() == pytest.approx(0.003 + CLEARANCE, rel=0.2)
        assert read_mcap_log(tmp_path / f"stiffness_{repetition}.mcap").force is not None


def test_series_that_are_whole_are_not_repeated(tmp_path: Path) -> None:
    settings = quick(repetitions=2, directions=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    rig = fake_rig(stiffness=golden)
    with rig, pytest.raises(KeyboardInterrupt):
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0, check=stop_at(60, rig))
    before = PointsFile(tmp_path, 3).read()
    assert 0 < len(before) < 4
    path = tmp_path / "points.csv"
    torn = path.read_bytes() + path.read_bytes().splitlines()[1] + b"\n1,2,3"
    path.write_bytes(torn)  # as if killed while a series was written
    assert len(PointsFile(tmp_path, 3).read()) == len(before)
    rig = fake_rig(stiffness=golden)
    with rig:
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    after = PointsFile(tmp_path, 3).read()
    assert len(after) == 4
    assert len(world_of(rig).alignments) == 4 - len(before)
    keys = {(series.key.repetition, series.key.direction) for series in after}
    assert len(keys) == 4
    assert (np.diff(read_log(tmp_path / "stiffness_1.csv").time) > 0).all()


@pytest.mark.parametrize(
    ("changes", "settings", "words"),
    [
        ({"probe": False}, {}, "this rig has no probe"),
        ({"tracker": False}, {}, "this rig has no tracker"),
        ({"high": 0.3e5}, {}, "channel 1 cannot have 0.4 bar"),
        ({}, {"channel": 4}, "there is no channel 4"),
    ],
)
def test_what_a_rig_cannot_do_is_said_before_anything_moves(
    tmp_path: Path, changes: dict, settings: dict, words: str
) -> None:
    rig = fake_rig(**changes)
    with rig, pytest.raises(InputError, match=words):
        run_stiffness(rig, tmp_path, quick(**settings), model(), rate=50.0)
    assert not any(value.any() for _, value in world_of(rig).writes)
    assert not world_of(rig).alignments


def test_a_probe_that_meets_nothing(tmp_path: Path) -> None:
    rig = fake_rig(stiffness=lambda p, d: 1e-3)
    with rig, pytest.raises(DeviceError, match="met nothing within 10 mm"):
        run_stiffness(rig, tmp_path, quick(), model(), rate=50.0)
    assert not world_of(rig).commanded.any()
    assert PointsFile(tmp_path, 3).read() == []


# -- slopes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 10, 11, 54, 301])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_students_quantile(confidence: float, freedom: int) -> None:
    expected = stats.t.ppf((1 + confidence) / 2, freedom)
    assert student_t(confidence, freedom) == pytest.approx(expected, rel=1e-10)


def test_a_line_by_least_squares() -> None:
    random = np.random.default_rng(0)
    x = np.linspace(0, 0.003, 9)
    y = 14 * x + 0.01 + 1e-3 * random.normal(size=9)
    found, expected = fit_line(x, y), stats.linregress(x, y)
    assert found is not None
    assert found.slope == pytest.approx(expected.slope)
    assert found.freedom == 7
    assert found.sigma == pytest.approx(expected.stderr)
    assert fit_line(x[:2], y[:2]) is None
    assert fit_line([1, 1, 1], [1, 2, 3]) is None
    assert fit_line([1, np.nan, 2], [1, 2, 3]) is None


def test_a_trend_is_taken_off_where_it_can_be_told() -> None:
    random = np.random.default_rng(0)
    x, t = np.array([0, 1, 2, 3, 2, 1, 0.0]), np.arange(7.0)
    y = 14 * x - 0.3 * t + 0.1 * random.normal(size=7)
    columns = np.stack([np.ones(7), x, t], axis=1)
    expected, (rest,), _, _ = np.linalg.lstsq(columns, y)
    sigma = math.sqrt(rest / 4 * np.linalg.inv(columns.T @ columns)[1, 1])
    found = fit_line(x, y, t)
    assert found is not None
    assert (found.slope, found.sigma) == pytest.approx((expected[1], sigma))
    assert (found.freedom, found.points) == (4, 7)
    alike = fit_line(t, y, t + 1e-3 * random.normal(size=7))
    plain = fit_line(t, y)
    assert alike is not None
    assert plain is not None
    assert (alike.slope, alike.freedom) == pytest.approx((plain.slope, 5))


def test_what_bends_beyond_doubt_is_fitted_by_a_parabola() -> None:
    """The slope that counts is that of the arm at rest, where x is 0."""
    random = np.random.default_rng(1)
    x, t = np.array([0, 1, 2, 3, 4, 3, 2, 1, 0.0]), np.arange(9.0)

    def repeated(bend: float) -> list[float]:
        series = [
            (x, 14 * x + bend * x**2 + 0.1 * t + 0.2 * random.normal(size=9), t) for _ in range(4)
        ]
        lines = fit_lines(series)
        assert {line.freedom for line in lines} == ({5} if bend else {6})
        return [line.slope for line in lines]

    np.testing.assert_allclose(repeated(0.0), 14, atol=0.25)
    np.testing.assert_allclose(repeated(-1.0), 14, atol=0.9)
    columns = np.stack([np.ones(9), x, x**2, t], axis=1)
    y = random.normal(size=9)
    found = fit_line(x, y, t, curved=True)
    assert found is not None
    assert found.slope == pytest.approx(np.linalg.lstsq(columns, y)[0][1])


def test_repetitions_that_differ_are_believed_over_residuals_that_do_not() -> None:
    lines = [LineFit(slope, 0.01, 7, 9) for slope in (13.0, 14.0, 15.0)]
    found = combine(lines)
    assert found is not None
    assert found.value == pytest.approx(14)
    assert found.spread == pytest.approx(1)
    assert found.sigma == pytest.approx(1 / math.sqrt(3))
    assert found.half_width == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)


def test_repetitions_that_agree_by_luck_do_not_hide_the_residuals() -> None:
    found = combine([LineFit(14.0, 0.5, 7, 9)] * 2)
    assert found is not None
    assert found.sigma == pytest.approx(0.5 / math.sqrt(2))
    assert found.half_width == pytest.approx(2.1448 * 0.5 / math.sqrt(2), rel=1e-4)
    assert combine([]) is None


@pytest.mark.parametrize("between", [0.0, 0.5])
def test_the_interval_holds_the_truth_as_often_as_it_says(between: float) -> None:
    random = np.random.default_rng(7)
    x, held, trials = np.linspace(0, 3, 7), 0, 800
    for _ in range(trials):
        lines = []
        for _ in range(5):
            slope = 14 + between * random.normal()
            line = fit_line(x, slope * x + random.normal(size=7) * 0.5)
            assert line is not None
            lines.append(line)
        found = combine(lines)
        assert found is not None
        held += abs(found.value - 14) <= found.half_width
    assert 0.93 <= held / trials <= 0.995


# -- figures --------------------------------------------------------------------------------------


def test_the_figure_of_kinematics_shows_band_and_model(tmp_path: Path) -> None:
    from stiffopt.plots.experiments import plot_kinematics

    head = "time_s,p1_pa,p2_pa,p3_pa,tip_x_m,tip_y_m,tip_z_m\n"
    for number in (1, 2):
        rows = "".join(f"{0.1 * k:.1f},50000,0,0,-0.0{number},0,0.09\n" for k in range(50))
        (tmp_path / f"kinematics_{number}.csv").write_text(head + rows)
    result = evaluate_kinematics(read_recordings(tmp_path, short()), model())
    figure = plot_kinematics(result, title="a $rig$")
    assert len(figure.axes) == 5
    band = figure.axes[1].collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((-20, -10))
    line = figure.axes[1].lines[0].get_ydata()
    expected = model().tip_pose([0.5e5, 0, 0])[0, 3] * 1e3
    np.testing.assert_allclose(line, expected)
    assert figure.axes[0].lines[0].get_ydata() == pytest.approx(0.5)
    figure.savefig(tmp_path / "figure.png")


@pytest.mark.parametrize("levels", [(0.0,), (0.4e5,), (0.0, 1e5)])
def test_the_figure_of_stiffness_shows_what_there_is(
    tmp_path: Path, levels: tuple[float, ...]
) -> None:
    """Also of an experiment that has hardly begun: only one series is there."""
    from stiffopt.experiments.probing import ProbePoint, SeriesKey
    from stiffopt.plots.experiments import plot_stiffness

    settings = quick(pressures=levels)
    points = [
        ProbePoint(float(k), 0.3 * k, 0.01 * k, 0.01 * k, np.zeros(3), np.zeros(3), True, True)
        for k in (0, 1, 2, 1, 0)
    ]
    PointsFile(tmp_path, 3).append(SeriesKey(1, levels[0], (1.0, 0.0, 0.0)), points)
    result = evaluate_stiffness(tmp_path, settings, model())
    figure = plot_stiffness(result)
    assert len(figure.axes) == 3
    (bars,) = figure.axes[0].containers
    assert bars.lines[0].get_ydata() == pytest.approx([30.0])  # N/m
    assert bars.lines[0].get_xdata() == pytest.approx([levels[0] * 1e-5])
    assert not figure.axes[1].containers
    assert figure.axes[1].lines[0].get_ydata()[0] == pytest.approx(14.03, abs=1e-2)
    figure.savefig(tmp_path / "figure.png")
    table = result.table()
    assert np.isnan(table.stiffness).sum() == len(table) - 1


# -- the simulated rig ----------------------------------------------------------------------------


@pytest.mark.long
def test_on_the_simulated_rig(tmp_path: Path) -> None:
    """Another arm than the model's, with inertia, creep, hysteresis and noise: but not far off."""
    pytest.importorskip("numba")
    from stiffopt.safety.rigs import open_rig

    path = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"
    kinematics = KinematicsSettings(channels=3, repetitions=2, poses=6)
    stiffness = StiffnessSettings(channels=3, repetitions=2, pressures=(0.0, 0.75e5))
    for name in "ks":
        (tmp_path / name).mkdir()
    with open_rig(path) as rig:
        run_kinematics(rig, tmp_path / "k", kinematics, rate=100.0)
    with open_rig(path) as rig:
        run_stiffness(rig, tmp_path / "s", stiffness, model(), rate=100.0)
    result = evaluate_kinematics(read_recordings(tmp_path / "k", kinematics), model())
    assert result.mean < 0.005
    assert result.repeatability < 0.001
    combined = evaluate_coverage(read_rounds(tmp_path / "k", 1), model())
    assert combined is not None
    assert len(combined.errors) == 6
    assert combined.worst < 0.015  # higher pressures, and it creeps
    for cell in evaluate_stiffness(tmp_path / "s", stiffness, model()).cells:
        assert cell.estimate is not None
        assert cell.estimate.value == pytest.approx(cell.model, rel=0.3)


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Rig], Rig]:
    """Let the command find this rig behind any file."""
    monkeypatch.chdir(tmp_path)

    def put(rig: Rig) -> Rig:
        monkeypatch.setattr(experiment_run, "rig_of", lambda path: (rig, "a rig", 50.0, "runs"))
        return rig

    return put


KINEMATICS = ["experiment", "kinematics", "rig.yaml", "--pressures", "0.5 bar", "--period", "1 s",
              "--repetitions", "2", "--poses", "2"]  # fmt: skip
STIFFNESS = ["experiment", "stiffness", "rig.yaml", "--pressures", "0:1:1 bar", "--directions",
             "x,-z", "--repetitions", "1", "--steps", "3"]  # fmt: skip


def test_kinematics_from_the_rig_to_the_figure(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig(slew=3e5))
    assert main(KINEMATICS) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("kinematics_a-rig_20")
    assert {path.name for path in folder.iterdir()} == {
        "experiment.yaml", "figure.png", "poses.png", "report.md", "kinematics_1.csv",
        "kinematics_1.mcap", "kinematics_2.csv", "kinematics_2.mcap", "kinematics_poses_1.csv",
        "kinematics_poses_1.mcap",
    }  # fmt: skip
    for name in ("figure.png", "poses.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr()
    assert "95th percentile" in said.out
    report = (folder / "report.md").read_text()
    assert "| tip error | mm | % of length | combined: mm | % of length |" in report
    assert "combined poses: 2 of 2, all channels, 0 to 1.5 bar" in report
    assert not said.err
    assert not world_of(rig).commanded.any()
    # complete: nothing moves, the report is made again
    rig = use(fake_rig())
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", str(folder)]) == 0
    assert "nothing was left to do" in capsys.readouterr().err
    assert not world_of(rig).writes


def test_kinematics_as_json(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, shift = model(), np.array([0.0, 0.0, 0.003])
    use(fake_rig(lambda p: arm.tip_pose(p)[:3, 3] + shift, slew=3e5))
    assert main([*KINEMATICS, "--json", "--no-plot", "--out", "run", "--max", "1.2 bar"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line)
    assert (found["model"], found["length_m"], found["folder"]) == ("stiff-flop-1", 0.09, "run")
    assert found["repetitions"] == 2
    assert found["mean_error_m"] == pytest.approx(0.003, rel=0.03)
    combined = found["combined"]
    assert combined["poses"] == 2
    for key in ("mean_error_m", "p95_error_m", "max_error_m", "errors_m"):
        assert combined[key] == pytest.approx([0.003] * 2 if key == "errors_m" else 0.003, rel=1e-3)
    assert np.max(combined["pressures_pa"], axis=0) == pytest.approx(1.2e5, abs=20)
    (tmp_path / "run" / "kinematics_poses_1.csv").write_text(
        "time_s,p1_pa,p2_pa,p3_pa,tip_x_m,tip_y_m,tip_z_m\n"
        + "".join(f"{0.1 * k:.1f},{k < 20},0,0,,,\n".replace("True", "1e5").replace("False", "0")
                  for k in range(30))
    )  # fmt: skip
    resume = ["experiment", "kinematics", "rig.yaml", "--resume", "run", "--no-plot"]
    assert main([*resume, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["combined"] is None
    assert main(resume) == 0
    assert "no combined pose was held with the tip in sight" in " ".join(
        capsys.readouterr().out.split()
    )


def test_a_folder_from_before_there_were_combined_poses_is_complete(
    use: Callable[[Rig], Rig], tmp_path: Path
) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--poses", "0", "--no-plot", "-q", "--out", "run"]) == 0
    path = tmp_path / "run" / "experiment.yaml"
    lines = path.read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("poses", "settle"))]
    assert len(kept) == len(lines) - 2
    path.write_text("\n".join(kept) + "\n")
    rig = use(fake_rig())
    command = ["experiment", "kinematics", "rig.yaml", "--resume", "run", "--no-plot", "-q"]
    assert main(command) == 0
    assert not world_of(rig).writes


def test_stiffness_from_the_rig_to_the_table(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use(fake_rig(stiffness=golden))
    assert main([*STIFFNESS, "--out", "k"]) == 0
    table = read_stiffness_table(tmp_path / "k" / "stiffness.csv")
    assert table.pressures[:, 0].tolist() == [0, 0, 1e5, 1e5]
    assert table.directions[:2].tolist() == [[1, 0, 0], [0, 0, -1]]
    np.testing.assert_allclose(table.stiffness, [14.03, 730.42, 13.91, 31.89], rtol=1e-3)
    np.testing.assert_allclose(table.others["model_n_per_m"], table.stiffness, rtol=2e-3)
    assert (tmp_path / "k" / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "95 % confidence" in capsys.readouterr().out


def test_quiet_is_quiet(use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--quiet", "--no-plot", "--out", "a"]) == 0
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")
    assert not Path("a/figure.png").exists()


def test_ctrl_c_vents_and_keeps_and_can_be_resumed(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig(slew=3e5))
    world, supply = world_of(rig), rig.bare  # type: ignore[attr-defined]
    assert isinstance(supply, FakeSupply)
    pressed: list[float] = []

    def press() -> None:
        pressed.append(world.commanded.max())
        signal.raise_signal(signal.SIGINT)

    def impatient() -> None:
        if pressed:  # a second time, while the arm is vented
            signal.raise_signal(signal.SIGINT)

    world.at.append((6.3, press))
    supply.on_write = impatient
    assert main([*KINEMATICS, "--out", "run"]) == 130
    assert pressed[0] > 0
    assert not world.commanded.any()
    assert not supply.is_open
    assert world.t - 100 < 6.4
    said = capsys.readouterr().err
    assert "rig.yaml --resume run" in said
    assert "interrupted" in said
    assert (tmp_path / "run" / "kinematics_1.csv").exists()
    assert len(read_log(tmp_path / "run" / "kinematics_2.part.csv")) > 10
    use(fake_rig(slew=3e5))
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", "run"]) == 0
    assert (tmp_path / "run" / "kinematics_2.csv").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_fault_of_the_rig(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    world_of(rig).at.append((4.0, lambda: setattr(world_of(rig), "seen", False)))
    assert main([*KINEMATICS, "--out", "run"]) == 5
    said = capsys.readouterr().err
    assert "has not seen the tip for 0.5 s; the arm is vented" in said
    assert "--resume run" in said
    assert not world_of(rig).commanded.any()


def test_a_supply_that_dies_is_said_to_be_dangerous(
    use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    world_of(rig).at.append((3.0, lambda: setattr(rig.bare, "dead", True)))
    assert main([*KINEMATICS, "--out", "run"]) == 5
    assert "MAY STILL BE UNDER PRESSURE" in capsys.readouterr().err


def test_no_device_leaves_no_folder(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    rig.bare.dead = True  # type: ignore[attr-defined]
    assert main([*KINEMATICS, "--out", "run"]) == 5
    assert "does not answer" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*KINEMATICS, "--pressures", "2 bar"], "cannot have 2 bar"),
        ([*KINEMATICS, "--pressures", "0.4,0.8"], "is no list of pressures"),
        ([*KINEMATICS, "--pressures", "1 mm"], "--pressures: '1 mm'"),
        ([*KINEMATICS, "--pressures", "0 bar"], "must be greater than 0"),
        ([*KINEMATICS, "--period", "5"], "--period: '5' has no unit"),
        ([*KINEMATICS, "--poses", "-1"], "'--poses'"),
        ([*KINEMATICS, "--max", "0 bar"], "max: must be greater than 0"),
        ([*KINEMATICS, "--max", "1 s"], "--max: '1 s'"),
        ([*KINEMATICS, "--settle", "0 s"], "settle: must be greater than 0"),
        ([*KINEMATICS, "--model", "stiff-flop-2"], "has 6 channels, the rig has 3"),
        ([*KINEMATICS, "--resume", "none"], "--pressures cannot be changed"),
        (["experiment", "kinematics", "rig.yaml", "--resume", "none"], "holds no experiment"),
        ([*KINEMATICS, "--out", "full"], "is not empty"),
        ([*STIFFNESS, "--directions", "x,w"], "'w' is no direction"),
        ([*STIFFNESS, "--directions", "x,x"], "a direction is given twice"),
        ([*STIFFNESS, "--channel", "7"], "there is no channel 7"),
        ([*STIFFNESS, "--displacement", "3 s"], "--displacement: '3 s'"),
    ],
)
def test_bad_input_moves_nothing(
    use: Callable[[Rig], Rig],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    rig = use(fake_rig())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").touch()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said
    assert not world_of(rig).writes
    assert not (tmp_path / "runs").exists()


def test_an_experiment_of_another_kind_or_robot_is_not_resumed(
    use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--out", "run", "--no-plot", "-q"]) == 0
    assert main([*KINEMATICS, "--out", "run"]) == 2
    assert "continue it with --resume run" in capsys.readouterr().err
    assert main(["experiment", "stiffness", "rig.yaml", "--resume", "run"]) == 2
    assert "experiment.yaml" in capsys.readouterr().err
    use(fake_rig(robot="stiff-flop-2"))
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", "run"]) == 2
    assert "begun with the robot stiff-flop-1, not stiff-flop-2" in capsys.readouterr().err


@pytest.mark.parametrize(("module", "extra"), [("matplotlib", "plot"), ("foxglove", "log")])
def test_what_is_not_installed_is_said_before_anything_moves(
    use: Callable[[Rig], Rig],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    module: str,
    extra: str,
) -> None:
    rig = use(fake_rig())
    monkeypatch.setitem(sys.modules, module, None)
    assert main(KINEMATICS) == 2
    assert f"pip install 'stiffopt[{extra}]'" in capsys.readouterr().err
    assert not world_of(rig).writes
    assert not Path("runs").exists()


def test_lists_and_ranges_of_pressures() -> None:
    assert pressures("-p", "0.4,0.8,1.0 bar") == (0.4e5, 0.8e5, 1e5)
    assert pressures("-p", "0:1.5:0.25 bar") == tuple(0.25e5 * k for k in range(7))
    assert pressures("-p", "0:0.3:0.1 bar") == pytest.approx((0, 1e4, 2e4, 3e4))
    assert pressures("-p", " 50 kPa ") == (5e4,)
    for text in ("", "bar", "1,,2 bar", "0:1 bar", "1:0:0.1 bar", "0:1:0 bar", "1,1 bar",
                 "0:1:0.0001 bar", "nan bar", "1;2 bar"):  # fmt: skip
        with pytest.raises(InputError, match=r"^-p: "):
            pressures("-p", text)
    assert directions("-d", "x, -z") == ((1, 0, 0), (0, 0, -1))


def test_the_settings_are_read_back(tmp_path: Path) -> None:
    from stiffopt.experiments.folder import create_folder, open_folder

    for number, settings in enumerate(
        (KinematicsSettings(channels=3), quick(directions=((0.0, 0.6, -0.8),)))
    ):
        folder = tmp_path / str(number)
        create_folder(folder, settings)
        assert open_folder(folder, type(settings)) == settings
    with pytest.raises(FileError, match="holds an experiment"):
        create_folder(tmp_path / "0", KinematicsSettings(channels=3))


def test_help_waits_for_no_numerics() -> None:
    script = (
        "import sys\nfrom stiffopt.cli.main import main\n"
        "assert main(['experiment', 'stiffness', '--help']) == 0\n"
        "found = {'numpy', 'casadi', 'matplotlib', 'mcap', 'numba'} & set(sys.modules)\n"
        "assert not found, found"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_alignment_that_takes_long_ends_with_a_vented_arm(tmp_path: Path) -> None:
    """Nobody commands while this probe is aligned, so the arm is let down; no jump back up."""
    rig = fake_rig(stiffness=golden)
    world, probe = world_of(rig), rig.probe
    assert probe is not None
    align = probe.align

    def slowly(direction: tuple[float, ...]) -> None:
        stall(rig, 60)
        align(direction)

    probe.align = slowly  # type: ignore[method-assign, assignment]
    settings = quick(directions=((1.0, 0.0, 0.0),))
    with rig, pytest.raises(DeviceError, match=r"stood still for 60 s.*--resume"):
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    late = [value for time, value in world.writes if time > 100 + 60]
    assert late
    assert not np.any(late)


class _ByHand:
    """A probe that a person mounts: `align` lasts until the rig has been spoken to for a while."""

    def __init__(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rig, self.writes = rig, [0]
        self.fail: Exception | None = None
        align = rig.probe.align  # type: ignore[union-attr]

        def by_hand(direction: tuple[float, ...]) -> None:
            world = world_of(rig)
            before, began = len(world.writes), world.t
            world.seen = False  # a hand before the sensor
            while world.t < began + 30 and not self.fail:
                time.sleep(0.001)
            world.seen = True
            if self.fail:
                raise self.fail
            self.writes.append(len(world.writes) - before)
            align(direction)

        monkeypatch.setattr(rig.probe, "align", by_hand)
        monkeypatch.setattr(type(rig.probe), "needs_a_person", True)


def test_pressures_are_held_while_a_person_mounts_the_probe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = fake_rig(stiffness=golden)
    person = _ByHand(rig, monkeypatch)
    with rig:
        run_stiffness(rig, tmp_path, quick(directions=((1.0, 0.0, 0.0),)), model(), rate=50.0)
    assert person.writes[-1] > 1000  # 30 s at 50 Hz: no watchdog would have run out
    _, pressures_then = world_of(rig).alignments[-1]
    assert pressures_then[0] == pytest.approx(0.4e5, abs=20)


def test_what_goes_wrong_while_the_probe_is_mounted_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = fake_rig(stiffness=golden)
    _ByHand(rig, monkeypatch).fail = DeviceError("nobody is at the terminal")
    settings = quick(directions=((1.0, 0.0, 0.0),))
    with rig, pytest.raises(DeviceError, match="nobody is at"):
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    assert not world_of(rig).commanded.any()


# -- what reaches the supply ----------------------------------------------------------------------

RATE = 100.0  # Hz


def began(rig: Rig, target: float, rate: float = RATE) -> Conductor:
    """Bring an open rig to a pressure."""
    conductor = Conductor(rig, rate)
    conductor.start()
    conductor.ramp(np.full(3, target))
    conductor.settle(np.full(3, target), lambda rows: False, 1.0)
    return conductor


def stall(rig: Rig, seconds: float) -> None:
    """Let the experiment stand still; what guards the arm goes on."""
    rig.clock.sleep(seconds)


def hold(conductor: Conductor, target: float, seconds: float) -> None:
    conductor.settle(np.full(3, target), lambda rows: False, seconds)


def written(rig: Rig, start: int = 0) -> np.ndarray:
    return np.array([value[0] for _, value in world_of(rig).writes[start:]])


def test_an_experiment_needs_the_gate() -> None:
    rig = fake_rig()
    rig.supply = rig.bare  # type: ignore[attr-defined]
    with rig, pytest.raises(InputError, match=r"open it by stiffopt\.open_rig"):
        Conductor(rig, RATE)


@pytest.mark.parametrize("gauges", [True, False])
def test_a_pause_shorter_than_a_command_holds_changes_nothing(gauges: bool) -> None:
    rig = fake_rig(slew=1e5)
    world_of(rig).watchdog = 0.3  # of the device: it is spoken to all the time
    if not gauges:
        world_of(rig).gauge = lambda p: np.full(3, np.nan)
    with rig:
        conductor = began(rig, 1e5)
        before = len(world_of(rig).writes)
        for pause in (0.32, 0.36, 0.49):
            stall(rig, pause)
            hold(conductor, 1e5, 0.3)
        assert set(written(rig, before)) == {1e5}
        assert world_of(rig).pressures == pytest.approx([1e5] * 3, rel=1e-3)


@pytest.mark.parametrize("start", [1e5, -0.5e5], ids=["pressure", "vacuum"])
def test_after_a_longer_pause_pressures_come_back_slowly(start: float) -> None:
    """The command has expired: the arm is being let down, and goes on from there."""
    rig = fake_rig(slew=1e5, low=-1.5e5)
    with rig:
        conductor = began(rig, start)
        before = len(world_of(rig).writes)
        stall(rig, 0.9)
        low = abs(world_of(rig).commanded[0])
        assert 0.5 * abs(start) < low < 0.7 * abs(start)
        conductor.ramp(np.full(3, start))
        assert np.diff(np.abs(written(rig, before))).max() <= 1001


@pytest.mark.parametrize("pause", [1.6, 10.0])
def test_after_a_long_pause_the_arm_is_vented_and_the_experiment_ends(pause: float) -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1e5)
        stall(rig, pause)
        assert not world_of(rig).commanded.any()
        before = len(world_of(rig).writes)
        with pytest.raises(DeviceError, match=r"stood still for 1.* s.*--resume"):
            conductor.tick(np.full(3, 1e5))
        assert not written(rig, before).any()


@pytest.mark.parametrize("pause", [0.6, 5.0])
def test_after_everything_stood_still_nothing_is_commanded(pause: float) -> None:
    """Not even what guards the arm has run meanwhile; the device has vented by itself."""
    rig = fake_rig(slew=1e5)
    world_of(rig).watchdog = 0.3
    with rig:
        conductor = began(rig, 1e5)
        before = len(world_of(rig).writes)
        world_of(rig).sleep_until(world_of(rig).t + pause)
        with pytest.raises(StiffoptError, match=r"no command came|stood still"):
            conductor.tick(np.full(3, 1e5))
        assert not written(rig, before).any()


@pytest.mark.parametrize("start", [1.5e5, -0.2e5])
@pytest.mark.parametrize("error", [-0.07e5, 0.07e5, 0.145e5])
@pytest.mark.parametrize("pause", [0.0, 0.4])
def test_a_gauge_that_is_wrong_moves_nothing(start: float, error: float, pause: float) -> None:
    """Too low by half of `Safety.max_pressure_error`, or too high by all of it."""
    rig = fake_rig(slew=1e5, low=-0.6e5)
    world_of(rig).gauge = lambda p: p + error
    with rig:
        conductor = began(rig, start)
        before = len(world_of(rig).writes)
        for target in (start, start / 2, start):
            stall(rig, pause)
            conductor.ramp(np.full(3, target))
            hold(conductor, target, 1.0)
        moved = np.diff(written(rig, before - 1))
    assert np.abs(moved).max() <= 1001


@pytest.mark.parametrize("shown", [0.0, 1.5e5, 9e5, np.nan])
@pytest.mark.parametrize("pause", [0.0, 0.4])
def test_one_or_two_bad_readings_move_nothing(shown: float, pause: float) -> None:
    rig = fake_rig(slew=1e5)
    world = world_of(rig)
    bad: list[float] = []
    world.gauge = lambda p: np.full(3, bad.pop()) if bad else p
    with rig:
        conductor = began(rig, 1e5)
        before = len(world.writes)
        for count in (1, 2):
            bad.extend([shown] * count)
            stall(rig, pause)
            conductor.ramp(np.full(3, 1e5))
            hold(conductor, 1e5, 1.0)
        assert set(written(rig, before)) == {1e5}
        conductor.ramp(np.zeros(3))
    assert np.diff(written(rig, before)[:-1]).min() >= -1001


@pytest.mark.parametrize("shown", [9e5, np.nan])
def test_readings_that_stay_impossible_end_the_experiment(shown: float) -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1e5)
        world_of(rig).gauge = lambda p: np.array([p[0], shown, p[2]])
        with pytest.raises(DeviceError, match=r"channel 2 reads .*, which cannot be"):
            hold(conductor, 1e5, 1.0)
    assert not world_of(rig).commanded.any()


def test_slow_regulators_are_not_taken_for_lost_pressure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fake_rig.LAG", 2.0)
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1.5e5)
        hold(conductor, 1.5e5, 5.0)
        for _ in range(200):
            conductor.tick(np.full(3, 0.2e5))
        before = len(world_of(rig).writes)
        for pause in (0.0, 0.2, 0.4, 0.4):
            stall(rig, pause)
            hold(conductor, 0.2e5, 3.0)
        assert set(written(rig, before)) == {0.2e5}
        conductor.ramp(np.full(3, 1.5e5))
        hold(conductor, 1.5e5, 3.0)


@pytest.mark.parametrize("start", [1e5, -0.5e5], ids=["pressure", "vacuum"])
@pytest.mark.parametrize("left", [0.0, 0.3])
def test_pressure_that_is_lost_ends_the_experiment(start: float, left: float) -> None:
    """Somebody has shut the air, or a tube is off: what was measured then is worth nothing."""
    rig = fake_rig(slew=1e5, low=-1e5)
    world, lost = world_of(rig), [False]
    world.gauge = lambda p: np.array([p[0] * left, p[1], p[2]]) if lost[0] else p
    with rig:
        conductor = began(rig, start)
        hold(conductor, start, 10.0)
        lost[0] = True
        before = world.t
        with pytest.raises(DeviceError, match=r"channel 1 reads .* (leaks|is stuck)"):
            hold(conductor, start, 5.0)
        assert world.t - before < 1.0
    assert not world.commanded.any()


def test_pressure_that_nobody_commanded_ends_the_experiment() -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = Conductor(rig, RATE)
        conductor.start()
        world_of(rig).gauge = lambda p: p + np.array([0.0, 0.0, 0.5e5])
        with pytest.raises(DeviceError, match=r"channel 3 reads 0\.5 bar.* is stuck"):
            hold(conductor, 0.0, 1.0)


def test_a_loop_that_was_held_up_does_not_jump_on_a_rig_without_slew(tmp_path: Path) -> None:
    rig = fake_rig(slew=None)
    assert effective_slew(rig).tolist() == [COMMANDS.default_slew] * 3
    stalls = iter([False] * 400 + [True] + [False] * 10000)

    def check() -> None:
        if next(stalls):
            stall(rig, 1.4)

    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1, period=4.0), rate=RATE, check=check)
    values = written(rig)
    assert values.max() > 0.45e5
    most = COMMANDS.default_slew * COMMANDS.pause_periods * PERIOD
    assert np.abs(np.diff(values)).max() <= most + 1e-6
    quick_teeth = PressureSequence.sawtooth(np.zeros(3), [1.5e5], 0.1, effective_slew(rig))
    assert quick_teeth.times[1] == pytest.approx(1.5e5 / COMMANDS.default_slew)


@pytest.mark.parametrize(("low", "high"), [(0.1e5, 0.6e5), (-0.6e5, 0.6e5), (-0.6e5, 0.0)])
def test_every_arm_can_be_ramped_down(low: float, high: float) -> None:
    rig = fake_rig(slew=1e5, low=low, high=high)
    target = 0.3e5 if high > 0 else -0.3e5
    with rig:
        conductor = began(rig, target)
        assert world_of(rig).commanded.tolist() == [target] * 3
        started = world_of(rig).t
        conductor.ramp(np.zeros(3))
        assert not world_of(rig).commanded.any()
        assert world_of(rig).t - started < 1.0


def test_a_ramp_that_gets_nowhere_ends() -> None:
    """Three channels together need more force than the rig allows."""
    rig = fake_rig(slew=1e5, high=0.2e5, safety=Safety(max_force=0.5))
    with rig:
        conductor = Conductor(rig, RATE)
        conductor.start()
        with pytest.raises(DeviceError, match="the gate limits them"):
            conductor.ramp(np.full(3, 0.2e5))
    force = max(rig.force(value) for _, value in world_of(rig).writes)
    assert 0.4 < force <= 0.5


def test_a_slew_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="slew: expected values above 0"):
        fake_rig(slew=0.0)


LIMITS = [(0.0, 1.5e5), (0.1e5, 1e5), (-0.6e5, 0.6e5), (-0.9e5, 0.0)]
STEPS = st.tuples(
    st.sampled_from(["tick", "ramp", "stall", "halt", "spike"]), st.floats(0, 1), st.booleans()
)


@examples(
    max_examples=40 if is_long() else 12, deadline=None, derandomize=True,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@example(LIMITS[0], 0.3, 0.0, [("ramp", 0.7, True), ("stall", 1.0, True), ("tick", 0.7, True)], 0)
@example(LIMITS[1], 0.3, 0.0, [("ramp", 0.2, True), ("halt", 1.0, True), ("ramp", 0.2, False)], 0)
@example(LIMITS[3], math.inf, -0.07e5, [("ramp", 0.7, True)] * 3, 1)
@given(
    limits=st.sampled_from(LIMITS),
    watchdog=st.sampled_from([0.3, 0.5, math.inf]),
    error=st.sampled_from([0.0, 0.145e5, -0.07e5]),
    steps=st.lists(STEPS, min_size=1, max_size=7),
    seed=st.integers(0, 99),
)
def test_commands_keep_their_promises(
    limits: tuple[float, float],
    watchdog: float,
    error: float,
    steps: list[tuple[str, float, bool]],
    seed: int,
) -> None:
    """Whatever happens: within limits and slew, or vented; and an end leaves the arm vented."""
    low, high = limits
    slew = [1e5, 0.3e5, None][seed % 3]
    rig = fake_rig(slew=slew, low=low, high=high)
    world, bad = world_of(rig), [0]
    world.watchdog = watchdog

    def gauge(p: np.ndarray) -> np.ndarray:
        bad[0] = max(bad[0] - 1, 0)
        return p + error if not bad[0] else np.full(3, 7e4 * (seed % 5 - 2))

    world.gauge = gauge
    ended = False
    with rig:
        conductor = began(rig, min(max(0.0, low), high))
        try:
            for what, share, long in steps:
                target = np.array([share, 1 - share, 0.5]) * (high - low) + low
                target = np.where([long, True, not long], target, 0.0)
                if what == "stall":
                    stall(rig, (2.0 if long else 0.6) * share)
                elif what == "halt":  # of all that runs here
                    world.sleep_until(world.t + (2.0 if long else 0.6) * share)
                elif what == "spike":
                    bad[0] = 2  # the next reading but none after it
                elif what == "ramp":
                    conductor.ramp(target)
                    assert world.commanded.tolist() == target.tolist()
                for _ in range(20 if long else 3):
                    conductor.tick(target)
            conductor.ramp(np.zeros(3))
            assert not world.commanded.any()
        except StiffoptError:
            ended = True
            assert any(what in ("stall", "halt") for what, _, _ in steps)
    assert not world.commanded.any()
    times = np.array([time for time, _ in world.writes])
    values = np.array([value for _, value in world.writes])
    assert ((values == 0) | ((values >= low) & (values <= high))).all()
    edge = min(max(0.0, low), high)  # what is nearest to nothing that can be held
    rate = COMMANDS.default_slew if slew is None else slew
    for k in range(1, len(values)):
        passed = min(times[k] - times[k - 1], COMMANDS.pause_periods * PERIOD)
        step = rate * passed + 1e-6
        vented = not values[k].any()  # at once, when the arm is closed or a command has expired
        for old, new in zip(values[k - 1], values[k], strict=True):
            smooth = abs(new - old) <= step
            gap = (old, new) in ((0, edge), (edge, 0)) or (
                new == 0 and abs(old) <= abs(edge) + step
            )
            assert smooth or gap or vented, (k, old, new)
    assert ended or not values[-1].any()


def test_two_processes_do_not_share_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    create_folder(folder, short(rig="sim", robot="stiff-flop-1"))
    with alone_in(folder):
        code = main(["experiment", "kinematics", str(SIM), "--resume", str(folder), "--no-plot"])
    assert code == 2
    assert "another process is at work" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in folder.iterdir()] == ["experiment.yaml"]


def test_a_probe_that_is_mounted_by_hand_needs_somebody(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stiffopt.plant.devices.SimulatedProbe.needs_a_person", True, raising=False)
    folder = tmp_path / "run"
    code = main(["experiment", "stiffness", str(SIM), "--out", str(folder), "--no-plot"])
    assert code == 2
    assert "at a terminal" in " ".join(capsys.readouterr().err.split())
    assert not folder.exists()


def test_readings_that_cannot_be_end_the_experiment(tmp_path: Path) -> None:
    description = load_rig_description(SIM)
    plant = description.plant.model_copy(update={"faults": True, "dynamics": "quasi-static"})
    rig = rig_for_programs(
        description.model_copy(update={"plant": plant}),
        stiffopt.load_robot("stiff-flop-1").description,
    )
    world = rig.world  # type: ignore[attr-defined]

    def spoil(done: float, total: float, text: str) -> None:
        if world.time > 3 and world.faults["supply"] == "ok":
            world.inject("supply", "garbage", 1)

    with rig, pytest.raises(DeviceError, match=r"channel 2 reads .*, which cannot be"):
        run_kinematics(rig, tmp_path, short(), rate=50.0, progress=spoil)
    assert not world.set_point.any()
