"""What `solve` does: solve one task file after the other; print, write and draw the solutions.

The tables need rich, so their module is imported where one is printed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from traceback import extract_tb

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
from stiffopt.cli.exits import interruptible
from stiffopt.cli.solved_task import SolvedTask, solve_file
from stiffopt.errors import StiffoptError


@dataclass
class Batch:
    """The task files of one command, which are solved in turn, and what has come of them.

    The fields without a default are the options of the command. `rows` are those of the summary,
    `codes` the exit codes of the files.
    """

    as_json: bool
    out: str | None
    plot: str | None
    pareto: int | None
    seed: int
    quiet: bool
    solved: list[SolvedTask] = field(default_factory=list)
    rows: list[tuple[str, ...]] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    stdout_is_closed: bool = False

    def run(self, tasks: Sequence[str]) -> int:
        """Solve task files and folders of them; return the exit code."""
        found = solve_files.find_tasks(tasks)
        files = found.paths
        if self.out is not None:
            solve_files.check_result_file(self.out, files)
        pictures = solve_files.picture_names(self.plot, files)
        with interruptible() as check, warnings_as_notes(quiet=self.quiet):
            for bad in found.errors:
                self._refuse(bad.path, str(bad))
            for note in found.skipped if not self.quiet else ():
                report_note(note)
            for number, (file, picture) in enumerate(zip(files, pictures, strict=True)):
                with ProgressBar(quiet=self.quiet) as bar:
                    if len(files) > 1:
                        bar.report(number, len(files), f"{file} ({number + 1} of {len(files)})")
                    else:
                        bar.report(0, None, file)
                    self._solve(file, picture, check, bar)
            self._summarise()
        if self.out is not None:
            try:
                solve_files.write_results(self.out, self.solved)
            except StiffoptError as error:
                report_error(str(error))
                self.codes.append(exits.BAD_INPUT)
        return exits.CLOSED_PIPE if self.stdout_is_closed else exits.most_serious(self.codes)

    def _solve(
        self, file: str, picture: str | None, check: Callable[[], None], bar: ProgressBar
    ) -> None:
        """Solve one file, or report what is wrong with it."""
        begin = perf_counter()
        try:
            try:
                solved = solve_file(file, seed=self.seed, pareto=self.pareto)
            finally:
                bar.hide()
            check()
        except StiffoptError as error:
            check()
            self._refuse(file, str(error))
        except OSError:
            raise
        except Exception as error:  # a mistake of ours must not leave the other files unsolved
            check()
            self._refuse(file, f"{file}: {_bug(error)}", exits.FAILED)
        else:
            self._take(solved, perf_counter() - begin)
            if picture is not None:
                self._draw(solved, picture, bar)

    def _refuse(self, file: str, message: str, code: int = exits.BAD_INPUT) -> None:
        """Report a file that could not be solved."""
        report_error(message)
        self.codes.append(code)
        self.rows.append((file, "bad input" if code == exits.BAD_INPUT else "failed"))

    def _take(self, solved: SolvedTask, seconds: float) -> None:
        """Print a solved task, and keep it for the summary and the result file."""
        self.solved.append(solved)
        self.codes.append(exits.OF_STATUS[solved.solution.status])
        if self.as_json:
            self._print(lambda: write_json(solve_records.json_record(solved)))
        elif not self.quiet:
            from stiffopt.cli.solve_report import block, summary_row

            self.rows.append(summary_row(solved, seconds))
            self._print(lambda: show(block(solved)))
        if solved.no_front:
            report_error(f"{solved.file}: {solved.no_front}")
            self.codes.append(exits.BAD_INPUT)

    def _summarise(self) -> None:
        """Print one line a file, where there are several."""
        if len(self.rows) > 1 and not self.as_json and not self.quiet:
            from stiffopt.cli.solve_report import summary

            self._print(lambda: show(summary(self.rows)))

    def _draw(self, solved: SolvedTask, picture: str, bar: ProgressBar) -> None:
        """Draw a solved task; where that fails the solution is still reported."""
        try:
            bar.report(0, None, f"{solved.file}: drawing")
            try:
                solve_files.draw(solved, picture)
            finally:
                bar.hide()
        except StiffoptError as error:
            report_error(f"no picture of {solved.file}: {error}")
            if solved.solution.pressures is not None:
                self.codes.append(exits.BAD_INPUT)

    def _print(self, printing: Callable[[], None]) -> None:
        """Print; where nobody reads any more, go on only if there are files to write."""
        if self.stdout_is_closed:
            return
        try:
            printing()
        except Closed:
            if self.out is None and self.plot is None:
                raise
            self.stdout_is_closed = True


def _bug(error: Exception) -> str:
    """Put a mistake of ours into one sentence that says where it is."""
    frames = extract_tb(error.__traceback__)
    where = f" in {frames[-1].name}, line {frames[-1].lineno}" if frames else ""
    return f"this should not happen: {type(error).__name__}{where}: {error}; please report it"
