"""Run `stiffopt experiment`: check all files and options, move the arm, vent it, report."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
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
from stiffopt.cli.exits import InterruptBetweenSteps, interruptible
from stiffopt.cli.rig_work import RigStoppedError, new_name, on_rig, open_rig_for, rig_of
from stiffopt.errors import InputError, require_package
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
from stiffopt.experiments.poses import POSES, load_poses, poses_for, run_poses
from stiffopt.experiments.stiffness import check_stiffness, missing_series
from stiffopt.logs import StiffnessTable, read_stiffness_table, write_stiffness_table
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import Published

Settings = KinematicsSettings | StiffnessSettings


@dataclass(frozen=True)
class _Plan:
    """Rig, robot and options of an experiment, checked before the arm moves."""

    rig: Rig
    rate: float
    folder: Path
    settings: Settings
    model: Manipulator
    is_new: bool
    published: Published | None
    table: StiffnessTable | None

    @property
    def is_complete(self) -> bool:
        """Whether every part of the experiment is recorded."""
        if isinstance(self.settings, KinematicsSettings):
            return not (
                missing_repetitions(self.folder, self.settings)
                or missing_rounds(self.folder, self.settings)
            )
        return not missing_series(self.folder, self.settings)


def run(
    experiment: str,
    rig: str,
    given: Mapping[str, Any],
    *,
    out: str | None,
    resume: str | None,
    model: str | None,
    plot: bool,
    as_json: bool = False,
    quiet: bool,
) -> None:
    """Do an experiment, or resume one; report and draw.

    `given` are the options that are settings of the experiment; absent options are None.
    """
    if plot:
        from stiffopt.plots import require_matplotlib

        require_matplotlib()
    require_package("foxglove-sdk", "log", "foxglove")
    if resume is not None and out is not None:
        raise InputError("give --out for a new experiment or --resume for an old one, not both")
    given = {key: value for key, value in given.items() if value is not None}
    with interruptible(), warnings_as_notes(quiet=quiet):
        plan = _planned(experiment, rig, given, out, resume, model)
    try:
        with warnings_as_notes(quiet=quiet):
            _do(plan, quiet=quiet)
            with interruptible():
                settings = plan.settings
                if isinstance(settings, KinematicsSettings):
                    _report_kinematics(plan, settings, plot=plot, as_json=as_json, quiet=quiet)
                else:
                    _report_stiffness(plan, settings, plot=plot, quiet=quiet)
    except (KeyboardInterrupt, RigStoppedError):
        if not quiet:
            report_note(
                f"the recording is in {plan.folder}; continue with: "
                f"stiffopt experiment {experiment} {rig} --resume {plan.folder}"
            )
        raise


def run_poses_file(file: str, *, out: str | None, quiet: bool) -> None:
    """Hold the poses of a file on the rig that it names, and record them."""
    require_package("foxglove-sdk", "log", "foxglove")
    settings = load_poses(file)
    with interruptible(), warnings_as_notes(quiet=quiet):
        rig, name, rate, log_folder = rig_of(str(Path(file).parent / settings.rig))
        if rig.tracker is None:
            raise InputError("this rig has no tracker; the experiments need one")
        rig.supply.check_arming()
        poses_for(rig, settings)
        folder = Path(log_folder) / new_name("poses", name) if out is None else Path(out)
        create_folder(folder, settings)
    interrupt, bar = InterruptBetweenSteps(), ProgressBar(quiet=quiet)

    def work() -> list[str]:
        run_poses(rig, folder, settings, rate=rate, progress=bar.report, check=interrupt.check)
        return []

    with warnings_as_notes(quiet=quiet), alone_in(folder), interrupt.handled(), bar:
        open_rig_for(rig, lambda: remove_folder(folder))
        on_rig(rig, work, interrupt)
    if not quiet:
        report_note(f"{len(settings.pressures)} poses are recorded in {folder / POSES}.csv")


# -- before anything moves ------------------------------------------------------------------------


def _planned(
    experiment: str,
    rig_file: str,
    given: Mapping[str, Any],
    out: str | None,
    resume: str | None,
    model_name: str | None,
) -> _Plan:
    rig, name, rate, log_folder = rig_of(rig_file)
    published, table = _published(rig, rig_file)
    if resume is None:
        about = {"rig": name, "robot": rig.robot.name, "channels": rig.supply.n}
        schema = KinematicsSettings if experiment == "kinematics" else StiffnessSettings
        settings: Settings = schema(
            **about, **{key: _read(key, value) for key, value in given.items()}
        )
        folder = Path(log_folder) / new_name(experiment, name) if out is None else Path(out)
    else:
        folder = Path(resume)
        settings = _old_settings(experiment, folder, given)
        check_same("the robot", rig.robot.name, settings.robot)
        check_same("the number of channels", rig.supply.n, settings.channels)
    model = load_robot(rig.robot if model_name is None else model_name)
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
        by_hand = rig.probe is not None and rig.probe.needs_a_person
        if by_hand and (sys.stdin is None or not sys.stdin.isatty()):
            raise InputError("this probe is mounted by hand; run the experiment at a terminal")
    if resume is None:
        create_folder(folder, settings)
    return _Plan(
        rig, rate, folder, settings, model, is_new=resume is None, published=published, table=table
    )


def _published(rig: Rig, path: str) -> tuple[Published | None, StiffnessTable | None]:
    """Return the published results that a rig file names, and their table of stiffness."""
    published = None if rig.settings is None else rig.settings.published
    if published is None or published.stiffness is None:
        return published, None
    return published, read_stiffness_table(Path(path).parent / published.stiffness)


def _old_settings(experiment: str, folder: Path, given: Mapping[str, Any]) -> Settings:
    """Return the settings of an experiment that is resumed."""
    if given:
        raise InputError(
            f"--{next(iter(given))} cannot be changed when an experiment is resumed; "
            f"{folder} has the settings"
        )
    if experiment == "stiffness":
        return open_folder(folder, StiffnessSettings)
    settings = open_folder(folder, KinematicsSettings)
    # a folder of an older version that does not mention combined poses has none
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
    """Return the value of an option."""
    if not isinstance(value, str):
        return value
    option = f"--{key}"
    if key == "pressures":
        return quantities.pressures(option, value)
    if key == "directions":
        return quantities.directions(option, value)
    return quantities.quantity(option, value, *_QUANTITIES[key])


# -- on the rig -----------------------------------------------------------------------------------


def _do(plan: _Plan, *, quiet: bool) -> None:
    if plan.is_complete:
        if not quiet:
            report_note(f"{plan.folder} is complete; nothing was left to do")
        return
    interrupt, bar = InterruptBetweenSteps(), ProgressBar(quiet=quiet)

    @contextmanager
    def waiting_for_a_person() -> Iterator[None]:
        bar.hide()
        with interrupt.at_once():
            yield

    def work() -> list[str]:
        rig, folder, settings = plan.rig, plan.folder, plan.settings
        common: dict[str, Any] = {
            "rate": plan.rate, "progress": bar.report, "check": interrupt.check,
        }  # fmt: skip
        if isinstance(settings, KinematicsSettings):
            return run_kinematics(rig, folder, settings, **common)
        return run_stiffness(
            rig, folder, settings, plan.model, aside=waiting_for_a_person, **common
        )

    with alone_in(plan.folder), interrupt.handled(), bar:
        open_rig_for(plan.rig, lambda: remove_folder(plan.folder) if plan.is_new else None)
        notes = on_rig(plan.rig, work, interrupt)
    if not quiet:
        for note in notes:
            report_note(note)


# -- afterwards -----------------------------------------------------------------------------------


def _report_kinematics(
    plan: _Plan, settings: KinematicsSettings, *, plot: bool, as_json: bool, quiet: bool
) -> None:
    folder, model = plan.folder, plan.model
    result = evaluate_kinematics(read_recordings(folder, settings), model)
    coverage = evaluate_coverage(read_rounds(folder, round_count(settings.poses)), model)
    report = experiment_report.kinematics_report(result, coverage, settings, model, plan.published)
    report.write(folder)
    if plot:
        from stiffopt.plots import save_figure
        from stiffopt.plots.experiments import plot_coverage, plot_kinematics

        within = None if plan.published is None else plan.published.tip_error
        figure = plot_kinematics(result, title=report.title, published=within)
        save_figure(figure, folder / "figure.png")
        if coverage is not None:
            title = f"{report.title}, combined poses"
            save_figure(plot_coverage(coverage, title=title), folder / "poses.png")
    if as_json:
        record = experiment_report.kinematics_record(result, coverage, settings, model)
        write_json({**record, "folder": str(folder)})
    elif not quiet:
        show(report.renderable(str(folder)))


def _report_stiffness(plan: _Plan, settings: StiffnessSettings, *, plot: bool, quiet: bool) -> None:
    folder, model = plan.folder, plan.model
    result = evaluate_stiffness(folder, settings, model)
    write_stiffness_table(folder / "stiffness.csv", result.table())
    report = experiment_report.stiffness_report(result, model, plan.table)
    report.write(folder)
    if plot:
        from stiffopt.plots import save_figure
        from stiffopt.plots.experiments import plot_stiffness

        figure = plot_stiffness(result, title=report.title, published=plan.table)
        save_figure(figure, folder / "figure.png")
    if not quiet:
        show(report.renderable(str(folder)))
