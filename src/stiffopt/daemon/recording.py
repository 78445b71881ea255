"""The recording of a run: a series of MCAP files, within limits of size and disk space.

Nothing here raises an exception; `RunRecording.trouble` reports what is wrong.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from stiffopt.daemon.secret import make_private
from stiffopt.daemon.topics import METADATA
from stiffopt.errors import os_reason
from stiffopt.logs.mcap_file import McapWriter

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC


@dataclass(frozen=True)
class RecordingLimits:
    """Limits of a recording, and intervals of its checks."""

    # bytes to leave free on the disk; a recording that would need them ends
    min_free: float = 200e6
    margin: float = 1.25  # factor on `min_free` for the free bytes that a recording needs to begin
    largest: float = 1e9  # bytes of a file after which the next one begins
    look: float = 1.0  # interval between checks of the free space, in s
    retry: float = 10.0  # time from a failure to the next attempt, in s


class RunRecording:
    """Records everything that is logged in a context of foxglove.

    After a failure it tries again, with a new file.

    Parameters
    ----------
    folder, name : folder of the files, readable by this user alone, and the rig's name, for their
        names.
    context, about : context of foxglove, and metadata of each file.
    wall, free : return the date in s since 1970, and the free bytes of a folder.
    limits : limits of the recording.

    Attributes
    ----------
    path : the present or last file; None before the first.
    trouble : why nothing is recorded, as a sentence; empty if all is well.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        name: str,
        context: Any,
        about: Mapping[str, str],
        *,
        wall: Callable[[], float] = time.time,
        free: Callable[[str], float] = lambda folder: shutil.disk_usage(folder).free,
        limits: RecordingLimits = RecordingLimits(),
    ) -> None:
        self.path: str | None = None
        self.trouble = ""
        self._folder = os.fspath(folder)
        self._name = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")[:80] or "run"
        self._context, self._about = context, about
        self._wall, self._free, self._limits = wall, free, limits
        self._file: McapWriter | None = None
        self._ended = 0  # bytes of the files that are closed
        self._look_at = self._retry_at = -float("inf")

    @property
    def is_open(self) -> bool:
        """Whether a file is being written."""
        return self._file is not None

    @property
    def written(self) -> int:
        """Bytes on the disk, in all files."""
        return self._ended + (0 if self._file is None else self._file.size)

    def commit(self, now: float) -> None:
        """Write logged messages to the disk, or try to begin; `now` is in s on a steady clock."""
        if self._file is None and now < self._retry_at:
            return
        try:
            if self._file is None:
                self._begin()
            else:
                self._continue(self._file, now)
            self.trouble = ""
        except Exception as error:  # foxglove may raise anything
            failed = isinstance(error, _RecordingError)
            trouble = str(error) if failed else f"the recording failed: {error}"
            self.close()
            self.trouble = trouble
            self._retry_at = now + self._limits.retry

    def close(self) -> None:
        """End the file with its index; a second call does nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.close()
        except Exception as error:
            self.trouble = f"the recording could not be ended: {error}"
        self._ended += file.size

    def _continue(self, file: McapWriter, now: float) -> None:
        try:
            file.commit()
        except OSError as error:
            raise self._unwritable(error) from None
        if now >= self._look_at:
            self._look_at = now + self._limits.look
            self._check_free(self._limits.min_free)
        if file.size >= self._limits.largest:
            self.close()
            self._begin()

    def _begin(self) -> None:
        """Begin a new file, for this user alone; never overwrite one."""
        try:
            make_private(self._folder)
            self._check_free(self._limits.margin * self._limits.min_free)
            file, path = self._new_file()
        except OSError as error:
            raise _RecordingError(
                f"{self._folder}: cannot be written: {os_reason(error)}"
            ) from None
        self.path = path
        try:
            self._file = McapWriter(file, self._context, {METADATA: self._about})
        except BaseException as error:
            os.unlink(path)
            if isinstance(error, OSError):
                raise self._unwritable(error) from None
            raise

    def _new_file(self) -> tuple[int, str]:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self._wall()))
        first = os.path.join(self._folder, f"{self._name}-{stamp}")
        path, count = f"{first}.mcap", 1
        while True:
            try:
                return os.open(path, _NEW, 0o600), path
            except FileExistsError:
                count += 1
                path = f"{first}-{count}.mcap"

    def _check_free(self, least: float) -> None:
        try:
            free = self._free(self._folder)
        except OSError as error:
            raise _RecordingError(f"{self._folder}: {os_reason(error)}") from None
        if free < least:
            needed = self._limits.margin * self._limits.min_free
            raise _RecordingError(
                f"nothing is recorded: {free / 1e6:.0f} MB are free in {self._folder}; "
                f"make room for more than {needed / 1e6:.0f} MB"
            )

    def _unwritable(self, error: OSError) -> _RecordingError:
        return _RecordingError(
            f"nothing is recorded: {self.path} cannot be written: {os_reason(error)}"
        )


class _RecordingError(Exception):
    """Why nothing is recorded, as a sentence."""
