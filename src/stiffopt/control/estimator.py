"""Kalman filter of the tip's pose, from pressures and a late, noisy and sometimes wrong tracker.

In the base frame, the tip is at the model's position for the effective pressures, plus an offset d
that changes slowly (model error, payload, creep), plus a vibration xi in the soft plane::

    y = s(p) + d + xi,      xi' = w - s_v',      w' = -2 zeta omega w - omega^2 xi

s_v is the part of the static displacement in which the first bending mode takes part
(`BendingMode`), and w the speed of that mode. The orientation has an offset of its own, and turns
with the vibration.

The vibration is the sum of a driven one, which the pressures excite from rest, and a free one,
which samples correct. A sample is compared with the state at its capture: the driven vibration of
that time, and the free one propagated back to it. The correction is propagated to the present,
which for a linear system equals filtering again from the time of capture. The model's error grows
with the tip's displacement, and so does the process noise of d and xi.

Viscosity makes the shape follow other pressures p, which are late. The mode has inertia, and feels
pressures that are ahead of these by a: to w' comes ``omega^2 s_v(a)``.

The frequency is ``omega = (1 + e)`` times that of the model. The filter also has the derivatives of
its state by e, with which each sample corrects e (recursive prediction error method, L. Ljung,
System Identification, 1999, section 11.4), and the state as if e had been known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.formula import Formula
from stiffopt.control.interface import SampleCounts
from stiffopt.control.principal import principal_axes
from stiffopt.control.tuning import EstimatorTuning
from stiffopt.control.vibration import BendingMode, lateral_stiffness, transition
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.interface import PoseSample

Symbols = Any  # of CasADi

_MODE_EVERY = 8  # steps between updates of frequency and soft plane, which change slowly
_NO_ROTATION = (1.0, 0.0, 0.0, 0.0)
_GIVES = 1e-9  # least compliance in a direction, over the greatest, that is not rounding


class _PastTip(NamedTuple):
    """The tip at one time as the pressures alone predict it."""

    time: float
    # rows (5, 3): position, the driven xi and w, and their derivatives by the relative frequency
    motion: Array
    rotation: Array  # (3, 3)
    pressures: Array  # that the shape has followed (n,), in Pa

    @property
    def static(self) -> Array:
        """Position (3,)."""
        return self.motion[0]


@dataclass(frozen=True)
class TipEstimate:
    """Estimated tip, in the base frame."""

    static: Array  # position (3,) of the model, in m
    offset: Array  # d (3,), in m
    turn: Array  # offset of the orientation (3,), as a rotation vector in base axes
    vibration: Array  # xi (3,), in m
    speed: Array  # w (3,), in m/s
    rotation: Array  # (3, 3)
    quaternion: Array  # (4,), w first

    @property
    def position(self) -> Array:
        """Position (3,), in m."""
        return self.static + self.offset + self.vibration


class TipEstimator:
    """Estimates the tip's pose, its offset from the model and its vibration.

    Parameters
    ----------
    period : duration of a step, in s.
    n : number of channels.
    mode : the arm's first bending mode, or None for an arm that does not vibrate.
    tuning : noise and outlier rejection.
    """

    def __init__(
        self, period: float, n: int, mode: BendingMode | None, tuning: EstimatorTuning
    ) -> None:
        self._period, self._mode, self._tuning = period, mode, tuning
        self._past: deque[_PastTip] = deque(maxlen=max(4, round(tuning.memory / period)))
        self._predict = _prediction(mode, n, tuning.damping)
        self._correct = _correction(tuning, mode is not None)
        self._orientation = _orientation()
        self.omega = math.inf  # of the vibration, in rad/s; infinite before it is known
        self._times = np.array([1.0, period])  # omega, and duration of the step
        self._directions = _directions(tuning)
        # displacement (3, n) of the mode per pressure beyond that of the straight arm, in m/Pa
        self.excess: Array = np.zeros((3, n))
        self.begin()

    def begin(self) -> None:
        """Restart with an arm at rest."""
        self._past.clear()
        # free vibration xi and w with their derivatives by the relative frequency, as far as
        # samples have changed them; and that of the offset
        self._free, self._offset_slope = np.zeros((4, 3)), np.zeros(3)
        # relative error of the mode's frequency, and its variance
        t = self._tuning
        self.detuning = np.array([t.frequency_offset, t.frequency_deviation**2])
        # whether samples correct the frequency: only while a planned motion swings the arm, since
        # what shakes it from outside has another frequency
        self.learns = False
        self.offset = np.zeros(6)  # tip pose relative to the model's: d in m, and a rotation vector
        self.soft_plane = np.diag([1.0, 1.0, 0.0])  # projection on the directions of low stiffness
        self.stiff_axis = np.diag([0.0, 0.0, 1.0])  # on those of a stiffness that is far higher
        self._lean: Array = np.zeros((3, 3))  # rotation of the tip per vibration
        self._pressures: Array | None = None
        deviations = (0.1, 0.05, 0.1) if self._mode is not None else (0.0, 0.0, 0.1)
        self._covariance = np.diag(np.square(deviations))  # of xi, w, d in the soft plane
        # variances of d along the stiff axis and of the orientation's offset
        self._variances = np.array([deviations[2] ** 2, 0.5**2])
        # path lengths since the last sample, of the model's tip and of the mode's excitation
        self._displacements = np.zeros(2)
        self._used_until = -math.inf
        self._ticks = 0
        self.sample: PoseSample | None = None  # the latest that was used
        self.predicted: Array = np.zeros(3)  # position at its capture without the offset
        self.turned: Array = np.zeros(3)  # rotation vector from the orientation predicted likewise
        self.modelled: Array = np.eye(3)  # the model's rotation at that time
        self.captured: Array = np.zeros(0)  # pressures (n,) at that time, in Pa
        # amplitudes of the driven and the free vibration at that time, in m
        self.swings = (0.0, 0.0)
        self._first: PoseSample | None = None
        self._unchanged: tuple[Array, Array] | None = None  # a sample, and the model's tip with it
        self._last_sample, self._rejected = -math.inf, 0

    @property
    def estimate(self) -> TipEstimate:
        """The tip now."""
        now, vibration = self._past[-1], self.vibration
        offset, turn = self.offset[:3], self.offset[3:]
        rotation, quaternion = self._orientation(turn, self._lean, vibration[0], now.rotation)
        return TipEstimate(
            now.static, offset, turn, vibration[0], vibration[1], rotation, quaternion
        )

    @property
    def position(self) -> Array:
        """Estimated position (3,) without the vibration, in m."""
        return self._past[-1].static + self.offset[:3]

    @property
    def vibration(self) -> Array:
        """Vibration and its speed (2, 3), in m and m/s."""
        return self._past[-1].motion[1:3] + self._free[:2]

    @property
    def deviation(self) -> float:
        """Standard deviation of the offset's position along the axis where it is largest, in m."""
        return math.sqrt(max(float(self._covariance[2, 2]), float(self._variances[0])))

    @property
    def frequency_factor(self) -> tuple[float, float]:
        """The vibration's frequency over that of the model, and its standard deviation."""
        error, variance = self.detuning.tolist()
        return 1 + error, math.sqrt(variance)

    @property
    def frequency_off(self) -> float:
        """The size of e, over the largest that the estimator permits."""
        return abs(float(self.detuning[0])) / self._tuning.frequency_bound

    @property
    def turn_known(self) -> bool:
        """Whether the tracker measures orientations."""
        return self.sample is not None and self.sample.quaternion is not None

    def advance(self, now: float, pressures: Array, tip: TipAt, ahead: Array | float = 0.0) -> None:
        """Predict the state at the end of a step, at the time `now`, in s.

        `pressures` (n,), in Pa, are those that the shape has followed; `tip` is the model's tip
        there. The mode feels pressures that are `ahead` (n,) of these.
        """
        if self._mode is not None:
            self._update_mode(tip)
        rotation = tip.pose[:3, :3]
        if self._pressures is None:
            motion = np.zeros((5, 3))
            motion[0] = tip.pose[:3, 3]
        else:
            last = self._past[-1]
            self._times[1] = now - last.time  # longer than the period in a loop that is late
            motion, self._free, self._displacements = self._predict(
                tip.pose, tip.jacobian, last.motion, self._free, self.soft_plane, pressures,
                self._pressures, ahead, self._times, self.excess, self._displacements,
            )  # fmt: skip
        self._pressures = pressures.copy()
        self._past.append(_PastTip(now, motion, rotation, self._pressures))

    def take(self, samples: Sequence[PoseSample]) -> SampleCounts:
        """Correct the state by samples, each at the time of its capture.

        Samples are ignored if they are older than the newest that was used or than the memory, if
        they did not see the tip, or if they repeat a pose exactly although the arm has moved.
        """
        used = rejected = 0
        for sample in samples:
            if not sample.visible or not self._past:
                continue
            if not self._used_until < sample.time <= self._past[-1].time + self._period:
                continue  # too old, from the future, or NaN
            past = self._past_at(sample.time)
            if past is None or self._is_frozen(sample, past):
                continue
            if self._is_plausible(sample, past):
                self._update(sample, past)
                used += 1
            elif self.sample is not None:
                rejected += 1
                self._rejected += 1
                if self._rejected >= self._tuning.patience:  # supervision has acted long before
                    self.sample = self._first = None
            self._last_sample = sample.time
        return SampleCounts(used, rejected, self._used_until)

    def change_model(self, before: TipAt, after: TipAt) -> Array:
        """Change to another model, whose tip is `after` where the last model's tip is `before`.

        The estimated tip stays where it is: the offset takes up the difference. Return the change
        of the offset (6,), in m and rad.
        """
        shift = after.pose[:3, 3] - before.pose[:3, 3]
        turn = after.pose[:3, :3] @ before.pose[:3, :3].T
        own = np.asarray(lie.exp(np.concatenate([np.zeros(3), self.offset[3:]])))
        left = np.asarray(lie.log(own @ lie.transform(turn.T, np.zeros(3))))[3:]
        offset = np.concatenate([self.offset[:3] - shift, left])
        change, self.offset = offset - self.offset, offset
        moved = np.vstack([shift, np.zeros((4, 3))])
        past = [
            each._replace(motion=each.motion + moved, rotation=turn @ each.rotation)
            for each in self._past
        ]
        self._past.clear()
        self._past.extend(past)
        self.predicted = self.predicted + shift
        if self._unchanged is not None:
            self._unchanged = self._unchanged[0], self._unchanged[1] + shift
        return change

    def set_frequency(self, omega: float, tip: TipAt) -> None:
        """Set the mode's frequency, in rad/s, at the configuration of the model's tip `tip`."""
        if self._mode is not None:
            compliances = np.linalg.eigvalsh(tip.compliance[:3, :3])
            self._mode = self._mode.at_frequency(omega, lateral_stiffness(compliances))

    def frequency_at(self, tip: TipAt) -> float:
        """Return the model's frequency, in rad/s, where its tip is `tip`; NaN without vibration."""
        return self._modelled_frequency(np.linalg.eigvalsh(tip.compliance[:3, :3]))

    def _modelled_frequency(self, compliances: NDArray[Any]) -> float:
        if self._mode is None:
            return math.nan
        omega = self._mode.frequency(lateral_stiffness(compliances))
        return max(self._tuning.least_frequency, omega)

    def change_frequency(self, before: float, after: float) -> None:
        """Change e as the model's frequency, in rad/s, at the present configuration changes.

        What samples have told of the frequency stays, and the prior goes with the model. With v
        the variance of e and v0 that of the prior, e takes up the share ``1 - v / v0`` of the
        change.
        """
        if self._mode is None:
            return
        error, variance = self.detuning
        t = self._tuning
        told = 1 - variance / t.frequency_deviation**2 if t.frequency_deviation > 0 else 0.0
        error += told * (1 + error) * (before / after - 1)
        self.detuning = np.array([np.clip(error, -t.frequency_bound, t.frequency_bound), variance])

    def _update_mode(self, tip: TipAt) -> None:
        """Update frequency, soft plane and lean from the compliance, every few steps."""
        self._ticks += 1
        if self._ticks % _MODE_EVERY != 1 or self._mode is None:
            return
        self.soft_plane, self.stiff_axis, self._lean, compliances = self._directions(
            tip.pose, tip.compliance
        )
        omega = (1 + float(self.detuning[0])) * self._modelled_frequency(compliances)
        self._times[0] = self.omega = omega

    def _transition(self, duration: float) -> Array:
        """Return the transition matrix (2, 2) of the free vibration over a duration in s."""
        if not math.isfinite(self.omega):
            return np.eye(2)
        return np.array(transition(self.omega, self._tuning.damping, duration))

    def _past_at(self, time: float) -> _PastTip | None:
        """Interpolate the past at a time; None if it is older than the memory."""
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
        motion = before.motion + share * (after.motion - before.motion)
        pressures = before.pressures + share * (after.pressures - before.pressures)
        return _PastTip(time, motion, (before if share < 0.5 else after).rotation, pressures)

    def _is_plausible(self, sample: PoseSample, past: _PastTip) -> bool:
        """Whether the tip can have moved there since the last sample, or is expected there."""
        if self.sample is None:  # use the first one once a second one agrees
            before, self._first = self._first, sample
            return before is not None and self._is_near(sample, before.position, before.time)
        if self._is_near(sample, self.sample.position, self._last_sample):
            return True
        free = self._transition(past.time - self._past[-1].time) @ self._free[:2]
        expected = past.motion[0] + past.motion[1] + free[0] + self.offset[:3]
        return self._is_near(sample, expected, self._last_sample)

    def _is_near(self, sample: PoseSample, position: Array, since: float) -> bool:
        """Whether a tip at a position (3,) at a time `since` can have reached the sample's."""
        elapsed = min(sample.time - since, self._tuning.longest_gap)
        reach = self._tuning.max_speed * elapsed + 10 * self._tuning.noise
        return math.dist(sample.position, position) <= reach

    def _is_frozen(self, sample: PoseSample, past: _PastTip) -> bool:
        """Whether the tracker repeats a position although the model's tip has moved."""
        if self._unchanged is None or (sample.position != self._unchanged[0]).any():
            self._unchanged = sample.position, past.static
            return False
        return math.dist(past.static, self._unchanged[1]) > self._tuning.frozen

    def _update(self, sample: PoseSample, past: _PastTip) -> None:
        first = not math.isfinite(self._used_until)
        elapsed = 0.0 if first else sample.time - self._used_until
        age = self._past[-1].time - past.time
        has_orientation = sample.quaternion is not None
        (
            self._free, self.offset, self._covariance, self._variances, self._offset_slope,
            self.detuning, self.predicted, swings, self.turned,
        ) = self._correct(
            past.motion, past.rotation, self._past[-1].motion, self._free, self.offset,
            self.soft_plane, self._lean, self._covariance, self._variances,
            (age, elapsed, self.omega, self.learns), self._displacements, sample.position,
            sample.quaternion if has_orientation else _NO_ROTATION, has_orientation,
            self._offset_slope, self.detuning,
        )  # fmt: skip
        self._displacements = np.zeros(2)
        self._used_until = sample.time
        self.sample, self._rejected = sample, 0
        self.captured, self.modelled = past.pressures, past.rotation
        self.swings = float(swings[0]), float(swings[1])


