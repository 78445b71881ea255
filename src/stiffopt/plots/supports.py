"""Draw where a post or a wall would make an arm stiffer: a map of its body, and the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from stiffopt.display import display_units
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.supports import Kind, SupportMap
from stiffopt.plots import style
from stiffopt.plots.arm import draw_arm
from stiffopt.plots.contact import draw_contact
from stiffopt.plots.view import View
from stiffopt.plots.wording import direction_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS, _IMPOSSIBLE = "viridis", "#d5d9dd"
_SHOWN = 3  # supports listed in the title


def plot_supports(
    robot: Manipulator,
    found: SupportMap,
    *,
    title: str | None = None,
    view: View | None = None,
) -> Figure:
    """Draw where a post or a wall would help, as `stiffopt.suggest_supports` returns it.

    On the left is the arm on the best of them. The maps on the right are the surface of its body,
    unrolled; numbers are the places that were tested.

    `title`: begins the title. `view`: (elevation, azimuth), see `draw_arm`.
    """
    figure = style.new_figure(13, 8.0)
    axes = style.add_space(figure, (0.02, 0.03, 0.45, 0.77))
    style.legend_in_corner(axes, _draw_arm(axes, robot, found, view))
    kinds = get_args(Kind)
    grid = figure.add_gridspec(
        len(kinds), 2, width_ratios=(1, 0.03), left=0.56, right=0.93, top=0.8, bottom=0.085,
        hspace=0.42, wspace=0.05,
    )  # fmt: skip
    drawn: Any = None
    for row, kind in enumerate(kinds):
        panel = figure.add_subplot(grid[row, 0])
        drawn = _draw_map(panel, found, kind)
    bar: Any = figure.colorbar(drawn, cax=figure.add_subplot(grid[:, 1]))
    style.label_logarithmic(bar.ax.yaxis, bar.vmin, bar.vmax)
    bar.set_label("stiffness over that without (estimated)", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    name = f"{title}: " if title else ""
    style.draw_head(figure, f"{name}where a post or a wall would help", *_lines(found))
    return figure


def _lines(found: SupportMap) -> list[str]:
    free = found.free
    unit, measure = display_units().of_si(free.stiffness_unit), free.task.measures[0]
    lines = [f"without it {unit.text(min(free.stiffnesses), '.3g')} {direction_text(measure)}"]
    lines += [
        f"{number}  {each.kind}: {found.times(each):.3g} times as stiff, {each.touched}"
        for number, each in enumerate(found.supports[:_SHOWN], start=1)
    ]
    return lines if found.supports else [*lines, "nothing that was tested makes it stiffer"]


def _draw_arm(axes: Any, robot: Manipulator, found: SupportMap, view: View | None) -> list[Any]:
    """Draw the arm on its best support, or else as it is."""
    if not found.supports:
        free = found.free
        assert free.pressures is not None
        return draw_arm(axes, robot, free.pressures, scene=free.task.scene, view=view)
    best = found.supports[0].solution
    assert best.equilibrium is not None
    assert best.task.scene is not None
    return draw_contact(axes, robot, best.equilibrium, best.task.scene, view=view)


def _draw_map(axes: Any, found: SupportMap, kind: Kind) -> Any:
    from matplotlib.colors import LogNorm

    length = display_units().length
    free = min(found.free.stiffnesses)
    largest = max(
        2.0, *(float(np.nanmax(each, initial=0)) / free for each in found.stiffness.values())
    )
    values = np.maximum(found.stiffness[kind] / free, 1.0)
    axes.set_facecolor(_IMPOSSIBLE)
    sides = np.degrees(found.sides)
    drawn = axes.pcolormesh(
        length.of(found.at), sides, values.T, cmap=_COLOURS, norm=LogNorm(1.0, largest),
        shading="nearest", rasterized=True,
    )  # fmt: skip
    for number, each in enumerate(found.supports, start=1):
        if each.kind == kind:
            axes.text(
                length.of(each.at), np.degrees(each.side), f"{number}", fontsize=9, weight="bold",
                ha="center", va="center",
                bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": style.DARK},
            )  # fmt: skip
    axes.set_title(
        f"a {kind}; grey: it would be in the way, or be pressed too hard", loc="left", fontsize=10
    )
    axes.set_xlabel(f"where it touches the arm: distance from the base at rest ({length})")
    axes.set_ylabel("on which side (deg from x)")
    axes.set_yticks(range(0, 361, 90))
    style.tidy(axes)
    return drawn
