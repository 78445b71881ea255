"""Draw figures of the experiments: the tip against the model, combined poses, stiffness."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.directions import direction_name
from stiffopt.display import display_units
from stiffopt.experiments.kinematics_result import CoverageResult, KinematicsResult
from stiffopt.experiments.stiffness_result import StiffnessResult
from stiffopt.logs import StiffnessTable
from stiffopt.plots.style import (
    AXES,
    DARK,
    GREY,
    MEASURED,
    MODEL,
    channel_colour,
    draw_head,
    legend_beside,
    make_logarithmic,
    new_figure,
    stacked_panels,
    tidy,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BAND = 0.55  # opacity
_BAND_EDGE = 4.0  # points, so that a thin band is visible beside the line


def plot_kinematics(
    result: KinematicsResult, *, title: str = "kinematics", published: float | None = None
) -> Figure:
    """Draw pressures, the tip against the model, and the error, over time.

    Lines in the last panel show `published`, an error along each axis, in m.
    """
    figure, grid = stacked_panels(
        (1.95, 1.95, 1.95, 1.95, 2.15), left=0.93, right=1.98, gap=0.28, sharex=True
    )
    panels = grid[:, 0]
    _draw_pressures(panels[0], result)
    for axis, axes in enumerate(panels[1:4]):
        _draw_tip(axes, result, axis)
    _draw_error(panels[4], result, published)
    panels[4].set_xlabel("time (s)")
    panels[4].set_xlim(0, result.time[-1])
    draw_head(
        figure, title,
        f"error of the model's tip: {_error_text(result)}      "
        f"{_counted(result.repetitions, 'repetition')}",
    )  # fmt: skip
    return figure


def _error_text(result: KinematicsResult | CoverageResult) -> str:
    """Return mean, 95th percentile and largest error, also in per cent of the arm's length."""
    unit = display_units().length
    mean, p95, worst = (
        f"{unit.text(error, '.2f')} ({error / result.length * 100:.1f} %{of})"
        for error, of in ((result.mean, " of length"), (result.p95, ""), (result.worst, ""))
    )
    return f"mean {mean}, 95 % below {p95}, at most {worst}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _draw_pressures(axes: Any, result: KinematicsResult) -> None:
    unit = display_units().pressure
    for channel, p in enumerate(result.pressures.T):
        colour = channel_colour(channel)
        axes.plot(result.time, unit.of(p), color=colour, linewidth=1.4, label=f"p{channel + 1}")
    axes.set_ylabel(f"pressure ({unit})")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    columns = 1 if result.pressures.shape[1] <= 5 else 2
    legend_beside(axes, ncols=columns)
    tidy(axes)


def _draw_tip(axes: Any, result: KinematicsResult, axis: int) -> None:
    from matplotlib.patches import Patch

    unit = display_units().length
    low, high = unit.of(result.low[:, axis]), unit.of(result.high[:, axis])
    model = unit.of(result.model[:, axis])
    axes.fill_between(result.time, low, high, color=AXES[axis], alpha=_BAND, linewidth=_BAND_EDGE)
    axes.plot(result.time, model, color=MODEL, linewidth=1.1, label="model")
    axes.set_ylabel(f"tip {'xyz'[axis]} ({unit})")
    what = "measured, range\nof repetitions" if result.repetitions > 1 else "measured"
    legend_beside(axes, handles=[Patch(color=AXES[axis], alpha=_BAND, label=what), *axes.lines])
    tidy(axes)


def _draw_error(axes: Any, result: KinematicsResult, published: float | None) -> None:
    unit = display_units().length
    for axis in range(3):
        axes.plot(
            result.time, unit.of(result.component_error[:, axis]), color=AXES[axis], linewidth=1.1,
            label=f"in {'xyz'[axis]} (mean)",
        )  # fmt: skip
    axes.plot(
        result.time, unit.of(result.error), color=DARK, linewidth=1.4, label="distance\n(largest)"
    )
    axes.axhline(0, color=GREY, linewidth=0.7)
    for sign in (1, -1) if published is not None else ():
        label = "published, mostly\nwithin (each axis)" if sign > 0 else None
        axes.axhline(
            sign * unit.of(published), color=GREY, linewidth=1.1, linestyle="--", label=label
        )
    axes.set_ylabel(f"model - measured ({unit})")
    legend_beside(axes)
    tidy(axes)


