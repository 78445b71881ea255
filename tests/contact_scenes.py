"""Arms and objects of the tests of contact."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import stiffopt
from independent.arms import FLOP, Arm
from independent.sections import rod_section
from stiffopt.model.scene import Scene

TWO = Arm((FLOP, FLOP))
REST = np.zeros(6)
X = (1.0, 0.0, 0.0)
BENT = np.array([0.9e5, 0.1e5, 0.0, 0.2e5, 0.7e5, 0.1e5])


@cache
def robot(arm: Arm = TWO) -> stiffopt.Manipulator:
    return stiffopt.Manipulator(stiffopt.RobotDescription(**arm.mapping()))


def scene(*shapes: dict[str, Any], **contact: Any) -> Scene:
    allowed = {"allowed": True, **contact}
    return Scene(
        objects=[{"name": f"{k}", "contact": allowed, **shape} for k, shape in enumerate(shapes)]
    )


def post(at: float, gap: float = 0.0, radius: float = 0.005) -> dict[str, Any]:
    """A post across the x axis, that far from a straight arm."""
    x = 0.015 + radius + gap
    return {"capsule": {"from": (x, -0.05, at), "to": (x, 0.05, at), "radius": radius}}


def push(force: float, *direction: float) -> np.ndarray:
    return np.array([*(force * np.array(direction or X)), 0.0, 0.0, 0.0])


def flexibilities(at: float) -> tuple[float, float, float]:
    """Of a straight arm across x: tip, between tip and a point, and of the point (m/N)."""
    law = rod_section(FLOP, np.zeros(3), TWO.gravity)
    bend, shear, length = law.compliance[4, 4], law.compliance[0, 0], TWO.length
    between = bend * (at**2 * length / 2 - at**3 / 6) + shear * at
    return bend * length**3 / 3 + shear * length, between, bend * at**3 / 3 + shear * at


def euler_load() -> float:
    """Of a straight arm that is free at the tip, in N: ``P (1 + P/GA - P/EA) = (pi / 2L)^2 EI``."""
    law, length = rod_section(FLOP, np.zeros(3), TWO.gravity), TWO.length
    bend, shear, stretch = law.compliance[3, 3], law.compliance[1, 1], law.compliance[2, 2]
    return float(np.roots([shear - stretch, 1.0, -((np.pi / (2 * length)) ** 2) / bend]).max())


def table(gap: float) -> dict[str, Any]:
    """A wall along the straight arm, on its x side."""
    return {"half_space": {"point": (0.015 + gap, 0, 0), "normal": (-1, 0, 0)}}


@cache
def around(arm: Arm) -> Scene:
    """Two posts that the free arm at `BENT` would enter by millimetres."""
    T = robot(arm).pose(BENT, [0.11, 0.17])
    shapes = []
    for pose, depth, radius in zip(T, (0.006, 0.003), (0.005, 0.008), strict=True):
        centre = pose[:3, 3] - pose[:3, 0] * (0.015 + radius - depth)
        side = 0.05 * pose[:3, 1]
        ends = {"from": tuple(centre - side), "to": tuple(centre + side)}
        shapes.append({"capsule": {**ends, "radius": radius}})
    return scene(*shapes, friction=0.3)


@cache
def leaning(arm: Arm) -> stiffopt.ContactEquilibrium:
    return robot(arm).contact_equilibrium(BENT, around(arm))
