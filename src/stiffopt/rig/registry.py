"""Drivers by name: the list of drivers, and the settings class for the ``driver`` of a rig file.

A driver comes with stiffopt, or with an installed package. The package announces it as an entry
point of the group ``stiffopt.supply``, ``stiffopt.tracker`` or ``stiffopt.probe``, or the rig file
names it in full as ``package.module:Class``. A driver is imported only when a rig file names it,
and only if it is installed: a module in the working directory or beside a rig file is refused.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.metadata import Distribution, EntryPoint, distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stiffopt.errors import InputError, shown
from stiffopt.rig.device import DeviceSettings
from stiffopt.rig.pressure import SupplySettings
from stiffopt.rig.probing import ProbeSettings
from stiffopt.rig.tracking import TrackerSettings

KINDS: dict[str, type[DeviceSettings]] = {
    "supply": SupplySettings,
    "tracker": TrackerSettings,
    "probe": ProbeSettings,
}
"""The kinds of devices, by their keys in a rig file, and the base class of their settings."""

_BUILT_IN = {
    "supply": {
        "simulated": "stiffopt.plant.settings:SimulatedSupplySettings",
        "modbus": "stiffopt.rig.drivers.modbus:ModbusSettings",
        "nidaq": "stiffopt.rig.drivers.nidaq:NidaqSettings",
        "open-regulator": "stiffopt.rig.drivers.open_regulator:OpenRegulatorSettings",
    },
    "tracker": {
        "simulated": "stiffopt.plant.settings:SimulatedTrackerSettings",
        "aurora": "stiffopt.rig.drivers.aurora:AuroraSettings",
        "openigtlink": "stiffopt.rig.drivers.openigtlink:OpenIGTLinkSettings",
    },
    "probe": {
        "simulated": "stiffopt.plant.settings:SimulatedProbeSettings",
        "probe": "stiffopt.rig.drivers.probe:ZaberProbeSettings",
    },
}


def built_in_drivers(kind: str) -> tuple[str, ...]:
    """Return the names of the drivers of a kind of device that come with stiffopt."""
    return tuple(_BUILT_IN[kind])


def driver_names(kind: str) -> tuple[str, ...]:
    """Return the names of all drivers of a kind of device, those of stiffopt first."""
    announced = {entry.name for entry, _ in _announced(kind)}
    return (*_BUILT_IN[kind], *sorted(announced.difference(_BUILT_IN[kind])))


def driver_class(kind: str, driver: Any) -> type[DeviceSettings]:
    """Return the settings class of a driver.

    `kind`: kind of the device, a key of `KINDS`. `driver`: value in the rig file: a name, or
    ``package.module:Class``. Raises `InputError`: there is no such driver, it is not installed, or
    it is for another kind of device.
    """
    if not isinstance(driver, str):
        raise InputError(f"expected the name of a driver, not {shown(driver)}")
    if driver in _BUILT_IN[kind]:
        found = load(_BUILT_IN[kind][driver])
    elif ":" in driver and driver.split(":")[0].split(".")[0] != "stiffopt":
        found = _load_installed(driver, _installed())
    else:
        found = _load_announced(kind, driver)
    if not (isinstance(found, type) and issubclass(found, KINDS[kind])):
        raise InputError(f"{driver} is no driver for this: no subclass of {KINDS[kind].__name__}")
    return found


def load(reference: str) -> Any:
    """Import the object that ``module:name`` refers to."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def one_of(words: Iterable[str]) -> str:
    """Join words to an enumeration: ``a, b or c``."""
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _load_announced(kind: str, name: str) -> Any:
    """Load the driver of this name that an installed package announces."""
    found = [(entry, owner) for entry, owner in _announced(kind) if entry.name == name]
    if not found:
        known = driver_names(kind)
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise InputError(
            f"there is no driver {shown(name)} for this; {hint}expected {one_of(known)}, or a "
            "class of an installed package as 'package.module:Class'"
        )
    if len(found) > 1:
        owners = ", ".join(sorted(owner.name for _, owner in found))
        raise InputError(
            f"several installed packages have a driver {shown(name)}: {owners}; name one as "
            f"{one_of(shown(entry.value) for entry, _ in found)}"
        )
    ((entry, owner),) = found
    return _load_installed(entry.value, [owner])


def _load_installed(reference: str, owners: Iterable[Distribution]) -> Any:
    """Load a class after checking that one of these packages has installed its module.

    Raises `InputError`: none has, or the class cannot be imported.
    """
    module, _, name = reference.partition(":")
    owned = list(owners)
    try:
        for spec in _specs(module):
            if spec.origin is not None and not any(_owns(o, spec.origin) for o in owned):
                raise InputError(
                    f"the driver {reference} would be loaded from {spec.origin}, which belongs to "
                    "no installed package; install its package with pip"
                )
        return load(reference)
    except InputError:
        raise
    except ModuleNotFoundError as error:
        raise InputError(
            f"the driver {reference} is not installed: {error}; install its package with pip"
        ) from None
    except AttributeError:
        raise InputError(f"the module {module} has no class '{name}'") from None
    except Exception as error:  # of any kind, in foreign code
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"the driver {reference} cannot be imported: {reason}") from None


def _specs(module: str) -> Iterator[ModuleSpec]:
    """Yield the specs of a module's packages and of itself, each before it is imported."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        name = ".".join(parts[:count])
        spec = find_spec(name) if all(part.isidentifier() for part in parts) else None
        if spec is None:
            raise ModuleNotFoundError(f"there is no module {shown(name)}")
        yield spec


def _owns(owner: Distribution, origin: str) -> bool:
    """Return whether an installed package contains this file, or refers to it if editable."""
    path, root = Path(origin).resolve(), Path(str(owner.locate_file(""))).resolve()
    files = [line.partition(",")[0] for line in (owner.read_text("RECORD") or "").splitlines()]
    if path.is_relative_to(root) and path.relative_to(root).as_posix() in files:
        return True
    for file in files:
        if file.endswith(".pth") and (root / file).is_file():  # of an editable install
            folders = (root / file).read_text(encoding="utf-8").splitlines()
            if any(path.is_relative_to(line) for line in folders if Path(line).is_absolute()):
                return True
    return False


def _announced(kind: str) -> Iterator[tuple[EntryPoint, Distribution]]:
    """Yield the drivers that installed packages announce for a kind of device."""
    seen = set()
    for distribution in _installed():
        entries = distribution.entry_points.select(group=f"stiffopt.{kind}")
        if entries and distribution.name not in seen:  # Python imports the first one
            seen.add(distribution.name)
            for entry in entries:
                yield entry, distribution


def _installed() -> Iterable[Distribution]:
    """Return the installed packages, without those in the working directory."""
    here = Path.cwd().resolve()
    path = [entry for entry in sys.path if entry and Path(entry).resolve() != here]
    return distributions(path=path)
