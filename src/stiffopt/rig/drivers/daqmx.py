"""NI-DAQmx for the drivers that use it: the connection, and tasks with one job each.

The driver software is on this machine or behind NI's gRPC device server. nidaqmx gives its gRPC
calls no deadline: if a server hung, its caller would hang for ever. Here every call has one, and
every failure becomes a `DeviceError`. If a server is unreachable while tasks are closed, it keeps
their channels; they are closed when it is reachable again.
"""

from __future__ import annotations

import importlib
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, InputError, shown
from stiffopt.rig.device import library

Terminals = Literal["default", "rse", "nrse", "differential", "pseudo-differential"]

_RESERVED = -50103
_NO_ANSWER = ("DEADLINE_EXCEEDED", "UNAVAILABLE", "CANCELLED")  # names of gRPC's status codes
_EXPIRED = (-200678, -200644)  # errors of a write or a timer reset after the watchdog has expired
_HINTS = {
    _RESERVED: "close the program that uses the device, or reset the device in NI MAX",
    -200220: "check the name of the device in NI MAX",
    -200170: "check the name of the channel in NI MAX",
    -201003: "check its cable and power",
    **dict.fromkeys(_EXPIRED, "reset the device in NI MAX"),
}
_TERMINALS = {"differential": "DIFF", "pseudo-differential": "PSEUDO_DIFF"}
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


def _channel(pattern: str, example: str) -> Any:
    return Field(pattern=rf"^[A-Za-z0-9_ -]+/{pattern}$", examples=[example])


OutputName = Annotated[str, _channel(r"ao\d+", "Dev1/ao0")]
InputName = Annotated[str, _channel(r"(ai\d+|_\w+)", "Dev1/ai0")]
LineName = Annotated[str, _channel(r"port\d+/line\d+", "Dev1/port0/line0")]


class WatchdogExpiredError(DeviceError):
    """The device's watchdog has expired, and it ignores digital writes."""


class SilentError(DeviceError):
    """The server has not answered in time."""


_left: dict[str, deque[Any]] = defaultdict(deque)
"""Tasks that could not be closed, by the address of the server that holds them."""


class Daqmx:
    """Connection to NI-DAQmx, which makes tasks; it first closes tasks left over from earlier.

    Raises `DeviceError`: the server still does not answer, and tasks were left on it.

    Parameters
    ----------
    address : address of NI's gRPC device server; None: the driver on this machine.
    timeout : timeout of every call, in s.
    extra : stiffopt's extra with nidaqmx, for the message if it is missing.
    """

    def __init__(self, address: str | None, timeout: float, extra: str) -> None:
        self.timeout = timeout
        self.nidaqmx = library("nidaqmx", "nidaqmx", extra)
        self.silent = False
        """Whether the server has not answered when a task was closed."""
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
        """Remember a task that the server did not close, by nidaqmx's handle."""
        if self._address and handle is not None:
            _left[self._address].append(handle)

    def _close_left(self, address: str) -> None:
        if not _left[address]:
            return
        interpreter = importlib.import_module("nidaqmx._grpc_interpreter").GrpcStubInterpreter(
            self.options["grpc_options"]
        )
        with suppress(IndexError):
            while handle := _left[address].pop():  # each is closed by one thread
                try:
                    with self.errors("closing a task that was left behind"):
                        interpreter.clear_task(handle)
                except SilentError:
                    _left[address].append(handle)
                    raise
                except DeviceError:
                    continue  # the server has restarted and does not know it

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments for making a task on the server, or here."""
        if self._channel is None:
            return {}
        module = importlib.import_module("nidaqmx.grpc_session_options")
        channel = _with_deadline(self._grpc, self._channel, self.timeout)
        return {"grpc_options": module.GrpcSessionOptions(channel, "")}

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Turn nidaqmx's exceptions into a sentence that begins with the operation."""
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


class InputChannel(NamedTuple):
    """An analogue input and how it is wired; voltages in V."""

    name: str
    terminals: str
    low: float
    high: float


