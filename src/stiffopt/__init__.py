"""Run a fluidic soft arm stiff where it matters.

`load_robot` gives the model of an arm, `load_task` a task, and `solve_pressure` the chamber
pressures that reach the task's target and make the tip as stiff as possible. `calibrate` fits the
model to recordings, `open_rig` commands an arm, and `Client` talks to the daemon that holds an arm
at its task. All quantities are in SI units.
"""

import pkgutil
import re
from importlib import import_module
from importlib.util import find_spec
from typing import Any

__version__ = "0.1.0"

# Names are imported at their first use: NumPy, CasADi and pydantic take a quarter of a second, too
# long for `--help` or a wrong option. The stub says where they come from.
_STUB = (pkgutil.get_data(__name__, "__init__.pyi") or b"").decode()
_MODULE_OF = {name: module for module, name in re.findall(r"from (\S+) import (\w+) as", _STUB)}
__all__ = sorted((*_MODULE_OF, "__version__"))


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
        return value
    if not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
