"""Settings of a calibration: what users choose, and the tuning values behind each of its steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stiffopt.schema import Items, Schema
from stiffopt.units import Duration

Finding = Literal["units", "clock", "axes", "channels", "lines"]
"""What is found by itself in recordings (`stiffopt.identify.detection`) unless it is to be kept."""


@dataclass(frozen=True)
class TrackerFaultSettings:
    """Which readings of a tracker count as faults (`stiffopt.identify.tracker_faults`).

    Attributes
    ----------
    farthest : distance from the median position beyond which a reading is impossible, in lengths
        of the arm.
    origin, origin_rows : a tracker may have been zeroed within this distance of the origin (lengths
        of the arm); so many rows there say that positions of zero are readings.
    jump_rows : number of rows that a jump may last.
    jump_pause : longest time between the rows around a jump, in usual steps of time per row.
    jump_factor : how many times the ordinary step a jump is.
    jump_sigmas, jump_least : smallest jump, in deviations of the noise and in lengths of the arm;
        a robust loss deals with smaller ones.
    turn_agrees : angle by which rows that follow each other may differ at one place, in rad.
    turn_moving : angle by which a body may turn while it moves by one length of the arm, in rad.
    turn_rows : so many rows in a row are no chance, however they are turned.
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
    """When a log cannot be one of the given arm in SI units (`stiffopt.identify.recording`).

    Attributes
    ----------
    least_rows : number of usable rows that a recording needs.
    tiny_pressure : share of the pressure limits that the highest pressure in Pa exceeds.
    beyond, idle : shares of a channel's range: beyond its limits by so much is worth a remark;
        a channel that moves by less is not used.
    farthest, widest : in lengths of the arm: distance of the tip from the frame's body, and
        range of the tip's positions, that would mean other units than m.
    slow, slow_integers : median time between rows that would mean ms, in s; and the same where all
        times are whole numbers.
    late : share of a channel's range by which the first measured pressure differs from the
        commanded one if the log begins with a step. Gauges are off by less.
    frame_share, frame_moved, frame_turned : in so many of the rows the body that is the frame may
        not have moved by more than this, in m and rad.
    noise_factor, still : the tip moves if its positions vary by so many deviations of their noise,
        and by so much of the arm's length.
    unexplained : share of their spread that noisy positions keep after a regression on pressures.
    times_shown : number of times that a remark names.
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
    straight : share of the range of pressures: commands so near to a straight line are on it.
    fine : of commands that change in every row, one is kept per so many s, as a lag can tell.
    longest_gap : number of rows that are left out at once.
    rest : share of the range of pressures below which an arm is at rest.
    loaded_fit_rows, loaded_rows : most rows of an arm under gravity, whose every pose is an
        equilibrium to be found, in a fit and in a comparison.
    rows : most rows of a log in a comparison.
    dead_time_step : slowest rows from which a dead time can be told from a lag, in s.
    """

    straight: float = 1e-3
    fine: float = 0.04
    longest_gap: int = 64
    rest: float = 0.02
    loaded_fit_rows: int = 300
    loaded_rows: int = 400
    rows: int = 50_000
    dead_time_step: float = 0.5


@dataclass(frozen=True)
class StartSettings:
    """Where fits begin (`stiffopt.identify.structures`, `stiffopt.identify.calibration`).

    Attributes
    ----------
    lag, dead_time : of a history that the robot file does not have, in s.
    play_widths, elongation_width, play_share : of its plays, and of that of elongation; widths as
        shares of the highest recorded pressure.
    creep_times, creep_share : of its creep, in s.
    bending_radius : least bending radius, in lengths of the segment.
    dead_band : share of the highest recorded pressure.
    turns, unknown_turn : turns of the base to begin with, in rad, where its tolerance is more than
        the latter.
    moduli : coordinates of the moduli to begin with, in prior deviations.
    position_noise, angle_noise : what the first fit expects the model to miss, in lengths of the
        arm and in rad.
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
    unknown_turn: float = 0.5
    moduli: tuple[float, ...] = (0.0, -1.0, 1.0)
    position_noise: float = 0.01
    angle_noise: float = float(np.radians(3.0))


@dataclass(frozen=True)
class FitSettings:
    """The least-squares problem and its solution (`stiffopt.identify.problem` and ``fit``).

    Attributes
    ----------
    loss_scale : residuals beyond so many deviations count less and less (soft L1).
    rounds : number of fits, each with the spread of residuals that the one before left.
    evaluations : most evaluations of the problem in each round.
    tolerance : relative, of cost, step and gradient.
    least_position, least_angle : smallest spread of residuals, in m and rad: logs have few digits.
    most_memory, memory_slack : sum of the shares of a channel's history beyond which a penalty
        grows, and the excess that counts as one deviation.
    least_modulus, most_stiffening, modulus_slack : share of a segment's modulus that pressure must
        leave; largest exponent by which an exponential law may raise it (at 1 more pressure bends
        less); and the excess that counts as one deviation.
    side : prior deviation of the side of its plays on which a channel begins, from -1 to 1.
    between_logs : time at the last pressures between two logs of a sequence, in s.
    systematic : deviation of the errors that rows at nearby pressures share, in lengths of the arm.
    near : what is near, as a share of the highest recorded pressure.
    centres_apart, most_centres : of these errors, in units of what is near, and their number.
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
    modulus_slack: float = 0.005
    side: float = 0.6
    between_logs: float = 60.0
    systematic: float = 0.005
    near: float = 0.3
    centres_apart: float = 0.7
    most_centres: int = 80


