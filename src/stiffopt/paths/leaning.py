"""The way into contact: from rest, where the arm is clear of all objects, to a braced equilibrium.

All pressures grow together, which is the approach by which equilibria in contact are defined
(`Manipulator.contact_equilibrium`). The equilibria along the way are followed one from the other,
so that the motion ends in the wanted one or is refused. Played backwards it lets go.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError
from stiffopt.model.arm_clearance import measured_scene
from stiffopt.model.contact.equilibrium import Contact, ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.brace import kept_clear_of, leant_on, quoted
from stiffopt.optimise.solution import PressureSolution
from stiffopt.paths.configurations import Unsolved

Vector = NDArray[np.float64]

SPEED = 0.02  # m/s, of any part of the body
FORCE_RATE = 0.1  # N/s, at which the force of a contact grows
_STATES = 61  # of the way that are looked at
_STATIONS = 41  # of the body
_SAME = 2e-4  # m, between tips of one equilibrium that was reached on two ways
_FORGIVEN = 1e-4  # m, by which the body may be nearer to other objects than the clearance


@dataclass(frozen=True)
class BraceApproach:
    """A motion from rest into contact.

    Attributes
    ----------
    times : (k,), in s.
    pressures : (k, n), in Pa: from none, in proportion.
    tip_poses : (k, 4, 4), in contact from where the arm touches something.
    forces : greatest force of a contact (k,), in N.
    contacts : at the end.
    free_tip : where the tip would be at the end without contact (3,), in m.
    scene : the objects that the arm leans on.
    """

    times: Vector
    pressures: Vector
    tip_poses: Vector
    forces: Vector
    contacts: tuple[Contact, ...]
    free_tip: Vector
    scene: Scene


def approach_to(
    robot: Manipulator, solution: PressureSolution, slew: Vector | float = np.inf
) -> BraceApproach:
    """The motion from rest to a braced answer.

    Parameters
    ----------
    robot : Manipulator
    solution : PressureSolution
        Of a task with a brace, which leans on something.
    slew : float or (n,)
        Greatest rates of change, in Pa/s.

    Raises
    ------
    Unsolved
        The way ends in another equilibrium, or presses an object with more than its greatest
        force, or the body comes too near to another object on it.
    """
    task, p = solution.task, solution.pressures
    assert task.brace is not None
    assert task.scene is not None
    assert p is not None
    assert solution.tip_pose is not None
    scene, others = leant_on(task.scene, task.brace), kept_clear_of(task.scene, task.brace)
    at = np.linspace(0.0, robot.length, _STATIONS)
    shares = np.linspace(0.0, 1.0, _STATES)
    states: list[ContactEquilibrium] = []
    try:
        for share in shares:
            nearby = states[-1] if states else None
            states.append(robot.contact_equilibrium(share * p, scene, nearby=nearby))
    except EquilibriumError as error:
        raise Unsolved(f"the way into contact is lost at {share:.0%} of it: {error}") from None
    end = states[-1]
    names = sorted(each.object for each in end.contacts)
    apart = float(np.linalg.norm(end.tip_pose[:3, 3] - solution.tip_pose[:3, 3]))
    if apart > _SAME or names != sorted(each.object for each in solution.contacts):
        raise Unsolved(
            "all pressures growing together lead to another equilibrium: the tip is "
            f"{1e3 * apart:.2g} mm away, leaning on {quoted(names) or 'nothing'}"
        )
    for eq in states:
        for each in eq.contacts:
            force = float(np.linalg.norm(each.force))
            if force > each.max_force * (1 + 1e-6):
                text = display_units().force.text(force, ".3g")
                raise Unsolved(f"on the way, '{each.object}' would be pressed with {text}")
    lines = np.array([eq.poses(at)[:, :3, 3] for eq in states])  # (k, stations, 3)
    if others is not None:
        _check_clear(robot, others, lines, at)
    forces = np.array([_largest(eq) for eq in states])
    moved = np.linalg.norm(np.diff(lines, axis=0), axis=-1).max(axis=1)
    rates = (np.diff(shares)[:, None] * p / slew).max(axis=1)
    least = np.maximum.reduce([moved / SPEED, np.abs(np.diff(forces)) / FORCE_RATE, rates])
    return BraceApproach(
        times=np.concatenate([[0.0], np.cumsum(np.maximum(least, 1e-3))]),
        pressures=shares[:, None] * p,
        tip_poses=np.array([eq.tip_pose for eq in states]),
        forces=forces,
        contacts=end.contacts,
        free_tip=robot.tip_pose(p)[:3, 3],
        scene=scene,
    )


def _largest(eq: ContactEquilibrium) -> float:
    found = [float(np.linalg.norm(each.force)) for each in eq.contacts]
    return max(found, default=0.0)


def _check_clear(robot: Manipulator, others: Scene, lines: Vector, at: Vector) -> None:
    """Refuse a way (k, stations, 3) on which the body comes too near to other objects."""
    radii = robot.body_radius(np.zeros(robot.n_pressures), at)
    for item in measured_scene(others, robot.description).items:
        gaps = item.distances(lines.reshape(-1, 3)).values.reshape(lines.shape[:2]) - radii
        gaps = gaps[:, at >= item.begin]
        if gaps.size and gaps.min() < others.clearance - _FORGIVEN:
            missing = display_units().length.text(others.clearance - float(gaps.min()), ".2g")
            raise Unsolved(f"on the way into contact the body is {missing} too near an object")
