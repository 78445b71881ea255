"""Draw maps: of a workspace, of stiffness along an arm (the paper's figure 6), and of the tip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.directions import direction_name
from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.experiments.arm_map import ArmMap, TipMap
from stiffopt.plots.style import (
    ARM,
    draw_head,
    label_logarithmic,
    make_logarithmic,
    new_figure,
    round_steps,
    tidy,
)
from stiffopt.workspace import WorkspaceMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_ENOUGH = 10  # samples in a cell from which its ratio of stiffnesses is shown
_UNKNOWN = "#d5d9dd"
_BEST, _CHOICE = "viridis", "YlOrRd"  # colours of stiffness, and of its ratio
_ROW, _HEAD, _FOOT = 2.75, 1.55, 0.95  # inches: a row, the head and the foot


# -- workspaces -----------------------------------------------------------------------------------


def plot_workspace(found: WorkspaceMap, *, title: str | None = None) -> Figure:
    """Draw sections through a workspace, a row for each direction.

    On the left is the largest stiffness that the tip can have at a place; on the right is the ratio
    of the largest to the smallest, which shows how much pressures can change it there. The upright
    section contains the arm at rest; the level one is where the workspace is widest.
    The title is by default the name of the robot.

    Raises `InputError`: the map has no cell with a sample.
    """
    if not len(found.table):
        raise InputError("there is nothing to draw: no sample has a stable equilibrium")
    sections = (_Section.upright(found), _Section.level(found))
    rows = len(found.plan.measures)
    height = _HEAD + _FOOT + _ROW * rows
    figure = new_figure(15.5, height)
    grid = figure.add_gridspec(
        rows, 7, width_ratios=(1, 1, 0.05, 0.2, 1, 1, 0.05), left=0.055, right=0.945,
        top=1 - _HEAD / height, bottom=_FOOT / height, wspace=0.36, hspace=0.32,
    )  # fmt: skip
    unit = display_units().of_si(found.plan.unit)
    for row, name in enumerate(found.direction_names):
        ratio = np.where(found.count >= _ENOUGH, found.ratio[row], np.inf)  # inf: unknown
        for first, values, colours, label in (
            (0, unit.of(found.best[row]), _BEST, f"greatest stiffness ({unit})"),
            (4, ratio, _CHOICE, "greatest / least"),
        ):
            panels = [figure.add_subplot(grid[row, first + k]) for k in range(2)]
            drawn = _draw_sections(panels, sections, values, colours)
            bar: Any = figure.colorbar(drawn, cax=figure.add_subplot(grid[row, first + 2]))
            label_logarithmic(bar.ax.yaxis, bar.vmin, bar.vmax)
            bar.ax.tick_params(labelsize=8)
            bar.set_label(label, fontsize=9)
            panels[0].set_title(
                f"{_way(found, row)} {name}", loc="left", fontsize=11, weight="bold"
            )
    _write_head(figure, found, title or found.plan.robot.description.name, height)
    _write_foot(figure)
    return figure


class _Section:
    """A layer of a workspace's cells, seen along one axis."""

    def __init__(self, found: WorkspaceMap, normal: int, layer: int) -> None:
        across, up = (axis for axis in range(3) if axis != normal)
        cells, first = found.cells, found.first_cell
        self.normal, self.axes = normal, (across, up)
        self.place = layer * found.plan.cell
        self.rows = np.flatnonzero(cells[:, normal] == layer)
        self._size = found.plan.cell
        self._shape = found.shape[across], found.shape[up]
        self._at = cells[self.rows][:, (across, up)] - first[[across, up]]
        self._first = first[[across, up]]
        self.length = found.plan.robot.length
        self.hangs = found.plan.robot.description.gravity[2] > 0
        self.radius = found.plan.robot.description.segments[0].outer_radius

    @classmethod
    def upright(cls, found: WorkspaceMap) -> _Section:
        """Return the plane y = 0, or the plane with the most cells if none was reached there."""
        layers = found.cells[:, 1]
        return cls(found, 1, 0 if (layers == 0).any() else _fullest(layers))

    @classmethod
    def level(cls, found: WorkspaceMap) -> _Section:
        """Return the height with the most cells."""
        return cls(found, 2, _fullest(found.cells[:, 2]))

    @property
    def name(self) -> str:
        """The position of the section, in words."""
        return f"at {'xyz'[self.normal]} = {display_units().length.text(self.place, 'g')}"

    def image(self, values: Array) -> Array:
        """Return values (M,) of cells as an image, row by row from below."""
        picture = np.full(self._shape, np.nan)
        picture[tuple(self._at.T)] = values[self.rows]
        return picture.T

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges left, right, bottom, top in the display unit of lengths."""
        size = display_units().length.of(self._size)
        low = (self._first - 0.5) * size
        high = low + np.array(self._shape) * size
        return (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def _fullest(layers: NDArray[np.int64]) -> int:
    values, counts = np.unique(layers, return_counts=True)
    return int(values[counts.argmax()])


def _draw_sections(
    panels: Sequence[Any], sections: Sequence[_Section], values: Array, colours: str
) -> Any:
    """Draw a quantity in both sections with the same colours; return the coloured artist."""
    from matplotlib.colors import ListedColormap, LogNorm

    seen = np.concatenate([values[section.rows] for section in sections])
    seen = seen[np.isfinite(seen)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (1.0, 1.0)
    low = 1.0 if colours == _CHOICE else low
    norm = LogNorm(low, max(high, 1.05 * low))
    drawn = None
    for axes, section, other in zip(panels, sections, reversed(sections), strict=True):
        image = section.image(values)
        unknown = np.where(np.isinf(image), 1.0, np.nan)
        look = {"extent": section.extent, "origin": "lower", "interpolation": "nearest"}
        axes.imshow(unknown, cmap=ListedColormap([_UNKNOWN]), zorder=1, **look)
        known = np.where(np.isfinite(image), image, np.nan)
        drawn = axes.imshow(known, cmap=colours, norm=norm, zorder=2, **look)
        _frame(axes, section, other)
    return drawn


def _frame(axes: Any, section: _Section, other: _Section) -> None:
    """Set up axes; draw the arm at rest and the line where the other section cuts this one."""
    left, right, bottom, top = section.extent
    unit = display_units().length
    if section.normal == 1:
        bottom = min(bottom, 0.0)
        length, side = unit.of(section.length), unit.of(section.radius)
        top = max(top, length)
        axes.fill(
            [-side, side, side, -side], [0, 0, length, length],
            facecolor="none", edgecolor=ARM, linewidth=1.1, linestyle="--", zorder=4,
        )  # fmt: skip
        axes.plot([-2.2 * side, 2.2 * side], [0, 0], color=ARM, linewidth=3.0, zorder=4)
    else:
        axes.plot(0, 0, marker="+", color=ARM, markersize=9, markeredgewidth=1.4, zorder=4)
    line = axes.axhline(unit.of(other.place), color=ARM, linewidth=0.9, linestyle=":", zorder=3)
    line.set_dash_capstyle("round")
    room = 0.04 * max(right - left, top - bottom)
    axes.set_xlim(left - room, right + room)
    ends = (bottom - room, top + room)
    axes.set_ylim(*(ends[::-1] if section.normal == 1 and section.hangs else ends))
    axes.set_aspect("equal")
    axes.set_facecolor("white")
    across, up = ("xyz"[axis] for axis in section.axes)
    axes.set_xlabel(f"{across} ({unit})   {section.name}", fontsize=9, labelpad=1)
    axes.set_ylabel(f"{up} ({unit})", fontsize=9, labelpad=1)
    tidy(axes)


def _way(found: WorkspaceMap, row: int) -> str:
    measure = found.plan.measures[row]
    way = "along" if measure.kind == "translation" else "about"
    return f"{way} {'' if measure.frame == 'base' else 'the tip’s '}".rstrip()


def _write_head(figure: Figure, found: WorkspaceMap, title: str, height: float) -> None:
    plan, first = found.plan, found.plan.measures[0]
    cell = display_units().length.text(plan.cell, "g")
    draw_head(
        figure,
        f"{title}: the workspace of the tip",
        f"{found.volume * 1e6:,.0f} cm³ reached      "
        f"{found.samples:,} samples, {np.median(found.count):g} in the median cell of "
        f"{cell}      stiffness of {first.kind}, {first.boundary}",
    )
    for x, text in (
        (0.055, "How stiff can the tip be made at a place?"),
        (0.52, "How much can the stiffness be changed there? (1: not at all)"),
    ):
        figure.text(x, 1 - 1.03 / height, text, fontsize=11.5, va="center", color="#20394f")


def _write_foot(figure: Figure) -> None:
    """Write the legend of lines and colours."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=ARM, linestyle="--", linewidth=1.1, label="the arm at rest"),
        Line2D([], [], color=ARM, linewidth=3, label="its base"),
        Line2D(
            [], [], color=ARM, linestyle=":", linewidth=1,
            label="where the other section is",
        ),
        Patch(facecolor=_UNKNOWN, label=f"reached by fewer than {_ENOUGH} samples: ratio unknown"),
    ]  # fmt: skip
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.03, 0.0), ncols=4, fontsize=9.5,
        frameon=False, columnspacing=2.5,
    )  # fmt: skip


