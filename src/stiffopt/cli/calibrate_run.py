"""What `stiffopt calibrate` and `stiffopt validate` do with their arguments."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import stiffopt
from stiffopt.cli import calibration_records as records
from stiffopt.cli.calibration_inputs import (
    Reading,
    check_model,
    check_strain_law,
    fixed_keys,
    read_tables,
)
from stiffopt.cli.console import report_error, show, warnings_as_notes, write_line
from stiffopt.cli.exits import BAD_INPUT, INTERRUPTED, SOLVED
from stiffopt.cli.experiment_display import Display
from stiffopt.cli.interrupts import Interruptible
from stiffopt.cli.outputs import check_new_file, check_new_folder, new_folder
from stiffopt.errors import InputError, StiffoptError
from stiffopt.files import save_file
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.calibration import calibrate as fit_robot
from stiffopt.identify.results import together
from stiffopt.identify.validation import validate as compare_robot

if TYPE_CHECKING:
    from stiffopt.identify.results import Comparison
    from stiffopt.model.description import RobotDescription

__all__ = ["CalibrateOptions", "Reading", "ValidateOptions", "run_calibrate", "run_validate"]

_ENDINGS = (".yaml", ".yml")
_FEW_ROWS = 600  # while models are compared

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class CalibrateOptions:
    """The arguments of `stiffopt calibrate`, as they were given."""

    reading: Reading
    out: str
    tables: tuple[str, ...]
    model: str
    strain_law: str
    fix: tuple[str, ...]
    rows: int | None
    report: str | None
    as_json: bool
    quiet: bool


@dataclass(frozen=True)
class ValidateOptions:
    """The arguments of `stiffopt validate`, as they were given."""

    reading: Reading
    report: str | None
    as_json: bool
    quiet: bool


def run_calibrate(options: CalibrateOptions) -> int:
    """Fit a robot; write, report and draw it; return the exit code."""

    def work(progress: Progress) -> Callable[[], None]:
        result = _calibrated(options, progress)
        progress(1, 1, "writing")
        with new_folder(options.report) as folder:
            if folder is not None:
                from stiffopt.cli import calibration_page

                calibration_page.write_calibration(folder, result, options.out)
            save_file(options.out, "robot", result.robot, _origin(options, result))
        return lambda: _tell_calibration(result, options)

    return _run(work, quiet=options.quiet)


def run_validate(options: ValidateOptions) -> int:
    """Compare a robot with logs; report and draw; return the exit code."""

    def work(progress: Progress) -> Callable[[], None]:
        _check_report(options.report)
        settings = options.reading.settings()
        robot = options.reading.description()
        logs = options.reading.read(robot, progress)
        found = compare_robot(robot, logs, settings, progress)
        with new_folder(options.report) as folder:
            if folder is not None:
                from stiffopt.cli import calibration_page

                calibration_page.write_validation(folder, robot, found)
        return lambda: _tell_validation(robot, found, options)

    return _run(work, quiet=options.quiet)


def _run(work: Callable[[Progress], Callable[[], None]], *, quiet: bool) -> int:
    """Work with progress, then tell what came of it; return the exit code."""
    try:
        display = Display(quiet=quiet)
        quietly = warnings_as_notes(quiet=quiet)
        with Interruptible() as interruptible, display.shown(), quietly:

            def progress(done: float, total: float, words: str) -> None:
                interruptible.check()
                display.report(done, total, words)

            tell = work(progress)
        tell()
    except KeyboardInterrupt:
        return INTERRUPTED
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT
    return SOLVED


def _calibrated(options: CalibrateOptions, progress: Progress) -> CalibrationResult:
    check_new_file(options.out, _ENDINGS)
    _check_report(options.report)
    if options.report and Path(options.report).resolve() == Path(options.out).resolve():
        raise InputError(f"{options.out}: the robot file and the report cannot have one name")
    if not options.reading.logs and not options.tables:
        raise InputError(
            "there is nothing to fit to; expected a LOG or a table of stiffness (--stiffness)"
        )
    check_model(options.model)
    check_strain_law(options.strain_law)
    rows = {}
    if options.rows is not None:
        rows = {"rows": options.rows, "trial_rows": min(options.rows, _FEW_ROWS)}
    robot = options.reading.description()
    settings = options.reading.settings(
        structure=options.model,
        strain_law=options.strain_law,
        fixed=fixed_keys(options.fix, robot),
        **rows,
    )
    tables = read_tables(options.tables, robot)
    logs = options.reading.read(robot, progress)
    return fit_robot(robot, logs, tables, settings, progress)


def _check_report(path: str | None) -> None:
    if path is not None:
        from stiffopt.plots import require_matplotlib

        check_new_folder(path)
        require_matplotlib()


def _origin(options: CalibrateOptions, result: CalibrationResult) -> list[str]:
    """Say at the top of the file what it came from."""
    robot, reading = options.reading.robot, options.reading
    lines = [f"Calibrated by stiffopt {stiffopt.__version__} from {Path(robot).name}."]
    names = [each.name for each in result.calibrated]
    if names:
        lines.append(f"Logs: {', '.join(names)}.")
    if options.tables:
        tables = ", ".join(os.path.basename(path) for path in options.tables)
        lines.append(f"Tables of stiffness: {tables}.")
    lines.append(f"Model: {result.structure.name}, {result.structure.words}.")
    if names:
        errors = together(result.calibrated)
        lines.append(
            f"Error of the tip on these logs: mean {errors.mean * 1e3:.2f} mm, "
            f"95 % below {errors.p95 * 1e3:.2f} mm."
        )
    words = ["the logs are a sequence"] * reading.sequence + ["each log is zeroed"] * reading.rezero
    if reading.pressures != "commanded":
        words.append(f"{reading.pressures} pressures lead")
    if options.fix:
        words.append(f"not fitted: {', '.join(options.fix)}")
    if words:
        lines.append(f"Options: {'; '.join(words)}.")
    return lines


def _tell_calibration(result: CalibrationResult, options: CalibrateOptions) -> None:
    if options.as_json:
        record = records.calibration(result, options.out, options.report)
        write_line(json.dumps(record, allow_nan=False))
    elif not options.quiet:
        from stiffopt.cli import calibration_report

        show(calibration_report.calibration(result, options.out, options.report))


def _tell_validation(
    robot: RobotDescription, found: tuple[Comparison, ...], options: ValidateOptions
) -> None:
    if options.as_json:
        write_line(json.dumps(records.validation(robot, found), allow_nan=False))
    elif not options.quiet:
        from stiffopt.cli import calibration_report

        show(calibration_report.validation(robot, found, options.report))
