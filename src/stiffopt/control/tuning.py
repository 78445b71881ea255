"""Tuning of the control loop: the numbers that somebody may want to change, by concept.

They hold for all arms and rigs. What differs from one rig to the next, such as limits, the lag of
the regulators or the noise of the tracker, stands in the rig file (`stiffopt.rig.settings`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = [
    "ControlTuning",
    "EstimatorTuning",
    "FeedbackTuning",
    "NearestTuning",
    "PlanningTuning",
    "ReferenceTuning",
    "RegulatorTuning",
    "ReplanningTuning",
    "SupervisionTuning",
    "TrackerTuning",
]


@dataclass(frozen=True)
class EstimatorTuning:
    """Noise and outlier rejection of the tip's Kalman filter (`TipEstimator`).

    Attributes
    ----------
    noise : standard deviation of a tracked position in each axis, in m.
    angular_noise : of a tracked orientation, in rad.
    max_speed : fastest that a tip moves, in m/s; samples that would need more are rejected.
    model_error : error of the model's displacement, as a share of that displacement.
    drift : growth of the offset's standard deviation at rest, in m / sqrt(s).
    angular_drift : the same of the orientation's offset, in rad / sqrt(s).
    agitation : growth of the standard deviation of the vibration's speed, in m/s / sqrt(s).
    frequency_error : relative error of the square of the vibration's frequency.
    damping : damping ratio of the vibration.
    memory : age beyond which a sample is dropped, in s.
    soft_share : compliance, as a share of the largest, below which a direction vibrates less.
    least_frequency : lower bound of the vibration's angular frequency, in rad/s; that of an arm
        about to buckle would be 0.
    frozen : displacement of the model, in m, after which a pose that has not changed in one digit
        is a frozen reading.
    patience : rejected samples in a row after which the filter starts from the new position.
    longest_gap : time since the last sample, in s, for which `max_speed` allows a displacement; a
        tip that jumped and stays there is thus never accepted.
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
    memory: float = 0.4
    soft_share: float = 0.15
    least_frequency: float = 0.5
    frozen: float = 2e-3
    patience: int = 40
    longest_gap: float = 0.05


@dataclass(frozen=True)
class RegulatorTuning:
    """Observer gains of the regulators' model, and how much of its offset is compensated.

    Attributes
    ----------
    pressure_gain : rate at which a reading corrects the pressure, in 1/s.
    offset_gain : rate at which it corrects the offset, in 1/s^2.
    max_compensation : largest offset of a regulator that commands make up for, in Pa.
    """

    pressure_gain: float = 30.0
    offset_gain: float = 225.0
    max_compensation: float = 3e3


@dataclass(frozen=True)
class ReferenceTuning:
    """Bandwidth of the reference filter.

    Attributes
    ----------
    vibrating_rate : rate of its lags over the angular frequency of an arm that vibrates.
    rigid_rate : largest rate of its lags, and that of an arm that does not vibrate, in 1/s.
    slew_share : share of the slew that the reference may take; the rest is for feedback.
    model_range : change of pressure (norm over all channels) over which the model's derivatives
        along the reference are not evaluated again, in Pa.
    """

    vibrating_rate: float = 1.2
    rigid_rate: float = 100.0
    slew_share: float = 0.9
    model_range: float = 3e3


@dataclass(frozen=True)
class FeedbackTuning:
    """Feedback at the tip.

    Attributes
    ----------
    lever : weight of an angle against a length, in m/rad.
    mode_weight : weight of the vibration's part of the tip's motion against the motion itself.
    effort : weight of effort against error in the linear-quadratic regulator.
    offset_rate : rate with which the offset of a vibrating arm is corrected, over its angular
        frequency; part of each vibration is mistaken for an offset.
    posture_weight : change of the tip's position below which a change of pressure is left to the
        plan, in m/bar: the square root of epsilon of the quadratic program.
    unreported_error : error that a limit may cause at the tip without a channel being reported as
        saturated, in m.
    max_offset : offset of the tip beyond which the model is not that of the arm, as a share of the
        arm's length.
    """

    lever: float = 0.05
    mode_weight: float = 3.0
    effort: float = 1.0
    offset_rate: float = 0.6
    posture_weight: float = 0.3e-3
    unreported_error: float = 2e-4
    max_offset: float = 0.5


