"""The observer: estimates the arm's state from commands, pressure readings and tracker samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.bracing import Bracing
from stiffopt.control.channels import Channels
from stiffopt.control.creep import CreepEstimator
from stiffopt.control.estimator import TipEstimator
from stiffopt.control.interface import SampleCounts
from stiffopt.control.linearised_tip import ArmModel, LeaningTip, LinearisedTip
from stiffopt.control.motion_watch import MotionWatch
from stiffopt.control.pressing import Pressing
from stiffopt.control.regulators import PressureEstimator
from stiffopt.control.replanning import AnyCourse
from stiffopt.control.setup import ControlSetup
from stiffopt.control.time_scatter import TimeScatter
from stiffopt.control.tip_errors import turn_of_a_push
from stiffopt.control.touch import TouchEstimator
from stiffopt.errors import StiffoptError
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.tip import TipAt, TipModel
from stiffopt.rig.interface import PoseSample, PressureReading

_MAX_STEPS = 50  # of the estimators in one tick, after a pause


class ArmObserver:
    """Estimates pressures and tip, senses contacts, and checks that the arm moves as it should.

    Parameters
    ----------
    setup : what it has in common with the other parts of the controller.
    go_back : called with pressures (n,) at which the model has no equilibrium; changes to a model
        that has one, by `change_robot`, and returns whether there is one.

    Attributes
    ----------
    channels, pressures, tip, touch, watch : the observer's parts; `tip` is the estimator of the
        tip.
    model : None until `check` has compiled it.
    modelled : the model's tip at the effective pressures.
    leaning : the model of the braced tip, while the arm may lean on objects.
    """

    def __init__(
        self,
        setup: ControlSetup,
        go_back: Callable[[Array], bool],
    ) -> None:
        self._go_back = go_back
        robot, control, tuning = setup.robot, setup.control, setup.tuning
        period, slew, mode, n = setup.period, setup.slew, setup.mode, robot.n_pressures
        self._robot, self._period, self._tuning = robot, period, tuning
        self._frequency = control.frequency
        tolerance = np.broadcast_to(np.asarray(setup.safety.max_pressure_error, dtype=float), n)
        self.channels = Channels(setup.limits, slew, tolerance, tuning.regulators)
        self.pressures = PressureEstimator(
            robot.description, control, period, slew, tuning.regulators, self.channels, tuning.lags
        )
        self.tip = TipEstimator(period, n, mode, tuning.estimator)
        # the lag of a calibrated robot file includes the arm's own
        viscous = mode is not None and self.pressures.lags_are_regulators
        self._viscous_lag = tuning.estimator.viscous_lag if viscous else 0.0
        self.touch = TouchEstimator(
            [segment.n_channels for segment in robot.description.segments],
            vibrates=mode is not None,
            damping=control.damping,
            tuning=tuning.touch,
            creep=CreepEstimator(
                n,
                any(s.history and s.history.creep for s in robot.description.segments),
                tuning.creep,
            ),
        )
        self.watch = MotionWatch(robot.description, tuning.motion, vibrates=mode is not None)
        self.times = TimeScatter(control.tracker_noise)
        self.model: ArmModel | None = None
        self._now, self._modelled_at = 0.0, np.zeros(n)

    def check(self) -> None:
        """Compile and try the model; raises the errors of `ArmModel`."""
        if self.model is None:
            self.model = ArmModel(self._robot, self._tuning.reference.model_range)
            self._set_frequency()
            self.begin(self._now)

    @property
    def compiled(self) -> ArmModel:
        """The model, compiled now if `check` has not been called."""
        self.check()
        assert self.model is not None
        return self.model

    def _set_frequency(self) -> None:
        """Give the vented arm the frequency of the settings, if they have one."""
        if self._frequency is not None and self.model is not None:
            vented = self.model.waypoints.at(np.zeros(self._robot.n_pressures))
            self.tip.set_frequency(2 * math.pi * self._frequency, vented)

    def begin(self, now: float) -> None:
        """Restart with a vented arm."""
        self._now = now
        self.pressures.begin()
        # effective pressures (n,) that the shape has followed, but for the first mode, in Pa
        self.strained = self.pressures.effective
        self.tip.begin()
        self.touch.begin()
        self.watch.begin()
        self.times.begin()
        self.modelled: TipAt | None = None
        self.leaning: LeaningTip | None = None
        self._looked_at = now  # capture time of the last sample, in s
        if self.model is not None:
            self.model.chambers.lean(None)
            self._modelled_at = zero = self.pressures.command
            self.modelled = self.model.chambers.at(zero)
            self.tip.advance(now, zero, self.modelled)

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
        course: AnyCourse | None,
    ) -> SampleCounts:
        """Estimate pressures and tip; see `Controller.observe`. `course` is the present one."""
        steps = min(max(1, round((now - self._now) / self._period)), _MAX_STEPS)
        self._now = now
        self.pressures.advance(steps, commanded, reading.pressures)
        effective = self._strain(steps * self._period)
        ahead = self.pressures.effective - effective
        tip = self._at(self.compiled.chambers, effective)
        self.modelled, self._modelled_at = tip, effective
        for step in range(steps):
            moment = now - (steps - 1 - step) * self._period
            self.tip.advance(moment, effective, tip, ahead)
        counts = self.tip.take(samples)
        sample = self.tip.sample
        if counts.used and sample is not None:
            if isinstance(course, Bracing) and self.leaning is not None:
                elapsed = sample.time - self._looked_at
                course.look(elapsed, sample.position, tip, effective, sample.quaternion)
                self._looked_at = sample.time
            else:
                self._feel(sample, effective, tip, course)
        return counts

    def _strain(self, elapsed: float) -> Array:
        """Let the shape follow the effective pressures for a time in s; return `strained` (n,)."""
        share = 1.0 if self._viscous_lag == 0 else 1 - math.exp(-elapsed / self._viscous_lag)
        self.strained = self.strained + share * (self.pressures.effective - self.strained)
        return self.strained

    @property
    def strained_ahead(self) -> Array:
        """`strained` (n,), with what the effective pressures change in a dead time, in Pa."""
        p = self.pressures
        return self.strained + (p.effective_ahead - p.effective)

    def on_path(self, pressures: Array) -> TipAt:
        """Return the model's tip at pressures (n,) on the reference's path."""
        return self._at(self.compiled.path, pressures)

    def at_waypoint(self, pressures: Array) -> TipAt:
        """Return the model's tip at pressures (n,) of a trajectory's waypoint."""
        return self._at(self.compiled.waypoints, pressures)

    def _at(self, model: LinearisedTip | TipModel, pressures: Array) -> TipAt:
        """Return a model's tip at pressures (n,), of an arm that has an equilibrium there."""
        try:
            return model.at(pressures)
        except StiffoptError:
            if not self._go_back(pressures):
                raise
            return model.at(pressures)

    def _feel(
        self, sample: PoseSample, effective: Array, tip: TipAt, course: AnyCourse | None
    ) -> None:
        """Estimate the force on the tip from a sample, and check the sample against the model."""
        self.times.take(sample.time, sample.position)
        predicted, pushed, rotations = self.tip.predicted, np.zeros(3), None
        presses = isinstance(course, Pressing) and course.touches_on_purpose
        if isinstance(course, Pressing) and presses:
            self.touch.expect(course.direction, course.press.speed, presses=course.presses)
        else:
            self.touch.expect(None)
            if isinstance(course, Pressing) and course.begins_free and self.touch.felt.touches:
                self.touch.forget()
        away, captured = sample.position - predicted, self.tip.captured
        self.touch.take(sample.time, away, captured, tip, self.tip.omega)
        if isinstance(course, Pressing) and course.is_blocked:
            return  # an object of unknown force holds the tip: its motion is not the model's
        turned = self.tip.turned if self.tip.turn_known else None
        if presses:
            pushed = self.touch.felt.displacement
            if turned is not None:
                turned = turned - turn_of_a_push(tip, along_stiff_axis=True) @ pushed
        elif sample.quaternion is not None:
            rotations = lie.rotation_from_quaternion(sample.quaternion), self.tip.modelled
        self.watch.take(
            sample.time, sample.position - pushed, predicted, self.tip.offset, captured,
            tip, turned=turned, swings=self.tip.swings, deviation=self.tip.deviation,
            omega=self.tip.omega, rotations=rotations,
        )  # fmt: skip

    def lean_on(self, leaning: LeaningTip | None) -> Array:
        """Change to the model of an arm that leans on objects; None: of the free arm.

        Return the change (6,) of the tip's offset, which takes up the change of the model.
        """
        model = self.compiled.chambers
        before = model.at(self._modelled_at)
        self.leaning = leaning
        model.lean(leaning)
        change = self._shift(before, model.at(self._modelled_at))
        self.touch.begin()
        self.watch.go_on()
        return change

    def change_robot(
        self, description: RobotDescription, ahead: Array | None = None
    ) -> Array | None:
        """Change the model's numbers; None, and no change, if such an arm has no equilibrium.

        It must have one where the tip was last modelled, and at the pressures `ahead` (n,). Return
        the change (6,) of the tip's offset, which takes up the change of the model.
        """
        model, before = self.compiled, self.modelled
        assert before is not None  # compiled
        frequency = self.tip.frequency_at(before)
        try:
            after = model.change(Manipulator(description), self._modelled_at, ahead)
        except StiffoptError:
            return None
        self._set_frequency()
        self.tip.change_frequency(frequency, self.tip.frequency_at(after))
        return self._shift(before, after)

    def _shift(self, before: TipAt, after: TipAt) -> Array:
        """Let the offset (6,) take up the difference between two models."""
        self.modelled = after
        change = self.tip.change_model(before, after)
        self.watch.change_model(change)
        self.touch.change_model(change)
        return change
