"""The way back: where the reference was a while ago, to which a doubted motion is taken back."""

from __future__ import annotations

from collections import deque

import numpy as np

from stiffopt.arrays import Array


class WayBack:
    """The latest places of the reference, with what feedback added to its commands.

    Parameters
    ----------
    ticks : for how many ticks they are kept.

    Attributes
    ----------
    goal : the place (n + 6,) to which the reference goes back; None while it does not.
    """

    def __init__(self, ticks: int) -> None:
        self._places: deque[tuple[Array, Array]] = deque(maxlen=max(1, ticks))
        self.forget()

    def forget(self) -> None:
        """Forget all places: there is no way back from here."""
        self._places.clear()
        self.goal: Array | None = None

    def add(self, place: Array, added: Array) -> None:
        """Note the place of the reference (n + 6,), and what feedback added (n,), in Pa."""
        self._places.append((place, added))

    def __bool__(self) -> bool:
        """Whether there is a place to go back to."""
        return bool(self._places)

    @property
    def earliest(self) -> Array:
        """The place (n + 6,) of the reference a while ago."""
        return self._places[0][0]

    @property
    def added(self) -> Array:
        """What feedback added there (n,), in Pa."""
        return self._places[0][1]

    def set_out(self, added: Array) -> Array:
        """Go back, where feedback is to add (n,), in Pa; return the goal."""
        self.goal = goal = self.earliest + np.concatenate([added, np.zeros(6)])
        return goal
