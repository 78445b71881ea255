"""Find the classes that the files of a package define, one kind of thing each."""

from importlib import import_module
from pkgutil import iter_modules
from typing import TypeVar

Kind = TypeVar("Kind")


def kinds_in(package: str, base: type[Kind]) -> list[type[Kind]]:
    """Return the subclasses of a class that the files of a package define, by file name."""
    kinds = []
    for file in iter_modules(import_module(package).__path__):
        module = import_module(f"{package}.{file.name}")
        kinds += [
            kind
            for kind in vars(module).values()
            if isinstance(kind, type)
            and issubclass(kind, base)
            and kind.__module__ == module.__name__
        ]
    return kinds
