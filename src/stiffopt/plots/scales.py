"""Logarithmic scales that people can read: few ticks, plain numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def round_steps(low: float, high: float, most: int = 8) -> NDArray[np.float64]:
    """Round numbers between two positive ones, evenly spread on a logarithmic scale."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    found: list[float] = []
    for steps in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), tuple(np.arange(10, 100, 5) / 10)):
        ticks = [float(step) * 10.0**decade for decade in decades for step in steps]
        ticks = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
        if len(found) >= 2 and len(ticks) > most:
            break
        found = ticks
    return np.array(found)


def make_logarithmic(axes: Any) -> None:
    """Give the vertical axis of a panel, whose limits are set, a logarithmic scale."""
    axes.set_yscale("log")
    label_logarithmic(axes.yaxis, *axes.get_ylim())


def label_logarithmic(axis: Any, low: float, high: float) -> None:
    """Put plain round numbers on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator

    axis.set_major_locator(FixedLocator(list(round_steps(low, high))))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _: f"{value:.3g}")
