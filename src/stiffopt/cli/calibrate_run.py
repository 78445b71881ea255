"""What `stiffopt calibrate` and `stiffopt validate` do: read, fit or compare, write, report."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

import stiffopt
from stiffopt.cli import quantities
from stiffopt.cli.calibration_logs import (
    RecordingOptions,
    check_model,
    fixed_keys,
    read_tables,
)
from stiffopt.cli.console import ProgressBar, show, warnings_as_notes, write_json
from stiffopt.cli.exits import Interruptible, exit_code
from stiffopt.cli.outputs import check_new_file, check_new_folder, new_folder
from stiffopt.errors import InputError
from stiffopt.files import save_file
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.calibration import calibrate as fit_robot
from stiffopt.identify.results import Comparison, Errors, together
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.validation import validate as compare_robot
from stiffopt.model.description import RobotDescription
from stiffopt.plots.wording import MM

__all__ = [
    "CalibrateOptions",
    "RecordingOptions",
    "run_calibrate",
    "run_validate",
]

_ENDINGS = (".yaml", ".yml")

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class CalibrateOptions:
    """The arguments of `stiffopt calibrate`, as they were given."""

    recordings: RecordingOptions
    out: str
    tables: tuple[str, ...]
    model: str
    strain_law: str
    fix: tuple[str, ...]
    rows: int | None
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
                from stiffopt.cli.calibration_report import write_calibration

                write_calibration(folder, result, options.out)
            save_file(options.out, "robot", result.robot, _origin(options, result))
        return lambda: _print_calibration(result, options)

    return _run(work, quiet=options.quiet)


def run_validate(
    recordings: RecordingOptions, report: str | None, *, as_json: bool, quiet: bool
) -> int:
    """Compare a robot with logs; report and draw; return the exit code."""

    def work(progress: Progress) -> Callable[[], None]:
        _check_report(report)
        settings = recordings.settings()
        robot = recordings.description()
        logs = recordings.read(robot, progress)
        found = compare_robot(robot, logs, settings, progress)
        with new_folder(report) as folder:
            if folder is not None:
                from stiffopt.cli.calibration_report import write_validation

                write_validation(folder, robot, found)

        def print_result() -> None:
            if as_json:
                write_json(validation_record(robot, found))
            elif not quiet:
                from stiffopt.cli.calibration_report import validation

                show(validation(robot, found, report))

        return print_result

    return _run(work, quiet=quiet)


def _run(work: Callable[[Progress], Callable[[], None]], *, quiet: bool) -> int:
    """Work with progress, then print the result, as `work` returns it; return the exit code."""

    def whole() -> None:
        bar = ProgressBar(quiet=quiet)
        with Interruptible() as interruptible, bar.shown(), warnings_as_notes(quiet=quiet):

            def progress(done: float, total: float, words: str) -> None:
                interruptible.check()
                bar.report(done, total, words)

            print_result = work(progress)
        print_result()

    return exit_code(whole)


def _calibrated(options: CalibrateOptions, progress: Progress) -> CalibrationResult:
    check_new_file(options.out, _ENDINGS)
    _check_report(options.report)
    if options.report and Path(options.report).resolve() == Path(options.out).resolve():
        raise InputError(f"{options.out}: the robot file and the report cannot have one name")
    if not options.recordings.logs and not options.tables:
        raise InputError(
            "there is nothing to fit to; expected a LOG or a table of stiffness (--stiffness)"
        )
    check_model(options.model)
    quantities.choice("--strain-law", options.strain_law, ("auto", "keep"))
    rows = {}
    if options.rows is not None:
        rows = {
            "rows": options.rows,
            "trial_rows": min(options.rows, CalibrationSettings().trial_rows),
        }
    robot = options.recordings.description()
    settings = options.recordings.settings(
        structure=options.model,
        strain_law=options.strain_law,
        fixed=fixed_keys(options.fix, robot),
        **rows,
    )
    tables = read_tables(options.tables, robot)
    logs = options.recordings.read(robot, progress)
    return fit_robot(robot, logs, tables, settings, progress)


def _check_report(path: str | None) -> None:
    if path is not None:
        from stiffopt.plots import require_matplotlib

        check_new_folder(path)
        require_matplotlib()


def _origin(options: CalibrateOptions, result: CalibrationResult) -> list[str]:
    """The comment at the top of the robot file: the data and options that it came from."""
    recordings = options.recordings
    lines = [f"Calibrated by stiffopt {stiffopt.__version__} from {Path(recordings.robot).name}."]
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
            f"Error of the tip on these logs: mean {errors.mean * MM:.2f} mm, "
            f"95 % below {errors.p95 * MM:.2f} mm."
        )
    words = ["the logs are a sequence"] * recordings.sequence + [
        "each log has its own origin"
    ] * recordings.rezero
    if recordings.pressures != "commanded":
        words.append(f"{recordings.pressures} pressures drive the model")
    if options.fix:
        words.append(f"not fitted: {', '.join(options.fix)}")
    if words:
        lines.append(f"Options: {'; '.join(words)}.")
    return lines


def _print_calibration(result: CalibrationResult, options: CalibrateOptions) -> None:
    if options.as_json:
        write_json(calibration_record(result, options.out, options.report))
    elif not options.quiet:
        from stiffopt.cli.calibration_report import calibration

        show(calibration(result, options.out, options.report))


# -- for programs ---------------------------------------------------------------------------------


def validation_record(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    """Return the errors of all logs together and of each, for JSON."""
    return {
        **_with_outside(robot, found),
        "robot": robot.name,
        "remarks": [f"{each.name}: {remark}" for each in found for remark in each.remarks],
        "logs": {each.name: _with_outside(robot, [each]) for each in found},
    }


def calibration_record(result: CalibrationResult, out: str, report: str | None) -> dict[str, Any]:
    """Return the result of a calibration for JSON."""
    length = result.before.length
    return {
        "robot": result.robot.name,
        "out": out,
        "report": report,
        "model": result.structure.name,
        "strain_laws": [segment.strain_law for segment in result.robot.segments],
        "models": [
            {
                "name": each.structure.name,
                "held_back_mean_mm": each.score * MM,
                "held_back": {name: _errors(e, length) for name, e in each.folds.items()},
            }
            for each in result.candidates
        ],
        "before": _comparisons(result.nominal, length),
        "after": _comparisons(result.calibrated, result.robot.length),
        "held_back": {name: _errors(e, length) for name, e in result.held_back.items()},
        "parameters": [
            {
                "name": each.name,
                "key": each.key or None,
                "unit": each.unit,
                "before": each.before,
                "value": each.value,
                "interval_95": [each.low, each.high],
                "learnt": each.learnt,
                "tolerances_from_before": each.far,
            }
            for each in result.estimates
        ],
        "remarks": list(result.remarks),
    }


def _comparisons(found: Sequence[Comparison], length: float) -> dict[str, Any] | None:
    if not found:
        return None
    logs = {each.name: _errors(each.errors, length) for each in found}
    return {**_errors(together(found), length), "logs": logs}


def _with_outside(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    record = _errors(together(found), robot.length)
    if robot.calibration is None:
        return {**record, "outside_training_percent": None, "outside_training": None}
    inside = np.concatenate([each.inside for each in found])
    beyond = [each.rows(~each.inside) for each in found if not each.inside.all()]
    return {
        **record,
        "outside_training_percent": float(np.mean(~inside) * 100),
        "outside_training": _errors(together(beyond), robot.length) if beyond else None,
    }


def _errors(errors: Errors, length: float) -> dict[str, Any]:
    names = ("mean", "median", "p95", "max")
    return {
        "n": errors.n,
        "position_error_mm": {name: getattr(errors, name) * MM for name in names},
        "position_error_percent_of_length": errors.mean / length * 100,
        "angle_error_deg": None if errors.angle is None else degrees(errors.angle),
    }
