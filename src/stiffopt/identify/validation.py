"""Validation: compare a robot file's predictions with logs and measured stiffness."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, PressureError, StiffoptError
from stiffopt.identify.detection import idle_channels
from stiffopt.identify.error_model import held_for, in_turn, is_moving
from stiffopt.identify.fit import fit
from stiffopt.identify.hypotheses import Hypothesis, of_channels, pairs
from stiffopt.identify.motions import (
    SHOWN,
    Motion,
    apart,
    are_both_moved,
    best_motions,
    different_poses,
    in_line,
    is_turning,
    of_rows,
    turned_like,
)
from stiffopt.identify.problem import CalibrationProblem, Noise, Predicted, Sample
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.results import Comparison
from stiffopt.identify.settings import DETECTION, ERRORS, SAMPLING, CalibrationSettings
from stiffopt.identify.setup import (
    NOISE,
    Beginnings,
    LogSource,
    RobotSource,
    Setup,
    chosen_rows,
    description_of,
    recordings_of,
    sampled,
)
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.identify.unknowns import Unknowns
from stiffopt.logs import StiffnessTable
from stiffopt.model.compliance import Boundary
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.uncertainty import Uncertainty


def validate(
    robot: RobotSource,
    logs: Sequence[LogSource],
    settings: CalibrationSettings | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> tuple[Comparison, ...]:
    """Predict recordings with a robot as it is, and compare.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    settings : CalibrationSettings, optional
        How logs are read; settings of the fit have no effect.
    progress : callable, optional
        Called with the work done, the total and a description.

    Raises
    ------
    InputError
        A log is not usable; the message names it.
    FileError
        A file cannot be read or is invalid.
    """
    description, settings = description_of(robot), settings or CalibrationSettings()
    if progress is not None:
        progress(0, 2, "reading logs")
    recordings = recordings_of(description, logs, settings)
    if progress is not None:
        progress(1, 2, "comparing")
    setup = Setup.of(description, recordings, (), settings)
    found = compare(setup)
    if description.calibration is None:
        return _with_idle_channels(setup, found, found)
    found = _with_idle_channels(setup, found, _put_right(setup, found))
    return tuple(_with_doubt(each, description.length) for each in found)


def _with_idle_channels(
    setup: Setup, recorded: Sequence[Comparison], found: Sequence[Comparison]
) -> tuple[Comparison, ...]:
    """Return comparisons with a remark on each channel that does nothing in a log.

    Not if the log's channels were corrected, which may be the reason.
    """
    if "lines" in setup.settings.keep:
        return tuple(found)
    return tuple(
        replace(each, remarks=(*each.remarks, *idle_channels(setup.description, [log]).values()))
        if np.array_equal(before.pressures, each.pressures)
        else each
        for log, before, each in zip(setup.recordings, recorded, found, strict=True)
    )


def _within(found: Comparison) -> float:
    """Return the share of the tips within the region of 99 % with history; 1 if there is none."""
    levels = found.levels if found.levels is not None else np.zeros(0)
    known = levels[np.isfinite(levels)]
    return float(np.mean(known <= DETECTION.region)) if len(known) else 1.0


def _with_doubt(found: Comparison, length: float) -> Comparison:
    """Return the comparison with a calibrated robot, with a remark if it is far off."""
    share, within = found.errors.mean / length, _within(found)
    if share > DETECTION.off:
        what = f"the mean error is {100 * share:.0f} % of the arm's length"
    elif within < DETECTION.within:
        what = f"only {100 * within:.0f} % of the tips lie within the regions of 99 %"
    else:
        return found
    remark = (
        f"{what}; look at whether the log is of the arm of this calibration, the order of the "
        "channels (--channels), the frame (--frame), and whether the pressures are those that the "
        "arm had, on the clock of the tip"
    )
    return replace(found, remarks=(*found.remarks, remark))


@dataclass(frozen=True, eq=False)
class _Correction:
    """A recording as it would be with another set-up, and a remark on that.

    `poses`: rows at which it is judged; `moves_all`: whether it has to explain the error at each of
    them, and not only their mean.
    """

    recording: Recording
    remark: str
    poses: NDArray[np.intp]
    moves_all: bool = False

    def explains(self, before: Comparison, after: Comparison) -> bool:
        """Return True if a log's error is much smaller after the correction than before."""
        if after.errors.mean > DETECTION.frame * before.errors.mean:
            return False
        then, now = before.errors.angle, after.errors.angle
        if then is not None and now is not None:
            most = DETECTION.overwhelming * then + DETECTION.frame_angle
            if now > min(then, most):
                return False  # rather a sensor that sits elsewhere on the tip, or frame and body
        least = np.min if self.moves_all else np.mean
        limit = DETECTION.frame * least(before.distance[self.poses])
        return bool(after.distance[self.poses].mean() <= limit)


