"""Finds pushes that begin or end while the pressures change: they are no faults.

A push moves the tip off the model's way, as swapped channels or a wrong frame do. But all that is
wrong with the pressures shows as they act: until they have moved the tip, the arm cannot be far off
its way. A push is not bound to them, and turns the tip as the arm's compliance has it. So a
displacement that is larger than all channels together can have caused by then, with the turn of a
push, is a push. For a while the tip's turn then shows how much of its displacement is due to it,
also while the arm swings.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import PushTuning
from stiffopt.control.tip_errors import turn_of_a_push
from stiffopt.optimise.tip import TipAt


class PushWatch:
    """Tells a push from faults by its beginning.

    Parameters
    ----------
    tuning : thresholds of a push.
    vibrates : whether the arm has inertia, so that it moves later than its pressures change.

    Attributes
    ----------
    omega : of the arm's vibration, in rad/s, for its owner to set; a faster arm moves sooner.
    """

    def __init__(self, tuning: PushTuning, *, vibrates: bool) -> None:
        self._tuning, self._late = tuning, tuning.late if vibrates else 0.0
        self.omega = 0.0
        self.begin()

    def begin(self) -> None:
        """Restart without a push."""
        self._until, self._size = -math.inf, 0.0

    def acts(self, now: float) -> bool:
        """Return whether a push has begun or ended lately, at a time in s."""
        return now < self._until

    def take(
        self,
        times: Array,
        seen: Array,
        away: Array,
        turned: Array,
        pressures: Array,
        swings: Array,
        jacobian: Array,
        tip: TipAt,
    ) -> bool:
        """Return whether a push is displacing the tip, by samples until now.

        Parameters
        ----------
        times :
            Times (k,), in s, for as long as pressures move an arm that vibrates.
        seen :
            Measured positions (k, 3), in m.
        away, turned :
            The same (k, 3) and rotations (k, 3), relative to the model's tip, in m and rad.
        pressures :
            Effective pressures (k, n), in Pa.
        swings :
            Amplitudes (k,) of the vibration that the pressures do not drive, in m.
        jacobian :
            Of the tip's position (3, n), base axes, in m/Pa.
        tip :
            The model's tip.
        """
        tuning, now = self._tuning, float(times[-1])
        first = int(times.searchsorted(now - tuning.time))
        ways = away[-1] - away[first:]
        sizes = (ways**2).sum(axis=1)
        farthest = int(np.argmax(sizes))
        size = math.sqrt(float(sizes[farthest]))
        if size < tuning.least or len(times) < 3:
            return False
        if math.dist(seen[-1], seen[first + farthest]) < tuning.moves * size:
            return False  # a tip that lies still has not been pushed
        bent = turn_of_a_push(tip) @ ways[farthest]
        missing = float(np.linalg.norm(turned[-1] - turned[first + farthest] - bent))
        expected = float(np.linalg.norm(bent))
        if expected < tuning.least_turn or missing > tuning.turn * expected:
            return False
        late = self._late * min(1.0, (tuning.slow / max(self.omega, 1e-9)) ** 2)
        acting = slice(max(2, int(times.searchsorted(now - late, "right"))))
        by_channels = self._caused(times[acting], pressures[acting], jacobian)
        by_swing = 2 * float(swings[first])  # from one side to the other
        if size < tuning.share * max(by_channels + tuning.noise, by_swing):
            return False
        self._size = max(size, self._size if self.acts(now) else 0.0)
        self._until = now + tuning.lasts
        return True

    def _caused(self, times: Array, pressures: Array, jacobian: Array) -> float:
        """Return how far all channels can have displaced the tip lately, in m.

        A change that has gone on at one speed counts with the time of a push alone, and less, as
        the arm does not swing with it. If it is slow, only its fastest channel counts: the tip has
        followed all of them until then, and one may just have failed.
        """
        tuning = self._tuning
        begun = max(1, int(times.searchsorted(times[0] + tuning.steady, "right")) - 1)
        rates = (pressures[begun] - pressures[0]) / (times[begun] - times[0])
        gains = np.sqrt((jacobian**2).sum(axis=0))
        away = pressures - rates * (times - times[0])[:, None]
        moved, steady = gains * np.ptp(away, axis=0), gains * np.abs(rates)
        largest, most = float(steady.max()), gains * np.ptp(pressures, axis=0)
        if largest < tuning.slow_change:
            return float(np.minimum(moved, most).sum()) + tuning.time * largest
        moved += tuning.steady_share * tuning.time * steady
        return float(np.minimum(moved, most).sum())

    def displacements(self, away: Array, turned: Array, tip: TipAt) -> Array:
        """Return the displacements (k, 3) that pushes explain of those from the last sample, in m.

        A push may turn the tip further than a force at the tip with that displacement would. What
        is much larger than it was when recognised has another cause, a wall for example.
        """
        turn = turn_of_a_push(tip)
        bent, turns = (away[-1] - away) @ turn.T, turned[-1] - turned
        shares = (bent * turns).sum(axis=1) / np.maximum((bent**2).sum(axis=1), 1e-12)
        by_push = turns @ np.linalg.pinv(turn, rcond=1e-6).T
        explained: Array = by_push / np.clip(shares, 1.0, self._tuning.further)[:, None]
        sizes = np.linalg.norm(explained, axis=1)
        most = self._tuning.grows * self._size
        explained *= np.minimum(1.0, most / np.maximum(sizes, 1e-9))[:, None]
        return explained
