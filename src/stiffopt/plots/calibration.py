"""Draw figures of calibrations and validations: errors, paths, models, stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.directions import direction_name
from stiffopt.display import display_units
from stiffopt.identify.results import Comparison
from stiffopt.identify.structures import Candidate
from stiffopt.identify.validation import StiffnessComparison
from stiffopt.model.description import RobotDescription
from stiffopt.plots.style import (
    BEFORE,
    MEASURED,
    MODEL,
    RANGE,
    channel_colour,
    draw_head,
    label_logarithmic,
    legend_beside,
    legend_on_top,
    literal,
    make_logarithmic,
    stacked_panels,
    thinned,
)
from stiffopt.plots.wording import vector_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MAX_LOGS = 8  # logs in a figure: those with the largest errors
_MAX_PATHS = 4  # logs in a figure of paths
_DRAWN = 3000  # points of a line
_SCATTERED = 1200  # points of a log in a scatter plot
_OUTSIDE = "#f2a541"
_HEAD = 1.08  # inches
_FOOT = 0.58
_GAP = 0.45
_ROW = 1.35
_LINE = 0.2  # of a legend
_LEGEND = 75  # characters in a line of a legend
_FEW = 30  # distinct pressures up to which logs are drawn side by side
_ASIDE = 0.015  # distance of logs side by side, as a share of the pressures' range
_PAUSE_STEPS = 5.0  # a pause in a recording exceeds this many median time steps, ...
_PAUSE = 1.0  # ... and this many seconds
_MIN_RANGE = 1e-3  # m, smallest range of an axis of the tip
_FLAT = 0.25  # smallest range of an axis, as a share of the widest of x, y and z


# -- over time ------------------------------------------------------------------------------------


def plot_errors_over_time(
    found: Sequence[Comparison], before: Sequence[Comparison] = (), *, title: str = "errors"
) -> Figure:
    """Draw the error of the tip over time, a panel for each log.

    `before` may contain the same logs, compared with the robot file before calibration.
    """
    shown = _worst(found)
    figure, panels = _rows(len(shown), _ROW if len(shown) > 2 else 2 * _ROW)
    logarithmic, unit = bool(before), display_units().length
    for axes, i in zip(panels[:, 0], shown, strict=True):
        each = found[i]
        _shade_outside(axes, each)
        if before:
            _line(axes, each.time, unit.of(before[i].distance), BEFORE, 0.9, "robot file before")
        _line(axes, each.time, unit.of(each.distance), MEASURED, 1.0, "this robot file")
        _panel_title(axes, each)
        axes.set_xlim(each.time[0], each.time[-1])
        if logarithmic:
            axes.set_yscale("log")
            _limit_decades(axes, found, before)
            make_logarithmic(axes)
        else:
            axes.set_ylim(bottom=0)
        axes.set_ylabel(f"error ({unit})")
    panels[-1, 0].set_xlabel("time (s)")
    _key(figure, panels[0, 0], found)
    draw_head(figure, title, _note("distance of the predicted from the measured tip", found, shown))
    return figure


def plot_tip_over_time(
    found: Sequence[Comparison], *, title: str = "tip", frame: str = "the tracker's frame"
) -> Figure:
    """Draw the measured and the predicted tip over time: x, y and z of each log."""
    shown = _worst(found)
    alone, unit = len(shown) == 1, display_units().length
    rows, columns = (3, 1) if alone else (len(shown), 3)
    figure, panels = _rows(rows, 1.7, columns=columns)
    for row, i in enumerate(shown):
        each = found[i]
        measured, predicted = unit.of(each.measured), unit.of(each.predicted)
        both = np.concatenate([measured, predicted])
        widest = float(np.nanmax(np.nanmax(both, axis=0) - np.nanmin(both, axis=0)))
        for axis in range(3):
            axes = panels[axis, 0] if alone else panels[row, axis]
            _shade_outside(axes, each)
            _line(axes, each.time, measured[:, axis], MEASURED, 1.6, "measured")
            _line(axes, each.time, predicted[:, axis], MODEL, 0.9, "predicted")
            axes.set_xlim(each.time[0], each.time[-1])
            axes.set_ylabel(f"{'xyz'[axis]} ({unit})")
            if axis == 0:
                _panel_title(axes, each)
            _room(axes, both[:, axis], max(_FLAT * widest, unit.of(_MIN_RANGE)))
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    _key(figure, panels[0, 0], found)
    draw_head(figure, title, _note(f"position in {frame}", found, shown))
    return figure


def plot_paths(
    found: Sequence[Comparison], *, title: str = "paths", frame: str = "the tracker's frame"
) -> Figure:
    """Draw the measured and the predicted path of the tip in three views, a row for each log."""
    shown, unit = _worst(found, _MAX_PATHS), display_units().length
    figure, panels = _rows(len(shown), 3.3 if len(shown) == 1 else 2.6, columns=3)
    for row, i in enumerate(shown):
        each = found[i]
        rows = _evenly(len(each.time), _DRAWN)
        measured = _path(each.time[rows], unit.of(each.measured[rows]))
        predicted = _path(each.time[rows], unit.of(each.predicted[rows]))
        for axes, (a, b) in zip(panels[row], ((0, 1), (0, 2), (1, 2)), strict=True):
            axes.plot(
                measured[:, a], measured[:, b], "-", color=MEASURED, linewidth=0.9, alpha=0.75,
                label="measured",
            )  # fmt: skip
            axes.plot(
                predicted[:, a], predicted[:, b], "-", color=MODEL, linewidth=0.7, alpha=0.75,
                label="predicted",
            )  # fmt: skip
            axes.set_xlabel(f"{'xyz'[a]} ({unit})", labelpad=1)
            axes.set_ylabel(f"{'xyz'[b]} ({unit})", labelpad=1)
            axes.set_aspect("equal", adjustable="datalim")
            axes.grid(alpha=0.2)
        _panel_title(panels[row, 0], each)
    _key(figure, panels[0, 0], ())
    draw_head(figure, title, _note(f"path in {frame}", found, shown))
    return figure


# -- over pressure --------------------------------------------------------------------------------


def plot_errors_over_pressure(
    found: Sequence[Comparison], robot: RobotDescription, *, title: str = "errors"
) -> Figure:
    """Draw the error of the tip over the pressure of each channel, a row for each segment.

    The last panel of a row is over the norm of the segment's pressures. The range of the
    calibration is shaded.
    """
    last = max(segment.n_channels for segment in robot.segments)
    length, pressure = display_units().length, display_units().pressure
    shown = [found[i] for i in _worst(found)]
    labels = [literal(each.name) for each in shown]
    seen = robot.calibration
    if seen is not None and seen.pressure_max:
        labels.append("what the calibration has seen")
    else:
        seen = None
    in_a_line = max(1, min(len(labels), _LEGEND // (max(map(len, labels)) + 4)))
    head = max(_HEAD, 0.35 + _LINE * -(-len(labels) // in_a_line))
    figure, panels = _rows(
        robot.n_segments, 2.5, columns=last + 1, head=head, between=0.08, sharey=True
    )
    are_moved = False
    for s, own in enumerate(robot.channel_ranges):
        for axes, channel in zip(panels[s], own, strict=False):
            pressures = [each.pressures[:, channel] for each in shown]
            limits = (seen.pressure_min[channel], seen.pressure_max[channel]) if seen else None
            are_moved |= _draw_clouds(axes, shown, pressures, limits)
            axes.set_xlabel(f"{robot.channel_name(channel)} ({pressure})")
        for axes in panels[s, len(own) : last]:
            axes.set_visible(False)
        norms = [np.linalg.norm(each.pressures[:, own], axis=1) for each in shown]
        limits = (0.0, seen.pressure_norm[s]) if seen else None
        are_moved |= _draw_clouds(panels[s, last], shown, norms, limits)
        panels[s, last].set_xlabel(f"norm of segment {s + 1} ({pressure})")
    for axes in panels[:, 0]:
        axes.set_ylabel(f"error ({length})")
    highest = max((float(np.nanmax(each.distance, initial=0.0)) for each in shown), default=1.0)
    panels[0, 0].set_ylim(0, 1.05 * length.of(highest))
    handles = list(panels[0, 0].lines)
    if seen:
        from matplotlib.patches import Patch

        handles.append(Patch(color=RANGE))
    legend_on_top(
        figure, handles, labels, ncols=in_a_line, fontsize=8.5, markerscale=4, columnspacing=1.2,
        handletextpad=0.4,
    )  # fmt: skip
    what = "error of the tip over pressure"
    if are_moved:
        what += " (the logs, of a few pressures each, stand side by side)"
    draw_head(figure, title, _note(what, found, _worst(found)))
    return figure


def _draw_clouds(
    axes: Any,
    logs: Sequence[Comparison],
    pressures: Sequence[Array],
    limits: tuple[float, float] | None,
) -> bool:
    """Draw the errors of logs over pressures in Pa, and shade limits.

    Logs with only a few distinct pressures are drawn side by side; returns whether they were.
    """
    length, pressure = display_units().length, display_units().pressure
    every = np.concatenate(pressures)
    moves = np.arange(len(logs), dtype=float) - (len(logs) - 1) / 2
    few = len(np.unique(every)) <= _FEW
    moves *= _ASIDE * float(np.ptp(every)) if few else 0.0
    if limits is not None:
        margin = float(moves.max(initial=0.0))
        low, high = pressure.of(limits[0] - margin), pressure.of(limits[1] + margin)
        axes.axvspan(low, high, color=RANGE, zorder=0)
    for number, (log, p) in enumerate(zip(logs, pressures, strict=True)):
        rows = _evenly(len(p), _SCATTERED)
        axes.plot(
            pressure.of(p[rows] + moves[number]), length.of(log.distance[rows]), ".",
            markersize=3.0, alpha=0.5, markeredgewidth=0, color=channel_colour(number),
        )  # fmt: skip
    return bool(moves.any())


# -- models and stiffness -------------------------------------------------------------------------


def plot_models(candidates: Sequence[Candidate], chosen: str, *, title: str = "models") -> Figure:
    """Draw the error of each model on held-back data."""
    figure, panels = stacked_panels(
        [0.5 * len(candidates)], left=1.76, right=2.86, head=1.13, foot=0.62
    )
    axes = panels[0, 0]
    folds, unit = list(candidates[0].folds), display_units().length
    for row, each in enumerate(candidates):
        is_chosen = each.structure.name == chosen
        axes.barh(
            row, unit.of(each.score), height=0.62, zorder=1,
            color="#b9cfe6" if is_chosen else "#e3e6e9",
        )  # fmt: skip
        for number, fold in enumerate(folds):
            axes.plot(
                unit.of(each.folds[fold].mean), row, "o", markersize=5,
                color=channel_colour(number), markeredgewidth=0,
                label=literal(fold) if row == 0 else None,
            )  # fmt: skip
    axes.set_yticks(range(len(candidates)), [each.structure.name for each in candidates])
    for tick, each in zip(axes.get_yticklabels(), candidates, strict=True):
        tick.set_fontweight("bold" if each.structure.name == chosen else "normal")
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel(f"mean error of the tip ({unit})")
    legend_beside(axes, title="held back", alignment="left")
    draw_head(figure, title, f"bars: mean over what was held back      chosen: {chosen}")
    return figure


def plot_stiffnesses(rows: Sequence[StiffnessComparison], *, title: str = "stiffness") -> Figure:
    """Draw measured stiffnesses with their 95 % intervals, and the robot's predictions."""
    figure, panels = stacked_panels([0.27 * len(rows)], left=2.64, right=2.2, head=1.13, foot=0.62)
    axes = panels[0, 0]
    places = np.arange(len(rows))
    unit = display_units().stiffness
    measured = unit.of(np.array([row.measured for row in rows]))
    axes.errorbar(
        measured, places, xerr=[unit.of(1.96 * row.sigma) for row in rows], fmt="s", markersize=5,
        capsize=3, color=MEASURED, label="measured, 95 %",
    )  # fmt: skip
    shown = [measured]
    for values, colour, mark, label in (
        ([row.before for row in rows], BEFORE, "D", "robot file before"),
        ([row.after for row in rows], MODEL, "o", "this robot file"),
    ):
        x = unit.of(np.array([np.nan if value is None else value for value in values]))
        shown.append(x)
        axes.plot(
            x, places, mark, markersize=5.5, markerfacecolor="none", markeredgewidth=1.4,
            color=colour, label=label,
        )  # fmt: skip
    axes.set_yticks(places, [_label(row) for row in rows], fontsize=8.5)
    axes.invert_yaxis()
    axes.set_xlabel(f"stiffness ({unit})")
    known = np.concatenate(shown)
    known = known[np.isfinite(known) & (known > 0)]
    if len(known) and known.max() > 8 * known.min():
        axes.set_xscale("log")
        label_logarithmic(axes.xaxis, *axes.get_xlim())
    else:
        axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.25, which="both")
    legend_beside(axes)
    draw_head(figure, title, "measured, and predicted at the same pressures")
    return figure


