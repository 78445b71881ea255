"""`Equilibrium`: the stable equilibrium under gravity and loads, reached continuously from rest.

Newton's method solves the shooting problem (`stiffopt.model.shooting`) along a path: first the
weight grows on the unpressurised arm, then pressures and loads grow together.  A step is halved
if Newton's method does not contract at once or if stability is lost.  If that no longer helps, the
path has ended: the arm buckles or falls over there.

Integrating a long hanging arm from its tip magnifies the smallest turn there by many orders of
magnitude, so plain shooting converges only from very near.  Therefore the states after every step
(orientation and moment) are unknowns too, and each step's defect (its end less the next unknown
state) is driven to zero together with the turn of the base: multiple shooting.  The linear
system is solved at the cost of single shooting by propagating the changes per turn of the tip and
the defects (the lifted Newton method, J. Albersmeyer and M. Diehl, SIAM J. Optim. 20, 2010).
"""

from functools import cached_property
from typing import NamedTuple, get_args

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.arguments import check_choice
from stiffopt.model.compliance import Frame, inverse_3x3
from stiffopt.model.shooting import SAME_STATION, Shooting

_LARGEST_TURN = 1.0  # rad of tip rotation in one continuation step; a longer one is halved
_SHORTEST_STEP = 1e-3  # share of the path from rest; below it the path has ended
_QUADRATIC = 1e-6  # rad; convergence is quadratic: after such a correction the error is 1e-12
_MOST_ITERATIONS = 12


class Loads(NamedTuple):
    """Loads on the arm, as CasADi or NumPy columns.

    `tip` and `station` hold a dead wrench in base axes (6,), then a follower wrench in the axes
    of the loaded point (6,); `gravity` (3,) is in base axes.
    """

    gravity: Array
    tip: Array
    station: Array

    @property
    def are_conservative(self) -> bool:
        """Whether all loads are dead forces, which have a potential."""
        return not (self.tip[3:].any() or self.station[3:].any())


def dead_and_follower(wrench: Array, frame: Frame) -> Array:
    """Return a wrench (6,) as `Loads` has it (12,): dead in frame "base", otherwise follower."""
    check_choice("frame", frame, get_args(Frame))
    none = np.zeros(6)
    return np.concatenate([wrench, none] if frame == "base" else [none, wrench])


class EquilibriumState(NamedTuple):
    """An equilibrium: the tip's orientation (w, x, y, z), which determines the rest.

    `states` (7, k) hold orientation and moment after each integration step, as starts of Newton's
    method.
    """

    pressures: Array
    quaternion: Array
    states: Array
    loads: Loads


class Continuation(NamedTuple):
    """The end of a path of equilibria."""

    state: EquilibriumState  # the last equilibrium that was found
    share: float  # share of the path at which it is; 1.0 is the end
    unstable: bool  # whether the path ends because stability is lost there


