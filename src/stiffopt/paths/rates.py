"""The step sizes and times that follow from the limits on the rates of pressures."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array


def least_times(pressures: ArrayLike, slew: ArrayLike) -> Array:
    """Return the shortest times (N - 1,) between pressures (N, n) in Pa, at rates (n,) in Pa/s.

    In s: ``max_i |p_{k+1,i} - p_{k,i}| / slew_i``.
    """
    steps = np.abs(np.diff(np.asarray(pressures, float), axis=0))
    return (steps / np.asarray(slew, float)).max(axis=1)


def step_limits(times: ArrayLike, slew: ArrayLike) -> Array:
    """Return the largest changes (N - 1, n) in Pa between times (N,) in s at rates (n,) in Pa/s."""
    return np.outer(np.diff(np.asarray(times, float)), np.asarray(slew, float))
