"""Report calibrations and validations: on the terminal, as a page with figures, and as JSON.

Terminal and page show the same tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, floor, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.cli.tables import MarkdownPage, TextTable, title
from stiffopt.directions import direction_name
from stiffopt.display import FIGURES, DisplayUnit, display_units
from stiffopt.errors import printable
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import (
    LEVELS,
    TIED,
    Comparison,
    Errors,
    FittedEstimate,
    coverage,
    together,
)
from stiffopt.identify.unknowns import BASE, SENSOR
from stiffopt.identify.validation import StiffnessComparison, compare_stiffness
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter
from stiffopt.plots import calibration as plots
from stiffopt.plots.wording import vector_text

_MAX_REMARKS = 8  # on the terminal; the page has all
_MAX_STIFFNESSES = 30
_MAX_PAIRS = 3
_MAX_DRAWN = 60  # measured stiffnesses
_ALL = "all"
_NORMAL = 1.96  # standard deviations of a 95 % interval
_OTHERS = "base in the tracker's frame, and sensors (moves from the robot file)"
_BEGIN = "how the logs begin"

# -- the terminal ---------------------------------------------------------------------------------


def calibration(result: CalibrationResult, out: str, report: str | None) -> RenderableType:
    """Return the report of a calibration for the terminal."""
    blocks: list[RenderableType] = [title(f"{result.robot.name}: calibration")]
    blocks.append(Text(f"  model  {result.structure.name}: {result.structure.words}"))
    if len(result.candidates) > 1:
        blocks += [Text(""), models_compared(result).renderable()]
    if result.calibrated:
        blocks += [Text(""), errors_before_and_after(result).renderable()]
    if result.held_back:
        blocks += [Text(""), errors_held_back(result).renderable()]
    if result.tables:
        rows = compare_stiffness(result.tables, result.before, result.robot)
        blocks += [Text(""), stiffnesses_compared(rows[:_MAX_STIFFNESSES]).renderable()]
        blocks += _more(len(rows) - _MAX_STIFFNESSES, "of these", report)
    for table in fitted_numbers(result, beginnings=False):
        blocks += [Text(""), table.renderable()]
    found = [f"{each.name}: {remark}" for each in result.calibrated for remark in each.remarks]
    blocks += _list("What was found in the logs", found, report)
    own = [remark for remark in result.remarks if remark not in found]
    pairs = [remark for remark in own if remark.startswith(TIED)]
    hidden = pairs[_MAX_PAIRS:]
    kept = [remark for remark in own if remark not in hidden]
    blocks += _list("What to make of it", kept, report, limit=None)
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
    blocks += [Text(""), errors_of_logs(robot, found).renderable()]
    covered = coverage_table(found)
    if covered.rows:
        blocks += [Text(""), covered.renderable()]
    blocks += _list("Training range", range_remarks(robot, found), report, limit=None)
    remarks = [f"{each.name}: {remark}" for each in found for remark in each.remarks]
    blocks += _list("What was found in the logs", remarks, report)
    if report is not None:
        blocks += [Text(""), Text(f"  report  {printable(report)}/report.md")]
    return Group(*blocks)


def _list(
    heading: str, remarks: Sequence[str], report: str | None, limit: int | None = _MAX_REMARKS
) -> list[RenderableType]:
    if not remarks:
        return []
    shown = remarks if limit is None else remarks[:limit]
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
    """Write the page of a calibration and its figures into a folder."""
    name = result.robot.name
    page = MarkdownPage(folder, f"{name}: calibration")
    page.text(
        f"The robot file `{Path(out).name}` holds all of this. The model is "
        f"*{result.structure.name}*: {result.structure.words}."
    )
    if result.calibrated:
        page.heading("Errors of the tip")
        page.table(errors_before_and_after(result))
        _draw_errors(page, result.robot, result.calibrated, result.nominal)
    if result.held_back:
        page.heading("What was held back")
        page.text("The model fitted to the rest predicts what it has not seen:")
        page.table(errors_held_back(result))
    if len(result.candidates) > 1:
        page.heading("Models")
        page.table(models_compared(result))
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
    for table in fitted_numbers(result, beginnings=True):
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
    """Write the page of a validation and its figures into a folder."""
    page = MarkdownPage(folder, f"{robot.name}: validation")
    page.text("Nothing of the robot was fitted to these logs.")
    page.heading("Errors of the tip")
    page.table(errors_of_logs(robot, found))
    page.heading("Training range")
    page.bullets(range_remarks(robot, found))
    page.heading("Figures")
    _draw_errors(page, robot, found, ())
    _remarks(page, [f"{each.name}: {remark}" for each in found for remark in each.remarks])
    page.write()


def _draw_errors(
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
    page.table(stiffnesses_compared(rows))
    if rows:
        page.figure(
            "stiffness.png", "Stiffness, measured and predicted",
            plots.plot_stiffnesses(rows[:_MAX_DRAWN], title=f"{result.robot.name}: stiffness"),
        )  # fmt: skip


def _remarks(page: MarkdownPage, remarks: Sequence[str]) -> None:
    if remarks:
        page.heading("Remarks")
        page.bullets(remarks)


# -- errors of the tip ----------------------------------------------------------------------------


def errors_before_and_after(result: CalibrationResult) -> TextTable:
    """Return the errors of the tip in each log, before and after calibration."""
    units = display_units()
    turns = any(each.angle is not None for each in (*result.nominal, *result.calibrated))
    heading = ("log", "before", "95 %", "after", "95 %", "max", "%", *(("axis",) * turns))

    def row(name: str, before: Errors, after: Errors) -> tuple[str, ...]:
        cells = [before.mean, before.p95, after.mean, after.p95, after.max]
        share = after.mean / result.robot.length * 100
        numbers = [*(_length(each) for each in cells), _decimals(share, 2)]
        return (name, *numbers, *((_angle(after),) * turns))

    rows = [
        row(one.name, one.errors, other.errors)
        for one, other in zip(result.nominal, result.calibrated, strict=True)
    ]
    if len(rows) > 1:
        rows.append(row(_ALL, together(result.nominal), together(result.calibrated)))
    return TextTable(
        f"Error of the tip in {units.length}, before and after",
        heading,
        tuple(rows),
        "before, after: mean distance from the measured tip in the logs that were fitted; %: mean "
        "after, of the arm's length" + f"; axis: mean angle in {units.angle}" * turns,
    )


def errors_of_logs(robot: RobotDescription, found: Sequence[Comparison]) -> TextTable:
    """Return the errors of the tip in each log, and the share of rows outside the calibration."""
    units = display_units()
    turns = any(each.angle is not None for each in found)
    known = robot.calibration is not None
    heading = ("log", "rows", "mean", "median", "95 %", "max", "%")
    further = ("axis",) * turns + ("outside",) * known

    def row(name: str, e: Errors, inside: float) -> tuple[str, ...]:
        numbers = [_length(each) for each in (e.mean, e.median, e.p95, e.max)]
        share = _decimals(e.mean / robot.length * 100, 2)
        return (
            name, f"{e.n}", *numbers, share, *((_angle(e),) * turns),
            *((_percent(1 - inside),) * known),
        )  # fmt: skip

    rows = [row(each.name, each.errors, float(each.inside.mean())) for each in found]
    if len(rows) > 1:
        inside = np.concatenate([each.inside for each in found])
        rows.append(row(_ALL, together(found), float(inside.mean())))
    remark = "distance of the predicted from the measured tip; %: mean, of the arm's length"
    remark += f"; axis: mean angle in {units.angle}" * turns
    if known:
        remark += "; outside: rows with pressures that the calibration had not seen"
    return TextTable(
        f"Error of the tip in {units.length}", (*heading, *further), tuple(rows), remark
    )


def coverage_table(found: Sequence[Comparison]) -> TextTable:
    """Return the share of measured tips within the regions about the predictions."""
    rows = tuple(
        (kind, f"{each.n}", *map(_with_interval, each.shares, each.intervals))
        for kind, each in coverage(found).items()
    )
    return TextTable(
        "Measured tips within the regions about the predictions",
        ("region", "rows", *(f"{level:.0%}".replace("%", " %") for level in LEVELS)),
        rows,
        "with history: about the prediction that knows what was commanded before; moving, settled: "
        "about the tip's pose at the commanded pressures alone, which change or are held; inside, "
        "outside: of what the calibration has seen; in percent, with half the 95 % interval from a "
        "bootstrap of blocks of two minutes",
    )


def _with_interval(share: float, interval: tuple[float, float]) -> str:
    """Return a share with half its interval, in percent: ``67 ±7``."""
    half = (interval[1] - interval[0]) / 2
    return f"{100 * share:.0f}" if np.isnan(half) else f"{100 * share:.0f} ±{100 * half:.0f}"


def range_remarks(robot: RobotDescription, found: Sequence[Comparison]) -> list[str]:
    """Return remarks on logs whose pressures lie outside those of the calibration."""
    if robot.calibration is None:
        return [
            f"the robot '{robot.name}' was not calibrated: there is no recorded range that these "
            "logs could leave"
        ]
    lines, unit = [], display_units().length
    for each in found:
        if each.inside.all():
            continue
        within, beyond = each.rows(each.inside).errors, each.outside
        what = _beyond(robot, each)
        text = (
            f"{each.name}: {_percent(1 - float(each.inside.mean()))} of the rows lie outside "
            f"what the calibration has seen{what}; the mean error there is "
            f"{_length(beyond.mean)} {unit}"
        )
        if within.n:
            text += f", elsewhere {_length(within.mean)} {unit}"
        lines.append(text)
    return lines or ["all pressures lie within what the calibration has seen"]


def _beyond(robot: RobotDescription, found: Comparison) -> str:
    """Name the channel that exceeds the recorded range most, and the excess, in parentheses."""
    calibration = robot.calibration
    if calibration is None or not calibration.pressure_max:
        return ""
    highest = found.pressures.max(axis=0)
    seen = np.array(calibration.pressure_max)
    over = highest - seen
    worst = int(np.argmax(over))
    if over[worst] > 0.02 * seen.max():
        unit = display_units().pressure
        return (
            f" ({robot.channel_name(worst)} goes to {unit.text(highest[worst], '.2f')}, it was "
            f"recorded to {unit.text(seen[worst], '.2f')})"
        )
    return " (combinations of pressures that are higher together, or below what was recorded)"


# -- models ---------------------------------------------------------------------------------------


def models_compared(result: CalibrationResult) -> TextTable:
    """Return the compared models with their errors on held-back data."""
    chosen = result.structure.name
    rows = []
    for each in result.candidates:
        worst = max(each.folds, key=lambda name: each.folds[name].mean)
        mark = "  <- chosen" if each.structure.name == chosen else ""
        rows.append(
            (
                each.structure.name + mark,
                _length(each.score),
                _length(each.folds[worst].mean),
                worst,
            )
        )
    return TextTable(
        "Models (docs/calibration.md), by their error in what was held back",
        ("model", f"mean {display_units().length}", "worst", "in"),
        tuple(rows),
        "the simplest of those that predict about as well as the best is chosen",
        words=("in",),
    )


def errors_held_back(result: CalibrationResult) -> TextTable:
    """Return the errors of the chosen model on held-back data."""
    return TextTable(
        "Error of the tip in what was held back (the others are fitted)",
        ("held back", f"mean {display_units().length}", "95 %", "max"),
        tuple(
            (name, _length(e.mean), _length(e.p95), _length(e.max))
            for name, e in result.held_back.items()
        ),
    )


# -- numbers that were fitted ---------------------------------------------------------------------


def fitted_numbers(result: CalibrationResult, *, beginnings: bool) -> list[TextTable]:
    """Return the fitted numbers with their 95 % intervals, in a table for each segment.

    With `beginnings`, also the initial state and the zero of each log.
    """
    groups: dict[str, list[tuple[str, ...]]] = {}
    for each in result.estimates:
        title, words = _place(each)
        if title != _BEGIN or beginnings:
            groups.setdefault(title, []).append(_number_row(each, words))
    heading = ("", "robot file", "fitted", "95 % interval", "unit", "learnt")
    return [
        TextTable(title, heading, tuple(rows), words=("unit",)) for title, rows in groups.items()
    ]


def _place(estimate: FittedEstimate) -> tuple[str, str]:
    """Return the title of a number's table, and its name there."""
    if not estimate.key:
        begins = estimate.name.startswith("zero of ") or " at the beginning of " in estimate.name
        words = estimate.name.replace(f"{BASE},", "base,").replace(f"{SENSOR},", "sensor,")
        return (_BEGIN if begins else _OTHERS), words
    title = f"segment {Parameter(estimate.key).segment + 1}"
    return title, estimate.name.replace(f", {title}", ",").removesuffix(",")


