"""Examples in pages: they run, and print what stands below them."""

from __future__ import annotations

import contextlib
import io
import re
from typing import Any

import pytest

NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:e[+-]?\d+)?")


def blocks(text: str, kind: str) -> list[str]:
    """Return the blocks of a page that are of a kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```", text, re.M | re.S)


def run_examples(text: str, page: str) -> int:
    """Run the Python blocks of a page one after the other; return how many there are.

    Each must have a text block right below it with what it prints.
    """
    pairs = re.findall(r"^```python\n(.*?)^```\n\n```text\n(.*?)^```", text, re.M | re.S)
    assert len(pairs) == len(blocks(text, "python")), f"{page}: an example without its answer"
    names: dict[str, Any] = {}
    for code, promised in pairs:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page, "exec"), names)
        assert_same_text(printed.getvalue(), promised)
    return len(pairs)


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
