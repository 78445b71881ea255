"""An experiment of given poses: each is held, in the order of a file, and the tip is recorded.

`stiffopt.identify.suggestion` writes such files.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from stiffopt.errors import InputError
from stiffopt.experiments.conductor import CONDUCTOR, Conductor, at_rest
from stiffopt.experiments.coverage import Coverage
from stiffopt.experiments.folder import ExperimentSettings, Progress
from stiffopt.experiments.kinematics import SETTLE, missing_rounds
from stiffopt.files import read_file, save_file
from stiffopt.rig.interface import Rig
from stiffopt.safety.gate import effective_slew
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Pressure

_HOLD = 10.0  # s
_Rows = Annotated[
    Items[Annotated[Items[Pressure], Field(min_length=1)]], Field(min_length=1, max_length=1000)
]


class PosesFile(Schema):
    """Poses to be held on a rig.

    Attributes
    ----------
    rig : path of its rig file, relative to this file.
    pressures : of all channels, a row for each pose, in the order in which they are held.
    hold : how long each pose is held.
    """

    rig: Annotated[str, Field(min_length=1)]
    pressures: _Rows
    hold: Annotated[Duration, Field(gt=0, le=3600)] = _HOLD

    @model_validator(mode="after")
    def _check(self) -> PosesFile:
        for index, row in enumerate(self.pressures):
            if len(row) != len(self.pressures[0]):
                raise BadKeyError(
                    f"pressures.{index}",
                    f"has {len(row)} values; expected {len(self.pressures[0])}, as the first row",
                )
        return self


class PosesSettings(ExperimentSettings):
    """Settings of an experiment of given poses, as its folder keeps them.

    Attributes
    ----------
    experiment : its kind.
    pressures, hold : as in `PosesFile`, in Pa and s.
    """

    experiment: Literal["poses"] = "poses"
    pressures: _Rows
    hold: Annotated[Duration, Field(gt=0, le=3600)] = _HOLD

    @property
    def poses(self) -> int:
        """Number of poses."""
        return len(self.pressures)


def load_poses(path: str | os.PathLike[str]) -> PosesFile:
    """Read a file of poses (``stiffopt-experiment/1``).

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    """
    return read_file(path, "experiment", PosesFile)


def save_poses(path: str | os.PathLike[str], rig: str, pressures: ArrayLike) -> None:
    """Write a file of poses (N, n), in Pa, for a rig file."""
    folder = Path(path).resolve().parent
    rows = tuple(map(tuple, np.asarray(pressures, dtype=float).tolist()))
    relative = os.path.relpath(Path(rig).resolve(), folder)
    save_file(path, "experiment", PosesFile(rig=relative, pressures=rows))


def poses_for(rig: Rig, settings: PosesSettings) -> Coverage:
    """Return the poses on a rig; `InputError` if one is beyond its limits."""
    limits = rig.supply.limits
    poses = np.array(settings.pressures)
    for number, pose in enumerate(poses, start=1):
        if len(pose) != limits.n:
            raise InputError(
                f"the poses have {len(pose)} pressures; expected {limits.n}, one for each channel "
                "of the rig"
            )
        for channel in np.flatnonzero((pose < limits.low) | (pose > limits.high)):
            raise InputError(
                f"pose {number}: channel {channel + 1} has {limits.low[channel] * 1e-5:g} to "
                f"{limits.high[channel] * 1e-5:g} bar; expected no {pose[channel] * 1e-5:g} bar"
            )
        if rig.max_force is not None and rig.force(pose) > rig.max_force:
            raise InputError(
                f"pose {number} would push with {rig.force(pose):.3g} N; safety.max_force of the "
                f"rig is {rig.max_force:g} N"
            )
    return Coverage(
        base=limits.clamp(np.clip(0.0, limits.low, limits.high)),
        poses=poses,
        speed=np.minimum(effective_slew(rig), CONDUCTOR.gentle),
        settle=settings.hold,
        held=True,
    )


def run_poses(
    rig: Rig,
    folder: Path,
    settings: PosesSettings,
    *,
    rate: float,
    progress: Progress = lambda done, total, text: None,
    check: Callable[[], None] = lambda: None,
) -> list[str]:
    """Record the rounds of poses that are missing in a folder.

    Arguments, errors and files are those of `stiffopt.experiments.kinematics.run_kinematics`, for
    its combined poses.
    """
    coverage = poses_for(rig, settings)
    todo = missing_rounds(folder, settings)
    conductor = Conductor(rig, rate, check)
    total, done, notes = sum(map(coverage.duration, todo)), 0.0, list[str]()
    if todo:
        conductor.start()
    for number in todo:

        def tell(seconds: float, text: str, before: float = done) -> None:
            progress(before + seconds, total, text)

        conductor.ramp(coverage.base)
        if not conductor.settle(coverage.base, at_rest, SETTLE):
            notes.append(f"before round {number} the arm was not at rest within {SETTLE:g} s")
        about = {"experiment": "poses", "poses": str(number), "rig": settings.rig}
        coverage.record(conductor, folder, number, about, tell)
        done += coverage.duration(number)
    return notes
