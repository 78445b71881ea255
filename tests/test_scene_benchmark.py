"""The judge of the benchmark among obstacles: its two ways of measuring, and stiffopt's."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from independent.arms import FLOP, Arm
from independent.rods import centre_line, rod_tip

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
pytest.importorskip("coal")
pytest.importorskip("igl")

from scenes import judge
from stiffopt import Scene, load_robot

TURNED = (0.8, 0.36, 0.48, 0.0)
OBJECTS: tuple[dict[str, Any], ...] = (
    {"name": "ball", "sphere": {"centre": (0.05, 0.01, 0.1), "radius": 0.01}},
    {"name": "rod", "capsule": {"from": (-0.05, -0.03, 0.1), "to": (-0.05, 0.03, 0.12),
                                "radius": 0.005}},
    {"name": "pipe", "cylinder": {"from": (0.0, 0.06, 0.1), "to": (0.03, 0.06, 0.16),
                                  "radius": 0.008}},
    {"name": "block", "box": {"centre": (0.0, -0.06, 0.15), "size": (0.02, 0.03, 0.02),
                              "orientation": TURNED}},
    {"name": "wall", "half_space": {"point": (0.0, 0.0, 0.25), "normal": (0.0, 0.6, -0.8)}},
    {"name": "lumen", "inside_tube": {"points": [(0, 0, 0), (0, 0, 0.1), (0.01, 0, 0.25)],
                                      "radius": 0.04}},
    {"name": "port", "trocar": {"centre": (0.002, 0.0, 0.05), "axis": (0, 0, 1), "radius": 0.025}},
)  # fmt: skip
PLATE = {"name": "plate", "half_space": {"point": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}}
CURLED = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 1.5]) * 1e5  # its tip is behind the base
PRESSURES = np.array([0.1, 0.3, 0.2, 0.5, 0.1, 0.3]) * 1e5


def test_the_judge_and_stiffopt_measure_the_same():
    line = centre_line(Arm((FLOP, FLOP)), PRESSURES, 600)
    found = judge.clearances(OBJECTS, line, FLOP.outer_radius)
    expected = load_robot("stiff-flop-2").clearances(PRESSURES, Scene(objects=OBJECTS))
    np.testing.assert_allclose(found, expected.distances, atol=1e-5)


def test_the_judge_sees_what_stiffopt_sees_of_a_plate_under_the_base():
    line = centre_line(Arm((FLOP, FLOP)), CURLED, 2000)
    robot = load_robot("stiff-flop-2")
    for asked in (0.0, 2e-3):
        found = judge.clearances((PLATE,), line, FLOP.outer_radius, asked)
        expected = robot.clearance(CURLED, Scene(clearance=asked, objects=[PLATE]))
        assert found[0] == pytest.approx(expected, abs=1e-5)
        assert found[0] < 0


def test_the_centre_line_under_weight_ends_at_the_tip_of_the_rod():
    arm = Arm((FLOP,)).under((0.0, 2.0, 9.81), 0.02)
    line = centre_line(arm, PRESSURES[:3], 6)
    np.testing.assert_allclose(line[-1], rod_tip(arm, PRESSURES[:3])[:3, 3], atol=1e-8)
    assert len(line) == 7
