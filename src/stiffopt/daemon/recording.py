"""Writes the recording of a run as MCAP: it survives a kill, and its failure stops nothing else.

foxglove's writer gives up for good, without a word, when its file fails it; so the file that it is
given is a piece of memory that cannot fail, and what is in there goes to the disk here. A commit
ends a chunk: what was committed is whole on the disk, in one piece, and survives a SIGKILL.
"""

from __future__ import annotations

import io
import os
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from stiffopt.daemon.secret import make_private
from stiffopt.daemon.topics import METADATA

__all__ = ["RecordingLimits", "RunRecording", "free_bytes"]

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC


@dataclass(frozen=True)
class RecordingLimits:
    """How much is recorded, and how often the disk is looked at.

    Attributes
    ----------
    min_free : bytes that are left free on the disk; a recording that would need them ends.
    margin : factor on `min_free` of what must be free before a recording begins.
    largest : bytes of a file, after which another one follows.
    look : s between two looks at how much is free.
    retry : s after a failure until recording is tried again.
    chunk : bytes of a chunk of MCAP; a commit comes long before.
    """

    min_free: float = 200e6
    margin: float = 1.25
    largest: float = 1e9
    look: float = 1.0
    retry: float = 10.0
    chunk: int = 1 << 22


def free_bytes(folder: str) -> float:
    """Return how many bytes an ordinary user may still write into a folder."""
    there = os.statvfs(folder)
    return float(there.f_bavail * there.f_frsize)


class RunRecording:
    """Records everything that is logged in a context of foxglove, in one file after another.

    Nothing here raises after the beginning: `trouble` says what is wrong, and what can be done is
    tried again.

    Parameters
    ----------
    folder :
        Where the files go; made, for this user alone, if it is not there.
    name :
        Of the rig; files are named after it and the time.
    context :
        Of foxglove.
    about :
        Kept in each file as metadata.
    wall, free :
        Give the date in s since 1970 and the bytes that are free in a folder.
    limits :
        How much is recorded.

    Attributes
    ----------
    path : the file that is written, or was last; None before the first.
    trouble : why nothing is recorded, as a sentence; empty while all is well.
    written : bytes so far, in all files.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        name: str,
        context: Any,
        about: Mapping[str, str],
        *,
        wall: Callable[[], float] = time.time,
        free: Callable[[str], float] = free_bytes,
        limits: RecordingLimits = RecordingLimits(),
    ) -> None:
        self.path: str | None = None
        self.trouble = ""
        self.written = 0
        self._folder, self._name = os.fspath(folder), _file_name(name)
        self._context, self._about = context, dict(about)
        self._wall, self._free, self._limits = wall, free, limits
        self._writer: Any = None
        self._window = _Window()
        self._file = -1
        self._size = 0
        self._look_at = self._retry_at = -float("inf")

    @property
    def is_open(self) -> bool:
        """Whether something is recorded."""
        return self._writer is not None

    def commit(self, now: float) -> None:
        """See what was logged onto the disk, or try to begin; `now` in s on any steady clock."""
        if self._writer is None:
            if now >= self._retry_at:
                self._retry_at = now + self._limits.retry
                self._begin()
            return
        try:
            self._writer.flush()
            self._write(self._window.take())
            if now >= self._look_at:
                self._look_at = now + self._limits.look
                self._check_free(self._limits.min_free)
            if self._size >= self._limits.largest:
                self._finish()
                self._begin()
        except _FailedError as failed:
            self._give_up(str(failed), now)
        except Exception as error:  # of foxglove, which is not ours to trust
            self._give_up(f"the recording failed: {error}", now)

    def close(self) -> None:
        """End the file with its index; to close twice does nothing."""
        try:
            self._finish()
        except Exception as error:
            self._give_up(f"the recording could not be ended: {error}", 0.0)

    def _begin(self) -> None:
        """Begin another file, or say why not."""
        import foxglove
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions

        try:
            make_private(self._folder)
            self._check_free(self._limits.margin * self._limits.min_free)
            self._file, self.path = self._new_file()
            self._size = 0
            self._window = _Window()
            self._writer = foxglove.open_mcap(
                self._window,
                context=self._context,
                writer_options=MCAPWriteOptions(
                    compression=MCAPCompression.Zstd,
                    compression_level=1,  # twice as fast as the default, and as small
                    compression_threads=0,
                    chunk_size=self._limits.chunk,
                ),
            )
            self._writer.write_metadata(METADATA, self._about)
            self._write(self._window.take())
            self.trouble = ""
        except _FailedError as failed:
            self._give_up(str(failed))
        except OSError as error:
            self._give_up(f"{self._folder}: cannot be written: {_reason(error)}")
        except Exception as error:
            self._give_up(f"the recording cannot begin: {error}")

    def _new_file(self) -> tuple[int, str]:
        """Make a file that was not there, for this user alone."""
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
            raise _FailedError(f"{self._folder}: {_reason(error)}") from None
        if free < least:
            needed = self._limits.margin * self._limits.min_free
            raise _FailedError(
                f"nothing is recorded: {free / 1e6:.0f} MB are free in {self._folder}; "
                f"make room for more than {needed / 1e6:.0f} MB"
            )

    def _write(self, data: bytes) -> None:
        """Write to the disk, whole or not at all."""
        done = 0
        try:
            while done < len(data):
                done += os.write(self._file, memoryview(data)[done:])
        except OSError as error:
            with suppress(OSError):  # no torn chunk stays, not even on a full disk
                os.ftruncate(self._file, self._size)
                os.lseek(self._file, self._size, os.SEEK_SET)
            raise _FailedError(
                f"nothing is recorded: {self.path} cannot be written: {_reason(error)}"
            ) from None
        self._size += len(data)
        self.written += len(data)

    def _finish(self) -> None:
        """Write the index and close."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        try:
            writer.close()
            self._write(self._window.take())
            os.fsync(self._file)
        finally:
            self._close_file()

    def _give_up(self, trouble: str, now: float | None = None) -> None:
        """End the file as well as it goes."""
        with suppress(Exception):
            self._finish()
        self._close_file()
        self.trouble = trouble
        if now is not None:
            self._retry_at = now + self._limits.retry

    def _close_file(self) -> None:
        if self._file >= 0:
            with suppress(OSError):
                os.close(self._file)
                if not self._size and self.path is not None:
                    os.unlink(self.path)  # nothing ever got there
            self._file = -1


class _FailedError(Exception):
    """The disk takes no more, or must not be filled further."""


class _Window:
    """A file in memory that holds what foxglove has written since the last commit.

    It goes back within a chunk to fill in its length, never further: a commit ends the chunk.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._begin = self._place = 0  # of the data in the file, and where the next byte goes

    def write(self, data: bytes | bytearray) -> int:
        start = self._place - self._begin
        if start < 0:
            raise OSError("what was committed would be changed")
        self._data[start : start + len(data)] = data
        self._place += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        end = self._begin + len(self._data)
        self._place = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: end}[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def flush(self) -> None:
        pass

    def take(self) -> bytes:
        """Return what is new; it will not be changed any more."""
        data = bytes(self._data)
        self._begin += len(data)
        self._data.clear()
        return data


def _file_name(name: str) -> str:
    """Return a name of a rig as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")[:80] or "run"


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
