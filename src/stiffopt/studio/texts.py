"""Contents of the studio's panel, as HTML, and of its copies, as files and as Python.

Names and messages may come from untrusted files, so all of them are escaped here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pprint import pformat
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.control.state import Event, Snapshot
from stiffopt.display import FIGURES, display_units
from stiffopt.files import file_text
from stiffopt.model.description import RobotDescription
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.optimise.solution import PressureSolution
from stiffopt.plots import style
from stiffopt.plots.wording import direction_text, gain_text, stiffness_text
from stiffopt.studio.design import Design
from stiffopt.studio.drawing import KEPT
from stiffopt.studio.leaning import contact_rows, leaning_rows
from stiffopt.studio.rig_watch import RigWatch
from stiffopt.studio.timeline import Timeline
from stiffopt.studio.workbench import StudioAnswer, Workbench

STATUS_WORDS = {"solved": "solved", "unreachable": "out of reach", "failed": "no answer"}
ROBOT_FILE = "my-arm.yaml"
"""File name of a changed robot, which a copied task refers to."""
_BEST = "best that was found everywhere"
_LOCAL = "next to the previous one; the best is searched for when you pause"
_SEARCHING = "searching; the first task of a kind compiles its solver, which takes a while ..."
_LEANING = "Pressures held (blue: the arm as it leans). Drag an object; untick 'lean' to go on."
_AT_LIMIT = 1e-3  # distance from a limit, as a share of the range, that counts as at it
_COPY = "navigator.clipboard.writeText(this.nextElementSibling.value)"


# -- the answer -----------------------------------------------------------------------------------


def answer_html(bench: Workbench) -> str:
    """Return the panel's view of the solution: status, numbers and pressures."""
    answer = bench.answer
    if bench.leaning is not None:
        return _padded(
            _headline("", _LEANING)
            + _table((escape(name), escape(text)) for name, text in leaning_rows(bench.leaning))
        )
    if answer is None:
        return _padded(_headline("failed" if bench.trouble else "", bench.trouble or _SEARCHING))
    solution = answer.solution
    shows_message = answer.is_best or not solution.found  # the message of a solution takes a while
    message = bench.trouble or (solution.message if shows_message else "")
    status = "failed" if bench.trouble else solution.status
    return _padded(
        _headline(status, message)
        + _table(_rows(answer))
        + pressures_html(answer.robot.description, *_bars(answer))
    )


def _padded(html: str) -> str:
    return f"<div style='padding:0 10px'>{html}</div>"


def _headline(status: str, message: str) -> str:
    colour = style.STATUS.get(status, style.GREY)
    word = STATUS_WORDS.get(status, "")
    text = f"<div style='font-size:0.85em;margin:2px 0 4px'>{escape(message)}</div>"
    return f"<div style='font-weight:700;font-size:1.15em;color:{colour}'>{word}</div>{text}"


def _rows(answer: StudioAnswer) -> Iterable[tuple[str, str]]:
    solution, tolerance = answer.solution, answer.design.task.target.tolerance
    units = display_units()
    plain = answer.plain_stiffness
    for number, (measure, value) in enumerate(
        zip(answer.design.task.measures, solution.stiffnesses, strict=False)
    ):
        unit = units.of_si(measure.unit)
        text = f"<b>{unit.text(value, FIGURES)}</b> {direction_text(measure)}"
        if number == 0 and plain is not None:
            gain = gain_text(value, plain)
            text += f"<br>plain pressures: {unit.number(plain, FIGURES)} ({gain})"
        yield "stiffness", text
    if solution.position_error is not None:
        error = units.length.text(solution.position_error, ".3g")
        yield "tip error", f"{error} (tolerance {units.length.text(tolerance.position, '.3g')})"
    if solution.angle_error is not None:
        error = units.angle.text(solution.angle_error, ".3g")
        yield "angle error", f"{error} (tolerance {units.angle.text(tolerance.angle, '.3g')})"
    if solution.tip_pose is not None:
        yield "tip", f"{position_text(solution.tip_pose[:3, 3])} {units.length}"
    limits = _limits_text(answer)
    if limits:
        yield "at a limit", limits
    for name, said in contact_rows(solution.contacts):
        yield escape(name), escape(said)
    if solution.contacts and solution.stiffness_free is not None:
        unit = units.of_si(solution.stiffness_unit)
        yield "clear of all", unit.text(solution.stiffness_free, FIGURES)
    elif solution.task.scene is not None:  # the exact clearance is too slow during a drag
        clear = solution.clearance if answer.is_best else None
        yield (
            "clearance",
            "shown when you pause" if clear is None else units.length.text(clear, ".3g"),
        )
    doubt = answer.robot.description.extrapolation(answer.pressures)
    if doubt:
        yield "doubt", doubt
    yield "answer", _BEST if answer.is_best else _LOCAL


