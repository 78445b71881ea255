"""The guard: a separate process that owns the supply and vents when its client fails.

`stiffopt.safety.guard_client.GuardLink` starts it. It accepts two kinds of commands and passes them
through the safety gate:

- A control loop sends a *stream*. If no command arrives for the guard's timeout, because the loop
  was killed or stopped or hangs, the guard vents.
- A program that commands now and then sends *goals* with a time of validity. The guard approaches
  and repeats a goal, and lets the pressures down when it has expired, see `stiffopt.safety.goal`.

In both cases it vents when the client's process has ended, on every signal that would end the guard
and can be handled, and when ``stiffopt vent`` calls on the vent line. After it has vented on its
own, it is *tripped*: it refuses commands until a client that knows of the trip arms it.

Two limits: while the supply's driver waits for its device, at most for the driver's own timeouts,
the guard does nothing else; and a guard that is killed cannot vent. Its client then vents in its
place (`stiffopt.safety.rescue`), and so does the device's own watchdog.
"""

from __future__ import annotations

import gc
import os
import pickle
import signal
import socket
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from typing import Any

import numpy as np

from stiffopt.errors import CommandError, DeviceError, SlowWarning, StiffoptError
from stiffopt.rig.interface import PoseSample, PressureCommand, PressureReading
from stiffopt.safety.gate import Applied, Outlet
from stiffopt.safety.goal import GoalFollower
from stiffopt.safety.hosted import HostedDevices, Owned, owned
from stiffopt.safety.messages import (
    JSON,
    CommandFrame,
    GuardAnswer,
    GuardChannel,
    GuardNotice,
    GuardRequest,
    Message,
    TrackedPoses,
    json_line,
)
from stiffopt.safety.realtime import real_time
from stiffopt.safety.settings import GUARD
from stiffopt.safety.vent_line import VentLine

