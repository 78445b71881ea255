"""Recording and evaluating kinematics, on a rig whose tip is where the test puts it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiment_runs import assert_gentle, first_row_alone, model, short, stop_at, whole_mcap  # noqa: F401
from fake_rig import fake_rig, world_of
from stiffopt.errors import DeviceError, InputError
from stiffopt.experiments.kinematics import KinematicsSettings, PressureSequence, run_kinematics
from stiffopt.experiments.kinematics_result import evaluate_kinematics, read_recordings
from stiffopt.logs import read_log, read_mcap_log

pytestmark = pytest.mark.usefixtures("first_row_alone")


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


@pytest.mark.usefixtures("whole_mcap")
def test_a_recording_holds_what_was_so_at_each_frame(tmp_path: Path) -> None:
    rig = fake_rig(slew=3e5)
    with rig:
        assert run_kinematics(rig, tmp_path, short(), rate=100.0) == []
    ended = 0.0
    for repetition, log in enumerate(read_recordings(tmp_path, short()), start=1):
        written = read_log(tmp_path / f"kinematics_{repetition}.csv").time
        assert 0 < written[0] - ended < 5  # one clock: the arm rests between them
        ended = written[-1]
        other = read_mcap_log(tmp_path / f"kinematics_{repetition}.mcap")
        np.testing.assert_allclose(other.time, written, atol=2e-6)
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
    assert repetition == 2
    assert not list(tmp_path.glob("*.part.*"))


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
