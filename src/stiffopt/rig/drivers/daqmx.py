"""NI-DAQmx, on this machine or behind NI's gRPC device server, for the drivers that use it.

nidaqmx gives its gRPC calls no deadline: a server that hangs would hang its caller for ever. Here
every call gets one, and every failure becomes a `DeviceError`. A server that is gone when tasks
are closed still holds their channels when it comes back: they are closed then.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from stiffopt.errors import DeviceError, InputError, MissingExtraError, shown
from stiffopt.schema import items_of

__all__ = [
    "RESERVED",
    "Address",
    "Daqmx",
    "InputName",
    "LineName",
    "OutputName",
    "Pair",
    "SilentError",
    "Terminals",
    "WatchdogExpiredError",
    "library",
]

ItemT = TypeVar("ItemT")

Pair = Annotated[tuple[ItemT, ItemT], BeforeValidator(items_of(2))]
"""Two items: low and high, or two points of a line."""
Terminals = Literal["default", "rse", "nrse", "differential", "pseudo-differential"]

RESERVED = -50103
_NO_ANSWER = ("DEADLINE_EXCEEDED", "UNAVAILABLE", "CANCELLED")  # by the names of gRPC
_EXPIRED = (-200678, -200644)  # a write, a reset of the timer after the watchdog has expired
_HINTS = {
    RESERVED: "close the program that uses the device, or reset the device in NI MAX",
    -200220: "check the name of the device in NI MAX",
    -200170: "check the name of the channel in NI MAX",
    -201003: "check its cable and power",
    **dict.fromkeys(_EXPIRED, "reset the device in NI MAX"),
}
_INSTALL = (
    "NI's driver is not on this machine; install NI-DAQmx (ni.com/downloads, 'NI-DAQmx'), or run "
    "NI's gRPC device server on the machine that has it and give its address as 'grpc'"
)


def _address(text: str) -> str:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"{shown(text)} is not an address; expected one such as '10.0.0.5:31763'")
    return text


Address = Annotated[str, AfterValidator(_address)]
"""Host and port of a server."""


def _channel(pattern: str) -> Any:
    return Field(pattern=rf"^[A-Za-z0-9_ -]+/{pattern}$")


OutputName = Annotated[str, _channel(r"ao\d+")]
InputName = Annotated[str, _channel(r"(ai\d+|_\w+)")]
LineName = Annotated[str, _channel(r"port\d+/line\d+")]


class WatchdogExpiredError(DeviceError):
    """The device's watchdog has expired, and it ignores digital writes."""


def library(module: str, package: str, extra: str) -> Any:
    """Import a library that may not be installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise MissingExtraError(package, extra) from None


class SilentError(DeviceError):
    """The server has not answered, or not in time."""


class _LeftTasks:
    """Tasks that this program could not close, by the address of the server that holds them."""

    def __init__(self) -> None:
        self._handles: dict[str, list[Any]] = {}
        self._lock = Lock()

    def add(self, address: str, handle: Any) -> None:
        with self._lock:
            self._handles.setdefault(address, []).append(handle)

    def take(self, address: str) -> list[Any]:
        with self._lock:
            return self._handles.pop(address, [])


_left = _LeftTasks()


class Daqmx:
    """What makes tasks, after closing those that this program has left on the server.

    Parameters
    ----------
    address :
        Of NI's gRPC device server; None: the driver on this machine.
    timeout :
        Of every call, in s.
    extra :
        Of stiffopt that brings nidaqmx, for the message when it is missing.

    Raises
    ------
    DeviceError
        The server still does not answer, and tasks have been left on it.
    """

    def __init__(self, address: str | None, timeout: float, extra: str) -> None:
        self.timeout = timeout
        self.nidaqmx = library("nidaqmx", "nidaqmx", extra)
        self.silent = False
        """Whether the server has left a task that was to be closed without an answer."""
        self._address = address
        self._where = f"the NI-DAQ server at {address}" if address else "NI-DAQmx"
        self._channel: Any = None
        self._grpc: Any = None
        if address:
            self._grpc = library("grpc", "nidaqmx[grpc]", extra)
            options = [("grpc.enable_http_proxy", 0)]  # the server is on the lab's own network
            self._channel = self._grpc.insecure_channel(address, options=options)
            try:
                self._close_left(address)
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Close the connection to the server."""
        if self._channel is not None:
            self._channel.close()

    def leave(self, handle: Any) -> None:
        """Keep in mind a task that the server did not close, by nidaqmx's name for it."""
        if self._address and handle is not None:
            _left.add(self._address, handle)

    def _close_left(self, address: str) -> None:
        handles = _left.take(address)
        if not handles:
            return
        interpreter = importlib.import_module("nidaqmx._grpc_interpreter").GrpcStubInterpreter(
            self.options["grpc_options"]
        )
        try:
            while handles:
                try:
                    with self.errors("closing a task that was left behind"):
                        interpreter.clear_task(handles[-1])
                except SilentError:
                    raise
                except DeviceError:
                    pass  # the server has started anew and does not know it
                handles.pop()
        finally:
            for handle in handles:
                _left.add(address, handle)

    @property
    def options(self) -> dict[str, Any]:
        """Keywords with which a task is made on the server, or here."""
        if self._channel is None:
            return {}
        module = importlib.import_module("nidaqmx.grpc_session_options")
        channel = _with_deadline(self._grpc, self._channel, self.timeout)
        return {"grpc_options": module.GrpcSessionOptions(channel, "")}

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Turn what nidaqmx raises into a sentence that begins with what was being done."""
        errors = self.nidaqmx.errors
        try:
            yield
        except (errors.DaqNotFoundError, errors.DaqNotSupportedError):
            raise DeviceError(f"{doing} failed: {_INSTALL}") from None
        except errors.RpcError as error:
            silent = getattr(error.rpc_code, "name", "") in _NO_ANSWER
            kind = SilentError if silent else DeviceError
            raise kind(f"{doing} failed: {self._unreachable(error)}") from None
        except errors.DaqError as error:
            code = int(error.error_code)
            expired = code in _EXPIRED
            hint = _HINTS.get(code)
            raise (WatchdogExpiredError if expired else DeviceError)(
                f"{doing} failed: {_first_sentence(error)} (NI-DAQmx {code})"
                + (f"; {hint}" if hint else "")
            ) from None
        except (errors.Error, OSError, ValueError) as error:
            raise DeviceError(f"{doing} failed: {_first_sentence(error)}") from None

    def _unreachable(self, error: Any) -> str:
        name = getattr(error.rpc_code, "name", str(error.rpc_code))
        if name == "UNAVAILABLE":
            return f"{self._where} cannot be reached; check that it runs and its address"
        if name == "DEADLINE_EXCEEDED":
            return f"{self._where} has not answered for {self.timeout:g} s"
        return f"{self._where} says {name}: {_first_sentence(error.description)}"


def _with_deadline(grpc: Any, channel: Any, timeout: float) -> Any:
    class Deadline(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]
        def intercept_unary_unary(self, proceed: Any, details: Any, request: Any) -> Any:
            return proceed(details._replace(timeout=timeout), request)

    return grpc.intercept_channel(channel, Deadline())


def _first_sentence(error: object) -> str:
    """Return the first paragraph of NI's text as one line without its full stop."""
    return " ".join(str(error).strip().split("\n\n")[0].split()).rstrip(".")
