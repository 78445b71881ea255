"""Run `stiffopt calibrate` and `stiffopt validate`: read recordings, fit or compare, report.

Input that cannot be read or does not suit the robot raises `InputError` before the fit.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

import stiffopt
from stiffopt.arrays import Array
from stiffopt.cli import quantities
from stiffopt.cli.console import report_error, show, write_json, write_line
from stiffopt.cli.exits import (
    FAILED,
    INTERRUPTED,
    SOLVED,
    Progress,
    interruptible_work,
    stoppable_work,
)
from stiffopt.cli.outputs import check_new_file, check_new_folder, new_folder
from stiffopt.display import display_units
from stiffopt.errors import (
    FileError,
    InputError,
    OutOfTimeError,
    StoppedError,
    printable,
    require_package,
    shown,
)
from stiffopt.experiments.poses import save_poses
from stiffopt.files import save_file
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.calibration import calibrate as fit_robot
from stiffopt.identify.results import together
from stiffopt.identify.settings import CalibrationSettings, Finding
from stiffopt.identify.structures import STRUCTURES
from stiffopt.identify.suggestion import Suggestion, suggest_poses
from stiffopt.identify.unknowns import history_unknowns, shape_unknowns
from stiffopt.identify.validation import validate as compare_robot
from stiffopt.logs import (
    Log,
    StiffnessTable,
    read_log,
    read_mcap_log,
    read_stiffness_table,
)
from stiffopt.model.description import Recordings, RobotDescription, Tolerances
from stiffopt.model.robot_files import load_description

_ENDINGS = (".yaml", ".yml")
_SEGMENT = re.compile(r"segments\[\d+\]\.")


def run_calibrate(
    recordings: RecordingOptions,
    out: str,
    *,
    tables: Sequence[str],
    model: str,
    strain_law: str,
    fix: Sequence[str],
    rows: int | None,
    quick: bool,
    timeout: str | None,
    suggest: str | None,
    rig: str | None,
    report: str | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Fit a robot; write, report and draw it; return the exit code."""
    code = SOLVED
    with stoppable_work(quiet=quiet) as progress:
        check_new_file(out, _ENDINGS)
        _check_report(report)
        if (suggest is None) != (rig is None):
            raise InputError("--suggest and --rig go together: the poses are for that rig")
        if suggest is not None:
            check_new_file(suggest, _ENDINGS)
        if report and Path(report).resolve() == Path(out).resolve():
            raise InputError(f"{out}: the robot file and the report cannot have the same name")
        if not recordings.logs and not tables:
            raise InputError(
                "there is nothing to fit to; expected a LOG or a table of stiffness (--stiffness)"
            )
        limits = None if rig is None else _RigLimits.of(rig)
        names = ["auto", *(structure.name for structure in STRUCTURES)]
        if model not in names:
            raise InputError(
                f"--model: there is no model {shown(model)}; expected one of {', '.join(names)}"
            )
        seconds = (
            None if timeout is None else quantities.quantity("--timeout", timeout, "s", "time")
        )
        quantities.choice("--strain-law", strain_law, ("auto", "keep"))
        counts = {}
        if rows is not None:
            counts = {"rows": rows, "trial_rows": min(rows, CalibrationSettings().trial_rows)}
        robot = recordings.description()
        if limits is not None and limits.channels != robot.n_pressures:
            raise InputError(
                f"{rig}: has {limits.channels} channels; the robot has {robot.n_pressures}"
            )
        settings = recordings.settings(
            structure=model, strain_law=strain_law, fixed=fixed_keys(fix, robot), **counts
        )
        if quick:
            settings = settings.quick(is_loaded=any(robot.gravity))
        stiffnesses = read_tables(tables, robot)
        logs = recordings.read(robot, progress)
        try:
            result = fit_robot(robot, logs, stiffnesses, settings, progress, timeout=seconds)
            code = FAILED if result.unfit else SOLVED
        except StoppedError as stop:
            if not isinstance(stop.found, CalibrationResult):
                if isinstance(stop, OutOfTimeError):
                    report_error(str(stop))
                raise KeyboardInterrupt from None
            result, code = stop.found, INTERRUPTED
        with new_folder(report) as folder:
            if folder is not None:
                from stiffopt.cli.calibration_report import write_calibration

                write_calibration(folder, result, out)
            origin = _origin(result, recordings, tables, fix, is_interrupted=code == INTERRUPTED)
            save_file(out, "robot", result.robot, origin)
        suggestion = None
        if limits is not None and suggest is not None and result.robot.calibration is not None:
            suggestion = suggest_poses(
                result.robot, low=limits.low, high=limits.high, is_allowed=limits.allows
            )
            save_poses(suggest, str(rig), suggestion.pressures)
    if result.unfit:
        report_error(f"the robot is of no use, and marked as unfit in {out}: {result.remarks[0]}")
    if quiet and not as_json:
        return code
    from stiffopt.cli.calibration_report import calibration, calibration_record

    if as_json:
        write_json({**calibration_record(result, out, report), **_record(suggestion, suggest)})
    else:
        show(calibration(result, out, report))
        if suggestion is not None:
            length = display_units().length
            then, now = length.text(suggestion.after, ".2f"), length.text(suggestion.before, ".2f")
            write_line(
                f"  poses       {printable(suggest or '')}, {len(suggestion.pressures)} to record "
                "next: the tip's uncertainty\n              (root mean square over all pressures) "
                f"should fall from {now} to {then}"
            )
    return code


