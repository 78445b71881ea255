"""The bench of the virtual lab: a simulated arm in real time, and the bases of its devices."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, InputError
from stiffopt.rig.device import DeviceSettings

if TYPE_CHECKING:  # importing numba is slow, and peers do not need it
    from stiffopt.plant.hardware import Frame
    from stiffopt.plant.world import World

SettingsT = TypeVar("SettingsT", bound=DeviceSettings)

FULL_SCALE = 10e5
"""Pressure of a lab's regulator at full scale, in Pa, as of a K8P at 10 V."""

_TICK = 0.005  # s, by which the world is behind at most
_START = 5.0  # s for a device to start listening, and for it to stop


@dataclass(frozen=True)
class TrackerFrame:
    """One frame of the tracker's hardware."""

    number: int  # of the frame
    time: float  # of its capture, on `time.monotonic`
    position: Array  # of the sensor in the tracker's frame (3,), in m; NaN if it is not seen
    quaternion: Array  # (4,), w first, of any sign, with the tracker's noise


class Bench:
    """The simulated arm and its devices; a thread advances them between `start` and `close`.

    Any thread may call any method. A peer implements two of the faults itself: it does not answer
    while `fault` is ``off``, and answers late while it is ``slow``. The others (``stuck``,
    ``garbage``, ``wrong``) show in the values that the methods return.

    Parameters
    ----------
    world : a world in real time.

    Attributes
    ----------
    failure : the error that ended the world, or None.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.failure: BaseException | None = None
        self._mounted_at = 0.0  # position of the stage on its own scale when it was mounted
        self._newest: Frame | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread that advances time."""
        self._thread = threading.Thread(target=self._keep_going, name="virtual-lab", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; a second call does nothing."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None

    def _keep_going(self) -> None:
        while not self._stop.wait(_TICK):
            try:
                self.world.catch_up()
            except Exception as error:  # reported by the lab's user
                self.failure = error
                return

    def fault(self, device: str) -> str:
        """Return the fault of ``supply``, ``tracker`` or ``probe``; ``ok`` if there is none."""
        return self.world.faults[device]

    @property
    def n(self) -> int:
        """Number of channels."""
        return len(self.world.pressures)

    def command(self, channel: int, pressure: float) -> None:
        """Set the set-point of a regulator (counted from 0), in Pa."""
        self.world.command_channel(channel, pressure)

    def fill(self, pressures: ArrayLike) -> None:
        """Set the pressures (n,) in the chambers, in Pa, for a peer with its own regulators."""
        self.world.fill(pressures)

    def channel_faults(self) -> dict[int, str]:
        """Return the supply's faults by channel, counted from 0."""
        return self.world.channel_faults()

    def measured(self) -> Array:
        """Return the pressures (n,) that the regulators report, in Pa."""
        return self.world.measured()

    def dump(self, *, open_valve: bool) -> None:
        """Open or close the dump valve, which empties all chambers when open."""
        self.world.dump(open_valve=open_valve)

    def frame(self) -> TrackerFrame | None:
        """Return the newest frame that the tracker has sent, or None before the first."""
        with self.world.lock:
            for frame in self.world.frames():
                self._newest = frame
            newest = self._newest
        if newest is None:
            return None
        captured = self.world.epoch + newest.captured
        return TrackerFrame(newest.number, captured, newest.position, newest.quaternion)

    def mount(self, direction: Iterable[float]) -> None:
        """Mount the stage along a unit vector (3,) in the base frame, just clear of the tip.

        It keeps its position on its own scale: only the rail is moved.
        """
        with self.world.lock:
            self.world.catch_up()
            self._mounted_at = self.stage_position
            self.world.stage.mount(tuple(direction))

    @property
    def stage_position(self) -> float:
        """Position of the probe's stage along its axis, in m."""
        return self._mounted_at + self.world.stage.position

    @property
    def stage_moving(self) -> bool:
        """Whether the stage moves."""
        return self.world.stage.speed > 0

    def stage_move(self, position: float, speed: float) -> None:
        """Start to move the stage to a position in m at a speed in m/s."""
        with self.world.lock:
            self.world.catch_up()
            self.world.stage.move(position - self._mounted_at, speed)

    def stage_stop(self) -> None:
        """Stop the stage."""
        self.world.stage.stop()

    def force(self) -> float:
        """Return the force that the probe's sensor measures, in N."""
        return self.world.stage.force()


class DevicePeer(ABC, Generic[SettingsT]):
    """A device as its driver sees it: it speaks the real protocol, with the bench behind it.

    Parameters
    ----------
    settings : settings of the real driver, as in the rig file. The peer follows them (register map,
        scales, channels), so that a lab can rehearse with its own file.
    bench : the bench behind it.

    Attributes
    ----------
    faults : faults of this device beyond those of all devices of its kind.
    """

    faults: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: SettingsT, bench: Bench) -> None:
        self.settings = settings
        self.bench = bench

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> SettingsT:
        """Return settings with which this device replaces a simulated one.

        `simulated`: settings of the simulated device. `n`: number of the arm's channels. Raises
        `InputError`: it has no default settings.
        """
        raise InputError(f"{cls.__name__} needs settings in the rig file")

    @staticmethod
    def on_loopback(host: str | None) -> bool:
        """Return whether a host is this machine's loopback: the lab listens nowhere else."""
        return host is not None and (host == "localhost" or host.startswith("127."))

    @abstractmethod
    def start(self) -> SettingsT:
        """Listen on loopback, on a free port or pseudo-terminal.

        Returns the settings, with the address at which the real driver reaches this peer. Raises
        `DeviceError`: the address in the settings is in use; `MissingExtraError`: the library of
        the protocol is not installed.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop listening and end every thread; a second call does nothing."""


class ServedPeer(DevicePeer[SettingsT]):
    """A device that is served by an event loop in a thread of its own.

    A subclass implements `_listening`, whose code runs in the loop and must never block it.
    """

    def __init__(self, settings: SettingsT, bench: Bench) -> None:
        super().__init__(settings, bench)
        self._thread: threading.Thread | None = None
        self._end: Callable[[], object] = lambda: None

    def start(self) -> SettingsT:
        """Start the loop; see `DevicePeer.start`."""
        if self._thread is not None:
            raise DeviceError(f"the {type(self).__name__} of the virtual lab runs already")
        started: Future[SettingsT] = Future()
        self._thread = threading.Thread(
            target=self._run, args=(started,), name=type(self).__name__, daemon=True
        )
        self._thread.start()
        try:
            return started.result(_START)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop listening and end the loop; a second call does nothing."""
        thread, self._thread = self._thread, None
        if thread is not None:
            with suppress(RuntimeError):  # the loop has already ended
                self._end()
            thread.join(_START)

    @abstractmethod
    def _listening(self) -> AbstractAsyncContextManager[SettingsT]:
        """Listen in a context that yields the peer's settings; see `DevicePeer.start`."""

    def _run(self, started: Future[SettingsT]) -> None:
        try:
            asyncio.run(self._serve(started))
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    async def _serve(self, started: Future[SettingsT]) -> None:
        ending = asyncio.Event()
        self._end = partial(asyncio.get_running_loop().call_soon_threadsafe, ending.set)
        async with self._listening() as settings:
            started.set_result(settings)
            await ending.wait()
