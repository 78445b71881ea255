"""`Path`: where the tip goes, how fast, how stiff; the schema of the path file and a class in code.

Everything is in SI. Built in code::

    Path(
        path={"line": {"from": (-0.03, -0.02, 0.19), "to": (-0.03, 0.02, 0.19)}},
        points=50,
        timing={"speed": 0.01},
        stiffness={"maximise": {"direction": (1, 0, 0), "frame": "path"}},
    )
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    ConfigDict,
    Field,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from stiffopt.directions import Direction, Quaternion, unit_quaternion
from stiffopt.errors import FileError, InputError
from stiffopt.files import read_file
from stiffopt.logs.table import read_table
from stiffopt.model.description import PerChannelRate, RobotDescription
from stiffopt.model.obstacle import Point, Radius
from stiffopt.optimise.goal import MIXED, OneOrMore, StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import ForRobot, PressureRange, Task
from stiffopt.paths.geometry import (
    ArcCurve,
    Curve,
    PathPoints,
    Polyline,
    SplineCurve,
    arc_through,
    path_axes,
)
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Length, Pressure, Speed

Vector = NDArray[np.float64]

MAX_POINTS = 5_000
"""Of a path."""
_OFF_CIRCLE = 1e-5  # m, that the start of a circle may be off it: a rounded coordinate
_ROUNDING = 1e-9  # of lengths, relative
_COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")


# -- where it goes --------------------------------------------------------------------------------


class PathLine(Schema):
    """A straight line.

    Attributes
    ----------
    start, end : in m; ``from`` and ``to`` in files.
    """

    model_config = ConfigDict(populate_by_name=True)

    start: Annotated[Point, Field(alias="from")]
    end: Annotated[Point, Field(alias="to")]

    @property
    def curve(self) -> Curve:
        """The line in space."""
        return Polyline(np.array([self.start, self.end]))

    @model_validator(mode="after")
    def _check(self) -> PathLine:
        if self.start == self.end:
            raise BadKeyError("to", "is where the line begins; expected another point")
        return self


class PathArc(Schema):
    """An arc of a circle from a point over a second one to a third one.

    Attributes
    ----------
    start, via, end : in m; ``from``, ``via`` and ``to`` in files.
    """

    model_config = ConfigDict(populate_by_name=True)

    start: Annotated[Point, Field(alias="from")]
    via: Point
    end: Annotated[Point, Field(alias="to")]

    @property
    def curve(self) -> Curve:
        """The line in space."""
        found = arc_through(*map(np.array, (self.start, self.via, self.end)))
        if found is None:
            raise BadKeyError(
                "via", "is on one line with the other two points, which no arc goes through"
            )
        return found

    @model_validator(mode="after")
    def _check(self) -> PathArc:
        _ = self.curve
        return self


class PathCircle(Schema):
    """A whole circle; it turns to the left about its normal.

    Attributes
    ----------
    centre : in m.
    normal : unit vector across its plane.
    radius : in m.
    start : the point at which it begins and ends, in m.
    """

    centre: Point
    normal: Direction
    radius: Radius
    start: Point

    @property
    def curve(self) -> Curve:
        """The line in space."""
        centre, axis = np.array(self.centre), np.array(self.normal)
        offset = np.array(self.start) - centre
        height = float(offset @ axis)
        if abs(height) > _OFF_CIRCLE:
            raise BadKeyError(
                "start",
                f"is {_mm(abs(height))} off the circle's plane; expected a point on the circle",
            )
        across = offset - height * axis
        distance = float(np.linalg.norm(across))
        if abs(distance - self.radius) > _OFF_CIRCLE:
            raise BadKeyError(
                "start",
                f"is {_mm(distance)} from the centre; expected the radius of {_mm(self.radius)}",
            )
        return ArcCurve(centre, centre + across * (self.radius / distance), axis, 2 * np.pi)

    @model_validator(mode="after")
    def _check(self) -> PathCircle:
        _ = self.curve
        return self


Rows = tuple[tuple[float, ...], ...]


class PointTable(NamedTuple):
    """What a CSV file says: positions (N, 3), and quaternions (N, 4) and times (N,) or None."""

    positions: Rows
    orientations: Rows | None
    times: tuple[float, ...] | None


class PathShape(Schema):
    """Where a path goes; one of these.

    Attributes
    ----------
    line, arc, circle : see `PathLine`, `PathArc`, `PathCircle`.
    spline : points in m, at least two; the cubic spline through them.
    through : targets, which are the points of the path; all of the same parts, the whole position
        among them.
    csv : file whose rows are the points, with the columns ``x_m``, ``y_m``, ``z_m`` and maybe
        ``time_s`` and ``qw``, ``qx``, ``qy``, ``qz``; in files relative to these.
    """

    line: PathLine | None = None
    arc: PathArc | None = None
    circle: PathCircle | None = None
    spline: Items[Point] | None = None
    through: Items[Target] | None = None
    csv: FilePath | None = None

    @property
    def kind(self) -> str:
        """The key that is given."""
        return next(key for key, value in self if value is not None)

    @property
    def is_listed(self) -> bool:
        """Whether the points are given one by one."""
        return self.kind in ("through", "csv")

    @cached_property
    def table(self) -> PointTable | None:
        """What the CSV file says, if there is one."""
        return None if self.csv is None else _read_points(self.csv)

    def curve(self, closed: bool) -> Curve:
        """Return the line in space that it is, or goes through; `BadKeyError` if there is none."""
        shape = self.line or self.arc or self.circle
        if shape is not None:
            if closed and self.circle is None:
                raise BadKeyError(
                    self.kind, "has two ends; only a circle, a spline or listed points can close"
                )
            return shape.curve
        if self.spline is not None:
            return SplineCurve(self._knots(self.spline, closed), closed)
        points = self._positions()
        gap = float(np.linalg.norm(points[0] - points[-1]))
        if closed and gap > _ROUNDING:
            raise BadKeyError(
                self.kind, f"ends {_mm(gap)} from where it begins; a closed path ends there again"
            )
        return Polyline(points, closed)

    @staticmethod
    def _knots(spline: tuple[tuple[float, float, float], ...], closed: bool) -> Vector:
        """Points (k, 3) of a spline; a closed one leads back to the first."""
        if len(spline) < 2:
            raise BadKeyError("spline", f"expected at least 2 points, not {len(spline)}")
        points = np.array(spline)
        for index in np.flatnonzero((points[1:] == points[:-1]).all(axis=1)):
            raise BadKeyError(
                f"spline.{index + 1}", "is the point before it again; remove one of the two"
            )
        if closed and (points[0] != points[-1]).any():
            points = np.vstack([points, points[:1]])
        return points

    def _positions(self) -> Vector:
        """Positions (N, 3) of points that are given one by one."""
        if self.table is not None:
            return np.array(self.table.positions)
        targets = self.through or ()
        if len(targets) < 2:
            raise BadKeyError("through", f"expected at least 2 targets, not {len(targets)}")
        for index, target in enumerate(targets):
            if target.position is None or None in target.position:
                raise BadKeyError(
                    f"through.{index}",
                    "needs all three coordinates of its position; none may be free",
                )
            if _parts(target) != _parts(targets[0]):
                raise BadKeyError(
                    f"through.{index}", "asks for other parts of the pose than the first target"
                )
        return np.array([target.position for target in targets], dtype=float)

    @field_validator("csv", mode="after")
    @classmethod
    def _from_its_folder(cls, file: FilePath | None, info: ValidationInfo) -> FilePath | None:
        folder = info.context.get("folder") if isinstance(info.context, Mapping) else None
        return file if file is None or folder is None else FilePath(folder) / file

    @field_serializer("csv", when_used="json")
    def _write_file(self, file: FilePath | None) -> str | None:
        return None if file is None else str(file.absolute())

    @model_validator(mode="after")
    def _check(self) -> PathShape:
        given = [key for key, value in self if value is not None]
        if not given:
            *most, last = type(self).model_fields
            raise ValueError(f"goes nowhere; expected the key {', '.join(most)} or {last}")
        if len(given) > 1:
            raise BadKeyError(given[1], f"is a second path, beside {given[0]}; expected one")
        try:
            _ = self.table
        except FileError as error:
            raise BadKeyError("csv", str(error)) from None
        return self


# -- how fast, how stiff, from where --------------------------------------------------------------


class PathTiming(Schema):
    """When the tip is at each point; one of these.

    Attributes
    ----------
    speed : along the path, in m/s.
    times : at each point, in s; the first is 0.
    fastest : as soon as the rates of the pressures allow.
    """

    speed: Annotated[Speed, Field(gt=0)] | None = None
    times: Items[Duration] | None = None
    fastest: Literal[True] | None = None

    @model_validator(mode="after")
    def _check(self) -> PathTiming:
        given = [key for key, value in self if value is not None]
        if not given:
            raise ValueError("says nothing; expected the key speed, times or fastest")
        if len(given) > 1:
            raise BadKeyError(given[1], f"cannot be combined with {given[0]}; remove one of them")
        return self


class PathMeasure(StiffnessMeasure):
    """A stiffness along a path.

    Attributes
    ----------
    frame : axes of `direction`: of the base, of the tip, or of the path, see `path_axes`.
    over : what is maximised of it: its worst value on the path, or its mean.
    """

    frame: Literal["base", "tip", "path"] = "base"  # type: ignore[assignment]
    over: Literal["worst", "mean"] = "worst"


class PathStiffness(Schema):
    """Stiffnesses that are maximised along a path.

    Attributes
    ----------
    maximise : at each point the smallest of these counts.
    """

    maximise: OneOrMore[PathMeasure]

    @property
    def over(self) -> Literal["worst", "mean"]:
        """What is maximised: the worst value on the path, or the mean."""
        return self.maximise[0].over

    def goals(self, tangents: Vector) -> tuple[StiffnessGoal, ...]:
        """Return the goal at each point of a path, whose tangents (N, 3) are given."""
        plain = [
            StiffnessMeasure(
                direction=m.direction, kind=m.kind, boundary=m.boundary,
                frame="tip" if m.frame == "tip" else "base",
            )
            for m in self.maximise
        ]  # fmt: skip
        goal = StiffnessGoal(maximise=plain)
        turning = [index for index, m in enumerate(self.maximise) if m.frame == "path"]
        if not turning:
            return (goal,) * len(tangents)
        ways = path_axes(tangents) @ np.array([plain[k].direction for k in turning]).T  # (N, 3, j)
        found = []
        for point in ways.transpose(0, 2, 1).tolist():
            here = list(plain)
            for index, way in zip(turning, point, strict=True):
                here[index] = plain[index].model_copy(update={"direction": tuple(way)})
            found.append(goal.model_copy(update={"maximise": tuple(here)}))
        return tuple(found)

    @model_validator(mode="after")
    def _check(self) -> PathStiffness:
        if not self.maximise:
            raise BadKeyError("maximise", "is empty; expected at least one stiffness")
        if len({measure.unit for measure in self.maximise}) > 1:
            raise BadKeyError("maximise", MIXED)
        if len({measure.over for measure in self.maximise}) > 1:
            raise BadKeyError("maximise", "mixes the worst and the mean; expected one in all")
        return self


class PathEnd(Schema):
    """The configuration at an end of a path.

    Attributes
    ----------
    pressures : one per channel, proximal segment first, in Pa.
    """

    pressures: Items[Pressure]


class PathPressure(PressureRange):
    """Limits that tighten the robot's; one for all channels or one per channel.

    Attributes
    ----------
    slew : greatest rate of change, in Pa/s, or None for the robot's.
    """

    slew: PerChannelRate | None = None


# -- the path -------------------------------------------------------------------------------------


class Path(ForRobot):
    """Where an arm's tip goes, how fast and how stiff.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to the path file; in code it
        may be left out.
    path : the line that the tip follows.
    pointing, orientation : of the tip on all of it, as in a `Target`, or None.
    count : number of points, both ends counted; in files and as argument ``points``.
    spacing : largest distance between neighbouring points, in m; either of the two, but for points
        that are given one by one, of which it is only checked.
    timing : when the tip is where; None for a CSV file that says it.
    tolerance : largest errors at each point.
    stiffness : what is maximised, or None: the least pressures.
    start, end : pressures there, or None where they are free.
    closed : whether the path and its pressures end as they begin; of a circle by default.
    load : load at the tip, or None.
    pressure : limits and rates that tighten the robot's.
    scene : what is around the arm, or None.
    source : the file that the path was read from, or None.
    """

    path: PathShape
    pointing: Direction | None = None
    orientation: Quaternion | None = None
    count: Annotated[int, Field(strict=True, ge=2, le=MAX_POINTS)] | None = Field(
        None, alias="points"
    )
    spacing: Annotated[Length, Field(gt=0)] | None = None
    timing: PathTiming | None = None
    tolerance: Tolerance = Tolerance()
    stiffness: PathStiffness | None = None
    start: PathEnd | None = None
    end: PathEnd | None = None
    closed: bool = Field(None, validate_default=True)
    pressure: PathPressure = PathPressure()

    def __repr__(self) -> str:
        parts = [] if self.robot is None else [self.robot]
        points = self.points()
        parts.append(f"{self.path.kind} of {_mm(points.curve.length)}, {len(points)} points")
        if points.times is not None:
            parts.append(f"{points.times[-1]:.4g} s")
        return f"Path({', '.join([*parts, *self._conditions()])})"

    __str__ = __repr__

    def points(self) -> PathPoints:
        """Return the points of the path with what is asked at each of them."""
        curve = self._curve()
        lengths = self._lengths(curve)
        tangents = curve.tangents(lengths)
        positions = curve.at(lengths)
        if self.closed:
            positions[-1] = positions[0]
        return PathPoints(
            targets=self._targets(positions),
            goals=self._goals(tangents),
            positions=positions,
            tangents=tangents,
            lengths=lengths,
            times=self._times(lengths),
            curve=curve,
        )

    def task(self, target: Target, goal: StiffnessGoal | None) -> Task:
        """Return the task that one point of the path is, without its neighbours."""
        return Task(
            robot=self.robot, target=target, stiffness=goal, load=self.load, scene=self.scene,
            pressure=PressureRange(min=self.pressure.min, max=self.pressure.max),
            source=self.source,
        )  # fmt: skip

    def end_pressures(self, description: RobotDescription) -> tuple[Vector | None, Vector | None]:
        """Return the pressures at the start and at the end, each (n,) in Pa, or None where free.

        Raises
        ------
        InputError
            They are too many or too few for the robot, or beyond its limits or the path's.
        """
        lower, upper = self.pressure_bounds(description)
        found: list[Vector | None] = []
        for key, given in (("start", self.start), ("end", self.end)):
            if given is None:
                found.append(None)
                continue
            pressures = np.array(given.pressures, dtype=float)
            if len(pressures) != len(lower):
                raise self._error(
                    f"{key}.pressures",
                    f"has {len(pressures)} values; expected {len(lower)}, one for each channel of "
                    "the robot, proximal segment first",
                )
            for index in np.flatnonzero((pressures < lower) | (pressures > upper)):
                raise self._error(
                    f"{key}.pressures",
                    f"{description.channel_name(int(index))} is at {pressures[index] * 1e-5:g} "
                    f"bar; expected {lower[index] * 1e-5:g} bar to {upper[index] * 1e-5:g} bar",
                )
            found.append(pressures)
        first, last = found
        if self.closed:
            first = last = last if first is None else first
        return first, last

    # -- the points -------------------------------------------------------------------------

    def _curve(self) -> Curve:
        try:
            return self.path.curve(self.closed)
        except BadKeyError as error:
            raise BadKeyError(".".join(map(str, ("path", *error.loc))), str(error)) from None

    def _lengths(self, curve: Curve) -> Vector:
        """Arc lengths (N,) of the points."""
        if self.path.is_listed and isinstance(curve, Polyline):
            self._check_listed(curve)
            return curve.knots
        if (self.count is None) == (self.spacing is None):
            raise ValueError("needs the key points or spacing, and not both")
        count = self.count
        if self.spacing is not None:
            count = max(1, math.ceil(curve.length / self.spacing * (1 - _ROUNDING))) + 1
            if count > MAX_POINTS:
                raise BadKeyError(
                    "spacing",
                    f"makes {count} points of {_mm(curve.length)}; "
                    f"at most {MAX_POINTS} are allowed",
                )
        return np.linspace(0.0, curve.length, max(count or 0, 3 if self.closed else 2))

    def _check_listed(self, curve: Polyline) -> None:
        """Refuse points that are too many, or too far apart."""
        count = len(curve.knots)
        if self.count is not None:
            raise BadKeyError("points", f"cannot be chosen: path.{self.path.kind} is the points")
        if count > MAX_POINTS:
            raise BadKeyError(
                f"path.{self.path.kind}", f"has {count} points; at most {MAX_POINTS} are allowed"
            )
        if self.spacing is None:
            return
        steps = np.diff(curve.knots)
        for index in np.flatnonzero(steps > self.spacing * (1 + _ROUNDING)):
            raise BadKeyError(
                "spacing",
                f"is {_mm(self.spacing)}, but points {index + 1} and {index + 2} of "
                f"path.{self.path.kind} are {_mm(float(steps[index]))} apart",
            )

    def _times(self, lengths: Vector) -> Vector | None:
        table, timing = self.path.table, self.timing
        if table is not None and table.times is not None:
            if timing is not None:
                raise BadKeyError("timing", "is told by the column time_s too; remove one of them")
            return np.array(table.times)
        if timing is None:
            raise ValueError("the key 'timing' is missing; expected a speed, times or fastest")
        if timing.speed is not None:
            for index in np.flatnonzero(np.diff(lengths) <= 0):
                raise BadKeyError(
                    "timing.speed",
                    f"leaves no time between points {index + 1} and {index + 2}, which are at the "
                    "same position; give times, or fastest",
                )
            return lengths / timing.speed
        if timing.times is None:
            return None
        times = np.array(timing.times, dtype=float)
        if len(times) != len(lengths):
            raise BadKeyError(
                "timing.times", f"has {len(times)} values; expected {len(lengths)}, one a point"
            )
        fault = _fault_of_times(times)
        if fault is not None:
            raise BadKeyError(f"timing.times.{fault[0]}", fault[1])
        return times

    def _targets(self, positions: Vector) -> tuple[Target, ...]:
        own = {"pointing": self.pointing, "orientation": self.orientation}
        if self.path.through is not None:
            return tuple(self._with_own(target, own) for target in self.path.through)
        table = self.path.table
        turns = None if table is None else table.orientations
        if turns is not None:
            self._refuse_own("path.csv")
            own["orientation"] = turns[0]  # type: ignore[assignment]
        first = Target(position=tuple(positions[0].tolist()), tolerance=self.tolerance, **own)
        changes: list[dict[str, Any]] = [{"position": tuple(row)} for row in positions.tolist()]
        for change, turn in zip(changes, turns or (), strict=False):
            change["orientation"] = turn
        return tuple(first.model_copy(update=change) for change in changes)

    def _with_own(self, target: Target, own: Mapping[str, Any]) -> Target:
        """Return a target of the list with the tolerance and the angular part of the path."""
        update: dict[str, Any] = {}
        if "tolerance" not in target.model_fields_set:
            update["tolerance"] = self.tolerance
        if target.pointing is None and target.orientation is None:
            update |= own
        else:
            self._refuse_own("path.through")
        return target.model_copy(update=update)

    def _refuse_own(self, where: str) -> None:
        """Refuse an angular part beside one of the points."""
        for key in ("pointing", "orientation"):
            if getattr(self, key) is not None:
                raise BadKeyError(key, f"is told by {where} too; remove one of them")

    def _goals(self, tangents: Vector) -> tuple[StiffnessGoal | None, ...]:
        if self.stiffness is None:
            return (None,) * len(tangents)
        if any(m.frame == "path" for m in self.stiffness.maximise) and not tangents.any():
            raise BadKeyError(
                "stiffness.maximise", "frame: path has no axes, as the path stays where it is"
            )
        return self.stiffness.goals(tangents)

    @field_validator("closed", mode="before")
    @classmethod
    def _closed_by_nature(cls, value: Any, info: ValidationInfo) -> Any:
        """A circle is closed unless the file says otherwise."""
        shape = info.data.get("path")
        return (shape is not None and shape.circle is not None) if value is None else value

    @model_validator(mode="after")
    def _check(self) -> Path:
        if self.pointing is not None and self.orientation is not None:
            raise BadKeyError(
                "orientation", "cannot be combined with pointing; remove one of the two"
            )
        if self.closed and self.start and self.end and self.start != self.end:
            raise BadKeyError(
                "end.pressures", "differ from those at the start, but the path is closed"
            )
        self.points()
        return self


def load_path(path: str | os.PathLike[str]) -> Path:
    """Read a path file.

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    """
    return read_file(path, "path", Path).model_copy(update={"source": FilePath(path)})


# -- points from CSV ------------------------------------------------------------------------------


def _read_points(file: FilePath) -> PointTable:
    """Read a CSV file of points; raise `FileError` with the line of the first mistake."""
    table = read_table(file)
    _check_columns(file, table.columns)
    if len(table.values) < 2:
        raise FileError(file, f"has {len(table.values)} points; expected at least 2")
    for row, column in np.argwhere(np.isnan(table.values)).tolist():
        raise FileError(file, f"{table.columns[column]} is missing", line=row + 2)
    times = table["time_s"] if "time_s" in table.columns else None
    fault = None if times is None else _fault_of_times(times)
    if fault is not None:
        raise FileError(file, f"time_s {fault[1]}", line=fault[0] + 2)
    stamps = None if times is None else tuple(times.tolist())
    positions = tuple(zip(*(table[name].tolist() for name in _COLUMNS[1:4]), strict=True))
    if "qw" not in table.columns:
        return PointTable(positions, None, stamps)
    turns = []
    for row, values in enumerate(
        zip(*(table[name].tolist() for name in _COLUMNS[4:]), strict=True)
    ):
        try:
            turns.append(unit_quaternion(values))
        except InputError as error:
            raise FileError(file, f"the quaternion {error}", line=row + 2) from None
    return PointTable(positions, tuple(turns), stamps)


def _check_columns(file: FilePath, columns: tuple[str, ...]) -> None:
    wanted = _COLUMNS[1:4] + (_COLUMNS[4:] if any(c in columns for c in _COLUMNS[4:]) else ())
    wrong: list[tuple[Callable[[str], bool], tuple[str, ...], str]] = [
        (lambda name: name not in _COLUMNS, columns, "is unknown"),
        (lambda name: columns.count(name) > 1, columns, "is there twice"),
        (lambda name: name not in columns, wanted, "is missing"),
    ]
    for is_wrong, names, what in wrong:
        for name in filter(is_wrong, names):
            raise FileError(
                file,
                f"the column '{name}' {what}; expected time_s (or none), x_m, y_m, z_m and "
                "qw, qx, qy, qz (or none of these)",
                line=1,
            )


# -- words ----------------------------------------------------------------------------------------


def _fault_of_times(times: Vector) -> tuple[int, str] | None:
    """Return the index of the first time that is wrong, and what is; None if all are right."""
    if times[0] != 0:
        return 0, f"begins at {times[0]:g} s; expected 0 s"
    for index in np.flatnonzero(np.diff(times) <= 0).tolist():
        return index + 1, f"is {times[index + 1]:g} s after {times[index]:g} s; it must increase"
    return None


def _parts(target: Target) -> tuple[str, ...]:
    return tuple(term.key for term in target.terms)


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
