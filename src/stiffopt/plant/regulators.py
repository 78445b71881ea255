"""The pressure regulators, one per channel: from set-points to the pressure in the chambers."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from stiffopt.plant.jit import jit

Array = Any

_EMPTYING = 0.02  # s; time constant with which a chamber empties through the dump valve


class Regulators(NamedTuple):
    """What regulators do, for n channels.

    Attributes
    ----------
    step : of time, s.
    lag, slew, saturation : (n,), s, Pa/s and Pa.
    leak : share of the pressure that a leak takes per second (n,).
    held : pressure at which a regulator is stuck (n,), Pa; NaN where it is not.
    dumped : whether the dump valve is open.
    """

    step: float
    lag: Array
    slew: Array
    saturation: Array
    leak: Array
    held: Array
    dumped: bool


@jit
def regulate(
    regulators: Regulators,
    delayed: Array,
    first: int,
    set_point: Array,
    pressure: Array,
    ripple: Array,
    trace: Array,
) -> int:
    """Let the regulators work for a number of steps.

    Parameters
    ----------
    regulators :
        What they do.
    delayed :
        Set-points that have not reached the regulators yet (d, n), a ring.
    first :
        Place in the ring of the oldest.
    set_point :
        The newest (n,).
    pressure :
        In the chambers (n,), without ripple; it is changed.
    ripple :
        To be added at each step (m, n).
    trace :
        Becomes the pressure midway through each step (m, n).

    Returns
    -------
    Place in the ring of the oldest set-point afterwards.
    """
    h = regulators.step
    depth = len(delayed)
    emptying = 1 - math.exp(-h / _EMPTYING)
    for i in range(len(trace)):
        for c in range(len(pressure)):
            wanted = set_point[c]
            if depth > 0:
                wanted, delayed[first, c] = delayed[first, c], wanted
            before = pressure[c]
            if not math.isnan(regulators.held[c]):
                wanted = regulators.held[c]
            wanted = min(wanted, regulators.saturation[c])
            change = wanted - before
            if regulators.lag[c] > 0:
                change *= 1 - math.exp(-h / regulators.lag[c])
            limit = regulators.slew[c] * h
            change = min(max(change, -limit), limit)
            change -= (1 - math.exp(-regulators.leak[c] * h)) * before
            if regulators.dumped:
                change = -emptying * before
            pressure[c] = before + change
            trace[i, c] = before + 0.5 * change + ripple[i, c]
        if depth > 0:
            first = (first + 1) % depth
    return first