# -- stiffness along an arm -----------------------------------------------------------------------


def plot_arm_map(found: ArmMap) -> Figure:
    """Draw stiffness along the arm, a row for each group of channels, a panel per direction.

    The first panel of a row shows the arm at the same pressures, from the side.
    """
    rows, columns = len(found.groups), len(found.directions)
    figure = new_figure(3.6 + 4.0 * columns, 1.4 + 3.5 * rows)
    width, height = figure.get_figwidth(), figure.get_figheight()
    grid = figure.add_gridspec(
        rows, columns + 2, width_ratios=(0.8, *(1.0,) * columns, 0.04), left=0.75 / width,
        right=1 - 0.75 / width, top=1 - 1.25 / height, bottom=0.62 / height, wspace=0.33,
        hspace=0.42,
    )  # fmt: skip
    colours = _colours(len(found.pressures))
    for row, group in enumerate(found.groups):
        side = figure.add_subplot(grid[row, 0])
        _draw_shapes(side, found, row, colours)
        side.set_title(_named(group), loc="left", fontsize=11, weight="bold")
        for column in range(columns):
            axes = figure.add_subplot(grid[row, column + 1])
            _draw_along(axes, found, row, column, colours)
    _pressure_bar(figure, figure.add_subplot(grid[:, -1]), found.pressures)
    of = "base" if found.frame == "base" else f"{found.frame} of each point"
    draw_head(
        figure,
        f"{found.robot}: stiffness along the arm",
        f"boundary {found.boundary}, axes of the {of}      dotted: the middle of the arm",
    )
    return figure


