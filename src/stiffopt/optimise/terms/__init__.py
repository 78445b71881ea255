"""The kinds of terms that a target may have: one file each, found by scanning this folder."""

from importlib import import_module
from pkgutil import iter_modules

from stiffopt.optimise.term import Term


def _found() -> tuple[type[Term], ...]:
    kinds = []
    for file in iter_modules(__path__):
        module = import_module(f"{__name__}.{file.name}")
        kinds += [
            kind
            for kind in vars(module).values()
            if isinstance(kind, type)
            and issubclass(kind, Term)
            and kind.__module__ == module.__name__
        ]
    return tuple(sorted(kinds, key=lambda kind: (kind.order, kind.key)))


TERMS = _found()
"""All kinds of terms, in the order in which they are listed."""