@dataclass(frozen=True)
class ChoiceSettings:
    """How one of several models is chosen (`stiffopt.identify.structures`).

    Attributes
    ----------
    logs : as many logs or more are held back one by one; of fewer, parts are.
    parts : number of these parts.
    top : share of the rows, those with the highest pressures, that are held back too; and of those
        with the lowest.
    regions, rounds : number of regions of pressure that are held back, and of the steps that look
        for them.
    evaluations : most evaluations of a fit without what is held back, which begins near its end.
    no_worse : relative error by which a simpler model may be worse.
    held, held_still, held_for : creep can be told if pressures are held for this share of the time;
        held is a change of less than this share of their range, for longer than so many s.
    """

    logs: int = 3
    parts: int = 4
    top: float = 0.2
    regions: int = 3
    rounds: int = 10
    evaluations: int = 20
    no_worse: float = 0.04
    held: float = 0.2
    held_still: float = 1e-3
    held_for: float = 1.0


@dataclass(frozen=True)
class ErrorSettings:
    """The error model of a calibration (`stiffopt.identify.error_model`).

    Attributes
    ----------
    discrepancy, residual, tail : what is expected before anything was held back: error of the tip
        far from what was recorded, in lengths of the arm; standard deviation of an axis in what is
        held back, by that of the fit; degrees of freedom beyond four.
    deviations : of their logarithms.
    per_cell : rows that count in a cell of pressures that is as wide as the reach.
    reaches, reach : distances over which the discrepancy may grow, and the expected one, as shares
        of the range of recorded pressures.
    gain : relative error of what pressures do in directions that were not recorded; no recording
        tells it.
    rows : most rows that tell what the discrepancy does to a fit.
    representatives, spacing : most pressures of a segment that stand for all that were recorded;
        and their distance, as a share of the range of pressures, at which they are enough.
    hold, still : pressures are held if they have not changed for so many s by more than this share
        of their range.
    compared : most rows of a log whose regions are compared with the readings.
    least_rows : of held, and of moving pressures that tell how far effective ones are from them.
    """

    discrepancy: float = 0.1
    residual: float = 1.2
    tail: float = 4.0
    deviations: tuple[float, float, float] = (0.8, 0.4, 0.7)
    per_cell: float = 1.0
    reaches: tuple[float, ...] = (0.2, 0.4, 0.8)
    reach: float = 0.4
    gain: float = 0.1
    rows: int = 800
    representatives: int = 60
    spacing: float = 0.04
    hold: float = 2.0
    still: float = 0.01
    compared: int = 1000
    least_rows: int = 20


@dataclass(frozen=True)
class SuggestionSettings:
    """Poses that a calibration suggests to record next (`stiffopt.identify.suggestion`).

    Attributes
    ----------
    poses : how many, unless somebody says.
    candidates : from which they are chosen, besides those of one channel and of all.
    levels : of these, as shares of the range of pressures.
    """

    poses: int = 12
    candidates: int = 200
    levels: tuple[float, ...] = (0.5, 1.0)


