"""The kinds of obstacles: one file each, found by scanning this folder."""

from stiffopt.model.kinds import kinds_in
from stiffopt.model.obstacle import Obstacle

OBSTACLES = {kind.key: kind for kind in kinds_in(__name__, Obstacle)}  # type: ignore[type-abstract]
"""All kinds, by their keys in files."""
