"""Adaptation of the model's numbers to where the tip is seen at rest.

A robot file knows moduli, gains and weights within a deviation: that of its calibration, with all
correlations, or that of its `tolerances`. Coordinates z (`stiffopt.model.parameters`) describe
these numbers, a mass at the tip that the file does not have, and the twists of base and sensor in
the tracker's frame. Their prior is N(0, P0). A *window* is the average of the tip at rest at some
effective pressures p::

    y = s(p, z) + e,      e ~ N(0, R),      R_ij = sigma_i sigma_j exp(-|p_i - p_j|^2 / 2 l^2)

e is the discrepancy of the model. Postures near each other share it, so a thousand windows of one
posture give no more information than one. The estimate is the most likely z, by Gauss-Newton::

    z = K (y - s(p, z0) + S z0),   K = P0 S' (S P0 S' + R)^-1,   P = P0 - K S P0,   S = ds/dz

Windows age: sigma grows, so without new windows the estimate returns towards its prior. Each
coordinate stays within three prior deviations.

Only moduli, the mass and, if the robot file has gains, the gains are *applied*: they replace the
numbers of the model that plans and controls. The tip's offset accounts for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.linalg import LinAlgError

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.state import AdaptedNumber
from stiffopt.control.tuning import AdaptationTuning
from stiffopt.errors import EquilibriumError, StiffoptError
from stiffopt.model.arguments import DirectionalMeasure
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.layout import is_as_drawn
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.parametric import ParametricArm
from stiffopt.optimise.tip import TipModel

_MASS = "tip_mass"
_APPLIED = ("material.youngs_modulus", "corrections.gain")


@dataclass(frozen=True, eq=False)
class Window:
    """The tip at rest, averaged over some time."""

    time: float  # at its end, in s
    pressures: Array  # effective (n,), in Pa
    position: Array  # (3,), in m
    rotation: Array | None  # (3, 3); None if the tracker measures none


@dataclass(frozen=True, eq=False)
class Adapted:
    """A model with adapted numbers."""

    description: RobotDescription  # with the applied numbers
    applied: Array  # their coordinates (k,); zero for numbers that are not applied
    # least and greatest applied coordinates (2, k) of later models, since one beyond them had no
    # equilibrium; None: there was none
    limits: Array | None = None

    def short_of(self, failed: Adapted | None) -> Adapted:
        """Return this arm, limited so that no later one is as far from it as one that failed.

        A number in which they differ does not pass its value here in the direction of that one.
        """
        if failed is None:
            return self
        low, high = np.full((2, len(self.applied)), [[-np.inf], [np.inf]])
        if failed.limits is not None:
            low, high = failed.limits
        here, there = self.applied, failed.applied
        low = np.where(there < here, np.maximum(low, here), low)
        high = np.where(there > here, np.minimum(high, here), high)
        return replace(self, limits=np.stack([low, high]))


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimated numbers of an arm."""

    numbers: tuple[AdaptedNumber, ...]
    proposal: Adapted | None  # to use from now on; None: the present model will do
    is_limited: bool = False  # whether `Adapted.limits` keep the model short of the numbers


class Learning:
    """Estimates of the arm and of its stiffness that the planner's process makes between plans.

    The first windows take half a second, later ones tens of milliseconds; the arm is at rest then.

    Parameters
    ----------
    description : the arm as its file describes it.
    tuning : tuning of the adaptation.
    """

    def __init__(self, description: RobotDescription, tuning: AdaptationTuning) -> None:
        self._description, self._tuning = description, tuning
        self._adaptation: Adaptation | None = None
        self._last: tuple[tuple[Window, ...], Adapted | None] = (), None  # of `estimate`
        self._applied: Array = np.zeros(0)  # coordinates (k,) of the present model
        self._deviation = math.nan
        self._deviation_of: tuple[DirectionalMeasure, Array] | None = None  # and pressures (n,)
        self._last_plan: Array | None = None  # pressures (n,)

    def estimate(self, windows: tuple[Window, ...], adapted: Adapted | None) -> Estimate | None:
        """Return the estimate of the arm's numbers; None if there is no news.

        `adapted` is the present arm.
        """
        before, self._last = self._last, (windows, adapted)
        if not windows or (windows is before[0] and adapted is before[1]):
            return None
        if self._adaptation is None:
            self._adaptation = Adaptation(self._description, self._tuning)
        adaptation, self._deviation_of = self._adaptation, None
        if windows is not before[0]:
            with suppress(StiffoptError, LinAlgError):  # beyond the strain law
                adaptation.take(windows)
        self._applied = adaptation.none_applied if adapted is None else adapted.applied
        limits = None if adapted is None else adapted.limits
        step = adaptation.step_from(self._applied, limits)
        return Estimate(adaptation.report(), step, adaptation.is_beyond(limits))

    def deviation(self, pressures: Array, measure: DirectionalMeasure) -> float:
        """Return the relative deviation of a stiffness at a plan's pressures (n,); NaN if unknown.

        It is computed again when plans rest at other pressures.
        """
        before, self._last_plan = self._last_plan, pressures
        if self._adaptation is None or before is None:
            return self._deviation
        if np.abs(pressures - before).max() > self._tuning.at_rest:
            return self._deviation
        last = self._deviation_of
        far = math.inf if last is None else float(np.linalg.norm(last[1] - pressures))
        if last is None or last[0] != measure or far > self._tuning.elsewhere:
            self._deviation_of, self._deviation = (measure, pressures), math.nan
            with suppress(StiffoptError):
                self._deviation = self._adaptation.deviation(pressures, measure, self._applied)
        return self._deviation


