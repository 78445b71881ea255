"""A log in memory: pressures and poses of an arm over time, and the columns of its files."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.arrays import Array
from stiffopt.errors import FileError, InputError, shown

_TIME = "time_s"
_AXES = ("x", "y", "z")
_PARTS = ("qw", "qx", "qy", "qz")
_UNITS = {"s": "s", "pa": "Pa", "m": "m", "n": "N"}  # by the ends of names
_SHOWN = 6  # names of a message
_PRESSURE = re.compile(r"pm?\d+_pa")
_BODY = re.compile(r"([a-z][a-z0-9]*(?:_[a-z0-9]+)*)_(?:[xyz]_m|q[wxyz])")


@dataclass(frozen=True)
class LogLayout:
    """The columns of a log.

    Attributes
    ----------
    n : number of channels.
    measured : whether pressures were measured.
    tip_quaternion : whether the tip's orientation was tracked.
    bodies : names of further bodies, and whether their orientation was tracked.
    force, stage : whether a probe's force and position were recorded.
    """

    n: int
    measured: bool = False
    tip_quaternion: bool = False
    bodies: Mapping[str, bool] = field(default_factory=dict)
    force: bool = False
    stage: bool = False

    @property
    def parts(self) -> dict[str, list[str]]:
        """Columns of each quantity, in the order of writing.

        The keys are ``time``, ``commanded``, ``measured``, ``BODY position``, ``BODY quaternion``
        (the tip is a body), ``force`` and ``stage``.
        """
        parts = {"time": [_TIME], "commanded": _pressures("p", self.n)}
        if self.measured:
            parts["measured"] = _pressures("pm", self.n)
        for name, turns in {"tip": self.tip_quaternion, **self.bodies}.items():
            parts[f"{name} position"] = [f"{name}_{axis}_m" for axis in _AXES]
            if turns:
                parts[f"{name} quaternion"] = [f"{name}_{part}" for part in _PARTS]
        if self.force:
            parts["force"] = ["force_n"]
        if self.stage:
            parts["stage"] = ["stage_m"]
        return parts

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns in the order of writing."""
        return tuple(name for names in self.parts.values() for name in names)

    def split(self, values: Array) -> dict[str, Array]:
        """Return the values (..., m) of each part, from all values in the order of the columns."""
        found, end = {}, 0
        for name, columns in self.parts.items():
            found[name] = values[..., end : end + len(columns)]
            end += len(columns)
        return found

    @classmethod
    def of_columns(cls, path: str, columns: Sequence[str]) -> LogLayout:
        """Return the layout of a file with these columns, in any order.

        `FileError`: a column is missing, appears twice or is unknown.
        """
        names = set(columns)
        for name in columns:
            if columns.count(name) > 1:
                raise FileError(path, f"the column {shown(name)} appears twice", line=1)
        n = next(k for k in count() if f"p{k + 1}_pa" not in names)
        bodies = {}
        for found in filter(None, map(_BODY.fullmatch, columns)):
            if found[1] != "tip":
                bodies[found[1]] = bool({f"{found[1]}_{part}" for part in _PARTS} & names)
        layout = cls(
            n=max(n, 1),
            measured=any(re.fullmatch(r"pm\d+_pa", name) for name in names),
            tip_quaternion=bool({f"tip_{part}" for part in _PARTS} & names),
            bodies=bodies,
            force="force_n" in names,
            stage="stage_m" in names,
        )
        wanted = layout.columns
        unknown = [name for name in columns if name not in wanted]
        missing = [name for name in wanted if name not in names]
        if missing:
            raise FileError(path, _missing(missing[0], unknown), line=1)
        if unknown:
            raise FileError(path, _unknown(unknown[0], wanted, layout.n), line=1)
        return layout


@dataclass(frozen=True, eq=False)
class Body:
    """The poses of a tracked body over time.

    `position`: (N, 3), in m; NaN where missing. `quaternion`: (N, 4), w first; None if no
    orientation was recorded.
    """

    position: Array
    quaternion: Array | None = None


