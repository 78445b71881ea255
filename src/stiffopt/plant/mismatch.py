"""How a simulated arm differs from its robot file: as given, and as drawn from a seed."""

from __future__ import annotations

import numpy as np

from stiffopt import lie
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.plant.settings import Mismatch, PlantSettings
from stiffopt.registration import Placement

__all__ = ["check_mismatch", "draw"]


def check_mismatch(given: Mismatch, robot: RobotDescription) -> None:
    """Refuse a list that has not one value per channel or per segment.

    Raises
    ------
    InputError
        It names the list.
    """
    channels, segments = robot.n_pressures, robot.n_segments
    for name, length, noun in (
        *((name, channels, "channel") for name in ("gain", "offset", "angle")),
        *((name, segments, "segment") for name in ("modulus", "length")),
    ):
        values = getattr(given, name)
        if values and len(values) != length:
            raise InputError(
                f"mismatch.{name} has {len(values)} values; expected {length}, one for each "
                f"{noun} of the robot, the proximal segment first"
            )


def draw(robot: RobotDescription, settings: PlantSettings) -> Mismatch:
    """Return the mismatch of the settings with what their spread and seed add to it.

    Raises
    ------
    InputError
        A list has not one value per channel or per segment.
    """
    given = settings.mismatch
    channels, segments = robot.n_pressures, robot.n_segments
    check_mismatch(given, robot)
    if settings.spread is None:
        return given
    spread = settings.spread
    rng = np.random.default_rng([settings.seed, 1])  # the noise of the devices has other streams

    def factors(values: tuple[float, ...], size: int, deviation: float) -> tuple[float, ...]:
        drawn = 1 + deviation * np.clip(rng.standard_normal(size), -3, 3)
        return tuple((np.array(values or (1.0,) * size) * np.maximum(drawn, 0.1)).tolist())

    def added(values: tuple[float, ...], size: int, deviation: float) -> tuple[float, ...]:
        drawn = deviation * np.clip(rng.standard_normal(size), -3, 3)
        return tuple((np.array(values or (0.0,) * size) + drawn).tolist())

    return Mismatch(
        gain=factors(given.gain, channels, spread.gain),
        offset=added(given.offset, channels, spread.offset),
        angle=added(given.angle, channels, spread.angle),
        modulus=factors(given.modulus, segments, spread.modulus),
        length=factors(given.length, segments, spread.length),
        base=_moved(given.base, rng, spread.base_position, spread.base_tilt),
        registration=_moved(
            given.registration, rng, spread.registration_position, spread.registration_angle
        ),
    )


def _moved(given: Placement, rng: np.random.Generator, shift: float, turn: float) -> Placement:
    twist = np.clip(rng.standard_normal(6), -3, 3) * np.repeat([shift, turn], 3)
    return Placement.of(given.transform() @ np.asarray(lie.exp(twist)))
