"""Strict reading of every file kind, with the line to blame in every error.

A file is YAML, read as plain data with the core schema of YAML 1.2: ``1e-3`` is a number, ``yes``,
``on``, ``1:30`` and dates are text. What a hand-written file does not need and a malicious one does
(anchors, aliases, tags, several documents, bottomless nesting) is refused. The data are then
validated by a `Schema`, the frozen pydantic model that is also the description in code.
"""

from __future__ import annotations

import difflib
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from stiffopt.errors import FileError, InputError, printable, shown
from stiffopt.units import FROM_FILE

__all__ = [
    "BadKeyError",
    "Document",
    "Items",
    "Schema",
    "Vector",
    "items_of",
    "line_of",
    "read_document",
    "read_file",
    "save_file",
    "write_file",
]

MAX_BYTES = 1_000_000
MAX_DEPTH = 20
MAX_MISTAKES = 10  # told at once
VERSIONS = {"robot": 1, "task": 1, "rig": 1}
"""The version of each kind of file that is read; a kind not listed is at version 1."""

Step = str | int
Loc = tuple[Step, ...]


class BadKeyError(ValueError):
    """Raised by a validator of a whole mapping to say which of its keys is to blame."""

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(reason)
        self.loc: Loc = tuple(int(step) if step.isdigit() else step for step in key.split("."))


class Schema(BaseModel):
    """Base of what is both the schema of a file and its frozen description in code.

    Built in code, quantities are numbers in SI (or text with a unit) and a mistake raises
    `InputError`. Read by `read_file`, quantities must have units and mistakes raise `FileError`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False)

    def __init__(self, /, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise InputError(_sentence(type(self), error)) from None

    # pydantic then keeps building nested models itself, so that errors know where they are.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]


ModelT = TypeVar("ModelT", bound=BaseModel)
ItemT = TypeVar("ItemT")


def _as_tuple(value: Any) -> Any:
    """Let lists and arrays stand for tuples; nothing else that can be iterated over."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(value)
    raise InputError(f"expected a list, not {shown(value)}")


def items_of(n: int) -> Callable[[Any], Any]:
    """Return the validator of a list of just `n` items."""

    def read(value: Any) -> Any:
        items = _as_tuple(value)
        if len(items) != n:
            raise InputError(f"expected {n} items, not {len(items)}")
        return items

    return read


Items = Annotated[tuple[ItemT, ...], BeforeValidator(_as_tuple)]
"""A list in the file, a tuple in code."""
Vector = Annotated[tuple[ItemT, ItemT, ItemT], BeforeValidator(items_of(3))]
"""Three items: x, y, z."""


@dataclass(frozen=True)
class Document:
    """Plain data and the line of everything in them."""

    path: str
    data: dict[str, Any]
    lines: dict[Loc, int] = field(repr=False)

    def error(self, loc: Loc, reason: str) -> FileError:
        """Return the error that blames what is at `loc`."""
        return FileError(self.path, reason, line=self.lines.get(loc), key=_dotted(loc) or None)


def read_file(path: str | os.PathLike[str], kind: str, model: type[ModelT]) -> ModelT:
    """Read a file and validate it.

    Parameters
    ----------
    path :
        The file.
    kind :
        What it must be, for example ``"robot"``: the file must then say
        ``format: stiffopt-robot/1``.
    model :
        The schema that describes it.

    Raises
    ------
    FileError
        With the line and the key of the first mistake; all others are listed after it.
    """
    document = read_document(path)
    _check_format(document, kind)
    for loc, value in _walk(document.data):
        if value is None:
            raise document.error(loc, "has no value; give it one or remove it")
    data = {key: value for key, value in document.data.items() if key != "format"}
    try:
        return model.model_validate(data, context=FROM_FILE)
    except ValidationError as error:
        raise _file_error(document, model, error) from None


def line_of(path: str | os.PathLike[str], *loc: Step) -> int | None:
    """Return the line of a key in a file, if the file (still) has it."""
    with suppress(FileError):
        return read_document(path).lines.get(loc)
    return None


def read_document(path: str | os.PathLike[str]) -> Document:
    """Read a YAML file as plain data with line numbers; the top level must be a mapping."""
    name = os.fspath(path)
    return _Composer(name, _read_text(name)).document()


