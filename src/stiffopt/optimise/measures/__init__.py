"""The kinds of stiffness measures: one file each, found by scanning this folder."""

from stiffopt.model.kinds import kinds_in
from stiffopt.optimise.measure import Measure, Role

_FOUND = kinds_in(__name__, Measure)  # type: ignore[type-abstract]
MEASURES = tuple(kind for kind in _FOUND if "role" in vars(kind))
"""All kinds of measures."""


def measures_of(role: Role) -> tuple[type[Measure], ...]:
    """Return the kinds of measures that may have a role."""
    return tuple(kind for kind in MEASURES if kind.role == role)
