"""Questions and answers between the control loop's process and its guard."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import deque
from typing import Any

import numpy as np

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import PoseSample, PressureCommand
from stiffopt.safety.frames import Answer, Channel, CommandFrame, Message, Poses, Request

__all__ = ["Exchange"]

_ANSWER = 2.0  # s, at least, in which the guard must answer
_CALLS = 4  # of the driver, at most, that an answer may have to wait for
_SLICE = 0.02  # s; no thread keeps others from receiving for longer
_AGAIN = 1e-3  # s, until a request is sent again that could not be sent
_RESOLUTION = 1e-3  # s, of waiting for the channel
_KEPT = 4096  # samples that nobody has taken; the oldest go first
_log = logging.getLogger(__name__)


class Exchange:
    """Everything that is said through a channel to a guard. Any thread may call any method.

    Whoever waits for something receives for all, so that no other thread is needed in between.

    Parameters
    ----------
    channel :
        To the guard.
    patience :
        Seconds that one call of the supply's driver may take.

    Attributes
    ----------
    newest : the newest answer of the guard, to whatever; None before the first.
    to_command : the newest answer to a command; None before the first since arming.
    answer_within : seconds in which the guard must answer to a request.
    unanswered_pings : how many have been sent since the guard last said anything.
    """

    def __init__(self, channel: Channel, patience: float = 0.0) -> None:
        self.newest: Answer | None = None
        self.to_command: Answer | None = None
        self.answer_within = max(_ANSWER, _CALLS * patience)
        self.unanswered_pings = 0
        self._channel = channel
        self._numbers = itertools.count(1)
        self._receiving = threading.Lock()
        self._answers: dict[int, Answer] = {}  # that somebody waits for
        self._waiting: set[int] = set()
        self._unanswered: deque[tuple[int, float]] = deque()  # commands, and when they were sent
        self._answered = 0  # number of the newest command or request that was
        self._poses: deque[PoseSample] = deque(maxlen=_KEPT)
        self._broken = 0  # messages that the guard could not understand

    def send_goal(self, goal: PressureCommand) -> Answer:
        """Send a goal and return the answer to it.

        Raises
        ------
        DeviceError
            The guard is gone, or does not answer.
        """
        sequence, end = next(self._numbers), time.monotonic() + self.answer_within
        pressures = np.asarray(goal.pressures, dtype=float)
        now = time.monotonic()
        frame = CommandFrame(sequence, now, goal.time, goal.valid_for, pressures, goal=True)
        return self._answer_to(frame, "a command", end)

    def send(self, command: PressureCommand, wait: float) -> None:
        """Send a command of a stream, and wait for its answer for up to `wait` s.

        Raises
        ------
        DeviceError
            The guard is gone, or takes nothing.
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

    def ask(self, do: str, **about: Any) -> Answer:
        """Send a request and return the answer, which may say that it could not be met.

        Raises
        ------
        DeviceError
            The guard is gone, or does not answer.
        """
        sequence, end = next(self._numbers), time.monotonic() + self.answer_within
        return self._answer_to(Request(sequence, do, about), f"'{do}'", end)

    def _answer_to(self, message: CommandFrame | Request, what: str, end: float) -> Answer:
        """Send a message and return the answer to it; `DeviceError` if none comes in time."""
        sequence = message.sequence
        self._waiting.add(sequence)
        try:
            while not self._channel.send(message):
                self._go_on_waiting(what, end)
                time.sleep(_AGAIN)
            while True:
                self._receive(_SLICE)
                if sequence in self._answers:
                    return self._answers[sequence]
                self._go_on_waiting(what, end)
        finally:
            self._waiting.discard(sequence)
            self._answers.pop(sequence, None)

    def ping(self) -> None:
        """Ask for a sign of life, and take in what has come; wait for nothing."""
        self._channel.send(Request(0, "ping"))
        self.unanswered_pings += 1
        self._receive()

    def take_poses(self) -> tuple[PoseSample, ...]:
        """Return the tracker's samples that have come since the last call."""
        self._receive()
        return tuple(self._poses.popleft() for _ in range(len(self._poses)))

    def must_live(self) -> None:
        """Raise `DeviceError` if the guard is gone."""
        if self._channel.closed:
            raise DeviceError(
                "the guard process has ended; the supply is vented directly, as far as it answers"
            )

    def silence(self) -> float:
        """Return how long a command has waited for its answer, in s; 0 if none does."""
        try:
            return time.monotonic() - self._unanswered[0][1]
        except IndexError:
            return 0.0

    def close(self) -> None:
        """Hang up."""
        with self._receiving:
            self._channel.close()

    def _go_on_waiting(self, what: str, end: float) -> None:
        self.must_live()
        if time.monotonic() > end:
            raise DeviceError(f"the guard process did not answer to {what} in time")

    def _receive(self, wait: float = 0.0) -> None:
        """Take in what has come; wait for something for up to `wait` s, but never for long."""
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
        if isinstance(message, Poses):
            self._poses.extend(message.samples)
        if isinstance(message, Answer):
            self.newest = message
            if message.sequence != 0 and message.sequence not in self._waiting:
                self.to_command = message
            if message.broken != self._broken:
                self._broken = message.broken
                _log.warning("the guard could not understand %d messages so far", message.broken)
            self._answered = max(self._answered, message.sequence)  # 0: it was not asked
            while self._unanswered and self._unanswered[0][0] <= message.sequence:
                self._unanswered.popleft()
            if message.sequence in self._waiting:
                self._answers[message.sequence] = message