def _put_right(setup: Setup, found: tuple[Comparison, ...]) -> tuple[Comparison, ...]:
    """Return comparisons in which logs that are off only by their set-up are corrected.

    Other channels have no free number, and a moved frame has six. So channels are tried first, and
    also for logs that are less far off, but outside their regions.
    """
    recordings, remarks = list(setup.recordings), [""] * len(found)
    for correct, outside in ((_with_channels_found, DETECTION.outside), (_with_frame_found, 0.0)):
        tried: dict[int, _Correction] = {}
        for i, each in enumerate(found):
            is_off = each.errors.mean > DETECTION.off * setup.description.length
            if (is_off or _within(each) < outside) and not remarks[i]:
                correction = correct(setup, recordings[i], each)
                if correction is not None:
                    tried[i] = correction
        if not tried:
            continue
        with_all = [tried[i].recording if i in tried else each for i, each in enumerate(recordings)]
        tested = Setup.of(setup.description, with_all, (), setup.settings)
        again = compare(tested, with_levels=False)
        for i, correction in tried.items():
            if correction.explains(found[i], again[i]):
                recordings[i], remarks[i] = correction.recording, correction.remark
    if not any(remarks):
        return found
    result = list(compare(Setup.of(setup.description, recordings, (), setup.settings)))
    for i, (before, after) in enumerate(zip(found, result, strict=True)):
        if remarks[i]:
            remark = (
                f"{remarks[i]}; the mean error is {after.errors.mean * 1e3:.1f} mm instead of "
                f"{before.errors.mean * 1e3:.1f} mm"
            )
            result[i] = replace(after, remarks=(*after.remarks, remark))
    return tuple(result)


def _with_frame_found(setup: Setup, recording: Recording, found: Comparison) -> _Correction | None:
    """Return a recording moved to where the robot predicts its tip; None if it is not suspected.

    The frame, or the tip's body if its orientation is known, may have been defined anew; a quarter
    turn of the frame is taken if it is about as good as any. Each pose counts once: where a log
    holds one for long, a motion could replace whatever the model has wrong there. A frame that was
    moved, and not only turned, has to move all poses that lie on a line.
    """
    description, length = setup.description, setup.description.length
    seen, turns = np.flatnonzero(np.isfinite(found.distance)), is_turning(recording.tracks[0])
    if turns and found.angle is not None:
        seen = seen[np.isfinite(found.angle[seen])]
    poses = seen[different_poses(found.effective[seen], description)]
    if "axes" in setup.settings.keep or not len(poses):
        return None
    recorded = of_rows(recording.tracks[:1], np.searchsorted(recording.time, found.time[poses]))
    reached = setup.base @ Manipulator(description).tip_pose(found.effective[poses])
    reached = reached @ setup.points[0].sensor
    expected = (Track("tip", reached[:, :3, 3], reached[:, :3, :3]),)
    if not turns:
        recorded, expected = ((replace(each[0], rotation=None),) for each in (recorded, expected))

    def miss(motion: Motion) -> float:
        poses = turned_like(motion.of(recorded), expected)
        return float(apart(poses, expected, length).mean())

    quarters = [Motion((0,), "frame", each, np.zeros(3)) for each in CUBE_ROTATIONS]
    quarter = min(quarters, key=miss)
    has_orientations = any(each.rotation is not None for each in recording.tracks)
    motions = best_motions((0,), recorded, expected, length, has_orientations=has_orientations)
    if DETECTION.overwhelming * miss(quarter) < miss(motions[0]):
        motions[0] = quarter
    best, *others = sorted(motions, key=miss)
    if best.kind == "scale" or (others and miss(best) > DETECTION.tie * miss(others[0])):
        return None
    if are_both_moved(best, recorded, expected, length):
        return None
    remark = f"{best.told([recording])} (--keep axes leaves that as it was recorded)"
    if recorded[0].rotation is None:
        remark += "; another arm or another order of channels may look so too"
    is_shifted = bool(np.linalg.norm(best.shift) > SHOWN)
    moved = replace(recording, tracks=best.of(recording.tracks))
    moves_all = in_line(expected[0].position) and is_shifted
    return _Correction(moved, remark, poses, moves_all)


