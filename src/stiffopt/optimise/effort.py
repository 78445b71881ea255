"""How hard a search tries before it ends."""

from typing import NamedTuple


class Effort(NamedTuple):
    """Limits of a search.

    Attributes
    ----------
    screened : int
        Samples that are brought to the pose and ranked by what they are worth there.
    agreeing : int
        Descents in a row that must find nothing new before the search ends.
    most_descents : int
    """

    screened: int
    agreeing: int
    most_descents: int


_PLACED = Effort(64, 4, 32)
_LOOSE = Effort(256, 8, 64)


def effort(rows: int) -> Effort:
    """Effort for a target with so many components of its residual.

    A target that asks for less than a position is reached in very different ways, and the best
    of them is easily overlooked.  Measured against hundreds of descents: see benchmarks.
    """
    return _PLACED if rows >= 3 else _LOOSE