@dataclass(frozen=True, eq=False)
class _RigLimits:
    """The pressures that a rig accepts."""

    low: Array
    high: Array
    allows: Callable[[Array], bool]

    @property
    def channels(self) -> int:
        return len(self.low)

    @classmethod
    def of(cls, path: str) -> _RigLimits:
        from stiffopt.safety.rigs import open_rig

        rig = open_rig(path)  # its devices are not opened
        most = np.inf if rig.max_force is None else rig.max_force
        limits = rig.supply.limits
        return cls(limits.low, limits.high, lambda pressures: rig.force(pressures) <= most)


def _record(suggestion: Suggestion | None, path: str | None) -> dict[str, Any]:
    """Return suggested poses for JSON, in SI units; empty without a suggestion."""
    if suggestion is None:
        return {}
    return {
        "suggestion": {
            "file": path,
            "pressures_pa": suggestion.pressures,
            "deviation_before_m": suggestion.before,
            "deviation_after_m": suggestion.after,
        }
    }


def run_validate(
    recordings: RecordingOptions, report: str | None, *, as_json: bool, quiet: bool
) -> None:
    """Compare a robot with logs; report and draw."""
    with interruptible_work(quiet=quiet) as progress:
        _check_report(report)
        settings = recordings.settings()
        robot = recordings.description()
        logs = recordings.read(robot, progress)
        found = compare_robot(robot, logs, settings, progress)
        with new_folder(report) as folder:
            if folder is not None:
                from stiffopt.cli.calibration_report import write_validation

                write_validation(folder, robot, found)
    if quiet and not as_json:
        return
    from stiffopt.cli.calibration_report import validation, validation_record

    if as_json:
        write_json(validation_record(robot, found))
    else:
        show(validation(robot, found, report))


# -- robot, recordings and tables of stiffness -----------------------------------------------------


@dataclass(frozen=True)
class RecordingOptions:
    """Options of both commands: robot, recordings, and how to read them."""

    robot: str
    logs: tuple[str, ...]
    sequence: bool
    rezero: bool
    beginning: str | None
    pressures: str
    channels: str | None
    frame: str | None
    keep: tuple[str, ...] = ()

    def settings(self, **others: Any) -> CalibrationSettings:
        """Return the settings of a calibration from these options and others."""
        quantities.choice("--pressures", self.pressures, ("commanded", "measured"))
        for each in self.keep:
            quantities.choice("--keep", each, get_args(Finding))
        given = {"sequence": self.sequence, "rezero": self.rezero, "pressures": self.pressures,
                 "keep": self.keep}  # fmt: skip
        if self.beginning is not None:
            settle = quantities.quantity("--beginning", self.beginning, "s", "time")
            if settle <= 0:
                raise InputError(f"--beginning: expected more than 0 s, got {settle:g} s")
            others["settle"] = settle
        return CalibrationSettings(**given, **others)

    def description(self) -> RobotDescription:
        """Return the robot, with the options' channels and frame for its recordings."""
        robot = load_description(self.robot)
        change: dict[str, Any] = {}
        if self.channels is not None:
            change["channels"] = quantities.channels("--channels", self.channels)
            if len(change["channels"]) != robot.n_pressures:
                raise InputError(
                    f"--channels: {shown(self.channels)} names {len(change['channels'])} columns, "
                    f"the robot '{robot.name}' has {robot.n_pressures} channels; expected one for "
                    "each"
                )
        if self.frame is not None:
            change["frame"] = self.frame
        if not change:
            return robot
        recordings = (robot.recordings or Recordings()).model_copy(update=change)
        return robot.model_copy(update={"recordings": recordings})

    def read(self, robot: RobotDescription, progress: Progress) -> list[tuple[str, Log]]:
        """Return the logs with their names, see `log_names`."""
        names = log_names(self.logs)
        if any(path.lower().endswith(".mcap") for path in self.logs):
            require_package("mcap", "log")
        found = []
        for i, (name, path) in enumerate(zip(names, self.logs, strict=True)):
            progress(i, len(names), f"reading {name}")
            log = _read(path)
            _check_channels(path, log, robot)
            found.append((name, log))
        return found


def log_names(paths: Sequence[str]) -> list[str]:
    """Return a name for each file: its own, with as many folders as make it unique."""
    parts = [Path(path).resolve().parts for path in paths]
    for i, each in enumerate(parts):
        if each in parts[:i]:
            raise FileError(paths[i], "is given twice; expected each log once")
    depth = [1] * len(parts)
    while True:
        names = ["/".join(each[-n:]) for each, n in zip(parts, depth, strict=True)]
        same = [i for i, name in enumerate(names) if names.count(name) > 1]
        if not same:
            return names
        for i in same:
            depth[i] += 1


