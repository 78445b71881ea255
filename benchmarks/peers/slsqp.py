"""SciPy's SLSQP on the full task: with CasADi's gradients, and differencing a NumPy model.

The program is that of `peers.ipopt`.  The tip's three coordinates within the ball are one
inequality; the start is the middle of the pressure range.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from peers import paper
from peers.base import TaskSolver, Vector
from stiffopt import Target, Task

LIMITS = (0.0, paper.PRESSURE_MAX)
OPTIONS = {"maxiter": 200, "ftol": 1e-8}


class _Slsqp(TaskSolver):
    distributions: ClassVar[tuple[str, ...]] = ("scipy", "casadi")

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
        d = np.array(task.stiffness.maximise[0].direction)
        x = np.array(target.position, dtype=float)
        program = self._program(d, x, target.tolerance.position)
        n = len(start)
        answer = minimize(x0=start, method="SLSQP", bounds=[LIMITS] * n, options=OPTIONS, **program)
        return np.clip(np.asarray(answer.x), *LIMITS)

    @abstractmethod
    def _program(self, d: Vector, target: Vector, radius: float) -> dict[str, Any]:
        """Objective and constraint as `minimize` takes them."""


class SlsqpGradients(_Slsqp):
    """Value and gradient of each function from one call of CasADi."""

    name: ClassVar[str] = "SLSQP, CasADi gradients"

    def __init__(self, segments: int) -> None:
        super().__init__(segments)
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

    def _program(self, d: Vector, target: Vector, radius: float) -> dict[str, Any]:
        parameters = np.concatenate([target, d, [radius]])

        def cost(p: Vector) -> tuple[float, Vector]:
            value, slope = self._cost(p, parameters)
            return float(value), slope.full()[:, 0]

        return {
            "fun": cost,
            "jac": True,
            "constraints": {
                "type": "ineq",
                "fun": lambda p: float(self._ball(p, parameters)),
                "jac": lambda p: self._slope(p, parameters).full()[:, 0],
            },
        }


class SlsqpDifferences(_Slsqp):
    """No symbolic mathematics: the model in NumPy, gradients by finite differences."""

    name: ClassVar[str] = "SLSQP, finite differences"
    distributions: ClassVar[tuple[str, ...]] = ("scipy", "numpy")

    def _program(self, d: Vector, target: Vector, radius: float) -> dict[str, Any]:
        def cost(p: Vector) -> float:
            _, R, C = paper.numeric(p)
            local = R.T @ d
            return float(np.log(local @ C[:3, :3] @ local))

        def ball(p: Vector) -> float:
            miss = paper.numeric(p)[0] - target
            return float(1 - miss @ miss / radius**2)

        return {"fun": cost, "constraints": {"type": "ineq", "fun": ball}}
