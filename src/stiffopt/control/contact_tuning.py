"""Tuning of contact: feeling forces, pressing, and leaning on objects."""

from __future__ import annotations

from dataclasses import dataclass, field

from stiffopt.optimise.settings import BRACE


@dataclass(frozen=True)
class CreepTuning:
    """Assumptions about the creep of an arm, and noise for learning it (`CreepEstimator`)."""

    times: tuple[float, ...] = (1.5, 6.0, 25.0)  # time constants, in s
    # shares that creep with each of them and their deviation; the latter for an arm whose creep
    # was calibrated; and the correlation of the shares of an arm
    share: float = 0.02
    deviation: float = 0.025
    known: float = 0.008
    alike: float = 0.5
    changes: float = 0.2  # growth of a share's deviation with the way, in 1/m
    first_error: float = 0.02  # deviation of the model's error, in m
    model_error: float = 0.05  # its growth, as a share of the recent way
    drift: float = 5e-5  # its growth at rest, in m / sqrt(s)
    noise: float = 1e-4  # of a mean of positions, in m
    unfelt: float = 0.02  # the same along axes in which no force is felt, in m
    late: float = 0.02  # by which the tip may move later than the model's, in s
    every: float = 0.1  # time over which samples are averaged, in s


@dataclass(frozen=True)
class TouchTuning:
    """Noise of the tip relative to the model, and thresholds of a force (`TouchEstimator`)."""

    force: float = 0.1  # standard deviation of forces that are considered possible, in N
    stiffness_error: float = 0.1  # of the arm, relative, where it is unknown
    noise: float = 1e-4  # of a position, in m
    late: float = 0.01  # by which the tip may move later than the model's, in s
    # error of the model, as a share of the recent way, and time constant of "recent", in s
    model_error: float = 0.03
    motion_time: float = 0.6
    # addition to that share in a fast motion, and speed of a fast motion, in m/s
    fast_error: float = 0.15
    fast: float = 0.1
    drift: float = 1e-4  # growth of the error's standard deviation at rest, in m / sqrt(s)
    # rate of creep after a motion, as a share of its way, in 1/s; time constant of its decay, in s;
    # and its random growth, as a share of the way within that time, in 1/s / sqrt(s)
    creep: float = 0.03
    creep_time: float = 5.0
    creep_change: float = 0.01
    # share of a motion that may excite vibration that the model does not predict
    swing_error: float = 0.1
    # growth of the standard deviation of the vibration's speed, in m/s / sqrt(s); and relative
    # error of its frequency
    agitation: float = 2e-3
    detuned: float = 0.06
    # standard deviations at the start: in m, m/s, m and m/s
    first_error: float = 0.02
    first_rate: float = 1e-3
    first_swing: float = 0.01
    first_speed: float = 0.03
    longest_gap: float = 1.0  # between samples, after which the estimator restarts, in s
    spacing: float = 0.1  # between the starts of hypotheses, in s
    hypothesis_time: float = 2.0  # after which a hypothesis is dropped, in s
    jump: float = 0.012  # standard deviation of a force when a hypothesis starts, in N
    # growth of a force's standard deviation, in N / sqrt(s): in the first `open_time` of a
    # hypothesis, in s, and later
    open_rate: float = 0.05
    open_time: float = 0.3
    force_rate: float = 0.003
    rate: float = 0.02  # standard deviation of the rate of a changing force, in N/s
    rate_time: float = 0.7  # time constant of that rate, in s
    evidence: float = 15.0  # log-likelihood ratio above which a hypothesis is adopted
    samples: int = 3  # successive samples above it
    least_force: float = 3e-3  # smallest force that counts, in N
    gone_share: float = 0.7  # share of it below which a force counts as gone
    quiet: int = 20  # successive samples below that share
    # during an approach: way in which the model's error there is learned, in m, and the error's
    # deviation before that, as a share of the way
    learning_way: float = 1.5e-3
    approach_error: float = 0.1
    # during a press: share of a motion by which the force displaces the tip back, and its deviation
    held_share: float = 0.9
    held_error: float = 0.15


@dataclass(frozen=True)
class ObstructionTuning:
    """When something holds the tip back from its target (`ObstructionWatch`)."""

    still: float = 1e-3  # displacement within which the tip has stopped, in m
    error: float = 4e-4  # of the tip, below which more is allowed in inverse proportion, in m
    # change of the offset without anything in the way, in m; and the part of it that creep may
    # cause, as a share of the way to the target
    least: float = 1.5e-3
    creep: float = 0.1
    # part that a change of posture at the target may cause, as a share of the channels' motions
    posture: float = 0.1


@dataclass(frozen=True)
class PressingTuning:
    """How the tip presses on something (`Pressing`)."""

    # time at the target before the approach, in s; and its upper bound while a better estimate of
    # the arm's stiffness is due, or the creep of the press to come is not known well enough: by its
    # deviation within a time, in s, as a share of the error that a felt force may have
    rest: float = 0.5
    longest_rest: float = 8.0
    foresight: float = 20.0
    creep_share: float = 0.4
    time: float = 0.7  # time constant of the force against a rigid surface, in s
    touch_share: float = 0.2  # share of the force above which the approach becomes a press
    lost: float = 0.4  # time without a force after which the contact is lost, in s
    # largest share of the force that may be felt, or that the arm's compliance explains; and by
    # how much more the tip may be held back, in m
    most_force: float = 1.6
    held_back: float = 2e-3
    out_of_reach: float = 2e-3  # distance of the arm's nearest pose that ends the press, in m
    settled: float = 0.5  # time within the tolerance after which an event reports it, in s
    patience: float = 5.0  # time beyond the tolerance after which there is an alarm, in s
    # way of the arm without contact, in m, on which the tip follows by at least this share, unless
    # it touched something when the approach began
    free_way: float = 1.5e-3
    free_share: float = 0.45
    # way on which the tip follows again before it has left an object at its target, and the largest
    # motion of the arm without contact for it, in m
    clear: float = 3e-3
    most_back: float = 0.03
    beyond: float = 2e-3  # distance of the tip beyond the target that an event reports, in m
    obstruction: ObstructionTuning = field(default_factory=ObstructionTuning)


