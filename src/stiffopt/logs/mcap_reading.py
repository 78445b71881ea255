"""Reads the metadata and JSON messages of an MCAP file, also of one that was cut short."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, BinaryIO

from stiffopt.errors import FileError, MissingExtraError

__all__ = ["McapContents", "read_mcap", "require_mcap"]


@dataclass
class McapContents:
    """The metadata and messages of an MCAP file.

    Attributes
    ----------
    metadata : records of metadata, by name.
    messages : topics and contents of the JSON messages, in the order in which they were written.
    complete : whether the recording was ended properly, and nothing in it is damaged.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: list[tuple[str, Any]] = field(default_factory=list)
    complete: bool = False

    def of_topic(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [message for name, message in self.messages if name == topic]


def require_mcap() -> None:
    """Check that the library mcap is installed.

    Raises
    ------
    MissingExtraError
        It is not installed.
    """
    try:
        missing = find_spec("mcap") is None
    except ValueError:  # a placeholder in sys.modules
        missing = True
    if missing:
        raise MissingExtraError("mcap", "log")


def read_mcap(path: str | os.PathLike[str], *, metadata_only: bool = False) -> McapContents:
    """Read a recording, also one that was cut short by a kill: all that is whole.

    Parameters
    ----------
    path :
        The file.
    metadata_only :
        Stop at the first message.

    Raises
    ------
    FileError
        It cannot be read, or a message in its middle is no JSON.
    MissingExtraError
        mcap is not installed.
    """
    require_mcap()
    name = os.fspath(path)
    try:
        with open(name, "rb") as stream:
            return _contents(stream, metadata_only)
    except FileNotFoundError:
        raise FileError(name, "there is no such file") from None
    except IsADirectoryError:
        raise FileError(name, "is a folder; expected a recording (.mcap)") from None
    except OSError as error:
        raise FileError(name, f"cannot be read: {(error.strerror or '').lower()}") from None


def _contents(stream: BinaryIO, metadata_only: bool) -> McapContents:
    from mcap.records import Channel, Footer, Message, Metadata

    found = McapContents()
    topics: dict[int, str | None] = {}
    damaged = False
    for record in _records(stream):
        if record is None:
            damaged = True
        elif isinstance(record, Message):
            if metadata_only:
                break
            topic = topics.get(record.channel_id)
            if topic is None:
                continue
            try:
                found.messages.append((topic, json.loads(record.data)))
            except ValueError:
                if not stream.read(1):
                    break  # the last message is not whole
                raise FileError(stream.name, "is damaged: a message is no JSON") from None
        elif isinstance(record, Channel):
            topics[record.id] = record.topic if record.message_encoding == "json" else None
        elif isinstance(record, Metadata):
            found.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Footer):
            found.complete = not damaged
    return found


def _records(stream: BinaryIO) -> Iterator[Any]:
    """Yield records up to the end, or to where it was cut short; None for a damaged chunk."""
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
        except Exception:  # whatever a decompressor makes of noise
            yield None
            continue
        yield from parts
