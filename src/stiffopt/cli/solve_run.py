"""What `solve` does: solve one task file after the other, print, write and draw what is found.

The tables need rich, so their module is imported where one is printed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from traceback import extract_tb
from typing import TYPE_CHECKING

from stiffopt.cli import exits, solve_files, solve_records
from stiffopt.cli.console import (
    Closed,
    ProgressBar,
    report_error,
    report_note,
    show,
    warnings_as_notes,
    write_json,
)
from stiffopt.cli.exits import Interruptible
from stiffopt.cli.solved_task import SolvedTask, solve_file
from stiffopt.errors import StiffoptError

if TYPE_CHECKING:
    from stiffopt.cli.solve_report import SummaryRow


@dataclass(frozen=True)
class SolveOptions:
    """The options of the command."""

    as_json: bool = False
    out: str | None = None
    plot: str | None = None
    pareto: int | None = None
    seed: int = 0
    quiet: bool = False

    @property
    def tables(self) -> bool:
        """Whether answers are printed as tables."""
        return not self.as_json and not self.quiet


def run(tasks: Sequence[str], options: SolveOptions) -> int:
    """Solve task files and folders of them; print, write and draw; return the exit code."""
    tasks_found = solve_files.find_tasks(tasks)
    files = tasks_found.paths
    try:
        if options.out is not None:
            solve_files.check_result_file(options.out, files)
        pictures = solve_files.picture_names(options.plot, files)
    except StiffoptError as error:
        report_error(str(error))
        return exits.BAD_INPUT
    with Interruptible() as interrupts, warnings_as_notes(quiet=options.quiet):
        batch = _Batch(options, len(files), interrupts)
        for bad in tasks_found.errors:
            batch.complain(bad.path, str(bad))
        for note in tasks_found.skipped if not options.quiet else ():
            report_note(note)
        return _solve_all(batch, files, pictures)


def _solve_all(batch: _Batch, files: Sequence[str], pictures: Sequence[str | None]) -> int:
    try:
        for file, picture in zip(files, pictures, strict=True):
            batch.solve(file, picture)
        batch.summarise()
        batch.write()
    except Closed:
        return exits.CLOSED_PIPE
    return exits.CLOSED_PIPE if batch.reader_left else exits.most_serious(batch.codes)


@dataclass
class _Batch:
    """The files that were solved so far, and their exit codes."""

    options: SolveOptions
    total: int
    interrupts: Interruptible
    solved: list[SolvedTask] = field(default_factory=list)
    rows: list[SummaryRow] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    reader_left: bool = False

    def __post_init__(self) -> None:
        self._progress = ProgressBar(quiet=self.options.quiet)
        self._number = 0  # of the file that is being solved, counted from 1

    def solve(self, file: str, picture: str | None) -> None:
        """Solve one file, or report what is wrong with it."""
        begin = perf_counter()
        self._number += 1
        try:
            with self._showing(file):
                solved = solve_file(file, seed=self.options.seed, pareto=self.options.pareto)
            self.interrupts.check()
        except StiffoptError as error:
            self.interrupts.check()
            self.complain(file, str(error))
        except (Closed, OSError):
            raise
        except Exception as error:  # a mistake of ours must not leave the other files unsolved
            self.interrupts.check()
            self.complain(file, f"{file}: {_bug(error)}", exits.FAILED)
        else:
            self._take(solved, perf_counter() - begin)
            if picture is not None:
                self._draw(solved, picture)

    def complain(self, file: str, message: str, code: int = exits.BAD_INPUT) -> None:
        """Report a file that could not be solved."""
        report_error(message)
        self.codes.append(code)
        if self.options.tables:
            from stiffopt.cli.solve_report import SummaryRow

            self.rows.append(SummaryRow(file, "bad input" if code == exits.BAD_INPUT else "failed"))

    def summarise(self) -> None:
        """Print one line a file, where there are several."""
        if len(self.rows) > 1:
            from stiffopt.cli.solve_report import summary

            self._print(lambda: show(summary(self.rows)))

    def write(self) -> None:
        """Write the result file."""
        if self.options.out is None:
            return
        try:
            solve_files.write_results(self.options.out, self.solved)
        except StiffoptError as error:
            report_error(str(error))
            self.codes.append(exits.BAD_INPUT)

    @contextmanager
    def _showing(self, text: str) -> Iterator[None]:
        """Show on which file work goes on, and how many are done where there are several."""
        with self._progress.shown():
            several = self.total > 1
            words = f"{text} ({self._number} of {self.total})" if several else text
            self._progress.report(self._number - 1, self.total if several else None, words)
            yield

    def _take(self, solved: SolvedTask, seconds: float) -> None:
        self.solved.append(solved)
        self.codes.append(exits.OF_STATUS[solved.solution.status])
        if self.options.as_json:
            self._print(lambda: write_json(solve_records.json_record(solved)))
        if self.options.tables:
            from stiffopt.cli.solve_report import SummaryRow, block

            self.rows.append(SummaryRow.of(solved, seconds))
            self._print(lambda: show(block(solved)))
        if solved.complaint:
            report_error(f"{solved.file}: {solved.complaint}")
            self.codes.append(exits.BAD_INPUT)

    def _draw(self, solved: SolvedTask, picture: str) -> None:
        """Draw a solved task; where that fails the solution is still reported."""
        try:
            with self._showing(f"{solved.file}: drawing"):
                solve_files.draw(solved, picture)
        except StiffoptError as error:
            report_error(f"no picture of {solved.file}: {error}")
            if solved.solution.pressures is not None:
                self.codes.append(exits.BAD_INPUT)

    def _print(self, printing: Callable[[], None]) -> None:
        """Print; where nobody reads any more, go on only if there are files to write."""
        if self.reader_left:
            return
        try:
            printing()
        except Closed:
            if self.options.out is None and self.options.plot is None:
                raise
            self.reader_left = True


def _bug(error: Exception) -> str:
    """Put a mistake of ours into one sentence that says where it is."""
    frames = extract_tb(error.__traceback__)
    where = f" in {frames[-1].name}, line {frames[-1].lineno}" if frames else ""
    return f"this should not happen: {type(error).__name__}{where}: {error}; please report it"
