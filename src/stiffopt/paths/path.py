"""`Path`: a tip path with its timing and stiffness goal; also the schema of path files.

All values are in SI. Example::

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
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from stiffopt.arrays import Array
from stiffopt.directions import Direction, Quaternion
from stiffopt.files import read_file
from stiffopt.model.description import PerChannelRate, RobotDescription
from stiffopt.optimise.goal import MIXED, OneOrMore, StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import ForRobot, PressureRange, Task
from stiffopt.paths.geometry import Curve, PathPoints, Polyline, path_axes
from stiffopt.paths.shapes import PathShape, check_one_key, fault_of_times, mm_text
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Length, Pressure, Speed

MAX_POINTS = 5_000
"""Largest number of points of a path."""
_LONGEST = 86_400.0  # s, longest duration of a path
_ROUNDING = 1e-9  # relative tolerance of lengths


class PathTiming(Schema):
    """The timing of a path; exactly one of these.

    Attributes
    ----------
    speed : along the path, in m/s.
    times : at each point, in s; the first is 0.
    fastest : as fast as the rates of the pressures allow.
    """

    speed: Annotated[Speed, Field(gt=0)] | None = None
    times: Items[Duration] | None = None
    fastest: Literal[True] | None = None

    @model_validator(mode="after")
    def _check(self) -> PathTiming:
        check_one_key(self)
        return self


class PathMeasure(StiffnessMeasure):
    """A stiffness that is maximised along a path.

    Attributes
    ----------
    frame : axes of `direction`: those of the base, of the tip, or of the path, see `path_axes`.
    over : whether to maximise its worst value on the path or its mean.
    """

    frame: Literal["base", "tip", "path"] = "base"  # type: ignore[assignment]
    over: Literal["worst", "mean"] = "worst"


class PathStiffness(Schema):
    """Stiffnesses that are maximised along a path.

    Attributes
    ----------
    maximise : the smallest of these counts at each point.
    """

    maximise: OneOrMore[PathMeasure]

    @property
    def over(self) -> Literal["worst", "mean"]:
        """Whether the worst value on the path is maximised, or the mean."""
        return self.maximise[0].over

    def goals(self, tangents: Array) -> tuple[StiffnessGoal, ...]:
        """Return the goal at each point of a path with tangents (N, 3)."""
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
    slew : largest rate of change, in Pa/s; None for the robot's.
    """

    slew: PerChannelRate | None = None


# -- the path -------------------------------------------------------------------------------------