def _draw_shapes(axes: Any, found: ArmMap, row: int, colours: list[Any]) -> None:
    unit = display_units().length
    flat = _bending_plane(found.backbones[row])
    shapes, foot = unit.of(found.backbones[row]), unit.of(0.1 * found.length)
    for shape, colour in zip(shapes, colours, strict=True):
        axes.plot(shape[:, :2] @ flat, shape[:, 2], color=colour, linewidth=2.2)
    axes.plot([-foot, foot], [0, 0], color=ARM, lw=3)
    across = "x" if abs(flat[0]) > 0.999 else "in the plane of bending"
    sign = "-" if flat[0] < -0.999 else ""
    axes.set_xlabel(f"{sign}{across} ({unit})", fontsize=9)
    axes.set_ylabel(f"z ({unit})", fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
    if found.hangs:
        axes.invert_yaxis()
    tidy(axes)


def _bending_plane(shapes: Array) -> Array:
    """Return the unit vector (2,) in the x-y plane along which the tip moves most, x by default."""
    tips = shapes[:, -1, :2] - shapes[0, -1, :2]
    farthest: Array = tips[np.argmax(np.linalg.norm(tips, axis=1))]
    size = float(np.linalg.norm(farthest))
    if size < 1e-3 or abs(farthest[0]) > 0.999 * size:
        return np.array([1.0, 0.0])
    return farthest / size


def _draw_along(axes: Any, found: ArmMap, row: int, column: int, colours: list[Any]) -> None:
    length, unit = display_units().length, display_units().stiffness
    at = length.of(found.at)
    for level, colour in enumerate(colours):
        values = unit.of(found.stiffness[row, level, :, column])
        axes.plot(at, values, color=colour, linewidth=1.7)
    axes.axvline(length.of(found.length / 2), color=ARM, linewidth=0.9, linestyle=":")
    name = direction_name(tuple(found.directions[column]))
    axes.set_title(f"along {name}", loc="left", fontsize=10.5)
    make_logarithmic(axes)
    axes.set_xlabel(f"distance from the base at rest ({length})", fontsize=9)
    axes.set_ylabel(f"stiffness ({unit})", fontsize=9)
    axes.set_xlim(at[0], at[-1])
    axes.grid(alpha=0.25, which="both")
    tidy(axes)


def plot_tip_map(found: TipMap) -> Figure:
    """Draw the tip's stiffness over two pressures, a heat map for each direction."""
    columns = len(found.directions)
    figure = new_figure(1.3 + 4.6 * columns, 5.4)
    width, height = figure.get_figwidth(), figure.get_figheight()
    grid = figure.add_gridspec(
        1, columns, left=0.75 / width, right=1 - 0.7 / width, top=1 - 1.25 / height,
        bottom=0.62 / height, wspace=0.3,
    )  # fmt: skip
    for column in range(columns):
        _draw_heat(figure, figure.add_subplot(grid[0, column]), found, column)
    a, b = found.channels
    rest = [
        f"p{k + 1} {display_units().pressure.text(p, 'g')}"
        for k, p in enumerate(found.others)
        if k + 1 not in found.channels
    ]
    others = f"      {', '.join(rest)}" if 0 < len(rest) <= 8 else ""
    draw_head(
        figure,
        f"{found.robot}: stiffness of the tip over channels {a} and {b}",
        f"boundary {found.boundary}, axes of the {found.frame}{others}",
    )
    return figure


def _draw_heat(figure: Figure, axes: Any, found: TipMap, column: int) -> None:
    from matplotlib.colors import LogNorm

    unit, pressure = display_units().stiffness, display_units().pressure
    values = unit.of(found.stiffness[:, :, column])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    norm = LogNorm(low, high) if high > 5 * low > 0 else None
    first, second = pressure.of(found.first), pressure.of(found.second)
    drawn = axes.pcolormesh(
        first, second, values.T, cmap=_BEST, norm=norm, shading="gouraud", rasterized=True
    )
    lines = axes.contour(
        first, second, values.T, levels=_levels(low, high), colors="white", linewidths=0.8
    )
    axes.clabel(lines, fmt=lambda value: f"{value:.3g}", fontsize=8)
    a, b = found.channels
    axes.set_xlabel(f"pressure of channel {a} ({pressure})")
    axes.set_ylabel(f"pressure of channel {b} ({pressure})")
    name = direction_name(tuple(found.directions[column]))
    axes.set_title(f"along {name}", loc="left", fontsize=11, weight="bold")
    axes.set_aspect("equal", adjustable="box")
    bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
    bar.set_label(f"stiffness ({unit})", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if norm is not None:
        label_logarithmic(bar.ax.yaxis, low, high)


def _levels(low: float, high: float) -> Array:
    from matplotlib.ticker import MaxNLocator

    if high > 5 * low > 0:
        return round_steps(low, high)
    return np.asarray(MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(low, high))


def _colours(count: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps[_BEST](k) for k in np.linspace(0, 0.92, count)]


def _pressure_bar(figure: Figure, axes: Any, pressures: Array) -> None:
    """Add a colour bar of the pressures."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    count = len(pressures)
    norm = BoundaryNorm(np.arange(count + 1) - 0.5, count)
    drawn = ScalarMappable(norm=norm, cmap=ListedColormap(_colours(count)))
    bar = figure.colorbar(drawn, cax=axes, ticks=range(count))
    unit = display_units().pressure
    bar.ax.set_yticklabels([unit.number(p, ".3g") for p in pressures], fontsize=9)
    bar.set_label(f"pressure ({unit})", fontsize=9.5)


def _named(group: tuple[int, ...]) -> str:
    numbers = ", ".join(map(str, group))
    return f"channel {numbers}" if len(group) == 1 else f"channels {numbers}"
