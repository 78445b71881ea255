"""Figure of a solved path: the arm along it, its stiffness and its pressures over time."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import InputError
from stiffopt.model.scene import Scene
from stiffopt.paths.path import Path
from stiffopt.paths.rates import step_limits
from stiffopt.paths.solution import PathSolution
from stiffopt.plots import style
from stiffopt.plots.arm import ArmDrawing
from stiffopt.plots.wording import BAR, MM, figures, unit_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Vector = NDArray[np.float64]

_POSES = 5  # of the arm
_FULL = 0.99  # share of a rate from which a pressure counts as changing at it


def plot_path(path: Path, solution: PathSolution, *, title: str | None = None) -> Figure:
    """Draw a solved path: the arm along it, and stiffness, clearance and pressures over time.

    Parameters
    ----------
    path : Path
    solution : PathSolution
    title : str, optional
        By default the name of the path's file.

    Raises
    ------
    InputError
        If the solution has no points, as the solver failed.
    MissingExtraError
        If matplotlib is not installed.
    """
    source = path.source
    drawn = _Drawn(
        solution, path.scene, path.pressure_bounds(solution.robot.description),
        path.points().positions if len(solution.times) else None,
    )  # fmt: skip
    name = solution.robot.description.name if source is None else source.stem
    return _figure(drawn, title or name, lambda: _key_numbers(path, solution))


def plot_motion(
    solution: PathSolution, scene: Scene | None = None, *, title: str | None = None
) -> Figure:
    """Draw a motion of `stiffopt.plan_motion` as `plot_path` draws a path.

    Parameters
    ----------
    solution : PathSolution
    scene : Scene, optional
        That was kept clear of.
    title : str, optional
        By default the name of the robot.

    Raises
    ------
    InputError
        If the solution has no points.
    MissingExtraError
        If matplotlib is not installed.
    """
    robot = solution.robot
    drawn = _Drawn(solution, scene, (robot.pressure_min, robot.pressure_max), None)
    name = title or robot.description.name
    return _figure(drawn, name, lambda: _duration(solution))


class _Drawn(NamedTuple):
    """What is drawn: with the scene, limits of the pressures and the positions asked for."""

    solution: PathSolution
    scene: Scene | None
    limits: tuple[Vector, Vector]
    asked: Vector | None


def _figure(drawn: _Drawn, title: str, key_numbers: Callable[[], str]) -> Figure:
    solution = drawn.solution
    style.require_matplotlib()
    if not len(solution.times):
        raise InputError("there is nothing to draw: the solution has no points")
    heights = [1.5] * (solution.stiffness is not None) + [0.8] * (solution.clearance is not None)
    heights += [1.2] * solution.robot.n_segments
    height = max(6.6, 1.4 + 1.35 * sum(heights))
    figure = style.new_figure(13, height)
    grid = figure.add_gridspec(
        len(heights), 2, width_ratios=(1.15, 1), height_ratios=heights, left=0.03, right=0.975,
        top=1 - 1.25 / height, bottom=0.55 / height, wspace=0.14, hspace=0.2,
    )  # fmt: skip
    _draw_arm(figure.add_subplot(grid[:, 0], projection="3d", computed_zorder=False), drawn)
    panels: list[Any] = []
    for row in range(len(heights)):
        panels.append(figure.add_subplot(grid[row, 1], sharex=panels[0] if panels else None))
        style.tidy(panels[-1])
        panels[-1].tick_params(labelbottom=row == len(heights) - 1)
    panels[-1].set_xlabel("time (s)")
    left = iter(panels)
    if solution.stiffness is not None:
        _draw_stiffness(next(left), solution)
    if solution.clearance is not None:
        _draw_clearance(next(left), drawn)
    _draw_pressures(list(left), drawn)
    style.draw_outcome(figure, title, key_numbers(), solution.status, solution.message)
    return figure


def _duration(solution: PathSolution) -> str:
    return f"{len(solution.times)} points in {solution.times[-1]:.4g} s"


def _key_numbers(path: Path, solution: PathSolution) -> str:
    parts = [_duration(solution)]
    if solution.position_errors is not None:
        parts.append(
            f"tip error at most {solution.position_errors.max() * MM:.3g} mm "
            f"(tolerance {path.tolerance.position * MM:g} mm)"
        )
    if solution.angle_errors is not None:
        parts.append(f"{degrees(solution.angle_errors.max()):.3g} deg")
    if solution.stiffness is not None and path.stiffness is not None:
        unit, index = unit_text(solution.stiffness_unit), int(np.argmin(solution.stiffness))
        share = ""
        if solution.alone is not None:
            share = f" ({solution.stiffness[index] / solution.alone[index]:.0%} of that alone)"
        parts.append(f"worst stiffness {figures(solution.stiffness[index])} {unit}{share}")
    return "      ".join(parts)


def _draw_arm(axes: Any, drawn: _Drawn) -> None:
    """The arm at some of the points, the path that was asked for and the one that is followed."""
    solution = drawn.solution
    drawing = ArmDrawing(axes, solution.robot)
    drawing.draw_base()
    last = len(solution.times) - 1
    for index in np.unique(np.linspace(0, last, _POSES).astype(int)):
        drawing.draw_tube(solution.pressures[index], 0.3 if index in (0, last) else 0.1)
    drawing.explain_segments()
    tips = solution.tip_poses[:, :3, 3].T * MM
    if drawn.asked is not None:
        axes.plot(*drawn.asked.T * MM, color=style.TARGET, linewidth=1.4, linestyle=":", zorder=9)
        drawing.add_line(style.TARGET, "path that is asked for", ":")
        drawing.corners.append(drawn.asked * MM)
    axes.plot(*tips, color=style.DARK, linewidth=2.2, zorder=8)
    drawing.add_line(style.DARK, "tip")
    drawing.corners.append(tips.T)
    marks = [(0, "o", style.DARK, "start", 10), (last, "s", style.DARK, "end", 9)]
    if solution.worst_index is not None:
        marks.append((solution.worst_index, "D", style.AT_LIMIT, "least stiff", 7))
    if solution.first_failure is not None:
        marks.append((solution.first_failure, "X", style.TARGET, "first that cannot be had", 7))
    for index, marker, colour, label, size in marks:
        look = {"marker": marker, "markersize": size, "markeredgecolor": "white"}
        axes.plot(*tips[:, index, None], color=colour, linestyle="none", zorder=11, **look)
        drawing.add_line(colour, label, "none", **look)
    if drawn.scene is not None:
        drawing.draw_objects(drawn.scene)
    drawing.finish(tips.mean(axis=1))


def _draw_stiffness(axes: Any, solution: PathSolution) -> None:
    """Stiffness over time, and what each point alone could have."""
    index = solution.worst_index
    if solution.stiffness is None or index is None:
        return
    if solution.alone is not None:
        axes.plot(
            solution.times, solution.alone, color=style.GREY, linewidth=5, alpha=0.35,
            label="each point alone",
        )  # fmt: skip
    axes.plot(
        solution.times, solution.stiffness, color=style.WITHIN_LIMITS, linewidth=2,
        label="on the path",
    )  # fmt: skip
    axes.plot(
        solution.times[index], solution.stiffness[index], "D", color=style.AT_LIMIT, markersize=7,
        markeredgecolor="white", label="least stiff",
    )  # fmt: skip
    axes.set_ylim(bottom=0.85 * solution.stiffness[index])
    axes.set_ylabel(f"stiffness\n({unit_text(solution.stiffness_unit)})")
    _legend(axes)


def _draw_clearance(axes: Any, drawn: _Drawn) -> None:
    """Clearance over time against what is required."""
    solution = drawn.solution
    if solution.clearance is None:
        return
    axes.plot(solution.times, solution.clearance * MM, color=style.OBSTACLE, linewidth=2)
    if drawn.scene is not None:
        required = drawn.scene.clearance * MM
        axes.axhline(required, color=style.BOUND, linestyle=":", label="required")
        _legend(axes)
    axes.set_ylim(bottom=min(0.0, solution.clearance.min() * MM))
    axes.set_ylabel("clearance\n(mm)")


def _draw_pressures(panels: list[Any], drawn: _Drawn) -> None:
    """Pressures over time, a panel for each segment; steps at the full rate stand out."""
    from matplotlib.collections import LineCollection

    solution = drawn.solution
    description = solution.robot.description
    limits = [bound * BAR for bound in drawn.limits]
    values, fast = solution.pressures * BAR, _fast_steps(solution)
    start, is_any = 0, False
    for number, (axes, segment) in enumerate(zip(panels, description.segments, strict=True)):
        for k in range(segment.n_channels):
            channel = start + k
            axes.plot(
                solution.times, values[:, channel], color=style.channel_colour(k), linewidth=1.8,
                label=f"channel {k + 1}", zorder=3,
            )  # fmt: skip
            line = np.column_stack([solution.times, values[:, channel]])
            parts = np.stack([line[:-1], line[1:]], axis=1)[fast[:, channel]]  # (k, 2, 2)
            if len(parts):
                label = "" if is_any else "at its rate"
                axes.add_collection(
                    LineCollection(
                        parts, colors=style.AT_LIMIT, linewidths=5, alpha=0.5, label=label, zorder=2
                    )
                )
                is_any = True
        mine = slice(start, start + segment.n_channels)
        for value in np.unique([bound[mine] for bound in limits]):
            axes.axhline(value, color=style.BOUND, linestyle=":", linewidth=1.2, zorder=1)
        low, high = limits[0][mine].min(), limits[1][mine].max()
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        axes.set_ylabel(
            f"segment {number + 1}\n(bar)", color=style.segment_text_colour(number), weight="bold"
        )
        _legend(axes)
        start += segment.n_channels


def _fast_steps(solution: PathSolution) -> Any:
    """Which channels (N - 1, n) change at their full rate in which step."""
    steps = np.abs(np.diff(solution.pressures, axis=0))
    if solution.slew is None:
        return np.zeros(steps.shape, dtype=bool)
    return steps >= _FULL * step_limits(solution.times, solution.slew)


def _legend(axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda k: labels[k] == "at its rate")
    axes.legend(
        [handles[k] for k in order], [labels[k] for k in order], loc="lower right",
        bbox_to_anchor=(1.0, 0.97), ncols=len(labels),
        fontsize=8, frameon=False, columnspacing=1.2, handlelength=1.4, borderaxespad=0.0,
    )  # fmt: skip
