"""The driver ``modbus``: a supply over Modbus, such as output couplers, IO-Link masters, valves.

pymodbus handles the protocol, over TCP or a serial line. `stiffopt.rig.drivers.modbus_registers`
describes where and how the pressures are stored.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from threading import RLock
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, InputError
from stiffopt.rig.device import library
from stiffopt.rig.drivers.modbus_registers import (
    ModbusChannel,
    ModbusDumpValve,
    ModbusWatchdog,
    PressureRegister,
    PressureScale,
    RegisterRun,
    RegisterTable,
    RegisterType,
    WordOrder,
    runs_of,
    values_of,
)
from stiffopt.rig.endpoints import serial_endpoints, tcp_endpoints
from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply, SupplySettings
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration

Registers = dict[int, tuple[int, ...]]

_WRITE, _READ, _TRIGGER = 24, 20, 23
"""Bytes of a request and its answer on a serial line, with two pauses of 3.5 bytes, but for the
values; of the watchdog's register with them."""
_ALSO_READ = 1  # byte by which function 23 exceeds `_WRITE`, but for the values
_ILLEGAL_FUNCTION = 1
_EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no such address",
    3: "it does not take this value",
    4: "it has failed, or its watchdog has run out",
    6: "it is busy",
    10: "the gateway has no path to it",
    11: "it does not answer the gateway",
}


_CODES = {
    "read_holding_registers": 3,
    "read_input_registers": 4,
    "write_coil": 5,
    "write_register": 6,
    "write_registers": 16,
    "readwrite_registers": 23,
}
_FAILURES = (OSError, struct.error, IndexError, ValueError)
"""Exceptions besides its own that pymodbus raises if a device is gone or sends nonsense."""


class ModbusTcp(Schema):
    """Modbus over TCP.

    Attributes
    ----------
    host : name or IP address of the device.
    port : 0 means any free port, only in the virtual lab.
    """

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=0, le=65535)] = 502

    advice: ClassVar[str] = "is it switched on, and are host and port right?"

    def __str__(self) -> str:
        return f"the Modbus device at {self.host}:{self.port}"

    def endpoints(self) -> tuple[str, ...]:
        """Return the endpoints by which a supply at this address is claimed."""
        return tcp_endpoints(self.host, self.port)

    def client(self, **options: Any) -> Any:
        """Return pymodbus's client."""
        return pymodbus_library("pymodbus.client").ModbusTcpClient(
            self.host, port=self.port, **options
        )


class ModbusSerial(Schema):
    """Modbus RTU on a serial line.

    Attributes
    ----------
    port : for example ``/dev/ttyUSB0`` or ``COM3``.
    baudrate, parity, stop_bits : as set in the device.
    """

    port: Annotated[str, Field(min_length=1)]
    baudrate: Annotated[int, Field(ge=1200, le=4_000_000)] = 19200
    parity: Literal["none", "even", "odd"] = "even"
    stop_bits: Literal[1, 2] = 1

    advice: ClassVar[str] = "is it plugged in, is the port right, may you use it (group dialout)?"

    def __str__(self) -> str:
        return f"the Modbus device on {self.port}"

    def endpoints(self) -> tuple[str, ...]:
        """Return the endpoints by which a supply on this line is claimed."""
        return serial_endpoints(self.port)

    @property
    def bits(self) -> int:
        """Bits of a byte on the line, with those of start, parity and stop."""
        return 9 + (self.parity != "none") + self.stop_bits

    def options(self) -> dict[str, Any]:
        """Return the settings by pymodbus's names."""
        parity = self.parity[0].upper()
        return {"baudrate": self.baudrate, "parity": parity, "stopbits": self.stop_bits}

    def client(self, **options: Any) -> Any:
        """Return pymodbus's client."""
        pymodbus_library("serial")
        client = pymodbus_library("pymodbus.client").ModbusSerialClient
        return client(self.port, **self.options(), **options)


