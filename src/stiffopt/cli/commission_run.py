"""Run `stiffopt commission`: check the files, move the arm, vent it, explain, report."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from stiffopt.cli import commission_report
from stiffopt.cli.console import ProgressBar, report_note, show, warnings_as_notes, write_json
from stiffopt.cli.exits import MISFIT, SOLVED, InterruptBetweenSteps, interruptible
from stiffopt.cli.outputs import check_new_file
from stiffopt.cli.rig_work import RigStoppedError, new_name, on_rig, open_rig_for, rig_of
from stiffopt.commissioning.commission import Commissioning, evaluate, record_of, stopped_record
from stiffopt.commissioning.correction import check_place, corrections, write_corrected
from stiffopt.commissioning.expected import ExpectedSteps, expected_steps
from stiffopt.commissioning.procedure import LOG, StepReadings, run_steps
from stiffopt.commissioning.record import save_record
from stiffopt.errors import FileError, InputError, require_package
from stiffopt.experiments.folder import empty_folder
from stiffopt.rig.interface import Rig

RECORD = "record.yaml"
"""Copy of the record in the folder of a commissioning."""


def run(
    rig_file: str,
    *,
    fast: bool,
    out: str | None,
    folder: str | None,
    plot: bool,
    as_json: bool,
    quiet: bool,
) -> int:
    """Commission the rig of a file and return the exit code; `fast` shortens the steps."""
    if plot:
        from stiffopt.plots import require_matplotlib

        require_matplotlib()
    require_package("foxglove-sdk", "log", "foxglove")
    if out is not None:
        check_new_file(out, (".yaml", ".yml"))
        check_place(out, rig_file)
    with interruptible(), warnings_as_notes(quiet=quiet):
        rig, name, rate, log_folder = rig_of(rig_file)
        if rig.tracker is None:
            raise InputError("this rig has no tracker, which commissioning needs")
        rig.supply.check_arming()
        expected = expected_steps(rig.robot, rig.supply.limits)
        _check_record(rig.settings.commissioning.record)
        place = Path(log_folder) / new_name("commissioning", name) if folder is None else folder
        target = empty_folder(Path(place))
    try:
        readings = _moved(rig, expected, target, rate, fast=fast, quiet=quiet)
    except RigStoppedError as error:
        save_record(rig.settings.commissioning.record, stopped_record(rig, str(error), quick=fast))
        raise
    with interruptible(), warnings_as_notes(quiet=quiet):
        frequency = _frequency(expected)
        found = evaluate(rig, expected, readings, quick=fast, frequency=frequency)
        return _reported(rig, rig_file, found, target, out, plot, as_json=as_json, quiet=quiet)


def _check_record(path: str) -> None:
    """Raise `FileError` before the arm moves if the record could not be written."""
    folder = Path(path).resolve().parent
    if not os.access(folder, os.W_OK):
        raise FileError(path, f"the record cannot be written: {folder} is no folder to write to")


def _moved(
    rig: Rig, expected: ExpectedSteps, folder: Path, rate: float, *, fast: bool, quiet: bool
) -> StepReadings:
    """Move the arm, and vent it whatever happens."""
    interrupt, bar = InterruptBetweenSteps(), ProgressBar(quiet=quiet)

    def work() -> StepReadings:
        return run_steps(
            rig, expected, folder, rate=rate, quick=fast, progress=bar.report,
            check=interrupt.check,
        )  # fmt: skip

    def undo() -> None:
        with suppress(OSError):
            folder.rmdir()

    with warnings_as_notes(quiet=quiet), interrupt.handled(), bar:
        open_rig_for(rig, undo)
        return on_rig(rig, work, interrupt)


def _frequency(expected: ExpectedSteps) -> float:
    """Return the model's frequency of the first bending mode, in Hz."""
    from math import pi

    from stiffopt.control.vibration import BendingMode

    mode = BendingMode.of(expected.description)
    return mode.frequency(1 / expected.compliance) / (2 * pi)


def _reported(
    rig: Rig,
    rig_file: str,
    found: Commissioning,
    folder: Path,
    out: str | None,
    plot: bool,
    *,
    as_json: bool,
    quiet: bool,
) -> int:
    """Write the record, the page and the corrected rig file; print the findings."""
    record = record_of(rig, found, f"{LOG}.csv")
    save_record(folder / RECORD, record)
    path = rig.settings.commissioning.record
    log = str((folder / f"{LOG}.csv").resolve())
    save_record(path, record.model_copy(update={"log": log}))
    data, changed = corrections(rig, rig_file, found.explanation, found.responses, found.findings)
    written = None
    if out is not None and changed:
        write_corrected(out, rig_file, data, changed)
        written = out
    report = commission_report.report(record, found, rig_file, changed, written)
    report.write(folder, found if plot else None)
    if as_json:
        files = {"record": path, "folder": str(folder), "out": written, "changed": changed}
        write_json({**commission_report.as_record(record), **files})
    elif not quiet:
        show(report.renderable(str(folder), path))
    if out is not None and not changed and not quiet:
        report_note("there is nothing in the rig file to correct; no file was written")
    return SOLVED if found.fits else MISFIT
