"""What a calibration or a validation has found, for people at a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.cli import calibration_facts as facts
from stiffopt.cli.calibration_facts import TextTable
from stiffopt.errors import printable
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import TIED, Comparison
from stiffopt.model.description import RobotDescription

_MOST_REMARKS = 8  # of the logs; the report has all
_MOST_STIFFNESSES = 30
_MOST_PAIRS = 3


def calibration(result: CalibrationResult, out: str, report: str | None) -> RenderableType:
    """Return what a calibration has found."""
    blocks: list[RenderableType] = [_title(f"{result.robot.name}: calibration")]
    blocks.append(Text(f"  model  {result.structure.name}: {result.structure.words}"))
    if len(result.candidates) > 1:
        blocks += _block(facts.models(result))
    if result.calibrated:
        blocks += _block(facts.before_and_after(result))
    if result.held_back:
        blocks += _block(facts.held_back(result))
    if result.tables:
        rows = facts.stiffness_rows(result.tables, result.before, result.robot)
        blocks += _block(facts.stiffnesses(rows[:_MOST_STIFFNESSES]))
        blocks += _more(len(rows) - _MOST_STIFFNESSES, "of these", report)
    for table in facts.numbers(result, beginnings=False):
        blocks += _block(table)
    found = [f"{each.name}: {remark}" for each in result.calibrated for remark in each.remarks]
    blocks += _remarks("What was found in the logs", found, report)
    own = [remark for remark in result.remarks if remark not in found]
    pairs = [remark for remark in own if remark.startswith(TIED)]
    hidden = pairs[_MOST_PAIRS:]
    kept = [remark for remark in own if remark not in hidden]
    blocks += _remarks("What to make of it", kept, report, most=None)
    blocks += _more(len(hidden), f"of '{TIED}'", report)
    blocks += [Text(""), Text(f"  robot file  {printable(out)}")]
    if report is not None:
        blocks.append(Text(f"  report      {printable(report)}/report.md"))
    return Group(*blocks)


def validation(
    robot: RobotDescription, found: Sequence[Comparison], report: str | None
) -> RenderableType:
    """Return what a validation has found."""
    blocks: list[RenderableType] = [_title(f"{robot.name}: validation")]
    blocks += _block(facts.after_only(robot, found))
    blocks += _remarks("Training range", facts.ranges(robot, found), report, most=None)
    remarks = [f"{each.name}: {remark}" for each in found for remark in each.remarks]
    blocks += _remarks("What was found in the logs", remarks, report)
    if report is not None:
        blocks += [Text(""), Text(f"  report  {printable(report)}/report.md")]
    return Group(*blocks)


def _title(text: str) -> Text:
    return Text(printable(text), "bold")


def _block(table: TextTable) -> list[RenderableType]:
    grid = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    for number, heading in enumerate(table.heading):
        left = number == 0 or heading in ("it has", "worst", "unit", "direction")
        grid.add_column(
            heading, justify="left" if left else "right", no_wrap=number > 0 and not left,
            overflow="fold",
        )  # fmt: skip
    for row in table.rows:
        grid.add_row(*(printable(cell) for cell in row))
    blocks: list[RenderableType] = [Text(""), Text(f"  {printable(table.title)}", "bold"), grid]
    if table.remark:
        blocks.append(Text(f"  {table.remark}", "dim"))
    return blocks


def _remarks(
    title: str, remarks: Sequence[str], report: str | None, most: int | None = _MOST_REMARKS
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
        Text(""), Text(f"  {title}", "bold"), grid,
        *_more(len(remarks) - len(shown), "of these", report),
    ]  # fmt: skip


def _more(count: int, what: str, report: str | None) -> list[RenderableType]:
    if count <= 0:
        return []
    where = f"{printable(report)}/report.md has all" if report else "--report DIR tells all"
    return [Text(f"  and {count} more {what}; {where}", "dim")]
