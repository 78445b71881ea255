"""Results of calibration and validation: errors of the tip, fitted numbers and remarks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.identify.fit import Fit
from stiffopt.identify.settings import REPORT
from stiffopt.identify.unknowns import BASE, SENSOR
from stiffopt.model.parameters import Parameter
from stiffopt.model.uncertainty import NORMAL_QUANTILE

TIED = "hardly told apart"
"""Beginning of the remark on two numbers that the data cannot distinguish."""
_PLACED = {
    BASE: "the base tracked too, or touched with a pointer",
    SENSOR: "the tip's orientation recorded while it bends in all directions",
}
"""Experiments that would determine these frames."""
_LEVEL = "; gravity turned with it: if the tracker is not level, say so in its registration"


@dataclass(frozen=True)
class Errors:
    """Errors of the tip over some rows.

    Attributes
    ----------
    n : number of compared rows.
    mean, median, p95, max : of the distance between measured and predicted position, in m; NaN if
        n is 0.
    angle : mean angle between measured and predicted axis of the tip, in rad, or None where no
        orientation was recorded.
    """

    n: int
    mean: float
    median: float
    p95: float
    max: float
    angle: float | None

    @classmethod
    def of(cls, distances: Array, angles: Array | None) -> Errors:
        """Summarise distances (N,) in m and angles (N,) in rad, ignoring NaN."""
        known = distances[np.isfinite(distances)]
        turned = None if angles is None else angles[np.isfinite(angles)]
        angle = float(turned.mean()) if turned is not None and len(turned) else None
        if not len(known):
            return cls(0, np.nan, np.nan, np.nan, np.nan, angle)
        return cls(
            len(known),
            float(known.mean()),
            float(np.median(known)),
            float(np.quantile(known, 0.95)),
            float(known.max()),
            angle,
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """A log and the model's prediction of it, in the frame of the recording.

    Attributes
    ----------
    name : of the log.
    time : (N,), in s.
    pressures : (N, n), commanded, in Pa.
    effective, rates : (N, n), effective pressures, at which the model predicts the tip, in Pa, and
        their time derivatives, in Pa/s.
    measured, predicted : (N, 3), positions of the tip's sensor, in m; NaN where not measured.
    angle : (N,), between the measured and the predicted axis of the tip, in rad; None if no
        orientation was recorded.
    inside : (N,), whether the pressures lie within those of the calibration; all true without one.
    moving : (N,), whether the pressures were changing.
    levels : (N,), probability of the smallest region about the prediction that contains the
        measured tip; None if the robot file has no error model.
    unsettled_levels : (N,), the same about `Manipulator.tip_pose` at the commanded pressures, which
        ignores earlier commands.
    remarks : findings in the log, one sentence each.
    """

    name: str
    time: Array
    pressures: Array
    effective: Array
    rates: Array
    measured: Array
    predicted: Array
    angle: Array | None
    inside: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    levels: Array | None
    unsettled_levels: Array | None
    remarks: tuple[str, ...]

    @property
    def distance(self) -> Array:
        """Error (N,) of the position in m; NaN where not measured."""
        return np.asarray(np.linalg.norm(self.measured - self.predicted, axis=1))

    @property
    def errors(self) -> Errors:
        """Errors of all rows."""
        return Errors.of(self.distance, self.angle)

    @property
    def outside(self) -> Errors:
        """Errors of the rows whose pressures lie outside those of the calibration."""
        return self.rows(~self.inside).errors

    def rows(self, wanted: NDArray[np.bool_]) -> Comparison:
        """Return the comparison of the wanted rows (N,) alone."""
        names = [each.name for each in fields(self) if each.name not in ("name", "remarks")]
        columns = {name: getattr(self, name) for name in names}
        kept = {name: column[wanted] for name, column in columns.items() if column is not None}
        return replace(self, **kept)


def together(comparisons: Sequence[Comparison]) -> Errors:
    """Summarise the errors of the rows of all logs together."""
    distances = np.concatenate([np.zeros(0), *(each.distance for each in comparisons)])
    angles = [each.angle for each in comparisons if each.angle is not None]
    return Errors.of(distances, np.concatenate(angles) if angles else None)


LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)
"""Probabilities of the regions whose coverage is reported."""


@dataclass(frozen=True)
class RegionCoverage:
    """Share of measured positions within the regions of `LEVELS`.

    Attributes
    ----------
    n : number of rows.
    shares : for each level, from 0 to 1.
    intervals : 95 % intervals of the shares, by a bootstrap of blocks of two minutes: neighbouring
        rows have similar errors. NaN with fewer than two blocks.
    """

    n: int
    shares: tuple[float, ...]
    intervals: tuple[tuple[float, float], ...]

    @property
    def by_level(self) -> dict[float, float]:
        """Shares by their levels."""
        return dict(zip(LEVELS, self.shares, strict=True))


def coverage(comparisons: Sequence[Comparison]) -> dict[str, RegionCoverage]:
    """Return the coverage of the regions about predictions, over the rows of all logs together.

    Returns
    -------
    Coverage by kind of prediction: ``with history``; and of `Manipulator.tip_pose`, ``moving`` and
    ``settled``. Each also appears for the rows inside and outside the recorded pressures, as in
    ``settled, outside``. Kinds without a row are left out.
    """
    found: dict[str, list[Array]] = {}  # of each block
    for each in comparisons:
        if each.levels is None or each.unsettled_levels is None:
            continue
        every = np.ones_like(each.moving)
        kinds = {
            "with history": (each.levels, every),
            "moving": (each.unsettled_levels, each.moving),
            "settled": (each.unsettled_levels, ~each.moving),
        }
        places = {"": every, ", inside": each.inside, ", outside": ~each.inside}
        for kind, (levels, wanted) in kinds.items():
            for place, where in places.items():
                rows = np.flatnonzero(wanted & where & np.isfinite(levels))
                block = (each.time[rows] - each.time[0]) // REPORT.block
                parts = np.split(levels[rows], np.flatnonzero(np.diff(block)) + 1)
                found.setdefault(kind + place, []).extend(part for part in parts if len(part))
    return {kind: _region_coverage(blocks) for kind, blocks in found.items() if blocks}


def _region_coverage(blocks: Sequence[Array]) -> RegionCoverage:
    """Return the coverage from the levels of the rows of each block."""
    sizes = np.array([len(block) for block in blocks])
    hits = np.array([[(block <= level).sum() for level in LEVELS] for block in blocks])
    shares = hits.sum(axis=0) / sizes.sum()
    limits = np.full((2, len(LEVELS)), np.nan)
    if len(blocks) > 1:
        drawn = np.random.default_rng(0).integers(len(blocks), size=(REPORT.draws, len(blocks)))
        among = hits[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)[:, np.newaxis]
        limits = np.quantile(among, (0.025, 0.975), axis=0)
    pairs = ((float(low), float(high)) for low, high in limits.T)
    return RegionCoverage(int(sizes.sum()), tuple(map(float, shares)), tuple(pairs))


@dataclass(frozen=True)
class FittedEstimate:
    """A fitted number with its interval.

    Attributes
    ----------
    name : in reports.
    key : its key in the robot file, or empty.
    unit : SI unit; empty for a plain number.
    before, value : before and after the fit, in SI; the motion of a frame is zero before.
    low, high : ends of the 95 % interval.
    learnt : share of the prior's variance that the data removed, from 0 to 1.
    far : distance from the robot file, in prior deviations.
    """

    name: str
    key: str
    unit: str
    before: float
    value: float
    low: float
    high: float
    learnt: float
    far: float


def estimates(found: Fit) -> tuple[FittedEstimate, ...]:
    """Return every number of a fit with its interval."""
    variance = np.diag(found.covariance)
    listed = []
    for unknown, x, v in zip(found.problem.unknowns.all, found.x, variance, strict=True):
        middle, half = x * unknown.deviation, NORMAL_QUANTILE * math.sqrt(v) * unknown.deviation
        ends = [max(middle - half, unknown.low), middle, min(middle + half, unknown.high)]
        before, unit, key = 0.0, unknown.unit, ""
        if unknown.parameter is not None:
            key, unit = unknown.parameter.key, unknown.parameter.number.unit
            before = unknown.parameter.value(found.problem.description)
            ends = [float(unknown.parameter.at(before, end)) for end in ends]
        listed.append(
            FittedEstimate(
                unknown.name,
                key,
                unit,
                before,
                ends[1],
                ends[0],
                ends[2],
                learnt=float(np.clip(1 - v, 0, 1)),
                far=float(x),
            )
        )
    return tuple(listed)


def doubts(found: Fit, listed: Sequence[FittedEstimate]) -> list[str]:
    """Return remarks on numbers that were not learnt, cannot be distinguished, or are far off."""
    remarks = []
    unlearnt: dict[str, list[str]] = {}
    for estimate in listed:
        if estimate.learnt < REPORT.learnt:
            unlearnt.setdefault(_experiment(estimate), []).append(estimate.name)
    for experiment, names in unlearnt.items():
        tell = f"; what would tell: {experiment}" if experiment else ""
        remarks.append(f"not learnt from these data: {'; '.join(names)}{tell}")
    robot, deviation = found.problem.description, np.sqrt(np.diag(found.covariance))
    correlation = found.covariance / np.outer(deviation, deviation)
    for i, one in enumerate(listed):
        for j in range(i):
            if abs(correlation[i, j]) > REPORT.tied:
                remarks.append(
                    f"{TIED}: {listed[j].name} and {one.name} (correlation {correlation[i, j]:.2f})"
                )
    for estimate in listed:
        turned = estimate.unit == "rad" and not estimate.key and not estimate.name.endswith("z")
        if abs(estimate.far) > REPORT.far or (turned and abs(estimate.value) > REPORT.tilt):
            remarks.append(
                f"far from the robot file: {estimate.name}, by {abs(estimate.far):.1f} of its "
                "tolerances; look for a reason before you trust it"
            )
            if turned and estimate.name.startswith(BASE) and any(robot.gravity):
                remarks[-1] += _LEVEL
    return remarks


def _experiment(estimate: FittedEstimate) -> str:
    if estimate.key:
        return Parameter(estimate.key).number.experiment
    return next((text for name, text in _PLACED.items() if estimate.name.startswith(name)), "")


def is_unfit(calibrated: Sequence[Comparison], length: float) -> bool:
    """Whether a fit misses its own recordings by too much to be useful."""
    return bool(calibrated) and together(calibrated).mean > REPORT.unfit * length


def what_to_look_at(calibrated: Sequence[Comparison], length: float) -> str:
    """Return the remark on a fit that misses its own recordings."""
    errors, unit = together(calibrated), display_units().length
    means = np.array([each.errors.mean for each in calibrated])
    alone = [
        f"{each.name} ({unit.text(mean, '.0f')})"
        for each, mean in zip(calibrated, means, strict=True)
        if mean > REPORT.alone * np.median(means)
    ]
    text = (
        f"UNFIT: the fit misses its own recordings by {unit.text(errors.mean, '.1f')} in the mean, "
        f"{errors.mean / length * 100:.0f} % of the arm's length; look at "
    )
    if alone:
        text += f"{', '.join(alone)}, far worse than the others, and then at "
    if len(calibrated) > 1:
        text += "whether all logs are of the same arm in the same place (else: --rezero), "
    return text + (
        "the order of the channels (--channels), the body in whose frame poses are taken (--frame) "
        "and its axes (are they right-handed?), the registration, lengths and chambers of the "
        "robot file, and whether the pressures are those that the arm had"
    )


def outliers(found: Fit) -> list[str]:
    """Return a remark on each recording with outlying rows, which the loss weights less."""
    remarks = []
    starts = found.problem.starts
    error = np.linalg.norm(found.predicted.errors[0], axis=1) if starts[-1] else np.zeros(0)
    far = error > REPORT.outlier * np.sqrt(3) * found.problem.noise.position
    for sample, (a, b) in zip(found.problem.samples, itertools.pairwise(starts), strict=True):
        if far[a:b].any():
            times = sample.recording.time[sample.rows][far[a:b]]
            one = len(times) == 1
            when = f"at {times[0]:.4g} s; it counts less"
            if not one:
                when = f"first at {times[0]:.4g} s, last at {times[-1]:.4g} s; they count less"
            remarks.append(
                f"{sample.recording.name}: {len(times)} of {b - a} rows {'is' if one else 'are'} "
                f"more than {REPORT.outlier:g} deviations from the model, {when}"
            )
    return remarks
