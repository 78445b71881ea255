"""Figures of the experiments: the tip against the model (5), combined poses, stiffness (7)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.directions import direction_name
from stiffopt.experiments.coverage_result import CoverageResult
from stiffopt.experiments.kinematics_result import KinematicsResult
from stiffopt.experiments.stiffness_result import StiffnessResult
from stiffopt.plots.figures import _literal, require_matplotlib
from stiffopt.plots.scales import make_logarithmic
from stiffopt.plots.wording import BAR, MM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED = "#2f6db3"
MODEL = "#d62728"
AXES = ("#2f6db3", "#2a8a57", "#c99a0b")
"""Of x, y and z."""
CHANNELS = ("#2f6db3", "#c2571a", "#2a8a57", "#8e5bb5", "#c99a0b", "#4aa7b5", "#b5547a", "#6b7a3a",
            "#7d5a4a")  # fmt: skip
N_PER_CM = 0.01  # per N/m

_BAND = 0.55  # opacity
_BAND_EDGE = 4.0  # points: a thin band must be seen beside the line


def plot_kinematics(result: KinematicsResult, *, title: str = "kinematics") -> "Figure":
    """Draw pressures, the tip against the model, and the error, over time.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 11.5))
    panels = figure.subplots(
        5, 1, sharex=True, height_ratios=(1, 1, 1, 1, 1.1),
        gridspec_kw={"left": 0.085, "right": 0.82, "top": 0.905, "bottom": 0.055, "hspace": 0.14},
    )  # fmt: skip
    _draw_pressures(panels[0], result)
    for axis, axes in enumerate(panels[1:4]):
        _draw_tip(axes, result, axis)
    _draw_error(panels[4], result)
    panels[4].set_xlabel("time (s)")
    panels[4].set_xlim(0, result.time[-1])
    percent = 100 / result.length
    repeated = f"{result.repetitions} repetition{'s' * (result.repetitions != 1)}"
    _head(
        figure, title,
        f"error of the model's tip: mean {result.mean * MM:.2f} mm "
        f"({result.mean * percent:.1f} % of length), 95 % below {result.p95 * MM:.2f} mm "
        f"({result.p95 * percent:.1f} %), at most {result.worst * MM:.2f} mm "
        f"({result.worst * percent:.1f} %)      {repeated}",
    )  # fmt: skip
    return figure


def _draw_pressures(axes: Any, result: KinematicsResult) -> None:
    for channel, p in enumerate(result.pressures.T):
        colour = CHANNELS[channel % len(CHANNELS)]
        axes.plot(result.time, p * BAR, color=colour, linewidth=1.4, label=f"p{channel + 1}")
    axes.set_ylabel("pressure (bar)")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    columns = 1 if result.pressures.shape[1] <= 5 else 2
    _legend(axes, ncols=columns)
    _plain(axes)


def _draw_tip(axes: Any, result: KinematicsResult, axis: int) -> None:
    from matplotlib.patches import Patch

    low, high = result.low[:, axis] * MM, result.high[:, axis] * MM
    model = result.model[:, axis] * MM
    axes.fill_between(result.time, low, high, color=AXES[axis], alpha=_BAND, linewidth=_BAND_EDGE)
    axes.plot(result.time, model, color=MODEL, linewidth=1.1, label="model")
    axes.set_ylabel(f"tip {'xyz'[axis]} (mm)")
    what = "measured\n(least to greatest)" if result.repetitions > 1 else "measured"
    _legend(axes, handles=[Patch(color=AXES[axis], alpha=_BAND, label=what), *axes.lines])
    _plain(axes)


def _draw_error(axes: Any, result: KinematicsResult) -> None:
    for axis in range(3):
        axes.plot(
            result.time, result.component_error[:, axis] * MM, color=AXES[axis], linewidth=1.1,
            label=f"in {'xyz'[axis]} (mean)",
        )  # fmt: skip
    axes.plot(
        result.time, result.error * MM, color="#333333", linewidth=1.4, label="distance\n(largest)"
    )
    axes.axhline(0, color="#999999", linewidth=0.7)
    axes.set_ylabel("model - measured (mm)")
    _legend(axes)
    _plain(axes)


