"""The README does what it says: its Python and its command print what stands below them.

Numbers may differ in the last digits between machines; all else must be the same.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")

NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:e[+-]?\d+)?")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```", README, re.M | re.S)


def assert_same_text(printed: str, promised: str) -> None:
    """Compare the words exactly, the numbers nearly, spaces and rules not at all."""

    def words(text: str) -> list[str]:
        text = re.sub(r"([\[\](),:])", r" \1 ", re.sub(r"[─━╌-]{3,}", " ", text))
        return text.split()

    given, wanted = words(printed), words(promised)
    for one, other in zip(given, wanted, strict=False):
        if NUMBER.fullmatch(one) and NUMBER.fullmatch(other):
            assert float(one) == pytest.approx(float(other), rel=0.01, abs=0.003), printed
        else:
            assert one == other, f"{one!r} is not {other!r} in:\n{printed}"
    assert len(given) == len(wanted), printed


@pytest.fixture
def _in_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.mark.usefixtures("_in_root", "compiled")
def test_python_examples_print_what_stands_below_them() -> None:
    pairs = re.findall(r"^```python\n(.*?)^```\n\n```text\n(.*?)^```", README, re.M | re.S)
    assert len(pairs) == len(blocks("python")) == len(blocks("text"))
    names: dict[str, Any] = {}
    for code, promised in pairs:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, "README.md", "exec"), names)
        assert_same_text(printed.getvalue(), promised)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("block", blocks("console"))
def test_command_prints_what_stands_below_it(block: str) -> None:
    first, _, promised = block.partition("\n")
    assert first.startswith("$ solve-pressure ")
    command, *arguments = first.removeprefix("$ ").split()
    done = subprocess.run(
        [Path(sys.executable).with_name(command), *arguments],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": "100", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert promised.strip(), "the README does not show the answer"
    assert_same_text(_without_times(done.stdout), _without_times(promised))


def _without_times(text: str) -> str:
    return re.sub(r"\d+(\.\d+)? (ms|s)\b", "some time", text)


def test_first_screen_has_a_picture() -> None:
    (picture,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")
