"""Program that reads an NDI tracker through ndicapi; `AuroraTracker` runs it as a process.

ndicapi is C code that does not check the length of replies and waits seconds for missing ones. In a
separate process it can neither crash the process that holds the pressures nor delay its end.

The only argument is the settings in JSON; the program writes one JSON object per line. It ends when
its standard input ends, or when the device is lost. It is run by its file name and imports nothing
of the package, so that it starts quickly.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
import time
from contextlib import suppress
from typing import Any

try:
    import termios
except ImportError:  # on Windows the library's own timeout of 5 s must do
    termios = None  # type: ignore[assignment]

BAUD_CODES = {9600: 0, 19200: 2, 38400: 3, 57600: 4, 115200: 5}
INIT_PATIENCE = 1.0  # s for the first answer, before other speeds and a reset are tried
RESET_PATIENCE = 4.0  # s for the answer to a reset
SETUP_PATIENCE = 5.0  # s for setting up sensors and field generator
POLL_PATIENCE = 0.3  # s for a frame
LAST_MOMENT = 0.7  # s from the request to end to a forced end
TEXT_ONLY = ("AURORA Rev 007", "AURORA Rev 008")  # firmware whose binary replies are unusable
NDI_IDS = {(0x0403, product) for product in range(0xDA70, 0xDA75)}
NDI_VENDOR = 0x23F2


class LostError(Exception):
    """The tracker is unusable, or was lost."""


class SerialPort:
    """The serial port, opened a second time to explain failures and to shorten timeouts."""

    def __init__(self, port: str) -> None:
        self.fd = -1
        if termios is None:
            return
        try:
            self.fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except FileNotFoundError:
            raise LostError(f"there is no port {port}; {known_ports()}") from None
        except PermissionError:
            raise LostError(
                f"no permission to use {port}; add your user to the group that owns it, usually "
                "with 'sudo usermod -aG dialout $USER', and log in again"
            ) from None
        except OSError as error:
            raise LostError(f"{port} cannot be opened: {error.strerror}") from None
        if not os.isatty(self.fd):
            os.close(self.fd)
            raise LostError(f"{port} is not a serial port; {known_ports()}")

    def wait_for(self, patience: float) -> None:
        """Set how long the library waits for a reply, in s."""
        if termios is not None:
            attributes = termios.tcgetattr(self.fd)
            attributes[6][termios.VTIME] = max(1, round(patience * 10))
            termios.tcsetattr(self.fd, termios.TCSANOW, attributes)

    def set_speed(self, baud: int) -> None:
        """Set the speed of this end of the line."""
        if termios is not None:
            attributes = termios.tcgetattr(self.fd)
            attributes[4] = attributes[5] = getattr(termios, f"B{baud}")
            termios.tcsetattr(self.fd, termios.TCSANOW, attributes)

    def close(self) -> None:
        """Close the port."""
        if self.fd >= 0:
            os.close(self.fd)


def known_ports() -> str:
    """Return a sentence that lists the serial ports."""
    from serial.tools import list_ports

    names = sorted(port.device for port in list_ports.comports())
    if not names:
        return "this computer has none now"
    are = "port here is" if len(names) == 1 else "ports here are"
    return f"the {are} {', '.join(names)}"


def find_port() -> str:
    """Return the port of the only NDI device, without opening ports of other makers."""
    from serial.tools import list_ports

    ports = [
        port.device
        for port in list_ports.comports()
        if port.vid == NDI_VENDOR or (port.vid, port.pid) in NDI_IDS
    ]
    if not ports:
        raise LostError(f"no USB port identifies itself as NDI's; {known_ports()}")
    if len(ports) > 1:
        raise LostError(f"there are several NDI devices, at {', '.join(ports)}; name one")
    return str(ports[0])


class Session:
    """A connection to the tracker, from the first command to the last."""

    def __init__(self, ndi: Any, port: str, baud: int) -> None:
        self.ndi = ndi
        self.port = port
        self.baud = baud
        self.line = SerialPort(port)
        self.device = ndi.ndiOpen(port)
        if not self.device:
            self.line.close()
            raise LostError(f"{port} cannot be opened; is another program using it?")

    def ask(self, command: str) -> str:
        """Send a command and return the reply; the library raises OSError for errors."""
        return str(self.ndi.ndiCommand(self.device, command))

    def greet(self, likely: int) -> None:
        """Initialise the device at whatever speed it has, and set the speed of both ends."""
        speeds = dict.fromkeys((likely, 9600, self.baud))
        if not any(self.is_heard_at(speed) for speed in speeds):
            self.reset()
        self.line.wait_for(SETUP_PATIENCE)
        self.ask(f"COMM:{BAUD_CODES[self.baud]}0000")
        self.line.set_speed(self.baud)
        time.sleep(0.1)  # time for the device to change its speed

    def is_heard_at(self, speed: int) -> bool:
        """Return whether the device can be initialised at a speed."""
        self.line.wait_for(INIT_PATIENCE)
        self.line.set_speed(speed)
        for _ in range(2):  # bytes sent at another speed may spoil the first command
            try:
                self.ask("INIT:")
            except OSError:
                if int(self.ndi.ndiGetError(self.device)) == int(self.ndi.NDI_TIMEOUT):
                    return False
            else:
                return True
        return False

    def reset(self) -> None:
        """Reset the device with a break on the line."""
        self.line.wait_for(RESET_PATIENCE)
        self.line.set_speed(9600)
        try:
            self.ndi.ndiRESET(self.device)
            self.line.wait_for(SETUP_PATIENCE)
            self.ask("INIT:")
        except OSError:
            raise LostError(
                f"no NDI tracker answers at {self.port}; check that it is switched on, its cable, "
                "and that this is its port"
            ) from None

    def handles(self, kind: int) -> list[int]:
        """Return the port handles of a kind: 1 for those to free, 2 for those to initialise."""
        self.ask(f"PHSR:{kind:02X}")
        count = int(self.ndi.ndiGetPHSRNumberOfHandles(self.device))
        return [int(self.ndi.ndiGetPHSRHandle(self.device, i)) for i in range(count)]

    def enable(self, sensor: int) -> int:
        """Initialise all sensors, enable one of them, and return its handle."""
        for handle in self.handles(1):
            self.ask(f"PHF:{handle:02X}")
        found: dict[int, str] = {}
        while new := [handle for handle in self.handles(2) if handle not in found]:
            for handle in new:  # the second sensor of a port appears after the first
                found[handle] = ""
                try:
                    self.ask(f"PINIT:{handle:02X}")
                except OSError as error:
                    found[handle] = str(error)
        if sensor > len(found):
            names = ", ".join(f"{handle:02X}" for handle in sorted(found)) or "none"
            raise LostError(
                f"the tracker at {self.port} has no sensor {sensor} (port handles: {names}); "
                "check that it is plugged in"
            )
        handle = sorted(found)[sensor - 1]
        if found[handle]:
            raise LostError(f"sensor {sensor} cannot be initialised: {found[handle]}")
        self.ask(f"PENA:{handle:02X}D")
        return handle

    def needs_text(self) -> bool:
        """Return whether the firmware is too old for binary replies."""
        version = self.ask("VER:0")
        tags = [row.partition(":")[2] for row in version.split("\n") if row.startswith("Freeze")]
        return any(tag.strip() in TEXT_ONLY for tag in tags)

    def close(self) -> None:
        """Stop tracking, restore the default speed, and close the line."""
        with suppress(OSError):
            self.line.wait_for(0.2)
            self.ask("TSTOP:")
            self.ask("COMM:00000")
        self.abandon()

    def abandon(self) -> None:
        """Close the line."""
        self.ndi.ndiClose(self.device)
        self.line.close()


def follow(session: Session, settings: dict[str, Any], stop: threading.Event, tell: Any) -> None:
    """Track until `stop` is set; report every frame once by `tell`."""
    ndi, device = session.ndi, session.device
    session.greet(settings["likely_baud"])
    wanted = settings["reply"]
    is_text = session.needs_text() if wanted == "auto" else wanted == "text"
    kind = "TX" if is_text else "BX"
    port = bytes([session.enable(settings["sensor"])])
    read_frame, read_pose = (
        getattr(ndi, f"ndiGet{kind}Frame"),
        getattr(ndi, f"ndiGet{kind}Transform"),
    )
    session.ask("TSTART:")
    session.line.wait_for(POLL_PATIENCE)
    command = f"{kind}:{0x0801 if settings['outside_volume'] else 0x0001:04X}"
    tell(ready=session.port)
    last, answered = None, time.monotonic()
    while not stop.is_set():
        asked = time.monotonic()
        try:
            session.ask(command)
        except OSError as error:
            tell(error=str(error))
            passing = int(ndi.ndiGetError(device)) in (int(ndi.NDI_TIMEOUT), int(ndi.NDI_BAD_CRC))
            if not passing or time.monotonic() - answered > settings["reconnect_after"]:
                raise LostError(f"the tracker at {session.port} is lost: {error}") from None
            stop.wait(settings["pause"])
            continue
        answered = time.monotonic()
        frame, pose = int(read_frame(device, port)), read_pose(device, port)
        if pose == "DISABLED":
            raise LostError(f"sensor {settings['sensor']} was unplugged")
        if frame != last:
            last = frame
            tell(at=asked, frame=frame, pose=None if pose == "MISSING" else list(pose))
        stop.wait(settings["pause"])


def run(settings: dict[str, Any], stop: threading.Event, tell: Any) -> None:
    """Connect and track; report why it ends unless `stop` was set."""
    try:
        ndi = importlib.import_module("ndicapy")
        port = find_port() if settings["port"] == "auto" else settings["port"]
        session = Session(ndi, port, settings["baud"])
    except LostError as error:
        tell(lost=str(error))
        return
    try:
        follow(session, settings, stop, tell)
    except LostError as error:
        session.abandon()
        tell(lost=str(error))
    except OSError as error:
        session.abandon()
        tell(lost=f"the tracker at {port} refuses to work: {error}")
    else:
        session.close()


def main() -> None:
    """Run with the settings of the command line."""
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # in case the library prints
    stop = threading.Event()

    def tell(**message: Any) -> None:
        try:
            lines.write(f"{json.dumps(message)}\n")
        except OSError:  # the parent process has ended
            os._exit(0)

    def watch() -> None:
        while os.read(0, 64):
            pass
        stop.set()
        time.sleep(LAST_MOMENT)
        os._exit(0)  # the library still waits

    threading.Thread(target=watch, daemon=True).start()
    run(json.loads(sys.argv[1]), stop, tell)


if __name__ == "__main__":
    main()
