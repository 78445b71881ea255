"""A log in memory: pressures and poses of an arm over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import InputError
from stiffopt.logs.layout import Array, LogLayout


@dataclass(frozen=True, eq=False)
class Body:
    """The poses of a tracked body over time.

    Attributes
    ----------
    position : ndarray
        (N, 3), in m; NaN where it is missing.
    quaternion : ndarray or None
        (N, 4), w first; None if no orientation was recorded.
    """

    position: Array
    quaternion: Array | None = None


@dataclass(frozen=True, eq=False)
class Log:
    """A log: pressures and poses over time, in SI units; NaN where a value is missing.

    Attributes
    ----------
    time : ndarray
        (N,), in s, increasing; the steps are uneven.
    commanded : ndarray
        Gauge pressures (N, n), in Pa.
    measured : ndarray or None
        Gauge pressures (N, n), in Pa.
    tip_position : ndarray
        (N, 3), in m, in the tracker's or the base frame.
    tip_quaternion : ndarray or None
        (N, 4), w first.
    bodies : mapping of str to Body
        Further tracked bodies.
    force : ndarray or None
        Force (N,) with which a probe pushes the tip along its axis, in N.
    stage : ndarray or None
        Place (N,) of the probe along its axis, in m.
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
        count = len(self.time)
        if self.commanded.ndim != 2 or not self.commanded.shape[1]:
            raise InputError("a log needs commanded pressures (N, n)")
        shapes: dict[str, tuple[Array | None, tuple[int, ...]]] = {
            "time": (self.time, (count,)),
            "commanded": (self.commanded, (count, self.n)),
            "measured": (self.measured, (count, self.n)),
            "tip_position": (self.tip_position, (count, 3)),
            "tip_quaternion": (self.tip_quaternion, (count, 4)),
            "force": (self.force, (count,)),
            "stage": (self.stage, (count,)),
        }
        for name, body in self.bodies.items():
            shapes[f"{name}: position"] = (body.position, (count, 3))
            shapes[f"{name}: quaternion"] = (body.quaternion, (count, 4))
        check_shapes(shapes)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.commanded.shape[1])

    @property
    def pressures(self) -> Array:
        """Measured pressures (N, n), in Pa; commanded ones where none were measured."""
        if self.measured is None:
            return self.commanded
        return np.where(np.isfinite(self.measured), self.measured, self.commanded)

    @property
    def layout(self) -> LogLayout:
        """Which columns it has."""
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

        Raises
        ------
        InputError
            It does not fit the layout, has no time, or is not later than `after`, to 1 us.
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
    """Raise `InputError` unless each array, by its name, has the shape that stands beside it."""
    for name, (value, shape) in shapes.items():
        if value is not None and value.shape != shape:
            raise InputError(f"{name} must have the shape {shape}, not {value.shape}")


def _row(values: Array | None, i: int) -> Array | None:
    return values[i] if values is not None else None


def numbers_of(name: str, value: ArrayLike | None, count: int) -> Array:
    """Return what a row has for a part (count,): NaN for None and for what is not finite."""
    if value is None:
        return np.full(count, np.nan)
    numbers = np.asarray(value, dtype=float).reshape(-1)
    if len(numbers) != count:
        raise InputError(f"{name} of a row must be {count} numbers, not {len(numbers)}")
    return np.where(np.isfinite(numbers), numbers, np.nan)