def write_file(path: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write data as YAML that `read_document` reads back as they were.

    The file appears whole or not at all: it is written beside its place and then moved there.

    Parameters
    ----------
    path :
        The file; its folder must exist.
    data :
        Text, numbers, booleans, None, lists, tuples, arrays and mappings with text as keys.
    """
    text = yaml.dump(_plain(data), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    target = Path(path)
    try:
        target = target.resolve()
        if target.exists() and not target.is_file():
            target.write_text(text, encoding="utf-8")  # a folder (an error), a pipe, /dev/stdout
            return
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            part = Path(folder) / "part"
            with part.open("w", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(target)
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be written: {_os_reason(error)}") from None


def save_file(path: str | os.PathLike[str], kind: str, schema: Schema) -> None:
    """Write a description as a file of its kind, which `read_file` reads back as its equal.

    Quantities are written with units; what is None or an empty list is left out.
    """
    data = _without_empty_lists(schema.model_dump(mode="json", exclude_none=True))
    write_file(path, {"format": f"stiffopt-{kind}/{VERSIONS.get(kind, 1)}", **data})


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
        raise FileError(path, f"cannot be read: {_os_reason(error)}") from None
    if len(raw) > MAX_BYTES:
        raise FileError(path, f"is larger than {MAX_BYTES // 1_000_000} MB; expected a short file")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise FileError(path, "is not UTF-8 text", line=line) from None


def _os_reason(error: OSError | ValueError) -> str:
    return (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)


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
    """Return what a plain scalar means in the core schema of YAML 1.2."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text) and len(text) < 400:
        bases = {"0o": 8, "0x": 16}
        return int(text[2:], bases[text[:2]]) if text[:2] in bases else int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


class _Composer:
    """Builds a `Document` from the events of the YAML parser."""

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
            raise self.error(after, "a second document begins here; expected one document a file")
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
            raise FileError(
                self.path, f"is not valid YAML: {', '.join(parts)}", line=line
            ) from None
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
        return FileError(self.path, reason, line=line, key=_dotted(loc) or None)

    def value(self, event: Any, loc: Loc) -> Any:
        self.lines.setdefault(loc, event.start_mark.line + 1)
        if len(loc) > MAX_DEPTH:
            raise self.error(event, f"is nested more than {MAX_DEPTH} levels deep")
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


def _walk(value: Any, loc: Loc = ()) -> Iterator[tuple[Loc, Any]]:
    """Yield everything in plain data with its place."""
    yield loc, value
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _walk(item, (*loc, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _walk(item, (*loc, index))


def _check_format(document: Document, kind: str) -> None:
    """Refuse a file that does not say it is of this kind and of the version that is read."""
    version = VERSIONS.get(kind, 1)
    wanted = f"stiffopt-{kind}/{version}"
    if "format" not in document.data:
        near = difflib.get_close_matches("format", document.data, n=1)
        hint = f" (is '{near[0]}' meant to be that?)" if near else ""
        raise FileError(document.path, f"has no 'format'; expected 'format: {wanted}'{hint}")
    given = document.data["format"]
    parts = re.fullmatch(r"stiffopt-([a-z]+)/(\d{1,9})", given) if isinstance(given, str) else None
    if parts is None:
        raise document.error(("format",), f"{shown(given)} is not a format; expected '{wanted}'")
    if parts[1] != kind:
        raise document.error(("format",), f"this is a {parts[1]} file, expected a {kind} file")
    if int(parts[2]) != version:
        raise document.error(
            ("format",), f"version {parts[2]} is not supported; expected '{wanted}'"
        )


# Data to text ------------------------------------------------------------------------------------


class _Dumper(yaml.SafeDumper):
    """Writes what `read_document` reads: no aliases, and text quoted where it looks like data."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_text(self, text: str) -> yaml.ScalarNode:
        quote = None if isinstance(_resolve(text), str) else "'"
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=quote)

    def represent_items(self, items: list[Any]) -> yaml.SequenceNode:
        flow = not any(isinstance(item, dict) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _Dumper.represent_text)
_Dumper.add_representer(list, _Dumper.represent_items)


def _without_empty_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_empty_lists(item) for key, item in value.items() if item != []}
    return [_without_empty_lists(item) for item in value] if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    """Return data as dicts, lists and scalars that YAML knows."""
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


# pydantic's errors to sentences ------------------------------------------------------------------


def _file_error(document: Document, model: type[BaseModel], error: ValidationError) -> FileError:
    """Return one error that leads with the topmost mistake and lists the others."""
    found = []
    for details in error.errors():
        loc, reason = _explain(model, details, document.data)
        line = max(document.lines.get(loc[:n], 0) for n in range(len(loc) + 1))
        found.append((line, _dotted(loc), reason))
    found.sort(key=lambda mistake: mistake[0])
    line, key, reason = found[0]
    for other_line, other_key, other in found[1:MAX_MISTAKES]:
        reason += f"; also line {other_line}: {other_key}: {other}"
    if len(found) > MAX_MISTAKES:
        reason += f"; and {len(found) - MAX_MISTAKES} more"
    return FileError(document.path, reason, line=line or None, key=key or None)


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    """Return the message for mistakes in a call."""
    found = (_explain(model, details, None) for details in error.errors())
    return "; also ".join(
        f"{'.'.join(filter(None, (model.__name__, _dotted(loc))))}: {reason}"
        for loc, reason in found
    )


def _explain(
    model: type[BaseModel], details: ErrorDetails, data: Mapping[str, Any] | None
) -> tuple[Loc, str]:
    """Return where a mistake is, in the file's own terms, and what it is, as a sentence."""
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    raw: Loc = details["loc"]
    error = context.get("error")
    if isinstance(error, BadKeyError):
        raw = (*raw, *error.loc)
    if kind == "missing":
        loc = _place(raw[:-1], data)
        return loc, f"the key '{raw[-1]}' is missing"
    loc = _place(raw, data)
    if kind == "extra_forbidden":
        return (*loc[:-1], str(raw[-1])), _unknown_key(model, raw)
    if error is not None:
        return loc, str(error)
    if data is not None:
        value = _at(data, loc)
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return loc, f"expected a mapping, not {shown(value)}"
    if kind == "literal_error":
        return loc, f"{shown(value)} is not one of {context['expected']}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        bound = next(iter(context.values()))
        relation = kind.replace("greater_than_equal", "at least").replace(
            "less_than_equal", "at most"
        )
        return loc, f"must be {relation.replace('_', ' ')} {bound:g}, not {shown(value)}"
    if kind == "string_too_short" or value in ("", [], ()):
        return loc, "must not be empty"
    if kind == "too_long":
        return loc, f"expected at most {context['max_length']} items, not {len(value)}"
    if kind == "string_type":
        return loc, f"expected text, not {shown(value)}"
    message = details["msg"]
    return loc, f"{message[:1].lower()}{message[1:]}"


def _place(raw: Loc, data: Mapping[str, Any] | None) -> Loc:
    """Drop from pydantic's path what the user did not write: union tags, implied list items."""
    steps = tuple(step for step in raw if not str(step).startswith("<"))
    if data is None:
        return steps
    loc: Loc = ()
    value: Any = data
    for index, step in enumerate(steps):
        if isinstance(value, dict) and isinstance(step, int):
            continue
        if isinstance(value, dict) and step not in value and index < len(steps) - 1:
            continue
        loc = (*loc, step)
        value = _at(data, loc)
    return loc


def _at(data: Any, loc: Loc) -> Any:
    for step in loc:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _unknown_key(model: type[BaseModel], raw: Loc) -> str:
    """Name the valid key that is nearest to an unknown one, or all of them."""
    models: list[type[BaseModel]] = [model]
    for step in raw[:-1]:
        if isinstance(step, str) and not step.startswith("<"):
            models = [
                inner
                for outer in models
                if step in outer.model_fields
                for inner in _models(outer.model_fields[step].annotation)
            ]
    known = {
        name: None
        for each in models
        for name, info in each.model_fields.items()
        if not info.exclude
    }
    near = difflib.get_close_matches(str(raw[-1]), known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"the keys here are {', '.join(known)}"
    return f"unknown key; {hint}"


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation speaks of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _dotted(loc: Sequence[Step]) -> str:
    text = ""
    for step in loc:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return printable(text)
