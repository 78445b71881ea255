"""Exports the recording of a run as CSV, or plots it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stiffopt.cli.console import report_error, report_note, write_line
from stiffopt.cli.exits import BAD_INPUT, INTERRUPTED, SOLVED, Interruptible
from stiffopt.cli.outputs import check_new_file, check_picture
from stiffopt.errors import FileError, StiffoptError

__all__ = ["export", "plot"]


def export(recording: str, out: str | None, *, quiet: bool) -> int:
    """Write a recording as log v1; return the exit code."""

    def work() -> None:
        from stiffopt.daemon.run_log import read_log_of_recording
        from stiffopt.logs import write_log

        path = _beside(recording, ".csv") if out is None else out
        check_new_file(path, (".csv",))
        log, whole = read_log_of_recording(recording)
        if not len(log):
            raise FileError(recording, "has no row to export; it was cut short too early")
        write_log(path, log)
        if quiet:
            return
        if not whole:
            report_note(f"{recording} was cut short or damaged; what is whole was exported")
        seen = int(np.isfinite(log.tip_position).all(axis=1).sum())
        write_line(
            f"{path}: {len(log)} rows, {seen} with a tip, {log.time[-1] - log.time[0]:.1f} s"
        )

    return _done(work)


def plot(recording: str, out: str | None, *, quiet: bool) -> int:
    """Draw a recording; return the exit code."""

    def work() -> None:
        from stiffopt.daemon.run_log import read_run
        from stiffopt.plots import save_figure
        from stiffopt.plots.run import plot_run

        path = _beside(recording, ".png") if out is None else out
        check_picture(path)
        run = read_run(recording)
        if not run.complete and not quiet:
            report_note(f"{recording} was cut short or damaged; what is whole was drawn")
        save_figure(plot_run(run), path)
        if not quiet:
            write_line(path)

    return _done(work)


def _done(work: Callable[[], None]) -> int:
    try:
        with Interruptible() as interruptible:
            work()
            interruptible.check()
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        report_error("interrupted", label="")
        return INTERRUPTED
    return SOLVED


def _beside(recording: str, ending: str) -> str:
    """Return the recording's name with another ending."""
    return os.fspath(Path(recording).with_suffix(ending))
