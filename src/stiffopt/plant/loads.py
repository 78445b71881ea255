"""What pushes on the rod from outside: weight, a wrench somewhere, the plate of a probe."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from stiffopt.plant.jit import jit
from stiffopt.plant.rod import Rod

Array = Any

_SOFT = 1e-6  # m, over which contact sets in: a kink would upset Newton's method


class Loads(NamedTuple):
    """What pushes on the arm.

    Attributes
    ----------
    node : on which the wrench acts.
    lever : how far beyond the node along its z axis, on a connector, m.
    force, moment : (3,), N and N m.
    follows : whether they turn with the node's section.
    plate : unit normal of the probe's plate (3,), from the probe towards the tip.
    plate_at : where the plate is along its normal, m.
    plate_speed : at which it moves, m/s.
    plate_stiffness : N/m; 0 where there is no plate.
    """

    node: int
    lever: float
    force: Array
    moment: Array
    follows: bool
    plate: Array
    plate_at: float
    plate_speed: float
    plate_stiffness: float


@jit
def loads_after(loads: Loads, duration: float) -> Loads:
    """Loads after some time: the plate moves."""
    return Loads(
        loads.node,
        loads.lever,
        loads.force,
        loads.moment,
        loads.follows,
        loads.plate,
        loads.plate_at + duration * loads.plate_speed,
        loads.plate_speed,
        loads.plate_stiffness,
    )


@jit
def depth_of(loads: Loads, tip: Array) -> float:
    """How far the tip is behind the plate's face, m; negative where it is clear of it."""
    along: float = loads.plate[0] * tip[0] + loads.plate[1] * tip[1] + loads.plate[2] * tip[2]
    return loads.plate_at - along


@jit
def contact_force(loads: Loads, depth: float) -> float:
    """Force of the plate on the tip at some depth, N: ``k max(depth, 0)``, rounded at 0."""
    if loads.plate_stiffness == 0:
        return 0.0
    rounded: float = 0.5 * loads.plate_stiffness * (depth + math.hypot(depth, _SOFT))
    return rounded


@jit
def contact_energy(loads: Loads, depth: float) -> float:
    """Integral of `contact_force`, J, but for a constant."""
    around = math.hypot(depth, _SOFT)
    energy: float = depth * (depth + around) + _SOFT**2 * math.asinh(depth / _SOFT)
    return 0.25 * loads.plate_stiffness * energy


@jit
def external_forces(rod: Rod, loads: Loads, R: Array, r: Array, J: Array, out: Array) -> None:
    """Generalised forces (n,) of gravity and wrench."""
    n = len(out)
    last = len(r) - 1
    out[:] = 0.0
    wrench, down = np.empty(6), np.empty(3)
    for node in range(1, last + 1):
        turn = R[node]
        mass, mx, my = rod.mass[node, 0, 0], rod.mass[node, 0, 1], rod.mass[node, 0, 2]
        for i in range(3):
            down[i] = 0.0
            for j in range(3):
                down[i] += turn[j, i] * rod.gravity[j]
            wrench[i] = mass * down[i]
        wrench[3] = my * down[2]
        wrench[4] = -mx * down[2]
        wrench[5] = mx * down[1] - my * down[0]
        if node == loads.node:
            for i in range(3):
                down[i] = 0.0
                for j in range(3):
                    along = (1.0 if i == j else 0.0) if loads.follows else turn[j, i]
                    down[i] += along * loads.force[j]
                    wrench[3 + i] += along * loads.moment[j]
                wrench[i] += down[i]
            wrench[3] -= loads.lever * down[1]
            wrench[4] += loads.lever * down[0]
        for k in range(n):
            total = 0.0
            for i in range(6):
                total += J[node, k, i] * wrench[i]
            out[k] += total


@jit
def add_contact(loads: Loads, depth: float, R: Array, J: Array, out: Array) -> None:
    """Add the plate's generalised forces (n,) on the tip, with axes R (3, 3) and Jacobian J."""
    push = contact_force(loads, depth)
    if push == 0:
        return
    for i in range(3):
        along = push * (
            R[0, i] * loads.plate[0] + R[1, i] * loads.plate[1] + R[2, i] * loads.plate[2]
        )
        for k in range(len(out)):
            out[k] += J[k, i] * along
