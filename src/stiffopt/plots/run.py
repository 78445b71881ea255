"""Draw a closed-loop run: tip, error, force, pressures, stiffness, states and events."""

from __future__ import annotations

import time
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.control.state import Event
from stiffopt.daemon.run_errors import ARRIVED, ARRIVED_ANGLE, ErrorStatistics, RunStages
from stiffopt.daemon.run_log import RecordedRun, RunSpan
from stiffopt.display import display_units
from stiffopt.errors import printable
from stiffopt.plots.style import (
    AXES,
    DARK,
    ELLIPSOID,
    FORCE,
    GREY,
    TARGET,
    channel_colour,
    draw_head,
    legend_beside,
    literal,
    make_logarithmic,
    stacked_panels,
    thinned,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_WIDE = 11.5  # inches
_HEAD = 1.82  # inches, title and four lines
_PANEL, _GAP, _ROW, _LINE = 1.35, 0.16, 0.24, 0.2
_FOOT = 0.62
_MAX_EVENTS = 14  # in the list
_FLOOR = 1e-5  # m; smaller errors are drawn here
_SMALLEST_RANGE = 2e-3  # m, of an axis of the tip
_BELOW_ZERO = 3e3  # Pa, shown below zero on axes of pressure
_STATES = {
    "unconfigured": "#c9cdd2",
    "inactive": "#c9cdd2",
    "active": "#7fb77e",
    "holding": "#f2b134",
    "fault": "#d9534f",
}
_SEVERITIES = {"info": "#4e79a7", "warning": "#e0a100", "error": "#b00020"}
_ALARM = "#e07b39"
_MAX_ALARMS = 6  # kinds of alarms that have a row
_HALF = 0.36  # half width of a band, as a share of a row
_LONGEST = 20  # letters of a name
_LETTER_WIDTH = 0.0095  # of the panel's width
_APART = 0.012  # of the panel's width; smallest distance between two numbers of events
_WANTED: dict[str, Any] = {"color": TARGET, "linestyle": (0, (4, 2))}
_LIMIT: dict[str, Any] = {"color": GREY, "linewidth": 0.9, "linestyle": (0, (1, 2))}


def plot_run(run: RecordedRun, *, title: str | None = None) -> Figure:
    """Draw a run with at least one tick; the title is by default the name of the rig."""
    listed = _listed(run.events)
    stiff = bool(np.isfinite(run.stiffness).any())
    angles = bool(np.isfinite(run.angle_error).any())
    forces = bool(np.isfinite(run.press_goal).any() or np.nan_to_num(run.wrench).any())
    heights = [_PANEL] * (4 + angles + forces + len(run.channels) + stiff)
    heights.append(_ROW * (1.6 + len(_alarm_kinds(run)) + bool(run.events)))
    below = _FOOT + _LINE * (len(listed) + 1.2) * bool(listed)
    figure, grid = stacked_panels(
        heights, wide=_WIDE, left=1.21, right=1.84, head=_HEAD, foot=below, gap=_GAP, sharex=True
    )
    panels = grid[:, 0]
    rest = iter(panels)
    for axis in range(3):
        _draw_tip(next(rest), run, axis)
    stages = RunStages.of(run)
    _draw_error(next(rest), run, stages)
    if angles:
        _draw_angle(next(rest), run)
    if forces:
        _draw_force(next(rest), run)
    first = 0
    for segment, count in enumerate(run.channels):
        _draw_pressures(next(rest), run, segment, range(first, first + count))
        first += count
    if stiff:
        _draw_stiffness(next(rest), run)
    _draw_timeline(panels[-1], run, listed)
    _shade(panels[:-1], run)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(run.time[0], max(run.time[-1], run.time[0] + 1e-3))
    for axes in panels[:-1]:
        axes.yaxis.set_label_coords(-0.062, 0.5)
    _list_events(figure, listed, below)
    draw_head(
        figure, title or run.about.get("rig", "run"), _what(run), *error_lines(run, stages),
        *_stiffness_line(run, stages),
    )  # fmt: skip
    return figure


def _line(axes: Any, time: Array, values: Array, label: str | None, **look: Any) -> None:
    axes.plot(*thinned(time, values), label=label, **{"linewidth": 1.3, **look})


def _draw_tip(axes: Any, run: RecordedRun, axis: int) -> None:
    unit = display_units().length
    seen = unit.of(run.seen_position[:, axis])
    if np.isfinite(seen).any():
        axes.plot(
            *thinned(run.captured, seen), "o", color=AXES[axis], alpha=0.3, markersize=4.5,
            markeredgewidth=0, label="tracker",
        )  # fmt: skip
    _line(axes, run.time, unit.of(run.tip_position[:, axis]), "estimate", color=AXES[axis])
    target = unit.of(run.target_position[:, axis])
    if np.isfinite(target).any():
        _line(axes, run.time, target, "target", **_WANTED)
    low, high = axes.get_ylim()
    minimum = unit.of(_SMALLEST_RANGE)
    if high - low < minimum:  # else noise would look like motion
        middle = (low + high) / 2
        axes.set_ylim(middle - minimum / 2, middle + minimum / 2)
    axes.set_ylabel(f"tip {'xyz'[axis]} ({unit})")
    legend_beside(axes)


def _draw_error(axes: Any, run: RecordedRun, stages: RunStages) -> None:
    unit = display_units().length
    error = unit.of(np.maximum(run.position_error, _FLOOR))
    look = {"color": DARK, "linewidth": 1.2}
    _line(axes, run.time, error, "approaching", **look, alpha=0.35)
    _line(axes, run.time, np.where(stages.hold, error, np.nan), "holding", **look)
    axes.set_ylabel(f"error ({unit})")
    known = error[np.isfinite(error)]
    if len(known):
        axes.set_ylim(0.8 * known.min(), 1.3 * max(known.max(), 2 * known.min()))
        make_logarithmic(axes)
        axes.grid(alpha=0.25, axis="y")
        legend_beside(axes)
    else:
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no target was set", transform=axes.transAxes, ha="center", color=GREY)


def _draw_angle(axes: Any, run: RecordedRun) -> None:
    unit = display_units().angle
    _line(axes, run.time, unit.of(run.angle_error), "angle", color=DARK, linewidth=1.2)
    axes.set_ylabel(f"error ({unit})")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25, axis="y")
    legend_beside(axes)


