"""`Friction`: what friction does at the contacts of a braced arm, which nobody measures.

A body that has slid on an object is held back by friction, with the coefficient times the normal
force, against its slide. So the way into contact ends with a force that the motion tells, and with
a tip that is off by what this force bends. From there it follows from what is commanded: the
tangential forces t (2k,) of k contacts change with pressures and pushes while they stick. Where one
exceeds the cone of friction, the body slides back to it, along the force::

    t = t' + K s,    s_j = -lambda_j t_j,    |t_j| = mu_j N_j,    lambda_j >= 0

with the forces t' without a slide and the arm's stiffness K at its contacts. An arm is far stiffer
along its axis than across, so slides of 0.1 mm relieve it along the axis, and few across.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.push import until_equal
from stiffopt.paths.leaning import Hold

Array = NDArray[np.float64]

_ROUNDS = 10  # over the contacts, and of Newton's method at one
_SAME = 1e-3  # share of the cone within which a force is on it
_LEAST = 1e-6  # N, a force of a contact that is about to open


class Friction:
    """Tangential forces of contacts with friction.

    Parameters
    ----------
    hold, planned :
        The contacts, linearised about their equilibrium without friction, and its pressures (n,).

    Attributes
    ----------
    forces : (2k,), on the arm, in N; see `Sticking`.
    tip : derivatives (6, 2k) of the tip's place and turn by them, base axes.
    """

    def __init__(self, hold: Hold, planned: Array) -> None:
        self._hold, self._sticking, self._planned = hold, hold.sticking, planned
        self._own = list(hold.sticking.own)
        self.forces = np.zeros(2 * len(self._own))
        self._pressures: Array | None = None
        held = hold.sticking
        own = [slice(2 * i, 2 * i + 2) for i in range(len(self._own))]
        self._principal = [np.linalg.eigh(held.per_slide[each, each]) for each in own]
        # what a tangential force changes, against an arm that slides freely
        bent = -held.slides(np.eye(2 * len(own)))
        self.tip, self._normals = held.tip @ bent, held.normals @ bent
        self.per_push = hold.per_push + self._normals @ held.per_push
        self.per_pressure = hold.per_pressure + self._normals @ held.per_pressure

    def follow(self, pressures: Array, share: float, creep: float = 0.0) -> None:
        """Go on to pressures (n,), in Pa, while creep makes them count more by a share.

        Their noise would move a contact that is about to slide, so only a share of their change
        counts at a time.
        """
        if self._pressures is None:
            self._pressures = pressures
        change = share * (pressures - self._pressures)
        self._pressures = self._pressures + change
        trial = self.forces + self._sticking.per_pressure @ (change + creep * pressures)
        slides = self._slides(trial, self.sliding(self._pressures) + self._normals @ trial)
        self.forces = trial + self._sticking.per_slide @ slides

    def sliding(self, pressures: Array) -> Array:
        """Return the normal forces (contacts,) of an arm that slides freely, in N."""
        found: Array = self._hold.forces + self._hold.per_pressure @ (pressures - self._planned)
        return found

    def normals(self, pressures: Array) -> Array:
        """Return the normal forces (contacts,) at pressures (n,), in N."""
        found: Array = self.sliding(pressures) + self._normals @ self.forces
        return found

    def slid(self, push: Array, normals: Array) -> Array:
        """Return how far the contacts (k,) slide under a push (3,) at the tip, in m.

        `normals`: normal forces (contacts,) before, in N.
        """
        trial = self.forces + self._sticking.per_push @ push
        slides = self._slides(trial, normals + self.per_push @ push)
        found: Array = np.linalg.norm(slides.reshape(-1, 2), axis=1)
        return found

    def left(self, way: Array, normals: Array) -> float:
        """Return the push in N along a unit vector (3,) at which a contact begins to slide."""
        held, inside = self._sticking, 1 - 2 * _SAME  # a force on the cone may also leave it
        rates, changes, least = held.per_push @ way, self.per_push @ way, math.inf
        for i, j in enumerate(self._own):
            own, mu = slice(2 * i, 2 * i + 2), held.friction[i]
            now = inside * self.forces[own]
            least = min(least, until_equal(now, rates[own], mu * normals[j], mu * changes[j]))
        return least

    def _slides(self, trial: Array, normals: Array) -> Array:
        """Return the slides (2k,) that bring forces (2k,) back to their cones."""
        held, slides = self._sticking, np.zeros_like(trial)
        for _ in range(_ROUNDS):
            last = slides.copy()
            for i, j in enumerate(self._own):
                own = slice(2 * i, 2 * i + 2)
                K = held.per_slide[own]
                force = trial[own] + K @ slides - K[:, own] @ slides[own]
                most = held.friction[i] * float(normals[j] + held.normals[j] @ slides)
                slides[own] = _slide(force, max(most, _LEAST), *self._principal[i])
            if np.abs(slides - last).max(initial=0.0) <= _SAME * np.abs(slides).max(initial=0.0):
                break
        return slides


def _slide(force: Array, most: float, stiffness: Array, axes: Array) -> Array:
    """Return the slide (2,) of a contact whose force (2,) exceeds the most that friction holds.

    `stiffness` (2,) along the columns of `axes` (2, 2). Newton's method for the inverse of the
    force, which grows nearly linearly with lambda.
    """
    if math.hypot(*force) <= most:
        return np.zeros(2)
    own, share = axes.T @ force, 0.0
    stiffness = np.maximum(stiffness, _SAME * stiffness.max())
    for _ in range(_ROUNDS):
        left = own / (1 + share * stiffness)
        size = math.hypot(*left)
        if abs(size - most) <= _SAME * most:
            break
        slope = float(left @ (stiffness / (1 + share * stiffness) * left)) / size**3
        share = max(share + (1 / most - 1 / size) / slope, 0.0)
    found: Array = -share * (axes @ left)
    return found
