"""Tuning of the control loop: the numbers that somebody may want to change, by concept.

They hold for all arms and rigs. What differs from one rig to the next, such as limits, the lag of
the regulators or the noise of the tracker, stands in the rig file (`stiffopt.rig.settings`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True)
class EstimatorTuning:
    """Noise and outlier rejection of the tip's Kalman filter (`TipEstimator`)."""

    noise: float = 5e-5  # standard deviation of a tracked position in each axis, in m
    angular_noise: float = 2e-3  # of a tracked orientation, in rad
    # fastest that a tip moves, in m/s; samples that would need more are rejected
    max_speed: float = 1.0
    model_error: float = 0.2  # error of the model's displacement, as a share of that displacement
    # error of what excites the vibration, as a share of the mode's displacement
    excitation_error: float = 0.05
    drift: float = 3e-4  # growth of the offset's standard deviation at rest, in m / sqrt(s)
    angular_drift: float = 3e-3  # the same of the orientation's offset, in rad / sqrt(s)
    # growth of the standard deviation of the vibration's speed, in m/s / sqrt(s)
    agitation: float = 2e-3
    frequency_error: float = 0.1  # relative error of the square of the vibration's frequency
    damping: float = 0.04  # damping ratio of the vibration
    memory: float = 0.4  # age beyond which a sample is dropped, in s
    # compliance, as a share of the largest, below which a direction vibrates less
    soft_share: float = 0.15
    # lower bound of the vibration's angular frequency, in rad/s; that of an arm about to buckle
    # would be 0
    least_frequency: float = 0.5
    # displacement of the model, in m, after which a pose that has not changed in one digit is a
    # frozen reading
    frozen: float = 2e-3
    patience: int = 40  # rejected samples in a row after which the filter starts anew from them
    # time since the last sample, in s, for which `max_speed` allows a displacement; a tip that
    # jumped and stays there is thus never accepted
    longest_gap: float = 0.05


@dataclass(frozen=True)
class RegulatorTuning:
    """Observer gains of the regulators' model, and what is done about those that do not follow.

    `Channels` says what limited and stuck channels are.
    """

    pressure_gain: float = 30.0  # rate at which a reading corrects the pressure, in 1/s
    offset_gain: float = 225.0  # rate at which it corrects the offset, in 1/s^2
    # largest offset of a regulator that commands make up for at once, in Pa
    max_compensation: float = 3e3
    # largest shortfall that they make up for in time, as a share of `Safety.max_pressure_error`
    make_up_share: float = 0.8
    # time constant of that, in s: slower than the pressure monitor, which finds sudden leaks
    make_up_time: float = 1.0
    told_share: float = 0.5  # share of that shortfall from which there is an alarm
    reading_time: float = 0.1  # time constant that takes the noise from readings, in s
    patience: float = 0.5  # time for which a channel must be short, or above, in s
    follows: float = 3e3  # distance from a command, in Pa, at which a regulator follows
    # distance of a command below the pressure of a channel that does not fall, as a share of
    # `Safety.max_pressure_error`
    probe_share: float = 0.5
    let_down_share: float = 0.1  # share of the slew with which a channel is let down on request


@dataclass(frozen=True)
class ReferenceTuning:
    """Bandwidth of the reference filter."""

    # rate of its lags over the angular frequency of an arm that vibrates
    vibrating_rate: float = 1.4
    # largest rate of its lags, and that of an arm that does not vibrate, in 1/s
    rigid_rate: float = 100.0
    # share of the slew that the reference may take; the rest is for feedback
    slew_share: float = 0.9
    # change of pressure (norm over all channels) over which the model's derivatives along the
    # reference are not evaluated again, in Pa
    model_range: float = 3e3
    # distance from the plan at which it has arrived, in Pa, and speed at which it rests, in Pa/s
    there: float = 5e3
    at_rest: float = 5e4


@dataclass(frozen=True)
class FeedbackTuning:
    """Feedback at the tip."""

    lever: float = 0.05  # weight of an angle against a length, in m/rad
    # weight of the vibration's part of the tip's motion against the motion itself
    mode_weight: float = 3.0
    effort: float = 3.0  # weight of effort against error in the linear-quadratic regulator
    # change of the tip's position below which a change of pressure is left to the plan, in m/bar:
    # the square root of epsilon of the quadratic program
    posture_weight: float = 0.3e-3
    # error that a limit may cause at the tip without a channel being reported as saturated, in m
    unreported_error: float = 2e-4
    # share of the arm's length beyond which the tip's offset is no error of this arm's model
    max_offset: float = 0.5


