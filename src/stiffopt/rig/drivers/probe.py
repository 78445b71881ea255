"""The driver ``probe``: a force sensor on a linear stage of Zaber that pushes the tip.

A person mounts the rail along each direction; the stage moves along the rail and stops if the force
is too high. zaber-motion controls the stage, over TCP or a serial line. Native units are converted
here, because zaber-motion would query a database on the internet. The sensor is on an analogue
input of an NI-DAQ device.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.device import library
from stiffopt.rig.drivers.daqmx import (
    Address,
    AnalogueInput,
    Daqmx,
    InputChannel,
    InputName,
    Terminals,
)
from stiffopt.rig.interface import Clock, ForceProbe, ForceSample, ProbeSettings
from stiffopt.schema import BadKeyError, Pair, Schema
from stiffopt.units import Duration, Force, ForcePerVoltage, Length, Speed, Voltage

SPEED_FACTOR = 1.6384
"""Zaber's native units of speed for one microstep per second."""

_POLL = 0.002  # s between polls of a moving stage
_ARRIVED = 5e-6  # m from the target
_PATIENCE = 2.0  # s by which a move may exceed its expected time
_MOMENT = 0.1  # s between two connections to a device that accepts only one
_SATURATED = 0.999  # share of the converter's range
_WORSE = 1.2  # factor on an excessive force that is allowed while the probe backs off


