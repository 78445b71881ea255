"""What an arm is: tubes in series, in SI, and those that tests use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from independent.motions import Vector


@dataclass(frozen=True)
class Tube:
    """One segment, by default the paper's (Table II with its lambda); angles in degrees."""

    length: float = 0.09
    outer_radius: float = 0.015
    inner_radius: float = 0.0045
    chamber_radius: float = 0.00225
    offset: float = 0.0101
    angles: tuple[float, ...] = (-30, 30, 90, 150, 210, 270)
    channels: tuple[tuple[int, ...], ...] = ((1, 2), (3, 4), (5, 6))
    youngs_modulus: float = 100e3
    poisson_ratio: float = 0.5
    density: float = 1070.0
    factors: tuple[float, float, float] | None = (-0.2, 1.2, 1.05)
    connector: float = 0.0
    law: str = "paper"

    def mapping(self) -> dict[str, Any]:
        """The segment as a robot file has it, but in SI."""
        compensation = None
        if self.factors is not None:
            keys = ("modulus_per_pressure", "area", "inertia")
            compensation = dict(zip(keys, self.factors, strict=True))
        return {
            "length": self.length,
            "outer_radius": self.outer_radius,
            "inner_radius": self.inner_radius,
            "chambers": {
                "radius": self.chamber_radius,
                "offset": self.offset,
                "angles": [float(angle) for angle in np.radians(self.angles)],
            },
            "channels": [list(channel) for channel in self.channels],
            "material": {
                "youngs_modulus": self.youngs_modulus,
                "poisson_ratio": self.poisson_ratio,
                "density": self.density,
            },
            "compensation": compensation,
            "connector": self.connector,
            "strain_law": self.law,
        }


@dataclass(frozen=True)
class Arm:
    """Segments in series, and what they carry."""

    tubes: tuple[Tube, ...]
    tip_mass: float = 0.0
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    highest: float = 1.5e5

    def mapping(self) -> dict[str, Any]:
        """The arm as a robot file has it, but in SI."""
        return {
            "name": "tested",
            "segments": [tube.mapping() for tube in self.tubes],
            "tip_mass": self.tip_mass,
            "gravity": list(self.gravity),
            "pressure": {"min": 0.0, "max": self.highest},
        }

    @property
    def n(self) -> int:
        """Number of channels."""
        return sum(len(tube.channels) for tube in self.tubes)

    @property
    def length(self) -> float:
        """Length at rest with the connectors."""
        return sum(tube.length + tube.connector for tube in self.tubes)

    def split(self, p: ArrayLike) -> list[Vector]:
        """Pressures of each segment."""
        ends = np.cumsum([len(tube.channels) for tube in self.tubes])[:-1]
        return np.split(np.asarray(p, dtype=float), ends)

    def under(self, gravity: Sequence[float], tip_mass: float = 0.0) -> Arm:
        """The same arm with weight."""
        x, y, z = gravity
        return replace(self, gravity=(x, y, z), tip_mass=tip_mass)


FLOP = Tube()
CROSS = Tube(
    length=0.06,
    outer_radius=0.012,
    inner_radius=0.003,
    chamber_radius=0.0015,
    offset=0.008,
    angles=(0, 90, 180, 270),
    channels=((1,), (2,), (3,), (4,)),
    youngs_modulus=150e3,
    poisson_ratio=0.45,
    factors=(-0.1, 1.1, 1.02),
    connector=0.012,
)
PAIR = Tube(  # two channels; chambers crowd on one side, so the centroid is off the axis
    length=0.075,
    chamber_radius=0.0025,
    offset=0.0095,
    angles=(0, 50, 200),
    channels=((1, 2), (3,)),
    factors=None,
    connector=0.004,
)
LOPSIDED = Tube(
    length=0.1,
    outer_radius=0.014,
    inner_radius=0.004,
    chamber_radius=0.003,
    offset=0.0105,
    angles=(10, 70, 130),
    channels=((1,), (2,), (3,)),
    poisson_ratio=0.4,
    factors=(-0.15, 1.1, 0.95),
)
SIX = Tube(
    length=0.05,
    outer_radius=0.01,
    inner_radius=0.0,
    chamber_radius=0.0012,
    offset=0.0072,
    angles=(0, 60, 120, 180, 240, 300),
    channels=((1,), (2,), (3,), (4,), (5,), (6,)),
    youngs_modulus=200e3,
    factors=(0.05, 1.0, 1.1),
    connector=0.006,
)
ARMS = {
    "1 segment": Arm((FLOP,)),
    "2 segments": Arm((FLOP, FLOP)),
    "2 channels, off axis": Arm((PAIR,)),
    "3 segments, mixed": Arm((LOPSIDED, CROSS, PAIR)),
    "5 segments, mixed": Arm((FLOP, CROSS, LOPSIDED, SIX, PAIR)),
}


def neo_hookean(tube: Tube) -> Tube:
    """The same segment with the neo-Hookean law."""
    return replace(tube, law="neo-hookean", factors=None, poisson_ratio=0.5)


def eq_9(i: int) -> float:
    """Angle of chamber i = 1..6 in degrees, literally."""
    alpha = 60
    return -alpha / 2 + (i - i % 2) / 2 * alpha + ((i - 1) - (i - 1) % 2) / 2 * (120 - alpha)
