"""Draw a solved path: the arm along it, its stiffness and its pressures over time.

Each panel is a function that draws into axes of the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.paths.path import Path
from stiffopt.paths.rates import step_limits
from stiffopt.paths.solution import PathSolution
from stiffopt.plots import style
from stiffopt.plots.arm import ArmDrawing
from stiffopt.plots.contact import draw_forces, draw_leaning_tube
from stiffopt.plots.view import View
from stiffopt.plots.wording import stiffness_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_POSES = 5  # of the arm
_LOGARITHMIC = 30  # largest by smallest stiffness from which the scale is logarithmic
_FULL = 0.99  # share of a rate from which a pressure counts as changing at it


def plot_path(
    path: Path, solution: PathSolution, *, title: str | None = None, view: View | None = None
) -> Figure:
    """Draw a solved path: the arm along it, and stiffness, clearance and pressures over time.

    Raises `InputError`: the solution has no points, or the view is invalid; `MissingExtraError` if
    matplotlib is not installed.

    Parameters
    ----------
    title : by default the name of the path's file.
    view : (elevation, azimuth), from where to look at the arm, in rad or as text with a unit; see
        `draw_arm`.
    """
    source = path.source
    name = solution.robot.description.name if source is None else source.stem
    limits = path.pressure_bounds(solution.robot.description)
    return _figure(
        solution,
        path,
        path.scene,
        limits,
        view,
        title or name,
        lambda: _key_numbers(path, solution),
    )


def plot_motion(
    solution: PathSolution,
    scene: Scene | None = None,
    *,
    title: str | None = None,
    view: View | None = None,
) -> Figure:
    """Draw a motion of `stiffopt.plan_motion` as `plot_path` draws a path.

    Raises `InputError`: the solution has no points, or the view is invalid; `MissingExtraError` if
    matplotlib is not installed.

    Parameters
    ----------
    scene : the scene that the motion keeps clear of.
    title : by default the name of the robot.
    view : (elevation, azimuth), from where to look at the arm, in rad or as text with a unit; see
        `draw_arm`.
    """
    robot = solution.robot
    limits = robot.pressure_min, robot.pressure_max
    name = title or robot.description.name
    return _figure(solution, None, scene, limits, view, name, lambda: _duration(solution))


def _figure(
    solution: PathSolution, path: Path | None, scene: Scene | None, limits: tuple[Array, Array],
    view: View | None, title: str, key_numbers: Callable[[], str],
) -> Figure:  # fmt: skip
    style.require_matplotlib()
    _require_points(solution)
    heights = [1.5] * (solution.stiffness is not None) + [0.8] * (solution.clearance is not None)
    heights += [1.2] * solution.robot.n_segments
    height = max(6.6, 1.4 + 1.35 * sum(heights))
    figure = style.new_figure(13, height)
    grid = figure.add_gridspec(
        len(heights), 1, height_ratios=heights, left=0.6, right=0.975, top=1 - 1.35 / height,
        bottom=0.55 / height, hspace=0.2,
    )  # fmt: skip
    axes = style.add_space(figure, (0.02, 0.1 / height, 0.52, 1 - 1.1 / height))
    handles = draw_path(axes, solution, path=path, scene=scene, view=view)
    style.legend_in_corner(axes, handles)
    panels: list[Any] = []
    for row in range(len(heights)):
        panels.append(figure.add_subplot(grid[row, 0], sharex=panels[0] if panels else None))
        style.tidy(panels[-1])
        panels[-1].tick_params(labelbottom=row == len(heights) - 1)
    left = iter(panels)
    if solution.stiffness is not None:
        draw_stiffness_along(next(left), solution)
    if solution.clearance is not None:
        draw_clearance_along(next(left), solution, None if scene is None else scene.clearance)
    for segment, panel in enumerate(left, start=1):
        draw_pressures_along(panel, solution, segment, limits)
    for panel in panels[:-1]:
        panel.set_xlabel("")
    style.draw_outcome(figure, title, key_numbers(), solution.status, solution.message)
    return figure


def _require_points(solution: PathSolution) -> None:
    if not len(solution.times):
        raise InputError("there is nothing to draw: the solution has no points")


def _duration(solution: PathSolution) -> str:
    return f"{len(solution.times)} points in {solution.times[-1]:.4g} s"


def _key_numbers(path: Path, solution: PathSolution) -> str:
    parts, units = [_duration(solution)], display_units()
    if solution.position_errors is not None:
        parts.append(
            f"tip error at most {units.length.text(solution.position_errors.max(), '.3g')} "
            f"(tolerance {units.length.text(path.tolerance.position, 'g')})"
        )
    if solution.angle_errors is not None:
        parts.append(units.angle.text(solution.angle_errors.max(), ".3g"))
    if solution.stiffness is not None and path.stiffness is not None:
        index = int(np.argmin(solution.stiffness))
        share = ""
        if solution.alone is not None:
            share = f" ({solution.stiffness[index] / solution.alone[index]:.0%} of that alone)"
        worst = stiffness_text(solution.stiffness[index], solution.stiffness_unit)
        parts.append(f"worst stiffness {worst}{share}")
    return "      ".join(parts)


def draw_path(
    axes: Any,
    solution: PathSolution,
    *,
    path: Path | None = None,
    scene: Scene | None = None,
    view: View | None = None,
    labelled: bool = True,
) -> list[Any]:
    """Draw the arm at some of the points, and the path of its tip.

    Returns handles for a legend. Raises `InputError`: the solution has no points, or the view is
    invalid.

    Parameters
    ----------
    axes : in 3-D, as for `draw_arm`.
    path : the requested path, to draw together with the followed one.
    scene : the objects around the arm.
    view : (elevation, azimuth), see `draw_arm`.
    labelled : whether to label the point of least stiffness.
    """
    _require_points(solution)
    drawing = ArmDrawing(axes, solution.robot)
    drawing.draw_base()
    last = len(solution.times) - 1
    for index in np.unique(np.linspace(0, last, _POSES).astype(int)):
        shade = 0.3 if index in (0, last) else 0.1
        leaning = solution.equilibrium(int(index))
        if leaning is None:
            drawing.draw_tube(solution.pressures[index], shade)
        else:
            draw_leaning_tube(drawing, leaning, shade)
    drawing.explain_segments()
    tips = drawing.unit.of(solution.tip_poses[:, :3, 3].T)
    if path is not None:
        _draw_requested(drawing, path)
    axes.plot(*tips, color=style.DARK, linewidth=2.2, zorder=8)
    drawing.add_line(style.DARK, "tip")
    drawing.add_body(tips.T)
    marks = [(0, "o", style.DARK, "start", 10), (last, "s", style.DARK, "end", 9)]
    if solution.worst_index is not None:
        marks.append((solution.worst_index, "D", style.AT_LIMIT, "least stiff", 7))
    if solution.first_failure is not None:
        marks.append((solution.first_failure, "X", style.TARGET, "first failure", 7))
    for index, marker, colour, label, size in marks:
        look = {"marker": marker, "markersize": size, "markeredgecolor": "white"}
        axes.plot(*tips[:, index, None], color=colour, linestyle="none", zorder=11, **look)
        drawing.add_line(colour, label, "none", **look)
        drawing.add_mark(tips[:, index])
    if labelled:
        _label_stiffness(drawing, solution, tips)
    if scene is not None:
        drawing.draw_objects(scene)
    end = solution.equilibria[-1] if solution.equilibria else None
    if end is not None:
        draw_forces(drawing, end)
    return drawing.finish(view)


def draw_asked_path(
    axes: Any, robot: Manipulator, path: Path, *, view: View | None = None
) -> list[Any]:
    """Draw a requested path, and the arm at its lowest pressures.

    Returns handles for a legend. Raises `InputError`: the view is invalid.

    Parameters
    ----------
    axes : in 3-D, as for `draw_arm`.
    view : (elevation, azimuth), see `draw_arm`.
    """
    drawing = ArmDrawing(axes, robot)
    drawing.draw_base()
    drawing.draw_tube(robot.pressure_min)
    drawing.explain_segments()
    _draw_requested(drawing, path)
    return drawing.finish(view, path.scene)


def _draw_requested(drawing: ArmDrawing, path: Path) -> None:
    points = drawing.unit.of(path.points().positions)
    drawing.axes.plot(*points.T, color=style.TARGET, linewidth=1.4, linestyle=":", zorder=9)
    drawing.add_line(style.TARGET, "path that is asked for", ":")
    drawing.corners.append(points)


def _label_stiffness(drawing: ArmDrawing, solution: PathSolution, tips: Array) -> None:
    """Label the point of least stiffness."""
    if solution.worst is not None and np.isfinite(solution.worst):
        text = f"least stiff:\n{stiffness_text(solution.worst, solution.stiffness_unit)}"
        drawing.add_label(tips[:, solution.worst_index], text, style.LEAST_STIFF_TEXT)


def draw_stiffness_along(axes: Any, solution: PathSolution) -> None:
    """Draw stiffness over time, and the best stiffness of each single point.

    Raises `InputError`: the solution has no stiffness: its path maximises none, or it has no
    points.

    Parameters
    ----------
    axes : of matplotlib.
    """
    index = solution.worst_index
    if solution.stiffness is None or index is None:
        raise InputError("there is nothing to draw: the solution has no stiffness")
    unit = display_units().of_si(solution.stiffness_unit)
    known = np.isfinite(solution.stiffness)
    values = np.where(known, unit.of(solution.stiffness), np.nan)
    for k, (begin, end) in enumerate(_stretches(solution.times, ~known)):
        axes.axvspan(
            begin, end, linewidth=0, color=style.GREY, alpha=0.2,
            label="" if k else "without limit: an object holds the tip",
        )  # fmt: skip
    if solution.alone is not None:
        axes.plot(
            solution.times, unit.of(solution.alone), color=style.GREY, linewidth=5, alpha=0.35,
            label="each point alone",
        )  # fmt: skip
    axes.plot(
        solution.times, values, ".-", color=style.WITHIN_LIMITS, linewidth=2, markersize=2,
        label="on the path",
    )  # fmt: skip
    if not known.any():
        axes.set_yticks([])
    else:
        axes.plot(
            solution.times[index], values[index], "D", color=style.AT_LIMIT, markersize=7,
            markeredgecolor="white", label="least stiff",
        )  # fmt: skip
        axes.set_ylim(bottom=0.85 * values[index])
    if values[known].max(initial=0.0) > _LOGARITHMIC * values[index]:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_ylabel(f"stiffness\n({unit})")
    axes.set_xlabel("time (s)")
    _legend(axes)


def _stretches(times: Array, where: Flags) -> Iterator[tuple[float, float]]:
    """Yield the beginning and end of each stretch, halfway to the next samples."""
    edges = np.concatenate([times[:1], (times[1:] + times[:-1]) / 2, times[-1:]])
    changes = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    for first, after in changes.reshape(-1, 2):
        yield float(edges[first]), float(edges[after])


def draw_clearance_along(axes: Any, solution: PathSolution, required: float | None = None) -> None:
    """Draw clearance over time, and the required clearance.

    Raises `InputError`: the solution has no clearance: there is no scene, or it has no points.

    Parameters
    ----------
    axes : of matplotlib.
    required : in m.
    """
    if solution.clearance is None or not len(solution.times):
        raise InputError("there is nothing to draw: the solution has no clearance")
    unit = display_units().length
    clearance = unit.of(solution.clearance)
    axes.plot(solution.times, clearance, color=style.OBSTACLE, linewidth=2)
    if required is not None:
        axes.axhline(unit.of(required), color=style.BOUND, linestyle=":", label="required")
        _legend(axes)
    axes.set_ylim(bottom=min(0.0, clearance.min()))
    axes.set_ylabel(f"clearance\n({unit})")
    axes.set_xlabel("time (s)")


def draw_pressures_along(
    axes: Any, solution: PathSolution, segment: int, limits: tuple[Array, Array] | None = None
) -> None:
    """Draw the pressures of a segment over time; steps at the full rate stand out.

    Raises `InputError`: the solution has no points, or the arm has no such segment.

    Parameters
    ----------
    axes : of matplotlib.
    segment : from 1, at the base.
    limits : ((n,), (n,)), lower and upper limits of all channels in Pa; by default the robot's.
    """
    _require_points(solution)
    segments = solution.robot.description.segments
    if not 1 <= segment <= len(segments):
        raise InputError(f"segment: the arm has segments 1 to {len(segments)}; got {segment}")
    unit = display_units().pressure
    low, high = map(unit.of, limits or (solution.robot.pressure_min, solution.robot.pressure_max))
    channels = solution.robot.description.channel_ranges[segment - 1]
    values, fast = unit.of(solution.pressures[:, channels]), _fast_steps(solution)[:, channels]
    for channel in range(values.shape[1]):
        axes.plot(
            solution.times, values[:, channel], color=style.channel_colour(channel), linewidth=1.8,
            label=f"channel {channel + 1}", zorder=3,
        )  # fmt: skip
    _mark_fast_steps(axes, solution.times, values, fast)
    for value in np.unique([low[channels], high[channels]]):
        axes.axhline(value, color=style.BOUND, linestyle=":", linewidth=1.2, zorder=1)
    bottom, top = low[channels].min(), high[channels].max()
    axes.set_ylim(bottom - 0.05 * (top - bottom), top + 0.05 * (top - bottom))
    axes.set_ylabel(
        f"segment {segment}\n({unit})", color=style.segment_text_colour(segment - 1), weight="bold"
    )
    axes.set_xlabel("time (s)")
    _legend(axes)


def _mark_fast_steps(axes: Any, times: Array, values: Array, fast: Any) -> None:
    """Mark the steps, given by `fast` (N - 1, k), in which pressures (N, k) change at full rate."""
    from matplotlib.collections import LineCollection

    lines = np.stack([np.broadcast_to(times[:, None], values.shape), values], axis=-1)  # (N, k, 2)
    parts = np.stack([lines[:-1], lines[1:]], axis=2)[fast]  # (j, 2, 2)
    if len(parts):
        axes.add_collection(
            LineCollection(
                parts, colors=style.AT_LIMIT, linewidths=5, alpha=0.5, label="at its rate", zorder=2
            )
        )


def _fast_steps(solution: PathSolution) -> Any:
    """Return which channels change at their full rate in each step, (N - 1, n)."""
    steps = np.abs(np.diff(solution.pressures, axis=0))
    if solution.slew is None:
        return np.zeros(steps.shape, dtype=bool)
    return steps >= _FULL * step_limits(solution.times, solution.slew)


def _legend(axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda k: labels[k] == "at its rate")
    axes.legend(
        [handles[k] for k in order], [labels[k] for k in order], loc="lower right",
        bbox_to_anchor=(1.0, 1.0), ncols=len(labels),
        fontsize=8, frameon=False, columnspacing=1.2, handlelength=1.4, borderaxespad=0.0,
    )  # fmt: skip
