"""Determine the kind of a file, and load it as a design or a timeline."""

from __future__ import annotations

import tempfile
from pathlib import Path as FilePath

from stiffopt.daemon.run_log import read_log_of_recording, read_run
from stiffopt.documents import read_document, write_whole
from stiffopt.errors import FileError
from stiffopt.logs import read_log
from stiffopt.logs.mcap_file import read_mcap
from stiffopt.logs.mcap_log import LOG_METADATA
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import load_robot
from stiffopt.model.robot_files import builtin_robots, load_description
from stiffopt.model.scene import load_scene
from stiffopt.optimise.task import load_task
from stiffopt.paths.motion_file import is_motion_csv
from stiffopt.paths.path import load_path
from stiffopt.paths.solver import solve_path
from stiffopt.studio.design import Design
from stiffopt.studio.timeline import Timeline

ROBOT = "stiff-flop-2"
"""The default robot."""
_KINDS = ("robot", "task", "scene", "path", "rig")


def kind_of(file: str) -> str:
    """Return the kind of a file by its ending and its ``format``; a built-in name is a robot.

    Raises `FileError`: the file cannot be read, or the studio does not show its kind.
    """
    if file in builtin_robots():
        return "robot"
    if FilePath(file).suffix.lower() in (".csv", ".mcap"):
        return "recording"
    given = read_document(file).data.get("format")
    kind = given.partition("/")[0].removeprefix("stiffopt-") if isinstance(given, str) else ""
    if kind not in _KINDS:
        known = ", ".join(_KINDS)
        raise FileError(
            file, f"cannot be shown in the studio; expected a file of a {known} or recording"
        )
    return kind


def design_of(file: str, robot: str | None = None) -> Design:
    """Return the design of a robot, a task or a scene file."""
    kind = kind_of(file)
    if kind == "task":
        return Design.of_task(load_task(file))
    if kind == "scene":
        design, scene = Design.of_robot(robot or ROBOT), load_scene(file)
        scene.check_against(design.description)
        return design.with_task(scene=scene)
    return Design.of_robot(file)


def timeline_of(file: str, robot: str | None = None) -> Timeline:
    """Return the timeline of a path file, which is solved, a motion or a recording."""
    if kind_of(file) == "path":
        path = load_path(file)
        return Timeline.of_path(path, solve_path(load_robot(path.resolve_robot()), path))
    if FilePath(file).suffix.lower() == ".csv":
        description = load_description(robot or ROBOT)
        if is_motion_csv(file):
            return Timeline.of_motion(file, description)
        return Timeline.of_log(file, read_log(file), description)
    if LOG_METADATA in read_mcap(file).metadata:
        log, _ = read_log_of_recording(file)
        return Timeline.of_log(file, log, load_description(robot or ROBOT))
    run = read_run(file)
    description = load_description(robot) if robot else _robot_of(run.about.get("robot_file", ""))
    return Timeline.of_run(file, run, description)


def _robot_of(text: str) -> RobotDescription:
    """Return the robot whose file is stored in a recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = FilePath(folder) / "robot.yaml"
        write_whole(path, text.encode())
        return load_description(path)
