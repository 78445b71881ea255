"""Many starts of IPOPT on a task with objects, at its own stations and with its own distances.

The model's functions are stiffopt's (tested by themselves), its optimiser and distances are not
used.  Each object and station is a row; where the body is between stations is seen only by
the judge, so IPOPT's points count when that confirms them.  Half of the starts are random pressures
within their limits, half random ones that keep clear and whose tips are not far from the target.
"""

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenes.judge import distances
from scenes.scene_tasks import CLEARANCE, RADIUS, Case
from stiffopt import EquilibriumError, Manipulator

Vector = NDArray[np.float64]

BAR = 1e5
STATIONS = 33
DRAWN, KEPT = 1500, 0.1  # random pressures, and the share of the clear ones that is not far
OPTIONS = {
    "print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-6,
    "ipopt.max_iter": 80, "ipopt.hessian_approximation": "limited-memory",
    "ipopt.acceptable_tol": 1e-4, "ipopt.acceptable_iter": 5,
}  # fmt: skip


class Ipopt:
    """One task as a nonlinear program of the pressures in bar."""

    def __init__(self, robot: Manipulator, case: Case) -> None:
        self._robot, self._case = robot, case
        self._program = _Program(robot, case)
        x = ca.MX.sym("x", robot.n_pressures)
        f, g = self._program(x)
        self._solver = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": f, "g": g}, OPTIONS)

    def ends(self, starts: int, rng: np.random.Generator) -> Iterator[tuple[float, Vector]]:
        """Stiffness and pressures (n,) in Pa where IPOPT ended, if its own rows hold there."""
        low, high = self._robot.pressure_min / BAR, self._robot.pressure_max / BAR
        clear = self._clear(rng)
        bounds = {"lbx": low, "ubx": high, **self._program.bounds}
        for number in range(starts):
            start = rng.uniform(low, high)
            if number % 2 and len(clear):
                start = clear[rng.integers(len(clear))] / BAR
            try:
                x = np.clip(self._solver(x0=start, **bounds)["x"].full()[:, 0], low, high)
                _, rows = self._program.values(x)
            except (EquilibriumError, RuntimeError):
                continue
            lower, upper = self._program.bounds["lbg"], self._program.bounds["ubg"]
            if (rows >= lower - 1e-2).all() and (rows <= upper + 1e-3).all():
                yield float(self._robot.stiffness(x * BAR, self._case.direction)), x * BAR

    def _clear(self, rng: np.random.Generator) -> Vector:
        """Random pressures (k, n) in Pa at which the stations keep clear, near the target."""
        robot, found = self._robot, []
        drawn = DRAWN // 5 if robot.is_loaded else DRAWN
        for p in rng.uniform(robot.pressure_min, robot.pressure_max, (drawn, robot.n_pressures)):
            try:
                line = robot.backbone(p, STATIONS)[:, :3, 3]
            except EquilibriumError:
                continue
            if all(distances(o, line).min() > RADIUS + CLEARANCE for o in self._case.objects):
                found.append((float(np.linalg.norm(line[-1] - self._case.position)), p))
        found.sort(key=lambda pair: pair[0])
        return np.array([p for _, p in found[: max(20, int(KEPT * len(found)))]])


