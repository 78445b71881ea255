"""The kinds of stiffness measures that a task may name: one file each, found by scanning."""

from stiffopt.model.kinds import kinds_in
from stiffopt.optimise.measure import Measure, Role

_FOUND = kinds_in(__name__, Measure)  # type: ignore[type-abstract]
MEASURES = tuple(kind for kind in _FOUND if "role" in vars(kind))
"""All kinds of measures."""


def measures_of(role: Role) -> tuple[type[Measure], ...]:
    """Those that may stand in one place of a task."""
    return tuple(kind for kind in MEASURES if kind.role == role)