def _with_channels_found(
    setup: Setup, recording: Recording, found: Comparison
) -> _Correction | None:
    """Return a recording whose columns are those of other channels; None if it is unclear which.

    The order, or the dead or shared line, is that with which the arm at rest at the pressures is
    clearly nearest to the tip. If none is near, pairs are tried, as in `hypotheses`: one has to be
    far nearer than any single one.
    """
    description = setup.description
    arm, low = Manipulator(description), np.maximum(description.pressure_min, 0.0)
    seen = np.flatnonzero(np.isfinite(found.distance))
    rows = seen[np.linspace(0, len(seen) - 1, DETECTION.channel_rows).astype(int)]
    point = np.linalg.inv(setup.points[0].sensor)[:, 3]

    def miss(hypothesis: Hypothesis, step: int = 1) -> float:
        some = rows[::step]
        try:
            poses = arm.tip_pose(hypothesis.driven(found.pressures[some], low))
        except (EquilibriumError, PressureError):  # the arm does not bear these pressures
            return np.inf
        tips = (setup.base @ poses @ point)[:, :3]
        return float(np.linalg.norm(tips - found.measured[some], axis=1).mean())

    def ranked(tried: Sequence[Hypothesis]) -> list[Hypothesis]:
        return sorted(tried, key=lambda each: miss(each, DETECTION.channel_step))

    def clearest(tried: Sequence[Hypothesis]) -> tuple[float, Hypothesis | None]:
        misses = [miss(each) for each in tried[: DETECTION.shortlist]]
        least, *others = sorted(misses) or [np.inf]
        is_clear = others and np.isfinite(least) and least <= DETECTION.tie * others[0]
        return least, tried[misses.index(least)] if is_clear else None

    single = [each for each in of_channels(description, 1) if each.kind not in setup.settings.keep]
    single = ranked(single)
    least, best = clearest(single)
    if least > DETECTION.frame * DETECTION.off * description.length:
        left, two = clearest(ranked(pairs(single, DETECTION.paired)))
        if two is not None and left <= DETECTION.overwhelming * least:
            best = two
    if best is None:
        return None
    (corrected,) = best.applied([recording], low)
    told = best.told(description, [recording.name])
    remark = f"{told} (--keep {best.kind} leaves that as it was recorded)"
    return _Correction(corrected, remark, seen)


