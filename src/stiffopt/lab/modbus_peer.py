"""The virtual lab's Modbus device: pymodbus's server with the register map of the rig file."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Any

import numpy as np

from stiffopt.errors import DeviceError
from stiffopt.lab.bench import FULL_SCALE, Bench, ServedPeer
from stiffopt.rig.drivers.modbus import (
    ModbusSerial,
    ModbusSettings,
    ModbusTcp,
    pymodbus_library,
)
from stiffopt.rig.drivers.modbus_registers import PressureRegister

LATE = 0.1  # s, delay of a slow device's answers
_TICK = 0.01  # s between checks of the watchdog
_COILS, _INPUTS = (1, 5, 15), 4  # function codes


class ModbusPeer(ServedPeer[ModbusSettings]):
    """A coupler with regulators on its outputs.

    Written set-points go to the bench, readings come from it. As in a real device, addresses that
    the rig file does not name are refused. The watchdog starts with the first write after its time
    was set; when it runs out, all outputs fall: set-points and coil.
    """

    def __init__(self, settings: ModbusSettings, bench: Bench) -> None:
        super().__init__(settings, bench)
        self._memory = dict.fromkeys(self._holding(), 0)  # holding registers
        self._last_write: float | None = None

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> ModbusSettings:
        """Return a coupler with a set-point and a reading per channel, watchdog and dump valve."""
        return ModbusSettings(
            tcp={"host": "127.0.0.1", "port": 0},
            scale={"counts": (0, 32767), "pressure": (0.0, FULL_SCALE)},
            table="holding",
            channels=[{"setpoint": 0x0800 + i, "reading": i} for i in range(n)],
            watchdog={"address": 0x1120, "timeout": 0.5},
            dump_valve={"coil": 0},
        )

    # server --------------------------------------------------------------------------------------

    @asynccontextmanager
    async def _listening(self) -> AsyncIterator[ModbusSettings]:
        """Listen on loopback or a pseudo-terminal."""
        self._fall()
        async with AsyncExitStack() as stack:
            terminals = None
            if self.settings.serial is not None:
                terminals = _Terminals()
                stack.callback(terminals.close)
            server, connection = await self._listen(terminals)
            stack.push_async_callback(asyncio.sleep, 0)  # lets the transports close
            stack.push_async_callback(server.shutdown)
            stack.callback(asyncio.create_task(self._watch()).cancel)
            kind = "tcp" if isinstance(connection, ModbusTcp) else "serial"
            yield self.settings.model_copy(update={kind: connection})

    async def _listen(self, terminals: _Terminals | None) -> tuple[Any, ModbusTcp | ModbusSerial]:
        servers = pymodbus_library("pymodbus.server")
        options = {"trace_packet": self._trace}
        if terminals is not None:
            asked = self.settings.serial or ModbusSerial(port="")
            line = asked.model_copy(update={"parity": "none"})  # pseudo-terminals have no parity
            server = servers.ModbusSerialServer(
                self._device(), port=terminals.inner, **line.options(), **options
            )
            await _begin(server, f"the pseudo-terminal {terminals.inner} cannot be opened")
            return server, line.model_copy(update={"port": terminals.outer})
        tcp = self.settings.tcp
        port = tcp.port if tcp is not None and self.on_loopback(tcp.host) else 0
        host = "127.0.0.1"
        server = servers.ModbusTcpServer(self._device(), address=(host, port), **options)
        await _begin(server, f"port {port} of {host} is in use; give another one or 0 for any")
        return server, ModbusTcp(host=host, port=server.transport.sockets[0].getsockname()[1])

    def _device(self) -> Any:
        simulator = pymodbus_library("pymodbus.simulator")

        def block(addresses: set[int]) -> list[Any]:
            kind = simulator.DataType.REGISTERS
            return [simulator.SimData(a, datatype=kind) for a in sorted(addresses or {0xFFFF})]

        valve = self.settings.dump_valve
        coil = simulator.SimData(
            0xFFFF if valve is None else valve.coil,
            values=[False],
            datatype=simulator.DataType.BITS,
        )
        inputs = {
            a for p in self.settings.readings.values() if p.table == "input" for a in p.addresses
        }
        blocks = ([coil], [coil], block(set(self._memory)), block(inputs))
        return simulator.SimDevice(self.settings.unit, simdata=blocks, action=self._act)

    def _holding(self) -> set[int]:
        settings = self.settings
        points = [p for p in settings.readings.values() if p.table == "holding"]
        points += [*settings.setpoints, *settings.read_backs]
        addresses = {address for point in points for address in point.addresses}
        return addresses.union(settings.watchdog.addresses if settings.watchdog else ())

    def _trace(self, sending: bool, packet: bytes) -> bytes:
        """Send nothing while the device is off."""
        return b"" if sending and self.bench.fault("supply") == "off" else packet

    # requests ------------------------------------------------------------------------------------

    async def _act(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: Sequence[int] | Sequence[bool] | None,
    ) -> Any:
        """Carry out a request; pymodbus answers with the content of ``registers``."""
        fault = self.bench.fault("supply")
        if fault == "off":  # `_trace` drops the answer
            return pymodbus_library("pymodbus.constants").ExcCodes.DEVICE_FAILURE
        if fault == "slow":
            await asyncio.sleep(LATE)
        if function in _COILS:
            if values is not None and self.settings.dump_valve is not None:
                self._switch(bool(values[0]))
        elif values is not None:
            self._store(address, values)
        else:
            shown = self._shown("input" if function == _INPUTS else "holding")
            for place in range(address, address + count):
                registers[place - start] = shown.get(place, 0)
        return None

    def _store(self, address: int, values: Sequence[int]) -> None:
        written = range(address, address + len(values))
        self._memory.update(zip(written, values, strict=True))
        if self.settings.watchdog is not None and self.settings.watchdog.address not in written:
            self._last_write = time.monotonic()
        for channel, point in enumerate(self.settings.setpoints):
            if set(point.addresses) & set(written):
                pressure = point.decode([self._memory[a] for a in point.addresses])
                self.bench.command(channel, pressure)

    def _shown(self, table: str) -> dict[int, int]:
        """Return the content of a table; a reading hides a set-point at its address."""
        shown = dict(self._memory) if table == "holding" else {}
        if table == "holding":
            pairs = zip(self.settings.read_backs, self.settings.setpoints, strict=True)
            for back, point in pairs:
                shown |= {
                    b: self._memory[a] for a, b in zip(point.addresses, back.addresses, strict=True)
                }
        measured = self.bench.measured()
        for channel, point in self.settings.readings.items():
            if point.table == table:
                shown |= dict(zip(point.addresses, _counts(point, measured[channel]), strict=True))
        return shown

    def _switch(self, state: bool) -> None:
        valve = self.settings.dump_valve
        if valve is not None:
            self.bench.dump(open_valve=state == valve.coil_for(open_valve=True))

    # watchdog ------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        watchdog = self.settings.watchdog
        while watchdog is not None:
            await asyncio.sleep(_TICK)
            timeout = self._memory[watchdog.address] * watchdog.resolution
            last = self._last_write
            if last is not None and timeout > 0 and time.monotonic() - last > timeout:
                self._fall()

    def _fall(self) -> None:
        """Reset all outputs, as when the device is switched on."""
        self._last_write = None
        for channel, point in enumerate(self.settings.setpoints):
            self._memory.update(zip(point.addresses, point.encode(0.0), strict=True))
            self.bench.command(channel, 0.0)
        self._switch(False)


class _Terminals:
    """Two joined pseudo-terminals: a serial line with both ends on this machine.

    Both ends are kept open here, otherwise the line would break when one side hangs up.
    """

    def __init__(self) -> None:
        import tty

        self._ends = [os.openpty(), os.openpty()]
        self.inner, self.outer = (os.ttyname(slave) for _, slave in self._ends)
        masters = [master for master, _ in self._ends]
        for (_, slave), source, target in zip(self._ends, masters, masters[::-1], strict=True):
            tty.setraw(slave)
            os.set_blocking(source, False)
            asyncio.get_running_loop().add_reader(source, self._pass_on, source, target)

    def _pass_on(self, source: int, target: int) -> None:
        with suppress(BlockingIOError):  # like a real line, a full one loses data
            os.write(target, os.read(source, 4096))

    def close(self) -> None:
        for ends in self._ends:
            asyncio.get_running_loop().remove_reader(ends[0])
            for end in ends:
                os.close(end)


async def _begin(server: Any, failure: str) -> None:
    try:
        await server.serve_forever(background=True)
    except RuntimeError:  # pymodbus logs the reason and does not raise it
        raise DeviceError(failure) from None


def _counts(point: PressureRegister, pressure: float) -> tuple[int, ...]:
    """Return the registers of a reading; integer types represent NaN by full scale."""
    if np.isfinite(pressure):
        return point.encode(float(pressure))
    low, high = point.pressure_range()
    if point.type == "float32":
        return point.registers(float(pressure))
    return point.encode(high if point.scale.rises else low)
