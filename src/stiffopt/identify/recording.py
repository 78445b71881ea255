"""Turn a log into a `Recording`: check it, remove faulty readings, express poses in one frame.

`prepare` refuses a log that cannot come from the given arm in SI units, or that holds nothing to
learn from. It reports doubtful findings as remarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, FileError, InputError, PressureError, shown
from stiffopt.identify.settings import DETECTION, PLAUSIBLE
from stiffopt.identify.tracker_faults import (
    MEDIAN_NORM,
    dropouts,
    jumps,
    mean_rotation,
    norms,
    repeats,
    rotations,
    roughness,
    unflipped,
    unit_quaternions,
    whole,
)
from stiffopt.logs import Body, Log
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

Rows = NDArray[np.bool_]

_PRESSURE_UNITS = {"MPa": 1e6, "bar": 1e5, "psi": 6894.757, "kPa": 1e3, "mbar": 1e2}
FRAME = "frame"
"""Value of `Recording.anew` if the frame was defined anew, and not a body."""
_TIP = "tip"
_UNUSED = "these are not used"


@dataclass(frozen=True, eq=False)
class Track:
    """Poses of a tracked point over time.

    Attributes
    ----------
    name : "tip" or a body's name.
    position : (N, 3), in m, in the frame of the recording; NaN in rows that must not be used.
    rotation : (N, 3, 3), NaN in rows that must not be used; None if no orientation was recorded.
    """

    name: str
    position: Array
    rotation: Array | None


@dataclass(frozen=True, eq=False)
class Recording:
    """A log, checked and cleaned for a fit.

    Attributes
    ----------
    name : of the file.
    time : (N,), in s.
    pressures : (N, n), in Pa, in the order of the robot's channels; all finite.
    before : (n,), pressures in the arm when the log begins, in Pa. They differ from the first row
        if the log begins with a commanded step that the measured pressures have yet to follow.
    tracks : the tip first.
    remarks : findings and how each was handled, one sentence each.
    anew : "frame" or the name of a track if its definition was new in this log, so that its poses
        were moved to about where it was before.
    """

    name: str
    time: Array
    pressures: Array
    before: Array
    tracks: tuple[Track, ...]
    remarks: tuple[str, ...]
    anew: str | None = None

    def track(self, name: str) -> Track:
        """Return the track of this name; raise `FileError` if there is none."""
        for track in self.tracks:
            if track.name == name:
                return track
        available = ", ".join(track.name for track in self.tracks)
        raise FileError(self.name, f"there is no track {shown(name)}; the tracks are {available}")


def prepare(
    log: Log,
    name: str,
    description: RobotDescription,
    *,
    channels: Sequence[int] | None = None,
    frame: str | None = None,
    bodies: Sequence[str] = (),
    pressures: Literal["commanded", "measured"] = "commanded",
    keep_units: bool = False,
) -> Recording:
    """Check a log and extract the rows and readings that a fit can use.

    Parameters
    ----------
    log : in SI units.
    name : of the file, for messages.
    description : the robot whose arm was recorded; its length and limits decide what is plausible.
    channels : the log's column, from 1, of each channel of the robot; None for the same order.
    frame : a body at rest, in whose frame all poses are expressed; None for the tracker's frame.
        If its orientation was not recorded, it is only the origin; the axes are the tracker's.
    bodies : further bodies to keep as tracks.
    pressures : which to use. A missing commanded pressure repeats the last one; a missing measured
        pressure is interpolated.
    keep_units : refuse pressures in a unit other than Pa. By default they are converted if only
        one unit is plausible.

    Raises
    ------
    InputError
        The log lacks a column or a body; units are not SI; nothing moves; fewer
        than 20 rows can be used.
    """
    columns = _columns(log.n, channels, description.n_pressures)
    for body in (*bodies, *([frame] if frame is not None else [])):
        if body not in log.bodies:
            others = ", ".join(log.bodies)
            available = f"the bodies there are {others}" if others else "there is none but the tip"
            raise FileError(name, f"there is no body {shown(body)}; {available}")
    if len(set(bodies)) < len(tuple(bodies)):
        raise InputError(f"a body is named twice: {', '.join(bodies)}")
    remarks = _check_time(name, log.time)
    _check_lengths(name, log, frame, description.length)
    p, found = _pressures(log, name, columns, pressures)
    remarks += found
    unit = None if keep_units else _unit(p, log.tip_position, description)
    if unit is not None:
        factor = _PRESSURE_UNITS[unit]
        measured = None if log.measured is None else factor * log.measured
        log = replace(log, commanded=factor * log.commanded, measured=measured)
        p = factor * p
        remarks += (
            f"the pressures are in {unit}, not Pa: the largest is {p.max() / factor:.4g}, and only "
            "in this unit does the robot file's arm move about as far as the tip did; --keep units "
            "refuses them",
        )
    remarks += _check_pressures(name, p, description)

    used = {_TIP: Body(log.tip_position, log.tip_quaternion)}
    used |= {body: log.bodies[body] for body in bodies}
    if frame is not None:
        used[frame] = log.bodies[frame]
    stale = _stale(log)
    remarks += _counted(stale, log.time, "every tracker reading repeats the row before", _UNUSED)
    reach = _reach(p, description)
    tracks = {}
    for body, poses in used.items():
        tracks[body], found = _track(body, poses, stale, log.time, reach, description.length)
        remarks += found
    if frame is not None:
        tracks, found = _in_frame(name, tracks, frame)
        remarks += found
    kept = tuple(tracks[body] for body in (_TIP, *bodies))
    _check_excitation(name, log.time, p, kept[0].position, description)
    before = _before(log, columns, p, description)
    return Recording(name, log.time, p, before, kept, remarks)


def _columns(available: int, channels: Sequence[int] | None, wanted: int) -> list[int]:
    """Return the log's column, from 0, of each channel of the robot."""
    if channels is None:
        if available != wanted:
            raise InputError(
                f"the log has {available} pressures and the robot {wanted} channels; say for each "
                f"channel of the robot which column of the log, from 1 to {available}, is its "
                "pressure"
            )
        return list(range(wanted))
    chosen = [int(column) for column in channels]
    if len(chosen) != wanted:
        raise InputError(
            f"{len(chosen)} columns of pressures are given for the {wanted} channels of the robot; "
            "expected one for each"
        )
    for column in chosen:
        if not 1 <= column <= available:
            raise InputError(
                f"there is no pressure column {column}; expected a number from 1 to {available}"
            )
        if chosen.count(column) > 1:
            raise InputError(
                f"the pressure column {column} is given for more than one channel of the robot; "
                "expected each once"
            )
    return [column - 1 for column in chosen]


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
    return filled, _counted(missing, log.time, f"a {which} pressure is missing", f"taken {how}")


