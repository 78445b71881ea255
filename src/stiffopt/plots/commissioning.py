"""Draw a commissioning: responses against the model, steps over time, noise, findings."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.commissioning.commission import Commissioning
from stiffopt.display import display_units
from stiffopt.plots.style import (
    AXES,
    DARK,
    GREY,
    MODEL,
    channel_colour,
    draw_head,
    legend_beside,
    literal,
    new_figure,
    tidy,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BEFORE = 0.4  # s that are drawn before a step
_LINE = 0.2  # inches, height of a line of findings
_CHARACTERS = 135


def plot_commissioning(
    found: Commissioning, *, title: str = "commissioning", findings: Sequence[str] = ()
) -> Figure:
    """Draw the measurements of a commissioning, with its findings as sentences."""
    lines = [line for text in findings for line in wrap(f"-  {text}", _CHARACTERS)]
    height = 9.6 + _LINE * len(lines)
    figure = new_figure(11, height)
    grid = figure.add_gridspec(
        2, 2, left=0.075, right=0.93, top=1 - 0.95 / height,
        bottom=(0.75 + _LINE * len(lines)) / height, hspace=0.3, wspace=0.3,
    )  # fmt: skip
    panels = [figure.add_subplot(grid[i, j]) for i in range(2) for j in range(2)]
    _draw_responses(panels[0], found)
    _draw_steps(panels[1], found)
    _draw_gauges(panels[2], found)
    _draw_noise(panels[3], found)
    for axes in panels:
        tidy(axes)
    units, seen = display_units(), found.responses
    swing = "no swing" if seen.swing is None else f"swing {seen.swing.frequency:.2f} Hz"
    draw_head(
        figure, title,
        f"steps of {units.pressure.text(seen.size, '.3f')}      tracker: noise "
        f"{units.length.text(seen.noise, '.3f')}, {1e3 * seen.latency:.0f} ms old      {swing}",
    )  # fmt: skip
    for number, line in enumerate(reversed(lines)):
        y = (0.2 + _LINE * number) / height
        figure.text(0.03, y, literal(line), fontsize=9.5, va="center")
    return figure


def _draw_responses(axes: Any, found: Commissioning) -> None:
    """Draw the displacement by each channel, in the plane across the arm."""
    unit, e = display_units().length, found.expected
    for k, moved in enumerate(found.responses.shift):
        expected = e.shift[e.row((k,))]
        x, y = (unit.of(np.array([0.0, v])) for v in expected[:2])
        axes.plot(x, y, color=MODEL, linewidth=3.5, alpha=0.3, label="model" if k == 0 else None)
        x, y = (unit.of(np.array([0.0, v])) for v in moved[:2])
        axes.plot(x, y, color=channel_colour(k), linewidth=1.5, marker="o", markevery=[1],
                  markersize=4, label=f"p{k + 1}")  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"tip x ({unit}), by a step of each channel")
    axes.set_ylabel(f"tip y ({unit})")
    legend_beside(axes)


def _draw_steps(axes: Any, found: Commissioning) -> None:
    """Draw the motion in each step along its final displacement, over time."""
    unit, r = display_units().length, found.readings
    for step, moved in zip(r.steps, found.responses.shift, strict=True):
        rows = (r.time > step.up - _BEFORE) & (r.time < min(step.down, step.up + 4.0))
        along = moved / max(float(np.linalg.norm(moved)), 1e-9)
        way = (r.position[rows] - found.responses.rest_position) @ along
        colour = channel_colour(step.channel)
        axes.plot(r.time[rows] - step.up, unit.of(way), color=colour, linewidth=1.1)
    axes.axvline(0, color=GREY, linewidth=0.7)
    axes.set_xlabel("time since the step (s)")
    axes.set_ylabel(f"tip along its way ({unit})")


def _draw_gauges(axes: Any, found: Commissioning) -> None:
    """Draw the gauge of each channel and its command, over time."""
    unit, r = display_units().pressure, found.readings
    for step in r.steps:
        rows = (r.tick > step.up - _BEFORE) & (r.tick < min(step.down, step.up + 1.5))
        time, k = r.tick[rows] - step.up, step.channel
        axes.step(time, unit.of(r.commanded[rows, k]), where="post", color=MODEL, linewidth=2.5,
                  alpha=0.3, label="commanded" if k == 0 else None)  # fmt: skip
        axes.plot(time, unit.of(r.measured[rows, k]), color=channel_colour(k), linewidth=1.1)
    axes.set_xlabel("time since the step (s)")
    axes.set_ylabel(f"gauges ({unit})")
    axes.legend(fontsize=9, frameon=False, loc="lower right")


def _draw_noise(axes: Any, found: Commissioning) -> None:
    """Draw the tip at rest over time, each axis about its mean."""
    unit, r = display_units().length, found.readings
    rows = (r.time >= r.rest[0]) & (r.time <= r.rest[1])
    for axis, letter in enumerate("xyz"):
        off = r.position[rows, axis] - found.responses.rest_position[axis]
        axes.plot(
            r.time[rows] - r.rest[0],
            unit.of(off),
            ".",
            color=AXES[axis],
            markersize=4,
            label=letter,
        )
    axes.axhline(0, color=DARK, linewidth=0.7)
    axes.set_xlabel("time at rest (s)")
    axes.set_ylabel(f"tip about its mean ({unit})")
    legend_beside(axes)
