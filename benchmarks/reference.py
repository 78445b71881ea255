"""Many-start reference solver for pressure tasks; it shares no code with stiffopt's optimiser.

The program is formulated anew on the model's functions and solved with SciPy: `least_squares`
(trust-region reflective) brings random pressures to the pose, and SLSQP continues from there.
Tolerances are balls as in the task: with a residual e and its radius rho the constraints are
``e / rho = s`` and ``s.s <= 1``, with slack variables s.  The status of SLSQP is ignored: a point
counts if the model's own methods confirm pose, limits and demands.

Angles are measured by chords (``|z - d|``, ``|R - R_d|``), not by logarithms as in stiffopt.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from stiffopt import EquilibriumError, Manipulator, MatchMatrix, MatchValue, Task
from stiffopt.model.compliance import directional_stiffness, stiffness_block

Vector = NDArray[np.float64]

BAR = 1e5
SLACK = 1e-5  # share of a tolerance by which the reference may overstep it


@dataclass(frozen=True)
class Answer:
    """Best point of a reference.

    Attributes
    ----------
    pressures : (n,) in Pa.
    value : smallest stiffness that is maximised; else the distance from what is to be matched
        (relative); else the mean square of the pressures in bar^2.
    reached : starts that ended at the pose.
    agreeing : of those the ones within 0.1 % of the best.
    spread : largest difference of a pressure in bar between those within 1e-6 of the best; None
        if that is but one.
    """

    pressures: Vector
    value: float
    reached: int
    agreeing: int
    spread: float | None = None


@dataclass(frozen=True)
class Closest:
    """Closest configuration that a reference finds to an unreachable pose.

    Attributes
    ----------
    position, angle : errors in m and rad, None where not asked for.
    spread : largest difference of a pressure in bar between those as close within 10 nm (10 nrad).
    """

    position: float | None
    angle: float | None
    spread: float | None


class Reference:
    """A task as a nonlinear program for SciPy."""

    def __init__(self, robot: Manipulator, task: Task) -> None:
        load = task.tip_load
        self.robot = robot.with_load(load.force, load.moment, load.frame) if load else robot
        self.task = task
        lower, upper = task.pressure_bounds(robot.description)
        self.lower, self.upper = lower / BAR, upper / BAR
        self.n = len(lower)
        goal = task.stiffness
        match = (goal.match,) if goal and goal.match else ()
        self.measures = (*goal.maximise, *match, *goal.at_least) if goal else ()
        self.count = len(goal.maximise) if goal else 0
        self._parameters = np.concatenate(
            [
                np.zeros(0),
                *(
                    np.ravel(m.matrix if isinstance(m, MatchMatrix) else m.direction)
                    for m in self.measures
                ),
            ]
        )
        structure = tuple(_structure(measure) for measure in self.measures)
        self._function = self.robot.evaluator(
            ("reference", structure), lambda s, p: _outputs(structure, s, p), len(self._parameters)
        )
        self._pose_function = self.robot.evaluator("reference pose", lambda s, _: _pose(s))
        self._cache: dict[bytes, tuple[Vector, ...]] = {}
        self.radii: dict[str, float] = {"position": task.target.tolerance.position}
        angle = task.target.tolerance.angle
        self.radii["angle"] = _chord(angle, task.target.orientation is not None)

    # -- evaluation -------------------------------------------------------------------------

    def _values(self, x: Vector) -> tuple[Vector, ...]:
        key = x.tobytes()
        if key not in self._cache:
            self._cache = {
                key: self._checked(self._function(x * BAR, self.robot.parameters(self._parameters)))
            }
        return self._cache[key]

    def _pose_values(self, x: Vector) -> tuple[Vector, ...]:
        key = b"pose" + x.tobytes()
        if key not in self._cache:
            self._cache = {key: self._checked(self._pose_function(x * BAR))}
        return self._cache[key]

    @staticmethod
    def _checked(values: list[Vector]) -> tuple[Vector, ...]:
        if not all(np.isfinite(value).all() for value in values):
            raise FloatingPointError("the model is not finite")
        return tuple(values)

    def residuals(self, values: tuple[Vector, ...]) -> dict[str, tuple[Vector, Vector]]:
        """Residual (k,) and Jacobian (k, n) per bar for each part of the pose."""
        position, R, J = values[0][:, 0], values[1], values[2] * BAR
        target = self.task.target
        parts = {}
        if target.position is not None:
            axes = [i for i in range(3) if target.position[i] is not None]
            wanted = np.array([target.position[i] for i in axes], dtype=float)
            parts["position"] = (position[axes] - wanted, (R @ J[:3])[axes])
        turns = np.stack([R @ _hat(w) for w in J[3:].T])  # (n, 3, 3)
        if target.pointing is not None:
            parts["angle"] = (R[:, 2] - np.array(target.pointing), turns[:, :, 2].T)
        if target.orientation is not None:
            w, x, y, z = target.orientation
            wanted_rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
            parts["angle"] = ((R - wanted_rotation).ravel(), turns.reshape(len(turns), 9).T)
        return parts

    # -- starts -----------------------------------------------------------------------------

    def starts(self, count: int, seed: int) -> Vector:
        """Random pressures (count, n) in bar, a part of them at limits."""
        unit = np.random.default_rng(seed).random((count, self.n))
        return self.lower + (self.upper - self.lower) * np.clip(1.2 * unit - 0.1, 0, 1)

    def reach(self, x: Vector, names: tuple[str, ...]) -> Vector | None:
        """Pressures nearest to the named parts of the pose, from x."""
        scales = {"position": self.robot.length, "angle": 1.0}

        def stacked(which: int) -> Callable[[Vector], Vector]:
            def function(x: Vector) -> Vector:
                parts = self.residuals(self._pose_values(x))
                return np.concatenate([parts[name][which] / scales[name] for name in names])

            return function

        upper = np.maximum(self.upper, self.lower + 1e-9)  # a channel may be held at a value
        width = 1e-6 * (upper - self.lower)
        inside = np.clip(x, self.lower + width, upper - width)
        self._pose_function.restart()
        try:
            result = least_squares(
                stacked(0), inside, stacked(1), bounds=(self.lower, upper),
                xtol=1e-11, ftol=1e-14, gtol=1e-12, max_nfev=60,
            )  # fmt: skip
        except (EquilibriumError, FloatingPointError):
            return None
        return np.clip(result.x, self.lower, self.upper)

    # -- programs ---------------------------------------------------------------------------

    def descend(
        self,
        x: Vector,
        objective: Callable[[Vector], tuple[float, Vector]] | None = None,
        names: tuple[str, ...] | None = None,
        floors: bool = True,
        most: int = 150,
    ) -> Vector | None:
        """SLSQP from x; the variables are x, one t for the worst of several, and the slacks."""
        names = tuple(self.residuals(self._pose_values(x))) if names is None else names
        parts = {name: self.residuals(self._pose_values(x))[name] for name in names}
        sizes = [len(parts[name][0]) for name in names]
        n, several = self.n, int(objective is None and self.count > 1)
        goal = self.task.stiffness
        floor_values = np.log([f.value for f in goal.at_least]) if goal and floors else np.zeros(0)
        first_floor = len(self.measures) - len(floor_values)
        total = n + several + sum(sizes)
        begin = n + several

        def pose(z: Vector) -> tuple[Vector, ...]:
            use = objective is None or len(floor_values)
            return (self._values if use else self._pose_values)(z[:n])

        def cost(z: Vector) -> float:
            return -z[n] if several else self._cost(z[:n], objective)[0]

        def cost_slope(z: Vector) -> Vector:
            slope = np.zeros(total)
            if several:
                slope[n] = -1
            else:
                slope[:n] = self._cost(z[:n], objective)[1]
            return slope

        def equal(z: Vector) -> Vector:
            parts = self.residuals(pose(z))
            scaled = [parts[name][0] / self.radii[name] for name in names]
            return np.concatenate([np.zeros(0), *scaled]) - z[begin:]

        def equal_slope(z: Vector) -> Vector:
            parts = self.residuals(pose(z))
            rows = [parts[name][1] / self.radii[name] for name in names]
            block = np.vstack([np.zeros((0, n)), *rows])
            between = np.zeros((len(block), several))
            return np.hstack([block, between, -np.eye(len(block))])

        def least(z: Vector) -> Vector:
            values, _ = self._stiffnesses(z[:n]) if len(self.measures) else (np.zeros(0), 0)
            worst = values[: self.count] - z[n] if several else np.zeros(0)
            used, balls = begin, []
            for size in sizes:
                balls.append(1 - z[used : used + size] @ z[used : used + size])
                used += size
            above = values[first_floor:] - floor_values if len(floor_values) else np.zeros(0)
            return np.concatenate([worst, balls, above, self._spare_clearance(z[:n])[0]])

        def least_slope(z: Vector) -> Vector:
            rows = []
            slopes = self._stiffnesses(z[:n])[1] if len(self.measures) else np.zeros((0, n))
            if several:
                row = np.zeros((self.count, total))
                row[:, :n] = slopes[: self.count]
                row[:, n] = -1
                rows.append(row)
            used = begin
            for size in sizes:
                row = np.zeros((1, total))
                row[0, used : used + size] = -2 * z[used : used + size]
                rows.append(row)
                used += size
            if len(floor_values):
                row = np.zeros((len(floor_values), total))
                row[:, :n] = slopes[first_floor:]
                rows.append(row)
            clear = self._spare_clearance(z[:n])[1]
            rows.append(np.pad(clear, ((0, 0), (0, total - n))))
            return np.vstack(rows)

        start = np.zeros(total)
        start[:n] = x
        self._function.restart()
        try:
            if several:
                start[n] = self._stiffnesses(x)[0][: self.count].min()
            start[begin:] = equal(start)  # slacks equal to the residuals
            for i, size in enumerate(sizes):
                used = begin + sum(sizes[:i])
                length = np.linalg.norm(start[used : used + size])
                start[used : used + size] /= max(1.0, length)
            limits = [*zip(self.lower, self.upper, strict=True)] + [(None, None)] * (total - n)
            result = minimize(
                cost, start, jac=cost_slope, method="SLSQP", bounds=limits,
                constraints=[
                    {"type": "eq", "fun": equal, "jac": equal_slope},
                    {"type": "ineq", "fun": least, "jac": least_slope},
                ],
                options={"maxiter": most, "ftol": 1e-11},
            )  # fmt: skip
        except (EquilibriumError, FloatingPointError):
            return None
        if not np.isfinite(result.x).all():
            return None
        return np.clip(result.x[:n], self.lower, self.upper)

    def _stiffnesses(self, x: Vector) -> tuple[Vector, Vector]:
        values = self._values(x)
        return values[3][:, 0], values[4] * BAR

    def _spare_clearance(self, x: Vector) -> tuple[Vector, Vector]:
        """Distances (k,) from objects beyond the clearance, in mm, and slopes (k, n) per bar."""
        if self.task.scene is None:
            return np.zeros(0), np.zeros((0, self.n))
        found = self.robot.clearances(x * BAR, self.task.scene)
        return 1e3 * (found.distances - self.task.scene.clearance), 1e3 * BAR * found.gradients

    def _cost(
        self, x: Vector, objective: Callable[[Vector], tuple[float, Vector]] | None
    ) -> tuple[float, Vector]:
        if objective is not None:
            return objective(x)
        goal = self.task.stiffness
        if self.count:
            values, slopes = self._stiffnesses(x)
            return -values[0], -slopes[0]
        if goal is not None and isinstance(goal.match, MatchValue):
            values, slopes = self._stiffnesses(x)
            miss = values[0] - np.log(goal.match.value)
            return miss**2, 2 * miss * slopes[0]
        if goal is not None and goal.match is not None:
            values, slopes = self._stiffnesses(x)
            return values[0], slopes[0]
        return float(x @ x) / self.n, 2 * x / self.n

    # -- answers ----------------------------------------------------------------------------

    def holds(self, x: Vector, floors: bool = True) -> bool:
        """Whether the model confirms the pose (and the floors) at x, by its public methods."""
        try:
            pose = self.robot.tip_pose(x * BAR)
        except EquilibriumError:
            return False
        position, angle = pose_errors(self.task, pose)
        tolerance = self.task.target.tolerance
        near = (position is None or position <= tolerance.position * (1 + SLACK)) and (
            angle is None or angle <= tolerance.angle * (1 + SLACK)
        )
        near = near and bool((self._spare_clearance(x)[0] > -0.01).all())
        goal = self.task.stiffness
        if not near or goal is None or not floors:
            return near
        return all(
            self._stiffness(x, floor) >= floor.value * (1 - SLACK) for floor in goal.at_least
        )

    def _stiffness(self, x: Vector, m: Any) -> float:
        return float(self.robot.stiffness(x * BAR, m.direction, m.kind, m.boundary, m.frame))

    def value(self, x: Vector) -> float:
        """What `Answer.value` says, by the public methods of the model."""
        goal = self.task.stiffness
        if self.count and goal is not None:
            return min(self._stiffness(x, m) for m in goal.maximise)
        if goal is not None and isinstance(goal.match, MatchValue):
            return abs(self._stiffness(x, goal.match) / goal.match.value - 1)
        if goal is not None and goal.match is not None:
            return float(np.sqrt(self._values(x)[3][0, 0]))
        return float(x @ x) / self.n

    def best(self, starts: int, seed: int = 0, floors: bool = True) -> Answer | None:
        """Best point of many starts that reaches the pose; None if none does."""
        names = tuple(self.residuals(self._pose_values((self.lower + self.upper) / 2)))
        points: list[tuple[float, Vector]] = []
        sign = -1.0 if self.count else 1.0
        for x in self.starts(starts, seed):
            near = self.reach(x, names)
            end = None if near is None else self.descend(near, floors=floors)
            if end is not None and self.holds(end, floors):
                points.append((sign * self.value(end), end))
        if not points:
            return None
        value, x = min(points, key=lambda point: point[0])
        agreeing = sum(v - value <= 1e-3 * max(abs(value), 1e-6) for v, _ in points)
        size = max(abs(value), 1e-6)
        same = [end for v, end in points if v - value <= 1e-6 * size]
        spread = float(np.ptp(same, axis=0).max()) if len(same) > 1 else None
        return Answer(x * BAR, sign * value, len(points), agreeing, spread)

    def closest(self, starts: int, seed: int = 0) -> Closest:
        """Least error of the position; or of the angle first, where both are asked for."""
        names = tuple(self.residuals(self._pose_values((self.lower + self.upper) / 2)))
        first = "angle" if "angle" in names else "position"
        ends = [self.reach(x, (first,)) for x in self.starts(starts, seed)]
        pairs = [(self._errors(x), x) for x in ends if x is not None]
        if len(names) == 1:
            which = 0 if first == "position" else 1
            return _closest([(errors[which], errors, x) for errors, x in pairs])
        least = min(errors[1] for errors, _ in pairs)
        allowed = max(self.task.target.tolerance.angle, least * (1 + 1e-6) + 1e-7)
        self.radii["angle"] = _chord(allowed, self.task.target.orientation is not None)
        length = self.robot.length

        def objective(x: Vector) -> tuple[float, Vector]:
            residual, slope = self.residuals(self._pose_values(x))["position"]
            return float(residual @ residual) / length**2, 2 * residual @ slope / length**2

        found = []
        for errors, x in pairs:
            if errors[1] > allowed * (1 + SLACK) + 1e-6:
                continue
            for point in (x, self.descend(x, objective, ("angle",), floors=False)):
                if point is None:
                    continue
                errors = self._errors(point)
                if errors[1] <= allowed * (1 + 1e-4) + 1e-6:
                    found.append((errors[0], errors, point))
        return _closest(found)

    def _errors(self, x: Vector) -> tuple[float, float]:
        position, angle = pose_errors(self.task, self.robot.tip_pose(x * BAR))
        return (np.nan if position is None else position, np.nan if angle is None else angle)


def _closest(found: list[tuple[float, tuple[float, float], Vector]]) -> Closest:
    least, errors, _ = min(found, key=lambda item: item[0])
    same = [x for error, _, x in found if error <= least + 1e-8]
    spread = float(np.ptp(same, axis=0).max()) if len(same) > 1 else None
    position, angle = (None if np.isnan(error) else error for error in errors)
    return Closest(position, angle, spread)


def pose_errors(task: Task, pose: Vector) -> tuple[float | None, float | None]:
    """Errors (m, rad) of a tip pose from a task's target, None where not asked for."""
    target = task.target
    position = angle = None
    if target.position is not None:
        pairs = zip(pose[:3, 3], target.position, strict=True)
        position = float(np.sqrt(sum((a - b) ** 2 for a, b in pairs if b is not None)))
    if target.pointing is not None:
        z, wanted = pose[:3, 2], np.array(target.pointing)
        angle = float(np.arctan2(np.linalg.norm(np.cross(wanted, z)), wanted @ z))
    if target.orientation is not None:
        w, x, y, z = target.orientation
        turn = Rotation.from_quat([x, y, z, w]).inv() * Rotation.from_matrix(pose[:3, :3])
        angle = float(turn.magnitude())
    return position, angle


