"""The token that a client needs to move the arm, and its file, which only this user can read.

The token comes from the environment, or is drawn at random and written to the file. Other users may
be able to write to the folder, so files and links that they put there are refused. A token that is
too short is refused if other machines can reach the interface.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from stiffopt.daemon.address import is_loopback
from stiffopt.errors import FileError, InputError, os_reason
from stiffopt.rig.settings import ServiceSettings

MIN_TOKEN = 16
"""Characters of a token that is not easily guessed."""
_LONGEST = 4096  # bytes to read of a file
_LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_OTHERWISE = "give another log.folder or service.token_file"
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def make_private(folder: str | os.PathLike[str]) -> None:
    """Make a folder and its missing parents, for this user alone; `OSError` if that fails."""
    last = Path(folder)
    missing = [path for path in (last, *last.parents) if not path.exists()]
    for path in reversed(missing):
        path.mkdir(mode=0o700, exist_ok=True)
    if not last.is_dir():
        raise NotADirectoryError(20, "not a folder")


def _check_folder(folder: Path) -> None:
    """Raise `FileError` if another user could exchange files in a folder.

    It must belong to this user or to root, and be writable for all only if it is sticky.
    """
    found = folder.stat()
    if found.st_uid not in (0, os.geteuid()):
        raise FileError(
            folder, f"belongs to another user, who can exchange files there; {_OTHERWISE}"
        )
    if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
        raise FileError(
            folder,
            f"is writable for all, so that anyone can exchange files there; remove that permission "
            f"(chmod o-w), or {_OTHERWISE}",
        )


def _check_mine(path: Path, opened: int | None = None) -> None:
    """Raise `FileError` unless a file is a regular one of this user, or does not exist.

    An open file is checked by its descriptor, any other by its name.
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
    raise FileError(path, f"{problem}, or {_OTHERWISE}")


def _read_mine(path: Path) -> str:
    """Return the text of a short file, without following a link or waiting for a pipe."""
    descriptor = os.open(path, _READ)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError("no regular file")
        return os.read(descriptor, _LONGEST).decode("ascii")
    finally:
        os.close(descriptor)


class Secret:
    """A token, and the file from which this user alone can read a drawn one.

    The file belongs to one daemon as long as it runs. A lock (flock) on another file, which the
    kernel releases however a process ends, keeps out a second daemon, which would replace the
    token. The lock file is not removed, since another process may be about to lock it. No symbolic
    link is followed, and nothing is written where another user could exchange it.
    `path` is None if the token comes from the environment.
    """

    def __init__(
        self, settings: ServiceSettings, folder: str | os.PathLike[str], name: str
    ) -> None:
        given = os.environ.get(settings.token, "").strip()
        self.token = given or secrets.token_urlsafe(24)
        self.path: Path | None = None
        if not given:
            self.path = Path(settings.token_file or Path(folder) / f"{name}.token")
        self._lock: int | None = None  # an open file

    def write(self) -> None:
        """Write the file, replacing an old one; no other user can ever read it.

        Raises `FileError`: it cannot be written, belongs to another running daemon, or is not a
        regular file of this user in a folder that others cannot change.
        """
        if self.path is None:
            return
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            make_private(self.path.parent)
            _check_folder(self.path.parent)
            self._take(self.path)
            _check_mine(self.path)
            with suppress(FileNotFoundError):
                fresh.unlink()
            descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with open(descriptor, "w", encoding="ascii") as file:
                file.write(f"{self.token}\n")
            os.replace(fresh, self.path)
        except OSError as error:
            with suppress(OSError):
                fresh.unlink()
            raise FileError(
                self.path,
                f"the token cannot be kept there: {os_reason(error)}; see service.token_file",
            ) from None

    def _take(self, path: Path) -> None:
        """Lock the token's file against other daemons."""
        if self._lock is not None:
            return
        place = path.with_name(f".{path.name}.lock")
        _check_mine(place)
        try:
            lock = os.open(place, _LOCK, 0o600)
        except PermissionError:
            if not place.exists():  # the folder is not writable
                raise
            raise FileError(
                place,
                "this lock of the token belongs to another user, whose daemon may be running; if "
                "it is not, remove this file, else give another log.folder or service.token_file",
            ) from None
        try:
            _check_mine(place, lock)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise FileError(
                path,
                "holds the token of another daemon of a rig of this name, which is running; end "
                "that one, or give this one another log.folder or service.token_file",
            ) from None
        except FileError:
            os.close(lock)
            raise
        except OSError:  # a file system without locks cannot show other daemons
            os.close(lock)
            return
        self._lock = lock

    def remove(self) -> None:
        """Remove the file, if it still has this token."""
        if self.path is None:
            return
        with suppress(OSError, ValueError):
            if _read_mine(self.path).strip() == self.token:
                self.path.unlink()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


# Who can reach the interface, and whether the token is good enough for that


def check_exposure(host: str, token: str, *, given: bool) -> list[tuple[str, str]]:
    """Return the warnings for a control interface on a host: kinds and texts of events.

    `given` is whether a person chose the token, rather than that it was drawn. `InputError`: the
    token is too short for a host that other machines can reach.
    """
    beyond, short = not is_loopback(host), given and len(token) < MIN_TOKEN
    if beyond and short:
        raise InputError(
            f"the token has {len(token)} characters, too few for the host {host}, which other "
            f"machines can reach; give one of at least {MIN_TOKEN}, leave the environment variable "
            "empty so that one is drawn, or listen on 127.0.0.1 (service.token, service.host in "
            "the rig file)"
        )
    if beyond:
        text = (
            f"the control interface listens on {host}, beyond this machine and unencrypted: "
            "whoever can listen in on the network can read the token and move the arm"
        )
        return [("exposed", text)]
    if short:
        text = f"the token is shorter than {MIN_TOKEN} characters; others here may guess it"
        return [("token", text)]
    return []
