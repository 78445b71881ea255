"""Run a fluidic soft arm stiff where it matters.

`load_robot` gives the model of an arm, `load_task` a task, and `solve_pressure` the chamber
pressures that reach the task's target and make the tip as stiff as possible. `calibrate` fits the
model to recordings, `open_rig` commands an arm, and `Client` talks to the daemon that holds an arm
at its task. All quantities are in SI units.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stiffopt.daemon.client import Client as Client
    from stiffopt.errors import CancelledError as CancelledError
    from stiffopt.errors import CommandError as CommandError
    from stiffopt.errors import DerivativeError as DerivativeError
    from stiffopt.errors import DeviceError as DeviceError
    from stiffopt.errors import EquilibriumError as EquilibriumError
    from stiffopt.errors import FileError as FileError
    from stiffopt.errors import GuardTripped as GuardTripped
    from stiffopt.errors import InputError as InputError
    from stiffopt.errors import MissingExtraError as MissingExtraError
    from stiffopt.errors import OutOfTimeError as OutOfTimeError
    from stiffopt.errors import PressureError as PressureError
    from stiffopt.errors import ServiceError as ServiceError
    from stiffopt.errors import SlowWarning as SlowWarning
    from stiffopt.errors import StiffoptError as StiffoptError
    from stiffopt.errors import StoppedError as StoppedError
    from stiffopt.errors import UnfitWarning as UnfitWarning
    from stiffopt.export.mesh import save_mesh as save_mesh
    from stiffopt.export.mesh import surface_mesh as surface_mesh
    from stiffopt.export.mjcf import mjcf as mjcf
    from stiffopt.identify.calibration import CalibrationResult as CalibrationResult
    from stiffopt.identify.calibration import calibrate as calibrate
    from stiffopt.identify.results import Comparison as Comparison
    from stiffopt.identify.settings import CalibrationSettings as CalibrationSettings
    from stiffopt.identify.validation import validate as validate
    from stiffopt.logs import Log as Log
    from stiffopt.logs import StiffnessTable as StiffnessTable
    from stiffopt.logs import read_log as read_log
    from stiffopt.logs import read_mcap_log as read_mcap_log
    from stiffopt.logs import read_stiffness_table as read_stiffness_table
    from stiffopt.model.contact.equilibrium import Contact as Contact
    from stiffopt.model.contact.equilibrium import ContactEquilibrium as ContactEquilibrium
    from stiffopt.model.contact.push import ContactLoss as ContactLoss
    from stiffopt.model.description import RobotDescription as RobotDescription
    from stiffopt.model.history import History as History
    from stiffopt.model.history import Memory as Memory
    from stiffopt.model.manipulator import Manipulator as Manipulator
    from stiffopt.model.manipulator import load_robot as load_robot
    from stiffopt.model.robot_files import builtin_robots as builtin_robots
    from stiffopt.model.robot_files import save_robot as save_robot
    from stiffopt.model.scene import Scene as Scene
    from stiffopt.model.scene import SceneObject as SceneObject
    from stiffopt.model.scene import load_scene as load_scene
    from stiffopt.model.screws import Twist as Twist
    from stiffopt.model.screws import Wrench as Wrench
    from stiffopt.model.uncertainty import TipUncertainty as TipUncertainty
    from stiffopt.optimise.brace import Brace as Brace
    from stiffopt.optimise.goal import AtLeast as AtLeast
    from stiffopt.optimise.goal import MatchMatrix as MatchMatrix
    from stiffopt.optimise.goal import MatchValue as MatchValue
    from stiffopt.optimise.goal import StiffnessGoal as StiffnessGoal
    from stiffopt.optimise.goal import StiffnessMeasure as StiffnessMeasure
    from stiffopt.optimise.pareto import pareto_front as pareto_front
    from stiffopt.optimise.press import Press as Press
    from stiffopt.optimise.solution import PressureSolution as PressureSolution
    from stiffopt.optimise.solver import PressureSolver as PressureSolver
    from stiffopt.optimise.solver import solve_batch as solve_batch
    from stiffopt.optimise.solver import solve_pressure as solve_pressure
    from stiffopt.optimise.supports import suggest_supports as suggest_supports
    from stiffopt.optimise.target import Target as Target
    from stiffopt.optimise.target import Tolerance as Tolerance
    from stiffopt.optimise.task import Load as Load
    from stiffopt.optimise.task import Task as Task
    from stiffopt.optimise.task import load_task as load_task
    from stiffopt.optimise.warm import WarmAnswer as WarmAnswer
    from stiffopt.paths.motion import plan_motion as plan_motion
    from stiffopt.paths.path import Path as Path
    from stiffopt.paths.path import load_path as load_path
    from stiffopt.paths.solution import PathSolution as PathSolution
    from stiffopt.paths.solver import solve_path as solve_path
    from stiffopt.paths.trajectory import Trajectory as Trajectory
    from stiffopt.paths.trajectory import Waypoint as Waypoint
    from stiffopt.rig.interface import Observation as Observation
    from stiffopt.rig.interface import PoseSample as PoseSample
    from stiffopt.rig.interface import PressureCommand as PressureCommand
    from stiffopt.rig.interface import Rig as Rig
    from stiffopt.safety.rigs import open_rig as open_rig
    from stiffopt.workspace import WorkspaceMap as WorkspaceMap
    from stiffopt.workspace import map_workspace as map_workspace
    from stiffopt.workspace import open_workspace_map as open_workspace_map

__version__ = "0.1.0"

# Names are imported at their first use: NumPy, CasADi and pydantic take a quarter of a second, too
# long for `--help` or a wrong option.
_NAMES = {
    "stiffopt.daemon.client": ("Client",),
    "stiffopt.errors": (
        *("CancelledError", "CommandError", "DerivativeError", "DeviceError", "EquilibriumError"),
        *(
            "FileError",
            "GuardTripped",
            "InputError",
            "MissingExtraError",
            "OutOfTimeError",
            "PressureError",
        ),
        *("ServiceError", "SlowWarning", "StiffoptError", "StoppedError", "UnfitWarning"),
    ),
    "stiffopt.export.mesh": ("save_mesh", "surface_mesh"),
    "stiffopt.export.mjcf": ("mjcf",),
    "stiffopt.identify.calibration": ("CalibrationResult", "calibrate"),
    "stiffopt.identify.results": ("Comparison",),
    "stiffopt.identify.settings": ("CalibrationSettings",),
    "stiffopt.identify.validation": ("validate",),
    "stiffopt.logs": (
        *("Log", "StiffnessTable", "read_log", "read_mcap_log", "read_stiffness_table"),
    ),
    "stiffopt.model.contact.equilibrium": ("Contact", "ContactEquilibrium"),
    "stiffopt.model.contact.push": ("ContactLoss",),
    "stiffopt.model.description": ("RobotDescription",),
    "stiffopt.model.history": ("History", "Memory"),
    "stiffopt.model.manipulator": ("Manipulator", "load_robot"),
    "stiffopt.model.robot_files": ("builtin_robots", "save_robot"),
    "stiffopt.model.scene": ("Scene", "SceneObject", "load_scene"),
    "stiffopt.model.screws": ("Twist", "Wrench"),
    "stiffopt.model.uncertainty": ("TipUncertainty",),
    "stiffopt.optimise.goal": (
        *("AtLeast", "MatchMatrix", "MatchValue", "StiffnessGoal", "StiffnessMeasure"),
    ),
    "stiffopt.optimise.pareto": ("pareto_front",),
    "stiffopt.optimise.solution": ("PressureSolution",),
    "stiffopt.optimise.solver": ("PressureSolver", "solve_batch", "solve_pressure"),
    "stiffopt.optimise.supports": ("suggest_supports",),
    "stiffopt.optimise.target": ("Target", "Tolerance"),
    "stiffopt.optimise.brace": ("Brace",),
    "stiffopt.optimise.press": ("Press",),
    "stiffopt.optimise.task": ("Load", "Task", "load_task"),
    "stiffopt.optimise.warm": ("WarmAnswer",),
    "stiffopt.paths.motion": ("plan_motion",),
    "stiffopt.paths.path": ("Path", "load_path"),
    "stiffopt.paths.solution": ("PathSolution",),
    "stiffopt.paths.solver": ("solve_path",),
    "stiffopt.paths.trajectory": ("Trajectory", "Waypoint"),
    "stiffopt.safety.rigs": ("open_rig",),
    "stiffopt.rig.interface": ("Observation", "PoseSample", "PressureCommand", "Rig"),
    "stiffopt.workspace": ("WorkspaceMap", "map_workspace", "open_workspace_map"),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
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
