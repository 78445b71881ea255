"""`FastSolver`: a whole search in machine code, task by task or many at once.

It is the method of `stiffopt.optimise.search` and `local`, written in C (folder ``native``) and
compiled with the functions of a task's structure; `stiffopt.optimise.loaded` adds the functions for
gravity and loads.  Tasks that it does not support or cannot solve go to the general method.
"""

import ctypes
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.batch import in_parallel
from stiffopt.model.compiled import Library
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import stop_flag
from stiffopt.optimise.obstacles import Obstacles, ObstaclesInC
from stiffopt.optimise.program import Program, pressure_ranges
from stiffopt.optimise.samples import SampleTable
from stiffopt.optimise.search import effort
from stiffopt.optimise.settings import CLOSEST, DESCENT, KEPT, REACH, SEARCH, Effort
from stiffopt.optimise.solution import Confidence

_NEAR = 18  # numbers of a term's `Nearness`
_COUNTS = 14  # numbers of an answer before its pressures
# requests and outcomes, as in solver.c
_SEARCH, _GUESS_FIRST, _GUESS_ALONE, _JUDGE, _REACH_ONLY, _CLOSEST, _CLOSEST_FROM, _BROUGHT = range(
    8
)
_UNSOLVED, ANSWERED, _GLOBAL, _JUDGED, _REACHED, _NEAREST, _NOT_FINITE, _TOO_SOFT = range(8)

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


def _mirrored(settings: Any) -> ctypes.Structure:
    """Return settings as a structure in C with the same fields."""
    kinds = {float: _double, int: _integer}
    values = settings._asdict() if isinstance(settings, Effort) else asdict(settings)
    fields = [(name, kinds[type(value)]) for name, value in values.items()]
    kind = type(type(settings).__name__, (ctypes.Structure,), {"_fields_": fields})
    return kind(**values)


_REACH_SETTINGS, _DESCENT_SETTINGS, _CLOSEST_SETTINGS, _EFFORT = map(
    _mirrored, (REACH, DESCENT, CLOSEST, SEARCH.placed)
)


class _Setup(ctypes.Structure):
    """Structure `Setup` of native/program.h."""

    _fields_ = [
        *((name, _integer) for name in (
            "n", "rows", "own_rows", "balls", "terms", "floors", "values", "parameters", "near",
            "samples",
        )),
        *((name, _pointer) for name in ("ball_rows", "one_sided", "scale", "unit", "stage")),
        ("reach", type(_REACH_SETTINGS)),
        ("descent", type(_DESCENT_SETTINGS)),
        ("closest", type(_CLOSEST_SETTINGS)),
        ("least_effort", type(_EFFORT)),
        ("most_effort", type(_EFFORT)),
        *((name, _double) for name in (
            "covered", "same_optimum", "unlike", "price_of_floors",
            "price_of_obstacles", "precision",
        )),
        *((name, _pointer) for name in ("sample_x", "sample_poses")),
        ("state", _integer),
        ("sample_states", _pointer),
        ("rod", _pointer),
        ("obstacles", _pointer),
    ]  # fmt: skip


class _OneTask(ctypes.Structure):
    """Structure `OneTask` of native/solver.c."""

    _fields_ = [(name, _pointer) for name in ("setup", "task", "answer", "stop")]


class CompiledAnswer(NamedTuple):
    """An answer of the compiled solver."""

    pressures: Array  # (n,), in Pa
    confidence: Confidence
    counts: dict[str, int]  # work done
    # arguments of `Judgement.of`: residuals, tip pose, compliance and values at the pressures
    judged: tuple[list[float], Array, Array, list[float]]
    # (n,), for the closest configuration: gradient of its error's Lagrangian without limits, per
    # share of a pressure's range
    slope: Array | None = None


