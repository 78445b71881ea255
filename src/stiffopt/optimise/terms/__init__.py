"""The kinds of terms that a target may have: one file each, found by scanning this folder."""

from stiffopt.model.kinds import kinds_in
from stiffopt.optimise.term import Term

_FOUND = kinds_in(__name__, Term)  # type: ignore[type-abstract]
TERMS = tuple(sorted(_FOUND, key=lambda kind: (kind.order, kind.key)))
"""All kinds of terms, in the order in which they are listed."""