def _number_row(estimate: FittedEstimate, words: str) -> tuple[str, ...]:
    unit = _unit(estimate)
    low, value, high = (unit.of(x) for x in (estimate.low, estimate.value, estimate.high))
    half = max(high - low, 0.0) / 2
    places = 1 - floor(log10(half)) if half > 0 and isfinite(half) else 3
    places = min(max(places, 0), 5)
    before = _plain(unit.of(estimate.before), places) if estimate.key else "-"
    learnt = f"{estimate.learnt * 100:.0f} %"
    return (
        words, before, _decimals(value, places),
        f"{_decimals(low, places)} to {_decimals(high, places)}", unit.name, learnt,
    )  # fmt: skip


def _unit(estimate: FittedEstimate) -> DisplayUnit:
    """Return the display unit of a fitted number; always kPa for moduli."""
    if estimate.key.endswith(".share"):
        return DisplayUnit("%", 100.0)
    return {
        "Pa": DisplayUnit("kPa", 1e-3),
        "m": display_units().length,
        "rad": display_units().angle,
        "s": DisplayUnit("s"),
    }.get(estimate.unit, DisplayUnit(""))


def _plain(value: float, places: int) -> str:
    """Format a number as in a file, without trailing zeros."""
    return f"{round(value, max(places, 3)) + 0.0:.8g}"


