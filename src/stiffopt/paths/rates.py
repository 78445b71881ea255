"""Limits on the rates of pressures, and the step sizes and times that follow from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.model.description import RobotDescription

Vector = NDArray[np.float64]


def slew_limits(
    description: RobotDescription, path_slew: float | tuple[float, ...] | None = None
) -> Vector | None:
    """Return the largest rates (n,) of a robot's channels, in Pa/s.

    They are the smaller of the robot's and those of a path, (n,) or one for all; None if neither
    gives any.
    """
    known = [rates for rates in (description.pressure_slew, path_slew) if rates is not None]
    if not known:
        return None
    rows = [np.broadcast_to(np.asarray(rates, float), description.n_pressures) for rates in known]
    smallest: Vector = np.min(rows, axis=0)
    return smallest


def least_times(pressures: ArrayLike, slew: ArrayLike) -> Vector:
    """Return the shortest times (N - 1,) between pressures (N, n) in Pa, at rates (n,) in Pa/s.

    In s: ``max_i |p_{k+1,i} - p_{k,i}| / slew_i``.
    """
    steps = np.abs(np.diff(np.asarray(pressures, float), axis=0))
    times: Vector = (steps / np.asarray(slew, float)).max(axis=1)
    return times


def step_limits(times: ArrayLike, slew: ArrayLike) -> Vector:
    """Return the largest changes (N - 1, n) in Pa between times (N,) in s at rates (n,) in Pa/s."""
    return np.outer(np.diff(np.asarray(times, float)), np.asarray(slew, float))