def compare(
    setup: Setup,
    known: Mapping[str, float] | None = None,
    on_evaluation: Callable[[], None] = lambda: None,
    *,
    with_levels: bool = True,
) -> tuple[Comparison, ...]:
    """Predict the recordings of a setup and compare.

    Parameters
    ----------
    setup : Setup
    known : scaled coordinates of zeros and initial states by name, as far as a fit has found them.
    on_evaluation : called at every evaluation.
    with_levels : whether to find out in which regions the readings lie, which takes a while.
    """
    description, recordings = setup.description, setup.recordings
    most = setup.settings.compared_rows if any(description.gravity) else SAMPLING.rows
    samples, kept = [], []
    for recording, begin in zip(recordings, setup.begins, strict=True):
        every = np.arange(len(recording.time))
        rows = every if len(every) <= most else chosen_rows(recording, most)
        samples.append(sampled(recording, rows, setup.span, begin))
        kept.append(rows)
    samples = setup.oriented(description, samples)
    unknowns, x = _beginnings(setup, samples, known or {}, on_evaluation)
    problem = CalibrationProblem(description, unknowns, samples, setup.points, setup.base, NOISE)
    predicted = problem.predict(x)
    found = [
        _comparison(setup, recording, rows, sample, predicted, slice(begin, end))
        for recording, rows, sample, (begin, end) in zip(
            recordings, kept, samples, pairwise(problem.starts), strict=True
        )
    ]
    if not with_levels:
        return tuple(found)
    calibration = description.calibration
    if calibration is None or calibration.errors is None:
        return tuple(found)
    source = Uncertainty(description)
    without_break = [found] if setup.settings.sequence else [[each] for each in found]
    return tuple(each for logs in without_break for each in _with_levels(setup, logs, source))


def _beginnings(
    setup: Setup,
    samples: Sequence[Sample],
    known: Mapping[str, float],
    on_evaluation: Callable[[], None],
) -> tuple[Unknowns, Array]:
    """Return zeros and initial states, known or estimated from the logs' beginnings."""
    all_zeros, all_sides = setup.beginnings(setup.description, samples)
    sensors: Beginnings = ((),) * len(setup.points)
    found_zeros, found_sides = [np.zeros(0)], [np.zeros(0)]
    for sample, zeros, sides in zip(samples, all_zeros, all_sides, strict=True):
        names = [each.name for each in (*zeros, *sides)]
        x = np.array([known.get(each, 0.0) for each in names])
        time = sample.recording.time[sample.rows]
        first = sample.rows[time <= time[0] + setup.settings.settle] if len(time) else sample.rows
        if len(first) and not all(each in known for each in names):
            begun = replace(sample, rows=first, weight=np.ones(len(first)) / np.sqrt(len(first)))
            if begun.begin == "previous":
                begun = replace(begun, begin="rest")
            problem = CalibrationProblem(
                setup.description,
                Unknowns((), (), sensors, (zeros,), (sides,)),
                [begun],
                setup.points,
                setup.base,
                _noise(setup.description, sample.recording.pressures[first]),
            )
            x = fit(problem, [x], on_evaluation, rounds=0).x
        found_zeros.append(x[: len(zeros)])
        found_sides.append(x[len(zeros) :])
    unknowns = Unknowns((), (), sensors, all_zeros, all_sides)
    return unknowns, np.concatenate([*found_zeros, *found_sides])


def _noise(description: RobotDescription, pressures: Array) -> Noise:
    """Return the spread of readings about predictions at pressures (N, n) after a known history.

    A first reading that is off by no more than the model may be wrong says nothing of the history.
    """
    known = description.calibration
    if known is None or not known.position_residual:
        return NOISE
    angle = known.angle_residual or NOISE.angle
    if known.errors is None:
        return Noise(known.position_residual, angle)
    found = Uncertainty(description).errors(pressures[:1], effective=pressures[:1]).covariance[0]
    position = float(np.sqrt(np.trace(found) / 3))
    return Noise(position, angle * max(position / known.position_residual, 1.0))


def _comparison(
    setup: Setup,
    recording: Recording,
    rows: NDArray[np.intp],
    sample: Sample,
    predicted: Predicted,
    own: slice,
) -> Comparison:
    """Compare rows of a recording with their predictions, the rows `own` of all samples."""
    description, tip = setup.description, setup.points[0]
    angle = None
    track = sample.recording.track(tip.name)
    if track.rotation is not None:
        axis = track.rotation[sample.rows] @ tip.sensor[:3, :3].T[:, 2]
        expected = setup.base[:3, :3] @ predicted.poses[0][own, :3, 2, np.newaxis]
        cosine = np.einsum("ni,ni->n", axis, expected[..., 0])
        angle = np.arccos(np.clip(cosine, -1, 1))
    pressures = recording.pressures[rows]
    inside = np.ones(len(rows), dtype=bool)
    if description.calibration is not None:
        counts = [segment.n_channels for segment in description.segments]
        inside = description.calibration.covers(counts, pressures)
    position = predicted.read[0].position[own]
    moving = is_moving(recording.time, recording.pressures)[rows]
    return Comparison(
        name=recording.name,
        time=recording.time[rows],
        pressures=pressures,
        effective=predicted.effective[own],
        rates=predicted.rates[own],
        measured=position + predicted.errors[0][own],
        predicted=position,
        angle=angle,
        inside=inside,
        moving=moving,
        levels=None,
        unsettled_levels=None,
        remarks=recording.remarks,
    )