def _chord(angle: float, of_rotation: bool) -> float:
    return float((2 * np.sqrt(2) if of_rotation else 2) * np.sin(min(angle, np.pi) / 2))


def _hat(w: Vector) -> Vector:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def _structure(measure: Any) -> tuple[str, ...]:
    kind = "matrix" if isinstance(measure, MatchMatrix) else measure.kind
    return kind, measure.frame, measure.boundary


def _pose(shape: Any) -> list[Any]:
    return [shape.position, shape.rotation, shape.jacobian]


def _outputs(structure: tuple[tuple[str, ...], ...], shape: Any, parameters: Any) -> list[Any]:
    """Pose, logarithms of the stiffnesses (a matrix: squared distance) and their slopes."""
    values, used = [], 0
    for kind, frame, boundary in structure:
        if kind == "matrix":
            wanted = ca.reshape(parameters[used : used + 9], 3, 3)
            used += 9
            K = stiffness_block(shape.compliance, "translation", boundary)
            if frame == "base":
                K = shape.rotation @ K @ shape.rotation.T
            values.append(ca.sumsqr(K - wanted) / ca.sumsqr(wanted))
            continue
        d = parameters[used : used + 3]
        used += 3
        k = directional_stiffness(
            shape.compliance, shape.rotation, d, frame=frame, kind=kind, boundary=boundary
        )
        values.append(ca.log(k))
    if not values:
        return [*_pose(shape), ca.DM.zeros(0, 1), ca.DM.zeros(0, 0)]
    column = ca.vertcat(*values)
    return [*_pose(shape), column, ca.densify(shape.total_jacobian(column))]
