"""A request for a plan, and the plan that answers it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted, Estimate, Window
from stiffopt.control.vibration import BentMode
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.leaning import BraceApproach


@dataclass(frozen=True)
class PlanRequest:
    """Everything that a plan depends on."""

    serial: int  # number of the task; a plan for an earlier one is discarded
    task: Task | None  # stiffness goal and limits; None: only check the way
    target: Target | None  # replaces the task's own
    offset: Array  # tip pose relative to the model's (6,), m and rad (rotation vector), base axes
    pressure_offset: Array  # effective pressures relative to commands (n,), in Pa
    search: bool = False  # whether to search all configurations, as for a new target
    # lowest and highest effective pressures (n,) that the channels can have, in Pa, within the
    # task's limits; empty: the task's limits
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    # with a scene: effective pressures (k, n) on the way to the plan, in Pa
    way: Array = field(default_factory=lambda: np.zeros((0, 0)))
    last: Plan | None = None  # replaces the planner's own last plan
    windows: tuple[Window, ...] = ()  # of the tip at rest, for adaptation
    adapted: Adapted | None = None  # the model that the offset refers to; None: the robot file's
    stay: bool = False  # whether to follow the target by the least change of the last pressures
    step: float = math.inf  # largest change of a pressure from the last plan, in Pa
    # effective pressures (n,) of the reference now, in Pa, of an arm that vibrates: its modes there
    # are wanted, and a new target is reached from there by the least motion; empty: neither
    here: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Plan:
    """Pressures for a target; serial, offset and target are those of the request."""

    serial: int
    pressures: Array  # effective (n,), in Pa
    offset: Array  # of the tip (6,), for which the plan was made
    target: Target | None
    reached: bool  # whether the model reaches the target, here or in a distant configuration
    stiffness: float  # along the task's first direction; NaN if it has none
    message: str  # how far the model's tip is from a target that it does not have, or has left
    blocked: str = ""  # why the way to the plan is not clear of the scene
    doubt: str = ""  # a warning if the model extrapolates there
    # whether it is the pose that is not reached, not only the stiffness, or that has been left for
    # other pressures that reach it
    far: bool = False
    # from its tip to the target, in m, of a plan that follows a target by the least change
    short: tuple[float, ...] = (0.0, 0.0, 0.0)
    adapted: Adapted | None = None  # the model that it was made with, as in the request
    deviation: float = math.nan  # of the stiffness there, relative
    estimate: Estimate | None = None  # of the model's numbers, if it is new
    approach: BraceApproach | None = None  # from rest until the arm leans on objects there
    bent: BentMode | None = None  # modes at the request's `here`, if they are new
    # effective pressures (n,), in Pa, that bring the tip to its target first, while plans lead from
    # there to the stiffest ones; empty otherwise
    tip_first: tuple[float, ...] = ()
