"""What all devices have in common: they are opened, used and closed, under one clock."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from stiffopt.errors import DeviceError

__all__ = ["Clock", "Device", "Opened", "SystemClock"]


class Clock(ABC):
    """The time of a rig."""

    @abstractmethod
    def now(self) -> float:
        """Time in s; it only grows."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Return when `now` has reached `moment`."""

    def sleep(self, duration: float) -> None:
        """Let a duration in s pass."""
        self.sleep_until(self.now() + duration)


class SystemClock(Clock):
    """Real time; changes of the wall clock do not touch it."""

    def now(self) -> float:
        """Time in s since some moment in the past."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until a moment."""
        remaining = moment - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


class Opened(ABC):
    """Something that `with` opens, and closes at its end."""

    @abstractmethod
    def open(self) -> None:
        """Connect."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Device(Opened):
    """Something that is opened once, used and closed.

    A driver's `_open` must leave nothing open when it raises.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock or SystemClock()
        self._is_open = False

    @property
    def is_open(self) -> bool:
        """Whether the device may be used."""
        return self._is_open

    def open(self) -> None:
        """Connect to the device.

        Raises
        ------
        DeviceError
            It does not answer, or not as expected.
        MissingExtraError
            The library that speaks to it is not installed.
        """
        if not self._is_open:
            self._open()
            self._is_open = True

    def close(self) -> None:
        """Disconnect; to close what is closed does nothing."""
        if self._is_open:
            self._is_open = False
            self._close()

    def _must_be_open(self) -> None:
        if not self._is_open:
            raise DeviceError(f"{type(self).__name__} is not open")

    @abstractmethod
    def _open(self) -> None:
        """Connect."""

    @abstractmethod
    def _close(self) -> None:
        """Disconnect, whatever state the device is in; raise nothing."""
