"""What `stiffopt experiment` does: check everything, move the arm, vent it, report and draw."""

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from stiffopt.cli import experiment_report, quantities
from stiffopt.cli.console import (
    ProgressBar,
    report_note,
    show,
    warnings_as_notes,
    write_json,
)
from stiffopt.cli.exits import (
    InterruptBetweenSteps,
    Interruptible,
    RigFaultError,
    exit_code,
)
from stiffopt.errors import DeviceError, InputError, StiffoptError, require_package
from stiffopt.experiments import (
    KinematicsSettings,
    StiffnessSettings,
    evaluate_coverage,
    evaluate_kinematics,
    evaluate_stiffness,
    run_kinematics,
    run_stiffness,
)
from stiffopt.experiments.coverage import coverage_for, round_count
from stiffopt.experiments.folder import (
    alone_in,
    check_same,
    create_folder,
    open_folder,
    remove_folder,
)
from stiffopt.experiments.kinematics import (
    missing_repetitions,
    missing_rounds,
    sequence_for,
)
from stiffopt.experiments.kinematics_result import read_recordings, read_rounds
from stiffopt.experiments.stiffness import check_stiffness, missing_series
from stiffopt.logs import write_stiffness_table
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.rig.interface import Rig

FIGURE, TABLE = "figure.png", "stiffness.csv"
POSES_FIGURE = "poses.png"

Settings = KinematicsSettings | StiffnessSettings


@dataclass(frozen=True)
class ExperimentOptions:
    """The arguments of a command; `given` are the settings of the experiment, None where absent."""

    rig: str
    out: str | None
    resume: str | None
    model: str | None
    plot: bool
    quiet: bool
    given: Mapping[str, str | int | None]
    as_json: bool = False


@dataclass(frozen=True)
class _Plan:
    """Everything that was checked before anything moves."""

    rig: Rig
    rate: float
    folder: Path
    settings: Settings
    model: Manipulator
    is_new: bool

    @property
    def is_complete(self) -> bool:
        """Whether nothing is left to do."""
        if isinstance(self.settings, KinematicsSettings):
            return not (
                missing_repetitions(self.folder, self.settings)
                or missing_rounds(self.folder, self.settings)
            )
        return not missing_series(self.folder, self.settings)


def run(experiment: str, options: ExperimentOptions) -> int:
    """Do an experiment, or go on with it; report and draw; return the exit code."""

    def work() -> None:
        with Interruptible(), warnings_as_notes(quiet=options.quiet):
            plan = _planned(experiment, options)
        try:
            with warnings_as_notes(quiet=options.quiet):
                _do(plan, options)
                with Interruptible():
                    _report(plan, options)
        except (KeyboardInterrupt, _StoppedError):
            if not options.quiet:
                report_note(
                    f"what was recorded is in {plan.folder}; go on with: "
                    f"stiffopt experiment {experiment} {options.rig} --resume {plan.folder}"
                )
            raise

    return exit_code(work)


class _StoppedError(RigFaultError):
    """The rig was opened, and something went wrong on it."""


# -- before anything moves ------------------------------------------------------------------------


def _planned(experiment: str, options: ExperimentOptions) -> _Plan:
    if options.plot:
        from stiffopt.plots import require_matplotlib

        require_matplotlib()
    require_package("foxglove-sdk", "log", "foxglove")
    if options.resume is not None and options.out is not None:
        raise InputError("give --out for a new experiment or --resume for an old one, not both")
    rig, name, rate, log_folder = _rig(options.rig)
    settings, folder = _settings(experiment, options, rig, name, log_folder)
    model = load_robot(rig.robot if options.model is None else options.model)
    if model.n_pressures != rig.supply.n:
        raise InputError(
            f"the robot '{model.description.name}' has {model.n_pressures} channels, the rig has "
            f"{rig.supply.n}"
        )
    if rig.tracker is None:
        raise InputError("this rig has no tracker; the experiments need one")
    rig.supply.check_arming()
    if isinstance(settings, KinematicsSettings):
        sequence_for(rig, settings)
        coverage_for(rig, settings.poses, settings.settle, settings.max)
    else:
        check_stiffness(rig, settings)
        _check_that_somebody_is_there(rig)
    is_new = options.resume is None
    if is_new:
        create_folder(folder, settings)
    return _Plan(rig, rate, folder, settings, model, is_new)


def _check_that_somebody_is_there(rig: Rig) -> None:
    """Refuse a probe that must be mounted by hand where nobody can be asked to."""
    by_hand = rig.probe is not None and rig.probe.needs_a_person
    if by_hand and (sys.stdin is None or not sys.stdin.isatty()):
        raise InputError("this probe is mounted by hand; run the experiment at a terminal")


def _rig(path: str) -> tuple[Rig, str, float, str]:
    """The rig of a file, its name, its rate and its log folder."""
    from stiffopt.rig.config import load_rig_description
    from stiffopt.safety.rigs import open_rig

    description = load_rig_description(path)
    return open_rig(path), description.name, description.rate, description.log.folder


def _settings(
    experiment: str, options: ExperimentOptions, rig: Rig, name: str, log_folder: str
) -> tuple[Settings, Path]:
    """The settings of the experiment, and the folder in which it is recorded."""
    schema = KinematicsSettings if experiment == "kinematics" else StiffnessSettings
    given = {key: value for key, value in options.given.items() if value is not None}
    if options.resume is not None:
        if given:
            raise InputError(
                f"--{next(iter(given))} cannot be changed when an experiment is resumed; "
                f"{options.resume} says what is done"
            )
        folder = Path(options.resume)
        settings: Settings = (
            _kinematics_settings(folder)
            if experiment == "kinematics"
            else open_folder(folder, StiffnessSettings)
        )
        check_same("the robot", rig.robot.name, settings.robot)
        check_same("the number of channels", rig.supply.n, settings.channels)
        return settings, folder
    about = {"rig": name, "robot": rig.robot.name, "channels": rig.supply.n}
    settings = schema(**about, **{key: _read(key, value) for key, value in given.items()})
    if options.out is not None:
        return settings, Path(options.out)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    safe = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "rig"
    return settings, Path(log_folder) / f"{experiment}_{safe}_{stamp}"


