"""Run a fluidic soft arm stiff where it matters.

The model (`load_robot`), the task (`load_task`) and the optimiser (`solve_pressure`) in SI units.
"""

from stiffopt.errors import (
    EquilibriumError,
    FileError,
    InputError,
    MissingExtraError,
    PressureError,
    StiffoptError,
)
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.robot_files import builtin_robots
from stiffopt.model.screws import Twist, Wrench
from stiffopt.optimise.goal import AtLeast, MatchMatrix, MatchValue, StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.pareto import pareto_front
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver, solve_pressure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, Task, load_task

__version__ = "0.1.0"

__all__ = [
    "AtLeast",
    "EquilibriumError",
    "FileError",
    "InputError",
    "Load",
    "Manipulator",
    "MatchMatrix",
    "MatchValue",
    "MissingExtraError",
    "PressureError",
    "PressureSolution",
    "PressureSolver",
    "RobotDescription",
    "StiffnessGoal",
    "StiffnessMeasure",
    "StiffoptError",
    "Target",
    "Task",
    "Tolerance",
    "Twist",
    "Wrench",
    "__version__",
    "builtin_robots",
    "load_robot",
    "load_task",
    "pareto_front",
    "solve_pressure",
]
