"""Where output goes: answers to stdout, errors, notes and progress to stderr.

Nothing that is printed is markup: a path may hold brackets.

rich is imported when something is shown, not before: JSON and help need none of it.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from stiffopt.errors import SlowWarning, printable

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress


class Closed(Exception):  # noqa: N818 - no error: the reader has had enough
    """Nobody reads stdout any more."""


def console_on(*, stderr: bool = False) -> Console:
    """Console on stdout or stderr that takes text as it is."""
    from rich.console import Console

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
    console = console_on()
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
    if sys.stdout is None:  # closed by whoever started us
        return
    with _noticing_closed_pipe():
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def report_error(message: str, *, label: str = "error: ") -> None:
    """Print one message to stderr, on one line if it has no line breaks of its own."""
    from rich.text import Text

    lines = "\n".join(printable(line) for line in message.splitlines())
    text = Text.assemble((label, "bold red"), lines)
    console_on(stderr=True).print(text, soft_wrap=True)


def report_note(message: str) -> None:
    """Print what a user may want to know but need not act on to stderr."""
    report_error(message, label="note: ")


@contextmanager
def warnings_as_notes(*, quiet: bool) -> Iterator[None]:
    """Show a `SlowWarning` as a note, or not at all."""
    others = warnings.showwarning

    def show_note(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if not issubclass(category, SlowWarning):
            others(message, category, filename, lineno, file, line)
        elif not quiet:
            report_note(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", SlowWarning)
        warnings.showwarning = show_note
        yield


class Work:
    """Progress of long work, shown on stderr while it lasts and only on a terminal."""

    def __init__(self, total: int, *, quiet: bool) -> None:
        self._progress = None if quiet or not sys.stderr.isatty() else _progress(total)

    @contextmanager
    def step(self, file: str) -> Iterator[None]:
        """Show that a file is being solved; the display is gone when it is done."""
        try:
            with self._shown(file):
                yield
        finally:
            if self._progress is not None:
                self._progress.advance(self._progress.task_ids[0])

    @contextmanager
    def drawing(self, file: str) -> Iterator[None]:
        """Show that its picture is being drawn."""
        with self._shown(f"{file}: drawing"):
            yield

    @contextmanager
    def _shown(self, description: str) -> Iterator[None]:
        if self._progress is None:
            yield
            return
        self._progress.update(self._progress.task_ids[0], description=printable(description))
        self._progress.start()
        try:
            yield
        finally:
            self._progress.stop()


def _progress(total: int) -> Progress:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    console = console_on(stderr=True)
    count = [BarColumn(bar_width=24), MofNCompleteColumn()] if total > 1 else []
    progress = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        *count,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        disable=not console.is_terminal,
    )
    progress.add_task("", total=total)
    return progress
