"""The column names of a log (log v1)."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError, shown

Array = NDArray[np.float64]


_TIME = "time_s"
_AXES = ("x", "y", "z")
_PARTS = ("qw", "qx", "qy", "qz")
_BODY = re.compile(r"([a-z][a-z0-9]*(?:_[a-z0-9]+)*)_(?:[xyz]_m|q[wxyz])")


@dataclass(frozen=True)
class LogLayout:
    """Which columns a log has.

    Attributes
    ----------
    n : number of channels.
    measured : whether pressures were measured.
    tip_quaternion : whether the tip's orientation was tracked.
    bodies : names of further bodies, and whether their orientation was tracked.
    force, stage : whether a probe's force and its place were recorded.
    """

    n: int
    measured: bool = False
    tip_quaternion: bool = False
    bodies: Mapping[str, bool] = field(default_factory=dict)
    force: bool = False
    stage: bool = False

    @property
    def parts(self) -> dict[str, list[str]]:
        """Columns of each quantity, in the order in which they are written.

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
        """Names of the columns in the order in which they are written."""
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
        """Return the layout of a file that has these columns, in any order.

        It raises `FileError` if a column is missing, there twice or unknown.
        """
        names = set(columns)
        for name in columns:
            if columns.count(name) > 1:
                raise FileError(path, f"the column {shown(name)} is there twice", line=1)
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
            raise FileError(path, _unknown(unknown[0], wanted), line=1)
        return layout


def _pressures(prefix: str, n: int) -> list[str]:
    return [f"{prefix}{k + 1}_pa" for k in range(n)]


def _missing(name: str, unknown: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, unknown, n=1)
    hint = f" (is {shown(near[0])} meant to be that?)" if near else ""
    return f"the column '{name}' is missing{hint}; a log starts with a row of names"


def _unknown(name: str, wanted: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, [*wanted, "force_n", "stage_m"], n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"the columns here are {', '.join(wanted)}"
    return f"unknown column {shown(name)}; {hint}"
