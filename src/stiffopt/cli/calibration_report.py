"""Reports of a calibration and of a validation: for the terminal, and as a page with figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.cli import calibration_tables as tables
from stiffopt.cli.tables import MarkdownPage, title
from stiffopt.errors import printable
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import TIED, Comparison
from stiffopt.identify.validation import compare_stiffness
from stiffopt.model.description import RobotDescription
from stiffopt.plots import calibration as plots

_MOST_REMARKS = 8  # of the logs, at the terminal; the page has all
_MOST_STIFFNESSES = 30
_MOST_PAIRS = 3
_MOST_DRAWN = 60  # measured stiffnesses

# -- the terminal ---------------------------------------------------------------------------------


def calibration(result: CalibrationResult, out: str, report: str | None) -> RenderableType:
    """Return the report of a calibration for the terminal."""
    blocks: list[RenderableType] = [title(f"{result.robot.name}: calibration")]
    blocks.append(Text(f"  model  {result.structure.name}: {result.structure.words}"))
    if len(result.candidates) > 1:
        blocks += [Text(""), tables.models_compared(result).renderable()]
    if result.calibrated:
        blocks += [Text(""), tables.errors_before_and_after(result).renderable()]
    if result.held_back:
        blocks += [Text(""), tables.errors_held_back(result).renderable()]
    if result.tables:
        rows = compare_stiffness(result.tables, result.before, result.robot)
        blocks += [Text(""), tables.stiffnesses_compared(rows[:_MOST_STIFFNESSES]).renderable()]
        blocks += _more(len(rows) - _MOST_STIFFNESSES, "of these", report)
    for table in tables.fitted_numbers(result, beginnings=False):
        blocks += [Text(""), table.renderable()]
    found = [f"{each.name}: {remark}" for each in result.calibrated for remark in each.remarks]
    blocks += _list("What was found in the logs", found, report)
    own = [remark for remark in result.remarks if remark not in found]
    pairs = [remark for remark in own if remark.startswith(TIED)]
    hidden = pairs[_MOST_PAIRS:]
    kept = [remark for remark in own if remark not in hidden]
    blocks += _list("What to make of it", kept, report, most=None)
    blocks += _more(len(hidden), f"of '{TIED}'", report)
    blocks += [Text(""), Text(f"  robot file  {printable(out)}")]
    if report is not None:
        blocks.append(Text(f"  report      {printable(report)}/report.md"))
    return Group(*blocks)


def validation(
    robot: RobotDescription, found: Sequence[Comparison], report: str | None
) -> RenderableType:
    """Return the report of a validation for the terminal."""
    blocks: list[RenderableType] = [title(f"{robot.name}: validation")]
    blocks += [Text(""), tables.errors_of_logs(robot, found).renderable()]
    blocks += _list("Training range", tables.range_remarks(robot, found), report, most=None)
    remarks = [f"{each.name}: {remark}" for each in found for remark in each.remarks]
    blocks += _list("What was found in the logs", remarks, report)
    if report is not None:
        blocks += [Text(""), Text(f"  report  {printable(report)}/report.md")]
    return Group(*blocks)


def _list(
    heading: str, remarks: Sequence[str], report: str | None, most: int | None = _MOST_REMARKS
) -> list[RenderableType]:
    if not remarks:
        return []
    shown = remarks if most is None else remarks[:most]
    grid = Table.grid(padding=(0, 1), pad_edge=False)
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for remark in shown:
        grid.add_row("  -", printable(remark))
    return [
        Text(""), Text(f"  {heading}", "bold"), grid,
        *_more(len(remarks) - len(shown), "of these", report),
    ]  # fmt: skip


def _more(count: int, what: str, report: str | None) -> list[RenderableType]:
    if count <= 0:
        return []
    where = f"{printable(report)}/report.md has all" if report else "--report DIR tells all"
    return [Text(f"  and {count} more {what}; {where}", "dim")]


# -- the page -------------------------------------------------------------------------------------


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
    page = MarkdownPage(folder, f"{name}: calibration")
    page.text(
        f"The robot file `{Path(out).name}` holds all of this. The model is "
        f"*{result.structure.name}*: {result.structure.words}."
    )
    if result.calibrated:
        page.heading("Errors of the tip")
        page.table(tables.errors_before_and_after(result))
        _errors(page, result.robot, result.calibrated, result.nominal)
    if result.held_back:
        page.heading("What was held back")
        page.text("The model fitted to the rest predicts what it has not seen:")
        page.table(tables.errors_held_back(result))
    if len(result.candidates) > 1:
        page.heading("Models")
        page.table(tables.models_compared(result))
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
    for table in tables.fitted_numbers(result, beginnings=True):
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
    page = MarkdownPage(folder, f"{robot.name}: validation")
    page.text("Nothing of the robot was fitted to these logs.")
    page.heading("Errors of the tip")
    page.table(tables.errors_of_logs(robot, found))
    page.heading("Training range")
    page.bullets(tables.range_remarks(robot, found))
    page.heading("Figures")
    _errors(page, robot, found, ())
    _remarks(page, [f"{each.name}: {remark}" for each in found for remark in each.remarks])
    page.write()


def _errors(
    page: MarkdownPage,
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


def _stiffness(page: MarkdownPage, result: CalibrationResult) -> None:
    rows = compare_stiffness(result.tables, result.before, result.robot)
    page.heading("Stiffness")
    page.table(tables.stiffnesses_compared(rows))
    if rows:
        page.figure(
            "stiffness.png", "Stiffness, measured and predicted",
            plots.plot_stiffnesses(rows[:_MOST_DRAWN], title=f"{result.robot.name}: stiffness"),
        )  # fmt: skip


def _remarks(page: MarkdownPage, remarks: Sequence[str]) -> None:
    if remarks:
        page.heading("Remarks")
        page.bullets(remarks)
