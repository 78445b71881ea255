"""The command that leans an arm on a scene: its report, its JSON, its picture, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt.cli.main import main

SCENE = """\
format: stiffopt-scene/1
objects:
  - name: post
    capsule: {from: [-40 mm, -50 mm, 120 mm], to: [-40 mm, 50 mm, 120 mm], radius: 5 mm}
    contact: {allowed: true, max_force: 0.1 N, friction: 0.2}
"""
PRESSURES = "0.8, 0, 0, 0, 0, 0 bar"


@pytest.fixture
def scene(tmp_path: Path) -> str:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return str(path)


def lean(scene: str, *more: str, pressures: str = PRESSURES) -> int:
    return main(
        ["map", "contact", "stiff-flop-2", "--scene", scene, "--pressures", pressures, *more]
    )


def test_json_says_what_the_model_says(scene, capsys):
    assert lean(scene, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    robot = stiffopt.load_robot("stiff-flop-2")
    p = np.array([0.8e5, 0, 0, 0, 0, 0])
    eq = robot.contact_equilibrium(p, stiffopt.load_scene(scene))
    (contact,) = said["contacts"]
    assert contact["object"] == "post"
    assert contact["force_n"] == pytest.approx(eq.contacts[0].force, abs=1e-6)
    assert said["stable"] is True
    assert said["within_limits"] is False
    along_x = said["stiffness"]["x"]
    assert along_x["free_n_per_m"] == pytest.approx(robot.stiffness(p, [1, 0, 0]))
    assert along_x["sliding_n_per_m"] == pytest.approx(eq.stiffness([1, 0, 0]), rel=1e-4)
    assert along_x["sticking_n_per_m"] > along_x["sliding_n_per_m"]
    assert [loss["how"] for loss in along_x["lost"]] == ["lifts off", "holds"]


def test_the_report_and_the_picture(scene, capsys, tmp_path, compiled):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "lean.png"
    assert lean(scene, "--plot", str(picture)) == 0
    words = capsys.readouterr().out.split()
    assert {"post", "free", "sliding", "sticking"} <= set(words)
    assert picture.stat().st_size > 10_000


def test_an_arm_that_touches_nothing(scene, capsys):
    assert lean(scene, pressures="0, 0, 0, 0, 0, 0 bar") == 0
    assert "at these pressures the arm touches no object" in capsys.readouterr().out


def test_bad_input(scene, capsys):
    assert lean(scene, pressures="0.8, 0, 0 bar") == 2
    assert "expected pressures of shape (6,)" in capsys.readouterr().err
    assert lean(scene, pressures="0.8, 0, 0, 0, 0, 0 N") == 2
    assert "--pressures" in capsys.readouterr().err
    assert lean("nowhere.yaml") == 2
    assert "nowhere.yaml" in capsys.readouterr().err
