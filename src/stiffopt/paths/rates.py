"""Limits on the rates of pressures, and the step sizes and times that follow from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.model.description import RobotDescription

Vector = NDArray[np.float64]


def slew_limits(
    description: RobotDescription, path_slew: float | tuple[float, ...] | None = None
) -> Vector | None:
    """Return the largest rate of change of each channel.

    Parameters
    ----------
    description :
        The robot, with n channels.
    path_slew : float or (n,), optional
        Of a path, in Pa/s.

    Returns
    -------
    (n,) array or None
        The smaller of the robot's and the path's, in Pa/s; None if neither gives one.
    """
    known = [rates for rates in (description.pressure_slew, path_slew) if rates is not None]
    if not known:
        return None
    rows = [np.broadcast_to(np.asarray(rates, float), description.n_pressures) for rates in known]
    smallest: Vector = np.min(rows, axis=0)
    return smallest


def least_times(pressures: ArrayLike, slew: ArrayLike) -> Vector:
    """Return the shortest time of each step between pressures.

    Parameters
    ----------
    pressures : (N, n)
        In Pa.
    slew : (n,)
        Largest rates, in Pa/s.

    Returns
    -------
    (N - 1,) array
        In s: ``max_i |p_{k+1,i} - p_{k,i}| / slew_i``.
    """
    steps = np.abs(np.diff(np.asarray(pressures, float), axis=0))
    times: Vector = (steps / np.asarray(slew, float)).max(axis=1)
    return times


def step_limits(times: ArrayLike, slew: ArrayLike) -> Vector:
    """Return the largest change of each pressure between consecutive times.

    Parameters
    ----------
    times : (N,)
        In s, increasing.
    slew : (n,)
        Greatest rates, in Pa/s.

    Returns
    -------
    (N - 1, n) array
        In Pa.
    """
    return np.outer(np.diff(np.asarray(times, float)), np.asarray(slew, float))
