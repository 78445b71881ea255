"""Run a fluidic soft arm stiff where it matters.

The model (`load_robot`), the task (`load_task`) and the optimiser (`solve_pressure`) in SI units;
the model of an arm from its recordings (`calibrate`); and a client of the daemon that holds the
stiff pose on an arm (`Client`).
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stiffopt.control.trajectory import Trajectory, Waypoint
    from stiffopt.daemon.client import Client
    from stiffopt.errors import (
        CommandError,
        DeviceError,
        EquilibriumError,
        FileError,
        GuardTripped,
        InputError,
        MissingExtraError,
        PressureError,
        ServiceError,
        SlowWarning,
        StiffoptError,
    )
    from stiffopt.identify.calibration import CalibrationResult, calibrate
    from stiffopt.identify.results import Comparison
    from stiffopt.identify.settings import CalibrationSettings
    from stiffopt.identify.validation import validate
    from stiffopt.logs import Log, StiffnessTable, read_log, read_mcap_log, read_stiffness_table
    from stiffopt.model.description import RobotDescription
    from stiffopt.model.history import History, Memory
    from stiffopt.model.manipulator import Manipulator, load_robot
    from stiffopt.model.robot_files import builtin_robots, save_robot
    from stiffopt.model.screws import Twist, Wrench
    from stiffopt.model.uncertainty import TipUncertainty
    from stiffopt.optimise.goal import (
        AtLeast,
        MatchMatrix,
        MatchValue,
        StiffnessGoal,
        StiffnessMeasure,
    )
    from stiffopt.optimise.pareto import pareto_front
    from stiffopt.optimise.solution import PressureSolution
    from stiffopt.optimise.solver import PressureSolver, solve_batch, solve_pressure
    from stiffopt.optimise.target import Target, Tolerance
    from stiffopt.optimise.task import Load, Task, load_task
    from stiffopt.rig.interface import Observation, PoseSample, PressureCommand, Rig
    from stiffopt.safety.rigs import open_rig
    from stiffopt.workspace import WorkspaceMap, map_workspace, open_workspace_map

__version__ = "0.1.0"

__all__ = [
    "AtLeast",
    "CalibrationResult",
    "CalibrationSettings",
    "Client",
    "CommandError",
    "Comparison",
    "DeviceError",
    "EquilibriumError",
    "FileError",
    "GuardTripped",
    "History",
    "InputError",
    "Load",
    "Log",
    "Manipulator",
    "MatchMatrix",
    "MatchValue",
    "Memory",
    "MissingExtraError",
    "Observation",
    "PoseSample",
    "PressureCommand",
    "PressureError",
    "PressureSolution",
    "PressureSolver",
    "Rig",
    "RobotDescription",
    "ServiceError",
    "SlowWarning",
    "StiffnessGoal",
    "StiffnessMeasure",
    "StiffnessTable",
    "StiffoptError",
    "Target",
    "Task",
    "TipUncertainty",
    "Tolerance",
    "Trajectory",
    "Twist",
    "Waypoint",
    "WorkspaceMap",
    "Wrench",
    "__version__",
    "builtin_robots",
    "calibrate",
    "load_robot",
    "load_task",
    "map_workspace",
    "open_rig",
    "open_workspace_map",
    "pareto_front",
    "read_log",
    "read_mcap_log",
    "read_stiffness_table",
    "save_robot",
    "solve_batch",
    "solve_pressure",
    "validate",
]

# Names are imported when they are first asked for: NumPy, CasADi and pydantic take a quarter of a
# second, for which neither `--help` nor a wrong option should wait.
_NAMES = {
    "stiffopt.control.trajectory": ("Trajectory", "Waypoint"),
    "stiffopt.daemon.client": ("Client",),
    "stiffopt.errors": (
        *("CommandError", "DeviceError", "EquilibriumError", "FileError", "GuardTripped"),
        *("InputError", "MissingExtraError", "PressureError", "ServiceError"),
        *("SlowWarning", "StiffoptError"),
    ),
    "stiffopt.identify.calibration": ("CalibrationResult", "calibrate"),
    "stiffopt.identify.results": ("Comparison",),
    "stiffopt.identify.settings": ("CalibrationSettings",),
    "stiffopt.identify.validation": ("validate",),
    "stiffopt.logs": (
        *("Log", "StiffnessTable", "read_log", "read_mcap_log", "read_stiffness_table"),
    ),
    "stiffopt.model.description": ("RobotDescription",),
    "stiffopt.model.history": ("History", "Memory"),
    "stiffopt.model.manipulator": ("Manipulator", "load_robot"),
    "stiffopt.model.robot_files": ("builtin_robots", "save_robot"),
    "stiffopt.model.screws": ("Twist", "Wrench"),
    "stiffopt.model.uncertainty": ("TipUncertainty",),
    "stiffopt.optimise.goal": (
        *("AtLeast", "MatchMatrix", "MatchValue", "StiffnessGoal", "StiffnessMeasure"),
    ),
    "stiffopt.optimise.pareto": ("pareto_front",),
    "stiffopt.optimise.solution": ("PressureSolution",),
    "stiffopt.optimise.solver": ("PressureSolver", "solve_batch", "solve_pressure"),
    "stiffopt.optimise.target": ("Target", "Tolerance"),
    "stiffopt.optimise.task": ("Load", "Task", "load_task"),
    "stiffopt.safety.rigs": ("open_rig",),
    "stiffopt.rig.interface": ("Observation", "PoseSample", "PressureCommand", "Rig"),
    "stiffopt.workspace": ("WorkspaceMap", "map_workspace", "open_workspace_map"),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
_MODULES = (
    "control",
    "daemon",
    "directions",
    "documents",
    "errors",
    "experiments",
    "files",
    "identify",
    "lie",
    "logs",
    "model",
    "optimise",
    "rig",
    "safety",
    "schema",
    "units",
    "workspace",
)


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
        return value
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
