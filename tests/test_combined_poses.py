"""Poses of all channels together: spread, held and evaluated."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import stiffopt
from experiment_runs import assert_gentle, first_row_alone, model, short, whole_mcap  # noqa: F401
from fake_rig import FakeWorld, fake_rig, straight, world_of
from stiffopt.errors import InputError
from stiffopt.experiments import evaluate_coverage, run_kinematics
from stiffopt.experiments.conductor import CONDUCTOR
from stiffopt.experiments.coverage import coverage_for, spread_pressures
from stiffopt.experiments.kinematics_result import read_rounds
from stiffopt.logs import Log, read_mcap_log

pytestmark = pytest.mark.usefixtures("first_row_alone")


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
    assert notes[-1].startswith("in 3 of 3 combined poses the tip still moved after 2 s: soft arms")
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
