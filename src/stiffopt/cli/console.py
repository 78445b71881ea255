"""Print answers to stdout; errors, notes and progress to stderr.

The markup of rich is off, since paths may contain brackets. rich is imported only when something
is shown: JSON and help do not need it.
"""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any, Self

from stiffopt.errors import SlowWarning, UnfitWarning, printable

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress


_FILE_WIDTH = 80  # columns of output that does not go to a terminal
_REFRESH = 0.1  # s, between updates of a progress bar
_FIRST_LINE, _LONGEST_SILENCE = 2.0, 30.0  # s, timing of progress lines without a terminal


class Closed(Exception):  # noqa: N818 - no error: `head`, for example, reads a few lines
    """The reader of stdout has closed it."""


def console_on(*, stderr: bool = False) -> Console:
    """Return a console on stdout or stderr that prints text literally.

    Without a terminal it is 80 columns wide, or `COLUMNS`. rich would take the width of the
    terminal from which the command was started, so that files would differ.
    """
    from rich.console import Console

    console = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _FILE_WIDTH
    return console


def show(renderable: RenderableType) -> None:
    """Print text or a table to stdout, in colour on a terminal; see `write_line`."""
    console = console_on()
    with console.capture() as capture:
        console.print(renderable)
    write_line("\n".join(line.rstrip() for line in capture.get().removesuffix("\n").split("\n")))


def write_line(text: str) -> None:
    """Print a line to stdout without wrapping; raise `Closed` if the reader is gone."""
    if sys.stdout is None:  # the program was started without stdout
        return
    try:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # the interpreter flushes the buffer at its end, which must not fail
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        raise Closed from None


def write_json(record: Mapping[str, Any]) -> None:
    """Print a record as one line of strict JSON to stdout: arrays are lists, NaN is null."""
    write_line(json.dumps(plain_data(record), allow_nan=False))


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
    """Print a note to stderr: information on which the user need not act."""
    report_error(message, label="note: ")


@contextmanager
def showing_slow_warnings(show: Callable[[str], object]) -> Iterator[None]:
    """Context in which a function shows the text of each `SlowWarning` and `UnfitWarning` once."""
    show_other, shown = warnings.showwarning, set[str]()

    def show_warning(
        message: Warning | str, category: type[Warning], *rest: Any, **more: Any
    ) -> None:
        if issubclass(category, SlowWarning | UnfitWarning):
            if str(message) not in shown:
                shown.add(str(message))
                show(str(message))
        else:
            show_other(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SlowWarning)
        warnings.simplefilter("always", UnfitWarning)
        warnings.showwarning = show_warning
        yield


def warnings_as_notes(*, quiet: bool) -> AbstractContextManager[None]:
    """Context in which these warnings are shown as notes, or not at all if `quiet`."""
    return showing_slow_warnings(lambda text: None if quiet else report_note(text))


class ProgressBar:
    """Shows the current work, its progress and the remaining time on stderr, as a context.

    A bar is shown from the first report to the end of the context. Without a terminal, lines are
    printed instead: the first after two seconds, then less and less often.
    """

    def __init__(self, *, quiet: bool, clock: Callable[[], float] = monotonic) -> None:
        self._wanted = (
            not quiet
            and sys.stderr is not None
            and os.environ.get("STIFFOPT_PROGRESS", "") != "none"
        )
        self._lines = None if self._wanted and sys.stderr.isatty() else _ProgressLines(clock)
        self._progress: Progress | None = None
        self._is_shown = False
        self._shown_at = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.hide()

    def report(self, done: float, total: float | None, text: str) -> None:
        """Show the progress; `total` is None if unknown."""
        if not self._wanted:
            return
        if self._lines is not None:
            self._lines.report(done, total, text)
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

    def hide(self) -> None:
        """Remove the bar until the next report, so that something else can be printed."""
        if self._progress is not None:
            self._progress.stop()
        self._is_shown = False


class _ProgressLines:
    """Prints progress lines with an estimate, less and less often, where there is no terminal."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._begin = clock()
        self._next = _FIRST_LINE

    def report(self, done: float, total: float | None, text: str) -> None:
        """Print a line if one is due."""
        spent = self._clock() - self._begin
        if spent < self._next:
            return
        self._next = spent + min(max(spent, _FIRST_LINE), _LONGEST_SILENCE)
        share = done / total if total else 0.0
        line = f"{printable(text)}: " if text else ""
        if share > 0.0:
            line += f"{share:.0%}, {spent:.0f} s so far, about {spent * (1 / share - 1):.0f} s left"
        else:
            line += f"{spent:.0f} s so far"
        print(line, file=sys.stderr, flush=True)


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
        columns += [TextColumn("so far,"), TimeRemainingColumn(), TextColumn("left")]
    return Progress(
        *columns,
        console=console_on(stderr=True),
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        speed_estimate_period=120.0,
    )
