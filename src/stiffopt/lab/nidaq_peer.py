"""The virtual lab's NI-DAQ devices: a gRPC server for the real nidaqmx, and regulators behind it.

The server is built on nidaqmx's own stubs. It implements the calls for tasks with voltages, digital
lines and watchdogs, and refuses all others like NI's server.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from queue import SimpleQueue
from threading import Event, RLock, Thread, Timer
from typing import Any
from uuid import uuid4

from stiffopt.errors import DeviceError
from stiffopt.lab.bench import FULL_SCALE, Bench, DevicePeer
from stiffopt.rig.device import library
from stiffopt.rig.drivers.nidaq import NidaqInput, NidaqOutput, NidaqSettings

LATE = 0.3  # s, delay of a slow device's answers
THREADS = 8

_VERSION = {0x1272: 24, 0x1923: 5, 0x2F22: 0}  # of the driver: major, minor, update
_EXPIRED = 0x21A8
_HIGH = 10192
_CHANNEL_MISSING = (-200170, "Physical channel specified does not exist on this device.")
_NO_TASK = (-200088, "Task specified is invalid or does not exist.")
_RESERVED = (-50103, "The specified resource is reserved.")
_OUT_OF_RANGE = (-200561, "Attempted writing analog data that is too large or too small.")
_WRITE_EXPIRED = (-200678, "Write cannot be performed because the watchdog timer has expired.")
_RESET_EXPIRED = (-200644, "Watchdog timer cannot be reset because it has expired.")
_BAD_ATTRIBUTE = (-200233, "Specified property is not supported by the device.")
_START, _STOP, _ABORT = 0, 1, 6
_FEED, _CLEAR = 0, 1


class _NiError(Exception):
    """An error to answer with: number and text."""


@dataclass
class _Session:
    """A task; `ranges` are those of its channels, in V."""

    kind: str = ""
    channels: list[str] = field(default_factory=list)
    ranges: list[tuple[float, float]] = field(default_factory=list)
    started: bool = False
    watchdog: _Watchdog | None = None

    @property
    def device(self) -> str:
        return self.channels[0].split("/")[0] if self.channels else ""


class _Watchdog:
    """Sets its lines and locks them when it is not fed in time."""

    def __init__(self, timeout: float, act: Callable[[dict[str, bool]], None]) -> None:
        self.timeout = timeout
        self.states: dict[str, bool] = {}
        self.expired = False
        self._act = act
        self._timer: Timer | None = None

    def start(self) -> None:
        self.stop()
        self._timer = Timer(self.timeout, self._expire)
        self._timer.daemon = True
        self._timer.start()

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None

    @property
    def running(self) -> bool:
        return self._timer is not None

    def _expire(self) -> None:
        self._act(self.states)
        self.expired = True


class DaqServer:
    """An emulated NI-DAQ device behind NI's gRPC server, until it is closed.

    Parameters
    ----------
    address : address to listen on, on this machine; None: any free port.
    extra : stiffopt's extra with nidaqmx, for the message if it is missing.
    outputs, inputs, lines : by name, functions that accept the voltage of an analogue output,
        return that of an analogue input, and accept the level of a digital line.
    fault : returns the fault of the device: ``ok``, ``off``, ``slow`` and others.
    """

    def __init__(
        self,
        address: str | None,
        extra: str,
        *,
        outputs: Mapping[str, Callable[[float], None]] | None = None,
        inputs: Mapping[str, Callable[[], float]] | None = None,
        lines: Mapping[str, Callable[[bool], None]] | None = None,
        fault: Callable[[], str] = lambda: "ok",
    ) -> None:
        self._wanted = address
        self._extra = extra
        self._outputs, self._inputs, self._lines = outputs or {}, inputs or {}, lines or {}
        self._fault = fault
        self._sessions: dict[str, _Session] = {}
        self._locked = False  # whether an expired watchdog makes it refuse digital writes
        self._lock = RLock()
        self._closing = Event()
        self._server: Any = None
        self._threads: LastingThreads | None = None

    def start(self) -> str:
        """Listen, and return the address."""
        grpc = library("grpc", "nidaqmx[grpc]", self._extra)
        self._messages = library("nidaqmx._stubs.nidaqmx_pb2", "nidaqmx[grpc]", self._extra)
        threads = LastingThreads(THREADS, "daq-server")
        # Without this option two servers may listen on one port and share the calls.
        server = grpc.server(threads, options=[("grpc.so_reuseport", 0)])
        handlers = {name: self._handler(grpc, name, call) for name, call in self._calls().items()}
        service = grpc.method_handlers_generic_handler("nidaqmx_grpc.NiDAQmx", handlers)
        server.add_generic_rpc_handlers((service,))
        wanted = self._wanted or "127.0.0.1:0"
        try:
            port = server.add_insecure_port(wanted)
        except RuntimeError:
            threads.shutdown()
            raise DeviceError(
                f"the virtual NI-DAQ device cannot listen on {wanted}: the port is in use; "
                "end what uses it, or remove 'grpc' to take a free one"
            ) from None
        server.start()
        self._server, self._threads = server, threads
        return f"127.0.0.1:{port}"

    def close(self) -> None:
        """End all sessions and threads; a second call does nothing."""
        self._closing.set()
        if sys.is_finalizing():  # stopping needs a new thread, which cannot start any more
            return
        server, self._server = self._server, None
        threads, self._threads = self._threads, None
        if server is not None:
            server.stop(grace=0).wait()
        if threads is not None:
            threads.shutdown()
        with self._lock:
            for session in self._sessions.values():
                if session.watchdog is not None:
                    session.watchdog.stop()
            self._sessions.clear()

    def _calls(self) -> dict[str, Callable[[Any], dict[str, Any]]]:
        return {
            "GetSystemInfoAttributeUInt32": self._version,
            "GetErrorString": lambda request: {"error_string": f"Error {request.error_code}"},
            "CreateTask": lambda request: self._created(_Session()),
            "CreateWatchdogTimerTaskEx": self._create_watchdog,
            "ClearTask": self._clear,
            "StartTask": lambda request: self._control(request, _START),
            "StopTask": lambda request: self._control(request, _STOP),
            "TaskControl": lambda request: self._control(request, request.action_raw),
            "GetTaskAttributeString": lambda request: {"value": request.task.name},
            "CreateAOVoltageChan": lambda r: self._add(r, "ao", r.physical_channel),
            "CreateAIVoltageChan": lambda r: self._add(r, "ai", r.physical_channel),
            "CreateDOChan": lambda r: self._add(r, "do", r.lines),
            "WriteAnalogF64": self._write,
            "ReadAnalogF64": self._read,
            "WriteDigitalLines": self._write_lines,
            "CfgWatchdogDOExpirStates": self._expiration,
            "ControlWatchdogTask": self._control_watchdog,
            "GetWatchdogAttributeBool": self._watchdog_attribute,
        }

    def _handler(self, grpc: Any, name: str, call: Callable[[Any], dict[str, Any]]) -> Any:
        response = getattr(self._messages, f"{name}Response")

        def answer(request: Any, context: Any) -> Any:
            if not self._answers(context):
                context.abort(grpc.StatusCode.CANCELLED, "")
            try:
                with self._lock:
                    return response(status=0, **call(request))
            except _NiError as error:
                code, text = error.args
                context.set_trailing_metadata((("ni-error", str(code)),))
                context.abort(grpc.StatusCode.UNKNOWN, text)

        return grpc.unary_unary_rpc_method_handler(
            answer,
            request_deserializer=getattr(self._messages, f"{name}Request").FromString,
            response_serializer=response.SerializeToString,
        )

    def _answers(self, context: Any) -> bool:
        """Return whether to answer a call; while the device is off, wait until the client ends."""
        fault = self._fault()
        if fault == "slow":
            self._closing.wait(LATE)
        while fault == "off" and context.is_active() and not self._closing.wait(0.02):
            pass
        return fault != "off"

    def _created(self, session: _Session) -> dict[str, Any]:
        name = f"task-{uuid4()}"  # a name that no earlier server has used
        self._sessions[name] = session
        return {"task": {"name": name}, "new_session_initialized": True}

    def _session(self, request: Any) -> _Session:
        if request.task.name not in self._sessions:
            raise _NiError(*_NO_TASK)
        return self._sessions[request.task.name]

    def _watchdog(self, request: Any) -> _Watchdog:
        watchdog = self._session(request).watchdog
        if watchdog is None:
            raise _NiError(*_NO_TASK)
        return watchdog

    def _version(self, request: Any) -> dict[str, Any]:
        return {"value": _VERSION.get(request.attribute_raw, 0)}

    def _clear(self, request: Any) -> dict[str, Any]:
        session = self._session(request)
        if session.watchdog is not None:
            session.watchdog.stop()
        del self._sessions[request.task.name]
        return {}

    def _add(self, request: Any, kind: str, channel: str) -> dict[str, Any]:
        known: Mapping[str, Any] = {
            "ao": self._outputs,
            "ai": self._inputs,
            "do": self._lines,
        }[kind]
        session = self._session(request)
        if channel not in known or session.kind not in ("", kind):
            raise _NiError(*_CHANNEL_MISSING)
        session.kind = kind
        session.channels.append(channel)
        if kind != "do":
            session.ranges.append((request.min_val, request.max_val))
        return {}

    def _control(self, request: Any, action: int) -> dict[str, Any]:
        session = self._session(request)
        if action == _START:
            self._must_be_free(session)
        if action in (_START, _STOP, _ABORT):
            session.started = action == _START
            if session.watchdog is not None:
                (session.watchdog.start if session.started else session.watchdog.stop)()
        return {}

    def _must_be_free(self, session: _Session) -> None:
        """Refuse like NI's driver: a device runs one task of a kind at a time."""
        for other in self._sessions.values():
            same = (other.kind, other.device) == (session.kind, session.device)
            if other is not session and other.started and same:
                raise _NiError(*_RESERVED)

    def _write(self, request: Any) -> dict[str, Any]:
        session = self._session(request)
        self._must_be_free(session)
        values = list(request.write_array)
        for volts, (low, high) in zip(values, session.ranges, strict=True):
            if not low <= volts <= high:
                raise _NiError(*_OUT_OF_RANGE)
        for channel, volts in zip(session.channels, values, strict=True):
            self._outputs[channel](volts)
        return {"samps_per_chan_written": 1}

    def _read(self, request: Any) -> dict[str, Any]:
        session = self._session(request)
        self._must_be_free(session)
        volts = [self._inputs[channel]() for channel in session.channels]
        pairs = zip(volts, session.ranges, strict=True)  # the converter saturates
        clipped = [min(max(value, low), high) for value, (low, high) in pairs]
        return {"read_array": clipped, "samps_per_chan_read": 1}

    def _write_lines(self, request: Any) -> dict[str, Any]:
        session = self._session(request)
        if self._locked:
            raise _NiError(*_WRITE_EXPIRED)
        for line, level in zip(session.channels, request.write_array, strict=True):
            self._lines[line](bool(level))
        return {"samps_per_chan_written": 1}

    def _create_watchdog(self, request: Any) -> dict[str, Any]:
        return self._created(_Session("watchdog", watchdog=_Watchdog(request.timeout, self._drive)))

    def _drive(self, states: dict[str, bool]) -> None:
        with self._lock:
            self._locked = True
            for line, level in states.items():
                self._lines[line](level)

    def _expiration(self, request: Any) -> dict[str, Any]:
        lines = [name.strip() for name in request.channel_names.split(",")]
        if any(line not in self._lines for line in lines):
            raise _NiError(*_CHANNEL_MISSING)
        levels = [state == _HIGH for state in request.expir_state_array]
        self._watchdog(request).states = dict(zip(lines, levels, strict=True))
        return {}

    def _control_watchdog(self, request: Any) -> dict[str, Any]:
        watchdog = self._watchdog(request)
        if request.action_raw == _FEED and watchdog.expired:
            raise _NiError(*_RESET_EXPIRED)
        if request.action_raw == _CLEAR:
            watchdog.expired = self._locked = False
        if watchdog.running:
            watchdog.start()
        return {}

    def _watchdog_attribute(self, request: Any) -> dict[str, Any]:
        if request.attribute_raw != _EXPIRED:
            raise _NiError(*_BAD_ATTRIBUTE)
        return {"value": self._watchdog(request).expired}


