"""Experiment 1 of the paper: record the tip while each channel in turn is ramped up and down.

The pressure sequence is that of figure 5a: for each pair of chambers in turn, three sawteeth to
0.4, 0.8 and 1.0 bar, nine teeth in 40 s for one segment. The arm is at rest before each repetition.
Combined poses (`stiffopt.experiments.coverage`), which are not in the paper, follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.errors import FileError
from stiffopt.experiments.conductor import Conductor, at_rest, check_pressures
from stiffopt.experiments.coverage import coverage_for, round_count, round_name
from stiffopt.experiments.folder import ExperimentSettings, Progress, recorded
from stiffopt.logs import read_log
from stiffopt.rig.interface import Rig
from stiffopt.safety.gate import effective_slew
from stiffopt.schema import Items
from stiffopt.units import Duration, Pressure

SETTLE = 20.0
"""Time, in s, that the arm may take to come to rest before a repetition."""
_TAIL = 1.0  # s, longest delay of the last frames
_AFTER = 0.2  # s recorded after the last tooth


class KinematicsSettings(ExperimentSettings):
    """Settings of the kinematics experiment.

    Attributes
    ----------
    experiment : its kind.
    pressures : peaks of the teeth of each channel, in Pa.
    period : duration of a tooth, up and down, in s.
    poses : number of combined poses that follow; 0 for the paper's sequence alone.
    settle : time that the arm may take to come to rest in each of these, in s.
    max : highest pressure of a channel in these, in Pa, besides the rig's limits.
    """

    experiment: Literal["kinematics"] = "kinematics"
    pressures: Annotated[Items[Annotated[Pressure, Field(gt=0)]], Field(min_length=1)] = (
        0.4e5,
        0.8e5,
        1.0e5,
    )
    period: Annotated[Duration, Field(gt=0)] = 40.0 / 9.0
    poses: Annotated[int, Field(ge=0, le=1000)] = 24
    settle: Annotated[Duration, Field(gt=0)] = 7.0
    max: Annotated[Pressure, Field(gt=0)] | None = None


@dataclass(frozen=True, eq=False)
class PressureSequence:
    """Pressures that change linearly between given times.

    `times`: (K,), in s, increasing from 0. `pressures`: (K, n), in Pa.
    """

    times: Array
    pressures: Array

    @classmethod
    def sawtooth(
        cls, base: ArrayLike, peaks: Sequence[float], period: float, slew: ArrayLike
    ) -> PressureSequence:
        """Return the teeth of each channel in turn.

        Parameters
        ----------
        base : (n,), pressures between the teeth, in Pa.
        peaks : of the teeth of each channel, in Pa.
        period : of a tooth, in s; a tooth takes longer if the channel is too slow.
        slew : (n,), largest rate of change, in Pa/s.
        """
        base = np.asarray(base, dtype=float)
        slew = np.broadcast_to(np.asarray(slew, dtype=float), base.shape)
        times, knots = [0.0], [base]
        for channel in range(len(base)):
            for peak in peaks:
                half = max(period / 2, abs(peak - base[channel]) / slew[channel])
                top = base.copy()
                top[channel] = peak
                times += [times[-1] + half, times[-1] + 2 * half]
                knots += [top, base]
        return cls(np.array(times), np.array(knots))

    @property
    def duration(self) -> float:
        """In s."""
        return float(self.times[-1])

    def at(self, times: ArrayLike) -> Array:
        """Return pressures (n,) at a time or (N, n) at times (N,), in Pa; constant past ends."""
        t = np.asarray(times, dtype=float)
        columns = [np.interp(t, self.times, column) for column in self.pressures.T]
        return np.stack(columns, axis=-1)


def sequence_for(rig: Rig, settings: KinematicsSettings) -> PressureSequence:
    """Return the sequence for a rig; `InputError` if a pressure is beyond its limits."""
    limits = rig.supply.limits
    check_pressures(rig, settings.pressures, range(limits.n))
    base = np.clip(0.0, limits.low, limits.high)
    return PressureSequence.sawtooth(base, settings.pressures, settings.period, effective_slew(rig))


def recording_name(repetition: int) -> str:
    """Return the name of a recording, without ending; repetitions count from 1."""
    return f"kinematics_{repetition}"


def missing_repetitions(folder: Path, settings: KinematicsSettings) -> list[int]:
    """Return the repetitions, counted from 1, that are missing in a folder."""
    numbers = range(1, settings.repetitions + 1)
    return [k for k in numbers if not _is_whole(folder, recording_name(k))]


def missing_rounds(folder: Path, settings: KinematicsSettings) -> list[int]:
    """Return the rounds of combined poses, counted from 1, that are missing in a folder."""
    numbers = range(1, round_count(settings.poses) + 1)
    return [k for k in numbers if not _is_whole(folder, round_name(k))]


def _is_whole(folder: Path, name: str) -> bool:
    """Return whether both files of a recording exist and the table can be read."""
    try:
        return (folder / f"{name}.mcap").exists() and len(read_log(folder / f"{name}.csv").time) > 1
    except FileError:  # damaged or absent
        return False


def run_kinematics(
    rig: Rig,
    folder: Path,
    settings: KinematicsSettings,
    *,
    rate: float,
    progress: Progress = lambda done, total, text: None,
    check: Callable[[], None] = lambda: None,
) -> list[str]:
    """Record the repetitions and the rounds of combined poses that are missing in a folder.

    Returns notes for the user.

    Parameters
    ----------
    rig : open.
    folder : gets ``kinematics_1.csv`` (log v1), ``kinematics_1.mcap`` and so on, and then
        ``kinematics_poses_1.csv`` and so on; an incomplete one is named ``kinematics_1.part.csv``.
    rate : rate of the commands, in Hz.
    progress : called with the seconds done, the total and a description.
    check : called often; it may raise to stop.

    Raises
    ------
    InputError
        A pressure is beyond the limits; nothing has moved.
    DeviceError
        A device fails; what was recorded is kept.
    """
    sequence = sequence_for(rig, settings)
    coverage = coverage_for(rig, settings.poses, settings.settle, settings.max)
    conductor = Conductor(rig, rate, check)
    todo, rounds = missing_repetitions(folder, settings), missing_rounds(folder, settings)
    total = sequence.duration * len(todo) + sum(map(coverage.duration, rounds))
    notes: list[str] = []
    if todo or rounds:
        conductor.start()

    def rest(base: Array, what: str) -> None:
        conductor.ramp(base)
        if not conductor.settle(base, at_rest, SETTLE):
            notes.append(f"before {what} the arm was not at rest within {SETTLE:g} s")

    done = 0.0

    def report(t: float, text: str) -> None:
        progress(done + t, total, text)

    for repetition in todo:
        text = f"repetition {repetition} of {settings.repetitions}"
        report(0.0, text)
        rest(sequence.at(0.0), f"repetition {repetition}")
        about = {"experiment": "kinematics", "repetition": str(repetition), "rig": settings.rig}
        name = recording_name(repetition)
        _record(conductor, sequence, folder, name, about, partial(report, text=text))
        done += sequence.duration
    restless = 0
    for number in rounds:
        text = f"round {number} of combined poses"
        report(0.0, text)
        rest(coverage.base, text)
        about = {"experiment": "kinematics", "poses": str(number), "rig": settings.rig}
        restless += coverage.record(conductor, folder, number, about, report)
        done += coverage.duration(number)
    if restless:
        notes.append(
            f"in {restless} of {settings.poses} combined poses the tip still moved after "
            f"{settings.settle:g} s: soft arms creep, and 'stiffopt calibrate' fits that. A longer "
            "--settle shows more of it"
        )
    return notes


def _record(
    conductor: Conductor,
    sequence: PressureSequence,
    folder: Path,
    name: str,
    about: dict[str, str],
    report: Callable[[float], None],
) -> None:
    clock = conductor.clock
    end = sequence.duration + _AFTER
    with recorded(conductor, folder, name, about, end) as begin:
        while (t := clock.now() - begin) < end + _TAIL:
            conductor.tick(sequence.at(t))
            report(min(t, sequence.duration))
            if t > end and conductor.rows[-1].time - begin > end:
                break  # all frames have arrived
