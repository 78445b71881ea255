"""What a robot file and a rig's settings say of an arm beside its equilibrium."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History, Memory
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.settings import ControlSettings

__all__ = ["memory_of", "regulation_of", "wrench_at"]

Array = NDArray[np.float64]


def regulation_of(robot: RobotDescription, control: ControlSettings) -> tuple[Array, float]:
    """Lags (n,) and dead time: of the regulators, or of a robot file that knows the arm's, in s."""
    lags, dead = [], control.regulator_dead_time
    for segment in robot.segments:
        history = segment.history
        own = history is not None and history.lag > 0
        lags += [history.lag if own and history else control.regulator_lag] * segment.n_channels
        if own and history is not None:
            dead = history.dead_time or dead
    return np.array(lags), dead


def memory_of(robot: RobotDescription) -> Memory | None:
    """Play and creep of the arm, from rest; lags are the regulators' business here."""
    found: list[History | None] = []
    places: list[int] = []
    for segment in robot.segments:
        history = segment.history
        if history is not None:
            update = {"lag": 0.0, "lag_falling": 0.0, "dead_time": 0.0}
            history = history.model_copy(update=update)
        found += [history] * segment.n_channels
        places += list(range(segment.n_channels))
    if not any(history is not None and history.parts for history in found):
        return None
    return Memory(found, places)


def wrench_at(tip: TipAt, offset: Array, turn: Array | None) -> Array:
    """Force and moment (6,), base axes, that would move a tip by an offset (3,), in m.

    Without its turn, a rotation vector (3,), by a force alone.
    """
    rotation = tip.pose[:3, :3]
    if turn is not None:
        motion = np.concatenate([rotation.T @ offset, rotation.T @ turn])
        wrench = np.linalg.solve(tip.compliance, motion)
    else:
        force = np.linalg.solve(tip.compliance[:3, :3], rotation.T @ offset)
        wrench = np.concatenate([force, np.zeros(3)])
    return np.concatenate([rotation @ wrench[:3], rotation @ wrench[3:]])
