"""The answer to a path or a motion: pressures over time, judged by the model alone."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.notebook import ShownInNotebook
from stiffopt.paths.trajectory import Trajectory, trajectory_through

Vector = NDArray[np.float64]

Status = Literal["solved", "unreachable", "failed"]


@dataclass(frozen=True, eq=False, repr=False)
class PathSolution(ShownInNotebook):
    """Pressures over time; between two times they are interpolated linearly.

    Errors, stiffness and clearance are computed from the model at `pressures`.

    Attributes
    ----------
    status : {"solved", "unreachable", "failed"}
        "unreachable": no pressures do all that was asked; the nearest path that can be followed is
        given, if there is one.  "failed": there is no answer, and all arrays are empty or None.
    message : str
        One or two sentences for people.
    robot : Manipulator
        The arm, which carries the load of the path.
    times : ndarray (N,)
        In s, from 0.
    pressures : ndarray (N, n)
        In Pa.
    tip_poses : ndarray (N, 4, 4)
    slew : ndarray (n,) or None
        The rates of change that were kept, in Pa/s; None where none is known.
    stiffness : ndarray (N,) or None
        The stiffness that is maximised, in `stiffness_unit`; of several the smallest.
    stiffness_unit : str or None
    alone : ndarray (N,) or None
        What each point alone could have: its best stiffness without rates and neighbours.
    position_errors, angle_errors : ndarray (N,) or None
        In m and rad; None where not asked for.
    clearance : ndarray (N,) or None
        Least distance between body and scene, in m; None without a scene.
    first_failure : int or None
        Index of the first point that the arm cannot have as it was asked for.
    confidence : str
        How sure the search is, in words.
    timings : dict of str to float
        Seconds.
    """

    status: Status
    message: str
    robot: Manipulator
    times: Vector
    pressures: Vector
    tip_poses: Vector
    slew: Vector | None = None
    stiffness: Vector | None = None
    stiffness_unit: str | None = None
    alone: Vector | None = None
    position_errors: Vector | None = None
    angle_errors: Vector | None = None
    clearance: Vector | None = None
    first_failure: int | None = None
    confidence: str = ""
    timings: dict[str, float] = field(default_factory=dict)

    @property
    def found(self) -> bool:
        """Whether every point holds what was asked of it, and every step its rates."""
        return self.status == "solved"

    @property
    def worst_index(self) -> int | None:
        """Index of the least stiff point."""
        if self.stiffness is None or not len(self.stiffness):
            return None
        return int(np.argmin(self.stiffness))

    @property
    def worst(self) -> float | None:
        """Least stiffness along the path, in `stiffness_unit`."""
        index = self.worst_index
        return None if self.stiffness is None or index is None else float(self.stiffness[index])

    def trajectory(self, begin: float = 0.0) -> Trajectory:
        """What a `ControlLoop` follows: the pressures, and the tip positions that they give.

        Points that are too many or too close are left out; see `trajectory_through`.

        Parameters
        ----------
        begin :
            When to be at the first point, in s, for an arm that has to go there.

        Raises
        ------
        InputError
            There are no pressures, or too many points that cannot be left out.
        """
        if not len(self.times):
            raise InputError(f"there is nothing to follow: {self.message}")
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
