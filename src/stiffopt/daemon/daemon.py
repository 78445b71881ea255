"""Starts and ends the daemon: guard, control loop, telemetry and network interface of a rig."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from stiffopt.commissioning.record import commissioned_control, commissioned_robot
from stiffopt.control.controller import TipController
from stiffopt.control.lifecycle import ARMED
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Severity, Snapshot, State
from stiffopt.control.ways import ClearanceWatch
from stiffopt.daemon.address import bracketed
from stiffopt.daemon.armable import too_fast
from stiffopt.daemon.calls import call_in_thread, ends_within
from stiffopt.daemon.keeper import Keeper, LogEvents, ServiceManager
from stiffopt.daemon.secret import Secret, check_exposure
from stiffopt.errors import CommandError, FileError, InputError, MissingExtraError, StiffoptError
from stiffopt.files import file_text
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.task import Task
from stiffopt.paths.motion_file import MotionTable
from stiffopt.rig.config import RigDescription, load_rig
from stiffopt.safety.guard_client import GuardLink
from stiffopt.safety.realtime import real_time, tidy
from stiffopt.safety.rigs import guarded_rig

if TYPE_CHECKING:
    from stiffopt.daemon.server import Server
    from stiffopt.daemon.telemetry import Telemetry


@dataclass(frozen=True)
class DaemonTimes:
    """Time limits of the parts of a daemon, in s."""

    arming: float = 10.0  # for an arm that was just connected to become ready to be armed
    # between attempts to arm; the tracker sees the tip some times meanwhile
    arming_again: float = 0.2
    telemetry: float = 5.0  # for telemetry to start
    tidy: float = 10.0  # between garbage collections
    # beyond `Safety.ramp_time`, for a daemon to end, whatever hangs. The limits below add up to
    # less, so that the command can still report the outcome
    stop: float = 15.0
    control: float = 6.0  # beyond the ramp, for the control thread to end
    # keeper, vent, supply, rest: for the end of the keeper, of a direct command to vent, of the
    # supply, and of all other parts
    keeper: float = 0.5
    vent: float = 1.0
    supply: float = 3.0
    rest: float = 2.5
    to_first_point: float = 2.0  # minimum for the way to a motion's first point


TIMES = DaemonTimes()


class Daemon:
    """The daemon of a rig: guard, control loop, telemetry and the HTTP interface.

    `start` connects and starts everything; the arm stays vented and inactive until `arm` is called
    here or by a client. `stop`, or the end of a `with` block, lets the pressures down, vents, and
    ends everything.

    Raises `FileError`: a file is wrong; `MissingExtraError`: a library is not installed.

    Parameters
    ----------
    rig : the rig file.
    service : whether to open ports: the control interface, and Foxglove.
    log_folder : folder of the recordings; None: the rig file's.
    json_lines : whether the guard writes JSON on stderr.

    Attributes
    ----------
    trouble : after `stop`, why the arm may not be vented; empty if it is vented for certain.
    hung : parts that had not ended when `stop` did. Their threads do not keep the process from
        ending, but a library in them may: see `os._exit`.
    """

    def __init__(
        self,
        rig: str | os.PathLike[str],
        *,
        service: bool = True,
        log_folder: str | os.PathLike[str] | None = None,
        json_lines: bool = False,
    ) -> None:
        description, robot = load_rig(rig)
        self.description = description
        if why := too_fast(description.rate):
            raise FileError(rig, why, key="rate")
        self.robot = load_robot(robot)
        self.trouble = ""
        self.hung: tuple[str, ...] = ()
        self._folder = os.fspath(log_folder or description.log.folder)
        self._manager = ServiceManager()
        guarded, self.link = guarded_rig(description, robot, json_lines=json_lines)
        self._clock = guarded.clock
        period, scene = 1 / description.rate, description.scene
        self._controller = TipController(
            load_robot(commissioned_robot(description, robot)),
            self.link.limits,
            guarded.slew,
            period=period,
            control=commissioned_control(description, robot),
            safety=description.safety,
            vibrates=_vibrates(description),
            scene=scene,
            plan_in_process=True,
        )
        self.loop = ControlLoop(
            guarded,
            self._controller,
            self.link,
            safety=description.safety,
            period=period,
            clearance=None if scene is None else ClearanceWatch(self.robot, scene),
        )
        self._secret = Secret(description.service, self._folder, description.name)
        self._telemetry = self._make_telemetry(service)
        self._server = self._make_server() if service else None
        self._keeper = Keeper(
            self.loop,
            self.link,
            self._manager,
            None if (server := self._server) is None else lambda: server.alive,
        )
        self._stopping = threading.Event()
        self._control: ControlThread | None = None
        self._hangs = False
        self._log = LogEvents(self.loop)
        self._started = self._stopped = self._recorded = False
        self._stop_begun = float("inf")

    # Reading -------------------------------------------------------------------------------------

    @property
    def url(self) -> str | None:
        """URL of the control interface; None if there is none."""
        return None if self._server is None else self._server.url

    @property
    def token(self) -> str:
        """The token that a client needs to move the arm."""
        return self._secret.token

    @property
    def token_file(self) -> Path | None:
        """The file of the token; None if it is in the environment, or no port is open."""
        return None if self._server is None else self._secret.path

    @property
    def foxglove_port(self) -> int | None:
        """Port for Foxglove; None if there is none."""
        return None if self._telemetry is None else self._telemetry.port

    @property
    def recording(self) -> str | None:
        """The present or last file of the recording; None if there is none."""
        return None if self._telemetry is None else self._telemetry.recording.path

    @property
    def ended(self) -> bool:
        """Whether control has ended, by request or by `failure`."""
        return self._control is None or not self._control.is_alive()

    @property
    def failure(self) -> BaseException | None:
        """The error that ended the control thread, or None."""
        if self._hangs:
            return TimeoutError("the control thread hangs")
        return None if self._control is None else self._control.failure

    # Start and end -------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the port, start the guard, connect, check the rig, and begin to tick.

        The arm stays vented.

        Raises `InputError`: a port is not free, the token is too short for others to reach it, a
        device does not answer, or a check failed; `MissingExtraError`: a library is not installed;
        `DeviceError`: the guard does not start.
        """
        if self._started:
            raise InputError("a daemon can be started only once; make another one")
        self._started = True
        try:
            self._log.attach()
            if self._server is not None:
                self._listen()
            self._manager.status("connecting to the rig")
            self.loop.configure()
            self._start_telemetry()
            self._control = ControlThread(
                self.loop, self.link, self._stopping, self._manager, self._telemetry
            )
            self._control.start()
            self._keeper.start()
        except BaseException:
            self.stop()
            raise
        self._manager.ready()

    def arm(self, task: Task | None = None, motion: MotionTable | None = None) -> None:
        """Arm as soon as the tracker has seen the vented arm for long enough.

        Then pursue a task, or play a motion. If arming, task or motion are refused, the arm becomes
        inactive and `InputError` is raised.
        """
        end = time.monotonic() + TIMES.arming
        while True:
            try:
                self.loop.arm()
                break
            except CommandError:
                last = self.loop.snapshot().state is State.FAULT or time.monotonic() > end
                if last or self._stopping.is_set():
                    raise
            self._stopping.wait(TIMES.arming_again)
        try:
            if task is not None:
                self.loop.set_task(task)
            if motion is not None:
                self._play(motion)
        except BaseException:
            with suppress(StiffoptError):
                self.loop.disarm()
            raise

    def _play(self, motion: MotionTable) -> None:
        """Go to the first point of a motion, at half of the slew at most, and follow it."""
        way = np.abs(motion.pressures[0] - self.loop.snapshot().commanded)
        begin = max(TIMES.to_first_point, 2 * float((way / self.loop.rig.slew).max()))
        ranges = self.robot.pressure_max - self.robot.pressure_min
        self.loop.follow_trajectory(motion.trajectory(ranges, begin))

    def begin_stop(self) -> None:
        """Begin to let the pressures down, vent and end control; do not wait for the end."""
        if not self._stopping.is_set():
            self._stop_begun = time.monotonic()
            self._stopping.set()
            self._manager.stopping()

    def vent(self, reason: str = "asked to", patience: float = 0.5) -> None:
        """Vent at once, even if the control thread does not answer within `patience`, in s."""
        if not ends_within(patience, call_in_thread("vent", lambda: self.loop.vent(reason))):
            ends_within(TIMES.vent, call_in_thread("vent-link", self.link.vent))

    def stop(self) -> State:
        """End everything and return the last state.

        First the pressures are let down and vented, and the guard, which owns the supply, ends;
        neither waits for anything else. Then everything else ends. Counted from `begin_stop`, or
        from here if that was not called, this takes less than `Safety.ramp_time` and `TIMES.stop`,
        whatever hangs. A second call does nothing.
        """
        if self._stopped:
            return self.loop.snapshot().state
        self._stopped = True
        self.begin_stop()
        self._end_control()
        self._keeper.stop(TIMES.keeper)
        state = self.loop.snapshot().state
        closing = call_in_thread("supply", self.link.close)
        before = TIMES.control + TIMES.keeper + TIMES.vent
        ends_within(self._left(before + TIMES.supply, TIMES.supply), closing)
        self._end_the_rest()
        if not ends_within(self._left(before + TIMES.supply + TIMES.rest), closing):
            self.trouble = "the guard does not end; whether the supply is vented is not known"
            self.hung = ("supply", *self.hung)
        elif closing.exception() is not None:
            self.trouble = str(closing.exception())
        self._log.detach()
        self._manager.close()
        return state

    def _left(self, beyond: float, least: float = 0.0) -> float:
        """Return the time left until `beyond` after the ramp, at least `least`, in s."""
        end = self._stop_begun + self.description.safety.ramp_time + beyond
        return max(end - time.monotonic(), least)

    def _end_control(self) -> None:
        """Wait for the control thread to let the pressures down; vent if it hangs."""
        if self._control is None:
            return
        self._control.join(self._left(TIMES.control))
        if self._control.is_alive():
            self._hangs = True
            self.hung = (*self.hung, "control")
            self.vent("the control thread hangs", patience=0.0)

    def _end_the_rest(self) -> None:
        """End the parts that do not command pressures, all at once; note those that hang."""
        works: dict[str, Callable[[], object]] = {"planner": self._controller.close}
        if self.loop.rig.tracker is not None:
            works["tracker"] = self.loop.rig.tracker.close
        if self._telemetry is not None and self._recorded:
            works["telemetry"] = self._telemetry.stop
        if self._server is not None:
            works["service"] = self._end_service
        calls = {name: call_in_thread(name, work) for name, work in works.items()}
        end = time.monotonic() + TIMES.rest
        for name, call in calls.items():
            if not ends_within(end - time.monotonic(), call):
                self.hung = (*self.hung, name)
                self._warn("stop", f"the {name} does not end and is left behind")
            elif call.exception() is not None:
                self._warn("stop", f"the {name} did not end well: {call.exception()}")

    def _end_service(self) -> None:
        if self._server is not None:
            self._server.stop()
            self._secret.remove()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # Parts ---------------------------------------------------------------------------------------

    def _make_telemetry(self, service: bool) -> Telemetry | None:
        """Return the telemetry; a daemon that opens no ports can run without."""
        settings = self.description.service
        if not service:
            settings = settings.model_copy(update={"foxglove_port": None})
        try:
            from stiffopt.daemon.telemetry import ArmShape, Telemetry

            return Telemetry(
                self.robot.description,
                self.description.name,
                self.loop,
                self._folder,
                settings,
                clock=self._clock,
                backbone=ArmShape(self.robot),
                about={"rig_file": file_text("rig", self.description)},
            )
        except MissingExtraError as error:
            if service:
                raise
            self.loop.add_alarm("log", f"nothing is recorded: {error}")
            return None

    def _make_server(self) -> Server:
        from stiffopt.daemon.metrics import Metrics
        from stiffopt.daemon.server import Server
        from stiffopt.daemon.service import create_app

        settings, robot = self.description.service, self.robot.description
        app = create_app(
            self.loop,
            robot=robot,
            token=self._secret.token,
            heartbeat=self.description.safety.heartbeat,
            clock=self._clock,
            metrics=Metrics(self.description.name, self.loop, self._telemetry).render,
            hosts=(settings.host,),
        )
        return Server(app, settings.host, settings.port)

    def _start_telemetry(self) -> None:
        """Start to record; if that hangs, as on a disk, control goes on without it."""
        if self._telemetry is None:
            return
        self._recorded = True
        starting = call_in_thread("telemetry", self._telemetry.start)
        if not ends_within(TIMES.telemetry, starting):
            text = (
                f"telemetry has not started within {TIMES.telemetry:g} s; control goes on without"
            )
            self.loop.add_alarm("telemetry", text)
        elif (error := starting.exception()) is not None:
            raise error
        if (port := self._telemetry.port) is not None:
            self._warn(
                "foxglove",
                f"Foxglove is served at ws://{bracketed(self.description.service.host)}:{port} "
                "without a token: whoever can reach that may read all telemetry, and so may any "
                "web page that is open in a browser there",
            )

    def _warn(self, kind: str, text: str) -> None:
        """Add an event with the severity of a warning."""
        self.loop.events.add(self._clock.now(), kind, text, Severity.WARNING)

    def _listen(self) -> None:
        """Open the port before writing the token: a daemon that has the port keeps its token."""
        if self._server is None:
            return
        given = self._secret.path is None
        warnings = check_exposure(self.description.service.host, self.token, given=given)
        try:
            self._server.start()
        except InputError as error:
            raise InputError(f"{error} (service.host, service.port in the rig file)") from None
        for kind, text in warnings:
            self._warn(kind, text)
        self._secret.write()


