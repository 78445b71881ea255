"""The plant: a simulated arm whose mechanics differ from the optimiser's model on purpose.

The rod has properties per reference length, and distributed weight, inertia, shear and stretch. Its
silicone is hyperelastic, creeps and has hysteresis. Pressure acts normal to the section, as the
force p A on each section at the chamber's centre, constant in the section's axes; it is conjugate
to the volume swept by a chamber of constant bore. (Acting along the chamber instead would change
the compliance of a bent arm by about 3 %.)

The channels behave according to the robot file: its history links the pressures in the chambers to
those that act, then its corrections apply. Silicone and mismatch come in addition.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, EquilibriumError, InputError, PressureError
from stiffopt.model.description import RobotDescription
from stiffopt.plant import contact, dynamics, material, rod
from stiffopt.plant.build import (
    draw,
    make_channels,
    make_material,
    make_memory,
    make_rod,
    node_at,
)
from stiffopt.plant.dynamics import RodState
from stiffopt.plant.jit import compiling_once
from stiffopt.plant.material import FibreMemory, Scheme
from stiffopt.plant.rod import RodLoads, contact_energy, contact_force, depth_of
from stiffopt.plant.settings import PlantLoad, PlantSettings

_STILL = 1e-3  # s, step for the stiffness against fast motions, without creep or slip


class SimulationError(DeviceError):
    """The simulation fails: a load or a pressure is far beyond the arm's strength."""


@dataclass(frozen=True)
class Energies:
    """Energies of the plant, in J."""

    kinetic: float  # of the motion
    elastic: float  # in the silicone, the springs of creep and hysteresis included
    gravity: float  # potential, zero where the arm's mass is at the base
    contact: float  # in the contact with the probe and with objects
    dissipated: float  # by viscosity, creep, hysteresis, impacts and friction so far
    work: float  # of the pressures so far
    load_work: float  # of the load's force and of the moving probe so far (moments are not counted)


class ObjectForce(NamedTuple):
    """The contact force of an object on the arm."""

    object: str  # its name
    force: Array  # on the arm (3,), in base axes, in N
    at: float  # arc length at rest of the middle of the contact, in m
    depth: float  # greatest depth of the body in the object, in m


@dataclass(frozen=True)
class Settling:
    """How `Plant.settle` follows a slow arm to rest: by steps of growing length."""

    # first, shortest, last: lengths of steps, in s: of the first; of the shortest one before it
    # gives up; and of the last one, after which viscosity has no effect any more
    first: float = 0.02
    shortest: float = 1e-6
    last: float = 1e9
    # growth, cut: factor on the next step after a success, and divisor after a failure
    growth: float = 3.0
    cut: float = 5.0
    tries: int = 400  # maximum number of steps
    # lower bound of the viscosity that slows the arm down, over the modulus, in s
    viscosity: float = 0.02