class ZaberStageSettings(Schema):
    """The stage and its mounting.

    Attributes
    ----------
    host, port : of a device with Ethernet or a serial server.
    serial : or the serial port, for example ``/dev/ttyUSB0``.
    device, axis : address of the device on its line, and number of the axis.
    microstep : length of a microstep, in m; by default that of the X-LSM100A.
    travel : permitted range on the rail, in m from the home position.
    max_speed : in m/s.
    towards_tip : 1 if the probe nears the tip as the stage moves away from its home, otherwise -1.
    home : whether to home a stage that does not know its position, or to refuse it.
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


class ForceSensorSettings(Schema):
    """The force sensor, on an analogue input of an NI-DAQ device.

    Attributes
    ----------
    channel : physical channel, such as ``Dev1/ai3``.
    terminals : wiring of the input.
    range : range of the converter, in V.
    sensitivity : pushing force on the tip per volt, in N/V; negative for the opposite sign.
    offset : force at 0 V before the first taring, in N.
    tare_samples : number of readings to average when the probe is aligned.
    grpc : host and port of NI's gRPC device server; None: the driver on this machine.
    """

    channel: InputName
    terminals: Terminals = "default"
    range: Pair[Voltage] = (-10.0, 10.0)
    sensitivity: ForcePerVoltage
    offset: Force = 0.0
    tare_samples: Annotated[int, Field(ge=1, le=10_000)] = 50
    grpc: Address | None = None

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if not self.range[0] < self.range[1]:
            raise BadKeyError("range", "the first voltage must be below the second")
        if self.sensitivity == 0:
            raise BadKeyError("sensitivity", "must not be 0")
        return self

    @property
    def largest(self) -> float:
        """Greatest force that can be measured in both directions, in N."""
        volts = _SATURATED * min(-self.range[0], self.range[1])
        return abs(self.sensitivity) * volts


class ZaberProbeSettings(ProbeSettings):
    """A force sensor on a Zaber stage.

    Attributes
    ----------
    stage, force : see there.
    max_force : force at which the stage is stopped, in N.
    timeout : timeout of every exchange with either device, in s.
    """

    extra: ClassVar[str] = "probe"
    peer: ClassVar[str] = "stiffopt.lab.probe_peer:ProbePeer"

    driver: Literal["probe"] = "probe"
    stage: ZaberStageSettings
    force: ForceSensorSettings
    max_force: Annotated[Force, Field(gt=0)] = 2.0
    timeout: Annotated[Duration, Field(gt=0, le=10)] = 1.0

    @model_validator(mode="after")
    def _can_be_felt(self) -> Self:
        if self.max_force > self.force.largest:
            raise BadKeyError(
                "max_force",
                f"the sensor saturates at {self.force.largest:.3g} N, so a larger force would go "
                "unnoticed",
            )
        return self

    def device(
        self, clock: Clock | None = None, prompt: Callable[[str], None] | None = None
    ) -> ForceProbe:
        """Return the probe.

        `clock`: clock of the rig. `prompt`: asks a person to do something and returns when it is
        done; None: on the terminal.
        """
        return ZaberProbe(self, clock, prompt)


def ask_at_the_terminal(request: str) -> None:
    """Print a request and wait for the Enter key."""
    try:
        input(f"{request}, then press Enter: ")
    except EOFError:
        raise DeviceError(f"nobody is at the terminal who could do this: {request}") from None


class ZaberProbe(ForceProbe):
    """The stage with the sensor; its position is 0 where it was aligned, positive to the tip."""

    def __init__(
        self,
        settings: ZaberProbeSettings,
        clock: Clock | None = None,
        prompt: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(clock)
        self._settings = settings
        self._prompt = prompt or ask_at_the_terminal
        self._sign = settings.stage.towards_tip
        self._offset = settings.force.offset
        self._zero = 0.0
        self._aligned = False

    @property
    def needs_a_person(self) -> bool:
        """True: the rail is mounted by hand."""
        return True

    def align(self, direction: Iterable[float]) -> None:
        """Ask a person to mount the rail along a unit vector (3,) in the base frame; then tare.

        Raises `CommandError`: the direction is not a unit vector.
        """
        self._must_be_open()
        axis = np.array(list(direction), dtype=float)
        if axis.shape != (3,) or not abs(np.linalg.norm(axis) - 1) < 1e-6:
            raise CommandError("expected a direction of three numbers, of length 1")
        self._aligned = False
        self._prompt(
            f"mount the probe's rail so that the probe moves along "
            f"[{', '.join(f'{x:.3g}' for x in axis)}] in the base frame, and bring the probe just "
            "clear of the tip"
        )
        self._zero = self._stage.place()
        self._tare()
        self._aligned = True

    def move_to(self, position: float, speed: float) -> None:
        """Move to a position along the axis, in m, at a speed in m/s; return on arrival.

        Raises
        ------
        CommandError
            Not aligned, too far or too fast; the stage does not move.
        DeviceError
            The force is too high or unknown, or the stage does not arrive; it is stopped.
        """
        self._must_be_open()
        if not self._aligned:
            raise CommandError("the probe is not aligned, so it has no position; align it first")
        place = self._zero + self._sign * position
        self._stage.check(place, speed)
        force = self._force()
        most = self._settings.max_force
        if abs(force) > most:
            if position > self._position():
                raise DeviceError(f"{self._too_much(force)}: it may only be moved away")
            most = _WORSE * abs(force)
        self._stage.move_to(place, speed, lambda: self._guard(most))

    def withdraw(self) -> None:
        """Return to where it was aligned, and ask a person to take the rail away."""
        self._must_be_open()
        self._back_off()
        self._aligned = False
        self._prompt("take the probe out of the arm's reach")

    def stop(self) -> None:
        """Stop at once."""
        self._must_be_open()
        self._stage.stop()

    def sample(self) -> ForceSample:
        """Read force and position."""
        self._must_be_open()
        force = self._force()
        return ForceSample(self.clock.now(), force, self._position())

    def _open(self) -> None:
        settings = self._settings
        self._aligned = False
        with ExitStack() as stack:
            daq = Daqmx(settings.force.grpc, settings.timeout, settings.extra)
            stack.callback(daq.close)
            force = settings.force
            wired = InputChannel(force.channel, force.terminals, *force.range)
            # The supply's inputs are often on the same device: reserve it only while reading.
            self._input = AnalogueInput(daq, [wired], shared=True)
            stack.callback(self._input.close)
            self._stage = ZaberStage(settings.stage, settings.timeout, self.clock)
            stack.callback(self._stage.close)
            self._force()
            self._home_if_needed()
            self._zero = self._stage.place()
            self._opened = stack.pop_all()

    def _close(self) -> None:
        # The supply vents at about this time, and the arm moves: the probe must not be in its way.
        # Only the way back to where a person has aligned the probe is known to be free, and it
        # takes force off the tip. Before an alignment no way is known, so the stage stays where it
        # is.
        with self._opened:
            with suppress(DeviceError):
                self._stage.stop()
            with suppress(DeviceError):
                self._back_off()

    def _back_off(self) -> None:
        if self._aligned and self._position() > 0:
            most = max(self._settings.max_force, _WORSE * abs(self._force()))
            speed = self._settings.stage.max_speed
            self._stage.move_to(self._zero, speed, lambda: self._guard(most))

    def _home_if_needed(self) -> None:
        if self._stage.knows_its_place():
            return
        where = self._settings.stage.where
        if self._settings.stage.home == "never":
            raise DeviceError(
                f"{where} does not know where it is; home it with nothing in its way, or set "
                "'home: if_needed'"
            )
        self._prompt(f"{where} must be homed: take the probe out of the arm's reach")
        self._tare()
        self._stage.home(lambda: self._guard(self._settings.max_force))

    def _position(self) -> float:
        return self._sign * (self._stage.place() - self._zero)

    def _tare(self) -> None:
        forces = [self._force() for _ in range(self._settings.force.tare_samples)]
        self._offset -= float(np.mean(forces))
        settings, most = self._settings.force, self._settings.max_force
        for force in (-most, most):
            volts = (force - self._offset) / settings.sensitivity
            if not settings.range[0] * _SATURATED < volts < settings.range[1] * _SATURATED:
                raise DeviceError(
                    f"the force sensor on {settings.channel} is {self._offset:.3g} N off, and "
                    f"would saturate before it feels {force:g} N; unload or trim it"
                )

    def _force(self) -> float:
        settings = self._settings.force
        volts = float(self._input.read()[0])
        low, high = (_SATURATED * bound for bound in settings.range)
        if not low < volts < high:
            raise DeviceError(
                f"the force sensor on {settings.channel} reads {volts:.3g} V, the end of its "
                "range; check its wiring and its load"
            )
        return settings.sensitivity * volts + self._offset

    def _guard(self, most: float) -> None:
        force = self._force()
        if not abs(force) <= most:
            raise DeviceError(self._too_much(force))

    def _too_much(self, force: float) -> str:
        return f"the probe feels {force:.4g} N; at most {self._settings.max_force:g} N are allowed"


class ZaberStage:
    """The stage; positions are in m from its home.

    `guard`: called continually while the stage moves; if it raises, the stage is stopped.
    """

    def __init__(self, settings: ZaberStageSettings, timeout: float, clock: Clock) -> None:
        if settings.host is None and settings.serial is None:
            raise DeviceError("the stage has no address; give its 'host' or its 'serial' port")
        self.settings = settings
        self._clock = clock
        ascii_protocol = library("zaber_motion.ascii", "zaber-motion", ZaberProbeSettings.extra)
        self._failure = library(
            "zaber_motion", "zaber-motion", ZaberProbeSettings.extra
        ).MotionLibException
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
        """Refuse a host that accepts no connection in time; zaber-motion would wait for minutes."""
        settings = self.settings
        try:
            socket.create_connection((settings.host or "", settings.port), timeout).close()
        except (OSError, ValueError) as error:  # ValueError: an invalid host name
            reason = f"no answer for {timeout:g} s"
            if not isinstance(error, TimeoutError):
                reason = getattr(error, "strerror", None) or str(error)
            raise DeviceError(f"connecting to {settings.where} failed: {reason}") from None

    def close(self) -> None:
        """Disconnect; the stage continues what it does."""
        with suppress(self._failure):
            self._connection.close()

    def place(self) -> float:
        """Return the position of the stage, in m."""
        with self._errors("reading the position of"):
            return float(self._axis.get_position()) * self.settings.microstep

    def knows_its_place(self) -> bool:
        """Return whether the stage has been homed since it was switched on."""
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
        """Move to a position; return on arrival.

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
        """Refuse a move that is too far or too fast, or NaN."""
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
        """Stop the stage after any error; report it if that fails too."""
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
