"""Progress of an experiment, on stderr and only on a terminal."""

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from time import monotonic
from typing import Any

from stiffopt.cli.console import console_on
from stiffopt.errors import printable

__all__ = ["Display"]

_REFRESH = 0.1  # s


class Display:
    """A bar that says what goes on, how much is done and how long the rest will take."""

    def __init__(self, *, quiet: bool) -> None:
        self._progress = None if quiet or not sys.stderr.isatty() else _progress()
        self._is_shown = False
        self._told = -1.0

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Context in which progress is shown once there is some."""
        try:
            yield
        finally:
            if self._progress is not None:
                self._progress.stop()
            self._is_shown = False

    def report(self, done: float, total: float, text: str) -> None:
        """Show how far the work is."""
        if self._progress is None:
            return
        now = monotonic()
        if self._is_shown and now - self._told < _REFRESH and done < total:
            return
        self._told = now
        if not self._progress.task_ids:
            self._progress.add_task("", total=total)
        self._progress.update(
            self._progress.task_ids[0], completed=done, total=total, description=printable(text)
        )
        if not self._is_shown:
            self._progress.start()
            self._is_shown = True

    @contextmanager
    def aside(self, inner: AbstractContextManager[None]) -> Iterator[None]:
        """Context without the bar, in which something else may be printed or asked."""
        if self._progress is not None and self._is_shown:
            self._progress.stop()
            self._is_shown = False
        with inner:
            yield


def _progress() -> Any:
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = [
        SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(bar_width=24),
        TaskProgressColumn(), TimeElapsedColumn(), TextColumn("gone,"), TimeRemainingColumn(),
        TextColumn("to go"),
    ]  # fmt: skip
    return Progress(
        *columns, console=console_on(stderr=True), transient=True, redirect_stdout=False,
        redirect_stderr=False, speed_estimate_period=120.0,
    )  # fmt: skip
