"""The virtual lab's probe: its stage and, beside it, the NI-DAQ device that reads its sensor."""

from __future__ import annotations

from functools import partial

from stiffopt.lab.bench import Bench, Peer
from stiffopt.lab.daq_server import DaqHardware, DaqServer
from stiffopt.lab.zaber_peer import ZaberPeer
from stiffopt.rig.drivers.probe import ProbeSettings

__all__ = ["ProbePeer"]


class ProbePeer(Peer[ProbeSettings]):
    """Stage and sensor.

    The sensor's device listens on a free port, whatever ``grpc`` says: on a real rig one server
    often stands before both the supply and the sensor.

    Parameters
    ----------
    homed :
        Whether the stage has been homed since it was switched on.
    """

    def __init__(self, settings: ProbeSettings, bench: Bench, *, homed: bool = True) -> None:
        super().__init__(settings, bench)
        self._stage = ZaberPeer(settings, bench, homed=homed)
        hardware = DaqHardware(
            inputs={settings.force.channel: self._volts}, fault=partial(bench.fault, "probe")
        )
        self._sensor = DaqServer(hardware, None, "probe")

    def start(self) -> ProbeSettings:
        """Listen, and return the settings with both addresses."""
        try:
            settings = self._stage.start()
            force = settings.force.model_copy(update={"grpc": self._sensor.start()})
        except BaseException:
            self.close()
            raise
        return settings.model_copy(update={"force": force})

    def close(self) -> None:
        """Stop both."""
        self._stage.close()
        self._sensor.close()

    def _volts(self) -> float:
        force = self.settings.force
        return (self.bench.force() - force.offset) / force.sensitivity
