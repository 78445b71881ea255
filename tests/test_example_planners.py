"""The planners in `examples`: they find a way, the rig plays it, and the true body is clear."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.mark.long
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    ("name", "least"), [("plan_past_a_sphere", 5.0), ("plan_around_a_box", 4.0)]
)
def test_the_played_body_is_clear(
    name: str,
    least: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if name == "plan_around_a_box":
        pytest.importorskip("ompl")
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    importlib.import_module(name).main(str(tmp_path / "figure.png"))
    said = capsys.readouterr().out
    assert float(said.split("the true body keeps ")[1].split(" mm")[0]) > least
    assert "the loop was active\n" in said
    assert (tmp_path / "figure.png").stat().st_size > 10_000
