"""MCAP files of all recordings: the writer, based on foxglove-sdk, and the reader, based on mcap.

A recording is a sequence of chunks. After a commit, each chunk is complete on the disk, so a killed
process loses only what it had not committed. The reader reads such a file as far as it is intact.
"""

from __future__ import annotations

import errno
import io
import json
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from stiffopt.errors import FileError, require_package
from stiffopt.logs.table import reading

_CHUNK = 1 << 22  # bytes; commits are much more frequent


class McapWriter:
    """Writes everything that is logged in a context of foxglove to a file.

    foxglove's own writer stops for good, silently, if a write to its file fails. Here it writes to
    memory, and `commit` copies that to the disk. If a write fails, the file is cut back to its last
    complete chunk and closed; nothing more is written to it.

    Raises `OSError`: the file cannot be written.

    Parameters
    ----------
    file : descriptor of an empty file, open for writing; this object closes it.
    context : context of foxglove.
    metadata : records of metadata, by name.
    profile : profile of the file: the conventions by which messages are to be read.

    Attributes
    ----------
    size : bytes on the disk.
    """

    def __init__(
        self,
        file: int,
        context: Any,
        metadata: Mapping[str, Mapping[str, str]],
        profile: str = "",
    ) -> None:
        import foxglove
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions

        self.size = 0
        self._context = context  # kept: it closes its channels when it is collected
        self._file = file
        self._memory = _Memory()
        try:
            self._writer = foxglove.open_mcap(
                self._memory,
                context=context,
                writer_options=MCAPWriteOptions(
                    profile=profile,
                    compression=MCAPCompression.Zstd,
                    compression_level=1,  # twice as fast as the default, with the same size
                    compression_threads=0,
                    chunk_size=_CHUNK,
                ),
            )
            for name, record in metadata.items():
                self._writer.write_metadata(name, dict(record))
            self._write()
        except BaseException:
            self._release()
            raise

    def commit(self) -> None:
        """End the chunk and write it to the disk; raise `OSError` if that fails."""
        if self._file < 0:
            raise OSError(errno.EBADF, "the file is closed")
        self._writer.flush()
        self._write()

    def close(self) -> None:
        """Write the index and close; `OSError` if that fails. A second call does nothing."""
        if self._file < 0:
            return
        try:
            self._writer.close()
            self._write()
            os.fsync(self._file)
        finally:
            self._release()

    def _write(self) -> None:
        """Write the memory's content to the disk, completely or not at all."""
        data, done = self._memory.take(), 0
        try:
            while done < len(data):
                done += os.write(self._file, memoryview(data)[done:])
        except OSError:
            with suppress(OSError):  # leave no torn chunk, even on a full disk
                os.ftruncate(self._file, self.size)
            self._release()
            with suppress(Exception):
                self._writer.close()  # ends logging to it
            raise
        self.size += len(data)

    def _release(self) -> None:
        if self._file >= 0:
            with suppress(OSError):
                os.close(self._file)
            self._file = -1


class _Memory:
    """The file object for foxglove's writer: it holds the bytes since the last commit.

    foxglove only seeks back within a chunk, to fill in its length.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._begin = self._place = 0  # offset of the data in the file, and of the next byte

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
        """Return the data, which will not change any more, and drop it."""
        data = bytes(self._data)
        self._begin += len(data)
        self._data.clear()
        return data


@dataclass
class McapContents:
    """The contents of an MCAP file."""

    # records of metadata, by name
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    # topics and contents of the JSON messages, in the order of writing
    messages: list[tuple[str, Any]] = field(default_factory=list)
    complete: bool = False  # whether the recording was ended properly and is undamaged

    def of_topic(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [message for name, message in self.messages if name == topic]


def read_mcap(path: str | os.PathLike[str]) -> McapContents:
    """Read the intact part of a recording, even if a kill has cut it short.

    Raises `FileError`: it cannot be read, or a message in its middle is no JSON;
    `MissingExtraError`: mcap is not installed.
    """
    require_package("mcap", "log")
    with reading(path, "a recording (.mcap)"), open(path, "rb") as stream:
        return _contents(stream)


def _contents(stream: BinaryIO) -> McapContents:
    from mcap.records import Channel, Footer, Message, Metadata

    found = McapContents()
    topics: dict[int, str | None] = {}
    damaged = False
    for record in _records(stream):
        if record is None:
            damaged = True
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic is None:
                continue
            try:
                found.messages.append((topic, json.loads(record.data)))
            except ValueError:
                if not stream.read(1):
                    break  # the last message is incomplete
                raise FileError(stream.name, "is damaged: a message is no JSON") from None
        elif isinstance(record, Channel):
            topics[record.id] = record.topic if record.message_encoding == "json" else None
        elif isinstance(record, Metadata):
            found.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Footer):
            found.complete = not damaged
    return found


def _records(stream: BinaryIO) -> Iterator[Any]:
    """Yield records up to the end, or to where the file was cut; None for a damaged chunk."""
    from mcap.exceptions import McapError
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    records = iter(StreamReader(stream, emit_chunks=True).records)
    while True:
        try:
            record = next(records)
        except (StopIteration, McapError, EOFError, struct.error, ValueError):
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            parts = breakup_chunk(record, validate_crc=True)
        except Exception:  # a decompressor may raise anything
            yield None
            continue
        yield from parts
