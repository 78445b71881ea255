"""The rod under load as a symbolic shooting problem.

For dead loads the internal force is known everywhere in base axes, and at the tip the internal
wrench equals the applied one; the only unknown there is the tip's orientation.  The equations
of a geometrically exact rod are therefore integrated from the tip to the base,

    q' = -q (0, u) / 2,   r' = -R v,   m' = R v x n + R c x f,   n(tau) = n_tip + f tau,
    (v, u) = strain(p) + C(p) (R^T n, R^T m),

(tau: reference length from the tip, n and m: force and moment that the distal part exerts,
f: weight per length, c: centroid).  The correct orientation is the one for which the base does not
rotate: **three** unknowns for any number of segments, for dead and follower loads alike.
All derivatives follow from the same map by the implicit function theorem.

The integrator is the eleven-stage Runge-Kutta method of order eight of Cooper and Verner
(SIAM J. Numer. Anal. 9, 1972).

Stability under conservative loads is Jacobi's condition: the energy is at a minimum if and only
if no shorter arm, clamped anywhere between tip and base, is at the point of buckling.  At that
point a moment at the tip turns it without bound, and beyond it turns it the opposite way.  So
the rotational compliance of every shorter arm must be positive definite.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import ceil, sqrt

import casadi as ca

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.compliance import inverse_3x3
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation
from stiffopt.model.segment import Segment
from stiffopt.model.shape import PointOfArm

_ROOT = sqrt(21)
_STAGES: tuple[dict[int, float], ...] = (
    {},
    {0: 1 / 2},
    {0: 1 / 4, 1: 1 / 4},
    {0: 1 / 7, 1: (-7 - 3 * _ROOT) / 98, 2: (21 + 5 * _ROOT) / 49},
    {0: (11 + _ROOT) / 84, 2: (18 + 4 * _ROOT) / 63, 3: (21 - _ROOT) / 252},
    {
        0: (5 + _ROOT) / 48,
        2: (9 + _ROOT) / 36,
        3: (-231 + 14 * _ROOT) / 360,
        4: (63 - 7 * _ROOT) / 80,
    },
    {
        0: (10 - _ROOT) / 42,
        2: (-432 + 92 * _ROOT) / 315,
        3: (633 - 145 * _ROOT) / 90,
        4: (-504 + 115 * _ROOT) / 70,
        5: (63 - 13 * _ROOT) / 35,
    },
    {0: 1 / 14, 4: (14 - 3 * _ROOT) / 126, 5: (13 - 3 * _ROOT) / 63, 6: 1 / 9},
    {
        0: 1 / 32,
        4: (91 - 21 * _ROOT) / 576,
        5: 11 / 72,
        6: (-385 - 75 * _ROOT) / 1152,
        7: (63 + 13 * _ROOT) / 128,
    },
    {
        0: 1 / 14,
        4: 1 / 9,
        5: (-733 - 147 * _ROOT) / 2205,
        6: (515 + 111 * _ROOT) / 504,
        7: (-51 - 11 * _ROOT) / 56,
        8: (132 + 28 * _ROOT) / 245,
    },
    {
        4: (-42 + 7 * _ROOT) / 18,
        5: (-18 + 28 * _ROOT) / 45,
        6: (-273 - 53 * _ROOT) / 72,
        7: (301 + 53 * _ROOT) / 72,
        8: (28 - 28 * _ROOT) / 45,
        9: (49 - 7 * _ROOT) / 18,
    },
)
_WEIGHTS: dict[int, float] = {0: 1 / 20, 7: 49 / 180, 8: 16 / 45, 9: 49 / 180, 10: 1 / 20}
LOBATTO = (0.0, (7 - _ROOT) / 14, 0.5, (7 + _ROOT) / 14, 1.0)
"""Places within a step of the stages that have a weight."""

STEP_LENGTH = 2.0
"""Longest integration step at resolution 1, in outer radii of the segment at rest."""

SAME_STATION = 1e-12
"""Arc lengths that differ by less than this share of the arm's length are the same station."""


