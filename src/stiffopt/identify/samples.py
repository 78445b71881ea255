"""Which rows of a recording are compared with a model, and which its history cannot do without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.problem import Begin, Sample
from stiffopt.identify.recording import Recording, Track

__all__ = ["begins", "chosen_rows", "sample", "thinned"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

_STRAIGHT = 1e-3  # of the range of pressures: commands this near to a line are on it
_FINE = 0.04  # s; of commands that change in every row so many are kept as a lag can tell
_LONGEST_GAP = 64  # rows that are left out at once
_REST = 0.02  # of the range of pressures: below, an arm is at rest


def chosen_rows(recording: Recording, most: int) -> Rows:
    """Rows (M,) to compare: at most so many of those in which the tip was seen, evenly spread."""
    usable = np.flatnonzero(np.isfinite(recording.tracks[0].position).all(axis=1))
    if len(usable) <= most:
        return usable
    chosen: Rows = usable[np.linspace(0, len(usable) - 1, most).round().astype(np.intp)]
    return chosen


def thinned(recording: Recording, wanted: Rows, span: Array) -> tuple[Recording, Rows]:
    """The recording without rows that neither are wanted nor matter to the pressures' course.

    Returns
    -------
    recording, rows
        The latter are where the wanted rows (M,) are now.
    """
    count = len(recording.time)
    kept = np.zeros(count, dtype=bool)
    kept[wanted] = True
    kept[0] = kept[-1] = True
    p = recording.pressures / span
    gap = _LONGEST_GAP
    open_rows = np.ones(count, dtype=bool)  # not yet known to be on a line
    while gap > 1:
        begins = np.arange(0, count - 1, gap)
        ends = np.minimum(begins + gap, count - 1)
        block = np.repeat(np.arange(len(begins)), ends - begins)
        rows = np.arange(len(block))
        begun, width = recording.time[begins], recording.time[ends] - recording.time[begins]
        part = (recording.time[rows] - begun[block]) / width[block]
        line = p[begins][block] + (p[ends] - p[begins])[block] * part[:, np.newaxis]
        off = np.abs(p[rows] - line).max(axis=1)
        worst = np.maximum.reduceat(off, begins)
        straight = (worst <= _STRAIGHT) & open_rows[begins]
        open_rows[rows[straight[block]]] = False
        kept[begins[straight]] = True
        kept[ends[straight]] = True
        gap //= 4
    slot = np.floor(recording.time / _FINE)
    kept |= open_rows & np.append(slot[1:] != slot[:-1], True)
    position = np.cumsum(kept) - 1
    tracks = tuple(
        Track(
            track.name,
            track.position[kept],
            None if track.rotation is None else track.rotation[kept],
        )
        for track in recording.tracks
    )
    smaller = replace(
        recording,
        time=recording.time[kept],
        pressures=recording.pressures[kept],
        tracks=tracks,
    )
    return smaller, position[wanted]


def sample(recording: Recording, span: Array, most: int, begin: Begin) -> Sample:
    """Sample of at most so many rows of a recording."""
    rows = chosen_rows(recording, most)
    smaller, places = thinned(recording, rows, span)
    return Sample(smaller, places, np.ones(len(places)), begin)


def begins(recordings: Sequence[Recording], span: Array, sequence: bool) -> list[Begin]:
    """How each recording begins; in a sequence, each as the one before it ended."""
    found: list[Begin] = []
    for index, recording in enumerate(recordings):
        at_rest = bool((np.abs(recording.before) <= _REST * span).all())
        if sequence and index:
            found.append("previous")
        else:
            found.append("rest" if at_rest else "unknown")
    return found
