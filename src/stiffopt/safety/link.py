"""The client's end of the guard process: it takes streams and goals, and is part of a rig."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import DeviceError, GuardTripped, InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, load_rig_description, slew_of
from stiffopt.rig.interface import (
    Clock,
    ForceProbe,
    PoseSample,
    PoseTracker,
    PressureCommand,
    PressureLimits,
    PressureReading,
    PressureSupply,
    Rig,
    SystemClock,
    vent_at_exit,
)
from stiffopt.safety.exchange import Exchange
from stiffopt.safety.frames import Answer
from stiffopt.safety.gate import check_protection
from stiffopt.safety.goal import GoalSupply
from stiffopt.safety.guard_process import GuardProcess
from stiffopt.safety.guarded import ForwardedProbe, ForwardedTracker
from stiffopt.safety.outlet import Applied
from stiffopt.safety.rescue import PING_PERIOD, GuardWatch

__all__ = ["GuardLink", "guarded_rig"]

Array = NDArray[np.float64]

_FRESH = 1e-3  # s, that a command waits for its own answer
_HUNG = 1.0  # s without a sign of life, beyond the driver's own time, after which it is ended
_SILENT = 0.25  # s without an answer to a command, at least, after which something is wrong
_CALLS = 3  # of the driver, at most, that one step of the guard makes
_SIMULATED = 10.0  # s without a sign of life of a simulated world, which may be compiling
_RESCUE = 5.0  # s, at least, for which a lost guard's supply is tried to be vented directly


class GuardLink:
    """Commands a supply that a guard process owns; see `stiffopt.safety.guard`.

    It is an `Outlet` whose times are those of `time.monotonic`. Any thread may call any method.
    When the guard has vented by itself, `apply`, `pursue` and `arm` say so by `GuardTripped`; `arm`
    works again once it was said, or the client has vented too. When the guard is gone, or hangs,
    the supply is vented directly, see `GuardWatch`.

    Parameters
    ----------
    description, robot :
        The rig.
    limits :
        What may be commanded.
    spare :
        Another object for the same supply, never opened while the guard lives: to vent it directly
        when the guard is gone. None for a simulated supply, which is gone with its guard.
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
        spare: PressureSupply | None = None,
        *,
        json_lines: bool = False,
    ) -> None:
        self.limits = limits
        self.has_dump_valve = spare is not None and spare.has_dump_valve
        self.real_time = ""
        self._rig = (description, robot)
        self._json_lines = json_lines
        self._process: GuardProcess | None = None
        self._exchange: Exchange | None = None
        self._spare = spare
        self._patience = 0.0 if spare is None else spare.patience
        self._watch: GuardWatch | None = None
        self._rescue_time = 0.0 if spare is None else max(_RESCUE, 2 * _CALLS * spare.patience)
        self._told = 0  # trips that were said

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
        self._told = 0
        self._process = GuardProcess(self._rig, json_lines=self._json_lines)
        try:
            self.real_time = self._process.wait_until_ready()
            self._exchange = Exchange(self._process.channel, self._patience)
            self.read()
        except BaseException:
            self._end()
            raise
        self._watch = GuardWatch(self, self._spare)
        self._watch.start()

    def close(self) -> None:
        """Vent, and end the guard; it is killed only if it does not end by itself.

        Raises
        ------
        DeviceError
            It is not certain that the supply is vented.
        """
        if self._process is None:
            return
        watch, self._watch = self._watch, None
        lost = not self._process.alive
        if watch is not None:
            if lost:
                watch.wait(self._rescue_time)
            watch.stop()
        if not lost:
            with suppress(DeviceError):  # how it ended tells better
                self._ask("close")
        code = self._end()
        if code != 0 and not (watch is not None and watch.vent(self._rescue_time)):
            if self._spare is not None:
                vent_at_exit(self._spare)
            reason = watch.error if watch is not None and watch.error else f"it ended with {code}"
            raise DeviceError(
                f"the guard process is gone and the supply may not be vented ({reason}); only its "
                "own watchdog and valves can do that now"
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
        """Whether the guard is there and has not answered for so long that it never may.

        Unanswered pings are counted, not seconds: this process may have been stopped meanwhile.
        """
        pings = 0 if self._exchange is None else self._exchange.unanswered_pings
        longest = _SIMULATED if self._spare is None else _HUNG + _CALLS * self._patience
        return self.alive and pings * PING_PERIOD > longest

    def ping(self) -> None:
        """Ask the guard for a sign of life; waits for nothing."""
        if self._exchange is not None:
            self._exchange.ping()

    def kill(self) -> None:
        """End a guard that hangs, so that another can be started; the kernel takes its devices."""
        if self._process is not None:
            self._process.kill()

    @property
    def pid(self) -> int | None:
        """Number of the guard's process, while it is open."""
        return None if self._process is None else self._process.pid

    # outlet --------------------------------------------------------------------------------------

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed."""
        if self._spare is not None:
            check_protection(self._spare, self._rig[0].safety)

    def arm(self) -> None:
        """Let the guard take a stream of commands; the first must come within a second.

        Raises
        ------
        GuardTripped
            The guard had vented by itself and this was not said yet.
        DeviceError
            The supply or the guard fails.
        """
        self._arm(goals=False)

    def arm_for_goals(self) -> None:
        """Let the guard take goals; all set-points are 0 until the first one comes.

        Raises
        ------
        GuardTripped, DeviceError
            As for `arm`.
        """
        self._arm(goals=True)

    def _arm(self, *, goals: bool) -> None:
        self._open_exchange().to_command = None
        answer = self._answer("arm", told=self._told, goals=goals)
        if answer.error:
            unsaid, self._told = answer.trips != self._told, answer.trips
            if unsaid and answer.tripped:
                raise GuardTripped(answer.error)
            raise DeviceError(answer.error)

    def restrict(self, high: Array) -> None:
        """Let no channel rise above a task's limits (n,), in Pa; see `SafetyGate.restrict`.

        Raises
        ------
        DeviceError
            The guard does not take them.
        """
        self._ask("restrict", high=np.asarray(high, dtype=float).tolist())

    @property
    def armed(self) -> bool:
        """Whether the guard takes commands."""
        return self.alive and self._answer("ping").armed

    @property
    def commanded(self) -> Array:
        """The set-points (n,) that the supply has been told, in Pa."""
        return self._answer("ping").commanded.copy()

    def vent(self) -> None:
        """Let all pressure out at once; this waits for nothing but the guard.

        Raises
        ------
        DeviceError
            The supply did not take it; the guard tries on as long as it lives. Or the guard is
            gone, and the supply could not be vented directly yet.
        """
        try:
            self._told = self._ask("vent").trips
        except DeviceError:
            if self.alive or self._watch is None or not self._watch.vent():
                raise

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
        self._check_trip()
        exchange.must_live()
        newest, silence = exchange.newest, exchange.silence()
        if newest is None or silence > max(_SILENT, self._patience):
            raise DeviceError(f"the guard process has not answered for {silence:.2g} s")
        return self._applied()

    def pursue(self, goal: PressureCommand) -> Applied:
        """Send a goal, and return what became of it.

        Raises
        ------
        GuardTripped
            The guard has vented by itself.
        DeviceError
            The guard is gone or does not answer, or the supply fails.
        """
        answer = self._open_exchange().send_goal(goal)
        if answer.tripped:
            self._told = answer.trips
            raise GuardTripped(f"the guard has vented: {answer.tripped}")
        return _applied(answer, answer)

    def _check_trip(self) -> None:
        newest = self._open_exchange().newest
        if newest is not None and newest.tripped:
            self._told = newest.trips
            raise GuardTripped(f"the guard has vented: {newest.tripped}")

    def _applied(self) -> Applied:
        """Return the newest set-points and readings, and what became of the newest command."""
        exchange = self._open_exchange()
        newest, to_command = exchange.newest, exchange.to_command
        if newest is None:
            raise DeviceError("the guard process has not answered yet")
        return _applied(newest, to_command or newest)

    # simulated rigs ------------------------------------------------------------------------------

    def inject(self, device: str, fault: str, channel: int | None = None) -> None:
        """Let a device of a simulated rig misbehave; see `stiffopt.plant.world.World`.

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

    def ask_world(self, word: str, **about: Any) -> Any:
        """Have the simulated rig in the guard process do something, and return what it answers.

        Raises
        ------
        DeviceError
            It cannot.
        """
        return self._ask(word, **about).value

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
        """Return the answer to a request, whatever it says."""
        return self._open_exchange().ask(do, **about)

    def _open_exchange(self) -> Exchange:
        if self._exchange is None:
            raise DeviceError("the guard process was not started, or has ended; open the link")
        return self._exchange


def _reading(answer: Answer) -> PressureReading:
    return PressureReading(answer.time, answer.measured)


def _applied(newest: Answer, done: Answer) -> Applied:
    """Return set-points and readings of one answer, and what became of a command of another."""
    return Applied(
        newest.commanded, _reading(newest), done.limited, done.refused, done.force_limited
    )


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
    limits, slew = limits_of(description, robot), slew_of(description, robot)
    clock: Clock = SystemClock()
    tracker: PoseTracker | None
    probe: ForceProbe | None
    if description.supply.driver == "simulated":
        link = GuardLink(description, robot, limits, json_lines=json_lines)
        link.has_dump_valve = bool(getattr(description.supply, "dump_valve", False))
        tracker = None if description.tracker is None else ForwardedTracker(link)
        probe = None if description.probe is None else ForwardedProbe(link)
    else:
        real = make_rig(description, robot)
        spare = real.supply
        assert isinstance(spare, PressureSupply)
        link = GuardLink(description, robot, spare.limits, spare, json_lines=json_lines)
        tracker, probe, clock = real.tracker, real.probe, real.clock
    guarded = Rig(
        robot,
        GoalSupply(link, clock),
        tracker,
        probe,
        clock=clock,
        slew=slew,
        max_force=description.safety.max_force,
        settings=description,
    )
    return guarded, link
