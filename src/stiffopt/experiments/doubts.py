"""What in a recording makes one doubt it, though it is complete."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stiffopt.experiments.conductor import Array
from stiffopt.logs import Log

__all__ = ["doubts"]

_LAG = 0.5  # s that a regulator may take
_OFF = 5e3  # Pa by which it may be off after that
_SOME = 0.01  # share of the samples that may be worse
_GAP = 0.5  # s for which the tip may be out of sight
_LOST = 0.1  # share of the frames that may be missing


def doubts(logs: Sequence[Log]) -> tuple[str, ...]:
    """Return sentences on pressures that did not obey and on frames that did not come."""
    found = [*_disobedient(logs)]
    gap = max((_longest_gap(log) for log in logs), default=0.0)
    if gap > _GAP:
        found.append(f"the tip was out of sight for up to {gap:.1f} s")
    lost = max((_lost(log) for log in logs), default=0.0)
    if lost > _LOST:
        found.append(f"up to {100 * lost:.0f} % of a recording's frames are missing or without tip")
    return tuple(found)


def _disobedient(logs: Sequence[Log]) -> list[str]:
    worst: dict[int, float] = {}
    for log in logs:
        if log.measured is None or len(log.time) < 2:
            continue
        low, high = _recent_extremes(log.time, log.commanded)
        with np.errstate(invalid="ignore"):
            off = np.fmax(np.fmax(log.measured - high, low - log.measured), 0.0)  # (N, n)
        for channel in range(log.n):
            known = off[np.isfinite(off[:, channel]), channel]
            if len(known) and np.mean(known > _OFF) > _SOME:
                worst[channel] = max(worst.get(channel, 0.0), float(known.max()))
    return [
        f"the measured pressure of channel {channel + 1} was up to {off * 1e-5:.2f} bar away from "
        f"what had been commanded in the {_LAG:g} s before"
        for channel, off in sorted(worst.items())
    ]


def _recent_extremes(time: Array, commanded: Array) -> tuple[Array, Array]:
    """Least and greatest command (N, n) in the time that a regulator may take."""
    low, high = commanded.copy(), commanded.copy()
    rows = int(np.ceil(_LAG / max(float(np.median(np.diff(time))), 1e-3)))
    for back in range(1, min(rows, len(time) - 1) + 1):
        low[back:] = np.minimum(low[back:], commanded[:-back])
        high[back:] = np.maximum(high[back:], commanded[:-back])
    return low, high


def _seen(log: Log) -> Array:
    return log.time[np.isfinite(log.tip_position).all(axis=1)]


def _longest_gap(log: Log) -> float:
    seen = _seen(log)
    ends = np.concatenate(([log.time[0]], seen, [log.time[-1]])) if len(log.time) else np.zeros(1)
    return float(np.diff(ends).max()) if len(ends) > 1 else 0.0


def _lost(log: Log) -> float:
    """Share of the frames without tip, by the usual time between frames."""
    if len(log.time) < 3:
        return 0.0
    usual = float(np.median(np.diff(log.time)))
    expected = float(log.time[-1] - log.time[0]) / usual + 1
    return max(0.0, 1 - len(_seen(log)) / expected)
