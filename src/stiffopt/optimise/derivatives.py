"""Derivatives of an answer with respect to the task, by the implicit function theorem.

At an answer, the terms f of the objective, the balls c, the floors g and the active limits
determine the pressures x (shares of their ranges), the multipliers and the value t of the
objective::

    sum lambda_i grad f_i + sum mu_b grad c_b - sum nu_j grad g_j = 0   (pressures off their limits)
    f_i = t,  sum lambda_i = 1,  c_b = (|r_b|^2 / rho_b^2 - 1) / 2 = 0,  g_j = bound_j

For a one-sided ball, c_b = r_b / rho_b - 1; so is each local minimum of the distance from an
object, see `stiffopt.optimise.least_distances`.  This system is F(y, theta) = 0, so ``dy =
-(dF/dy)^-1 dF/dtheta``; the derivative of the value is ``dt = dL/dtheta`` alone.

The model's first derivatives are exact.  Second ones are their central differences (relative error
about 1e-7), as there is no formula under gravity or loads.  The curvature of a ball, whose radius
is small, is taken from its formula.  An answer is exact only to the optimiser's precision, so a few
Newton steps come first.
"""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.directions import unit_vector
from stiffopt.errors import DerivativeError, InputError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.least_distances import FollowedObstacles
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import DERIVATIVES, DESCENT
from stiffopt.optimise.task import Task

By = Literal["target", "direction", "limits", "clearance"]


class _Change(NamedTuple):
    """Rates of change of a point: terms and floors (k,), residual (m,), gradients (., n)."""

    terms: Array
    term_gradients: Array
    floors: Array
    floor_gradients: Array
    residual: Array
    jacobian: Array

    @classmethod
    def of(cls, points: list[ProgramPoint], weights: Array) -> "_Change":
        """Return the weighted sum of points."""
        return cls(
            *(
                np.tensordot(weights, [getattr(point, name) for point in points], 1)
                for name in cls._fields
            )
        )


@dataclass
class _Active:
    """Active constraints: indices of terms, constraints and floors; pressures held (n,)."""

    terms: list[int]
    balls: list[int]
    floors: list[int]
    held: Flags