class LastingThreads(Executor):
    """Threads that keep serving while the interpreter exits, which is when supplies vent."""

    def __init__(self, n: int, name: str) -> None:
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._threads = [Thread(target=self._work, name=name, daemon=True) for _ in range(n)]
        for thread in self._threads:
            thread.start()

    def submit(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `Executor`."""
        future: Future[Any] = Future()

        def job() -> None:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(call(*args, **kwargs))
                except BaseException as error:
                    future.set_exception(error)

        self._jobs.put(job)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the threads after the submitted calls, and wait for them."""
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


class NidaqPeer(DevicePeer[NidaqSettings]):
    """An NI-DAQ device with regulators, and a dump valve if the settings name one.

    It listens at the address ``grpc`` if that is on this machine, otherwise on a free port.
    """

    def __init__(self, settings: NidaqSettings, bench: Bench) -> None:
        super().__init__(settings, bench)
        self._volts = {c.output.channel: c.output.volts_for(0.0) for c in settings.channels}
        host, _, port = (settings.grpc or "").rpartition(":")
        self._server = DaqServer(
            f"127.0.0.1:{port}" if self.on_loopback(host) else None,
            settings.extra,
            outputs={
                channel.output.channel: partial(self._set, index, channel.output)
                for index, channel in enumerate(settings.channels)
            },
            inputs=self._inputs(),
            lines=self._lines(),
            fault=partial(bench.fault, "supply"),
        )

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> NidaqSettings:
        """Return analogue outputs and inputs of 0 to 10 V, and a dump valve on a digital line."""
        pressures = (0.0, FULL_SCALE)
        channels = [
            {
                "output": {"channel": f"Dev1/ao{i}", "pressures": pressures},
                "input": {"channel": f"Dev1/ai{i}", "pressures": pressures},
            }
            for i in range(n)
        ]
        return NidaqSettings(channels=channels, dump_valve={"line": "Dev1/port0/line0"})

    def start(self) -> NidaqSettings:
        """Listen, and return the settings with the address."""
        return self.settings.model_copy(update={"grpc": self._server.start()})

    def close(self) -> None:
        """Stop."""
        self._server.close()

    def _inputs(self) -> dict[str, Callable[[], float]]:
        inputs: dict[str, Callable[[], float]] = {}
        for index, channel in enumerate(self.settings.channels):
            if channel.output.read_back is not None:
                inputs[channel.output.read_back] = partial(
                    self._volts.__getitem__, channel.output.channel
                )
            if channel.input is not None:
                inputs[channel.input.channel] = partial(self._get, index, channel.input)
        return inputs

    def _lines(self) -> dict[str, Callable[[bool], None]]:
        valve = self.settings.dump_valve
        if valve is None:
            return {}
        shut = valve.closed_when == "high"
        return {valve.line: lambda level: self.bench.dump(open_valve=level != shut)}

    def _set(self, index: int, output: NidaqOutput, volts: float) -> None:
        self._volts[output.channel] = volts
        self.bench.command(index, output.pressure_at(volts))

    def _get(self, index: int, wired: NidaqInput) -> float:
        return wired.volts_for(float(self.bench.measured()[index]))
