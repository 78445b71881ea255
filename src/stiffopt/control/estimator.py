"""Where the tip is, from the pressures and a tracker that is late, noisy and now and then wrong.

In the base frame, the tip is where the model puts it for the pressures in the chambers, plus an
offset d that changes slowly (model error, payload, creep), plus a swing xi in the soft plane::

    y = s(p) + d + xi,      xi' = w - s_v',      w' = -2 zeta omega w - omega^2 xi

where s_v is the part of the static motion that the first bending mode has (see `Vibration`) and w
the speed of that mode.  The tip's orientation has an offset of its own, and turns with the swing.

A Kalman filter on xi, w and d takes samples at the time of their capture: the difference is taken
from what was thought of that moment, and what it teaches is carried on to the present, which for a
linear model is the same as to run everything again from there.  How far the model may be off
depends on how far it has moved: the noise that drives d and xi grows with the way of s.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.control.steering import Seen
from stiffopt.control.vibration import Vibration
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.interface import PoseSample

__all__ = ["EstimatorSettings", "TipEstimate", "TipEstimator"]

Array = NDArray[np.float64]

_REMEMBERED = 0.4  # s; older samples are of no use
_SOFT = 0.15  # of the softest direction's compliance; directions with less swing less
_FROZEN = 2e-3  # m; a tip that the model moves by more cannot be seen where it was
_GIVEN_UP = 40  # rejected samples in a row after which all begins anew
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


@dataclass
class _Moment:
    """What was thought of a moment; later corrected by samples that were captured before."""

    time: float
    static: Array  # (3,)
    rotation: Array  # (3, 3), without offset
    swing: Array  # (2, 3): xi, w
    offset: Array  # (3,)


@dataclass(frozen=True)
class TipEstimate:
    """Where the tip is thought to be.

    Attributes
    ----------
    static : (3,), where the model puts it, in m.
    offset : (3,) d, in m.
    turn : (3,) rotation vector of the orientation's offset, base axes.
    swing, speed : (3,) xi and w, in m and m/s.
    """

    static: Array
    offset: Array
    turn: Array
    swing: Array
    speed: Array

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
    sample : PoseSample or None
        The last that was used.
    """

    def __init__(
        self, period: float, vibration: Vibration | None, settings: EstimatorSettings
    ) -> None:
        self._period, self._vibration, self._settings = period, vibration, settings
        self._past: deque[_Moment] = deque(maxlen=max(4, round(_REMEMBERED / period)))
        self.omega = math.inf
        self.begin()

    def begin(self) -> None:
        """Start anew, with an arm at rest."""
        s = self._settings
        self._past.clear()
        self._swing, self._offset, self._turn = np.zeros((2, 3)), np.zeros(3), np.zeros(3)
        self.across_matrix = np.diag([1.0, 1.0, 0.0])
        self._lean: Array = np.zeros((3, 3))  # turn of the tip per swing
        self._pressures: Array | None = None
        wide = (0.1, 0.05, 0.1) if self._vibration is not None else (0.0, 0.0, 0.1)
        self._lateral = np.diag(np.square(wide))  # covariance of xi, w, d in the soft plane
        self._axial = wide[2] ** 2
        self._angular = 0.5**2
        self._way = self._way_of_swing = 0.0
        self._used_until = -math.inf
        self._ticks = 0
        self.sample: PoseSample | None = None
        self._first: PoseSample | None = None
        self._same: tuple[Array, Array] | None = None  # a position, and the model's when it came
        self._seen_at, self._refused = -math.inf, 0
        self._noise = s.noise**2

    @property
    def estimate(self) -> TipEstimate:
        """Where the tip is now."""
        now = self._past[-1]
        return TipEstimate(
            now.static, self._offset, self._turn, self._swing[0].copy(), self._swing[1].copy()
        )

    @property
    def beside(self) -> Array:
        """By what the tip is beside the model (6,): d, and the rotation vector of its turn."""
        return np.concatenate([self._offset, self._turn])

    @property
    def turn_known(self) -> bool:
        """Whether the tracker tells orientations."""
        return self.sample is not None and self.sample.quaternion is not None

    @property
    def rotation(self) -> Array:
        """Orientation of the tip now (3, 3), in the base."""
        turn = self._turn + self._lean @ self._swing[0]
        result: Array = lie.rotation_from_quaternion(_quaternion(turn)) @ self._past[-1].rotation
        return result

    def advance(self, now: float, pressures: Array, tip: TipAt) -> None:
        """Take a step, at whose end the chambers have pressures (n,), and the model this tip."""
        rotation, static = tip.pose[:3, :3], tip.pose[:3, 3].copy()
        if self._past:
            moved = static - self._past[-1].static
            self._way += float(np.linalg.norm(moved))
            if self._vibration is not None and self._pressures is not None:
                self._look_at_mode(tip)
                change = self._vibration.participation * (pressures - self._pressures)
                input_ = self.across(rotation @ (tip.jacobian[:3] @ change))
                self._way_of_swing += float(np.linalg.norm(input_))
                swing = self._swing
                swing[0] -= 0.5 * input_
                swing = self._transition(self._period) @ swing
                swing[0] -= 0.5 * input_
                self._swing = swing
        self._pressures = pressures.copy()
        self._past.append(_Moment(now, static, rotation, self._swing.copy(), self._offset.copy()))

    def ahead(self, duration: float) -> Array:
        """Swing and its speed (2, 3) after a duration in s, if the pressures stay."""
        return self._transition(duration) @ self._swing

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
        self.omega = self._vibration.frequency(2 / float(softness[1] + softness[2]))
        turning = rotation @ tip.compliance[3:, :3] @ rotation.T
        self._lean = turning @ axes[:, 1:] @ np.diag(1 / softness[1:]) @ axes[:, 1:].T

    def across(self, vector: Array) -> Array:
        """Part of a vector (3,) in the directions in which the tip is soft."""
        result: Array = self.across_matrix @ vector
        return result

    def _transition(self, duration: float) -> Array:
        """What a duration in s does to xi and w (2, 2), while the pressures stay."""
        omega = self.omega
        if not math.isfinite(omega):
            return np.eye(2)
        zeta = self._settings.damping
        fast = omega * math.sqrt(1 - zeta**2)
        decay = math.exp(-zeta * omega * duration)
        c, s = decay * math.cos(fast * duration), decay * math.sin(fast * duration) / fast
        return np.array([[c + zeta * omega * s, s], [-(omega**2) * s, c - zeta * omega * s]])

    # -- of the samples -------------------------------------------------------------------------

    def _moment(self, time: float) -> _Moment | None:
        """What was thought of a moment, between two steps; None if it is out of memory."""
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
            before.swing + share * (after.swing - before.swing),
            self._offset,
        )

    def _plausible(self, sample: PoseSample, moment: _Moment) -> bool:
        """Whether a tip can have got there since it was last seen, or is where it is expected."""
        if self.sample is None:  # two must agree before the first is believed
            before, self._first = self._first, sample
            return before is not None and self._is_near(sample, before.position, before.time)
        expected = moment.static + moment.swing[0] + moment.offset
        return self._is_near(sample, self.sample.position, self._seen_at) or self._is_near(
            sample, expected, self._seen_at
        )

    def _is_near(self, sample: PoseSample, position: Array, since: float) -> bool:
        """Whether a tip that was at a position (3,) can be where the sample has it."""
        elapsed = min(sample.time - since, _LONGEST_LEAP)
        reach = self._settings.max_speed * elapsed + 10 * self._settings.noise
        return float(np.linalg.norm(sample.position - position)) <= reach

    def _repeats(self, sample: PoseSample, moment: _Moment) -> bool:
        """Whether a tracker says the same again and again while the arm should have moved."""
        if self._same is None or (sample.position != self._same[0]).any():
            self._same = sample.position, moment.static
            return False
        return float(np.linalg.norm(moment.static - self._same[1])) > _FROZEN

    def _learn(self, sample: PoseSample, moment: _Moment) -> None:
        first = not math.isfinite(self._used_until)
        elapsed = 0.0 if first else sample.time - self._used_until
        self._widen(elapsed, moment)
        surprise = sample.position - (moment.static + moment.swing[0] + moment.offset)
        # in the soft plane: xi, w and d; along the stiff axis: d alone
        row = np.array([1.0, 0.0, 1.0])
        if self._vibration is None:
            row[0] = 0.0
        spread = self._lateral @ row
        gain = spread / (float(row @ spread) + self._noise)
        self._lateral = self._lateral - np.outer(gain, spread)
        axial_gain = self._axial / (self._axial + self._noise)
        self._axial *= 1 - axial_gain
        across = self.across(surprise) if self._vibration is not None else surprise
        offset = gain[2] * across + axial_gain * (surprise - across)
        swing = np.outer(gain[:2], across)
        self._offset = self._offset + offset
        for past in reversed(self._past):
            if past.time < sample.time - self._period:  # what lies just before is corrected too
                break
            past.offset = past.offset + offset
            if self._vibration is not None:
                past.swing = past.swing + self._transition(past.time - sample.time) @ swing
        self._swing = self._past[-1].swing.copy()
        if sample.quaternion is not None:
            self._learn_turn(sample.quaternion, moment)
        self._used_until = sample.time
        self.sample, self._refused = sample, 0

    def _learn_turn(self, quaternion: Array, moment: _Moment) -> None:
        seen = lie.rotation_from_quaternion(quaternion)
        turn = self._turn + self._lean @ moment.swing[0]
        thought = lie.rotation_from_quaternion(_quaternion(turn)) @ moment.rotation
        error = lie.rotation_vector_from_quaternion(lie.quaternion_from_rotation(seen @ thought.T))
        gain = self._angular / (self._angular + self._settings.angular_noise**2)
        self._angular *= 1 - gain
        self._turn = self._turn + gain * error

    def _widen(self, elapsed: float, moment: _Moment) -> None:
        """Let certainty fade over the time since the last sample, and the way gone since then."""
        s = self._settings
        way = (s.model_error * self._way) ** 2
        drift = s.drift**2 * elapsed + way
        self._axial += drift
        length = max(1e-3, float(np.linalg.norm(moment.static)))
        self._angular += s.angular_drift**2 * elapsed + way / length**2 * 4
        if self._vibration is None:
            self._lateral[2, 2] += drift
        else:
            omega = self.omega if math.isfinite(self.omega) else 0.0
            F = np.eye(3)
            F[:2, :2] = self._transition(elapsed)
            P = F @ self._lateral @ F.T
            own = s.model_error * self._way_of_swing
            detuned = s.frequency_error * omega**2 * elapsed * np.linalg.norm(moment.swing[0])
            P[0, 0] += own**2
            P[1, 1] += s.agitation**2 * elapsed + (omega * own) ** 2 + float(detuned) ** 2
            P[2, 2] += drift
            self._lateral = 0.5 * (P + P.T)
        self._way = self._way_of_swing = 0.0


def _quaternion(turn: Array) -> Array:
    """Quaternion (4,) of a rotation vector (3,)."""
    angle = float(np.linalg.norm(turn))
    half = 0.5 * angle
    share = math.sin(half) / angle if angle > 1e-12 else 0.5
    return np.array([math.cos(half), *(share * turn)])