class Adaptation:
    """Estimates the numbers of an arm.

    Parameters
    ----------
    description : the arm as its file describes it.
    tuning : bounds, discrepancy and pace.
    """

    def __init__(self, description: RobotDescription, tuning: AdaptationTuning) -> None:
        self._description, self._tuning = description, tuning
        keys, self._prior, self._frames = _prior(description, tuning)
        self._arm = _parametric_arm(description, keys)
        self._parameters = [Parameter(key) for key in keys]
        self._gravity = np.array(description.gravity)
        self._has_mass = bool(self._gravity.any())
        gains = not is_as_drawn(description)
        self._moduli = [index for index, key in enumerate(keys) if key.endswith(_APPLIED[0])]
        self._applies = np.zeros(len(self._prior), dtype=bool)
        for index, key in enumerate(keys):
            name = key.split("].", 1)[1]
            self._applies[index] = name == _APPLIED[0] or (gains and name.startswith(_APPLIED[1]))
        if self._has_mass:
            self._applies[len(keys)] = True
        self.estimate: Array = np.zeros(len(self._prior))
        self.covariance: Array = self._prior
        self.none_applied: Array = np.zeros(len(self._prior))

    def take(self, windows: Sequence[Window]) -> None:
        """Update the estimate from all windows.

        Windows in which the arm of the last estimate has no equilibrium are left out.
        """
        z, noise = self.estimate, self._noise(windows)
        errors, slopes = self._linearised(windows, z)
        for _ in range(self._tuning.iterations):
            seen = np.isfinite(errors)
            e, S, R = errors[seen], slopes[seen], noise[np.ix_(seen, seen)]
            gain = np.linalg.solve(S @ self._prior @ S.T + R, S @ self._prior).T
            self.covariance = self._prior - gain @ S @ self._prior
            step = self._bounded(gain @ (e + S @ z)) - z
            found = self._shortened(windows, z, step, errors, noise)
            if found is None:
                return
            z, errors, slopes = found
            self.estimate = z
            moved = np.abs(step) / np.sqrt(np.diag(self._prior))
            if moved.max() < self._tuning.converged:
                return

    def _shortened(
        self, windows: Sequence[Window], z: Array, step: Array, before: Array, noise: Array
    ) -> tuple[Array, Array, Array] | None:
        """Return likelier coordinates (k,), with errors and slopes; None: there are none.

        `before` (6 w,) are the errors at z. A full step of a soft arm may lead to numbers that fit
        worse, or that have no equilibrium in a window.
        """
        seen = np.isfinite(before)
        R = noise[np.ix_(seen, seen)]

        def cost(errors: Array, z: Array) -> float:
            e = errors[seen]
            return float(e @ np.linalg.solve(R, e) + z @ np.linalg.solve(self._prior, z))

        for share in 0.5 ** np.arange(self._tuning.halvings):
            trial = z + share * step
            errors, slopes = self._linearised(windows, trial)
            if np.isfinite(errors[seen]).all() and cost(errors, trial) < cost(before, z):
                return trial, errors, slopes
        return None

    def _bounded(self, z: Array) -> Array:
        limit = self._tuning.bound * np.sqrt(np.diag(self._prior))
        return np.asarray(np.clip(z, -limit, limit))

    def step_from(self, applied: Array, limits: Array | None = None) -> Adapted | None:
        """Return the arm with numbers nearer to the estimate; None if they are near enough.

        The step is limited, so that the model changes slowly. `applied` are the present coordinates
        (k,), and `limits` those of `Adapted`.
        """
        deviations = np.sqrt(np.diag(self._prior))
        goal = self.estimate if limits is None else np.clip(self.estimate, *limits)
        change = np.where(self._applies, goal - applied, 0.0)
        share = np.max(np.abs(change) / np.maximum(deviations, 1e-12), initial=0.0)
        if share < self._tuning.least_step:
            return None
        after = applied + change * min(1.0, self._tuning.step / share)
        try:
            description = self._with(after)
            TipModel(Manipulator(description)).at(np.zeros(description.n_pressures))
        except StiffoptError:  # such an arm has no equilibrium, or breaks its strain law
            return None
        return Adapted(description, after, limits)

    def is_beyond(self, limits: Array | None) -> bool:
        """Return whether the estimate lies outside of limits (2, k), by more than a step."""
        if limits is None:
            return False
        beyond = np.abs(self.estimate - np.clip(self.estimate, *limits))[self._applies]
        deviations = np.sqrt(np.diag(self._prior))[self._applies]
        return bool((beyond > self._tuning.least_step * deviations).any())

    def _with(self, z: Array) -> RobotDescription:
        """Return the arm with those of the coordinates (k,) that are applied."""
        own = self._description
        values = {
            parameter: float(parameter.at(parameter.value(own), z[index]))
            for index, parameter in enumerate(self._parameters)
            if self._applies[index]
        }
        mass = own.tip_mass + (z[len(self._parameters)] if self._has_mass else 0.0)
        return with_values(own, values).model_copy(update={"tip_mass": max(float(mass), 0.0)})

    def report(self) -> tuple[AdaptedNumber, ...]:
        """Return the estimated numbers with their deviations."""
        deviations = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        found = []
        for index, parameter in enumerate(self._parameters):
            value = float(parameter.at(parameter.value(self._description), self.estimate[index]))
            scale = abs(parameter.per_coordinate(value))
            found.append(AdaptedNumber(parameter.key, value, scale * deviations[index]))
        if self._has_mass:
            index = len(self._parameters)
            mass = self._description.tip_mass + self.estimate[index]
            found.append(AdaptedNumber(_MASS, float(mass), deviations[index]))
        for name, index in (("base.tilt_x", -3), ("base.tilt_y", -2), ("base.turn", -1)):
            at = len(self._prior) - self._frames + 6 + index
            found.append(AdaptedNumber(name, float(self.estimate[at]), deviations[at]))
        return tuple(found)

    def deviation(self, pressures: Array, measure: DirectionalMeasure, applied: Array) -> float:
        """Return the relative standard deviation of the model's stiffness at pressures (n,).

        It contains the difference between the estimate and the model, which has the `applied`
        coordinates (k,), and the error of the strain law. That error grows with the strains, which
        are larger in an arm that is softer than its file says.
        """
        t, count = self._tuning, len(self._parameters)
        k, _, slopes, _ = self._arm.stiffnesses(pressures[None], self.estimate[:count], measure)
        present, *_ = self._arm.stiffnesses(pressures[None], applied[:count], measure)
        slope, pending = slopes[0] / k[0], math.log(present[0] / k[0])
        variance = max(float(slope @ self.covariance[:count, :count] @ slope), 0.0)
        weights = np.abs(slope[self._moduli])
        softer = -float(weights @ self.estimate[self._moduli]) / max(float(weights.sum()), 1e-12)
        law = t.stiffness_error * math.exp(t.strain_power * max(softer, 0.0))
        return math.sqrt(variance + law**2 + pending**2)

    def _linearised(self, windows: Sequence[Window], z: Array) -> tuple[Array, Array]:
        """Return errors (6 w,) of the model at coordinates (k,) and their slopes (6 w, k).

        Each of the w windows has errors of position, in m, and of orientation, as a rotation vector
        in base axes; NaN if not measured, or if the model has no equilibrium there.
        """
        errors = np.full((len(windows), 6), np.nan)
        slopes = np.zeros((len(windows), 6, len(z)))
        p = np.array([window.pressures for window in windows])
        heavier = self._poses(p, z, self._tuning.heavier) if self._has_mass else None
        poses = self._poses(p, z)
        for k, window in enumerate(windows):
            here, there = poses[k], None if heavier is None else heavier[k]
            if here is None or (self._has_mass and there is None):
                continue
            T, per_coordinate = here
            R, y = T[:3, :3], T[:3, 3]
            errors[k, :3] = window.position - y
            if window.rotation is not None:
                errors[k, 3:] = _turn(R, window.rotation)
            axes = lie.rotate_blocks(R)
            columns = [axes @ per_coordinate]
            if there is not None:
                change = np.concatenate([there[0][:3, 3] - y, _turn(R, there[0][:3, :3])])
                columns.append(change[:, None] / self._tuning.heavier)
            columns.append(np.block([[np.eye(3), -lie.hat(y)], [np.zeros((3, 3)), np.eye(3)]]))
            if self._frames == 12:
                columns.append(np.asarray(axes))
            slopes[k] = np.hstack(columns)
        S = slopes.reshape(-1, len(z))
        frames = z[len(z) - self._frames :]
        return errors.ravel() - S[:, len(z) - self._frames :] @ frames, S

    def _poses(
        self, pressures: Array, z: Array, heavier: float = 0.0
    ) -> list[tuple[Array, Array] | None]:
        """Return poses (4, 4) at pressures (w, n), and their slopes (6, k); None: no equilibrium.

        The arm has the coordinates (k,), and a mass more in kg.
        """
        count = len(self._parameters)
        if self._has_mass:
            force = (z[count] + heavier) * self._gravity
            self._arm.set_tip_load((*force, *np.zeros(9)))
        try:
            found = self._arm.poses(pressures, z[:count])
        except EquilibriumError:
            if len(pressures) == 1:
                return [None]
            return [self._poses(each[None], z, heavier)[0] for each in pressures]
        return list(zip(found.transforms, found.per_coordinate, strict=True))

    def _noise(self, windows: Sequence[Window]) -> Array:
        """Return the covariance (6 w, 6 w) of discrepancies; it grows with displacement and age."""
        t = self._tuning
        p = np.array([window.pressures for window in windows])
        rest = np.array([0.0, 0.0, self._description.length])
        away = np.array([np.linalg.norm(window.position - rest) for window in windows])
        length, newest = self._description.length, max(window.time for window in windows)
        age = np.array([math.exp((newest - window.time) / t.memory) for window in windows])
        known = self._description.calibration
        position, angle = (
            t.position_error + t.model_error * away,
            t.angle_error * np.ones_like(away),
        )
        if known is not None:
            position = np.full_like(away, max(known.position_residual, t.position_error))
        angle = np.maximum(angle, 2 * position / length)
        sigma = np.stack([position, position, position, angle, angle, angle], axis=1) * age[:, None]
        distance = np.linalg.norm(p[:, None] - p[None], axis=2)
        shared = np.exp(-0.5 * (distance / t.reach) ** 2) + 1e-2 * np.eye(len(p))
        return np.asarray(np.kron(shared, np.eye(6)) * np.outer(sigma.ravel(), sigma.ravel()))


