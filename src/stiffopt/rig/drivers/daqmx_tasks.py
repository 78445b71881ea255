"""Tasks of NI-DAQmx, each with one job: to write voltages, to read them, a line, a watchdog."""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import DeviceError
from stiffopt.rig.drivers.daqmx import RESERVED, Daqmx, SilentError

__all__ = ["AnalogueInput", "AnalogueOutput", "DigitalOutput", "InputChannel", "Watchdog"]

Array = NDArray[np.float64]

_TERMINALS = {"differential": "DIFF", "pseudo-differential": "PSEUDO_DIFF"}


class InputChannel(NamedTuple):
    """An analogue input and how it is wired; voltages in V."""

    name: str
    terminals: str
    low: float
    high: float


class _Task:
    """A task with one job; `made` is closed if it cannot be set up."""

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
        """Clear the task, whatever state it is in; to close twice does nothing."""
        task, self._task = self._task, None
        if task is None:
            return
        handle, left = task._handle, True  # nidaqmx forgets it even if it could not close
        try:
            if not self._daq.silent:
                with self._daq.errors(self._doing):
                    task.close()  # stops it first
                left = False
        except SilentError:
            self._daq.silent = True  # one wait is enough
        except DeviceError:
            left = False  # there is no one left who would care
        finally:
            if left:
                self._daq.leave(handle)
            task._handle = None  # else it complains when it is collected


class AnalogueOutput(_Task):
    """Voltages, all written at once; nobody else can use the channels meanwhile."""

    def __init__(self, daq: Daqmx, channels: Sequence[tuple[str, float, float]]) -> None:
        self._channels = channels
        super().__init__(daq, f"opening {', '.join(name for name, _, _ in channels)}")

    def _set_up(self) -> None:
        for name, low, high in self._channels:
            self._task.ao_channels.add_ao_voltage_chan(name, min_val=low, max_val=high)
        writers = importlib.import_module("nidaqmx.stream_writers")
        self._writer = writers.AnalogMultiChannelWriter(self._task.out_stream, auto_start=True)
        self._writer.verify_array_shape = False  # it asks the device for its channels each time
        self._task.start()

    def write(self, volts: Array) -> None:
        """Write voltages (n,), in V."""
        with self._daq.errors("writing the set-points"):
            self._writer.write_one_sample(volts, timeout=self._daq.timeout)


class AnalogueInput(_Task):
    """Voltages, all read at once.

    Parameters
    ----------
    shared :
        Another task reads inputs of the same device: hold it only while reading, which is slower.
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
                busy = self._shared and f"NI-DAQmx {RESERVED}" in str(error)
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


class Watchdog(_Task):
    """The device's own timer: not fed in time, it drives a digital line by itself."""

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
        """Begin to count, or go on."""
        if self.running:
            self.feed()
            return
        with self._daq.errors("starting the watchdog"):
            self._task.control(self._daq.nidaqmx.constants.TaskMode.TASK_START)
        self.running = True

    def feed(self) -> None:
        """Start the count anew.

        Raises
        ------
        WatchdogExpiredError
            Too late.
        """
        with self._daq.errors("feeding the watchdog"):
            self._task.reset_timer()

    def stop(self) -> None:
        """Count no longer."""
        with self._daq.errors("stopping the watchdog"):
            self._task.control(self._daq.nidaqmx.constants.TaskMode.TASK_STOP)
        self.running = False

    def clear(self) -> None:
        """Let the device take digital writes again after the watchdog has expired."""
        with self._daq.errors("clearing the watchdog"):
            self._task.clear_expiration()