def _limits_text(answer: StudioAnswer) -> str:
    """Describe which channels are at which limits, by segment."""
    parts = []
    for number, own in enumerate(answer.robot.description.channel_ranges, start=1):
        for side, name in ((-1, "min"), (1, "max")):
            mine = np.flatnonzero(answer.at_limit[own] == side)
            if len(mine):
                channels = ", ".join(str(k + 1) for k in mine)
                parts.append(f"segment {number}: {channels} at {name}")
    return "; ".join(parts)


def position_text(position: ArrayLike) -> str:
    """Format a position in the display unit of lengths, to about 0.1 mm."""
    unit = display_units().length
    numbers = (unit.number(float(x), ".1f") for x in np.asarray(position))
    return f"({', '.join(numbers)})"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(
        f"<tr><td style='color:#666;padding-right:8px;vertical-align:top'>{name}</td>"
        f"<td>{text}</td></tr>"
        for name, text in rows
    )
    return f"<table style='font-size:0.85em;border-spacing:0 2px'>{cells}</table>"


def _bars(answer: StudioAnswer) -> tuple[Any, ...]:
    description = answer.robot.description
    low, high = answer.design.task.pressure_bounds(description)
    plain = None if answer.plain is None else answer.plain.pressures
    return answer.pressures, low, high, (answer.at_limit != 0).tolist(), plain


def pressures_html(
    description: RobotDescription,
    pressures: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    at_limit: Sequence[bool],
    marks: ArrayLike | None = None,
    mark: str = "plain pressures",
) -> str:
    """Return bars of pressures between their limits, with marks at other pressures.

    Parameters
    ----------
    description : the robot, with n channels.
    pressures, low, high : (n,), in Pa.
    at_limit : (n,), which bars to highlight.
    marks : (n,), in Pa, named `mark` in the legend.
    """
    p, low, high = (np.asarray(each, dtype=float) for each in (pressures, low, high))
    top, bottom = max(high.max(), p.max()), min(low.min(), 0.0)
    rows, unit = [], display_units().pressure

    def share(value: float) -> str:
        return f"{np.clip(100 * (value - bottom) / (top - bottom), 0, 100):.1f}%"

    for number, own in enumerate(description.channel_ranges):
        rows.append(
            f"<div style='color:{style.segment_text_colour(number)};font-weight:600;"
            f"margin-top:4px'>segment {number + 1}</div>"
        )
        for channel, index in enumerate(own, start=1):
            colour = style.AT_LIMIT if at_limit[index] else style.WITHIN_LIMITS
            tick = ""
            if marks is not None:
                tick = _line(share(float(np.asarray(marks)[index])), "#222", 2)
            rows.append(
                "<div style='display:flex;align-items:center;gap:6px;height:15px'>"
                f"<span style='width:1em'>{channel}</span>"
                f"<span style='position:relative;flex:1;height:10px;background:{style.RANGE}'>"
                f"<span style='position:absolute;left:0;top:0;bottom:0;"
                f"width:{share(p[index])};background:{colour}'></span>"
                f"{_line(share(high[index]), style.BOUND, 2)}{tick}</span>"
                f"<span style='width:4.6em;text-align:right'>{unit.text(p[index], '.2f')}</span>"
                "</div>"
            )
    legend = f"orange: at a limit{'' if marks is None else f' &middot; black mark: {mark}'}"
    return (
        f"<div style='font-size:0.8em'>{''.join(rows)}"
        f"<div style='color:#666;margin-top:3px'>{legend}</div></div>"
    )


def _line(left: str, colour: str, width: int) -> str:
    return (
        f"<span style='position:absolute;left:{left};top:-2px;bottom:-2px;width:{width}px;"
        f"background:{colour}'></span>"
    )