# -- stiffness ------------------------------------------------------------------------------------


def stiffnesses_compared(rows: Sequence[StiffnessComparison]) -> TextTable:
    """Return a table of measured and predicted stiffness."""
    unit, pressure = display_units().stiffness, display_units().pressure

    def text(value: float | None) -> str:
        return "-" if value is None else unit.number(value, FIGURES)

    return TextTable(
        f"Stiffness in {unit}, measured and predicted",
        (f"pressures ({pressure})", "direction", "measured", "before", "after", "off by"),
        tuple(
            (
                vector_text(row.pressures, pressure),
                f"{direction_name(row.direction)}, {row.boundary}",
                f"{text(row.measured)} +- {_two(unit.of(_NORMAL * row.sigma))}",
                text(row.before),
                text(row.after),
                "-" if row.after is None else f"{(row.after / row.measured - 1) * 100:+.0f} %",
            )
            for row in rows
        ),
        "+-: 95 % interval of the measurement; off by: after, relative to the measured value",
        words=("direction",),
    )


# -- words ----------------------------------------------------------------------------------------


def _length(value: float) -> str:
    unit = display_units().length
    return _decimals(unit.of(value), max(0, 2 + unit.more_decimals))


def _decimals(value: float, places: int) -> str:
    """Format a number with decimals; a dash for NaN, and no minus before zero."""
    return f"{round(value, places) + 0.0:.{places}f}" if isfinite(value) else "-"


