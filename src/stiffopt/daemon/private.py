"""Files and folders of this user alone, also where others may put something in their place."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from stiffopt.errors import FileError

__all__ = ["check_folder", "check_mine", "make_private", "read_mine"]

_LONGEST = 4096  # bytes of a file that is read whole
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def make_private(folder: str | os.PathLike[str]) -> None:
    """Make a folder, and what is missing above it, for this user alone; `OSError` if it fails."""
    last = Path(folder)
    missing = [path for path in (last, *last.parents) if not path.exists()]
    for path in reversed(missing):
        path.mkdir(mode=0o700, exist_ok=True)
    if not last.is_dir():
        raise NotADirectoryError(20, "not a folder")


def check_folder(folder: Path, advice: str) -> None:
    """Raise `FileError` where another user could exchange files in a folder.

    Parameters
    ----------
    folder :
        What must belong to this user or to root, and be writable for all only if it is sticky.
    advice :
        What to do otherwise, as the end of a sentence.
    """
    found = folder.stat()
    if found.st_uid not in (0, os.geteuid()):
        raise FileError(folder, f"belongs to another user, who can exchange files there; {advice}")
    if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
        raise FileError(
            folder,
            f"is writable for all, so that anyone can exchange files there; take that right away "
            f"(chmod o-w), or {advice}",
        )


def check_mine(path: Path, advice: str, opened: int | None = None) -> None:
    """Raise `FileError` unless a file is a regular one of this user, or is not there.

    Parameters
    ----------
    path :
        The file; a symbolic link is none.
    advice :
        What to do otherwise, as the end of a sentence.
    opened :
        Its descriptor if it is open; else what has the name now is looked at.
    """
    try:
        found = os.lstat(path) if opened is None else os.fstat(opened)
    except FileNotFoundError:
        return
    if stat.S_ISLNK(found.st_mode):
        problem = "is a symbolic link, which is not followed here; remove it"
    elif not stat.S_ISREG(found.st_mode):
        problem = "is no regular file; remove it"
    elif found.st_uid != os.geteuid():
        problem = (
            "belongs to another user, whose daemon may be running; if it is not, remove this file"
        )
    else:
        return
    raise FileError(path, f"{problem}, or {advice}")


def read_mine(path: Path) -> str:
    """Return the text of a short file, without following a link or waiting for a pipe."""
    descriptor = os.open(path, _READ)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError("no regular file")
        return os.read(descriptor, _LONGEST).decode("ascii")
    finally:
        os.close(descriptor)
