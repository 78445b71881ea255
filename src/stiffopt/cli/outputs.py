"""Check the paths of output files and folders before long work.

Each check raises `FileError` if the path cannot be written.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stiffopt.errors import FileError, os_reason

_PICTURES = (".png", ".pdf", ".svg")


def check_picture(path: str | None) -> None:
    """Check the path of a figure, if there is one, and that matplotlib is installed."""
    if path is not None:
        from stiffopt.plots import require_matplotlib

        check_ending(path, _PICTURES)
        require_matplotlib()
        check_writable(path)


def check_new_file(path: str, endings: tuple[str, ...]) -> None:
    """Check the path and ending of a file that must not exist yet."""
    check_writable(path)
    check_ending(path, endings)
    if os.path.lexists(path):
        raise FileError(path, "exists; give another name, or remove it")


def check_new_folder(path: str) -> None:
    """Check the path of a folder that must not exist yet."""
    if os.path.lexists(path):
        raise FileError(path, "exists; give another folder, or remove it")
    parent = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(parent):
        raise FileError(path, f"cannot be made: there is no folder '{parent}'")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise FileError(path, "cannot be made: permission denied")


@contextmanager
def new_folder(path: str | None) -> Iterator[Path | None]:
    """Context with a folder that is renamed to `path` at the end, or removed on failure."""
    if path is None:
        yield None
        return
    target = Path(os.path.abspath(path))
    try:
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary:
            part = Path(temporary) / "part"
            part.mkdir()
            yield part
            part.rename(target)
    except OSError as error:
        raise FileError(path, f"cannot be made: {os_reason(error)}") from None


def check_ending(path: str, endings: tuple[str, ...]) -> None:
    """Refuse a path with another ending."""
    if not path.lower().endswith(endings):
        raise FileError(path, f"expected a name that ends in {' or '.join(endings)}")


def check_writable(path: str) -> None:
    """Refuse a path that is a folder, or at which no file can be written."""
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(path) or not os.path.basename(path):
        raise FileError(path, "is a folder; expected a file")
    if not os.path.isdir(folder):
        raise FileError(path, f"cannot be written: there is no folder '{folder}'")
    regular = os.path.isfile(path) or not os.path.exists(path)
    writable = not os.path.exists(path) or os.access(path, os.W_OK)
    if not writable or (regular and not os.access(folder, os.W_OK | os.X_OK)):
        raise FileError(path, "cannot be written: permission denied")
