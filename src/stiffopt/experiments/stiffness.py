"""Experiment 2 of the paper: a probe displaces the tip at several pressures of one channel.

At each pressure the arm settles. Then, for each direction, the probe is aligned, touches the tip
and displaces it in steps, there and back; at each step it waits until the force is constant. The
whole is repeated. The stiffness is the slope of force over displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.directions import Direction, direction_name
from stiffopt.errors import InputError
from stiffopt.experiments.conductor import Conductor, at_rest, check_pressures
from stiffopt.experiments.folder import ExperimentSettings, Progress, RawRecording
from stiffopt.experiments.probing import PointsFile, Probing, Series, SeriesKey
from stiffopt.model.manipulator import Manipulator
from stiffopt.rig.interface import Rig
from stiffopt.schema import Items
from stiffopt.units import Duration, Force, Length, Pressure

HARD_STOP = 5.0
"""Multiple of `StiffnessSettings.force` at which a series ends."""
_REST_WINDOW = 4.0  # s for which the tip must be at rest before a series


class StiffnessSettings(ExperimentSettings):
    """Settings of the stiffness experiment.

    Attributes
    ----------
    experiment : its kind.
    channel : the channel to pressurise, counted from 1.
    pressures : of that channel, in Pa.
    directions : unit vectors along which the probe pushes, in the base frame.
    displacement : travel of the stage beyond the first contact, in m.
    force : in N; the displacement is reduced if the model predicts a larger force.
    steps : number of steps of a series, each way.
    settle : time that the arm may take to come to rest, in s.
    reach : travel within which the stage searches for the tip, in m.
    """

    experiment: Literal["stiffness"] = "stiffness"
    channel: Annotated[int, Field(ge=1)] = 1
    pressures: Annotated[Items[Pressure], Field(min_length=1)] = (
        0.0,
        0.25e5,
        0.5e5,
        0.75e5,
        1.0e5,
        1.25e5,
        1.5e5,
    )
    directions: Annotated[Items[Direction], Field(min_length=1)] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, -1.0),
    )
    displacement: Annotated[Length, Field(gt=0, le=0.1)] = 0.003
    force: Annotated[Force, Field(gt=0)] = 0.2
    steps: Annotated[int, Field(ge=2, le=1000)] = 5
    settle: Annotated[Duration, Field(gt=0)] = 60.0
    reach: Annotated[Length, Field(gt=0, le=0.1)] = 0.01

    def pressures_at(self, pressure: float) -> Array:
        """Return the pressures (n,) with `pressure` in the one channel and 0 in all others."""
        p = np.zeros(self.channels)
        p[self.channel - 1] = pressure
        return p


def check_stiffness(rig: Rig, settings: StiffnessSettings) -> None:
    """Raise `InputError` if the rig cannot do the experiment."""
    if rig.probe is None:
        raise InputError("this rig has no probe; the stiffness experiment needs one")
    if rig.tracker is None:
        raise InputError("this rig has no tracker; the stiffness experiment needs one")
    if settings.channel > rig.supply.n:
        raise InputError(
            f"there is no channel {settings.channel}; this rig has {rig.supply.n} channels"
        )
    check_pressures(rig, settings.pressures, [settings.channel - 1])


def all_series(settings: StiffnessSettings) -> list[SeriesKey]:
    """Return every series, in the order in which they are done."""
    return [
        SeriesKey(repetition, pressure, direction)
        for repetition in range(1, settings.repetitions + 1)
        for pressure in settings.pressures
        for direction in settings.directions
    ]


def missing_series(folder: Path, settings: StiffnessSettings) -> list[SeriesKey]:
    """Return the series that are missing in a folder."""
    done = {_rounded(series.key) for series in PointsFile(folder, settings.channels).read()}
    return [key for key in all_series(settings) if _rounded(key) not in done]


def run_stiffness(
    rig: Rig,
    folder: Path,
    settings: StiffnessSettings,
    model: Manipulator,
    *,
    rate: float,
    progress: Progress = lambda done, total, text: None,
    check: Callable[[], None] = lambda: None,
    aside: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> list[str]:
    """Do the series of the experiment that are missing in a folder.

    Returns notes for the user.

    Parameters
    ----------
    rig : open, with a tracker and a probe.
    folder : gets ``points.csv``, with the steps of all series, and a recording of each repetition,
        as ``stiffness_1.csv`` (log v1) and ``stiffness_1.mcap``.
    model : only limits the size of the steps; the data are independent of it.
    rate : rate of the commands, in Hz.
    progress : called with the number of series done, the total and a description.
    check : called often; it may raise to stop.
    aside : returns the context in which the probe is aligned, perhaps by a person.

    Raises
    ------
    InputError
        The rig cannot do the experiment; nothing has moved.
    DeviceError
        A device fails, or the probe does not find the tip; what was measured is kept.
    """
    check_stiffness(rig, settings)
    todo = missing_series(folder, settings)
    if not todo:
        return []
    run = _StiffnessRun(folder, settings, model, Conductor(rig, rate, check), aside)
    total = len(all_series(settings))
    for number, key in enumerate(todo, start=total - len(todo)):
        text = (
            f"repetition {key.repetition} of {settings.repetitions}, "
            f"{key.pressure * 1e-5:g} bar, {direction_name(key.direction)}"
        )
        progress(number, total, text)
        try:
            run.do(key)
        except BaseException:
            run.finish()
            raise
    run.wind_down()
    progress(total, total, "done")
    return run.notes()


class _StiffnessRun:
    """A run of the experiment, with its state between two series."""

    def __init__(
        self,
        folder: Path,
        settings: StiffnessSettings,
        model: Manipulator,
        conductor: Conductor,
        aside: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._folder, self._settings, self._model = folder, settings, model
        self._aside = aside
        self._conductor = conductor
        self._probing = Probing(conductor)
        self._points = PointsFile(folder, settings.channels)
        self._raw: RawRecording | None = None
        self._at: tuple[int, float] | None = None
        self._restless = self._unsettled = self._done = 0
        conductor.start()

    def do(self, key: SeriesKey) -> None:
        """Do one series and store its points."""
        settings, conductor = self._settings, self._conductor
        p = settings.pressures_at(key.pressure)
        if self._raw is None or self._raw.repetition != key.repetition:
            self.finish()
            self._raw = RawRecording(self._folder, key.repetition, conductor, settings.rig)
        before, self._at = self._at, (key.repetition, key.pressure)
        if before is not None and before != self._at:
            self._withdraw()  # the arm is about to move
        if before is None or before[0] != key.repetition:
            conductor.ramp(np.zeros(settings.channels))  # repetitions start from zero pressure
            self._rest(np.zeros(settings.channels))
        self._rest(p)
        self._by_hand(partial(self._probing.probe.align, key.direction))
        at_rest_then = self._rest(p)  # aligning may have taken long, or moved the arm
        points = self._probing.run(p, self._planned(p, key))
        self._restless += not at_rest_then
        self._unsettled += sum(not point.settled for point in points)
        self._done += 1
        self._points.append(key, points)

    def _withdraw(self) -> None:
        self._by_hand(self._probing.probe.withdraw)

    def _by_hand(self, task: Callable[[], None]) -> None:
        """Run a task of the probe for which a person may be needed."""
        with self._aside():
            if self._probing.probe.needs_a_person:
                self._conductor.meanwhile(task)
            else:
                task()

    def wind_down(self) -> None:
        """Withdraw the probe, let the pressure down, close the recording."""
        try:
            self._withdraw()
            self._conductor.ramp(np.zeros(self._settings.channels))
        finally:
            self.finish()

    def _rest(self, p: Array) -> bool:
        self._conductor.ramp(p)
        still = partial(at_rest, window=_REST_WINDOW)  # or creeps too slowly to matter
        return self._conductor.settle(p, still, self._settings.settle)

    def _planned(self, p: Array, key: SeriesKey) -> Series:
        """Return a series in which the model predicts at most `StiffnessSettings.force`."""
        settings = self._settings
        expected = float(self._model.stiffness(p, key.direction))
        return Series(
            direction=np.array(key.direction),
            displacement=min(settings.displacement, settings.force / max(expected, 1e-9)),
            steps=settings.steps,
            reach=settings.reach,
            max_force=HARD_STOP * settings.force,
        )

    def notes(self) -> list[str]:
        """Return notes for the user."""
        found = []
        if self._restless:
            found.append(
                f"the arm still crept after {self._settings.settle:g} s before {self._restless} of "
                f"{self._done} series; a longer --settle may help"
            )
        if self._unsettled:
            found.append(f"the force had not come to rest at {self._unsettled} points")
        return found

    def finish(self) -> None:
        """Close the recording."""
        if self._raw is not None:
            self._raw.close()
            self._raw = None


def _rounded(key: SeriesKey) -> tuple[int, float, tuple[float, ...]]:
    """Return the key of a series rounded as in the file."""
    direction = tuple(round(component, 6) + 0.0 for component in key.direction)
    return key.repetition, round(key.pressure, 1), direction
