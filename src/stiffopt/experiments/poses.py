"""Record the poses of a file one after another: `format: stiffopt-experiment/1`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.experiments.conductor import Conductor, check_pressures
from stiffopt.experiments.folder import Progress, recorded
from stiffopt.files import read_file, save_file
from stiffopt.rig.interface import Rig
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration, Pressure

POSES = "poses"
"""Name of the recording, without ending."""


class PosesFile(Schema):
    """A file of poses.

    Attributes
    ----------
    rig : path of a rig file, relative to this one.
    hold : time for which to hold each pose, in s.
    pressures : of each pose, one value per channel, in Pa.
    """

    rig: Annotated[str, Field(min_length=1)]
    hold: Annotated[Duration, Field(gt=0, le=3600)] = 7.0
    pressures: Annotated[Items[Items[Pressure]], Field(min_length=1)]


def load_poses(path: str | os.PathLike[str]) -> PosesFile:
    """Read a file of poses; raise `FileError` with line and key of the first mistake."""
    return read_file(path, "experiment", PosesFile)


def save_poses(path: str | os.PathLike[str], rig: str, pressures: ArrayLike) -> None:
    """Write a file of poses (N, n), in Pa, for a rig file."""
    rows = tuple(map(tuple, np.asarray(pressures, dtype=float).tolist()))
    relative = os.path.relpath(Path(rig).resolve(), Path(path).resolve().parent)
    save_file(path, "experiment", PosesFile(rig=relative, pressures=rows))


def poses_for(rig: Rig, settings: PosesFile) -> Array:
    """Return the poses (N, n) in Pa; raise `InputError` if the rig does not allow one of them."""
    for number, pose in enumerate(settings.pressures, start=1):
        if len(pose) != rig.supply.n:
            raise InputError(
                f"pose {number} has {len(pose)} pressures; the rig has {rig.supply.n} channels"
            )
        for channel, p in enumerate(pose):
            check_pressures(rig, [p], [channel])
        force = rig.force(np.array(pose))
        if rig.max_force is not None and force > rig.max_force:
            unit = display_units().force
            raise InputError(
                f"pose {number} is {unit.text(force, '.3g')}, above safety.max_force, "
                f"{unit.text(rig.max_force, 'g')}"
            )
    return np.array(settings.pressures, dtype=float)


def run_poses(
    rig: Rig,
    folder: Path,
    settings: PosesFile,
    *,
    rate: float,
    progress: Progress = lambda done, total, text: None,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Move gently from zero pressure through all poses and back, and record ``poses.csv``.

    Parameters
    ----------
    rig : open.
    folder : gets ``poses.csv`` (log v1) and ``poses.mcap``.
    rate : rate of the commands, in Hz.
    progress : called with the number of poses done, the total and a description.
    check : called often; it may raise to stop.

    Raises
    ------
    InputError
        The rig does not allow a pose; nothing has moved.
    DeviceError
        A device fails.
    """
    poses = poses_for(rig, settings)
    limits = rig.supply.limits
    base = np.clip(0.0, limits.low, limits.high)
    conductor = Conductor(rig, rate, check)
    conductor.start()
    conductor.ramp(base)
    with recorded(conductor, folder, POSES, {"experiment": POSES}):
        for number, pose in enumerate([*poses, base]):
            progress(number, len(poses) + 1, f"pose {min(number + 1, len(poses))} of {len(poses)}")
            conductor.ramp(pose)
            conductor.settle(pose, lambda rows: False, settings.hold)
