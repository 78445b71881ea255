"""Plan the motion into contact: from rest, clear of all objects, to a braced equilibrium.

All pressures grow in proportion, as in the definition of equilibria in contact
(`Manipulator.contact_equilibrium`). Each equilibrium along the way is found from the one before. If
they do not end in the wanted one, the motion is refused. Where friction would keep the tip from its
target, the way goes on past its end, and comes back (`eased`). Backwards from where it first
reaches its end, it releases the contact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError
from stiffopt.model.contact.equilibrium import Contact, ContactEquilibrium
from stiffopt.model.contact.sticking import Sticking
from stiffopt.model.contact.way import STATES, Rubbing, rubbed, states_from_rest
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.brace import kept_clear_of, leant_on, quoted
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.optimise.easing import body_lines, eased, missing_clearance
from stiffopt.optimise.settings import BRACE
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.configurations import Unsolved, maximised

SPEED = 0.02  # m/s, largest, of any part of the body
FORCE_RATE = 0.1  # N/s, largest change of a contact's force
GRADUAL = 1.0  # s, in which the way gets its speed or loses it
_AS_STIFF = 0.05  # largest difference of stiffnesses in the same equilibrium
_PUSH = 2e-3  # N, step of finite differences by a push at the tip
_SAME_PRESSURE = 1.0  # Pa
_STRAIGHT = 0.9  # least cosine of the angle between steps of a way that does not turn


class Hold(NamedTuple):
    """The k contacts of a braced equilibrium, linearised about it.

    Attributes
    ----------
    forces : along the normals (k,), in N.
    deviations : their standard deviations by a calibration (k,), in N; zero without one.
    per_pressure : their derivatives by pressures (k, n), in N/Pa.
    per_push : their derivatives by a force at the tip (k, 3), in base axes.
    sticking : how friction holds those that have some.
    tangential : the forces of friction that the way leaves, as in `Rubbing`, in N.
    """

    forces: Array
    deviations: Array
    per_pressure: Array
    per_push: Array
    sticking: Sticking
    tangential: Array


@dataclass(frozen=True)
class BraceApproach:
    """A motion from rest into contact.

    Attributes
    ----------
    times : (k,), in s.
    pressures : (k, n), in Pa, growing in proportion from zero; then perhaps past this and back.
    tips : of the equilibria on the way, with their Jacobians and compliances.
    forces : largest force of a contact (k,), in N.
    contacts : at the end.
    hold : their forces and limits at the end.
    free_tips : positions (k, 3), in m, of the tip at these pressures without contact.
    """

    times: Array
    pressures: Array
    tips: tuple[TipAt, ...]
    forces: Array
    contacts: tuple[Contact, ...]
    hold: Hold
    free_tips: Array

    @cached_property
    def reached(self) -> float:
        """Time at which the way first reaches its end, in s."""
        return self.time_back(float(self.times[-1]))

    def time_back(self, time: float) -> float:
        """Return when the way first has its pressures of a time, in s.

        From there backwards, a way that went past its end does not do so again.
        """
        past = np.linalg.norm(self.pressures - self.pressures[-1], axis=1)
        reached = int(np.argmax(past < _SAME_PRESSURE))
        if time <= self.times[reached]:
            return time
        leg = slice(reached, reached + int(np.argmax(past[reached:])) + 1)
        return float(np.interp(np.interp(time, self.times, past), past[leg], self.times[leg]))


def approach_to(
    robot: Manipulator, solution: PressureSolution, slew: Array | float = np.inf
) -> BraceApproach:
    """Return the motion from rest to a braced solution.

    Parameters
    ----------
    solution : of a task with a brace; it leans on an object.
    slew : largest rates of change, one or (n,), in Pa/s.

    Raises
    ------
    Unsolved
        As `way_into_contact` does.
    """
    states = way_into_contact(robot, solution)
    deviations = BraceUncertainty(robot, states[-1]).forces / BRACE.sure
    pressures = np.array([eq.pressures for eq in states])
    return BraceApproach(
        times=least_times_along(robot, states, slew),
        pressures=pressures,
        tips=tuple(TipAt(eq.tip_pose, eq.tip_jacobian, eq.tip_compliance) for eq in states),
        forces=np.array([_largest(eq) for eq in states]),
        contacts=states[-1].contacts,
        hold=_hold(states[-1], deviations, rubbed(states)),
        free_tips=robot.pose(pressures, robot.length)[:, :3, 3],
    )


def way_into_contact(
    robot: Manipulator, solution: PressureSolution, *, is_eased: bool = True
) -> list[ContactEquilibrium]:
    """Return the equilibria from rest to a braced solution.

    `is_eased`: see `way_from_rest`.

    Raises
    ------
    Unsolved
        As `way_from_rest` does, or the way ends in another equilibrium.
    """
    assert solution.tip_pose is not None
    assert solution.pressures is not None
    states = way_from_rest(robot, solution.task, solution.pressures, is_eased=is_eased)
    end = states[-1]
    names, wanted = ({each.object for each in found.contacts} for found in (end, solution))
    apart = float(np.linalg.norm(end.tip_pose[:3, 3] - solution.tip_pose[:3, 3]))
    if apart > BRACE.same or (wanted and names != wanted):
        raise Unsolved(
            "all pressures growing together lead to another equilibrium: the tip is "
            f"{1e3 * apart:.2g} mm away, leaning on {quoted(sorted(names)) or 'nothing'}"
        )
    stiffness, promised = stiffness_leaning(end, solution.task), solution.stiffness
    if wanted and promised and abs(promised / stiffness - 1) > _AS_STIFF:
        unit = display_units().of_si(solution.stiffness_unit)
        raise Unsolved(
            "all pressures growing together lead to another equilibrium, of "
            f"{unit.text(stiffness)} instead of {unit.text(promised)}"
        )
    return states


def stiffness_leaning(eq: ContactEquilibrium, task: Task) -> float:
    """Return the smallest of the stiffnesses that a task with a brace maximises."""
    assert task.brace is not None
    grip = task.brace.contacts
    return min(
        eq.stiffness(m.direction, m.kind, m.boundary, m.frame, grip) for m in maximised(task)
    )


def touches_at(robot: Manipulator, task: Task, p: Array) -> bool:
    """Return whether the arm at pressures (n,) touches an object of a task's brace."""
    assert task.brace is not None
    assert task.scene is not None
    try:
        return bool(robot.contact_equilibrium(p, leant_on(task.scene, task.brace)).contacts)
    except EquilibriumError:  # the way into contact tells why
        return False


