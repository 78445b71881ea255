"""Style of all figures: colours, panels, titles, legends, logarithmic scales, and saving.

matplotlib is imported only when something is drawn.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.documents import write_whole
from stiffopt.errors import FileError, printable, require_package

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# -- colours --------------------------------------------------------------------------------------

MEASURED = "#2f6db3"
MODEL = "#d62728"
TARGET = "#d62728"
BEFORE = "#9aa3ab"
"""Robot file before calibration."""
AXES = ("#2f6db3", "#2a8a57", "#c99a0b")
"""Axes x, y and z."""
CHANNELS = ("#2f6db3", "#c2571a", "#2a8a57", "#8e5bb5", "#c99a0b", "#4aa7b5", "#b5547a", "#6b7a3a",
            "#7d5a4a")  # fmt: skip
"""Channels, or logs, in turn."""
SEGMENTS = ("#7fa8c9", "#a9c47f", "#c9a27f", "#a58fc4", "#7fc4b8")
"""Segments in turn."""
DIRECTIONS = ("#c2571a", "#8c2d04", "#e0a100", "#b5547a")
"""Stiffnesses that a task names, in turn."""
FORCE = "#8c564b"
ELLIPSOID = "#6a3d9a"
AT_LIMIT = "#f28e2b"
LEAST_STIFF_TEXT = "#b35c00"
WITHIN_LIMITS = "#4e79a7"
RANGE = "#e9ecef"
"""Allowed or recorded range."""
BOUND = "#9aa3ab"
LOAD = "#111111"
OBSTACLE = "#8a6d5c"
ARM = "#39424b"
"""Outline of the arm."""
STATUS = {"solved": "#2a7f3f", "unreachable": "#b35c00", "failed": "#b00020"}
GREY = "#8a8f96"
DARK = "#333333"


def segment_colour(segment: int) -> str:
    """Return the colour of a segment, counted from 0."""
    return SEGMENTS[segment % len(SEGMENTS)]


def segment_text_colour(segment: int) -> str:
    """Return a segment's colour, dark enough for text and thin lines."""
    red, green, blue = (int(segment_colour(segment)[i : i + 2], 16) for i in (1, 3, 5))
    return f"#{red * 6 // 10:02x}{green * 6 // 10:02x}{blue * 6 // 10:02x}"


def channel_colour(channel: int) -> str:
    """Return the colour of a channel, or of a log, counted from 0."""
    return CHANNELS[channel % len(CHANNELS)]


# -- figures --------------------------------------------------------------------------------------

_WIDE = 11.0  # inches
_DPI = 130
_LONGEST_NOTE = 160  # characters of a message


def require_matplotlib() -> None:
    """Raise `MissingExtraError`, which says how to install matplotlib, if it is missing."""
    require_package("matplotlib", "plot")


def new_figure(width: float, height: float, **settings: Any) -> Figure:
    """Return an empty figure of a size in inches.

    Raises `MissingExtraError` if matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), **settings)


def add_space(figure: Figure, place: tuple[float, float, float, float]) -> Any:
    """Add 3-D axes at the right of a place of a figure: left, bottom, width, height."""
    return figure.add_axes(place, projection="3d", computed_zorder=False, anchor="E")


def stacked_panels(
    heights: Sequence[float], *, columns: int = 1, wide: float = _WIDE, left: float = 0.8,
    right: float = 0.17, head: float = 1.1, foot: float = 0.6, gap: float = 0.4,
    between: float = 0.24, **shared: Any,
) -> tuple[Figure, Any]:  # fmt: skip
    """Return a figure with rows of panels, and the panels (rows, columns).

    Parameters
    ----------
    heights : of the rows.
    columns : number of panels in a row.
    wide, left, right, head, foot, gap : width of the figure, its margins on the four sides, and
        the space between two rows; like `heights` in inches.
    between : space between two columns, as a share of a panel's width.
    shared : ``sharex`` and ``sharey``, as matplotlib's ``subplots`` takes them.
    """
    rows = len(heights)
    height = head + sum(heights) + gap * (rows - 1) + foot
    figure = new_figure(wide, height)
    panels = figure.subplots(
        rows, columns, squeeze=False, height_ratios=list(heights), **shared,
        gridspec_kw={
            "left": left / wide, "right": 1 - right / wide, "top": 1 - head / height,
            "bottom": foot / height, "hspace": gap * rows / sum(heights), "wspace": between,
        },
    )  # fmt: skip
    for axes in panels.flat:
        tidy(axes)
    return figure, panels


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure atomically, in the format of the path's ending.

    Raises `FileError`: the file cannot be written.
    """
    buffer = BytesIO()
    try:
        figure.savefig(buffer, format=Path(path).suffix[1:].lower() or "png", dpi=_DPI)
    except ValueError as error:  # a format that matplotlib does not know
        raise FileError(path, f"cannot be drawn: {error}") from None
    write_whole(path, buffer.getvalue())