@dataclass(frozen=True)
class RodStretch:
    """A piece of arm between two stations, integrated in equal steps from tip to base."""

    segment: int
    rigid: bool
    length: float
    steps: int
    distal: float  # arc length at rest of its far end, from the base


def slopes(
    q: ca.SX,
    m: ca.SX,
    force: ca.SX,
    weight: ca.SX,
    strain: ca.SX,
    compliance: ca.SX,
    centroid: ca.SX | Array,
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the right-hand sides q', tangent -r', and m' of the rod's equations, per length."""
    R = lie.rotation_from_quaternion(q)
    xi = strain + compliance @ ca.vertcat(R.T @ force, R.T @ m)
    tangent = R @ xi[:3]
    moment = ca.cross(tangent, force)
    centroid = ca.SX(centroid)
    if not centroid.is_zero():
        moment += ca.cross(R @ ca.vertcat(centroid, 0), weight)
    return -0.5 * lie.quaternion_product(q, ca.vertcat(0, xi[3:])), tangent, moment


def _step_functions(sparsity: ca.Sparsity, centroid: Array) -> tuple[ca.Function, ca.Function]:
    """Return one integration step of length h towards the base, (10,) to (10,), and its notes.

    See `Stretch` for the notes.
    """
    start = ca.SX.sym("y", 10)  # q (4), r (3), m (3)
    strain = ca.SX.sym("strain", 6)
    compliance = ca.SX.sym("C", sparsity)
    n, f, h = ca.SX.sym("n", 3), ca.SX.sym("f", 3), ca.SX.sym("h")

    def derivative(state: ca.SX, tau: ca.SX) -> ca.SX:
        turning, tangent, moment = slopes(
            state[:4], state[7:], n + f * tau, f, strain, compliance, centroid
        )
        return ca.vertcat(turning, -tangent, moment)

    found: list[ca.SX] = []
    for row in _STAGES:
        state = start
        for j, a in row.items():
            state = state + h * a * found[j]
        found.append(derivative(state, h * sum(row.values())))
    end = start
    for j, b in _WEIGHTS.items():
        end = end + h * b * found[j]
    notes = ca.horzcat(start, *(h * found[j] for j in _WEIGHTS))
    arguments = [start, strain, compliance, n, f, h]
    return ca.Function("step", arguments, [end]), ca.Function("notes", arguments, [notes])


def _rigid_point(
    quaternion: ca.MX, position: ca.MX, axis: ca.MX, distance: float
) -> tuple[ca.MX, ca.MX]:
    return quaternion, position - distance * axis


def _soft_point(step: Callable[[float], ca.MX], distance: float) -> tuple[ca.MX, ca.MX]:
    state = step(distance)
    return state[:4], state[4:7]


def _turn_between(q: ca.MX, dq: ca.MX) -> ca.MX:
    """Return rotation vectors (3, k) in body axes of changes dq (4, k) of a unit quaternion q."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    left = ca.vertcat(  # vector part of conjugate(q) * dq
        ca.horzcat(-x, w, z, -y), ca.horzcat(-y, -z, w, x), ca.horzcat(-z, y, -x, w)
    )
    return 2 * left @ dq


@dataclass(frozen=True)
class Stretch:
    """One integration step, or a rigid piece, between two arc lengths from the base.

    `towards_base`: function of the distance from its distal end towards the base, to quaternion and
    position (from the tip). `notes`: (10, 6) quaternion, position and moment at its distal end, and
    its length times their slopes at the `LOBATTO` points.
    """

    proximal: float
    distal: float
    towards_base: Callable[[float], tuple[ca.MX, ca.MX]]
    notes: ca.MX


