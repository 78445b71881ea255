"""Report solved tasks on the terminal: a block for each task, and a summary of several."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.cli.contact_report import friction_text, pressed_contacts
from stiffopt.cli.solve_records import priced
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.cli.tables import STATUS_COLOURS, block_title, labelled
from stiffopt.display import FIGURES, display_units
from stiffopt.errors import printable
from stiffopt.optimise.goal import MatchMatrix, StiffnessMeasure
from stiffopt.optimise.press import POSITION_ERROR, Feeling
from stiffopt.optimise.settings import BRACE, OBSTACLES
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.supports import SupportMap
from stiffopt.optimise.term import Term
from stiffopt.plots.wording import (
    gain_text,
    least_maximised,
    limit_of,
    stiffness_text,
    vector_text,
)

_PARTS = {
    "parameters": "the errors of the calibrated parameters",
    "hysteresis": "hysteresis: it matters where the arm was before",
    "discrepancy": "what the model gets wrong far from the recorded pressures",
    "residual": "what no parameter explained in the recordings",
}

SMALL_GAIN = 0.01
"""Gain over the plain solution below which the report explains why it is small."""

Vector = NDArray[Any]
Line = tuple[str, RenderableType]


def block(solved: SolvedTask) -> RenderableType:
    """Return the full report of one task, about 80 columns wide."""
    solution = solved.solution
    title = block_title(printable(solved.file), solution.status, solution.timings)
    return Group(title, labelled(_lines(solved)), "")


def _lines(solved: SolvedTask) -> Iterable[Line]:
    solution = solved.solution
    if solution.message:
        message = solution.message.removeprefix("unreachable: ")
        yield "note", Text(message, style=STATUS_COLOURS[solution.status])
    yield "robot", Text(_robot(solved))
    if solution.pressures is None or solution.tip_pose is None:
        return
    yield "pressures", _pressures(solved, solution.pressures)
    yield from _tip(solution, solution.tip_pose)
    yield from _press(solution, solution.tip_pose)
    yield from _brace(solution)
    yield from _clearance(solution)
    yield from _uncertainty(solved)
    yield from _stiffnesses(solved)
    yield from _small_gain(solved)
    yield from _worth(solution)
    if solution.confidence is not None and solution.confidence.reached:
        yield "search", Text(str(solution.confidence))
    if solved.front is not None:
        yield "trade-off", _front(solved)
    if solved.supports is not None:
        yield from _supports(solved.supports, leans=bool(solved.solution.contacts))


def _robot(solved: SolvedTask) -> str:
    robot = solved.robot
    segments = "1 segment" if robot.n_segments == 1 else f"{robot.n_segments} segments"
    loaded = ", in equilibrium under gravity or load" if robot.is_loaded else ""
    name = printable(robot.description.name)
    length = display_units().length.text(robot.length, "g")
    return f"{name}, {segments}, {length}, {robot.n_pressures} channels{loaded}"


def _pressures(solved: SolvedTask, pressures: Vector) -> RenderableType:
    """Return a table of pressures, a row for each segment, with marks at limits."""
    description, unit = solved.robot.description, display_units().pressure
    table = Table.grid(padding=(0, 2), pad_edge=False)
    widest = max(map(len, description.channel_ranges))
    table.add_row("", *(Text(f"channel {k + 1}", "dim") for k in range(widest)))
    for number, own in enumerate(description.channel_ranges, start=1):
        cells = []
        for index in own:
            limit = limit_of(solved.solution, description.channel_name(index))
            cells.append(
                Text.assemble(
                    (unit.text(pressures[index], ".3f"), "bold"),
                    (f" {limit}".rstrip(), "yellow"),
                )
            )
        table.add_row(Text(f"segment {number}", "dim"), *cells)
    return table


def _tip(solution: PressureSolution, pose: Vector) -> Iterable[Line]:
    unit = display_units().length
    x, y, z = (unit.number(value, ".3f") for value in pose[:3, 3])
    yield "tip at", Text(f"({x}, {y}, {z}) {unit}, pointing {vector_text(pose[:3, 2])}")
    for number, term in enumerate(solution.task.target.terms):
        yield "" if number else "tip error", _error(term, solution.errors[term.name])


def _press(solution: PressureSolution, pose: Vector) -> Iterable[Line]:
    """Yield the force of a press, and how well the arm can measure it."""
    press, compliance = solution.task.press, solution.compliance
    if press is None or compliance is None:
        return
    R, unit = pose[:3, :3], display_units().force
    felt = Feeling.of(press.direction_in_base(R), R @ compliance[:3, :3] @ R.T)
    yield (
        "press",
        f"{unit.text(press.force, '.3g')} along {vector_text(np.array(press.direction))}, "
        f"{press.frame} axes; felt to {unit.text(felt.deviation(POSITION_ERROR), '.2g')}",
    )


def _brace(solution: PressureSolution) -> Iterable[Line]:
    """Yield the contacts, the stiffness without them, what they hold, and the active limits."""
    if solution.equilibrium is None or not solution.contacts:
        return
    units = display_units()
    for number, each in enumerate(pressed_contacts(solution.equilibrium)):
        most = f" of at most {units.force.text(each.max_force, 'g')}"
        yield (
            "" if number else "leans on",
            Text.assemble(
                (f"'{printable(each.object)}'", "bold"),
                f" {each.where} along the arm with ",
                (units.force.text(each.force, ".3g"), "bold"),
                most if np.isfinite(each.max_force) else "",
            ),
        )
    if solution.equilibrium.friction.tip:
        yield "friction", friction_text(solution.equilibrium)
    free, unit = solution.stiffness_free, units.of_si(solution.stiffness_unit)
    value = solution.stiffness
    if free is None or value is None:
        yield "clear of it", "the target cannot be reached without leaning on something"
    else:
        yield "clear of it", f"{unit.text(free)}; leaning is {value / free:.3g} times as stiff"
    for number, held in enumerate(solution.preloads):
        loss, where = held.loss, vector_text(held.direction)
        grip = f" {held.contacts}" if len({each.contacts for each in solution.preloads}) > 1 else ""
        text = f"any push along {where} up to {units.force.text(BRACE.largest_push, 'g')}"
        if np.isfinite(loss.force):
            text = f"{units.force.text(loss.force, '.3g')} along {where}: then "
            if loss.object:
                left = units.stiffness.text(loss.stiffness_after, ".3g")
                text += f"'{printable(loss.object)}' {loss.how}, which leaves {left}"
            else:
                text += f"it {loss.how}"
        yield "" if number else "holds", f"{text}{grip and f' ({grip.strip()})'}"
    if solution.limited_by:
        yield "limited by", printable(", ".join(solution.limited_by))


def _clearance(solution: PressureSolution) -> Iterable[Line]:
    """Yield the clearance of the body from the scene."""
    scene, distance = solution.task.scene, solution.clearance
    if scene is None or distance is None:
        return
    short, unit = distance < scene.clearance - OBSTACLES.allowed, display_units().length
    yield (
        "clearance",
        Text.assemble(
            (unit.text(distance, ".3f"), "bold yellow" if short else "bold"),
            f" from '{printable(solution.nearest_object or '')}', required: at least "
            f"{unit.text(scene.clearance, 'g')}",
        ),
    )
    if solution.mesh_error is not None:
        error = unit.text(solution.mesh_error, ".2g")
        note = f"up to {error} too small: the grid of its mesh is coarse"
        yield "", f"{note}, see 'resolution'"


def _error(term: Term, value: float) -> Text:
    """Return the error of a term of the target, or the margin of an inequality."""
    if term.is_inequality:
        return Text(term.words(value), "bold" if term.holds(value) else "bold yellow")
    unit = display_units().of_si(term.unit)
    over = value > term.radius * (1 + 1e-9)
    shown = unit.text(value, FIGURES if over else ".3f")
    tolerance = unit.text(term.radius, "g")
    return Text.assemble(
        (shown, "bold yellow" if over else "bold"),
        f" in {term.name}, {'more than the ' if over else ''}tolerance {tolerance}",
    )


def _uncertainty(solved: SolvedTask) -> Iterable[Line]:
    """Yield the uncertainty of the tip's position from the calibration."""
    known = solved.uncertainty
    if known is None:
        return
    if not known.semi_axes.any():
        yield (
            "known to",
            Text("the calibration saw no positions, so that the tip's error is unknown"),
        )
        return
    unit = display_units().length
    axes = " x ".join(unit.number(value, ".2f") for value in known.semi_axes)
    yield (
        "known to",
        Text.assemble(
            (f"{axes} {unit}", "bold"),
            f", semi-axes of the tip's 95 % ellipsoid\nmostly for {_PARTS[known.largest_part]}",
        ),
    )
    if known.extrapolation:
        yield "warning", Text(known.extrapolation, style="yellow")