@dataclass(frozen=True)
class ReplanningTuning:
    """When plans are made anew, and how quickly they follow the estimated offset."""

    interval: float = 0.05  # between plans, in s
    # time constant with which the plan's offset follows the estimate, in s
    offset_time: float = 1.0
    # least such time constant of an arm that vibrates, in rad of its vibration
    offset_periods: float = 3.0
    # change of a target, in m, after which all configurations are searched
    far_position: float = 5e-3
    far_angle: float = math.radians(5)  # the same of its orientation or pointing, in rad
    # change of a pressure that a channel can have, in Pa, after which they are searched too
    other_pressure: float = 1e4


@dataclass(frozen=True)
class PostureTuning:
    """How trajectories of pressures are followed."""

    # share of the slew that the reference may take on them: they are within it already
    slew_share: float = 1.0
    # distance in pressure at which the arm is where a trajectory begins, in Pa
    there: float = 1e4


@dataclass(frozen=True)
class ForecastTuning:
    """How requests are checked against the rig's scene before they are accepted."""

    patience: float = 8.0  # in which a way must have been checked, in s
    look: float = 2e-3  # between looks for the planner's answer, in s
    # distance and angle between targets of a trajectory for which plans are made, in m and rad
    spacing: float = 1e-3
    turn: float = math.radians(1)
    most: int = 1000  # such targets
    # distance in pressure that the arm may have moved since a way was checked, in Pa
    moved: float = 1e4


@dataclass(frozen=True)
class AdaptationTuning:
    """How the arm's numbers are adapted (`Adaptation`), and how often the model changes."""

    bound: float = 3.0  # of each coordinate, in prior deviations
    mass: float = 0.01  # deviation of the mass at the tip that the file does not have, in kg
    iterations: int = 2  # of Gauss-Newton
    # discrepancy of the model: of the position, in m, and as a share of its displacement from rest;
    # of the orientation, in rad
    position_error: float = 1e-3
    model_error: float = 0.04
    angle_error: float = 0.02
    stiffness_error: float = 0.05  # of the stiffness, relative
    reach: float = 5e4  # distance in pressure over which it is the same, in Pa
    memory: float = 1800.0  # time in which the deviation of a window's error grows e-fold, in s
    # change of an applied number, in prior deviations, below which it stays; largest one in a step
    least_step: float = 0.05
    step: float = 1.0
    interval: float = 10.0  # between two changes of the model, in s, or until another target
    # after such a change, time in s in which the plan is followed slowly, and share of the slew
    calm_time: float = 4.0
    slew_share: float = 0.1
    # distance in pressure after which the deviation of the stiffness is computed anew, in Pa
    elsewhere: float = 3e4
    at_rest: float = 1e3  # change of a pressure from plan to plan, in Pa, below which it rests


@dataclass(frozen=True)
class WindowTuning:
    """When the tip is at rest, and how long it is averaged (`WindowWatch`)."""

    every: float = 0.04  # between two looks, in s
    wait: float = 0.6  # time at rest before a window, in s
    duration: float = 0.8  # of a window, in s
    again: float = 10.0  # from a window to the next one of the same rest, in s
    # changes within a window above which it begins anew: of a pressure, in Pa, of the tip, in m
    drift_pressure: float = 4e3
    drift_position: float = 3e-4
    vibration: float = 3e-4  # above which the tip is not at rest, in m
    seen: float = 0.3  # age of the latest sample above which it is not known, in s
    same: float = 1e4  # distance in pressure below which it is the same posture, in Pa
    # distance of the tips of two windows of one posture, in m, at which the load is another one
    changed: float = 2e-3
    most: int = 10  # windows that are kept


@dataclass(frozen=True)
class PlanningTuning:
    """When a plan may change to another configuration of the arm."""

    # relative stiffness by which another configuration must be better; it doubles with each change
    advantage: float = 0.02
    # change of the offset, in m, after which all configurations are searched
    search_offset: float = 2e-3
    # change of the offset from plan to plan below which the arm is at rest, in m
    at_rest: float = 5e-5
    # distance in pressure beyond which an optimum is another configuration, in Pa
    neighbourhood: float = 2e4
    # what each metre of a target's displacement adds to it, in Pa/m
    neighbourhood_per_metre: float = 2e7
    # plans for which an optimum in another configuration is refused before it is taken
    patience: int = 20
    position_tolerance: float = 1e-5  # with which plans are made, in m
    angle_tolerance: float = 1e-3  # likewise, in rad


@dataclass(frozen=True)
class NearestTuning:
    """Gauss-Newton search for the configuration nearest to a target that is out of reach."""

    iterations: int = 40  # at most
    max_step: float = 0.3e5  # largest change of a pressure in an iteration, in Pa
    progress: float = 1e-7  # of the error, in m, below which the search ends
    regularisation: float = 1e-4  # of the normal equations, in m/bar