def note_html(text: str) -> str:
    """Return a note below an input of the panel."""
    return _padded(f"<div style='font-size:0.85em'>{escape(text)}</div>")


# -- answers side by side -------------------------------------------------------------------------


def compared_html(bench: Workbench) -> str:
    """Return a table of the present and the kept solutions, each with its colour."""
    now = [] if bench.answer is None else [(style.DARK, "now", bench.answer)]
    kept = [(KEPT[k % len(KEPT)], str(k + 1), answer) for k, answer in enumerate(bench.kept)]
    if not kept:
        return _padded("<div style='font-size:0.85em'>Keep an answer to compare others.</div>")
    units = display_units()
    titles = ("", "stiffness", f"tip ({units.length})", f"pressures ({units.pressure})")
    head = "".join(f"<th style='text-align:left;padding-right:8px'>{each}</th>" for each in titles)
    rows = "".join(
        f"<tr><td style='color:{colour};font-weight:700;padding-right:8px'>{name}</td>"
        f"<td style='padding-right:8px'>{_stiffness_text(answer.solution)}</td>"
        f"<td style='padding-right:8px'>{position_text(answer.solution.tip_pose[:3, 3])}</td>"
        f"<td>{_pressures_text(answer.pressures)}</td></tr>"
        for colour, name, answer in now + kept
        if answer.solution.tip_pose is not None
    )
    table = f"<table style='font-size:0.8em;border-spacing:0 3px'><tr>{head}</tr>{rows}</table>"
    return _padded(table)


def _stiffness_text(solution: PressureSolution) -> str:
    measures = solution.task.measures
    if solution.stiffness is None or not measures:
        return "-"
    text = stiffness_text(solution.stiffness, solution.stiffness_unit)
    text += f" {direction_text(measures[0])}" if isinstance(measures[0], StiffnessMeasure) else ""
    return text if solution.found else f"{text} ({STATUS_WORDS[solution.status]})"


def _pressures_text(pressures: ArrayLike) -> str:
    unit = display_units().pressure
    return " ".join(unit.number(value, ".2f") for value in np.asarray(pressures))


# -- copies ---------------------------------------------------------------------------------------


def task_text(design: Design) -> str:
    """Return the design's task file; it names `ROBOT_FILE` if the robot was changed."""
    robot = ROBOT_FILE if design.has_own_robot else design.robot
    return file_text("task", design.task.model_copy(update={"robot": robot}))


def robot_text(design: Design) -> str:
    """Return the design's robot file."""
    return file_text("robot", design.description)


def python_text(design: Design) -> str:
    """Return a program that solves the design."""
    lines = ["import stiffopt", "", f"robot = stiffopt.load_robot({design.robot!r})"]
    update = {
        key: value for key, value in design.description if value != getattr(design.original, key)
    }
    if update:
        lines.append(
            f"robot = stiffopt.load_robot(robot.description.model_copy(update={_literal(update)}))"
        )
    given = design.task.model_dump(
        exclude_none=True, exclude_defaults=True, by_alias=True, exclude={"robot"}
    )
    lines += ["task = stiffopt.Task("]
    lines += [f"    {key}={_literal(value)}," for key, value in given.items()]
    lines += [")", "solution = stiffopt.solve_pressure(robot, task)", "print(solution)", ""]
    return "\n".join(lines)


def _literal(value: Any) -> str:
    """Return plain data as Python source, on several lines if long."""
    return pformat(_plain(value), width=88, sort_dicts=False).replace("\n", "\n    ")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(item) for item in value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def copy_html(title: str, text: str) -> str:
    """Return a field with a text and a button that copies it."""
    return _padded(
        f"<div style='font-size:0.85em;margin-bottom:3px'>{escape(title)}</div>"
        f"<button onclick='{_COPY}' style='cursor:pointer;padding:2px 10px'>copy</button>"
        f"<textarea readonly rows='14' spellcheck='false' style='width:100%;font-family:monospace;"
        f"font-size:11px;white-space:pre'>{escape(text)}</textarea>"
    )


# -- timelines ------------------------------------------------------------------------------------


