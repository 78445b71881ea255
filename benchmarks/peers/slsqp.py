"""SciPy's SLSQP on the full task, with CasADi's gradients.

The program is that of `peers.ipopt`.  The tip's three coordinates within the ball are one
inequality; the start is the middle of the pressure range.
"""

from collections.abc import Callable
from typing import ClassVar

import casadi as ca
import numpy as np

from peers import paper
from peers.base import TaskSolver, Vector
from stiffopt import Target, Task

LIMITS = (0.0, paper.PRESSURE_MAX)
OPTIONS = {"maxiter": 200, "ftol": 1e-8}


class Slsqp(TaskSolver):
    """Value and gradient of each function from one call of CasADi."""

    name: ClassVar[str] = "SLSQP, CasADi gradients"
    distributions: ClassVar[tuple[str, ...]] = ("scipy", "casadi")

    def __init__(self, segments: int) -> None:
        super().__init__(segments)
        from scipy.optimize import minimize

        self._minimize = minimize
        parameters = ca.SX.sym("parameters", 7)
        target, d, radius = parameters[:3], parameters[3:6], parameters[6]
        p, x, R, C = paper.symbolic(segments)
        local = R.T @ d
        cost = ca.log(local.T @ C[:3, :3] @ local)
        ball = 1 - ca.sumsqr(x - target) / radius**2
        arguments = [p, parameters]
        self._cost = ca.Function("cost", arguments, [cost, ca.densify(ca.gradient(cost, p))])
        self._ball = ca.Function("ball", arguments, [ball])
        self._slope = ca.Function("slope", arguments, [ca.densify(ca.gradient(ball, p))])

    def cold(self, task: Task) -> Vector | None:
        """One start in the middle of the range."""
        middle = np.full(3 * self.segments, paper.PRESSURE_MAX / 2)
        return self._solve(task, task.target, middle) * paper.BAR

    def remember(self, task: Task) -> Callable[[Target], Vector | None]:
        """Warm from the last pressures; SLSQP takes no multipliers."""
        last = self.cold(task)
        assert last is not None
        return lambda target: self._solve(task, target, last / paper.BAR) * paper.BAR

    def _solve(self, task: Task, target: Target, start: Vector) -> Vector:
        assert task.stiffness is not None
        d, x = task.stiffness.maximise[0].direction, target.position
        parameters = np.array([*x, *d, target.tolerance.position], dtype=float)

        def cost(p: Vector) -> tuple[float, Vector]:
            value, slope = self._cost(p, parameters)
            return float(value), slope.full()[:, 0]

        answer = self._minimize(
            cost, start, jac=True, method="SLSQP", bounds=[LIMITS] * len(start), options=OPTIONS,
            constraints={
                "type": "ineq",
                "fun": lambda p: float(self._ball(p, parameters)),
                "jac": lambda p: self._slope(p, parameters).full()[:, 0],
            },
        )  # fmt: skip
        return np.clip(np.asarray(answer.x), *LIMITS)
