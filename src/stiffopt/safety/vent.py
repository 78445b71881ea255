"""Venting a rig from outside, whoever commands it."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

from stiffopt.errors import DeviceError
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.rig.interface import PressureSupply
from stiffopt.safety.hosted import simulated_endpoint
from stiffopt.safety.rescue import vent_directly
from stiffopt.safety.vent_line import Peer, ask_to_vent

__all__ = ["vent_rig"]

_PATIENCE = 3.0  # s in which a guard must have vented, beyond its driver's own time
_CALLS = 4  # of the driver, at most, that venting takes
_GONE = 2.0  # s in which a process that was ended must be gone


def vent_rig(path: str | os.PathLike[str]) -> str:
    """Vent the supply of a rig, by the guard that owns it, else directly; return how, in words.

    A guard that does not answer, or cannot vent, is ended, and the supply vented in its place. The
    daemon's interface and its token are not needed.

    Raises
    ------
    FileError
        A file is wrong.
    MissingExtraError
        A library is not installed.
    DeviceError
        It is not certain that the supply is vented.
    """
    description = load_rig_description(path)
    if description.supply.driver == "simulated":
        return _vent_simulated(description)
    robot = load_description(description.robot, base=Path(path).parent)
    supply = make_rig(description.model_copy(update={"tracker": None, "probe": None}), robot).supply
    if not isinstance(supply, PressureSupply):
        raise DeviceError("this rig's supply cannot be reached directly")
    done = ""
    for endpoint in supply.endpoints:
        done = _vent_by_guard(endpoint, _PATIENCE + _CALLS * supply.patience) or done
    if done:
        return done
    if not vent_directly(supply):
        raise DeviceError(
            "it was vented directly, but another program, of another user, commands this supply "
            "and may raise the pressure again"
        )
    return "vented directly: no program commands this supply"


def _vent_by_guard(endpoint: str, patience: float) -> str:
    """Have the guards of a supply vent; return how, empty if none could be asked."""
    done, failed = [], []
    for reply in ask_to_vent(endpoint, patience):
        if reply.answered and reply.error:
            failed.append(f"{reply.guard.name} could not vent, and tries on: {reply.error}")
        elif reply.answered:
            done.append(reply.guard.name)
        elif _is_guard(reply.guard.pid) and not _ended(reply.guard):
            failed.append(f"{reply.guard.name}: {reply.error}")
    if failed:
        raise DeviceError("; ".join(failed))
    return f"vented by its guard, {', '.join(done)}, which takes no command now" if done else ""


def _vent_simulated(description: RigDescription) -> str:
    done = _vent_by_guard(simulated_endpoint(description), _PATIENCE)
    return done or f"nothing to vent: nobody runs the simulated rig '{description.name}'"


def _ended(guard: Peer) -> bool:
    """End a guard that does not answer; return whether it is gone, by this or already."""
    if guard.pid <= 0:
        return False
    if _is_guard(guard.pid):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(guard.pid, signal.SIGKILL)
    end = time.monotonic() + _GONE
    while _is_guard(guard.pid) and time.monotonic() < end:
        time.sleep(0.01)
    return not _command_line(guard.pid)


def _is_guard(pid: int) -> bool:
    """Return whether a process runs, and is a guard."""
    return b"stiffopt.safety.guard" in _command_line(pid)


def _command_line(pid: int) -> bytes:
    """Return the command line of a process; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