def _prediction(mode: BendingMode | None, n: int, damping: float) -> Formula:
    """Return the formula of one step of the state.

    Inputs: pose (4, 4) and Jacobian (6, n) of the model's tip, the last motion (5, 3), see
    `_PastTip`, the free vibration with its slope (4, 3), soft plane (3, 3), pressures (n,) now and
    before, by how much those that the mode feels are ahead (n,), (omega, duration), the mode's
    displacement per pressure (3, n) beyond that of the straight arm, and displacements (2,) of tip
    and mode so far.
    Outputs: motion, free vibration with its slope, and displacements.
    """
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    motion, free_motion = ca.SX.sym("motion", 5, 3), ca.SX.sym("free", 4, 3)
    before, driven, slope = motion[0, :].T, motion[1:3, :], motion[3:, :]
    free, free_slope = free_motion[:2, :], free_motion[2:, :]
    now, last = ca.SX.sym("now", n), ca.SX.sym("last", n)
    soft_plane, times = ca.SX.sym("soft_plane", 3, 3), ca.SX.sym("times", 2)
    excess, ahead = ca.SX.sym("excess", 3, n), ca.SX.sym("ahead", n)
    so_far = ca.SX.sym("so_far", 2)
    position, excitation = pose[:3, 3], ca.SX.zeros(3)
    driven_after, free_after, slope_after, free_slope_after = driven, free, slope, free_slope
    if mode is not None:
        excitation, pull = (
            soft_plane @ (pose[:3, :3] @ (jacobian[:3, :] @ (ca.DM(mode.participation) * p)))
            + excess @ p
            for p in (now - last, ahead)
        )
        omega, elapsed = times[0], times[1]
        F = transition(omega, damping, elapsed)
        # half of what acts on the mode does so at the beginning of the step, half at its end
        half = 0.5 * ca.vertcat(-excitation.T, elapsed * omega**2 * pull.T)
        driven_after, free_after = F @ (driven + half) + half, F @ free
        xi, w = ca.vertsplit(0.5 * (driven + free + driven_after + free_after))
        force = -2 * omega**2 * (xi - pull.T) - 2 * damping * omega * w
        half = 0.5 * ca.vertcat(ca.SX.zeros(1, 3), elapsed * force)
        slope_after, free_slope_after = F @ (slope + half) + half, F @ free_slope
    displacements = ca.vertcat(ca.norm_2(position - before), ca.norm_2(excitation))
    inputs = [
        pose, jacobian, motion, free_motion, soft_plane, now, last, ahead, times, excess, so_far,
    ]  # fmt: skip
    after = ca.vertcat(position.T, driven_after, slope_after)
    outputs = [after, ca.vertcat(free_after, free_slope_after), so_far + displacements]
    return Formula(inputs, outputs, [jacobian, excess])


