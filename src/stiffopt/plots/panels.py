"""Flat panels: pressures against their limits, stiffness against tip error."""

from collections.abc import Sequence
from math import degrees
from typing import Any

import numpy as np

from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import PressureSolution
from stiffopt.plots import style
from stiffopt.plots.wording import BAR, MM, least_maximised, unit_text

_MOST_LABELS = 15  # pressures with a number on their bar


def draw_pressures(axes: Any, robot: Manipulator, solution: PressureSolution) -> None:
    """Bars of the pressures in bar against the limits that hold; those at a limit stand out."""
    description = robot.description
    lower, upper = (bound * BAR for bound in solution.task.pressure_bounds(description))
    values = np.asarray(solution.pressures) * BAR
    at_limit = [_active_side(solution, description.channel_name(k)) for k in range(len(values))]
    places = _places(robot)
    axes.bar(places, upper - lower, bottom=lower, width=0.8, color=style.RANGE, zorder=1)
    for side, bounds in (("min", lower), ("max", upper)):
        for place, bound, at in zip(places, bounds, at_limit, strict=True):
            held = at == side
            axes.hlines(
                bound, place - 0.4, place + 0.4, zorder=5 if held else 2, clip_on=False,
                color=style.LIMIT if held else "#9aa3ab", linewidth=3.5 if held else 1.2,
            )  # fmt: skip
    colours = [style.LIMIT if at else style.INSIDE for at in at_limit]
    axes.bar(places, values, width=0.62, color=colours, zorder=3)
    top = max(upper.max(), 0.0) - min(lower.min(), 0.0)
    if len(values) <= _MOST_LABELS:
        for place, value, colour in zip(places, values, colours, strict=True):
            axes.text(
                place, max(value, 0.0) + 0.012 * top, f"{value + 0.0:.2f}", ha="center",
                va="bottom", fontsize=9, color=colour if colour == style.LIMIT else "#20394f",
                weight="bold", zorder=4,
            )  # fmt: skip
    _label_channels(axes, robot, places)
    axes.set_ylabel("pressure (bar)")
    axes.set_ylim(min(lower.min(), 0.0), max(upper.max(), 0.0) + 0.2 * top)
    _pressure_legend(axes, any(at_limit))
    _plain_frame(axes)


def draw_pareto(axes: Any, front: Sequence[PressureSolution], plain: float | None) -> None:
    """Stiffness against tip error, each point the stiffest at its error."""
    axes.set_title("stiffness gained by a larger tip error", fontsize=11, loc="left")
    _plain_frame(axes)
    if not front:
        axes.text(
            0.5, 0.5, "out of reach at every tolerance tried", ha="center", transform=axes.transAxes
        )
        return
    by_position = front[0].position_error is not None
    errors = [
        (point.position_error or 0.0) * MM if by_position else degrees(point.angle_error or 0.0)
        for point in front
    ]
    values = [least_maximised(point) or 0.0 for point in front]
    axes.plot(errors, values, "o-", color=style.INSIDE, markersize=5, label="stiffest found")
    axes.plot(errors[:1], values[:1], "o", color=style.TARGET, markersize=8, label="this task")
    if plain is not None:
        axes.axhline(plain, color="#8a8a8a", linestyle="--", linewidth=1.2, label="plain solution")
    if min(errors) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel(f"tip error ({'mm' if by_position else 'deg'})")
    axes.set_ylabel(f"stiffness ({unit_text(front[0].stiffness_unit)})")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=9, frameon=False)


def _active_side(solution: PressureSolution, channel: str) -> str:
    """Return at which limit a channel is: ``min``, ``max`` or neither."""
    sides = (s for s in ("min", "max") if f"{channel} {s}" in solution.active_bounds)
    return next(sides, "")


def _places(robot: Manipulator) -> Any:
    """Where the bars stand: a gap between segments."""
    places, place = [], 0.0
    for segment in robot.description.segments:
        for _ in range(segment.n_channels):
            places.append(place)
            place += 1.0
        place += 0.6
    return np.array(places)


def _label_channels(axes: Any, robot: Manipulator, places: Any) -> None:
    counts = [segment.n_channels for segment in robot.description.segments]
    axes.set_xticks(places, [str(k + 1) for n in counts for k in range(n)])
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel("channel")
    start = 0
    for number, count in enumerate(counts):
        middle = places[start : start + count].mean()
        axes.text(
            middle, 1.0, f"segment {number + 1}", transform=axes.get_xaxis_transform(),
            ha="center", va="top", fontsize=10, weight="bold",
            color=style.edge(number),
        )  # fmt: skip
        start += count


def _pressure_legend(axes: Any, any_active: bool) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=style.INSIDE, label="pressure")]
    if any_active:
        handles.append(Patch(color=style.LIMIT, label="at a limit"))
    handles.append(Patch(facecolor=style.RANGE, edgecolor="#9aa3ab", label="allowed"))
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=9,
        frameon=False, columnspacing=1.2, handlelength=1.2,
    )  # fmt: skip


def _plain_frame(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