def moment_html(timeline: Timeline, time: float) -> str:
    """Return the panel's view of one moment of a timeline."""
    moment, length = timeline.at(time), display_units().length
    description = timeline.robot.description
    tip = timeline.robot.tip_pose(moment.pressures)[:3, 3]
    rows = [("time", f"{time:.2f} of {timeline.duration:.2f} s")]
    for chart in timeline.charts:
        if not chart.shows_pressures:
            values = ", ".join(f"{value:.3g}" for value in chart.values[moment.row][:1])
            rows.append((escape(chart.title), values))
    rows.append(("tip of the model", f"{position_text(tip)} {length}"))
    if moment.seen is not None:
        rows.append(("tip seen (blue)", f"{position_text(moment.seen)} {length}"))
    for when, text in timeline.events_until(time):
        rows.append((f"{round(when, 1) + 0.0:.1f} s", escape(text)))
    low, high = timeline.robot.pressure_min, timeline.robot.pressure_max
    at_limit = moment.pressures >= high - _AT_LIMIT * (high - low)
    bars = pressures_html(description, moment.pressures, low, high, at_limit.tolist())
    headline = f"<div style='font-size:0.9em;margin:2px 0 4px'>{escape(timeline.headline)}</div>"
    return _padded(headline + _table(rows) + bars)


# -- rigs -----------------------------------------------------------------------------------------

BALLS = {"estimated": style.DARK, "seen": style.MEASURED, "target": style.TARGET}
"""Colours of the balls in a rig's view."""
_STATES = {"active": "#2a7f3f", "holding": "#b35c00", "fault": "#b00020"}


def rig_html(watch: RigWatch) -> str:
    """Return the panel's view of a rig's state."""
    said = f"<div style='font-size:0.85em;color:#666'>{escape(watch.outcome)}</div>"
    if not watch.may_command:
        said = "<div style='font-size:0.85em;color:#666'>read only: no token was given</div>"
    state = watch.state
    if state is None:
        return _padded(_headline("failed", watch.trouble) + said)
    colour = _STATES.get(state.state, style.GREY)
    headline = (
        f"<div style='font-weight:700;font-size:1.15em;color:{colour}'>{escape(state.state)}</div>"
        f"<div style='font-size:0.85em'>{escape(state.reason)}</div>"
    )
    description = watch.design.description
    measured = np.where(np.isfinite(state.measured), state.measured, 0.0)
    low, high = (np.where(np.isfinite(b), b, 0.0) for b in (state.low, state.high))
    bars = pressures_html(
        description, measured, low, np.maximum(high, low + 1.0), state.saturated.tolist(),
        np.where(np.isfinite(state.commanded), state.commanded, 0.0), "commanded",
    )  # fmt: skip
    return _padded(
        headline + said + _table(_rig_rows(state)) + bars + _events(watch.events, state.time)
    )


def _rig_rows(state: Snapshot) -> Iterable[tuple[str, str]]:
    yield "doing", escape(state.task or "nothing")
    length, unit = display_units().length, display_units().of_si(state.stiffness_unit)
    places = (
        ("tip estimated", "estimated", state.tip_position),
        ("tip seen", "seen", state.seen_position),
        ("target", "target", state.target_position),
    )
    for name, ball, position in places:
        if position is not None and np.isfinite(position).any():
            dot = f"<span style='color:{BALLS[ball]}'>&#9679;</span>"
            yield name, f"{dot} {position_text(position)} {length}".replace("nan", "free")
    if np.isfinite(state.position_error):
        yield "error", length.text(state.position_error, ".2f")
    if np.isfinite(state.stiffness):
        now = unit.number(state.stiffness, FIGURES)
        yield "stiffness", f"{now} of {unit.text(state.best_stiffness, FIGURES)}"
    if state.brace:
        yield "brace", state.brace
    for each in state.leans_on:
        yield "contact", escape(str(each))
    for alarm in state.alarms:
        yield "alarm", f"<span style='color:#b35c00'>{escape(alarm.text)}</span>"


def _events(events: Iterable[Event], now: float) -> str:
    lines = "".join(
        f"<div>{max(0.0, now - event.time):.0f} s ago: {escape(event.text)}</div>"
        for event in reversed([*events])
    )
    return f"<div style='font-size:0.8em;color:#666;margin-top:6px'>{lines}</div>"