class Plant:
    """The simulated arm: chamber pressures in, poses out, step by step.

    `robot`: description of the arm. `settings`: how this arm differs, and how it is simulated.
    Raises `InputError`: the settings do not fit the robot; `MissingExtraError`: numba is not
    installed.
    """

    settling = Settling()

    def __init__(self, robot: RobotDescription, settings: PlantSettings | None = None) -> None:
        self.robot = robot
        self.settings = settings or PlantSettings()
        self.mismatch = draw(robot, self.settings)
        self._channels = make_channels(robot, self.mismatch)
        self._past = make_memory(robot)
        self._steps = 0
        self._load: PlantLoad | None = None
        self._plate: tuple[Array, float, float, float] | None = None
        self._material = make_material(robot, self.settings, self.mismatch, self._channels, 0.0)
        self._mesh(None)
        with compiling_once():
            self._state = self._at_rest()
            self.set_load(self.settings.load)
            self._tame()

    def _tame(self) -> None:
        """Set the viscosity for the required damping of the first bending mode, and settle."""
        self.settle(np.zeros(self.robot.n_pressures))
        wanted = self.settings.silicone.damping
        if wanted > 0:
            first = 2 * math.pi * float(self.modes(1)[0][0])
            self._material = self._material._replace(viscosity=2 * wanted / first)
            self.settle(np.zeros(self.robot.n_pressures))

    def _mesh(self, station: float | None) -> None:
        self._rod = make_rod(self.robot, self.settings, self.mismatch, station)
        self._around = contact.make_surroundings(self.settings.scene, self.robot, self._rod)

    def _at_rest(self) -> RodState:
        parts, n = self._material, self._rod.per_segment * self.robot.n_segments
        nodes = len(self._rod.mass)
        shape = (self.robot.n_segments, len(self._rod.weight), parts.fibre_x.shape[1])
        state = RodState(
            q=np.zeros(n),
            momentum=np.zeros(n),
            rate=np.zeros(n),
            last_rate=np.zeros(n),
            rotations=np.empty((nodes, 3, 3)),
            positions=np.empty((nodes, 3)),
            inverse=np.zeros((n, n)),
            tangent_of=np.zeros(2),
            totals=np.zeros(4),
            memory=FibreMemory(
                strain=np.zeros(shape),
                creep=np.zeros((*shape[:2], len(parts.creep_share), shape[2])),
                slip=np.zeros((*shape[:2], len(parts.slip_share), shape[2])),
            ),
            grip=np.zeros((len(self._around.kind), len(self._around.at), 3)),
        )
        rod.poses(self._rod, state.q, state.rotations, state.positions)
        return state

    @property
    def step(self) -> float:
        """Step in time, in s."""
        return self.settings.discretisation.step

    @property
    def time(self) -> float:
        """Time since the plant was made, in s."""
        return self._steps * self.step

    def tip_pose(self) -> Array:
        """Pose of the tip (4, 4) in the nominal base frame."""
        return self.poses()[-1]

    def poses(self) -> Array:
        """Poses (m, 4, 4) of the nodes from the base to the tip, in the nominal base frame."""
        T = np.tile(np.eye(4), (len(self._state.positions), 1, 1))
        T[:, :3, :3] = self._state.rotations
        T[:, :3, 3] = self._state.positions
        return T

    def set_load(self, load: PlantLoad | None) -> None:
        """Apply a wrench from now on, or none. Raises `InputError`: the load is not on the arm."""
        station = None if load is None else load.at
        if station != (None if self._load is None else self._load.at):
            self._mesh(station)
            nodes = len(self._rod.mass)
            self._state = self._state._replace(
                rotations=np.empty((nodes, 3, 3)), positions=np.empty((nodes, 3))
            )
            rod.poses(self._rod, self._state.q, self._state.rotations, self._state.positions)
        self._load = load
        self._state.tangent_of[:] = 0.0

    def set_plate(
        self,
        normal: ArrayLike | None,
        at: float = 0.0,
        stiffness: float = 0.0,
        speed: float = 0.0,
    ) -> None:
        """Place the flat plate of a probe, or take it away.

        Parameters
        ----------
        normal : unit vector (3,) in the base frame from the probe towards the tip; None: no plate.
        at : position of the plate along it, in m: it touches a tip that is less far along.
        stiffness : of the contact, in N/m.
        speed : speed of the plate while time passes next, in m/s.
        """
        self._plate = None if normal is None else (np.array(normal, float), at, speed, stiffness)

    def contact_force(self) -> float:
        """Return the force of the plate on the tip, in N."""
        loads = self._loads()
        return float(contact_force(loads, depth_of(loads, self._state.positions[-1])))

    def object_forces(self) -> tuple[ObjectForce, ...]:
        """Return the force of each object of the scene that touches the arm now."""
        scene, state = self.settings.scene, self._state
        forces = contact.no_forces(self._around)
        R, r = state.rotations, state.positions
        contact.touch(self._around, R, r, R, r, state.grip, True, forces)
        rows = zip(forces.force, forces.middle, forces.deepest, strict=True)
        return tuple(
            ObjectForce(item.name, force, float(middle), float(deepest))
            for item, (force, middle, deepest) in zip(
                () if scene is None else scene.objects, rows, strict=True
            )
            if deepest > 0
        )

    def advance(self, duration: float, pressures: ArrayLike) -> None:
        """Advance time at constant pressures in the chambers.

        `duration`: in s; rounded to whole steps. `pressures`: gauge pressures (n,), in Pa. Raises
        `SimulationError`: the simulation fails.
        """
        steps = round(duration / self.step)
        self.follow(np.tile(self._checked(pressures), (steps, 1)))

    def follow(self, pressures: Array) -> None:
        """Take one step at each row of chamber pressures (m, n), in Pa.

        Raises `SimulationError`: the simulation fails; the state is that before the failure.
        """
        full = self.settings.dynamics == "full"
        scheme = Scheme(self.step, 0.5 if full else 1.0, True)
        before, effective = copy.copy(self._past), pressures
        if self._past is not None:
            effective = self._past.run(self.step, pressures)
        done = dynamics.run(
            self._rod,
            self._around,
            self._material,
            scheme,
            self._loads(),
            full,
            self._state,
            self._acting(effective),
        )
        self._steps += int(done)
        if done < len(pressures):
            if before is not None:
                before.run(self.step, pressures[:done])
                self._past = before
            raise SimulationError(
                f"the simulated arm cannot be followed beyond {self.time:.3f} s: a load, a contact "
                "or a pressure is far beyond what it bears, or the time step is too long"
            )

    def skip(self, duration: float) -> None:
        """Skip a time in which nothing happens, in s; rounded down to whole steps."""
        self._steps += int(duration / self.step)

    def settle(self, pressures: ArrayLike, load: PlantLoad | None = None) -> None:
        """Bring the arm to equilibrium at rest, with its silicone's creep done and no hysteresis.

        A history in the robot file, by contrast, restarts with a rise from no pressure to these,
        see `stiffopt.model.history.Memory.start`.

        `pressures`: in the chambers (n,), in Pa. `load`: replaces the present one from now on, if
        given. Raises `EquilibriumError`: a slow arm would reach no equilibrium.
        """
        if load is not None:
            self.set_load(load)
        p = self._checked(pressures)
        if self._past is not None:
            self._past.start(p)
            p = self._past.effective
        acting = self._acting(p[None, :])
        # Viscosity slows down an arm without inertia: steps of growing length follow it to rest.
        settling = self.settling
        slow = self._material._replace(viscosity=max(self._material.viscosity, settling.viscosity))
        self._state.rate[:] = 0.0
        self._state.last_rate[:] = 0.0
        step = settling.first
        for _ in range(settling.tries):
            scheme = Scheme(step, 1.0, False)
            args = (self._rod, self._around, slow, scheme, self._loads(), False, self._state)
            self._state.tangent_of[:] = 0.0
            if dynamics.run(*args, acting):
                if step >= settling.last:
                    break
                step *= settling.growth
            else:
                step /= settling.cut
                if step < settling.shortest:
                    raise EquilibriumError("the simulated arm finds no equilibrium")
            self._state.rate[:] = 0.0
            self._state.last_rate[:] = 0.0
        else:
            raise EquilibriumError("the simulated arm finds no equilibrium")
        self._state.momentum[:] = 0.0
        self._state.tangent_of[:] = 0.0
        self._state.totals[:3] = 0.0

    def energies(self) -> Energies:
        """Return the present energies."""
        state, mass = self._state, self._mass()
        speed = np.linalg.solve(mass, state.momentum)
        weight = np.zeros(3)
        for m, R, r in zip(self._rod.mass, state.rotations, state.positions, strict=True):
            weight += m[0, 0] * r + R[:, :2] @ m[0, 1:]
        loads = self._loads()
        depth = depth_of(loads, state.positions[-1])
        return Energies(
            kinetic=0.5 * float(state.momentum @ speed),
            elastic=float(
                material.stored(self._rod, self._material, state.memory, self._last_acting, state.q)
            ),
            gravity=-float(self._rod.gravity @ weight),
            contact=float(contact_energy(loads, depth) + state.totals[3]),
            dissipated=float(state.totals[0]),
            work=float(state.totals[1]),
            load_work=float(state.totals[2]),
        )

    def modes(self, count: int = 6) -> tuple[Array, Array]:
        """Return natural frequencies and damping of small vibrations about the present state.

        Returns
        -------
        Frequencies (k,) in Hz, the lowest first, of the undamped arm (springs of creep and
        hysteresis count as stiff), and shares of critical damping (k,) by viscosity.
        """
        still = self._material._replace(viscosity=0.0)
        viscous = self._material._replace(viscosity=self._material.viscosity + 1e-12)
        scheme = Scheme(_STILL, 1.0, True)
        K = self._tangent(still, scheme)
        C = (self._tangent(viscous, scheme) - K) * _STILL
        half = np.linalg.inv(np.linalg.cholesky(self._mass()))
        squares, shapes = np.linalg.eigh(half @ (0.5 * (K + K.T)) @ half.T)
        if squares[0] <= 0:
            raise EquilibriumError("the simulated arm does not rest in a stable equilibrium")
        omega = np.sqrt(squares[:count])
        damped = np.einsum("ik,ij,jk->k", shapes, half @ C @ half.T, shapes)[:count]
        return omega / (2 * math.pi), damped / (2 * omega)

    def _tangent(self, parts: material.SectionMaterial, scheme: Scheme) -> Array:
        """Return the derivative (n, n) of the imbalance without inertia by the end of a step."""
        q, n = self._state.q.copy(), len(self._state.q)
        work = dynamics.make_work(n, len(self._state.positions), self._around)
        K, high, low = np.empty((n, n)), np.empty(n), np.empty(n)
        step = dynamics.Step(
            self._rod, self._around, parts, scheme, self._loads(), False, self._last_acting
        )
        for k in range(n):
            nudge = dynamics.NUDGE / dynamics.in_strain(self._rod, k)
            q[k] = self._state.q[k] + nudge
            dynamics.residual(step, self._state, work, q, high)
            q[k] = self._state.q[k] - nudge
            dynamics.residual(step, self._state, work, q, low)
            q[k] = self._state.q[k]
            K[:, k] = (high - low) / (2 * nudge)
        return K

    def _mass(self) -> Array:
        n = len(self._state.q)
        J, M = np.empty((len(self._rod.mass), n, 6)), np.empty((n, n))
        rod.jacobians(self._rod, self._state.q, J)
        rod.mass_matrix(self._rod, self._state.rotations, J, M)
        return M

    def _loads(self) -> RodLoads:
        load, plate = self._load, self._plate
        last = len(self._rod.mass) - 1
        normal, at, speed, stiffness = (np.zeros(3), 0.0, 0.0, 0.0) if plate is None else plate
        node, lever, force, moment, follows = last, 0.0, np.zeros(3), np.zeros(3), False
        if load is not None:
            if load.at is not None:
                node, lever = node_at(self.robot, self._rod, load.at)
            force, moment = np.array(load.force), np.array(load.moment)
            follows = load.frame == "tip"
        return RodLoads(node, lever, force, moment, follows, normal, at, speed, stiffness)

    def _checked(self, pressures: ArrayLike) -> Array:
        p = np.array(pressures, dtype=float)
        if p.shape != (self.robot.n_pressures,):
            raise InputError(f"expected {self.robot.n_pressures} pressures, not {p.shape}")
        if not np.isfinite(p).all():
            raise PressureError("the pressures are not finite")
        return p

    def _acting(self, effective: Array) -> Array:
        acting = self._channels.acting(effective)
        if len(acting):
            self._last_acting = acting[-1]
        return acting
