"""Where the tip is, from the pressures and a tracker that is late, noisy and now and then wrong.

In the base frame, the tip is where the model puts it for the pressures in the chambers, plus an
offset d that changes slowly (model error, payload, creep), plus a swing xi in the soft plane::

    y = s(p) + d + xi,      xi' = w - s_v',      w' = -2 zeta omega w - omega^2 xi

where s_v is the part of the static motion that the first bending mode has (see `Vibration`) and w
the speed of that mode.  The tip's orientation has an offset of its own, and turns with the swing.

The swing is the sum of one that the pressures drive, from rest, and of a free one that samples
teach.  A Kalman filter on xi, w and d takes samples at the time of their capture: the difference is
taken from what the driven swing was then, with the free one brought back to that moment, and what
it teaches is carried on to the present, which for a linear model is the same as to run everything
again from there.  How far the model may be off depends on how far it has moved: the noise that
drives d and xi grows with the way of s.  `tip_filter` has the formulas.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.control import tip_filter
from stiffopt.control.steering import Seen
from stiffopt.control.vibration import Vibration
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.interface import PoseSample

__all__ = ["EstimatorSettings", "TipEstimate", "TipEstimator"]

Array = NDArray[np.float64]

_REMEMBERED = 0.4  # s; older samples are of no use
_SOFT = 0.15  # of the softest direction's compliance; directions with less swing less
_SLOWEST = 0.5  # rad/s; an arm about to buckle swings no slower, as far as the filter is concerned
_FROZEN = 2e-3  # m; a tip that the model moves by more cannot be seen where it was
_GIVEN_UP = 40  # rejected samples in a row after which all begins anew
_UNTURNED = (1.0, 0.0, 0.0, 0.0)
_LONGEST_LEAP = 0.05  # s; a tip that jumps and stays there is not believed after any time


@dataclass(frozen=True)
class EstimatorSettings:
    """How much is believed, and how quickly.

    Attributes
    ----------
    noise : standard deviation of a tracked position in each axis, in m.
    angular_noise : of a tracked orientation, in rad.
    max_speed : no tip moves faster, in m/s.
    model_error : by which share of its way the model may go wrong.
    drift : growth of the offset's standard deviation while nothing moves, in m / sqrt(s).
    angular_drift : the same of the orientation, in rad / sqrt(s).
    agitation : of the swing's speed, from what is not modelled, in m/s / sqrt(s).
    frequency_error : by which share the square of the swing's frequency may be wrong.
    damping : share of critical damping of the swing.
    """

    noise: float = 5e-5
    angular_noise: float = 2e-3
    max_speed: float = 1.0
    model_error: float = 0.2
    drift: float = 3e-4
    angular_drift: float = 3e-3
    agitation: float = 2e-3
    frequency_error: float = 0.2
    damping: float = 0.04


class _Moment(NamedTuple):
    """What the pressures alone have done to the tip."""

    time: float
    static: Array  # (3,)
    rotation: Array  # (3, 3)
    driven: Array  # (2, 3): xi, w


@dataclass(frozen=True)
class TipEstimate:
    """Where the tip is thought to be.

    Attributes
    ----------
    static : (3,), where the model puts it, in m.
    offset : (3,) d, in m.
    turn : (3,) rotation vector of the orientation's offset, base axes.
    swing, speed : (3,) xi and w, in m and m/s.
    rotation, quaternion : (3, 3) and (4,), w first, of the tip in the base.
    """

    static: Array
    offset: Array
    turn: Array
    swing: Array
    speed: Array
    rotation: Array
    quaternion: Array

    @property
    def position(self) -> Array:
        """(3,), in m."""
        result: Array = self.static + self.offset + self.swing
        return result


class TipEstimator:
    """Follows the tip.

    Parameters
    ----------
    period :
        Of the steps, in s.
    n :
        Number of channels.
    vibration :
        The arm's first bending mode, or None for an arm that does not swing.
    settings :
        What is believed.

    Attributes
    ----------
    omega : float
        Angular frequency of the swing, in rad/s; infinite while it is not known.
    across_matrix : ndarray
        What of a vector (3, 3) is in the directions in which the tip is soft.
    beside : ndarray
        By what the tip is beside the model (6,): d, and the rotation vector of its turn.
    sample : PoseSample or None
        The last that was used.
    """

    def __init__(
        self, period: float, n: int, vibration: Vibration | None, settings: EstimatorSettings
    ) -> None:
        self._period, self._vibration, self._settings = period, vibration, settings
        self._past: deque[_Moment] = deque(maxlen=max(4, round(_REMEMBERED / period)))
        self._predict = tip_filter.prediction(vibration, n, settings.damping)
        self._correct = tip_filter.correction(settings, vibration is not None)
        self._orient = tip_filter.orientation()
        self.omega = math.inf
        self._times = np.array([1.0, period])  # omega, and since the step before
        self.begin()

    def begin(self) -> None:
        """Start anew, with an arm at rest."""
        self._past.clear()
        self._free = np.zeros((2, 3))
        self.beside = np.zeros(6)
        self._offset, self._turn = self.beside[:3], self.beside[3:]
        self.across_matrix = np.diag([1.0, 1.0, 0.0])
        self._lean: Array = np.zeros((3, 3))  # turn of the tip per swing
        self._pressures: Array | None = None
        wide = (0.1, 0.05, 0.1) if self._vibration is not None else (0.0, 0.0, 0.1)
        self._covariance = np.diag(np.square(wide))  # of xi, w, d in the soft plane
        self._variances = np.array([wide[2] ** 2, 0.5**2])  # of d along the stiff axis, and of turn
        self._ways = np.zeros(2)  # of the model's tip, and of what drives the swing
        self._used_until = -math.inf
        self._ticks = 0
        self.sample: PoseSample | None = None
        self._first: PoseSample | None = None
        self._same: tuple[Array, Array] | None = None  # a position, and the model's when it came
        self._seen_at, self._refused = -math.inf, 0

    @property
    def estimate(self) -> TipEstimate:
        """Where the tip is now."""
        now, swing = self._past[-1], self.swing
        rotation, quaternion = self._orient(self._turn, self._lean, swing[0], now.rotation)
        return TipEstimate(
            now.static, self._offset, self._turn, swing[0], swing[1], rotation, quaternion
        )

    @property
    def swing(self) -> Array:
        """Swing and its speed (2, 3), in m and m/s."""
        result: Array = self._past[-1].driven + self._free
        return result

    @property
    def turn_known(self) -> bool:
        """Whether the tracker tells orientations."""
        return self.sample is not None and self.sample.quaternion is not None

    def advance(self, now: float, pressures: Array, tip: TipAt) -> None:
        """Take a step, at whose end the chambers have pressures (n,), and the model this tip."""
        if self._vibration is not None:
            self._look_at_mode(tip)
        rotation = tip.pose[:3, :3]
        if self._pressures is None:
            self._past.append(_Moment(now, tip.pose[:3, 3].copy(), rotation, np.zeros((2, 3))))
        else:
            last = self._past[-1]
            self._times[1] = now - last.time  # which for a loop that is late is no period
            static, driven, self._free, ways = self._predict(
                tip.pose, tip.jacobian, last.static, last.driven, self._free, self.across_matrix,
                pressures - self._pressures, self._times,
            )  # fmt: skip
            self._ways += ways
            self._past.append(_Moment(now, static, rotation, driven))
        self._pressures = pressures.copy()

    def take(self, samples: Sequence[PoseSample]) -> Seen:
        """Learn from samples, each at the time of its capture.

        Those that are older than the newest that was used, or than what is remembered, those of a
        tip that was not seen, and those that repeat a pose to the last digit while the arm should
        have moved, are left out.
        """
        used = rejected = 0
        for sample in samples:
            if not sample.visible or not self._past:
                continue
            if not self._used_until < sample.time <= self._past[-1].time + self._period:
                continue  # old, from the future, or of no time at all
            moment = self._moment(sample.time)
            if moment is None:
                continue
            if self._repeats(sample, moment):
                continue
            if self._plausible(sample, moment):
                self._learn(sample, moment)
                used += 1
            elif self.sample is not None:
                rejected += 1
                self._refused += 1
                if self._refused >= _GIVEN_UP:  # whoever watches has long drawn the conclusion
                    self.sample = self._first = None
            self._seen_at = sample.time
        return Seen(used, rejected, self._used_until)

    # -- of the swing ---------------------------------------------------------------------------

    def _look_at_mode(self, tip: TipAt) -> None:
        """Take frequency, soft plane and lean from the compliance, now and then: they are slow."""
        self._ticks += 1
        if self._ticks % 8 != 1 or self._vibration is None:
            return
        rotation = tip.pose[:3, :3]
        linear = rotation @ tip.compliance[:3, :3] @ rotation.T
        softness, axes = np.linalg.eigh(linear)
        # of a strongly bent arm, no direction is stiff altogether
        share = np.minimum(1.0, softness / (_SOFT * softness[2]))
        self.across_matrix = axes * share @ axes.T
        omega = self._vibration.frequency(2 / float(softness[1] + softness[2]))
        self.omega = max(_SLOWEST, omega)
        self._times[0] = self.omega
        turning = rotation @ tip.compliance[3:, :3] @ rotation.T
        self._lean = turning @ axes[:, 1:] @ np.diag(1 / softness[1:]) @ axes[:, 1:].T

    def _transition(self, duration: float) -> Array:
        """What a duration in s does to the free swing (2, 2)."""
        if not math.isfinite(self.omega):
            return np.eye(2)
        F: Array = np.array(tip_filter.transition(self.omega, self._settings.damping, duration))
        return F

    # -- of the samples -------------------------------------------------------------------------

    def _moment(self, time: float) -> _Moment | None:
        """What was at a moment, between two steps; None if it is out of memory."""
        past = self._past
        if time < past[0].time:
            return None
        index = len(past) - 1
        while index > 0 and past[index].time > time:
            index -= 1
        before = past[index]
        if index == len(past) - 1:
            return before
        after = past[index + 1]
        share = (time - before.time) / (after.time - before.time)
        return _Moment(
            time,
            before.static + share * (after.static - before.static),
            before.rotation if share < 0.5 else after.rotation,
            before.driven + share * (after.driven - before.driven),
        )

    def _plausible(self, sample: PoseSample, moment: _Moment) -> bool:
        """Whether a tip can have got there since it was last seen, or is where it is expected."""
        if self.sample is None:  # two must agree before the first is believed
            before, self._first = self._first, sample
            return before is not None and self._is_near(sample, before.position, before.time)
        if self._is_near(sample, self.sample.position, self._seen_at):
            return True
        free = self._transition(moment.time - self._past[-1].time) @ self._free
        expected = moment.static + moment.driven[0] + free[0] + self._offset
        return self._is_near(sample, expected, self._seen_at)

    def _is_near(self, sample: PoseSample, position: Array, since: float) -> bool:
        """Whether a tip that was at a position (3,) can be where the sample has it."""
        elapsed = min(sample.time - since, _LONGEST_LEAP)
        reach = self._settings.max_speed * elapsed + 10 * self._settings.noise
        return math.dist(sample.position, position) <= reach

    def _repeats(self, sample: PoseSample, moment: _Moment) -> bool:
        """Whether a tracker says the same again and again while the arm should have moved."""
        if self._same is None or (sample.position != self._same[0]).any():
            self._same = sample.position, moment.static
            return False
        return math.dist(moment.static, self._same[1]) > _FROZEN

    def _learn(self, sample: PoseSample, moment: _Moment) -> None:
        first = not math.isfinite(self._used_until)
        elapsed = 0.0 if first else sample.time - self._used_until
        age = self._past[-1].time - moment.time
        told = sample.quaternion is not None
        self._free, offset, turn, self._covariance, self._variances = self._correct(
            moment.static, moment.rotation, moment.driven, self._free, self._offset, self._turn,
            self.across_matrix, self._lean, self._covariance, self._variances,
            (age, elapsed, self.omega), self._ways, sample.position,
            sample.quaternion if told else _UNTURNED, told,
        )  # fmt: skip
        self.beside = np.concatenate([offset, turn])
        self._offset, self._turn = self.beside[:3], self.beside[3:]
        self._ways = np.zeros(2)
        self._used_until = sample.time
        self.sample, self._refused = sample, 0
