"""`PathSolution`: the solution of a path or motion, pressures over time."""

from dataclasses import dataclass, field

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.notebook import ShownInNotebook
from stiffopt.optimise.solution import Status
from stiffopt.paths.trajectory import Trajectory, trajectory_through

LEANS = (
    "leans on objects, and is not followed as a trajectory: give the rig its task, and the daemon "
    "goes the same way"
)
"""Why a motion into contact cannot be played."""


@dataclass(frozen=True, eq=False, repr=False)
class PathSolution(ShownInNotebook):
    """Pressures over time, linear between two times.

    Errors, stiffness and clearance are recomputed from the model at `pressures`.

    Attributes
    ----------
    status : {"solved", "unreachable", "failed"}
        "unreachable": no pressures meet all requirements; the solution is the nearest path that can
        be followed, if there is one.  "failed": no solution; all arrays are empty or None.
    message : str
        One or two sentences for the user.
    robot : Manipulator
        With the load of the path.
    times : ndarray (N,)
        In s, from 0.
    pressures : ndarray (N, n)
        In Pa.
    tip_poses : ndarray (N, 4, 4)
    slew : ndarray (n,) or None
        Largest rates of change that were allowed, in Pa/s; None if none is known.
    stiffness : ndarray (N,) or None
        The smallest of the stiffnesses that are maximised, in `stiffness_unit`.
    stiffness_unit : str or None
    alone : ndarray (N,) or None
        Best stiffness of each single point, without rates and neighbours.
    position_errors, angle_errors : ndarray (N,) or None
        In m and rad; None where not asked for.
    clearance : ndarray (N,) or None
        Smallest distance between body and scene, in m; None without a scene.
    equilibria : tuple of ContactEquilibrium or None
        Of a motion into or out of contact: those of its last points, from rest on, or of all; None
        where the arm is on its way clear of the scene.  Else empty.
    first_failure : int or None
        Index of the first point that cannot be solved, or of the last from which no way on was
        found.
    confidence : str
        How thorough the search was, in words.
    timings : dict of str to float
        In s.
    """

    status: Status
    message: str
    robot: Manipulator
    times: Array
    pressures: Array
    tip_poses: Array
    slew: Array | None = None
    stiffness: Array | None = None
    stiffness_unit: str | None = None
    alone: Array | None = None
    position_errors: Array | None = None
    angle_errors: Array | None = None
    clearance: Array | None = None
    equilibria: tuple[ContactEquilibrium | None, ...] = ()
    first_failure: int | None = None
    confidence: str = ""
    timings: dict[str, float] = field(default_factory=dict)

    @classmethod
    def without_answer(
        cls, status: Status, message: str, robot: Manipulator, slew: Array | None
    ) -> "PathSolution":
        """Return a solution with a message alone."""
        none = np.zeros((0, robot.n_pressures))
        return cls(status, message, robot, np.zeros(0), none, np.zeros((0, 4, 4)), slew)

    @property
    def found(self) -> bool:
        """Whether every point meets its requirements, and every step the rates."""
        return self.status == "solved"

    def equilibrium(self, index: int) -> ContactEquilibrium | None:
        """Return the equilibrium in contact at a point, if the motion knows it."""
        own = index - len(self.times) + len(self.equilibria)
        return self.equilibria[own] if own >= 0 else None

    @property
    def leans(self) -> Flags:
        """Flags (N,) of the points at which the arm is in contact."""
        own = [eq is not None and bool(eq.contacts) for eq in self.equilibria]
        return np.array([False] * (len(self.times) - len(own)) + own)

    @property
    def worst_index(self) -> int | None:
        """Index of the least stiff point."""
        if self.stiffness is None or not len(self.stiffness):
            return None
        return int(np.argmin(self.stiffness))

    @property
    def worst(self) -> float | None:
        """Smallest stiffness along the path, in `stiffness_unit`."""
        index = self.worst_index
        return None if self.stiffness is None or index is None else float(self.stiffness[index])

    def trajectory(self, begin: float = 0.0) -> Trajectory:
        """Return the trajectory for a `ControlLoop`: pressures and the resulting tip positions.

        Superfluous points are left out if there are too many; see `trajectory_through`.

        Parameters
        ----------
        begin :
            Time of the first point, in s; it leaves the arm time to go there.

        Raises
        ------
        InputError
            There are no pressures, or too many points remain, or the arm leans on objects.
        """
        if not len(self.times):
            raise InputError(f"there is nothing to follow: {self.message}")
        if self.leans.any():
            raise InputError(f"the motion {LEANS}")
        ranges = self.robot.pressure_max - self.robot.pressure_min
        tips = self.tip_poses[:, :3, 3]
        return trajectory_through(self.times, self.pressures, tips, ranges, begin)

    def __repr__(self) -> str:
        if not len(self.times):
            return f"PathSolution({self.status}: {self.message})"
        parts = [f"{self.status}: {len(self.times)} points in {self.times[-1]:.4g} s"]
        if self.worst is not None:
            unit = display_units().of_si(self.stiffness_unit)
            parts.append(f"at least {unit.text(self.worst)}")
        if self.clearance is not None:
            parts.append(f"{display_units().length.text(self.clearance.min(), '.3g')} clear")
        return f"PathSolution({', '.join(parts)})"
