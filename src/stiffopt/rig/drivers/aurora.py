"""The driver ``aurora``: the NDI Aurora electromagnetic tracker on a serial port (ndicapi)."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from stiffopt.errors import DeviceError, require_package
from stiffopt.rig.interface import Clock, StreamedSettings, StreamedTracker
from stiffopt.units import Duration, Frequency

_READER = Path(__file__).with_name("ndi_reader.py")
_END = 0.9  # s for the reader to end on its own
_BETWEEN_TRIES = 0.5  # s before a lost device is looked for again
_POLLS_PER_FRAME = 10  # so a frame is seen at most a tenth of a period late


class AuroraSettings(StreamedSettings):
    """An NDI Aurora.

    The device does not report when it captured a frame, and NDI states no latency: the default is
    one frame at 40 Hz. A sensor with five degrees of freedom does not know its roll.

    Attributes
    ----------
    port : serial port, such as ``/dev/ttyUSB0`` or ``COM3``; ``auto`` uses the only USB port that
        identifies itself as NDI's, and no other.
    baud : speed of the line while tracking.
    sensor : number of the sensor at the tip, counted from 1 in the order of port handles.
    rate : frames that the device captures per second.
    reply : ``binary`` is finer and faster; ``text`` (0.01 mm) is for old firmware, which ``auto``
        recognises.
    outside_volume : accept poses outside of the volume that NDI characterised.
    reconnect_after : time of silence after which the device is reconnected, in s.
    """

    extra: ClassVar[str] = "aurora"
    peer: ClassVar[str] = "stiffopt.lab.aurora_peer:AuroraPeer"

    driver: Literal["aurora"] = "aurora"
    port: Annotated[str, Field(min_length=1)] = "auto"
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 115200
    sensor: Annotated[int, Field(ge=1, le=16)] = 1
    rate: Annotated[Frequency, Field(gt=0, le=400)] = 40.0
    reply: Literal["auto", "binary", "text"] = "auto"
    outside_volume: bool = False
    reconnect_after: Annotated[Duration, Field(gt=0, le=60)] = 5.0

    def device(self, clock: Clock | None = None) -> AuroraTracker:
        """Return the tracker, not yet open."""
        return AuroraTracker(self, clock)


class AuroraTracker(StreamedTracker):
    """Runs `ndi_reader` as a process, reads its output in a thread, and restarts it if it ends.

    It is a process, not a thread: the library waits up to 5 s for a silent device, cannot be
    interrupted, and does not check the length of replies. A process can be killed, and if it
    crashes, the process that holds the pressures survives.

    A frame counts as captured `latency` before its request: the reply takes time on the wire that
    the frame does not.
    """

    def __init__(self, settings: AuroraSettings, clock: Clock | None = None) -> None:
        super().__init__(settings, clock)
        self.settings = settings
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self._settled = threading.Event()  # set when the first connection works or has failed
        self._refusal = ""  # why the first connection failed
        self._lost = ""  # why the last one ended
        self._frame = -1  # last frame number of the device
        self._frames_before = 0  # number of frames in earlier sessions of the device

    def _open(self) -> None:
        require_package("ndicapi", self.settings.extra, "ndicapy")
        require_package("pyserial", self.settings.extra, "serial")
        self._stopping.clear()
        self._settled.clear()
        self._refusal = self._lost = ""
        self._process = self._start_reader(9600)
        self._thread = threading.Thread(target=self._listen, name="aurora", daemon=True)
        self._thread.start()
        try:
            if not self._settled.wait(self.settings.connect_timeout):
                self._refusal = (
                    f"no NDI tracker answers at port {self.settings.port} within "
                    f"{self.settings.connect_timeout:g} s; check that it is switched on and its "
                    "cable"
                )
            if self._refusal:
                raise DeviceError(f"aurora: {self._refusal}")
        except BaseException:  # even if the wait was interrupted
            self._close()
            raise

    def _close(self) -> None:
        with self._starting:
            self._stopping.set()
            process = self._process
        if process is not None:
            _end(process)
        if self._thread is not None:
            self._thread.join()
        self._process = self._thread = None

    def _start_reader(self, likely_baud: int) -> subprocess.Popen[str]:
        chosen = self.settings
        options = {
            **chosen.model_dump(
                include={"port", "baud", "sensor", "reply", "outside_volume", "reconnect_after"}
            ),
            "likely_baud": likely_baud,
            "pause": 1 / (_POLLS_PER_FRAME * chosen.rate),
        }
        return subprocess.Popen(
            [sys.executable, str(_READER), json.dumps(options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,  # Ctrl-C must only reach the process that vents
        )

    def _listen(self) -> None:
        """Process the reader's output until the tracker is closed."""
        while (process := self._process) is not None and process.stdout is not None:
            with process.stdout as lines:
                for line in lines:
                    self._take(line)
            _end(process)
            if self._stopping.is_set():
                return
            if not self._settled.is_set():
                self._refusal = self._lost or "the program that reads the tracker does not run"
                self._settled.set()
                return
            self._count(f"aurora: {self._lost or 'the program that reads the tracker ended'}")
            self._lost = ""
            if self._stopping.wait(_BETWEEN_TRIES):
                return
            with self._starting:
                if self._stopping.is_set():
                    return
                self._process = self._start_reader(self.settings.baud)

    def _take(self, line: str) -> None:
        try:
            message: dict[str, Any] = json.loads(line)
        except ValueError:  # the reader was killed while writing
            return
        if "frame" in message:
            self._take_frame(message["at"], message["frame"], message["pose"])
        elif "error" in message:
            self._count(f"aurora: {message['error']}")
        elif "ready" in message:
            self._settled.set()
        elif "lost" in message:
            self._lost = message["lost"]

    def _take_frame(self, asked: float, frame: int, pose: list[float] | None) -> None:
        if frame == self._frame:  # the device hangs, and was reconnected
            return
        if frame < self._frame:  # the device has restarted its count
            self._frames_before += self._frame + 1
        self._frame = frame
        number = self._frames_before + frame
        elapsed = time.monotonic() - asked  # this clock is the same in both processes
        captured = self.clock.now() - elapsed - self.settings.latency
        if pose is None:
            self._hand_over_nothing(captured, number)
        else:
            position = np.array(pose[4:7]) * 1e-3
            self._hand_over(captured, number, position, pose[:4])


def _end(process: subprocess.Popen[str]) -> None:
    """Ask a reader to end; kill it if it does not."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