def plot_coverage(result: CoverageResult, *, title: str = "combined poses") -> Figure:
    """Draw the pressures of each combined pose, and the error of the model's tip there."""
    (count, n), units = result.pressures.shape, display_units()
    height = 4.6 + 0.32 * n
    figure = new_figure(11, height)
    from matplotlib.ticker import MaxNLocator

    grid = figure.add_gridspec(
        2, 2, height_ratios=(0.32 * n, 3.0), width_ratios=(1, 0.018), left=0.085, right=0.92,
        top=1 - 1.1 / height, bottom=0.62 / height, hspace=0.12, wspace=0.03,
    )  # fmt: skip
    top = figure.add_subplot(grid[0, 0])
    below = figure.add_subplot(grid[1, 0], sharex=top)
    edges, length, pressure = np.arange(count + 1) + 0.5, units.length, units.pressure
    shades = top.pcolormesh(
        edges, np.arange(n + 1) + 0.5, pressure.of(result.pressures.T), cmap="viridis",
        edgecolors="white", linewidth=0.6,
    )  # fmt: skip
    top.set_yticks(range(1, n + 1), [f"p{channel}" for channel in range(1, n + 1)])
    top.invert_yaxis()
    top.tick_params(labelbottom=False, labelsize=9)
    top.spines[:].set_visible(False)
    scale = figure.colorbar(shades, cax=figure.add_subplot(grid[0, 1]))
    scale.set_label(pressure.name)
    scale.ax.tick_params(labelsize=9)
    below.bar(np.arange(1, count + 1), length.of(result.errors), width=0.7, color=MEASURED)
    for value, style, label in ((result.mean, "-", "mean"), (result.p95, "--", "95 %")):
        below.axhline(length.of(value), color=MODEL, linewidth=1.2, linestyle=style, label=label)
    below.set_xlim(edges[0], edges[-1])
    below.set_ylim(bottom=0)
    below.set_xlabel("pose, in the order in which they were taken")
    below.set_ylabel(f"error of the model's tip ({length})")
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_beside(below)
    tidy(below)
    draw_head(
        figure, title,
        f"error of the model's tip at the end of a pose: {_error_text(result)}      "
        f"{_counted(count, 'pose')}",
    )  # fmt: skip
    return figure


def plot_stiffness(
    result: StiffnessResult, *, title: str = "stiffness", published: StiffnessTable | None = None
) -> Figure:
    """Draw measured, modelled and published stiffness over pressure, a panel per direction."""
    directions = result.settings.directions
    columns = min(len(directions), 3)
    rows = -(-len(directions) // columns)
    figure = new_figure(1.2 + 4.3 * columns, 1.5 + 3.6 * rows)
    height = figure.get_figheight()
    grid = figure.add_gridspec(
        rows, columns, left=0.8 / figure.get_figwidth(), right=0.985, top=1 - 1.25 / height,
        bottom=0.62 / height, wspace=0.24, hspace=0.4,
    )  # fmt: skip
    for number in range(len(directions)):
        axes = figure.add_subplot(grid[number // columns, number % columns])
        _draw_stiffness(axes, result, number, published)
        if number == 0:
            axes.legend(fontsize=9, frameon=False)
    settings = result.settings
    repeated = _counted(settings.repetitions, "repetition")
    draw_head(
        figure, title,
        f"channel {settings.channel} pressurised      {repeated}, bars: 95 % confidence of the "
        "mean      boundary free",
    )  # fmt: skip
    return figure


def _draw_stiffness(
    axes: Any, result: StiffnessResult, number: int, published: StiffnessTable | None
) -> None:
    direction = result.settings.directions[number]
    cells = [cell for cell in result.along(direction) if cell.estimate is not None]
    unit, pressure = display_units().stiffness, display_units().pressure
    curve = unit.of(result.curves[:, number])
    axes.plot(pressure.of(result.curve_pressures), curve, color=MODEL, linewidth=1.6, label="model")
    for cell in cells:
        x = np.full(len(cell.slopes), pressure.of(cell.pressure))
        axes.plot(
            x, unit.of(np.array(cell.slopes)), "o", color=MEASURED, alpha=0.35, markersize=3.5,
            markeredgewidth=0, label="each repetition" if cell is cells[0] else None,
        )  # fmt: skip
    estimates = [cell.estimate for cell in cells if cell.estimate is not None]
    if estimates:
        axes.errorbar(
            [pressure.of(cell.pressure) for cell in cells],
            [unit.of(each.value) for each in estimates],
            yerr=[unit.of(each.half_width) for each in estimates],
            color=MEASURED, marker="s", markersize=4.5, capsize=3, linestyle="none",
            label="measured",
        )  # fmt: skip
    beside = [] if published is None else result.beside(published)
    mine = [(row, cell) for row, cell in beside if cell.direction == direction]
    if published is not None and mine:
        rows = [row for row, _ in mine]
        spread = published.others.get("repeatability_n_per_m", published.sigma)
        axes.errorbar(
            [pressure.of(cell.pressure) for _, cell in mine], unit.of(published.stiffness[rows]),
            yerr=unit.of(spread[rows]), color=DARK, marker="D", markersize=6, capsize=4,
            markerfacecolor="none", linestyle="none", label="published",
        )  # fmt: skip
    axes.set_title(f"along {direction_name(direction)}", loc="left", fontsize=11, weight="bold")
    axes.set_xlabel(f"pressure ({pressure})")
    axes.set_ylabel(f"stiffness ({unit})")
    shown = [*(unit.of(each.value) for each in estimates), *curve]
    shown += [unit.of(float(published.stiffness[row])) for row, _ in mine if published is not None]
    if max(shown) > 8 * min(shown) > 0:
        make_logarithmic(axes)
    else:
        axes.set_ylim(0, 1.15 * max(max(shown), axes.get_ylim()[1] / 1.15))
    axes.grid(alpha=0.25, which="both")
    tidy(axes)
