"""The page that a lab wants after a run: tip, error, pressures, stiffness, and what happened."""

from __future__ import annotations

import time
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.daemon.run_log import RecordedRun, RunEvent
from stiffopt.errors import printable
from stiffopt.plots.experiments import AXES, CHANNELS, _head, _legend, _plain
from stiffopt.plots.figures import _literal, require_matplotlib
from stiffopt.plots.run_timeline import SHADES, draw_timeline, timeline_rows
from stiffopt.plots.scales import make_logarithmic
from stiffopt.plots.style import TARGET
from stiffopt.plots.wording import BAR, MM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_run"]

Array = NDArray[np.float64]

_WIDE = 11.5  # inches
_HEAD = 1.3
_PANEL, _GAP, _ROW, _LINE = 1.35, 0.16, 0.24, 0.2
_FOOT = 0.62
_MOST_EVENTS = 14  # in the list
_POINTS = 4000  # of a line; more would not be seen
_FLOOR = 1e-5  # m; errors below are drawn there
_SMALLEST_RANGE = 2.0  # mm, of an axis of the tip
_GREY = "#8a8f96"


def plot_run(run: RecordedRun, *, title: str | None = None) -> Figure:
    """Draw a run.

    Parameters
    ----------
    run :
        At least one tick.
    title :
        By default the name of the rig.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    listed = _listed(run.events)
    stiff = bool(np.isfinite(run.stiffness).any())
    angles = bool(np.isfinite(run.angle_error).any())
    heights = [_PANEL] * 3 + [_PANEL] * (1 + angles) + [_PANEL] * (len(run.channels) + stiff)
    heights.append(_ROW * (timeline_rows(run) + 0.6))
    below = _FOOT + _LINE * (len(listed) + 1.2) * bool(listed)
    height = _HEAD + sum(heights) + _GAP * (len(heights) - 1) + below
    figure = Figure(figsize=(_WIDE, height))
    panels = figure.subplots(
        len(heights), 1, sharex=True, height_ratios=heights,
        gridspec_kw={
            "left": 0.105, "right": 0.84, "top": 1 - _HEAD / height, "bottom": below / height,
            "hspace": _GAP / np.mean(heights),
        },
    )  # fmt: skip
    rest = iter(panels)
    for axis in range(3):
        _draw_tip(next(rest), run, axis)
    _draw_error(next(rest), run)
    if angles:
        _draw_angle(next(rest), run)
    first = 0
    for segment, count in enumerate(run.channels):
        _draw_pressures(next(rest), run, segment, range(first, first + count))
        first += count
    if stiff:
        _draw_stiffness(next(rest), run)
    draw_timeline(panels[-1], run, listed)
    _shade(panels[:-1], run)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(run.time[0], max(run.time[-1], run.time[0] + 1e-3))
    for axes in panels[:-1]:
        axes.yaxis.set_label_coords(-0.062, 0.5)
    _list_events(figure, listed, below)
    _head(figure, title or run.about.get("rig", "run"), _literal(_what(run)))
    figure.text(0.025, 1 - 0.94 / height, _literal(_figures(run)), fontsize=10, va="center")
    return figure


def _draw_tip(axes: Any, run: RecordedRun, axis: int) -> None:
    seen = run.seen_position[:, axis] * MM
    if np.isfinite(seen).any():
        axes.plot(
            *_thinned(run.captured, seen), "o", color=AXES[axis], alpha=0.3, markersize=4.5,
            markeredgewidth=0, label="tracker",
        )  # fmt: skip
    axes.plot(
        *_thinned(run.time, run.tip_position[:, axis] * MM), color=AXES[axis], linewidth=1.3,
        label="estimate",
    )  # fmt: skip
    target = run.target_position[:, axis] * MM
    if np.isfinite(target).any():
        axes.plot(
            *_thinned(run.time, target), color=TARGET, linewidth=1.3, linestyle=(0, (4, 2)),
            label="target",
        )  # fmt: skip
    low, high = axes.get_ylim()
    if high - low < _SMALLEST_RANGE:  # noise is not to look like motion
        middle = (low + high) / 2
        axes.set_ylim(middle - _SMALLEST_RANGE / 2, middle + _SMALLEST_RANGE / 2)
    axes.set_ylabel(f"tip {'xyz'[axis]} (mm)")
    _legend(axes)
    _plain(axes)


def _draw_error(axes: Any, run: RecordedRun) -> None:
    error = np.maximum(run.position_error, _FLOOR) * MM
    axes.plot(*_thinned(run.time, error), color="#333333", linewidth=1.2, label="position")
    axes.set_ylabel("error (mm)")
    known = error[np.isfinite(error)]
    if len(known):
        axes.set_ylim(0.8 * known.min(), 1.3 * max(known.max(), 2 * known.min()))
        make_logarithmic(axes)
        axes.grid(alpha=0.25, axis="y")
        _legend(axes)
    else:
        axes.set_yticks([])
        axes.text(
            0.5, 0.5, "nothing was asked for", transform=axes.transAxes, ha="center", color=_GREY
        )
    _plain(axes)


def _draw_angle(axes: Any, run: RecordedRun) -> None:
    axes.plot(
        *_thinned(run.time, np.degrees(run.angle_error)), color="#333333", linewidth=1.2,
        label="angle",
    )  # fmt: skip
    axes.set_ylabel("error (deg)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25, axis="y")
    _legend(axes)
    _plain(axes)


def _draw_pressures(axes: Any, run: RecordedRun, segment: int, channels: range) -> None:
    from matplotlib.lines import Line2D

    for channel in channels:
        colour = CHANNELS[(channel - channels[0]) % len(CHANNELS)]
        axes.plot(
            *_thinned(run.time, run.measured[:, channel] * BAR), color=colour, linewidth=2.6,
            alpha=0.3,
        )  # fmt: skip
        axes.plot(
            *_thinned(run.time, run.commanded[:, channel] * BAR), color=colour, linewidth=1.1,
            label=f"p{channel + 1}",
        )  # fmt: skip
    limits = np.unique(np.stack([run.low, run.high])[:, :, list(channels)] * BAR)
    for limit in limits[np.isfinite(limits)]:
        axes.axhline(limit, color=_GREY, linewidth=0.9, linestyle=(0, (1, 2)), zorder=1)
    handles = [*axes.get_legend_handles_labels()[0]]
    if segment == 0:
        handles += [
            Line2D([], [], color=_GREY, linewidth=2.6, alpha=0.5, label="measured"),
            Line2D([], [], color=_GREY, linewidth=1.1, label="commanded"),
            Line2D([], [], color=_GREY, linewidth=0.9, linestyle=(0, (1, 2)), label="limits"),
        ]
    axes.set_ylabel(f"segment {segment + 1}\n(bar)")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.03), high + 0.02 * (high - low))
    _legend(axes, handles=handles)
    _plain(axes)


def _draw_stiffness(axes: Any, run: RecordedRun) -> None:
    if np.isfinite(run.best_stiffness).any():
        axes.plot(
            *_thinned(run.time, run.best_stiffness), color=TARGET, linewidth=1.3,
            linestyle=(0, (4, 2)), label="of the plan",
        )  # fmt: skip
    axes.plot(
        *_thinned(run.time, run.stiffness), color="#6a3d9a", linewidth=1.3, label="of the arm,\nnow"
    )  # fmt: skip
    axes.set_ylabel("stiffness\n(N/m, N m/rad)")
    axes.grid(alpha=0.25, axis="y")
    _legend(axes)
    _plain(axes)


def _shade(panels: Any, run: RecordedRun) -> None:
    """Let the states in which it did not steer show behind everything."""
    for span in run.states:
        if span.kind in SHADES and span.kind != "active":
            for axes in panels:
                axes.axvspan(
                    span.begin, span.end, color=SHADES[span.kind], alpha=0.22, linewidth=0, zorder=0
                )


def _list_events(figure: Any, listed: list[RunEvent], below: float) -> None:
    height = figure.get_figheight()
    for line, event in enumerate(listed):
        text = shorten(printable(event.text), 120, placeholder=" ...")
        y = (below - _FOOT - _LINE * (line + 0.6)) / height
        figure.text(0.04, y, f"{line + 1}", fontsize=8.5, weight="bold", va="center", ha="right")
        figure.text(0.105, y, f"{event.time:.2f} s", fontsize=8.5, va="center", ha="right")
        figure.text(0.12, y, _literal(event.kind), fontsize=8.5, va="center", weight="bold")
        figure.text(0.28, y, _literal(text), fontsize=8.5, va="center")


def _listed(events: tuple[RunEvent, ...]) -> list[RunEvent]:
    """Return the events that are told in words: the gravest where there are too many."""

    def rank(index: int) -> tuple[int, int]:
        event = events[index]
        over = event.kind.endswith("-over")
        return {"error": 0, "warning": 1}.get(event.severity, 2) + over, index

    order = sorted(range(len(events)), key=rank)
    return [events[i] for i in sorted(order[:_MOST_EVENTS])]


def _what(run: RecordedRun) -> str:
    begin = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(int(run.about["start_ns"]) // 10**9))
    parts = [run.about.get("robot", ""), begin, f"{run.time[-1] - run.time[0]:.1f} s"]
    if "overruns" in run.timing:
        parts.append(f"{run.timing['ticks']} ticks, {run.timing['overruns']} overruns")
    if not run.complete:
        parts.append("not a whole recording")
    return "      ".join(parts)


def _figures(run: RecordedRun) -> str:
    """Say how well it went while it steered."""
    steered = np.zeros(len(run), dtype=bool)
    for span in run.states:
        if span.kind == "active":
            steered |= (run.time >= span.begin) & (run.time < span.end)
    parts = []
    error = run.position_error[steered & np.isfinite(run.position_error)] * MM
    if len(error):
        low, middle, high = np.quantile(error, (0.05, 0.5, 0.95))
        parts.append(f"error: median {middle:.3g} mm, 90 % within {low:.3g} to {high:.3g} mm")
    share = (run.stiffness / run.best_stiffness)[steered]
    if np.isfinite(share).any():
        parts.append(f"stiffness: median {100 * np.nanmedian(share):.0f} % of the plan's")
    return f"while active:   {'      '.join(parts)}" if parts else "nothing was asked for"


def _thinned(moments: Array, values: Array) -> tuple[Array, Array]:
    """Return a line with at most some thousand points that shows the same extremes."""
    count = len(moments)
    size = -(-2 * count // _POINTS)
    if size <= 2:
        return moments, values
    bins = count // size
    shaped = values[: bins * size].reshape(bins, size)
    filled_low = np.where(np.isfinite(shaped), shaped, np.inf)
    filled_high = np.where(np.isfinite(shaped), shaped, -np.inf)
    pair = np.sort(np.stack([filled_low.argmin(axis=1), filled_high.argmax(axis=1)]), axis=0)
    rows = np.unique((pair + np.arange(bins) * size).ravel(order="F"))
    rows = np.append(rows, count - 1) if rows[-1] != count - 1 else rows
    return moments[rows], values[rows]