@dataclass(frozen=True)
class Chain:
    """Symbolic integration from tip to base; implements `Shape` under loads.

    It is the shape of the arm at a *station*: a point of the arm that may carry a load, by default
    its tip.  ``inputs`` are the tip's quaternion (4,), ``x`` (see below), gravity (3,) and the
    loads at tip and station (12,) of `Loads`.  Derivatives are taken by ``x = (delta, p, w)``: an
    infinitesimal turn of the tip (3,), the pressures (n,) and a dead wrench (6,) that is added
    at the station.
    """

    inputs: tuple[ca.MX, ...]
    residual: ca.MX  # (3,) rotation of the base, zero in equilibrium
    nodes: tuple[ca.MX, ...]  # quaternions after each step from the tip to the base
    quaternion: ca.MX  # of the station
    position: ca.MX  # of the station, from the base
    tip_quaternion: ca.MX
    force: ca.MX  # at the base
    stretches: tuple[Stretch, ...]

    def station(self, at: float) -> PointOfArm:
        """See `stiffopt.model.shape.Shape.station`."""
        stretch = next(each for each in self.stretches if each.proximal <= at)
        q, position = stretch.towards_base(stretch.distal - at)
        base = self.stretches[-1]
        _, origin = base.towards_base(base.distal)
        return PointOfArm(position - origin, lie.rotation_from_quaternion(q))

    @property
    def x(self) -> ca.MX:
        """Variables (3 + n + 6,): turn of the tip, pressures, added dead wrench."""
        return self.inputs[1]

    @property
    def pressures(self) -> ca.MX:
        """Channel pressures (n,)."""
        return self.x[3:-6]

    @property
    def rotation(self) -> ca.MX:
        """Axes (3, 3) of the station in the base frame."""
        return lie.rotation_from_quaternion(self.quaternion)

    @property
    def transform(self) -> ca.MX:
        """Pose (4, 4) of the station."""
        return lie.transform(self.rotation, self.position)

    @cached_property
    def _per_x(self) -> tuple[ca.MX, ca.MX]:
        """Change of the residual and body twist of the station per x, with a free tip."""
        change = ca.jacobian(ca.vertcat(self.residual, self.quaternion, self.position), self.x)
        twist = ca.vertcat(
            self.rotation.T @ change[7:, :], _turn_between(self.quaternion, change[3:7, :])
        )
        return change[:3, :], twist

    @cached_property
    def _turn_per_rest(self) -> ca.MX:
        """Turn of the tip (3, n + 6) that keeps the base fixed, per pressure and wrench."""
        residual, _ = self._per_x
        return -inverse_3x3(residual[:, :3]) @ residual[:, 3:]

    @cached_property
    def _twist_per_rest(self) -> ca.MX:
        _, twist = self._per_x
        return self.per_rest(twist)

    @property
    def jacobian(self) -> ca.MX:
        """Body twist (6, n) of the station per unit pressure."""
        return self._twist_per_rest[:, :-6]

    @property
    def compliance(self) -> ca.MX:
        """Tangent compliance (6, 6) at the station, in its axes, for added dead loads."""
        return self._twist_per_rest[:, -6:] @ ca.diagcat(self.rotation, self.rotation)

    def flexibility(self, wrench: ca.MX) -> ca.MX:
        """Return ``w' C w`` of a dead wrench (6,) at the station, in its axes."""
        return wrench.T @ self.compliance @ wrench

    def total_jacobian(self, values: ca.MX) -> ca.MX:
        """Return the derivative (k, n) of values (k,) by the pressures, along the equilibrium."""
        return self.per_rest(ca.jacobian(values, self.x))[:, :-6]

    def gravity_jacobian(self, values: ca.MX) -> ca.MX:
        """Return the derivative (k, 3) of values (k,) by gravity, along the equilibrium."""
        gravity = self.inputs[2]
        residual, _ = self._per_x
        turn = -inverse_3x3(residual[:, :3]) @ ca.jacobian(self.residual, gravity)
        return ca.jacobian(values, gravity) + ca.jacobian(values, self.x)[:, :3] @ turn

    @property
    def per_gravity(self) -> ca.MX:
        """Body twist (6, 3) of the station per m/s^2 of gravity, along the equilibrium."""
        residual, twist = self._per_x
        values = ca.vertcat(self.residual, self.quaternion, self.position)
        change = ca.jacobian(values, self.inputs[2])  # with a free tip
        tip = -inverse_3x3(residual[:, :3]) @ change[:3, :]
        turn = _turn_between(self.quaternion, change[3:7, :])
        return ca.vertcat(self.rotation.T @ change[7:, :], turn) + twist[:, :3] @ tip

    def per_rest(self, change: ca.MX) -> ca.MX:
        """Reduce a change (k, 3 + n + 6) to equilibrium: (k, n + 6) per pressure and wrench."""
        return change[:, 3:] + change[:, :3] @ self._turn_per_rest

    @property
    def base_turn(self) -> ca.MX:
        """Turn of the base (3, 3) per turn of the tip, in base axes: the identity if unloaded."""
        per_turn = _turn_between(self.nodes[-1], self._nodes_per(self.x, 0)[-4:, :])
        return per_turn @ lie.rotation_from_quaternion(self.tip_quaternion).T

    @property
    def rotational_compliances(self) -> ca.MX:
        """Rotation of the tip per moment at it, side by side (3, 3 k), in tip axes.

        Each block is for the arm clamped at one of the k nodes instead of at the base.
        """
        R = lie.rotation_from_quaternion(self.tip_quaternion)
        turns = ca.vertsplit(self._nodes_per(self.x, 0), 4)
        moments = ca.vertsplit(self._nodes_per(self.inputs[3], 3), 4)
        blocks = []
        for node, turn, moment in zip(self.nodes, turns, moments, strict=True):
            per_turn, per_moment = _turn_between(node, turn), _turn_between(node, moment)
            blocks.append(-inverse_3x3(per_turn) @ per_moment @ R)
        return ca.horzcat(*blocks)

    def _nodes_per(self, variables: ca.MX, first: int) -> ca.MX:
        """Return the change (4 k, 3) of all nodes per each of three variables, in one sweep."""
        seeds = ca.DM.eye(variables.numel())[:, first : first + 3]
        return ca.jtimes(ca.vertcat(*self.nodes), variables, ca.MX(seeds))


