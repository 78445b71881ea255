"""How well a robot file predicts logs that it may not have seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.identify.comparison import Comparison
from stiffopt.identify.fit import fit
from stiffopt.identify.problem import Noise, Point, Predicted, Problem, Sample, Unknowns
from stiffopt.identify.recording import Recording, Track, aligned
from stiffopt.identify.samples import begins, chosen_rows, thinned
from stiffopt.identify.unknowns import Unknown, side_unknowns, zero_unknowns
from stiffopt.model.description import Recordings, RobotDescription, Tolerances

__all__ = ["compare", "points_of"]

Array = NDArray[np.float64]

MOST_ROWS = 50_000  # of a log that are compared; more say nothing more
SETTLE = 2.0  # s, in which the state of an arm that does not begin at rest is estimated
_NOISE = Noise(1e-3, np.radians(2.0))  # of that estimate


def compare(
    description: RobotDescription,
    recordings: Sequence[Recording],
    *,
    sequence: bool = False,
    rezero: bool = False,
    settle: float = SETTLE,
    most: int = MOST_ROWS,
    tell: Callable[[], None] = lambda: None,
) -> tuple[Comparison, ...]:
    """Run a model along recordings.

    Parameters
    ----------
    description : RobotDescription
    recordings : sequence of Recording
        In the order in which they were made.
    sequence : bool
        Whether each begins in the state in which the one before ended.
    rezero : bool
        Whether positions are counted anew in each recording.
    settle : float
        Time in s at the beginning of a recording from which its zero and its state are estimated.
    most : int
        Rows of a recording that are compared.
    """
    span = np.subtract(description.pressure_max, description.pressure_min)
    points = points_of(description, recordings)
    base = placements(description).registration.tracker_in_base.inverse()
    states = begins(recordings, span, sequence)
    samples, kept = [], []
    for recording, begin in zip(recordings, states, strict=True):
        every = np.arange(len(recording.time))
        rows = every if len(every) <= most else chosen_rows(recording, span, most)
        smaller, places = thinned(recording, rows, span)
        samples.append(Sample(smaller, places, np.ones(len(places)), begin))
        kept.append(rows)
    samples = oriented(description, samples, points, base)
    unknowns, x = _beginnings(description, samples, points, base, rezero, settle, tell)
    predicted = Problem(description, unknowns, samples, points, base, _NOISE).predict(x)
    starts = np.cumsum([0, *(len(sample.rows) for sample in samples)])
    return tuple(
        _comparison(description, recording, rows, predicted, slice(begin, end), points[0])
        for recording, rows, begin, end in zip(
            recordings, kept, starts[:-1], starts[1:], strict=True
        )
    )
