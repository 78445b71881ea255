"""What `solve-pressure` does with its arguments, file by file.

The tables need rich, so their module is imported where one is printed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from traceback import extract_tb
from typing import TYPE_CHECKING

from stiffopt.cli import exits, outputs, records
from stiffopt.cli.answer import Answer, answer_file
from stiffopt.cli.console import (
    Closed,
    Work,
    report_error,
    report_note,
    show,
    warnings_as_notes,
    write_line,
)
from stiffopt.cli.inputs import Inputs, find_tasks
from stiffopt.cli.interrupts import Interruptible
from stiffopt.errors import StiffoptError

if TYPE_CHECKING:
    from stiffopt.cli.report import Row


@dataclass(frozen=True)
class Options:
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


def run(tasks: Sequence[str], options: Options) -> int:
    """Solve task files and folders of them; print, write and draw; return the exit code."""
    inputs = find_tasks(tasks)
    try:
        to_write = outputs.check(options.out, options.plot, inputs.files)
    except StiffoptError as error:
        report_error(str(error))
        return exits.BAD_INPUT
    with Interruptible() as interrupts, warnings_as_notes(quiet=options.quiet):
        return _run_checked(inputs, to_write, options, interrupts)


def _run_checked(
    inputs: Inputs, to_write: outputs.FilesToWrite, options: Options, interrupts: Interruptible
) -> int:
    batch = _Batch(options, Work(len(inputs.files), quiet=options.quiet), interrupts)
    for bad in inputs.errors:
        batch.complain(bad.path, str(bad))
    for note in inputs.skipped if not options.quiet else ():
        report_note(note)
    try:
        for file, picture in zip(inputs.files, to_write.plots, strict=True):
            batch.solve(file, picture)
        batch.summarise()
        batch.write(to_write.out)
    except Closed:
        return exits.CLOSED_PIPE
    return exits.CLOSED_PIPE if batch.reader_left else exits.most_serious(batch.codes)


@dataclass
class _Batch:
    """What became of the files so far."""

    options: Options
    work: Work
    interrupts: Interruptible
    answers: list[Answer] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    reader_left: bool = False

    def solve(self, file: str, picture: str | None) -> None:
        """Answer one file, or report what is wrong with it."""
        begin = perf_counter()
        try:
            with self.work.step(file):
                answer = answer_file(file, seed=self.options.seed, pareto=self.options.pareto)
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
            self._take(answer, perf_counter() - begin)
            if picture is not None:
                self._draw(answer, picture)

    def complain(self, file: str, message: str, code: int = exits.BAD_INPUT) -> None:
        """Report a file that has no answer."""
        report_error(message)
        self.codes.append(code)
        if self.options.tables:
            from stiffopt.cli.report import Row

            self.rows.append(Row(file, "bad input" if code == exits.BAD_INPUT else "failed"))

    def summarise(self) -> None:
        """Print one line a file, where there are several."""
        if len(self.rows) > 1:
            from stiffopt.cli.report import summary

            self._print(lambda: show(summary(self.rows)))

    def write(self, path: str | None) -> None:
        """Write the result file."""
        if path is None:
            return
        try:
            outputs.write_results(path, self.answers)
        except StiffoptError as error:
            report_error(str(error))
            self.codes.append(exits.BAD_INPUT)

    def _take(self, answer: Answer, seconds: float) -> None:
        self.answers.append(answer)
        self.codes.append(exits.OF_STATUS[answer.solution.status])
        if self.options.as_json:
            self._print(lambda: write_line(records.json_line(answer)))
        if self.options.tables:
            from stiffopt.cli.report import Row, block

            self.rows.append(Row.of(answer, seconds))
            self._print(lambda: show(block(answer)))
        if answer.complaint:
            report_error(f"{answer.file}: {answer.complaint}")
            self.codes.append(exits.BAD_INPUT)

    def _draw(self, answer: Answer, picture: str) -> None:
        """Draw an answer; where that fails the answer still stands."""
        try:
            with self.work.drawing(answer.file):
                outputs.draw(answer, picture)
        except StiffoptError as error:
            report_error(f"no picture of {answer.file}: {error}")
            if answer.solution.pressures is not None:
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
