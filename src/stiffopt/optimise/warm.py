"""The lean call of planners: from one answer to the next, arrays in and arrays out.

A row of numbers and the memory of an answer are made once; a call writes the target and the guess
into them, calls machine code and copies what it found.  All else waits until it is asked for: a
call whose memory is no longer in the processor's caches pays for each line of Python it runs.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.directions import unit_quaternion, unit_vector
from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_vector
from stiffopt.optimise.fast import ANSWERED, FastSolver
from stiffopt.optimise.program import Program
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.term import Term

if TYPE_CHECKING:
    from stiffopt.optimise.solver import PressureSolver

Vector = NDArray[np.float64]
Limits = tuple[Vector, Vector]


class Asked(NamedTuple):
    """What a warm call asks beside a guess; None: as the task has it."""

    position: ArrayLike | None = None
    pointing: ArrayLike | None = None
    orientation: ArrayLike | None = None
    limits: tuple[ArrayLike, ArrayLike] | None = None

    def parts(self, task: Task) -> dict[str, Any]:
        """The parts of the target that take the place of the task's, checked, by key."""
        parts: dict[str, Any] = {}
        if self.position is not None:
            wanted = zip(checked_vector("position", self.position).tolist(),
                         task.target.position or (0, 0, 0), strict=True)  # fmt: skip
            parts["position"] = tuple(None if own is None else new for new, own in wanted)
        if self.pointing is not None:
            p = checked_vector("pointing", self.pointing)
            parts["pointing"] = unit_vector(tuple(p.tolist()))
        if self.orientation is not None:
            q = checked_vector("orientation", self.orientation, 4)
            parts["orientation"] = unit_quaternion(tuple(q.tolist()))
        for key in parts:
            if getattr(task.target, key) is None:
                raise InputError(f"the task's target has no {key}, so that none can be given")
        return parts

    def narrowed(self, lower: Vector, upper: Vector) -> Limits:
        """The limits (n,) in Pa, where they are within the task's."""
        low, high = self.limits or (lower, upper)
        low = np.maximum(checked_vector("the lower limits", low, len(lower)), lower)
        high = np.minimum(checked_vector("the upper limits", high, len(lower)), upper)
        if (low > high).any():
            raise InputError("limits leave a channel no pressure that the task permits")
        return low, high

    def task(self, task: Task, lower: Vector, upper: Vector) -> Task:
        """The task as it was asked; `lower`, `upper` (n,): its limits in Pa."""
        target = task.target.model_copy(update=self.parts(task))
        if self.limits is None:
            return task.model_copy(update={"target": target})
        low, high = (tuple(each.tolist()) for each in self.narrowed(lower, upper))
        limits = PressureRange(min=low, max=high)
        return task.model_copy(update={"target": target, "pressure": limits})


class WarmAnswer:
    """Answer of `PressureSolver.warm`: its pressures; the rest is computed when it is looked at.

    It has the attributes of its `solution` too.

    Attributes
    ----------
    pressures : ndarray (n,) or None
        In Pa; None where no answer was found.
    solution : PressureSolution or None
        The answer, judged by the model; None where none was found that holds.
    found : bool
        Whether the model confirms that all tolerances, limits and demands of the task hold.
    """

    __slots__ = ("_asked", "_block", "_solved", "_solver", "pressures")

    def __init__(
        self,
        pressures: Vector | None,
        solver: "PressureSolver",
        block: Vector,
        asked: Asked | None = None,
    ) -> None:
        self.pressures = pressures
        self._solver, self._block, self._asked = solver, block, asked

    @classmethod
    def judged(cls, pressures: Vector | None, solution: PressureSolution | None) -> "WarmAnswer":
        """Answer of which the solution is known."""
        answer = cls.__new__(cls)
        answer.pressures, answer._solved = pressures, solution
        return answer

    @property
    def solution(self) -> PressureSolution | None:
        """See the class."""
        if not hasattr(self, "_solved"):
            self._solved = self._solver._solution_of(self._block, self._asked)
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
        """Support pickling: it is judged now."""
        return WarmAnswer.judged, (self.pressures, self.solution)

    def __repr__(self) -> str:
        return f"WarmAnswer({self.solution!r})" if self.found else "WarmAnswer(nothing was found)"


class WarmCalls:
    """Warm calls for one task, whose memory is used again and again.

    Attributes
    ----------
    fast : FastSolver
    program : Program
        Of the task.
    like : ndarray
        Block of numbers of the task (see `FastSolver.block`).
    position : slice or None
        Where the target's position is in a block, if none of its axes is free.
    """

    def __init__(self, fast: FastSolver, row: Vector, program: Program) -> None:
        self.fast, self.program = fast, program
        self.like = fast.block(fast.with_target(row, program, None))
        self._spare = [self._memory()]
        self._guess, self._outcome = fast.guess, len(row)
        self._n = fast.guess.stop - fast.guess.start
        self._terms: dict[str, tuple[slice, Term]] = {}
        start = fast.targets.start
        for term in program.terms:
            self._terms[term.key] = slice(start, start + len(term.parameters)), term
            start += len(term.parameters)
        place = self._terms.get("position")
        self.position = place[0] if place is not None and place[1].size == 3 else None

    def _memory(self) -> tuple[Vector, Callable[[], int]]:
        """A block of numbers and the call that answers it."""
        block = self.like.copy()
        return block, self.fast.call(block)

    def place(self, position: Any, guess: Any) -> Vector | None:
        """Block with the answer next to a guess (n,) for a position (3,); None for all else.

        That is where there is no answer, an argument is wrong, or axes of the position are free.
        """
        if self.position is None or not self._spare:
            return None
        memory = self._spare.pop()
        block, call = memory
        found = None
        try:
            if len(position) == 3 and len(guess) == self._n:
                block[self.position] = position
                block[self._guess] = guess
                call()
                if block.item(self._outcome) == ANSWERED:
                    found = block.copy()
        except (TypeError, ValueError):
            pass
        self._spare.append(memory)
        return found

    def general(self, parts: dict[str, Any], guess: Vector, limits: Limits | None) -> Vector | None:
        """The same for other parts of the target, and within limits."""
        block = self.like.copy()
        for key, value in parts.items():
            where, term = self._terms[key]
            block[where] = term.like(value).parameters
        block[self._guess] = guess
        if limits is not None:
            self.fast.limit(block, *limits)
        self.fast.call(block)()
        return block if block[self._outcome] == ANSWERED else None