def way_from_rest(
    robot: Manipulator, task: Task, p: Array, *, is_eased: bool = False
) -> list[ContactEquilibrium]:
    """Return the equilibria from rest to pressures (n,) among the objects of a task with a brace.

    `is_eased`: whether the way may end by easing the friction (`eased`).

    Raises
    ------
    Unsolved
        The way is lost, presses an object with more than its largest force, or brings the body too
        near to an object that must not be touched.
    """
    assert task.brace is not None
    assert task.scene is not None
    scene, others = leant_on(task.scene, task.brace), kept_clear_of(task.scene, task.brace)
    states: list[ContactEquilibrium] = []
    try:
        states.extend(states_from_rest(robot, scene, p))
    except EquilibriumError as error:
        share = len(states) / (STATES - 1)
        raise Unsolved(f"the way from rest is lost at {share:.0%} of it: {error}") from None
    if is_eased and states[-1].contacts:
        states, _ = eased(robot, task, scene, states)
    for number, eq in enumerate(states):
        for own, force in eq.pressed():
            each = eq.contacts[own[0]]
            if force > each.max_force * (1 + 1e-6):
                text = display_units().force.text(force, ".3g")
                where = "on the way" if number else "at rest"
                raise Unsolved(f"{where}, '{each.object}' would be pressed with {text}")
    if others is not None:
        missing = missing_clearance(robot, others, states)
        if missing:
            text = display_units().length.text(missing, ".2g")
            raise Unsolved(f"on the way the body is {text} too near an object")
    return states


def least_times_along(
    robot: Manipulator, states: list[ContactEquilibrium], slew: Array | float
) -> Array:
    """Return the times (k,), in s, of equilibria that keep speed, rates of force and pressure.

    Where the way turns, it slows down.
    """
    _, lines = body_lines(robot, states)
    moved = np.linalg.norm(np.diff(lines, axis=0), axis=-1).max(axis=1)
    forces = np.array([_largest(eq) for eq in states])
    pressures = np.array([eq.pressures for eq in states])
    if len(states) < 2:
        return np.zeros(len(states))
    rates = (np.abs(np.diff(pressures, axis=0)) / slew).max(axis=1)
    least = np.maximum.reduce([moved / SPEED, np.abs(np.diff(forces)) / FORCE_RATE, rates])
    # in the step of the first touch, its mean speed is less than that before, or the force's after
    least = np.maximum.reduce([least, np.append(least[1:], 0.0), np.append(0.0, least[:-1])])
    times = np.concatenate([[0.0], np.cumsum(np.maximum(least, 1e-3))])
    ways = np.diff(pressures, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-6)
    turns = 1 + np.flatnonzero((ways[1:] * ways[:-1]).sum(axis=1) < _STRAIGHT)
    if not len(turns):
        return times
    legs = [np.diff(gradual(leg - leg[0])) for leg in _pieces(times, turns.tolist())]
    return np.concatenate([[0.0], np.cumsum(np.concatenate(legs))])


def _pieces(values: Array, at: list[int]) -> Iterator[Array]:
    """Yield the pieces of values (k,) between indices, with both ends."""
    ends = [0, *at, len(values) - 1]
    for begin, end in pairwise(ends):
        yield values[begin : end + 1]


def gradual(times: Array) -> Array:
    """Return times (k,), in s, of the same way with a speed that grows and falls uniformly."""
    to_end = times[-1] - times
    after = _begun_gradually(np.minimum(times, to_end))
    whole = 2 * _begun_gradually(times[-1] / 2)
    return np.where(times <= to_end, after, whole - after)


def _begun_gradually(times: Array) -> Array:
    """Return when a way is as far as it would be at times (k,) if it began at full speed.

    Its share of the speed grows as t / T with T = `GRADUAL`, so that it is at t^2 / (2 T).
    """
    return np.where(times < GRADUAL / 2, np.sqrt(2 * GRADUAL * times), times + GRADUAL / 2)


def _hold(eq: ContactEquilibrium, deviations: Array, rubbing: Rubbing) -> Hold:
    pushed = [
        (eq.shifted(push=step).normal_forces - eq.shifted(push=-step).normal_forces) / (2 * _PUSH)
        for step in _PUSH * np.eye(3)
    ]
    slopes = eq.force_gradients, np.array(pushed).T
    return Hold(eq.normal_forces, deviations, *slopes, rubbing.sticking, rubbing.tangential)


def _largest(eq: ContactEquilibrium) -> float:
    return max((force for _, force in eq.pressed()), default=0.0)
