"""Do a series of the stiffness experiment: the probe touches the tip and displaces it in steps.

`Probing` does a series on the rig; `PointsFile` stores the points of all series.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.errors import DeviceError, FileError, InputError
from stiffopt.experiments.conductor import Conductor, TrackedFrame, split_window
from stiffopt.logs.table import cut_torn_end, read_table, writing
from stiffopt.rig.interface import ForceProbe

NAME = "points.csv"
_DIRECTION = ("direction_x", "direction_y", "direction_z")
_KEY = ("repetition", "pressure_pa", *_DIRECTION)
_VALUES = ("time_s", "force_n", "displacement_m", "stage_m", "tip_x_m", "tip_y_m", "tip_z_m")
_FLAGS = ("touching", "settled")


@dataclass(frozen=True)
class ProbeTuning:
    """Tuning of the probe's approach, and of the criterion for a settled force."""

    speed: float = 0.002  # of the stage, in m/s
    piece: float = 0.1  # longest single movement, in s; the supply is commanded in between
    approach: float = 1e-4  # step of the stage during the search for the tip, in m
    tare: float = 1.0  # time over which the force without contact is averaged, in s
    # time over which a force must be constant at a step, in s; its second half is averaged
    window: float = 1.0
    change: float = 0.01  # share by which a constant force may change
    timeout: float = 6.0  # longest time at a step, in s
    touch: float = 5.0  # smallest force of a contact, in standard deviations of the noise
    min_touch: float = 1e-3  # smallest force of a contact, in N


PROBE = ProbeTuning()


@dataclass(frozen=True)
class Series:
    """Parameters of a series."""

    direction: Array  # unit vector (3,) in the base frame, along which the probe pushes
    displacement: float  # travel of the stage beyond the first contact, and back, in m
    steps: int  # number of steps each way
    reach: float  # travel within which the stage searches for the tip, in m
    max_force: float  # force at which the series ends, in N


@dataclass(frozen=True)
class ProbePoint:
    """A step of a series: means over a time in which the force was constant."""

    time: float  # middle of that time on the rig's clock, in s
    force: float  # of the probe, minus its reading without contact, in N
    displacement: float  # of the tip along the direction, from its free position, in m
    stage: float  # travel of the stage beyond the first contact, in m
    position: Array  # of the tip (3,), in m
    measured: Array  # pressures (n,), in Pa
    touching: bool  # whether the force exceeds the noise
    settled: bool  # whether the force became constant in time


class Probing:
    """Does series with the probe of a rig while its conductor holds the pressures."""

    def __init__(self, conductor: Conductor) -> None:
        if conductor.rig.probe is None:
            raise InputError("this rig has no probe; the stiffness experiment needs one")
        self._conductor = conductor
        self.probe: ForceProbe = conductor.rig.probe
        self._at = 0.0

    def run(self, pressures: Array, series: Series) -> list[ProbePoint]:
        """Touch the tip, displace it in steps, return in the same steps, and retreat.

        Pressures (n,), in Pa, are held. The way back separates the arm's creep, which never stops,
        from the effect of the displacement. Raises `DeviceError` if the probe does not find the tip
        or a device fails.
        """
        self._conductor.probing = True
        try:
            return self._pushed(pressures, series)
        except BaseException:
            self.probe.stop()
            raise
        finally:
            self._conductor.probing = False

    def _pushed(self, pressures: Array, series: Series) -> list[ProbePoint]:
        self._at = self.probe.sample().position
        free = self._tared(pressures)
        points: list[ProbePoint] = []
        contact = self._touch(pressures, series, free)
        places = [contact + series.displacement * k / series.steps for k in range(series.steps + 1)]
        reached = 0
        for place in places:
            if not self._move(pressures, place, free.force + series.max_force):
                break
            points.append(self._point(pressures, series, free, contact))
            reached += 1
        for place in reversed(places[: max(reached - 1, 0)]):
            self._move(pressures, place, np.inf)
            points.append(self._point(pressures, series, free, contact))
        self._move(pressures, 0.0, np.inf)
        return points

    def _tared(self, pressures: Array) -> _Free:
        """Measure force, noise and tip position without contact."""
        begin = self._conductor.clock.now()
        self._conductor.settle(pressures, lambda rows: False, PROBE.tare)
        rows = [row for row in self._conductor.since(begin) if np.isfinite(row.force)]
        seen = [row.position for row in rows if row.visible]
        if len(rows) < 3 or not seen:
            raise DeviceError("the tracker did not see the tip while the probe was zeroed")
        forces = np.array([row.force for row in rows])
        noise = float(forces.std(ddof=1))
        return _Free(float(forces.mean()), noise, np.mean(seen, axis=0))

    def _touch(self, pressures: Array, series: Series, free: _Free) -> float:
        """Advance until the probe measures a contact; return the position of the stage."""
        begin = self._at
        threshold = max(PROBE.touch * free.noise, PROBE.min_touch)
        step = min(PROBE.approach, series.displacement / 4)
        while self._at - begin < series.reach:
            self._move(pressures, self._at + step, free.force + series.max_force)
            if self._force() - free.force > threshold and self._force() - free.force > threshold:
                return self._at
        raise DeviceError(
            f"the probe has met nothing within {series.reach * 1e3:g} mm; is it aligned with the "
            "tip, is its force read with the right sign?"
        )

    def _force(self) -> float:
        force = self.probe.sample().force
        if not np.isfinite(force):
            raise DeviceError("the force of the probe cannot be read")
        return force

    def _point(self, pressures: Array, series: Series, free: _Free, contact: float) -> ProbePoint:
        conductor = self._conductor
        begin = conductor.clock.now()

        def steady(rows: Sequence[TrackedFrame]) -> bool:
            halves = split_window(rows, PROBE.window, 2)
            if halves is None:
                return False
            first, second = (np.mean([row.force for row in half]) for half in halves)
            slack = 4 * free.noise / np.sqrt(min(map(len, halves)))
            return bool(abs(second - first) <= max(PROBE.change * abs(second - free.force), slack))

        settled = conductor.settle(pressures, steady, PROBE.timeout)
        rows = conductor.since(begin)
        last = [row for row in rows if row.time > rows[-1].time - PROBE.window / 2]
        seen = [row for row in last if row.visible]
        if not seen:
            raise DeviceError("the tracker did not see the tip at a step of the probe")
        force = float(np.mean([row.force for row in last])) - free.force
        position = np.mean([row.position for row in seen], axis=0)
        return ProbePoint(
            time=float(np.mean([row.time for row in last])),
            force=force,
            displacement=float((position - free.position) @ series.direction),
            stage=float(np.mean([row.stage for row in last])) - contact,
            position=position,
            measured=np.mean([row.measured for row in last], axis=0),
            touching=force
            > max(PROBE.touch * free.noise / np.sqrt(len(last)), PROBE.min_touch / 2),
            settled=settled,
        )

    def _move(self, pressures: Array, place: float, max_force: float) -> bool:
        """Move in short pieces; stop and return False if the force exceeds `max_force`."""
        while self._at != place:
            far = PROBE.speed * PROBE.piece
            self._at += float(np.clip(place - self._at, -far, far))
            if abs(self._at - place) < 1e-9:
                self._at = place
            self.probe.move_to(self._at, PROBE.speed)
            self._conductor.tick(pressures)
            if self._force() > max_force:
                return False
        return True


