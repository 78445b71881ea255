"""The basis of all devices: a clock, opening and closing, and settings in the rig file."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from importlib import import_module
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from stiffopt.errors import DeviceError, InputError, MissingExtraError
from stiffopt.model.description import RobotDescription
from stiffopt.schema import Schema


class Clock(ABC):
    """Base of the clocks of a rig."""

    @abstractmethod
    def now(self) -> float:
        """Return the time, in s; it never decreases."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Return when `now` has reached `moment`."""

    def sleep(self, duration: float) -> None:
        """Wait for a duration, in s."""
        self.sleep_until(self.now() + duration)


class SystemClock(Clock):
    """Real time, unaffected by changes of the wall clock."""

    def now(self) -> float:
        """Return the time, in s, since a fixed moment in the past."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until a time, in s."""
        remaining = moment - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


class Opened(ABC):
    """Base of rigs and devices: open and close them by `with` or by hand."""

    @abstractmethod
    def open(self) -> None:
        """Connect."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Device(Opened):
    """Base of all devices: opened, used, closed.

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
        """Disconnect; a second call does nothing."""
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


class MisfitError(InputError):
    """A section of a rig file contradicts another section, or the robot.

    `place`: keys that lead to the mistake, from the top of the rig file.
    """

    def __init__(self, reason: str, *place: str | int) -> None:
        super().__init__(reason)
        self.place = place


class RigSection(Schema):
    """A section of a rig file that another package defines, such as a device or the plant."""

    def check_against(self, rig: Any, robot: RobotDescription) -> None:
        """Check this section against the rest of the rig (a `RigDescription`) and its robot.

        Raises
        ------
        MisfitError
            There is a contradiction.
        """


class DeviceSettings(RigSection):
    """Base of a device's settings in a rig file.

    Attributes
    ----------
    driver : name of the driver, or its class as ``package.module:Class``. A driver that has only
        one name declares it as a `Literal`.
    extra : stiffopt's extra that installs the driver's libraries; empty: it needs none.
    peer : ``module:Class`` of the `stiffopt.lab.bench.Peer` that plays this device in the virtual
        lab; empty: there is none.
    simulated : whether the device belongs to a simulated arm.
    """

    extra: ClassVar[str] = ""
    peer: ClassVar[str] = ""
    simulated: ClassVar[bool] = False

    driver: Annotated[str, Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _names_its_class(cls, value: Any) -> Any:
        """Give settings made in code the name by which a rig file finds this class."""
        if isinstance(value, dict) and cls.model_fields["driver"].is_required():
            return {"driver": f"{cls.__module__}:{cls.__qualname__}", **value}
        return value


def library(module: str, package: str, extra: str) -> Any:
    """Import a library that one of stiffopt's extras installs.

    Raises `MissingExtraError`: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtraError(package, extra) from None
