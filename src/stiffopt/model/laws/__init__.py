"""Strain laws, one file each; every file in this package is found.

A law is a subclass of `stiffopt.model.actuation.StrainLaw` with a `name`; docs/extending.md
explains how to write one.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from stiffopt.errors import InputError, shown
from stiffopt.model.actuation import SectionGeometry, StrainLaw
from stiffopt.model.segment import Segment


def strain_laws() -> dict[str, type[StrainLaw]]:
    """Return every law by its name in robot files, the simplest first."""
    _import_all()
    laws = StrainLaw.registered.values()
    return {law.name: law for law in sorted(laws, key=lambda law: (law.complexity, law.name))}


@cache
def _import_all() -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


def law_class(name: str) -> type[StrainLaw]:
    """Return the law of this name. Raises `InputError`: there is none."""
    laws = strain_laws()
    if name not in laws:
        *others, last = (shown(each) for each in laws)
        raise InputError(f"{shown(name)} is not one of {', '.join(others)} or {last}")
    return laws[name]


def strain_law(segment: Segment, geometry: SectionGeometry | None = None) -> StrainLaw:
    """Return the strain law of a segment, with its own geometry or a given one."""
    return law_class(segment.strain_law)(segment, geometry)
