"""The way from rest into contact, and what friction does on it.

On the way the body slides on what it touches, and friction holds it back. The tangential forces t
follow the way from one equilibrium without friction to the next, as in `Sticking`: with the change
of the pressures they become t' = t + T dp, and where they exceed their cones, the body slides back
to these. The arm that they bend is that of the last equilibrium, to first order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.contact.sticking import Sticking
from stiffopt.model.scene import Scene

if TYPE_CHECKING:
    from stiffopt.model.contact.equilibrium import ContactEquilibrium
    from stiffopt.model.manipulator import Manipulator


STATES = 61  # equilibria along the way
TANGENTIAL = 1e-4  # m/N, compliance of a contact that sticks; an arm along itself has 40 times it


class Rubbing(NamedTuple):
    """The effect of friction on an arm that has come into contact.

    Attributes
    ----------
    sticking : how the contacts hold at the end.
    tangential : their forces (2k,), components along `Sticking.across`, in N.
    tip : by which these move the tip (3,), base axes, in m.
    normals : by which these change the normal forces of all contacts (contacts,), in N.
    past : by which the pressures (n,) went past their end and came back, in Pa; None if not.
    """

    sticking: Sticking
    tangential: Array
    tip: Array
    normals: Array
    past: Array | None = None

    def pressing(self, contacts: Sequence[int]) -> float:
        """Return by how much friction presses on contacts, in N; relief does not count."""
        return float(np.maximum(self.normals[list(contacts)], 0.0).sum())


def states_from_rest(arm: Manipulator, scene: Scene, p: Array) -> Iterator[ContactEquilibrium]:
    """Yield equilibria from rest to pressures (n,), which grow in proportion.

    Raises
    ------
    EquilibriumError
        The next one cannot be reached.
    """
    eq: ContactEquilibrium | None = None
    for share in np.linspace(0.0, 1.0, STATES if p.any() else 1):
        eq = arm.contact_equilibrium(share * p, scene, nearby=eq)
        yield eq


def rubbed(states: Iterable[ContactEquilibrium]) -> Rubbing:
    """Return what friction does on a way, at its end; see `rubbings`.

    Raises
    ------
    EquilibriumError
        The arm touches nothing at the end.
    """
    *_, found = None, *rubbings(states)
    if found is None:
        raise EquilibriumError("in smaller steps the arm comes to lean on nothing")
    return found


def rubbings(states: Iterable[ContactEquilibrium]) -> Iterator[Rubbing | None]:
    """Yield what friction does on a way, at each of its equilibria; None without contact.

    A force belongs to the nearest contact with the same object at the next equilibrium.
    """
    carried: list[tuple[str, float, Array]] = []  # object, arc length, and tangential force (3,)
    before: Array | None = None
    for eq in states:
        if not eq.contacts:
            carried, before = [], eq.pressures
            yield None
            continue
        held = eq.sticking.softened(TANGENTIAL)
        own = [eq.contacts[j] for j in held.own]
        t = np.zeros((len(own), 2))
        for name, at, force in carried:
            near = [i for i, each in enumerate(own) if each.object == name]
            if near:
                i = min(near, key=lambda i: abs(own[i].at - at))
                t[i] += held.across[i] @ force
        change = eq.pressures - (eq.pressures if before is None else before)
        trial = t.ravel() + held.per_pressure @ change
        tip, normals = held.bent()
        normal = eq.normal_forces
        forces = trial + held.per_slide @ held.slid_back(trial, normal + normals @ trial)
        parts = np.einsum("ki,kij->kj", forces.reshape(-1, 2), held.across)
        carried = [(each.object, each.at, part) for each, part in zip(own, parts, strict=True)]
        before = eq.pressures
        yield Rubbing(held, forces, tip[:3] @ forces, normals @ forces)
