"""Answer the files of one command in turn; an invalid one does not stop the others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from traceback import extract_tb
from typing import Generic, TypeVar

from stiffopt.cli import exits
from stiffopt.cli.console import Closed, ProgressBar, report_error, show
from stiffopt.errors import StiffoptError

AnswerT = TypeVar("AnswerT")


@dataclass
class Batch(ABC, Generic[AnswerT]):
    """The files of one command and their answers.

    `rows` are those of the summary, `codes` the exit codes of the files. `writes_files` says
    whether answers also go into files; if so, the work goes on when nobody reads stdout.
    """

    as_json: bool
    quiet: bool
    writes_files: bool
    answers: list[AnswerT] = field(default_factory=list)
    rows: list[tuple[str, ...]] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    stdout_is_closed: bool = False

    @abstractmethod
    def answer(self, file: str) -> AnswerT:
        """Answer one file; raise `StiffoptError` if it is invalid."""

    @abstractmethod
    def take(self, answer: AnswerT, seconds: float) -> None:
        """Print an answer, which took `seconds`, and add its exit code."""

    @abstractmethod
    def draw(self, answer: AnswerT, picture: str) -> None:
        """Draw an answer."""

    @abstractmethod
    def is_drawable(self, answer: AnswerT) -> bool:
        """Whether an answer can be drawn."""

    def answer_all(
        self, files: Sequence[str], pictures: Sequence[str | None], check: Callable[[], None]
    ) -> None:
        """Answer files in turn, and draw each answer for which a picture is named."""
        for number, (file, picture) in enumerate(zip(files, pictures, strict=True)):
            with ProgressBar(quiet=self.quiet) as bar:
                if len(files) > 1:
                    bar.report(number, len(files), f"{file} ({number + 1} of {len(files)})")
                else:
                    bar.report(0, None, file)
                self._answer(file, picture, check, bar)

    def _answer(
        self, file: str, picture: str | None, check: Callable[[], None], bar: ProgressBar
    ) -> None:
        """Answer one file, or report its error."""
        begin = perf_counter()
        try:
            try:
                answer = self.answer(file)
            finally:
                bar.hide()
            check()
        except StiffoptError as error:
            check()
            self.refuse(file, str(error))
        except OSError:
            raise
        except Exception as error:  # a bug must not leave the other files unanswered
            check()
            self.refuse(file, f"{file}: {_bug(error)}", exits.FAILED)
        else:
            self.answers.append(answer)
            self.take(answer, perf_counter() - begin)
            if picture is not None:
                self._draw(file, answer, picture, bar)

    def _draw(self, file: str, answer: AnswerT, picture: str, bar: ProgressBar) -> None:
        """Draw an answer, or report why that fails."""
        try:
            bar.report(0, None, f"{file}: drawing")
            try:
                self.draw(answer, picture)
            finally:
                bar.hide()
        except StiffoptError as error:
            report_error(f"no picture of {file}: {error}")
            if self.is_drawable(answer):
                self.codes.append(exits.BAD_INPUT)

    def refuse(self, file: str, message: str, code: int = exits.BAD_INPUT) -> None:
        """Report a file that could not be answered."""
        report_error(message)
        self.codes.append(code)
        self.rows.append((file, "bad input" if code == exits.BAD_INPUT else "failed"))

    def print(self, printing: Callable[[], None]) -> None:
        """Print; once nobody reads stdout, go on only if there are files to write."""
        if self.stdout_is_closed:
            return
        try:
            printing()
        except Closed:
            if not self.writes_files:
                raise
            self.stdout_is_closed = True

    def summarise(self, *headings: str) -> None:
        """Print a line for each file under some headings, if there are several files."""
        if len(self.rows) > 1 and not self.as_json and not self.quiet:
            from stiffopt.cli.tables import summary  # which needs rich

            self.print(lambda: show(summary(self.rows, headings)))

    def write(self, writing: Callable[[], None]) -> None:
        """Write a file with the answers, or report why that fails."""
        try:
            writing()
        except StiffoptError as error:
            report_error(str(error))
            self.codes.append(exits.BAD_INPUT)

    @property
    def exit_code(self) -> int:
        """Of the command."""
        return exits.CLOSED_PIPE if self.stdout_is_closed else exits.most_serious(self.codes)


def _bug(error: Exception) -> str:
    """Describe a bug in one sentence, with its place."""
    frames = extract_tb(error.__traceback__)
    where = f" in {frames[-1].name}, line {frames[-1].lineno}" if frames else ""
    return f"this should not happen: {type(error).__name__}{where}: {error}; please report it"
