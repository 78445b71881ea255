"""Plain CasADi + IPOPT: what a user would write for the full task.

Variables are the pressures in bar within their limits; the tip lies in the ball of the position
tolerance; the logarithm of the compliance along d is minimised.  The program is built once with
target and direction as parameters (`nlpsol`, exact derivatives); timed are calls of it alone.
Options are those of the usual ones that took the fewest iterations: cold, an adaptive barrier
(a quarter to nearly half of them less); warm, `warm_start_init_point` with the multipliers of the
last solution and a small first barrier.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from peers import paper
from peers.base import TaskSolver, Vector
from stiffopt import Target, Task

QUIET = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes"}
COLD = {"ipopt.tol": 1e-6, "ipopt.max_iter": 200, "ipopt.mu_strategy": "adaptive"}
WARM = {
    "ipopt.tol": 1e-6,
    "ipopt.max_iter": 200,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-5,
}


class Ipopt(TaskSolver):
    """The compliance as the paper has it, 6x6 (eq. 17); one start at mid-pressure."""

    name: ClassVar[str] = "CasADi + IPOPT"
    distributions: ClassVar[tuple[str, ...]] = ("casadi",)

    def __init__(self, segments: int) -> None:
        super().__init__(segments)
        self.n = 3 * segments
        parameters = ca.SX.sym("parameters", 7)  # target, direction, tolerance
        target, d, radius = parameters[:3], parameters[3:6], parameters[6]
        p, x, along = self._model(d)
        program = {
            "x": p,
            "p": parameters,
            "f": ca.log(along),
            "g": ca.sumsqr(x - target) / radius**2,
        }
        self._cold = ca.nlpsol("cold", "ipopt", program, {**QUIET, **COLD})
        self._warm = ca.nlpsol("warm", "ipopt", program, {**QUIET, **WARM})
        self.middle = np.full(self.n, paper.PRESSURE_MAX / 2)

    def _model(self, d: Any) -> tuple[Any, Any, Any]:
        p, x, R, C = paper.symbolic(self.segments)
        local = R.T @ d
        return p, x, local.T @ C[:3, :3] @ local

    def cold(self, task: Task) -> Vector | None:
        """One start in the middle of the range."""
        return self.from_start(task, self.middle)

    def from_start(self, task: Task, start: Vector) -> Vector | None:
        """From a start (n,) in bar."""
        return self._pressures(self._solve(self._cold, _parameters(task, task.target), x0=start))

    def remember(self, task: Task) -> Callable[[Target], Vector | None]:
        """Warm from the last solution and its multipliers."""
        last = self._solve(self._cold, _parameters(task, task.target), x0=self.middle)
        start = {"x0": last["x"], "lam_x0": last["lam_x"], "lam_g0": last["lam_g"]}

        def again(target: Target) -> Vector | None:
            return self._pressures(self._solve(self._warm, _parameters(task, target), **start))

        return again

    def _solve(self, solver: Any, parameters: Vector, **start: Any) -> Any:
        return solver(p=parameters, lbx=0, ubx=paper.PRESSURE_MAX, lbg=-ca.inf, ubg=1, **start)

    def _pressures(self, answer: Any) -> Vector:
        return np.clip(answer["x"].full()[:, 0], 0, paper.PRESSURE_MAX) * paper.BAR


class IpoptEnergy(Ipopt):
    """The same by a user who sees that ``d'C_vv d`` is one integral of strain energy."""

    name: ClassVar[str] = "CasADi + IPOPT, energy form"

    def _model(self, d: Any) -> tuple[Any, Any, Any]:
        return paper.energy_form(self.segments, d)


def _parameters(task: Task, target: Target) -> Vector:
    assert task.stiffness is not None
    assert target.position is not None
    position = np.array(target.position, dtype=float)
    d = np.array(task.stiffness.maximise[0].direction)
    return np.concatenate([position, d, [target.tolerance.position]])