class Equilibrium:
    """Numerical equilibria of one shooting problem.

    `shooting`: the arm. `at`: arc length of the station on which `Loads.station` acts; None is the
    tip.
    """

    def __init__(self, shooting: Shooting, at: float | None = None) -> None:
        self.shooting = shooting
        self.at = at
        self._rest: dict[bytes, Continuation] = {}

    def arguments(self, state: EquilibriumState) -> tuple[Array, ...]:
        """Return the numerical inputs of a `Chain` at an equilibrium."""
        x = np.concatenate([np.zeros(3), state.pressures, np.zeros(6)])
        return (state.quaternion, x, *state.loads)

    @cached_property
    def _newton(self) -> ca.Function:
        return newton_step(self.shooting, self.at)

    @cached_property
    def _stability(self) -> ca.Function:
        chain = self.shooting.chain(self.at)
        return ca.Function(
            "stability", chain.inputs, [chain.rotational_compliances, chain.base_turn]
        )

    def correct(self, guess: EquilibriumState) -> EquilibriumState | None:
        """Run Newton's method from a nearby state; return None if it is not near.

        "Near" means that the first correction turns no part of the arm by more than a radian
        and later ones shrink, so there is no fold between the guess and the answer.
        """
        state, previous = guess, _LARGEST_TURN
        for iteration in range(_MOST_ITERATIONS):
            quaternion, states, largest = self._newton(
                state.quaternion, state.states, state.pressures, *state.loads
            )
            size = float(largest)
            bound = previous if iteration < 2 else 0.5 * previous
            if not size <= bound:  # NaN too
                return None
            state = state._replace(quaternion=quaternion.full()[:, 0], states=states.full())
            if size < _QUADRATIC:
                return state
            previous = size
        return None

    def is_stable(self, state: EquilibriumState) -> bool:
        """Return whether an equilibrium is a minimum of the energy (Jacobi's condition).

        Follower loads and moments have no energy.  For these, the arm must not have passed a
        divergence, where turns of the tip leave the base unturned, and beyond which they turn it
        the opposite way. Flutter is not detected.
        """
        blocks, base_turn = (part.full() for part in self._stability(*self.arguments(state)))
        if not (np.isfinite(blocks).all() and np.isfinite(base_turn).all()):
            return False
        compliances = blocks.T.reshape(-1, 3, 3)  # from the tip to the base
        if state.loads.are_conservative:
            symmetric = (compliances + compliances.swapaxes(1, 2)) / 2
            return bool((np.linalg.eigvalsh(symmetric) > 0).all())
        eigenvalues = np.linalg.eigvals(base_turn)
        return not (eigenvalues.real <= -np.abs(eigenvalues.imag)).any()

    def follow(
        self,
        start: EquilibriumState,
        end: EquilibriumState,
        shortest: float = _SHORTEST_STEP,
        stable: bool = True,
    ) -> "Continuation":
        """Follow the equilibrium continuously between two sets of pressures and loads.

        The path is straight from `start` to `end` (whose shape is not used), in steps no shorter
        than the share `shortest`; stability is checked if `stable`.
        """
        state, share, step = start, 0.0, 1.0
        halved = unstable = False
        while share < 1.0:
            target = min(1.0, share + step)
            pressures, loads = _between(start, end, target)
            corrected = self.correct(state._replace(pressures=pressures, loads=loads))
            unstable = corrected is not None and stable and not self.is_stable(corrected)
            if corrected is None or unstable:
                step, halved = step / 2, True
                if step < shortest:
                    return Continuation(state, share, unstable)
            else:
                state, share = corrected, target
                step, halved = step if halved else 2 * step, False
        return Continuation(state, 1.0, False)

    def settle(self, pressures: Array, loads: Loads) -> EquilibriumState:
        """Find the equilibrium reached from rest: first the arm's weight, then pressures and loads.

        Raises `EquilibriumError` if the arm buckles or falls over on the way; the message says
        where.
        """
        hanging = self._at_rest(loads.gravity)
        end = hanging._replace(pressures=pressures, loads=loads)
        state, share, unstable = self.follow(hanging, end)
        what = "its pressures"
        if loads.tip.any() or loads.station.any():
            what += " and load"
        if unstable:
            raise EquilibriumError(
                f"no stable equilibrium: the arm buckles or falls over at {share:.0%} of {what} "
                f"(raised together from the unpressurised arm under its weight)"
            )
        if share < 1.0:
            raise EquilibriumError(_lost(share, what))
        return state

    def _at_rest(self, gravity: Array) -> EquilibriumState:
        """Return the unpressurised arm under its own weight and payload."""
        key = gravity.tobytes()
        if key not in self._rest:
            none = Loads(np.zeros(3), np.zeros(12), np.zeros(12))
            upright = np.array([1.0, 0.0, 0.0, 0.0])
            steps = self._newton.size2_in(1)
            states = np.repeat(np.concatenate([upright, np.zeros(3)])[:, np.newaxis], steps, 1)
            pressures = np.zeros(self.shooting.n_variables)
            straight = EquilibriumState(pressures, upright, states, none)
            weighted = straight._replace(loads=none._replace(gravity=gravity))
            self._rest[key] = self.follow(straight, weighted)
        path = self._rest[key]
        if path.unstable:
            raise EquilibriumError(
                f"no stable equilibrium: the unpressurised arm buckles or falls over at "
                f"{path.share:.0%} of its own weight and payload; mount it hanging, or make it "
                f"shorter, lighter or stiffer"
            )
        if path.share < 1.0:
            raise EquilibriumError(_lost(path.share, "its own weight and payload"))
        return path.state

    def shape(self, state: EquilibriumState, stations: Array) -> Array:
        """Return the poses (k, 4, 4) at arc lengths (k,) of an equilibrium."""
        sections = [np.asarray(part) for part in self.shooting.sections(state.pressures)]
        length = self.shooting.description.length
        station_at = length if self.at is None else self.at
        tip, station = state.loads.tip, state.loads.station
        q, r = state.quaternion, np.zeros(3)
        R = lie.rotation_from_quaternion(q)
        force = tip[:3] + R @ tip[6:9] + self.shooting.description.tip_mass * state.loads.gravity
        moment = tip[3:6] + R @ tip[9:]
        found = {length: (q, r)}
        for piece in self.shooting.pieces([station_at, *stations]):
            R = lie.rotation_from_quaternion(q)
            if abs(piece.distal - station_at) <= SAME_STATION * length:
                force = force + station[:3] + R @ station[6:9]
                moment = moment + station[3:6] + R @ station[9:]
            if piece.rigid:
                r = r - piece.length * R[:, 2]
                moment = moment + piece.length * np.cross(R[:, 2], force)
            else:
                strain, compliance = sections[2 * piece.segment : 2 * piece.segment + 2]
                weight = self.shooting.weight(piece.segment) * state.loads.gravity
                h = piece.length / piece.steps
                for _ in range(piece.steps):
                    y = np.concatenate([q, r, moment])
                    y = np.asarray(
                        self.shooting.step[piece.segment](y, strain, compliance, force, weight, h)
                    )[:, 0]
                    q, r, moment = y[:4], y[4:7], y[7:]
                    force = force + h * weight
            found[piece.distal - piece.length] = (q, r)
        marks = np.array(sorted(found))
        origin = found[marks[0]][1]
        poses = []
        for s in stations:
            q, position = found[marks[np.argmin(np.abs(marks - s))]]
            poses.append(
                lie.transform(
                    lie.rotation_from_quaternion(q / np.linalg.norm(q)), position - origin
                )
            )
        return np.stack(poses)


