"""`BraceCorrection`: slow changes of a brace's pressures that bring the tip to its target."""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.friction import Friction
from stiffopt.paths.leaning import Hold


class BraceCorrection:
    """Corrects the tip of a braced arm, with constant contact forces.

    Once the tip has come to its target, contacts that are to stick are also relieved of the
    friction that the way into contact left: the pressures change the tangential forces while the
    tip stays.

    Parameters
    ----------
    hold : the contacts at the end of the way.
    friction : of contacts that are to stick; None if they may slide.
    n : number of pressures.
    tuning : times and limits.

    Attributes
    ----------
    change : of the planned pressures (n,), in Pa.
    """

    def __init__(
        self, hold: Hold, friction: Friction | None, n: int, tuning: BracingTuning
    ) -> None:
        self._hold, self._friction, self._tuning = hold, friction, tuning
        self.change: Array = np.zeros(n)
        self._recent: Array = np.zeros(3)  # of the tip, by the model; friction may withhold it
        self._is_off = False  # the tip is known to stay off its target
        self._nearest = (math.inf, 0.0)  # distance of the tip from it, in m, and when it fell to it

    def correct(
        self,
        elapsed: float,
        held: float,
        error: Array,
        jacobian: Array,
        low: Array,
        high: Array,
    ) -> str:
        """Change the pressures; return the words of a tip that stays off its target, once.

        Parameters
        ----------
        elapsed, held : time since the last call, and in contact, in s.
        error : of the tip (3,), in m; zero in components that the target leaves open.
        jacobian : of the position of a tip whose contacts slide, base axes (3, n), in m/Pa.
        low, high : least and greatest changes (n,) that the limits of pressure leave, in Pa.
        """
        t, hold, friction = self._tuning, self._hold, self._friction
        words = self._stays_off(held, float(np.linalg.norm(error)))
        rows, wanted = [jacobian, t.force_weight * hold.per_pressure], [error]
        if friction is not None and held >= t.settling:  # the tip has come to its target
            rates = hold.sticking.per_pressure
            jacobian = jacobian + friction.tip[:3] @ rates
            rows = [jacobian, t.force_weight * friction.per_pressure, t.force_weight * rates]
            wanted = [error, np.zeros(len(hold.forces)), -t.force_weight * friction.forces]
        step = elapsed * self._step(np.vstack(rows), np.concatenate(wanted), low, high)
        time, speed = t.first_time, t.first_speed
        if held >= t.settling:  # so slow that a push which is not felt yet is quicker
            time, speed = t.time, t.correction_speed
        step /= time
        step *= min(1.0, speed * elapsed / max(float(np.linalg.norm(jacobian @ step)), 1e-12))
        before = self.change
        self.change = np.clip(before + step, -t.most_change, t.most_change)
        self._recent = self._recent + jacobian @ (self.change - before)
        return words

    def withheld(self, off: Array) -> Array:
        """Return the part of the recent correction (3,), in m, that explains a residual (3,) best.

        A contact with friction sticks at first and slips later, so the tip may lag behind the
        correction, or catch up, by up to all of it.
        """
        square = float(self._recent @ self._recent)
        share = -float(off @ self._recent) / max(square, 1e-12)
        return float(np.clip(share, -1.0, 1.0)) * self._recent

    def forget(self, elapsed: float) -> None:
        """Let the recent correction fade, as friction withholds it only for some time."""
        self._recent *= 1 - min(elapsed / self._tuning.withheld_time, 1.0)

    def _stays_off(self, held: float, off: float) -> str:
        """Return the words of a tip whose distance from its target, in m, does not fall; once."""
        t, (least, since) = self._tuning, self._nearest
        if off < (1 - t.progress) * least:
            self._nearest = off, held
        elif not self._is_off and least > t.off_target and held > since + t.patience:
            self._is_off = True
            text = f"the tip stays {1e3 * off:.1f} mm from its target while the arm leans"
            own = self._hold.sticking.own
            return f"{text}; friction may hold the body" if own else text
        return ""

    def _step(self, rows: Array, wanted: Array, low: Array, high: Array) -> Array:
        """Return the change (n,) of pressures that fits rows (m, n) @ it best.

        To relieve friction takes all channels, so those at their limits are known to stay there.
        `wanted` may lack zeros at its end. A channel that comes to its limit stays there for this
        step, even if the others could then do better without that: the next steps make it up.
        """
        n = len(self.change)
        A = np.vstack([rows, self._tuning.pressure_weight * np.eye(n)])
        b = np.concatenate([wanted, np.zeros(len(A) - len(wanted))])
        if self._friction is None:
            low, high = np.full(n, -np.inf), np.full(n, np.inf)
        else:
            most = self._tuning.most_change
            low = np.clip(low, -most - self.change, 0.0)
            high = np.clip(high, 0.0, most - self.change)
        step, free = np.zeros(n), np.ones(n, dtype=bool)
        while free.any():
            B = A[:, free]
            step[free] = np.linalg.solve(B.T @ B, B.T @ (b - A[:, ~free] @ step[~free]))
            beyond = (step < low) | (step > high)
            if not beyond.any():
                break
            step, free = np.clip(step, low, high), free & ~beyond
        return step
