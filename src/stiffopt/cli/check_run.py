"""Check files for `stiffopt check`, each by its kind."""

from __future__ import annotations

import difflib
import os
import re
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stiffopt.cli.console import write_json, write_line
from stiffopt.cli.exits import BAD_INPUT, SOLVED
from stiffopt.documents import read_document
from stiffopt.errors import FileError, InputError, StiffoptError, dotted, shown
from stiffopt.files import format_of, line_of

_FORMAT = re.compile(r"stiffopt-([a-z]+)/\d+")


def check_files(paths: Sequence[str], *, as_json: bool, quiet: bool) -> int:
    """Check files, print their mistakes and return the exit code."""
    code = SOLVED
    kinds = {path: _kind_of(path) for path in paths}
    rigs = [path for path in paths if kinds[path] == "rig"]
    for path in paths:
        kind, mistakes = _checked(path, kinds[path], rigs[0] if len(rigs) == 1 else None)
        if mistakes:
            code = BAD_INPUT
        if as_json:
            write_json({"file": path, "kind": kind, "mistakes": [_record(m) for m in mistakes]})
            continue
        for mistake in mistakes:
            write_line(mistake.alone)
        if not mistakes and not quiet:
            article = "an" if kind[:1] in "aeiou" else "a"
            write_line(f"{path}: {article} {kind} file without mistakes")
    return code


def _record(mistake: FileError) -> dict[str, Any]:
    return {
        "file": mistake.path,
        "line": mistake.line,
        "key": mistake.key,
        "reason": mistake.own_reason,
    }


def check_file(path: str) -> tuple[str, list[FileError]]:
    """Return the kind of a file, empty if unknown, and its mistakes."""
    return _checked(path, _kind_of(path), None)


def _checked(path: str, found: str | FileError, rig: str | None) -> tuple[str, list[FileError]]:
    """Do the same for a file whose kind, or why there is none, was found.

    A task for the robot of `rig`, a rig file, is compared with the scene there.
    """
    if isinstance(found, FileError):
        return "", [found, *found.others]
    kind = found
    try:
        _CHECKS[kind](path)
        if kind == "task" and rig is not None:
            _check_on_rig(path, rig)
    except FileError as error:
        return kind, [error, *error.others]
    except StiffoptError as error:
        return kind, [FileError(path, str(error))]
    return kind, []


def _kind_of(path: str) -> str | FileError:
    """Return the kind of a file by its ending, or of a YAML file by its format; else a mistake."""
    if _is_pipe(path):  # reading would block, and works only once
        return FileError(path, "is a pipe; expected a file")
    ending = Path(path).suffix.lower()
    if ending in (".csv", ".mcap"):
        return "log"
    try:
        document = read_document(path)
    except FileError as error:
        return error
    given = document.data.get("format")
    match = _FORMAT.fullmatch(given) if isinstance(given, str) else None
    if match is not None and match[1] in _CHECKS:
        return match[1]
    formats = [format_of(kind) for kind in _CHECKS if kind != "log"]
    expected = f"expected one of {', '.join(formats)}"
    if given is None:
        return FileError(path, f"has no 'format'; {expected}")
    near = difflib.get_close_matches(str(given), formats, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else f"; {expected}"
    reason = f"{shown(given)} is no format that can be checked{hint}"
    return document.error(("format",), reason)


def _is_pipe(path: str) -> bool:
    """Whether a path is a pipe, or leads to one as a shell's ``<(...)`` does."""
    try:
        return stat.S_ISFIFO(os.stat(path).st_mode)
    except OSError:
        return False


def _check_robot(path: str) -> None:
    from stiffopt.model.robot_files import load_description

    load_description(Path(path))


def _check_scene(path: str) -> None:
    from stiffopt.model.scene import load_scene

    load_scene(path)


def _check_task(path: str) -> None:
    from stiffopt.optimise.task import load_task

    _check_with_robot(load_task(path))


def _check_on_rig(path: str, rig: str) -> None:
    """Compare a task with the scene of a rig that has its robot."""
    from stiffopt.control.checks import check_scene
    from stiffopt.optimise.task import load_task
    from stiffopt.rig.config import load_rig

    task = load_task(path)
    try:
        description, robot = load_rig(rig)
    except StiffoptError:
        return  # told of the rig itself
    if task.resolve_robot().name == robot.name:
        check_scene(task, description.scene)


def _check_path(path: str) -> None:
    from stiffopt.paths.path import load_path

    found = load_path(path)
    _check_with_robot(found)
    found.end_pressures(found.resolve_robot())


def _check_with_robot(wanted: Any) -> None:
    """Check the limits and the scene of a task or path against its robot."""
    robot = wanted.resolve_robot()
    wanted.pressure_bounds(robot)
    wanted.check_scene(robot)


def _check_rig(path: str) -> None:
    from stiffopt.daemon.armable import check_description
    from stiffopt.rig.config import load_rig

    mistakes = [
        FileError(path, str(error), line=line_of(path, *error.place), key=dotted(error.place))
        for error in check_description(*load_rig(path))
    ]
    if mistakes:
        mistakes[0].others = tuple(mistakes[1:])
        raise mistakes[0]


def _check_experiment(path: str) -> None:
    from stiffopt.experiments.poses import load_poses

    load_poses(path)


def _check_bench(path: str) -> None:
    from stiffopt.identify.bench import load_bench
    from stiffopt.model.robot_files import load_description

    bench, base = load_bench(path)
    for arm in bench.arms:
        load_description(arm.robot, base=base)


def _check_commissioning(path: str) -> None:
    from stiffopt.commissioning.record import load_record

    load_record(path)


def _check_log(path: str) -> None:
    if path.lower().endswith(".mcap"):
        from stiffopt.daemon.run_log import read_log_of_recording

        _, is_whole = read_log_of_recording(path)
        if not is_whole:
            reason = "was truncated or damaged; 'stiffopt log export' writes its complete part"
            raise FileError(path, reason)
        return
    from stiffopt.logs import read_log, read_stiffness_table

    try:
        read_log(path)
    except InputError as error:
        try:
            read_stiffness_table(path)
        except InputError:
            raise error from None


_CHECKS: dict[str, Callable[[str], None]] = {
    "robot": _check_robot,
    "task": _check_task,
    "path": _check_path,
    "scene": _check_scene,
    "rig": _check_rig,
    "experiment": _check_experiment,
    "bench": _check_bench,
    "commissioning": _check_commissioning,
    "log": _check_log,
}
