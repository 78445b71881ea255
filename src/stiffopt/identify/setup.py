"""Build the least-squares problem of a calibration from a robot, logs and a model structure."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.identify.detection import begun, on_one_clock
from stiffopt.identify.problem import Begin, CalibrationProblem, Noise, Sample, TrackedPoint
from stiffopt.identify.recording import Recording, Track, prepare
from stiffopt.identify.settings import SAMPLING, START, CalibrationSettings
from stiffopt.identify.structures import ModelStructure
from stiffopt.identify.tracker_faults import aligned
from stiffopt.identify.unknowns import (
    BASE,
    SENSOR,
    Unknown,
    Unknowns,
    anew_unknowns,
    history_unknowns,
    placement_unknowns,
    shape_unknowns,
    side_unknowns,
    zero_unknowns,
)
from stiffopt.logs import Log, StiffnessTable, read_log, read_mcap_log, read_stiffness_table
from stiffopt.model.arm import Arm
from stiffopt.model.description import Recordings, RobotDescription, Tolerances
from stiffopt.model.robot_files import load_description
from stiffopt.registration import Placement

Rows = NDArray[np.intp]

NOISE = Noise(1e-3, np.radians(2.0))
"""Assumed noise of readings for a robot that was not calibrated, in m and rad."""

_Path = str | os.PathLike[str]
RobotSource = _Path | RobotDescription | Arm
"""A built-in robot's name, the path of a robot file, a description or a `Manipulator`."""
LogSource = _Path | Log | tuple[str, Log]
"""The path of a log (CSV or ``.mcap``), a log, or a log with its name."""
TableSource = _Path | StiffnessTable
"""The path of a table of measured stiffness, or the table."""
Beginnings = tuple[tuple[Unknown, ...], ...]
"""Unknowns of each recording."""


def description_of(robot: RobotSource) -> RobotDescription:
    """Return the description of a robot."""
    if isinstance(robot, RobotDescription):
        return robot
    return robot.description if isinstance(robot, Arm) else load_description(robot)


def tables_of(tables: Sequence[TableSource], description: RobotDescription) -> list[StiffnessTable]:
    """Return tables of measured stiffness.

    Raises
    ------
    InputError
        A table does not have the robot's number of channels.
    """
    found = []
    for each in tables:
        table = each if isinstance(each, StiffnessTable) else read_stiffness_table(each)
        if table.n != description.n_pressures:
            raise InputError(
                f"a table of stiffness has {table.n} pressures and robot '{description.name}' "
                f"{description.n_pressures} channels; expected as many"
            )
        found.append(table)
    return found


def _named(logs: Sequence[LogSource]) -> list[tuple[str, Log]]:
    """Read logs and name them by their files, with the folder where files share a name."""
    if isinstance(logs, str):
        raise InputError("expected a list of logs, not one path")
    files = Counter(Path(log).name for log in logs if isinstance(log, str | os.PathLike))
    found = []
    for number, log in enumerate(logs, start=1):
        if isinstance(log, Log):
            found.append((f"log {number}", log))
        elif isinstance(log, tuple):
            found.append(log)
        else:
            path = Path(log)
            read = read_mcap_log if path.suffix == ".mcap" else read_log
            found.append((path.name if files[path.name] == 1 else str(path), read(path)))
    return found


def recordings_of(
    description: RobotDescription,
    logs: Sequence[LogSource],
    settings: CalibrationSettings,
) -> list[Recording]:
    """Read logs as recordings of this robot, as its file and the settings specify."""
    given, read = description.recordings or Recordings(), _named(logs)
    found = [
        prepare(
            log,
            name,
            description,
            channels=given.channels or None,
            frame=given.frame,
            bodies=tuple(given.bodies),
            pressures=settings.pressures,
            keep_units="units" in settings.keep,
        )
        for name, log in read
    ]
    span = np.subtract(description.pressure_max, description.pressure_min)
    if "clock" not in settings.keep:
        found = [on_one_clock(recording, span) for recording in found]
    found = [
        begun(recording, span) if log.measured is None else recording
        for recording, (_, log) in zip(found, read, strict=True)
    ]
    return _with_order_checked(found) if settings.sequence else found


