"""A linear stage of Zaber, over TCP or a serial line, in metres along its rail.

zaber-motion speaks the protocol. Its conversion of units asks a database on the internet, so this
converts by itself.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.drivers.daqmx import Pair, library
from stiffopt.rig.interface import Clock
from stiffopt.schema import BadKeyError, Schema
from stiffopt.units import Length, Speed

__all__ = ["SPEED_FACTOR", "Stage", "StageSettings"]

SPEED_FACTOR = 1.6384
"""Zaber's native units of speed for one microstep per second."""

_POLL = 0.002  # s between two looks at a moving stage
_ARRIVED = 5e-6  # m from the target
_PATIENCE = 2.0  # s longer than a move should take
_MOMENT = 0.1  # s after which a device that takes one connection takes the next


class StageSettings(Schema):
    """The stage and how it is mounted.

    Attributes
    ----------
    host, port : of a device with Ethernet or a serial server.
    serial : or the serial port, for example ``/dev/ttyUSB0``.
    device, axis : address of the device on its line, and number of the axis.
    microstep : length of one, in m; by default that of the X-LSM100A.
    travel : places on the rail that may be gone to, in m from the home position.
    max_speed : in m/s.
    towards_tip : 1 if the probe nears the tip as the stage moves away from its home, else -1.
    home : whether a stage that does not know where it is may be homed, or is refused.
    """

    host: Annotated[str, Field(min_length=1)] | None = None
    port: Annotated[int, Field(ge=1, le=65535)] = 55550
    serial: Annotated[str, Field(min_length=1)] | None = None
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    microstep: Annotated[Length, Field(gt=0, le=1e-4)] = 0.047625e-6
    travel: Pair[Length] = (0.0, 0.1)
    max_speed: Annotated[Speed, Field(gt=0, le=0.1)] = 0.01
    towards_tip: Literal[1, -1] = 1
    home: Literal["never", "if_needed"] = "never"

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.host is not None and self.serial is not None:
            raise BadKeyError("serial", "expected one of 'host' and 'serial', not both")
        if not self.travel[0] < self.travel[1]:
            raise BadKeyError("travel", "the first place must be below the second")
        return self

    @property
    def where(self) -> str:
        """The stage, for messages."""
        return f"the stage at {self.serial or f'{self.host}:{self.port}'}"