def pieces_of(
    description: RobotDescription, resolution: int, cuts: Sequence[float] = ()
) -> list[RodStretch]:
    """Return the pieces of the arm from tip to base, cut at the given arc lengths."""
    pieces: list[RodStretch] = []
    start, slack = 0.0, SAME_STATION * description.length
    for index, segment in enumerate(description.segments):
        for length, rigid in ((segment.length, False), (segment.connector, True)):
            end = start + length
            inside = sorted(c for c in cuts if start + slack < c < end - slack)
            for near, far in pairwise([start, *inside, end]):
                if far - near > slack:
                    longest = STEP_LENGTH * segment.outer_radius / resolution
                    steps = max(1, ceil((far - near) / longest - 1e-9))
                    pieces.append(RodStretch(index, rigid, far - near, steps, far))
            start = end
    return pieces[::-1]


def mass_per_length(segment: Segment) -> float:
    """Return the mass of a segment per length at rest, in kg/m."""
    return float((segment.material.density or 0.0) * SectionGeometry.of(segment).area)


class Shooting:
    """Symbolic shooting problem of one robot, its weight and payload included.

    Parameters
    ----------
    description : the arm; its gravity and tip mass are part of every equilibrium.
    actuation : its strain law, per segment.
    resolution : multiplies the number of integration steps.
    """

    def __init__(
        self, description: RobotDescription, actuation: Actuation, resolution: int = 1
    ) -> None:
        self.description = description
        self.resolution = resolution
        self._geometry = [SectionGeometry.of(segment) for segment in description.segments]
        self.sections = ca.Function(
            "sections",
            [actuation.pressures],
            [
                part
                for section in actuation.sections
                for part in (section.strain, section.compliance)
            ],
        )
        steps = [
            _step_functions(section.compliance.sparsity(), geometry.centroid)
            for section, geometry in zip(actuation.sections, self._geometry, strict=True)
        ]
        self.step = [step for step, _ in steps]
        self._notes = [notes for _, notes in steps]

    @property
    def n_variables(self) -> int:
        """Number of inputs of the sections: pressures, and parameters if there are any."""
        return int(self.sections.numel_in(0))

    def pieces(self, cuts: Sequence[float]) -> list[RodStretch]:
        """Return the pieces of the arm from tip to base, cut at the given arc lengths."""
        return pieces_of(self.description, self.resolution, cuts)

    def chain(self, at: float | None = None) -> Chain:
        """Return the symbolic shooting map with the station at arc length `at` (None: the tip)."""
        q, x = ca.MX.sym("q", 4), ca.MX.sym("x", 3 + self.n_variables + 6)
        gravity, tip, station = ca.MX.sym("g", 3), ca.MX.sym("tip", 12), ca.MX.sym("station", 12)
        delta, p, added = x[:3], x[3:-6], x[-6:]
        sections = self.sections.call([p])

        turned = lie.quaternion_product(q, ca.vertcat(1, delta / 2))
        tip_quaternion = orientation = turned / ca.norm_2(turned)
        R = lie.rotation_from_quaternion(orientation)
        force = tip[:3] + R @ tip[6:9] + self.description.tip_mass * gravity
        moment = tip[3:6] + R @ tip[9:]
        position = ca.MX.zeros(3)
        length = self.description.length
        station_at = length if at is None else at
        station_quaternion, station_position = tip_quaternion, position
        nodes, stretches = [], []
        for piece in self.pieces([station_at]):
            distal = piece.distal
            if abs(piece.distal - station_at) <= SAME_STATION * length:
                R = lie.rotation_from_quaternion(orientation)
                force = force + station[:3] + added[:3] + R @ station[6:9]
                moment = moment + station[3:6] + added[3:] + R @ station[9:]
                station_quaternion, station_position = orientation, position
            if piece.rigid:
                axis = lie.rotation_from_quaternion(orientation)[:, 2]
                rigid = partial(_rigid_point, orientation, position, axis)
                before = ca.vertcat(orientation, position, moment)
                position = position - piece.length * axis
                moment = moment + piece.length * ca.cross(axis, force)
                gain = ca.vertcat(orientation, position, moment) - before
                notes = ca.horzcat(before, ca.repmat(gain, 1, len(LOBATTO)))
                stretches.append(Stretch(distal - piece.length, distal, rigid, notes))
                continue
            strain, compliance = sections[2 * piece.segment : 2 * piece.segment + 2]
            weight = self.weight(piece.segment) * gravity
            h = piece.length / piece.steps
            for _ in range(piece.steps):
                start = ca.vertcat(orientation, position, moment)
                step = partial(self.step[piece.segment], start, strain, compliance, force, weight)
                notes = self._notes[piece.segment](start, strain, compliance, force, weight, h)
                stretches.append(Stretch(distal - h, distal, partial(_soft_point, step), notes))
                distal -= h
                state = step(h)
                orientation, position, moment = state[:4], state[4:7], state[7:]
                force = force + h * weight
                nodes.append(orientation)
        return Chain(
            inputs=(q, x, gravity, tip, station),
            residual=2 * orientation[1:] * ca.sign(orientation[0]),
            nodes=tuple(nodes),
            quaternion=station_quaternion,
            position=station_position - position,
            tip_quaternion=tip_quaternion,
            force=force,
            stretches=tuple(stretches),
        )

    def weight(self, segment: int) -> float:
        """Return the mass per reference length of a segment, in kg/m."""
        return mass_per_length(self.description.segments[segment])
