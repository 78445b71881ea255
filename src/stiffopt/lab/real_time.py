"""The bench of the virtual lab: a simulated world that runs in real time."""

from __future__ import annotations

import threading
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stiffopt.lab.bench import Bench, TrackerFrame
from stiffopt.plant.camera import Frame
from stiffopt.plant.world import World

__all__ = ["RealTimeBench"]

Array = NDArray[np.float64]

_TICK = 0.005  # s, at most, by which the world is behind


class RealTimeBench(Bench):
    """A world in real time, kept going by a thread between `start` and `close`.

    Parameters
    ----------
    world :
        Made for real time.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._mounted_at = 0.0  # where the stage was, on its own scale, when it was mounted
        self._newest: Frame | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """What ended the world, if something did."""

    def start(self) -> None:
        """Let time pass."""
        self._thread = threading.Thread(target=self._keep_going, name="virtual-lab", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; to close twice does nothing."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None

    def _keep_going(self) -> None:
        while not self._stop.wait(_TICK):
            try:
                self.world.catch_up()
            except Exception as error:  # told by whoever waits for the lab
                self.failure = error
                return

    def mount(self, direction: Iterable[float]) -> None:
        """Mount the stage along a unit vector (3,) in the base frame, just clear of the tip.

        It keeps its place on its own scale: only the rail is moved.
        """
        with self.world.lock:
            self.world.catch_up()
            self._mounted_at = self.stage_position
            self.world.mount_stage(tuple(direction))

    @property
    def n(self) -> int:
        """Number of channels."""
        return len(self.world.pressures)

    def command(self, channel: int, pressure: float) -> None:
        """See `Bench`."""
        self.world.command_channel(channel, pressure)

    def measured(self) -> Array:
        """See `Bench`."""
        return self.world.measured()

    def dump(self, *, open_valve: bool) -> None:
        """See `Bench`."""
        self.world.dump(open_valve=open_valve)

    def frame(self) -> TrackerFrame | None:
        """See `Bench`."""
        with self.world.lock:
            for frame in self.world.frames():
                self._newest = frame
            newest = self._newest
        if newest is None:
            return None
        captured = self.world.epoch + newest.captured
        return TrackerFrame(newest.number, captured, newest.position, newest.quaternion)

    def fault(self, device: str) -> str:
        """See `Bench`."""
        return self.world.faults[device]

    @property
    def stage_position(self) -> float:
        """See `Bench`."""
        return self._mounted_at + self.world.stage_position

    @property
    def stage_moving(self) -> bool:
        """See `Bench`."""
        return self.world.stage_moving

    def stage_move(self, position: float, speed: float) -> None:
        """See `Bench`."""
        with self.world.lock:
            self.world.catch_up()
            self.world.move_stage(position - self._mounted_at, speed)

    def stage_stop(self) -> None:
        """See `Bench`."""
        self.world.stop_stage()

    def force(self) -> float:
        """See `Bench`."""
        return self.world.force()
