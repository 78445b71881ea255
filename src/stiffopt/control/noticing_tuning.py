"""Tuning of noticing faults: when a motion or a tracker is doubted, and how long holds last."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SupervisionTuning:
    """Patience of the state machine; `Safety` of the rig file defines faults."""

    # time for which the alarm of the total force outlasts the last limited command, in s
    force_alarm: float = 0.5
    max_failures: int = 3  # successive failures of the controller after which pressures are held
    chamber_lag: float = 0.3  # by which the pressures in the chambers may lag behind commands, in s
    longest_stop: float = 1.0  # in which the controller stops a doubted motion, in s
    falls: float = 3e3  # above its command, in Pa, at which a chamber is on its way down
    # time of control after which a hold is a new one, and its timeout starts again, in s
    hold_memory: float = 2.0
    # time after a doubt in which another one lets the pressures down at once, in s
    doubt_memory: float = 30.0
    vent_attempts: int = 3  # when the loop ends
    # time after the ramp in which the ending loop keeps trying to vent, in s
    stop_margin: float = 0.5
    # distance of the vented tip from the model's, as a share of the arm's length, beyond which
    # arming is refused
    vented_offset: float = 0.1


@dataclass(frozen=True)
class ScatterTuning:
    """When the times of the tracker's samples scatter (`TimeScatter`)."""

    most: float = 0.02  # standard deviation of the times above which there is an alarm, in s
    least: float = 0.01  # that the noise of positions may seem to be, in s
    least_speed: float = 0.01  # of the tip, in m/s
    window: float = 0.35  # of motion, in s
    count: int = 7  # least number of samples in it
    longest_span: float = 0.135  # of four samples: over a longer one a swing is rough itself, in s
    outlier: float = 3.0  # multiple of the median error that counts of an error


@dataclass(frozen=True)
class DriftScale:
    """A drift: faster than `least_speed`, in m/s, in each of `count` intervals, in s."""

    interval: float
    count: int
    least_speed: float


@dataclass(frozen=True)
class PushTuning:
    """When a displacement of the tip in motion is a push (`PushWatch`)."""

    time: float = 0.3  # in which it displaces the tip, in s
    # for which changes of pressure move an arm that vibrates, and after which they begin to, in s
    acting: float = 0.6
    late: float = 0.1
    slow: float = 12.0  # above which it is less, as the inverse square, in rad/s
    steady: float = 0.3  # time at the beginning in which the speed of a steady change is seen, in s
    steady_share: float = 0.7  # of such a change that counts; times `share` it is more than all
    # motion of the tip by each channel below which such a change is slow, in m/s: the arm then
    # becomes stiff with 5 mm/s at most, and feedback adds to that
    slow_change: float = 6e-3
    least: float = 2e-3  # least displacement, in m
    moves: float = 0.3  # least share of it by which the tip moves
    # displacement over all that the pressures can have moved the tip, and length added to that, in
    # m; or over the swing that the arm has already. For faults that was 1.5 at most
    share: float = 1.6
    noise: float = 1e-3
    # turn of the tip by a push: its least size, in rad; share of it that may be missing; multiple
    # of it up to which a push may turn the tip further
    least_turn: float = 0.02
    turn: float = 0.3
    further: float = 2.0
    lasts: float = 1.0  # time after that in which the arm swings, in s
    # multiple of its largest displacement, when recognised, that it explains later
    grows: float = 1.2


@dataclass(frozen=True)
class StillTuning:
    """When a sensor lies still while the pressures turn the tip (`StillWatch`)."""

    window: float = 1.0  # in which it is looked for, in s
    interval: float = 0.1  # by which the first sample may be later than its beginning, in s
    samples: int = 2  # least number of samples in a third of it
    # largest change of the mean pose between thirds: over the scatter of a sample, and in rad
    scatters: float = 3.0
    turn: float = 3e-3
    # least turn of the model that is not seen, in rad: of healthy arms it was 0.013 at most
    least: float = 0.025
    further: float = 2.0  # see `MotionTuning.further`
    misses: int = 2  # successive samples


