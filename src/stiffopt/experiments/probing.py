"""One series of the stiffness experiment: the probe touches the tip and displaces it in steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.errors import DeviceError, InputError
from stiffopt.experiments.conductor import Array, Conductor, Row, split_window
from stiffopt.rig.interface import ForceProbe

__all__ = ["Point", "Probing", "Series"]

SPEED = 0.002  # m/s of the stage
_PIECE = 0.1  # s that one movement takes at most: the supply is spoken to in between
_APPROACH = 1e-4  # m by which the stage looks for the tip
_TARE = 1.0  # s for which the force is read before there is contact
_STEP_WINDOW = 1.0  # s over which a force must not change; its second half is what is sampled
_STEP_CHANGE = 0.01  # by which it may change nevertheless
_STEP_TIMEOUT = 6.0  # s
_TOUCH = 5.0  # noise levels that are contact
_LEAST_TOUCH = 1e-3  # N


@dataclass(frozen=True)
class Series:
    """What one series shall do.

    Attributes
    ----------
    direction : unit vector (3,) in the base frame, along which the probe pushes.
    displacement : by which the stage goes beyond the first contact, and back, in m.
    steps : in which it does so, each way.
    reach : how far the stage looks for the tip, in m.
    most_force : at which the series ends, in N.
    """

    direction: Array
    displacement: float
    steps: int
    reach: float
    most_force: float


@dataclass(frozen=True)
class Point:
    """One step: means over a time in which the force did not change.

    Attributes
    ----------
    time : of its middle, on the rig's clock, in s.
    force : with which the probe pushes, less what it felt without contact, in N.
    displacement : of the tip along the direction, from where it was free, in m.
    stage : beyond the first contact, in m.
    position : of the tip (3,), in m.
    measured : pressures (n,), in Pa.
    touching : whether the force is more than noise.
    settled : whether the force had come to rest.
    """

    time: float
    force: float
    displacement: float
    stage: float
    position: Array
    measured: Array
    touching: bool
    settled: bool


class Probing:
    """Does series with the probe of a rig while pressures are held.

    Parameters
    ----------
    conductor : Conductor
        Of a rig that has a probe.
    """

    def __init__(self, conductor: Conductor) -> None:
        if conductor.rig.probe is None:
            raise InputError("this rig has no probe; the stiffness experiment needs one")
        self._conductor = conductor
        self.probe: ForceProbe = conductor.rig.probe
        self._at = 0.0

    def run(self, pressures: Array, series: Series) -> list[Point]:
        """Touch, displace in steps, go back in the same, retreat; pressures (n,) are held.

        There and back, so that the creep of the arm, which goes on all the time, can be told from
        the effect of the displacement.

        Raises
        ------
        DeviceError
            The probe meets nothing, or a device fails.
        """
        self._conductor.probing = True
        try:
            return self._pushed(pressures, series)
        except BaseException:
            self.probe.stop()
            raise
        finally:
            self._conductor.probing = False

    def _pushed(self, pressures: Array, series: Series) -> list[Point]:
        self._at = self.probe.sample().position
        free = self._tared(pressures)
        points: list[Point] = []
        contact = self._touch(pressures, series, free)
        places = [contact + series.displacement * k / series.steps for k in range(series.steps + 1)]
        reached = 0
        for place in places:
            if not self._move(pressures, place, free.force + series.most_force):
                break
            points.append(self._point(pressures, series, free, contact))
            reached += 1
        for place in reversed(places[: max(reached - 1, 0)]):
            self._move(pressures, place, np.inf)
            points.append(self._point(pressures, series, free, contact))
        self._move(pressures, 0.0, np.inf)
        return points

    def _tared(self, pressures: Array) -> _Free:
        """What is felt and seen without contact."""
        begin = self._conductor.clock.now()
        self._conductor.settle(pressures, lambda rows: False, _TARE)
        rows = [row for row in self._conductor.since(begin) if np.isfinite(row.force)]
        seen = [row.position for row in rows if row.visible]
        if len(rows) < 3 or not seen:
            raise DeviceError("the tracker did not see the tip while the probe was zeroed")
        forces = np.array([row.force for row in rows])
        noise = float(forces.std(ddof=1))
        return _Free(float(forces.mean()), noise, np.mean(seen, axis=0))

    def _touch(self, pressures: Array, series: Series, free: _Free) -> float:
        """Go ahead until a force is felt; return where."""
        begin = self._at
        least = max(_TOUCH * free.noise, _LEAST_TOUCH)
        step = min(_APPROACH, series.displacement / 4)
        while self._at - begin < series.reach:
            self._move(pressures, self._at + step, free.force + series.most_force)
            if self._felt() - free.force > least and self._felt() - free.force > least:
                return self._at
        raise DeviceError(
            f"the probe has met nothing within {series.reach * 1e3:g} mm; is it aligned with the "
            "tip, is its force read with the right sign?"
        )

    def _felt(self) -> float:
        force = self.probe.sample().force
        if not np.isfinite(force):
            raise DeviceError("the force of the probe cannot be read")
        return force

    def _point(self, pressures: Array, series: Series, free: _Free, contact: float) -> Point:
        conductor = self._conductor
        begin = conductor.clock.now()

        def steady(rows: Sequence[Row]) -> bool:
            halves = split_window(rows, _STEP_WINDOW, 2)
            if halves is None:
                return False
            first, second = (np.mean([row.force for row in half]) for half in halves)
            slack = 4 * free.noise / np.sqrt(min(map(len, halves)))
            return bool(abs(second - first) <= max(_STEP_CHANGE * abs(second - free.force), slack))

        settled = conductor.settle(pressures, steady, _STEP_TIMEOUT)
        rows = conductor.since(begin)
        last = [row for row in rows if row.time > rows[-1].time - _STEP_WINDOW / 2]
        seen = [row for row in last if row.visible]
        if not seen:
            raise DeviceError("the tracker did not see the tip at a step of the probe")
        force = float(np.mean([row.force for row in last])) - free.force
        position = np.mean([row.position for row in seen], axis=0)
        return Point(
            time=float(np.mean([row.time for row in last])),
            force=force,
            displacement=float((position - free.position) @ series.direction),
            stage=float(np.mean([row.stage for row in last])) - contact,
            position=position,
            measured=np.mean([row.measured for row in last], axis=0),
            touching=force > max(_TOUCH * free.noise / np.sqrt(len(last)), _LEAST_TOUCH / 2),
            settled=settled,
        )

    def _move(self, pressures: Array, place: float, most_force: float) -> bool:
        """Move in short pieces; say whether the place was reached before the force was."""
        while self._at != place:
            far = SPEED * _PIECE
            self._at += float(np.clip(place - self._at, -far, far))
            if abs(self._at - place) < 1e-9:
                self._at = place
            self.probe.move_to(self._at, SPEED)
            self._conductor.tick(pressures)
            if self._felt() > most_force:
                return False
        return True


@dataclass(frozen=True)
class _Free:
    """Force without contact, its noise, and where the tip is then."""

    force: float
    noise: float
    position: Array