def read_tables(paths: Sequence[str], robot: RobotDescription) -> list[StiffnessTable]:
    """Return tables of stiffness."""
    tables = []
    for path in paths:
        table = read_stiffness_table(path)
        if table.pressures.shape[1] != robot.n_pressures:
            raise FileError(
                path,
                f"has {table.pressures.shape[1]} pressures, the robot '{robot.name}' has "
                f"{robot.n_pressures} channels",
            )
        tables.append(table)
    return tables


def fixed_keys(given: Sequence[str], robot: RobotDescription) -> tuple[str, ...]:
    """Return the parameters that --fix names by keys, keys without indices, or ends of keys."""
    known = _fitted_keys(robot)
    found: list[str] = []
    for text in given:
        wanted = text.strip()
        meant = [
            key
            for key in known
            for candidate in (key, _SEGMENT.sub("", key))
            if candidate == wanted or candidate.startswith((f"{wanted}[", f"{wanted}."))
        ]
        if not meant:
            ends = dict.fromkeys(re.sub(r"\[\d+\]", "", _SEGMENT.sub("", key)) for key in known)
            raise InputError(
                f"--fix: {shown(text)} is no parameter of the robot '{robot.name}' that is fitted; "
                f"expected a key such as {known[0]}, or one of {', '.join(ends)} for all of them"
            )
        found += meant
    return tuple(dict.fromkeys(found))


def _fitted_keys(robot: RobotDescription) -> list[str]:
    """Return the keys of all parameters that any model fits."""
    tolerances = robot.tolerances or Tolerances()
    keys: dict[str, None] = {}
    for structure in STRUCTURES:
        begun = structure.applied(robot, float(max(robot.pressure_max)))
        unknowns = shape_unknowns(begun, structure.shape, tolerances)
        for each in (*unknowns, *history_unknowns(begun, tolerances)):
            if each.parameter is not None:
                keys[each.parameter.key] = None
    return list(keys)


def _read(path: str) -> Log:
    if path.lower().endswith(".mcap"):
        return read_mcap_log(path)
    try:
        return read_log(path)
    except FileError as error:
        try:
            read_stiffness_table(path)
        except FileError:
            raise error from None
        raise FileError(
            path, f"is a table of stiffness, not a log; give it as --stiffness {path}"
        ) from None


def _check_channels(path: str, log: Log, robot: RobotDescription) -> None:
    columns = robot.recordings.channels if robot.recordings is not None else ()
    if columns:
        if max(columns) > log.n:
            raise FileError(
                path,
                f"has no column p{max(columns)}_pa, which --channels or the robot file names; "
                f"there are {log.n} pressures",
            )
    elif log.n != robot.n_pressures:
        example = ",".join(str(c + 1) for c in range(robot.n_pressures))
        remedy = f"give the column of each channel with --channels {example}"
        if log.n < robot.n_pressures:
            remedy = "is this another robot's log?"
        raise FileError(
            path,
            f"has {log.n} pressures, the robot '{robot.name}' has {robot.n_pressures} channels; "
            f"{remedy}",
        )


# -- results --------------------------------------------------------------------------------------


def _check_report(path: str | None) -> None:
    if path is not None:
        from stiffopt.plots import require_matplotlib

        check_new_folder(path)
        require_matplotlib()


def _origin(
    result: CalibrationResult,
    recordings: RecordingOptions,
    tables: Sequence[str],
    fix: Sequence[str],
    *,
    is_interrupted: bool,
) -> list[str]:
    """Return the comment at the top of the robot file: the data and options of the fit."""
    lines = [f"Calibrated by stiffopt {stiffopt.__version__} from {Path(recordings.robot).name}."]
    names = [each.name for each in result.calibrated]
    if names:
        lines.append(f"Logs: {', '.join(names)}.")
    if tables:
        files = ", ".join(os.path.basename(path) for path in tables)
        lines.append(f"Tables of stiffness: {files}.")
    lines.append(f"Model: {result.structure.name}, {result.structure.words}.")
    if result.unfit:
        lines.append("UNFIT: it misses the logs below by more than 10 % of the arm's length.")
    if is_interrupted:
        lines.append("Interrupted: not all models were compared, and few rows were fitted.")
    if names:
        errors = together(result.calibrated)
        lines.append(
            f"Error of the tip on these logs: mean {1e3 * errors.mean:.2f} mm, "
            f"95 % below {1e3 * errors.p95:.2f} mm."
        )
    words = ["the logs are a sequence"] * recordings.sequence
    words += ["each log has its own origin"] * recordings.rezero
    if recordings.pressures != "commanded":
        words.append(f"{recordings.pressures} pressures drive the model")
    if fix:
        words.append(f"not fitted: {', '.join(fix)}")
    if words:
        lines.append(f"Options: {'; '.join(words)}.")
    return lines