def _stiffnesses(solved: SolvedTask) -> Iterable[Line]:
    solution = solved.solution
    goal = solution.task.stiffness
    plain = solved.plain or (None,) * len(solution.stiffnesses)
    intervals = solved.intervals or (None,) * len(solution.stiffnesses)
    for number, (measure, value, at_plain, ends) in enumerate(
        zip(solution.task.measures, solution.stiffnesses, plain, intervals, strict=False)
    ):
        yield "" if number else "stiffness", _stiffness(measure, value, at_plain, ends)
    if (
        goal is not None
        and isinstance(goal.match, MatchMatrix)
        and solution.matrix_distance is not None
    ):
        yield (
            "stiffness",
            Text.assemble(
                (f"{solution.matrix_distance:.4f}", "bold"),
                f" from the matrix to match, tolerance {goal.match.tolerance:g} "
                "(relative Frobenius distance)",
            ),
        )


def _small_gain(solved: SolvedTask) -> Iterable[Line]:
    """Explain why an answer is hardly stiffer than the plain solution, if it is not."""
    solution = solved.solution
    goal, value = solution.task.stiffness, least_maximised(solution)
    if goal is None or value is None or not solved.plain:
        return
    if value >= (1 + SMALL_GAIN) * min(solved.plain[: len(goal.maximise)]):
        return
    if solution.freedom == 0:
        reason = "no freedom is left, the pose fixes all channels"
    else:
        reason = "the plain pressures are all but the stiffest here"
    advice = "a free axis or a larger tolerance may gain more"
    yield "gain", Text(f"below {SMALL_GAIN:.0%}: {reason}\n{advice}".replace("%", " %"))


