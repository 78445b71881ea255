"""What is asked of a planner, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

__all__ = ["Plan", "Request"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Request:
    """What to plan for.

    Attributes
    ----------
    serial : counts tasks; a plan for an older one is of no use.
    task : what is asked.
    target : where, instead of the task's own target.
    offset : (6,) of the tip from the model, in m and rad (rotation vector), base axes.
    beside : (n,), by which the pressures that act differ from those that are commanded, in Pa.
    anew : whether all configurations are to be searched, as for a new target.
    """

    serial: int
    task: Task
    target: Target
    offset: Array
    beside: Array
    anew: bool = False


@dataclass(frozen=True)
class Plan:
    """Pressures for a target.

    Attributes
    ----------
    serial : of the request.
    pressures : (n,), in Pa.
    offset : (6,) that they count with.
    target : that they are for.
    reached : whether the model reaches it.
    stiffness : of the task's first direction; NaN where it names none.
    message : why it is not reached.
    """

    serial: int
    pressures: Array
    offset: Array
    target: Target
    reached: bool
    stiffness: float
    message: str
