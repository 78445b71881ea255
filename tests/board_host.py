"""A host for open regulators, written from docs/open-regulator.md; shares nothing with the driver.

With it are the fixtures of all tests that need the firmware.
"""

from __future__ import annotations

import struct
import time
from typing import Any, NamedTuple

import pytest

IDENTITY, LIMITS, ARM, SET, VENT, READ, STATISTICS = range(1, 8)
ERROR = 0xFF


class Report(NamedTuple):
    time: int
    armed: int
    cause: int
    channel: int
    supply: int
    set_points: tuple[int, ...]
    readings: tuple[int, ...]


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def stuffed(data: bytes) -> bytes:
    frame = b""
    for part in data.split(b"\0"):
        frame += bytes([len(part) + 1]) + part
    return frame + b"\0"


def unstuffed(frame: bytes) -> bytes:
    parts = []
    while frame:
        parts.append(frame[1 : frame[0]])
        frame = frame[frame[0] :]
    return b"\0".join(parts)


def frame_of(
    kind: int, payload: bytes = b"", *, sequence: int = 1, board: int = 1, version: int = 1
) -> bytes:
    body = bytes((version, board, sequence, kind)) + payload
    return stuffed(body + struct.pack("<H", crc16(body)))


def body_of(frame: bytes) -> bytes:
    """Return the body of a frame, whose CRC must be right."""
    assert frame.endswith(b"\0"), frame
    whole = unstuffed(frame[:-1])
    assert crc16(whole[:-2]) == struct.unpack("<H", whole[-2:])[0]
    return whole[:-2]


def report_of(payload: bytes) -> Report:
    values = struct.unpack_from(f"<{(len(payload) - 9) // 2}h", payload, 9)
    return Report(*struct.unpack_from("<IBBBh", payload), values[::2], values[1::2])


def command(report: Report, *set_points: int, validity: int = 100) -> bytes:
    """Return the payload of a SET that follows a report."""
    return struct.pack(f"<IH{len(set_points)}h", report.time, validity, *set_points)


class Host:
    """Asks a board on a serial port."""

    def __init__(self, port: str, board: int = 1) -> None:
        import serial

        self.line: Any = serial.Serial(port, 500_000, timeout=2.0)
        self.board = board
        self._sequence = 0

    def ask(self, kind: int, payload: bytes = b"", **header: int) -> tuple[int, bytes]:
        """Return kind and payload of the answer."""
        self._sequence = self._sequence % 255 + 1
        header = {"sequence": self._sequence, "board": self.board, **header}
        self.line.write(frame_of(kind, payload, **header))
        body = body_of(self.line.read_until(b"\0"))
        assert body[2] == header["sequence"]
        return body[3], body[4:]

    def report(self, kind: int = READ, payload: bytes = b"") -> Report:
        answered, told = self.ask(kind, payload)
        assert answered == kind | 0x80, (answered, told)
        return report_of(told)

    def press(self, *set_points: int, seconds: float = 0.0) -> Report:
        """Arm, and command set-points for some time."""
        last, end = self.report(ARM), time.monotonic() + seconds
        while True:
            last = self.report(SET, command(last, *set_points))
            if time.monotonic() >= end:
                return last
            time.sleep(0.01)

    def close(self) -> None:
        self.line.close()


def need_firmware() -> None:
    """Skip a test where firmware cannot be built or run."""
    from stiffopt.lab.firmware import missing_tools

    if missing := missing_tools():
        pytest.skip(missing)