def _stiffness(
    measure: StiffnessMeasure,
    value: float,
    plain: float | None,
    interval: tuple[float, float] | None,
) -> Text:
    unit = display_units().of_si(measure.unit)
    remarks = [_condition(measure)]
    if interval is not None:
        low, high = (unit.number(end, FIGURES) for end in interval)
        remarks.append(f"95 %: {low} to {high}")
    if plain is not None:
        remarks.append(f"plain: {unit.number(plain, FIGURES)}, {gain_text(value, plain)}")
    remark = ", ".join(filter(None, remarks))
    return Text.assemble(
        (unit.text(value, FIGURES), "bold"),
        f"  ({remark})" if remark else "",
        f"\n{measure.words()}",
    )


def _condition(measure: StiffnessMeasure) -> str:
    """Return the task's condition on the value, or nothing."""
    value, tolerance = (getattr(measure, key, None) for key in ("value", "tolerance"))
    if value is None:
        return ""
    asked = display_units().of_si(measure.unit).number(value, FIGURES)
    if tolerance is None:
        return f"required: at least {asked}"
    return f"required: {asked} to {tolerance * 100:g} %"


def _worth(solution: PressureSolution) -> Iterable[Line]:
    """Yield the stiffness gained by relaxing limits and tolerances."""
    given = priced(solution)
    if given is None:
        return
    units = display_units()
    unit, pressure, length = units.of_si(given.objective_unit), units.pressure, units.length
    offers = []  # gain in SI per display unit
    for term in solution.task.target.terms:
        price = given.per_tolerance.get(term.name)
        factor, unit_of_term = term.shown(1.0)
        per = "degree" if unit_of_term == "deg" else unit_of_term
        what = "by which it may fall short of" if term.is_inequality else "of"
        if price:
            tolerance = f"'{term.name}'" if term.is_inequality else f"{term.name} tolerance"
            offers.append((price / factor, f"{per} {what} {tolerance}"))
    vented = _vented(solution)
    for name, value in sorted(given.per_bound.items(), key=lambda item: -item[1]):
        moved = "raised" if name.endswith("max") else "lowered"
        if value and name not in vented:
            offers.append((pressure.to_si(value), f"{pressure} by which {name} is {moved}"))
    for name, price in given.per_clearance.items():
        if price:
            less = f"{length} less clearance of '{printable(name)}'"
            offers.append((length.to_si(price), less))
    for number, (value, per) in enumerate(offers):
        text = Text.assemble((unit.text(value, "+.3g"), "bold"), f" per {per}")
        yield "" if number else "worth", text