def _before(log: Log, columns: list[int], pressures: Array, description: RobotDescription) -> Array:
    """Return pressures (n,) in the arm at the first row.

    These are the first pressures, except where the measured ones are still far from them.
    """
    first: Array = pressures[0].copy()
    if log.measured is None:
        return first
    measured = log.measured[0, columns]
    span = np.subtract(description.pressure_max, description.pressure_min)
    late = np.abs(measured - first) > PLAUSIBLE.late * span  # False for a missing (NaN) reading
    first[late] = measured[late]
    return first


def _stale(log: Log) -> Rows:
    """Return which rows (N,) hold no new reading of any body."""
    everything = [Body(log.tip_position, log.tip_quaternion), *log.bodies.values()]
    tracked = [body.position for body in everything]
    tracked += [body.quaternion for body in everything if body.quaternion is not None]
    if len(tracked) == 1 or not len(log):
        return np.zeros(len(log), dtype=bool)  # a single point at rest repeats legitimately
    return repeats(tracked)


def _reach(pressures: Array, description: RobotDescription) -> Array:
    """Return the longest way (N,), in m, that the pressures so far can have moved the tip.

    A channel's whole range is taken to move the tip by at most the arm's length.
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
        *_counted(missing, time, f"the position of {name} is missing"),
        *_counted(nowhere, time, f"the position of {name} is zero or impossible", _UNUSED),
        *_counted(jumped, time, f"the position of {name} jumps and comes back", _UNUSED),
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
        *_counted(missing, time, f"the orientation of {name} is missing"),
        *_counted(
            flips, time, f"the orientation of {name} flips about the body's own axes", "undone"
        ),
        *_counted(
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
    moves, turns = (
        float(np.quantile(away, PLAUSIBLE.frame_share)),
        float(np.quantile(turned, PLAUSIBLE.frame_share)),
    )
    remarks: tuple[str, ...] = ()
    if moves > PLAUSIBLE.frame_moved or turns > PLAUSIBLE.frame_turned:
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


# plausibility -------------------------------------------------------------------------------------


def _counted(
    rows: NDArray[np.bool_], time: Array, what: str, done: str | None = None
) -> tuple[str, ...]:
    """Return a sentence with the number and first times of the rows (N,), or () for no rows."""
    at = np.flatnonzero(rows)
    if not len(at):
        return ()
    times = ", ".join(f"{time[i]:.6g}" for i in at[: PLAUSIBLE.times_shown])
    more = ", ..." if len(at) > PLAUSIBLE.times_shown else ""
    end = f"; {done}" if done else ""
    return (f"{what} in {len(at)} row{'s' * (len(at) > 1)} (at {times}{more} s){end}",)


def _check_time(name: str, time: Array) -> tuple[str, ...]:
    """Refuse too few rows, and return a remark if times look like milliseconds."""
    if len(time) < PLAUSIBLE.least_rows:
        raise FileError(name, f"has {len(time)} rows; expected at least {PLAUSIBLE.least_rows}")
    step = float(np.median(np.diff(time)))
    if step > (PLAUSIBLE.slow_integers if np.all(time == np.round(time)) else PLAUSIBLE.slow):
        return (
            f"rows are {step:g} s apart; if these are milliseconds, time_s must be divided by 1000",
        )
    return ()


def _check_lengths(name: str, log: Log, frame: str | None, length: float) -> None:
    """Refuse positions that cannot be in m, by the range of the tip and its distance."""
    tip = log.tip_position
    seen = whole(tip) & np.any(tip != 0, axis=1)  # zeros may mean "missing"
    if not seen.any():
        raise FileError(name, "the position of tip is missing in every row")
    low, high = np.quantile(tip[seen], (0.1, 0.9), axis=0)
    over = float(np.linalg.norm(high - low))
    if over > PLAUSIBLE.widest * length:
        raise FileError(name, f"the tip moves over {over:.3g} m, {_mm(length)}")
    if frame is None:
        return
    apart = norms(tip - log.bodies[frame].position)[seen]
    far = float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else 0.0
    if far > PLAUSIBLE.farthest * length:
        raise FileError(name, f"the tip is {far:.3g} m away from {frame}, {_mm(length)}")


def _mm(length: float) -> str:
    return f"and the robot is {length:.3g} m long; the positions look like mm, expected m"


def _unit(pressures: Array, tip: Array, description: RobotDescription) -> str | None:
    """Return the unit of pressures (N, n) that are too small for Pa, or None if it is unclear.

    With the right unit, the robot file's arm under its weight moves about as far as the tip did.
    """
    limit = np.maximum(np.abs(description.pressure_min), np.abs(description.pressure_max))
    share = float(np.max(np.max(np.abs(pressures), axis=0) / limit))
    seen = np.flatnonzero(whole(tip))
    if not 0 < share < PLAUSIBLE.tiny_pressure or len(seen) < PLAUSIBLE.least_rows:
        return None
    rows = seen[np.linspace(0, len(seen) - 1, min(len(seen), DETECTION.rows)).astype(int)]
    moved = np.sqrt(np.var(tip[rows], axis=0).sum())
    arm = Manipulator(description.model_copy(update={"calibration": None}))
    fitting = []
    for unit, factor in _PRESSURE_UNITS.items():
        if share * factor > 1 + PLAUSIBLE.beyond:
            continue
        try:
            expected = arm.tip_pose(factor * pressures[rows])[:, :3, 3]
        except (EquilibriumError, PressureError):  # the arm does not bear these pressures
            continue
        ratio = np.sqrt(np.var(expected, axis=0).sum()) / max(moved, 1e-9)
        if 1 / DETECTION.unit < ratio < DETECTION.unit:
            fitting.append(unit)
    return fitting[0] if len(fitting) == 1 else None


def _check_pressures(name: str, pressures: Array, description: RobotDescription) -> tuple[str, ...]:
    """Refuse pressures (N, n) that are not in Pa or never change; return remarks on odd ones."""
    low, high = np.array(description.pressure_min), np.array(description.pressure_max)
    limit = np.maximum(np.abs(low), np.abs(high))
    largest = np.max(np.abs(pressures), axis=0)
    share = float(np.max(largest / limit))
    in_another_unit = share < PLAUSIBLE.tiny_pressure
    span = largest if in_another_unit else high - low
    idle = np.ptp(pressures, axis=0) <= PLAUSIBLE.idle * span
    if idle.all():
        raise FileError(
            name,
            f"no pressure moves by more than {100 * PLAUSIBLE.idle:g} % of its range; "
            "expected a recording in which they do",
        )
    if in_another_unit:
        near = {unit: share * factor for unit, factor in _PRESSURE_UNITS.items()}
        unit = max((u for u in near if near[u] < 1.2), key=near.__getitem__, default="kPa")
        raise FileError(
            name,
            f"the largest pressure is {np.max(np.abs(pressures)):g} Pa, {100 * share:.2g} % of "
            f"the robot's limit; the pressures look like {unit}, expected Pa",
        )
    remarks = []
    for channel, p in enumerate(pressures.T):
        below, above = low[channel] - p.min(), p.max() - high[channel]
        if max(below, above) > PLAUSIBLE.beyond * (high - low)[channel]:
            worst = p.max() if above > below else p.min()
            remarks.append(
                f"{description.channel_name(channel)} is at {worst * 1e-5:.3g} bar, beyond the "
                f"robot's limits of {low[channel] * 1e-5:g} to {high[channel] * 1e-5:g} bar"
            )
    if idle.any():
        names = ", ".join(description.channel_name(c) for c in np.flatnonzero(idle).tolist())
        remarks.append(
            f"nothing is learnt about {names}, as the pressure there never moves by more than "
            f"{100 * PLAUSIBLE.idle:g} % of its range"
        )
    return tuple(remarks)


def _check_excitation(
    name: str, time: Array, pressures: Array, tip: Array, description: RobotDescription
) -> None:
    """Refuse a recording in which too few positions (N, 3) are left or the tip does not move."""
    seen = whole(tip)
    if seen.sum() < PLAUSIBLE.least_rows:
        raise FileError(
            name,
            f"{seen.sum()} of {len(tip)} rows can be used; "
            f"expected at least {PLAUSIBLE.least_rows}",
        )
    position = tip[seen]
    spread = float(np.sqrt(np.sum(np.var(position, axis=0))))
    # white noise is sqrt(3/2) times as far from the line between its neighbours as from its mean
    rough = float(np.median(roughness(time[seen], position))) / MEDIAN_NORM * np.sqrt(3)
    noise = rough / np.sqrt(3 / 2)
    before = np.vstack([pressures[:1], pressures[:-1]])
    causes = np.hstack([pressures, before])[seen] / np.max(np.abs(pressures))
    moves = spread > PLAUSIBLE.noise_factor * noise or _follows(causes, position)
    if spread < PLAUSIBLE.still * description.length or not moves:
        raise FileError(
            name,
            f"the tip does not move: its positions vary by {spread * 1e3:.3f} mm, of which "
            f"{min(noise, spread) * 1e3:.3f} mm are noise; expected motion well above that",
        )


def _follows(causes: Array, position: Array) -> bool:
    """Return whether a linear regression on causes (N, m) explains positions (N, 3).

    Unlike the comparison with the neighbours, this works for rows that are far apart in time.
    """
    known = np.column_stack([np.ones(len(causes)), causes])
    solution, _, rank, _ = np.linalg.lstsq(known, position, rcond=1e-6)
    freedom = max(len(position) - int(rank), 1)
    rest = np.sum((position - known @ solution) ** 2) / freedom
    total = np.sum(np.var(position, axis=0, ddof=1))
    return bool(rest < PLAUSIBLE.unexplained**2 * total)
