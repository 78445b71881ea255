"""Simulated arms for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from independent.arms import FLOP, Arm
from stiffopt.model.description import RobotDescription
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    PlantLoad,
    PlantSettings,
    Silicone,
)

LINEAR = Silicone(law="linear", damping=0.0, creep=(), hysteresis=())
PLAIN = replace(FLOP, factors=None)  # without lambda
CONSTANT = replace(FLOP, factors=(0.0, 1.2, 1.05))  # a modulus that pressure does not change
STIFF = replace(FLOP, factors=(0.0, 1e5, 1.0))  # neither shears nor stretches
ONE, TWO = Arm((FLOP,)), Arm((FLOP, FLOP))
DOWN = (0.0, 0.0, 9.81)
BAR = 1e5


def make(arm: Arm, silicone: Silicone = LINEAR, **settings: Any) -> Plant:
    settings.setdefault("dynamics", "quasi-static")
    return Plant(RobotDescription(**arm.mapping()), PlantSettings(silicone=silicone, **settings))


def settled(arm: Arm, p: Any = None, load: PlantLoad | None = None, **settings: Any) -> Any:
    plant = make(arm, **settings)
    plant.settle(np.zeros(arm.n) if p is None else p, load)
    return plant.tip_pose()


def material(**changes: Any) -> Silicone:
    return LINEAR.model_copy(update=changes)
