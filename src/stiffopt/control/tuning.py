"""Tuning of the control loop: numbers that somebody may want to change, by concept.

Those of noticing faults and of contact are in `noticing_tuning.py` and `contact_tuning.py`. All of
them apply to all arms and rigs. What differs between rigs, such as limits, the lag of the
regulators or the noise of the tracker, is in the rig file (`stiffopt.rig.settings`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from stiffopt.control.contact_tuning import BracingTuning, CreepTuning, PressingTuning, TouchTuning
from stiffopt.control.noticing_tuning import MissingMotionTuning, MotionTuning
from stiffopt.rig.settings import ControlSettings, Safety


@dataclass(frozen=True)
class EstimatorTuning:
    """Noise and outlier rejection of the tip's Kalman filter (`TipEstimator`)."""

    noise: float = 5e-5  # standard deviation of a tracked position in each axis, in m
    angular_noise: float = 2e-3  # of a tracked orientation, in rad
    # fastest that a tip moves, in m/s; samples that would need more are rejected
    max_speed: float = 1.0
    model_error: float = 0.2  # error of the model's displacement, as a share of that displacement
    # relative error of the mode's displacement, which excites the vibration
    excitation_error: float = 0.05
    drift: float = 3e-4  # growth of the offset's standard deviation at rest, in m / sqrt(s)
    angular_drift: float = 3e-3  # the same of the orientation's offset, in rad / sqrt(s)
    # growth of the standard deviation of the vibration's speed, in m/s / sqrt(s)
    agitation: float = 2e-3
    frequency_error: float = 0.1  # relative error of the square of the vibration's frequency
    # the same of the frequency itself, as it is learned in motion: its mean (hysteresis slips in a
    # large motion, so that it is slower than a small swing), deviation, random change with the way
    # of the mode, in 1 / sqrt(m), and largest size
    frequency_offset: float = -0.025
    frequency_deviation: float = 0.03
    frequency_change: float = 0.1
    frequency_bound: float = 0.15
    # time after a planned motion for which the arm swings on, and shows its frequency, in s
    swings_on: float = 1.5
    # time by which viscosity makes the tip late, except in the first mode, in s
    viscous_lag: float = 0.035
    damping: float = 0.04  # damping ratio of the vibration
    memory: float = 0.4  # age beyond which a sample is dropped, in s
    # compliance, as a share of the largest, below which a direction vibrates less
    soft_share: float = 0.15
    # the same, above which a direction vibrates slowly enough for fast corrections to excite it
    stiff_share: float = 0.05
    # lower bound of the model's angular frequency, in rad/s; it is 0 for an arm about to buckle
    least_frequency: float = 0.5
    # displacement of the model, in m, after which an exactly unchanged pose is a frozen reading
    frozen: float = 2e-3
    patience: int = 40  # successive rejected samples after which the filter restarts from them
    # time since the last sample, in s, for which `max_speed` allows a displacement; a tip that
    # jumped and stays there is thus never accepted
    longest_gap: float = 0.05


@dataclass(frozen=True)
class RegulatorTuning:
    """Observer gains of the regulators' model, and the treatment of channels that do not follow.

    `Channels` explains limited and stuck channels.
    """

    pressure_gain: float = 30.0  # rate at which a reading corrects the pressure, in 1/s
    offset_gain: float = 225.0  # rate at which it corrects the offset, in 1/s^2
    # largest offset of a regulator that commands compensate at once, in Pa
    max_compensation: float = 3e3
    # largest shortfall that they compensate slowly, as a share of `Safety.max_pressure_error`
    make_up_share: float = 0.8
    # its time constant, in s: slower than the pressure monitor, which finds sudden leaks
    make_up_time: float = 1.0
    alarm_share: float = 0.3  # share of that shortfall above which there is an alarm
    reading_time: float = 0.1  # time constant that smooths readings, in s
    patience: float = 0.5  # time for which a channel must be short, or above, in s
    follows: float = 3e3  # distance from a command, in Pa, at which a regulator follows
    # distance of the command from the pressure of a channel that does not follow, as a share of
    # `Safety.max_pressure_error`: less than the half at which the monitor looks for leaks
    probe_share: float = 0.4
    unmoved: float = 1e3  # change of a reading below which it does not move, in Pa
    # lag and dead time of a slow regulator, as multiples of those of the rig file: its pressure is
    # the least by which a reading must have moved
    slow: float = 2.0
    # a shortfall that grows by more than `unmoved` while its command rests is reported: interval of
    # checks and time at rest before the first one, in s; change of the command that ends the rest,
    # in Pa, and share of it by which the shortfall may change; time constant with which larger
    # shortfalls become usual, in s
    rest_interval: float = 0.05
    rest_time: float = 1.0
    rest_range: float = 1e4
    gain_error: float = 0.05
    usual_time: float = 30.0
    # pressure by which a channel is behind, beyond `follows`, at which the reference stands still,
    # in Pa, and time constant with which it no longer waits, in s
    longest_wait: float = 5e3
    wait_time: float = 1.0
    slow_memory: float = 10.0  # time after that for which feedback leaves the channel alone, in s
    let_down_share: float = 0.1  # share of the slew with which a removed channel is let down


