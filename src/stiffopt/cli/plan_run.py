"""Run `stiffopt plan`: plan a motion; print, write and draw it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from stiffopt.arrays import Array
from stiffopt.cli import exits
from stiffopt.cli.console import report_error, show, write_json
from stiffopt.cli.exits import interruptible_work
from stiffopt.cli.outputs import check_picture
from stiffopt.cli.path_records import csv_text, solution_quantities, solution_values
from stiffopt.cli.path_run import check_csv, is_csv
from stiffopt.cli.quantities import listed, quantity
from stiffopt.cli.quantities import view as view_angles
from stiffopt.cli.solve_files import check_result_file
from stiffopt.cli.solve_records import contact_record
from stiffopt.documents import write_file, write_whole
from stiffopt.errors import InputError, StiffoptError, printable, shown
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.scene import Scene, load_scene
from stiffopt.optimise.task import Task, load_task
from stiffopt.paths.configurations import checked_pressures
from stiffopt.paths.motion import plan_motion
from stiffopt.paths.motion_file import RESULT_FORMAT
from stiffopt.paths.solution import PathSolution

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True)
class PlanCommand:
    """The options of `stiffopt plan` that define the motion."""

    robot: str | None
    start: str
    goals: tuple[str, ...]
    scene: str | None
    clearance: str | None
    slew: str | None
    seed: int
    timeout: str

    def run(
        self,
        *,
        as_json: bool,
        out: tuple[str, ...],
        plot: str | None,
        view: str | None = None,
        quiet: bool,
    ) -> int:
        """Plan, print, write and draw; return the exit code."""
        ends = [self.start, *self.goals]
        for file in out:
            if is_csv(file):
                check_csv(file, [file])
            else:
                check_result_file(file, [each for each in ends if _is_file(each)], RESULT_FORMAT)
        check_picture(plot)
        angles = view_angles(view)
        with interruptible_work(quiet=quiet) as progress:
            progress(0, 0, "planning")
            scene, solution = self._plan()
        if as_json:
            end = solution.equilibria[-1] if solution.equilibria else None
            contacts = () if end is None else end.contacts
            values = {**solution_values(solution), "contacts": list(map(contact_record, contacts))}
            write_json({"from": self.start, "to": self.goals, **values})
        elif not quiet:
            show(self._report(scene, solution))
        return self._write(scene, solution, out, plot, angles) or exits.OF_STATUS[solution.status]

    def _plan(self) -> tuple[Scene | None, PathSolution]:
        """Return the scene and the motion."""
        given = [load_task(text) if _is_file(text) else text for text in (self.start, *self.goals)]
        tasks = [each for each in given if isinstance(each, Task)]
        robot = self._robot(tasks)
        ends = [
            each if isinstance(each, Task) else _pressures(robot, option, each)
            for option, each in zip(["--from"] + ["--to"] * len(self.goals), given, strict=True)
        ]
        replacing = None if self.scene is None else load_scene(self.scene)
        goals_first = [each for each in (*ends[1:], ends[0]) if isinstance(each, Task)]
        scenes = (each.scene for each in goals_first if each.scene is not None)
        scene = next(scenes, None) if replacing is None else replacing
        clearance = None
        if self.clearance is not None:
            clearance = quantity("--clearance", self.clearance, "m", "length")
            if clearance < 0:
                raise InputError(f"--clearance: must be at least 0, not {shown(self.clearance)}")
        solution = plan_motion(
            robot, ends[0], ends[1:], scene=replacing, clearance=clearance, slew=self._slew(robot),
            seed=self.seed, timeout=quantity("--timeout", self.timeout, "s", "time"),
        )  # fmt: skip
        if scene is not None and clearance is not None:
            scene = scene.model_copy(update={"clearance": clearance})
        return scene, solution

    def _robot(self, tasks: list[Task]) -> Manipulator:
        if self.robot is not None:
            return load_robot(self.robot)
        if not tasks:
            raise InputError("--robot: name a robot; pressures alone do not determine it")
        descriptions = [task.resolve_robot() for task in tasks]
        if any(each != descriptions[0] for each in descriptions):
            raise InputError("--robot: the tasks name different robots; name the one that is meant")
        return load_robot(descriptions[0])

    def _slew(self, robot: Manipulator) -> Array | None:
        if self.slew is None:
            return None
        if "," in self.slew:
            rates = _of_channels(robot, "--slew", self.slew, "Pa/s", "rate of pressure")
        else:
            rates = np.array(quantity("--slew", self.slew, "Pa/s", "rate of pressure"))
        if not (rates > 0).all():
            raise InputError(f"--slew: must be greater than 0, not {shown(self.slew)}")
        return rates

    def _write(
        self,
        scene: Scene | None,
        solution: PathSolution,
        out: tuple[str, ...],
        plot: str | None,
        view: tuple[float, ...] | None,
    ) -> int:
        """Write files, and draw; return an exit code if that fails."""
        code = exits.SOLVED
        for file in out:
            if is_csv(file):
                write_whole(FilePath(file), csv_text(solution).encode())
                continue
            record = {"from": self.start, "to": list(self.goals), **solution_quantities(solution)}
            write_file(file, {"format": RESULT_FORMAT, "results": [record]})
        if plot is not None and len(solution.times):
            from stiffopt.plots import plot_motion, save_figure

            try:
                save_figure(plot_motion(solution, scene, view=view), plot)
            except StiffoptError as error:
                report_error(f"no picture: {error}")
                code = exits.BAD_INPUT
        return code

    def _report(self, scene: Scene | None, solution: PathSolution) -> RenderableType:
        """Return the report for the terminal."""
        from rich.console import Group

        from stiffopt.cli.path_report import points_table
        from stiffopt.cli.tables import block_title, labelled

        robot = solution.robot.description
        title = block_title(f"motion of {printable(robot.name)}", solution.status, solution.timings)
        parts: list[RenderableType] = [title, labelled(self._lines(scene, solution))]
        if len(solution.times):
            parts += ["", points_table(solution)]
        return Group(*parts, "")

    def _lines(
        self, scene: Scene | None, solution: PathSolution
    ) -> Iterable[tuple[str, RenderableType]]:
        from rich.text import Text

        from stiffopt.cli.path_report import clearance_lines, rate_lines

        if solution.message:
            yield "note", Text(solution.message)
        yield "from", Text(printable(self.start))
        yield "to", Text("\n".join(map(printable, self.goals)))
        if not len(solution.times):
            return
        yield "time", Text(f"{solution.times[-1]:.4g} s, {len(solution.times)} points")
        yield from rate_lines(solution)
        if scene is None:
            yield "clearance", Text("not checked: neither --scene nor a task gives a scene")
        yield from clearance_lines(solution, scene)
        if solution.confidence:
            yield "search", Text(solution.confidence)


def _of_channels(robot: Manipulator, option: str, text: str, unit: str, what: str) -> Array:
    """Return the values of an option, one for each channel."""
    values = np.array(listed(option, text, unit, what))
    if len(values) != robot.n_pressures:
        raise InputError(
            f"{option}: expected one {what} for each of the {robot.n_pressures} channels of "
            f"'{printable(robot.description.name)}'; got {len(values)}: {shown(text)}"
        )
    return values


def _pressures(robot: Manipulator, option: str, text: str) -> Array:
    """Return the pressures of an option, within the limits of the robot."""
    return checked_pressures(option, robot, _of_channels(robot, option, text, "Pa", "pressure"))


def _is_file(text: str) -> bool:
    """Whether an end of a motion is a task file rather than pressures."""
    return text.lower().endswith((".yaml", ".yml")) or FilePath(text).is_file()
