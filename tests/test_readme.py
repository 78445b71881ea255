"""The README does what it says: its Python and its command print what stands below them.

Numbers may differ in the last digits between machines; all else must be the same.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import stiffopt.plant.devices  # noqa: F401 - its code is kept where it usually is
from examples import assert_same_text, blocks, run_examples

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture
def _in_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.mark.usefixtures("_in_root", "compiled")
@pytest.mark.filterwarnings("ignore:the simulator is compiled")
def test_python_examples_print_what_stands_below_them() -> None:
    assert run_examples(README, "README.md") == len(blocks(README, "text"))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("block", blocks(README, "console"))
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
    text = re.sub(r", after compiling once for \d+ s", "", text)
    return re.sub(r"\d+(\.\d+)? (ms|s)\b", "some time", text)


def test_first_screen_has_a_picture() -> None:
    (picture,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")
