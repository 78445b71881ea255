"""Figure of a workspace: sections that show how stiff the tip can be made at each place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import InputError
from stiffopt.plots.style import ARM, draw_head, label_logarithmic, new_figure, tidy
from stiffopt.plots.wording import MM, unit_text
from stiffopt.workspace import WorkspaceMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Vector = NDArray[np.float64]

ENOUGH = 10
"""Samples that a cell needs for its ratio of stiffnesses to be shown; fewer tell little of it."""

_UNKNOWN = "#d5d9dd"
_BEST, _CHOICE = "viridis", "YlOrRd"
_ROW, _HEAD, _FOOT = 2.75, 1.55, 0.95  # inches: a direction, above and below all


def plot_workspace(found: WorkspaceMap, *, title: str | None = None) -> Figure:
    """Draw sections through a workspace, a row for each direction.

    On the left the greatest stiffness that the tip can have at a place, on the right the ratio of
    the greatest to the least: how much pressures can change it there. The upright section holds the
    arm at rest, the level one is where the workspace is widest.

    Parameters
    ----------
    found : WorkspaceMap
    title : str, optional
        By default the name of the robot.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If no tip was found anywhere.
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
    unit = unit_text(found.plan.unit)
    for row, name in enumerate(found.direction_names):
        for first, values, colours, label in (
            (0, found.best[row], _BEST, f"greatest stiffness ({unit})"),
            (4, _known(found, found.ratio[row]), _CHOICE, "greatest / least"),
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
    """A layer of cells, seen along one axis."""

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
        """The plane y = 0, or if nothing was reached there the plane with the most cells."""
        layers = found.cells[:, 1]
        return cls(found, 1, 0 if (layers == 0).any() else _fullest(layers))

    @classmethod
    def level(cls, found: WorkspaceMap) -> _Section:
        """The height at which most cells are reached."""
        return cls(found, 2, _fullest(found.cells[:, 2]))

    @property
    def name(self) -> str:
        """Where the section is."""
        return f"at {'xyz'[self.normal]} = {self.place * MM + 0.0:g} mm"

    def image(self, values: Vector) -> Vector:
        """Values (M,) of cells as an image, row by row from below."""
        picture = np.full(self._shape, np.nan)
        picture[tuple(self._at.T)] = values[self.rows]
        return picture.T

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges left, right, bottom, top in mm."""
        low = (self._first - 0.5) * self._size * MM
        high = low + np.array(self._shape) * self._size * MM
        return (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def _fullest(layers: NDArray[np.int64]) -> int:
    values, counts = np.unique(layers, return_counts=True)
    return int(values[counts.argmax()])


def _known(found: WorkspaceMap, values: Vector) -> Vector:
    """Values of cells, infinite where too few samples say something of them."""
    return np.where(found.count >= ENOUGH, values, np.inf)


def _draw_sections(
    panels: Sequence[Any], sections: Sequence[_Section], values: Vector, colours: str
) -> Any:
    """Draw the same quantity in both sections, in the same colours; return what has them."""
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
    """Axes in mm, the arm at rest, and where the other section cuts this one."""
    left, right, bottom, top = section.extent
    if section.normal == 1:
        bottom = min(bottom, 0.0)
        top = max(top, section.length * MM)
        side = section.radius * MM
        axes.fill(
            [-side, side, side, -side], [0, 0, section.length * MM, section.length * MM],
            facecolor="none", edgecolor=ARM, linewidth=1.1, linestyle="--", zorder=4,
        )  # fmt: skip
        axes.plot([-2.2 * side, 2.2 * side], [0, 0], color=ARM, linewidth=3.0, zorder=4)
    else:
        axes.plot(0, 0, marker="+", color=ARM, markersize=9, markeredgewidth=1.4, zorder=4)
    line = axes.axhline(other.place * MM, color=ARM, linewidth=0.9, linestyle=":", zorder=3)
    line.set_dash_capstyle("round")
    room = 0.04 * max(right - left, top - bottom)
    axes.set_xlim(left - room, right + room)
    ends = (bottom - room, top + room)
    axes.set_ylim(*(ends[::-1] if section.normal == 1 and section.hangs else ends))
    axes.set_aspect("equal")
    axes.set_facecolor("white")
    across, up = ("xyz"[axis] for axis in section.axes)
    axes.set_xlabel(f"{across} (mm)   {section.name}", fontsize=9, labelpad=1)
    axes.set_ylabel(f"{up} (mm)", fontsize=9, labelpad=1)
    tidy(axes)


def _way(found: WorkspaceMap, row: int) -> str:
    measure = found.plan.measures[row]
    way = "along" if measure.kind == "translation" else "about"
    return f"{way} {'' if measure.frame == 'base' else 'the tip’s '}".rstrip()


def _write_head(figure: Figure, found: WorkspaceMap, title: str, height: float) -> None:
    plan, first = found.plan, found.plan.measures[0]
    draw_head(
        figure,
        f"{title}: the workspace of the tip",
        f"{found.volume * 1e6:,.0f} cm³ reached      "
        f"{found.samples:,} samples, {np.median(found.count):g} in the median cell of "
        f"{plan.cell * MM:g} mm      stiffness of {first.kind}, {first.boundary}",
    )
    for x, text in (
        (0.055, "How stiff can the tip be made at a place?"),
        (0.52, "How much can the stiffness be changed there? (1: not at all)"),
    ):
        figure.text(x, 1 - 1.03 / height, text, fontsize=11.5, va="center", color="#20394f")


def _write_foot(figure: Figure) -> None:
    """Explain what lines and colours mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=ARM, linestyle="--", linewidth=1.1, label="the arm at rest"),
        Line2D([], [], color=ARM, linewidth=3, label="its base"),
        Line2D(
            [], [], color=ARM, linestyle=":", linewidth=1,
            label="where the other section is",
        ),
        Patch(facecolor=_UNKNOWN, label=f"reached by fewer than {ENOUGH} samples: ratio unknown"),
    ]  # fmt: skip
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.03, 0.0), ncols=4, fontsize=9.5,
        frameon=False, columnspacing=2.5,
    )  # fmt: skip