def _vented(solution: PressureSolution) -> set[str]:
    """Return the names of lower limits that a supply without vacuum cannot go below."""
    if solution.robot is None:
        return set()
    description = solution.robot.description
    lower, _ = solution.task.pressure_bounds(description)
    return {f"{description.channel_name(k)} min" for k, limit in enumerate(lower) if limit <= 0}


def _supports(found: SupportMap, *, leans: bool) -> Iterable[Line]:
    """Yield where a post or a wall would help, best first; `leans`: whether the answer does."""
    length, unit = display_units().length, display_units().of_si(found.free.stiffness_unit)
    than = " as clear of all objects" if leans else ""
    if not found.supports:
        yield "would help", "no post and no wall, of those that were tested"
    for number, each in enumerate(found.supports, start=1):
        stiffness = unit.text(min(each.solution.stiffnesses), FIGURES)
        post, wall, where = each.object.capsule, each.object.half_space, ""
        if post is not None:
            ends = [vector_text(np.round(end, 4), length) for end in (post.start, post.end)]
            where = f"from {ends[0]} to {ends[1]} {length}, radius {length.text(post.radius, 'g')}"
        elif wall is not None:
            point, normal = vector_text(np.round(wall.point, 4), length), vector_text(wall.normal)
            where = f"through {point} {length}, normal {normal}"
        yield (
            "" if number > 1 else "would help",
            f"{number}. {each.kind}: {stiffness}, {found.times(each):.3g} times as stiff{than}; "
            f"{each.touched}; {where}",
        )


def _front(solved: SolvedTask) -> RenderableType:
    front = solved.front or ()
    if not front:
        return Text("none: the target is out of reach at every tolerance that was tried")
    table = Table.grid(padding=(0, 2), pad_edge=False)
    headings = ["error"] if front[0].position_error is not None else []
    headings += ["angle"] if front[0].angle_error is not None else []
    headings += ["stiffness", "gain", f"pressures in {display_units().pressure}"]
    for heading in headings:
        left = heading.startswith("pressures")
        table.add_column(justify="left" if left else "right", no_wrap=not left)
    table.add_row(*(Text(heading, "dim") for heading in headings))
    first = least_maximised(front[0]) or 1.0
    for point in front:
        value = least_maximised(point) or 0.0
        table.add_row(
            *_errors(point),
            stiffness_text(value, front[0].stiffness_unit),
            gain_text(value, first),
            _list(solved, point),
        )
    return table


def _errors(solution: PressureSolution) -> list[str]:
    cells, units = [], display_units()
    if solution.position_error is not None:
        cells.append(units.length.text(solution.position_error, ".2f"))
    if solution.angle_error is not None:
        cells.append(units.angle.text(solution.angle_error, ".2f"))
    return cells


def _list(solved: SolvedTask, solution: PressureSolution) -> str:
    """Return all pressures on one line, separated by segment."""
    if solution.pressures is None:
        return ""
    texts = [display_units().pressure.number(p, ".2f") for p in solution.pressures]
    ranges = solved.robot.description.channel_ranges
    return " | ".join(" ".join(texts[own.start : own.stop]) for own in ranges)


def summary_row(solved: SolvedTask, seconds: float) -> tuple[str, ...]:
    """Return the task's line of the summary; it took `seconds` in all."""
    solution = solved.solution
    position, angle = solution.position_error, solution.angle_error
    units, stiffness = display_units(), solution.stiffness
    return (
        solved.file,
        solution.status,
        "" if position is None else units.length.number(position, ".3f"),
        "" if angle is None else units.angle.number(angle, ".2f"),
        "" if stiffness is None else stiffness_text(stiffness, solution.stiffness_unit),
        gain_text(solution.stiffnesses[0], solved.plain[0]) if solved.plain else "",
        f"{seconds:.1f}",
    )
