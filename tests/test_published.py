"""What was published of an arm, beside what experiments on it find."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stiffopt.cli.experiment_report import kinematics_report, stiffness_report
from stiffopt.display import choose_units
from stiffopt.experiments import KinematicsSettings, StiffnessSettings
from stiffopt.experiments.kinematics_result import KinematicsResult
from stiffopt.experiments.slope import SlopeEstimate
from stiffopt.experiments.stiffness_result import StiffnessCell, StiffnessResult
from stiffopt.logs import read_stiffness_table
from stiffopt.model.manipulator import load_robot
from stiffopt.rig.config import load_rig_description

PAPER = Path(__file__).parent.parent / "rig" / "paper.yaml"


def result() -> StiffnessResult:
    """Stiffness at the ends of the paper's range, each 10 % above the published one."""
    settings = StiffnessSettings(channels=3, pressures=(0.0, 1.5e5))
    table = read_stiffness_table(PAPER.parent / "../calibration/stiff-flop-1-stiffness.csv")
    cells = []
    for row, (p, direction) in enumerate(
        (p, d) for p in settings.pressures for d in settings.directions
    ):
        value = 1.1 * float(table.stiffness[row])
        estimate = SlopeEstimate(value, 0.02 * value, 0.01 * value, 0.01 * value, 5)
        cells.append(StiffnessCell(p, direction, estimate, None, (value,), 10, 0.9 * value))
    return StiffnessResult(settings, tuple(cells), np.array([0.0, 1.5e5]), np.ones((2, 3)))


def test_the_papers_rig_names_what_was_published() -> None:
    published = load_rig_description(PAPER).published
    assert published is not None
    assert (published.tip_error, published.largest_tip_error) == (0.005, 0.01)
    assert published.stiffness is not None
    table = read_stiffness_table(PAPER.parent / published.stiffness)
    assert table.stiffness[0] == 19


def test_stiffness_stands_beside_what_was_published(monkeypatch: pytest.MonkeyPatch) -> None:
    table = read_stiffness_table(PAPER.parent / "../calibration/stiff-flop-1-stiffness.csv")
    model = load_robot("stiff-flop-1-calibrated")
    choose_units("N/cm")
    try:
        report = stiffness_report(result(), model, table)
    finally:
        choose_units(None)
    assert report.published is not None
    assert len(report.published.rows) == 6
    first, last = report.published.rows[0], report.published.rows[-1]
    assert first[:3] == ("0", "x", "0.19 +- 0.03")
    assert first[3] == "0.2090 +- 0.0021"  # as many decimals as its interval, in any unit
    assert first[4] == "+10 %"
    assert last[:3] == ("1.5", "z", "0.18 +- 0.03")  # pushed along -z, the same line
    assert last[6] == "-1 %"
    assert stiffness_report(result(), model).published is None


def test_errors_of_the_tip_stand_beside_what_was_published() -> None:
    published = load_rig_description(PAPER).published
    time = np.linspace(0, 40, 101)
    errors = np.outer(np.linspace(0, 1, 101), [4e-3, 8e-3, 1e-3])
    pressures = np.zeros((101, 3))
    zeros = np.zeros((101, 3))
    found = KinematicsResult(
        1, time, pressures, zeros, zeros, zeros, np.linalg.norm(errors, axis=1), errors,
        np.linalg.norm(errors, axis=1), 0.09,
    )  # fmt: skip
    model = load_robot("stiff-flop-1-calibrated")
    settings = KinematicsSettings(channels=3, poses=0)
    report = kinematics_report(found, None, settings, model, published)
    assert report.published is not None
    assert report.published.rows[0] == ("x", "3.80", "4.00", "100 %", "5", "10")
    assert report.published.rows[1][3] == "62 %"  # of the time within 5 mm


def test_the_figure_shows_what_was_published() -> None:
    pytest.importorskip("matplotlib")
    from stiffopt.plots.experiments import plot_stiffness

    table = read_stiffness_table(PAPER.parent / "../calibration/stiff-flop-1-stiffness.csv")
    figure = plot_stiffness(result(), published=table)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert "published" in labels
