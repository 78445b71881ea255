"""What a calibration or a validation found, as tables for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, floor, isfinite, log10

import numpy as np

from stiffopt.cli.tables import TextTable
from stiffopt.directions import direction_name
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import Comparison, Errors, FittedEstimate, together
from stiffopt.identify.unknowns import BASE, SENSOR
from stiffopt.identify.validation import StiffnessComparison
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter
from stiffopt.plots.wording import BAR, MM, figures, vector_text

_UNITS = {"Pa": ("kPa", 1e-3), "m": ("mm", 1e3), "rad": ("deg", 180 / np.pi), "s": ("s", 1.0)}
_ALL = "all"
_NORMAL = 1.96  # standard deviations of a 95 % interval
_OTHERS = "base in the tracker's frame, and sensors (moves from the robot file)"
_BEGIN = "how the logs begin"


# -- errors of the tip ----------------------------------------------------------------------------


def errors_before_and_after(result: CalibrationResult) -> TextTable:
    """Errors of the tip in each log, before and after calibration."""
    turns = any(each.angle is not None for each in (*result.nominal, *result.calibrated))
    heading = ("log", "before", "95 %", "after", "95 %", "max", "%", *(("axis",) * turns))

    def row(name: str, before: Errors, after: Errors) -> tuple[str, ...]:
        cells = [before.mean, before.p95, after.mean, after.p95, after.max]
        share = after.mean / result.robot.length * 100
        numbers = [*(_millimetres(each) for each in cells), _decimals(share, 2)]
        return (name, *numbers, *((_angle(after),) * turns))

    rows = [
        row(one.name, one.errors, other.errors)
        for one, other in zip(result.nominal, result.calibrated, strict=True)
    ]
    if len(rows) > 1:
        rows.append(row(_ALL, together(result.nominal), together(result.calibrated)))
    return TextTable(
        "Error of the tip in mm, before and after",
        heading,
        tuple(rows),
        "before, after: mean distance from the measured tip in the logs that were fitted; %: mean "
        "after, of the arm's length" + "; axis: mean angle in deg" * turns,
    )


def errors_of_logs(robot: RobotDescription, found: Sequence[Comparison]) -> TextTable:
    """Errors of the tip in each log, and the share of rows outside the range that was seen."""
    turns = any(each.angle is not None for each in found)
    known = robot.calibration is not None
    heading = ("log", "rows", "mean", "median", "95 %", "max", "%")
    further = ("axis",) * turns + ("outside",) * known

    def row(name: str, e: Errors, inside: float) -> tuple[str, ...]:
        numbers = [_millimetres(each) for each in (e.mean, e.median, e.p95, e.max)]
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
    remark += "; axis: mean angle in deg" * turns
    if known:
        remark += "; outside: rows with pressures that the calibration had not seen"
    return TextTable("Error of the tip in mm", (*heading, *further), tuple(rows), remark)


def range_remarks(robot: RobotDescription, found: Sequence[Comparison]) -> list[str]:
    """Return sentences on the logs whose pressures the calibration had not seen."""
    if robot.calibration is None:
        return [
            f"the robot '{robot.name}' was not calibrated: there is no recorded range that these "
            "logs could leave"
        ]
    lines = []
    for each in found:
        if each.inside.all():
            continue
        within, beyond = each.rows(each.inside).errors, each.outside
        what = _beyond(robot, each)
        text = (
            f"{each.name}: {_percent(1 - float(each.inside.mean()))} of the rows lie outside "
            f"what the calibration has seen{what}; the mean error there is "
            f"{_millimetres(beyond.mean)} mm"
        )
        if within.n:
            text += f", elsewhere {_millimetres(within.mean)} mm"
        lines.append(text)
    return lines or ["all pressures lie within what the calibration has seen"]


def _beyond(robot: RobotDescription, found: Comparison) -> str:
    """Which channel exceeds the recorded range most, and by how much, in parentheses."""
    calibration = robot.calibration
    if calibration is None or not calibration.pressure_max:
        return ""
    highest = found.pressures.max(axis=0)
    seen = np.array(calibration.pressure_max)
    over = highest - seen
    worst = int(np.argmax(over))
    if over[worst] > 0.02 * seen.max():
        return (
            f" ({robot.channel_name(worst)} goes to {highest[worst] * BAR:.2f} bar, it was "
            f"recorded to {seen[worst] * BAR:.2f} bar)"
        )
    return " (combinations of pressures that are higher together, or below what was recorded)"


# -- models ---------------------------------------------------------------------------------------


def models_compared(result: CalibrationResult) -> TextTable:
    """Models that were compared, by their errors in what each was not fitted to."""
    chosen = result.structure.name
    rows = []
    for each in result.candidates:
        worst = max(each.folds, key=lambda name: each.folds[name].mean)
        mark = "  <- chosen" if each.structure.name == chosen else ""
        rows.append(
            (
                each.structure.name + mark,
                each.structure.words,
                _millimetres(each.score),
                f"{_millimetres(each.folds[worst].mean)} ({worst})",
            )
        )
    return TextTable(
        "Models, by their error in what was held back",
        ("model", "it has", "mean mm", "worst"),
        tuple(rows),
        "the simplest of those that predict about as well as the best is chosen",
        words=("it has", "worst"),
    )


def errors_held_back(result: CalibrationResult) -> TextTable:
    """Errors in what the chosen model was not fitted to."""
    return TextTable(
        "Error of the tip in what was held back (the others are fitted)",
        ("held back", "mean mm", "95 %", "max"),
        tuple(
            (name, _millimetres(e.mean), _millimetres(e.p95), _millimetres(e.max))
            for name, e in result.held_back.items()
        ),
    )


# -- numbers that were fitted ---------------------------------------------------------------------


def fitted_numbers(result: CalibrationResult, *, beginnings: bool) -> list[TextTable]:
    """The fitted numbers with their 95 % intervals, a table for each segment.

    With `beginnings` also the state and the origin with which each log begins.
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
    """The title of the table in which a number stands, and its name there."""
    if not estimate.key:
        begins = estimate.name.startswith("zero of ") or " at the beginning of " in estimate.name
        words = estimate.name.replace(f"{BASE},", "base,").replace(f"{SENSOR},", "sensor,")
        return (_BEGIN if begins else _OTHERS), words
    title = f"segment {Parameter(estimate.key).segment + 1}"
    return title, estimate.name.replace(f", {title}", ",").removesuffix(",")


