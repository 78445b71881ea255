"""Validation: how well a robot file predicts logs and measured stiffness."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import StiffoptError
from stiffopt.identify.fit import fit
from stiffopt.identify.problem import CalibrationProblem, Noise, Predicted, Sample, TrackedPoint
from stiffopt.identify.recording import Recording
from stiffopt.identify.results import Comparison
from stiffopt.identify.settings import SAMPLING, CalibrationSettings
from stiffopt.identify.setup import (
    NOISE,
    LogSource,
    RobotSource,
    begins,
    chosen_rows,
    description_of,
    nothing_unknown,
    oriented,
    placements,
    points_of,
    recordings_of,
    thinned,
)
from stiffopt.identify.unknowns import Unknowns, side_unknowns, zero_unknowns
from stiffopt.logs import StiffnessTable
from stiffopt.model.compliance import Boundary
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.manipulator import Manipulator

__all__ = ["StiffnessComparison", "compare", "compare_stiffness", "validate"]

Array = NDArray[np.float64]


def validate(
    robot: RobotSource,
    logs: Sequence[LogSource],
    settings: CalibrationSettings | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> tuple[Comparison, ...]:
    """Run a robot along recordings and compare; nothing of the robot is fitted.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    settings : CalibrationSettings, optional
        How logs are read; what is fitted has no effect here.
    progress : callable, optional
        Is told what is done, of how much, and in words.

    Raises
    ------
    InputError
        A log is not usable; it names the log.
    FileError
        A file cannot be read or is wrong.
    """
    description, settings = description_of(robot), settings or CalibrationSettings()
    if progress is not None:
        progress(0, 2, "reading logs")
    recordings = recordings_of(description, logs, settings)
    if progress is not None:
        progress(1, 2, "comparing")
    return compare(
        description,
        recordings,
        sequence=settings.sequence,
        rezero=settings.rezero,
        settle=settings.settle,
    )


def compare(
    description: RobotDescription,
    recordings: Sequence[Recording],
    *,
    sequence: bool = False,
    rezero: bool = False,
    settle: float = 2.0,
    most: int = SAMPLING.rows,
    known: Mapping[str, float] | None = None,
    tell: Callable[[], None] = lambda: None,
) -> tuple[Comparison, ...]:
    """Run a model along recordings.

    Parameters
    ----------
    description : RobotDescription
    recordings : sequence of Recording
        In the order in which they were made.
    sequence : bool
        Whether each begins in the state in which the one before ended.
    rezero : bool
        Whether positions are counted anew in each recording.
    settle : float
        Time in s at the beginning of a recording from which its zero and its state are estimated.
    most : int
        Rows of a recording that are compared.
    known : dict of str to float, optional
        Scaled coordinates of zeros and states by name, where a fit has found them already.
    """
    span = np.subtract(description.pressure_max, description.pressure_min)
    points = points_of(description, recordings)
    base = placements(description).registration.tracker_in_base.inverse()
    states = begins(recordings, span, sequence)
    if any(description.gravity):
        most = min(most, SAMPLING.loaded_rows)
    samples, kept = [], []
    for recording, begin in zip(recordings, states, strict=True):
        every = np.arange(len(recording.time))
        rows = every if len(every) <= most else chosen_rows(recording, most)
        smaller, places = thinned(recording, rows, span)
        samples.append(Sample(smaller, places, np.ones(len(places)), begin))
        kept.append(rows)
    samples = oriented(description, samples, points, base)
    unknowns, x = _beginnings(description, samples, points, base, rezero, settle, known or {}, tell)
    predicted = CalibrationProblem(description, unknowns, samples, points, base, NOISE).predict(x)
    starts = np.cumsum([0, *(len(sample.rows) for sample in samples)])
    return tuple(
        _comparison(
            description, recording, rows, sample, predicted, slice(begin, end), base, points[0]
        )
        for recording, rows, sample, begin, end in zip(
            recordings, kept, samples, starts[:-1], starts[1:], strict=True
        )
    )


def _beginnings(
    description: RobotDescription,
    samples: Sequence[Sample],
    points: Sequence[TrackedPoint],
    base: Array,
    rezero: bool,
    settle: float,
    known: Mapping[str, float],
    tell: Callable[[], None],
) -> tuple[Unknowns, Array]:
    """Zeros and states of the recordings, as known or as estimated from their beginnings."""
    tolerances = description.tolerances or Tolerances()
    remembers = any(segment.history and segment.history.play for segment in description.segments)
    all_zeros, all_sides, found = [], [], []
    for sample in samples:
        name = sample.recording.name
        zeros = tuple(zero_unknowns(name, tolerances)) if rezero else ()
        unknown = sample.begin == "unknown" and remembers
        sides = tuple(side_unknowns(description, name)) if unknown else ()
        all_zeros.append(zeros)
        all_sides.append(sides)
        names = [each.name for each in (*zeros, *sides)]
        x = np.array([known.get(each, 0.0) for each in names])
        told = all(each in known for each in names)
        time = sample.recording.time[sample.rows]
        first = sample.rows[time <= time[0] + settle] if len(time) else sample.rows
        if not told and len(first):
            begun = replace(sample, rows=first, weight=np.ones(len(first)) / np.sqrt(len(first)))
            if begun.begin == "previous":
                begun = replace(begun, begin="rest")
            own = replace(nothing_unknown([begun], points), zeros=(zeros,), sides=(sides,))
            problem = CalibrationProblem(
                description, own, [begun], points, base, _noise(description)
            )
            x = fit(problem, [x], tell, rounds=0).x
        found.append(x)
    unknowns = replace(
        nothing_unknown(samples, points), zeros=tuple(all_zeros), sides=tuple(all_sides)
    )
    # zeros of all recordings come before all sides
    zeros_first = [x[: len(zeros)] for x, zeros in zip(found, all_zeros, strict=True)]
    sides_last = [x[len(zeros) :] for x, zeros in zip(found, all_zeros, strict=True)]
    return unknowns, np.concatenate([np.zeros(0), *zeros_first, *sides_last])


def _noise(description: RobotDescription) -> Noise:
    """Noise of readings about the prediction, as the calibration left it."""
    known = description.calibration
    if known is None or not known.position_residual:
        return NOISE
    return Noise(known.position_residual, known.angle_residual or NOISE.angle)


def _comparison(
    description: RobotDescription,
    recording: Recording,
    rows: NDArray[np.intp],
    sample: Sample,
    predicted: Predicted,
    own: slice,
    base: Array,
    tip: TrackedPoint,
) -> Comparison:
    angle = None
    track = sample.recording.track(tip.name)
    if track.rotation is not None:
        there = track.rotation[sample.rows] @ tip.sensor[:3, :3].T[:, 2]
        expected = base[:3, :3] @ predicted.poses[0][own, :3, 2, np.newaxis]
        cosine = np.einsum("ni,ni->n", there, expected[..., 0])
        angle = np.arccos(np.clip(cosine, -1, 1))
    pressures = recording.pressures[rows]
    inside = np.ones(len(rows), dtype=bool)
    if description.calibration is not None:
        counts = [segment.n_channels for segment in description.segments]
        inside = description.calibration.covers(counts, pressures)
    position = predicted.read[0].position[own]
    return Comparison(
        name=recording.name,
        time=recording.time[rows],
        pressures=pressures,
        effective=predicted.effective[own],
        measured=position + predicted.errors[0][own],
        predicted=position,
        angle=angle,
        inside=inside,
        remarks=recording.remarks,
    )


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
    before, after : predictions of the robot file before and after calibration, in N/m; None where
        the model has no equilibrium.
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
    """Compare all rows of tables in which a stiffness was measured."""
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
