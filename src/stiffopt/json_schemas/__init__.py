"""JSON Schemas of stiffopt's files, for completion and checking in editors.

They are generated from the models that read the files (`stiffopt.schema`): keys, the form of
quantities, and the descriptions in the models' docstrings.
A JSON Schema cannot express everything that the models check; ``stiffopt check`` does.
"""

from __future__ import annotations

import inspect
import json
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from stiffopt.documents import write_whole
from stiffopt.files import format_of

MODELS = {
    "robot": "stiffopt.model.description:RobotDescription",
    "task": "stiffopt.optimise.task:Task",
    "path": "stiffopt.paths.path:Path",
    "scene": "stiffopt.model.scene:Scene",
    "rig": "stiffopt.rig.config:RigDescription",
    "experiment": "stiffopt.experiments.poses:PosesFile",
    "commissioning": "stiffopt.commissioning.record:CommissioningRecord",
}
"""The kinds of files that people write, and the models that read them."""

_ATTRIBUTE = re.compile(r"^(\w+(?:, \w+)*) : (.*)$")


def json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a kind of file.

    Parameters
    ----------
    kind : a key of `MODELS`.
    """
    module, _, name = MODELS[kind].partition(":")
    model: type[BaseModel] = getattr(import_module(module), name)
    schema = model.model_json_schema(schema_generator=_Generator)
    keys = {"format": {"const": format_of(kind), "description": "kind and version of this file"}}
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        **schema,
        "title": f"stiffopt {kind} file",
        "properties": keys | schema["properties"],
        "required": ["format", *schema.get("required", ())],
    }


def schema_file(kind: str) -> Path:
    """Return the file in this package with the JSON Schema of a kind of file."""
    return Path(__file__).parent / f"{kind}.schema.json"


class _Generator(GenerateJsonSchema):
    """Describe keys by the docstrings of their models; leave out fields that files do not have."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        made = super().model_schema(schema)
        model: type[BaseModel] = schema["cls"]
        described = _attributes(model)
        made.pop("title", None)
        made["description"] = (inspect.getdoc(model) or "").partition("\n\n")[0].replace("\n", " ")
        for name, info in model.model_fields.items():
            key = info.alias or name
            if info.exclude:
                made["properties"].pop(key, None)
                continue
            value = made["properties"][key]
            value.pop("title", None)
            if name in described:
                value["description"] = described[name]
        return made

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        """Leave defaults out: they are in SI, and files have units."""
        return self.generate_inner(schema["schema"])

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        """Leave null out: files may not have it."""
        return self.generate_inner(schema["schema"])


@cache
def _attributes(model: type[BaseModel]) -> dict[str, str]:
    """Return the descriptions of attributes in the docstrings of a model and its bases."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        names: list[str] = []
        for line in inspect.cleandoc(base.__doc__ or "").splitlines():
            match = _ATTRIBUTE.match(line)
            if match:
                names = match[1].split(", ")
                found.update(dict.fromkeys(names, match[2]))
            elif names and line.startswith("    "):
                found.update({name: f"{found[name]} {line.strip()}" for name in names})
            else:
                names = []
    return found


def write_schema_files() -> None:
    """Rewrite the files that ship with the package, for `make schemas`."""
    for kind in MODELS:
        text = json.dumps(json_schema(kind), ensure_ascii=False, separators=(",", ":"))
        write_whole(schema_file(kind), f"{text}\n".encode())
