"""The recording of a run: it survives what happens to disks, and says so."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from conftest import is_long
from fake_loop import ManualClock
from made_runs import BEGIN, FakeLoop, event, snapshot, ticks
from stiffopt.daemon import recording as recording_module
from stiffopt.daemon.recording import RecordingLimits, RunRecording
from stiffopt.daemon.run_log import read_run
from stiffopt.daemon.telemetry import about_run
from stiffopt.model.robot_files import load_description

foxglove = pytest.importorskip("foxglove")

ROBOT = load_description("stiff-flop-2")
WALL = 1_800_000_000.0  # s since 1970: 2027-01-15 08:00 UTC


class Logger:
    """A recording and what is logged into it."""

    def __init__(self, folder: Path, name: str = "rig", **options: Any) -> None:
        from stiffopt.daemon.topics import TelemetryChannels

        context = foxglove.Context()
        self.channels = TelemetryChannels(context, round(WALL * 1e9), 0.03)
        about = about_run(ROBOT, name, snapshot(BEGIN), BEGIN, 0)
        self.recording = RunRecording(
            folder, name, context, about, wall=lambda: WALL, **{"free": lambda _: 1e12, **options}
        )
        self.count = 0

    def log(self, count: int, now: float = 0.0) -> None:
        """Log some ticks and commit."""
        for tick in ticks(self.count + count)[self.count :]:
            self.channels.log_state(tick)
            self.channels.log_tick(tick)
            self.channels.log_samples(tick)
        self.count += count
        self.recording.commit(now)


def test_a_commit_is_on_the_disk_whole(tmp_path: Path) -> None:
    logger = Logger(tmp_path)
    logger.recording.commit(0.0)
    path = logger.recording.path
    assert path is not None
    for count in (5, 10, 15):
        logger.log(5)
        run = read_run(path)  # while it is being written
        assert len(run) == count
        assert not run.complete
    assert logger.recording.written == os.path.getsize(path)
    logger.recording.close()
    logger.recording.close()
    assert read_run(path).complete
    assert logger.recording.written == os.path.getsize(path)


def test_what_was_ended_has_an_index_to_jump_by(tmp_path: Path) -> None:
    from mcap.reader import SeekingReader

    logger = Logger(tmp_path)
    logger.recording.commit(0.0)
    for _ in range(3):
        logger.log(10)
    logger.recording.close()
    assert logger.recording.path is not None
    with open(logger.recording.path, "rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.chunk_count == 3
    assert len(summary.chunk_indexes) == 3


def test_a_cut_anywhere_leaves_what_is_before(tmp_path: Path) -> None:
    logger = Logger(tmp_path)
    logger.recording.commit(0.0)
    begin = logger.recording.written
    ends = []
    for _ in range(6):
        logger.log(5)
        ends.append(logger.recording.written)
    logger.recording.close()
    assert logger.recording.path is not None
    data = Path(logger.recording.path).read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in range(begin, len(data), 37 if is_long() else 149):
        cut.write_bytes(data[:size])
        whole = sum(end <= size for end in ends)
        if whole == 0:
            continue
        assert 5 * whole <= len(read_run(cut)) <= 5 * (whole + 1)


def test_a_recording_is_for_this_user_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        logger = Logger(tmp_path / "a" / "runs")
        logger.recording.commit(0.0)
    finally:
        os.umask(before)
    logger.recording.close()
    assert logger.recording.path is not None
    modes = [
        stat.S_IMODE(os.stat(path).st_mode)
        for path in (tmp_path / "a", tmp_path / "a" / "runs", logger.recording.path)
    ]
    assert modes == [0o700, 0o700, 0o600]


def test_a_name_never_overwrites(tmp_path: Path) -> None:
    loggers = [Logger(tmp_path, "my rig / 2") for _ in range(3)]
    for logger in loggers:
        logger.recording.commit(0.0)
        logger.recording.close()
    names = [Path(str(logger.recording.path)).name for logger in loggers]
    assert names == [
        "my-rig-2-20270115T080000Z.mcap",
        "my-rig-2-20270115T080000Z-2.mcap",
        "my-rig-2-20270115T080000Z-3.mcap",
    ]


def test_a_large_recording_goes_on_in_another_file(tmp_path: Path) -> None:
    logger = Logger(tmp_path, limits=RecordingLimits(largest=20_000.0))
    logger.recording.commit(0.0)
    for _ in range(60):
        logger.log(10)
    logger.recording.close()
    runs = [read_run(path) for path in tmp_path.glob("*.mcap")]
    assert len(runs) > 1
    assert all(run.complete for run in runs)
    assert sum(map(len, runs)) == 600
    assert max(path.stat().st_size for path in tmp_path.glob("*.mcap")) < 40_000


def test_the_disk_is_not_filled_to_its_last_byte(tmp_path: Path) -> None:
    free = 1e12
    logger = Logger(tmp_path, free=lambda _: free)
    logger.recording.commit(0.0)
    logger.log(10, 0.0)
    free = RecordingLimits().min_free - 1
    logger.log(10, 0.5)  # looked at once a second
    assert logger.recording.is_open
    logger.log(10, 1.1)
    assert not logger.recording.is_open
    assert "200 MB are free" in logger.recording.trouble
    (path,) = tmp_path.glob("*.mcap")
    run = read_run(path)
    assert run.complete
    assert len(run) == 30
    free = RecordingLimits().min_free + 1  # not yet enough
    logger.log(10, 100.0)
    assert "MB are free" in logger.recording.trouble
    free = 1e12
    logger.log(10, 105.0)  # not before it is time
    assert logger.recording.trouble
    logger.recording.commit(110.1)
    logger.log(10, 110.2)
    assert not logger.recording.trouble
    logger.recording.close()
    assert logger.recording.path != str(path)
    assert len(read_run(str(logger.recording.path))) == 10


def test_a_failing_disk_is_told_and_what_was_written_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logger = Logger(tmp_path)
    logger.recording.commit(0.0)
    logger.log(10)
    write, there = os.write, 100

    def full(file: int, data: Any) -> int:
        nonlocal there
        if not there:
            raise OSError(errno.ENOSPC, "No space left on device")
        some, there = min(there, len(data)), 0
        return write(file, data[:some])  # some bytes still fit

    monkeypatch.setattr(recording_module.os, "write", full)
    logger.log(10, 5.0)
    assert "no space left" in logger.recording.trouble
    (path,) = tmp_path.glob("*.mcap")
    assert len(read_run(path)) == 10
    logger.log(10, 10.0)
    assert "no space left" in logger.recording.trouble
    monkeypatch.undo()
    logger.recording.commit(15.1)
    logger.log(10, 15.2)
    assert not logger.recording.trouble
    logger.recording.close()
    assert len(list(tmp_path.glob("*.mcap"))) == 2
    assert len(read_run(str(logger.recording.path))) == 10


def test_a_recording_that_cannot_begin_leaves_no_file_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("no writer")

    logger = Logger(tmp_path)
    monkeypatch.setattr(foxglove, "open_mcap", fail)
    before = len(os.listdir("/proc/self/fd"))
    for attempt in range(10):  # each comes after a while
        logger.recording.commit(100.0 * attempt)
        assert "no writer" in logger.recording.trouble
    assert len(os.listdir("/proc/self/fd")) == before
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    logger = Logger(tmp_path / "file" / "runs")
    logger.recording.commit(0.0)
    assert "cannot be written" in logger.recording.trouble
    logger.log(3, 1.0)
    logger.recording.close()


def test_a_folder_that_vanishes_is_told(tmp_path: Path) -> None:
    def gone(folder: str) -> float:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    logger = Logger(tmp_path)
    logger.recording.commit(0.0)
    logger.recording._free = gone
    logger.log(3, 2.0)
    assert "no such file" in logger.recording.trouble


LIMITED = """
import resource, sys, time
sys.path.insert(0, {tests!r})
from made_runs import *
from test_telemetry import telemetry
from pathlib import Path
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
loop = FakeLoop()
made = telemetry(loop, Path({folder!r}))
made.start()
given = ticks(6000)
for tick in given:
    made.put(tick)
    time.sleep(0.0005)
    if "log" in loop.alarms:
        break
