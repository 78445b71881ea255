"""Settings of a calibration: the user's choices, and the tuning values of each of its steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stiffopt.schema import Items, Schema
from stiffopt.units import Duration

Finding = Literal["units", "clock", "drift", "axes", "channels", "lines"]
"""Errors of recordings that are corrected automatically (`stiffopt.identify.correction`)."""


@dataclass(frozen=True)
class TrackerFaultSettings:
    """Criteria for faulty readings of a tracker (`stiffopt.identify.tracker_faults`).

    Attributes
    ----------
    farthest : distance from the median position beyond which a reading is impossible, in lengths
        of the arm.
    origin, origin_rows : positions of exactly zero are true readings if at least `origin_rows`
        other rows lie within `origin` (in lengths of the arm) of the origin; otherwise they mean
        "missing".
    jump_rows : largest number of rows in a jump.
    jump_pause : longest time across a jump, in median time steps per row.
    jump_factor : smallest jump, in usual steps at that time.
    jump_sigmas, jump_least : smallest jump, in deviations of the noise and in lengths of the arm;
        the fit's robust loss handles smaller ones.
    turn_agrees : largest angle between consecutive rows of a body at rest, in rad.
    turn_moving : further angle by which a body may turn per arm's length of its motion, in rad.
    turn_rows : a run of at least this many rows is kept although no rotation fits it.
    """

    farthest: float = 100.0
    origin: float = 0.05
    origin_rows: int = 3
    jump_rows: int = 5
    jump_pause: float = 5.0
    jump_factor: float = 3.0
    jump_sigmas: float = 10.0
    jump_least: float = 0.01
    turn_agrees: float = float(np.radians(20.0))
    turn_moving: float = 4.0
    turn_rows: int = 5


@dataclass(frozen=True)
class PlausibilitySettings:
    """Criteria for a log of the given arm in SI units (`stiffopt.identify.recording`).

    Attributes
    ----------
    least_rows : smallest number of usable rows.
    tiny_pressure : a highest pressure below this share of the limits is not in Pa.
    beyond, idle : as shares of a channel's range: excess over its limits that deserves a remark,
        and change of its pressure up to which nothing is learnt about it.
    farthest, widest : distance of the tip from the frame's body, and range of the tip's positions,
        beyond which positions are not in m; in lengths of the arm.
    slow, slow_integers : median time between rows, in s, beyond which times look like ms; the
        latter applies if all times are whole numbers.
    late : a log begins with a step if the first measured pressure differs from the commanded one by
        more than this share of the channel's range. Gauges are more accurate.
    frame_share, frame_moved, frame_turned : in this share of the rows, the frame's body must stay
        within these distances of its mean, in m and rad; else a remark says so.
    noise_factor, still : the tip moves if the spread of its positions exceeds this multiple of
        their noise, and this share of the arm's length.
    unexplained : alternatively to the noise, it moves if a regression on pressures leaves less than
        this share of the spread.
    times_shown : how many times a remark lists.
    """

    least_rows: int = 20
    tiny_pressure: float = 0.01
    beyond: float = 0.1
    idle: float = 0.02
    farthest: float = 100.0
    widest: float = 10.0
    slow: float = 60.0
    slow_integers: float = 5.0
    late: float = 0.15
    frame_share: float = 0.95
    frame_moved: float = 2e-3
    frame_turned: float = float(np.radians(2.0))
    noise_factor: float = 3.0
    still: float = 1e-3
    unexplained: float = 0.8
    times_shown: int = 3


@dataclass(frozen=True)
class SamplingSettings:
    """Which rows of recordings are fitted and compared (`stiffopt.identify.setup`).

    Attributes
    ----------
    straight : rows whose commands are within this share of the pressure range of a straight line
        are left out.
    fine : where commands change in every row, one row is kept per this time in s, fine enough to
        identify a lag.
    longest_gap : largest number of rows left out at once.
    rest : share of the range of pressures below which an arm is at rest.
    loaded_fit_rows, loaded_rows : largest numbers of rows in a fit and in a comparison of an arm
        under gravity, each of whose poses needs a search for equilibrium.
    rows : largest number of rows of a log in a comparison.
    turn_rows : number of rows of a log by which a body's axes are told from turned ones.
    dead_time_step : longest time between rows, in s, that distinguishes a dead time from a lag.
    """

    straight: float = 1e-3
    fine: float = 0.04
    longest_gap: int = 64
    rest: float = 0.02
    loaded_fit_rows: int = 300
    loaded_rows: int = 400
    rows: int = 50_000
    turn_rows: int = 20
    dead_time_step: float = 0.5


@dataclass(frozen=True)
class StartSettings:
    """Initial values of fits (`stiffopt.identify.structures`, `stiffopt.identify.calibration`).

    Attributes
    ----------
    lag, dead_time : of a history that the robot file does not have, in s.
    play_widths, elongation_width, play_share : of its plays, the second for that of elongation;
        widths as shares of the highest recorded pressure.
    creep_times, creep_share : of its creep; times in s.
    bending_radius : smallest bending radius, in lengths of the segment.
    dead_band : as a share of the highest recorded pressure.
    turns : turns of the base from which fits start, in rad, if its turn is unknown.
    moduli : coordinates of the moduli from which fits start, in prior deviations.
    anew_position, anew_angle : prior deviations of a log's frame or body after it was found to be
        defined anew, and moved back, in lengths of the arm and in rad.
    position_noise, angle_noise : expected model error in the first fit, in lengths of the arm and
        in rad.
    """

    lag: float = 0.3
    dead_time: float = 0.05
    play_widths: tuple[float, ...] = (0.05, 0.12, 0.24, 0.46)
    elongation_width: float = 0.46
    play_share: float = 0.05
    creep_times: tuple[float, ...] = (2.0, 20.0)
    creep_share: float = 0.02
    bending_radius: float = 0.6
    dead_band: float = 0.05
    turns: tuple[float, ...] = (0.0, 2 * np.pi / 3, -2 * np.pi / 3, np.pi)
    moduli: tuple[float, ...] = (0.0, -1.0, 1.0)
    anew_position: float = 0.05
    anew_angle: float = float(np.radians(5.0))
    position_noise: float = 0.01
    angle_noise: float = float(np.radians(3.0))


@dataclass(frozen=True)
class FitSettings:
    """The least-squares problem and its solution (`stiffopt.identify.problem` and ``fit``).

    Attributes
    ----------
    loss_scale : deviations beyond which the loss grows only linearly (soft L1).
    rounds : number of refits, each with the noise estimated from the fit before.
    evaluations : largest number of evaluations of the problem in each round.
    tolerance : relative, of cost, step and gradient.
    least_position, least_angle : smallest spread of residuals, in m and rad; logs have few digits.
    most_memory, memory_slack : sum of the shares of a channel's history beyond which a penalty
        grows, and the excess that counts as one deviation.
    least_modulus, most_stiffening, most_softening, modulus_slack : share of a segment's modulus
        that pressure must leave under a linear law; largest exponents by which an exponential law
        may raise it (at 1, more pressure bends the arm less) and lower it; and the excess of any of
        these that counts as one deviation.
    side : prior deviation of a channel's initial state of hysteresis, from -1 to 1.
    between_logs : assumed time at the last pressures between two logs of a sequence, in s, where
        each has its own clock.
    systematic : deviation of the errors that rows at nearby pressures share, in lengths of the arm.
    near : correlation length of these errors, as a share of the highest recorded pressure.
    centres_apart, most_centres : spacing of their centres, in correlation lengths, and largest
        number of centres.
    recent, classes, class_rows, uneven : the noise of a row depends on how much the pressures
        changed in the last `recent` s, by `classes` of rows, fewer if one had less than
        `class_rows` independent ones; it does not if it grows by less than the factor `uneven`.
    """

    loss_scale: float = 2.0
    rounds: int = 3
    evaluations: int = 60
    tolerance: float = 1e-6
    least_position: float = 1e-6
    least_angle: float = 1e-5
    most_memory: float = 0.9
    memory_slack: float = 0.01
    least_modulus: float = 0.1
    most_stiffening: float = 0.7
    most_softening: float = 4.0
    modulus_slack: float = 0.005
    side: float = 0.6
    between_logs: float = 60.0
    systematic: float = 0.005
    near: float = 0.3
    centres_apart: float = 0.7
    most_centres: int = 80
    recent: float = 0.6
    classes: int = 6
    class_rows: int = 25
    uneven: float = 1.5


@dataclass(frozen=True)
class ChoiceSettings:
    """Folds and the choice of a model (`stiffopt.identify.folds` and ``structures``).

    Attributes
    ----------
    logs : smallest number of logs from which each log is a fold; with fewer, parts of logs are.
    parts : number of folds in time.
    top : share of the rows in the fold of the highest pressures, and in that of the lowest.
    regions, rounds : number of clusters of pressure, and of the iterations that find them.
    tolerance : of a fit without a fold, relative: less than a tenth of a unit of cost, of which
        half is one standard deviation of a number.
    no_worse : relative increase of error that a simpler model may have.
    held, held_still, held_for : creep can be identified if pressures are held for more than the
        share `held` of the time; held means a change by less than the share `held_still` of their
        range for more than `held_for` s.
    """

    logs: int = 3
    parts: int = 4
    top: float = 0.2
    regions: int = 3
    rounds: int = 10
    tolerance: float = 1e-4
    no_worse: float = 0.04
    held: float = 0.2
    held_still: float = 1e-3
    held_for: float = 1.0


@dataclass(frozen=True)
class ErrorSettings:
    """The error model of a calibration (`stiffopt.identify.error_model`).

    Attributes
    ----------
    discrepancy, residual, tail, timing : prior medians: tip error far from recorded pressures, in
        lengths of the arm; standard deviation per axis on held-back rows, relative to that of the
        fit; degrees of freedom beyond four; error in time, in median time steps of the logs, as
        commands are not known between their rows.
    session, session_with_creep : what differs between recording sessions, per axis, in lengths of
        the arm; for a model with creep only the zero of the tracker, not the state of the silicone.
    unchecked : factor on that of the discrepancy where nothing was held back, as after `--quick`.
    deviations : prior standard deviations of their logarithms.
    per_cell : number of rows that count in a cell of pressures as wide as the reach.
    reaches, reach : candidates for the distance over which the discrepancy grows, and its prior
        median, as shares of the range of recorded pressures.
    untested : relative error of the effect of pressures in directions that were not recorded, in
        discrepancies over the recorded range; no recording can show it.
    rows : largest number of rows in the estimate of the discrepancy's effect on a fit.
    representatives, spacing : largest number of a segment's pressures kept to represent all
        recorded ones, and the spacing, as a share of the pressure range, at which fewer suffice.
    hold, still : pressures are held if they changed by less than the share `still` of their range
        within the last `hold` s.
    compared : largest number of rows of a log whose regions are compared with the readings.
    least_rows : smallest number of held, or of moving, rows from which the difference of effective
        from commanded pressures is estimated.
    """

    discrepancy: float = 0.01
    residual: float = 1.5
    tail: float = 10.0
    timing: float = 0.5
    session: float = 0.005
    session_with_creep: float = 0.001
    unchecked: float = 4.0
    deviations: tuple[float, float, float, float] = (0.8, 0.4, 0.4, 1.0)
    per_cell: float = 1.0
    reaches: tuple[float, ...] = (0.2, 0.4, 0.8)
    reach: float = 0.4
    untested: float = 6.5
    rows: int = 800
    representatives: int = 60
    spacing: float = 0.04
    hold: float = 1.0
    still: float = 0.005
    compared: int = 1000
    least_rows: int = 20


@dataclass(frozen=True)
class SuggestionSettings:
    """Suggestion of poses to record next (`stiffopt.identify.suggestion`).

    Attributes
    ----------
    poses : default number of poses.
    candidates : number of candidates spread over the box of pressures; further ones pressurise one
        channel, or all.
    levels : pressures of those further ones, as shares of the range.
    """

    poses: int = 12
    candidates: int = 200
    levels: tuple[float, ...] = (0.5, 1.0)


@dataclass(frozen=True)
class ReportSettings:
    """Thresholds of the remarks on a result (`stiffopt.identify.results`).

    Attributes
    ----------
    learnt : a number is not learnt if the data remove less than this share of its prior variance.
    tied : correlation beyond which two numbers cannot be distinguished.
    far : suspicious distance from the robot file, in prior deviations.
    tilt : suspicious tilt of base or sensor, in rad, whatever the tolerance.
    outlier : distance of an outlying row from the model, in deviations.
    unfit, alone : mean error in the fitted logs, in lengths of the arm, beyond which a robot is
        unfit; and multiple of the median log's error beyond which one log is singled out.
    block, draws : length in s of the blocks of rows in the bootstrap of a coverage, and number of
        draws.
    correlation_digits : decimals of correlations in the robot file.
    """

    learnt: float = 0.5
    tied: float = 0.95
    far: float = 3.0
    tilt: float = float(np.radians(8.0))
    outlier: float = 4.0
    unfit: float = 0.1
    alone: float = 3.0
    block: float = 120.0
    draws: int = 1000
    correlation_digits: int = 4


@dataclass(frozen=True)
class DetectionSettings:
    """Evidence needed to correct a recording (`stiffopt.identify.detection`, `hypotheses`).

    Attributes
    ----------
    overwhelming : largest share of the misfit that an accepted hypothesis leaves.
    tie : largest misfit of an accepted hypothesis, as a share of any rival's.
    faults : largest number of faults that are corrected, one after another.
    rows : number of compared rows of all recordings together.
    softness : factors on pressures, for arms softer or stiffer than the robot file says.
    farther : softness with which the arm moves more than this many times as far as the tip did is
        not tried.
    shortlist : number of hypotheses that are compared with an arm under its weight, and of those of
        a kind of which each is tried together with another one.
    few : largest number of channels of a segment, or of segments, of which all orders are tried.
    moved : largest distance of the base from its place in the robot file, in lengths of the arm.
    off, frame : mean error of a log, in lengths of the arm, beyond which its set-up is suspected to
        differ from the calibration's; and the share of it that a correction may leave.
    region, within : a remark reports a log with less than a share `within` of its tips in the
        region of this probability.
    outside : with less than this share in it, a log is suspected to have other channels.
    channel_rows, channel_step : number of rows with which orders of channels are compared in a log
        that is off; the best of them are found by every `channel_step`-th of these.
    paired : number of hypotheses of each kind that are tried together with another one there.
    poses, apart : smallest number of poses by which a frame is judged, since two can be moved to
        fit any others; and their distance, as a share of the range of permitted pressures.
    rest : largest pressure of a pose near rest, as a share of that range.
    in_line : spread of poses across a line, as a share of that along it, up to which they count as
        poses on a line.
    frame_softness : factors on pressures of the arm with which logs are compared with each other.
    frame_ridge : of the correction of its shape, relative to one of the whole length in each row.
    frame_lever : distance from a body's origin, in lengths of the arm, of the points on its axes by
        which poses are compared.
    frame_angle : angle of orientations, in rad, beyond which a motion may leave a share
        `overwhelming` of their misfit.
    frame_rounds : how often the motions of frame and body are found in turn.
    both_angle : angle of orientations, in rad, left by one motion, beyond which a share `tie` that
        two motions leave of its misfit is evidence for both; else it is `overwhelming`.
    known_turn : spread of the tip, in lengths of the arm, that determines a turn.
    ridge : added to the diagonal of the normal equations of regressions.
    clock_rows : number of rows in the regression for the clocks.
    clock_lag : lag of an arm, in s.
    clock_usual : longest delay that the arm itself may have, in s.
    clock_most, clock_share : largest time shift that is tried, in s and as a share of the log.
    clock_shifts : number of shifts that are tried.
    clock_rounds : of the robust regression.
    clock_early, clock_late : largest share of the mean error that an accepted shift leaves, if the
        tip moves before its pressures, and if it moves after them, as a slow arm does too.
    begins : time in s at the beginning of a log that does not tell where its tip is at rest.
    begins_near, begins_apart : a log begins at rest if the first tip's distance from where the arm
        rests is at most `begins_near` median errors of the regression, and that from where the
        first pressures hold it at least `begins_apart`.
    drift_rows, drift_parts : number of rows in the regression for a drift, and of parts of the log.
    drift_spread : smallest spread of the pressures in each part, over that of all.
    drift_near, drift_visits : a part visits the pressures of a row if it comes this near to them,
        as a share of their range; and share of the parts that must do so.
    drift_left : largest share of the median error that an accepted drift leaves.
    drift_rounds : of the robust regression.
    idle_rows, idle_rounds : number of rows in the regression for channels that do nothing, and of
        its robust rounds.
    idle_visible : a channel is judged if what it should add to the regression's RMS error is at
        least this many times that error.
    idle_shows : largest share of that which a channel that does nothing shows.
    unit : largest factor between the arm's observed and expected motion with the right unit.
    """

    overwhelming: float = 0.5
    tie: float = 0.75
    faults: int = 4
    rows: int = 120
    softness: tuple[float, ...] = (0.2, 0.35, 0.6, 1.0, 1.7, 3.0, 5.0)
    farther: float = 1.5
    shortlist: int = 6
    few: int = 4
    moved: float = 0.25
    off: float = 0.1
    frame: float = 0.3
    region: float = 0.99
    within: float = 0.5
    outside: float = 0.9
    channel_rows: int = 60
    channel_step: int = 3
    paired: int = 3
    poses: int = 4
    apart: float = 0.1
    rest: float = 0.15
    in_line: float = 0.3
    frame_softness: tuple[float, ...] = (1.0, 0.6, 1.7)
    frame_ridge: float = 0.01
    frame_lever: float = 0.25
    frame_angle: float = float(np.radians(3.0))
    frame_rounds: int = 20
    both_angle: float = float(np.radians(15.0))
    known_turn: float = 0.02
    ridge: float = 0.01
    clock_rows: int = 600
    clock_lag: float = 0.3
    clock_usual: float = 2.0
    clock_most: float = 30.0
    clock_share: float = 0.2
    clock_shifts: int = 121
    clock_rounds: int = 3
    clock_early: float = 0.75
    clock_late: float = 0.6
    begins: float = 2.0
    begins_near: float = 2.0
    begins_apart: float = 3.0
    drift_rows: int = 1200
    drift_parts: int = 8
    drift_near: float = 0.1
    drift_visits: float = 0.75
    drift_spread: float = 0.5
    drift_left: float = 0.7
    drift_rounds: int = 8
    idle_rows: int = 1200
    idle_rounds: int = 4
    idle_visible: float = 3.0
    idle_shows: float = 0.2
    unit: float = 2.3


TRACKER = TrackerFaultSettings()
PLAUSIBLE = PlausibilitySettings()
SAMPLING = SamplingSettings()
START = StartSettings()
FIT = FitSettings()
CHOICE = ChoiceSettings()
ERRORS = ErrorSettings()
REPORT = ReportSettings()
SUGGESTION = SuggestionSettings()
DETECTION = DetectionSettings()


class CalibrationSettings(Schema):
    """How logs are read, and what is fitted to them.

    Attributes
    ----------
    structure : name of a model of `stiffopt.identify.structures.STRUCTURES`, or ``auto`` for the
        simplest of those that predict held-back logs (with few logs, held-back parts) best.
    strain_law : ``auto`` for the robot file's, unless another law of `stiffopt.model.laws` predicts
        held-back data clearly better; or ``keep``.
    sequence : whether the logs follow each other, so that each begins in the state that the
        previous one led to; after the pause by their times, or a minute if these begin anew.
    rezero : whether each log has its own zero of positions.
    pressures : which of the recorded pressures drive the model.
    fixed : keys of parameters that are not fitted.
    keep : what to leave as recorded: the ``units`` of pressures, the ``clock`` of pressures and
        tracker, a ``drift`` of a log's positions, the ``axes`` of a log's frame, the order of the
        ``channels``, dead or shared ``lines``. Errors in the others are corrected, with a remark,
        if the evidence is overwhelming.
    settle : time in s at the beginning of a log from which its initial state (unless at rest) and
        its zero are estimated if the log is only predicted.
    rows : number of fitted rows of all logs together, spread evenly.
    trial_rows : the same, for the comparison of models.
    start_rows : the same, for the choice among several starts.
    compared_rows : largest number of compared rows of each log, for an arm under gravity.
    start_evaluations : largest number of evaluations of the problem from each start.
    rounds : number of refits, each with the noise estimated from the fit before.
    holds_back : whether to compare models on held-back data; if not, `structure` must name one.
    """

    structure: str = "auto"
    strain_law: Literal["auto", "keep"] = "auto"
    sequence: bool = False
    rezero: bool = False
    pressures: Literal["commanded", "measured"] = "commanded"
    fixed: Items[str] = ()
    keep: Items[Finding] = ()
    settle: Annotated[Duration, Field(gt=0)] = 2.0
    rows: Annotated[int, Field(ge=50, le=100_000)] = 2000
    trial_rows: Annotated[int, Field(ge=50, le=100_000)] = 600

    start_rows: Annotated[int, Field(ge=20, le=100_000)] = 150
    compared_rows: Annotated[int, Field(ge=20, le=100_000)] = SAMPLING.loaded_rows
    start_evaluations: Annotated[int, Field(ge=1)] = FIT.evaluations
    rounds: Annotated[int, Field(ge=0)] = FIT.rounds
    holds_back: bool = True

    def quick(self, *, is_loaded: bool) -> CalibrationSettings:
        """Return settings for a quick first answer: one model, nothing held back, few rows.

        Parameters
        ----------
        is_loaded : whether the arm is under gravity, so that each pose takes longer.
        """
        structure = "hysteresis" if self.structure == "auto" else self.structure
        most = {"rows": 60, "start_rows": 40, "compared_rows": 60} if is_loaded else {
            "rows": 400, "start_rows": 150}  # fmt: skip
        most |= {"start_evaluations": 10, "rounds": 1}
        fewer = {name: min(getattr(self, name), count) for name, count in most.items()}
        kept = {"structure": structure, "strain_law": "keep", "holds_back": False}
        return self.model_copy(update={**kept, **fewer})
