"""The line to a Modbus device, over TCP or serial: one request, one answer, or a `DeviceError`."""

from __future__ import annotations

import importlib
import logging
import struct
from threading import RLock
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from stiffopt.errors import DeviceError, MissingExtraError
from stiffopt.rig.endpoints import serial_endpoints, tcp_endpoints
from stiffopt.schema import Schema

__all__ = ["ModbusLine", "RefusedError", "SerialLine", "Tcp", "library"]

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


class Tcp(Schema):
    """Modbus TCP.

    Attributes
    ----------
    host : name or IP address of the device.
    port : 0 stands for any free port, in the virtual lab alone.
    """

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=0, le=65535)] = 502

    advice: ClassVar[str] = "is it switched on, and are host and port right?"

    def __str__(self) -> str:
        return f"the Modbus device at {self.host}:{self.port}"

    def endpoints(self) -> tuple[str, ...]:
        """Return what a supply at this address is claimed by."""
        return tcp_endpoints(self.host, self.port)

    def client(self, **options: Any) -> Any:
        """Return pymodbus's client."""
        return library("pymodbus.client").ModbusTcpClient(self.host, port=self.port, **options)


class SerialLine(Schema):
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
        """Return what a supply on this line is claimed by."""
        return serial_endpoints(self.port)

    def options(self) -> dict[str, Any]:
        """Return the settings by pymodbus's names."""
        parity = self.parity[0].upper()
        return {"baudrate": self.baudrate, "parity": parity, "stopbits": self.stop_bits}

    def client(self, **options: Any) -> Any:
        """Return pymodbus's client."""
        library("serial")
        client = library("pymodbus.client").ModbusSerialClient
        return client(self.port, **self.options(), **options)


class RefusedError(DeviceError):
    """The device has answered that it will not do it.

    Attributes
    ----------
    code : exception code of the protocol.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class ModbusLine:
    """Sends requests to a device and returns its answers.

    A request that fails ends the connection; the next one connects anew, once. No request is
    ever sent twice, and none is sent after `close`: a closed line stays closed. Any thread may call
    any method.

    Parameters
    ----------
    address :
        How the device is reached.
    unit :
        Its number on the line.
    timeout :
        For each answer, in s.

    Attributes
    ----------
    connections : how often it has connected.
    """

    def __init__(
        self,
        address: Tcp | SerialLine,
        unit: int,
        timeout: float,
    ) -> None:
        self.address = address
        self.unit = unit
        self.timeout = timeout
        self.connections = 0
        self._client = address.client(timeout=timeout, retries=0)
        self._failures = (library("pymodbus.exceptions").ModbusException, *_FAILURES)
        self._connected = self._closed = False
        self._lock = RLock()

    def connect(self) -> None:
        """Connect, where there is no connection."""
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
        """End the connection for good, when the request that is under way has its answer."""
        with self._lock:
            self._closed = True
            self.disconnect()

    def ask(self, what: str, function: str, *args: Any, **options: Any) -> Any:
        """Send one request and return the answer.

        Parameters
        ----------
        what :
            What is asked for, in words, for messages.
        function, args, options :
            Method of pymodbus's client and its arguments.

        Raises
        ------
        RefusedError
            The device refuses.
        DeviceError
            It does not answer, or not as it should.
        """
        with self._lock:
            self.connect()
            try:
                method = getattr(self._client, function)
                answer = method(*args, device_id=self.unit, **options)
            except BaseException as error:
                # Whatever it was: a late answer must not be taken for that to the next request.
                self.disconnect()
                if not isinstance(error, self._failures):
                    raise
                reason = _reason(error, self.timeout)
                raise DeviceError(f"{self.address} does not answer: {what}; {reason}") from None
            code = answer.function_code
            echo = answer.address if function.startswith("write") and code < 0x80 else None
            if code & 0x7F != _CODES[function] or (echo is not None and echo != args[0]):
                self.disconnect()  # it may answer an earlier request; pymodbus lets it pass
                raise DeviceError(f"{self.address} answers something else: {what}")
        if code >= 0x80:
            reason = _EXCEPTIONS.get(answer.exception_code, "it does not say why")
            message = f"{self.address} refuses: {what}; exception {answer.exception_code}, {reason}"
            raise RefusedError(message, answer.exception_code)
        return answer

    def ask_registers(self, what: str, n: int, function: str, *args: Any, **opts: Any) -> list[int]:
        """Send a request that is answered with `n` registers, and return these."""
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


_FAILURES = (OSError, struct.error, IndexError, ValueError)
"""What pymodbus lets through when a device is gone or talks nonsense, besides its own errors."""


def _reason(error: BaseException, timeout: float) -> str:
    text = str(getattr(error, "string", "") or error).strip().rstrip(".")
    if "No response" in text:
        return f"nothing came within {timeout:g} s"
    if type(error).__name__ == "ConnectionException":
        return "the connection broke"
    return text or type(error).__name__


def library(name: str) -> Any:
    """Import pymodbus, or pyserial, which it needs for serial lines, or a part of them."""
    try:
        module = importlib.import_module(name)
    except ImportError:
        package = "pyserial" if name == "serial" else "pymodbus"
        raise MissingExtraError(package, "modbus") from None
    log = logging.getLogger("pymodbus.logging")
    if not log.handlers:  # else it prints what is raised as an error anyway
        log.addHandler(logging.NullHandler())
    return module
