"""The answer to a path or a motion: pressures over time, judged by the model alone."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.manipulator import Manipulator
from stiffopt.paths.trajectory import Trajectory

Vector = NDArray[np.float64]
Status = Literal["solved", "unreachable", "failed"]


@dataclass(frozen=True, eq=False, repr=False)
class PathSolution:
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

    def trajectory(self) -> Trajectory:
        """What a `ControlLoop` follows: the pressures, and the tip positions that they give."""
        raise NotImplementedError

    def __repr__(self) -> str:
        if not len(self.times):
            return f"PathSolution({self.status}: {self.message})"
        parts = [f"{self.status}: {len(self.times)} points in {self.times[-1]:.4g} s"]
        if self.worst is not None:
            unit = (self.stiffness_unit or "").replace("*", " ")
            parts.append(f"at least {self.worst:.4g} {unit}")
        if self.clearance is not None:
            parts.append(f"{1e3 * self.clearance.min():.3g} mm clear")
        return f"PathSolution({', '.join(parts)})"