@dataclass(frozen=True)
class LagTuning:
    """How the lags of the regulators are adapted (`LagEstimator`)."""

    deviation: float = 0.3  # of the rig file's lag, relative
    least_deviation: float = 0.03  # below which it does not fall, so that changes are followed
    bound: float = math.log(2)  # largest logarithm of a lag over the rig file's
    noise: float = 5e3  # of a reading, with what the model of the regulator lacks, in Pa
    offset: float = 3e3  # deviation of a gauge from its command at rest, in Pa
    offset_drift: float = 3e3  # its growth, in Pa / sqrt(s)
    gate: float = 4.0  # deviations of a reading beyond which it tells nothing about the lag
    change: float = 0.05  # relative change of a lag below which the model keeps its own


@dataclass(frozen=True)
class ReferenceTuning:
    """Bandwidth of the reference filter."""

    # rate of its lags over the angular frequency of an arm that vibrates
    vibrating_rate: float = 1.7
    # largest rate of its lags, and that of an arm that does not vibrate, in 1/s
    rigid_rate: float = 100.0
    # share of the slew that the reference may take; the rest is for feedback
    slew_share: float = 0.9
    # the tip's way to a new target, before the arm becomes stiff: its least time in periods of the
    # vibration, and the greatest mean speed of the tip by any channel, in m/s
    periods_to_target: float = 0.5
    channel_speed: float = 0.08
    demanded_channel_speed: float = 0.05  # the same of a task that demands a stiffness
    # motion over which the model on the reference is not linearised again; see `LinearisedTip`
    model_range: float = 0.07
    # time by which a doubted motion of an arm that vibrates is taken back, in s
    taken_back: float = 0.3
    # distance from the plan at which it has arrived, in Pa, and rate below which it rests, in Pa/s
    there: float = 5e3
    at_rest: float = 5e4


@dataclass(frozen=True)
class FirstMotionTuning:
    """The first motion after arming (`FirstMotion`)."""

    slew_share: float = 0.1  # share of the slew that the reference may take
    # way of the model's tip, and part of a channel in it, after which it ends, in m, if the tip has
    # followed with an error of at most a share of that way; it begins with a smaller part
    way: float = 5e-3
    error: float = 0.5
    part: float = 1e-3
    # largest correction by feedback at first, in m, and its growth with the reference's way
    correction: float = 0.5e-3
    correction_share: float = 0.2


@dataclass(frozen=True)
class CorrectionTuning:
    """Bound of corrections while the arm goes to its pressures (`CorrectionBound`)."""

    least: float = 3e-3  # of the tip's position at rest, in m
    share: float = 0.2  # of the latest motion of the tip on the reference, added to it
    # largest sum, in m: what feedback does must stay below 10 mm; of a long motion a share instead,
    # since a wrong modulus is off by a share; time for which such a motion counts, in s
    most: float = 5e-3
    share_of_long: float = 0.17
    long_time: float = 5.0
    time: float = 1.0  # of the latest motion, as plans follow the offset, in s
    # growth once the bound does not apply, with and without inertia, in m/s
    release: float = 0.01
    release_without_inertia: float = 0.02


@dataclass(frozen=True)
class FeedbackTuning:
    """Feedback at the tip."""

    lever: float = 0.05  # weight of an angle against a length, in m/rad
    # weight of the vibration's part of the tip's motion against the motion itself
    mode_weight: float = 3.0
    effort: float = 1.0  # weight of effort against error in the linear-quadratic regulator
    # change of the tip's position below which a change of pressure is left to the plan, in m/bar:
    # the square root of epsilon of the quadratic program
    posture_weight: float = 0.3e-3
    # error that a limit may cause at the tip before its channel is reported as saturated, in m
    unreported_error: float = 2e-4
    # share of the arm's length beyond which the tip's offset cannot be an error of its model
    max_offset: float = 0.5


@dataclass(frozen=True)
class MotionErrorTuning:
    """How the tip's offset changes with motion (`MotionErrorEstimator`)."""

    deviation: float = 0.1  # of the share by which the tip moves farther than modelled
    drift: float = 3e-4  # growth of the deviation of the rest of the offset, in m / sqrt(s)
    noise: float = 3e-4  # of an offset, in m
    late: float = 0.1  # error of an offset in motion, as the way of the tip in this time, in s
    every: float = 0.1  # between two offsets that are taken in, in s
    # distance, in m, between the model's tip and its average over a vibration, below which a step
    # has ended
    ended: float = 1e-4


