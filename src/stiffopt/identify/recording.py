"""A log becomes what a fit can use: checked, in one frame, without what was not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError, InputError, shown
from stiffopt.identify.orientations import (
    aligned,
    mean_rotation,
    rotations,
    unflipped,
    unit_quaternions,
)
from stiffopt.identify.plausibility import (
    check_excitation,
    check_lengths,
    check_pressures,
    check_time,
    counted,
)
from stiffopt.identify.screening import dropouts, jumps, norms, repeats, whole
from stiffopt.logs import Body, Log
from stiffopt.model.description import RobotDescription

__all__ = ["Recording", "Track", "aligned", "prepare"]

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

_MOST = 0.95  # share of the rows in which a frame must not have moved ...
_MOVED = 2e-3  # ... by this, in m
_TURNED = np.radians(2.0)  # ... or by this
_LATE = 0.15  # of the range; gauges are off by less, regulators in the first row by more
_TIP = "tip"
_UNUSED = "these are not used"


@dataclass(frozen=True, eq=False)
class Track:
    """A tracked point.

    Attributes
    ----------
    name : "tip" or a body's name.
    position : (N, 3), in m, in the frame of the recording; NaN where not to be used.
    rotation : (N, 3, 3), NaN where not to be used; None if no orientation was recorded.
    """

    name: str
    position: Array
    rotation: Array | None


@dataclass(frozen=True, eq=False)
class Recording:
    """A log as a fit uses it.

    Attributes
    ----------
    name : of the file.
    time : (N,), in s.
    pressures : (N, n), in Pa, in the order of the robot's channels; all finite.
    before : (n,), pressures in the arm when the log begins, in Pa. A log may begin with a step:
        commanded in its first row, where the measured pressure is still the old one.
    tracks : the tip first.
    remarks : what was found and what was done about it, one sentence each.
    """

    name: str
    time: Array
    pressures: Array
    before: Array
    tracks: tuple[Track, ...]
    remarks: tuple[str, ...]

    def track(self, name: str) -> Track:
        """Return the track of this name.

        Raises
        ------
        InputError
            There is none.
        """
        for track in self.tracks:
            if track.name == name:
                return track
        there = ", ".join(track.name for track in self.tracks)
        raise FileError(self.name, f"there is no track {shown(name)}; the tracks are {there}")


def prepare(
    log: Log,
    name: str,
    description: RobotDescription,
    *,
    channels: Sequence[int] | None = None,
    frame: str | None = None,
    bodies: Sequence[str] = (),
    pressures: Literal["commanded", "measured"] = "commanded",
) -> Recording:
    """Check a log and take out of it what a fit can use.

    Parameters
    ----------
    log :
        In SI units.
    name :
        Of the file, for messages.
    description :
        The robot whose arm was recorded; its length and its limits say what is plausible.
    channels :
        For each channel of the robot the log's column, from 1; None for the same order.
    frame :
        Body that does not move and in whose frame everything is expressed; None for the tracker's.
        Where its orientation was not recorded, positions are counted from it along the tracker's
        axes.
    bodies :
        Further bodies to keep as tracks.
    pressures :
        Which ones; a missing one is as the last before it (commanded) or on the line between its
        neighbours (measured).

    Raises
    ------
    InputError
        Columns or bodies are asked for that are not there; units are not SI; nothing moves; fewer
        than 20 rows can be used.
    """
    columns = _columns(log.n, channels, description.n_pressures)
    for body in (*bodies, *([frame] if frame is not None else [])):
        if body not in log.bodies:
            _no_body(name, body, log)
    if len(set(bodies)) < len(tuple(bodies)):
        raise InputError(f"a body is asked for twice: {', '.join(bodies)}")
    remarks = check_time(name, log.time)
    check_lengths(name, log, frame, description.length)
    p, found = _pressures(log, name, columns, pressures)
    remarks += found
    remarks += check_pressures(name, p, description)

    used = {_TIP: Body(log.tip_position, log.tip_quaternion)}
    used |= {body: log.bodies[body] for body in bodies}
    if frame is not None:
        used[frame] = log.bodies[frame]
    stale = _stale(log)
    remarks += counted(stale, log.time, "every tracker reading repeats the row before", _UNUSED)
    reach = _reach(p, description)
    tracks = {}
    for body, poses in used.items():
        tracks[body], found = _track(body, poses, stale, log.time, reach, description.length)
        remarks += found
    if frame is not None:
        tracks, found = _in_frame(name, tracks, frame)
        remarks += found
    kept = tuple(tracks[body] for body in (_TIP, *bodies))
    check_excitation(name, log.time, p, kept[0].position, description)
    before = _before(log, columns, p, description)
    return Recording(name, log.time, p, before, kept, remarks)


def _columns(there: int, channels: Sequence[int] | None, wanted: int) -> list[int]:
    """Return which column, from 0, each channel of the robot has."""
    if channels is None:
        if there != wanted:
            raise InputError(
                f"the log has {there} pressures and the robot {wanted} channels; say for each "
                f"channel of the robot which column of the log, from 1 to {there}, is its pressure"
            )
        return list(range(wanted))
    chosen = [int(column) for column in channels]
    if len(chosen) != wanted:
        raise InputError(
            f"{len(chosen)} columns of pressures are given for the {wanted} channels of the robot; "
            "expected one for each"
        )
    for column in chosen:
        if not 1 <= column <= there:
            raise InputError(
                f"there is no pressure column {column}; expected a number from 1 to {there}"
            )
        if chosen.count(column) > 1:
            raise InputError(
                f"the pressure column {column} is given for more than one channel of the robot; "
                "expected each once"
            )
    return [column - 1 for column in chosen]


def _no_body(name: str, body: str, log: Log) -> NoReturn:
    others = ", ".join(log.bodies)
    there = f"the bodies there are {others}" if others else "there is none but the tip"
    raise FileError(name, f"there is no body {shown(body)}; {there}")


def _pressures(
    log: Log, name: str, columns: list[int], which: str
) -> tuple[Array, tuple[str, ...]]:
    """Return pressures (N, n) without gaps."""
    if which == "measured":
        if log.measured is None:
            raise FileError(name, "has no measured pressures; expected columns pm1_pa, ...")
        p = log.measured[:, columns]
    elif which == "commanded":
        p = log.commanded[:, columns]
    else:
        raise InputError(f"expected commanded or measured pressures, not {shown(which)}")
    known = np.isfinite(p)
    for channel in np.flatnonzero(~known.any(axis=0)):
        raise FileError(name, f"every {which} pressure of column {columns[channel] + 1} is missing")
    filled = p.copy()
    for channel in np.flatnonzero(~known.all(axis=0)):
        at = np.flatnonzero(known[:, channel])
        if which == "measured":
            filled[:, channel] = np.interp(log.time, log.time[at], p[at, channel])
        else:
            last = np.searchsorted(at, np.arange(len(p)), side="right") - 1
            filled[:, channel] = p[at[np.maximum(last, 0)], channel]
    how = "from the rows before and after" if which == "measured" else "as in the last row with one"
    missing = ~whole(p)
    return filled, counted(missing, log.time, f"a {which} pressure is missing", f"taken {how}")


def _before(log: Log, columns: list[int], pressures: Array, description: RobotDescription) -> Array:
    """Return pressures (n,) in the arm at the first row: measured, where they are far from it."""
    first: Array = pressures[0].copy()
    if log.measured is None:
        return first
    measured = log.measured[0, columns]
    span = np.subtract(description.pressure_max, description.pressure_min)
    late = np.abs(measured - first) > _LATE * span  # not where it is missing
    first[late] = measured[late]
    return first


def _stale(log: Log) -> Rows:
    """Say which rows (N,) hold no new reading of any body."""
    everything = [Body(log.tip_position, log.tip_quaternion), *log.bodies.values()]
    tracked = [body.position for body in everything]
    tracked += [body.quaternion for body in everything if body.quaternion is not None]
    if len(tracked) == 1 or not len(log):
        return np.zeros(len(log), dtype=bool)  # one point that rests repeats itself
    return repeats(tracked)


def _reach(pressures: Array, description: RobotDescription) -> Array:
    """How far (N,) the changes of pressure until then may have moved the tip altogether, in m.

    The whole range of a channel moves it by no more than about the length of the arm.
    """
    span = np.subtract(description.pressure_max, description.pressure_min)
    change = np.abs(np.diff(pressures, axis=0)) / span
    return description.length * np.concatenate(([0.0], np.cumsum(change.sum(axis=1))))


def _track(
    name: str, body: Body, stale: Rows, time: Array, reach: Array, length: float
) -> tuple[Track, tuple[str, ...]]:
    """Return the track in the tracker's frame, and remarks."""
    position = body.position.copy()
    missing = ~whole(position)
    position[missing | stale] = np.nan
    nowhere = dropouts(position, length)
    position[nowhere] = np.nan
    jumped = jumps(time, position, reach, length)
    position[jumped] = np.nan
    remarks = (
        *counted(missing, time, f"the position of {name} is missing"),
        *counted(nowhere, time, f"the position of {name} is zero or impossible", _UNUSED),
        *counted(jumped, time, f"the position of {name} jumps and comes back", _UNUSED),
    )
    if body.quaternion is None:
        return Track(name, position, None), remarks
    quaternion = unit_quaternions(body.quaternion)
    missing = ~whole(quaternion)
    quaternion[stale | nowhere | jumped] = np.nan
    turns = unflipped(quaternion, position, length)
    flips = np.zeros(len(time), dtype=bool)
    flips[turns.flips] = True
    remarks += (
        *counted(missing, time, f"the orientation of {name} is missing"),
        *counted(
            flips, time, f"the orientation of {name} flips about the body's own axes", "undone"
        ),
        *counted(
            turns.stray, time, f"the orientation of {name} agrees with no row near it", _UNUSED
        ),
    )
    return Track(name, position, rotations(turns.quaternion)), remarks