@dataclass(frozen=True)
class MissingMotionTuning:
    """When the tip lacks the motion of a channel (`MissingMotion`)."""

    interval: float = 0.2  # between samples that are compared, in s
    longest_pause: float = 0.5  # between two samples, after which they are not compared, in s
    # share of a channel's motion that errors of the model explain; share that counts of a change of
    # the offset across it
    usual: float = 0.5
    across: float = 0.5
    # motion of the tip by a channel above which the arm goes to a target, in m/s: as it becomes
    # stiff that is 5 mm/s, and up to 15 mm/s where feedback makes up for what the tip lacks
    fastest: float = 2e-2
    most: float = 3e-3  # missing motion beyond that, of a fault, in m
    # at which the channel goes back then, as the motion of the model's tip by it, in m/s
    back_speed: float = 5e-3


@dataclass(frozen=True)
class MotionTuning:
    """Thresholds for doubting the tip's motion (`MotionWatch`)."""

    longest_wait: float = 1.5  # of the reference while a push acts, and until it may wait again
    spacing: float = 0.02  # minimum time between two samples that are compared, in s
    longest_pause: float = 0.1  # without control, after which samples are not compared, in s
    # error of the model, as a share of the motion that each segment causes: at first, and the least
    # that is permitted of an arm that has followed its model; time after which a motion has proven
    # to be no fault, in s
    model_error: float = 0.35
    least_error: float = 0.15
    proven_after: float = 2.0
    # displacement of the tip at rest, in m, within a time, in s, after which it has to prove itself
    # again: a payload may change its response
    push: float = 8e-4
    push_time: float = 0.25
    pushes: PushTuning = field(default_factory=PushTuning)  # of pushes in motion
    still_watch: StillTuning = field(default_factory=StillTuning)  # of a sensor that lies still
    noise: float = 1e-3  # of a measured motion, in m
    scatter: float = 5e-5  # standard deviation of a tracked position in each axis, in m
    # shortest way for a test of the response: in m, and as a share of the arm's length
    least_motion: float = 3e-3
    least_motion_share: float = 0.025
    response_window: float = 0.6  # within which the tip must have moved like the model's, in s
    # share of the model's way by which the tip may miss it, if not by moving farther along it
    most_error: float = 0.5
    # share of the model's way below which the tip lies still, which no error of the model explains
    still: float = 0.1
    late: float = 0.01  # by which the tip may move later than the model's, in s
    # share of the amplitude of the vibration that the pressures excite, whose phase may be wrong
    swing_error: float = 0.35
    # share of the explained difference from the model above which the reference is slowed down
    usual_share: float = 0.4
    misses: int = 2  # successive samples that show no response
    slip_window: float = 1.0  # in which a slip is looked for, in s
    # share of the turn that a push would cause by which the measured turn must miss it
    slip: float = 0.7
    least_turn: float = 0.02  # by which it must miss it at least, in rad
    bends: float = 0.5  # share below which a change that begins so is a push
    further: float = 2.0  # multiple of that turn up to which a larger one in its direction fits
    # displacement of a growing push, in m, above which it must miss it by less than another share
    largest_push: float = 8e-3
    slip_of_large: float = 0.25
    slips: int = 4  # successive samples that show a slip
    jump_window: float = 0.25  # in which a slip at rest is looked for, vibration included, in s
    # decrease of the missing share of the turn in these samples with which it is a push, whose
    # higher modes turned the tip otherwise at first
    catches_up: float = 0.1
    # an arm that responds otherwise than modelled explains a displacement: share of it that may be
    # across the model's motion, and its largest share of that motion
    aside: float = 0.5
    largest_error: float = 0.85
    scales: tuple[DriftScale, ...] = (
        DriftScale(0.25, 5, 2e-3),
        DriftScale(1.0, 5, 6e-4),
        DriftScale(2.5, 4, 3.5e-4),
    )
    turn: float = 1e-3  # motion back after which a swing has turned, in m
    swings: int = 4  # successive swings between turning points
    least_swing: float = 4.5e-3  # smallest size of a swing, in m
    decay: float = 0.8  # the swings decay if the last one is a smaller share of the largest
    swing_window: float = 6.0  # in which the swings must be, in s


@dataclass(frozen=True)
class TrackerTuning:
    """When a tracker's rhythm is known, and when it is trusted again."""

    window: int = 24  # samples from which interval and latency are learned
    enough: int = 8  # minimum number of samples for that
    # ticks with new samples, none overdue, after which a missing tip is seen again
    back: int = 8
    jitter: float = 0.25  # share of an interval by which a sample may be late
