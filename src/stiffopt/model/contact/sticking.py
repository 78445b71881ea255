"""`Sticking`: how contacts with friction hold, and slide; linear about an equilibrium.

The tangential forces t (2k,) of k contacts change with pressures and pushes while they stick. Where
one exceeds the cone of friction, the body slides back to it, along the force::

    t = t' + K s,    s_j = -lambda_j t_j,    |t_j| = mu_j N_j,    lambda_j >= 0

with the forces t' without a slide and the arm's stiffness K at its contacts. An arm is far stiffer
along its axis than across, so slides of 0.1 mm relieve it along the axis, and few across.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array

_ROUNDS = 10  # over the contacts, and of Newton's method at one
_SAME = 1e-3  # share of the cone within which a force is on it
_LEAST = 1e-6  # N, a force of a contact that is about to open


class Sticking(NamedTuple):
    """How the k contacts with friction hold, linear about an equilibrium without their friction.

    Each has a tangential force with two components, on the arm. They change with pressures and
    pushes while the body does not slide, and with its slides. Those without friction stay closed.

    Attributes
    ----------
    own : their indices among all contacts (k,).
    across : directions (k, 2, 3) of the components, in base axes.
    friction : coefficients (k,).
    per_pressure : derivatives of the forces (2k, n), in N/Pa.
    per_push : by a force at the tip in base axes (2k, 3).
    per_slide : by slides of the body (2k, 2k), in N/m.
    tip : derivatives of the tip's place and turn, base axes, by the slides (6, 2k).
    normals : of the normal forces of all contacts by the slides (contacts, 2k), in N/m.
    """

    own: tuple[int, ...]
    across: Array
    friction: Array
    per_pressure: Array
    per_push: Array
    per_slide: Array
    tip: Array
    normals: Array

    def slides(self, forces: Array) -> Array:
        """Return the slides (2k,), in m, that tangential forces (2k,) withhold."""
        return np.asarray(-np.linalg.solve(self.per_slide, forces))

    def softened(self, compliance: float) -> Sticking:
        """Return the same for contacts whose surfaces give way along themselves, by so many m/N.

        Two contacts that stick at almost the same station hold almost the same thing, so that K,
        the stiffness against slides, is huge in one direction, or negative by rounding. With the
        compliance c, ``G = (1 + c K)^-1`` is the share of a slide that the body takes part in.
        """
        stiffness, axes = np.linalg.eigh((self.per_slide + self.per_slide.T) / 2)
        rigid = stiffness <= 0
        share = np.where(rigid, 0.0, 1 / (1 + compliance * np.maximum(stiffness, 0.0)))
        given = axes * share @ axes.T
        return self._replace(
            per_pressure=given @ self.per_pressure,
            per_push=given @ self.per_push,
            per_slide=axes * np.where(rigid, 1 / compliance, stiffness * share) @ axes.T,
            tip=self.tip @ given,
            normals=self.normals @ given,
        )

    def bent(self) -> tuple[Array, Array]:
        """Return what tangential forces change, against an arm that slides freely.

        Of the tip's place and turn (6, 2k), and of all normal forces (contacts, 2k).
        """
        slides = -self.slides(np.eye(len(self.per_slide)))
        return self.tip @ slides, self.normals @ slides

    def slid_back(self, forces: Array, normals: Array) -> Array:
        """Return the slides (2k,) that bring tangential forces (2k,) back to their cones.

        Along each force, as in ``t = t' + K s``, ``s_j = -lambda_j t_j`` and ``|t_j| = mu_j N_j``.
        `normals`: normal forces of all contacts without slides, in N.
        """
        slides = np.zeros_like(forces)
        parts = [slice(2 * i, 2 * i + 2) for i in range(len(self.own))]
        for _ in range(_ROUNDS):
            last = slides.copy()
            for i, own in enumerate(parts):
                K = self.per_slide[own]
                force = forces[own] + K @ slides - K[:, own] @ slides[own]
                j = self.own[i]
                most = self.friction[i] * float(normals[j] + self.normals[j] @ slides)
                slides[own] = _slide(force, max(most, _LEAST), K[:, own])
            if np.abs(slides - last).max(initial=0.0) <= _SAME * np.abs(slides).max(initial=0.0):
                break
        return slides


def _slide(force: Array, most: float, K: Array) -> Array:
    """Return the slide (2,) of a contact whose force (2,) exceeds the most that friction holds.

    `K`: stiffness (2, 2) against slides, in N/m. Newton's method for the inverse of the force,
    which grows nearly linearly with lambda.
    """
    if math.hypot(*force) <= most:
        return np.zeros(2)
    stiffness, axes = np.linalg.eigh(K)
    own, share = axes.T @ force, 0.0
    stiffness = np.maximum(stiffness, _SAME * stiffness.max())
    for _ in range(_ROUNDS):
        left = own / (1 + share * stiffness)
        size = math.hypot(*left)
        if abs(size - most) <= _SAME * most:
            break
        slope = float(left @ (stiffness / (1 + share * stiffness) * left)) / size**3
        share = max(share + (1 / most - 1 / size) / slope, 0.0)
    return -share * (axes @ left)
