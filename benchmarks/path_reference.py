"""Reference solvers for paths that share no code with `solve_path`.

`PathProgram` solves the whole path as one nonlinear program on the model's functions, with IPOPT.
`lattice` is a dynamic program over many configurations at each point, for two segments.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import Manipulator
from stiffopt.model.compliance import directional_stiffness

Vector = NDArray[np.float64]

BAR = 1e5
MM = 1e3
_AT_ONCE = 100
INSIDE = 1e-4  # share of tolerances and rates that is left, against rounding


@dataclass(frozen=True)
class Question:
    """Positions of the tip at N points, and what may be between them.

    Attributes
    ----------
    positions : (N, 3) in m.
    directions : (N, 3) of the free translational stiffness, base axes.
    steps : (N - 1, n), largest changes of pressure, in bar.
    tolerance : in m.
    over : "worst" or "mean"
    """

    positions: Vector
    directions: Vector
    steps: Vector
    tolerance: float
    over: str


class PathProgram:
    """A path of a free arm as one nonlinear program."""

    def __init__(self, robot: Manipulator, count: int) -> None:
        self._robot, self._count, self._n = robot, count, robot.n_pressures
        tip = robot.tip_function("path_reference", _tip_and_stiffness, 3)
        n = self._n
        p, d = ca.SX.sym("p", n), ca.SX.sym("d", 3)
        position, stiffness = tip(p * BAR, ca.vertcat(ca.DM(robot.numbers), d))[:2]
        self.point = ca.Function("point", [p, d], [position * MM, stiffness])
        self._map = self.point.map(count)
        self._solvers: dict[str, ca.Function] = {}

    def stiffness(self, question: Question, x: Vector) -> Vector:
        """Logarithms (N,) of the stiffness at pressures (N, n) in bar."""
        values = self._map(x.T, question.directions.T)[1]
        return np.array(values).ravel()

    def value(self, question: Question, x: Vector) -> float:
        """The logarithm of the stiffness, the worst or on average."""
        k = self.stiffness(question, x)
        return float(k.min() if question.over == "worst" else k.mean())

    def holds(self, question: Question, x: Vector) -> bool:
        """Whether tips, limits and steps are kept, by the model's public methods."""
        off = self._robot.tip_pose(x * BAR)[:, :3, 3] - question.positions
        lower, upper = limits(self._robot)
        return bool(
            (np.linalg.norm(off, axis=1) <= question.tolerance).all()
            and (np.abs(np.diff(x, axis=0)) <= question.steps).all()
            and (x >= lower - 1e-12).all()
            and (x <= upper + 1e-12).all()
        )

    def improved(self, question: Question, x: Vector, most: int = 150) -> Vector | None:
        """A local optimum from pressures (N, n) in bar; None if it does not hold."""
        N, n = x.shape
        worst = question.over == "worst"
        tips, values = self._map(x.T, question.directions.T)
        off = (np.array(tips).T - question.positions * MM) / (question.tolerance * MM)
        start = np.concatenate([x.ravel(), off.ravel(), [np.array(values).min()]])
        lower, upper = limits(self._robot)
        free, balls = np.full(3 * N, np.inf), np.zeros(N)
        steps = question.steps.ravel() * (1 - INSIDE)
        parameters = [question.positions.ravel() * MM, question.directions.ravel()]
        found = self._solver(question.over, most)(
            x0=start, p=np.concatenate([*parameters, [question.tolerance * MM]]),
            lbx=np.concatenate([np.tile(lower, N), -free, [-np.inf if worst else 0.0]]),
            ubx=np.concatenate([np.tile(upper, N), free, [np.inf if worst else 0.0]]),
            lbg=np.concatenate([np.zeros(3 * N), balls - np.inf, -steps, np.zeros(N)]),
            ubg=np.concatenate([np.zeros(3 * N), balls + 1 - INSIDE, steps, np.full(N, np.inf)]),
        )  # fmt: skip
        best = np.array(found["x"]).ravel()[: N * n].reshape(N, n)
        best = np.clip(best, lower, upper)
        return best if self.holds(question, best) else None

    def _solver(self, over: str, most: int) -> ca.Function:
        if over not in self._solvers:
            N, n = self._count, self._n
            x, offsets, t = ca.MX.sym("x", n, N), ca.MX.sym("offsets", 3, N), ca.MX.sym("t")
            targets, directions = ca.MX.sym("targets", 3, N), ca.MX.sym("directions", 3, N)
            tolerance = ca.MX.sym("tolerance")  # mm
            tips, values = self._map(x, directions)
            least = values.T - t if over == "worst" else ca.MX.zeros(N)
            program = {
                "x": ca.vertcat(ca.vec(x), ca.vec(offsets), t),
                "p": ca.vertcat(ca.vec(targets), ca.vec(directions), tolerance),
                "f": -t if over == "worst" else -ca.sum2(values) / N,
                "g": ca.vertcat(
                    ca.vec(tips - targets - tolerance * offsets),
                    ca.sum1(offsets**2).T,
                    ca.vec(x[:, 1:] - x[:, :-1]),
                    least,
                ),
            }
            quiet = {
                "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
                "ipopt.max_iter": most, "ipopt.tol": 1e-5, "ipopt.constr_viol_tol": 1e-7,
                "ipopt.acceptable_tol": 1e-3, "ipopt.acceptable_constr_viol_tol": 1e-6,
                "error_on_fail": False,
            }  # fmt: skip
            self._solvers[over] = ca.nlpsol("path", "ipopt", program, quiet)
        return self._solvers[over]


