"""Where output goes: answers to stdout, errors, notes and progress to stderr.

Nothing that is printed is markup: a path may hold brackets.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from stiffopt.errors import printable


class Closed(Exception):  # noqa: N818 - no error: the reader has had enough
    """Nobody reads stdout any more."""


def _console(*, stderr: bool = False) -> Console:
    return Console(stderr=stderr, markup=False, highlight=False, emoji=False)


@contextmanager
def _noticing_closed_pipe() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        # what is buffered, and what the interpreter flushes as it ends, must go somewhere
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        raise Closed from None


def show(renderable: RenderableType) -> None:
    """Print text or a table to stdout, in colour on a terminal.

    Raises
    ------
    Closed
        Nobody reads stdout any more.
    """
    console = _console()
    with console.capture() as capture:
        console.print(renderable)
    write_line("\n".join(line.rstrip() for line in capture.get().removesuffix("\n").split("\n")))


def write_line(text: str) -> None:
    """Print a line to stdout as it is, whatever its width.

    Raises
    ------
    Closed
        Nobody reads stdout any more.
    """
    with _noticing_closed_pipe():
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def report_error(message: str, *, label: str = "error: ") -> None:
    """Print one message to stderr, on one line if it has no line breaks of its own."""
    lines = "\n".join(printable(line) for line in message.splitlines())
    text = Text.assemble((label, "bold red"), lines)
    _console(stderr=True).print(text, soft_wrap=True)


def report_note(message: str) -> None:
    """Print what a user may want to know but need not act on to stderr."""
    report_error(message, label="note: ")


class Work:
    """Progress of long work, shown on stderr while it lasts and only on a terminal."""

    def __init__(self, total: int, *, quiet: bool) -> None:
        console = _console(stderr=True)
        count = [BarColumn(bar_width=24), MofNCompleteColumn()] if total > 1 else []
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            *count,
            TimeElapsedColumn(),
            console=console,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=total)

    @contextmanager
    def step(self, file: str) -> Iterator[None]:
        """Show that a file is being solved; the display is gone when it is done."""
        try:
            with self._shown(file):
                yield
        finally:
            self._progress.advance(self._task)

    @contextmanager
    def drawing(self, file: str) -> Iterator[None]:
        """Show that its picture is being drawn."""
        with self._shown(f"{file}: drawing"):
            yield

    @contextmanager
    def _shown(self, description: str) -> Iterator[None]:
        self._progress.update(self._task, description=printable(description))
        self._progress.start()
        try:
            yield
        finally:
            self._progress.stop()