@dataclass(frozen=True)
class ReplanningTuning:
    """When to make new plans, and how quickly they follow the estimated offset."""

    interval: float = 0.05  # between plans, in s
    # time constant with which the plan's offset follows the estimate, in s
    offset_time: float = 1.0
    # lower bound of that time constant for an arm that vibrates, in rad of its vibration
    offset_periods: float = 3.0
    # change of a target, in m, after which all configurations are searched
    far_position: float = 5e-3
    far_angle: float = math.radians(5)  # the same of its orientation or pointing, in rad
    # speed of the tip on its straight way after a loss of channels, in m/s; largest change of a
    # pressure from plan to plan meanwhile, and one with which it has arrived, in Pa
    detour_speed: float = 0.03
    detour_step: float = 5e3
    detour_rest: float = 1e3
    # change of an available pressure, in Pa, after which all configurations are searched
    other_pressure: float = 1e4
    missing: MissingMotionTuning = field(default_factory=MissingMotionTuning)


@dataclass(frozen=True)
class PostureTuning:
    """How the loop follows trajectories of pressures."""

    # share of the slew that the reference may take: the trajectories are within it already
    slew_share: float = 1.0
    # distance in pressure below which the arm is at the start of a trajectory, in Pa
    there: float = 1e4


@dataclass(frozen=True)
class ForecastTuning:
    """How requests are checked against the rig's scene before they are accepted."""

    patience: float = 8.0  # for the check of a way, in s
    look: float = 2e-3  # interval of looking for the planner's answer, in s
    # distance and angle between the targets of a trajectory to plan for, in m and rad
    spacing: float = 1e-3
    turn: float = math.radians(1)
    most: int = 1000  # number of such targets
    # distance in pressure by which the arm may have moved since the check of a way, in Pa
    moved: float = 1e4


@dataclass(frozen=True)
class AdaptationTuning:
    """How the arm's numbers are adapted (`Adaptation`), and how often the model changes."""

    bound: float = 3.0  # of each coordinate, in prior deviations
    mass: float = 0.01  # deviation of the tip mass that the file does not have, in kg
    heavier: float = 2e-5  # mass by which the slope of the pose by the mass is taken, in kg
    iterations: int = 10  # of Gauss-Newton, at most
    halvings: int = 5  # of a step that does not improve the fit
    converged: float = 0.02  # largest change of a number that ends the search, in prior deviations
    # discrepancy of the model: of the position, in m, and as a share of its displacement from rest;
    # of the orientation, in rad
    position_error: float = 1e-3
    model_error: float = 0.04
    angle_error: float = 0.02
    # of the stiffness at the strains of the file's arm, relative; power of the strains with which
    # it grows, from simulated silicone
    stiffness_error: float = 0.07
    strain_power: float = 2.0
    reach: float = 5e4  # distance in pressure over which the discrepancy is correlated, in Pa
    memory: float = 1800.0  # time in which the deviation of a window's error grows e-fold, in s
    # change of an applied number, in prior deviations, below which it stays; largest one in a step
    least_step: float = 0.05
    step: float = 1.0
    interval: float = 10.0  # between two changes of the model, in s, unless the target changes
    kept: int = 3  # models to go back to, in addition to the robot file's
    # time after going back in which the motion of the tip is not judged, in s: the offset still
    # changes after the model that ran away
    blind_time: float = 0.5
    # time after such a change for which the plan is followed slowly, in s, and share of the slew
    calm_time: float = 4.0
    slew_share: float = 0.1
    # distance in pressure after which the deviation of the stiffness is computed again, in Pa
    elsewhere: float = 3e4
    at_rest: float = 1e3  # change of a pressure between plans below which it is at rest, in Pa


@dataclass(frozen=True)
class WindowTuning:
    """When the tip is at rest, and how long it is averaged (`WindowWatch`)."""

    every: float = 0.04  # interval of checks for rest, in s
    wait: float = 0.6  # time at rest before a window, in s
    duration: float = 0.8  # of a window, in s
    again: float = 10.0  # from a window to the next one at the same rest, in s
    # changes within a window above which it restarts: of a pressure, in Pa, of the tip, in m
    drift_pressure: float = 4e3
    drift_position: float = 3e-4
    vibration: float = 3e-4  # above which the tip is not at rest, in m
    seen: float = 0.3  # age of the latest sample above which rest is unknown, in s
    same: float = 1e4  # distance in pressure below which postures count as the same, in Pa
    # distance between the tips of two windows of one posture above which the load has changed, in m
    changed: float = 2e-3
    most: int = 10  # number of windows to keep