def _two(value: float) -> str:
    """Format a number with two significant figures, without an exponent below a million."""
    return f"{float(f'{value:.2g}'):g}"


def _angle(errors: Errors) -> str:
    return "-" if errors.angle is None else display_units().angle.number(errors.angle, ".1f")


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %" if share == 0 or share >= 0.01 else f"{share * 100:.1g} %"


# -- for programs ---------------------------------------------------------------------------------


def validation_record(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    """Return the errors of all logs together and of each, for JSON."""
    return {
        **_outside_record(robot, found),
        "robot": robot.name,
        "coverage": {
            kind: {
                "n": each.n,
                **{f"{level:g}": share for level, share in each.by_level.items()},
                "intervals": [
                    None if np.isnan(low) else [low, high] for low, high in each.intervals
                ],
            }
            for kind, each in coverage(found).items()
        },
        "remarks": [f"{each.name}: {remark}" for each in found for remark in each.remarks],
        "logs": {each.name: _outside_record(robot, [each]) for each in found},
    }


def calibration_record(result: CalibrationResult, out: str, report: str | None) -> dict[str, Any]:
    """Return the result of a calibration for JSON."""
    length = result.before.length
    return {
        "robot": result.robot.name,
        "out": out,
        "report": report,
        "unfit": result.unfit,
        "model": result.structure.name,
        "strain_laws": [segment.strain_law for segment in result.robot.segments],
        "models": [
            {
                "name": each.structure.name,
                "held_back_mean_mm": 1e3 * each.score,
                "held_back": {name: _errors_record(e, length) for name, e in each.folds.items()},
            }
            for each in result.candidates
        ],
        "before": _comparisons_record(result.nominal, length),
        "after": _comparisons_record(result.calibrated, result.robot.length),
        "held_back": {name: _errors_record(e, length) for name, e in result.held_back.items()},
        "parameters": [
            {
                "name": each.name,
                "key": each.key or None,
                "unit": each.unit,
                "before": each.before,
                "value": each.value,
                "interval_95": [each.low, each.high],
                "learnt": each.learnt,
                "tolerances_from_before": each.far,
            }
            for each in result.estimates
        ],
        "remarks": list(result.remarks),
    }


def _comparisons_record(found: Sequence[Comparison], length: float) -> dict[str, Any] | None:
    if not found:
        return None
    logs = {each.name: _errors_record(each.errors, length) for each in found}
    return {**_errors_record(together(found), length), "logs": logs}


def _outside_record(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    record = _errors_record(together(found), robot.length)
    if robot.calibration is None:
        return {**record, "outside_training_percent": None, "outside_training": None}
    inside = np.concatenate([each.inside for each in found])
    beyond = [each.rows(~each.inside) for each in found if not each.inside.all()]
    return {
        **record,
        "outside_training_percent": float(np.mean(~inside) * 100),
        "outside_training": _errors_record(together(beyond), robot.length) if beyond else None,
    }


def _errors_record(errors: Errors, length: float) -> dict[str, Any]:
    names = ("mean", "median", "p95", "max")
    return {
        "n": errors.n,
        "position_error_mm": {name: 1e3 * getattr(errors, name) for name in names},
        "position_error_percent_of_length": errors.mean / length * 100,
        "angle_error_deg": None if errors.angle is None else degrees(errors.angle),
    }
