"""What the tests of `solve-pressure` share: task files, and how to run it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from stiffopt.cli import main as entry

ONE = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-20 mm, 5 mm, free], tolerance: {position: 0.5 mm}}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""


TWO = """\
format: stiffopt-task/1
robot: stiff-flop-2
target: {position: [-30 mm, 10 mm, 190 mm]}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""


FAR = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-80 mm, 10 mm, 110 mm]}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""


Write = Callable[..., str]


@pytest.fixture(name="write")
def write_fixture(tmp_path: Path) -> Write:
    def write(name: str, text: str) -> str:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


def run(*arguments: str) -> Any:
    """Run `solve-pressure` in this process."""
    return CliRunner().invoke(entry.solve_pressure_app, list(arguments))


def process(*arguments: str, command: str = "solve-pressure", **options: Any) -> Any:
    """Run an installed command as a process of its own."""
    script = Path(sys.executable).with_name(command)
    return subprocess.run(
        [str(script), *arguments], capture_output=True, text=True, check=False, **options
    )


def lines(text: str) -> list[dict[str, Any]]:
    """Read JSON lines strictly."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]
