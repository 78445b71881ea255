"""Measuring stiffness with a probe, on a rig as stiff as the test makes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiment_runs import (  # noqa: F401
    assert_gentle,
    first_row_alone,
    golden,
    model,
    quick,
    stop_at,
    whole_mcap,
)
from fake_rig import CLEARANCE, FakeWorld, fake_rig, straight, world_of
from stiffopt.errors import DeviceError, InputError
from stiffopt.experiments import evaluate_stiffness, run_stiffness
from stiffopt.experiments.probing import PointsFile
from stiffopt.experiments.slope import fit_line
from stiffopt.logs import read_log, read_mcap_log

pytestmark = pytest.mark.usefixtures("first_row_alone")


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