class FastSolver:
    """Compiled solver of tasks of one structure and one set of limits on one arm.

    Each task is a row of numbers: its parameters, radii, limits, floors and guess.

    Parameters
    ----------
    library : functions of the structure, with the compiled solver.
    program : any of that structure; for one with obstacles see `among`.
    table : starts of searches; that of a loaded arm includes the arm in machine code.

    Attributes
    ----------
    table : starts of searches.
    targets, guess : places of the target's parameters and of the guess in a row.
    """

    def __init__(
        self, library: Library, robot: Manipulator, program: Program, table: SampleTable
    ) -> None:
        self._library, self.table = library, table  # own the memory behind the pointers below
        arm = table.arm
        size = library.cdll.stiffopt_setup_size
        size.restype = _integer
        if size() != ctypes.sizeof(_Setup):
            raise RuntimeError("the compiled solver and this file disagree on their interface")
        self._solve = library.cdll.stiffopt_solve
        self._solve.argtypes = [
            _pointer, _pointer, _integer, _pointer, _integer, _integer, _integer, _pointer
        ]  # fmt: skip
        n = robot.n_pressures
        constraints = program.constraints(robot.length)
        self._length = robot.length
        stages = [term.name for term in program.in_order_of_approach]
        self._arrays = (
            np.array([c.end - c.first for c in constraints], dtype=np.int64),
            np.array([c.one_sided for c in constraints], dtype=np.int64),
            np.array([c.scale for c in constraints]),
            pressure_ranges(robot.description),
            np.array(
                [stages.index(c.name) if c.name in stages else -1 for c in constraints],
                dtype=np.int64,
            ),
            table.shares,
        )
        ball_rows, one_sided, scale, unit, stage, sample_x = (a.ctypes.data for a in self._arrays)
        least, most = (effort(program.n_equal, share, arm is not None) for share in (0.0, 1.0))
        setup = _Setup(
            n=n,
            rows=program.n_rows,
            own_rows=program.n_own_rows,
            balls=len(constraints),
            terms=program.n_terms,
            floors=program.n_floors,
            values=len(program.measures),
            parameters=len(robot.numbers) + program.n_parameters,
            near=len(program.terms),
            samples=len(table.pressures),
            ball_rows=ball_rows,
            one_sided=one_sided,
            scale=scale,
            unit=unit,
            stage=stage,
            reach=_REACH_SETTINGS,
            descent=_DESCENT_SETTINGS,
            closest=_CLOSEST_SETTINGS,
            least_effort=type(_EFFORT)(*least),
            most_effort=type(_EFFORT)(*most),
            covered=SEARCH.covered,
            same_optimum=SEARCH.same_optimum,
            unlike=SEARCH.unlike,
            price_of_floors=SEARCH.price_of_floors,
            price_of_obstacles=SEARCH.price_of_obstacles,
            precision=program.precision,
            sample_x=sample_x,
            sample_poses=table.flat_poses.ctypes.data,
        )
        if arm is not None:
            setup.state = arm.state_size
            setup.sample_states = table.states.ctypes.data
            setup.rod = arm.address
        self._obstacles: ObstaclesInC | None = None
        self._setup = setup
        self._address = ctypes.addressof(setup)
        self._numbers = robot.numbers
        first = len(robot.numbers)
        self.targets = slice(first, first + len(program.target_parameters))
        self._radii = slice(setup.parameters, setup.parameters + len(constraints))
        limits = self._radii.stop + 2 * n
        self._mode = limits + program.n_floors + _NEAR * setup.near
        self._near = slice(limits + program.n_floors, self._mode)
        self._width = self._mode + 1 + n
        ends = np.cumsum([_COUNTS + n, n, program.n_rows, 16, 36, len(program.measures)]).tolist()
        self._parts = [slice(start, end) for start, end in pairwise(ends)]
        self._answer_width = ends[-1]
        self.guess = slice(self._mode + 1, self._width)
        self._pressures = slice(self._width + _COUNTS, self._width + _COUNTS + n)

    def among(self, obstacles: Obstacles, robot: Manipulator) -> "FastSolver":
        """Return the same solver with another scene that has as many rows."""
        other = copy(self)
        other._obstacles = in_c = ObstaclesInC(obstacles, robot, self.table.arm)
        other._setup = type(self._setup).from_buffer_copy(self._setup)
        other._setup.obstacles = in_c.address
        other._address = ctypes.addressof(other._setup)
        return other

    def row(self, program: Program, lower: Array, upper: Array, floors: Array) -> Array:
        """Return the row of a task without its target and guess."""
        row = np.zeros(self._width)
        row[: self.targets.start] = self._numbers
        start = self.targets.stop
        row[start : self._radii.start] = program.measure_parameters
        row[self._radii.stop : self._near.start] = np.concatenate([lower, upper, floors])
        return row

    def with_target(self, row: Array, program: Program, guess: Array | None) -> Array:
        """Return a copy of a row with a target and, if given, a guess (Pa) to try first."""
        row = row.copy()
        row[self.targets] = program.target_parameters
        row[self._radii] = program.radii
        near: tuple[float, ...] = ()
        for term in program.terms:
            near += term.nearness(self._length).numbers
        row[self._near] = near
        if guess is not None:
            row[self._mode] = _GUESS_FIRST
            row[self.guess] = guess
        return row

    def limit(self, row: Array, lower: Array, upper: Array) -> None:
        """Set other limits (n,) in a row, in Pa, within those that it was made for."""
        row[self._radii.stop : self._radii.stop + 2 * len(lower)] = np.concatenate([lower, upper])

    def next_to(self, row: Array, guess: Array, lower: Array, upper: Array) -> Array:
        """Return a row that requests the answer next to a guess (n,), within limits (n,)."""
        row = row.copy()
        row[self._mode] = _GUESS_ALONE
        row[self.guess] = guess
        self.limit(row, lower, upper)
        return row

    def judging(self, row: Array, pressures: Array) -> Array:
        """Return a row that requests the judgement of pressures (n,)."""
        row = row.copy()
        row[self._mode] = _JUDGE
        row[self.guess] = pressures
        return row

    def optima(self, rows: Array, threads: int | None = None) -> tuple[Array, Array]:
        """Return the answers to rows of `next_to`, not judged: pressures (N, n), objectives (N,).

        An objective is infinite where there is no answer.
        """
        return self._pressures_and_values(rows, threads, ANSWERED)

    def brought(self, rows: Array, guesses: Array) -> tuple[Array, Array]:
        """Return pressures (N, n) on target near guesses (N, n), which need not be optimal.

        The second array are their objectives (N,), infinite where a guess is not brought there.
        Within the rows' limits, and clear of their scene.
        """
        rows = rows.copy()
        rows[:, self._mode] = _BROUGHT
        rows[:, self.guess] = guesses
        return self._pressures_and_values(rows, 1 if len(rows) < 64 else None, _REACHED)

    def _pressures_and_values(
        self, rows: Array, threads: int | None, outcome: int
    ) -> tuple[Array, Array]:
        """Return pressures (N, n) and objectives (N,) of rows; infinite without that outcome."""
        numbers = self._numbers_of(np.ascontiguousarray(rows), threads)
        n = self.guess.stop - self.guess.start
        values = np.where(numbers[:, 0] == outcome, numbers[:, 1], np.inf)
        return numbers[:, _COUNTS : _COUNTS + n], values

    def solve(self, row: Array) -> CompiledAnswer | None:
        """Return the answer to one task; None if the general method is needed.

        If no answer meets a demanded stiffness, this is the one nearest to it: judge the answer.
        """
        return self.answer(self._run_one(row))

    def closest(self, row: Array, start: Array | None = None) -> CompiledAnswer | None:
        """Return the configuration closest to an unreachable target.

        The search starts from samples and first from a start (n,) in Pa, if given.  None if the
        general method is needed.
        """
        if start is None:
            return self.answer(self._run_one(row, _CLOSEST))
        row[self.guess] = start
        return self.answer(self._run_one(row, _CLOSEST_FROM))

    def can_reach(self, row: Array) -> bool:
        """Return whether a configuration nearest to the target is brought to it."""
        return bool(self._run_one(row, _REACH_ONLY)[0] == _REACHED)

    def block(self, row: Array) -> Array:
        """Return a row that requests the answer next to its guess, followed by memory for it."""
        block = np.concatenate([row, np.zeros(self._answer_width)])
        block[self._mode] = _GUESS_ALONE
        return block

    def call(self, block: Array) -> tuple[Callable[[], int], ctypes.Structure]:
        """Return a function that solves a block in place, and the structure that it works on.

        The function returns the outcome; the answer is not judged.  The block must not move.  The
        function takes a single structure, as converting arguments costs more than using them.  The
        structure's field `stop` may be set to the address of a `StopFlag`.
        """
        row = block.ctypes.data
        task = _OneTask(self._address, row, row + block.itemsize * self._width, None)
        solve_one = self._library.cdll.stiffopt_solve_one
        solve_one.argtypes = [_pointer]
        return partial(solve_one, ctypes.addressof(task)), task

    def judged(self, block: Array) -> CompiledAnswer | None:
        """Return the answer in a block, judged by the model."""
        row, numbers = block[: self._width].copy(), block[self._width :]
        row[self.guess] = self.pressures(block)
        judged = self._run_one(row, _JUDGE)
        judged[1:_COUNTS] = numbers[1:_COUNTS]
        return self.answer(judged)

    def pressures(self, block: Array) -> Array:
        """Return the pressures (n,) of the answer in a block, in Pa."""
        return block[self._pressures]

    def point(self, parameters: Array, radii: Array, pressures: Array) -> list[Array] | None:
        """Evaluate a loaded arm's program from rest; None without an equilibrium.

        Pressures are (n,) in Pa.  Returns residuals (m,), with those of obstacles zero, their
        Jacobian (m, n) per share of a range, terms (t,), their gradients (t, n), floors (f,) and
        theirs (f, n).
        """
        s = self._setup
        values = np.empty(s.n + (s.rows + s.terms + s.floors) * (1 + s.n))
        arrays = [np.ascontiguousarray(each) for each in (parameters, radii, pressures)]
        point = self._library.cdll.stiffopt_point
        point.argtypes = [_pointer] * 5
        if not point(self._address, *(each.ctypes.data for each in (*arrays, values))):
            return None
        counts = [count for k in (s.rows, s.terms, s.floors) for count in (k, k * s.n)]
        parts = np.split(values[s.n :], np.cumsum(counts)[:-1])
        return [each.reshape(-1, s.n) if i % 2 else each for i, each in enumerate(parts)]

    def _run_one(self, row: Array, mode: int | None = None) -> Array:
        numbers = np.empty(self._answer_width)
        if mode is not None:
            row[self._mode] = mode
        with stop_flag() as stop:
            self._run(row, numbers, 0, 1, stop)
        return numbers

    def solve_all(self, rows: Array, threads: int | None = None) -> list[CompiledAnswer | None]:
        """Answer many tasks, one row each, on `threads` threads (default: all cores)."""
        return [self.answer(each) for each in self._numbers_of(np.ascontiguousarray(rows), threads)]

    def _numbers_of(self, rows: Array, threads: int | None) -> Array:
        """Return the numbers (N, w) of the answers to rows."""
        chunk = 1 if self._setup.state else KEPT.chunk  # Ctrl-C waits for a chunk
        numbers = np.empty((len(rows), self._answer_width))

        def work(starts: Iterator[int]) -> None:
            for start in starts:
                self._run(rows, numbers, start, min(start + chunk, len(rows)), stop)

        with stop_flag() as stop:
            in_parallel(work, range(0, len(rows), chunk), threads)
        return numbers

    def _run(self, rows: Array, answers: Array, begin: int, end: int, stop: int) -> None:
        failed = self._solve(
            self._address, rows.ctypes.data, self._width,
            answers.ctypes.data, self._answer_width, begin, end, stop,
        )  # fmt: skip
        if failed:
            raise MemoryError("no memory is left for the compiled solver")

    def answer(self, numbers: Array) -> CompiledAnswer | None:
        """Return the answer from the numbers of a call, which it keeps; None if there is none."""
        if numbers[0] not in (ANSWERED, _GLOBAL, _JUDGED, _NEAREST, _TOO_SOFT):
            return None
        slope, residuals, pose, compliance, values = self._parts
        _, _, _, _, tried, reached, descents, agreeing, optima, complete, *work = map(
            int, numbers[:_COUNTS].tolist()
        )
        numbers.flags.writeable = False
        iterations, poses, points, programs = work
        return CompiledAnswer(
            numbers[_COUNTS : slope.start],
            Confidence(tried, descents, agreeing, optima, complete == 1),
            {
                "starts": tried,
                "reached": reached,
                "descents": descents,
                "iterations": iterations,
                "poses": poses,
                "points": points,
                "programs": programs,
            },
            (
                numbers[residuals].tolist(),
                numbers[pose].reshape(4, 4),
                numbers[compliance].reshape(6, 6),
                numbers[values].tolist(),
            ),
            numbers[slope],
        )