@dataclass(frozen=True, eq=False)
class Log:
    """A log: pressures and poses over time, in SI units; NaN where a value is missing.

    Attributes
    ----------
    time : (N,), in s, increasing; the steps are uneven.
    commanded : gauge pressures (N, n), in Pa.
    measured : gauge pressures (N, n), in Pa, or None.
    tip_position : (N, 3), in m, in the tracker's or the base frame.
    tip_quaternion : (N, 4), w first, or None.
    bodies : further tracked bodies.
    force : force (N,) of a probe on the tip along its axis, in N, or None.
    stage : position (N,) of the probe along its axis, in m, or None.
    """

    time: Array
    commanded: Array
    tip_position: Array
    tip_quaternion: Array | None = None
    measured: Array | None = None
    bodies: Mapping[str, Body] = field(default_factory=dict)
    force: Array | None = None
    stage: Array | None = None

    def __post_init__(self) -> None:
        rows = len(self.time)
        if self.commanded.ndim != 2 or not self.commanded.shape[1]:
            raise InputError("a log needs commanded pressures (N, n)")
        shapes: dict[str, tuple[Array | None, tuple[int, ...]]] = {
            "time": (self.time, (rows,)),
            "commanded": (self.commanded, (rows, self.n)),
            "measured": (self.measured, (rows, self.n)),
            "tip_position": (self.tip_position, (rows, 3)),
            "tip_quaternion": (self.tip_quaternion, (rows, 4)),
            "force": (self.force, (rows,)),
            "stage": (self.stage, (rows,)),
        }
        for name, body in self.bodies.items():
            shapes[f"{name}: position"] = (body.position, (rows, 3))
            shapes[f"{name}: quaternion"] = (body.quaternion, (rows, 4))
        check_shapes(shapes)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.commanded.shape[1])

    @property
    def pressures(self) -> Array:
        """Measured pressures (N, n), in Pa; commanded ones where not measured."""
        if self.measured is None:
            return self.commanded
        return np.where(np.isfinite(self.measured), self.measured, self.commanded)

    @property
    def layout(self) -> LogLayout:
        """The columns of this log."""
        return LogLayout(
            n=self.n,
            measured=self.measured is not None,
            tip_quaternion=self.tip_quaternion is not None,
            bodies={name: body.quaternion is not None for name, body in self.bodies.items()},
            force=self.force is not None,
            stage=self.stage is not None,
        )

    def rows(self) -> Iterator[LogRow]:
        """Yield the log row by row."""
        for i in range(len(self)):
            yield LogRow(
                time=float(self.time[i]),
                commanded=self.commanded[i],
                measured=_row(self.measured, i),
                position=self.tip_position[i],
                quaternion=_row(self.tip_quaternion, i),
                bodies={
                    name: (body.position[i], _row(body.quaternion, i))
                    for name, body in self.bodies.items()
                },
                force=float(self.force[i]) if self.force is not None else np.nan,
                stage=float(self.stage[i]) if self.stage is not None else np.nan,
            )


@dataclass(frozen=True)
class LogRow:
    """One row of a `Log`; a missing value is None or NaN."""

    time: float
    commanded: ArrayLike
    measured: ArrayLike | None = None
    position: ArrayLike | None = None
    quaternion: ArrayLike | None = None
    bodies: Mapping[str, tuple[ArrayLike, ArrayLike | None]] = field(default_factory=dict)
    force: float = np.nan
    stage: float = np.nan

    def values(self, layout: LogLayout, after: float | None = None) -> Array:
        """Return the row as numbers (m,) in the order of the columns of a layout.

        Raises `InputError`: it does not fit the layout, has no time, or is not later than `after`,
        to 1 us.
        """
        if not np.isfinite(self.time) or (after is not None and round(self.time, 6) <= after):
            raise InputError(f"a row at {self.time:g} s cannot follow one at {after} s")
        given: dict[str, ArrayLike | None] = {
            "time": self.time,
            "commanded": self.commanded,
            "measured": self.measured,
            "force": self.force,
            "stage": self.stage,
        }
        for name, pose in {"tip": (self.position, self.quaternion), **self.bodies}.items():
            given[f"{name} position"], given[f"{name} quaternion"] = pose
        return np.concatenate(
            [numbers_of(name, given.get(name), len(c)) for name, c in layout.parts.items()]
        )


def log_of_values(values: Array, layout: LogLayout) -> Log:
    """Return the log whose columns (N, m) are in the order of a layout."""
    parts = {name: np.ascontiguousarray(part) for name, part in layout.split(values).items()}
    return Log(
        time=parts["time"][:, 0],
        commanded=parts["commanded"],
        measured=parts.get("measured"),
        tip_position=parts["tip position"],
        tip_quaternion=parts.get("tip quaternion"),
        bodies={
            name: Body(parts[f"{name} position"], parts.get(f"{name} quaternion"))
            for name in layout.bodies
        },
        force=parts["force"][:, 0] if layout.force else None,
        stage=parts["stage"][:, 0] if layout.stage else None,
    )


def check_shapes(shapes: Mapping[str, tuple[NDArray[Any] | None, tuple[int, ...]]]) -> None:
    """Raise `InputError` unless each array, by its name, has the given shape."""
    for name, (value, shape) in shapes.items():
        if value is not None and value.shape != shape:
            raise InputError(f"{name} must have the shape {shape}, not {value.shape}")


def _row(values: Array | None, i: int) -> Array | None:
    return values[i] if values is not None else None


def numbers_of(name: str, value: ArrayLike | None, size: int) -> Array:
    """Return a row's values of a part (size,); NaN for None and for values that are not finite."""
    if value is None:
        return np.full(size, np.nan)
    numbers = np.asarray(value, dtype=float).reshape(-1)
    if len(numbers) != size:
        raise InputError(f"{name} of a row must be {size} numbers, not {len(numbers)}")
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _pressures(prefix: str, n: int) -> list[str]:
    return [f"{prefix}{k + 1}_pa" for k in range(n)]


def _missing(name: str, unknown: Sequence[str]) -> str:
    misnamed = [each for each in unknown if not _PRESSURE.fullmatch(each)]
    near = difflib.get_close_matches(name, misnamed, n=1)
    if near:
        unit = _UNITS.get(name.rpartition("_")[2])
        in_unit = f", in {unit}" if unit else ""
        hint = f" (is {shown(near[0])} meant to be that{in_unit}?)"
    else:
        others = ", ".join(map(shown, misnamed[:_SHOWN]))
        hint = f"; nothing is known of {others}" if others else ""
    return f"the column '{name}' is missing{hint}; a log starts with a row of names"


def _unknown(name: str, wanted: Sequence[str], n: int) -> str:
    near = difflib.get_close_matches(name, [*wanted, f"p{n + 1}_pa", "force_n", "stage_m"], n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"the columns here are {', '.join(wanted)}"
    return f"unknown column {shown(name)}; {hint}"
