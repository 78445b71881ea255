"""Stiffness along an arm: the golden numbers at its tip, beams along it, and the command."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt.cli.main import main
from stiffopt.errors import InputError
from stiffopt.experiments.arm_map import first_channels, map_arm, map_tip
from stiffopt.plots.style import round_steps

GOLDEN = {  # bar: stiffness along x, y, z in N/cm; reference/paper-notes.md
    0.0: (0.1403, 0.1403, 7.3042),
    0.4: (0.1267, 0.1213, 2.2238),
    0.8: (0.1280, 0.1025, 0.5526),
    1.0: (0.1391, 0.0933, 0.3189),
    1.5: (0.2823, 0.0724, 0.1163),
}


def robot(name: str = "stiff-flop-1") -> stiffopt.Manipulator:
    return stiffopt.load_robot(name)


def test_the_tip_of_the_map_has_the_golden_numbers() -> None:
    found = map_arm(robot(), [[1]], np.array(list(GOLDEN)) * 1e5, points=4)
    np.testing.assert_allclose(
        found.stiffness[0, :, -1] * 0.01, list(GOLDEN.values()), rtol=2e-3, atol=1e-4
    )


def test_a_straight_arm_is_a_beam_everywhere() -> None:
    """Without pressure: 3 EI / s^3 with shear, EA / s; E I and A of Table II with lambda."""
    arm = robot()
    found = map_arm(arm, [[1]], [0.0], points=10)
    EI, EA, GA = 100e3 * 1.05 * 3.445e-8, 100e3 * 1.2 * 547.8e-6, 100e3 / 3 * 1.2 * 547.8e-6
    s = found.at
    bending = 1 / (s**3 / (3 * EI) + s / GA)
    np.testing.assert_allclose(found.stiffness[0, 0, :, 0], bending, rtol=1e-3)
    np.testing.assert_allclose(found.stiffness[0, 0, :, 1], bending, rtol=1e-3)
    np.testing.assert_allclose(found.stiffness[0, 0, :, 2], EA / s, rtol=1e-3)
    assert found.at[found.middle] == pytest.approx(0.045)
    assert found.at[-1] == arm.length


def test_from_the_middle_to_the_tip_it_falls_six_to_eight_times() -> None:
    """What the paper says of its figure 6, along x, while the arm is not bent right over."""
    found = map_arm(robot(), pressures=[0.0, 0.5e5, 1e5], points=8)
    assert found.groups == ((1,), (1, 2))
    ratio = found.stiffness[:, :, found.middle, 0] / found.stiffness[:, :, -1, 0]
    assert ratio.min() > 5
    assert ratio.max() < 8


@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
def test_a_map_is_what_the_model_says_point_by_point(name: str) -> None:
    arm = robot(name)
    found = map_arm(arm, [[1, 5]], [0.3e5, 0.6e5], points=4, boundary="guided", frame="tip")
    p = np.zeros(6)
    p[[0, 4]] = 0.6e5
    for j in (0, 2):
        at = float(found.at[j])
        expected = arm.stiffness(p, np.eye(3), boundary="guided", frame="tip", at=at)
        np.testing.assert_allclose(found.stiffness[0, 1, j], expected, rtol=1e-6)
        np.testing.assert_allclose(found.positions[0, 1, j], arm.pose(p, at)[:3, 3], atol=1e-9)
    np.testing.assert_allclose(found.backbones[0, 1, -1], arm.tip_pose(p)[:3, 3], atol=1e-6)


def test_default_groups_take_the_first_channels_of_each_segment() -> None:
    arm = robot("stiff-flop-3")
    assert first_channels(arm, 1) == (1, 4, 7)
    assert first_channels(arm, 2) == (1, 2, 4, 5, 7, 8)


def test_a_map_over_two_channels_is_what_the_model_says() -> None:
    arm = robot("stiff-flop-2")
    found = map_tip(arm, (2, 4), levels=4, others=[0, 0, 0, 0, 0.2e5, 0])
    for i in (0, 3):
        for j in (1, 2):
            p = [0, found.first[i], 0, found.second[j], 0.2e5, 0]
            expected = arm.stiffness(p, np.eye(3))
            np.testing.assert_allclose(found.stiffness[i, j], expected, rtol=1e-9)
    assert found.first.tolist() == [0, 0.5e5, 1e5, 1.5e5]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"groups": [[4]]}, "there is no channel 4"),
        ({"groups": [[0]]}, "there is no channel 0"),
        ({"groups": [[]]}, "at least one channel"),
        ({"pressures": [2e5]}, "channel 1 cannot have 2 bar"),
        ({"pressures": [np.nan]}, "channel 1 cannot have nan bar"),
        ({"points": 1}, "points"),
        ({"boundary": "loose"}, "unknown boundary"),
    ],
)
def test_what_cannot_be_mapped(arguments: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        map_arm(robot(), **arguments)


def test_a_map_over_one_channel_is_none() -> None:
    with pytest.raises(InputError, match="two different channels"):
        map_tip(robot(), (1, 1))


@pytest.mark.parametrize(("low", "high"), [(0.1, 30), (0.06, 0.25), (0.2, 0.21), (11, 850)])
def test_steps_of_a_scale_are_few_and_round(low: float, high: float) -> None:
    steps = round_steps(low, high)
    assert len(steps) <= 8
    assert all(low * 0.999 <= step <= high * 1.001 for step in steps)
    assert all(len(f"{step:.10g}".strip("0.")) <= 2 for step in steps)


# -- the command ----------------------------------------------------------------------------------


def test_the_command_prints_draws_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot, table = tmp_path / "arm.png", tmp_path / "arm.csv"
    options = ["--points", "5", "--pressures", "0,1 bar", "--plot", str(plot), "--csv", str(table)]
    assert main(["map", "arm", "stiff-flop-1", *options]) == 0
    said = capsys.readouterr()
    assert "13.91" in said.out  # along x at 1 bar
    assert not said.err
    assert plot.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 2 * 2 * 5
    tip = next(r for r in rows if r["channels"] == "1" and r["pressure_pa"] == "100000"
               and r["at_m"] == "0.09")  # fmt: skip
    assert float(tip["stiffness_y_n_per_m"]) == pytest.approx(9.33, rel=1e-3)
    assert float(tip["x_m"]) == pytest.approx(-0.040803, abs=1e-6)


def test_the_json_is_one_strict_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "arm", "stiff-flop-1", "--points", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert np.shape(found["stiffness_n_per_m"]) == (2, 7, 3, 3)
    assert found["channels"] == [[1], [1, 2]]
    assert main(["map", "arm", "stiff-flop-1", "--over", "1,3", "--levels", "4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert np.shape(found["stiffness_n_per_m"]) == (4, 4, 3)
    assert found["channels"] == [1, 3]


def test_a_map_over_two_channels_from_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot, table = tmp_path / "tip.pdf", tmp_path / "tip.csv"
    options = ["--over", "1,2", "--levels", "5", "--plot", str(plot), "--csv", str(table)]
    assert main(["map", "arm", "stiff-flop-1", *options]) == 0
    assert "at p1, p2 (bar)" in capsys.readouterr().out
    assert plot.read_bytes().startswith(b"%PDF")
    assert len(table.read_text().splitlines()) == 26


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--over", "1"], "two different channels"),
        (["--over", "1,9"], "there is no channel 9"),
        (["--over", "a,b"], "--over: 'a,b' are no channels"),
        (["--over", "1,2", "--points", "3"], "--points has no meaning"),
        (["--levels", "3"], "give --over too"),
        (["--channels", "1,1"], "a channel is given twice"),
        (["--pressures", "1"], "is no list of pressures"),
        (["--plot", "a.txt"], "ends in .png"),
        (["--csv", "a.txt"], "ends in .csv"),
        (["--csv", "none/a.csv"], "there is no folder 'none'"),
        (["--boundary", "loose"], "unknown boundary"),
    ],
)
def test_bad_input(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    options: list[str], words: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["map", "arm", "stiff-flop-1", *options]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert not said.out
    assert not list(tmp_path.iterdir())


def test_an_unknown_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "arm", "stiff-flop-9"]) == 2
    assert "stiff-flop-9" in capsys.readouterr().err


def test_no_matplotlib(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["map", "arm", "stiff-flop-1", "--plot", "a.png"]) == 2
    assert "pip install 'stiffopt[plot]'" in capsys.readouterr().err
