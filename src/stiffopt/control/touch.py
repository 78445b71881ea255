"""Estimate the contact force at the tip.

Model error, creep and vibration also displace the tip, so the estimator separates them from the
force. The tracker measures the tip at y; the model predicts s for the present pressures. In each
axis, the difference is modelled as the sum of displacements u, e and xi, with rates r of u and b of
e, and a speed eta of xi::

    y - s = u + e + xi,    u' = r,    r' = -r / T_r,    e' = b + g s_n',    b' = -b / T,
    xi' = eta,    eta' = -2 zeta omega eta - omega^2 xi

A force F on the tip displaces it by u = C F in the directions in which it is soft; along a stiff
axis no force can be felt. e is the error of the model. It changes with motion, by a share of the
way, and creeps at the rate b, which motion sets off; the creep that can be predicted is part of s
(`stiffopt.control.creep`). xi is the part of the first bending mode's vibration that pressures do
not explain. A force that begins displaces the equilibrium, not the tip: u + xi stays the same, so
the following vibration shows its size before it has decayed. While the tip approaches something
along n, g is the error per way s_n of the model's tip along n; it is learned before the contact.

In one sample, force and error look alike; they differ in how they begin. Without contact, u is
zero. At intervals a hypothesis starts: a force has just begun, changed or gone. Each hypothesis is
a Kalman filter of its own; its log-likelihood is compared with that of the present filter (the
generalised likelihood ratio test of Willsky and Jones, 1976). One that is far better replaces the
present filter. A push that grows for seconds is found in parts.

All axes have the same noise, so each filter has one covariance (7, 7) and a mean (7, 3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import CreepTuning, TouchTuning
from stiffopt.control.creep import CreepEstimator
from stiffopt.control.formula import Formula
from stiffopt.control.principal import principal_axes
from stiffopt.optimise.press import SOFT_SHARE
from stiffopt.optimise.tip import TipAt

_U, _R, _E, _B, _G, _XI, _ETA = range(7)  # indices of the state


@dataclass(frozen=True)
class TipForce:
    """Force on the tip, base axes.

    Attributes
    ----------
    touches : whether a force is felt; otherwise the force is zero, except on an approach.
    force : (3,), in N; zero along axes in which the arm cannot feel.
    covariance : of the force (3, 3), in N^2. Along axes in which the arm cannot feel, it is that of
        all forces considered possible.
    displacement : of the tip by the force (3,), in m.
    """

    touches: bool
    force: Array
    covariance: Array
    displacement: Array


@dataclass
class _Filters:
    """The present filter, followed by the hypotheses, k in all."""

    means: Array  # (k, 7, 3)
    covariances: Array  # (k, 7, 7)
    evidence: Array  # (k,) log-likelihoods relative to the present filter
    since: Array  # (k,) when they began, in s
    released: NDArray[np.bool_]  # (k,) whether the hypothesis is that the force has gone

    def keep(self, chosen: Array | list[int]) -> _Filters:
        return _Filters(
            self.means[chosen], self.covariances[chosen], self.evidence[chosen],
            self.since[chosen], self.released[chosen],
        )  # fmt: skip

    def with_one(self, mean: Array, covariance: Array, since: float, released: bool) -> _Filters:
        return _Filters(
            np.concatenate([self.means, mean[None]]),
            np.concatenate([self.covariances, covariance[None]]),
            np.append(self.evidence, 0.0),
            np.append(self.since, since),
            np.append(self.released, released),
        )


class TouchEstimator:
    """Estimates the force on the tip.

    Parameters
    ----------
    segments : number of channels of each segment.
    vibrates : whether the arm vibrates.
    damping : damping ratio of the vibration.
    tuning : noise, and thresholds of the force.
    creep : estimates the creep of the tip; nothing of it is known by default.

    Attributes
    ----------
    creep : estimates the creep of the tip.
    felt : the force at the last sample; NaN before the first.
    stiffness_error : relative deviation of the arm's stiffness; NaN if unknown.
    """

    def __init__(
        self,
        segments: list[int],
        *,
        vibrates: bool,
        damping: float,
        tuning: TouchTuning,
        creep: CreepEstimator | None = None,
    ) -> None:
        self.creep = creep or CreepEstimator(sum(segments), False, CreepTuning())
        self._tuning, self._damping, self._vibrates = tuning, damping, vibrates
        self._ends = np.cumsum([0, *segments[:-1]])
        swings = float(vibrates)
        self._seen = np.array([1.0, 0.0, 1.0, 0.0, 0.0, swings, 0.0])  # row of y - s in the state
        # direction and speed of an approach, during which a force may begin at any time
        self._approach: tuple[Array, float] | None = None
        self._changed = False  # whether the model has changed since the last sample
        self._approached = 0.0  # way of the model's tip since the approach began, in m
        self._presses = False
        # change of the state when a force begins
        self._begins = np.array([1.0, 0.0, 0.0, 0.0, 0.0, -swings, 0.0])
        self._feeling = _feeling()
        self.begin()

    def begin(self) -> None:
        """Restart, without contact."""
        t = self._tuning
        self.creep.begin()
        deviations = [0.0, 0.0, t.first_error, t.first_rate, 0.0, 0.0, 0.0]
        if self._vibrates:
            deviations[_XI:] = [t.first_swing, t.first_speed]
        self._filters = _Filters(
            np.zeros((1, 7, 3)), np.diag(np.square(deviations))[None], np.zeros(1),
            np.array([-math.inf]), np.array([False]),
        )  # fmt: skip
        self._believed = False  # whether a force is felt
        self._time = -math.inf
        self._pressures: Array = np.zeros(0)
        self._way = 0.0  # recent way of the model's tip, in m; see `TouchTuning.motion_time`
        # displacement (3, s) by each segment within the time of creep; to and fro cancel
        self._recent_way = np.zeros((3, len(self._ends)))
        self._better = self._quiet = 0  # successive samples
        self._begun = -math.inf  # time of the last hypothesis, in s
        self._softest = 1.0  # largest compliance, in m/N
        self._looked_at: Array | None = None  # compliance for which the following numbers are
        # stiffness (3, 3) of the tip in the directions of feeling, and projection on these
        self._stiffness, self._felt_axes = np.eye(3), np.eye(3)
        self.stiffness_error = math.nan
        unknown = np.full(3, np.nan)
        self.felt = TipForce(False, unknown, np.full((3, 3), np.nan), np.zeros(3))

    def expect(self, direction: Array | None, speed: float = 0.0, *, presses: bool = False) -> None:
        """Prepare for a force that grows slowly, as when the tip approaches something.

        Parameters
        ----------
        direction : direction (3,) of the approach, base axes; None: no approach. There must be no
            contact when it begins.
        speed : speed of the approach, in m/s.
        presses : whether the tip presses on something now. It then hardly moves along the
            direction: the force displaces it by as much as the pressures would move it.
        """
        self._presses = presses
        if direction is None:
            if self._approach is not None and not self._believed:
                self._merge()
            if self._approach is not None:
                self.creep.skip()
            self._approach = None
            return
        if self._approach is None:
            self._believed, self._approached = False, 0.0
            self._merge()
            f = self._filters
            for state in (_G, _B):  # the arm has rested: the creep that is left is predicted
                f.means[:, state] = f.covariances[:, state] = f.covariances[:, :, state] = 0.0
            f.covariances[:, _G, _G] = self._tuning.approach_error**2
            f.covariances[:, _B, _B] = self.creep.rate_deviation(direction) ** 2
        self._approach = direction, speed

    @property
    def _has_force(self) -> bool:
        """Whether the present filter has a force: one that is felt, or that may begin."""
        learned = self._approach is not None and self._approached > self._tuning.learning_way
        return self._believed or learned

    def change_model(self, change: Array) -> None:
        """Adjust to another model, for which the tip's offset changes by (6,)."""
        self._filters.means[:, _E] += change[:3]
        self.creep.change_model(change[:3])
        self._changed = True

    def forget(self) -> None:
        """Take a force that is felt for an error of the model, whose creep has ended."""
        self._believed = False
        self._merge()
        f = self._filters
        f.means[:, _B] = f.covariances[:, _B] = f.covariances[:, :, _B] = 0.0
        self.creep.skip()

    def take(
        self, time: float, away: Array, pressures: Array, tip: TipAt, omega: float = math.inf
    ) -> None:
        """Take in a sample of the tracker.

        Parameters
        ----------
        time : time of capture, in s.
        away : measured position (3,) minus the model's prediction for that time, in m. The
            prediction includes the vibration that pressures excite.
        pressures : effective pressures (n,), in Pa.
        tip : the model's tip at these pressures.
        omega : angular frequency of the vibration, in rad/s.
        """
        t = self._tuning
        elapsed = gap = time - self._time
        if not (elapsed > 0 and np.isfinite(away).all()):
            return
        jacobian = tip.pose[:3, :3] @ tip.jacobian[:3]
        if self._changed:
            self._filters.means[:, _E] -= self.creep.take_over(jacobian)
            self._changed = False
        self.creep.advance(gap, pressures, jacobian)
        if elapsed > t.longest_gap:
            self.begin()
            self._pressures, elapsed = pressures.copy(), 0.0
            self._filters.means[0, _E] = away - self.creep.displacement
        self._look_at(tip)
        moved, before = self._moved(pressures, jacobian), self._way
        self._time = time
        F, Q, pressed = self._process(elapsed, moved, omega)
        speed = _length(moved) / elapsed if elapsed > 0 else 0.0
        self._predict(elapsed, F, Q, pressed)
        self._correct(away - self.creep.displacement, t.noise**2 + (t.late * speed) ** 2)
        self._decide()
        if self._believed:
            self.creep.skip()
        elif self._approach is None:
            grown = self._way**2 - (before * math.exp(-elapsed / t.motion_time)) ** 2
            known = self.creep.displacement
            still = away - self._filters.means[0, _XI]
            self.creep.learn(elapsed, still, grown, speed, self._felt_axes)
            # what is now taken for creep was taken for an error of the model: nothing has moved
            self._filters.means[:, _E] -= self.creep.displacement - known
        self.felt = self._force()

    def _force(self) -> TipForce:
        t, stiffness, felt = self._tuning, self._stiffness, self._felt_axes
        displacement = self._filters.means[0, _U] if self._has_force else np.zeros(3)
        force = stiffness @ displacement
        error = self.stiffness_error if math.isfinite(self.stiffness_error) else t.stiffness_error
        covariance = self._variance() * stiffness @ stiffness + error**2 * np.outer(force, force)
        covariance += t.force**2 * (np.eye(3) - felt)
        return TipForce(self._believed, force, covariance, felt @ displacement)

    def _variance(self) -> float:
        """Return the variance of u; without a force, that of one that could have been felt."""
        filters = self._filters
        if self._has_force or len(filters.since) == 1:
            return float(filters.covariances[0, _U, _U])
        off = np.abs(self._time - filters.since[1:] - self._tuning.open_time)
        return float(filters.covariances[1 + int(np.argmin(off)), _U, _U])

    def _look_at(self, tip: TipAt) -> None:
        """Find the directions in which the tip is soft, and the stiffness there."""
        if tip.compliance is self._looked_at:
            return
        self._looked_at = tip.compliance
        self._stiffness, self._felt_axes, softest = self._feeling(tip.pose, tip.compliance)
        self._softest = float(softest[0])

    def _moved(self, pressures: Array, jacobian: Array) -> Array:
        """Return displacements (3, s) of the model's tip by segment since the last sample, in m."""
        columns = jacobian * (pressures - self._pressures)
        self._pressures = pressures.copy()
        return np.add.reduceat(columns, self._ends, axis=1)

    def _process(self, elapsed: float, moved: Array, omega: float) -> tuple[Array, Array, Array]:
        """Return transition (7, 7), covariance (7, 7) of its noise, and change (3,) of u by motion.

        During a motion in one direction the errors add up, not their squares: the variance grows
        with the square of the recent way.
        """
        t = self._tuning
        before = self._way * math.exp(-elapsed / t.motion_time)
        self._way = before + _length(moved)
        grown = self._way**2 - before**2
        self._recent_way = self._recent_way * math.exp(-elapsed / t.creep_time) + moved
        F, Q = np.eye(7), np.zeros((7, 7))
        F[:, _R] = elapsed * self._begins
        F[_R, _R] = math.exp(-elapsed / t.rate_time)
        F[_E, _B], F[_B, _B] = elapsed, math.exp(-elapsed / t.creep_time)
        hurry = min(1.0, _length(moved) / (elapsed * t.fast)) if elapsed > 0 else 0.0
        Q[_E, _E] = (t.model_error**2 + (t.fast_error * hurry) ** 2) * grown + t.drift**2 * elapsed
        Q[_B, _B] = t.creep**2 * grown + (t.creep_change * _length(self._recent_way)) ** 2 * elapsed
        pressed = np.zeros(3)
        if self._approach is not None:
            Q[_B, _B] = 0.0  # otherwise a beginning contact would be taken for creep
            n = self._approach[0]
            along = float(n @ moved.sum(axis=1))
            self._approached += along
            if self._presses:
                pressed = -t.held_share * along * n
                Q[_U, _U] = (t.held_error * along) ** 2
            else:
                F[_E, _G] = along
        if self._vibrates:
            F[_XI:, _XI:] = _vibration(omega, self._damping, elapsed)
            mean = self._filters.means[0]
            swing = math.hypot(*mean[_XI], *(mean[_ETA] / omega))
            excited = t.swing_error**2 * grown
            Q[_XI, _XI] = excited
            Q[_ETA, _ETA] = omega**2 * excited + elapsed * (
                t.agitation**2 + t.detuned**2 * omega**3 * swing**2
            )
        return F, Q, pressed

    def _predict(self, elapsed: float, F: Array, Q: Array, pressed: Array) -> None:
        """Predict all filters."""
        t, f = self._tuning, self._filters
        is_open = self._time - f.since < t.open_time
        rate = np.where(is_open, t.open_rate, t.force_rate) * self._softest
        rate[f.released] = 0.0
        if not self._has_force:
            rate[0] = 0.0
        noises = Q + (rate**2 * elapsed)[:, None, None] * np.outer(self._begins, self._begins)
        spread = 2 * elapsed / t.rate_time * self._rate() ** 2  # keeps the deviation of r
        noises[:, _R, _R] = np.where(rate > 0, spread, 0.0)
        f.means = F @ f.means
        f.means[:, _U] += pressed
        f.covariances = F @ f.covariances @ F.T + noises

    def _correct(self, away: Array, noise: float) -> None:
        """Correct all filters by a position (3,) relative to the model's, and compare them."""
        f, seen = self._filters, self._seen
        means, covariances = f.means, f.covariances
        missed = away - seen @ means
        seen_with = covariances @ seen
        variances = seen_with @ seen + noise
        gains = seen_with / variances[:, None]
        soft = missed @ self._felt_axes
        stiff = gains.copy()  # along a stiff axis no force is felt, and nothing vibrates
        stiff[:, [_U, _R, _XI, _ETA]] = 0.0
        f.means = means + gains[:, :, None] * soft[:, None]
        f.means += stiff[:, :, None] * (missed - soft)[:, None]
        if self._approach is not None:  # a contact can only push the tip back
            ahead = np.maximum(f.means[:, _U] @ self._approach[0], 0.0)
            onward = ahead[:, None] * self._approach[0]
            f.means[:, _U] -= onward
            f.means[:, _E] += onward
        f.covariances = covariances - gains[:, :, None] * seen_with[:, None]
        squares = 0.5 * (soft**2).sum(axis=1) / variances
        widths = np.log(variances)
        # a filter without force has less variance, which is no evidence that a force has gone
        f.evidence += squares[0] - squares + np.where(f.released, 0.0, widths[0] - widths)

    def _decide(self) -> None:
        """Adopt a far better hypothesis, start new ones, and drop a small force."""
        t, f = self._tuning, self._filters
        best = int(np.argmax(f.evidence))
        displaced = f.means[best, _U] - f.means[0, _U]
        change = float(np.linalg.norm(self._stiffness @ displaced))
        counts = f.released[best] or change > t.least_force
        is_better = best > 0 and f.evidence[best] > t.evidence and counts
        self._better = self._better + 1 if is_better else 0
        if self._better >= t.samples:
            self._believed = not f.released[best]
            self._filters = f.keep([best])
            self._filters.evidence[:], self._filters.released[:] = 0.0, False
            self._better = self._quiet = 0
        elif self._time - self._begun >= t.spacing - 1e-9:
            self._begin_hypotheses()
        if self._believed:
            self._let_go()

    def _begin_hypotheses(self) -> None:
        """Start the hypotheses that a force has just begun or changed, and that it has gone."""
        t, f = self._tuning, self._filters
        self._begun = self._time
        kept = np.flatnonzero(self._time - f.since[1:] < t.hypothesis_time) + 1
        f = f.keep([0, *kept.tolist()])
        mean, covariance = f.means[0], f.covariances[0]
        jump = (t.jump * self._softest) ** 2 * np.outer(self._begins, self._begins)
        jump[_R, _R] = self._rate() ** 2
        f = f.with_one(mean, covariance + jump, self._time, released=False)
        if self._believed:
            gone = np.eye(7)  # the equilibrium jumps, the tip stays where it is
            gone[:, _U] -= self._begins
            gone[_R, _R] = 0.0
            f = f.with_one(gone @ mean, gone @ covariance @ gone.T, self._time, released=True)
        self._filters = f

    def _let_go(self) -> None:
        """Drop a force that has been small for a while; the rest counts as model error."""
        t = self._tuning
        force = float(np.linalg.norm(self._stiffness @ self._filters.means[0, _U]))
        least = max(t.gone_share * t.least_force, self._deviation())
        self._quiet = self._quiet + 1 if force < least else 0
        if self._quiet < t.quiet:
            return
        self._believed, self._quiet = False, 0
        self._merge()

    def _deviation(self) -> float:
        """Return the standard deviation of the force along the softest direction, in N."""
        return math.sqrt(self._filters.covariances[0, _U, _U]) / self._softest

    def _rate(self) -> float:
        """Return the standard deviation of the rate of u while a force changes, in m/s."""
        rate = self._tuning.rate * self._softest
        return rate if self._approach is None else max(rate, self._approach[1])

    def _merge(self) -> None:
        """Turn the rest of a force into model error, and drop the hypotheses."""
        merged = np.eye(7)
        merged[_E, _U], merged[_U, _U], merged[_R, _R] = 1.0, 0.0, 0.0
        self._filters = self._filters.keep([0])
        self._filters.means = merged @ self._filters.means
        self._filters.covariances = merged @ self._filters.covariances @ merged.T