@dataclass(frozen=True)
class PlanningTuning:
    """When a plan may change to other pressures for the same target, and how slowly."""

    # relative stiffness by which another configuration must be better; it doubles with each change
    advantage: float = 0.02
    # change of the offset, in m, after which all configurations are searched
    search_offset: float = 2e-3
    # change of the offset from plan to plan below which the arm is at rest, in m
    at_rest: float = 5e-5
    # distance in pressure beyond which an optimum is another configuration, in Pa
    neighbourhood: float = 2e4
    # growth of that distance per metre of a target's displacement, in Pa/m
    neighbourhood_per_metre: float = 2e7
    # successive plans that refuse an optimum in another configuration before one takes it, or that
    # come no nearer to it on the way
    patience: int = 20
    # motion of the tip by one channel from plan to plan on the way to other pressures, in m; plans
    # on that way until a step has this size; share of it by which the rest has to shrink
    change_step: float = 2.5e-4
    change_growth: int = 40
    change_progress: float = 0.05
    # steps in which such a way is looked for, and their longest one over their mean without a jump
    change_looks: int = 8
    change_jump: float = 3.0
    # least stiffness when the tip is at its target first, as a share of the best
    soft: float = 0.5
    # share of a stiffness by which it has to be more than is demanded before the last plan
    demand_margin: float = 0.01
    # plans by which feedback is late on such a way, share of the newest in the mean change of the
    # offset, and longest lead for it, in m
    lead: float = 8.0
    drift_share: float = 0.15
    longest_lead: float = 1e-3
    bent_step: float = 3e3  # change of a pressure after which the modes are new, in Pa
    position_tolerance: float = 1e-5  # of plans, in m
    angle_tolerance: float = 1e-3  # of plans, in rad


@dataclass(frozen=True)
class NearestTuning:
    """Gauss-Newton search for the configuration nearest to a target that is out of reach."""

    iterations: int = 40  # at most
    max_step: float = 0.3e5  # largest change of a pressure in an iteration, in Pa
    progress: float = 1e-7  # decrease of the error below which the search ends, in m
    regularisation: float = 1e-4  # of the normal equations, in m/bar


@dataclass(frozen=True)
class ControlTuning:
    """Tuning of `TipController`, by part; noise, speed and damping come from the rig file."""

    regulators: RegulatorTuning = field(default_factory=RegulatorTuning)
    lags: LagTuning = field(default_factory=LagTuning)
    estimator: EstimatorTuning = field(default_factory=EstimatorTuning)
    reference: ReferenceTuning = field(default_factory=ReferenceTuning)
    first_motion: FirstMotionTuning = field(default_factory=FirstMotionTuning)
    feedback: FeedbackTuning = field(default_factory=FeedbackTuning)
    correction: CorrectionTuning = field(default_factory=CorrectionTuning)
    motion_error: MotionErrorTuning = field(default_factory=MotionErrorTuning)
    # of a step, which goes one way and soon ends: its offsets count more, for smaller changes
    step_error: MotionErrorTuning = field(
        default_factory=lambda: MotionErrorTuning(deviation=0.05, late=0.01, every=0.05)
    )
    replanning: ReplanningTuning = field(default_factory=ReplanningTuning)
    posture: PostureTuning = field(default_factory=PostureTuning)
    forecast: ForecastTuning = field(default_factory=ForecastTuning)
    adaptation: AdaptationTuning = field(default_factory=AdaptationTuning)
    windows: WindowTuning = field(default_factory=WindowTuning)
    motion: MotionTuning = field(default_factory=MotionTuning)
    creep: CreepTuning = field(default_factory=CreepTuning)
    touch: TouchTuning = field(default_factory=TouchTuning)
    pressing: PressingTuning = field(default_factory=PressingTuning)
    bracing: BracingTuning = field(default_factory=BracingTuning)

    def on_rig(self, control: ControlSettings, safety: Safety) -> ControlTuning:
        """Return the tuning with what the settings of a rig say: noise, speed and damping."""
        noise = control.tracker_noise
        return replace(
            self,
            estimator=replace(
                self.estimator,
                noise=noise,
                max_speed=safety.max_tip_speed,
                damping=control.damping,
            ),
            motion=replace(self.motion, scatter=noise),
            creep=replace(self.creep, noise=max(self.creep.noise, 2 * noise)),
            touch=replace(self.touch, noise=max(self.touch.noise, 2 * noise)),
            bracing=replace(self.bracing, sliding=replace(self.bracing.sliding, noise=noise)),
        )