class ModbusSettings(SupplySettings):
    """Connection and register map of a supply.

    Attributes
    ----------
    tcp, serial : the connection, one of the two.
    unit : number of the device on its line.
    timeout : time for each answer, in s.
    channels : one for each channel of the robot, in its order.
    scale, type, word_order : defaults for all registers.
    table : default table of the readings.
    read_write : write and read in one request (function 23) if the device supports it.
    verify : read back what was written.
    watchdog, dump_valve : of the device, if it has them.
    """

    extra: ClassVar[str] = "modbus"
    peer: ClassVar[str] = "stiffopt.lab.modbus_peer:ModbusPeer"

    driver: Literal["modbus"] = "modbus"
    tcp: ModbusTcp | None = None
    serial: ModbusSerial | None = None
    unit: Annotated[int, Field(ge=0, le=255)] = 1
    timeout: Annotated[Duration, Field(ge=0.005, le=5)] = 0.2
    channels: Annotated[Items[ModbusChannel], Field(min_length=1)]
    scale: PressureScale
    type: RegisterType = "int16"
    word_order: WordOrder = "big"
    table: RegisterTable = "input"
    read_write: bool = True
    verify: bool = True
    watchdog: ModbusWatchdog | None = None
    dump_valve: ModbusDumpValve | None = None

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if (self.tcp is None) == (self.serial is None):
            raise ValueError("expected one of the keys 'tcp' and 'serial'")
        if self.serial is not None and not 1 <= self.unit <= 247:
            raise BadKeyError("unit", f"expected 1 to 247 on a serial line, not {self.unit}")
        for index, (channel, point) in enumerate(zip(self.channels, self.setpoints, strict=True)):
            low, high = point.pressure_range()
            if not low <= 0 <= high:
                reason = "the register cannot say 0 bar, so not vent"
                raise BadKeyError(f"channels.{index}.setpoint", reason)
            if channel.min is not None and channel.max is not None and channel.min > channel.max:
                raise BadKeyError(f"channels.{index}.max", "must be above min")
        self._check_addresses()
        return self

    def _check_addresses(self) -> None:
        """Refuse registers beyond the last address, and writes that overwrite a set-point."""
        taken = dict.fromkeys(self.watchdog.addresses if self.watchdog else (), "the watchdog")
        for index, point in enumerate(self.setpoints):
            for address in point.addresses:
                if address in taken:
                    raise BadKeyError(
                        f"channels.{index}.setpoint",
                        f"register {address} is that of {taken[address]}",
                    )
                taken[address] = f"channel {index + 1}"
        for index, point in (*enumerate(self.setpoints + self.read_backs), *self.readings.items()):
            if point.addresses[-1] > 0xFFFF:
                reason = f"its registers go beyond 65535, the last one: {point.address} is too high"
                raise BadKeyError(f"channels.{index % len(self.channels)}", reason)

    @property
    def setpoints(self) -> tuple[PressureRegister, ...]:
        """Register that commands each channel."""
        return tuple(self._point(c.setpoint, "holding") for c in self.channels)

    @property
    def read_backs(self) -> tuple[PressureRegister, ...]:
        """Register from which each channel's command is read back."""
        pairs = zip(self.channels, self.setpoints, strict=True)
        return tuple(
            point if c.setpoint.read_back is None else replace(point, address=c.setpoint.read_back)
            for c, point in pairs
        )

    @property
    def readings(self) -> dict[int, PressureRegister]:
        """Register of each measured channel, by channel, counted from 0."""
        return {
            index: self._point(c.reading, c.reading.table or self.table)
            for index, c in enumerate(self.channels)
            if c.reading is not None
        }

    @property
    def connection(self) -> ModbusTcp | ModbusSerial:
        """The connection to the device."""
        connection = self.tcp or self.serial
        if connection is None:
            raise InputError("expected one of the keys 'tcp' and 'serial'")
        return connection

    @property
    def exchange_time(self) -> float:
        """Least time of a command on a serial line, with its answers and readings, in s."""
        if self.serial is None:
            return 0.0
        joint = self.joint_run
        reads = self.verified_runs
        if joint is None:
            reads += self.measured_runs
        else:
            reads = tuple(run for run in reads if not run.is_within(joint))
        size = sum(_WRITE + 2 * run.count for run in self.written_runs)
        size += sum(_READ + 2 * run.count for run in reads)
        if joint is not None:
            size += _ALSO_READ + 2 * joint.count
        if self.watchdog is not None and self.watchdog.trigger is not None:
            size += _TRIGGER
        return size * self.serial.bits / self.serial.baudrate

    @property
    def written_runs(self) -> tuple[RegisterRun, ...]:
        """Registers that each command writes, a request each."""
        return runs_of(enumerate(self.setpoints))

    @property
    def verified_runs(self) -> tuple[RegisterRun, ...]:
        """Registers that are read back, a request each."""
        return runs_of(enumerate(self.read_backs)) if self.verify else ()

    @property
    def measured_runs(self) -> tuple[RegisterRun, ...]:
        """Registers of the readings, a request each."""
        return runs_of(self.readings.items())

    @property
    def joint_run(self) -> RegisterRun | None:
        """Registers to read by function 23, if it can write and read all at once."""
        readings = list(self.readings.items())
        verified = [item for run in self.verified_runs for item in run.points]
        if not self.read_write or len(self.written_runs) > 1:
            return None
        if any(run.table != "holding" for run in self.measured_runs):
            return None
        for points in (readings + verified, readings):
            runs = runs_of(points)
            if len(runs) == 1:
                return runs[0]
        return None

    def measures(self, channel: int) -> bool:
        """Whether the channel has a register of readings."""
        return self.channels[channel].reading is not None

    def _reach(self, channel: int) -> tuple[float, float]:
        return self.setpoints[channel].pressure_range()

    def _make(self, limits: PressureLimits, clock: Clock | None) -> ModbusSupply:
        for index, point in enumerate(self.setpoints):
            low, high = float(limits.low[index]), float(limits.high[index])
            try:
                point.encode(low or high, lowest=low, highest=high)
            except InputError as error:
                raise InputError(f"channel {index + 1}: {error}; widen its limits") from None
        return ModbusSupply(self, limits, clock)

    def _point(self, register: Any, table: str) -> PressureRegister:
        kind, scale = register.type or self.type, register.scale or self.scale
        return PressureRegister(register.address, table, kind, self.word_order, scale)


