"""Venting a rig from outside (``stiffopt vent``), whichever program commands it."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

from stiffopt.errors import DeviceError
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig
from stiffopt.rig.interface import PressureSupply
from stiffopt.safety.hosted import simulated_endpoint
from stiffopt.safety.rescue import vent_directly
from stiffopt.safety.vent_line import SocketPeer, ask_to_vent, trusted

_PATIENCE = 3.0  # s in which a guard must have vented, beyond the time that its driver needs
_CALLS = 4  # driver calls, at most, that venting takes
_GONE = 2.0  # s in which a killed process must have ended


def vent_rig(path: str | os.PathLike[str]) -> str:
    """Vent the supply of a rig, by its guard or else directly; return how, in words.

    A guard that does not answer is killed. Unless a trusted guard reports that it has vented, the
    supply is vented directly, even if another guard owns it. None of this uses the network, unless
    the device itself does, and no other user can prevent it.

    Raises `FileError`: a file is wrong; `MissingExtraError`: a library is not installed;
    `DeviceError`: it is not certain that the supply is vented.
    """
    description, robot = load_rig(path)
    if description.supply.simulated:
        return _vent_simulated(description)
    supply = make_rig(description.model_copy(update={"tracker": None, "probe": None}), robot).supply
    if not isinstance(supply, PressureSupply):
        raise DeviceError("this rig's supply cannot be reached directly")
    failed: list[str] = []
    for endpoint in supply.endpoints:
        done, troubles = _vent_by_guards(endpoint, _PATIENCE + _CALLS * supply.patience)
        if done:
            return done
        failed += troubles
    return _vent_directly(supply, failed)


def _vent_by_guards(endpoint: str, patience: float) -> tuple[str, list[str]]:
    """Call the guards of a supply to vent; return success and failures, in words."""
    done, failed = [], []
    for reply in ask_to_vent(endpoint, patience):
        guard = reply.guard
        if reply.answered and not reply.error and trusted(guard.uid):
            done.append(guard.name)
        elif reply.answered:
            said = f"could not vent, and tries on: {reply.error}" if reply.error else "has vented"
            failed.append(f"{guard.name} says that it {said}")
        elif _is_guard(guard.pid) and not _ended(guard):
            failed.append(f"{guard.name}: {reply.error}")
    by = f"vented by its guard, {', '.join(done)}, which takes no command now"
    return by if done else "", failed


def _vent_directly(supply: PressureSupply, failed: list[str]) -> str:
    try:
        alone = vent_directly(supply)
    except DeviceError as error:
        raise DeviceError("; ".join([*failed, str(error)])) from None
    if not alone:
        claimed = (
            "it was vented directly, but another program has claimed this supply and may raise "
            "the pressure again"
        )
        raise DeviceError("; ".join([*failed, claimed]))
    return "vented directly: no program commands this supply"


def _vent_simulated(description: RigDescription) -> str:
    done, failed = _vent_by_guards(simulated_endpoint(description), _PATIENCE)
    if failed:
        raise DeviceError("; ".join(failed))
    return done or f"nothing to vent: nobody runs the simulated rig '{description.name}'"


def _ended(guard: SocketPeer) -> bool:
    """Kill a guard that does not answer; return whether it has ended."""
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
    """Return whether a process runs and is a guard."""
    return b"stiffopt.safety.guard" in _command_line(pid)


def _command_line(pid: int) -> bytes:
    """Return the command line of a process; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