def _tip_and_stiffness(shape: object, parameters: object) -> list[object]:
    stiffness = directional_stiffness(
        shape.compliance, shape.rotation, parameters,  # type: ignore[attr-defined]
        frame="base", kind="translation", boundary="free",
    )  # fmt: skip
    return [shape.position, ca.log(stiffness)]  # type: ignore[attr-defined]


# -- many configurations at each point -------------------------------------------------------------


def brought(robot: Manipulator, target: Vector, starts: Vector, steps: int = 8) -> Vector:
    """Pressures (k, n) in bar from starts towards targets (3,) or (k, 3), by Newton's method."""
    lower, upper = limits(robot)
    x = starts.copy()
    for _ in range(steps):
        T = robot.tip_pose(x * BAR)
        J = T[:, :3, :3] @ robot.tip_jacobian(x * BAR)[:, :3] * BAR
        off = target - T[:, :3, 3]
        square = J @ J.swapaxes(1, 2) + 1e-10 * np.eye(3)
        step = J.swapaxes(1, 2) @ np.linalg.solve(square, off[..., None])
        x = np.clip(x + np.clip(step[..., 0], -0.5, 0.5), lower, upper)
    return x


def followed(robot: Manipulator, question: Question, count: int, seed: int) -> Vector:
    """Starts (count, N, n) in bar: random pressures at the first target that go along the path."""
    rng = np.random.default_rng(seed)
    lower, upper = limits(robot)
    x = lower + (upper - lower) * rng.uniform(size=(count, len(lower)))
    found = []
    for target in question.positions:
        x = brought(robot, target, x, 4 if found else 12)
        found.append(x)
    return np.stack(found, axis=1)


def limits(robot: Manipulator) -> tuple[Vector, Vector]:
    """Limits (n,) of the pressures in bar."""
    return np.array(robot.pressure_min) / BAR, np.array(robot.pressure_max) / BAR


def _within(robot: Manipulator, target: Vector, tolerance: float, x: Vector) -> Vector:
    """Those of pressures (k, n) in bar whose tips are at a target."""
    off = np.linalg.norm(robot.tip_pose(x * BAR)[:, :3, 3] - target, axis=1)
    found: Vector = x[off <= tolerance * (1 - INSIDE)]
    return found


