"""The driver ``nidaq``: regulators on analogue outputs of NI-DAQ devices, and a dump valve."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError
from stiffopt.rig.drivers.daqmx import (
    Address,
    AnalogueInput,
    AnalogueOutput,
    Daqmx,
    DigitalOutput,
    InputChannel,
    InputName,
    LineName,
    OutputName,
    Terminals,
    WatchdogExpiredError,
    WatchdogTask,
)
from stiffopt.rig.endpoints import tcp_endpoints
from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply, SupplySettings
from stiffopt.schema import BadKeyError, Items, Pair, Schema
from stiffopt.units import Duration, Pressure, Voltage


class _VoltageLine(Schema):
    """A voltage that encodes a pressure: a straight line through two points.

    Attributes
    ----------
    volts, pressures : the two points, in V and Pa.
    """

    volts: Pair[Voltage] = (0.0, 10.0)
    pressures: Pair[Pressure]

    @model_validator(mode="after")
    def _two_points(self) -> Self:
        for name, (first, second) in (("volts", self.volts), ("pressures", self.pressures)):
            if first == second:
                raise BadKeyError(name, "expected two different values")
        return self

    def volts_for(self, pressure: float) -> float:
        """Return the voltage in V for a pressure in Pa."""
        return float(_through(pressure, self.pressures, self.volts))

    def pressure_at(self, volts: float) -> float:
        """Return the pressure in Pa for a voltage in V."""
        return float(_through(volts, self.volts, self.pressures))


def _through(x: float, xs: tuple[float, float], ys: tuple[float, float]) -> float:
    return ys[0] + (x - xs[0]) * (ys[1] - ys[0]) / (xs[1] - xs[0])


class NidaqOutput(_VoltageLine):
    """The set-point of a regulator. Voltages beyond the two points are never written.

    Attributes
    ----------
    channel : physical channel, such as ``Dev1/ao0``.
    read_back : internal channel on which the device measures this output, such as
        ``Dev1/_ao0_vs_aognd``; None: it is not checked.
    """

    channel: OutputName
    read_back: InputName | None = None

    @model_validator(mode="after")
    def _can_vent(self) -> Self:
        if not min(self.pressures) <= 0 <= max(self.pressures):
            raise BadKeyError("pressures", "must span 0 bar: the regulator could not vent")
        return self


class NidaqInput(_VoltageLine):
    """The measured pressure of a regulator or a sensor.

    Attributes
    ----------
    channel : physical channel, such as ``Dev1/ai0``.
    terminals : wiring of the input.
    range : range of the converter, in V.
    """

    channel: InputName
    terminals: Terminals = "default"
    range: Pair[Voltage] = (-10.0, 10.0)

    @model_validator(mode="after")
    def _low_below_high(self) -> Self:
        if not self.range[0] < self.range[1]:
            raise BadKeyError("range", "the first voltage must be below the second")
        return self


class NidaqChannel(Schema):
    """One channel of the arm.

    Attributes
    ----------
    output : its set-point.
    input : its measured pressure; None: it is not measured.
    min, max : lowest and highest pressure in Pa, if tighter than elsewhere.
    """

    output: NidaqOutput
    input: NidaqInput | None = None
    min: Pressure | None = None
    max: Pressure | None = None


class NidaqDumpValve(Schema):
    """A valve that empties all chambers.

    Attributes
    ----------
    line : digital line, such as ``Dev1/port0/line0``.
    closed_when : level of the line that keeps the valve closed. Wire it so that the valve opens
        when the power fails.
    """

    line: LineName
    closed_when: Literal["high", "low"] = "high"


class NidaqSettings(SupplySettings):
    """Regulators on NI-DAQ devices.

    Attributes
    ----------
    grpc : host and port of NI's gRPC device server; None: the driver on this machine.
    timeout : timeout of every exchange with the device, in s.
    channels : one for each channel of the arm.
    read_back_tolerance : allowed error of an output that is read back, in V.
    share_inputs : the probe reads inputs of the same device, so reserve it only while reading.
    dump_valve : None: there is none.
    watchdog : time without a write after which the device opens the dump valve by itself, in s;
        None: it does not.
    """

    extra: ClassVar[str] = "nidaq"
    peer: ClassVar[str] = "stiffopt.lab.nidaq_peer:NidaqPeer"

    driver: Literal["nidaq"] = "nidaq"
    grpc: Address | None = None
    timeout: Annotated[Duration, Field(gt=0, le=10)] = 1.0
    channels: Annotated[Items[NidaqChannel], Field(min_length=1)]
    read_back_tolerance: Annotated[Voltage, Field(gt=0)] = 0.05
    share_inputs: bool = False
    dump_valve: NidaqDumpValve | None = None
    watchdog: Annotated[Duration, Field(ge=0.01, le=5)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.watchdog is not None and self.dump_valve is None:
            raise BadKeyError("watchdog", "needs a 'dump_valve': the device's watchdog opens it")
        names: dict[str, str] = {}
        for index, channel in enumerate(self.channels):
            for kind in ("output", "input"):
                name = getattr(getattr(channel, kind), "channel", None)
                place = f"channels.{index}.{kind}"
                if name in names:
                    raise BadKeyError(place, f"{name} is already that of {names[name]}")
                if name is not None:
                    names[name] = f"channel {index + 1}"
        return self

    def measures(self, channel: int) -> bool:
        """Whether the channel has an input."""
        return self.channels[channel].input is not None

    def _reach(self, channel: int) -> tuple[float, float]:
        low, high = sorted(self.channels[channel].output.pressures)
        return low, high

    def _make(self, limits: PressureLimits, clock: Clock | None) -> NidaqSupply:
        return NidaqSupply(self, limits, clock)


class NidaqSupply(PressureSupply):
    """Regulators on NI-DAQ devices: one task for all outputs, one for all inputs."""

    def __init__(
        self, settings: NidaqSettings, limits: PressureLimits, clock: Clock | None = None
    ) -> None:
        super().__init__(limits, clock)
        self._settings = settings
        outputs = [channel.output for channel in settings.channels]
        self._lowest = np.array([min(output.volts) for output in outputs])
        self._highest = np.array([max(output.volts) for output in outputs])
        self._read_backs = [i for i, output in enumerate(outputs) if output.read_back is not None]
        self._vented = np.array([output.volts_for(0.0) for output in outputs])
        self.has_watchdog = settings.watchdog is not None  # which opens the dump valve
        self.has_dump_valve = settings.dump_valve is not None
        self.patience = 3 * settings.timeout  # of outputs, valve and inputs

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The devices that have its outputs, on this machine or behind a server."""
        names = sorted({c.output.channel.split("/")[0].lower() for c in self._settings.channels})
        places: tuple[str, ...] = ("ni-daq",)
        if self._settings.grpc is not None:
            host, _, port = self._settings.grpc.rpartition(":")
            places = tcp_endpoints(host.strip("[]"), int(port))
        return tuple(f"{place} {name}" for place in places for name in names)

    def _open(self) -> None:
        settings = self._settings
        with ExitStack() as stack:
            daq = Daqmx(settings.grpc, settings.timeout, settings.extra)
            stack.callback(daq.close)
            names = [channel.output.channel for channel in settings.channels]
            ranges = list(zip(names, self._lowest, self._highest, strict=True))
            self._outputs = AnalogueOutput(daq, ranges)
            stack.callback(self._outputs.close)
            try:
                self._open_rest(daq, stack)
            except BaseException:
                # An earlier program may have left the outputs at some pressure.
                with suppress(Exception):  # the first error is the one to tell
                    self._outputs.write(self._vented)
                raise
            self._opened = stack.pop_all()

    def _open_rest(self, daq: Daqmx, stack: ExitStack) -> None:
        settings = self._settings
        self._inputs: AnalogueInput | None = None
        if channels := self._input_channels():
            self._inputs = AnalogueInput(daq, channels, shared=settings.share_inputs)
            stack.callback(self._inputs.close)
        self._valve: _Valve | None = None
        if settings.dump_valve is not None:
            self._valve = _Valve(daq, settings.dump_valve, settings.watchdog)
            stack.callback(self._valve.close, self.clock)

    def _close(self) -> None:
        self._opened.close()

    def _input_channels(self) -> list[InputChannel]:
        """Return the inputs: first the measured pressures, then the outputs to read back."""
        inputs = [channel.input for channel in self._settings.channels]
        found = [InputChannel(i.channel, i.terminals, *i.range) for i in inputs if i is not None]
        for channel, low, high in zip(
            self._settings.channels, self._lowest, self._highest, strict=True
        ):
            if channel.output.read_back is not None:
                found.append(InputChannel(channel.output.read_back, "default", low, high))
        return found

    def _write(self, pressures: Array) -> None:
        volts = self._send(pressures)
        if self._read_backs and self._inputs is not None:
            self._check(volts, self._inputs.read())

    def _read(self) -> Array:
        return self._pressures(None if self._inputs is None else self._inputs.read())

    def _exchange(self, pressures: Array) -> Array | None:
        if self._inputs is None:
            return None
        volts = self._send(pressures)
        found = self._inputs.read()
        self._check(volts, found)
        return self._pressures(found)

    def _send(self, pressures: Array) -> Array:
        """Write set-points; return the written voltages (n,)."""
        outputs = [channel.output for channel in self._settings.channels]
        volts = np.array([o.volts_for(p) for o, p in zip(outputs, pressures, strict=True)])
        volts = np.where(np.isfinite(volts), volts, self._vented)
        volts = np.array(np.clip(volts, self._lowest, self._highest))
        self._outputs.write(volts)
        if self._valve is not None and not self._valve.feed() and np.any(pressures):
            raise DeviceError(
                "the device's watchdog has opened the dump valve, as nothing was written for "
                f"{self._settings.watchdog:g} s; vent, then arm the supply again"
            )
        return volts

    def _check(self, wanted: Array, inputs: Array) -> None:
        """Refuse outputs with a wrong voltage; `inputs` has them last."""
        found = inputs[len(inputs) - len(self._read_backs) :]
        for index, volts in zip(self._read_backs, found, strict=True):
            if not abs(volts - wanted[index]) <= self._settings.read_back_tolerance:
                name = self._settings.channels[index].output.channel
                raise DeviceError(
                    f"channel {index + 1}: {name} is at {volts:.3f} V instead of "
                    f"{wanted[index]:.3f} V; check its wiring for a short circuit"
                )

    def _pressures(self, inputs: Array | None) -> Array:
        """Return measured pressures (n,), in Pa; `inputs` has them first."""
        pressures = np.full(self.n, np.nan)
        volts = iter([] if inputs is None else inputs)
        for index, channel in enumerate(self._settings.channels):
            if channel.input is not None:
                pressures[index] = channel.input.pressure_at(float(next(volts)))
        return pressures

    def _dump(self, *, open_valve: bool) -> None:
        if self._valve is not None:
            (self._valve.open if open_valve else self._valve.shut)()


