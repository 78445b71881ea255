"""The short form of the soak (benchmarks/soak.py): forty seconds in place of a day."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import soak


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, soak.__file__, *options], capture_output=True, text=True, timeout=600
    )


@pytest.mark.usefixtures("compiled")
def test_some_targets_and_a_fault_and_then_others(tmp_path: Path) -> None:
    out = tmp_path / "soak.jsonl"
    told = ("--block", "20", "--fault-every", "24", "--seed", "40", "--out", str(out))
    for hours, blocks in (("0.0056", 1), ("0.0112", 2)):  # the second goes on where the first ended
        done = run("--hours", hours, *told)
        assert done.returncode == 0, done.stdout + done.stderr
        found = [json.loads(line) for line in out.read_text().splitlines()]
        assert len(found) == blocks
        assert all(block["error_mm"]["mean"] < 0.1 and not block["wrong"] for block in found)
    assert sum(sum(f["times"] for f in block["faults"].values()) for block in found) >= 2
    assert len({block["process"] for block in found}) == 2


def test_a_run_that_went_wrong_ends_with_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [soak.__file__, "--report", str(tmp_path / "soak.jsonl")])
    out = tmp_path / "soak.jsonl"
    block = {
        "simulated_s": 600.0, "error_mm": {"mean": 0.05, "worst": 0.2}, "faults": {}, "wrong": [],
        "memory_mb": 200.0, "objects": 1, "process": 1,
    }  # fmt: skip
    for grown, code in (({}, 0), ({"memory_mb": 260.0}, 1), ({"wrong": ["a fault"]}, 1)):
        lines = [block] * 9 + [block | grown] * 3
        out.write_text("".join(json.dumps(line) + "\n" for line in lines))
        assert soak.main() == code
