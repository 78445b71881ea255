"""Read YAML documents as plain data with the line number of every value, and write them.

The core schema of YAML 1.2 applies: ``1e-3`` is a number, ``yes``, ``on``, ``1:30`` and dates are
text. Anchors, aliases, tags, several documents in a file and deep nesting are rejected: files
written by hand do not need them, and malicious ones do.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stiffopt.errors import FileError, InputError, Loc, dotted, os_reason, printable, shown

MAX_BYTES = 1_000_000
MAX_DEPTH = 20
_TOO_DEEP = f"is nested more than {MAX_DEPTH} levels deep"


@dataclass(frozen=True)
class Document:
    """Plain data and the line number of every value in them."""

    path: str
    data: dict[str, Any]
    lines: dict[Loc, int] = field(repr=False)

    def error(self, loc: Loc, reason: str) -> FileError:
        """Return an error about the value at `loc`."""
        return FileError(self.path, reason, line=self.lines.get(loc), key=dotted(loc) or None)


def read_document(path: str | os.PathLike[str]) -> Document:
    """Read a YAML file as plain data with line numbers; the top level must be a mapping."""
    name = os.fspath(path)
    return document_of(_read_text(name), name)


def document_of(text: str, name: str) -> Document:
    """Parse a YAML text as plain data with line numbers, as `read_document` does for a file.

    `text`: content of the file. `name`: name of the file in errors.
    """
    return _Composer(name, text).document()


def to_yaml(data: Mapping[str, Any]) -> str:
    """Return data as YAML text, which `read_document` reads back as equal data."""
    return str(
        yaml.dump(_plain(data), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    )


def write_file(
    path: str | os.PathLike[str], data: Mapping[str, Any], comment: Sequence[str] = ()
) -> None:
    """Write data as YAML, which `read_document` reads back as equal data.

    The file appears complete or not at all, see `write_whole`.

    Parameters
    ----------
    path : the file; its folder must exist.
    data : text, numbers, booleans, None, lists, tuples, arrays and mappings with text as keys.
    comment : lines above the data, for people.
    """
    text = "".join(f"# {printable(line)}\n" for line in comment) + to_yaml(data)
    write_whole(path, text.encode())


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file that appears complete or not at all, by moving a temporary file to its place.

    Raises `FileError`: it cannot be written; an existing file is unchanged.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_file():
            target.write_bytes(content)  # a folder (an error), a pipe, /dev/stdout
            return
        target = target.resolve()
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            part = Path(folder) / "part"
            with part.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(target)
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be written: {os_reason(error)}") from None


# Text to data ------------------------------------------------------------------------------------


def _read_text(path: str) -> str:
    try:
        with open(path, "rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise FileError(path, "there is no such file") from None
    except IsADirectoryError:
        raise FileError(path, "is a folder; expected a file") from None
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read: {os_reason(error)}") from None
    if len(raw) > MAX_BYTES:
        raise FileError(path, f"is larger than {MAX_BYTES // 1_000_000} MB; expected a short file")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise FileError(path, "is not UTF-8 text", line=line) from None


_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{f"{sign}{word}": float(f"{sign}inf") for sign in ("", "+", "-") for word in
       (".inf", ".Inf", ".INF")},
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}  # fmt: skip


def _resolve(text: str) -> Any:
    """Return the value of a plain scalar in the core schema of YAML 1.2."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text) and len(text) < 400:
        bases = {"0o": 8, "0x": 16}
        return int(text[2:], bases[text[:2]]) if text[:2] in bases else int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


class _Composer:
    """Build a `Document` from the events of the YAML parser."""

    def __init__(self, path: str, text: str) -> None:
        self.path = path
        self.lines: dict[Loc, int] = {}
        loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        self.events: Iterator[Any] = yaml.parse(text, Loader=loader)

    def document(self) -> Document:
        self.next()  # start of the stream
        event = self.next()
        if isinstance(event, yaml.StreamEndEvent):
            raise FileError(self.path, "is empty")
        event = self.next()
        data = self.value(event, ())
        self.next()  # end of the document
        after = self.next()
        if not isinstance(after, yaml.StreamEndEvent):
            raise self.error(after, "a second document begins here; expected one document per file")
        if data is None:
            raise FileError(self.path, "is empty")
        if not isinstance(data, dict):
            raise self.error(event, "expected a mapping (lines of 'key: value') at the top level")
        return Document(self.path, data, self.lines)

    def next(self) -> Any:
        try:
            event = next(self.events)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            parts = [part for part in (error.context, error.problem) if part]
            line = mark.line + 1 if mark else None
            # libyaml has a limit of its own, and scans ahead of the events that it gives
            too_deep = "maximum nesting depth" in (error.problem or "")
            reason = _TOO_DEEP if too_deep else f"is not valid YAML: {', '.join(parts)}"
            raise FileError(self.path, reason, line=line) from None
        except yaml.YAMLError as error:
            reason = getattr(error, "reason", None) or "it cannot be parsed"
            raise FileError(self.path, f"is not valid YAML: {reason}") from None
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise self.error(event, "anchors (&) and aliases (*) are not allowed; write it out")
        if getattr(event, "tag", None) is not None:
            raise self.error(event, f"the tag {shown(event.tag)} is not allowed; remove it")
        return event

    def error(self, event: Any, reason: str, loc: Loc = ()) -> FileError:
        line = event.start_mark.line + 1
        return FileError(self.path, reason, line=line, key=dotted(loc) or None)

    def value(self, event: Any, loc: Loc) -> Any:
        self.lines.setdefault(loc, event.start_mark.line + 1)
        if len(loc) > MAX_DEPTH:
            raise self.error(event, _TOO_DEEP)
        if isinstance(event, yaml.MappingStartEvent):
            return self.mapping(loc)
        if isinstance(event, yaml.SequenceStartEvent):
            return self.sequence(loc)
        return _resolve(event.value) if event.implicit[0] else event.value

    def sequence(self, loc: Loc) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := self.next(), yaml.SequenceEndEvent):
            items.append(self.value(event, (*loc, len(items))))
        return items

    def mapping(self, loc: Loc) -> dict[str, Any]:
        items: dict[str, Any] = {}
        while not isinstance(event := self.next(), yaml.MappingEndEvent):
            key = event.value if isinstance(event, yaml.ScalarEvent) else None
            if key is None or (event.implicit[0] and not isinstance(_resolve(key), str)):
                name = shown(key) if key else "this"
                raise self.error(event, f"{name} is not text; expected a name as the key", loc)
            here = (*loc, key)
            if key in items:
                first = self.lines[here]
                raise self.error(event, f"duplicate key, first given on line {first}", here)
            self.lines[here] = event.start_mark.line + 1
            items[key] = self.value(self.next(), here)
        return items


# Data to text ------------------------------------------------------------------------------------


class _Dumper(yaml.SafeDumper):
    """Write YAML for `read_document`: no aliases, and text quoted where it looks like data."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def write_plain(self, text: str, split: bool = True) -> None:
        """Break lines between the items of a list, but not within an item such as ``0.5 bar``."""
        super().write_plain(text, split and not self.flow_level)

    def represent_text(self, text: str) -> yaml.ScalarNode:
        quote = None if isinstance(_resolve(text), str) else "'"
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=quote)

    def represent_items(self, items: list[Any]) -> yaml.SequenceNode:
        flow = not any(isinstance(item, dict) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _Dumper.represent_text)
_Dumper.add_representer(list, _Dumper.represent_items)


def _plain(value: Any) -> Any:
    """Convert data to dicts, lists and scalars that YAML supports."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise InputError(f"a {type(value).__name__} cannot be written to a YAML file")
