"""The JSON Schemas that editors use: those of the models, true of every file that is shipped."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from stiffopt.documents import read_document
from stiffopt.json_schemas import MODELS, json_schema, schema_file

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path
    for folder in ("problems", "rig", "src/stiffopt/robots", "examples")
    for path in (ROOT / folder).rglob("*.yaml")
)


def kind_of(path: Path) -> str:
    return str(read_document(path).data["format"]).removeprefix("stiffopt-").partition("/")[0]


@pytest.mark.parametrize("kind", MODELS)
def test_what_is_shipped_is_made_from_the_models(kind: str) -> None:
    shipped = json.loads(schema_file(kind).read_text(encoding="utf-8"))
    assert shipped == json_schema(kind), "the models have changed: make schemas"
    jsonschema.Draft202012Validator.check_schema(shipped)


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if kind_of(path) in MODELS],
    ids=lambda path: path.relative_to(ROOT).as_posix(),
)
def test_shipped_files_agree(path: Path) -> None:
    errors = jsonschema.Draft202012Validator(json_schema(kind_of(path))).iter_errors(
        read_document(path).data
    )
    assert not [f"{list(error.absolute_path)}: {error.message}" for error in errors]


@pytest.mark.parametrize(
    ("kind", "place", "value"),
    [
        ("robot", ("segments", 0, "outer_radios"), "15 mm"),
        ("robot", ("segments", 0, "length"), 90),
        ("robot", ("tip_mass",), "20"),
        ("task", ("target", "position", 0), "fre"),
        ("task", ("stiffness", "maximise", "directon"), [1, 0, 0]),
        ("rig", ("supply", "lagg"), "20 ms"),
        ("rig", ("rate",), 100),
        ("rig", ("format",), "stiffopt-task/1"),
    ],
)
def test_mistakes_are_seen(kind: str, place: tuple[Any, ...], value: Any) -> None:
    files = {
        "robot": "src/stiffopt/robots/stiff-flop-2.yaml",
        "task": "problems/two_segment_stiff_x.yaml",
        "rig": "rig/sim.yaml",
    }
    data = read_document(ROOT / files[kind]).data
    inner: Any = data
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    assert not jsonschema.Draft202012Validator(json_schema(kind)).is_valid(data)


def test_keys_are_described() -> None:
    robot = json_schema("robot")
    segment = robot["$defs"]["Segment"]["properties"]
    assert "at rest" in segment["length"]["description"]
    assert "90 mm" in str(segment["length"])
    assert "source" not in json_schema("task")["properties"]


def _server() -> list[str]:
    """Return the command of the YAML language server, or skip."""
    found = shutil.which("yaml-language-server")
    folder = os.environ.get("STIFFOPT_NODE_MODULES", "")
    script = Path(folder) / "yaml-language-server" / "bin" / "yaml-language-server"
    if found:
        return [found, "--stdio"]
    if folder and script.exists() and shutil.which("node"):
        return ["node", str(script), "--stdio"]
    pytest.skip("needs: npm install -g yaml-language-server (Debian packages nodejs, npm)")


class _Editor:
    """An editor that speaks the Language Server Protocol to the YAML language server."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self.send(id=1, method="initialize", params={"capabilities": {}, "rootUri": None})
        self.wait(lambda message: message.get("id") == 1)
        self.send(method="initialized", params={})

    def send(self, **message: Any) -> None:
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        assert self.process.stdin is not None
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self.process.stdin.flush()

    def wait(self, is_it: Any) -> dict[str, Any]:
        """Read messages until one is the right one; answer the server's questions."""
        assert self.process.stdout is not None
        while True:
            length = 0
            while line := self.process.stdout.readline().strip():
                if line.lower().startswith(b"content-length"):
                    length = int(line.split(b":")[1])
            assert length, "the server has ended"
            message: dict[str, Any] = json.loads(self.process.stdout.read(length))
            if is_it(message):
                return message
            if "id" in message and "method" in message:
                items = message.get("params", {}).get("items", [])
                answer = [{"validate": True, "schemaStore": {"enable": False}} for _ in items]
                self.send(id=message["id"], result=answer or None)

    def open(self, uri: str, text: str) -> list[tuple[int, str]]:
        """Open a file; return the lines (from 0) and texts of what is wrong with it."""
        item = {"uri": uri, "languageId": "yaml", "version": 1, "text": text}
        self.send(method="textDocument/didOpen", params={"textDocument": item})
        answer = self.wait(
            lambda message: (
                message.get("method") == "textDocument/publishDiagnostics"
                and message["params"]["uri"] == uri
            )
        )
        return [
            (found["range"]["start"]["line"], found["message"])
            for found in answer["params"]["diagnostics"]
        ]

    def complete(self, uri: str, line: int) -> list[str]:
        """Return the keys that are offered at the begin of a line."""
        position = {"line": line, "character": 0}
        self.send(
            id=7,
            method="textDocument/completion",
            params={"textDocument": {"uri": uri}, "position": position},
        )
        answer = self.wait(lambda message: message.get("id") == 7)
        return [item["label"] for item in answer["result"]["items"]]


def test_an_editor_completes_and_checks() -> None:
    editor = _Editor(_server())
    try:
        for kind, name in (
            ("robot", "src/stiffopt/robots/stiff-flop-2.yaml"),
            ("task", "problems/two_segment_match_matrix.yaml"),
            ("rig", "rig/modbus-aurora.yaml"),
            ("path", "problems/paths/path_line_stiff_x.yaml"),
        ):
            head = f"# yaml-language-server: $schema={schema_file(kind).as_uri()}\n"
            text = head + (ROOT / name).read_text(encoding="utf-8")
            assert editor.open(f"file:///good-{kind}.yaml", text) == [], name
        robot = schema_file("robot").as_uri()
        text = (ROOT / "src/stiffopt/robots/stiff-flop-2.yaml").read_text(encoding="utf-8")
        bad = text.replace("outer_radius", "outer_radios", 1).replace("-0.2,", "a,", 1)
        lines = [
            line
            for line, _ in editor.open(
                "file:///bad.yaml", f"# yaml-language-server: $schema={robot}\n{bad}"
            )
        ]
        at = bad.splitlines().index("    outer_radios: 15 mm") + 1
        assert at in lines
        text = f"# yaml-language-server: $schema={robot}\n{text}\n"
        editor.open("file:///more.yaml", text)
        offered = editor.complete("file:///more.yaml", text.count("\n"))
        assert {"gravity", "tip_mass"} <= set(offered)
    finally:
        editor.process.kill()
        editor.process.communicate()
