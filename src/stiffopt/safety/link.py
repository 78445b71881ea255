"""The control loop's side of the guard process: an outlet, and the rig around it."""

from __future__ import annotations

import math
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import DeviceError, InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, load_rig_description, slew_of
from stiffopt.rig.interface import (
    Clock,
    PoseSample,
    PoseTracker,
    PressureCommand,
    PressureLimits,
    PressureReading,
    Rig,
    SystemClock,
)
from stiffopt.safety.exchange import Exchange
from stiffopt.safety.frames import Answer
from stiffopt.safety.guard_process import GuardProcess
from stiffopt.safety.guarded import ForwardedTracker, GuardedSupply
from stiffopt.safety.outlet import Applied

__all__ = ["GuardLink", "guarded_rig"]

Array = NDArray[np.float64]

_FRESH = 1e-3  # s, that a command waits for its own answer
_HUNG = 1.0  # s without any answer, after which it is not waited for any more
_SILENT = 0.25  # s without an answer to a command, after which something is wrong


class GuardLink:
    """Commands a supply that a guard process owns; see `stiffopt.safety.guard`.

    It is an `Outlet` whose times are those of `time.monotonic`. Any thread may call any method.
    When the guard has vented by itself, `apply` and `arm` say so by a `DeviceError`; `arm` works
    again once it was said, or the loop has vented too.

    Parameters
    ----------
    description, robot :
        The rig.
    limits :
        What may be commanded.
    json_lines :
        Whether the guard speaks JSON on stderr; else for people.

    Attributes
    ----------
    real_time : what the guard says of its own punctuality, once it is open.
    """

    def __init__(
        self,
        description: RigDescription,
        robot: RobotDescription,
        limits: PressureLimits,
        *,
        json_lines: bool = False,
    ) -> None:
        self.limits = limits
        self.real_time = ""
        self._rig = (description, robot)
        self._json_lines = json_lines
        self._process: GuardProcess | None = None
        self._exchange: Exchange | None = None
        self._told = 0  # trips that were said
        self._deaf = math.inf  # since when it does not answer

    # life ----------------------------------------------------------------------------------------

    def open(self) -> None:
        """Start the guard and wait until it has connected to the supply, and vented it.

        Raises
        ------
        DeviceError
            The supply does not answer, or the guard does not start.
        MissingExtraError
            A library is not installed.
        """
        if self._process is not None:
            return
        self._told, self._deaf = 0, math.inf
        self._process = GuardProcess(self._rig, json_lines=self._json_lines)
        try:
            self.real_time = self._process.wait_until_ready()
            self._exchange = Exchange(self._process.channel)
            self.read()
        except BaseException:
            self._end()
            raise

    def close(self) -> None:
        """Vent, and end the guard; it is killed only if it does not end by itself.

        Raises
        ------
        DeviceError
            It is not certain that the supply is vented.
        """
        if self._process is None:
            return
        with suppress(DeviceError):  # how it ended tells better
            self._ask("close")
        code = self._end()
        if code != 0:
            raise DeviceError(
                f"the guard ended with code {code}: the supply may not be vented; only its own "
                "watchdog and valves can do that now"
            )

    def _end(self) -> int:
        """Hang up and return the guard's exit code."""
        process, exchange = self._process, self._exchange
        self._process = self._exchange = None
        if exchange is not None:
            exchange.close()
        return 0 if process is None else process.end()

    @property
    def alive(self) -> bool:
        """Whether the guard is there."""
        return self._process is not None and self._process.alive

    @property
    def hung(self) -> bool:
        """Whether the guard is there and has not answered for so long that it never may."""
        return self.alive and self._deaf < time.monotonic() - _HUNG

    def kill(self) -> None:
        """End a guard that hangs, so that another can be started; the kernel takes its devices."""
        if self._process is not None:
            self._process.kill()

    @property
    def pid(self) -> int | None:
        """Number of the guard's process, while it is open."""
        return None if self._process is None else self._process.pid

    # outlet --------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Let the guard take commands; the first must come within a second.

        Raises
        ------
        DeviceError
            The guard had vented by itself and this was not said yet, or the supply fails.
        """
        answer = self._answer("arm", told=self._told)
        if answer.error:
            self._told = answer.trips
            raise DeviceError(answer.error)

    def vent(self) -> None:
        """Let all pressure out at once; this waits for nothing but the guard.

        Raises
        ------
        DeviceError
            The supply did not take it, or the guard is gone; the guard tries on as long as it
            lives.
        """
        self._told = self._ask("vent").trips

    def read(self) -> PressureReading:
        """Let the guard read the pressures, in Pa.

        Raises
        ------
        DeviceError
            The supply or the guard does not answer.
        """
        return _reading(self._ask("read"))

    def apply(self, command: PressureCommand) -> Applied:
        """Send a command, and return the newest answer: to this command, or to one before it.

        Raises
        ------
        DeviceError
            The guard is gone, does not answer or has vented by itself, or the supply fails.
        """
        exchange = self._open_exchange()
        exchange.send(command, _FRESH)
        newest = exchange.newest
        if newest is not None and newest.tripped:
            self._told = newest.trips
            raise DeviceError(f"the guard has vented: {newest.tripped}")
        exchange.must_live()
        silence = exchange.silence()
        if newest is None or silence > _SILENT:
            self._deaf = min(self._deaf, time.monotonic())
            raise DeviceError(f"the guard process has not answered for {silence:.2g} s")
        self._deaf = math.inf
        return Applied(
            newest.commanded,
            _reading(newest),
            newest.limited,
            newest.refused,
            newest.force_limited,
        )

    # simulated rigs ------------------------------------------------------------------------------

    def inject(self, device: str, fault: str, channel: int | None = None) -> None:
        """Let a device of a simulated rig misbehave; see `stiffopt.rig.simulated.world.World`.

        Raises
        ------
        DeviceError
            The rig is real, does not allow faults, or has no such fault.
        """
        self._ask("inject", device=device, fault=fault, channel=channel)

    def truth(self) -> Array:
        """Return the true pose (4, 4) of a simulated tip, which no controller may look at."""
        return np.array(self._ask("truth").value)

    def true_pressures(self) -> Array:
        """Return the true pressures (n,) in simulated chambers, in Pa."""
        return np.array(self._ask("pressures").value)

    def take_poses(self) -> tuple[PoseSample, ...]:
        """Return what a simulated tracker has seen since the last call; waits for nothing."""
        return () if self._exchange is None else self._exchange.take_poses()

    def _ask(self, do: str, **about: Any) -> Answer:
        """Return the answer to a request; raise `DeviceError` if it could not be met."""
        answer = self._answer(do, **about)
        if answer.error:
            raise DeviceError(answer.error)
        return answer

    def _answer(self, do: str, **about: Any) -> Answer:
        """Return the answer to a request, whatever it says; take note if there is none."""
        exchange = self._open_exchange()
        try:
            answer = exchange.ask(do, **about)
        except DeviceError:
            self._deaf = min(self._deaf, time.monotonic())
            raise
        self._deaf = math.inf
        return answer

    def _open_exchange(self) -> Exchange:
        if self._exchange is None:
            raise DeviceError("the guard process was not started, or has ended; open the link")
        return self._exchange


def _reading(answer: Answer) -> PressureReading:
    return PressureReading(answer.time, answer.measured)


def guarded_rig(
    rig: str | os.PathLike[str] | RigDescription,
    robot: RobotDescription | None = None,
    *,
    json_lines: bool = False,
) -> tuple[Rig, GuardLink]:
    """Return a rig in real time whose supply a guard process owns, and the link to that.

    Nothing is started before one of them is opened. To open or close the rig opens or closes the
    link too.

    Parameters
    ----------
    rig :
        A rig file, or its content.
    robot :
        Of the rig; needed if its content is given.
    json_lines :
        Whether the guard speaks JSON on stderr.

    Raises
    ------
    FileError
        A file is wrong.
    InputError
        The robot is missing.
    MissingExtraError
        A library is not installed.
    """
    if isinstance(rig, RigDescription):
        if robot is None:
            raise InputError("expected the robot of the rig too")
        description = rig
    else:
        description = load_rig_description(rig)
        robot = robot or load_description(description.robot, base=Path(rig).parent)
    clock: Clock = SystemClock()
    tracker: PoseTracker | None
    if description.supply.driver == "simulated":
        limits = limits_of(description, robot)
        link = GuardLink(description, robot, limits, json_lines=json_lines)
        tracker = None if description.tracker is None else ForwardedTracker(link)
    else:
        real = make_rig(description.model_copy(update={"probe": None}), robot)
        link = GuardLink(description, robot, real.supply.limits, json_lines=json_lines)
        tracker, clock = real.tracker, real.clock
    supply, slew = GuardedSupply(link), slew_of(description, robot)
    return Rig(robot, supply, tracker, clock=clock, slew=slew, settings=description), link
