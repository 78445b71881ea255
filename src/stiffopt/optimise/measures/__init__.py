"""The kinds of stiffness measures that a task may name: one file each, found by scanning."""

from importlib import import_module
from pkgutil import iter_modules

from stiffopt.optimise.measure import Measure, Role


def _found() -> tuple[type[Measure], ...]:
    kinds = []
    for file in iter_modules(__path__):
        module = import_module(f"{__name__}.{file.name}")
        kinds += [
            kind
            for kind in vars(module).values()
            if isinstance(kind, type)
            and issubclass(kind, Measure)
            and kind.__module__ == module.__name__
            and "role" in vars(kind)
        ]
    return tuple(kinds)


MEASURES = _found()
"""All kinds of measures."""


def measures_of(role: Role) -> tuple[type[Measure], ...]:
    """Those that may stand in one place of a task."""
    return tuple(kind for kind in MEASURES if kind.role == role)
