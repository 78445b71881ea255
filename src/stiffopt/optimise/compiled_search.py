"""Find answers by machine code: the stiffest pressures, or the closest configuration."""

from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.scene import Scene
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise import diagnosis
from stiffopt.optimise.answers import Answers, pressed
from stiffopt.optimise.fast import CompiledAnswer, FastSolver
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import OBSTACLES
from stiffopt.optimise.solution import (
    Confidence,
    Explanation,
    Judgement,
    PressureSolution,
    active_bounds,
    are_within,
    judge,
)
from stiffopt.optimise.task import Task


class CompiledSearch:
    """Search by machine code for one kind of task; returns None until code is compiled.

    `answers`: the solver's factory of solutions.
    """

    def __init__(self, answers: Answers) -> None:
        self._answers, self._prepared = answers, answers.prepared
        self._robot = answers.robot

    def fast(self, task: Task, guess: Array | None) -> tuple[FastSolver, Array, Program] | None:
        """Return the task's compiled solver, its row of numbers and its program.

        None without machine code, and for a brace: the compiled solvers do not model contact.
        """
        if task.brace is not None:
            return None
        program = self._prepared.program(task.target)
        fast = self._prepared.fast(program)
        if fast is None:
            return None
        solver, row = fast
        return solver, solver.with_target(row, program, guess), program

    def solve(
        self, task: Task, guess: Array | None, limits: tuple[Array, Array] | None = None
    ) -> PressureSolution | None:
        """Return the compiled solver's answer if it finds one that holds."""
        if limits is not None and guess is not None:
            guess = np.clip(guess, *limits)
        fast = self.fast(task, guess)
        if fast is None:
            return None
        solver, row, program = fast
        if limits is not None:
            solver.limit(row, *limits)
        return self._answers.if_it_holds(task, program, solver.solve(row))

    def nearest(self, task: Task, start: Array | None = None) -> PressureSolution | None:
        """Return the closest configuration by machine code; a start (n,) is in Pa.

        None if there is no code, or if the pose is reached.  With a scene, a reached pose is solved
        from there instead.
        """
        fast = self.fast(task, None)
        answer = None if fast is None else fast[0].closest(fast[1], start)
        checkpoint()  # an interrupted search does not show that the pose is out of reach
        if fast is None or answer is None or answer.slope is None:
            return None
        p = answer.pressures
        within = are_within(p, self._prepared.lower, self._prepared.upper)
        judgement = Judgement.of(fast[2], answer.judged, within)
        if judgement.pose_holds and task.scene is not None:
            return self.solve(task, p)
        if judgement.pose_holds or not within:
            return None
        active = active_bounds(self._robot, task, p)
        holding = [*map(repr, judgement.touched), *pressed(active, -answer.slope)]
        message = diagnosis.unreachable_message(
            judgement, task, holding
        ) + self._answers.blocked_words(task, judgement.touched)

        def explain() -> Explanation:
            problem = PressureProblem(self._robot, task)
            last = diagnosis.last_stage(problem, judgement.errors)
            result = LocalResult.at(last, last.pose(p / problem.unit))
            return self._answers.explanation(problem, result, judgement, p, message)

        fields = self._answers.quantities(task, judgement)
        fields.update(
            status="unreachable",
            message=message,
            active_bounds=tuple(active),
            pressures=p,
            confidence=replace(answer.confidence, reached=0),
            counts=answer.counts,
            timings={},
        )
        return PressureSolution.explained_later(explain, fields)

    def among_obstacles(self, task: Task) -> PressureSolution | None:
        """Return an answer among obstacles where `solve` and `nearest` have none.

        If the pose is reached and clear but too soft, return the stiffest answer.  Otherwise
        descend from the clear sample nearest to the target or, if none is clear, from the first
        clear configuration found near the clearest ones.  Without one, return the clearest.
        """
        fast = self.fast(task, None)
        if fast is None or task.scene is None:
            return None
        solver, row, program = fast
        answer = solver.solve(row)
        checkpoint()
        if answer is not None:
            within = are_within(answer.pressures, self._prepared.lower, self._prepared.upper)
            judgement = Judgement.of(program, answer.judged, within)
            if judgement.pose_holds and judgement.is_clear and within and judgement.shortfalls:
                return self._too_soft(task, judgement, answer)
        samples = solver.table.pressures[: OBSTACLES.clearest]
        distances = self._robot.clearance(samples, task.scene)
        clear = distances >= task.scene.clearance
        far = solver.table.distances(program.terms, self._robot.length)[: len(samples)]
        if clear.any():
            return self.nearest(task, samples[np.where(clear, far, np.inf).argmin()])
        p, drawn = self._clearest_near(task.scene, samples, distances)
        if self._robot.clearance(p, task.scene) >= task.scene.clearance:
            return self.nearest(task, p)
        return self._clearest(task, p, len(samples) + drawn)

    def _clearest_near(self, scene: Scene, p: Array, distances: Array) -> tuple[Array, int]:
        """Return pressures (n,) clear of a scene, or the clearest found, and how many were drawn.

        Each round draws closer around the clearest so far, at first those of p (N, n).
        """
        rng, drawn = np.random.default_rng(0), 0
        low, high = self._prepared.lower, self._prepared.upper
        for share in np.geomspace(*OBSTACLES.spread, OBSTACLES.rounds):
            if distances.max() >= scene.clearance:
                break
            checkpoint()
            best = np.argsort(-distances)[: OBSTACLES.parents]
            p, distances = p[best], distances[best]
            others = np.repeat(p, OBSTACLES.children, axis=0)
            others += share * (high - low) * rng.standard_normal(others.shape)
            try:
                found = self._robot.clearance(np.clip(others, low, high, out=others), scene)
            except EquilibriumError:  # near where the arm buckles
                break
            drawn += len(others)
            p, distances = np.concatenate([p, others]), np.concatenate([distances, found])
        nearest: Array = p[distances.argmax()]
        return nearest, drawn

    def _too_soft(
        self, task: Task, judgement: Judgement, answer: CompiledAnswer
    ) -> PressureSolution:
        """Return the stiffest answer, which misses a demanded stiffness."""
        return PressureSolution(
            status="unreachable",
            message=diagnosis.demands_message(judgement),
            active_bounds=tuple(active_bounds(self._robot, task, answer.pressures)),
            **self._answers.quantities(task, judgement),
            pressures=answer.pressures,
            confidence=answer.confidence,
            counts=answer.counts,
        )

    def _clearest(self, task: Task, p: Array, tried: int) -> PressureSolution:
        """Return the sample with the most clearance, where none has enough."""
        judgement = judge(self._robot, task, p)
        return PressureSolution(
            status="unreachable",
            message=diagnosis.no_way_message(judgement, task, tried),
            active_bounds=tuple(active_bounds(self._robot, task, p)),
            **self._answers.quantities(task, judgement),
            pressures=p,
            confidence=Confidence(tried, 0, 0, 0, complete=False),
        )