@dataclass(frozen=True)
class ReplanningTuning:
    """When plans are made anew, and how quickly they follow the estimated offset.

    Attributes
    ----------
    interval : between plans, in s.
    offset_time : time constant with which the plan's offset follows the estimate, in s.
    offset_periods : least such time constant of an arm that vibrates, in rad of its vibration.
    far_position : change of a target, in m, after which all configurations are searched.
    far_angle : the same of its orientation or pointing, in rad.
    """

    interval: float = 0.05
    offset_time: float = 1.0
    offset_periods: float = 3.0
    far_position: float = 5e-3
    far_angle: float = math.radians(5)


@dataclass(frozen=True)
class PlanningTuning:
    """When a plan may change to another configuration of the arm.

    Attributes
    ----------
    advantage : relative stiffness by which another configuration must be better; it doubles with
        each change.
    search_offset : change of the offset, in m, after which all configurations are searched.
    at_rest : change of the offset from plan to plan below which the arm is at rest, in m.
    neighbourhood : distance in pressure beyond which an optimum is another configuration, in Pa.
    neighbourhood_per_metre : what each metre of a target's displacement adds to it, in Pa/m.
    patience : plans for which an optimum in another configuration is refused before it is taken.
    position_tolerance, angle_tolerance : tolerances with which plans are made, in m and rad.
    """

    advantage: float = 0.02
    search_offset: float = 2e-3
    at_rest: float = 5e-5
    neighbourhood: float = 2e4
    neighbourhood_per_metre: float = 2e7
    patience: int = 20
    position_tolerance: float = 1e-5
    angle_tolerance: float = 1e-3


@dataclass(frozen=True)
class NearestTuning:
    """Gauss-Newton search for the configuration nearest to a target that is out of reach.

    Attributes
    ----------
    iterations : at most.
    max_step : largest change of a pressure in an iteration, in Pa.
    progress : of the error, in m, below which the search ends.
    regularisation : of the normal equations, in m/bar.
    """

    iterations: int = 40
    max_step: float = 0.3e5
    progress: float = 1e-7
    regularisation: float = 1e-4


@dataclass(frozen=True)
class SupervisionTuning:
    """Patience of the state machine; what is a fault is decided by `Safety` of the rig file.

    Attributes
    ----------
    force_alarm : time for which the alarm of the total force outlasts the last command that was
        shortened, in s.
    max_failures : failures of the controller in a row after which pressures are held.
    vent_attempts : to vent when the loop ends.
    stop_margin : time after the ramp in which the ending loop goes on trying to vent, in s.
    vented_offset : distance of the vented tip from the model's, as a share of the arm's length,
        beyond which the arm is not armed.
    """

    force_alarm: float = 0.5
    max_failures: int = 3
    vent_attempts: int = 3
    stop_margin: float = 0.5
    vented_offset: float = 0.1


@dataclass(frozen=True)
class TrackerTuning:
    """What is known of a tracker's rhythm, and when it is trusted again.

    Attributes
    ----------
    window : samples from which interval and latency are learned.
    enough : samples without which neither is known.
    back : ticks with new samples, none overdue, after which a tip that was missing is seen again.
    jitter : share of an interval by which a sample may be late.
    """

    window: int = 24
    enough: int = 8
    back: int = 8
    jitter: float = 0.25


@dataclass(frozen=True)
class ControlTuning:
    """Tuning of `TipController`, by part.

    Attributes
    ----------
    regulators, estimator, reference, feedback, replanning : see their classes; noise, speed and
        damping of the estimator are those of the rig file.
    """

    regulators: RegulatorTuning = field(default_factory=RegulatorTuning)
    estimator: EstimatorTuning = field(default_factory=EstimatorTuning)
    reference: ReferenceTuning = field(default_factory=ReferenceTuning)
    feedback: FeedbackTuning = field(default_factory=FeedbackTuning)
    replanning: ReplanningTuning = field(default_factory=ReplanningTuning)