def _draw_force(axes: Any, run: RecordedRun) -> None:
    """Draw the estimated force: its component along a press, else its magnitude."""
    unit, force = display_units().force, run.wrench[:, :3]
    size = np.linalg.norm(force, axis=1)
    felt = np.where(np.isfinite(run.press_force), run.press_force, size)
    covariance = run.wrench_covariance.reshape(-1, 3, 3)
    way = force / np.maximum(size, 1e-12)[:, None]
    band = 2 * np.sqrt(np.einsum("ti,tij,tj->t", way, covariance, way))
    _line(axes, run.time, unit.of(felt), "felt", color=FORCE)
    time, low = thinned(run.time, unit.of(felt - band))
    _, high = thinned(run.time, unit.of(felt + band))
    axes.fill_between(time, low, high, color=FORCE, alpha=0.18, linewidth=0, label="95 %")
    if np.isfinite(run.press_goal).any():
        _line(axes, run.time, unit.of(run.press_goal), "wanted", **_WANTED)
    axes.set_ylabel(f"force ({unit})")
    axes.grid(alpha=0.25, axis="y")
    legend_beside(axes)


def _draw_pressures(axes: Any, run: RecordedRun, segment: int, channels: range) -> None:
    from matplotlib.lines import Line2D

    unit = display_units().pressure
    for channel in channels:
        colour = channel_colour(channel - channels[0])
        measured, commanded = (unit.of(p[:, channel]) for p in (run.measured, run.commanded))
        _line(axes, run.time, measured, None, color=colour, linewidth=2.6, alpha=0.3)
        _line(axes, run.time, commanded, f"p{channel + 1}", color=colour, linewidth=1.1)
    limits = np.unique(unit.of(np.stack([run.low, run.high])[:, :, list(channels)]))
    for limit in limits[np.isfinite(limits)]:
        axes.axhline(limit, **_LIMIT, zorder=1)
    handles = [*axes.get_legend_handles_labels()[0]]
    if segment == 0:
        handles += [
            Line2D([], [], color=GREY, linewidth=2.6, alpha=0.5, label="measured"),
            Line2D([], [], color=GREY, linewidth=1.1, label="commanded"),
            Line2D([], [], **_LIMIT, label="limits"),
        ]
    axes.set_ylabel(f"segment {segment + 1}\n({unit})")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -unit.of(_BELOW_ZERO)), high + 0.02 * (high - low))
    legend_beside(axes, handles=handles)