_ASKED = "asked to"
_POSES = 200  # tracker samples per packet
_LONGEST = 500  # characters of a text: an answer must fit into one packet
_IGNORED = ("SIGINT", "SIGPIPE", "SIGTSTP", "SIGTTIN", "SIGTTOU")  # the client decides on the end
_HARMLESS = ("SIGCHLD", "SIGCONT", "SIGURG", "SIGWINCH")  # their default action does nothing
_FATAL = ("SIGKILL", "SIGSTOP", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL")


class Guard:
    """The decisions of the guard process: when to pass commands on, when to vent.

    Parameters
    ----------
    outlet : the gate in front of the supply; open.
    channel : connection to the client.
    timeout : silence of a stream after which the guard vents, in s.
    follower : brings the supply to goals; None: only streams are accepted.
    line : vent line for calls of ``stiffopt vent``; None: there is none.
    clock : returns the time in s; `time.monotonic` is common to all processes.
    pause : sleeps for some s.
    epoch : time 0 of the rig's own clock on `clock`, in s.
    hosted : tracker, probe and truth of a simulated rig.
    as_json : whether log lines on stderr are JSON instead of sentences.
    orphaned : returns whether the client's process has ended. A forked child of it may keep its end
        of the channel open.
    """

    def __init__(
        self,
        outlet: Outlet,
        channel: GuardChannel,
        timeout: float,
        *,
        follower: GoalFollower | None = None,
        line: VentLine | None = None,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
        epoch: float = 0.0,
        hosted: HostedDevices | None = None,
        as_json: bool = False,
        orphaned: Callable[[], bool] = lambda: False,
    ) -> None:
        self._orphaned = orphaned
        self._outlet = outlet
        self._channel = channel
        self._timeout = timeout
        self._silence = (
            f"no command had come for {timeout * 1e3:g} ms: the program that commands, or this "
            "computer, was late"
        )
        self._follower = follower
        self._line = line
        if line is not None:
            channel.wake_for(line.descriptors())
        self._clock = clock
        self._pause = pause
        self._epoch = epoch
        self._hosted = hosted
        self._as_json = as_json
        n = outlet.limits.n
        self._commanded = np.zeros(n)
        self._reading = PressureReading(np.nan, np.full(n, np.nan))
        self._armed = False
        self._goals = False  # whether it is armed for goals
        self._due: float | None = None  # time when a silent stream is vented; None: no stream
        self._to_vent: float | None = None  # next attempt to vent; None: vented, or armed
        self._trips = 0
        self._tripped = ""
        self._leaving = ""
        self._tidied = clock()
        self._broken_told = 0.5  # broken packets reported; the next report is at twice as many

    def leave(self, reason: str) -> None:
        """End soon, after venting; for signal handlers."""
        self._leaving = reason

    def serve(self) -> int:
        """Run until the client has ended or requests the end; return the exit code."""
        try:
            while not self._leaving:
                self.step()
        except BaseException as error:  # a bug here must not keep an arm under pressure
            self._leaving = f"the guard failed: {type(error).__name__}: {error}"
            raise
        finally:
            code = self._end()
        return code

    def step(self) -> None:
        """Wait briefly for messages, handle them, and check all deadlines."""
        self._handle(self._channel.receive(self._patience()))
        self._answer_callers()
        if self._channel.broken >= 2 * self._broken_told:
            self._report_broken()
        if (self._channel.closed or self._orphaned()) and not self._leaving:
            self._leaving = "the process that commands has ended"
        self._check_deadline()
        self._follow()
        now = self._clock()
        if self._to_vent is not None and now >= self._to_vent:
            self._vent()
        if not self._armed and now - self._tidied > GUARD.collect:
            gc.collect()
            self._tidied = now
        self._forward_poses()

    def _patience(self) -> float:
        moments = [self._clock() + (GUARD.idle if self._hosted is None else GUARD.hosting)]
        moments += [moment for moment in (self._due, self._to_vent) if moment is not None]
        if self._follower is not None:
            moments.append(self._follower.due + self._epoch)
        return max(0.0, min(moments) - self._clock())

    # messages ------------------------------------------------------------------------------------

    def _handle(self, messages: Sequence[Message]) -> None:
        """Handle messages: requests to vent first, and only the newest of several commands."""
        vents = [
            i for i, m in enumerate(messages) if isinstance(m, GuardRequest) and m.do == "vent"
        ]
        last_vent = vents[-1] if vents else 0
        newest: CommandFrame | None = None
        later: list[GuardRequest] = []
        for index, message in enumerate(messages):
            if isinstance(message, CommandFrame):
                self._extend_deadline(message)
                self._overtaken(newest, "a newer command")
                newest = message
            elif isinstance(message, GuardRequest) and (message.do == "vent" or index >= last_vent):
                if message.do in ("arm", "vent"):
                    self._overtaken(newest, f"a request to {message.do}")
                    newest = None
                self._carry_out_request(message)
            elif isinstance(message, GuardRequest) and message.do in ("arm", "restrict"):
                self._answer(message.sequence, error="a command to vent has overtaken this")
            elif isinstance(message, GuardRequest):
                later.append(message)
        for request in later:  # they came before a request to vent, and could wait
            self._carry_out_request(request)
        if newest is not None:
            self._check_deadline()
            self._pass_on(newest)

    def _overtaken(self, frame: CommandFrame | None, by: str) -> None:
        """Answer a goal that is not pursued; a command of a stream needs no such answer."""
        if frame is not None and frame.goal:
            self._answer(
                frame.sequence,
                Applied(self._commanded, self._reading, refused=f"{by} has overtaken this one"),
            )

    def _extend_deadline(self, frame: CommandFrame) -> None:
        """Extend a stream's deadline, counted from when the frame was sent: it may have waited."""
        if self._due is None or frame.goal:
            return
        if not frame.sent <= self._due:  # NaN is too late as well
            self._trip(self._silence)
        else:
            self._due = min(frame.sent, self._clock()) + self._timeout

    def _check_deadline(self) -> None:
        if self._due is not None and self._clock() > self._due:
            self._trip(self._silence)

    def _pass_on(self, frame: CommandFrame) -> None:
        if self._tripped:
            self._answer(frame.sequence)
            return
        command = PressureCommand(frame.pressures, frame.time - self._epoch, frame.valid_for)
        try:
            applied = self._carry_out(command, goal=frame.goal)
        except CommandError as error:
            applied = Applied(self._commanded, self._reading, refused=str(error))
        except Exception as error:
            text = _sentence(error)
            self._trip(f"the supply failed: {text}")
            self._answer(frame.sequence, error=text)
            return
        self._commanded, self._reading = applied.pressures, applied.reading
        self._answer(frame.sequence, applied)

    def _carry_out(self, command: PressureCommand, *, goal: bool) -> Applied:
        if goal != self._goals and self._armed:
            raise CommandError("the supply was armed for commands of another kind; arm it again")
        if goal and self._follower is not None:
            applied = self._follower.pursue(command)
            self._armed = self._follower.armed
            return applied
        return self._outlet.apply(command)

    def _follow(self) -> None:
        """When it is due, let the follower repeat a goal, or let down after it has expired."""
        follower = self._follower
        if follower is None or follower.due + self._epoch > self._clock():
            return
        try:
            follower.tick()
        except Exception as error:
            self._trip(f"the supply failed: {_sentence(error)}")
            return
        self._commanded, self._armed = follower.commanded, follower.armed

    def _answer_callers(self) -> None:
        """Vent for callers on the vent line."""
        if self._line is None:
            return
        for caller in self._line.wanting_to_vent():
            if self._armed:
                error = self._trip(f"{caller.peer.name} called 'stiffopt vent'")
            else:
                error = self._vent()
            caller.answer(error)

    def _carry_out_request(self, request: GuardRequest) -> None:
        error, value = "", None
        try:
            match request.do:
                case "arm":
                    self._arm(request.about.get("told"), goals=bool(request.about.get("goals")))
                case "ping":
                    pass
                case "restrict":
                    self._outlet.restrict(np.array(request.about.get("high"), dtype=float))
                case "vent":
                    error = self._vent()
                case "read":
                    self._reading = self._outlet.read()
                case "close":
                    self._leaving = _ASKED
                    error = self._vent()
                case word:
                    value = self._ask_hosted(word, request.about)
        except Exception as problem:
            error = _sentence(problem)
        self._answer(request.sequence, error=error, value=value)

    def _arm(self, told: Any, *, goals: bool) -> None:
        """Arm, unless the client, which knows of `told` trips, does not know of the last one."""
        if self._tripped and told != self._trips:
            raise DeviceError(f"the guard had vented: {self._tripped}")
        if self._to_vent is not None:
            raise DeviceError("the supply could not be vented yet; it cannot be armed")
        try:
            if self._armed:  # arming starts without pressure and without a goal
                (self._follower or self._outlet).vent()
            if goals and self._follower is not None:
                self._follower.arm_for_goals()
            else:
                self._outlet.arm()
        except BaseException:
            self._vent()
            raise
        self._commanded = np.zeros_like(self._commanded)
        self._tripped = ""
        self._armed, self._goals = True, goals
        self._due = None if goals else self._clock() + GUARD.first_command

    def _ask_hosted(self, word: str, about: dict[str, Any]) -> Any:
        if self._hosted is None:
            raise DeviceError(f"the guard does not know '{word}'; only a simulated rig might")
        return self._hosted.ask(word, about)

    def _report_broken(self) -> None:
        """Report messages that could not be decoded; they extend no deadline."""
        self._broken_told = self._channel.broken
        self._say(f"messages refused so far that make no sense: {self._broken_told}")

    # actions -------------------------------------------------------------------------------------

    def _trip(self, reason: str) -> str:
        """Vent, and refuse commands until a client that knows of it arms; return the error."""
        self._tripped = reason[:_LONGEST]
        self._trips += 1
        error = self._vent()
        if not error:
            self._say(f"vented: {reason}")
        self._answer(0)
        return error

    def _vent(self) -> str:
        """Vent; if that fails, return the error and schedule another attempt."""
        self._armed, self._due = False, None
        try:
            (self._follower or self._outlet).vent()
        except Exception as error:
            if self._to_vent is None:
                self._say(f"COULD NOT VENT, and tries again: {_sentence(error)}", "error")
            self._to_vent = self._clock() + GUARD.retry
            return _sentence(error)
        if self._to_vent is not None:
            self._say("vented after all")
        self._to_vent = None
        self._commanded = np.zeros_like(self._commanded)
        return ""

    def _answer(
        self, sequence: int, applied: Applied | None = None, *, error: str = "", value: Any = None
    ) -> None:
        answer = GuardAnswer(
            sequence,
            self._commanded,
            self._reading.pressures,
            self._reading.time + self._epoch,
            armed=self._armed,
            limited=applied is not None and applied.limited,
            force_limited=applied is not None and applied.force_limited,
            trips=self._trips,
            broken=self._channel.broken,
            tripped=self._tripped,
            refused="" if applied is None else applied.refused[:_LONGEST],
            error=error[:_LONGEST],
            value=value,
        )
        self._channel.send(answer)  # lost if the client is stopped and its socket full

    def _forward_poses(self) -> None:
        if self._hosted is None:
            return
        samples = tuple(_on_monotonic(sample, self._epoch) for sample in self._hosted.poses())
        for first in range(0, len(samples), _POSES):
            self._channel.send(TrackedPoses(samples[first : first + _POSES]))

    def _end(self) -> int:
        """Vent, with several attempts, and close; return 0 if the supply is vented."""
        surprised = self._armed and self._leaving != _ASKED
        failure = self._vent()
        for _ in range(GUARD.attempts):
            if not failure:
                break
            self._pause(GUARD.retry)
            failure = self._vent()
        if surprised and not failure:
            self._say(f"vented: {self._leaving}")
        if self._line is not None:
            self._line.close()
        try:
            self._outlet.close()
        except Exception as error:
            failure = failure or _sentence(error)
        if failure:
            text = f"THE SUPPLY COULD NOT BE VENTED: {failure}; cut its power or open its valve"
            self._say(text, "error")
        return 1 if failure else 0

    def _say(self, text: str, level: str = "warning") -> None:
        line = json_line(level, "guard", text) if self._as_json else f"stiffopt guard: {text}"
        with suppress(OSError, ValueError):  # nobody reads stderr any more
            print(line, file=sys.stderr, flush=True)


def _sentence(error: BaseException) -> str:
    known = isinstance(error, StiffoptError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def _on_monotonic(sample: PoseSample, epoch: float) -> PoseSample:
    times = (sample.time + epoch, sample.received + epoch)
    return PoseSample(*times, sample.frame, sample.position, sample.quaternion)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the guard process and return its exit code: 0 if the supply is vented at the end.

    `arguments`: file descriptor of the inherited socket, and optionally ``json`` for JSON lines on
    stderr; None: those of the command line. The parent process sends the rig, pickled, on standard
    input.
    """
    parent = os.getppid()
    _ignore(_IGNORED)
    _on_signals(lambda *_: sys.exit(0))  # until there is something to vent
    given = sys.argv[1:] if arguments is None else arguments
    descriptor, as_json = int(given[0]), JSON in given[1:]
    with ExitStack() as stack:
        channel = stack.enter_context(closing(GuardChannel(socket.socket(fileno=descriptor))))
        with suppress(OSError, AttributeError):  # other systems rely on `orphaned`
            ended = os.pidfd_open(parent)
            stack.callback(os.close, ended)
            channel.wake_for([ended])
        try:
            owns = _open_rig(channel)
        except StiffoptError as error:
            channel.send(
                GuardNotice(
                    "failed", {"kind": type(error).__name__, "args": list(map(str, error.args))}
                )
            )
            return 1
        guard = Guard(
            owns.gate,
            channel,
            owns.timeout,
            follower=owns.follower,
            line=owns.line(),
            epoch=owns.epoch,
            hosted=owns.hosted,
            as_json=as_json,
            orphaned=lambda: os.getppid() != parent,
        )
        _on_signals(lambda number, _: guard.leave(_signal_name(number)))
        with real_time(GUARD.priority) as granted:
            channel.send(GuardNotice("ready", {"real_time": granted.notice}))
            return guard.serve()


def _ignore(names: Sequence[str]) -> None:
    for name in names:
        signal.signal(getattr(signal, name), signal.SIG_IGN)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return f"signal {number}"


def _on_signals(handler: Callable[[int, Any], object]) -> None:
    """Install a handler for every signal that would end the process and can be handled.

    Faults of the processor are left out: after the handler the same instruction would fail again.
    """
    left = {getattr(signal, name) for name in (*_IGNORED, *_HARMLESS, *_FATAL)}
    for number in signal.valid_signals() - left:
        with suppress(OSError, ValueError):  # the system reserves some
            signal.signal(number, handler)


def _open_rig(channel: GuardChannel) -> Owned:
    """Make and connect the rig that standard input describes; report slow steps."""

    def tell(message: Warning | str, *_: object, **__: object) -> None:
        channel.send(GuardNotice("notice", {"text": str(message)}))

    with warnings.catch_warnings():
        warnings.simplefilter("always", SlowWarning)
        warnings.showwarning = tell
        owns = owned(*pickle.load(sys.stdin.buffer))
        owns.gate.open()
    return owns


if __name__ == "__main__":
    sys.exit(main())
