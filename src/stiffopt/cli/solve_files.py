"""Find the task files of `solve`, and write its result files and figures.

An unusable path raises `FileError`.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from stiffopt.cli.outputs import check_ending, check_picture, check_writable
from stiffopt.cli.solve_records import result_record
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.documents import read_document, write_file
from stiffopt.errors import FileError, os_reason

RESULT_FORMAT = "stiffopt-result/1"
_YAML = (".yaml", ".yml")


class TaskFiles(NamedTuple):
    """Paths of task files in the order of work, and notes and errors about other files."""

    paths: list[str]
    skipped: list[str]
    errors: list[FileError]


def find_tasks(named: Iterable[str]) -> TaskFiles:
    """Replace each folder by the task files in it, sorted by name; subfolders are left alone.

    A file in a folder is skipped, with a note, only if its `format` is of another kind, such as a
    robot file.  A file that cannot be read, or has no `format`, may be a task file with a mistake,
    and is kept.
    """
    found = TaskFiles([], [], [])
    for name in named:
        if not os.path.isdir(name):
            found.paths.append(name)
            continue
        try:
            tasks, others = _in_folder(name)
        except FileError as error:
            found.errors.append(error)
        else:
            found.paths.extend(tasks)
            found.skipped.extend(others)
    return found


def _in_folder(folder: str) -> tuple[list[str], list[str]]:
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise FileError(folder, f"cannot be read: {os_reason(error)}") from None
    paths = [
        os.path.join(folder, name)
        for name in names
        if name.endswith(_YAML) and not name.startswith(".")
    ]
    paths = [path for path in paths if not os.path.isdir(path)]
    kinds = {path: _other_kind(path) for path in paths}
    tasks = [path for path, kind in kinds.items() if kind is None]
    if not tasks:
        raise FileError(folder, "has no task files (*.yaml); expected at least one")
    return tasks, [f"{path}: skipped, a {kind} file" for path, kind in kinds.items() if kind]


def _other_kind(path: str) -> str | None:
    """Return the kind of a stiffopt file that is not a task file, None for all others."""
    try:
        given = read_document(Path(path)).data.get("format")
    except FileError:
        return None
    if not isinstance(given, str) or not given.startswith("stiffopt-"):
        return None
    kind = given.removeprefix("stiffopt-").partition("/")[0]
    return None if kind in ("task", "") else kind


def check_result_file(path: str, tasks: Sequence[str], result: str = RESULT_FORMAT) -> None:
    """Check the path of --out: only another result file is overwritten."""
    check_writable(path)
    if os.path.exists(path) and not os.path.isfile(path):
        return  # a pipe, a terminal
    check_ending(path, _YAML)
    if not os.path.exists(path):
        return
    if any(os.path.exists(task) and os.path.samefile(path, task) for task in tasks):
        raise FileError(path, "is one of the files to solve; give --out another name")
    if not _begins(path, result):
        raise FileError(
            path, f"exists and is no result file ('format: {result}'); give another name"
        )


def _begins(path: str, result: str) -> bool:
    """Whether a file may be overwritten: it begins like a result file, or is empty."""
    kind = result.partition("/")[0]
    try:
        with open(path, "rb") as stream:
            start = stream.read(64)
    except OSError as error:
        raise FileError(path, f"cannot be read: {os_reason(error)}") from None
    return not start or start.startswith(f"format: {kind}/".encode())


def picture_names(plot: str | None, tasks: Sequence[str]) -> tuple[str | None, ...]:
    """Return the checked path of each task's figure; None without --plot."""
    if plot is None:
        return (None,) * len(tasks)
    names = names_for_each(plot, tasks)
    for name in names:
        check_picture(name)
    return names


def names_for_each(path: str, tasks: Sequence[str]) -> tuple[str, ...]:
    """Return the file for each task: FILE for a single task, FILE-<task> for several."""
    if len(tasks) == 1:
        return (path,)
    stem, ending = os.path.splitext(path)
    names: list[str] = []
    for task in tasks:
        name = first = f"{stem}-{Path(task).stem}"
        count = 1
        while f"{name}{ending}" in names:  # a task of the same name in another folder
            count += 1
            name = f"{first}-{count}"
        names.append(f"{name}{ending}")
    return tuple(names)


def write_results(path: str, solved: Sequence[SolvedTask]) -> None:
    """Write the result file."""
    results = [result_record(each) for each in solved]
    write_file(path, {"format": RESULT_FORMAT, "results": results})


def draw_supports(solved: SolvedTask, path: str | None, view: Sequence[float] | None) -> None:
    """Draw where a post or a wall would help."""
    from stiffopt.plots import save_figure
    from stiffopt.plots.supports import plot_supports

    if solved.supports is not None and path is not None:
        title = Path(solved.file).stem
        save_figure(plot_supports(solved.robot, solved.supports, title=title, view=view), path)


def draw(solved: SolvedTask, path: str, view: Sequence[float] | None) -> None:
    """Draw a solved task; raise `InputError` if the solver failed and there is nothing to draw."""
    from stiffopt.plots import plot_solution, save_figure

    figure = plot_solution(
        solved.robot,
        solved.solution,
        front=solved.front,
        plain=solved.plain[0] if solved.plain else None,
        title=Path(solved.file).stem,
        view=view,
    )
    save_figure(figure, path)