def _draw_stiffness(axes: Any, run: RecordedRun) -> None:
    unit = display_units().of_si(run.stiffness_unit)
    if np.isfinite(run.best_stiffness).any():
        _line(axes, run.time, unit.of(run.best_stiffness), "of the plan", **_WANTED)
    _line(axes, run.time, unit.of(run.stiffness), "of the arm,\nnow", color=ELLIPSOID)
    axes.set_ylabel(f"stiffness\n({unit})")
    axes.grid(alpha=0.25, axis="y")
    legend_beside(axes)


def _shade(panels: Any, run: RecordedRun) -> None:
    """Shade the times at which the loop was not active, in the colour of its state."""
    for span in run.states:
        if span.kind in _STATES and span.kind != "active":
            for axes in panels:
                shade = {"color": _STATES[span.kind], "alpha": 0.22, "linewidth": 0}
                axes.axvspan(span.begin, span.end, **shade, zorder=0)


def _list_events(figure: Any, listed: list[Event], below: float) -> None:
    height = figure.get_figheight()
    for line, event in enumerate(listed):
        text = shorten(printable(event.text), 120, placeholder=" ...")
        y = (below - _FOOT - _LINE * (line + 0.6)) / height
        figure.text(0.04, y, f"{line + 1}", fontsize=8.5, weight="bold", va="center", ha="right")
        figure.text(0.105, y, f"{event.time:.2f} s", fontsize=8.5, va="center", ha="right")
        figure.text(0.12, y, literal(event.kind), fontsize=8.5, va="center", weight="bold")
        figure.text(0.28, y, literal(text), fontsize=8.5, va="center")


def _listed(events: tuple[Event, ...]) -> list[Event]:
    """Return the events to list in words: the most severe if there are too many."""

    def rank(index: int) -> tuple[int, int]:
        event = events[index]
        over = event.kind.endswith("-over")
        return {"error": 0, "warning": 1}.get(event.severity, 2) + over, index

    order = sorted(range(len(events)), key=rank)
    return [events[i] for i in sorted(order[:_MAX_EVENTS])]