def _with_order_checked(recordings: Sequence[Recording]) -> list[Recording]:
    """Return logs of a sequence with a remark on each that seems to belong before the previous one.

    Such a log ends before the previous one begins. A log whose clock begins anew does so too, but
    mostly has the times of an earlier one.
    """
    found = list(recordings[:1])
    for previous, recording in pairwise(recordings):
        begin, end = recording.time[[0, -1]]
        own_times = all(end < each.time[0] or begin > each.time[-1] for each in found)
        if end < previous.time[0] and own_times:
            remark = (
                f"it ends at {end:.6g} s, before {previous.name} begins, which is given before it; "
                "if they have one clock, give the logs of a sequence in the order of their times "
                "(a shell puts _10 before _2)"
            )
            recording = replace(recording, remarks=(*recording.remarks, remark))
        found.append(recording)
    return found


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that stays fixed while models are compared: robot, recordings and settings.

    Attributes
    ----------
    description : as the robot file has it.
    recordings : tuple of Recording
    tables : tuple of StiffnessTable
    settings : CalibrationSettings
    base : pose (4, 4) of the base in the recordings' frame, according to the robot file.
    points : the tracked points, the tip first.
    found : faults of all recordings that were corrected, one sentence each.
    """

    description: RobotDescription
    recordings: tuple[Recording, ...]
    tables: tuple[StiffnessTable, ...]
    settings: CalibrationSettings
    base: Array
    points: tuple[TrackedPoint, ...]
    found: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        description: RobotDescription,
        recordings: Sequence[Recording],
        tables: Sequence[StiffnessTable],
        settings: CalibrationSettings,
    ) -> Setup:
        """Create the setup of a robot, with base and sensors placed as its file says."""
        given = description.recordings or Recordings()
        places: dict[str, tuple[float | None, Placement]] = {
            "tip": (None, given.registration.tip_in_sensor)
        }
        places |= {name: (body.at, body.point_in_sensor) for name, body in given.bodies.items()}
        points = tuple(
            TrackedPoint(
                name,
                at,
                placement.inverse(),
                turns=all(recording.track(name).rotation is not None for recording in recordings),
            )
            for name, (at, placement) in places.items()
        )
        base = given.registration.tracker_in_base.inverse()
        return cls(
            description,
            tuple(recordings),
            tuple(tables),
            settings,
            base,
            points if recordings else (),
        )

    @property
    def span(self) -> Array:
        """Range (n,) of each channel's pressure, in Pa."""
        return np.subtract(self.description.pressure_max, self.description.pressure_min)

    @property
    def seen(self) -> float:
        """Highest pressure that was recorded, in Pa."""
        highest = [float(np.abs(recording.pressures).max()) for recording in self.recordings]
        return max(highest, default=float(max(self.description.pressure_max)))

    @property
    def is_fine(self) -> bool:
        """Whether all logs are sampled finely enough to distinguish a dead time from a lag."""
        steps = [float(np.median(np.diff(recording.time))) for recording in self.recordings]
        return max(steps, default=0.0) <= 1.01 * SAMPLING.dead_time_step

    @property
    def tolerances(self) -> Tolerances:
        """Prior uncertainty of the robot file's numbers."""
        return self.description.tolerances or Tolerances()

    @property
    def begins(self) -> list[Begin]:
        """State of the arm at the beginning of each recording."""
        return begins(self.recordings, self.span, self.settings.sequence)

    def samples(self, rows: int) -> list[Sample]:
        """Return samples of the recordings, about `rows` rows in all, shared by their lengths."""
        if any(self.description.gravity):
            rows = min(rows, SAMPLING.loaded_fit_rows)
        total = sum(len(recording.time) for recording in self.recordings)
        found = []
        for recording, begin in zip(self.recordings, self.begins, strict=True):
            limit = max(10, rows * len(recording.time) // total)
            found.append(sampled(recording, chosen_rows(recording, limit), self.span, begin))
        return found

    def problem(self, structure: ModelStructure, rows: int) -> CalibrationProblem:
        """Return the problem of fitting a model structure to about `rows` rows."""
        description = structure.applied(self.description, self.seen, self.is_fine)
        samples = self.oriented(description, self.samples(rows))
        noise = Noise(START.position_noise * description.length, START.angle_noise)
        tolerances = self.tolerances
        parameters = shape_unknowns(description, structure.shape, tolerances)
        parameters += history_unknowns(description, tolerances)
        turn = np.array([tolerances.base_tilt, tolerances.base_tilt, tolerances.base_turn])
        position = np.full(3, tolerances.base_position)
        zeros, sides = self.beginnings(description, samples)
        unknowns = Unknowns(
            parameters=tuple(
                unknown
                for unknown in parameters
                if unknown.parameter is None or unknown.parameter.key not in self.settings.fixed
            ),
            base=tuple(placement_unknowns(BASE, position, turn, turns=True)) if samples else (),
            sensors=tuple(self._sensor(point) for point in self.points),
            zeros=zeros,
            sides=sides,
        )
        return CalibrationProblem(
            description, unknowns, samples, self.points, self.base, noise, self.tables
        )

    def beginnings(
        self, description: RobotDescription, samples: Sequence[Sample]
    ) -> tuple[Beginnings, Beginnings]:
        """Return each recording's unknown zero, or motion, and unknown initial sides of plays."""
        plays = any(segment.history and segment.history.play for segment in description.segments)
        zeros, sides = [], []
        for each in samples:
            name = each.recording.name
            zero = zero_unknowns(name, self.tolerances) if self.settings.rezero else []
            if each.recording.anew is not None:
                zero = anew_unknowns(f"{each.recording.anew} of {name}", description.length)
            side = side_unknowns(description, name) if each.begin == "unknown" and plays else []
            zeros.append(tuple(zero))
            sides.append(tuple(side))
        return tuple(zeros), tuple(sides)

    def oriented(self, description: RobotDescription, samples: Sequence[Sample]) -> list[Sample]:
        """Resolve the rotation of the cube that each track may share, by a model's prediction.

        See `stiffopt.identify.tracker_faults`.
        """
        if not any(point.turns for point in self.points):
            return list(samples)
        nothing: Beginnings = ((),)
        unknowns = Unknowns(
            (), (), nothing * len(self.points), nothing * len(samples), nothing * len(samples)
        )
        turning = [point.name for point in self.points if point.turns]
        few = [_of_few_rows(each, turning) for each in samples]
        if not any(len(each.rows) for each in few):
            return list(samples)
        problem = CalibrationProblem(description, unknowns, few, self.points, self.base, NOISE)
        predicted = problem.predict(np.zeros(0))
        found = []
        for each, some, (begin, end) in zip(samples, few, pairwise(problem.starts), strict=True):
            tracks: list[Track] = []
            for track in each.recording.tracks:
                k = [point.name for point in self.points].index(track.name)
                if self.points[k].turns and track.rotation is not None:
                    expected = self.base[:3, :3] @ predicted.poses[k][begin:end, :3, :3]
                    expected = expected @ self.points[k].sensor[:3, :3]
                    track = replace(track, rotation=_turned(track.rotation, some.rows, expected))
                tracks.append(track)
            recording = replace(each.recording, tracks=tuple(tracks))
            found.append(replace(each, recording=recording))
        return found

    def _sensor(self, point: TrackedPoint) -> tuple[Unknown, ...]:
        """Return the unknown placement of a sensor.

        That of the tip is fitted only if orientations were recorded: its position and the tilt of
        the base have nearly the same effect.
        """
        tolerances = self.tolerances
        if point.name == "tip":
            position, angle = tolerances.sensor_position, tolerances.sensor_angle
            if not point.turns:
                return ()
            name = SENSOR
        else:
            position, angle = tolerances.body_position, tolerances.body_angle
            name = f"sensor of {point.name}"
        return tuple(placement_unknowns(name, np.full(3, position), np.full(3, angle), point.turns))


# rows ---------------------------------------------------------------------------------------------


def chosen_rows(recording: Recording, limit: int) -> Rows:
    """Return at most `limit` rows (M,) in which the tip was measured, evenly spread."""
    usable = np.flatnonzero(np.isfinite(recording.tracks[0].position).all(axis=1))
    if len(usable) <= limit:
        return usable
    return usable[np.linspace(0, len(usable) - 1, limit).round().astype(np.intp)]


def thinned(recording: Recording, wanted: Rows, span: Array) -> tuple[Recording, Rows]:
    """Remove rows that are neither wanted nor needed to interpolate the pressures.

    Returns
    -------
    recording, rows
        The shorter recording, and the indices in it of the wanted rows (M,).
    """
    count = len(recording.time)
    kept = np.zeros(count, dtype=bool)
    kept[wanted] = True
    kept[0] = kept[-1] = True
    p = recording.pressures / span
    gap = SAMPLING.longest_gap
    open_rows = np.ones(count, dtype=bool)  # not yet known to lie on a straight line
    while gap > 1:
        begins = np.arange(0, count - 1, gap)
        ends = np.minimum(begins + gap, count - 1)
        block = np.repeat(np.arange(len(begins)), ends - begins)
        rows = np.arange(len(block))
        begun, width = recording.time[begins], recording.time[ends] - recording.time[begins]
        part = (recording.time[rows] - begun[block]) / width[block]
        line = p[begins][block] + (p[ends] - p[begins])[block] * part[:, np.newaxis]
        off = np.abs(p[rows] - line).max(axis=1)
        worst = np.maximum.reduceat(off, begins)
        straight = (worst <= SAMPLING.straight) & open_rows[begins]
        open_rows[rows[straight[block]]] = False
        kept[begins[straight]] = True
        kept[ends[straight]] = True
        gap //= 4
    slot = np.floor(recording.time / SAMPLING.fine)
    kept |= open_rows & np.append(slot[1:] != slot[:-1], True)
    position = np.cumsum(kept) - 1
    tracks = tuple(
        Track(
            track.name,
            track.position[kept],
            None if track.rotation is None else track.rotation[kept],
        )
        for track in recording.tracks
    )
    smaller = replace(
        recording,
        time=recording.time[kept],
        pressures=recording.pressures[kept],
        tracks=tracks,
    )
    return smaller, position[wanted]


def _of_few_rows(sample: Sample, turning: Sequence[str]) -> Sample:
    """Return a sample of few rows that tell how the bodies `turning` are turned in its log."""
    found: set[int] = set()
    for track in sample.recording.tracks:
        if track.name in turning and track.rotation is not None:
            known = sample.rows[np.isfinite(track.rotation[sample.rows]).all(axis=(1, 2))]
            count = min(len(known), SAMPLING.turn_rows)
            found.update(known[np.linspace(0, len(known) - 1, count).round().astype(np.intp)])
    rows = np.array(sorted(found), dtype=np.intp)
    return replace(sample, rows=rows, weight=np.ones(len(rows)), spread=1.0)


def sampled(recording: Recording, rows: Rows, span: Array, begin: Begin) -> Sample:
    """Return a sample of rows (M,) of a recording, thinned elsewhere."""
    smaller, places = thinned(recording, rows, span)
    return Sample(smaller, places, np.ones(len(places)), begin)


def begins(recordings: Sequence[Recording], span: Array, sequence: bool) -> list[Begin]:
    """Return the kind of state in which each recording begins."""
    found: list[Begin] = []
    for index, recording in enumerate(recordings):
        at_rest = bool((np.abs(recording.before) <= SAMPLING.rest * span).all())
        if sequence and index:
            found.append("previous")
        else:
            found.append("rest" if at_rest else "unknown")
    return found


def _turned(rotation: Array, rows: NDArray[np.intp], expected: Array) -> Array:
    """Return that of 24 versions of rotations (N, 3, 3) nearest to those expected in `rows`."""
    between = np.swapaxes(expected, 1, 2) @ rotation[rows]
    if not np.isfinite(between).all(axis=(1, 2)).any():
        return rotation
    version = np.swapaxes(between, 1, 2) @ aligned(between, np.eye(3))
    known = np.isfinite(version).all(axis=(1, 2))
    return np.asarray(rotation @ version[known][0])
