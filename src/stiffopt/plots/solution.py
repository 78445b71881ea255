"""Draw a solution: the arm with its pressures, and the trade-off against tip error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import FIGURES, display_units
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.task import Task
from stiffopt.plots import style
from stiffopt.plots.arm import ArmDrawing
from stiffopt.plots.contact import draw_forces, draw_leaning_tube
from stiffopt.plots.shapes import StiffnessEllipsoid
from stiffopt.plots.style import literal, new_figure, tidy
from stiffopt.plots.view import View
from stiffopt.plots.wording import (
    direction_text,
    gain_text,
    least_maximised,
    limit_of,
    short_direction,
    stiffness_text,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MAX_LABELS = 15  # largest number of pressures with a number on their bar
_NEAR_BOUND = 0.06  # of the axis; a bar nearer to its limit has its number above the limit
_BOLD_NUMBER = 3.4  # width of "1.234", in font sizes
_ELLIPSOID_SHARE = 0.22  # largest semi-axis, as a share of the arm's length
_ARROW_SHARE = 0.22  # length of an arrow, likewise


def plot_solution(
    robot: Manipulator,
    solution: PressureSolution,
    *,
    front: Sequence[PressureSolution] | None = None,
    plain: float | None = None,
    title: str | None = None,
    scene: Scene | None = None,
    view: View | None = None,
) -> Figure:
    """Draw a solution: the arm in space, and its pressures against their limits.

    Raises `InputError`: the solution has no pressures, or the view is invalid; `MissingExtraError`
    if matplotlib is not installed.

    Parameters
    ----------
    robot : the arm; the load of the solution's task is applied to it.
    front : a trade-off to draw beside it, as `stiffopt.pareto_front` returns it.
    plain : first stiffness of the plain solution, which ignores stiffness, for comparison.
    title : by default the name of the task's file.
    scene : the objects around the arm; by default those of the task.
    view : (elevation, azimuth), from where to look at the arm, in rad or as text with a unit; see
        `draw_arm`.
    """
    style.require_matplotlib()
    figure = new_figure(13, 6.6 if front is None else 7.8)
    grid = figure.add_gridspec(
        1 if front is None else 2, 1, left=0.6, right=0.975, top=0.79, bottom=0.09, hspace=0.42
    )
    axes = style.add_space(figure, (0.02, 0.015, 0.52, 0.825))
    style.legend_in_corner(axes, draw_solution(axes, robot, solution, scene=scene, view=view))
    draw_pressures(figure.add_subplot(grid[0, 0]), robot, solution)
    if front is not None:
        draw_pareto(figure.add_subplot(grid[1, 0]), front, plain=plain)
    source = solution.task.source
    name = robot.description.name if source is None else source.stem
    style.draw_outcome(
        figure, title or name, _key_numbers(solution, plain), solution.status, solution.message
    )
    return figure


def plot_pareto(
    front: Sequence[PressureSolution], *, plain: float | None = None, title: str | None = None
) -> Figure:
    """Draw a trade-off: stiffness against tip error.

    Raises `MissingExtraError` if matplotlib is not installed.

    Parameters
    ----------
    front : as `stiffopt.pareto_front` returns it.
    plain : first stiffness of the plain solution, which ignores stiffness, for comparison.
    """
    figure = new_figure(6.4, 4.4, layout="constrained")
    axes = figure.add_subplot()
    draw_pareto(axes, front, plain=plain)
    if title:
        axes.set_title(literal(title))
    return figure


def _key_numbers(solution: PressureSolution, plain: float | None) -> str:
    tolerance, units = solution.task.target.tolerance, display_units()
    parts = []
    if solution.position_error is not None:
        parts.append(
            f"tip error {units.length.text(solution.position_error, '.3g')} "
            f"(tolerance {units.length.text(tolerance.position, 'g')})"
        )
    if solution.angle_error is not None:
        parts.append(
            f"{units.angle.text(solution.angle_error, '.3g')} "
            f"(tolerance {units.angle.text(tolerance.angle)})"
        )
    if solution.stiffness is not None:
        measure = solution.task.measures[0]
        unit, compared = units.of_si(measure.unit), ""
        if plain is not None:
            gain = gain_text(solution.stiffness, plain)
            compared = f" (plain: {unit.number(plain, FIGURES)}, {gain})"
        if solution.contacts and solution.stiffness_free is not None:
            compared = f" ({unit.number(solution.stiffness_free, FIGURES)} clear of objects)"
        parts.append(
            f"stiffness {unit.text(solution.stiffness, FIGURES)}{compared} "
            f"{direction_text(measure)}"
        )
    if solution.matrix_distance is not None:
        parts.append(f"{solution.matrix_distance:.3g} from the matrix to match")
    return "      ".join(parts)


def draw_pressures(axes: Any, robot: Manipulator, solution: PressureSolution) -> None:
    """Draw the pressures as bars with their limits; those at a limit are highlighted.

    Raises `InputError`: the solution has no pressures.

    Parameters
    ----------
    axes : of matplotlib.
    """
    _require_pressures(solution)
    description, unit = robot.description, display_units().pressure
    lower, upper = map(unit.of, solution.task.pressure_bounds(description))
    values = unit.of(np.asarray(solution.pressures))
    at_limit = [limit_of(solution, description.channel_name(k)) for k in range(len(values))]
    places = _places(robot)
    axes.bar(places, upper - lower, bottom=lower, width=0.8, color=style.RANGE, zorder=1)
    for side, bounds in (("min", lower), ("max", upper)):
        for place, bound, at in zip(places, bounds, at_limit, strict=True):
            held = at == side
            axes.hlines(
                bound, place - 0.4, place + 0.4, zorder=5 if held else 2, clip_on=False,
                color=style.AT_LIMIT if held else style.BOUND, linewidth=3.5 if held else 1.2,
            )  # fmt: skip
    colours = [style.AT_LIMIT if at else style.WITHIN_LIMITS for at in at_limit]
    axes.bar(places, values, width=0.62, color=colours, zorder=3)
    top = max(upper.max(), 0.0) - min(lower.min(), 0.0)
    if len(values) <= _MAX_LABELS:
        wide = axes.bbox.width / axes.get_figure(root=True).dpi * 72 / (np.ptp(places) + 1.5)
        size = min(9.0, wide / _BOLD_NUMBER)
        for place, value, bound, colour in zip(places, values, upper, colours, strict=True):
            above = bound if 0 < bound - value < _NEAR_BOUND * top else value
            number = unit.number(unit.to_si(value), ".3f")
            axes.text(
                place, max(above, 0.0) + 0.012 * top, number, ha="center", va="bottom",
                fontsize=size, weight="bold", zorder=4,
                color=colour if colour == style.AT_LIMIT else "#20394f",
            )  # fmt: skip
    _label_channels(axes, robot, places)
    axes.set_ylabel(f"pressure ({unit})")
    axes.set_ylim(min(lower.min(), 0.0), max(upper.max(), 0.0) + 0.2 * top)
    _pressure_legend(axes, any(at_limit))
    tidy(axes)


def draw_pareto(
    axes: Any, front: Sequence[PressureSolution], *, plain: float | None = None
) -> None:
    """Draw the trade-off of stiffness against tip error.

    Parameters
    ----------
    axes : of matplotlib.
    front : as `stiffopt.pareto_front` returns it.
    plain : first stiffness of the plain solution, which ignores stiffness, for comparison.
    """
    axes.set_title("stiffness gained by a larger tip error", fontsize=11, loc="left")
    tidy(axes)
    if not front:
        axes.text(
            0.5, 0.5, "out of reach at every tolerance tried", ha="center", transform=axes.transAxes
        )
        return
    by_position = front[0].position_error is not None
    of_error = display_units().length if by_position else display_units().angle
    errors = [
        of_error.of((point.position_error if by_position else point.angle_error) or 0.0)
        for point in front
    ]
    unit = display_units().of_si(front[0].stiffness_unit)
    values = [unit.of(least_maximised(point) or 0.0) for point in front]
    axes.plot(errors, values, "o-", color=style.WITHIN_LIMITS, markersize=5, label="stiffest found")
    axes.plot(errors[:1], values[:1], "o", color=style.TARGET, markersize=8, label="this task")
    if plain is not None:
        axes.axhline(
            unit.of(plain), color=style.GREY, linestyle="--", linewidth=1.2, label="plain solution"
        )
    if min(errors) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel(f"tip error ({of_error})")
    axes.set_ylabel(f"stiffness ({unit})")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=9, frameon=False)


def _places(robot: Manipulator) -> Any:
    """Return the positions of the bars, with a gap between segments."""
    ranges = enumerate(robot.description.channel_ranges)
    return np.array([k + 0.6 * segment for segment, own in ranges for k in own])


def _label_channels(axes: Any, robot: Manipulator, places: Any) -> None:
    ranges = robot.description.channel_ranges
    axes.set_xticks(places, [str(k + 1) for own in ranges for k in range(len(own))])
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel("channel")
    for number, own in enumerate(ranges):
        axes.text(
            places[own].mean(), 1.0, f"segment {number + 1}", transform=axes.get_xaxis_transform(),
            ha="center", va="top", fontsize=10, weight="bold",
            color=style.segment_text_colour(number),
        )  # fmt: skip


def _pressure_legend(axes: Any, any_active: bool) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=style.WITHIN_LIMITS, label="pressure")]
    if any_active:
        handles.append(Patch(color=style.AT_LIMIT, label="at a limit"))
    handles.append(Patch(facecolor=style.RANGE, edgecolor=style.BOUND, label="allowed"))
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=9,
        frameon=False, columnspacing=1.2, handlelength=1.2,
    )  # fmt: skip


# -- the arm in 3-D -------------------------------------------------------------------------------


def draw_solution(
    axes: Any,
    robot: Manipulator,
    solution: PressureSolution,
    *,
    scene: Scene | None = None,
    view: View | None = None,
) -> list[Any]:
    """Draw a solution in space: the arm, its stiffness and its task.

    Returns handles for a legend. Raises `InputError`: the solution has no pressures, or the view is
    invalid.

    Parameters
    ----------
    axes : in 3-D, as for `draw_arm`.
    robot : the arm; the load of the solution's task is applied to it.
    scene : the objects around the arm; by default those of the task.
    view : (elevation, azimuth), see `draw_arm`.
    """
    _require_pressures(solution)
    arm = solution.task.loaded(robot)
    drawing = _Drawing(axes, arm, solution)
    drawing.draw_base()
    leaning = solution.equilibrium
    if leaning is None:
        drawing.draw_tube(np.asarray(solution.pressures))
    else:
        draw_leaning_tube(drawing, leaning)
        draw_forces(drawing, leaning)
    drawing.explain_segments()
    drawing.draw_directions()
    drawing.draw_ellipsoid()
    if leaning is not None:
        drawing.draw_free_ellipsoid()
    drawing.draw_target()
    drawing.draw_loads()
    return drawing.finish(view, scene or solution.task.scene)


def draw_task(axes: Any, robot: Manipulator, task: Task, *, view: View | None = None) -> list[Any]:
    """Draw a task in space: the arm at its lowest pressures, and the task's target and goals.

    Returns handles for a legend. Raises `InputError`: the view is invalid.

    Parameters
    ----------
    axes : in 3-D, as for `draw_arm`.
    robot : the arm; the load of the task is applied to it.
    view : (elevation, azimuth), see `draw_arm`.
    """
    arm = task.loaded(robot)
    start = arm.pressure_min
    drawing = _Drawing(axes, arm, PressureSolution("failed", "", task, start, arm.tip_pose(start)))
    drawing.draw_base()
    drawing.draw_tube(start)
    drawing.explain_segments()
    drawing.draw_directions()
    drawing.draw_target()
    drawing.draw_loads()
    return drawing.finish(view, task.scene)


def _require_pressures(solution: PressureSolution) -> None:
    if solution.pressures is None:
        raise InputError("there is nothing to draw: the solution has no pressures")


@dataclass
class _Drawing(ArmDrawing):
    """Draws the arm at a solution's pressures, its stiffness and its task."""

    solution: PressureSolution

    @property
    def tip(self) -> Array:
        """Position of the tip in the axes."""
        return np.asarray(self.unit.of(np.asarray(self.solution.tip_pose)[:3, 3]))

    @property
    def rotation(self) -> Array:
        """Orientation of the tip."""
        return np.asarray(self.solution.tip_pose)[:3, :3]

    # -- stiffness --------------------------------------------------------------------------

    def draw_ellipsoid(self) -> None:
        """Draw the stiffness ellipsoid with its axes; see `StiffnessEllipsoid`."""
        values, ways = found = StiffnessEllipsoid.of(
            np.asarray(self.solution.compliance), self.rotation
        )
        radii = found.radii(_ELLIPSOID_SHARE * self.size)
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 37), np.linspace(0, np.pi, 19))
        ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
        points = np.einsum("ij,j...->i...", ways * radii, ball)
        x, y, z = points + self.tip[:, None, None]
        self.axes.plot_surface(
            x, y, z, color=style.ELLIPSOID, alpha=0.25, linewidth=0, shade=False, zorder=5
        )
        for radius, way in zip(radii, ways.T, strict=True):
            ends = self.tip + np.outer([-1, 1], way) * radius
            self.axes.plot(*ends.T, color=style.ELLIPSOID, linewidth=1.3, zorder=6)
        self.add_body(np.stack([x, y, z], axis=-1).reshape(-1, 3))
        longest = ways[:, -1] * np.copysign(radii[-1], self.rotation[:, 2] @ ways[:, -1])
        unit = display_units().stiffness
        largest = unit.text(values[-1], FIGURES)
        self.add_label(self.tip + longest, f"ellipsoid\n{largest}", style.ELLIPSOID)
        listed = ", ".join(unit.number(value, FIGURES) for value in values[::-1])
        self.add_patch(
            style.ELLIPSOID, f"stiffness ellipsoid, radius² ∝ k:\n{listed} {unit}\nalong its axes"
        )

    def draw_free_ellipsoid(self) -> None:
        """Draw the outline of the ellipsoid of the arm clear of objects, to the same scale."""
        free = self.solution.free
        if free is None or not free.found:
            return
        braced = StiffnessEllipsoid.of(np.asarray(self.solution.compliance), self.rotation)
        values, ways = found = StiffnessEllipsoid.of(
            np.asarray(free.compliance), np.asarray(free.tip_pose)[:3, :3]
        )
        share = _ELLIPSOID_SHARE * np.sqrt(values[-1] / braced.stiffnesses[-1])
        radii = found.radii(share * self.size)
        turn = np.linspace(0, 2 * np.pi, 61)
        for k in range(3):
            ring = np.insert(np.stack([np.cos(turn), np.sin(turn)]), k, 0.0, axis=0)
            self.axes.plot(
                *(self.tip[:, None] + ways * radii @ ring), color=style.DARK, linewidth=1.1,
                linestyle=":", zorder=7,
            )  # fmt: skip
        unit = display_units().stiffness
        listed = ", ".join(unit.number(value, FIGURES) for value in values[::-1])
        self.add_line(style.DARK, f"ellipsoid clear of objects:\n{listed} {unit}", ":")

    def draw_directions(self) -> None:
        """Draw an arrow along each direction whose stiffness the task names."""
        pairs = zip_longest(self.solution.task.measures, self.solution.stiffnesses)
        for number, (measure, value) in enumerate(pairs):
            if not isinstance(measure, StiffnessMeasure):
                continue
            shade = style.DIRECTIONS[number % len(style.DIRECTIONS)]
            way = np.asarray(measure.direction)
            way = self.rotation @ way if measure.frame == "tip" else way
            arrow = way * _ARROW_SHARE * self.size
            self.draw_arrow(self.tip, arrow, shade, 9)
            amount = "" if value is None else f"{stiffness_text(value, measure.unit)}\n"
            self.add_label(self.tip + arrow, f"{amount}{short_direction(measure)}", shade)
            words = f"{direction_text(measure)}\n{measure.frame} axes, {measure.boundary}"
            self.add_line(shade, f"{amount}{words}")

    # -- target and loads -------------------------------------------------------------------

    def draw_target(self) -> None:
        """Draw the target position, a line along each free axis, and pointing or orientation."""
        target = self.solution.task.target
        point = self.tip.copy()
        if target.position is not None:
            free = [k for k in range(3) if target.position[k] is None]
            for k in range(3):
                asked = self.unit.of(target.position[k] or 0.0)
                point[k] = self.tip[k] if k in free else asked
            self._draw_point(point, free)
        length = 0.2 * self.size
        if target.pointing is not None:
            self.draw_arrow(point, length * np.array(target.pointing), style.TARGET, 8, "--")
            self.add_line(style.TARGET, "target pointing", "--")
        if target.orientation is not None:
            self._draw_triad(point, target.orientation, length)

    def _draw_point(self, point: Array, free: list[int]) -> None:
        self.axes.plot(
            *point[:, None], marker="X", markersize=11, color=style.TARGET,
            markeredgecolor="white", linestyle="none", zorder=10,
        )  # fmt: skip
        self.add_mark(point)
        for k in free:
            ends = np.stack([point, point])
            ends[:, k] += np.array([-0.3, 0.3]) * self.size
            self.axes.plot(*ends.T, color=style.TARGET, linestyle=":", linewidth=1.6, zorder=9)
            self.corners.append(ends)
            self.covered.append(np.linspace(ends[0], ends[1], 40))
        names = ", ".join("xyz"[k] for k in free)
        label = f"target ({names} free)" if free else "target"
        self.add_line(
            style.TARGET, label, "none", marker="X", markersize=9, markeredgecolor="white"
        )
        miss = np.linalg.norm(point - self.tip)
        if miss > 0.01 * self.size:
            self.axes.plot(
                *np.stack([self.tip, point]).T, color=style.TARGET, linewidth=1.4, zorder=9
            )
            self.covered.append(np.linspace(self.tip, point, 40))

    def _draw_triad(self, point: Array, quaternion: Any, length: float) -> None:
        wanted = np.asarray(lie.rotation_from_quaternion(np.array(quaternion)))
        for k, shade in enumerate(("#d62728", "#2ca02c", "#1f4fd6")):
            self.draw_arrow(point, 0.8 * length * wanted[:, k], shade, 8, "--")
            self.draw_arrow(self.tip, 0.5 * length * self.rotation[:, k], shade, 8)
        self.add_line("#555555", "target orientation\n(x red, y green, z blue)", "--")
        self.add_line("#555555", "orientation of the tip")

    def draw_loads(self) -> None:
        """Draw the force at the tip and the direction of gravity."""
        task = self.solution.task
        load, name = task.tip_load, "load" if task.press is None else "reaction of the press"
        if load is not None and any(load.force):
            force = np.array(load.force)
            way = (self.rotation @ force if load.frame == "tip" else force) / np.linalg.norm(force)
            self.draw_arrow(self.tip - 0.2 * self.size * way, 0.2 * self.size * way, style.LOAD, 9)
            size = display_units().force.text(float(np.linalg.norm(force)), ".3g")
            self.add_line(style.LOAD, f"{name} {size}")
        gravity = np.array(self.robot.description.gravity)
        if gravity.any():
            way = gravity / np.linalg.norm(gravity)
            start = np.array([0.4, 0.3, 0.25]) * self.size
            self.draw_arrow(start, 0.18 * self.size * way, "#666666", 9)
            self.add_label(start, "gravity", "#666666")
