"""What `stiffopt map workspace` does with its arguments."""

import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from types import FrameType
from typing import Any, cast

from stiffopt.cli import outputs
from stiffopt.cli.console import (
    console_on,
    report_error,
    report_note,
    show,
    warnings_as_notes,
    write_line,
)
from stiffopt.cli.exits import BAD_INPUT, INTERRUPTED, SOLVED
from stiffopt.errors import InputError, StiffoptError, shown
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.manipulator import load_robot
from stiffopt.units import parse_quantity
from stiffopt.workspace import WorkspaceMap, map_workspace

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class MapOptions:
    """The arguments of the command, as they were given."""

    robot: str
    out: str | None
    samples: int | None
    levels: int | None
    cell: str
    directions: list[str] | None
    kind: str
    boundary: str
    frame: str
    seed: int
    scheduler: str | None
    plot: str | None
    as_json: bool
    overwrite: bool
    quiet: bool


def run(options: MapOptions) -> int:
    """Make a map, or continue one; print and draw it; return the exit code."""
    try:
        picture = outputs.check(None, options.plot, (options.robot,)).plots[0]
        begin = perf_counter()
        found = _mapped(options)
        seconds = perf_counter() - begin
        if options.out is not None and not found.evaluated and not options.quiet:
            report_note(f"{options.out} is complete; there was nothing left to sample")
        _answer(found, options, seconds)
        if picture is not None:
            _draw(found, picture)
    except KeyboardInterrupt:
        return INTERRUPTED
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT
    return SOLVED


def _mapped(options: MapOptions) -> WorkspaceMap:
    directions = None
    if options.directions is not None:
        directions = [_direction(text) for text in options.directions]
    cell, robot = _cell(options.cell), load_robot(options.robot)
    display = _Display(quiet=options.quiet, out=options.out)
    with display.shown(), warnings_as_notes(quiet=options.quiet):
        return map_workspace(
            robot, options.out, directions=directions, kind=cast(Kind, options.kind),
            boundary=cast(Boundary, options.boundary), frame=cast(Frame, options.frame),
            samples=options.samples, levels=options.levels, cell=cell, seed=options.seed,
            scheduler=options.scheduler, overwrite=options.overwrite, progress=display.report,
        )  # fmt: skip


def _answer(found: WorkspaceMap, options: MapOptions, seconds: float) -> None:
    from stiffopt.cli import map_report

    if options.as_json:
        write_line(map_report.json_line(found, options.out, seconds))
    elif not options.quiet:
        show(map_report.summary(found, options.out, seconds))


def _draw(found: WorkspaceMap, path: str) -> None:
    from stiffopt.plots import save_figure
    from stiffopt.plots.workspace import plot_workspace

    save_figure(plot_workspace(found), path)


def _direction(text: str) -> tuple[float, ...]:
    """Direction from x, y, z or three numbers."""
    if text.strip() in _AXES:
        return _AXES[text.strip()]
    try:
        parts = tuple(float(part) for part in re.split(r"\s*,\s*", text.strip()))
    except ValueError:
        parts = ()
    if len(parts) != 3:
        raise InputError(
            f"--direction: {shown(text)} is no direction; expected x, y, z or three numbers "
            "such as 0,0.6,0.8"
        )
    return parts


def _cell(text: str) -> float:
    try:
        return parse_quantity(text, "m", "length")
    except InputError as error:
        raise InputError(f"--cell: {error}") from None


class _Display:
    """Progress on stderr, on a terminal; and Ctrl-C, which stops between two steps of the work.

    A second Ctrl-C does not wait for that.
    """

    def __init__(self, *, quiet: bool, out: str | None) -> None:
        self._quiet, self._out = quiet, out
        self._asked = False
        self._samples: tuple[int, int] | None = None
        self._progress = None if quiet or not sys.stderr.isatty() else _progress()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the progress, and stop on Ctrl-C."""
        previous = None
        if threading.current_thread() is threading.main_thread():
            previous = signal.signal(signal.SIGINT, self._interrupt)
        try:
            yield
        except KeyboardInterrupt:
            self._stop()
            self._say_how_to_resume()
            raise
        finally:
            self._stop()
            if previous is not None:
                signal.signal(signal.SIGINT, previous)

    def report(self, done: int, total: int) -> None:
        """Show how far the work is; raise if it shall stop."""
        first, self._samples = self._samples is None, (done, total)
        if self._asked:
            raise KeyboardInterrupt
        if first:
            if done and not self._quiet:
                report_note(f"{self._out} goes on after {done:,} of {total:,} samples")
            if self._progress is not None:
                self._progress.add_task("", total=total, completed=done)
                self._progress.start()
        if self._progress is not None:
            self._progress.update(self._progress.task_ids[0], completed=done)

    def _stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True

    def _say_how_to_resume(self) -> None:
        if self._quiet or self._samples is None:
            return
        done, total = self._samples
        report_note(
            f"stopped after {done:,} of {total:,} samples; "
            + (
                f"the same command goes on with {self._out}"
                if self._out
                else "nothing was kept: with --out a run can be resumed"
            )
        )


def _progress() -> Any:
    """Bar with the time it took and the time it will take."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = [
        SpinnerColumn(), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("samples,"),
        TimeElapsedColumn(), TextColumn("gone,"), TimeRemainingColumn(), TextColumn("to go"),
    ]  # fmt: skip
    return Progress(
        *columns, console=console_on(stderr=True), transient=True, redirect_stdout=False,
        redirect_stderr=False, speed_estimate_period=60.0,
    )  # fmt: skip