def _correction(tuning: EstimatorTuning, vibrates: bool) -> Formula:
    """Return the formula of the measurement update by one sample.

    Inputs at the capture: motion (5, 3), see `_PastTip`, and the model's rotation (3, 3).
    Now: motion, free vibration with its slope (4, 3), offset of the pose (6,), soft plane and lean
    (3, 3), covariance (3, 3) of xi, w and d in the soft plane, variances (2,) of d along the stiff
    axis and of the turn.
    Of the sample: (age, time since the last sample, omega, 1 if it may correct the frequency),
    displacements (2,) since the last sample, position (3,), quaternion (4,), and 1 if it has one.
    Slope of the offset's position (3,); and (error of the frequency, its variance).
    Outputs: free vibration with its slope, offset, covariance, variances, the offset's slope, the
    frequency's error with its variance, the position (3,) expected without the offset and the free
    vibration, and amplitudes (2,) of the driven and the free vibration.
    """
    t = tuning
    motion, rotation = ca.SX.sym("motion", 5, 3), ca.SX.sym("rotation", 3, 3)
    motion_now, free_motion = ca.SX.sym("motion_now", 5, 3), ca.SX.sym("free", 4, 3)
    static, driven, slope = motion[0, :].T, motion[1:3, :], motion[3:, :]
    slope_now, free, free_slope = motion_now[3:, :], free_motion[:2, :], free_motion[2:, :]
    pose_offset = ca.SX.sym("offset", 6)
    offset, turn = pose_offset[:3], pose_offset[3:]
    soft_plane, lean = ca.SX.sym("soft_plane", 3, 3), ca.SX.sym("lean", 3, 3)
    covariance, variances = ca.SX.sym("covariance", 3, 3), ca.SX.sym("variances", 2)
    times, displacements = ca.SX.sym("times", 4), ca.SX.sym("displacements", 2)
    position, quaternion = ca.SX.sym("position", 3), ca.SX.sym("quaternion", 4)
    has_orientation = ca.SX.sym("has_orientation")
    offset_slope, detuning = ca.SX.sym("offset_slope", 3), ca.SX.sym("detuning", 2)
    age, elapsed, omega, learns = ca.vertsplit(times)

    # process noise, from the time and the displacement since the last sample
    model_error = (t.model_error * displacements[0]) ** 2
    drift = t.drift**2 * elapsed + model_error
    length = ca.fmax(1e-3, ca.norm_2(static))
    axial = variances[0] + drift
    angular = variances[1] + t.angular_drift**2 * elapsed + model_error / length**2 * 4
    vibration = driven
    if vibrates:
        vibration = driven + transition(omega, t.damping, -age) @ free
        excited = t.excitation_error * displacements[1]
        detuned = t.frequency_error * omega**2 * elapsed * ca.norm_2(vibration[0, :])
        Q = [excited**2, t.agitation**2 * elapsed + (omega * excited) ** 2 + detuned**2, drift]
        F = ca.diagcat(transition(omega, t.damping, elapsed), 1)
        P = F @ covariance @ F.T + ca.diag(ca.vertcat(*Q))
        P = 0.5 * (P + P.T)
    else:
        P = covariance + ca.diagcat(0, 0, drift)

    # in the soft plane xi, w and d; along the stiff axis d alone
    innovation = position - (static + vibration[0, :].T + offset)
    H = ca.DM([1.0 if vibrates else 0.0, 0.0, 1.0])
    PH = P @ H
    noise = t.noise**2
    gain = PH / (H.T @ PH + noise)
    axial_gain = axial / (axial + noise)
    soft = soft_plane @ innovation if vibrates else innovation
    free_after, free_slope_after = free, free_slope
    offset_slope_after, detuning_after = offset_slope, detuning
    offset_after = offset + gain[2] * soft + axial_gain * (innovation - soft)
    if vibrates:
        F = transition(omega, t.damping, age)
        before = slope + transition(omega, t.damping, -age) @ free_slope
        psi = soft_plane @ (before[0, :].T + offset_slope)  # of the expected position
        free_slope_after = free_slope - F @ (gain[:2] @ psi.T)
        offset_slope_after = offset_slope - gain[2] * psi
        variance = detuning[1] + learns * t.frequency_change**2 * displacements[1]
        variance = ca.fmin(variance, t.frequency_deviation**2)
        weight = learns / (H.T @ PH + noise)
        variance /= 1 + variance * ca.sumsqr(psi) * weight
        error = detuning[0] + variance * ca.dot(psi, soft) * weight
        error = ca.fmin(ca.fmax(error, -t.frequency_bound), t.frequency_bound)
        detuning_after = ca.vertcat(error, variance)
        change = error - detuning[0]
        free_after = free + F @ (gain[:2] @ soft.T) + change * (slope_now + free_slope_after)
        offset_after += change * offset_slope_after

    def turn_from(expected: ca.SX) -> ca.SX:
        """Return the rotation vector to the measured orientation from the model's, turned."""
        between = lie.rotation_from_quaternion(quaternion) @ (_rotation(expected) @ rotation).T
        return lie.rotation_vector_from_quaternion(lie.quaternion_from_rotation(between))

    angle = turn_from(turn + lean @ vibration[0, :].T)
    turned = turn_from(lean @ driven[0, :].T)
    angular_gain = has_orientation * angular / (angular + t.angular_noise**2)
    inputs = [
        motion, rotation, motion_now, free_motion, pose_offset, soft_plane, lean, covariance,
        variances, times, displacements, position, quaternion, has_orientation, offset_slope,
        detuning,
    ]  # fmt: skip
    swings = [
        ca.norm_2(ca.vertcat(each[0, :].T, each[1, :].T / omega)) for each in (driven, free_after)
    ]
    variances_after = ca.vertcat((1 - axial_gain) * axial, (1 - angular_gain) * angular)
    outputs = [
        ca.vertcat(free_after, free_slope_after),
        ca.vertcat(offset_after, turn + angular_gain * angle), P - gain @ PH.T, variances_after,
        offset_slope_after, detuning_after, static + driven[0, :].T, ca.vertcat(*swings), turned,
    ]  # fmt: skip
    return Formula(inputs, outputs)