@dataclass(frozen=True)
class SlidingTuning:
    """How slides of a braced arm are estimated and told (`SlideEstimator`)."""

    # deviation of a tracked position in each axis, in m; of a turn over that, in rad/m
    noise: float = 5e-5
    turn: float = 40.0
    # a turn jumps if it differs from the prediction by so many standard deviations
    jump: float = 6.0
    # deviations of the model's error for place and turn, in m and rad: at first; by creep, per
    # e-fold of the time in contact and of a time before, in s; and by drift in a second
    error: tuple[float, float] = (1e-2, 3e-2)
    creep: tuple[float, float] = (2e-4, 3e-3)
    creep_share: float = 0.01  # by which pressures seem to grow, or fall, per such e-fold
    creep_time: float = 3.0
    drift: tuple[float, float] = (1e-5, 2e-4)
    push_time: float = 5.0  # in which a push comes or goes, in s
    # deviation of a slide in a second, in m; time after which one is the model's error, in s
    slide: float = 1e-4
    longest: float = 60.0
    # least size of a slide that is told, in m, and over its standard deviation
    told: float = 2e-4
    surely: float = 2.0
    samples: int = 3  # in a row, in which a slide is that large, or the turn jumps


@dataclass(frozen=True)
class BracingTuning:
    """How the arm leans on objects (`Bracing`)."""

    at_rest: float = 2e3  # pressure below which the arm is at rest, in Pa
    to_rest: float = 3.0  # time in which it goes to rest, in s
    # time in which the way into contact and back gets its speed or loses it, in s; least pace of it
    gradual: float = 1.0
    least_pace: float = 0.02
    settle: float = 1.0  # time at the end of the approach before the brace counts as held, in s
    # distance between the tips of the braced and the free arm that the tracker can distinguish, in
    # m; share of it beyond which the arm is free; and successive samples
    min_distance: float = 4e-3
    # the same on the way, where an object that is a little further away is touched a little later
    min_on_way: float = 15e-3
    free_share: float = 0.6
    samples: int = 3
    off_plan: float = 3e4  # pressure error above which contacts are not judged, in Pa
    let_down: float = 2e3  # the same while the pressures are held: then they are being let down
    swing_time: float = 0.08  # time constant of averaging the measured tip, in s
    # displacement of the tip above which a push is felt, in m; time constant with which a smaller
    # one becomes the model's error, in s
    felt: float = 6e-4
    error_time: float = 5.0
    # the same for a push that uses up a share of what a contact holds, and that share
    least_felt: float = 2e-4
    felt_share: float = 0.12
    # at first, while the tip goes to its target and the arm creeps most: duration and such a time
    # constant, in s
    settling: float = 8.0
    settling_time: float = 0.3
    # time after that in which contacts that are to stick are relieved of friction, in s
    relief: float = 8.0
    # time constant with which friction follows the pressures, whose noise would move it, in s; and
    # the slide of a contact, as the estimated push foretells it, that is a slip, in m
    even_time: float = 0.5
    # creep beyond the model's, which lengthens an arm that friction holds: share by which pressures
    # count more, per e-fold of the time since the way into contact, and of a time before, in s
    creep: float = 0.01
    creep_time: float = 3.0
    slid: float = 1e-4
    # deviation of the creep since the arm settled, which may be a slow push: share by which
    # pressures seem to grow, per e-fold
    unknown_creep: float = 0.02
    # time for which friction at the contacts may withhold a correction of the tip, in s
    withheld_time: float = 5.0
    # time after which a push becomes the model's error too, and uncertain contacts let go, in s
    longest_push: float = 60.0
    # deviation of that displacement, in m, and of pushes, in N
    deviation: float = 2e-4
    usual_push: float = 0.1
    # where contacts are to stick: share of that for pushes aside from the directions of stiffness;
    # and the time constant with which what a push displaces becomes creep, in s
    aside: float = 0.3
    push_creeps: float = 30.0
    # a contact is held or lost if its force is above or below zero by so many standard deviations,
    # as many as the margin of a task has (`BRACE.sure`); time for which it has to be certain until
    # it is not reported as uncertain any more, in s
    certain: float = 2.0
    again: float = 2.0
    # least standard deviation of a contact's force without a push, as a share of it, and of its
    # change by a push, as a share of that
    least_deviation: float = 0.2
    response: float = 0.1
    # time constants with which the tip goes to its target, at first and once it has settled, in s
    first_time: float = 2.0
    time: float = 3.0
    # largest speeds of the tip by that, at first and once it has settled, in m/s
    first_speed: float = 4e-3
    correction_speed: float = 5e-4
    force_weight: float = 0.1  # error of the tip equivalent to a change of contact force, in m/N
    pressure_weight: float = 2e-8  # the same for a pressure, in m/Pa
    most_change: float = BRACE.corrected  # largest change of a planned pressure, in Pa
    # error of the tip that is reported if it does not fall by a share for a time, in m and s
    off_target: float = BRACE.missed
    progress: float = 0.1
    patience: float = 10.0
    sliding: SlidingTuning = field(default_factory=SlidingTuning)