class Stage:
    """The stage; places are m from its home position.

    Parameters
    ----------
    guard :
        Called all the time while the stage moves; if it raises, the stage is stopped.
    """

    def __init__(self, settings: StageSettings, timeout: float, clock: Clock) -> None:
        if settings.host is None and settings.serial is None:
            raise DeviceError("the stage has no address; give its 'host' or its 'serial' port")
        self.settings = settings
        self._clock = clock
        ascii_protocol = library("zaber_motion.ascii", "zaber-motion", "probe")
        self._failure = library("zaber_motion", "zaber-motion", "probe").MotionLibException
        self._connection = self._connect(ascii_protocol.Connection, timeout)
        try:
            with self._errors("setting up"):
                self._connection.default_request_timeout = max(1, round(1000 * timeout))
            self._axis: Any = self._connection.get_device(settings.device).get_axis(settings.axis)
            self.place()
        except BaseException:
            self.close()
            raise

    def _connect(self, connection: Any, timeout: float) -> Any:
        settings = self.settings
        if settings.serial is not None:
            with self._errors("connecting to"):
                return connection.open_serial_port(settings.serial)
        self._must_accept(timeout)
        give_up = self._clock.now() + timeout
        while True:
            self._clock.sleep(_MOMENT)
            try:
                with self._errors("connecting to"):
                    return connection.open_tcp(settings.host, settings.port)
            except DeviceError:
                if self._clock.now() > give_up:
                    raise

    def _must_accept(self, timeout: float) -> None:
        """Refuse a host that takes no connection in time; zaber-motion waits for minutes."""
        settings = self.settings
        try:
            socket.create_connection((settings.host or "", settings.port), timeout).close()
        except (OSError, ValueError) as error:  # ValueError: no name that a host could have
            reason = f"no answer for {timeout:g} s"
            if not isinstance(error, TimeoutError):
                reason = getattr(error, "strerror", None) or str(error)
            raise DeviceError(f"connecting to {settings.where} failed: {reason}") from None

    def close(self) -> None:
        """Disconnect; the stage goes on with what it does."""
        with suppress(self._failure):
            self._connection.close()

    def place(self) -> float:
        """Return where the stage is, in m."""
        with self._errors("reading the position of"):
            return float(self._axis.get_position()) * self.settings.microstep

    def knows_its_place(self) -> bool:
        """Say whether the stage has been homed since it was switched on."""
        with self._errors("asking"):
            return bool(self._axis.is_homed())

    def home(self, guard: Callable[[], None]) -> None:
        """Home the stage."""
        longest = (self.settings.travel[1] - self.settings.travel[0]) / 1e-3
        with self._stopping():
            with self._errors("homing"):
                self._axis.home(wait_until_idle=False)
            self._wait(longest, guard)
        if not self.knows_its_place():
            raise DeviceError(f"{self.settings.where} could not be homed{self._warnings()}")

    def move_to(self, place: float, speed: float, guard: Callable[[], None]) -> None:
        """Move, and return when there.

        Raises
        ------
        CommandError
            Too far or too fast; the stage does not move.
        DeviceError
            It does not answer or does not arrive.
        """
        self.check(place, speed)
        start = self.place()
        native_speed = max(1, int(speed / self.settings.microstep * SPEED_FACTOR))
        with self._stopping():
            with self._errors("moving"):
                target = round(place / self.settings.microstep)
                self._axis.move_absolute(target, wait_until_idle=False, velocity=native_speed)
            self._wait(abs(place - start) / speed, guard)
        self._must_be_at(place)

    def check(self, place: float, speed: float) -> None:
        """Refuse a move that is too far or too fast; comparisons with NaN are false."""
        low, high = self.settings.travel
        if not low <= place <= high:
            raise CommandError(
                f"the stage would be at {1e3 * place:.6g} mm; it may be moved from "
                f"{1e3 * low:g} to {1e3 * high:g} mm"
            )
        if not 0 < speed <= self.settings.max_speed:
            raise CommandError(
                f"{1e3 * speed:.6g} mm/s is out of range; the stage may move at up to "
                f"{1e3 * self.settings.max_speed:g} mm/s"
            )

    def stop(self) -> None:
        """Stop at once."""
        with self._errors("stopping"):
            self._axis.stop(wait_until_idle=False)

    def _wait(self, expected: float, guard: Callable[[], None]) -> None:
        give_up = self._clock.now() + 1.5 * expected + _PATIENCE
        while self._moves():
            guard()
            if self._clock.now() > give_up:
                raise DeviceError(f"{self.settings.where} takes too long{self._warnings()}")
            self._clock.sleep(_POLL)

    def _moves(self) -> bool:
        with self._errors("asking"):
            return bool(self._axis.is_busy())

    def _must_be_at(self, place: float) -> None:
        there = self.place()
        if not abs(there - place) <= _ARRIVED + self.settings.microstep:
            raise DeviceError(
                f"{self.settings.where} has stopped at {1e3 * there:.4f} mm instead of "
                f"{1e3 * place:.4f} mm{self._warnings()}"
            )

    def _warnings(self) -> str:
        with self._errors("asking"):
            flags = sorted(self._axis.warnings.get_flags())
        return f"; its warnings are {', '.join(flags)}" if flags else ""

    @contextmanager
    def _stopping(self) -> Iterator[None]:
        """Stop the stage whatever goes wrong; say so if that fails too."""
        try:
            yield
        except BaseException as error:
            try:
                self.stop()
            except DeviceError as second:
                first = str(error) or type(error).__name__
                raise DeviceError(
                    f"{first}; and {second}: press the emergency stop if the stage still moves"
                ) from error
            raise

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        except self._failure as error:
            reason = " ".join(str(error).split(": ", 1)[-1].split()).rstrip(".")
            raise DeviceError(f"{doing} {self.settings.where} failed: {reason}") from None
