"""How well a robot file predicts logs that it may not have seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.comparison import Comparison
from stiffopt.identify.fit import fit
from stiffopt.identify.problem import Noise, Point, Predicted, Problem, Sample, Unknowns
from stiffopt.identify.recording import Recording, Track, aligned, prepare
from stiffopt.identify.samples import begins, chosen_rows, thinned
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.unknowns import Unknown, side_unknowns, zero_unknowns
from stiffopt.logs import Log
from stiffopt.model.description import Recordings, RobotDescription, Tolerances
from stiffopt.registration import Placement

__all__ = ["compare", "recordings_of", "validate"]

Array = NDArray[np.float64]

MOST_ROWS = 50_000  # of a log that are compared; more say nothing more
MOST_LOADED_ROWS = 400  # of an arm under gravity, whose every pose is an equilibrium to be found
_NOISE = Noise(1e-3, np.radians(2.0))  # of readings, for a robot that was not calibrated


def validate(
    description: RobotDescription,
    logs: Sequence[tuple[str, Log]],
    settings: CalibrationSettings | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> tuple[Comparison, ...]:
    """Run a robot along logs and compare; nothing of the robot is fitted.

    Parameters
    ----------
    description : RobotDescription
    logs : sequence of (name, Log)
        In the order in which they were recorded.
    settings : CalibrationSettings, optional
        How logs are read; what is fitted has no effect here.
    progress : callable, optional
        Is told what is done, of how much, and in words.

    Raises
    ------
    InputError
        A log is not usable; it names the log.
    """
    settings = settings or CalibrationSettings()
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


def recordings_of(
    description: RobotDescription,
    logs: Sequence[tuple[str, Log]],
    settings: CalibrationSettings,
) -> list[Recording]:
    """Return logs as a fit and a validation use them."""
    given = placements(description)
    return [
        prepare(
            log,
            name,
            description,
            channels=given.channels or None,
            frame=given.frame,
            bodies=tuple(given.bodies),
            pressures=settings.pressures,
        )
        for name, log in logs
    ]


def compare(
    description: RobotDescription,
    recordings: Sequence[Recording],
    *,
    sequence: bool = False,
    rezero: bool = False,
    settle: float = 2.0,
    most: int = MOST_ROWS,
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
        most = min(most, MOST_LOADED_ROWS)
    samples, kept = [], []
    for recording, begin in zip(recordings, states, strict=True):
        every = np.arange(len(recording.time))
        rows = every if len(every) <= most else chosen_rows(recording, most)
        smaller, places = thinned(recording, rows, span)
        samples.append(Sample(smaller, places, np.ones(len(places)), begin))
        kept.append(rows)
    samples = oriented(description, samples, points, base)
    unknowns, x = _beginnings(description, samples, points, base, rezero, settle, known or {}, tell)
    predicted = Problem(description, unknowns, samples, points, base, _NOISE).predict(x)
    starts = np.cumsum([0, *(len(sample.rows) for sample in samples)])
    return tuple(
        _comparison(
            description, recording, rows, sample, predicted, slice(begin, end), base, points[0]
        )
        for recording, rows, sample, begin, end in zip(
            recordings, kept, samples, starts[:-1], starts[1:], strict=True
        )
    )


def placements(description: RobotDescription) -> Recordings:
    """How the robot's logs are read, or what is usual."""
    return description.recordings or Recordings()


def points_of(description: RobotDescription, recordings: Sequence[Recording]) -> tuple[Point, ...]:
    """Tracked points of an arm, the tip first, where the robot file says that their sensors are."""
    given = placements(description)
    places: dict[str, tuple[float | None, Placement]] = {
        "tip": (None, given.registration.tip_in_sensor)
    }
    places |= {name: (body.at, body.point_in_sensor) for name, body in given.bodies.items()}
    return tuple(
        Point(
            name,
            at,
            placement.inverse(),
            turns=all(recording.track(name).rotation is not None for recording in recordings),
        )
        for name, (at, placement) in places.items()
    )


def oriented(
    description: RobotDescription,
    samples: Sequence[Sample],
    points: Sequence[Point],
    base: Array,
) -> list[Sample]:
    """Samples whose bodies are turned by what their markers cannot tell, to what is predicted."""
    if not any(point.turns for point in points):
        return list(samples)
    predicted = Problem(description, _none(samples, points), samples, points, base, _NOISE).predict(
        np.zeros(0)
    )
    starts = np.cumsum([0, *(len(sample.rows) for sample in samples)])
    found = []
    for sample, begin, end in zip(samples, starts[:-1], starts[1:], strict=True):
        tracks: list[Track] = []
        for track in sample.recording.tracks:
            k = [point.name for point in points].index(track.name)
            if points[k].turns and track.rotation is not None:
                expected = base[:3, :3] @ predicted.poses[k][begin:end, :3, :3]
                expected = expected @ points[k].sensor[:3, :3]
                track = replace(track, rotation=_turned(track.rotation, sample.rows, expected))
            tracks.append(track)
        found.append(replace(sample, recording=replace(sample.recording, tracks=tuple(tracks))))
    return found


def _turned(rotation: Array, rows: NDArray[np.intp], expected: Array) -> Array:
    """The version of rotations (N, 3, 3) whose wanted rows are nearest to what is expected."""
    between = np.swapaxes(expected, 1, 2) @ rotation[rows]
    if not np.isfinite(between).all(axis=(1, 2)).any():
        return rotation
    version = np.swapaxes(between, 1, 2) @ aligned(between, np.eye(3))
    known = np.isfinite(version).all(axis=(1, 2))
    return np.asarray(rotation @ version[known][0])


def _none(samples: Sequence[Sample], points: Sequence[Point]) -> Unknowns:
    """Nothing that may change."""
    nothing: tuple[tuple[Unknown, ...], ...] = ((),)
    each = nothing * len(samples)
    return Unknowns((), (), nothing * len(points), each, each)


def _beginnings(
    description: RobotDescription,
    samples: Sequence[Sample],
    points: Sequence[Point],
    base: Array,
    rezero: bool,
    settle: float,
    known: Mapping[str, float],
    tell: Callable[[], None],
) -> tuple[Unknowns, Array]:
    """Zeros and states of the recordings, as known or as their own beginnings tell them."""
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
            own = replace(_none([begun], points), zeros=(zeros,), sides=(sides,))
            problem = Problem(description, own, [begun], points, base, _noise(description))
            x = fit(problem, [x], tell, rounds=0).x
        found.append(x)
    unknowns = replace(_none(samples, points), zeros=tuple(all_zeros), sides=tuple(all_sides))
    # zeros of all recordings come before all sides
    zeros_first = [x[: len(zeros)] for x, zeros in zip(found, all_zeros, strict=True)]
    sides_last = [x[len(zeros) :] for x, zeros in zip(found, all_zeros, strict=True)]
    return unknowns, np.concatenate([np.zeros(0), *zeros_first, *sides_last])


def _noise(description: RobotDescription) -> Noise:
    """What a prediction may be expected to miss: nothing finer can be told from it."""
    known = description.calibration
    if known is None or not known.position_residual:
        return _NOISE
    return Noise(known.position_residual, known.angle_residual or _NOISE.angle)


def _comparison(
    description: RobotDescription,
    recording: Recording,
    rows: NDArray[np.intp],
    sample: Sample,
    predicted: Predicted,
    own: slice,
    base: Array,
    tip: Point,
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
