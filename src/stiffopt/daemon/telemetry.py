"""Telemetry: sends the loop's state to Foxglove and records it, in a thread of its own.

In each tick the loop hands over a snapshot, which takes a microsecond. A failure here raises an
alarm, and control continues.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Snapshot
from stiffopt.daemon.recording import RunRecording
from stiffopt.daemon.topics import FORMAT, TelemetryChannels
from stiffopt.errors import StiffoptError, require_package
from stiffopt.files import file_text
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.rig.device import Clock
from stiffopt.rig.settings import ServiceSettings


@dataclass(frozen=True)
class TelemetryRates:
    """Intervals of the kinds of messages, in s, and sizes."""

    wake: float = 0.02  # between checks for new snapshots
    commit: float = 0.1  # between writes to the disk; a killed process loses this much
    queue: int = 4096  # snapshots that may wait; the oldest are dropped first
    tick: float = 0.01  # between logged snapshots; more of them would delay the loop
    # frames, shape, state: between messages of the frames, of the arm's shape and the timing, and
    # of the state while it does not change
    frames: float = 0.04
    shape: float = 0.1
    state: float = 1.0
    calm: float = 10.0  # without a loss or failure, after which its alarm is cleared
    shape_poses: int = 12  # poses along the arm for Foxglove
    # share of the interpreter's time for the shape; the control thread needs it too
    shape_share: float = 0.02


RATES = TelemetryRates()


class Telemetry:
    """Logs what a loop does, to Foxglove and to a recording.

    Raises `MissingExtraError`: foxglove-sdk is not installed.

    Parameters
    ----------
    robot, name : the model of the arm, which the recording keeps, and the name of the rig.
    loop, clock : the rig's loop and clock.
    folder : folder of the recordings.
    settings : settings of Foxglove's port.
    backbone : returns poses (m, 4, 4) along the arm for pressures (n,), in Pa.
    about : further metadata for the recording, such as the text of the rig file.
    wall : nanoseconds since 1970; read once, so that messages do not jump with the wall clock.
    """

    def __init__(
        self,
        robot: RobotDescription,
        name: str,
        loop: ControlLoop,
        folder: str,
        settings: ServiceSettings,
        *,
        clock: Clock,
        backbone: Callable[[Array], Array] | None = None,
        about: Mapping[str, str] | None = None,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        require_package("foxglove-sdk", "daemon", "foxglove")
        from foxglove import Context

        self.dropped = 0
        self._loop, self._name, self._settings = loop, name, settings
        self._backbone = backbone
        self._queue: deque[Snapshot] = deque(maxlen=RATES.queue)
        self._context = Context()
        begin = clock.now()
        self._offset = wall() - round(begin * 1e9)
        thickness = 2 * max(segment.outer_radius for segment in robot.segments)
        self._channels = TelemetryChannels(self._context, self._offset, thickness)
        first = loop.snapshot()
        facts = {**about_run(robot, name, first, begin, self._offset), **(about or {})}
        self.recording = RunRecording(folder, name, self._context, facts, wall=lambda: wall() / 1e9)
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._stopped = False
        self._working = threading.Lock()
        self._next_event = 0
        self._last_state: object = None
        self._logged = np.inf  # time of the last snapshot; none yet
        self._due_tick = self._due_state = self._due_frames = self._due_shape = -np.inf
        self._due_commit = -np.inf
        self._alarms: dict[str, str] = {}
        self._dropped_before = 0
        self._dropped_at = self._failed_at = -np.inf

    @property
    def port(self) -> int | None:
        """Port for Foxglove; None if there is none."""
        return None if self._server is None else int(self._server.port)

    def put(self, snapshot: Snapshot) -> None:
        """Hand over a snapshot; the control thread calls this in each tick. It never waits."""
        if len(self._queue) == RATES.queue:
            self.dropped += 1
        self._queue.append(snapshot)

    def start(self) -> None:
        """Open the port, begin to record, and start the thread."""
        self._listen()
        self.work()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def stop(self, patience: float = 5.0) -> None:
        """Log the rest, end the recording and stop the server; a second call does nothing.

        `TimeoutError`: a write, as to a disk that hangs, has not ended after `patience`, in s; then
        nothing more is recorded.
        """
        if self._stopped:
            return
        self._stop.set()
        if not self._working.acquire(timeout=patience):
            raise TimeoutError(f"telemetry was not written within {patience:g} s")
        self._working.release()
        if self._thread is not None:
            self._thread.join(patience)
            self._thread = None
        end = self._loop.snapshot()
        if end.time > (self._queue[-1].time if self._queue else self._logged):
            self.put(end)  # the state after the last tick
        self.work(last=True)
        self.recording.close()
        if self._server is not None:
            self._server.stop()
            self._server = None
        self._channels.close()
        self._stopped = True

    def work(self, *, last: bool = False) -> None:
        """Log what has arrived since the last call; with `last`, write it to the disk at once."""
        with self._working:
            if not self.recording.is_open:
                self._commit(time.monotonic())  # open the file before anything is logged
            while self._queue:
                self._attempt(self._log, self._queue.popleft())
                time.sleep(0)  # the control thread may want the interpreter
            events, self._next_event = self._loop.events.since(self._next_event)
            for event in events:
                self._attempt(self._channels.log_event, event)
            now = time.monotonic()
            if last or now >= self._due_commit:
                self._due_commit = now + RATES.commit
                self._commit(now)
            self._look_back(now)

    def _attempt(self, log: Callable[[Any], None], what: Any) -> None:
        """Log something; a failure raises an alarm."""
        try:
            log(what)
        except Exception as error:
            self._failed_at = time.monotonic()
            self._set_alarm("telemetry", f"something could not be logged: {error}")

    def _run(self) -> None:
        while not self._stop.wait(RATES.wake):
            self.work()

    def _listen(self) -> None:
        port = self._settings.foxglove_port
        if port is None or self._server is not None:
            return
        import foxglove

        try:
            self._server = foxglove.start_server(
                name=f"stiffopt: {self._name}",
                host=self._settings.host,
                port=port,
                context=self._context,
            )
        except RuntimeError as error:
            where = f"{self._settings.host}:{port}"
            self._set_alarm("foxglove", f"Foxglove cannot connect: {where} is not free ({error})")

    def _log(self, now: Snapshot) -> None:
        self._logged = now.time
        due = on_time = now.time >= self._due_tick - RATES.tick / 2
        state = (now.state, now.reason, now.task, {alarm.kind for alarm in now.alarms})
        if state != self._last_state or now.time >= self._due_state:
            self._channels.log_state(now)
            self._last_state, self._due_state = state, now.time + RATES.state
            due = True
        if due:
            regular = on_time and now.time <= self._due_tick + RATES.tick
            self._due_tick = (self._due_tick if regular else now.time) + RATES.tick
            self._channels.log_tick(now)
        self._channels.log_samples(now)  # all samples, in every tick
        if now.time >= self._due_frames:
            self._due_frames = now.time + RATES.frames
            self._channels.log_frames(now)
        if now.time >= self._due_shape:
            self._due_shape = now.time + RATES.shape
            self._channels.log_timing(now, self.dropped)
            self._log_arm(now)

    def _log_arm(self, now: Snapshot) -> None:
        p = now.pressures
        if self._backbone is not None and p is not None:
            with suppress(StiffoptError):  # an arm without a known shape is not drawn
                self._channels.log_arm(now, self._backbone(p))

    def _commit(self, now: float) -> None:
        self.recording.commit(now)
        self._set_alarm("log", self.recording.trouble)

    def _look_back(self, now: float) -> None:
        """Raise an alarm for lost snapshots; clear alarms after a while without a failure."""
        if now > self._failed_at + RATES.calm:
            self._set_alarm("telemetry", "")
        if self.dropped > self._dropped_before:
            self._dropped_before, self._dropped_at = self.dropped, now
            text = f"telemetry is too slow; {self.dropped} snapshots were never logged"
            self._set_alarm("telemetry-lost", text)
        elif now > self._dropped_at + RATES.calm:
            self._set_alarm("telemetry-lost", "")

    def _set_alarm(self, kind: str, text: str) -> None:
        """Raise an alarm if it is new, or clear it if the text is empty."""
        if self._alarms.get(kind, "") == text:
            return
        self._alarms[kind] = text
        if text:
            self._loop.add_alarm(kind, text)
        else:
            self._loop.clear_alarm(kind)


class ArmShape:
    """The shape of the arm's model, computed as often as `TelemetryRates.shape_share` permits."""

    def __init__(self, robot: Manipulator) -> None:
        self._robot = robot
        self._due = 0.0
        self._last: Array | None = None

    def __call__(self, pressures: Array) -> Array:
        """Return poses (m, 4, 4) along the arm, possibly slightly old ones."""
        now = time.monotonic()
        if self._last is None or now >= self._due:
            self._last = self._robot.backbone(pressures, RATES.shape_poses)
            ended = time.monotonic()
            self._due = ended + (ended - now) / RATES.shape_share
        return self._last


def about_run(
    robot: RobotDescription, name: str, first: Snapshot, begin: float, offset: int
) -> dict[str, str]:
    """Return the metadata of a recording: all that a reader needs besides the messages."""
    from stiffopt import __version__

    return {
        "format": FORMAT,
        "rig": name,
        "robot": robot.name,
        "robot_file": file_text("robot", robot),
        "channels": ",".join(str(segment.n_channels) for segment in robot.segments),
        "low_pa": ",".join(f"{value:g}" for value in first.low),
        "high_pa": ",".join(f"{value:g}" for value in first.high),
        "start_s": repr(begin),
        "start_ns": str(offset + round(begin * 1e9)),
        "stiffopt": __version__,
    }
