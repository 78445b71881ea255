"""From the reference and the estimated arm to the next command: correction, damping, limits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.control.allocation import Allocation
from stiffopt.control.feedback import (
    GainSchedule,
    tracking_rows,
    with_excess,
    with_offsets,
    with_reference,
)
from stiffopt.control.motion_error import MotionErrorEstimator
from stiffopt.control.observer import ArmObserver
from stiffopt.control.reference import Reference, VibrationFilter
from stiffopt.control.setup import ControlSetup
from stiffopt.control.vibration import BentMode
from stiffopt.optimise.tip import TipAt


class TipFeedback:
    """Corrects the tip's offset from the reference, and damps its vibration; see `tracking_rows`.

    Parameters
    ----------
    setup : what it has in common with the other parts of the controller.
    arm : the observer of the arm.

    Attributes
    ----------
    saturated : flags (n,) of channels at a limit that keeps the tip from its target.
    """

    def __init__(self, setup: ControlSetup, arm: ArmObserver) -> None:
        period, mode, damping = setup.period, setup.mode, setup.control.damping
        slew, tuning, step_error = setup.slew, setup.tuning.feedback, setup.tuning.step_error
        self._arm, self._tuning = arm, tuning
        lag, dead_time = arm.pressures.lag, arm.pressures.dead_time
        # the offset and the position of the model's tip on the reference's path
        self._averaged = VibrationFilter(period, damping, 9)
        self._period, self._ended = period, step_error.ended
        self._on_trajectories = MotionErrorEstimator(setup.tuning.motion_error)
        self._motion_error = self._in_steps = MotionErrorEstimator(step_error)
        self._gains = None
        law = tracking_rows(len(slew), mode is not None, damping, dead_time, tuning)
        if mode is not None:
            self._gains = GainSchedule(period, lag, damping, tuning.effort)
            law = with_excess(law, mode.participation)
        self._allocation = Allocation(
            with_reference(with_offsets(law)),
            setup.limits.low,
            setup.limits.high,
            slew * period,
            setup.safety.max_tip_speed * period,
            setup.control.solver,
            tuning,
        )

    def begin(self) -> None:
        """Restart."""
        self.resume()
        self.saturated = np.zeros(len(self._arm.pressures.command), dtype=bool)

    def resume(self) -> None:
        """Continue after a pause: the past does not count."""
        self._is_new = True
        self._motion_error.stop()

    def shift(self, change: Array) -> None:
        """Shift the offset by a change (6,) of the model."""
        self._motion_error.stop()
        self._averaged.shift(np.concatenate([change, -change[:3]]))

    def command(
        self,
        tip: TipAt,
        reference: Reference,
        prescribed: Array,
        offset: Array,
        goal: Array,
        limits: tuple[Array, Array],
        follows: bool | None = False,
        most: float = math.inf,
        bent: BentMode | None = None,
    ) -> Array | None:
        """Return the next command (n,), in Pa; None if the solver failed.

        Parameters
        ----------
        tip : the model's tip on the reference's path.
        reference : the reference, with the offset that its plan accounts for.
        prescribed : components (5,) that the target prescribes; see `prescribed_components`.
        offset : present estimate of the tip's offset (6,).
        goal : command (n,) of the reference, in Pa.
        limits : lowest and highest command (n,), in Pa.
        follows : whether the tip follows a trajectory, or steps to a target; None: neither, and
            what its motion does to the offset is not learned.
        most : largest correction of the position, in m.
        bent : modes of the arm near here, from which the estimator's `excess` is; None: those of
            the straight arm.
        """
        arm, position = self._arm, tip.pose[:3, 3]
        self._learn(position, follows)
        self._average(np.concatenate([offset, position]))
        self._allocation.limit(*limits)
        command, held, residual = self._allocation.solve(
            (
                tip.pose, tip.jacobian, prescribed, *self._vibration_inputs(reference, bent),
                offset, self._motion_error.slope, arm.tip.stiff_axis,
                arm.pressures.lag + arm.pressures.dead_time, most,
                reference.motion, self._averaged.averages,
            ),
            goal,
            arm.pressures.command,
        )  # fmt: skip
        if command is not None:
            reported = residual > self._tuning.unreported_error
            self.saturated = held if reported else np.zeros(len(goal), dtype=bool)
        return command

    def _learn(self, position: Array, follows: bool | None) -> None:
        """Learn how the offset changes while the tip on the reference (3,) moves."""
        other = self._on_trajectories if follows else self._in_steps
        if follows is None or other is not self._motion_error:
            self._motion_error.stop()
        self._motion_error, modelled = other, self._arm.modelled
        behind = 0.0
        if not self._is_new:
            behind = math.dist(position.tolist(), self._averaged.value[6:].tolist())
        if follows is None or (not follows and behind < self._ended):
            self._motion_error.stop()
        elif modelled is not None:
            self._motion_error.learn(self._period, modelled.pose[:3, 3], self._arm.tip.offset[:3])

    def _average(self, now: Array) -> None:
        """Average offset and position (9,) of the tip over a vibration."""
        if self._is_new:
            self._averaged.begin(now)
            self._is_new = False
        self._averaged.advance(now, self._arm.tip.omega)

    def _vibration_inputs(
        self, reference: Reference, bent: BentMode | None
    ) -> tuple[ArrayLike, ...]:
        """Return the inputs of `tracking_rows` and `with_excess` for an arm that vibrates.

        Those that `with_reference` replaces are left out.
        """
        if self._gains is None:
            return ()
        estimator = self._arm.tip
        plane = estimator.soft_plane if bent is None else bent.plane
        return (
            estimator.vibration, plane, estimator.excess, estimator.omega,
            self._gains.at(estimator.omega), self._arm.pressures.effective_ahead,
            self._arm.strained_ahead, reference.chamber,
        )  # fmt: skip