class AnswerDerivatives:
    """Derivatives of the answer to a task.

    Raises `DerivativeError` if the answer is not an isolated optimum.

    Parameters
    ----------
    robot : the arm, which carries the task's load.
    pressures : (n,), the answer, in Pa.

    Attributes
    ----------
    weak : constraints that are about to become active or inactive.  If there are any, derivatives
        hold only on the side on which the active constraints stay the same.
    """

    def __init__(self, robot: Manipulator, task: Task, pressures: Array) -> None:
        self._problem = problem = _problem(robot, task, pressures)
        self._evaluate = _evaluation(problem)
        x = pressures / problem.unit
        self._point = self._evaluate(x, problem.parameters)
        prices = LocalResult.at(problem, self._point).multipliers
        if prices is None:
            raise DerivativeError("the answer is no optimum, so that it has no derivatives")
        touching = DERIVATIVES.touching
        self._active = _Active(
            np.flatnonzero(prices.terms > DERIVATIVES.least).tolist(),
            [i for i, pull in enumerate(prices.balls) if self._seems_to_bind(i, pull)],
            np.flatnonzero(prices.floors > DERIVATIVES.least).tolist(),
            (x <= problem.lower + touching) | (x >= problem.upper - touching),
        )
        self._snap()
        beside = len(self._active.balls) + len(self._active.floors)
        self._weights = np.concatenate([prices.terms[self._active.terms], np.zeros(beside)])
        for _ in range(DERIVATIVES.rounds):
            self._polish()
            if not self._changed():
                break
        else:
            raise DerivativeError("which constraints bind at the answer is not clear")
        self._check_distances()
        self.weak = tuple(self._weak_names())

    def _seems_to_bind(self, i: int, pull: Array) -> bool:
        """Return whether a constraint is first assumed to be active, by its error and its price."""
        c = self._problem.constraints[i]
        if c.first >= self._problem.program.n_own_rows:
            return bool(pull.any())  # many minima may be equally near
        return bool(self._point.errors[i] > c.radius * (1 - DERIVATIVES.near))

    def _check_distances(self) -> None:
        """Reject an answer at which a distance's slope changes differently on its two sides."""
        problem, point = self._problem, self._point
        bind = [problem.constraints[i] for i in self._active.balls]
        names = {c.first: c.name for c in bind if c.first >= problem.program.n_own_rows}
        if not names:
            return
        ways, rows = DERIVATIVES.step * np.eye(len(point.x)), list(names)
        after, before = (
            np.array([self._evaluate(x, problem.parameters).jacobian[rows] for x in point.x + side])
            - point.jacobian[rows]
            for side in (ways, -ways)
        )  # (n, k, n)
        uneven, even = (np.abs(each).max(axis=(0, 2)) for each in (after + before, after - before))
        for name, is_edge in zip(names.values(), uneven > DERIVATIVES.edge * even, strict=True):
            if is_edge:
                raise DerivativeError(
                    f"the {name} has an edge at the answer, which has no derivatives there"
                )

    def _snap(self) -> None:
        """Put held pressures onto their limits."""
        problem, x = self._problem, self._point.x
        nearest = np.where(x - problem.lower < problem.upper - x, problem.lower, problem.upper)
        x = np.where(self._active.held, nearest, np.clip(x, problem.lower, problem.upper))
        self._point = self._evaluate(x, problem.parameters)

    # -- derivatives ------------------------------------------------------------------------

    def gradient(self, of: str, by: By) -> Array:
        """See `PressureSolution.gradient`."""
        if of not in ("stiffness", "pressures"):
            raise InputError(f"derivatives are of 'stiffness' or 'pressures'; got {shown(of)}")
        if of == "stiffness" and self._problem.program.aim != "maximise":
            raise InputError("only a stiffness that is maximised has a derivative")
        if by == "limits":
            return self._by_limits(of)
        if by == "target":
            return np.stack([self._by(of, change) for change in self._target_changes()], -1)
        if by == "clearance":
            return self._by(of, self._clearance_change())
        if by == "direction":
            rows = [[self._by(of, c) for c in each] for each in self._direction_changes()]
            found = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
            return found[..., 0, :] if len(rows) == 1 else found
        raise InputError(
            f"derivatives are by 'target', 'direction', 'limits' or 'clearance'; got {shown(by)}"
        )

    def _by(self, of: str, change: _Change, moved: int | None = None) -> Array:
        """Return the derivative of the answer for a change of the program."""
        if of == "stiffness":
            t = float(self._point.terms.max())
            return np.asarray(-np.exp(-t) * self._value_rate(change))
        rate = np.zeros(len(self._point.x))
        rate[~self._active.held] = -np.linalg.solve(self._matrix, self._rates(change))[
            : int((~self._active.held).sum())
        ]
        if moved is not None:
            rate[moved] = 1.0
        return rate * self._problem.unit

    def _by_limits(self, of: str) -> Array:
        """Return derivatives (..., 2, n) by lower and upper limits; zero for inactive ones."""
        problem, n = self._problem, len(self._point.x)
        found = np.zeros((2, n, n) if of == "pressures" else (2, n))
        for i in np.flatnonzero(self._active.held).tolist():
            upper = int(self._point.x[i] >= problem.upper[i] - DESCENT.touching)
            found[upper, i] = self._by(of, self._inward_change(i), i) / problem.unit[i]
        return np.moveaxis(found, -1, 0) if of == "pressures" else found

    def _clearance_change(self) -> _Change:
        """Return the change per m of clearance."""
        if self._problem.task.scene is None:
            raise InputError("only a task with a scene has a clearance")
        none = _Change.of([self._point], np.zeros(1))
        own = np.arange(len(none.residual)) < self._problem.program.n_own_rows
        return none._replace(residual=np.where(own, 0.0, 1.0))

    def _target_changes(self) -> list[_Change]:
        """Return the changes by a motion of the target in base axes: per m, and per rad."""
        target = self._problem.task.target
        turns = any(term.unit == "rad" for term in target.terms)
        axes = np.eye(6)[: 6 if turns else 3]
        return [self._difference(partial(self._moved_target, axis)) for axis in axes]

    def _moved_target(self, way: Array, by: float) -> Program:
        return self._problem.program.at(self._problem.task.target.moved_back(-by * way))

    def _direction_changes(self) -> Iterator[list[_Change]]:
        """Yield the changes by each component of each direction that is maximised."""
        program = self._problem.program
        for k, measure in enumerate(program.measures[: program.n_terms]):
            if program.aim != "maximise" or not isinstance(measure, StiffnessMeasure):
                raise InputError("only a stiffness that is maximised has a direction")
            yield [self._difference(partial(_turned, program, k, axis)) for axis in np.eye(3)]

    def _difference(self, program_at: Callable[[float], Program]) -> _Change:
        """Return the change by a parameter of the program, as a central difference."""
        h, robot = DERIVATIVES.step_of_parameters, self._problem.robot
        programs = (program_at(-h), program_at(h))
        points = [self._evaluate(self._point.x, robot.parameters(p.parameters)) for p in programs]
        return _Change.of(points, np.array([-0.5, 0.5]) / h)

    # -- the system -------------------------------------------------------------------------

    def _change(self, i: int) -> _Change:
        """Return the change by one of the pressures."""
        return self._combined(i, (-1.0, 1.0), (-0.5, 0.5))

    def _inward_change(self, i: int) -> _Change:
        """Return the change by a pressure at a limit, from inside: there may be a kink."""
        if self._point.x[i] <= self._problem.lower[i] + DESCENT.touching:
            return self._combined(i, (1.0, 2.0, 3.0), (-2.5, 4.0, -1.5))
        return self._combined(i, (-1.0, -2.0, -3.0), (2.5, -4.0, 1.5))

    def _combined(self, i: int, steps: tuple[float, ...], weights: tuple[float, ...]) -> _Change:
        h, problem = DERIVATIVES.step, self._problem
        e = np.eye(len(self._point.x))[i]
        points = [self._evaluate(self._point.x + h * s * e, problem.parameters) for s in steps]
        return _Change.of(points, np.array(weights) / h)

    def _split(self) -> tuple[Array, Array, Array]:
        """Return the multipliers of the active terms, balls and floors."""
        a = len(self._active.terms)
        b = a + len(self._active.balls)
        return self._weights[:a], self._weights[a:b], self._weights[b:]

    def _ball_slopes(self, change: _Change) -> tuple[Array, Array]:
        """Return the rates of the active balls (b,), and their gradients' weighted sum (n,)."""
        rates, slope = [], np.zeros(len(self._point.x))
        for i, weight in zip(self._active.balls, self._split()[1], strict=True):
            c = self._problem.constraints[i]
            rows, rho = slice(c.first, c.end), c.radius
            dr, dJ = change.residual[rows], change.jacobian[rows]
            if c.one_sided:
                rates.append(dr[0] / rho)
                slope += weight * dJ[0] / rho
                continue
            r, J = self._point.residual[rows], self._point.jacobian[rows]
            rates.append(r @ dr / rho**2)
            slope += weight * (dr @ J + r @ dJ) / rho**2
        return np.array(rates), slope

    def _rates(self, change: _Change) -> Array:
        """Return the rate of F with the unknowns fixed."""
        terms, _, floors = self._split()
        active = self._active
        ball_rates, slope = self._ball_slopes(change)
        slope = slope + terms @ change.term_gradients[active.terms]
        slope = slope - floors @ change.floor_gradients[active.floors]
        return np.concatenate(
            [slope[~active.held], change.terms[active.terms], [0.0], ball_rates,
             change.floors[active.floors]]
        )  # fmt: skip

    def _value_rate(self, change: _Change) -> float:
        """Return the rate of the objective's value, which is that of the Lagrangian."""
        terms, balls, floors = self._split()
        return float(
            terms @ change.terms[self._active.terms]
            + balls @ self._ball_slopes(change)[0]
            - floors @ change.floors[self._active.floors]
        )

    def _constraint_slopes(self) -> Array:
        """Return the gradients (k, n) of active constraints, in the order of the multipliers."""
        point, active = self._point, self._active
        rows = [*point.term_gradients[active.terms]]
        for i in active.balls:
            c = self._problem.constraints[i]
            weights = np.ones(1) / c.radius
            if not c.one_sided:
                weights = point.residual[c.first : c.end] / c.radius**2
            rows.append(weights @ point.jacobian[c.first : c.end])
        return np.array([*rows, *(-point.floor_gradients[active.floors])])

    def _left(self) -> Array:
        """Return F at the present point."""
        point, active, problem = self._point, self._active, self._problem
        slopes, terms = self._constraint_slopes(), self._split()[0]
        balls = []
        for i in active.balls:
            share = point.errors[i] / problem.constraints[i].radius
            inside = DESCENT.inside
            one_sided = problem.constraints[i].one_sided
            balls.append(share - inside if one_sided else (share**2 - inside**2) / 2)
        floors = point.floors[active.floors] - problem.floors[active.floors]
        return np.concatenate(
            [(self._weights @ slopes)[~active.held], point.terms[active.terms] - self._t,
             [terms.sum() - 1], balls, floors]
        )  # fmt: skip

    def _set_matrix(self) -> None:
        """Set the derivative of F by the unknowns: free pressures, t, and multipliers."""
        free, active = ~self._active.held, self._active
        slopes = self._constraint_slopes()[:, free]
        n, a, k = int(free.sum()), len(active.terms), len(slopes)
        signs = np.where(np.arange(k) < k - len(active.floors), 1.0, -1.0)
        K = np.zeros((n + 1 + k, n + 1 + k))
        for column, i in enumerate(np.flatnonzero(free).tolist()):
            K[:n, column] = self._rates(self._change(i))[:n]
        K[:n, :n] = (K[:n, :n] + K[:n, :n].T) / 2
        K[:n, n + 1 :] = slopes.T
        rows = [*range(n, n + a), *range(n + a + 1, n + 1 + k)]
        K[rows, :n] = signs[:, np.newaxis] * slopes
        K[n : n + a, n] = -1.0
        K[n + a, n + 1 : n + 1 + a] = 1.0
        if np.linalg.cond(K) > DERIVATIVES.largest_condition:
            raise DerivativeError(
                "other pressures next to the answer are as good, so that it has no derivatives"
            )
        self._matrix = K

    def _polish(self) -> None:
        """Run Newton's method from the answer to the optimum with the same active constraints."""
        free = ~self._active.held
        n = int(free.sum())
        self._t = float(self._point.terms.max())
        slopes, a = self._constraint_slopes()[:, free], len(self._active.terms)
        if len(slopes) > a:  # refine the prices, which are as inexact as the answer
            pull = self._weights[:a] @ slopes[:a]
            self._weights[a:] = np.linalg.lstsq(slopes[a:].T, -pull, rcond=None)[0]
        for _ in range(DERIVATIVES.iterations):
            self._set_matrix()
            step = np.linalg.solve(self._matrix, -self._left())
            step *= min(
                1.0, DERIVATIVES.longest_step / max(np.abs(step[:n]).max(initial=0.0), 1e-99)
            )
            x = self._point.x.copy()
            x[free] += step[:n]
            self._t += step[n]
            self._weights = self._weights + step[n + 1 :]
            self._point = self._evaluate(x, self._problem.parameters)
            if np.abs(step[:n]).max(initial=0.0) < DERIVATIVES.small_step:
                return
        raise DerivativeError("the answer is too far from an optimum to have derivatives")

    # -- active constraints -----------------------------------------------------------------

    def _changed(self) -> bool:
        """Drop multipliers of wrong sign, add violations; return whether the active set changed."""
        problem, point, active, tiny = self._problem, self._point, self._active, DERIVATIVES.tiny
        x, errors = point.x, zip(point.errors, problem.constraints, strict=True)
        violated = (
            point.terms > self._t + tiny,
            np.array([error > c.radius * (1 + tiny) for error, c in errors], dtype=bool),
            point.floors < problem.floors - tiny,
        )
        kept: list[list[int]] = []
        weights: list[float] = []
        for old, own, beyond in zip(
            (active.terms, active.balls, active.floors), self._split(), violated, strict=True
        ):
            pushing = {i: w for i, w in zip(old, own, strict=True) if w > -tiny}
            pushing.update({int(i): 0.0 for i in np.flatnonzero(beyond) if i not in pushing})
            kept.append(list(pushing))
            weights += pushing.values()
        held = active.held | (x < problem.lower) | (x > problem.upper)
        for i in np.flatnonzero(active.held).tolist():
            held[i] = self._price(i) > -DERIVATIVES.least
        now = _Active(kept[0], kept[1], kept[2], held)
        changed = any(getattr(now, name) != getattr(active, name)
                      for name in ("terms", "balls", "floors"))  # fmt: skip
        changed = changed or bool((held != active.held).any())
        if changed:
            self._active, self._weights = now, np.array(weights)
            self._snap()
        return changed

    def _price(self, i: int) -> float:
        """Return the objective's slope as a pressure leaves its limit, per share of its range."""
        inward = 1.0 if self._point.x[i] <= self._problem.lower[i] + DESCENT.touching else -1.0
        return inward * self._value_rate(self._inward_change(i))

    def _weak_names(self) -> Iterator[str]:
        problem, point, active, near = self._problem, self._point, self._active, DERIVATIVES.weak
        terms, balls, floors = self._split()
        for i, value in enumerate(point.terms):
            weight = terms[active.terms.index(i)] if i in active.terms else 0.0
            if weight < near and value > self._t - near:
                yield f"stiffness {i + 1}"
        for i, (error, c) in enumerate(zip(point.errors, problem.constraints, strict=True)):
            weight = balls[active.balls.index(i)] if i in active.balls else 0.0
            if weight < near * DERIVATIVES.least and error > c.radius * (1 - near):
                yield c.name
        for i, value in enumerate(point.floors):
            weight = floors[active.floors.index(i)] if i in active.floors else 0.0
            if weight < near and value < problem.floors[i] + near:
                yield f"stiffness {problem.program.n_terms + i + 1}"
        for i, held in enumerate(active.held):
            off = min(point.x[i] - problem.lower[i], problem.upper[i] - point.x[i])
            if (held and self._price(i) < near) or (not held and off < near):
                yield problem.robot.description.channel_name(i)


