"""A rig for the studio: its daemon's state and events, and commands to it.

All commands go through `stiffopt.Client`, with its token and its lease. Only venting has a second
way: if the daemon does not answer, the guard vents, as with ``stiffopt vent``.

`RigWatch.poll` renews control while a browser is connected. If none is, or if the studio hangs, the
daemon misses the heartbeat, takes control back and holds the arm.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from stiffopt.control.bracing import BracePhase
from stiffopt.control.state import Event, Snapshot
from stiffopt.daemon.client import Client, daemon_url
from stiffopt.errors import CommandError, InputError, StiffoptError
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import robot_path
from stiffopt.optimise.task import PressureRange
from stiffopt.rig.config import limits_of, load_rig
from stiffopt.safety.vent import vent_rig
from stiffopt.studio.design import Design
from stiffopt.studio.workbench import Workbench

NAME = "studio"
"""Name of this client that others see."""
_LEANS = (BracePhase.APPROACHING, BracePhase.HELD, BracePhase.RELEASING)
_EVENTS = 6  # number shown
_QUICK = 2.0  # s, time limit of the daemon's answers; then the guard is asked to vent


class RigWatch:
    """Reads a running daemon and, with its token, commands it.

    Parameters
    ----------
    file : the rig file.
    token : the token or its file; None to read only.
    is_watched : returns whether a browser is connected; if not, control is not renewed.

    Attributes
    ----------
    design : the rig's robot, its scene and its limits, for a preview.
    state : the latest state, or None.
    events : the latest events, the newest last.
    trouble : why there is no state, or an empty text.
    outcome : of the last command.
    """

    def __init__(
        self,
        file: str | os.PathLike[str],
        token: str | os.PathLike[str] | None = None,
        is_watched: Callable[[], bool] = lambda: True,
    ) -> None:
        rig, robot = load_rig(file)
        if not rig.service.port:
            raise InputError(f"{file}: service.port is 0, so its daemon has no known address")
        self._file, self._is_watched = file, is_watched
        design = Design.of_description(robot, robot_path(rig.robot, Path(file).parent))
        self.design = design.with_task(
            scene=rig.scene, pressure=PressureRange(max=tuple(limits_of(rig, robot).high.tolist()))
        )
        url = daemon_url(rig.service)
        self.may_command = token is not None
        given = "" if token is None else token  # empty: not even that of the environment
        self._client = Client(url, given, name=NAME, heartbeat="manual")
        self._quick = Client(url, given, name=NAME, heartbeat="manual", timeout=_QUICK)
        self.state: Snapshot | None = None
        self.events: deque[Event] = deque(maxlen=_EVENTS)
        self.trouble, self.outcome = "asking the daemon ...", ""
        self._next = 0
        self._is_known = False
        self._lock = threading.Lock()  # one command at a time, except for venting

    def close(self) -> None:
        """Release control if the studio has it; the arm continues its task."""
        for client in (self._client, self._quick):
            with suppress(StiffoptError):
                client.close()

    @property
    def in_control(self) -> bool:
        """Whether the studio has control of the arm."""
        return self._client.in_control

    def present_design(self, robot: Manipulator) -> Design:
        """Return the rig's design with its present target, else with the tip's present position.

        Before the daemon's first answer, it has the default target.
        """
        state = self.state
        position = None if state is None else state.target_position
        if state is not None and (position is None or not np.isfinite(position).any()):
            pressures = state.pressures
            with suppress(StiffoptError):  # the model may have no equilibrium there
                position = None if pressures is None else robot.tip_pose(pressures)[:3, 3]
        if position is None or not np.isfinite(position).any():
            return self.design
        axes = (round(float(x), 5) if np.isfinite(x) else None for x in position)
        return self.design.with_target(position=tuple(axes))

    def leaning(self, robot: Manipulator) -> ContactEquilibrium | None:
        """Return the model's equilibrium in contact at the measured pressures of a braced arm.

        None if the arm does not lean, or the model has no such equilibrium.
        """
        state, scene = self.state, self.design.task.scene
        if state is None or state.pressures is None or scene is None or state.brace not in _LEANS:
            return None
        within = np.clip(state.pressures, robot.pressure_min, robot.pressure_max)
        with suppress(StiffoptError):
            return robot.contact_equilibrium(within, scene)
        return None

    def poll(self) -> None:
        """Read state and events; renew control while a browser is connected."""
        try:
            if not self._is_known:
                self._check_robot()
            if self.in_control and self._is_watched():
                self._client.renew()
            self.state = self._quick.state()
            events, self._next = self._quick.events(self._next)
            self.events.extend(events)
            self.trouble = ""
        except CommandError as error:
            self.outcome = str(error)  # control was lost
        except StiffoptError as error:
            self.state, self.trouble = None, str(error)

    def _check_robot(self) -> None:
        report, own = self._quick.robot(), self.design.description
        if (report.name, report.n) != (own.name, own.n_pressures):
            raise InputError(f"the daemon has the robot '{report.name}', not '{own.name}'")
        self._is_known = True

    # -- commands -----------------------------------------------------------------------------

    def take_control(self) -> None:
        """Take control of the arm, see `Client.take_control`."""
        self._do("you have control", self._client.take_control)

    def release(self) -> None:
        """Release control; the arm continues its task."""
        self._do("control is given back", self._client.release)

    def arm(self) -> None:
        """Arm: check everything and start control."""
        self._do("armed", self._client.arm)

    def hold(self) -> None:
        """Hold the present pressures."""
        self._do("held", lambda: self._client.hold("asked for in the studio"))

    def disarm(self) -> None:
        """Let the pressures down slowly, then vent."""
        self._do("let down", self._client.disarm)

    def reset(self) -> None:
        """Leave the state fault; the arm stays vented."""
        self._do("reset", self._client.reset)

    def go(self, bench: Workbench) -> None:
        """Send the task of the preview, if it has a valid solution."""
        answer, design = bench.answer, bench.design
        if design.has_own_robot:
            self.outcome = "not sent: gravity or tip mass of the preview are not those of the rig"
        elif answer is None or answer.design != design or bench.trouble:
            self.outcome = "not sent: wait until the preview is solved"
        elif not answer.solution.found:
            self.outcome = f"not sent: the preview is {answer.solution.status}"
        else:
            task = design.task.model_copy(update={"robot": None, "scene": None, "source": None})
            self._do("going to the target", lambda: self._client.set_task(task))

    def vent(self) -> None:
        """Vent at once through the daemon, or through the guard if the daemon does not answer."""
        if not self.may_command:
            self.outcome = "venting needs the token; 'stiffopt vent RIG' needs none"
            return
        try:
            self._quick.vent()
            self.outcome = "vented"
        except StiffoptError as error:
            self.outcome = f"the daemon did not vent ({error}); asking the guard ..."
            try:
                self.outcome = vent_rig(self._file)
            except StiffoptError as failed:
                self.outcome = f"THE ARM MAY BE UNDER PRESSURE: {failed}"

    def _do(self, done: str, command: Callable[[], None]) -> None:
        if not self.may_command:
            self.outcome = "this needs the token: start the studio with --token-file"
            return
        with self._lock:
            try:
                command()
                self.outcome = done
            except StiffoptError as error:
                self.outcome = str(error)
