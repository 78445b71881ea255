"""`BracePushEstimator`: which push at the tip of a braced arm explains what moves it."""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.friction import Friction
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.configurations import maximised
from stiffopt.paths.leaning import BraceApproach


class BracePushEstimator:
    """Estimates pushes from displacements of the tip; see `stiffopt.control.bracing`.

    Parameters
    ----------
    task : with the directions in which the arm is to be stiff.
    approach : the way into contact.
    friction : of the contacts; None if contacts that slide are as good as those that stick.
    tuning : what is expected of pushes and of the model.

    Attributes
    ----------
    per_push : derivatives (k, 3) of the contacts' normal forces by a push.
    """

    def __init__(
        self, task: Task, approach: BraceApproach, friction: Friction | None, tuning: BracingTuning
    ) -> None:
        self._task, self._approach, self._tuning = task, approach, tuning
        self._friction = friction
        self.per_push = approach.hold.per_push if friction is None else friction.per_push

    def likely(self, tip: TipAt, off: Array, creep: float = 0.0) -> tuple[Array, Array]:
        """Return the most likely push (3,) that moves the tip by `off` (3,), and its covariance.

        In base axes, in N. `tip`: model of the braced tip; `creep`: deviation of what else moves
        it, in m.
        """
        R = tip.pose[:3, :3]
        C = R @ tip.compliance[:3, :3] @ R.T
        if self._friction is not None:
            C = C + self._friction.tip[:3] @ self._approach.hold.sticking.per_push
        usual, noise = self.usual(R), self._noise(off) + creep**2 * np.eye(3)
        gain = np.linalg.solve(C @ usual @ C.T + noise, C @ usual).T
        return gain @ off, usual - gain @ C @ usual

    def lost(self, tip: TipAt, change: Array, creep: float) -> Array:
        """Return the forces (k,) that contacts lose if a push moves the tip by `change` (3,).

        See `likely` for the other arguments.
        """
        push, _ = self.likely(tip, change, creep)
        return np.maximum(-(self.per_push @ push), 0.0)

    def feels(self, off: Array, push: Array, before: Array) -> bool:
        """Return whether a displacement (3,) of the tip is more than the model's error.

        It is if it is large, or if its push uses up a share of what a contact holds: an arm that is
        stiff loses its contact before the tip has moved far. `before`: normal forces (k,).
        """
        t, size = self._tuning, float(np.linalg.norm(off))
        uses = float((-(self.per_push @ push) / np.maximum(before, 1e-6)).max())
        if self._friction is not None and push.any():
            force = float(np.linalg.norm(push))
            uses = max(uses, force / max(self._friction.left(push / force, before), 1e-6))
        return size > t.felt or (size > t.least_felt and uses > t.felt_share)

    def usual(self, rotation: Array) -> Array:
        """Return the covariance (3, 3) of pushes before the tip is seen, in N^2; base axes.

        An arm whose contacts are to stick hardly moves along its axis. There, pushes are expected
        rather along the directions in which the task wants it to be stiff.
        """
        t, share = self._tuning, 1.0 if self._friction is None else self._tuning.aside
        turns = {"base": np.eye(3), "tip": rotation}
        ways = np.array([turns[m.frame] @ m.direction for m in maximised(self._task)]).T
        along = ways @ np.linalg.pinv(ways)
        return t.usual_push**2 * (share**2 * np.eye(3) + (1 - share**2) * along)

    def _noise(self, off: Array) -> Array:
        """Return the covariance (3, 3) of a displacement (3,) of the tip that no push explains.

        A tip that is moved by y goes along an arc, so that its place is off the linear response by
        y^2 / (2 length).
        """
        length = float(np.linalg.norm(self._approach.free_tips[0]))
        bent = float(off @ off) / (2 * length)
        return (self._tuning.deviation**2 + bent**2) * np.eye(3)
