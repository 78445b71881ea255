"""The driver ``open-regulator``: a microcontroller with valves, which controls the pressures.

docs/open-regulator.md describes board, firmware and protocol. The board vents on its own if
commands stop; this driver never keeps it alive: each command comes from a caller.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.device import MisfitError
from stiffopt.rig.drivers.open_regulator_line import (
    ARM,
    EXTRA,
    LIMITS,
    SET,
    STATISTICS,
    UNIT,
    VENT,
    VERSION,
    BoardLine,
    Identity,
    Status,
    wrong_version,
)
from stiffopt.rig.endpoints import serial_endpoints
from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply, SupplySettings
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Pressure, PressureRate

_TRIES = 3  # of a request to vent
_LARGEST = 32767 * UNIT
_SLOWEST = 20.0  # Hz


class BoardChannel(Schema):
    """A channel of the robot on the board.

    Attributes
    ----------
    output : channel of the board, counted from 1.
    max : highest pressure, in Pa; by default that of rig and robot.
    """

    output: Annotated[int, Field(ge=1, le=6)]
    max: Annotated[Pressure, Field(gt=0, le=_LARGEST)] | None = None


class OpenRegulatorSettings(SupplySettings):
    """Connection and channels of a board.

    Attributes
    ----------
    port : for example ``/dev/serial/by-id/...``.
    baudrate : that of the firmware.
    board : number of the board; any other board is refused.
    timeout : time for each answer, in s.
    startup : time for a board to answer after the port was opened, in s; some boards reset then and
        wait in a boot loader.
    slew : limit that the board enforces, in Pa/s; by default its highest.
    channels : one for each channel of the robot, in its order.
    """

    extra: ClassVar[str] = EXTRA
    peer: ClassVar[str] = "stiffopt.lab.open_regulator_peer:OpenRegulatorPeer"
    vents_within: ClassVar[float] = 0.1

    driver: Literal["open-regulator"] = "open-regulator"
    port: Annotated[str, Field(min_length=1)]
    baudrate: Annotated[int, Field(ge=9600, le=2_000_000)] = 500_000
    board: Annotated[int, Field(ge=1, le=254)] = 1
    timeout: Annotated[Duration, Field(ge=0.005, le=5)] = 0.1
    startup: Annotated[Duration, Field(gt=0, le=10)] = 2.0
    slew: Annotated[PressureRate, Field(gt=0)] | None = None
    channels: Annotated[Items[BoardChannel], Field(min_length=1, max_length=6)]

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        outputs = [channel.output for channel in self.channels]
        for index, output in enumerate(outputs):
            if output in outputs[:index]:
                raise BadKeyError(f"channels.{index}.output", f"output {output} is taken already")
        return self

    def check_against(self, rig: Any, robot: RobotDescription) -> None:
        """Refuse a rate at which the board would vent between two commands."""
        if rig.rate < _SLOWEST:
            raise MisfitError(
                f"an open regulator vents after {1e3 * self.vents_within:g} ms without a command; "
                f"expected at least {_SLOWEST:g} Hz",
                "rate",
            )

    def _reach(self, channel: int) -> tuple[float, float]:
        return 0.0, _LARGEST

    def _make(self, limits: PressureLimits, clock: Clock | None) -> OpenRegulatorSupply:
        return OpenRegulatorSupply(self, limits, clock)


class OpenRegulatorSupply(PressureSupply):
    """A board that controls the pressures of its channels.

    Each command carries the board's time of its last report, and is valid for `Identity.silence`
    after that. So the board refuses a command that was delayed anywhere.
    """

    has_watchdog = True
    has_dump_valve = True

    def __init__(
        self, settings: OpenRegulatorSettings, limits: PressureLimits, clock: Clock | None = None
    ) -> None:
        super().__init__(limits, clock)
        self.settings = settings
        self._outputs = np.array([channel.output for channel in settings.channels]) - 1
        self._line: BoardLine
        self._identity: Identity
        self._held_counts: tuple[int, ...] | None = None
        """Set-points that the board has; None: unknown."""
        self._last_report: tuple[float, Status] | None = None
        """Time of the last report, and the report."""
        self.patience = settings.startup + 6 * settings.timeout

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The serial port."""
        return serial_endpoints(self.settings.port)

    def prepare(self) -> None:
        """Import pyserial and cobs."""
        self._new_line()

    def statistics(self) -> dict[str, int]:
        """Return the board's counters since its start; see docs/open-regulator.md.

        Raises `DeviceError`: it does not answer.
        """
        self._must_be_open()
        names = ("reset", "time_ms", "frames", "bad_frames", "refused", "vented", "longest_tick_us")
        with self._lock:
            values = struct.unpack_from("<BIHHHHH", self._line.ask(STATISTICS))
        return dict(zip(names, values, strict=True))

    # connection ----------------------------------------------------------------------------------

    def _new_line(self) -> BoardLine:
        chosen = self.settings
        return BoardLine(chosen.port, chosen.baudrate, chosen.board, chosen.timeout)

    def _open(self) -> None:
        self._line = self._new_line()
        self._held_counts = self._last_report = None
        try:
            self._identity = self._first_identity()
            self._check_identity(self._identity)
        except BaseException:
            self._line.close()
            raise

    def _close(self) -> None:
        self._line.close()

    def _first_identity(self) -> Identity:
        startup, timeout = self.settings.startup, self.settings.timeout
        end = self.clock.now() + startup
        while True:
            try:
                return self._line.identity(min(timeout, startup / 10))
            except DeviceError:
                if self.clock.now() >= end:
                    raise
                self.clock.sleep(0.02)

    def _check_identity(self, identity: Identity) -> None:
        chosen, who = self.settings, str(self._line)
        if identity.version != VERSION:
            raise DeviceError(wrong_version(who, identity.version))
        if identity.board != chosen.board:
            raise DeviceError(
                f"{who} is board {identity.board}, and the rig file asks for board {chosen.board}; "
                "are two boards mixed up?"
            )
        if self._outputs.max() >= identity.channels:
            raise DeviceError(f"{who} has {identity.channels} channels only")
        if self.limits.high.max() > identity.max_pressure:
            raise DeviceError(
                f"{who} takes at most {identity.max_pressure * 1e-5:g} bar, less than the rig's "
                "limit; lower safety.max_pressure or the channels' max"
            )

    # commands ------------------------------------------------------------------------------------

    def _counts(self, pressures: Array) -> tuple[int, ...]:
        """Return pressures (n,) in units, rounded down, for each channel of the board."""
        counts = np.zeros(self._identity.channels, dtype=int)
        counts[self._outputs] = np.floor(self.limits.clamp(pressures) / UNIT + 1e-6)
        return tuple(counts.tolist())

    def _keep(self, status: Status) -> Status:
        self._last_report = self.clock.now(), status
        return status

    def _report(self) -> Status:
        return self._keep(self._line.status())

    def _recent(self) -> Status:
        """Return the last report, or a new one if that is old: commands expire with it."""
        if (
            self._last_report is not None
            and self.clock.now() - self._last_report[0] < self._identity.silence / 4
        ):
            return self._last_report[1]
        return self._report()

    def _begin(self) -> None:
        """Set the limits and arm the board, unless it is armed already."""
        if self._report().armed:
            return
        most, chosen = self._identity.max_slew, self.settings.slew
        slew = max(1, int((most if chosen is None else min(chosen, most)) / UNIT / 1e3 + 1e-6))
        limits = self._counts(self.limits.high)
        self._line.ask(LIMITS, struct.pack(f"<H{len(limits)}h", slew, *limits))
        self._keep(self._line.status(ARM))

    def _write(self, pressures: Array) -> None:
        self._set(pressures)

    def _set(self, pressures: Array) -> Status:
        counts, before = self._counts(pressures), self._held_counts
        self._held_counts = None
        if any(counts) and before is not None and not any(before):
            self._begin()  # silence without pressure has vented the board, for no other reason
        time, validity = self._recent().time, round(self._identity.silence * 1e3)
        payload = struct.pack(f"<IH{len(counts)}h", time, validity, *counts)
        status = self._keep(self._line.status(SET, payload))
        if status.set_points != counts:
            raise DeviceError(f"{self._line} holds other set-points than it received")
        self._held_counts = counts
        return status

    def _exchange(self, pressures: Array) -> ArrayLike | None:
        return self._measured(self._set(pressures))

    def _read(self) -> ArrayLike:
        return self._measured(self._report())

    def _measured(self, status: Status) -> Array:
        return np.array(status.readings, dtype=float)[self._outputs] * UNIT

    def _check_held(self) -> None:
        status = self._report()
        if self._held_counts and any(self._held_counts) and status.set_points != self._held_counts:
            why = "another program commands it" if status.armed else f"it vented: {status.reason}"
            raise DeviceError(f"{self._line} does not hold its set-points; {why}")

    def _dump(self, *, open_valve: bool) -> None:
        if open_valve:
            self._held_counts = None
            status = self._keep(_insist(lambda: self._line.status(VENT)))
            self._held_counts = status.set_points
        else:
            self._begin()


def _insist(act: Callable[[], Any]) -> Any:
    """Send a request that makes the arm safe; repeat it if it fails."""
    for _ in range(_TRIES - 1):
        with suppress(DeviceError):
            return act()
    return act()