def _lost(share: float, what: str) -> str:
    return (
        f"no equilibrium was found beyond {share:.0%} of {what}: either there is none, or the load "
        "is so large that it takes a higher resolution to integrate the arm"
    )


def _between(start: EquilibriumState, end: EquilibriumState, share: float) -> tuple[Array, Loads]:
    """Return the pressures and loads at a share of the straight path between two states."""

    def mix(a: Array, b: Array) -> Array:
        return (1 - share) * a + share * b

    loads = Loads(*(mix(a, b) for a, b in zip(start.loads, end.loads, strict=True)))
    return mix(start.pressures, end.pressures), loads


# Newton's method --------------------------------------------------------------------------------

_CARRIED = 4  # propagated changes: three turns of the tip, and the defects


class _Carried:
    """A value with its changes (k, 4) along the propagated directions."""

    def __init__(self, value: ca.MX, changes: ca.MX) -> None:
        self.value = value
        self.changes = changes

    def __add__(self, other: "_Carried | ca.MX") -> "_Carried":
        if isinstance(other, _Carried):
            return _Carried(self.value + other.value, self.changes + other.changes)
        return _Carried(self.value + other, self.changes)


def _constant(value: ca.MX) -> _Carried:
    return _Carried(value, ca.MX.zeros(value.size1(), _CARRIED))


def _apply(function: ca.Function, *arguments: _Carried) -> list[_Carried]:
    """Return the outputs of a function with their changes, by forward differentiation."""
    values = [argument.value for argument in arguments]
    outputs = function.call(values)
    seeds = [argument.changes for argument in arguments]
    changes = function.forward(_CARRIED).call([*values, *outputs, *seeds])
    return [_Carried(value, change) for value, change in zip(outputs, changes, strict=True)]


def _applied_wrench() -> ca.Function:
    """Return the function of q and a load (12,) to its force and moment in base axes."""
    q, load = ca.SX.sym("q", 4), ca.SX.sym("load", 12)
    R = lie.rotation_from_quaternion(q)
    force, moment = load[:3] + R @ load[6:9], load[3:6] + R @ load[9:]
    return ca.Function("applied", [q, load], [force, moment])


def _rigid_step() -> ca.Function:
    """Return the function of q, force and length to the moment that a rigid connector adds."""
    q, force, length = ca.SX.sym("q", 4), ca.SX.sym("n", 3), ca.SX.sym("c")
    axis = lie.rotation_from_quaternion(q)[:, 2]
    return ca.Function("rigid", [q, force, length], [length * ca.cross(axis, force)])


