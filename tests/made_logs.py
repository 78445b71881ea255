"""Recordings of arms that are known: their histories in fine steps, behind a tracker with noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stiffopt.logs import Body, Log
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import Memory
from stiffopt.model.manipulator import Manipulator

__all__ = ["course", "effective_pressures", "made_log", "reddened"]

Array = NDArray[np.float64]

FINE = 0.01  # s


def course(
    n: int,
    duration: float,
    seed: int = 0,
    *,
    highest: float = 1e5,
    rate: float = 10.0,
    hold: float = 1.5,
    corner: float = 1.0,
) -> tuple[Array, Array]:
    """Times (N,) and pressures (N, n): from zero to random ones, each reached by a ramp and held.

    Pressures are within a share `corner` of the highest.
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(duration * rate)) / rate
    knots, values = [0.0], [np.zeros(n)]
    while knots[-1] < duration:
        target = random.uniform(0, corner * highest, n) * (random.random(n) < 0.8)
        ramp = 0.2 + 1.5 * float(np.abs(target - values[-1]).max()) / highest
        knots += [knots[-1] + ramp, knots[-1] + ramp + random.uniform(0.3, 2 * hold)]
        values += [target, target]
    pressures = np.column_stack([np.interp(time, knots, v) for v in np.array(values).T])
    return time, pressures


def effective_pressures(
    robot: RobotDescription, time: Array, pressures: Array, side: float | None = None
) -> Array:
    """Effective pressures (N, n) under commands that run evenly from row to row.

    The arm comes from a rise out of rest or, with a `side`, from a long past (`Memory.settle`).
    """
    histories = [s.history for s in robot.segments for _ in range(s.n_channels)]
    places = [c for s in robot.segments for c in range(s.n_channels)]
    memory = Memory(histories, places=places)
    memory.start(pressures[0])
    if side is not None:
        memory.settle(pressures[0], side)
    found = [memory.effective.copy()]
    for begin, end, before, after in zip(
        time[:-1], time[1:], pressures[:-1], pressures[1:], strict=True
    ):
        count = max(1, round((end - begin) / FINE))
        share = (np.arange(count)[:, None] + 0.5) / count
        found.append(memory.run((end - begin) / count, before + share * (after - before))[-1])
    return np.array(found)


def made_log(
    robot: RobotDescription,
    time: Array,
    pressures: Array,
    *,
    seed: int = 0,
    noise: float = 2e-4,
    rho: float = 0.0,
    base: Array | None = None,
    sensor: Array | None = None,
    turns: bool = False,
    bodies: tuple[tuple[str, float], ...] = (),
    side: float | None = None,
) -> Log:
    """What is recorded of a robot.

    Parameters
    ----------
    noise : of each axis of the position, in m; of the orientation ten times as many rad.
    rho : correlation of the noise of neighbouring rows.
    base : pose (4, 4) of the base in the tracker's frame.
    sensor : pose (4, 4) of the sensor in the tip's frame.
    turns : whether orientations are recorded.
    bodies : names and arc lengths of further bodies.
    side : see `effective_pressures`.
    """
    random = np.random.default_rng(1000 + seed)
    base = np.eye(4) if base is None else base
    sensor = np.eye(4) if sensor is None else sensor
    arm = Manipulator(robot)
    u = effective_pressures(robot, time, pressures, side)

    def tracked(poses: Array, sensor: Array) -> Body:
        T = base @ poses @ sensor
        position = T[:, :3, 3] + noise * reddened(random, len(time), rho)
        if not turns:
            return Body(position)
        turned = Rotation.from_rotvec(10 * noise * reddened(random, len(time), rho))
        rotation = Rotation.from_matrix(T[:, :3, :3]) * turned
        quaternion = rotation.as_quat(scalar_first=True)
        return Body(position, quaternion)

    tip = tracked(arm.tip_pose(u), sensor)
    others = {name: tracked(arm.pose(u, at), np.eye(4)) for name, at in bodies}
    return Log(time, pressures, tip.position, tip.quaternion, bodies=others)


def reddened(random: np.random.Generator, count: int, rho: float) -> Array:
    """Noise (N, 3) of variance one, of which neighbours are correlated."""
    white = random.normal(0, 1, (count, 3))
    for i in range(1, count):
        white[i] = rho * white[i - 1] + np.sqrt(1 - rho**2) * white[i]
    return white
