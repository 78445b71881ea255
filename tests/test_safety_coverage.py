"""Every line and branch of the code that stands between a command and the arm is run by a test."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("coverage", reason="coverage is not installed; it is part of stiffopt[dev]")

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "stiffopt"
GOALS = tuple(f"tests/test_goal{part}.py" for part in ("", "_checks", "_supply"))
GUARDING = {
    "safety/gate.py": ("tests/test_safety.py", "tests/test_claim.py", *GOALS),
    "safety/goal.py": GOALS,
    "safety/claim.py": ("tests/test_claim.py",),
    "safety/guard.py": tuple(f"tests/test_guard{part}.py" for part in ("", "_goals", "_program")),
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


@pytest.fixture(scope="module")
def covered(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What coverage tells of each file after all these tests, in one process."""
    folder = tmp_path_factory.mktemp("coverage")
    report = folder / "report.json"
    sources = ",".join(str(PACKAGE / source) for source in GUARDING)
    tests = sorted({test for each in GUARDING.values() for test in each})
    coverage = (sys.executable, "-m", "coverage")
    environment = {**os.environ, "COVERAGE_FILE": str(folder / "data")}

    def run(*command: str) -> None:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr

    pytest_ = ("-m", "pytest", "-q", "-p", "no:cacheprovider", *tests)
    run(*coverage, "run", "--branch", f"--include={sources}", *pytest_)
    run(*coverage, "json", "-o", str(report))
    files: dict[str, Any] = json.loads(report.read_text())["files"]
    return {str((ROOT / name).relative_to(PACKAGE)): found for name, found in files.items()}


@pytest.mark.parametrize("source", GUARDING)
def test_every_line_is_run(source: str, covered: dict[str, Any]) -> None:
    found = covered[source]
    assert found["summary"]["num_statements"] > 40
    assert found["missing_lines"] == []
    assert set(found["excluded_lines"]) <= lines_for_types(PACKAGE / source)
    assert found["missing_branches"] == []
