"""The lean call of planners: from one answer to the next, arrays in and arrays out.

A row of numbers and the memory of an answer are made once; a call writes the target and the guess
into them, calls machine code and copies what it found.  All else waits until it is asked for.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.fast import FastSolver
from stiffopt.optimise.program import Program
from stiffopt.optimise.solution import Judgement, PressureSolution
from stiffopt.optimise.term import Term

Vector = NDArray[np.float64]
Limits = tuple[Vector, Vector]


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

    __slots__ = ("_holds", "_solve", "_solved", "pressures")

    def __init__(
        self,
        pressures: Vector | None,
        holds: Callable[[], bool],
        solve: Callable[[], PressureSolution | None],
    ) -> None:
        self.pressures, self._holds, self._solve = pressures, holds, solve

    @property
    def solution(self) -> PressureSolution | None:
        """See the class."""
        if not hasattr(self, "_solved"):
            self._solved = self._solve()
        return self._solved

    @property
    def found(self) -> bool:
        """See the class."""
        return self._holds()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if self.solution is None:
            raise AttributeError(f"no answer was found, so there is no {name!r}; look at 'found'")
        return getattr(self.solution, name)

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling: it is judged now."""
        return judged_answer, (self.pressures, self.solution)

    def __repr__(self) -> str:
        return f"WarmAnswer({self.solution!r})" if self.found else "WarmAnswer(nothing was found)"


def judged_answer(pressures: Vector | None, solution: PressureSolution | None) -> WarmAnswer:
    """Answer that was judged already."""
    return WarmAnswer(pressures, lambda: solution is not None, lambda: solution)


class WarmCalls:
    """Warm calls for one task, whose rows and memory for answers are used again and again."""

    def __init__(self, fast: FastSolver, row: Vector, program: Program) -> None:
        self.fast, self._program = fast, program
        self._row = fast.with_target(row, program, None)
        self._spare = [self._memory()]
        self._parts: dict[str, tuple[slice, Term]] = {}
        start = fast.targets.start
        for term in program.terms:
            self._parts[term.key] = slice(start, start + len(term.parameters)), term
            start += len(term.parameters)

    def _memory(self) -> tuple[Vector, Vector, Callable[[], int]]:
        """A row, the numbers of its answer, and the call that finds them."""
        row = self._row.copy()
        numbers, call = self.fast.call(row)
        return row, numbers, call

    def __call__(
        self, parts: dict[str, Any], guess: Vector, limits: Limits | None
    ) -> Vector | None:
        """Numbers of the answer next to a guess (n,) in Pa, not judged; None where there is none.

        Parameters
        ----------
        parts :
            Of the target, instead of the task's: a position (3,), or what is in a `Target` under
            the same key.
        """
        found = self._run(parts, guess, limits, self.fast.guess_alone)
        return found if self.fast.is_local(found) else None

    def holds(self, parts: dict[str, Any], pressures: Vector, within: bool) -> bool:
        """Whether the model confirms pressures (n,); `within`: whether they are within limits."""
        judged = self.fast.judgement(self._run(parts, pressures, None, self.fast.judge))
        return judged is not None and Judgement.of(self._program, judged, within).holds

    def _run(
        self, parts: dict[str, Any], pressures: Vector, limits: Limits | None, asked: float
    ) -> Vector:
        """Numbers of an answer, a copy."""
        try:
            memory = self._spare.pop()
        except IndexError:  # other threads have them all
            memory = self._memory()
        row, numbers, call = memory
        self.fast.write(row, self._row, asked, pressures)
        for key, value in parts.items():
            where, term = self._parts[key]
            row[where] = value if isinstance(value, np.ndarray) else term.like(value).parameters
        if limits is not None:
            self.fast.limit(row, *limits)
        call()
        found = numbers.copy()
        self._spare.append(memory)
        return found