class _Task:
    """A DAQmx task with one job; it is closed again if its set-up fails."""

    def __init__(self, daq: Daqmx, doing: str) -> None:
        self._daq = daq
        self._doing = doing
        self._task: Any = None
        with daq.errors(doing):
            self._task = self._make()
        try:
            with daq.errors(doing):
                self._set_up()
        except BaseException:
            self.close()
            raise

    def _make(self) -> Any:
        return self._daq.nidaqmx.Task(**self._daq.options)

    def _set_up(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Clear the task, whatever its state; a second call does nothing."""
        task, self._task = self._task, None
        if task is None:
            return
        handle, left = task._handle, True  # nidaqmx forgets the handle even if closing fails
        try:
            if not self._daq.silent:
                with self._daq.errors(self._doing):
                    task.close()  # stops it first
                left = False
        except SilentError:
            self._daq.silent = True  # do not wait again for the next task
        except DeviceError:
            left = False  # the server answered: it no longer has the task
        finally:
            if left:
                self._daq.leave(handle)
            task._handle = None  # otherwise nidaqmx warns when the task is collected


class AnalogueOutput(_Task):
    """Voltages, all written at once; meanwhile no other program can use the channels."""

    def __init__(self, daq: Daqmx, channels: Sequence[tuple[str, float, float]]) -> None:
        self._channels = channels
        super().__init__(daq, f"opening {', '.join(name for name, _, _ in channels)}")

    def _set_up(self) -> None:
        for name, low, high in self._channels:
            self._task.ao_channels.add_ao_voltage_chan(name, min_val=low, max_val=high)
        writers = importlib.import_module("nidaqmx.stream_writers")
        self._writer = writers.AnalogMultiChannelWriter(self._task.out_stream, auto_start=True)
        self._writer.verify_array_shape = False  # the check would query the device each time
        self._task.start()

    def write(self, volts: Array) -> None:
        """Write voltages (n,), in V."""
        with self._daq.errors("writing the set-points"):
            self._writer.write_one_sample(volts, timeout=self._daq.timeout)


class AnalogueInput(_Task):
    """Voltages, all read at once.

    `shared`: whether another task reads inputs of the same device. If so, reserve it only while
    reading, which is slower.
    """

    def __init__(
        self, daq: Daqmx, channels: Sequence[InputChannel], *, shared: bool = False
    ) -> None:
        self._channels = channels
        self._shared = shared
        super().__init__(daq, f"opening {', '.join(channel.name for channel in channels)}")

    def _set_up(self) -> None:
        terminals = self._daq.nidaqmx.constants.TerminalConfiguration
        for name, wiring, low, high in self._channels:
            self._task.ai_channels.add_ai_voltage_chan(
                name,
                terminal_config=terminals[_TERMINALS.get(wiring, wiring.upper())],
                min_val=low,
                max_val=high,
            )
        readers = importlib.import_module("nidaqmx.stream_readers")
        self._reader = readers.AnalogMultiChannelReader(self._task.in_stream)
        self._reader.verify_array_shape = False
        if not self._shared:
            self._task.start()

    def read(self) -> Array:
        """Return voltages (n,), in V."""
        volts = np.full(len(self._channels), np.nan)
        give_up = time.monotonic() + self._daq.timeout
        while True:
            try:
                with self._daq.errors("reading the inputs"):
                    self._reader.read_one_sample(volts, timeout=self._daq.timeout)
                return volts
            except DeviceError as error:
                busy = self._shared and f"NI-DAQmx {_RESERVED}" in str(error)
                if not busy or time.monotonic() > give_up:
                    raise
            time.sleep(0.001)  # the other task's reading takes about as long


class DigitalOutput(_Task):
    """A digital line."""

    def __init__(self, daq: Daqmx, line: str) -> None:
        self._line = line
        super().__init__(daq, f"opening {line}")

    def _set_up(self) -> None:
        self._task.do_channels.add_do_chan(self._line)
        writers = importlib.import_module("nidaqmx.stream_writers")
        self._writer = writers.DigitalSingleChannelWriter(self._task.out_stream, auto_start=True)
        self._writer.verify_array_shape = False

    def write(self, *, high: bool) -> None:
        """Drive the line high or low."""
        with self._daq.errors(f"writing {self._line}"):
            self._writer.write_one_sample_one_line(high, timeout=self._daq.timeout)


class WatchdogTask(_Task):
    """The device's own timer: unless it is fed in time, the device sets a digital line itself."""

    def __init__(self, daq: Daqmx, line: str, timeout: float, *, high: bool) -> None:
        self._line, self._timeout, self._high = line, timeout, high
        self.running = False
        super().__init__(daq, f"setting up the watchdog of {line}")

    def _make(self) -> Any:
        system = importlib.import_module("nidaqmx.system.watchdog")
        device = self._line.split("/")[0]
        return system.WatchdogTask(device, timeout=self._timeout, **self._daq.options)

    def _set_up(self) -> None:
        constants = self._daq.nidaqmx.constants
        state = importlib.import_module("nidaqmx.types").DOExpirationState(
            physical_channel=self._line,
            expiration_state=constants.Level.HIGH if self._high else constants.Level.LOW,
        )
        self._task.cfg_watchdog_do_expir_states([state])

    def start(self) -> None:
        """Start the timer, or restart it."""
        if self.running:
            self.feed()
            return
        with self._daq.errors("starting the watchdog"):
            self._task.control(self._daq.nidaqmx.constants.TaskMode.TASK_START)
        self.running = True

    def feed(self) -> None:
        """Restart the timer. Raises `WatchdogExpiredError`: it has expired."""
        with self._daq.errors("feeding the watchdog"):
            self._task.reset_timer()

    def stop(self) -> None:
        """Stop the timer."""
        with self._daq.errors("stopping the watchdog"):
            self._task.control(self._daq.nidaqmx.constants.TaskMode.TASK_STOP)
        self.running = False

    def clear(self) -> None:
        """Make the device accept digital writes again after the watchdog has expired."""
        with self._daq.errors("clearing the watchdog"):
            self._task.clear_expiration()