def _with_levels(setup: Setup, logs: Sequence[Comparison], source: Uncertainty) -> list[Comparison]:
    """Return comparisons of logs without a break with the levels of their regions."""
    ends = np.cumsum([0, *(len(each.time) for each in logs)])
    rows = np.concatenate([
        np.linspace(begin, end - 1, min(end - begin, ERRORS.compared)).astype(np.intp)
        for begin, end in pairwise(ends)
    ])  # fmt: skip
    p, u, rates = (np.concatenate([getattr(each, name) for each in logs])[rows]
                   for name in ("pressures", "effective", "rates"))  # fmt: skip
    moving = np.concatenate([each.moving for each in logs])[rows]
    time = in_turn([each.time for each in logs])[rows]
    held = np.concatenate([held_for(each.time, each.moving) for each in logs])[rows]
    known = source.errors(p, effective=u, rates=rates, time=time)
    unknown = source.errors(p, moving=moving, held=held)
    off = np.concatenate([each.measured - each.predicted for each in logs])[rows]
    off = off @ setup.base[:3, :3]
    found = []
    for each, error in ((known, off), (unknown, off + known.position - unknown.position)):
        levels = np.full(ends[-1], np.nan)
        levels[rows] = source.levels(error, each)
        found.append(np.split(levels, ends[1:-1]))
    return [
        replace(each, levels=known, unsettled_levels=unknown)
        for each, known, unknown in zip(logs, *found, strict=True)
    ]


# measured stiffness -------------------------------------------------------------------------------


@dataclass(frozen=True)
class StiffnessComparison:
    """A measured stiffness and its predictions.

    Attributes
    ----------
    pressures : of the channels, in Pa.
    direction : unit vector in the base frame.
    boundary : ``free``, ``guided`` or ``clamped``.
    measured : in N/m.
    sigma : its standard uncertainty, in N/m.
    before, after : predictions before and after calibration, in N/m; None where the model has no
        equilibrium.
    """

    pressures: tuple[float, ...]
    direction: tuple[float, float, float]
    boundary: str
    measured: float
    sigma: float
    before: float | None
    after: float | None


def compare_stiffness(
    tables: Sequence[StiffnessTable], before: RobotDescription, after: RobotDescription
) -> list[StiffnessComparison]:
    """Compare each measured stiffness of the tables with the predictions of two robots."""
    arms = [Manipulator(before), Manipulator(after)]
    found = []
    for table in tables:
        for i in np.flatnonzero(np.isfinite(table.stiffness)):
            pressures, boundary = table.pressures[i], table.boundaries[i]
            x, y, z = map(float, table.directions[i])
            predicted = [
                _predicted(arm, pressures, (x, y, z), cast(Boundary, boundary)) for arm in arms
            ]
            found.append(
                StiffnessComparison(
                    tuple(map(float, pressures)),
                    (x, y, z),
                    boundary,
                    float(table.stiffness[i]),
                    float(table.sigma[i]),
                    *predicted,
                )
            )
    return found


def _predicted(
    arm: Manipulator,
    pressures: np.ndarray,
    direction: tuple[float, float, float],
    boundary: Boundary,
) -> float | None:
    try:
        return float(arm.stiffness(pressures, direction, boundary=boundary))
    except StiffoptError:  # the arm buckles there, or its strain law ends
        return None