deadline = time.monotonic() + 20
while "log" not in loop.alarms and time.monotonic() < deadline:
    time.sleep(0.01)
loop.events.all.append(event(1.0, "still", "Still here."))
for tick in given[:1000]:
    made.put(tick)
made.stop()
print(loop.alarms["log"])
print(len(made._queue))
"""


def test_a_file_that_may_not_grow_stops_the_recording_and_nothing_else(tmp_path: Path) -> None:
    """The system itself refuses to write: at a limit of the size of files."""
    script = LIMITED.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    alarm, rest = done.stdout.splitlines()
    assert "cannot be written: file too large" in alarm
    assert rest == "0"
    (path, *_) = sorted(tmp_path.glob("*.mcap"))
    assert path.stat().st_size <= 200_000
    assert len(read_run(path)) > 20


def test_an_alarm_comes_with_the_trouble_and_goes_with_it(tmp_path: Path) -> None:
    from stiffopt.daemon.telemetry import Telemetry
    from stiffopt.rig.settings import ServiceSettings

    loop = FakeLoop()
    (tmp_path / "file").touch()
    made = Telemetry(
        ROBOT, "rig", loop, str(tmp_path / "file" / "runs"), ServiceSettings(foxglove_port=None),
        clock=ManualClock(BEGIN),
    )  # fmt: skip
    made.start()
    assert "cannot be written" in loop.alarms["log"]
    loop.events.all.append(event(0.1, "armed", "The arm is armed."))
    (tmp_path / "file").unlink()
    made.recording._retry_at = 0.0
    made.put(snapshot(BEGIN))
    made.work(last=True)
    made.stop()
    assert "log" not in loop.alarms
    assert loop.told == ["".join(loop.told)]  # once
