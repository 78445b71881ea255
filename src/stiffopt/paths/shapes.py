"""Shapes of paths: the key ``path`` of a path file, and the curve that it describes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import cached_property
from pathlib import Path as FilePath
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from stiffopt.arrays import Array
from stiffopt.directions import Direction, unit_quaternion
from stiffopt.errors import FileError, InputError
from stiffopt.files import folder_of
from stiffopt.logs.table import read_table
from stiffopt.model.obstacle import Point, Radius
from stiffopt.optimise.target import Target
from stiffopt.paths.geometry import ArcCurve, Curve, Polyline, SplineCurve, arc_through
from stiffopt.schema import BadKeyError, Items, Schema

_OFF_CIRCLE = 1e-5  # m, tolerated distance of a circle's start from the circle, for rounding
_APART = 1e-9  # m, distance from which the ends of a closed path count as different points
_FARTHEST = 1e3  # m, largest coordinate
_COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")


class _Formula(Schema):
    """A curve given by a few numbers."""

    model_config = ConfigDict(populate_by_name=True)

    @property
    @abstractmethod
    def curve(self) -> Curve:
        """The curve in space; raises `BadKeyError` if there is none."""

    @model_validator(mode="after")
    def _check(self) -> _Formula:
        _ = self.curve
        return self


class PathLine(_Formula):
    """A straight line.

    Attributes
    ----------
    start, end : in m; ``from`` and ``to`` in files.
    """

    start: Annotated[Point, Field(alias="from")]
    end: Annotated[Point, Field(alias="to")]

    @property
    def curve(self) -> Curve:
        """See the base class."""
        if self.start == self.end:
            raise BadKeyError("to", "is where the line begins; expected another point")
        return Polyline(np.array([self.start, self.end]))


class PathArc(_Formula):
    """An arc of a circle from one point through a second to a third.

    Attributes
    ----------
    start, via, end : in m; ``from``, ``via`` and ``to`` in files.
    """

    start: Annotated[Point, Field(alias="from")]
    via: Point
    end: Annotated[Point, Field(alias="to")]

    @property
    def curve(self) -> Curve:
        """See the base class."""
        found = arc_through(*map(np.array, (self.start, self.via, self.end)))
        if found is None:
            raise BadKeyError(
                "via", "is on one line with the other two points, which no arc goes through"
            )
        return found


class PathCircle(_Formula):
    """A whole circle, followed about its normal by the right-hand rule.

    Attributes
    ----------
    centre : in m.
    normal : unit normal of its plane.
    radius : in m.
    start : the point at which it begins and ends, in m.
    """

    centre: Point
    normal: Direction
    radius: Radius
    start: Point

    @property
    def curve(self) -> Curve:
        """See the base class."""
        centre, axis = np.array(self.centre), np.array(self.normal)
        offset = np.array(self.start) - centre
        height = float(offset @ axis)
        if abs(height) > _OFF_CIRCLE:
            raise BadKeyError(
                "start",
                f"is {mm_text(abs(height))} off the circle's plane; expected a point on the circle",
            )
        across = offset - height * axis
        distance = float(np.linalg.norm(across))
        if abs(distance - self.radius) > min(_OFF_CIRCLE, self.radius / 2):
            raise BadKeyError(
                "start",
                f"is {mm_text(distance)} from the centre; "
                f"expected the radius of {mm_text(self.radius)}",
            )
        return ArcCurve(centre, centre + across * (self.radius / distance), axis, 2 * np.pi)


Rows = tuple[tuple[float, ...], ...]


class PointTable(NamedTuple):
    """A CSV file's positions (N, 3), and its quaternions (N, 4) and times (N,), or None."""

    positions: Rows
    orientations: Rows | None
    times: tuple[float, ...] | None


