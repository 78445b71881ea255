"""An arm that leans on the studio's objects at held pressures.

While an object is dragged, the pressures are constant and the arm yields to it: equilibrium,
contact forces and braced stiffness follow the object. (With a task, the solver would move the arm
out of its way.)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import FIGURES, display_units
from stiffopt.errors import InputError
from stiffopt.model.contact.equilibrium import Approach, Contact, ContactEquilibrium
from stiffopt.model.contact.push import ContactLoss
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.plots import style
from stiffopt.plots.shapes import StiffnessEllipsoid
from stiffopt.studio.design import Design
from stiffopt.studio.drawing import NOWHERE, ArmTube, add_force_arrows, draw, place, rgb, turn

_LARGEST_PUSH = 1.0  # N, up to which the loss of a contact is sought
_ARROW_SHARE, _ELLIPSOID_SHARE = 0.25, 0.22  # of the arm's length


@dataclass(frozen=True, eq=False)
class Leaning:
    """An arm at held pressures among the objects of a design.

    Attributes
    ----------
    design : contains the scene and the stiffness to show.
    robot : the arm, with the task's load.
    equilibrium : with contacts.
    """

    design: Design
    robot: Manipulator
    equilibrium: ContactEquilibrium
    _losses: dict[str, ContactLoss] = field(default_factory=dict)

    @classmethod
    def of(cls, design: Design, robot: Manipulator, pressures: Array) -> Leaning:
        """Find the equilibrium of an arm against objects that allow contact.

        With a brace it is reached as that says, else the objects come to the arm.

        Raises `InputError`: no object allows contact; `EquilibriumError`: the arm slips off, snaps
        through or buckles on the way.
        """
        scene = design.task.scene
        if scene is None or not any(each.may_be_leant_on for each in scene.objects):
            raise InputError(
                "there is nothing to lean on; choose an object and tick 'may be leant on'"
            )
        brace = design.task.brace
        approach: Approach = "objects" if brace is None else brace.approach
        found = robot.contact_equilibrium(pressures, scene, approach=approach)
        return cls(design, robot, found)

    @property
    def measure(self) -> StiffnessMeasure | None:
        """The task's first stiffness with a direction, or None."""
        found = (each for each in self.design.task.measures if isinstance(each, StiffnessMeasure))
        return next(found, None)

    @cached_property
    def stiffness(self) -> tuple[float, float] | None:
        """The measure's value for the free arm at these pressures, and for the leaning arm."""
        m = self.measure
        if m is None:
            return None
        parts = (m.direction, m.kind, m.boundary, m.frame)
        free = self.robot.stiffness(self.equilibrium.pressures, *parts)
        return float(free), self.equilibrium.stiffness(*parts)

    def pushes(self) -> tuple[ContactLoss, ContactLoss] | None:
        """Return the pushes along and against the direction that lose the first contact."""
        m = self.measure
        if m is None or m.kind != "translation" or not self.equilibrium.contacts:
            return None
        way = np.array(m.direction)
        if m.frame == "tip":
            way = self.equilibrium.tip_pose[:3, :3] @ way
        for name, sign in (("along", 1), ("against", -1)):
            if name not in self._losses:
                self._losses[name] = self.equilibrium.lift_off(sign * way, _LARGEST_PUSH)
        return self._losses["along"], self._losses["against"]


def contact_rows(contacts: Iterable[Contact]) -> Iterable[tuple[str, str]]:
    """Yield the panel's rows on contacts, as names and plain text."""
    units = display_units()
    for each in contacts:
        force = float(np.linalg.norm(each.force))
        limit = f" of {units.force.text(each.max_force)}" if np.isfinite(each.max_force) else ""
        over = ", TOO MUCH" if force > each.max_force else ""
        at = units.length.text(each.at, ".1f")
        yield (
            f"on {each.object}",
            f"{units.force.text(force, '.3g')}{limit}, {at} from the base{over}",
        )


