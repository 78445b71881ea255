"""`Report`: the state, the alarms and the events that the controller publishes."""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.bracing import Bracing
from stiffopt.control.interface import Notice
from stiffopt.control.observer import ArmObserver
from stiffopt.control.pressing import Pressing
from stiffopt.control.replanning import Replanner
from stiffopt.control.setup import ControlSetup
from stiffopt.control.state import AdaptedNumber, ControllerStatus, Severity
from stiffopt.control.tip_errors import TipErrors, target_arrays
from stiffopt.model.uncertainty import NORMAL_QUANTILE
from stiffopt.optimise.target import Target

_WELL_WITHIN = 0.8  # share of the bound on the frequency's error below which its alarm ends


class Report:
    """Reports what the controller pursues, and what it knows of the arm.

    Parameters
    ----------
    setup : what it has in common with the other parts of the controller.
    arm : the state of the arm.
    replanner : what is pursued, and the plans for it.
    """

    def __init__(self, setup: ControlSetup, arm: ArmObserver, replanner: Replanner) -> None:
        self._n, self._arm, self._replanner = setup.robot.n_pressures, arm, replanner
        # distance of the measured tip from the model's above which the model is wrong, in m
        self._largest_offset = setup.tuning.feedback.max_offset * setup.robot.length
        self._errors = TipErrors()
        self._is_detuned = False  # whether the frequency is as far off as it may be

    @property
    def model_is_wrong(self) -> bool:
        """Whether the measured tip is too far from the model's tip to believe the model."""
        return math.hypot(*self._arm.tip.offset[:3].tolist()) > self._largest_offset

    def status(self, now: float, led: tuple[Target, Array] | None) -> ControllerStatus:
        """Return the controller's part of the state.

        `now`: time, in s. `led`: on a trajectory of pressures, its present target and effective
        pressures (n,), in Pa.
        """
        n, arm, pursuit = self._n, self._arm, self._replanner.pursuit
        if arm.modelled is None:
            return ControllerStatus(plan=np.full(n, np.nan))
        estimate, sample, course = arm.tip.estimate, arm.tip.sample, pursuit.course
        felt, bracing = arm.touch.felt, course if isinstance(course, Bracing) else None
        touches, force, covariance = felt.touches, felt.force, felt.covariance
        if bracing is not None and bracing.leans:
            force, covariance = bracing.push, bracing.covariance
            touches = bool(force.any())
        target, press_force, press_goal = pursuit.target_at(now), math.nan, math.nan
        if led is not None:
            target = led[0]
        if isinstance(course, Pressing):
            target = course.shown(estimate.position)
            press_force, press_goal = course.force, course.press.force
            touches = touches or course.touches
        position, pointing, quaternion = target_arrays(target)
        position_error, angle_error = self._errors.at(target, estimate.position, estimate.rotation)
        plan, stiffness = self._replanner.plan, math.nan
        if pursuit.stiffness is not None:
            tip = arm.modelled
            stiffness = pursuit.stiffness(tip.compliance, tip.pose[:3, :3])
        ratio = math.exp(NORMAL_QUANTILE * self._replanner.deviation)  # NaN if unknown
        planned = np.full(n, np.nan)
        if led is not None:
            planned = led[1] - arm.pressures.history_offset
        elif plan is not None:
            planned = plan.pressures - arm.pressures.history_offset
        return ControllerStatus(
            plan=planned,
            tip_position=estimate.position,
            tip_quaternion=estimate.quaternion,
            seen_position=np.full(3, np.nan) if sample is None else sample.position,
            seen_age=math.inf if sample is None else now - sample.time,
            target_position=position,
            target_quaternion=quaternion,
            target_pointing=pointing,
            position_error=position_error,
            angle_error=angle_error,
            stiffness=stiffness,
            stiffness_low=stiffness / ratio,
            stiffness_high=stiffness * ratio,
            adapted=self._adapted_numbers(),
            best_stiffness=math.nan if plan is None else plan.stiffness,
            disturbance=estimate.offset,
            touches=touches,
            wrench=np.concatenate([force, np.zeros(3)]),
            wrench_covariance=covariance.ravel(),
            press_force=press_force,
            press_goal=press_goal,
            brace="" if bracing is None or bracing.is_let_down else bracing.phase.value,
            brace_contacts="" if bracing is None else bracing.contacts,
            brace_force=math.nan if bracing is None else bracing.force,
            brace_force_deviation=math.nan if bracing is None else bracing.deviation,
            brace_margin=math.nan if bracing is None else bracing.margin,
            leans_on=() if bracing is None else bracing.held,
            task=pursuit.kind,
            stiffness_unit=pursuit.unit,
            model_position=estimate.static,
            lost=arm.channels.lost,
            shortfall=arm.channels.shortfall,
        )

    def _adapted_numbers(self) -> tuple[AdaptedNumber, ...]:
        known, lags = self._replanner.known, self._arm.pressures.lags
        numbers = () if known is None else known.numbers
        tip = self._arm.tip
        if math.isfinite(tip.omega):  # it vibrates
            factor = AdaptedNumber("frequency_factor", *tip.frequency_factor)
            numbers = (*numbers, factor)
        if lags is None:
            return numbers
        found = zip(lags.lag.tolist(), lags.deviation.tolist(), strict=True)
        return *numbers, *(
            AdaptedNumber(f"regulator_lag[{channel}]", *each) for channel, each in enumerate(found)
        )

    def notices(self, rests_short: bool, *, waits: bool) -> tuple[Notice, ...]:
        """Return alarms and events.

        `rests_short`: whether the tip rests short of its target, so that its distance can be told.
        `waits`: whether the reference waits for the end of a push.
        """
        arm, pursuit, away = self._arm, self._replanner.pursuit, None
        if rests_short:
            estimate = arm.tip.estimate
            away = self._errors.at(pursuit.target, estimate.position, estimate.rotation)
        notices = (*self._replanner.notices(away), *arm.channels.notices())
        if isinstance(pursuit.course, Pressing | Bracing):
            notices = (*notices, *pursuit.course.notices())
        if waits:
            text = (
                "the arm seems to be pushed: it waits on its way to the target, for a second or two"
            )
            notices = (*notices, Notice("motion-waits", text, Severity.INFO, standing=True))
        if self.model_is_wrong:
            distance = 1e3 * float(np.linalg.norm(arm.tip.offset[:3]))
            text = (
                f"the tip is seen {distance:.0f} mm from where the model has it; check the "
                "tracker's registration and sensor, the tubes, and that the robot file is this "
                "arm's"
            )
            notices = (*notices, Notice("implausible", text, Severity.ERROR, standing=True))
        # e leaves its bound with every other sample; its alarm lasts until it is well within
        off = arm.tip.frequency_off
        self._is_detuned = off >= (_WELL_WITHIN if self._is_detuned else 1.0)
        if self._is_detuned:
            factor, _ = arm.tip.frequency_factor
            text = (
                f"the arm vibrates at {factor:.2f} of the model's frequency or beyond, so that it "
                "swings after its motions; run 'stiffopt commission', and check the robot file"
            )
            notices = (*notices, Notice("frequency", text, standing=True))
        if arm.times.is_large:
            text = (
                f"the times of the tracker's samples scatter by {1e3 * arm.times.scatter:.0f} ms, "
                "so that the tip leaves its way as it moves; stamp samples where they are "
                "captured, and look for a busy computer or network"
            )
            notices = (*notices, Notice("tracker-times", text, standing=True))
        if doubt := arm.watch.doubt:
            held = Notice(doubt.kind, doubt.text, Severity.ERROR, True, True, doubt.undo)
            notices = (*notices, held)
        return notices