def _label(row: StiffnessComparison) -> str:
    unit = display_units().pressure
    pressures = vector_text(row.pressures, unit)
    label = f"{direction_name(row.direction)} at {pressures} {unit}"
    return label if row.boundary == "free" else f"{label}, {row.boundary}"


# -- parts ----------------------------------------------------------------------------------------


def _rows(rows: int, height: float, *, columns: int = 1, **settings: Any) -> tuple[Figure, Any]:
    """Return a figure with rows of panels of one height in inches, and its panels."""
    gap = _GAP * (1.25 if columns > 1 and "sharey" not in settings else 1.0)
    settings = {"head": _HEAD, "foot": _FOOT, "gap": gap, **settings}
    return stacked_panels([height] * rows, columns=columns, **settings)


def _worst(found: Sequence[Comparison], limit: int = _MAX_LOGS) -> list[int]:
    """Return the indices of the logs with the largest errors, in order."""
    if len(found) <= limit:
        return list(range(len(found)))
    errors = np.nan_to_num(np.array([each.errors.p95 for each in found]))
    return sorted(np.argsort(errors)[::-1][:limit].tolist())


def _note(what: str, found: Sequence[Comparison], shown: Sequence[int]) -> str:
    if len(shown) == len(found):
        return what
    return f"{what}      of {len(found)} logs the {len(shown)} with the largest errors"