def _what(run: RecordedRun) -> str:
    begin = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(int(run.about["start_ns"]) // 10**9))
    parts = [run.about.get("robot", ""), begin, f"{run.time[-1] - run.time[0]:.1f} s"]
    if "overruns" in run.timing:
        parts.append(f"{run.timing['ticks']} ticks, {run.timing['overruns']} overruns")
    if not run.complete:
        parts.append("not a whole recording")
    return "      ".join(parts)


def error_lines(run: RecordedRun, stages: RunStages | None = None) -> list[str]:
    """Describe the tip's errors, on the way to its targets and at them."""
    approach, hold = stages or RunStages.of(run)
    units = display_units()
    if not (approach | hold).any():
        return ["no target was set"]
    lines = [f"on the way to a target:   {_errors_text(run, approach)}"] if approach.any() else []
    if hold.any():
        return [*lines, f"at a target:   {_errors_text(run, hold)}"]
    return [
        *lines,
        f"no target was reached to {units.length.text(ARRIVED, 'g')} and "
        f"{units.angle.text(ARRIVED_ANGLE, 'g')}",
    ]


def _errors_text(run: RecordedRun, ticks: Flags) -> str:
    length, angle = display_units().length, display_units().angle
    known = (
        (ErrorStatistics.of(length.of(run.position_error[ticks])), length),
        (ErrorStatistics.of(angle.of(run.angle_error[ticks])), angle),
    )
    return "      ".join(
        f"error mean {found.mean:.3g}, 95 % below {found.p95:.3g}, "
        f"at most {found.largest:.3g} {unit}"
        for found, unit in known
        if found is not None
    )


def _stiffness_line(run: RecordedRun, stages: RunStages) -> list[str]:
    """Describe the median stiffness while the loop had a target."""
    share = (run.stiffness / run.best_stiffness)[stages.approach | stages.hold]
    if not np.isfinite(share).any():
        return []
    return [f"stiffness: median {100 * np.nanmedian(share):.0f} % of the plan's"]


# -- states, alarms and events over time ----------------------------------------------------------


def _draw_timeline(axes: Any, run: RecordedRun, listed: list[Event]) -> None:
    """Draw bands for states and alarms, and marks for events, with numbers for listed ones."""
    kinds = _alarm_kinds(run)
    labels = ["state", *kinds, *(["events"] if run.events else [])]
    width = max(float(run.time[-1] - run.time[0]), 1e-3)
    for span in run.states:
        _band(axes, span, 0, _STATES[span.kind])
        if (span.end - span.begin) / width > _LETTER_WIDTH * (len(span.kind) + 1):
            middle = (span.begin + span.end) / 2
            axes.text(middle, 0, span.kind, ha="center", va="center", fontsize=8, clip_on=True)
    for span in run.alarms:
        if span.kind in kinds:
            _band(axes, span, 1 + kinds.index(span.kind), _ALARM)
    if run.events:
        _draw_events(axes, run, listed, len(labels) - 1, width)
    names = [label if len(label) <= _LONGEST else f"{label[: _LONGEST - 3]}..." for label in labels]
    axes.set_yticks(range(len(labels)), [literal(name) for name in names])
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0, labelsize=8)
    axes.tick_params(axis="x", labelsize=9)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _band(axes: Any, span: RunSpan, row: int, colour: str) -> None:
    axes.fill_between([span.begin, span.end], row - _HALF, row + _HALF, color=colour, linewidth=0.6)


def _draw_events(axes: Any, run: RecordedRun, listed: list[Event], row: int, width: float) -> None:
    numbers = {id(event): number for number, event in enumerate(listed, start=1)}
    last = -float("inf")
    for event in run.events:
        colour = _SEVERITIES.get(event.severity, _SEVERITIES["info"])
        axes.vlines(event.time, row - _HALF, row + _HALF, color=colour, linewidth=1.6)
        number = numbers.get(id(event))
        if number is not None and event.time - last > _APART * width:
            last = event.time
            axes.annotate(
                str(number), (event.time, row), xytext=(2, 0), textcoords="offset points",
                va="center", fontsize=8, color=colour, weight="bold",
            )  # fmt: skip


def _alarm_kinds(run: RecordedRun) -> list[str]:
    """Return the kinds of alarms that have a row: those that lasted longest."""
    stood: dict[str, float] = {}
    for span in run.alarms:
        stood[span.kind] = stood.get(span.kind, 0.0) + span.end - span.begin
    kept = sorted(stood, key=lambda kind: -stood[kind])[:_MAX_ALARMS]
    return [kind for kind in stood if kind in kept]
