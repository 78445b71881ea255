"""Combined poses: all channels pressurised at once, spread evenly over the rig's limits.

The paper's sequence moves one channel at a time. It shows neither how channels act together nor
what happens above its peaks, so that a model fitted to it alone would have to extrapolate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.experiments.conductor import CONDUCTOR, Conductor, at_rest
from stiffopt.experiments.folder import recorded
from stiffopt.rig.interface import Rig
from stiffopt.safety.gate import effective_slew

ROUND = 6
"""Largest number of poses in a round, after which the arm returns to the base pressures."""
_BEFORE = 3.0  # s that the arm usually takes to come to rest before a round
_SKIPPED = 12  # first Halton points, which are correlated in large bases


def spread_pressures(count: int, low: ArrayLike, high: ArrayLike) -> Array:
    """Return pressures (count, n) that fill a box evenly, in Pa.

    In each channel the pressures are equally spaced from one end to the other, ordered like a
    Halton sequence: any number of poses reaches both ends, and combines the channels evenly. From
    one pose to the next, about half of the channels rise and half fall. The result is
    deterministic.

    `count`: number of poses. `low`, `high`: (n,), ends of each channel's range, in Pa.
    """
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    if count == 1:
        return high[np.newaxis]
    from scipy.stats.qmc import Halton

    sequence = Halton(len(low), scramble=False).fast_forward(_SKIPPED + 1).random(count)
    numbers = np.arange(_SKIPPED + 1, _SKIPPED + 1 + count)
    share = np.argsort(np.argsort(sequence, axis=0), axis=0) / max(count - 1, 1)
    mixed = np.argsort(numbers**2 * np.sqrt(2.0) % 1.0)  # the sequence rises in steps
    return np.asarray(np.clip(low + share[mixed] * (high - low), low, high))


@dataclass(frozen=True, eq=False)
class Coverage:
    """Combined poses within the limits of a rig."""

    base: Array  # pressures (n,) between rounds, in Pa: the allowed ones nearest to 0
    poses: Array  # pressures (N, n), in Pa
    speed: Array  # rates (n,) at which pressures change, in Pa/s
    settle: float  # time that the arm may take to come to rest in a pose, in s

    @property
    def rounds(self) -> list[Array]:
        """The poses (m, n) of each round, about equally many; rounds begin and end at `base`."""
        count = round_count(len(self.poses))
        return np.array_split(self.poses, count) if count else []

    def duration(self, number: int) -> float:
        """Return the longest duration of a round, counted from 1, in s."""
        return _BEFORE + sum(self._durations(self.rounds[number - 1]))

    def _durations(self, poses: Array) -> list[float]:
        """Return the longest durations, in s, of moving to each pose and settling there."""
        knots = np.vstack([self.base, poses, self.base])
        ways = np.abs(np.diff(knots, axis=0)) / self.speed
        return [float(way) + self.settle for way in ways.max(axis=1)]

    def record(
        self,
        conductor: Conductor,
        folder: Path,
        number: int,
        about: dict[str, str],
        report: Callable[[float, str], None],
    ) -> int:
        """Record a round, from `base` through its poses and back.

        Returns the number of poses in which the arm did not settle in time.

        Parameters
        ----------
        conductor : has seen the tip; the arm is at `base`.
        folder, about : as for `recorded`; the files are named by `round_name`.
        number : of the round, from 1.
        report : called with the seconds done and a description.
        """
        poses, before = self.rounds[number - 1], sum(map(len, self.rounds[: number - 1]))
        durations = self._durations(poses)
        restless = 0
        with recorded(conductor, folder, round_name(number), about):
            for index, pose in enumerate([*poses, self.base]):
                count = min(before + index + 1, before + len(poses))
                report(
                    _BEFORE + sum(durations[:index]),
                    f"combined pose {count} of {len(self.poses)}",
                )
                conductor.ramp(pose)
                rested = conductor.settle(pose, at_rest, self.settle)
                restless += not rested and index < len(poses)
        return restless


def coverage_for(rig: Rig, count: int, settle: float, highest: float | None = None) -> Coverage:
    """Return combined poses that cover the limits of a rig, with time in s to settle in each.

    No channel exceeds the `highest` pressure, in Pa; `InputError` if that is below its limits.
    """
    limits = rig.supply.limits
    high = limits.high if highest is None else np.minimum(limits.high, highest)
    for channel in np.flatnonzero(high < limits.low):
        raise InputError(
            f"combined poses of at most {high[channel] * 1e-5:g} bar: channel {channel + 1} has "
            f"{limits.low[channel] * 1e-5:g} to {limits.high[channel] * 1e-5:g} bar"
        )
    poses = spread_pressures(count, limits.low, high)
    return Coverage(
        base=np.clip(0.0, limits.low, limits.high),
        poses=np.array([_shortened(rig, pose) for pose in poses]).reshape(poses.shape),
        speed=np.minimum(effective_slew(rig), CONDUCTOR.gentle),
        settle=settle,
    )


def _shortened(rig: Rig, pose: Array) -> Array:
    """Scale pressures (n,) down to the total force that the rig allows, if it is exceeded."""
    force = rig.force(pose)
    if rig.max_force is None or force <= rig.max_force:
        return pose
    shortened = pose * (rig.max_force / force)
    if (shortened < rig.supply.limits.low).any():
        raise InputError(
            f"combined poses: safety.max_force, {rig.max_force:g} N, leaves no pressures within "
            "the limits of the channels; ask for no combined poses (--poses 0)"
        )
    return shortened


def round_count(poses: int) -> int:
    """Return the number of rounds for a number of poses."""
    return -(-poses // ROUND)


def round_name(number: int) -> str:
    """Return the name of a round's recording, without ending; rounds count from 1.

    Sorted by name, rounds follow the paper's sequence, up to the ninth in the order of recording.
    """
    return f"kinematics_poses_{number}"
