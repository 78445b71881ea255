"""The token of those who may move the arm: from the environment, or drawn and kept in a file."""

from __future__ import annotations

import fcntl
import os
import secrets
from contextlib import suppress
from pathlib import Path

from stiffopt.daemon.private import check_folder, check_mine, make_private, read_mine
from stiffopt.errors import FileError
from stiffopt.rig.settings import ServiceSettings

__all__ = ["Secret"]

_LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_OTHERWISE = "give another log.folder or service.token_file"


class Secret:
    """A token, and the file in which a drawn one can be read by this user alone.

    The file is one daemon's for as long as that lives: a lock beside it, which the kernel releases
    however a process ends, keeps a second one from putting its token in the place of the first's.
    The lock's file stays: whoever had just opened it would else lock what nobody sees any more.
    No symbolic link is followed, and nothing is written where another user could exchange it.

    Parameters
    ----------
    settings :
        Of the rig's service.
    folder, name :
        Where the file is, and what its name begins with, unless the settings say.

    Attributes
    ----------
    token : str
        The token.
    path : Path or None
        The file; None where the environment has the token.
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
        """Write the file, in the place of what is there; nobody else can read it at any moment.

        Raises
        ------
        FileError
            It cannot be written, is that of another daemon, which runs, or is not a regular file of
            this user in a folder that others cannot change.
        """
        if self.path is None:
            return
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            make_private(self.path.parent)
            check_folder(self.path.parent, _OTHERWISE)
            self._take(self.path)
            check_mine(self.path, _OTHERWISE)
            with suppress(FileNotFoundError):
                fresh.unlink()
            descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with open(descriptor, "w", encoding="ascii") as file:
                file.write(f"{self.token}\n")
            os.replace(fresh, self.path)
        except OSError as error:
            with suppress(OSError):
                fresh.unlink()
            reason = (error.strerror or str(error)).lower()
            raise FileError(
                self.path, f"the token cannot be kept there: {reason}; see service.token_file"
            ) from None

    def _take(self, path: Path) -> None:
        """Lock the file of the token against other daemons."""
        if self._lock is not None:
            return
        place = path.with_name(f".{path.name}.lock")
        check_mine(place, _OTHERWISE)
        try:
            lock = os.open(place, _LOCK, 0o600)
        except PermissionError:
            if not place.exists():  # nothing can be written in this folder
                raise
            raise FileError(
                place,
                "this lock of the token belongs to another user, whose daemon may be running; if "
                "it is not, remove this file, else give another log.folder or service.token_file",
            ) from None
        try:
            check_mine(place, _OTHERWISE, lock)
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
        except OSError:  # a file system without locks: nothing is to be known of others there
            os.close(lock)
            return
        self._lock = lock

    def remove(self) -> None:
        """Remove the file, if it is still that of this token."""
        if self.path is None:
            return
        with suppress(OSError, ValueError):
            if read_mine(self.path).strip() == self.token:
                self.path.unlink()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
