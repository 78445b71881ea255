"""Every line and branch of the code that stands between a command and the arm is run by a test."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("coverage", reason="coverage is not installed; it is part of stiffopt[dev]")

ROOT = Path(__file__).parents[1]
GUARDING = {
    "safety/gate.py": ("tests/test_safety.py", "tests/test_claim.py", "tests/test_goal.py"),
    "safety/goal.py": ("tests/test_goal.py",),
    "safety/claim.py": ("tests/test_claim.py",),
    "safety/guard.py": ("tests/test_guard.py",),
    "safety/rescue.py": ("tests/test_rescue.py",),
    "safety/vent_line.py": ("tests/test_vent_line.py",),
}
"""Files that must be covered to the last line, and the tests that do so."""


def lines_for_types(path: Path) -> set[int]:
    """Lines that only a type checker reads: no test can run them."""
    return {
        line
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for line in range(node.lineno - 1, (node.end_lineno or node.lineno) + 1)  # and a blank one
    }


@pytest.mark.parametrize("source", GUARDING)
def test_every_line_is_run(source: str, tmp_path: Path) -> None:
    data, report = tmp_path / "data", tmp_path / "report.json"
    path = ROOT / "src" / "stiffopt" / source
    pytest_ = ("-m", "pytest", "-q", "-p", "no:cacheprovider", *GUARDING[source])
    coverage = (sys.executable, "-m", "coverage")
    environment = {**os.environ, "COVERAGE_FILE": str(data)}

    def run(*command: str) -> None:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr

    run(*coverage, "run", "--branch", f"--include={path}", *pytest_)
    run(*coverage, "json", "-o", str(report))
    (found,) = json.loads(report.read_text())["files"].values()
    assert found["summary"]["num_statements"] > 40
    assert found["missing_lines"] == []
    assert set(found["excluded_lines"]) <= lines_for_types(path)
    assert found["missing_branches"] == []
