"""Many starts of IPOPT on a task with objects, at its own stations and with its own distances.

The model's functions are stiffopt's (tested by themselves), its optimiser and distances are not
used.  Each object and station is a row, and each ring one more, so that the arm passes through it.
Half of the starts are random pressures within their limits, half random ones that keep clear and
whose tips are not far from the target.  The tip is at the target first, by three equations, then
where the multipliers point to on the ball of the tolerance: with the ball itself as a row, hardly a
start in a hundred came to an end.  By what the judge finds an object nearer than its rows say, as
between stations, more is asked of it, twice.
"""

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenes.judge import clearances, distances
from scenes.scene_tasks import CLEARANCE, RADIUS, Case
from stiffopt import EquilibriumError, Manipulator

Vector = NDArray[np.float64]

BAR = 1e5
STATIONS, LINE = 33, 400  # of the rows, and of a centre line for the judge
SAME = 1e-4  # bar, between two ends that are the same optimum
MOST_MORE = 1e-3  # m that is asked beyond the clearance, at a time
DRAWN, KEPT = 1500, 0.1  # random pressures, and the share of the clear ones that is not far
OPTIONS = {
    "print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-6,
    "ipopt.max_iter": 50, "ipopt.hessian_approximation": "limited-memory",
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
        self._tolerance = case.task(with_scene=False).target.tolerance.position

    def ends(self, starts: int, rng: np.random.Generator) -> Iterator[tuple[float, Vector]]:
        """Stiffness and pressures (n,) in Pa where IPOPT ended, if its own rows hold there."""
        low, high = self._robot.pressure_min / BAR, self._robot.pressure_max / BAR
        clear = self._clear(rng)
        known: list[tuple[Vector, tuple[float, Vector] | None]] = []
        for number in range(starts):
            x = rng.uniform(low, high)
            if number % 2 and len(clear):
                x = clear[rng.integers(len(clear))] / BAR
            self._program.place(self._case.position)
            found = self._end(x, low, high)
            if found is None:
                continue
            x, pull = found
            same = [end for first, end in known if np.abs(x - first).max() < SAME]
            end = same[0] if same else self._at_edge(x, pull, low, high)
            known.append((x, end))
            if end is not None:
                yield end

    def _at_edge(
        self, x: Vector, pull: Vector, low: Vector, high: Vector
    ) -> tuple[float, Vector] | None:
        """From an end at the target to one on the edge of its tolerance, see above."""
        for _ in range(2):
            self._program.place(self._case.position + 0.99 * self._tolerance * pull, x * BAR)
            found = self._end(x, low, high)
            if found is None:
                return None
            x, pull = found
        return float(self._robot.stiffness(x * BAR, self._case.direction)), x * BAR

    def _end(self, x: Vector, low: Vector, high: Vector) -> tuple[Vector, Vector] | None:
        """Where IPOPT ends, and to which side (3,) the tip is pulled."""
        try:
            found = self._solver(x0=x, lbx=low, ubx=high, lbg=0, ubg=self._program.upper)
            x = np.clip(found["x"].full()[:, 0], low, high)
            rows = self._program.values(x)[1]
        except (EquilibriumError, RuntimeError):
            return None
        if not ((rows > -1e-3) & (rows < self._program.upper + 1e-3)).all():
            return None
        pull = found["lam_g"].full()[:3, 0]
        return x, pull / max(float(np.linalg.norm(pull)), 1e-9)

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
        rings = sum("trocar" in item for item in case.objects)
        self.rows = 3 + len(case.objects) * len(self._at) + rings
        self.upper = np.where(np.arange(self.rows) < 3, 0.0, np.inf)
        self.place(case.position)
        self.construct("program")

    def place(self, target: Any, p: Vector | None = None) -> None:
        """Have the tip at a place (3,) in m, and objects as far away as the judge sees them."""
        self._target = np.array(target)
        if p is None:
            self._asked = np.full(len(self._case.objects), RADIUS + CLEARANCE)
        else:
            line = self._robot.backbone(p, LINE)[:, :3, 3]
            lacking = CLEARANCE - np.array(clearances(self._case.objects, line, RADIUS, CLEARANCE))
            self._asked += np.clip(lacking, 0, MOST_MORE)
        self._last: tuple[bytes, tuple[Any, ...]] = (b"", ())

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
        robot, direction = self._robot, np.array(self._case.direction)
        h = 1e-3 * np.eye(len(p))  # bar
        C = robot.compliance_between(
            p + BAR * np.concatenate([0 * h[:1], h, -h]), *2 * [robot.length]
        )
        logs = np.log(np.einsum("i,kij,j->k", direction, C[:, :3, :3], direction))
        slope = (logs[1 : len(p) + 1] - logs[len(p) + 1 :]) / 2e-3
        poses, J = robot.pose(p, self._at), robot.body_jacobian(p, self._at)
        moves = poses[:, :3, :3] @ J[:, :3] * BAR  # (m, 3, n)
        x = poses[:, :3, 3]
        rows, slopes = [(x[-1] - self._target) / 1e-3], [moves[-1] / 1e-3]
        for item, asked in zip(self._case.objects, self._asked, strict=True):
            d, normals = self._distances(item, x)
            rows.append((d - asked) / 1e-3)
            slopes.append(np.einsum("mi,min->mn", normals, moves) / 1e-3)
            if "trocar" in item:
                left, slope = _passing(item["trocar"], x, moves)
                rows.append(np.array([left / 1e-3])), slopes.append(slope[None] / 1e-3)
        return logs[0], np.concatenate(rows), slope, np.vstack(slopes)

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


def _passing(ring: dict[str, Any], x: Vector, moves: Vector) -> tuple[float, Vector]:
    """What is left between a ring and the body where its centre line x (m, 3) crosses the plane.

    Else it is that beside its tip.  With the derivatives (n,).
    """
    axis = np.array(ring["axis"])
    height = (x - ring["centre"]) @ axis
    crossing = np.flatnonzero((height[:-1] <= 0) != (height[1:] <= 0))
    place, move = x[-1], moves[-1]
    if len(crossing):
        k = crossing[0]
        share, way = height[k] / (height[k] - height[k + 1]), x[k + 1] - x[k]
        place, move = x[k] + share * way, (1 - share) * moves[k] + share * moves[k + 1]
        move = move - np.outer(way, axis @ move) / (way @ axis)
    beside = place - ring["centre"]
    length = max(float(np.linalg.norm(beside)), 1e-9)
    return ring["radius"] - RADIUS - CLEARANCE - length, -beside @ move / length


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
