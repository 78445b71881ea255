"""The register map of a Modbus supply: where the pressures are, and how counts encode them."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from stiffopt.errors import InputError
from stiffopt.schema import BadKeyError, Items, JsonSchemaOfFile, Pair, Schema
from stiffopt.units import Duration, Number, Pressure, finite_number, parse_quantity, read_from_file

Address = Annotated[int, Field(ge=0, le=0xFFFF)]
RegisterType = Literal["int16", "uint16", "int32", "uint32", "float32"]
WordOrder = Literal["big", "little"]
RegisterTable = Literal["input", "holding"]

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_RANGES = {
    "int16": (-0x8000, 0x7FFF),
    "uint16": (0, 0xFFFF),
    "int32": (-0x80000000, 0x7FFFFFFF),
    "uint32": (0, 0xFFFFFFFF),
    "float32": (-1e12, 1e12),
}
_LONGEST = 120  # registers that every request may carry, even one that reads and writes


class PressureScale(Schema):
    """The straight line between counts and pressure, through two points.

    In a file, one pressure such as ``1 mbar`` means that pressure per count.

    Attributes
    ----------
    counts : the two counts.
    pressure : the pressures there, in Pa.
    """

    counts: Pair[Number]
    pressure: Pair[Pressure]

    @model_validator(mode="before")
    @classmethod
    def _per_count(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, dict | PressureScale):
            return value
        if isinstance(value, str) or read_from_file(info):
            per_count = parse_quantity(value, "Pa", "pressure per count")
            return {"counts": [0, 1], "pressure": ["0 Pa", f"{per_count!r} Pa"]}
        return {"counts": [0, 1], "pressure": [0.0, finite_number(value)]}

    @model_validator(mode="after")
    def _is_a_line(self) -> Self:
        for name, ends in (("counts", self.counts), ("pressure", self.pressure)):
            if ends[0] == ends[1]:
                raise BadKeyError(name, "the two points must differ")
        return self

    @property
    def rises(self) -> bool:
        """Whether more counts mean more pressure."""
        return (self.counts[1] > self.counts[0]) == (self.pressure[1] > self.pressure[0])

    def to_pressure(self, count: float) -> float:
        """Return the pressure in Pa at a count."""
        (c0, c1), (p0, p1) = self.counts, self.pressure
        return p0 + (count - c0) * (p1 - p0) / (c1 - c0)

    def to_count(self, pressure: float) -> float:
        """Return the count at a pressure in Pa, not rounded."""
        (c0, c1), (p0, p1) = self.counts, self.pressure
        return c0 + (pressure - p0) * (c1 - c0) / (p1 - p0)


class Register(Schema):
    """A register; in a file, a bare address is enough.

    Attributes
    ----------
    address : as in the protocol, counted from 0.
    type, scale : if they differ from those of the supply.
    """

    address: Address
    type: RegisterType | None = None
    scale: PressureScale | None = None

    @model_validator(mode="before")
    @classmethod
    def _bare_address(cls, value: Any) -> Any:
        bare = isinstance(value, int) and not isinstance(value, bool)
        return {"address": value} if bare else value


class SetPointRegister(Register):
    """A holding register that sets a pressure.

    Attributes
    ----------
    read_back : address from which the set-point is read back, if it is a different one.
    """

    read_back: Address | None = None


class ReadingRegister(Register):
    """A register with a measured pressure.

    Attributes
    ----------
    table : if it differs from that of the supply.
    """

    table: RegisterTable | None = None


_OR_ADDRESS = JsonSchemaOfFile(lambda made: {"anyOf": [made, {"type": "integer"}]})


class ModbusChannel(Schema):
    """One regulator.

    Attributes
    ----------
    setpoint : register that sets its pressure.
    reading : register with the measured pressure; None: it is not measured.
    min, max : limits in Pa, if they are tighter than those of the rig.
    """

    setpoint: Annotated[SetPointRegister, _OR_ADDRESS]
    reading: Annotated[ReadingRegister, _OR_ADDRESS] | None = None
    min: Pressure | None = None
    max: Pressure | None = None


class RegisterValue(Schema):
    """A value to write into a holding register."""

    address: Address
    value: Annotated[int, Field(ge=0, le=0xFFFF)]


class ModbusWatchdog(Schema):
    """The device's own watchdog, which turns its outputs off when commands stop.

    It is set up on every new connection: first ``before``, then the time, unless the register
    already has it, then ``after``.

    Attributes
    ----------
    timeout : time without a command after which it acts, in s.
    address : holding register of the time.
    resolution : time per count of that register, in s.
    before, after : other registers to write, in this order.
    trigger : holding register that must change as a sign of life; it is written after every
        command. None: commands alone are enough.
    """

    timeout: Annotated[Duration, Field(gt=0, le=60)] = 0.5
    address: Address
    resolution: Annotated[Duration, Field(gt=0, le=10)] = 0.001
    before: Items[RegisterValue] = ()
    after: Items[RegisterValue] = ()
    trigger: Address | None = None

    @property
    def addresses(self) -> tuple[int, ...]:
        """All registers that the watchdog writes."""
        others = tuple(item.address for item in (*self.before, *self.after))
        return (self.address, *others, *(() if self.trigger is None else (self.trigger,)))

    @property
    def counts(self) -> int:
        """Value of the register for the timeout, rounded down."""
        return int(self.timeout / self.resolution + 1e-9)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if not 1 <= self.counts <= 0xFFFF:
            raise BadKeyError("timeout", "expected 1 to 65535 times the resolution")
        return self


class ModbusDumpValve(Schema):
    """A valve on a digital output that empties all chambers.

    Attributes
    ----------
    coil : its address.
    energised : state of the valve while the coil is on; ``closed``: without power it opens.
    """

    coil: Address
    energised: Literal["closed", "open"] = "closed"

    def coil_for(self, *, open_valve: bool) -> bool:
        """Return the state of the coil for a state of the valve."""
        return open_valve == (self.energised == "open")


@dataclass(frozen=True)
class PressureRegister:
    """The registers of one pressure, and its encoding.

    `address`, `table`: of its first register. `type`, `word_order`, `scale`: encoding of the
    pressure.
    """

    address: int
    table: str
    type: RegisterType
    word_order: WordOrder
    scale: PressureScale

    @property
    def width(self) -> int:
        """Number of registers."""
        return struct.calcsize(_FORMATS[self.type]) // 2

    @property
    def addresses(self) -> range:
        """Its registers."""
        return range(self.address, self.address + self.width)

    def pressure_range(self) -> tuple[float, float]:
        """Return the lowest and highest pressure that can be encoded, in Pa."""
        ends = sorted(self.scale.to_pressure(count) for count in _RANGES[self.type])
        return ends[0], ends[1]

    def encode(
        self, pressure: float, *, lowest: float = -math.inf, highest: float = math.inf
    ) -> tuple[int, ...]:
        """Return the registers for the pressure nearest to a finite one, within limits.

        0 is written whatever the limits are, and never as more than the highest limit if that is
        above 0.

        Raises `InputError`: the pressure is not finite, or no count is within the limits.
        """
        if not math.isfinite(pressure):
            raise InputError(f"{pressure} is not a finite pressure")
        if pressure == 0:
            lowest, highest = -math.inf, max(highest, 0.0)
        count = self._rounded(self.scale.to_count(pressure))
        said = self.scale.to_pressure(count)
        if not lowest <= said <= highest:
            count = self._next(count, 1 if (said < lowest) == self.scale.rises else -1)
            if pressure != 0 and not lowest <= self.scale.to_pressure(count) <= highest:
                raise InputError(
                    f"its register cannot represent any pressure from {lowest * 1e-5:g} to "
                    f"{highest * 1e-5:g} bar"
                )
        return self.registers(count)

    def registers(self, count: float) -> tuple[int, ...]:
        """Return the registers for a count within the range of the type."""
        value = count if self.type == "float32" else int(count)
        words = struct.unpack(f">{self.width}H", struct.pack(_FORMATS[self.type], value))
        return words[::-1] if self.word_order == "little" else words

    def decode(self, registers: Sequence[int]) -> float:
        """Return the pressure in Pa that registers encode; it may be NaN."""
        words = registers[::-1] if self.word_order == "little" else registers
        (count,) = struct.unpack(_FORMATS[self.type], struct.pack(f">{self.width}H", *words))
        return self.scale.to_pressure(count)

    def _rounded(self, count: float) -> float:
        low, high = _RANGES[self.type]
        count = min(max(count, low), high)
        return float(np.float32(count)) if self.type == "float32" else round(count)

    def _next(self, count: float, step: int) -> float:
        if self.type == "float32":
            return float(np.nextafter(np.float32(count), np.float32(step * np.inf)))
        return self._rounded(count + step)


@dataclass(frozen=True)
class RegisterRun:
    """Contiguous registers, which one request reads or writes.

    `table`, `start`, `count`: their table, first address and number. `points`: the pressures in
    them, by channel, counted from 0.
    """

    table: str
    start: int
    count: int
    points: tuple[tuple[int, PressureRegister], ...]

    def __str__(self) -> str:
        channels = sorted({channel + 1 for channel, _ in self.points})
        s = "s" if len(channels) > 1 else ""
        return f"channel{s} {', '.join(map(str, channels))} ({self.where})"

    @property
    def where(self) -> str:
        """The registers in words."""
        last = self.start + self.count - 1
        what = f"{self.start} to {last}" if self.count > 1 else f"{self.start}"
        return f"{self.table} register{'s' if self.count > 1 else ''} {what}"

    def is_within(self, other: RegisterRun) -> bool:
        """Return True if the other run contains every point of this one."""
        return set(self.points) <= set(other.points)

    def cut(self, registers: Sequence[int], point: PressureRegister) -> Sequence[int]:
        """Return the registers of a point from those of the run."""
        offset = point.address - self.start
        return registers[offset : offset + point.width]


def runs_of(points: Iterable[tuple[int, PressureRegister]]) -> tuple[RegisterRun, ...]:
    """Return the fewest runs that cover points, without registers in between."""
    found: list[RegisterRun] = []
    for item in sorted(points, key=lambda item: (item[1].table, item[1].address)):
        point = item[1]
        end = point.address + point.width
        if found and found[-1].table == point.table:
            last = found[-1]
            count = max(last.count, end - last.start)
            if point.address <= last.start + last.count and count <= _LONGEST:
                found[-1] = RegisterRun(last.table, last.start, count, (*last.points, item))
                continue
        found.append(RegisterRun(point.table, point.address, point.width, (item,)))
    return tuple(found)


def values_of(run: RegisterRun, registers: Mapping[int, Sequence[int]]) -> list[int]:
    """Return the values of all registers of a run from those of its channels."""
    values = [0] * run.count
    for channel, point in run.points:
        offset = point.address - run.start
        values[offset : offset + point.width] = registers[channel]
    return values