class ModbusSupply(PressureSupply):
    """Regulators behind Modbus.

    A request that fails is an error at once and ends the connection; the next one reconnects, once.
    Only zeros are ever sent twice, when the supply vents.
    """

    _line: ModbusLine

    def __init__(
        self, settings: ModbusSettings, limits: PressureLimits, clock: Clock | None = None
    ) -> None:
        super().__init__(limits, clock)
        self.settings = settings
        self._watched = 0  # number of the connection on which the watchdog was started
        self._beat = 0
        self._setpoints = settings.setpoints
        self._read_backs = settings.read_backs
        self._readings = settings.readings
        self._written = settings.written_runs
        self._verified = settings.verified_runs
        self._measured = settings.measured_runs
        self._joint = settings.joint_run
        self._held_registers: Registers | None = (
            None  # registers that the device must have; None: unknown
        )
        self.has_watchdog = settings.watchdog is not None
        self.has_dump_valve = settings.dump_valve is not None
        requests = len(self._written) + len(self._verified) + len(self._measured) + 1
        self.patience = requests * settings.timeout

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The address of the device, without its unit, which many devices ignore."""
        return self.settings.connection.endpoints()

    def prepare(self) -> None:
        """Import pymodbus, which takes a third of a second."""
        pymodbus_library("pymodbus.client")

    def _open(self) -> None:
        settings = self.settings
        self._watched = 0
        self._line = ModbusLine(settings.connection, settings.unit, settings.timeout)
        try:
            self._line.connect()
            self._watch()
        except BaseException:
            with suppress(DeviceError):  # even if the watchdog fails, vent
                self._write_once(self._encoded(np.zeros(self.n)), whatever_happens=True)
            self._line.close()
            raise

    def _close(self) -> None:
        self._line.close()

    def _watch(self) -> None:
        """Start the device's watchdog, once per connection, since the device may be a new one."""
        watchdog = self.settings.watchdog
        self._line.connect()
        if watchdog is None or self._watched == self._line.connections:
            return
        for item in watchdog.before:
            self._line.write(item.address, item.value)
        held = self._line.read("the time of the watchdog", "holding", watchdog.address, 1)
        if held != [watchdog.counts]:
            self._line.write(watchdog.address, watchdog.counts)
        for item in watchdog.after:
            self._line.write(item.address, item.value)
        self._watched = self._line.connections

    def _trigger(self) -> None:
        watchdog = self.settings.watchdog
        if watchdog is not None and watchdog.trigger is not None:
            self._beat = self._beat % 0xFFFF + 1
            self._line.write(watchdog.trigger, self._beat)

    # set-points ----------------------------------------------------------------------------------

    def _encoded(self, pressures: Array) -> Registers:
        """Return each channel's registers, always within its limits."""
        last = self.limits.clamp(pressures)
        channels = zip(self._setpoints, last, self.limits.low, self.limits.high, strict=True)
        return {
            index: point.encode(float(pressure), lowest=float(low), highest=float(high))
            for index, (point, pressure, low, high) in enumerate(channels)
        }

    def _write(self, pressures: Array) -> None:
        registers = self._encoded(pressures)
        if np.any(self.limits.clamp(pressures)):
            self._watch()
            self._write_once(registers)
        else:
            _insist(lambda: self._write_once(registers, whatever_happens=True))

    def _write_once(self, registers: Registers, *, whatever_happens: bool = False) -> None:
        self._held_registers = None
        errors: list[DeviceError] = []
        for run in self._written:
            try:
                values = values_of(run, registers)
                self._line.ask(f"write {run}", "write_registers", run.start, values)
            except DeviceError as error:
                errors.append(error)
                if not whatever_happens:
                    break
        if errors:
            raise errors[0]
        self._trigger()
        for run in self._verified:
            self._read_back(run, registers)
        self._held_registers = registers

    def _check_held(self) -> None:
        registers = self._held_registers
        if (
            registers is None or self.settings.serial is not None
        ):  # a serial line has only one master
            return
        for run in self._verified:
            self._read_back(run, registers)

    def _read_back(self, run: RegisterRun, registers: Registers) -> None:
        self._verify(run, self._line.read(str(run), run.table, run.start, run.count), registers)

    def _verify(self, run: RegisterRun, values: Sequence[int], registers: Registers) -> None:
        for channel, point in run.points:
            held, written = tuple(run.cut(values, point)), tuple(registers[channel])
            if point == self._read_backs[channel] and held != written:
                raise DeviceError(
                    f"{self.settings.connection}: register {point.address} of channel "
                    f"{channel + 1} holds {point.decode(held) * 1e-5:.6g} bar after "
                    f"{point.decode(written) * 1e-5:.6g} bar was written; does another program "
                    "write to it, has the device's watchdog run out, or does the device read it "
                    "back at another address?"
                )

    # readings ------------------------------------------------------------------------------------

    def _read(self) -> ArrayLike:
        pressures = np.full(self.n, np.nan)
        for run in self._measured:
            values = self._line.read(str(run), run.table, run.start, run.count)
            self._decode(run, values, pressures)
        return pressures

    def _decode(self, run: RegisterRun, values: Sequence[int], pressures: Array) -> None:
        for channel, point in run.points:
            if self._readings.get(channel) == point:
                pressures[channel] = point.decode(run.cut(values, point))

    def _exchange(self, pressures: Array) -> ArrayLike | None:
        joint = self._joint
        if joint is None:
            return None
        self._watch()
        registers, (written,) = self._encoded(pressures), self._written
        self._held_registers = None
        what = f"write {written} and read {joint}"
        addresses = {"read_address": joint.start, "write_address": written.start}
        try:
            values = self._line.ask_registers(
                what,
                joint.count,
                "readwrite_registers",
                **addresses,
                read_count=joint.count,
                values=values_of(written, registers),
            )
        except ModbusRefusedError as error:
            if error.code != _ILLEGAL_FUNCTION:
                raise
            self._joint = None  # the device did nothing; use two requests from now on
            return None
        self._trigger()
        measured = np.full(self.n, np.nan)
        self._decode(joint, values, measured)
        for run in self._verified:
            if run.is_within(joint):
                self._verify(joint, values, registers)
            else:
                self._read_back(run, registers)
        self._held_registers = registers
        return measured

    # dump valve ----------------------------------------------------------------------------------

    def _dump(self, *, open_valve: bool) -> None:
        valve = self.settings.dump_valve
        if valve is None:
            return
        what = f"{'open' if open_valve else 'close'} the dump valve (coil {valve.coil})"
        state = valve.coil_for(open_valve=open_valve)
        if open_valve:
            _insist(lambda: self._line.ask(what, "write_coil", valve.coil, state))
        else:
            self._line.ask(what, "write_coil", valve.coil, state)


