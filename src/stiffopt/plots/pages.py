"""Render robots, tasks, paths and solutions for notebooks: a figure and a small table.

`stiffopt.notebook` uses these pages.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import singledispatch
from html import escape
from importlib import import_module
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stiffopt.display import display_units
from stiffopt.errors import StiffoptError, printable
from stiffopt.model.compiled import compiling_nothing
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.stopping import giving_up
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.task import ForRobot, Task
from stiffopt.paths.path import Path
from stiffopt.paths.solution import PathSolution
from stiffopt.plots import style
from stiffopt.plots.arm import draw_arm
from stiffopt.plots.path import draw_asked_path, draw_path, draw_stiffness_along
from stiffopt.plots.solution import draw_pressures, draw_solution, draw_task
from stiffopt.plots.wording import stiffness_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LONGEST = 2.0  # s, time limit of a page
_SIDE = 3.4  # inches, side of the panel of an arm
_DPI = 80
_CELL = "text-align:left;vertical-align:top;padding:1px 10px 1px 0"

Row = tuple[str, str]


class _Page(NamedTuple):
    """A title, a status, rows of a table, and a function that draws the figure."""

    title: str
    status: str
    rows: Iterable[Row]
    draw: Callable[[], Figure]


def page(shown: object) -> str:
    """Return HTML of an object: its table and its figure, as far as the time limit allows.

    Raises `TypeError`: there is no page for this type.
    """
    made, rows, picture = _page_of(shown), "", ""
    with suppress(ImportError):
        import_module("matplotlib.figure")  # not counted in the time limit
    with suppress(StiffoptError), compiling_nothing(), giving_up(_LONGEST):
        for row in made.rows:
            rows += _row(row)
    with suppress(StiffoptError), compiling_nothing(), giving_up(_LONGEST):
        picture = _picture(made.draw())
    colour = style.STATUS.get(made.status, style.DARK)
    head = f"<b>{_escaped(made.title)}</b> <span style='color:{colour}'>{made.status}</span>"
    return (
        "<div style='display:flex;flex-wrap:wrap;align-items:flex-start;gap:16px'>"
        f"<div>{head}<table>{rows}</table></div>{picture}</div>"
    )


def _escaped(text: str) -> str:
    return "<br>".join(escape(printable(line)) for line in text.split("\n"))


def _row(row: Row) -> str:
    name, value = map(_escaped, row)
    return f"<tr><th style='{_CELL}'>{name}</th><td style='{_CELL}'>{value}</td></tr>"


def _picture(figure: Figure) -> str:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return f"<img src='data:image/png;base64,{b64encode(buffer.getvalue()).decode()}'/>"


@singledispatch
def _page_of(shown: object) -> _Page:
    raise TypeError(f"there is no page for a {type(shown).__name__}")


# -- robots, tasks and paths ----------------------------------------------------------------------


@_page_of.register
def _(robot: Manipulator) -> _Page:
    def draw() -> Figure:
        return _in_space(lambda axes: draw_arm(axes, robot, robot.pressure_min))

    return _Page(robot.description.name, "", _robot_rows(robot), draw)


def _robot_rows(robot: Manipulator) -> Iterable[Row]:
    length, pressure = display_units().length, display_units().pressure
    lengths = ", ".join(length.text(each.length, "g") for each in robot.description.segments)
    yield "segments", lengths
    yield "length", length.text(robot.length, "g")
    yield "channels", str(robot.n_pressures)
    low, high = robot.pressure_min.min(), robot.pressure_max.max()
    yield "pressures", f"{pressure.number(low, 'g')} to {pressure.text(high, 'g')}"
    if robot.is_loaded:
        yield "loaded", "in equilibrium under gravity or load"


@_page_of.register
def _(task: Task) -> _Page:
    def draw() -> Figure:
        robot = load_robot(task.resolve_robot())
        return _in_space(lambda axes: draw_task(axes, robot, task))

    return _Page(_title(task, "Task"), "", _task_rows(task), draw)


def _title(given: ForRobot, kind: str) -> str:
    return kind if given.source is None else given.source.stem


def _task_rows(task: Task) -> Iterable[Row]:
    yield "robot", task.robot or "the one that the solver is given"
    for term in task.target.terms:
        yield term.key, term.condition()
    for name, part in (("stiffness", task.stiffness), ("press", task.press), ("brace", task.brace)):
        if part is not None:
            yield name, repr(part).partition("(")[2].removesuffix(")")
    yield from _condition_rows(task)


def _condition_rows(given: ForRobot) -> Iterable[Row]:
    if given.load is not None:
        force = display_units().force.text(float(np.linalg.norm(given.load.force)), ".3g")
        yield "load", f"{force}, {given.load.frame} axes"
    if given.scene is not None:
        yield "scene", ", ".join(item.name for item in given.scene.objects)


@_page_of.register
def _(path: Path) -> _Page:
    def draw() -> Figure:
        robot = load_robot(path.resolve_robot())
        return _in_space(lambda axes: draw_asked_path(axes, robot, path))

    return _Page(_title(path, "Path"), "", _path_rows(path), draw)


def _path_rows(path: Path) -> Iterable[Row]:
    points, unit = path.points(), display_units().length
    yield "robot", path.robot or "the one that the solver is given"
    yield "path", f"{path.path.kind} of {unit.text(points.curve.length)}, {len(points)} points"
    if points.times is not None:
        yield "time", f"{points.times[-1]:.4g} s"
    yield "tolerance", unit.text(path.tolerance.position, "g")
    yield from _condition_rows(path)


# -- answers --------------------------------------------------------------------------------------


@_page_of.register
def _(solution: PressureSolution) -> _Page:
    def draw() -> Figure:
        robot = solution.robot or load_robot(solution.task.resolve_robot())
        figure = style.new_figure(2.1 * _SIDE, _SIDE)
        draw_solution(style.add_space(figure, (0.0, 0.0, 0.5, 1.0)), robot, solution)
        draw_pressures(figure.add_axes((0.6, 0.15, 0.39, 0.74)), robot, solution)
        return figure

    return _Page(_title(solution.task, "Solution"), solution.status, _answer_rows(solution), draw)


def _answer_rows(solution: PressureSolution) -> Iterable[Row]:
    if solution.pressures is not None and solution.tip_position is not None:
        yield from _quantity_rows(solution, solution.pressures, solution.tip_position)
    if solution.message:  # last, since computing the message may take long
        yield "note", solution.message


def _quantity_rows(solution: PressureSolution, pressures: Any, tip: Any) -> Iterable[Row]:
    length, pressure = display_units().length, display_units().pressure
    yield "pressures", f"{', '.join(pressure.number(p, '.3f') for p in pressures)} {pressure}"
    yield "tip at", f"({', '.join(length.number(x, '.3f') for x in tip)}) {length}"
    for term in solution.task.target.terms:
        if term.name in solution.errors:
            yield f"error in {term.name}", term.words(solution.errors[term.name])
    for number, (measure, value) in enumerate(
        zip(solution.task.measures, solution.stiffnesses, strict=False)
    ):
        words = f"{stiffness_text(value, measure.unit)}, {measure.words()}"
        yield "" if number else "stiffness", words


@_page_of.register
def _(solution: PathSolution) -> _Page:
    def draw() -> Figure:
        if solution.stiffness is None:
            return _in_space(lambda axes: draw_path(axes, solution))
        figure = style.new_figure(2.1 * _SIDE, _SIDE)
        draw_path(style.add_space(figure, (0.0, 0.0, 0.5, 1.0)), solution, labelled=False)
        axes = figure.add_axes((0.62, 0.15, 0.36, 0.7))
        draw_stiffness_along(axes, solution)
        style.tidy(axes)
        return figure

    return _Page(solution.robot.description.name, solution.status, _points_rows(solution), draw)


def _points_rows(solution: PathSolution) -> Iterable[Row]:
    if solution.message:
        yield "note", solution.message
    if not len(solution.times):
        return
    unit = display_units().length
    yield "points", f"{len(solution.times)} in {solution.times[-1]:.4g} s"
    if solution.position_errors is not None:
        yield "tip error", f"at most {unit.text(solution.position_errors.max(), '.3g')}"
    if solution.worst is not None:
        yield "stiffness", f"at least {stiffness_text(solution.worst, solution.stiffness_unit)}"
    if solution.clearance is not None:
        yield "clearance", f"at least {unit.text(solution.clearance.min(), '.3g')}"


def _in_space(draw: Callable[[Any], object]) -> Figure:
    """Draw into a figure with one 3-D panel."""
    figure = style.new_figure(_SIDE, _SIDE)
    draw(style.add_space(figure, (0.0, 0.0, 1.0, 1.0)))
    return figure