def _panel_title(axes: Any, found: Comparison) -> None:
    errors = found.errors
    text = f"{found.name}"
    if errors.n:
        unit = display_units().length
        text += (
            f"   mean {unit.text(errors.mean, '.2f')}, 95 % below {unit.text(errors.p95, '.2f')}"
        )
    axes.set_title(literal(text), loc="left", fontsize=9.5, pad=7)


def _line(axes: Any, time: Array, values: Array, colour: str, width: float, label: str) -> None:
    """Draw a line that breaks at pauses; thinning keeps its peaks."""
    time, values = thinned(time, values, _DRAWN)
    line = _path(time, np.stack([time, values], axis=1))
    axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=width, label=label)


def _path(time: Array, values: Array) -> Array:
    """Return points (N, k) of a line without missing ones; NaN at pauses."""
    known = np.isfinite(values).all(axis=1)
    t, points = time[known], values[known]
    if len(t) < 3:
        return points
    steps = np.diff(t)
    pauses = np.flatnonzero(steps > max(_PAUSE_STEPS * float(np.median(steps)), _PAUSE)) + 1
    return np.asarray(np.insert(points, pauses, np.nan, axis=0))


def _evenly(count: int, limit: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.intp))


def _shade_outside(axes: Any, found: Comparison) -> None:
    """Mark the times at which pressures were outside those of the calibration."""
    if found.inside.all():
        return
    axes.fill_between(
        found.time, 0, 1, where=~found.inside, step="post", transform=axes.get_xaxis_transform(),
        color=_OUTSIDE, alpha=0.3, linewidth=0, zorder=0,
    )  # fmt: skip