def _feeling() -> Formula:
    """Return the formula of how a tip feels a force, in base axes.

    Inputs: pose (4, 4) and compliance (6, 6) of the tip. Outputs: its stiffness (3, 3) in the
    directions in which it is soft, the projection (3, 3) on these, and its largest compliance.
    """
    pose, compliance = ca.SX.sym("pose", 4, 4), ca.SX.sym("compliance", 6, 6)
    values, axes = principal_axes(compliance[:3, :3])
    axes, soft = pose[:3, :3] @ axes, values > SOFT_SHARE * values[2]
    stiff = soft / ca.if_else(soft, values, 1)  # where the tip leans on an object, values may be 0
    stiffness, felt = (axes @ ca.diag(each) @ axes.T for each in (stiff, soft))
    return Formula([pose, compliance], [stiffness, felt, values[2]])


def _length(way: Array) -> float:
    """Return the sum of the lengths of the segments' ways (3, s)."""
    return float(np.sqrt((way**2).sum(axis=0)).sum())


def _vibration(omega: float, damping: float, duration: float) -> Array:
    """Return the transition (2, 2) of a free vibration; see `vibration.transition`."""
    damped = omega * math.sqrt(1 - damping**2)
    decay = math.exp(-damping * omega * duration)
    c, s = decay * math.cos(damped * duration), decay * math.sin(damped * duration) / damped
    return np.array([[c + damping * omega * s, s], [-(omega**2) * s, c - damping * omega * s]])