class _Program(ca.Callback):
    """Objective and rows, from Python, with derivatives."""

    def __init__(self, robot: Manipulator, case: Case) -> None:
        super().__init__()
        self._robot, self._case = robot, case
        self._at = np.linspace(0, robot.length, STATIONS)[1:]
        self._target = np.array(case.position)
        self._tolerance = case.task(with_scene=False).target.tolerance.position
        self.rows = 1 + len(case.objects) * len(self._at)
        self.bounds = {
            "lbg": np.append(-np.inf, np.zeros(self.rows - 1)),
            "ubg": np.append(1.0, np.full(self.rows - 1, np.inf)),
        }
        self._last: tuple[bytes, tuple[Any, ...]] = (b"", ())
        self.construct("program")

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 2

    def get_sparsity_in(self, _: int) -> Any:
        return ca.Sparsity.dense(self._robot.n_pressures, 1)

    def get_sparsity_out(self, index: int) -> Any:
        return ca.Sparsity.dense(self.rows if index else 1, 1)

    def eval(self, arguments: Any) -> Any:
        return list(self.values(arguments[0].full()[:, 0]))

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inames: Any, onames: Any, options: Any) -> Any:
        self._slopes = _Slopes(self, name, options)
        return self._slopes

    def values(self, x: Vector) -> tuple[float, Vector]:
        """Logarithm of the compliance, and rows (k,)."""
        return self._all(x)[:2]

    def slopes(self, x: Vector) -> tuple[Vector, Vector]:
        """Their derivatives (n,) and (k, n) per bar."""
        return self._all(x)[2:]

    def _all(self, x: Vector) -> Any:
        if self._last[0] != x.tobytes():
            try:
                self._last = x.tobytes(), self._computed(x * BAR)
            except EquilibriumError:
                n = len(x)
                nan = np.full(self.rows, np.nan)
                self._last = x.tobytes(), (np.nan, nan, np.full(n, np.nan), nan[:, None] * x)
        return self._last[1]

    def _computed(self, p: Vector) -> tuple[float, Vector, Vector, Vector]:
        robot, direction = self._robot, self._case.direction
        stiffness = float(robot.stiffness(p, direction))
        slope = -robot.stiffness_gradient(p, direction) / stiffness * BAR
        poses, J = robot.pose(p, self._at), robot.body_jacobian(p, self._at)
        moves = poses[:, :3, :3] @ J[:, :3] * BAR  # (m, 3, n)
        x = poses[:, :3, 3]
        miss = (x[-1] - self._target) / self._tolerance
        rows, slopes = [np.array([miss @ miss])], [2 * miss @ moves[-1:] / self._tolerance]
        for item in self._case.objects:
            d, normals = self._distances(item, x)
            rows.append((d - RADIUS - CLEARANCE) / 1e-3)
            slopes.append(np.einsum("mi,min->mn", normals, moves) / 1e-3)
        return -np.log(stiffness), np.concatenate(rows), slope, np.vstack(slopes)

    def _distances(self, item: dict[str, Any], x: Vector) -> tuple[Vector, Vector]:
        """Distances (m,) and their gradients (m, 3)."""
        h = 1e-6
        shifts = np.concatenate([np.zeros((1, 3)), h * np.eye(3), -h * np.eye(3)])
        if "trocar" in item:  # of the circle, point by point
            shape = item["trocar"]
            seen = (x + shifts[:, None]).reshape(-1, 3) - shape["centre"]
            height = seen @ np.array(shape["axis"])
            beside = np.linalg.norm(seen - np.outer(height, shape["axis"]), axis=1)
            values = np.hypot(beside - shape["radius"], height)
        else:
            values = distances(item, (x + shifts[:, None]).reshape(-1, 3))
        values = values.reshape(7, -1)
        return values[0], (values[1:4] - values[4:]).T / (2 * h)


class _Slopes(ca.Callback):
    """Derivatives of a `_Program`."""

    def __init__(self, program: _Program, name: str, options: Any) -> None:
        super().__init__()
        self._program = program
        self.construct(name, options)

    def get_n_in(self) -> int:
        return 3

    def get_n_out(self) -> int:
        return 2

    def get_sparsity_in(self, index: int) -> Any:
        n = self._program._robot.n_pressures
        return ca.Sparsity(1, 1) if index == 1 else (
            ca.Sparsity(self._program.rows, 1) if index == 2 else ca.Sparsity.dense(n, 1)
        )  # fmt: skip

    def get_sparsity_out(self, index: int) -> Any:
        n = self._program._robot.n_pressures
        return ca.Sparsity.dense(self._program.rows if index else 1, n)

    def eval(self, arguments: Any) -> Any:
        slope, slopes = self._program.slopes(arguments[0].full()[:, 0])
        return [ca.DM(slope.reshape(1, -1)), ca.DM(slopes)]
