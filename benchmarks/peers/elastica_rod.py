"""PyElastica: static shape of the arm at rest under a tip load, by dynamic relaxation.

The rod has the arm's length and, set directly, its section stiffnesses: ``G A`` and ``E A`` in
shear and stretch, ``E I`` and ``2 G I`` in bending and torsion, with the compensated A and I.
(PyElastica lets bending stiffness fall with stretch, which the paper's law does not; at rest
and under a sideways load the stretch is below 1e-3.) What is static does not depend on density,
and damping is chosen for speed: `uniform_damping_constant`, critical for the slowest bending
mode of the straight rod. (The older keyword `damping_constant` is deprecated, and freezes the
rotations of a rod this small.) The time step is 0.4 of the shortest element over the speed of
sound.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from peers import paper
from peers.base import Peer, Vector

DENSITY = 1070.0
_COURANT = 0.4
_PERIODS = 3.0  # of the slowest mode, simulated
_CHECKS = 200


@dataclass(frozen=True)
class Relaxation:
    """What one relaxation showed.

    Attributes
    ----------
    tip : (3,) where it ended, in m.
    drift : how far the tip still moved in the last tenth of the simulated time, in m.
    seconds : until the tip stayed within the accuracy of where it ended.
    steps : time steps until then.
    """

    tip: Vector
    drift: float
    seconds: float
    steps: int


class Elastica(Peer):
    """One Cosserat rod, clamped at the base."""

    name: ClassVar[str] = "PyElastica"
    distributions: ClassVar[tuple[str, ...]] = ("pyelastica",)

    def __init__(self, segments: int, elements_per_segment: int = 20) -> None:
        super().__init__(segments)
        import elastica

        self._elastica = elastica
        self.length = segments * paper.LENGTH
        self.elements = elements_per_segment * segments
        self.settle(np.array([1e-3, 0, 0]), 1e-4, periods=0.01)  # compiles

    def settle(self, force: Vector, accuracy: float, periods: float = _PERIODS) -> Relaxation:
        """Relax from straight under a dead force (3,) at the tip; accuracy in m."""
        rod, simulator, dt, steps = self._rod(force, periods)
        stepper = self._elastica.PositionVerlet()
        per_check = max(1, steps // _CHECKS)
        time, done, begin = np.float64(0.0), 0, perf_counter()
        tips, clock = [rod.position_collection[:, -1].copy()], [0.0]
        while done < steps:
            for _ in range(per_check):
                time = stepper.step(simulator, time, dt)
            done += per_check
            tips.append(rod.position_collection[:, -1].copy())
            clock.append(perf_counter() - begin)
        away = np.linalg.norm(np.array(tips) - tips[-1], axis=1)
        late = np.flatnonzero(away > accuracy)
        first = int(late[-1]) + 1 if len(late) else 0
        return Relaxation(
            tips[-1], float(away[-len(away) // 10 :].max()), clock[first], first * per_check
        )

    def _rod(self, force: Vector, periods: float) -> tuple[Any, Any, np.float64, int]:
        elastica = self._elastica

        class Simulator(
            elastica.BaseSystemCollection,
            elastica.Constraints,
            elastica.Forcing,
            elastica.Damping,
        ):
            pass

        rod = elastica.CosseratRod.straight_rod(
            self.elements, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]),
            self.length, paper.OUTER, DENSITY, youngs_modulus=paper.E0,
            shear_modulus=paper.E0 / (2 * (1 + paper.POISSON)),
        )  # fmt: skip
        E, G = paper.E0, paper.E0 / (2 * (1 + paper.POISSON))
        stretch = np.diag([G * paper.AREA, G * paper.AREA, E * paper.AREA])
        bend = np.diag([E, E, 2 * G]) * paper.INERTIA
        rod.shear_matrix[:] = stretch[:, :, None]
        rod.bend_matrix[:] = bend[:, :, None]
        mass_per_length = float(rod.mass.sum()) / self.length
        slowest = 3.516 * np.sqrt(E * paper.INERTIA / mass_per_length) / self.length**2
        sound = np.sqrt(E * paper.AREA / mass_per_length)
        dt = np.float64(_COURANT * self.length / self.elements / sound)
        simulator = Simulator()
        simulator.append(rod)
        simulator.constrain(rod).using(
            elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        simulator.add_forcing_to(rod).using(
            elastica.EndpointForces, np.zeros(3), np.asarray(force, dtype=float), ramp_up_time=1e-9
        )
        simulator.dampen(rod).using(
            elastica.AnalyticalLinearDamper, uniform_damping_constant=2 * slowest, time_step=dt
        )
        simulator.finalize()
        return rod, simulator, dt, max(1, int(periods * 2 * np.pi / slowest / dt))