def lattice(
    robot: Manipulator, program: PathProgram, question: Question, per_point: int, seed: int
) -> Vector | None:
    """The best sequence (N, n) in bar over many configurations at each point; None without one.

    At the first point random pressures are brought to the target; at each further one those of the
    point before and some new ones; the worst value is maximised first, then the mean.
    """
    rng = np.random.default_rng(seed)
    lower, upper = limits(robot)
    before = np.zeros((0, len(lower)))
    layers: list[Vector] = []
    values: list[Vector] = []
    for index, target in enumerate(question.positions):
        step = question.steps[max(index - 1, 0)]
        chosen = before
        if len(before) > per_point // 2:
            chosen = before[rng.permutation(len(before))[: per_point // 2]]
        near = chosen + step * rng.uniform(-1, 1, chosen.shape)
        shares = rng.uniform(-0.2, 1.2, (per_point, len(lower)))
        new = lower + (upper - lower) * np.clip(shares, 0, 1)
        starts = np.vstack([chosen, np.clip(near, lower, upper), new[: per_point - len(chosen)]])
        offsets = rng.normal(size=(len(starts), 3))
        offsets *= rng.uniform(0, 0.9, (len(starts), 1)) ** (1 / 3) / np.linalg.norm(
            offsets, axis=1, keepdims=True
        )
        x = brought(robot, target + question.tolerance * offsets, starts)
        before = _within(robot, target, question.tolerance, x)
        layers.append(before)
        direction = question.directions[index]
        values.append(np.log(robot.stiffness(before * BAR, direction)))
    least = -np.inf
    if question.over == "worst":
        least = _sequence(layers, values, question.steps, -np.inf, bottleneck=True)[1]
        if not np.isfinite(least):
            return None
    found, total = _sequence(layers, values, question.steps, least - 1e-9, bottleneck=False)
    return found if np.isfinite(total) else None


def _sequence(
    layers: list[Vector], values: list[Vector], steps: Vector, least: float, bottleneck: bool
) -> tuple[Vector | None, float]:
    """The best sequence and its worst value (`bottleneck`), or sum of values from `least` on."""
    best = np.where(values[0] >= least, values[0], -np.inf)
    origins: list[NDArray[np.intp]] = []
    for index in range(1, len(layers)):
        own = np.where(values[index] >= least, values[index], -np.inf)
        came, origin = _from_before(layers[index - 1], best, layers[index], steps[index - 1])
        best = np.minimum(came, own) if bottleneck else came + own
        origins.append(origin)
    if not len(best) or not np.isfinite(best.max()):
        return None, -np.inf
    at = int(best.argmax())
    total, chain = float(best[at]), [at]
    for origin in reversed(origins):
        chain.append(int(origin[chain[-1]]))
    picked = [layer[k] for layer, k in zip(layers, chain[::-1], strict=True)]
    return np.array(picked), total


def _from_before(
    earlier: Vector, best: Vector, later: Vector, step: Vector
) -> tuple[Vector, NDArray[np.intp]]:
    """Of each later configuration the best value that leads to it within a step, and from where."""
    came, origin = np.full(len(later), -np.inf), np.zeros(len(later), dtype=np.intp)
    ordered = np.flatnonzero(np.isfinite(best))
    ordered = ordered[np.argsort(-best[ordered], kind="stable")]
    left = np.arange(len(later))
    for begin in range(0, len(ordered), _AT_ONCE):  # the best first
        some = ordered[begin : begin + _AT_ONCE]
        may = np.ones((len(left), len(some)), dtype=bool)
        for own, others, allowed in zip(later[left].T, earlier[some].T, step, strict=True):
            may &= np.abs(own[:, None] - others) <= allowed
        first = may.argmax(axis=1)
        reached = may[np.arange(len(left)), first]
        came[left[reached]] = best[some[first[reached]]]
        origin[left[reached]] = some[first[reached]]
        left = left[~reached]
    return came, origin
