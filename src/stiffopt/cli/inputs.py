"""From what the user names, files and folders, to the task files that are meant."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from stiffopt.documents import read_document
from stiffopt.errors import FileError

_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class Inputs:
    """Task files in the order to solve them, and what was found on the way.

    Attributes
    ----------
    files : paths as the user would write them.
    skipped : notes about files in folders that are no task files.
    errors : folders that cannot be used.
    """

    files: tuple[str, ...]
    skipped: tuple[str, ...] = ()
    errors: tuple[FileError, ...] = ()


def find_tasks(named: Iterable[str]) -> Inputs:
    """Replace each folder by the task files in it, sorted by name; subfolders are left alone.

    A file in a folder is left out, with a note, only if its `format` says that it is something
    else, a robot file for example.  One that cannot be read or says nothing may be a task file
    with a mistake in it, and is kept.
    """
    files: list[str] = []
    skipped: list[str] = []
    errors: list[FileError] = []
    for name in named:
        if not os.path.isdir(name):
            files.append(name)
            continue
        try:
            tasks, others = _in_folder(name)
        except FileError as error:
            errors.append(error)
        else:
            files.extend(tasks)
            skipped.extend(others)
    return Inputs(tuple(files), tuple(skipped), tuple(errors))


def _in_folder(folder: str) -> tuple[list[str], list[str]]:
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise FileError(folder, f"cannot be read: {(error.strerror or '').lower()}") from None
    paths = [
        os.path.join(folder, name)
        for name in names
        if name.endswith(_SUFFIXES) and not name.startswith(".")
    ]
    paths = [path for path in paths if not os.path.isdir(path)]
    kinds = {path: _other_kind(path) for path in paths}
    tasks = [path for path, kind in kinds.items() if kind is None]
    if not tasks:
        raise FileError(folder, "has no task files (*.yaml); expected at least one")
    return tasks, [f"{path}: skipped, a {kind} file" for path, kind in kinds.items() if kind]


def _other_kind(path: str) -> str | None:
    """Return the kind of a stiffopt file that is no task file, None for all else."""
    try:
        given = read_document(Path(path)).data.get("format")
    except FileError:
        return None
    if not isinstance(given, str) or not given.startswith("stiffopt-"):
        return None
    kind = given.removeprefix("stiffopt-").partition("/")[0]
    return None if kind in ("task", "") else kind
