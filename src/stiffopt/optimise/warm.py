"""Warm calls of planners, with little overhead: arrays in, arrays out.

A row of numbers and memory for the answer are allocated once.  A call writes the target and the
guess into them, calls machine code and copies the result.  Everything else is lazy, since each line
of Python costs time once its memory has left the processor's caches.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.directions import unit_quaternion, unit_vector
from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_vector
from stiffopt.optimise.fast import ANSWERED, FastSolver
from stiffopt.optimise.program import Program
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.task import Task
from stiffopt.optimise.term import Term

if TYPE_CHECKING:
    from stiffopt.optimise.solver import PressureSolver


def task_with_target(
    task: Task,
    position: ArrayLike | None,
    pointing: ArrayLike | None,
    orientation: ArrayLike | None,
) -> Task:
    """Return the task with other parts of its target, after checking them."""
    parts: dict[str, Any] = {}
    if position is not None:
        given, own = checked_vector("position", position), task.target.position or (0, 0, 0)
        pairs = zip(given.tolist(), own, strict=True)
        parts["position"] = tuple(None if axis is None else new for new, axis in pairs)
    if pointing is not None:
        parts["pointing"] = unit_vector(tuple(checked_vector("pointing", pointing).tolist()))
    if orientation is not None:
        q = checked_vector("orientation", orientation, 4)
        parts["orientation"] = unit_quaternion(tuple(q.tolist()))
    for key in parts:
        if getattr(task.target, key) is None:
            raise InputError(f"the task's target has no {key}, so that none can be given")
    return task.model_copy(update={"target": task.target.model_copy(update=parts)})


class WarmAnswer:
    """Answer of `PressureSolver.warm`: its pressures; everything else is computed lazily.

    It also has the attributes of its `solution`.

    Attributes
    ----------
    pressures : ndarray (n,) or None
        In Pa; None where no answer was found.
    solution : PressureSolution or None
        The answer, judged by the model; None where none was found that holds.
    found : bool
        Whether the model confirms that all tolerances, limits and demands of the task hold.
    """

    __slots__ = ("_block", "_solved", "_solver", "pressures")

    def __init__(self, pressures: Array | None, solver: "PressureSolver", block: Array) -> None:
        self.pressures, self._solver, self._block = pressures, solver, block

    @classmethod
    def judged(cls, pressures: Array | None, solution: PressureSolution | None) -> "WarmAnswer":
        """Return an answer whose solution is known."""
        answer = cls.__new__(cls)
        answer.pressures, answer._solved = pressures, solution
        return answer

    @property
    def solution(self) -> PressureSolution | None:
        """See the class."""
        if not hasattr(self, "_solved"):
            self._solved = self._solver._solution_of(self._block)
        return self._solved

    @property
    def found(self) -> bool:
        """See the class."""
        if hasattr(self, "_solved"):
            return self._solved is not None
        return self._solver._confirms(self._block)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if self.solution is None:
            raise AttributeError(f"no answer was found, so there is no {name!r}; look at 'found'")
        return getattr(self.solution, name)

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling: judge the answer now."""
        return WarmAnswer.judged, (self.pressures, self.solution)

    def __repr__(self) -> str:
        return f"WarmAnswer({self.solution!r})" if self.found else "WarmAnswer(nothing was found)"


class _WarmMemory(NamedTuple):
    """A block of numbers, its views for position and guess, and the call that solves it."""

    block: Array
    place: Array | None
    start: Array
    call: Callable[[], int]
    task: Any


class WarmCalls:
    """Warm calls for one task; their memory is reused.

    `program`: of the task. `like`: block of numbers of the task (see `FastSolver.block`).
    """

    def __init__(self, fast: FastSolver, row: Array, program: Program) -> None:
        self.fast, self.program = fast, program
        self.like = fast.block(fast.with_target(row, program, None))
        self._n = fast.guess.stop - fast.guess.start
        self._parts: dict[str, tuple[slice, Term]] = {}
        start = fast.targets.start
        for term in program.terms:
            self._parts[term.key] = slice(start, start + len(term.parameters)), term
            start += len(term.parameters)
        place = self._parts.get("position")
        self._place = None if place is None else place[0]
        axes: tuple[int, ...] = () if place is None else getattr(place[1], "axes", ())
        self._axes = None if len(axes) == 3 else list(axes)
        self._spare = [self._memory()]

    def _memory(self) -> _WarmMemory:
        """Return a new block with its views and call."""
        block = self.like.copy()
        place = None if self._place is None else block[self._place]
        return _WarmMemory(block, place, block[self.fast.guess], *self.fast.call(block))

    def next_to(
        self, guess: Any, position: Any, pointing: Any, orientation: Any, stop: int = 0
    ) -> Array | None:
        """Return a block with the answer next to a guess; None without one, or for bad arguments.

        `stop` is the address of a `StopFlag`.
        """
        if not self._spare:  # all in use by other threads
            self._spare.append(self._memory())
        memory = self._spare.pop()
        block, place, start, call, task = memory
        if stop:
            task.stop = stop
        others = pointing is not None or orientation is not None
        found = None
        try:
            if position is None:
                block[self.fast.targets] = self.like[self.fast.targets]
            elif len(position) == 3 and place is not None:
                place[...] = position if self._axes is None else np.asarray(position)[self._axes]
            else:
                raise ValueError
            if others:
                self._turn(block, pointing, orientation)
            if len(guess) == self._n:
                start[...] = guess
                if call() == ANSWERED:
                    found = block.copy()
        except (KeyError, TypeError, ValueError):
            pass
        if others:
            block[self.fast.targets] = self.like[self.fast.targets]
        if stop:
            task.stop = None
        self._spare.append(memory)
        return found

    def _turn(self, block: Array, pointing: Any, orientation: Any) -> None:
        """Write the angular parts of a target."""
        if pointing is not None:
            where, term = self._parts["pointing"]
            block[where] = term.like(unit_vector(tuple(map(float, pointing)))).parameters
        if orientation is not None:
            where, _ = self._parts["orientation"]
            block[where] = unit_quaternion(tuple(map(float, orientation)))

    def task_of(self, block: Array, task: Task) -> Task:
        """Return the task that a block describes."""
        parts: dict[str, Any] = {}
        for key, (where, _) in self._parts.items():
            values = tuple(block[where].tolist())
            if key == "position":
                left = iter(values)
                own = task.target.position or ()
                parts[key] = tuple(None if axis is None else next(left) for axis in own)
            elif key in ("pointing", "orientation"):
                parts[key] = values[: 3 if key == "pointing" else 4]
        return task.model_copy(update={"target": task.target.model_copy(update=parts)})
