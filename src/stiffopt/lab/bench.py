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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import DeviceError, InputError
from stiffopt.rig.device import DeviceSettings

if TYPE_CHECKING:  # numba takes its time, and peers need none of it
    from stiffopt.plant.hardware import Frame
    from stiffopt.plant.world import World

Array = NDArray[np.float64]
SettingsT = TypeVar("SettingsT", bound=DeviceSettings)

FULL_SCALE = 10e5
"""Pressure in Pa that a regulator of the lab reaches at full scale, as of a K8P at 10 V."""

_TICK = 0.005  # s, at most, by which the world is behind
_START = 5.0  # s, within which a device must listen, and within which it must have stopped


@dataclass(frozen=True)
class TrackerFrame:
    """What the tracker's hardware sees in one frame.

    Attributes
    ----------
    number : of the frame.
    time : of its capture, on `time.monotonic`.
    position : of the sensor in the tracker's frame (3,), in m; NaN where it is not seen.
    quaternion : (4,), w first, of any sign, with the tracker's noise.
    """

    number: int
    time: float
    position: Array
    quaternion: Array


class Bench:
    """The simulated arm and its devices, kept going by a thread between `start` and `close`.

    Every method may be called by any thread. Of the faults, a peer plays two itself: it does not
    answer at all while `fault` is ``off``, and answers late while it is ``slow``. All others
    (``stuck``, ``garbage``, ``wrong``) show in what the methods return.

    Parameters
    ----------
    world :
        Made for real time.

    Attributes
    ----------
    failure : what ended the world, if something did.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.failure: BaseException | None = None
        self._mounted_at = 0.0  # where the stage was, on its own scale, when it was mounted
        self._newest: Frame | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

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

    def fault(self, device: str) -> str:
        """Return the fault of ``supply``, ``tracker`` or ``probe``; ``ok`` if there is none."""
        return self.world.faults[device]

    @property
    def n(self) -> int:
        """Number of channels."""
        return len(self.world.pressures)

    def command(self, channel: int, pressure: float) -> None:
        """Give a regulator (counted from 0) its set-point, in Pa."""
        self.world.command_channel(channel, pressure)

    def fill(self, pressures: ArrayLike) -> None:
        """Put pressures (n,), in Pa, into the chambers: a peer has regulators of its own."""
        self.world.fill(pressures)

    def channel_faults(self) -> dict[int, str]:
        """Return the supply's faults by channel, counted from 0."""
        return self.world.channel_faults()

    def measured(self) -> Array:
        """Pressures (n,) that the regulators report, in Pa."""
        return self.world.measured()

    def dump(self, *, open_valve: bool) -> None:
        """Open or close the dump valve: open, it empties all chambers."""
        self.world.dump(open_valve=open_valve)

    def frame(self) -> TrackerFrame | None:
        """Return the newest frame that has left the tracker, or None before the first."""
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

        It keeps its place on its own scale: only the rail is moved.
        """
        with self.world.lock:
            self.world.catch_up()
            self._mounted_at = self.stage_position
            self.world.stage.mount(tuple(direction))

    @property
    def stage_position(self) -> float:
        """Place of the probe's stage along its axis, in m."""
        return self._mounted_at + self.world.stage.position

    @property
    def stage_moving(self) -> bool:
        """Whether the stage moves."""
        return self.world.stage.speed > 0

    def stage_move(self, position: float, speed: float) -> None:
        """Let the stage start to move, to a place in m at a speed in m/s."""
        with self.world.lock:
            self.world.catch_up()
            self.world.stage.move(position - self._mounted_at, speed)

    def stage_stop(self) -> None:
        """Stop the stage."""
        self.world.stage.stop()

    def force(self) -> float:
        """Force that the probe's sensor feels, in N."""
        return self.world.stage.force()


class DevicePeer(ABC, Generic[SettingsT]):
    """A device as its driver sees it: it speaks the real protocol, with the bench behind it.

    Parameters
    ----------
    settings :
        Of the real driver, as they are in the rig file; the peer follows them (register map,
        scales, channels), so that a lab can rehearse with its own file.
    bench :
        What is behind it.

    Attributes
    ----------
    faults : what this device can do wrong beyond the faults of all devices of its kind.
    """

    faults: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: SettingsT, bench: Bench) -> None:
        self.settings = settings
        self.bench = bench

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> SettingsT:
        """Return settings with which this device takes the place of a simulated one.

        Parameters
        ----------
        simulated :
            Settings of the simulated device.
        n :
            Number of the arm's channels.

        Raises
        ------
        InputError
            It has no settings that go without saying.
        """
        raise InputError(f"{cls.__name__} needs settings in the rig file")

    @staticmethod
    def on_loopback(host: str | None) -> bool:
        """Say whether a host is this machine's own address: the lab listens nowhere else."""
        return host is not None and (host == "localhost" or host.startswith("127."))

    @abstractmethod
    def start(self) -> SettingsT:
        """Listen on loopback, on a free port or pseudo-terminal.

        Returns
        -------
        The settings with the address put in, with which the real driver reaches this peer.

        Raises
        ------
        DeviceError
            The address that the settings ask for is in use.
        MissingExtraError
            The library that speaks the protocol is not installed.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop listening and end every thread; to close twice does nothing."""


class ServedPeer(DevicePeer[SettingsT]):
    """A device that an event loop plays, in a thread of its own.

    A subclass listens in `_listening`; what it does there runs in the loop and never blocks it.
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
        """Stop listening and end the loop; to close twice does nothing."""
        thread, self._thread = self._thread, None
        if thread is not None:
            with suppress(RuntimeError):  # the loop has ended by itself
                self._end()
            thread.join(_START)

    @abstractmethod
    def _listening(self) -> AbstractAsyncContextManager[SettingsT]:
        """Listen in a context, which gives the settings that lead here; see `DevicePeer.start`."""

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
