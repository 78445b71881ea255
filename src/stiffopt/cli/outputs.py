"""The files that are written: checked before the long work, written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stiffopt.cli.answer import Answer
from stiffopt.cli.records import result_record
from stiffopt.documents import write_file
from stiffopt.errors import FileError

RESULT_FORMAT = "stiffopt-result/1"
_PICTURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class FilesToWrite:
    """Paths that were found to be writable.

    Attributes
    ----------
    out : the result file, or None.
    plots : one for each task, or None where none is drawn.
    """

    out: str | None
    plots: tuple[str | None, ...]


def check(out: str | None, plot: str | None, tasks: Sequence[str]) -> FilesToWrite:
    """Check the paths of --out and --plot before any long work is done.

    Raises
    ------
    FileError
        A path that cannot be written, has the wrong ending, or is a file of another kind.
    MissingExtraError
        A plot is asked for and matplotlib is not installed.
    """
    if out is not None:
        _check_out(out, tasks)
    if plot is None:
        return FilesToWrite(out, (None,) * len(tasks))
    from stiffopt.plots import require_matplotlib

    _check_ending(plot, _PICTURES)
    require_matplotlib()
    plots = _plot_names(plot, tasks)
    for path in plots:
        _check_writable(path)
    return FilesToWrite(out, plots)


def check_new_file(path: str, endings: tuple[str, ...]) -> None:
    """Check the path of a file that is written only where there is none.

    Raises
    ------
    FileError
        It is there, cannot be written, or has the wrong ending.
    """
    _check_writable(path)
    _check_ending(path, endings)
    if os.path.lexists(path):
        raise FileError(path, "exists; give another name, or remove it")


def check_new_folder(path: str) -> None:
    """Check the path of a folder that is made only where there is nothing.

    Raises
    ------
    FileError
        It is there, or cannot be made.
    """
    if os.path.lexists(path):
        raise FileError(path, "exists; give another folder, or remove it")
    parent = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(parent):
        raise FileError(path, f"cannot be made: there is no folder '{parent}'")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise FileError(path, "cannot be made: permission denied")


@contextmanager
def new_folder(path: str | None) -> Iterator[Path | None]:
    """Context with a folder that gets its name at the end, and is removed if something fails.

    Raises
    ------
    FileError
        It cannot be made.
    """
    if path is None:
        yield None
        return
    target = Path(os.path.abspath(path))
    try:
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as beside:
            part = Path(beside) / "part"
            part.mkdir()
            yield part
            part.rename(target)
    except OSError as error:
        raise FileError(path, f"cannot be made: {(error.strerror or '').lower()}") from None


def write_results(path: str, answers: Sequence[Answer]) -> None:
    """Write the result file.

    Raises
    ------
    FileError
        It cannot be written.
    """
    results = [result_record(answer) for answer in answers]
    write_file(path, {"format": RESULT_FORMAT, "results": results})


def draw(answer: Answer, path: str) -> None:
    """Draw an answer into a file; draw nothing where there is none.

    Raises
    ------
    FileError
        It cannot be written.
    """
    from stiffopt.plots import plot_solution, save_figure

    figure = plot_solution(
        answer.robot,
        answer.solution,
        front=answer.front,
        plain=answer.plain[0] if answer.plain else None,
        title=answer.name,
    )
    save_figure(figure, path)


def _check_out(path: str, tasks: Sequence[str]) -> None:
    _check_writable(path)
    if os.path.exists(path) and not os.path.isfile(path):
        return  # a pipe, a terminal
    _check_ending(path, (".yaml", ".yml"))
    if not os.path.exists(path):
        return
    if any(os.path.exists(task) and os.path.samefile(path, task) for task in tasks):
        raise FileError(path, "is one of the tasks; give --out another name")
    if not _is_result_file(path):
        raise FileError(
            path, f"exists and is no result file ('format: {RESULT_FORMAT}'); give another name"
        )


def _is_result_file(path: str) -> bool:
    """Whether a file may be overwritten: a result file starts with its format; so may nothing."""
    kind = RESULT_FORMAT.partition("/")[0]
    try:
        with open(path, "rb") as stream:
            start = stream.read(64)
    except OSError as error:
        raise FileError(path, f"cannot be read: {(error.strerror or '').lower()}") from None
    return not start or start.startswith(f"format: {kind}/".encode())


def _check_ending(path: str, endings: tuple[str, ...]) -> None:
    if not path.lower().endswith(endings):
        raise FileError(path, f"expected a name that ends in {' or '.join(endings)}")


def _check_writable(path: str) -> None:
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(path) or not os.path.basename(path):
        raise FileError(path, "is a folder; expected a file")
    if not os.path.isdir(folder):
        raise FileError(path, f"cannot be written: there is no folder '{folder}'")
    regular = os.path.isfile(path) or not os.path.exists(path)
    writable = not os.path.exists(path) or os.access(path, os.W_OK)
    if not writable or (regular and not os.access(folder, os.W_OK | os.X_OK)):
        raise FileError(path, "cannot be written: permission denied")


def _plot_names(plot: str, tasks: Sequence[str]) -> tuple[str, ...]:
    """Return a file for each task: FILE-<task>.png, or FILE.png if there is but one."""
    if len(tasks) == 1:
        return (plot,)
    stem, ending = os.path.splitext(plot)
    names: list[str] = []
    for task in tasks:
        name = first = f"{stem}-{Path(task).stem}"
        count = 1
        while f"{name}{ending}" in names:  # the same name in another folder
            count += 1
            name = f"{first}-{count}"
        names.append(f"{name}{ending}")
    return tuple(names)
