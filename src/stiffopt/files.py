"""Read robot, task, rig and other stiffopt files strictly, with the line in every error.

A file is a YAML document (`stiffopt.documents`) with its kind and version in the key
``format``. Its data are validated by the model that also describes it in code (`stiffopt.schema`).
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, ValidationError, ValidationInfo
from pydantic_core import PydanticKnownError

from stiffopt.documents import Document, read_document, to_yaml, write_file
from stiffopt.errors import FileError, Loc, dotted, shown
from stiffopt.schema import Schema, explain
from stiffopt.units import FROM_FILE, read_from_file

VERSIONS = {"robot": 1, "task": 1, "rig": 1}
"""Supported version of each kind of file; it is 1 for kinds that are not listed."""

ModelT = TypeVar("ModelT", bound=BaseModel)


def _not_in_a_file(value: Any, info: ValidationInfo) -> Any:
    if read_from_file(info):
        raise PydanticKnownError("extra_forbidden")
    return value


SourceFile = Annotated[Path | None, Field(exclude=True), BeforeValidator(_not_in_a_file)]
"""The file that a description was read from; not allowed as a key of a file."""


def read_file(path: str | os.PathLike[str], kind: str, model: type[ModelT]) -> ModelT:
    """Read a file and validate it.

    Raises `FileError` with the line and the key of the first mistake; all others are listed after
    it.

    Parameters
    ----------
    path : the file.
    kind : its required kind, for example ``"robot"`` for files with ``format: stiffopt-robot/1``.
    model : its schema.
    """
    return from_document(read_document(path), kind, model)


def from_document(document: Document, kind: str, model: type[ModelT]) -> ModelT:
    """Validate a document; see `read_file`."""
    _check_format(document, kind)
    for loc, value in _walk(document.data):
        if value is None:
            raise document.error(loc, "has no value; give it one or remove it")
    data = {key: value for key, value in document.data.items() if key != "format"}
    context = {**FROM_FILE, "folder": Path(document.path).parent}
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        raise _file_error(document, model, error) from None


def folder_of(info: ValidationInfo) -> Path:
    """Return the folder of the file that is validated; in a call, the working directory."""
    return Path(info.context.get("folder", "") if isinstance(info.context, Mapping) else "")


def line_of(path: str | os.PathLike[str], *loc: str | int) -> int | None:
    """Return the line of a key in a file; None if the file does not (or no longer) have it."""
    with suppress(FileError):
        return read_document(path).lines.get(loc)
    return None


def save_file(
    path: str | os.PathLike[str], kind: str, schema: Schema, comment: Sequence[str] = ()
) -> None:
    """Write a description as a file of its kind, which `read_file` reads back as its equal.

    Quantities are written with units; None and empty lists are left out. The lines of
    `comment` are written above, for people.
    """
    write_file(path, _as_file(kind, schema), comment)


def file_text(kind: str, schema: Schema) -> str:
    """Return what `save_file` writes."""
    return to_yaml(_as_file(kind, schema))


def format_of(kind: str) -> str:
    """Return the value of the key ``format`` in a file of a kind."""
    return f"stiffopt-{kind}/{VERSIONS.get(kind, 1)}"


def _as_file(kind: str, schema: Schema) -> dict[str, Any]:
    data = _without_empty_lists(schema.model_dump(mode="json", exclude_none=True, by_alias=True))
    return {"format": format_of(kind), **data}


def _check_format(document: Document, kind: str) -> None:
    """Reject a file of another kind or version."""
    version = VERSIONS.get(kind, 1)
    wanted = format_of(kind)
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


def _walk(value: Any, loc: Loc = ()) -> Iterator[tuple[Loc, Any]]:
    """Yield everything in plain data with its place."""
    yield loc, value
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _walk(item, (*loc, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _walk(item, (*loc, index))


def _file_error(document: Document, model: type[BaseModel], error: ValidationError) -> FileError:
    """Return one error that leads with the topmost mistake and lists the others."""
    found = []
    for details in error.errors():
        loc, reason = explain(model, details, document.data)
        line = max(document.lines.get(loc[:n], 0) for n in range(len(loc) + 1))
        found.append((line, dotted(loc), reason))
    found.sort(key=lambda mistake: mistake[0])
    line, key, reason = found[0]
    others = [FileError(document.path, r, line=n or None, key=k or None) for n, k, r in found[1:]]
    return FileError(document.path, reason, line=line or None, key=key or None, others=others)


def _without_empty_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_empty_lists(item) for key, item in value.items() if item != []}
    return [_without_empty_lists(item) for item in value] if isinstance(value, list) else value