def plot_coverage(result: CoverageResult, *, title: str = "combined poses") -> "Figure":
    """Draw the pressures of each combined pose, and how far the model's tip is off there.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    count, n = result.pressures.shape
    height = 4.6 + 0.32 * n
    figure = Figure(figsize=(11, height))
    grid = figure.add_gridspec(
        2, 2, height_ratios=(0.32 * n, 3.0), width_ratios=(1, 0.018), left=0.085, right=0.92,
        top=1 - 1.1 / height, bottom=0.62 / height, hspace=0.12, wspace=0.03,
    )  # fmt: skip
    top = figure.add_subplot(grid[0, 0])
    below = figure.add_subplot(grid[1, 0], sharex=top)
    edges = np.arange(count + 1) + 0.5
    shades = top.pcolormesh(
        edges, np.arange(n + 1) + 0.5, result.pressures.T * BAR, cmap="viridis",
        edgecolors="white", linewidth=0.6,
    )  # fmt: skip
    top.set_yticks(range(1, n + 1), [f"p{channel}" for channel in range(1, n + 1)])
    top.invert_yaxis()
    top.tick_params(labelbottom=False, labelsize=9)
    top.spines[:].set_visible(False)
    scale = figure.colorbar(shades, cax=figure.add_subplot(grid[0, 1]))
    scale.set_label("bar")
    scale.ax.tick_params(labelsize=9)
    below.bar(np.arange(1, count + 1), result.errors * MM, width=0.7, color=MEASURED)
    for value, style, label in ((result.mean, "-", "mean"), (result.p95, "--", "95 %")):
        below.axhline(value * MM, color=MODEL, linewidth=1.2, linestyle=style, label=label)
    below.set_xlim(edges[0], edges[-1])
    below.set_ylim(bottom=0)
    below.set_xlabel("pose, in the order in which they were taken")
    below.set_ylabel("error of the model's tip (mm)")
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    below.legend(
        loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9, frameon=False, borderaxespad=0.0,
        handlelength=1.6,
    )  # fmt: skip
    _plain(below)
    percent = 100 / result.length
    _head(
        figure, title,
        f"error of the model's tip at the end of a pose: mean {result.mean * MM:.2f} mm "
        f"({result.mean * percent:.1f} % of length), 95 % below {result.p95 * MM:.2f} mm "
        f"({result.p95 * percent:.1f} %), at most {result.worst * MM:.2f} mm "
        f"({result.worst * percent:.1f} %)      {count} pose{'s' * (count != 1)}",
    )  # fmt: skip
    return figure


def plot_stiffness(result: StiffnessResult, *, title: str = "stiffness") -> "Figure":
    """Draw stiffness over pressure, a panel for each direction, measured and modelled.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    directions = result.settings.directions
    columns = min(len(directions), 3)
    rows = -(-len(directions) // columns)
    figure = Figure(figsize=(1.2 + 4.3 * columns, 1.5 + 3.6 * rows))
    height = figure.get_figheight()
    grid = figure.add_gridspec(
        rows, columns, left=0.8 / figure.get_figwidth(), right=0.985, top=1 - 1.25 / height,
        bottom=0.62 / height, wspace=0.24, hspace=0.4,
    )  # fmt: skip
    for number in range(len(directions)):
        axes = figure.add_subplot(grid[number // columns, number % columns])
        _draw_stiffness(axes, result, number)
        if number == 0:
            axes.legend(fontsize=9, frameon=False)
    settings = result.settings
    repeated = f"{settings.repetitions} repetition{'s' * (settings.repetitions != 1)}"
    _head(
        figure, title,
        f"channel {settings.channel} pressurised      {repeated}, bars: 95 % confidence of the "
        "mean      boundary free",
    )  # fmt: skip
    return figure


def _draw_stiffness(axes: Any, result: StiffnessResult, number: int) -> None:
    direction = result.settings.directions[number]
    cells = [cell for cell in result.along(direction) if cell.estimate is not None]
    axes.plot(
        result.curve_pressures * BAR, result.curves[:, number] * N_PER_CM, color=MODEL,
        linewidth=1.6, label="model",
    )  # fmt: skip
    for cell in cells:
        x = np.full(len(cell.slopes), cell.pressure * BAR)
        axes.plot(
            x, np.array(cell.slopes) * N_PER_CM, "o", color=MEASURED, alpha=0.35, markersize=3.5,
            markeredgewidth=0, label="each repetition" if cell is cells[0] else None,
        )  # fmt: skip
    estimates = [cell.estimate for cell in cells if cell.estimate is not None]
    if estimates:
        axes.errorbar(
            [cell.pressure * BAR for cell in cells],
            [each.value * N_PER_CM for each in estimates],
            yerr=[each.half_width * N_PER_CM for each in estimates],
            color=MEASURED, marker="s", markersize=4.5, capsize=3, linestyle="none",
            label="measured",
        )  # fmt: skip
    axes.set_title(f"along {direction_name(direction)}", loc="left", fontsize=11, weight="bold")
    axes.set_xlabel("pressure (bar)")
    axes.set_ylabel("stiffness (N/cm)")
    shown = [*(each.value * N_PER_CM for each in estimates), *result.curves[:, number] * N_PER_CM]
    if max(shown) > 8 * min(shown) > 0:
        make_logarithmic(axes)
    else:
        axes.set_ylim(0, 1.15 * max(max(shown), axes.get_ylim()[1] / 1.15))
    axes.grid(alpha=0.25, which="both")
    _plain(axes)


def _legend(axes: Any, ncols: int = 1, handles: Any = None) -> None:
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9,
        frameon=False, ncols=ncols, borderaxespad=0.0, handlelength=1.6,
    )  # fmt: skip


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)


def _head(figure: "Figure", title: str, facts: str) -> None:
    height = figure.get_figheight()
    figure.text(0.025, 1 - 0.34 / height, _literal(title), fontsize=15, weight="bold", va="center")
    figure.text(0.025, 1 - 0.68 / height, facts, fontsize=10, va="center")
