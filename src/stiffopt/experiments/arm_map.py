"""Map a model's stiffness along the arm (figure 6 of the paper), and over two pressures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_integer
from stiffopt.model.compliance import Boundary, Frame
from stiffopt.model.manipulator import Manipulator

NEAREST_BASE = 0.2
"""Share of the length from which stiffness is mapped; at the base it is infinite."""
Progress = Callable[[float, float], None]


@dataclass(frozen=True, eq=False)
class ArmMap:
    """Stiffness at points along an arm."""

    robot: str  # name
    length: float  # at rest, in m
    # G groups of channels (from 1); the channels of a group are pressurised together
    groups: tuple[tuple[int, ...], ...]
    pressures: Array  # of the group's channels, (P,), in Pa
    at: Array  # arc lengths of the points at rest (S,), in m
    directions: Array  # unit vectors (d, 3)
    # boundary, frame: of the stiffness
    boundary: str
    frame: str
    stiffness: Array  # (G, P, S, d), in N/m
    positions: Array  # of the points in the base frame (G, P, S, 3), in m
    backbones: Array  # shapes of the arm (G, P, B, 3), from its base, in m
    hangs: bool  # whether z points down

    @property
    def middle(self) -> int:
        """Index of the point nearest to the middle of the arm."""
        return int(np.argmin(np.abs(self.at - self.length / 2)))


@dataclass(frozen=True, eq=False)
class TipMap:
    """Stiffness of the tip over the pressures of two channels."""

    robot: str  # name
    channels: tuple[int, int]  # the two, counted from 1
    # first, second: their pressures (A,) and (B,), in Pa
    first: Array
    second: Array
    others: Array  # pressures (n,) of the other channels, in Pa
    directions: Array  # unit vectors (d, 3)
    # boundary, frame: of the stiffness
    boundary: str
    frame: str
    stiffness: Array  # (A, B, d), in N/m; NaN where the arm has no equilibrium


def first_channels(robot: Manipulator, count: int) -> tuple[int, ...]:
    """Return the first `count` channels of each segment, counted from 1."""
    return tuple(k + 1 for own in robot.description.channel_ranges for k in own[:count])


def map_arm(
    robot: Manipulator,
    groups: Sequence[Sequence[int]] | None = None,
    pressures: ArrayLike | None = None,
    *,
    points: int = 25,
    directions: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    boundary: Boundary = "free",
    frame: Frame = "base",
    progress: Progress = lambda done, total: None,
) -> ArmMap:
    """Map the stiffness along an arm.

    Raises `InputError`: the robot lacks a channel, or does not allow a pressure;
    `EquilibriumError`: the arm has no stable equilibrium at one of the pressures.

    Parameters
    ----------
    groups : groups of channels (from 1) that are pressurised together; by default the first channel
        of each segment, and the first two of each segment.
    pressures : (P,), of the group's channels, in Pa; by default seven up to the highest that all
        channels allow.
    points : number of points along the arm; the middle and the tip are among them.
    directions : (d, 3)
    boundary, frame : of the stiffness; see `Manipulator.stiffness`.
    progress : called with the number of points done and the total.
    """
    points = checked_integer("points, the number of points along the arm,", points, 2)
    if groups is None:
        groups = list(dict.fromkeys(first_channels(robot, count) for count in (1, 2)))
    chosen = tuple(_checked_channels(robot, group) for group in groups)
    if pressures is None:
        top = float(robot.pressure_max.min())
        pressures = np.linspace(max(0.0, float(robot.pressure_min.max())), top, 7)
    levels = np.atleast_1d(np.asarray(pressures, dtype=float))
    for group in chosen:
        for level in levels:
            _check_level(robot, group, float(level))
    batch = np.concatenate([_pressurised(robot, group, levels) for group in chosen])
    table = np.atleast_2d(np.asarray(directions, dtype=float))
    at = _stations(robot.length, points)
    found, positions = [], []
    for done, station in enumerate(at):
        progress(done, len(at))
        tip = station == at[-1]
        where = None if tip else float(station)
        found.append(robot.stiffness(batch, table, boundary=boundary, frame=frame, at=where))
        T = robot.tip_pose(batch) if tip else robot.pose(batch, float(station))
        positions.append(T[:, :3, 3])
    progress(len(at), len(at))
    shape = (len(chosen), len(levels))
    return ArmMap(
        robot=robot.description.name,
        length=robot.length,
        groups=chosen,
        pressures=levels,
        at=at,
        directions=table,
        boundary=boundary,
        frame=frame,
        stiffness=np.stack(found, axis=1).reshape(*shape, len(at), len(table)),
        positions=np.stack(positions, axis=1).reshape(*shape, len(at), 3),
        backbones=robot.backbone(batch, 41)[..., :3, 3].reshape(*shape, 41, 3),
        hangs=robot.description.gravity[2] > 0,
    )


def map_tip(
    robot: Manipulator,
    channels: Sequence[int],
    *,
    levels: int = 31,
    others: ArrayLike | None = None,
    directions: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    boundary: Boundary = "free",
    frame: Frame = "base",
    progress: Progress = lambda done, total: None,
) -> TipMap:
    """Map the stiffness of the tip over the pressures of two channels.

    Raises `InputError`: these are not two channels of the robot; `EquilibriumError`: the arm has no
    stable equilibrium at one of the pressures.

    Parameters
    ----------
    channels : the two, counted from 1.
    levels : number of pressures of each, from its lowest to its highest.
    others : (n,), pressures of the other channels, in Pa; by default their lowest.
    directions, boundary, frame, progress : see `map_arm`.
    """
    levels = checked_integer("levels, the number of pressures of a channel,", levels, 2)
    pair = _checked_channels(robot, channels)
    if len(pair) != 2:
        raise InputError(f"expected two different channels, not {len(pair)}")
    rest = np.maximum(robot.pressure_min, 0.0) if others is None else np.array(others, dtype=float)
    if rest.shape != (robot.n_pressures,):
        raise InputError(f"expected {robot.n_pressures} pressures of the other channels")
    first, second = (
        np.linspace(robot.pressure_min[c - 1], robot.pressure_max[c - 1], levels) for c in pair
    )
    table = np.atleast_2d(np.asarray(directions, dtype=float))
    rows = []
    for done, p in enumerate(first):
        progress(done, levels)
        batch = np.tile(rest, (levels, 1))
        batch[:, pair[0] - 1], batch[:, pair[1] - 1] = p, second
        rows.append(robot.stiffness(batch, table, boundary=boundary, frame=frame))
    progress(levels, levels)
    return TipMap(
        robot=robot.description.name,
        channels=(pair[0], pair[1]),
        first=first,
        second=second,
        others=rest,
        directions=table,
        boundary=boundary,
        frame=frame,
        stiffness=np.stack(rows),
    )


def _stations(length: float, points: int) -> Array:
    """Return arc lengths from near the base to the tip; the middle is among them."""
    lower = max(2, round(points * (0.5 - NEAREST_BASE) / (1 - NEAREST_BASE)) + 1)
    first = np.linspace(NEAREST_BASE * length, 0.5 * length, min(lower, points))
    return np.concatenate(
        [first, np.linspace(0.5 * length, length, max(points - lower, 1) + 1)[1:]]
    )


def _pressurised(robot: Manipulator, group: Sequence[int], levels: Array) -> Array:
    batch = np.tile(np.maximum(robot.pressure_min, 0.0), (len(levels), 1))
    batch[:, [channel - 1 for channel in group]] = levels[:, np.newaxis]
    return batch


def _checked_channels(robot: Manipulator, channels: Sequence[int]) -> tuple[int, ...]:
    for channel in channels:
        if not 1 <= channel <= robot.n_pressures:
            raise InputError(
                f"there is no channel {channel}; {robot.description.name} has the channels 1 to "
                f"{robot.n_pressures}"
            )
    if not channels:
        raise InputError("expected at least one channel")
    return tuple(dict.fromkeys(int(channel) for channel in channels))


def _check_level(robot: Manipulator, group: Sequence[int], level: float) -> None:
    for channel in group:
        low, high = robot.pressure_min[channel - 1], robot.pressure_max[channel - 1]
        if not low <= level <= high * (1 + 1e-9):
            raise InputError(
                f"channel {channel} cannot have {level * 1e-5:g} bar; its limits are "
                f"{low * 1e-5:g} to {high * 1e-5:g} bar"
            )
