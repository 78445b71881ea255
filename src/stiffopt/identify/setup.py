"""From a robot, a structure and recordings to a least-squares problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.problem import Noise, Point, Problem, Sample, Unknowns
from stiffopt.identify.recording import Recording
from stiffopt.identify.samples import begins, sample
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.structure import Structure
from stiffopt.identify.unknowns import (
    BASE,
    SENSOR,
    Unknown,
    history_unknowns,
    placement_unknowns,
    shape_unknowns,
    side_unknowns,
    zero_unknowns,
)
from stiffopt.identify.validation import oriented, placements, points_of
from stiffopt.logs import StiffnessTable
from stiffopt.model.description import RobotDescription, Tolerances

__all__ = ["Setup"]

Array = NDArray[np.float64]

_POSITION_SHARE = 0.01  # of the arm's length: spread of positions that a first fit expects
_FINEST_DEAD_TIME = 0.1  # s between rows; of slower logs dead time and lag are one
_ANGLE = np.radians(3.0)  # the same of angles
_MOST_LOADED_ROWS = 300  # of an arm under gravity, whose every pose is an equilibrium to be found


@dataclass(frozen=True, eq=False)
class Setup:
    """What stays the same while models are compared.

    Attributes
    ----------
    description : RobotDescription
        As the robot file has it.
    recordings : tuple of Recording
    tables : tuple of StiffnessTable
    settings : CalibrationSettings
    base : ndarray
        Pose (4, 4) of the base in the recordings' frame, as far as the robot file knows.
    points : tuple of Point
        That are tracked.
    """

    description: RobotDescription
    recordings: tuple[Recording, ...]
    tables: tuple[StiffnessTable, ...]
    settings: CalibrationSettings
    base: Array
    points: tuple[Point, ...]

    @classmethod
    def of(
        cls,
        description: RobotDescription,
        recordings: Sequence[Recording],
        tables: Sequence[StiffnessTable],
        settings: CalibrationSettings,
    ) -> Setup:
        """Return the setup, with bodies turned to what the robot file says of them."""
        base = placements(description).registration.tracker_in_base.inverse()
        points = points_of(description, recordings) if recordings else ()
        return cls(description, tuple(recordings), tuple(tables), settings, base, points)

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
        """Whether every log has rows so close that a dead time can be told from a lag."""
        steps = [float(np.median(np.diff(recording.time))) for recording in self.recordings]
        return max(steps, default=0.0) <= 1.01 * _FINEST_DEAD_TIME

    @property
    def tolerances(self) -> Tolerances:
        """How well the robot file is known."""
        return self.description.tolerances or Tolerances()

    def samples(self, rows: int) -> list[Sample]:
        """At most so many rows of all recordings, each with its share."""
        if any(self.description.gravity):
            rows = min(rows, _MOST_LOADED_ROWS)
        total = sum(len(recording.time) for recording in self.recordings)
        states = begins(self.recordings, self.span, self.settings.sequence)
        return [
            sample(recording, self.span, max(10, rows * len(recording.time) // total), begin)
            for recording, begin in zip(self.recordings, states, strict=True)
        ]

    def problem(self, structure: Structure, rows: int) -> Problem:
        """The problem of fitting a structure to so many rows."""
        description = structure.applied(self.description, self.seen, self.is_fine)
        samples = oriented(description, self.samples(rows), self.points, self.base)
        noise = Noise(_POSITION_SHARE * description.length, _ANGLE)
        unknowns = self.unknowns(structure, description, samples)
        return Problem(description, unknowns, samples, self.points, self.base, noise, self.tables)

    def unknowns(
        self, structure: Structure, description: RobotDescription, samples: Sequence[Sample]
    ) -> Unknowns:
        """What a structure may change."""
        tolerances = self.tolerances
        shape = shape_unknowns(description, structure.shape, tolerances)
        histories = history_unknowns(description, tolerances)
        parameters = [
            unknown
            for unknown in (*shape, *histories)
            if unknown.parameter is None or unknown.parameter.key not in self.settings.fixed
        ]
        remembers = any(
            segment.history and segment.history.play for segment in description.segments
        )
        turn = [tolerances.base_tilt, tolerances.base_tilt, tolerances.base_turn]
        nothing: tuple[Unknown, ...] = ()
        return Unknowns(
            parameters=tuple(parameters),
            base=tuple(
                placement_unknowns(
                    BASE, np.full(3, tolerances.base_position), np.array(turn), turns=True
                )
                if samples
                else nothing
            ),
            sensors=tuple(self._sensor(point) for point in self.points),
            zeros=tuple(
                tuple(zero_unknowns(each.recording.name, tolerances))
                if self.settings.rezero
                else nothing
                for each in samples
            ),
            sides=tuple(
                tuple(side_unknowns(description, each.recording.name))
                if each.begin == "unknown" and remembers
                else nothing
                for each in samples
            ),
        )

    def _sensor(self, point: Point) -> tuple[Unknown, ...]:
        """Where a sensor is; of the tip's only if it tells turns, as moves and tilts trade off."""
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


def started(problem: Problem, near: Mapping[str, float]) -> Array:
    """Scaled coordinates (d,) of a problem's unknowns where they are known by name, else zero."""
    x = np.array([near.get(unknown.name, 0.0) for unknown in problem.unknowns.all])
    return np.asarray(np.clip(x, problem.low, problem.high))


def named(problem: Problem, x: Array) -> dict[str, float]:
    """Scaled coordinates by name."""
    return {
        unknown.name: float(value) for unknown, value in zip(problem.unknowns.all, x, strict=True)
    }


def without(problem: Problem, held_back: Sequence[NDArray[np.bool_]]) -> Problem:
    """The problem in which some rows of its samples do not count."""
    samples = [
        replace(each, weight=np.where(away, 0.0, each.weight))
        for each, away in zip(problem.samples, held_back, strict=True)
    ]
    return problem.with_samples(samples, problem.noise)