class _Valve:
    """The valve; a watchdog with a timeout in s opens it if the software falls silent."""

    def __init__(self, daq: Daqmx, settings: NidaqDumpValve, timeout: float | None) -> None:
        self._opens_when_high = settings.closed_when == "low"
        self._timeout = timeout or 0.0
        self._line = DigitalOutput(daq, settings.line)
        self._watchdog: WatchdogTask | None = None
        try:
            if timeout is not None:
                high = self._opens_when_high
                self._watchdog = WatchdogTask(daq, settings.line, timeout, high=high)
        except BaseException:
            self._line.close()
            raise

    def open(self) -> None:
        """Open the valve, which empties the arm."""
        try:
            self._line.write(high=self._opens_when_high)
        except WatchdogExpiredError:
            if self._watchdog is None:
                raise
            # The device holds the valve open, but refuses writes until the watchdog is cleared.
            self._watchdog.clear()
            self._line.write(high=self._opens_when_high)
        # Not before: if the write had failed, the watchdog would still open the valve.
        if self._watchdog is not None and self._watchdog.running:
            self._watchdog.stop()

    def shut(self) -> None:
        """Close the valve; start the watchdog before."""
        if self._watchdog is not None:
            self._watchdog.start()
        self._line.write(high=not self._opens_when_high)

    def feed(self) -> bool:
        """Feed the watchdog; return False if it has expired."""
        if self._watchdog is not None and self._watchdog.running:
            try:
                self._watchdog.feed()
            except WatchdogExpiredError:
                return False
        return True

    def close(self, clock: Clock) -> None:
        """Release the line, which keeps its level."""
        if self._watchdog is not None:
            if self._watchdog.running:  # opening the valve failed: let the device do it
                clock.sleep(1.2 * self._timeout)
            self._watchdog.close()
        self._line.close()