class PathShape(Schema):
    """The shape of a path; exactly one of these.

    Attributes
    ----------
    line, arc, circle : see `PathLine`, `PathArc`, `PathCircle`.
    spline : points in m, at least two; the cubic spline through them.
    through : targets, which are the points of the path. All prescribe the same components of the
        pose, among them the whole position.
    csv : file whose rows are the points, with the columns ``x_m``, ``y_m``, ``z_m`` and optionally
        ``time_s`` and ``qw``, ``qx``, ``qy``, ``qz``; in a path file relative to it.
    """

    line: PathLine | None = None
    arc: PathArc | None = None
    circle: PathCircle | None = None
    spline: Items[Point] | None = None
    through: Items[Target] | None = None
    csv: FilePath | None = None

    @property
    def kind(self) -> str:
        """The given key."""
        return next(key for key, value in self if value is not None)

    @property
    def is_listed(self) -> bool:
        """Whether the points are listed one by one."""
        return self.kind in ("through", "csv")

    @cached_property
    def table(self) -> PointTable | None:
        """The contents of the CSV file, or None."""
        return None if self.csv is None else _read_points(self.csv)

    def curve(self, closed: bool) -> Curve:
        """Return the curve; raise `BadKeyError` if there is none."""
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
        if closed and gap > _APART:
            raise BadKeyError(
                self.kind,
                f"ends {mm_text(gap)} from where it begins; a closed path ends there again",
            )
        return Polyline(points, closed)

    @staticmethod
    def _knots(spline: tuple[tuple[float, float, float], ...], closed: bool) -> Array:
        """Return the points (k, 3) of a spline; a closed one ends at the first."""
        if len(spline) < 2:
            raise BadKeyError("spline", f"expected at least 2 points, not {len(spline)}")
        points = np.array(spline)
        for index in np.flatnonzero((points[1:] == points[:-1]).all(axis=1)):
            raise BadKeyError(
                f"spline.{index + 1}", "is the point before it again; remove one of the two"
            )
        if closed and (points[0] != points[-1]).any():
            points = np.vstack([points, points[:1]])
        if closed and len(points) < 4:
            raise BadKeyError("spline", "expected at least 3 points, as the path is closed")
        return points

    def _positions(self) -> Array:
        """Return the positions (N, 3) of listed points."""
        if self.table is not None:
            return np.array(self.table.positions)

        def parts(target: Target) -> tuple[str, ...]:
            return tuple(term.key for term in target.terms)

        targets = self.through or ()
        if len(targets) < 2:
            raise BadKeyError("through", f"expected at least 2 targets, not {len(targets)}")
        for index, target in enumerate(targets):
            if target.position is None or None in target.position:
                raise BadKeyError(
                    f"through.{index}",
                    "needs all three coordinates of its position; none may be free",
                )
            if parts(target) != parts(targets[0]):
                raise BadKeyError(
                    f"through.{index}", "asks for other parts of the pose than the first target"
                )
        return np.array([target.position for target in targets], dtype=float)

    @field_validator("csv", mode="after")
    @classmethod
    def _from_its_folder(cls, file: FilePath | None, info: ValidationInfo) -> FilePath | None:
        return None if file is None else folder_of(info) / file

    @field_serializer("csv", when_used="json")
    def _write_file(self, file: FilePath | None) -> str | None:
        return None if file is None else str(file.absolute())

    @model_validator(mode="after")
    def _check(self) -> PathShape:
        check_one_key(self)
        try:
            _ = self.table
        except FileError as error:
            raise BadKeyError("csv", str(error)) from None
        return self


def _read_points(file: FilePath) -> PointTable:
    """Read a CSV file of points; raise `FileError` with the line of the first mistake."""
    table = read_table(file)
    _check_columns(file, table.columns)
    if len(table.values) < 2:
        raise FileError(file, f"has {len(table.values)} points; expected at least 2")
    for row, column in np.argwhere(np.isnan(table.values)).tolist():
        raise FileError(file, f"{table.columns[column]} is missing", line=row + 2)
    stamps = None
    if "time_s" in table.columns:
        stamps = tuple(table["time_s"].tolist())
        fault = fault_of_times(table["time_s"])
        if fault is not None:
            raise FileError(file, f"time_s {fault[1]}", line=fault[0] + 2)
    places = np.column_stack([table[name] for name in _COLUMNS[1:4]])
    for row in np.flatnonzero(np.abs(places).max(axis=1) > _FARTHEST).tolist():
        raise FileError(file, f"is more than {_FARTHEST:g} m from the base", line=row + 2)
    positions = tuple(map(tuple, places.tolist()))
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
        (lambda name: columns.count(name) > 1, columns, "appears twice"),
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


def fault_of_times(times: Array) -> tuple[int, str] | None:
    """Return the index of the first invalid time and the fault; None if all are valid."""
    if times[0] != 0:
        return 0, f"begins at {times[0]:g} s; expected 0 s"
    for index in np.flatnonzero(np.diff(times) <= 0).tolist():
        return index + 1, f"is {times[index + 1]:g} s after {times[index]:g} s; it must increase"
    return None


def check_one_key(schema: Schema) -> None:
    """Raise an error unless exactly one of the keys of a mapping is given."""
    given = [key for key, value in schema if value is not None]
    if not given:
        *most, last = type(schema).model_fields
        raise ValueError(f"is empty; expected the key {', '.join(most)} or {last}")
    if len(given) > 1:
        raise BadKeyError(given[1], f"cannot be combined with {given[0]}; remove one of the two")


def mm_text(length: float) -> str:
    """Return a length in m as text in mm."""
    return f"{length * 1e3:.6g} mm"