def _in_frame(
    name: str, tracks: dict[str, Track], frame: str
) -> tuple[dict[str, Track], tuple[str, ...]]:
    """Express tracks in the mean frame of a body that does not move."""
    body = tracks[frame]
    seen = whole(body.position)
    if not seen.any():
        raise FileError(name, f"no position of {frame}, the frame, can be used")
    origin = np.median(body.position[seen], axis=0)
    away = norms(body.position[seen] - origin)
    axes, turned = np.eye(3), np.zeros(1)
    if body.rotation is not None:
        known = body.rotation[np.isfinite(body.rotation).all(axis=(1, 2))]
        if not len(known):
            raise FileError(name, f"no orientation of {frame}, the frame, can be used")
        axes = mean_rotation(known)
        size = norms((known - axes).reshape(-1, 9))  # sqrt(8) sin(angle / 2)
        turned = 2 * np.arcsin(np.minimum(size / np.sqrt(8), 1.0))
    moves, turns = float(np.quantile(away, _MOST)), float(np.quantile(turned, _MOST))
    remarks: tuple[str, ...] = ()
    if moves > _MOVED or turns > _TURNED:
        remarks = (
            f"{frame}, in whose frame everything is expressed, moves by {moves * 1e3:.1f} mm and "
            f"{np.degrees(turns):.1f} degrees about its mean; it is taken to be at rest",
        )
    moved = {
        track.name: Track(
            track.name,
            np.einsum("nj,ji->ni", track.position - origin, axes),
            None if track.rotation is None else np.einsum("ji,njk->nik", axes, track.rotation),
        )
        for track in tracks.values()
    }
    return moved, remarks
