"""Real devices in place of simulated ones: how the virtual lab is wired if nobody says how."""

from __future__ import annotations

from typing import Any

from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.config import RigDescription
from stiffopt.rig.drivers.aurora import AuroraSettings
from stiffopt.rig.drivers.modbus import ModbusSettings
from stiffopt.rig.drivers.nidaq import NidaqSettings
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings
from stiffopt.rig.drivers.probe import ProbeSettings

__all__ = ["with_real_devices"]

_FULL_SCALE = 10e5  # Pa at 10 V, as of a K8P


def with_real_devices(
    description: RigDescription, robot: RobotDescription, supply: str, tracker: str
) -> RigDescription:
    """Return a rig whose simulated devices are replaced by real ones on this machine.

    Parameters
    ----------
    description, robot :
        The rig and its robot.
    supply :
        ``modbus`` or ``nidaq``.
    tracker :
        ``aurora`` or ``openigtlink``.

    Raises
    ------
    InputError
        There is no such driver.
    """
    supplies = {"modbus": _modbus, "nidaq": _nidaq}
    trackers = {"aurora": AuroraSettings, "openigtlink": OpenIGTLinkSettings}
    for word, drivers in ((supply, supplies), (tracker, trackers)):
        if word not in drivers:
            raise InputError(f"there is no driver '{word}' here; expected {' or '.join(drivers)}")
    real: dict[str, Any] = {}
    lab: dict[str, Any] = {}
    for name in ("supply", "tracker", "probe"):
        settings = getattr(description, name)
        if settings is not None and settings.driver == "simulated":
            lab[name] = settings
    if "supply" in lab:
        real["supply"] = supplies[supply](robot.n_pressures)
    if "tracker" in lab:
        real["tracker"] = trackers[tracker](
            driver=tracker,
            registration=lab["tracker"].registration,
            latency=lab["tracker"].latency,
        )
    if "probe" in lab:
        real["probe"] = _probe()
    if not real:
        return description
    before = description.lab.model_dump() if description.lab else {}
    fields = {**{name: getattr(description, name) for name in RigDescription.model_fields}, **real}
    return RigDescription(**{**fields, "lab": {**before, **lab}})


def _modbus(n: int) -> ModbusSettings:
    """Return a coupler with a set-point and a reading per channel, a watchdog and a dump valve."""
    return ModbusSettings(
        driver="modbus",
        tcp={"host": "127.0.0.1", "port": 0},
        scale={"counts": (0, 32767), "pressure": (0.0, _FULL_SCALE)},
        table="holding",
        channels=[{"setpoint": 0x0800 + i, "reading": i} for i in range(n)],
        watchdog={"address": 0x1120, "timeout": 0.5},
        dump_valve={"coil": 0},
    )


def _nidaq(n: int) -> NidaqSettings:
    """Return analogue outputs and inputs of 0 to 10 V, and a dump valve on a digital line."""
    pressures = (0.0, _FULL_SCALE)
    return NidaqSettings(
        driver="nidaq",
        channels=[
            {
                "output": {"channel": f"Dev1/ao{i}", "pressures": pressures},
                "input": {"channel": f"Dev1/ai{i}", "pressures": pressures},
            }
            for i in range(n)
        ],
        dump_valve={"line": "Dev1/port0/line0"},
    )


def _probe() -> ProbeSettings:
    """Return a stage on TCP and a sensor of 2 N/V."""
    return ProbeSettings(
        driver="probe",
        stage={},
        force={"channel": "Dev2/ai0", "sensitivity": 2.0},
    )
