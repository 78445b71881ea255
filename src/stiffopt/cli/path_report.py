"""Report solved paths on the terminal: a block for each path, with a table of some points."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.cli.path_records import SolvedPath, rate_margins
from stiffopt.cli.tables import STATUS_COLOURS, block_title, labelled, number_table
from stiffopt.display import FIGURES, PLAIN, display_units
from stiffopt.errors import printable
from stiffopt.model.scene import Scene
from stiffopt.paths.solution import PathSolution
from stiffopt.plots.wording import stiffness_text

_ROWS = 10  # approximate number in the table


def block(solved: SolvedPath) -> RenderableType:
    """Return the full report of one path, about 80 columns wide."""
    solution = solved.solution
    title = block_title(printable(solved.file), solution.status, solution.timings)
    parts: list[RenderableType] = [title, labelled(_lines(solved))]
    if len(solution.times):
        parts += ["", points_table(solution)]
    return Group(*parts, "")


def summary_row(solved: SolvedPath, seconds: float) -> tuple[str, ...]:
    """Return the path's line of the summary; it took `seconds` in all."""
    solution = solved.solution
    worst = "" if solution.worst is None else _stiffness(solution.worst, solution)
    last = f"{solution.times[-1]:.4g}" if len(solution.times) else ""
    count = str(len(solution.times)) if len(solution.times) else ""
    return solved.file, solution.status, count, last, worst, f"{seconds:.1f}"


def _lines(solved: SolvedPath) -> Iterable[tuple[str, RenderableType]]:
    path, solution = solved.path, solved.solution
    if solution.message:
        message = solution.message.removeprefix("unreachable: ")
        yield "note", Text(message, style=STATUS_COLOURS[solution.status])
    robot = solution.robot
    yield "robot", Text(f"{printable(robot.description.name)}, {robot.n_pressures} channels")
    if not len(solution.times):
        return
    length = display_units().length.text(path.points().curve.length)
    closed = "closed " if path.closed else ""
    yield (
        "path",
        Text(
            f"{closed}{path.path.kind} of {length}, {len(solution.times)} points "
            f"in {solution.times[-1]:.4g} s"
        ),
    )
    yield from _stiffness_lines(solved)
    yield from rate_lines(solution)
    yield from clearance_lines(solution, path.scene)
    if solution.confidence:
        yield "search", Text(solution.confidence)


def _stiffness_lines(solved: SolvedPath) -> Iterable[tuple[str, RenderableType]]:
    """Yield the worst stiffness and the mean; the maximised one is marked."""
    path, solution = solved.path, solved.solution
    index = solution.worst_index
    if solution.stiffness is None or index is None or path.stiffness is None:
        return
    share = ""
    if solution.alone is not None:
        share = f", {solution.stiffness[index] / solution.alone[index]:.1%} of that alone"
    over = path.stiffness.over
    what = "\n".join(measure.words() for measure in path.stiffness.maximise)
    yield (
        "stiffness",
        Text.assemble(
            (_stiffness(solution.stiffness[index], solution), "bold"),
            f" at its worst, point {index + 1}{share}{' (maximised)' * (over == 'worst')}\n",
            (_stiffness(float(solution.stiffness.mean()), solution), "bold"),
            f" in the mean{' (maximised)' * (over == 'mean')}\n{what}",
        ),
    )


def rate_lines(solution: PathSolution) -> Iterable[tuple[str, RenderableType]]:
    """Yield where the pressures are nearest to their rates."""
    margins = rate_margins(solution)
    if margins is None or solution.slew is None:
        yield "rates", Text("not known: neither robot nor path says a slew")
        return
    index = int(np.argmin(margins))
    if index == 0:  # nothing moves
        return
    step = np.abs(solution.pressures[index] - solution.pressures[index - 1])
    channel = int(np.argmax(step / solution.slew))
    rate = step[channel] / (solution.times[index] - solution.times[index - 1])
    name, unit = solution.robot.description.channel_name(channel), display_units().pressure
    fastest = solution.slew[channel]
    yield (
        "rates",
        Text.assemble(
            (f"{unit.number(rate, '.3g')} of {unit.text(fastest, '.3g')}/s", "bold"),
            f" at most, by {name} on the way to point {index + 1}",
        ),
    )


def clearance_lines(
    solution: PathSolution, scene: Scene | None
) -> Iterable[tuple[str, RenderableType]]:
    """Yield where the body is nearest to the scene."""
    if solution.clearance is None or scene is None:
        return
    index, unit = int(np.argmin(solution.clearance)), display_units().length
    yield (
        "clearance",
        Text.assemble(
            (unit.text(solution.clearance[index], ".3f"), "bold"),
            f" at point {index + 1}, required: at least {unit.text(scene.clearance, 'g')}",
        ),
    )


def points_table(solution: PathSolution) -> RenderableType:
    """Return a table of evenly spaced points and of the notable ones."""
    count = len(solution.times)
    marks: dict[int, str] = {}
    if solution.worst_index is not None:
        marks[solution.worst_index] = "worst"
    if solution.first_failure is not None:
        both = ", worst" * (solution.first_failure in marks)
        marks[solution.first_failure] = f"first failure{both}"
    shown = {*range(0, count, max(1, round(count / _ROWS))), count - 1, *marks}
    columns = _columns(solution)
    table = number_table("  point", *columns, "")
    table.columns[0].justify = "right"
    table.columns[-1].justify = "left"
    for index in sorted(shown):
        cells = [values[index] for values in columns.values()]
        table.add_row(str(index + 1), *cells, Text(marks.get(index, ""), "yellow"))
    return _explained(table, solution)


def _columns(solution: PathSolution) -> dict[str, list[str]]:
    """Return the available columns: heading, and a cell for each point."""
    margins = rate_margins(solution)
    alone = solution.alone
    share = None if solution.stiffness is None or alone is None else solution.stiffness / alone
    digits = 2 if solution.times[-1] >= 1 else 4
    length, angle = display_units().length, display_units().angle
    unit = display_units().of_si(solution.stiffness_unit)
    found = (
        ("time s", solution.times, PLAIN, f".{digits}f"),
        (f"error {length}", solution.position_errors, length, ".3f"),
        (angle.name, solution.angle_errors, angle, ".2f"),
        (unit.name, solution.stiffness, unit, FIGURES),
        ("of alone", share, PLAIN, ".1%"),
        (f"clear {length}", solution.clearance, length, ".2f"),
        ("rate left", margins, PLAIN, ".0%"),
    )
    cells = {
        heading: [unit.number(value, form).replace("-0%", "0%") for value in values.tolist()]
        for heading, values, unit, form in found
        if values is not None
    }
    if margins is not None:
        cells["rate left"][0] = ""  # there is no way to the first point
    return cells


def _explained(table: Table, solution: PathSolution) -> RenderableType:
    """Explain the headings below the table."""
    notes = []
    if solution.alone is not None:
        notes.append("of alone: share of what the point could have by itself")
    if solution.slew is not None:
        notes.append("rate left: to the fastest channel, on the way to it")
    return Group(table, *(Text(f"  {note}", "dim") for note in notes))


def _stiffness(value: float, solution: PathSolution) -> str:
    return stiffness_text(value, solution.stiffness_unit)
