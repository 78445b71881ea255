"""Judge search results by the model and turn them, with messages, into `PressureSolution`."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise import diagnosis
from stiffopt.optimise.fast import CompiledAnswer
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.prepared import Prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import PRICES
from stiffopt.optimise.solution import (
    Confidence,
    Explanation,
    Judgement,
    PressureSolution,
    Sensitivities,
    active_bounds,
    are_within,
    judge,
)
from stiffopt.optimise.task import Task


class Answers:
    """Factory of one solver's solutions.

    `prepared`: limits, samples and compiled solvers for the kind of task. `solve_at_once`: solves
    another task on the arm; see `PressureSolver.solve_at_once`.
    """

    def __init__(
        self, prepared: Prepared, solve_at_once: Callable[[Task], PressureSolution | None]
    ) -> None:
        self.prepared, self._solve_at_once = prepared, solve_at_once
        self.robot: Manipulator = prepared.robot

    def if_it_holds(
        self, task: Task, program: Program, answer: CompiledAnswer | None
    ) -> PressureSolution | None:
        """Return the solution for an answer of the compiled solver; None if it does not hold."""
        if answer is None:
            return None
        p = answer.pressures
        within = are_within(p, self.prepared.lower, self.prepared.upper)
        judgement = Judgement.of(program, answer.judged, within)
        if not judgement.holds:
            return None

        def explain() -> Explanation:
            problem = PressureProblem(self.robot, task)
            point = problem.point(p / problem.unit)
            result = LocalResult.at(problem, point)
            return self.explanation(problem, result, judgement, p)

        fields = self.quantities(task, judgement)
        fields.update(
            status="solved",
            pressures=p,
            confidence=answer.confidence,
            counts=answer.counts,
            timings={},
        )
        return PressureSolution.explained_later(explain, fields)

    def of(
        self, problem: PressureProblem, result: LocalResult, confidence: Confidence
    ) -> PressureSolution:
        """Judge a search result and explain it."""
        pressures = np.clip(result.point.x * problem.unit, self.prepared.lower, self.prepared.upper)
        judgement = judge(self.robot, problem.task, pressures)
        return PressureSolution(
            status="solved" if judgement.holds else "unreachable",
            **self.explanation(problem, result, judgement, pressures)._asdict(),
            **self.quantities(problem.task, judgement),
            pressures=pressures,
            confidence=confidence,
        )

    def quantities(self, task: Task, judgement: Judgement) -> dict[str, Any]:
        """Return the fields of a solution that follow from its judgement."""
        return {
            "task": task,
            "robot": self.robot,
            "tip_pose": judgement.tip_pose,
            "errors": judgement.errors,
            "position_error": judgement.errors.get("position"),
            "angle_error": judgement.errors.get("angle"),
            "compliance": judgement.compliance,
            "stiffness": judgement.stiffnesses[0] if judgement.stiffnesses else None,
            "stiffness_unit": self.prepared.unit,
            "stiffnesses": judgement.stiffnesses,
            "matrix_distance": judgement.matrix_distance,
        }

    def explanation(
        self,
        problem: PressureProblem,
        result: LocalResult,
        judgement: Judgement,
        pressures: Array,
        message: str = "",
    ) -> Explanation:
        """Explain a judged result; a given message is kept."""
        task = problem.task
        active = active_bounds(self.robot, task, pressures)
        sensitivities = self._sensitivities(problem, result, pressures, active)
        freedom = diagnosis.freedom(problem, pressures / problem.unit)
        if not message and not judgement.pose_holds:
            holding = [*map(repr, judgement.touched), *self._holding(result, active)]
            message = diagnosis.unreachable_message(judgement, task, holding) + self.blocked_words(
                task, judgement.touched
            )
        elif not message and not judgement.holds:
            message = diagnosis.demands_message(judgement)
        elif not message and freedom == 0 and task.stiffness is not None:
            message = diagnosis.no_freedom_message(task, self.robot.n_pressures, sensitivities)
        return Explanation(message, tuple(active), freedom, sensitivities)

    def blocked_words(self, task: Task, touched: Iterable[str]) -> str:
        """Name the objects in the way if the task can be solved without its scene."""
        if task.scene is None:
            return ""
        coarse = diagnosis.coarse_meshes(self.robot, task.scene, touched)
        plain = task.model_copy(update={"scene": None})
        found = self._solve_at_once(plain)
        if found is None or not found.found or found.pressures is None:
            return coarse
        return diagnosis.in_the_way(self.robot, task.scene, found.pressures) + coarse

    @staticmethod
    def _holding(result: LocalResult, active: dict[str, tuple[int, int]]) -> list[str]:
        """Return the active limits that hold the closest configuration back."""
        if result.multipliers is None:
            return list(active)
        return pressed(active, result.multipliers.bounds)

    def _sensitivities(
        self,
        problem: PressureProblem,
        result: LocalResult,
        pressures: Array,
        active: dict[str, tuple[int, int]],
    ) -> Sensitivities | None:
        prices = result.multipliers
        if prices is None:
            return None
        gradient = None
        if problem.task.measures:
            gradient = problem.task.measures[0].stiffness_gradient(self.robot, pressures)
        scale = result.objective.gain(result.point)

        per_tolerance: dict[str, float] = {}
        for ball, pull in zip(result.point.bounded, prices.balls, strict=True):
            price = scale * _clean(float(np.linalg.norm(pull)))
            per_tolerance[ball.name] = per_tolerance.get(ball.name, 0.0) + price
        return Sensitivities(
            tip_jacobian=self.robot.tip_jacobian(pressures),
            stiffness_gradient=gradient,
            per_bound={
                name: scale
                * _clean(max(0.0, side * float(prices.bounds[index])))
                / float(problem.unit[index])
                for name, (index, side) in active.items()
            },
            per_tolerance=per_tolerance,
            objective_unit=result.objective.unit,
        )


def pressed(active: dict[str, tuple[int, int]], multipliers: Array) -> list[str]:
    """Return the active limits that have a multiplier; (n,), positive towards larger pressure."""
    rounding = 1e-6 * float(np.abs(multipliers).max())
    return [n for n, (index, side) in active.items() if side * multipliers[index] > rounding]


def _clean(price: float) -> float:
    return price if price > PRICES.least else 0.0