class ControlThread(threading.Thread):
    """Runs the control loop in real time until `stopping` is set, then lets the pressures down.

    In each tick the service manager gets a sign of life, and telemetry the state. If a `failure`
    ended the thread, the loop has vented.
    """

    def __init__(
        self,
        loop: ControlLoop,
        link: GuardLink,
        stopping: threading.Event,
        manager: ServiceManager,
        telemetry: Telemetry | None,
    ) -> None:
        super().__init__(name="control", daemon=True)
        self.failure: BaseException | None = None
        self._loop, self._link, self._stopping = loop, link, stopping
        self._manager, self._telemetry = manager, telemetry
        self._tidied = 0.0
        loop.listen(self.ticked)

    def run(self) -> None:
        """Tick; see `ControlLoop.run`."""
        try:
            with real_time() as granted:
                self._report("control", granted.notice, well=not granted.denied)
                notice = self._link.real_time
                self._report("guard", notice, well=not notice.startswith("not"))
                self._loop.run(self._stopping)
        except BaseException as error:  # `run` has vented; `Daemon.failure` has it
            self.failure = error

    def ticked(self, now: Snapshot) -> None:
        """Pass the state at the end of a tick on; called in this thread."""
        self._manager.watchdog()
        if self._telemetry is not None:
            self._telemetry.put(now)
        if now.time - self._tidied > TIMES.tidy:
            self._tidied = now.time
            tidy(thoroughly=now.state not in ARMED)

    def _report(self, who: str, notice: str, *, well: bool) -> None:
        severity = Severity.INFO if well else Severity.WARNING
        self._loop.events.add(self._loop.rig.clock.now(), "real-time", f"{who}: {notice}", severity)


def _vibrates(description: RigDescription) -> bool:
    """Return whether the arm has inertia; only a quasi-static simulated one has none."""
    dynamics = getattr(description.plant, "dynamics", None)
    return not (description.supply.simulated and dynamics == "quasi-static")
