"""Starting and ending a guard process."""

from __future__ import annotations

import pickle
import socket
import subprocess
import sys
import time
import warnings
from contextlib import suppress

from stiffopt.errors import DeviceError, MissingExtraError, SlowWarning
from stiffopt.model.description import RobotDescription
from stiffopt.rig.config import RigDescription
from stiffopt.safety.frames import Channel, Word
from stiffopt.safety.lines import JSON

__all__ = ["GuardProcess"]

_START = 120.0  # s, in which a guard must be ready: the simulator may have to be compiled
_END = 4.0  # s, in which it must vent and end before it is told to, and then is killed
_SLICE = 0.05  # s


class GuardProcess:
    """A process that runs `stiffopt.safety.guard.main`, from its start on.

    Parameters
    ----------
    rig :
        Whose supply it shall own, and its robot.
    json_lines :
        Whether it shall speak JSON on stderr.

    Attributes
    ----------
    channel : to it.
    pid : its number.
    """

    def __init__(
        self, rig: tuple[RigDescription, RobotDescription], *, json_lines: bool = False
    ) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-P", "-m", "stiffopt.safety.guard", str(theirs.fileno())]
            # in a session of its own: Ctrl-C and Ctrl-Z on the terminal are not for the guard
            self._process = subprocess.Popen(
                command + [JSON] * json_lines,
                stdin=subprocess.PIPE,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )
        self.channel = Channel(ours)
        self.pid = self._process.pid
        self._rig = rig

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def wait_until_ready(self) -> str:
        """Return when it has connected to the supply, with what it says of its punctuality.

        Raises
        ------
        DeviceError
            The supply does not answer, or the process does not start.
        MissingExtraError
            A library is not installed.
        """
        if self._process.stdin is not None:
            with suppress(BrokenPipeError), self._process.stdin as stdin:
                pickle.dump(self._rig, stdin)
        end = time.monotonic() + _START
        while time.monotonic() < end:
            for message in self.channel.receive(_SLICE):
                match message:
                    case Word("notice", about):
                        warnings.warn(about["text"], SlowWarning, stacklevel=3)
                    case Word("failed", about):
                        raise _failure(**about)
                    case Word("ready", about):
                        return str(about["real_time"])
            if self.channel.closed:
                raise DeviceError("the guard process ended before it was ready")
        raise DeviceError(f"the guard process was not ready within {_START:g} s")

    def kill(self) -> None:
        """End it at once, also while it is stopped; it vents nothing then."""
        self._process.kill()
        self._process.wait()

    def end(self) -> int:
        """Hang up, which alone makes it vent and end, and return its exit code.

        It is killed only if it does not end by itself.
        """
        self.channel.close()
        for last_word in (self._process.terminate, self._process.kill):
            try:
                return self._process.wait(_END)
            except subprocess.TimeoutExpired:
                last_word()
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(_END)
        return -1  # not even that ends it: the system itself waits for a device


def _failure(kind: str, args: list[str]) -> Exception:
    """Return the error for which the guard could not be started."""
    if kind == "MissingExtraError":
        return MissingExtraError(*args)
    return DeviceError(" ".join(args))