def _prior(description: RobotDescription, tuning: AdaptationTuning) -> tuple[list[str], Array, int]:
    """Return keys of the numbers, prior covariance (k, k), and the number of frames' coordinates.

    The coordinates are those of the numbers, of the mass if there is gravity, and of the frames.
    """
    mass = [tuning.mass**2] if any(description.gravity) else []
    known, tolerances = description.calibration, description.tolerances or Tolerances()
    if known is not None and known.parameters:
        keys = [fitted.key for fitted in known.parameters]
        count, covariance = len(keys), known.covariance
        frames = len(known.frames) or 6
        size = count + len(mass) + frames
        prior = np.zeros((size, size))
        kept = [*range(count), *range(size - frames, size)][: len(covariance)]
        prior[np.ix_(kept, kept)] = covariance
        if not known.frames:
            prior[-6:, -6:] = np.diag(_frames(tolerances))
    else:
        keys, variances = [], []
        for place, segment in enumerate(description.segments):
            keys.append(f"segments[{place}].material.youngs_modulus")
            gains = [f"segments[{place}].corrections.gain[{c}]" for c in range(segment.n_channels)]
            keys += gains
            variances += [tolerances.youngs_modulus**2, *[tolerances.gain**2] * len(gains)]
        count, frames = len(keys), 6
        prior = np.diag([*variances, *mass, *_frames(tolerances)])
    if mass:
        prior[count, count] = mass[0]
    return keys, prior, frames


def _frames(tolerances: Tolerances) -> list[float]:
    """Return the variances (6,) of the twist of the base in the tracker's frame."""
    position, tilt = tolerances.base_position**2, tolerances.base_tilt**2
    return [position, position, position, tilt, tilt, tolerances.base_turn**2]


def _parametric_arm(description: RobotDescription, keys: Sequence[str]) -> ParametricArm:
    return _made(description.model_dump_json(), tuple(keys))


@lru_cache(maxsize=4)
def _made(description: str, keys: tuple[str, ...]) -> ParametricArm:
    robot = RobotDescription.model_validate_json(description)
    return ParametricArm(robot, [Parameter(key) for key in keys])


def _turn(before: Array, after: Array) -> Array:
    """Return the rotation vector (3,), in base axes, from one orientation (3, 3) to another."""
    T = np.eye(4)
    T[:3, :3] = after @ before.T
    return np.asarray(lie.log(T))[3:]