class Path(ForRobot):
    """A path of an arm's tip, with timing, tolerances and stiffness goal.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to the path file; in code it
        may be left out.
    path : the curve that the tip follows.
    pointing, orientation : of the tip all along the path, as in a `Target`, or None.
    count : number of points, both ends included; in files and as argument ``points``.
    spacing : largest distance between neighbouring points, in m; given instead of `count`. For
        points that are listed one by one, it is only checked.
    timing : None for a CSV file with times.
    tolerance : largest errors at each point.
    stiffness : stiffness to maximise; None for the least pressures.
    start, end : pressures at the ends; None where they are free.
    closed : whether the path and its pressures end as they begin; by default true for a circle.
    load : load at the tip, or None.
    pressure : limits and rates that tighten the robot's.
    scene : the objects around the arm, or None.
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
        parts.append(f"{self.path.kind} of {mm_text(points.curve.length)}, {len(points)} points")
        if points.times is not None:
            parts.append(f"{points.times[-1]:.4g} s")
        return f"Path({', '.join([*parts, *self._conditions()])})"

    __str__ = __repr__

    def points(self) -> PathPoints:
        """Return the points of the path, with target and stiffness goal of each."""
        curve = self._curve()
        lengths = self._lengths(curve)
        tangents = curve.tangents(lengths)
        positions = curve.at(lengths)
        if self.closed:
            positions[-1] = positions[0]
        times = self._times(lengths)
        if times is not None and not times[-1] <= _LONGEST:
            raise BadKeyError("timing", f"takes {times[-1]:.3g} s; expected a day at most")
        targets = self._targets(positions)
        if self.closed:
            _check_ends(targets[0], targets[-1])
        return PathPoints(
            targets=targets,
            goals=self._goals(tangents),
            positions=positions,
            tangents=tangents,
            lengths=lengths,
            times=times,
            curve=curve,
        )

    def task(self, target: Target, goal: StiffnessGoal | None) -> Task:
        """Return the task of a single point of the path."""
        return Task(
            robot=self.robot, target=target, stiffness=goal, load=self.load, scene=self.scene,
            pressure=PressureRange(min=self.pressure.min, max=self.pressure.max),
            source=self.source,
        )  # fmt: skip

    def end_pressures(self, description: RobotDescription) -> tuple[Array | None, Array | None]:
        """Return the pressures at the start and at the end, each (n,) in Pa, or None where free.

        Raises
        ------
        InputError
            They are too many or too few for the robot, or beyond its limits or the path's.
        """
        lower, upper = self.pressure_bounds(description)
        found: list[Array | None] = []
        for key, given in (("start", self.start), ("end", self.end)):
            if given is None:
                found.append(None)
                continue
            pressures = np.array(given.pressures, dtype=float)
            if len(pressures) != len(lower):
                raise self.error_at(
                    f"{key}.pressures",
                    f"has {len(pressures)} values; expected {len(lower)}, one for each channel of "
                    "the robot, proximal segment first",
                )
            for index in np.flatnonzero((pressures < lower) | (pressures > upper)):
                raise self.error_at(
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

    def _lengths(self, curve: Curve) -> Array:
        """Return the arc lengths (N,) of the points."""
        if self.path.is_listed and isinstance(curve, Polyline):
            self._check_listed(curve)
            return curve.knots
        if (self.count is None) == (self.spacing is None):
            raise ValueError("needs the key points or spacing, and not both")
        least = 3 if self.closed or self.path.circle is not None else 2
        if self.count is not None:
            if self.count < least:
                raise BadKeyError("points", f"must be at least {least} on a path that is closed")
            return np.linspace(0.0, curve.length, self.count)
        steps = curve.length / (self.spacing or 1.0) * (1 - _ROUNDING)
        if steps > MAX_POINTS - 1:
            raise BadKeyError(
                "spacing",
                f"makes {steps + 1:.6g} points of {mm_text(curve.length)}; at most {MAX_POINTS} "
                "are allowed",
            )
        return np.linspace(0.0, curve.length, max(math.ceil(steps) + 1, least))

    def _check_listed(self, curve: Polyline) -> None:
        """Refuse too many listed points, or points too far apart."""
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
                f"is {mm_text(self.spacing)}, but points {index + 1} and {index + 2} of "
                f"path.{self.path.kind} are {mm_text(float(steps[index]))} apart",
            )

    def _times(self, lengths: Array) -> Array | None:
        table, timing = self.path.table, self.timing
        if table is not None and table.times is not None:
            if timing is not None:
                raise BadKeyError("timing", "is given by the column time_s too; remove one of them")
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
            with np.errstate(over="ignore"):
                return lengths / timing.speed
        if timing.times is None:
            return None
        times = np.array(timing.times, dtype=float)
        if len(times) != len(lengths):
            raise BadKeyError(
                "timing.times", f"has {len(times)} values; expected {len(lengths)}, one a point"
            )
        fault = fault_of_times(times)
        if fault is not None:
            raise BadKeyError(f"timing.times.{fault[0]}", fault[1])
        return times

    def _targets(self, positions: Array) -> tuple[Target, ...]:
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
        """Return a listed target with the path's tolerance and pointing or orientation."""
        update: dict[str, Any] = {}
        if "tolerance" not in target.model_fields_set:
            update["tolerance"] = self.tolerance
        if target.pointing is None and target.orientation is None:
            update |= own
        else:
            self._refuse_own("path.through")
        return target.model_copy(update=update)

    def _refuse_own(self, where: str) -> None:
        """Refuse the path's pointing or orientation where the points have their own."""
        for key in ("pointing", "orientation"):
            if getattr(self, key) is not None:
                raise BadKeyError(key, f"is given by {where} too; remove one of them")

    def _goals(self, tangents: Array) -> tuple[StiffnessGoal | None, ...]:
        if self.stiffness is None:
            return (None,) * len(tangents)
        turns = any(m.frame == "path" for m in self.stiffness.maximise)
        for index in np.flatnonzero(~tangents.any(axis=1)) if turns else ():
            raise BadKeyError(
                "stiffness.maximise",
                f"frame: path has no axes at point {index + 1}, where the path has no tangent",
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


def _check_ends(first: Target, last: Target) -> None:
    """Refuse a closed path that ends in another direction than it begins."""
    for key in ("pointing", "orientation"):
        before, after = getattr(first, key), getattr(last, key)
        if before is None or after is None:
            continue
        cosine = float(np.dot(before, after))
        if (cosine if key == "pointing" else abs(cosine)) < 1 - _ROUNDING:  # q and -q are the same
            raise BadKeyError(
                "closed", f"cannot be: the last point has another {key} than the first"
            )


def load_path(path: str | os.PathLike[str]) -> Path:
    """Read a path file.

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    """
    return read_file(path, "path", Path).model_copy(update={"source": FilePath(path)})
