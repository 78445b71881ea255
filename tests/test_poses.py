"""Poses of a file on a rig: gone through gently, recorded, and refused where the rig cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stiffopt.cli.main import main
from stiffopt.logs import read_log

RIG = Path(__file__).parent.parent / "rig" / "sim.yaml"


def written(folder: Path, pressures: str) -> str:
    path = folder / "next.yaml"
    path.write_text(
        f"format: stiffopt-experiment/1\nrig: {RIG}\nhold: 0.5 s\npressures: {pressures}\n",
        encoding="utf-8",
    )
    return str(path)


def test_poses_are_gone_through_and_recorded(tmp_path: Path) -> None:
    file = written(tmp_path, "[[0.2 bar, 0 bar, 0 bar], [0.2 bar, 0.1 bar, 0 bar]]")
    out = tmp_path / "run"
    assert main(["experiment", "poses", file, "--out", str(out), "-q"]) == 0
    log = read_log(out / "poses.csv")
    assert (out / "poses.mcap").exists()
    for pose in ([2e4, 0, 0], [2e4, 1e4, 0]):
        held = np.abs(log.commanded - pose).max(axis=1) < 1
        assert held.sum() > 10
    np.testing.assert_allclose(log.commanded[-1], 0, atol=1)
    assert np.ptp(log.tip_position[:, 0]) > 2e-3


@pytest.mark.parametrize(
    ("pressures", "message"),
    [
        ("[[0.2 bar, 0 bar]]", "pose 1 has 2 pressures"),
        ("[[0 bar, 0 bar, 2 bar]]", "channel 3 cannot have 2 bar"),
        ("[]", "pressures"),
    ],
)
def test_what_the_rig_cannot_do_is_refused(
    pressures: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    code = main(["experiment", "poses", written(tmp_path, pressures), "--out", str(out)])
    assert code == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
