"""`Friction`: what friction does at the contacts of a braced arm, which nobody measures.

A body that has slid on an object is held back by friction, with the coefficient times the normal
force, against its slide. So the way into contact ends with a force that the plan has followed
(`stiffopt.model.contact.way`), and with a tip that is off by what this force bends. From there it
follows from what is commanded, to first order about the end of the way (`Sticking`).
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.contact.push import until_equal
from stiffopt.paths.leaning import Hold

_SAME = 1e-3  # share of the cone within which a force is on it


class Friction:
    """Tangential forces of contacts with friction.

    Parameters
    ----------
    hold, planned : the contacts, linearised about their equilibrium without friction at the end of
        the way, and its pressures (n,).

    Attributes
    ----------
    forces : (2k,), on the arm, in N; see `Sticking`.
    tip : derivatives (6, 2k) of the tip's place and turn by them, base axes.
    """

    def __init__(self, hold: Hold, planned: Array) -> None:
        self._hold, self._sticking, self._planned = hold, hold.sticking, planned
        self._own = list(hold.sticking.own)
        self.forces: Array = hold.tangential
        self._pressures = planned
        held = hold.sticking
        self.tip, self._normals = held.bent()
        self.per_push = hold.per_push + self._normals @ held.per_push
        self.per_pressure = hold.per_pressure + self._normals @ held.per_pressure

    def follow(self, pressures: Array, share: float, creep: float = 0.0) -> None:
        """Go on to pressures (n,), in Pa, while creep makes them count more by a share.

        Their noise would move a contact that is about to slide, so only a share of their change
        counts at a time.
        """
        change = share * (pressures - self._pressures)
        self._pressures = self._pressures + change
        trial = self.forces + self._sticking.per_pressure @ (change + creep * pressures)
        normals = self.sliding(self._pressures) + self._normals @ trial
        slides = self._sticking.slid_back(trial, normals)
        self.forces = trial + self._sticking.per_slide @ slides

    def sliding(self, pressures: Array) -> Array:
        """Return the normal forces (contacts,) of an arm that slides freely, in N."""
        return self._hold.forces + self._hold.per_pressure @ (pressures - self._planned)

    def normals(self, pressures: Array) -> Array:
        """Return the normal forces (contacts,) at pressures (n,), in N."""
        return self.sliding(pressures) + self._normals @ self.forces

    def slid(self, push: Array, normals: Array) -> Array:
        """Return how far the contacts (k,) slide under a push (3,) at the tip, in m.

        `normals`: normal forces (contacts,) before, in N.
        """
        trial = self.forces + self._sticking.per_push @ push
        slides = self._sticking.slid_back(trial, normals + self.per_push @ push)
        return np.linalg.norm(slides.reshape(-1, 2), axis=1)

    def left(self, way: Array, normals: Array) -> float:
        """Return the push in N along a unit vector (3,) at which a contact begins to slide."""
        held, inside = self._sticking, 1 - 2 * _SAME  # a force on the cone may also leave it
        rates, changes, least = held.per_push @ way, self.per_push @ way, math.inf
        for i, j in enumerate(self._own):
            own, mu = slice(2 * i, 2 * i + 2), held.friction[i]
            now = inside * self.forces[own]
            least = min(least, until_equal(now, rates[own], mu * normals[j], mu * changes[j]))
        return least
