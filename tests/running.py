"""`stiffopt run` and `stiffopt lab` as processes, on rig files patient with a busy machine."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import yaml

RIGS = Path(__file__).resolve().parent.parent / "rig"
COMMAND = [
    sys.executable,
    "-c",
    "import sys; from stiffopt.cli.main import main; sys.exit(main())",
]
TASK = """\
format: stiffopt-task/1
robot: {robot}
target: {{position: {position}, tolerance: {{position: 0.5 mm}}}}
stiffness: {{maximise: {{direction: [1, 0, 0]}}}}
"""
ONE = TASK.format(robot="stiff-flop-1", position="[-20 mm, 5 mm, free]")
TWO = TASK.format(robot="stiff-flop-2-hanging", position="[-20 mm, 10 mm, 186 mm]")
_PATIENT = {
    "command_timeout": "5 s",
    "guard_timeout": "2 s",
    "max_overruns": 200,
    "heartbeat": "5 s",
    "tracker_frames": 100,
    "tracker_timeout": "5 s",
    "pressure_error_time": "3 s",
}


def patient_rig(folder: Path, name: str = "sim", **blocks: Any) -> Path:
    """Write a shipped rig file, on free ports and patient; `blocks` are put over its own."""
    content = yaml.safe_load((RIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    content["safety"] = {**content.get("safety", {}), **_PATIENT}
    content["service"] = {"port": 0, "foxglove_port": 0}
    content["log"] = {"folder": str(folder / "runs")}
    for key, block in blocks.items():
        content[key] = {**(content.get(key) or {}), **block}
    path = folder / f"{name}-patient.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def wait_for(condition: Callable[[], Any], timeout: float = 60.0) -> Any:
    """Return what is so at last."""
    end = time.monotonic() + timeout
    while not (value := condition()):
        assert time.monotonic() < end, "that did not happen in time"
        time.sleep(0.01)
    return value


class Process:
    """A command that runs, and what it has said so far."""

    def __init__(self, *arguments: str, prefix: str = "") -> None:
        command = [*COMMAND[:2], prefix + COMMAND[2]]
        self.popen = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        pairs = ((self.popen.stdout, self.out), (self.popen.stderr, self.err))
        self._threads = [Thread(target=self._listen, args=p, daemon=True) for p in pairs]
        for thread in self._threads:
            thread.start()

    @staticmethod
    def _listen(stream: Any, heard: list[str]) -> None:
        for line in stream:
            heard.append(line)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """The JSON lines so far; each must be one."""
        return [json.loads(line) for line in tuple(self.out)]

    def line(self, kind: str, timeout: float = 120.0, **fields: Any) -> dict[str, Any]:
        """Wait for a JSON line of a kind."""

        def found() -> dict[str, Any] | None:
            for line in self.lines:
                if line["kind"] == kind and all(line.get(k) == v for k, v in fields.items()):
                    return line
            assert self.popen.poll() is None, (self.out, self.err)
            return None

        line = wait_for(found, timeout)
        assert isinstance(line, dict)
        return line

    def say(self, text: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(f"{text}\n")
        self.popen.stdin.flush()

    def end(self, number: int = signal.SIGTERM, timeout: float = 20.0) -> int:
        """Send a signal and return the exit code."""
        self.popen.send_signal(number)
        return self.wait(timeout)

    def wait(self, timeout: float = 60.0) -> int:
        code = self.popen.wait(timeout)
        for thread in self._threads:
            thread.join(10)
        return code

    def close(self) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()
        for thread in self._threads:  # a guard holds the ends until it has vented, and gone
            thread.join(10)
        for stream in (self.popen.stdin, self.popen.stdout, self.popen.stderr):
            assert stream is not None
            stream.close()


@contextmanager
def running(*arguments: str, prefix: str = "") -> Iterator[Process]:
    """Give a process of `stiffopt`, after some code; it is gone at the end."""
    process = Process(*arguments, prefix=prefix)
    try:
        yield process
    finally:
        process.close()


def guard_of(pid: int) -> int:
    """Return the number of the guard process that a daemon has started."""

    def children() -> list[int]:
        found = []
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += [int(child) for child in (task / "children").read_text().split()]
        return [c for c in found if b"stiffopt.safety.guard" in _command(c)]

    (guard,) = wait_for(children)
    return int(guard)


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@contextmanager
def virtual_lab(rig: Path, out: Path) -> Iterator[tuple[Process, Callable[[], np.ndarray]]]:
    """The virtual lab of a rig, and what tells the pressures in the chambers, in bar."""
    with running("lab", str(rig), "--out", str(out)) as process:
        wait_for(out.exists, 180)

        def pressures() -> np.ndarray:
            told = len(process.err)
            process.say("status")
            wait_for(lambda: any("pressures" in line for line in process.err[told:]))
            text = " ".join(" ".join(process.err[told:]).split())
            found = re.search(r"pressures ([-\d., ]+) bar", text)
            assert found
            return np.array([float(p) for p in found[1].split(",")])

        yield process, pressures
