"""Pressures over time for the studio to play: of a path, a motion or a recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.daemon.run_log import RecordedRun, log_of_run
from stiffopt.display import display_units
from stiffopt.errors import FileError, InputError
from stiffopt.logs.log import Log
from stiffopt.logs.table import read_table
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.scene import Scene
from stiffopt.paths.motion_file import read_motion
from stiffopt.paths.path import Path
from stiffopt.paths.solution import PathSolution
from stiffopt.plots.wording import stiffness_text

_SHOWN = 400  # points of a chart
_EVENTS = 4  # shown at a time


class TimelineChart(NamedTuple):
    """A chart over time."""

    title: str  # with the unit
    names: tuple[str, ...]  # of the k lines
    values: Array  # (N, k)
    shows_pressures: bool = False  # whether they are pressures of channels


class TimelineMoment(NamedTuple):
    """The state at one moment of a timeline."""

    row: int  # index of the last row until then
    pressures: Array  # (n,), in Pa, interpolated
    seen: Array | None  # (3,), last measured position of the tip, in m, or None


@dataclass(frozen=True, eq=False)
class Timeline:
    """Pressures over time, with charts, positions and events."""

    robot: Manipulator  # the arm, with the load of the path
    times: Array  # (N,), in s, from 0, increasing
    pressures: Array  # (N, n), in Pa, without gaps
    charts: tuple[TimelineChart, ...] = ()  # quantities to draw over time
    headline: str = ""  # status and message, for the user
    asked: Array | None = None  # (N, 3), target positions, in m, or None
    # (N, 3), measured positions of the tip, in m, NaN where it was not seen; or None
    seen: Array | None = None
    events: tuple[tuple[float, str], ...] = ()  # times and texts
    scene: Scene | None = None  # the objects around the arm, or None

    @property
    def duration(self) -> float:
        """In s."""
        return float(self.times[-1])

    def at(self, time: float) -> TimelineMoment:
        """Return the state at a time in s."""
        index = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, None))
        after = min(index + 1, len(self.times) - 1)
        begin, end = self.times[index], self.times[after]
        share = 0.0 if end == begin else float(np.clip((time - begin) / (end - begin), 0, 1))
        pressures = (1 - share) * self.pressures[index] + share * self.pressures[after]
        seen = None
        if self.seen is not None:
            known = np.flatnonzero(np.isfinite(self.seen[: index + 1]).all(axis=1))
            seen = self.seen[known[-1]] if len(known) else None
        return TimelineMoment(index, pressures, seen)

    def events_until(self, time: float) -> tuple[tuple[float, str], ...]:
        """Return the last events until a time, the newest first."""
        return tuple([event for event in self.events if event[0] <= time][: -_EVENTS - 1 : -1])

    def shown_rows(self) -> NDArray[np.int_]:
        """Return the rows that a chart shows: all, or some hundreds of them."""
        count = min(len(self.times), _SHOWN)
        return np.unique(np.linspace(0, len(self.times) - 1, count).astype(int))

    # -- sources ------------------------------------------------------------------------------

    @classmethod
    def of_path(cls, path: Path, solution: PathSolution) -> Timeline:
        """Return the timeline of a solved path. Raises `InputError`: the solution has no points."""
        if not len(solution.times):
            raise InputError(f"there is nothing to play: {solution.message}")
        charts = []
        headline = f"{solution.status}. {solution.message}".strip()
        if solution.stiffness is not None:
            unit = display_units().of_si(solution.stiffness_unit)
            lines, names = [solution.stiffness], ["on the path"]
            if solution.alone is not None:
                lines, names = [*lines, solution.alone], [*names, "each point alone"]
            charts.append(
                TimelineChart(f"stiffness ({unit})", tuple(names), unit.of(np.stack(lines, axis=1)))
            )
            least = stiffness_text(float(solution.stiffness.min()), solution.stiffness_unit)
            headline += f" Least stiffness {least}."
        if solution.clearance is not None:
            length = display_units().length
            clearance = length.of(solution.clearance[:, None])
            charts.append(TimelineChart(f"clearance ({length})", ("body",), clearance))
        description = solution.robot.description
        asked = path.points().positions
        return cls(
            solution.robot, solution.times, solution.pressures,
            (*charts, *_pressure_charts(description, solution.pressures)), headline,
            asked if asked.shape == (len(solution.times), 3) else None, scene=path.scene,
        )  # fmt: skip

    @classmethod
    def of_motion(cls, file: str | os.PathLike[str], description: RobotDescription) -> Timeline:
        """Return the timeline of a CSV file that `stiffopt path` or `stiffopt plan` wrote."""
        motion, table = read_motion(file, description), read_table(file)
        charts = [
            TimelineChart(name.replace("_", " "), ("",), table[name][:, None])
            for name in table.columns
            if name.startswith("stiffness")
        ]
        return cls(
            load_robot(description), motion.times, motion.pressures,
            (*charts, *_pressure_charts(description, motion.pressures)), FilePath(file).name,
        )  # fmt: skip

    @classmethod
    def of_log(
        cls,
        file: str | os.PathLike[str],
        log: Log,
        description: RobotDescription,
        events: Sequence[tuple[float, str]] = (),
    ) -> Timeline:
        """Return the timeline of a recording, read as the robot's `recordings` say."""
        given, columns = description.recordings, list(range(description.n_pressures))
        if given is not None and given.channels:
            columns = [column - 1 for column in given.channels]
        if max(columns) >= log.n or (len(columns) != log.n and given is None):
            raise FileError(
                file,
                f"has {log.n} channels and the robot '{description.name}' {len(columns)}; name "
                "the robot that was recorded",
            )
        pressures = np.asarray(log.pressures[:, columns])
        usable = np.isfinite(pressures).all(axis=1)
        times, pressures = log.time[usable], pressures[usable]
        _check_rows(file, times, pressures)
        seen = log.tip_position[usable]
        if given is not None:
            turns = None if log.tip_quaternion is None else log.tip_quaternion[usable]
            seen = np.stack([
                given.registration.tip_in_base(
                    place, None if turns is None or np.isnan(turns[k]).any() else turns[k]
                )[0]
                for k, place in enumerate(seen)
            ])  # fmt: skip
        robot, begin, unit = load_robot(description), times[0], display_units().length
        offset = unit.of(np.linalg.norm(seen - robot.tip_pose(pressures)[:, :3, 3], axis=1))
        return cls(
            robot, times - begin, pressures,
            (
                TimelineChart(f"tip seen from the model's ({unit})", ("",), offset[:, None]),
                *_pressure_charts(description, pressures),
            ),
            FilePath(file).name, seen=seen,
            events=tuple((when - begin, text) for when, text in events),
        )  # fmt: skip

    @classmethod
    def of_run(
        cls, file: str | os.PathLike[str], run: RecordedRun, description: RobotDescription
    ) -> Timeline:
        """Return the timeline of a daemon's recording, with its events."""
        events = [(event.time, event.text) for event in run.events]
        return cls.of_log(file, log_of_run(run), description, events)


def _check_rows(file: str | os.PathLike[str], times: Array, pressures: Array) -> None:
    if len(times) < 2:
        raise FileError(file, "has too few rows with pressures to play; expected two or more")
    if not np.isfinite(pressures).all() or not (np.diff(times) > 0).all():
        raise FileError(file, "has pressures that are missing, or times that do not increase")


def _pressure_charts(description: RobotDescription, pressures: Array) -> tuple[TimelineChart, ...]:
    """Return a chart of the pressures of each segment."""
    unit = display_units().pressure
    return tuple(
        TimelineChart(
            f"segment {number}: pressure ({unit})",
            tuple(f"channel {k + 1}" for k in range(len(own))),
            unit.of(pressures[:, own]),
            shows_pressures=True,
        )
        for number, own in enumerate(description.channel_ranges, start=1)
    )
