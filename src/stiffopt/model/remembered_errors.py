"""How far an arm answers to what its model has wrong at former pressures.

An arm with hysteresis remembers former pressures, and with them the discrepancy there
(`stiffopt.model.calibration.ErrorModel`).  How much it does is uncertain where the model has no
creep, since a fit may have taken creep for play: the present pressures count as if the plays
followed them, and the former ones as if they did not.  With creep in the model, plays follow, and
each creep forgets in its own time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, lagged

_MORE_MEMORY = 0.07  # of the pressure acts through hysteresis that no model has
_FADING = 30.0  # s in which an arm forgets former pressures, where the model has no creep for that


@dataclass(frozen=True, eq=False)
class RememberedErrors:
    """What the discrepancy at present and at former pressures does to the tip.

    Attributes
    ----------
    kept : shares (n,) of the channels' pressures that are still former ones.
    forgotten : shares (n,) of former pressures that count, by the time in s in which they fade.
    """

    kept: Array
    forgotten: Mapping[float, Array]

    @classmethod
    def of(cls, robot: RobotDescription, span: float) -> RememberedErrors:
        """Return those of a robot whose pressures move within a range of `span` Pa."""
        ends = np.cumsum([0, *(segment.n_channels for segment in robot.segments)])
        kept, rest = np.zeros(ends[-1]), np.zeros(ends[-1])
        forgotten: dict[float, Array] = {}
        for segment, (begin, end) in zip(robot.segments, pairwise(ends), strict=True):
            history = segment.history or NO_HISTORY
            following = _with_more(history.remembered_shares(end - begin, span))
            staying = _with_more(history.remembered_shares(end - begin))
            kept[begin:end] = following
            left = following if history.creep else staying
            memory = np.array([history.memory_of(channel) for channel in range(end - begin)])
            for creep in history.creep:
                share = np.minimum(creep.share * memory, left)
                forgotten.setdefault(creep.time, np.zeros(ends[-1]))[begin:end] += share
                left = left - share
            rest[begin:end] = left
        forgotten[_FADING] = forgotten.get(_FADING, 0.0) + rest
        return cls(kept, forgotten)

    def before(self, time: Array, moves: Array) -> Array:
        """Return mean squares (N, n), in m^2, by which errors at former pressures move the tip.

        At the pressures of the times (N,) in s they do so by `moves` (N, n). Before the first time,
        the arm was where it was then.
        """
        faded = (
            share * np.sqrt(lagged(time, moves, time_of_fading, moves[0]))
            for time_of_fading, share in self.forgotten.items()
        )
        return np.asarray(sum(faded) ** 2)

    def before_unknown(self, moves: Array) -> Array:
        """Return the same (n,) for pressures that are not known, with `moves` (n,) as usual."""
        return np.asarray(sum(self.forgotten.values()) ** 2 * moves)

    def even_variance(self, moves: Array, before: Array) -> Array:
        """Return the variance (N,) of each axis of the tip, in m^2, the same for all directions.

        Errors at the pressures of now and at former ones move the tip by mean squares `moves`
        (N, n) and `before` (N, n) or (n,).
        """
        return np.asarray(((1 - self.kept) ** 2 * moves + before).sum(axis=-1) / 3)


def _with_more(share: Array) -> Array:
    """Return shares of the pressures that act through hysteresis, with what no model has of it."""
    return share + (1 - share) * _MORE_MEMORY
