"""Report the equilibrium of an arm that leans on objects: on the terminal and as JSON."""

from typing import Any, NamedTuple

import numpy as np
from rich.console import Group, RenderableType

from stiffopt.cli.solve_records import contact_record, loss_record
from stiffopt.cli.tables import TextTable, labelled, title
from stiffopt.display import FIGURES, display_units
from stiffopt.errors import printable
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.plots.wording import vector_text

_AXES = dict(zip("xyz", np.eye(3), strict=True))


def record(robot: Manipulator, found: ContactEquilibrium) -> dict[str, Any]:
    """Return an equilibrium for JSON, in SI units."""
    return {
        "robot": robot.description.name,
        "pressures_pa": found.pressures,
        "tip_position_m": found.tip_pose[:3, 3],
        "stable": found.stable,
        "within_limits": found.within_limits,
        "contacts": [contact_record(each) for each in found.contacts],
        "friction_tip_m": found.friction.tip,
        "friction_forces_n": found.friction.forces,
        "stiffness": {name: _stiffness(robot, found, d) for name, d in _AXES.items()},
    }


def _stiffness(robot: Manipulator, found: ContactEquilibrium, d: Any) -> dict[str, Any]:
    return {
        "free_n_per_m": robot.stiffness(found.pressures, d),
        "sliding_n_per_m": found.stiffness(d),
        "sticking_n_per_m": found.stiffness(d, contacts="sticking"),
        "lost": [loss_record(found.lift_off(sign * d)) for sign in (1, -1)],
    }


class PressedContact(NamedTuple):
    """A contact, or those along a line as one: `force` in N, `where` in words."""

    object: str
    where: str
    force: float
    max_force: float


def pressed_contacts(found: ContactEquilibrium) -> list[PressedContact]:
    """Return the contacts that have a limit of their own, from the base to the tip."""
    unit, rows = display_units().length, []
    for own, force in found.pressed():
        at = sorted(found.contacts[j].at for j in own)
        where = f"at {unit.text(at[0], '.1f')}"
        if len(at) > 1:
            where = f"from {unit.number(at[0], '.1f')} to {unit.text(at[-1], '.1f')}"
        each = found.contacts[own[0]]
        rows.append((at[0], PressedContact(each.object, where, force, each.max_force)))
    return [row for _, row in sorted(rows)]


def summary(robot: Manipulator, found: ContactEquilibrium) -> RenderableType:
    """Return the report of an equilibrium."""
    units = display_units()
    said = record(robot, found)
    facts: list[tuple[str, RenderableType]] = [
        ("tip", f"{vector_text(found.tip_pose[:3, 3], units.length)} {units.length}"),
        ("stable", "yes" if found.stable else "no"),
    ]
    if not found.contacts:
        facts.append(("contacts", "none: at these pressures the arm touches no object"))
    if said["friction_tip_m"]:
        facts.append(("friction", friction_text(found)))
    parts: list[RenderableType] = [
        title(f"{printable(robot.description.name)}: leaning on objects"), labelled(facts),
    ]  # fmt: skip
    if found.contacts:
        rows = tuple(
            (
                printable(each.object),
                each.where,
                units.force.number(each.force),
                units.force.number(each.max_force) if np.isfinite(each.max_force) else "-",
            )
            for each in pressed_contacts(found)
        )
        heading = ("contact", "along the arm", f"force ({units.force})", f"at most ({units.force})")
        parts.append(TextTable("", heading, rows).renderable())
    lines = tuple(
        (
            name,
            *(units.stiffness.number(each[key], FIGURES) for key in
              ("free_n_per_m", "sliding_n_per_m", "sticking_n_per_m")),
            *(_loss_text(loss) for loss in each["lost"]),
        )
        for name, each in said["stiffness"].items()
    )  # fmt: skip
    headings = ("along", "free", "sliding", "sticking", "lost at +", "lost at -")
    remark = (
        f"{units.stiffness}, contacts sliding and sticking; lost: the push at the tip, along and "
        "against the axis, by which the first contact lifts off or the arm buckles if all slide, "
        f"in {units.force}"
    )
    parts.append(TextTable("", headings, lines, remark).renderable())
    return Group(*parts)


def friction_text(found: ContactEquilibrium) -> str:
    """Say what friction can change."""
    units, bounds = display_units(), found.friction
    return (
        f"can keep the tip up to {units.length.text(bounds.tip, '.2g')} from there, and contact "
        f"forces up to {units.force.text(bounds.forces.max(), '.2g')} from these"
    )


def _loss_text(loss: dict[str, Any]) -> str:
    return "-" if loss["force_n"] is None else display_units().force.number(loss["force_n"], ".3g")
