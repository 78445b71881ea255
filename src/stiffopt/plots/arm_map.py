"""Figures of maps: stiffness along an arm (the paper's figure 6), and of the tip over pressures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.directions import direction_name
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
from stiffopt.plots.wording import BAR, MM, N_PER_CM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = "viridis"


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
    shapes = found.backbones[row] * MM
    flat = _bending_plane(shapes)
    for shape, colour in zip(shapes, colours, strict=True):
        axes.plot(shape[:, :2] @ flat, shape[:, 2], color=colour, linewidth=2.2)
    axes.plot([-0.1 * found.length * MM, 0.1 * found.length * MM], [0, 0], color=ARM, lw=3)
    across = "x" if abs(flat[0]) > 0.999 else "in the plane of bending"
    sign = "-" if flat[0] < -0.999 else ""
    axes.set_xlabel(f"{sign}{across} (mm)", fontsize=9)
    axes.set_ylabel("z (mm)", fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
    if found.hangs:
        axes.invert_yaxis()
    tidy(axes)


def _bending_plane(shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector (2,) in the plane x-y along which the tip moves most; x if it hardly moves."""
    tips = shapes[:, -1, :2] - shapes[0, -1, :2]
    farthest: NDArray[np.float64] = tips[np.argmax(np.linalg.norm(tips, axis=1))]
    size = float(np.linalg.norm(farthest))
    if size < 1.0 or abs(farthest[0]) > 0.999 * size:
        return np.array([1.0, 0.0])
    return farthest / size


def _draw_along(axes: Any, found: ArmMap, row: int, column: int, colours: list[Any]) -> None:
    for level, colour in enumerate(colours):
        values = found.stiffness[row, level, :, column] * N_PER_CM
        axes.plot(found.at * MM, values, color=colour, linewidth=1.7)
    axes.axvline(found.length / 2 * MM, color=ARM, linewidth=0.9, linestyle=":")
    name = direction_name(tuple(found.directions[column]))
    axes.set_title(f"along {name}", loc="left", fontsize=10.5)
    make_logarithmic(axes)
    axes.set_xlabel("distance from the base at rest (mm)", fontsize=9)
    axes.set_ylabel("stiffness (N/cm)", fontsize=9)
    axes.set_xlim(found.at[0] * MM, found.at[-1] * MM)
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
        f"p{k + 1} {p * BAR:g} bar"
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

    values = found.stiffness[:, :, column] * N_PER_CM
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    norm = LogNorm(low, high) if high > 5 * low > 0 else None
    first, second = found.first * BAR, found.second * BAR
    drawn = axes.pcolormesh(
        first, second, values.T, cmap=_COLOURS, norm=norm, shading="gouraud", rasterized=True
    )
    lines = axes.contour(
        first, second, values.T, levels=_levels(low, high), colors="white", linewidths=0.8
    )
    axes.clabel(lines, fmt=lambda value: f"{value:.3g}", fontsize=8)
    a, b = found.channels
    axes.set_xlabel(f"pressure of channel {a} (bar)")
    axes.set_ylabel(f"pressure of channel {b} (bar)")
    name = direction_name(tuple(found.directions[column]))
    axes.set_title(f"along {name}", loc="left", fontsize=11, weight="bold")
    axes.set_aspect("equal", adjustable="box")
    bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
    bar.set_label("stiffness (N/cm)", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if norm is not None:
        label_logarithmic(bar.ax.yaxis, low, high)


def _levels(low: float, high: float) -> NDArray[np.float64]:
    from matplotlib.ticker import MaxNLocator

    if high > 5 * low > 0:
        return round_steps(low, high)
    return np.asarray(MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(low, high))


def _colours(count: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps[_COLOURS](k) for k in np.linspace(0, 0.92, count)]


def _pressure_bar(figure: Figure, axes: Any, pressures: NDArray[np.float64]) -> None:
    """Show which colour is which pressure."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    count = len(pressures)
    norm = BoundaryNorm(np.arange(count + 1) - 0.5, count)
    drawn = ScalarMappable(norm=norm, cmap=ListedColormap(_colours(count)))
    bar = figure.colorbar(drawn, cax=axes, ticks=range(count))
    bar.ax.set_yticklabels([f"{p * BAR:.3g}" for p in pressures], fontsize=9)
    bar.set_label("pressure (bar)", fontsize=9.5)


def _named(group: tuple[int, ...]) -> str:
    numbers = ", ".join(map(str, group))
    return f"channel {numbers}" if len(group) == 1 else f"channels {numbers}"
