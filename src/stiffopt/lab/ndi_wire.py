"""How commands and replies are written on the line of an NDI tracker.

A command is ``NAME:parameters``, a CRC-16 in hexadecimal digits and a carriage return, or ``NAME
parameters`` without a CRC; a reply ends with its CRC-16, and binary ones have a header.
"""

from __future__ import annotations

import struct

import numpy as np

from stiffopt.lab.bench import TrackerFrame

__all__ = ["RefusedError", "crc16", "framed", "hexadecimal", "parse", "pose_as_text"]


class RefusedError(Exception):
    """A command that the device answers with an error code."""

    INVALID = 0x01
    BAD_CRC = 0x04
    BAD_PARAMETERS = 0x07
    BAD_HANDLE = 0x08
    WRONG_MODE = 0x0C
    NOT_INITIALISED = 0x0E
    SYSTEM_NOT_INITIALISED = 0x10


def crc16(data: bytes) -> int:
    """Return the CRC-16 of the protocol: polynomial x^16 + x^15 + x^2 + 1, reflected, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def parse(command: bytes) -> tuple[str, str]:
    """Return name and parameters of a command, whose CRC must be right where there is one."""
    text = command.decode("latin-1")
    name, colon, rest = text.partition(":")
    if not colon:
        name, _, parameters = text.partition(" ")
        return name, parameters
    if f"{crc16(text[:-4].encode('latin-1')):04X}" != rest[-4:].upper():
        raise RefusedError(RefusedError.BAD_CRC)
    return name, rest[:-4]


def hexadecimal(text: str) -> int:
    """Return a number of hexadecimal digits."""
    try:
        return int(text, 16)
    except ValueError:
        raise RefusedError(RefusedError.BAD_PARAMETERS) from None


def pose_as_text(frame: TrackerFrame) -> str:
    """Return signs and digits, without the points: 1e-4 of the quaternion, 0.01 mm, 1e-4 mm."""
    numbers = np.array([*frame.quaternion * 1e4, *frame.position * 1e5])
    if not np.isfinite(numbers).all() or np.abs(numbers[4:]).max() > 999999:
        return "MISSING"
    turns = "".join(f"{round(x):+06d}" for x in numbers[:4])
    places = "".join(f"{round(x):+07d}" for x in numbers[4:])
    return f"{turns}{places}{1000:+06d}"


def framed(body: bytes) -> bytes:
    """Return a binary reply: start, length and their CRC-16, the body and its CRC-16."""
    header = struct.pack("<HH", 0xA5C4, len(body))
    parts = (header, struct.pack("<H", crc16(header)), body, struct.pack("<H", crc16(body)))
    return b"".join(parts)
