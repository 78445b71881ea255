"""What is printed, and where: answers to stdout; errors, notes and progress to stderr.

Nothing that is printed is markup, for a path may hold brackets. rich is imported when something is
shown and not before: JSON and help need none of it.
"""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any, TextIO

from stiffopt.errors import SlowWarning, printable

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress


_REFRESH = 0.1  # s, between two changes of a progress bar


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


def write_json(record: Mapping[str, Any]) -> None:
    """Print a record as one line of strict JSON to stdout, see `json_text`."""
    write_line(json_text(record))


def json_text(record: Mapping[str, Any]) -> str:
    """Return a record as one line of strict JSON: arrays are lists, NaN and infinity are null."""
    return json.dumps(plain_data(record), allow_nan=False)


def plain_data(value: Any) -> Any:
    """Return arrays and tuples as lists, and numbers that are not finite as None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: plain_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


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


class ProgressBar:
    """What goes on, how much of it is done and how long the rest takes.

    It is shown on stderr, on a terminal only, and is gone when the work is done.
    """

    def __init__(self, *, quiet: bool) -> None:
        self._wanted = not quiet and sys.stderr is not None and sys.stderr.isatty()
        self._progress: Progress | None = None
        self._is_shown = False
        self._shown_at = 0.0

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Context in which progress is shown once there is some."""
        try:
            yield
        finally:
            self._stop()

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Context without the bar, in which something else may be printed or asked."""
        self._stop()
        yield

    def report(self, done: float, total: float | None, text: str) -> None:
        """Show how far the work is; `total` is None where nobody knows."""
        if not self._wanted:
            return
        now = monotonic()
        if self._is_shown and now - self._shown_at < _REFRESH and done != total:
            return
        self._shown_at = now
        if self._progress is None:
            self._progress = _progress(is_counted=total is not None)
            self._progress.add_task("", total=total, completed=int(done))
        self._progress.update(
            self._progress.task_ids[0], completed=done, total=total, description=printable(text)
        )
        if not self._is_shown:
            self._progress.start()
            self._is_shown = True

    def _stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()
        self._is_shown = False


def _progress(*, is_counted: bool) -> Progress:
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: list[ProgressColumn] = [
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        TimeElapsedColumn(),
    ]
    if is_counted:
        columns[2:2] = [BarColumn(bar_width=24), TaskProgressColumn()]
        columns += [TextColumn("gone,"), TimeRemainingColumn(), TextColumn("to go")]
    return Progress(
        *columns,
        console=console_on(stderr=True),
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        speed_estimate_period=120.0,
    )