def _kinematics_settings(folder: Path) -> KinematicsSettings:
    """Settings of a folder; an old one that does not mention combined poses has none."""
    settings = open_folder(folder, KinematicsSettings)
    begun_with = settings.poses if "poses" in settings.model_fields_set else 0
    return settings.model_copy(update={"poses": begun_with})


_QUANTITIES = {
    "max": ("Pa", "pressure"),
    "period": ("s", "duration"),
    "settle": ("s", "duration"),
    "displacement": ("m", "length"),
    "force": ("N", "force"),
}


def _read(key: str, value: str | int) -> Any:
    """Value of an option."""
    if not isinstance(value, str):
        return value
    option = f"--{key}"
    if key == "pressures":
        return quantities.pressures(option, value)
    if key == "directions":
        return quantities.directions(option, value)
    return quantities.quantity(option, value, *_QUANTITIES[key])


# -- on the rig -----------------------------------------------------------------------------------


def _do(plan: _Plan, options: ExperimentOptions) -> None:
    if plan.is_complete:
        if not options.quiet:
            report_note(f"{plan.folder} is complete; nothing was left to do")
        return
    interrupt, bar = InterruptBetweenSteps(), ProgressBar(quiet=options.quiet)
    common: dict[str, Any] = {
        "rate": plan.rate, "progress": bar.report, "check": interrupt.check,
    }  # fmt: skip

    @contextmanager
    def waiting_for_a_person() -> Iterator[None]:
        with bar.hidden(), interrupt.at_once():
            yield

    def work() -> list[str]:
        if isinstance(plan.settings, KinematicsSettings):
            return run_kinematics(plan.rig, plan.folder, plan.settings, **common)
        return run_stiffness(
            plan.rig,
            plan.folder,
            plan.settings,
            plan.model,
            aside=waiting_for_a_person,
            **common,
        )

    with alone_in(plan.folder), interrupt.handled(), bar.shown():
        _open(plan)
        notes = _on_rig(plan.rig, work, interrupt)
    if not options.quiet:
        for note in notes:
            report_note(note)


def _open(plan: _Plan) -> None:
    """Open the rig; leave no folder behind if there is none."""
    try:
        plan.rig.open()
    except StiffoptError as error:
        if plan.is_new:
            remove_folder(plan.folder)
        raise RigFaultError(str(error)) if isinstance(error, DeviceError) else error from error


def _on_rig(rig: Rig, work: Callable[[], list[str]], interrupt: InterruptBetweenSteps) -> list[str]:
    """Work, and vent and close the rig whatever happens."""
    failure: BaseException | None = None
    notes: list[str] = []
    try:
        notes = work()
    except BaseException as error:
        failure = error
    interrupt.hold()
    try:
        rig.close()
    except StiffoptError as error:
        first = f" (after: {failure})" if isinstance(failure, StiffoptError) else ""
        raise _StoppedError(f"THE ARM MAY STILL BE UNDER PRESSURE: {error}{first}") from error
    if isinstance(failure, StiffoptError):
        raise _StoppedError(f"{failure}; the arm is vented") from failure
    if failure is not None:
        raise failure
    return notes


# -- afterwards -----------------------------------------------------------------------------------


def _report(plan: _Plan, options: ExperimentOptions) -> None:
    """Evaluate, report, draw."""
    if isinstance(plan.settings, KinematicsSettings):
        _report_kinematics(plan, plan.settings, options)
    else:
        _report_stiffness(plan, plan.settings, options)


def _report_kinematics(
    plan: _Plan, settings: KinematicsSettings, options: ExperimentOptions
) -> None:
    folder, model = plan.folder, plan.model
    result = evaluate_kinematics(read_recordings(folder, settings), model)
    coverage = evaluate_coverage(read_rounds(folder, round_count(settings.poses)), model)
    report = experiment_report.kinematics_report(result, coverage, settings, model)
    report.write(folder)
    if options.plot:
        from stiffopt.plots import save_figure
        from stiffopt.plots.experiments import plot_coverage, plot_kinematics

        save_figure(plot_kinematics(result, title=report.title), folder / FIGURE)
        if coverage is not None:
            title = f"{report.title}, combined poses"
            save_figure(plot_coverage(coverage, title=title), folder / POSES_FIGURE)
    if options.as_json:
        record = experiment_report.kinematics_record(result, coverage, settings, model)
        write_json({**record, "folder": str(folder)})
    elif not options.quiet:
        show(report.renderable(str(folder)))


def _report_stiffness(plan: _Plan, settings: StiffnessSettings, options: ExperimentOptions) -> None:
    folder, model = plan.folder, plan.model
    result = evaluate_stiffness(folder, settings, model)
    write_stiffness_table(folder / TABLE, result.table())
    report = experiment_report.stiffness_report(result, model)
    report.write(folder)
    if options.plot:
        from stiffopt.plots import save_figure
        from stiffopt.plots.experiments import plot_stiffness

        save_figure(plot_stiffness(result, title=report.title), folder / FIGURE)
    if not options.quiet:
        show(report.renderable(str(folder)))