def _limit_decades(axes: Any, found: Sequence[Comparison], before: Sequence[Comparison]) -> None:
    unit = display_units().length
    distances = unit.of(np.concatenate([each.distance for each in (*found, *before)]))
    known = distances[np.isfinite(distances) & (distances > 0)]
    if len(known):
        axes.set_ylim(np.quantile(known, 0.002) * 0.8, known.max() * 1.2)


def _room(axes: Any, values: Array, minimum: float) -> None:
    """Set the limits of the axis around values, with a margin and at least a range of `minimum`."""
    known = values[np.isfinite(values)]
    if len(known):
        middle, half = (known.max() + known.min()) / 2, (known.max() - known.min()) / 2
        half = max(1.08 * half, minimum / 2)
        axes.set_ylim(middle - half, middle + half)


def _key(figure: Figure, axes: Any, found: Sequence[Comparison]) -> None:
    """Add a legend of the lines, and of the shading if there is any, at the top."""
    handles, labels = axes.get_legend_handles_labels()
    if any(not each.inside.all() for each in found):
        from matplotlib.patches import Patch

        handles.append(Patch(color=_OUTSIDE, alpha=0.3))
        labels.append("outside what the calibration has seen")
    legend_on_top(figure, handles, labels, columnspacing=1.4)