def _turned(program: Program, which: int, way: Array, by: float) -> Program:
    """Return the program with one direction moved along `way` and normalised."""
    measures = list(program.measures)
    measure = measures[which]
    assert isinstance(measure, StiffnessMeasure)  # checked in `_direction_changes`
    moved = unit_vector(tuple((np.array(measure.direction) + by * way).tolist()))
    measures[which] = measure.model_copy(update={"direction": moved})
    return replace(program, measures=tuple(measures))


def _problem(robot: Manipulator, task: Task, pressures: Array) -> PressureProblem:
    """Return the program of a task, with a row for each local minimum of a distance."""
    problem = PressureProblem(robot, task)
    if task.scene is None:
        return problem
    return problem.among(FollowedObstacles(task.scene, robot.description, robot, pressures))


def _evaluation(problem: PressureProblem) -> Callable[[Array, Array], ProgramPoint]:
    """Return the function of pressures (n,), as shares, and parameters; from rest under loads."""
    robot, task = problem.robot, problem.task
    program = Program.of(task, robot.description)
    bare = task.model_copy(update={"load": None, "press": None})  # the arm already carries it
    fast = prepared(robot, bare, 0).fast(program) if robot.is_loaded else None
    radii = np.array([c.radius for c in program.constraints(robot.length)])
    own = slice(program.n_own_rows)

    def evaluate(x: Array, parameters: Array) -> ProgramPoint:
        parts = None if fast is None else fast[0].point(parameters, radii, x * problem.unit)
        if parts is not None:
            residual, jacobian = problem.with_obstacles(x, parts[0][own], parts[1][own])
            return ProgramPoint(x, residual, jacobian, problem.constraints, *parts[2:])
        other = copy(problem)
        other.parameters = parameters
        other.restart()
        return other.point(x)

    return evaluate
