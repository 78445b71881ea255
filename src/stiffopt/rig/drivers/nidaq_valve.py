"""A dump valve on a digital line of an NI-DAQ device, and the device's watchdog that opens it."""

from __future__ import annotations

from typing import Literal

from stiffopt.rig.drivers.daqmx import Daqmx, LineName, WatchdogExpiredError
from stiffopt.rig.drivers.daqmx_tasks import DigitalOutput, Watchdog
from stiffopt.rig.interface import Clock
from stiffopt.schema import Schema

__all__ = ["DumpValve", "Valve"]


class DumpValve(Schema):
    """A valve that empties all chambers.

    Attributes
    ----------
    line : digital line, such as ``Dev1/port0/line0``.
    closed_when : level of the line that holds the valve shut. Wire it so that the valve opens
        when the power fails.
    """

    line: LineName
    closed_when: Literal["high", "low"] = "high"


class Valve:
    """The valve; a watchdog with a timeout in s opens it when the software is silent."""

    def __init__(self, daq: Daqmx, settings: DumpValve, timeout: float | None) -> None:
        self._opens_when_high = settings.closed_when == "low"
        self._timeout = timeout or 0.0
        self._line = DigitalOutput(daq, settings.line)
        self._watchdog: Watchdog | None = None
        try:
            if timeout is not None:
                high = self._opens_when_high
                self._watchdog = Watchdog(daq, settings.line, timeout, high=high)
        except BaseException:
            self._line.close()
            raise

    def open(self) -> None:
        """Empty the arm."""
        try:
            self._line.write(high=self._opens_when_high)
        except WatchdogExpiredError:
            if self._watchdog is None:
                raise
            # The device holds the valve open, but takes no other word for it until it is told.
            self._watchdog.clear()
            self._line.write(high=self._opens_when_high)
        # Only now: if the line could not be written, the watchdog still opens the valve.
        if self._watchdog is not None and self._watchdog.running:
            self._watchdog.stop()

    def shut(self) -> None:
        """Let the arm be filled, watched from before the valve shuts."""
        if self._watchdog is not None:
            self._watchdog.start()
        self._line.write(high=not self._opens_when_high)

    def feed(self) -> bool:
        """Tell the watchdog that the software lives; return False if it comes too late."""
        if self._watchdog is not None and self._watchdog.running:
            try:
                self._watchdog.feed()
            except WatchdogExpiredError:
                return False
        return True

    def close(self, clock: Clock) -> None:
        """Let go of the line, which keeps its level."""
        if self._watchdog is not None:
            if self._watchdog.running:  # the valve could not be opened: the device shall do it
                clock.sleep(1.2 * self._timeout)
            self._watchdog.close()
        self._line.close()
