"""Open a rig for a command, work on it, and vent it whatever happens."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from typing import TypeVar

from stiffopt.cli.exits import InterruptBetweenSteps, RigFaultError
from stiffopt.errors import DeviceError, StiffoptError
from stiffopt.rig.interface import Rig

T = TypeVar("T")


class RigStoppedError(RigFaultError):
    """The work failed after the rig was opened."""


def rig_of(path: str) -> tuple[Rig, str, float, str]:
    """Return the rig of a file, its name, its rate in Hz and its log folder."""
    from stiffopt.rig.config import load_rig
    from stiffopt.safety.rigs import rig_for_programs

    description, robot = load_rig(path)
    rig = rig_for_programs(description, robot)
    return rig, description.name, description.rate, description.log.folder


def new_name(experiment: str, rig: str) -> str:
    """Return a name for the folder of a new experiment, with the rig's name and the time."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    safe = re.sub(r"[^\w.-]+", "-", rig).strip("-.") or "rig"
    return f"{experiment}_{safe}_{stamp}"


def open_rig_for(rig: Rig, undo: Callable[[], None]) -> None:
    """Open the rig; if that fails, undo what was prepared."""
    try:
        rig.open()
    except StiffoptError as error:
        undo()
        raise RigFaultError(str(error)) if isinstance(error, DeviceError) else error from error


def on_rig(rig: Rig, work: Callable[[], T], interrupt: InterruptBetweenSteps) -> T:
    """Run `work`, then vent and close the rig whatever happens; return the result of `work`."""
    failure: BaseException | None = None
    try:
        done = work()
    except BaseException as error:
        failure = error
    interrupt.hold()
    try:
        rig.close()
    except StiffoptError as error:
        first = f" (after: {failure})" if isinstance(failure, StiffoptError) else ""
        raise RigStoppedError(f"THE ARM MAY STILL BE UNDER PRESSURE: {error}{first}") from error
    if isinstance(failure, StiffoptError):
        raise RigStoppedError(f"{failure}; the arm is vented") from failure
    if failure is not None:
        raise failure
    return done