# -- words ----------------------------------------------------------------------------------------


def literal(text: str) -> str:
    """Escape text so that matplotlib does not typeset it as mathematics."""
    return printable(text).replace("$", r"\$")


def draw_head(figure: Figure, title: str, *lines: str) -> None:
    """Write a title at the top of a figure, and lines with key numbers below it."""
    height = figure.get_figheight()
    figure.text(0.025, 1 - 0.34 / height, literal(title), fontsize=15, weight="bold", va="center")
    for number, line in enumerate(lines):
        y = 1 - (0.68 + 0.26 * number) / height
        figure.text(0.025, y, literal(line), fontsize=10, va="center")


def draw_outcome(figure: Figure, title: str, numbers: str, status: str, message: str) -> None:
    """Write the head of a solution's figure: title, key numbers, message and status."""
    draw_head(
        figure, title, numbers, shorten(printable(message), _LONGEST_NOTE, placeholder=" ...")
    )
    figure.text(
        0.975, 1 - 0.34 / figure.get_figheight(), status, fontsize=13, weight="bold", va="center",
        ha="right", color=STATUS[status],
    )  # fmt: skip


def legend_beside(axes: Any, **settings: Any) -> None:
    """Put a legend to the right of a panel."""
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9, frameon=False, borderaxespad=0.0,
        handlelength=1.6, **settings,
    )  # fmt: skip


def legend_in_corner(axes: Any, handles: Sequence[Any]) -> None:
    """Put a legend into the upper left corner of 3-D axes, and move their box to the right."""
    from stiffopt.plots.view import move_to_the_right

    move_to_the_right(axes)
    place = axes.get_position(original=True)
    axes.get_figure().legend(
        handles=handles, loc="upper left", bbox_to_anchor=(place.x0, place.y1), fontsize=9,
        frameon=False,
    )  # fmt: skip


def legend_on_top(
    figure: Figure, handles: Sequence[Any], labels: Sequence[str], **settings: Any
) -> None:
    """Put a legend into the upper right corner of a figure."""
    figure.legend(
        handles, labels, loc="upper right", frameon=False,
        bbox_to_anchor=(0.985, 1 - 0.14 / figure.get_figheight()),
        **{"fontsize": 9, "ncols": len(labels), "handlelength": 1.6, **settings},
    )  # fmt: skip


def tidy(axes: Any) -> None:
    """Remove the frame's upper and right side, and make the numbers smaller."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)


# -- scales and lines -----------------------------------------------------------------------------


_STEPS = (
    (1.0,),
    (1.0, 3.0),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
    tuple(step / 10 for step in range(10, 100)),
)
"""Ticks of a decade, from few to many."""


def round_steps(low: float, high: float, limit: int = 8) -> Array:
    """Return at most about `limit` round numbers between two, evenly spread on a log scale."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    found: list[float] = []
    for steps in _STEPS:
        ticks = [float(step) * 10.0**decade for decade in decades for step in steps]
        ticks = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
        if len(found) >= 2 and len(ticks) > limit:
            break
        found = ticks
    return np.array(found)


def make_logarithmic(axes: Any) -> None:
    """Give the vertical axis of a panel, whose limits are set, a logarithmic scale."""
    axes.set_yscale("log")
    label_logarithmic(axes.yaxis, *axes.get_ylim())


def label_logarithmic(axis: Any, low: float, high: float, limit: int = 8) -> None:
    """Put plain round numbers on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator

    axis.set_major_locator(FixedLocator(list(round_steps(low, high, limit))))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _: f"{value:.5g}")


def thinned(time: Array, values: Array, limit: int = 4000) -> tuple[Array, Array]:
    """Return a line with at most about `limit` points that shows the same extremes."""
    count = len(time)
    size = -(-2 * count // limit)
    if size <= 2:
        return time, values
    bins = count // size
    shaped = values[: bins * size].reshape(bins, size)
    filled_low = np.where(np.isfinite(shaped), shaped, np.inf)
    filled_high = np.where(np.isfinite(shaped), shaped, -np.inf)
    pair = np.sort(np.stack([filled_low.argmin(axis=1), filled_high.argmax(axis=1)]), axis=0)
    rows = np.unique((pair + np.arange(bins) * size).ravel(order="F"))
    rows = np.append(rows, count - 1) if rows[-1] != count - 1 else rows
    return time[rows], values[rows]