class _Free(NamedTuple):
    """Readings without contact."""

    force: float  # mean reading of the probe, in N
    noise: float  # its standard deviation, in N
    position: Array  # of the tip (3,), in m


@dataclass(frozen=True)
class SeriesKey:
    """Identifies a series: repetition (from 1), pressure in Pa, direction (unit vector)."""

    repetition: int
    pressure: float
    direction: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class SeriesPoints:
    """The N points of a series as arrays; see `ProbePoint`."""

    key: SeriesKey
    time: Array
    force: Array
    displacement: Array
    stage: Array
    touching: Flags
    settled: Flags
    measured: Array


class PointsFile:
    """The file with the points of all series on n channels; each series is appended as a whole."""

    def __init__(self, folder: Path, n: int) -> None:
        self.path = folder / NAME
        self.n = n

    @property
    def _columns(self) -> tuple[str, ...]:
        measured = tuple(f"pm{k + 1}_pa" for k in range(self.n))
        return (*_KEY, "point", "points", *_VALUES, *measured, *_FLAGS)

    def read(self) -> list[SeriesPoints]:
        """Return the complete series, in order."""
        if not self.path.exists():
            return []
        cut_torn_end(os.fspath(self.path))
        if not self.path.stat().st_size:
            return []
        table = read_table(self.path)
        if table.columns != self._columns:
            raise FileError(self.path, "has other columns than this experiment", line=1)
        series = []
        start = 0
        while start < len(table.values):
            count = int(table["points"][start])
            rows = table.values[start : start + count]
            place = table.columns.index("point")
            if count < 1 or rows[:, place].tolist() != list(range(1, count + 1)):
                later = np.flatnonzero(table["point"][start + 1 :] == 1)
                start = start + 1 + int(later[0]) if len(later) else len(table.values)
                continue  # the last series of a killed run
            series.append(self._series(dict(zip(table.columns, rows.T, strict=True))))
            start += count
        return series

    def _series(self, columns: dict[str, Array]) -> SeriesPoints:
        x, y, z = (float(columns[name][0]) for name in _DIRECTION)
        key = SeriesKey(int(columns["repetition"][0]), float(columns["pressure_pa"][0]), (x, y, z))
        return SeriesPoints(
            key=key,
            time=columns["time_s"],
            force=columns["force_n"],
            displacement=columns["displacement_m"],
            stage=columns["stage_m"],
            touching=columns["touching"] > 0,
            settled=columns["settled"] > 0,
            measured=np.stack([columns[f"pm{k + 1}_pa"] for k in range(self.n)], axis=1),
        )

    def append(self, key: SeriesKey, points: Sequence[ProbePoint]) -> None:
        """Append a series and flush it to disk."""
        lines = []
        for number, point in enumerate(points, start=1):
            values = [
                key.repetition, key.pressure, *key.direction, number, len(points),
                point.time - points[0].time, point.force, point.displacement, point.stage,
                *point.position, *point.measured, point.touching, point.settled,
            ]  # fmt: skip
            fields = [f"{value:.9g}" if np.isfinite(value) else "" for value in map(float, values)]
            lines.append(",".join(fields))
        with writing(self.path), open(self.path, "ab") as stream:
            header = [] if stream.tell() else [",".join(self._columns)]
            stream.write("".join(f"{line}\n" for line in [*header, *lines]).encode())
            stream.flush()
            os.fsync(stream.fileno())