def _directions(tuning: EstimatorTuning) -> Formula:
    """Return the formula of the directions in which the tip vibrates, in base axes.

    Inputs: pose (4, 4) and compliance (6, 6) of the model's tip.
    Outputs: `soft_plane`, `stiff_axis` and the lean (3, 3), and the principal compliances (3,).
    """
    pose, compliance = ca.SX.sym("pose", 4, 4), ca.SX.sym("compliance", 6, 6)
    values, axes = principal_axes(compliance[:3, :3])
    rotation, softest = pose[:3, :3], values[2]
    # in a strongly bent arm no direction is entirely stiff
    soft = ca.fmin(1, values / (tuning.soft_share * softest))
    stiff = ca.fmax(0, 1 - values / (tuning.stiff_share * softest))
    # a tip that leans on objects may give way in one direction only
    gives = ca.logic_and(values > _GIVES * softest, ca.DM([0, 1, 1]))
    turns = compliance[3:, :3] @ axes @ ca.diag(gives / ca.if_else(gives, values, 1))
    outputs = [
        rotation @ matrix @ axes.T @ rotation.T
        for matrix in (axes @ ca.diag(soft), axes @ ca.diag(stiff), turns)
    ]
    return Formula([pose, compliance], [*outputs, values])


def _orientation() -> Formula:
    """Return the formula of the tip's rotation (3, 3) and quaternion (4,).

    Inputs: offset of the orientation (3,), lean (3, 3), vibration (3,), the model's rotation (3,
    3).
    """
    turn, lean = ca.SX.sym("turn", 3), ca.SX.sym("lean", 3, 3)
    vibration, rotation = ca.SX.sym("vibration", 3), ca.SX.sym("rotation", 3, 3)
    turned = _rotation(turn + lean @ vibration) @ rotation
    outputs = [turned, lie.quaternion_from_rotation(turned)]
    return Formula([turn, lean, vibration, rotation], outputs)


def _rotation(vector: Symbols) -> Symbols:
    """Return the rotation (3, 3) of a rotation vector (3,)."""
    return lie.exp(ca.vertcat(ca.SX.zeros(3), vector))[:3, :3]
