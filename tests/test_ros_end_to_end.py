"""From a ROS 2 peer through the real firmware to simulated silicone and back, with kills.

peer -> `stiffopt ros` -> daemon -> driver -> firmware in simavr -> simulated arm -> tracker's
protocol -> daemon -> `stiffopt ros` -> peer: it holds a stiff pose until something on the way is
killed, at a random moment; the chambers are empty soon after, whatever it is.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from board_host import need_firmware
from ros_peer import own_domain
from running import ONE, Process, guard_of, patient_rig, virtual_lab, wait_for

pytestmark = pytest.mark.real_time

HOLDER = Path(__file__).with_name("ros_holder.py")
PLANT = {"seed": 3, "spread": {"modulus": "5 %", "length": "0.5 %"}}
SAFETY = {"heartbeat": "2 s", "hold_timeout": "1 s"}
VICTIMS = ("peer", "node", "daemon", "guard", "all but the board")


class Holder:
    """The peer that commands, as a process."""

    def __init__(self, task: Path) -> None:
        command = [sys.executable, str(HOLDER), str(own_domain()), str(task)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.said: list[str] = []
        self._thread = Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line.strip())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._thread.join(10)
        assert self.process.stdout is not None
        self.process.stdout.close()


def daemon_of(node: Process) -> int:
    """Return the number of the daemon that a node has started."""

    def children() -> list[int]:
        found: list[int] = []
        for task in Path(f"/proc/{node.popen.pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
        return [c for c in found if b"run" in Path(f"/proc/{c}/cmdline").read_bytes().split(b"\0")]

    (daemon,) = wait_for(children)
    return int(daemon)


def end(process: int) -> None:
    """Let a process end by itself that lost its parent, as a daemon without its node."""
    with suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM)

    def gone() -> bool:
        try:
            return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
        except OSError:
            return True

    wait_for(gone)


class Session:
    """The node and its daemon, started anew where they have ended."""

    def __init__(self, rig: Path) -> None:
        self._rig = rig
        self._node: Process | None = None
        self._daemon: int | None = None

    def pids(self) -> tuple[int, int]:
        """Return the numbers of node and daemon, which run."""
        if self._node is None or self._daemon is None or self._node.popen.poll() is not None:
            self.close()
            self._node = Process("ros", str(self._rig), "--domain", str(own_domain()))
            self._node.line("started")
            self._daemon = daemon_of(self._node)
        return self._node.popen.pid, self._daemon

    def wait_for_the_node(self) -> None:
        """Wait until it has ended, since its daemon has."""
        assert self._node is not None
        assert self._node.wait() != 0

    def close(self) -> None:
        if self._node is not None:
            self._node.popen.kill()
            if self._daemon is not None:
                end(self._daemon)
            self._node.close()  # now nobody writes to its streams any more
        self._node = self._daemon = None


@pytest.mark.parametrize(("seed", "rounds"), [(0, 2), pytest.param(1, 20, marks=pytest.mark.long)])
def test_it_holds_a_stiff_pose_and_whatever_is_killed_the_chambers_empty(
    seed: int,
    rounds: int,
    tmp_path: Path,
    compiled: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    need_firmware()
    monkeypatch.setenv("STIFFOPT_FIRMWARE", "SILENCE_MS=5000")
    rng = np.random.default_rng(seed)
    victims = [VICTIMS[k % len(VICTIMS)] for k in range(rounds)]
    if rounds > len(VICTIMS):
        rng.shuffle(victims)
    rig = patient_rig(
        tmp_path, "open-regulator", supply={"timeout": "1 s"}, plant=PLANT, safety=SAFETY,
        ros={"commands": True, "interface": "lo"},
    )  # fmt: skip
    task, out = tmp_path / "task.yaml", tmp_path / "lab.yaml"
    task.write_text(ONE, encoding="utf-8")
    with virtual_lab(rig, out) as (_, pressures):
        session = Session(out)
        try:
            for number, victim in enumerate(victims):
                node, daemon = session.pids()
                holder = Holder(task)
                try:  # once it holds the pose, or on the way there
                    said = "near" if number == 0 else "asked"
                    wait_for(lambda holder=holder, said=said: said in holder.said, 120)
                    time.sleep(rng.uniform(0, 3))
                    wait_for(lambda: pressures().max() > 0.1)
                    kill(victim, holder.process.pid, node, daemon)
                    wait_for(lambda: pressures().max() < 0.02)
                finally:
                    holder.close()
                if victim == "daemon":
                    session.wait_for_the_node()
        finally:
            session.close()


def kill(victim: str, peer: int, node: int, daemon: int) -> None:
    guard = guard_of(daemon)
    if victim == "all but the board":
        os.kill(guard, signal.SIGSTOP)  # so that it cannot vent, nor the daemon
    for number in {
        "peer": [peer],
        "node": [node],
        "daemon": [daemon],
        "guard": [guard],
        "all but the board": [daemon, guard, node, peer],
    }[victim]:
        os.kill(number, signal.SIGKILL)