def _insist(act: Callable[[], object]) -> None:
    """Send a request that makes the arm safe; if it fails, repeat it on a new connection."""
    try:
        act()
    except DeviceError:
        act()


class ModbusRefusedError(DeviceError):
    """The device has refused the request. `code`: exception code of the protocol."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class ModbusLine:
    """Sends requests to a device and returns its answers.

    A request that fails ends the connection; the next one reconnects, once. No request is ever sent
    twice, and none is sent after `close`: a closed line stays closed. Any thread may call any
    method.

    Parameters
    ----------
    address : the connection.
    unit : number of the device on the line.
    timeout : time for each answer, in s.

    Attributes
    ----------
    connections : number of connections so far.
    """

    def __init__(
        self,
        address: ModbusTcp | ModbusSerial,
        unit: int,
        timeout: float,
    ) -> None:
        self.address = address
        self.unit = unit
        self.timeout = timeout
        self.connections = 0
        self._client = address.client(timeout=timeout, retries=0)
        self._failures = (pymodbus_library("pymodbus.exceptions").ModbusException, *_FAILURES)
        self._connected = self._closed = False
        self._lock = RLock()

    def connect(self) -> None:
        """Connect, unless there is a connection."""
        with self._lock:
            if self._closed:
                raise DeviceError(f"the connection to {self.address} is closed; nothing was sent")
            if self._connected:
                return
            if not self._client.connect():
                raise DeviceError(f"{self.address} cannot be reached; {self.address.advice}")
            self._connected = True
            self.connections += 1

    def disconnect(self) -> None:
        """End the connection; the next request makes a new one."""
        with self._lock:
            self._connected = False
            self._client.close()

    def close(self) -> None:
        """End the connection for good, after the answer to a request under way."""
        with self._lock:
            self._closed = True
            self.disconnect()

    def ask(self, what: str, function: str, *args: Any, **options: Any) -> Any:
        """Send one request and return the answer.

        `what`: the request in words, for messages. `function`, `args`, `options`: method of
        pymodbus's client and its arguments. Raises `ModbusRefusedError`: the device refuses;
        `DeviceError`: it does not answer, or answers wrongly.
        """
        with self._lock:
            self.connect()
            try:
                method = getattr(self._client, function)
                answer = method(*args, device_id=self.unit, **options)
            except BaseException as error:
                # A late answer must not be taken for that to the next request.
                self.disconnect()
                if not isinstance(error, self._failures):
                    raise
                reason = _reason(error, self.timeout)
                raise DeviceError(f"{self.address} does not answer: {what}; {reason}") from None
            code = answer.function_code
            echo = answer.address if function.startswith("write") and code < 0x80 else None
            if code & 0x7F != _CODES[function] or (echo is not None and echo != args[0]):
                self.disconnect()  # the answer may be to an earlier request, unnoticed by pymodbus
                raise DeviceError(f"{self.address} sent an unexpected answer: {what}")
        if code >= 0x80:
            reason = _EXCEPTIONS.get(answer.exception_code, "it does not say why")
            message = f"{self.address} refuses: {what}; exception {answer.exception_code}, {reason}"
            raise ModbusRefusedError(message, answer.exception_code)
        return answer

    def ask_registers(self, what: str, n: int, function: str, *args: Any, **opts: Any) -> list[int]:
        """Send a request and return the `n` registers of the answer."""
        with self._lock:
            registers = self.ask(what, function, *args, **opts).registers
            if len(registers) != n:
                self.disconnect()
                got = len(registers)
                raise DeviceError(f"{self.address} sends {got} registers, not {n}: {what}")
        return list(registers)

    def read(self, what: str, table: str, start: int, n: int) -> list[int]:
        """Read `n` registers of the table ``holding`` or ``input``."""
        return self.ask_registers(f"read {what}", n, f"read_{table}_registers", start, count=n)

    def write(self, address: int, value: int) -> None:
        """Write one holding register."""
        self.ask(f"write {value} to register {address}", "write_register", address, value)


def _reason(error: BaseException, timeout: float) -> str:
    text = str(getattr(error, "string", "") or error).strip().rstrip(".")
    if "No response" in text:
        return f"nothing came within {timeout:g} s"
    if type(error).__name__ == "ConnectionException":
        return "the connection broke"
    return text or type(error).__name__


def pymodbus_library(name: str) -> Any:
    """Import a part of pymodbus, or pyserial, which it needs for serial lines."""
    package = "pyserial" if name == "serial" else "pymodbus"
    module = library(name, package, ModbusSettings.extra)
    log = logging.getLogger("pymodbus.logging")
    if not log.handlers:  # otherwise it prints what is raised anyway
        log.addHandler(logging.NullHandler())
    return module