def leaning_rows(leaning: Leaning) -> Iterable[tuple[str, str]]:
    """Yield the panel's rows on a leaning arm, as names and plain text."""
    units = display_units()
    if leaning.stiffness is not None and leaning.measure is not None:
        free, braced = leaning.stiffness
        unit = units.of_si(leaning.measure.unit)
        yield "braced", f"{unit.text(braced, FIGURES)}, {braced / free:.3g} times the free arm's"
        yield "free", unit.text(free, FIGURES)
    yield from contact_rows(leaning.equilibrium.contacts)
    if not leaning.equilibrium.contacts:
        yield "contacts", "none: drag an object that may be leant on against the arm"
    pushes = leaning.pushes()
    if pushes is not None:
        texts = [_loss_text(each) for each in pushes]
        yield "a push of", f"{texts[0]} along the direction, {texts[1]} against it loses a contact"
    if not leaning.equilibrium.stable:
        yield "stability", "unstable: the arm would not stay so"


def _loss_text(loss: ContactLoss) -> str:
    unit = display_units().force
    if not np.isfinite(loss.force):
        return f"more than {unit.text(_LARGEST_PUSH)}"
    return unit.text(loss.force, ".3g")


def force_arrows(equilibrium: ContactEquilibrium | None, length: float) -> Any:
    """Return arrows (k, 2, 3) of the contact forces on an arm; they end at the contacts."""
    contacts = () if equilibrium is None else equilibrium.contacts
    largest = max((np.linalg.norm(each.force) for each in contacts), default=1.0)
    ends = [
        (each.position - _ARROW_SHARE * length * each.force / largest, each.position)
        for each in contacts
    ]
    return np.array(ends, dtype=np.float32) if ends else NOWHERE


class LeaningView:
    """Draws a leaning arm: its shape, the forces on it, and its braced stiffness.

    `server`: viser.ViserServer. `description`: the robot.
    """

    def __init__(self, server: Any, description: RobotDescription) -> None:
        scene, length = server.scene, description.length
        self._length = length
        self._arm = ArmTube(server, "/leaning", description, style.MEASURED, 0.6)
        self._ellipsoid = scene.add_icosphere(
            "/leaning/ellipsoid", radius=1.0, subdivisions=3, color=rgb(style.MEASURED),
            opacity=0.25, visible=False,
        )  # fmt: skip
        self._forces = add_force_arrows(server, "/leaning/forces", length)

    @property
    def visible(self) -> bool:
        """Whether the leaning arm is visible."""
        return self._arm.visible

    @property
    def arm_end(self) -> Array:
        """Position of the drawn arm's end (3,), in m."""
        return self._arm.end

    def show(self, leaning: Leaning | None) -> None:
        """Draw a leaning arm; None hides it."""
        if leaning is None:
            self._arm.visible = self._ellipsoid.visible = False
            draw(self._forces, NOWHERE)
            return
        found = leaning.equilibrium
        self._arm.show(leaning.robot, found.pressures, found)
        self._show_ellipsoids(leaning)
        draw(self._forces, force_arrows(found, self._length))

    def _show_ellipsoids(self, leaning: Leaning) -> None:
        """Draw the braced ellipsoid, to the scale of the free arm's, which `AnswerView` draws."""
        pose = leaning.equilibrium.tip_pose
        braced = StiffnessEllipsoid.of(leaning.equilibrium.tip_compliance, pose[:3, :3])
        p = leaning.equilibrium.pressures
        free = StiffnessEllipsoid.of(leaning.robot.tip_compliance(p), np.eye(3))
        scale = _ELLIPSOID_SHARE * self._length / np.sqrt(free.stiffnesses.max())
        place(self._ellipsoid, pose[:3, 3])
        turn(self._ellipsoid, lie.quaternion_from_rotation(braced.axes))
        self._ellipsoid.scale = tuple((scale * np.sqrt(braced.stiffnesses)).tolist())
        self._ellipsoid.visible = True
