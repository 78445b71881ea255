"""The virtual lab's NI-DAQ device: volts on its terminals, the bench's regulators behind them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from stiffopt.lab.bench import Bench, Peer
from stiffopt.lab.daq_server import DaqHardware, DaqServer
from stiffopt.rig.drivers.nidaq import Input, NidaqSettings, Output

__all__ = ["NidaqPeer", "local"]

_LOOPBACK = ("127.0.0.1", "localhost")


def local(address: str | None) -> str | None:
    """Return an address if it is on this machine: the lab listens nowhere else."""
    if address is None or address.rpartition(":")[0] not in _LOOPBACK:
        return None
    return f"127.0.0.1:{address.rpartition(':')[2]}"


class NidaqPeer(Peer[NidaqSettings]):
    """An NI-DAQ device with regulators, and a dump valve where the settings name one.

    It listens where ``grpc`` says if that is on this machine, else on a free port.
    """

    def __init__(self, settings: NidaqSettings, bench: Bench) -> None:
        super().__init__(settings, bench)
        self._volts = {c.output.channel: c.output.volts_for(0.0) for c in settings.channels}
        hardware = DaqHardware(
            outputs={
                channel.output.channel: partial(self._set, index, channel.output)
                for index, channel in enumerate(settings.channels)
            },
            inputs=self._inputs(),
            lines=self._lines(),
            fault=partial(bench.fault, "supply"),
        )
        self._server = DaqServer(hardware, local(settings.grpc), "nidaq")

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

    def _set(self, index: int, output: Output, volts: float) -> None:
        self._volts[output.channel] = volts
        self.bench.command(index, output.pressure_at(volts))

    def _get(self, index: int, wired: Input) -> float:
        return wired.volts_for(float(self.bench.measured()[index]))
