"""A force sensor on a Zaber stage: pushes on the tip, feels the force, and stops in time.

A person mounts the rail along each direction; the stage then moves along it and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.drivers.daqmx import Address, Daqmx, InputName, Pair, Terminals
from stiffopt.rig.drivers.daqmx_tasks import AnalogueInput, InputChannel
from stiffopt.rig.drivers.zaber import Stage, StageSettings
from stiffopt.rig.interface import Clock, ForceProbe, ForceSample
from stiffopt.schema import BadKeyError, Schema
from stiffopt.units import Duration, Force, ForcePerVoltage, Voltage

__all__ = ["ForceSettings", "ProbeSettings", "ZaberProbe", "ask_at_the_terminal"]

_SATURATED = 0.999  # of the converter's range
_WORSE = 1.2  # factor on a force that is too high already while the probe backs off


class ForceSettings(Schema):
    """The force sensor, on an analogue input of an NI-DAQ device.

    Attributes
    ----------
    channel : physical channel, such as ``Dev1/ai3``.
    terminals : how it is wired.
    range : of the converter, in V.
    sensitivity : force that pushes the tip per volt, in N/V; negative if the sign is the other.
    offset : force at 0 V before the first taring, in N.
    tare_samples : readings that are averaged when the probe is aligned.
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
        """Force that can be felt in either sense, in N."""
        volts = _SATURATED * min(-self.range[0], self.range[1])
        return abs(self.sensitivity) * volts


class ProbeSettings(Schema):
    """A force sensor on a Zaber stage.

    Attributes
    ----------
    stage, force : see there.
    max_force : at which the stage is stopped, in N.
    timeout : of every exchange with either device, in s.
    """

    driver: Literal["probe"]
    stage: StageSettings
    force: ForceSettings
    max_force: Annotated[Force, Field(gt=0)] = 2.0
    timeout: Annotated[Duration, Field(gt=0, le=10)] = 1.0

    @model_validator(mode="after")
    def _can_be_felt(self) -> Self:
        if self.max_force > self.force.largest:
            raise BadKeyError(
                "max_force",
                f"the sensor saturates at {self.force.largest:.3g} N, so that nobody would notice",
            )
        return self

    def device(
        self, clock: Clock | None = None, prompt: Callable[[str], None] | None = None
    ) -> ForceProbe:
        """Return the probe.

        Parameters
        ----------
        clock :
            Of the rig.
        prompt :
            Asks a person to do something and returns when it is done; by default on the terminal.
        """
        return ZaberProbe(self, clock, prompt)


def ask_at_the_terminal(request: str) -> None:
    """Print a request and wait for the Enter key."""
    try:
        input(f"{request}, then press Enter: ")
    except EOFError:
        raise DeviceError(f"nobody is at the terminal who could do this: {request}") from None


class ZaberProbe(ForceProbe):
    """The stage with the sensor; its position is 0 where it was aligned, and grows to the tip."""

    def __init__(
        self,
        settings: ProbeSettings,
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
        """Ask that the rail be mounted along a unit vector (3,) in the base frame; tare there.

        Raises
        ------
        CommandError
            Not a unit vector.
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
        """Move to a place along the axis, in m, at a speed in m/s, and return when there.

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
        """Back off to where it was aligned, and ask that the rail be taken out of the way."""
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
            daq = Daqmx(settings.force.grpc, settings.timeout, "probe")
            stack.callback(daq.close)
            force = settings.force
            wired = InputChannel(force.channel, force.terminals, *force.range)
            # The supply's inputs are often on the same device: hold it only while reading.
            self._input = AnalogueInput(daq, [wired], shared=True)
            stack.callback(self._input.close)
            self._stage = Stage(settings.stage, settings.timeout, self.clock)
            stack.callback(self._stage.close)
            self._force()
            self._home_if_needed()
            self._zero = self._stage.place()
            self._opened = stack.pop_all()

    def _close(self) -> None:
        # The supply vents at about this time, and the arm goes where it wants: it should not find
        # the probe in its way. Back along the way it came, no further than where a person has put
        # it, is the one move that is known to be free and that takes force off the tip. Before
        # an alignment nothing is known about the way, and the stage stays where it stands.
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
