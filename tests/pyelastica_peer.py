"""PyElastica as a peer of the simulated arm: the static tip, by dynamic relaxation.

The section's constants are set by hand, so that rod and arm agree in all but their mechanics.
Two differences remain: PyElastica's bending stiffness falls with stretch, and its joints lie
between elements, so that the outermost half elements would not bend; the first and the last
joint are made as soft as the rod that they stand for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import elastica
import numpy as np
from numpy.typing import NDArray

from references import Beam

Vector = NDArray[np.float64]

_COURANT = 0.4
_NEVER = 1e-9  # s; ramp


@dataclass(frozen=True)
class Relaxed:
    """Where a rod came to rest.

    Attributes
    ----------
    tip : (3,) in m.
    drift : how far the tip still moved in the last tenth of the simulated time, in m.
    """

    tip: Vector
    drift: float


class _TipMoment(elastica.NoForces):
    """A moment at the tip that keeps its direction."""

    def __init__(self, moment: Sequence[float]) -> None:
        super().__init__()
        self.moment = np.array(moment, dtype=float)

    def apply_torques(self, system: Any, time: float = 0.0) -> None:
        system.external_torques[:, -1] += system.director_collection[:, :, -1] @ self.moment


class _Simulator(
    elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping
):
    pass


def relax(
    section: Beam,
    length: float,
    *,
    tip_mass: float = 0.0,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    force: Sequence[float] = (0.0, 0.0, 0.0),
    moment: Sequence[float] = (0.0, 0.0, 0.0),
    elements: int = 30,
    periods: float = 2.5,
) -> Relaxed:
    """Let a rod along z, clamped at the origin, come to rest under dead loads.

    It runs for so many periods of the slowest bending mode of the straight rod, for which it is
    critically damped.
    """
    rod = elastica.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]),
        length, np.sqrt(section.mass / 1000 / np.pi), 1000.0, youngs_modulus=1e5,
        shear_modulus=3e4,
    )  # fmt: skip
    rod.shear_matrix[:] = section.stiffness[:3, :3, np.newaxis]
    rod.bend_matrix[:] = section.stiffness[3:, 3:, np.newaxis]
    rod.bend_matrix[..., [0, -1]] *= 2 / 3
    rod.mass[-1] += tip_mass
    heavy = section.mass * length + 4 * tip_mass
    slowest = 3.5 * np.sqrt(section.bending / (heavy * length**3))
    dt = np.float64(_COURANT * length / elements / np.sqrt(section.axial / section.mass))
    simulator = _Simulator()
    simulator.append(rod)
    simulator.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    add = simulator.add_forcing_to
    add(rod).using(elastica.GravityForces, acc_gravity=np.array(gravity, dtype=float))
    add(rod).using(
        elastica.EndpointForces, np.zeros(3), np.array(force, dtype=float), ramp_up_time=_NEVER
    )
    add(rod).using(_TipMoment, moment)
    simulator.dampen(rod).using(
        elastica.AnalyticalLinearDamper, uniform_damping_constant=2 * slowest, time_step=dt
    )
    simulator.finalize()
    return _run(simulator, rod, dt, int(periods * 2 * np.pi / slowest / dt))


def _run(simulator: Any, rod: Any, dt: np.float64, steps: int) -> Relaxed:
    stepper, time, late = elastica.PositionVerlet(), np.float64(0.0), []
    for step in range(steps):
        time = stepper.step(simulator, time, dt)
        if step >= 0.9 * steps:
            late.append(rod.position_collection[:, -1].copy())
    return Relaxed(late[-1], float(np.linalg.norm(np.array(late) - late[-1], axis=1).max()))