@dataclass(frozen=True)
class ReportSettings:
    """What is remarked on in the result (`stiffopt.identify.results`).

    Attributes
    ----------
    learnt : share of the prior's variance that the data must remove.
    tied : correlation from which two numbers cannot be told apart.
    far : distance from the robot file, in prior deviations.
    tilt : of base or sensor that is doubted whatever the tolerance, in rad.
    outlier : distance of a row from the model, in deviations.
    unfit, alone : mean error in what was fitted, in lengths of the arm, above which a robot is
        unfit; and how many times the median of all logs the error of one is that is to blame.
    correlation_digits : decimals of correlations in the robot file.
    """

    learnt: float = 0.5
    tied: float = 0.95
    far: float = 3.0
    tilt: float = float(np.radians(8.0))
    outlier: float = 4.0
    unfit: float = 0.1
    alone: float = 3.0
    correlation_digits: int = 4


@dataclass(frozen=True)
class DetectionSettings:
    """When a recording is taken to be other than it seems (`stiffopt.identify.detection`).

    Attributes
    ----------
    overwhelming : share of the misfit that the better hypothesis may leave.
    tie : of two hypotheses neither is taken if the better leaves more than this share of what the
        other does.
    rows : of all recordings that are compared.
    softness : factors on pressures, for arms softer or stiffer than the robot file says.
    unknown_turn : tolerance of the base's turn from which the turn is not known, in rad.
    few_channels : of how many channels all orders are tried.
    off, frame : mean error of a log, in lengths of the arm, from which its frame may be another
        than the one of the calibration; and the share of it that is left if it was.
    known_turn : spread of the tip, in lengths of the arm, that tells a turn.
    moved : how far the base may be from where the robot file has it, in lengths of the arm.
    clock_rows : rows of a regression for the clocks.
    clock_lag : of an arm, in s.
    clock_usual : delay up to which it may be the arm's own, in s.
    clock_most, clock_share : largest shift of time that is looked for, in s and as a share of the
        log; clock_shifts : how many of them.
    clock_overwhelming : as `overwhelming`, of the regression.
    unit : factor within which the arm's motion must be what is expected with a unit of pressure.
    """

    overwhelming: float = 0.5
    tie: float = 0.75
    rows: int = 120
    softness: tuple[float, ...] = (0.2, 0.35, 0.6, 1.0, 1.7, 3.0, 5.0)
    unknown_turn: float = 0.5
    moved: float = 0.25
    few_channels: int = 3
    off: float = 0.1
    frame: float = 0.3
    known_turn: float = 0.02
    clock_rows: int = 600
    clock_lag: float = 0.3
    clock_usual: float = 2.0
    clock_most: float = 30.0
    clock_share: float = 0.2
    clock_shifts: int = 61
    clock_overwhelming: float = 0.3
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
    structure : name of a model of `stiffopt.identify.structures.STRUCTURES`, or ``auto``: the one
        that predicts held-back logs (of a single log, held-back parts) best; of those that are as
        good, the simplest.
    strain_law : ``auto``: the robot file's, unless another law of `stiffopt.model.laws` predicts
        what is held back clearly better; or ``keep``.
    sequence : whether the logs follow each other, so that each begins in the state in which the
        one before it ended.
    rezero : whether positions are counted anew in each log.
    pressures : which of the recorded pressures the model is run with.
    fixed : keys of parameters that stay as they are.
    keep : what is taken as it was recorded: the ``units`` of pressures, the ``clock`` of pressures
        and tracker, the ``axes`` of a log's frame, the order of the ``channels``, dead or shared
        ``lines``. All else is put right where the evidence is overwhelming, and told.
    settle : time at the beginning of a log that does not begin at rest, from which its state (and
        its zero) is estimated where the log is only predicted, in s.
    rows : number of rows that are fitted, of all logs together; chosen so as to cover them.
    trial_rows : the same, while models are compared.
    start_rows : the same, while a start is chosen among several.
    compared_rows : the same, of each log, where the arm is under gravity and all is compared.
    start_evaluations : most evaluations of the problem from each of several starts.
    rounds : number of fits, each with the spread of residuals that the one before left.
    holds_back : whether models are fitted without parts of the logs and compared by these; else
        `structure` names one.
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
        """These settings for a first answer: one model, its law kept, nothing held back, few rows.

        Parameters
        ----------
        is_loaded : whether each pose is an equilibrium to be found, which takes longer.
        """
        structure = "hysteresis" if self.structure == "auto" else self.structure
        most = {"rows": 60, "start_rows": 40, "compared_rows": 60} if is_loaded else {
            "rows": 400, "start_rows": 150}  # fmt: skip
        most |= {"start_evaluations": 10, "rounds": 1}
        fewer = {name: min(getattr(self, name), count) for name, count in most.items()}
        kept = {"structure": structure, "strain_law": "keep", "holds_back": False}
        return self.model_copy(update={**kept, **fewer})