def newton_step(shooting: Shooting, at: float | None = None) -> ca.Function:
    """Return one step of the lifted Newton method, with the load's station at `at` (None: the tip).

    It maps (tip quaternion (4,), states (7, k), pressures, gravity, tip load, station load) to
    (quaternion, states, largest turn of the tip or a state in rad).
    """
    pieces = shooting.pieces([] if at is None else [at])
    count = sum(piece.steps for piece in pieces if not piece.rigid)
    q, states = ca.MX.sym("q", 4), ca.MX.sym("states", 7, count)
    p, gravity = ca.MX.sym("p", shooting.n_variables), ca.MX.sym("g", 3)
    tip, station = ca.MX.sym("tip", 12), ca.MX.sym("station", 12)
    sections = shooting.sections.call([p])
    applied, rigid = _applied_wrench(), _rigid_step()
    steps = [_lifted_step(step) for step in shooting.step]

    per_turn = [lie.quaternion_product(q, ca.DM([0, *row])) / 2 for row in ca.DM.eye(3).full()]
    orientation = _Carried(q, ca.horzcat(*per_turn, ca.MX.zeros(4)))
    force, moment = _apply(applied, orientation, _constant(tip))
    force = force + shooting.description.tip_mass * gravity
    length = shooting.description.length
    met: list[ca.MX] = []  # changes of the state after each step
    for piece in pieces:
        if abs(piece.distal - (length if at is None else at)) <= SAME_STATION * length:
            added_force, added_moment = _apply(applied, orientation, _constant(station))
            force, moment = force + added_force, moment + added_moment
        if piece.rigid:
            (added,) = _apply(rigid, orientation, force, _constant(ca.MX(piece.length)))
            moment = moment + added
            continue
        strain, compliance = sections[2 * piece.segment : 2 * piece.segment + 2]
        weight = shooting.weight(piece.segment) * gravity
        h = piece.length / piece.steps
        for _ in range(piece.steps):
            lifted = states[:, len(met)]
            changes = steps[piece.segment](
                orientation.value, orientation.changes, moment.value, moment.changes,
                force.value, force.changes, strain, compliance, weight, h, lifted,
            )  # fmt: skip
            orientation = _Carried(lifted[:4], changes[:4, :])
            moment = _Carried(lifted[4:], changes[4:, :])
            force = force + h * weight
            met.append(changes)
    base = orientation.changes[1:, :]
    turn = -inverse_3x3(base[:, :3]) @ (orientation.value[1:] + base[:, 3])
    moves = [changes @ ca.vertcat(turn, 1) for changes in met]
    turned = lie.quaternion_product(q, ca.vertcat(1, turn / 2))
    largest = ca.norm_2(turn)
    for move in moves:
        largest = ca.fmax(largest, 2 * ca.norm_2(move[:4]))
    return ca.Function(
        "newton",
        [q, states, p, gravity, tip, station],
        [turned / ca.norm_2(turned), states + ca.horzcat(*moves), largest],
    )


def _lifted_step(step: ca.Function) -> ca.Function:
    """Return an integration step that propagates changes to the lifted state at its end.

    It maps orientation, moment and force, each followed by its changes, the section (strain,
    compliance), weight, length and lifted state (7,) to the changes of the lifted state: those of
    the step's end, with the defect added to the last column.
    """
    q, m, n = ca.SX.sym("q", 4), ca.SX.sym("m", 3), ca.SX.sym("n", 3)
    dq, dm, dn = (ca.SX.sym("d", size, _CARRIED) for size in (4, 3, 3))
    strain, C = ca.SX.sym("strain", 6), ca.SX.sym("C", step.sparsity_in(2))
    f, h, lifted = ca.SX.sym("f", 3), ca.SX.sym("h"), ca.SX.sym("lifted", 7)
    end = step(ca.vertcat(q, ca.SX.zeros(3), m), strain, C, n, f, h)
    end = ca.vertcat(end[:4], end[7:])
    changes = ca.jtimes(end, ca.vertcat(q, m, n), ca.vertcat(dq, dm, dn))
    changes[:, 3] += end - lifted
    return ca.Function("lifted", [q, dq, m, dm, n, dn, strain, C, f, h, lifted], [changes])