def _number_row(estimate: FittedEstimate, words: str) -> tuple[str, ...]:
    unit, factor = _UNITS.get(estimate.unit, ("", 1.0))
    if estimate.key.endswith(".share"):
        unit, factor = "%", 100.0
    low, value, high = (each * factor for each in (estimate.low, estimate.value, estimate.high))
    half = max(high - low, 0.0) / 2
    places = 1 - floor(log10(half)) if half > 0 and isfinite(half) else 3
    places = min(max(places, 0), 5)
    before = _plain(estimate.before * factor, places) if estimate.key else "-"
    learnt = f"{estimate.learnt * 100:.0f} %"
    return (
        words, before, _decimals(value, places),
        f"{_decimals(low, places)} to {_decimals(high, places)}", unit, learnt,
    )  # fmt: skip


def _plain(value: float, places: int) -> str:
    """A number as it stands in a file, without zeros at its end."""
    return f"{round(value, max(places, 3)) + 0.0:.8g}"


# -- stiffness ------------------------------------------------------------------------------------


def stiffnesses_compared(rows: Sequence[StiffnessComparison]) -> TextTable:
    """Stiffness, measured and predicted."""

    def text(value: float | None) -> str:
        return "-" if value is None else figures(value)

    return TextTable(
        "Stiffness in N/m, measured and predicted",
        ("pressures (bar)", "direction", "measured", "before", "after", "off by"),
        tuple(
            (
                vector_text(pressure * BAR for pressure in row.pressures),
                f"{direction_name(row.direction)}, {row.boundary}",
                f"{figures(row.measured)} +- {_two(_NORMAL * row.sigma)}",
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


def _millimetres(value: float) -> str:
    return _decimals(value * MM, 2)


def _decimals(value: float, places: int) -> str:
    """A number with so many decimals; a dash where there is none, and no minus before zero."""
    return f"{round(value, places) + 0.0:.{places}f}" if isfinite(value) else "-"


def _two(value: float) -> str:
    """A number with two significant figures, and no power of ten before a million."""
    return f"{float(f'{value:.2g}'):g}"


def _angle(errors: Errors) -> str:
    return "-" if errors.angle is None else f"{degrees(errors.angle):.1f}"


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %" if share == 0 or share >= 0.01 else f"{share * 100:.1g} %"
