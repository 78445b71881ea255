"""Whether a recording can be one of a given arm, in SI units, from which something is learnt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError
from stiffopt.identify.screening import MEDIAN_NORM, norms, roughness, whole
from stiffopt.logs import Log
from stiffopt.model.description import RobotDescription

__all__ = ["check_excitation", "check_lengths", "check_pressures", "check_time", "counted"]

Array = NDArray[np.float64]

_PRESSURE_UNITS = {"MPa": 1e6, "bar": 1e5, "psi": 6894.757, "kPa": 1e3, "mbar": 1e2}
_TINY = 0.01  # share of the limits that pressures in Pa exceed
_BEYOND = 0.1  # share of a channel's range beyond its limits
_IDLE = 0.02  # share of a channel's range
_FAR = 100.0  # lengths of the arm
_WIDE = 10.0  # the same
_SLOW = 60.0  # s from row to row, in the median
_LONG = 5.0  # the same where all times are whole numbers
_ROWS = 20
_NOISES = 3.0
_STILL = 1e-3  # lengths of the arm
_UNEXPLAINED = 0.8  # share of its spread that noise keeps after a regression on the pressures
_SHOWN = 3  # times that a remark names


def counted(
    rows: NDArray[np.bool_], time: Array, what: str, done: str | None = None
) -> tuple[str, ...]:
    """Return a sentence on rows (N,), with their number and their first times; none if none."""
    at = np.flatnonzero(rows)
    if not len(at):
        return ()
    times = ", ".join(f"{time[i]:.6g}" for i in at[:_SHOWN])
    more = ", ..." if len(at) > _SHOWN else ""
    end = f"; {done}" if done else ""
    return (f"{what} in {len(at)} row{'s' * (len(at) > 1)} (at {times}{more} s){end}",)


def check_time(name: str, time: Array) -> tuple[str, ...]:
    """Return a remark if times look like milliseconds.

    Raises
    ------
    InputError
        There are too few rows.
    """
    if len(time) < _ROWS:
        raise FileError(name, f"has {len(time)} rows; expected at least {_ROWS}")
    step = float(np.median(np.diff(time)))
    if step > (_LONG if np.all(time == np.round(time)) else _SLOW):
        return (
            f"rows are {step:g} s apart; if these are milliseconds, time_s must be divided by 1000",
        )
    return ()


def check_lengths(name: str, log: Log, frame: str | None, length: float) -> None:
    """Refuse positions that cannot be in m.

    Raises
    ------
    InputError
        The tip moves over 10 lengths of the arm, or is 100 away from the body that is the frame.
    """
    tip = log.tip_position
    seen = whole(tip) & np.any(tip != 0, axis=1)  # zeros may stand for none
    if not seen.any():
        raise FileError(name, "the position of tip is missing in every row")
    low, high = np.quantile(tip[seen], (0.1, 0.9), axis=0)
    over = float(np.linalg.norm(high - low))
    if over > _WIDE * length:
        raise FileError(name, f"the tip moves over {over:.3g} m, {_mm(length)}")
    if frame is None:
        return
    apart = norms(tip - log.bodies[frame].position)[seen]
    far = float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else 0.0
    if far > _FAR * length:
        raise FileError(name, f"the tip is {far:.3g} m away from {frame}, {_mm(length)}")


def _mm(length: float) -> str:
    return f"and the robot is {length:.3g} m long; the positions look like mm, expected m"


def check_pressures(name: str, pressures: Array, description: RobotDescription) -> tuple[str, ...]:
    """Return remarks on pressures (N, n) beyond the limits and on channels that are not used.

    Raises
    ------
    InputError
        They do not look like Pa; no channel is used.
    """
    low, high = np.array(description.pressure_min), np.array(description.pressure_max)
    limit = np.maximum(np.abs(low), np.abs(high))
    share = float(np.max(np.max(np.abs(pressures), axis=0) / limit))
    if 0 < share < _TINY:
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
        if max(below, above) > _BEYOND * (high - low)[channel]:
            worst = p.max() if above > below else p.min()
            remarks.append(
                f"{description.channel_name(channel)} is at {worst * 1e-5:.3g} bar, beyond the "
                f"robot's limits of {low[channel] * 1e-5:g} to {high[channel] * 1e-5:g} bar"
            )
    idle = np.ptp(pressures, axis=0) <= _IDLE * (high - low)
    if idle.all():
        raise FileError(
            name,
            f"no pressure moves by more than {100 * _IDLE:g} % of its range; "
            "expected a recording in which they do",
        )
    if idle.any():
        names = ", ".join(description.channel_name(c) for c in np.flatnonzero(idle).tolist())
        remarks.append(
            f"nothing is learnt about {names}, as the pressure there never moves by more than "
            f"{100 * _IDLE:g} % of its range"
        )
    return tuple(remarks)


def check_excitation(
    name: str, time: Array, pressures: Array, tip: Array, description: RobotDescription
) -> None:
    """Refuse a recording (N rows) in which too little can be used or the tip does not move.

    Raises
    ------
    InputError
        Fewer than 20 positions of the tip (N, 3) are left, or they are noise.
    """
    seen = whole(tip)
    if seen.sum() < _ROWS:
        raise FileError(
            name, f"{seen.sum()} of {len(tip)} rows can be used; expected at least {_ROWS}"
        )
    position = tip[seen]
    spread = float(np.sqrt(np.sum(np.var(position, axis=0))))
    # white noise is sqrt(3/2) times as far from the line between its neighbours as from its mean
    rough = float(np.median(roughness(time[seen], position))) / MEDIAN_NORM * np.sqrt(3)
    noise = rough / np.sqrt(3 / 2)
    before = np.vstack([pressures[:1], pressures[:-1]])
    causes = np.hstack([pressures, before])[seen] / np.max(np.abs(pressures))
    moves = spread > _NOISES * noise or _follows(causes, position)
    if spread < _STILL * description.length or not moves:
        raise FileError(
            name,
            f"the tip does not move: its positions vary by {spread * 1e3:.2g} mm, of which "
            f"{min(noise, spread) * 1e3:.2g} mm are noise; expected motion well above that",
        )


def _follows(causes: Array, position: Array) -> bool:
    """Say whether positions (N, 3) depend on causes (N, m): rows may be far apart, but no noise."""
    known = np.column_stack([np.ones(len(causes)), causes])
    solution, _, rank, _ = np.linalg.lstsq(known, position, rcond=1e-6)
    freedom = max(len(position) - int(rank), 1)
    rest = np.sum((position - known @ solution) ** 2) / freedom
    total = np.sum(np.var(position, axis=0, ddof=1))
    return bool(rest < _UNEXPLAINED**2 * total)
