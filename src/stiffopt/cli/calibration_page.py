"""The page of a calibration or a validation: Markdown with its figures beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stiffopt.cli import calibration_facts as facts
from stiffopt.cli.calibration_facts import StiffnessRow, TextTable
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import Comparison
from stiffopt.model.description import RobotDescription
from stiffopt.plots import calibration as plots
from stiffopt.plots.figures import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.md"
_MOST_ROWS = 60  # of measured stiffnesses that are drawn


class _Page:
    """Markdown that grows, and the folder of its figures."""

    def __init__(self, folder: Path, title: str) -> None:
        self._folder = folder
        self._lines = [f"# {title}", ""]

    def heading(self, text: str) -> None:
        self._lines += [f"## {text}", ""]

    def text(self, text: str) -> None:
        self._lines += [text, ""]

    def bullets(self, items: Sequence[str]) -> None:
        self._lines += [*(f"- {_plain(item)}" for item in items), ""]

    def table(self, table: TextTable) -> None:
        align = "".join(" --- |" if i == 0 else " ---: |" for i in range(len(table.heading)))
        self._lines += [f"| {' | '.join(table.heading)} |", f"|{align}"]
        self._lines += [f"| {' | '.join(map(_cell, row))} |" for row in table.rows]
        self._lines.append("")
        if table.remark:
            self.text(f"{table.remark[:1].upper()}{table.remark[1:]}.")

    def figure(self, name: str, alt: str, figure: Figure) -> None:
        save_figure(figure, self._folder / name)
        self._lines += [f"![{alt}]({name})", ""]

    def write(self) -> None:
        (self._folder / PAGE).write_text("\n".join(self._lines), encoding="utf-8")


def write_calibration(folder: Path, result: CalibrationResult, out: str) -> None:
    """Write the page of a calibration and its figures into a folder.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    FileError
        If a figure cannot be written.
    """
    name = result.robot.name
    page = _Page(folder, f"{name}: calibration")
    page.text(
        f"The robot file `{Path(out).name}` holds all of this. The model is "
        f"*{result.structure.name}*: {result.structure.words}."
    )
    if result.calibrated:
        page.heading("Errors of the tip")
        page.table(facts.before_and_after(result))
        _errors(page, result.robot, result.calibrated, result.nominal)
    if result.held_back:
        page.heading("What was held back")
        page.text("The model fitted to the rest predicts what it has not seen:")
        page.table(facts.held_back(result))
    if len(result.candidates) > 1:
        page.heading("Models")
        page.table(facts.models(result))
        page.figure(
            "models.png", "Errors of each model in what was held back",
            plots.plot_models(
                result.candidates, result.structure.name, title=f"{name}: models compared"
            ),
        )  # fmt: skip
    if result.tables:
        _stiffness(page, result)
    page.heading("Numbers that were fitted")
    page.text(
        "Intervals hold the true value with 95 % probability if the model is right. *Learnt* is "
        "the share of the robot file's own uncertainty (its variance) that the data removed: near "
        "0 %, a number is still what the robot file said."
    )
    for table in facts.numbers(result, beginnings=True):
        page.text(f"**{table.title[:1].upper()}{table.title[1:]}**")
        page.table(table)
    _remarks(page, result.remarks)
    page.heading("How to use it")
    file = Path(out).name
    page.bullets(
        [
            f"Check it on a log of another day: `stiffopt validate --robot {file} LOG...`",
            f"Solve tasks with it: write `robot: {file}` in the task file. The answer then says "
            "how well the tip and its stiffness are known.",
            f'In Python: `robot = stiffopt.load_robot("{file}")` and '
            "`robot.tip_uncertainty(pressures)`.",
        ]
    )
    page.write()


def write_validation(folder: Path, robot: RobotDescription, found: Sequence[Comparison]) -> None:
    """Write the page of a validation and its figures into a folder.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    FileError
        If a figure cannot be written.
    """
    page = _Page(folder, f"{robot.name}: validation")
    page.text("Nothing of the robot was fitted to these logs.")
    page.heading("Errors of the tip")
    page.table(facts.after_only(robot, found))
    page.heading("Training range")
    page.bullets(facts.ranges(robot, found))
    page.heading("Figures")
    _errors(page, robot, found, ())
    _remarks(page, [f"{each.name}: {remark}" for each in found for remark in each.remarks])
    page.write()


def _errors(
    page: _Page,
    robot: RobotDescription,
    found: Sequence[Comparison],
    before: Sequence[Comparison],
) -> None:
    name = robot.name
    body = robot.recordings.frame if robot.recordings is not None else None
    frame = "the tracker's frame" if body is None else f"the frame of the body '{body}'"
    page.figure(
        "errors_over_time.png", "Error of the tip over time",
        plots.plot_errors_over_time(found, before, title=f"{name}: error of the tip"),
    )  # fmt: skip
    page.figure(
        "errors_over_pressure.png", "Error of the tip over pressure",
        plots.plot_errors_over_pressure(found, robot, title=f"{name}: error over pressure"),
    )  # fmt: skip
    page.figure(
        "paths.png", "Measured and predicted paths of the tip",
        plots.plot_paths(found, title=f"{name}: path of the tip", frame=frame),
    )  # fmt: skip
    page.figure(
        "tip_over_time.png", "Measured and predicted tip over time",
        plots.plot_tip_over_time(found, title=f"{name}: tip over time", frame=frame),
    )  # fmt: skip


def _stiffness(page: _Page, result: CalibrationResult) -> None:
    rows = facts.stiffness_rows(result.tables, result.before, result.robot)
    page.heading("Stiffness")
    page.table(facts.stiffnesses(rows))
    if rows:
        page.figure(
            "stiffness.png", "Stiffness, measured and predicted",
            plots.plot_stiffnesses(
                [_measured(row) for row in rows[:_MOST_ROWS]],
                title=f"{result.robot.name}: stiffness",
            ),
        )  # fmt: skip


def _measured(row: StiffnessRow) -> plots.MeasuredStiffness:
    label = f"{row.direction} at {row.pressures} bar"
    if row.boundary != "free":
        label += f", {row.boundary}"
    return plots.MeasuredStiffness(label, row.measured, row.sigma, row.before, row.after)


def _remarks(page: _Page, remarks: Sequence[str]) -> None:
    if remarks:
        page.heading("Remarks")
        page.bullets(remarks)


def _plain(text: str) -> str:
    """Text that Markdown leaves as it is; what is between backticks, it does anyway."""
    parts = text.split("`")
    parts[::2] = [
        part.replace("*", r"\*").replace("_", r"\_").replace("<", "&lt;") for part in parts[::2]
    ]
    return "`".join(parts)


def _cell(text: str) -> str:
    return _plain(text).replace("|", r"\|")