@dataclass(frozen=True)
class SupervisionTuning:
    """Patience of the state machine; what is a fault is decided by `Safety` of the rig file."""

    # time for which the alarm of the total force outlasts the last command that was shortened, in s
    force_alarm: float = 0.5
    max_failures: int = 3  # failures of the controller in a row after which pressures are held
    chamber_lag: float = 0.3  # by which the pressures in the chambers may lag behind commands, in s
    # time of steering after which a hold is a new one, and its timeout begins anew, in s
    hold_memory: float = 2.0
    # time after a doubt in which another one lets the pressures down at once, in s
    doubt_memory: float = 30.0
    vent_attempts: int = 3  # to vent when the loop ends
    # time after the ramp in which the ending loop goes on trying to vent, in s
    stop_margin: float = 0.5
    # distance of the vented tip from the model's, as a share of the arm's length, beyond which the
    # arm is not armed
    vented_offset: float = 0.1


@dataclass(frozen=True)
class DriftScale:
    """A drift that counts: in so many intervals, each in s, faster than a speed in m/s."""

    interval: float
    count: int
    least_speed: float


@dataclass(frozen=True)
class MotionTuning:
    """What in the tip's motion is doubted (`MotionWatch`)."""

    spacing: float = 0.02  # least time between two samples that are compared, in s
    longest_pause: float = 0.1  # since the arm was steered, after which none is compared, in s
    # by what share of what each segment moves the tip the model may be wrong
    model_error: float = 0.35
    noise: float = 1e-3  # of a motion that is seen, in m
    scatter: float = 5e-5  # standard deviation of a tracked position in each axis, in m
    # way from which on a response is looked at: a length in m, and a share of the arm's length
    least_motion: float = 3e-3
    least_motion_share: float = 0.025
    response_window: float = 0.6  # in which the tip must have moved as the model has it, in s
    least_response: float = 0.25  # share of that way by which it must have moved along it
    most_across: float = 0.75  # share of that way by which it may have moved across it
    late: float = 0.01  # by which the tip may move later than the model has it, in s
    misses: int = 2  # samples in a row that show no response
    slip_window: float = 1.0  # in which a slip is looked for, in s
    # share of the turn that a push brings along by which the measured turn must miss it
    slip: float = 0.7
    least_turn: float = 0.02  # by which it must miss it at least, in rad
    slips: int = 4  # samples in a row that show a slip
    scales: tuple[DriftScale, ...] = (
        DriftScale(0.25, 5, 2e-3),
        DriftScale(1.0, 5, 6e-4),
        DriftScale(2.5, 4, 3.5e-4),
    )
    turn: float = 1e-3  # way back after which a swing has turned, in m
    swings: int = 4  # between turns, one after the other
    least_swing: float = 4.5e-3  # from one turn to the next, in m
    decay: float = 0.8  # a last swing that is a smaller share of the largest decays
    swing_window: float = 6.0  # in which they must be, in s


@dataclass(frozen=True)
class TouchTuning:
    """Noise of what is between model and tip, and when a force is believed (`TouchEstimator`)."""

    force: float = 0.1  # standard deviation of forces that are thought possible, in N
    stiffness_error: float = 0.1  # of the arm, relative, where it is not known
    noise: float = 1e-4  # of a position, in m
    late: float = 0.01  # by which the tip may move later than the model has it, in s
    # error of the model, as a share of the way of the last moments, and how long these last, in s
    model_error: float = 0.03
    motion_time: float = 0.6
    # what a fast motion adds to that share, and how fast that is, in m/s
    fast_error: float = 0.15
    fast: float = 0.1
    drift: float = 1e-4  # growth of its standard deviation at rest, in m / sqrt(s)
    # rate of creep after a motion, as a share of its way, in 1/s; the time in which it decays, in
    # s; and its growth at random, as a share of the way of that time, in 1/s / sqrt(s)
    creep: float = 0.03
    creep_time: float = 5.0
    creep_change: float = 0.01
    # share of a motion that may excite the vibration beyond what the model has
    swing_error: float = 0.1
    # growth of the standard deviation of the vibration's speed, in m/s / sqrt(s); and, as a share,
    # by how much its frequency may be off
    agitation: float = 2e-3
    detuned: float = 0.06
    # standard deviations when it begins: in m, m/s, m and m/s
    first_error: float = 0.02
    first_rate: float = 1e-3
    first_swing: float = 0.01
    first_speed: float = 0.03
    longest_gap: float = 1.0  # between samples, after which it begins anew, in s
    spacing: float = 0.1  # between the beginnings of hypotheses, in s
    hypothesis_time: float = 2.0  # after which one is given up, in s
    jump: float = 0.012  # standard deviation of a force when a hypothesis begins, in N
    # growth of a force's standard deviation, in N / sqrt(s): while a hypothesis is open, for so
    # many seconds, and later
    open_rate: float = 0.05
    open_time: float = 0.3
    force_rate: float = 0.003
    rate: float = 0.02  # standard deviation of the rate of a force that changes, in N/s
    rate_time: float = 0.7  # in which that rate decays, in s
    evidence: float = 15.0  # logarithm of the likelihood ratio from which one is believed
    samples: int = 3  # in a row in which it must be
    least_force: float = 3e-3  # that counts, in N
    gone_share: float = 0.7  # share of it below which a force is none any more
    quiet: int = 20  # after so many samples in a row
    # while the tip approaches something: the way in which the model's error there is learned, in m,
    # and its deviation before, as a share of the way
    learning_way: float = 1.5e-3
    approach_error: float = 0.1
    # while it presses: the share of a motion by which the force displaces the tip back, and its
    # deviation
    held_share: float = 0.9
    held_error: float = 0.15


