"""The client's side of the guard: it starts the process, commands through it and supervises it.

Control loop, scripts and experiments use a `GuardLink`. It starts a `GuardProcess`, exchanges
messages with it (`Exchange`), and lets a `GuardWatch` vent the supply directly when the guard has
ended or hangs.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, GuardTripped, MissingExtraError, warn_slow
from stiffopt.model.description import RobotDescription
from stiffopt.rig.config import RigDescription
from stiffopt.rig.interface import (
    PoseSample,
    PressureCommand,
    PressureLimits,
    PressureReading,
    PressureSupply,
    vent_at_exit,
)
from stiffopt.safety.gate import Applied, check_protection
from stiffopt.safety.messages import (
    JSON,
    CommandFrame,
    GuardAnswer,
    GuardChannel,
    GuardNotice,
    GuardRequest,
    Message,
    TrackedPoses,
)
from stiffopt.safety.rescue import GuardWatch
from stiffopt.safety.settings import CLIENT

_START_SLICE = 0.05  # s between checks of a guard that starts
_SLICE = 0.02  # s; no thread keeps others from receiving for longer
_RESEND = 1e-3  # s until a message that did not fit into the socket is sent again
_RESOLUTION = 1e-3  # s, of waiting for the socket
_KEPT = 4096  # tracker samples that nobody has taken; the oldest are dropped first
_log = logging.getLogger(__name__)


class GuardProcess:
    """A child process that runs `stiffopt.safety.guard`; it starts with the object.

    Parameters
    ----------
    rig : description of the rig whose supply it owns, and of its robot.
    json_lines : whether it writes JSON lines on stderr.

    Attributes
    ----------
    channel : connection to the process.
    pid : process id.
    """

    def __init__(
        self, rig: tuple[RigDescription, RobotDescription], *, json_lines: bool = False
    ) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-P", "-m", "stiffopt.safety.guard", str(theirs.fileno())]
            # in a session of its own: the terminal's Ctrl-C and Ctrl-Z must not reach the guard
            self._process = subprocess.Popen(
                command + [JSON] * json_lines,
                stdin=subprocess.PIPE,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )
        self.channel = GuardChannel(ours)
        self.pid = self._process.pid
        self._rig = rig

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def wait_until_ready(self) -> str:
        """Wait until the guard owns the supply; return its real-time privileges, in words.

        Raises `DeviceError`: the supply does not answer, or the process does not start;
        `MissingExtraError`: a library is not installed.
        """
        if self._process.stdin is not None:
            with suppress(BrokenPipeError), self._process.stdin as stdin:
                pickle.dump(self._rig, stdin)
        begin, patience = time.monotonic(), CLIENT.start
        while time.monotonic() < begin + patience:
            for message in self.channel.receive(_START_SLICE):
                match message:
                    case GuardNotice("notice", about):
                        warn_slow(about["text"])
                        patience = CLIENT.slow
                    case GuardNotice("failed", about):
                        raise _failure(**about)
                    case GuardNotice("ready", about):
                        return str(about["real_time"])
            if self.channel.closed:
                raise DeviceError("the guard process ended before it was ready")
        raise DeviceError(f"the guard process was not ready within {patience:g} s")

    def has_ended(self, wait: float) -> bool:
        """Wait up to `wait` s for the process to end; return whether it has."""
        try:
            self._process.wait(wait)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """Kill the process at once, even if it is stopped; then it does not vent."""
        self._process.kill()
        self._process.wait()

    def end(self) -> int:
        """Close the connection, which makes the guard vent and end; return its exit code.

        If it does not end by itself, it is terminated and finally killed.
        """
        self.channel.close()
        for force in (self._process.terminate, self._process.kill):
            try:
                return self._process.wait(CLIENT.end)
            except subprocess.TimeoutExpired:
                force()
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(CLIENT.end)
        return -1  # it cannot even be killed: the system itself waits for a device


def _failure(kind: str, args: list[str]) -> Exception:
    """Return the error that kept the guard from starting."""
    if kind == "MissingExtraError":
        return MissingExtraError(*args)
    return DeviceError(" ".join(args))


class Exchange:
    """Sends messages to a guard and matches its answers. Any thread may call any method.

    A thread that waits for its answer receives for all threads, so no thread is needed for
    receiving.

    Parameters
    ----------
    channel : connection to the guard.
    patience : longest time of one call of the supply's driver, in s.

    Attributes
    ----------
    newest : newest answer of the guard to any message; None before the first.
    to_command : newest answer to a command of a stream; None before the first since arming.
    answer_within : time in which the guard must answer a request, in s.
    unanswered_pings : number of pings since the last message of the guard.
    """

    def __init__(self, channel: GuardChannel, patience: float = 0.0) -> None:
        self.newest: GuardAnswer | None = None
        self.to_command: GuardAnswer | None = None
        self.answer_within = max(CLIENT.answer, CLIENT.answer_calls * patience)
        self.unanswered_pings = 0
        self._channel = channel
        self._numbers = itertools.count(1)
        self._receiving = threading.Lock()
        self._answers: dict[int, GuardAnswer] = {}  # to requests with a waiting thread
        self._waiting: set[int] = set()
        self._unanswered: deque[tuple[int, float]] = deque()  # commands, and when they were sent
        self._answered = 0  # sequence number of the newest answer
        self._poses: deque[PoseSample] = deque(maxlen=_KEPT)
        self._broken = 0  # messages that the guard could not decode

    def send_goal(self, goal: PressureCommand) -> GuardAnswer:
        """Send a goal and return the answer to it.

        Raises `DeviceError`: the guard has ended, or does not answer.
        """
        sequence, now = next(self._numbers), time.monotonic()
        pressures = np.asarray(goal.pressures, dtype=float)
        frame = CommandFrame(sequence, now, goal.time, goal.valid_for, pressures, goal=True)
        return self._answer_to(frame, "a command")

    def send(self, command: PressureCommand, wait: float) -> None:
        """Send a command of a stream and wait up to `wait` s for its answer.

        Raises `DeviceError`: the guard has ended, or does not accept the command.
        """
        sequence, now = next(self._numbers), time.monotonic()
        pressures = np.asarray(command.pressures, dtype=float)
        frame = CommandFrame(sequence, now, command.time, command.valid_for, pressures)
        self._unanswered.append((sequence, now))
        if not self._channel.send(frame):
            self.must_live()
            raise DeviceError("the guard process takes no commands; does it hang?")
        end = now + wait
        while self._answered < sequence and (left := end - time.monotonic()) > _RESOLUTION / 2:
            self._receive(left)
            self.must_live()
        self._receive()

    def ask(self, do: str, **about: Any) -> GuardAnswer:
        """Send a request and return the answer, which may report a failure.

        Raises `DeviceError`: the guard has ended, or does not answer.
        """
        return self._answer_to(GuardRequest(next(self._numbers), do, about), f"'{do}'")

    def _answer_to(self, message: CommandFrame | GuardRequest, what: str) -> GuardAnswer:
        """Send a message and return its answer; raise `DeviceError` if none comes in time."""
        sequence, end = message.sequence, time.monotonic() + self.answer_within
        self._waiting.add(sequence)
        try:
            while not self._channel.send(message):
                self._go_on_waiting(what, end)
                time.sleep(_RESEND)
            while True:
                self._receive(_SLICE)
                if sequence in self._answers:
                    return self._answers[sequence]
                self._go_on_waiting(what, end)
        finally:
            self._waiting.discard(sequence)
            self._answers.pop(sequence, None)

    def ping(self) -> None:
        """Request a sign of life and receive what has arrived; do not wait."""
        self._channel.send(GuardRequest(0, "ping"))
        self.unanswered_pings += 1
        self._receive()

    def take_poses(self) -> tuple[PoseSample, ...]:
        """Return the tracker samples that have arrived since the last call."""
        self._receive()
        return tuple(self._poses.popleft() for _ in range(len(self._poses)))

    @property
    def closed(self) -> bool:
        """Whether the connection is closed, by either end."""
        return self._channel.closed

    def must_live(self) -> None:
        """Raise `DeviceError` if the guard has ended."""
        if self.closed:
            raise DeviceError(
                "the guard process has ended; the supply is vented directly, as far as it answers"
            )

    def silence(self) -> float:
        """Return how long the oldest unanswered command has waited, in s; 0 without one."""
        try:
            return time.monotonic() - self._unanswered[0][1]
        except IndexError:
            return 0.0

    def close(self) -> None:
        """Close the connection."""
        with self._receiving:
            self._channel.close()

    def _go_on_waiting(self, what: str, end: float) -> None:
        self.must_live()
        if time.monotonic() > end:
            raise DeviceError(f"the guard process did not answer to {what} in time")

    def _receive(self, wait: float = 0.0) -> None:
        """Receive what has arrived; wait up to `wait` s for a message, but never for long."""
        if not self._receiving.acquire(timeout=wait):
            return  # another thread receives, also for this one
        try:
            messages = self._channel.receive(min(wait, _SLICE))
            if messages:
                self.unanswered_pings = 0
            for message in messages:
                self._note(message)
        finally:
            self._receiving.release()

    def _note(self, message: Message) -> None:
        if isinstance(message, TrackedPoses):
            self._poses.extend(message.samples)
        if isinstance(message, GuardAnswer):
            self.newest = message
            if message.sequence != 0 and message.sequence not in self._waiting:
                self.to_command = message
            if message.broken != self._broken:
                self._broken = message.broken
                _log.warning("the guard could not understand %d messages so far", message.broken)
            self._answered = max(self._answered, message.sequence)  # 0: a report, no answer
            while self._unanswered and self._unanswered[0][0] <= message.sequence:
                self._unanswered.popleft()
            if message.sequence in self._waiting:
                self._answers[message.sequence] = message


class GuardLink:
    """Commands a supply through the guard process that owns it; see `stiffopt.safety.guard`.

    It accepts streams, as an `Outlet`, and goals, as a `GoalFollower`. Times are those of
    `time.monotonic`. Any thread may call any method. When the guard has vented on its own, `apply`,
    `pursue` and `arm` raise `GuardTripped` once; after that, or after `vent`, `arm` works again. If
    the guard has ended or hangs, the supply is vented directly, see `GuardWatch`.

    Parameters
    ----------
    description, robot : the rig and its robot.
    limits : limits of the commands.
    spare : second object for the same supply, never opened before, for venting directly when the
        guard has ended. None for a simulated supply, which ends with its guard.
    json_lines : whether the guard writes JSON lines on stderr instead of sentences.

    Attributes
    ----------
    has_dump_valve : whether venting also opens a valve.
    real_time : the guard's real-time privileges, in words; known after `open`.
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
        self._rescue_time = (
            0.0 if spare is None else max(CLIENT.rescue, 2 * CLIENT.hung_calls * spare.patience)
        )
        self._told = 0  # trips of the guard that the caller knows of

    # start and end -------------------------------------------------------------------------------

    def open(self) -> None:
        """Start the guard and wait until it has connected to the supply and vented it.

        Raises `DeviceError`: the supply does not answer, or the guard does not start;
        `MissingExtraError`: a library is not installed.
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

        Raises `DeviceError`: it is not certain that the supply is vented.
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
            with suppress(DeviceError):  # its exit code says more
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
        """Close the connection and return the guard's exit code."""
        process, exchange = self._process, self._exchange
        self._process = self._exchange = None
        if exchange is not None:
            exchange.close()
        return 0 if process is None else process.end()

    @property
    def alive(self) -> bool:
        """Whether the guard's process runs."""
        return self._process is not None and self._process.alive

    def _has_ended(self) -> bool:
        """Whether the guard has ended; wait briefly if its connection is already closed."""
        if self._process is None:
            return True
        closed = self._exchange is None or self._exchange.closed
        return self._process.has_ended(CLIENT.exit if closed else 0.0)

    @property
    def hung(self) -> bool:
        """Whether the guard runs, but has been silent for so long that it must hang.

        Unanswered pings are counted instead of seconds, since this process may have been stopped.
        """
        pings = 0 if self._exchange is None else self._exchange.unanswered_pings
        longest = (
            CLIENT.hung_simulated
            if self._spare is None
            else CLIENT.hung + CLIENT.hung_calls * self._patience
        )
        return self.alive and pings * CLIENT.ping > longest

    def ping(self) -> None:
        """Request a sign of life from the guard; do not wait for it."""
        if self._exchange is not None:
            self._exchange.ping()

    def kill(self) -> None:
        """Kill a guard that hangs; the kernel closes its devices and frees its claim."""
        if self._process is not None:
            self._process.kill()

    @property
    def pid(self) -> int | None:
        """Process id of the guard; None while the link is closed."""
        return None if self._process is None else self._process.pid

    # commands ------------------------------------------------------------------------------------

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed."""
        if self._spare is not None:
            check_protection(self._spare, self._rig[0].safety)

    def arm(self) -> None:
        """Arm for a stream of commands, the first of which must come within a second.

        Raises `GuardTripped`: the guard had vented on its own and the caller did not know yet;
        `DeviceError`: the supply or the guard fails.
        """
        self._arm(goals=False)

    def arm_for_goals(self) -> None:
        """Arm for goals; all set-points are 0 until the first one.

        Raises `GuardTripped` or `DeviceError` as for `arm`.
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

        Raises `DeviceError`: the guard refuses them, or does not answer.
        """
        self._ask("restrict", high=np.asarray(high, dtype=float).tolist())

    @property
    def armed(self) -> bool:
        """Whether the guard accepts commands."""
        return self.alive and self._answer("ping").armed

    @property
    def commanded(self) -> Array:
        """Set-points (n,) of the supply, in Pa."""
        return self._answer("ping").commanded.copy()

    def vent(self) -> None:
        """Let all pressure out at once; wait for nothing but the guard.

        Raises `DeviceError`: the supply did not accept it; the guard keeps trying as long as it
        lives. Or the guard has ended, and the supply could not be vented directly yet.
        """
        try:
            self._told = self._ask("vent").trips
        except DeviceError:
            if not self._has_ended() or self._watch is None or not self._watch.vent():
                raise

    def read(self) -> PressureReading:
        """Return the measured pressures, in Pa.

        Raises `DeviceError`: the supply or the guard does not answer.
        """
        return _reading(self._ask("read"))

    def apply(self, command: PressureCommand) -> Applied:
        """Send a command of a stream; return the newest answer, to this command or an earlier one.

        Raises `DeviceError`: the guard has ended, does not answer or has vented on its own, or the
        supply fails.
        """
        exchange = self._open_exchange()
        exchange.send(command, CLIENT.fresh)
        newest, silence = exchange.newest, exchange.silence()
        if newest is not None:
            self._check_trip(newest)
        exchange.must_live()
        if newest is None or silence > max(CLIENT.silent, self._patience):
            raise DeviceError(f"the guard process has not answered for {silence:.2g} s")
        # newest set-points and readings, with the outcome of the newest command
        return _applied(newest, exchange.to_command or newest)

    def pursue(self, goal: PressureCommand) -> Applied:
        """Send a goal and return the answer to it.

        Raises `GuardTripped`: the guard has vented on its own; `DeviceError`: the guard has ended
        or does not answer, or the supply fails.
        """
        answer = self._open_exchange().send_goal(goal)
        self._check_trip(answer)
        return _applied(answer, answer)

    def _check_trip(self, answer: GuardAnswer) -> None:
        if answer.tripped:
            self._told = answer.trips
            raise GuardTripped(f"the guard has vented: {answer.tripped}")

    # simulated rigs ------------------------------------------------------------------------------

    def inject(self, device: str, fault: str, channel: int | None = None) -> None:
        """Inject a fault into a device of a simulated rig; see `stiffopt.plant.world.World`.

        Raises `DeviceError`: the rig is real, does not allow faults, or has no such fault.
        """
        self._ask("inject", device=device, fault=fault, channel=channel)

    def truth(self) -> Array:
        """Return the true tip pose (4, 4) of a simulated rig; no controller may use it."""
        return np.array(self._ask("truth").value)

    def ask_world(self, word: str, **about: Any) -> Any:
        """Send a request to the simulated rig in the guard process and return its result.

        Raises `DeviceError`: the request fails, or the rig is not simulated.
        """
        return self._ask(word, **about).value

    def take_poses(self) -> tuple[PoseSample, ...]:
        """Return the new samples of a simulated tracker; do not wait."""
        return () if self._exchange is None else self._exchange.take_poses()

    def _ask(self, do: str, **about: Any) -> GuardAnswer:
        """Return the answer to a request; raise `DeviceError` if it failed."""
        answer = self._answer(do, **about)
        if answer.error:
            raise DeviceError(answer.error)
        return answer

    def _answer(self, do: str, **about: Any) -> GuardAnswer:
        """Return the answer to a request, even if it failed."""
        return self._open_exchange().ask(do, **about)

    def _open_exchange(self) -> Exchange:
        if self._exchange is None:
            raise DeviceError("the guard process was not started, or has ended; open the link")
        return self._exchange


def _reading(answer: GuardAnswer) -> PressureReading:
    return PressureReading(answer.time, answer.measured)


def _applied(newest: GuardAnswer, done: GuardAnswer) -> Applied:
    """Combine set-points and readings of one answer with the outcome of another."""
    return Applied(
        newest.commanded, _reading(newest), done.limited, done.refused, done.force_limited
    )