@dataclass(frozen=True)
class PressingTuning:
    """How the tip presses on something (`Pressing`)."""

    # time at the target before the approach begins, in s; and the longest time that it waits until
    # the arm's stiffness is known better
    rest: float = 0.5
    longest_rest: float = 8.0
    time: float = 0.7  # time constant of the force against a rigid surface, in s
    touch_share: float = 0.2  # share of the force from which the approach slows down
    lost: float = 0.4  # time without a contact after which it is lost, in s
    # largest share of the force that may be felt, or that the arm's compliance explains; and by
    # how much the tip may be held back beyond that, in m
    most_force: float = 1.6
    held_back: float = 2e-3
    settled: float = 0.5  # time within the tolerance after which it is told, in s
    patience: float = 5.0  # time beyond it after which there is an alarm, in s


@dataclass(frozen=True)
class BracingTuning:
    """How the arm leans on objects (`Bracing`)."""

    at_rest: float = 2e3  # pressure below which the arm is at rest, in Pa
    to_rest: float = 3.0  # time in which it goes to rest, in s
    settle: float = 1.0  # time at the end of the approach before it is held, in s
    # distance between the tips of the braced and the free arm that can be told apart, in m; share
    # of it from which the arm is free; and samples in a row
    told_apart: float = 4e-3
    free_share: float = 0.6
    samples: int = 3
    off_plan: float = 1.5e4  # pressure beside the wanted one from which nothing is judged, in Pa
    swing_time: float = 0.08  # over which the seen tip is averaged, in s
    # displacement of the tip from which a push is felt, in m; time constant with which what is
    # smaller becomes the model's error, in s; and time after which a push does, too
    felt: float = 6e-4
    error_time: float = 2.0
    # at first, while the tip goes to its target and the arm creeps most: for how long, and with
    # which time constant, in s
    settling: float = 8.0
    settling_time: float = 0.3
    longest_push: float = 60.0
    # deviation of that displacement, in m, and of pushes, in N
    deviation: float = 5e-4
    usual_push: float = 0.1
    every: float = 0.05  # between two looks at what the contacts hold, in s
    looks: int = 2  # in a row
    time: float = 3.0  # time constant with which the tip goes to its target, in s
    force_weight: float = 0.1  # error of the tip that a change of a contact force counts as, in m/N
    pressure_weight: float = 2e-8  # likewise of a pressure, in m/Pa
    most_change: float = 1e4  # largest change of a planned pressure, in Pa


@dataclass(frozen=True)
class TrackerTuning:
    """What is known of a tracker's rhythm, and when it is trusted again."""

    window: int = 24  # samples from which interval and latency are learned
    enough: int = 8  # samples without which neither is known
    # ticks with new samples, none overdue, after which a tip that was missing is seen again
    back: int = 8
    jitter: float = 0.25  # share of an interval by which a sample may be late


@dataclass(frozen=True)
class ControlTuning:
    """Tuning of `TipController`, by part; the rig file has noise, speed and damping of the tip."""

    regulators: RegulatorTuning = field(default_factory=RegulatorTuning)
    estimator: EstimatorTuning = field(default_factory=EstimatorTuning)
    reference: ReferenceTuning = field(default_factory=ReferenceTuning)
    feedback: FeedbackTuning = field(default_factory=FeedbackTuning)
    replanning: ReplanningTuning = field(default_factory=ReplanningTuning)
    posture: PostureTuning = field(default_factory=PostureTuning)
    forecast: ForecastTuning = field(default_factory=ForecastTuning)
    adaptation: AdaptationTuning = field(default_factory=AdaptationTuning)
    windows: WindowTuning = field(default_factory=WindowTuning)
    motion: MotionTuning = field(default_factory=MotionTuning)
    touch: TouchTuning = field(default_factory=TouchTuning)
    pressing: PressingTuning = field(default_factory=PressingTuning)
    bracing: BracingTuning = field(default_factory=BracingTuning)
