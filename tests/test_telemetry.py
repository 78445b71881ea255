"""Telemetry: what is logged is what was, live and recorded, and nothing hurts the loop."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fake_loop import ManualClock
from made_runs import (
    BEGIN,
    PERIOD,
    FakeLoop,
    command_at,
    event,
    samples_between,
    snapshot,
    ticks,
    tip_at,
)
from stiffopt.control.state import Alarm, Severity, State
from stiffopt.daemon.run_log import log_of_run, read_run
from stiffopt.daemon.telemetry import Telemetry
from stiffopt.daemon.topics import topic_schemas
from stiffopt.logs import read_log, write_log
from stiffopt.model.robot_files import load_description
from stiffopt.rig.settings import ServiceSettings

pytest.importorskip("foxglove")

ROBOT = load_description("stiff-flop-2-hanging")
NOWHERE = ServiceSettings(foxglove_port=None)
WALL = 1_800_000_000_000_000_000  # ns since 1970


def telemetry(loop: FakeLoop, folder: Path, **options: Any) -> Telemetry:
    given: dict[str, Any] = {"clock": ManualClock(BEGIN), "wall": lambda: WALL, "settings": NOWHERE}
    return Telemetry(ROBOT, "a rig", loop, str(folder), **{**given, **options})


def recorded(folder: Path, loop: FakeLoop, snapshots: list[Any], **options: Any) -> Path:
    made = telemetry(loop, folder, **options)
    made.work(last=True)  # no thread, so that all is the same in each run
    for index, each in enumerate(snapshots):
        made.put(each)
        if index % 20 == 0:
            made.work(last=True)
    made.stop()
    (path,) = folder.glob("*.mcap")
    assert made.recording.path == str(path)
    return path


def messages(path: Path) -> dict[str, list[Any]]:
    from mcap.reader import make_reader

    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def test_a_snapshot_is_recorded_as_it_was(tmp_path: Path) -> None:
    loop = FakeLoop()
    loop.events.all.append(event(0.5, "armed", "The arm is armed.", Severity.WARNING))
    given = ticks(200)
    run = read_run(recorded(tmp_path, loop, given))
    assert len(run) == 200
    assert run.complete
    assert run.channels == (3, 3)
    np.testing.assert_allclose(run.time, np.arange(200) * PERIOD, atol=1e-6)
    np.testing.assert_allclose(run.commanded, [s.commanded for s in given], atol=0.06)
    np.testing.assert_allclose(run.measured, [s.measured for s in given], atol=0.06)
    np.testing.assert_allclose(run.plan, [s.plan for s in given], atol=0.06)
    np.testing.assert_allclose(run.high, [s.high for s in given], atol=0.06)
    np.testing.assert_allclose(run.tip_position, [s.tip_position for s in given], atol=6e-8)
    np.testing.assert_allclose(run.target_position, [s.target_position for s in given], atol=6e-8)
    np.testing.assert_allclose(run.position_error, [s.position_error for s in given], atol=6e-8)
    np.testing.assert_allclose(run.stiffness, [s.stiffness for s in given], atol=6e-5)
    assert np.isnan(run.angle_error).all()
    assert run.saturated[:, 2].all()
    assert run.saturated.sum() == 200
    (happened,) = run.events
    assert (happened.kind, happened.severity, round(happened.time, 6)) == ("armed", "warning", 0.5)
    assert run.timing["overruns"] == 2
    assert run.about["rig"] == "a rig"
    assert "outer_radius" in run.about["robot_file"]
    frames = [s for each in given for s in each.samples]
    np.testing.assert_allclose(run.captured, [s.time - BEGIN for s in frames], atol=1e-6)
    np.testing.assert_allclose(run.seen_position, [s.position for s in frames], atol=6e-8)
    np.testing.assert_allclose(run.seen_quaternion, [s.quaternion for s in frames], atol=6e-8)


def test_states_and_alarms_are_spans_of_time(tmp_path: Path) -> None:
    missing = Alarm("tracker-missing", "The tracker sees nothing.", BEGIN + 1.0)
    given = ticks(100)
    given += [
        snapshot(BEGIN + 1.0 + k * PERIOD, state=State.HOLDING, reason="lost", alarms=(missing,))
        for k in range(50)
    ]
    given += [snapshot(BEGIN + 1.5 + k * PERIOD) for k in range(30)]
    run = read_run(recorded(tmp_path, FakeLoop(), given))
    spans = [(s.kind, s.text, round(s.begin, 3), round(s.end, 3)) for s in run.states]
    assert spans == [
        ("active", "", 0.0, 1.0), ("holding", "lost", 1.0, 1.5), ("active", "", 1.5, 1.79),
    ]  # fmt: skip
    (alarm,) = run.alarms
    assert (alarm.kind, round(alarm.begin, 3), round(alarm.end, 3)) == ("tracker-missing", 1.0, 1.5)


def test_dates_come_from_the_rigs_clock_and_not_from_a_wall_clock_that_jumps(
    tmp_path: Path,
) -> None:
    walls = iter([WALL] + [WALL - 10**15] * 100)
    found = messages(recorded(tmp_path, FakeLoop(), ticks(50), wall=lambda: next(walls)))
    dates = [message.log_time for message in found["/pressure"]]
    assert dates == [WALL + round(k * PERIOD * 1e9) for k in range(50)]
    assert [m.publish_time for m in found["/pressure"]] == dates
    assert {"/tf", "/tip", "/tracker", "/state", "/limits", "/timing"} <= set(found)


def test_messages_hold_to_their_schemas_and_foxglove_reads_these(tmp_path: Path) -> None:
    loop = FakeLoop()
    loop.events.all.append(event(0.1, "armed", "The arm is armed."))
    blind = snapshot(BEGIN)
    object.__setattr__(blind, "measured", np.full(6, np.nan))
    object.__setattr__(blind, "tip_position", np.full(3, np.nan))
    found = messages(recorded(tmp_path, loop, [blind, *ticks(20)]))
    kinds = {
        "number": (int, float), "integer": int, "boolean": bool, "string": str, "array": list,
    }  # fmt: skip

    def check(schema: dict[str, Any], value: Any) -> None:
        assert schema["type"] in (*kinds, "object")  # Foxglove refuses lists of types
        if schema["type"] == "object":
            assert set(value) <= set(schema["properties"])
            for key, item in value.items():
                check(schema["properties"][key], item)
        elif value is not None:
            assert isinstance(value, kinds[schema["type"]])
            for item in value if schema["type"] == "array" else ():
                check(schema["items"], item)

    for topic, schema in topic_schemas().items():
        assert found[topic]
        for message in found[topic]:
            check(schema, json.loads(message.data))


def test_the_arm_is_drawn_from_measured_pressures_ten_times_a_second(tmp_path: Path) -> None:
    asked = []

    def backbone(p: np.ndarray) -> np.ndarray:
        asked.append(p)
        return np.tile(np.eye(4), (20, 1, 1))

    given = ticks(100)
    found = messages(recorded(tmp_path, FakeLoop(), given, backbone=backbone))
    assert len(found["/scene"]) == len(asked) == 10
    np.testing.assert_allclose(asked[0], given[0].measured)


def test_an_export_has_the_pressures_of_the_moment_of_capture(tmp_path: Path) -> None:
    run = read_run(recorded(tmp_path, FakeLoop(), ticks(400)))
    write_log(tmp_path / "run.csv", log_of_run(run))
    log = read_log(tmp_path / "run.csv")
    assert len(log) == pytest.approx(4.0 / 0.025, abs=3)
    from made_runs import measured_at, turn_at

    for i, t in enumerate(log.time):
        assert (t - 0.003) / 0.025 == pytest.approx(round((t - 0.003) / 0.025), abs=1e-3)
        np.testing.assert_allclose(log.commanded[i], command_at(BEGIN + t), atol=0.1)
        np.testing.assert_allclose(log.tip_position[i], tip_at(BEGIN + t), atol=1e-7)
        assert log.tip_quaternion is not None
        np.testing.assert_allclose(log.tip_quaternion[i], turn_at(BEGIN + t), atol=1e-6)
        assert log.measured is not None
        if 0.003 < t < 3.98:
            np.testing.assert_allclose(log.measured[i], measured_at(BEGIN + t), atol=0.2)


def test_what_was_not_seen_is_not_exported_as_seen(tmp_path: Path) -> None:
    from made_runs import sample

    given = ticks(100)
    at = [k for k, each in enumerate(given) if each.samples]
    wild = given[at[5]]
    object.__setattr__(wild, "rejected", 1)
    blind = given[at[8]]
    unseen = sample(blind.samples[0].time, 8, seen=False)
    object.__setattr__(blind, "samples", (unseen,))
    late = given[at[12]]
    object.__setattr__(given[at[11]], "samples", (late.samples[0],))
    object.__setattr__(late, "samples", (sample(late.samples[0].time - 0.025, 11),))
    for k in range(60, 100):
        object.__setattr__(given[k], "samples", ())
    log = log_of_run(read_run(recorded(tmp_path, FakeLoop(), given)))
    assert np.all(np.diff(log.time) > 0)  # also those that came in another order
    seen = np.isfinite(log.tip_position).all(axis=1)
    for t in (wild.samples[0].time - BEGIN, unseen.time - BEGIN):
        (row,) = np.flatnonzero(np.abs(log.time - t) < 1e-6)
        assert not seen[row]
    for i in np.flatnonzero(seen):
        np.testing.assert_allclose(log.tip_position[i], tip_at(BEGIN + log.time[i]), atol=1e-7)
    blind_rows = log.time[log.time > 0.6]
    assert 6 <= len(blind_rows) <= 9  # the pressures go on without a tip
    assert not seen[log.time > 0.6].any()
    assert np.diff(blind_rows).max() < 0.06


def test_a_run_without_a_tracker_has_rows_of_pressures(tmp_path: Path) -> None:
    given = [snapshot(BEGIN + k * PERIOD) for k in range(100)]
    log = log_of_run(read_run(recorded(tmp_path, FakeLoop(), given)))
    assert 18 <= len(log) <= 21
    assert not np.isfinite(log.tip_position).any()


def test_what_is_too_much_is_counted_and_said(tmp_path: Path) -> None:
    loop = FakeLoop()
    made = telemetry(loop, tmp_path)
    tick = snapshot(BEGIN)
    for _ in range(4096 + 7):
        made.put(tick)
    assert made.dropped == 7
    made.work()
    assert "7 snapshots" in loop.alarms["telemetry-lost"]
    assert len(made._queue) == 0
    made.stop()


def test_a_disk_that_hangs_holds_nobody_up_and_the_end_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = telemetry(FakeLoop(), tmp_path)
    made.start()
    hangs, begun, write = threading.Event(), threading.Event(), os.write

    def hang(file: int, data: Any) -> int:
        begun.set()
        hangs.wait(20)
        return write(file, data)

    monkeypatch.setattr(os, "write", hang)
    for tick in ticks(3):
        made.put(tick)
    assert begun.wait(10)
    begin = time.monotonic()
    made.put(ticks(4)[-1])
    assert time.monotonic() - begin < 0.1
    with pytest.raises(TimeoutError, match=r"within 0\.2 s"):
        made.stop(0.2)
    assert time.monotonic() - begin < 2
    hangs.set()
    made.stop()  # now it does not hang any more


def test_to_stop_twice_begins_no_other_recording(tmp_path: Path) -> None:
    made = telemetry(FakeLoop(), tmp_path)
    made.start()
    made.put(snapshot(BEGIN))
    made.stop()
    made.stop()
    assert len(list(tmp_path.glob("*.mcap"))) == 1


def test_to_hand_over_a_snapshot_costs_the_loop_next_to_nothing(tmp_path: Path) -> None:
    made = telemetry(FakeLoop(), tmp_path)
    tick, costs = snapshot(BEGIN), []
    for _ in range(3000):
        begin = time.perf_counter()
        made.put(tick)
        costs.append(time.perf_counter() - begin)
    made.stop()
    assert np.median(costs) < 10e-6


def test_a_failure_is_an_alarm_and_the_rest_goes_on(tmp_path: Path) -> None:
    loop = FakeLoop()
    given = ticks(20)
    object.__setattr__(given[10], "commanded", "nonsense")
    path = recorded(tmp_path, loop, given)
    assert "could not be logged" in loop.alarms["telemetry"]
    assert len(read_run(path)) == 19


def test_of_a_faster_loop_a_hundred_ticks_a_second_are_logged_and_all_samples(
    tmp_path: Path,
) -> None:
    period = 0.002
    times = BEGIN + period * np.arange(1000)
    given = [snapshot(t, samples=samples_between(t - period, t)) for t in times]
    given[503] = snapshot(times[503], state=State.HOLDING)
    run = read_run(recorded(tmp_path, FakeLoop(), given))
    assert len(run) == pytest.approx(200, abs=3)
    assert len(run.captured) == sum(len(each.samples) for each in given)
    assert np.any(np.isclose(run.time, 503 * period))  # what changes is logged at once
    log = log_of_run(run)
    seen = np.isfinite(log.tip_position).all(axis=1)
    for t, p in zip(log.time[seen], log.commanded[seen], strict=True):
        assert np.abs(p - command_at(BEGIN + t)).max() <= 100.1  # at most one tick old


def test_two_instances_do_not_mix(tmp_path: Path) -> None:
    one, two = telemetry(FakeLoop(), tmp_path / "1"), telemetry(FakeLoop(), tmp_path / "2")
    one.start()
    two.start()
    given = ticks(30)
    for each in given:
        one.put(each)
    two.put(given[0])
    one.stop()
    two.stop()
    assert one.recording.path is not None
    assert two.recording.path is not None
    assert (len(read_run(one.recording.path)), len(read_run(two.recording.path))) == (30, 1)


def test_foxglove_sees_the_topics_with_their_schemas(tmp_path: Path) -> None:
    from websockets.sync.client import connect

    made = telemetry(FakeLoop(), tmp_path, settings=ServiceSettings(foxglove_port=0))
    made.start()
    over = threading.Event()

    def feed() -> None:
        for tick in ticks(2000):
            made.put(tick)
            if over.wait(0.005):
                return

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        channels: dict[str, Any] = {}
        data = 0
        deadline = time.monotonic() + 20
        with connect(
            f"ws://127.0.0.1:{made.port}", subprotocols=["foxglove.sdk.v1"], close_timeout=1
        ) as client:  # type: ignore[list-item]
            while (len(channels) < 10 or data < 20) and time.monotonic() < deadline:
                received = client.recv(timeout=10)
                if isinstance(received, bytes):
                    data += 1
                    continue
                message = json.loads(received)
                if message["op"] != "advertise":
                    continue
                fresh = {channel["topic"]: channel for channel in message["channels"]}
                channels |= fresh
                wanted = [{"id": c["id"], "channelId": c["id"]} for c in fresh.values()]
                client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    finally:
        over.set()
        feeder.join()
        made.stop()
    assert data >= 20
    assert made.port is None
    for topic, schema in topic_schemas().items():
        assert channels[topic]["encoding"] == "json"
        assert json.loads(channels[topic]["schema"]) == schema
    for topic, name in {
        "/tf": "foxglove.FrameTransforms", "/scene": "foxglove.SceneUpdate", "/log": "foxglove.Log",
    }.items():  # fmt: skip
        assert channels[topic]["schemaName"] == name


def test_whoever_connects_to_foxglove_may_look_and_not_touch_and_only_from_here(
    tmp_path: Path,
) -> None:
    """Pages of any site on this machine may look: that is how Foxglove itself connects."""
    from websockets.sync.client import connect

    made = telemetry(FakeLoop(), tmp_path, settings=ServiceSettings(foxglove_port=0))
    made.start()
    try:
        listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        bound = {
            place.partition(":")[0] for place in listening if place.endswith(f":{made.port:04X}")
        }
        assert bound == {"0100007F"}  # 127.0.0.1, and no other
        with connect(
            f"ws://127.0.0.1:{made.port}",
            subprotocols=["foxglove.sdk.v1"],  # type: ignore[list-item]
            origin="https://app.foxglove.dev",  # type: ignore[arg-type]
            close_timeout=1,
        ) as client:
            told = json.loads(client.recv(timeout=10))
            assert told["op"] == "serverInfo"
            assert told["capabilities"] == []
            channel = {"id": 1, "topic": "/target", "encoding": "json", "schemaName": "x"}
            client.send(json.dumps({"op": "advertise", "channels": [channel]}))
            while (told := json.loads(client.recv(timeout=10)))["op"] != "status":
                pass
            assert "does not support clientPublish" in told["message"]
    finally:
        made.stop()


def test_a_port_that_is_taken_is_an_alarm(tmp_path: Path) -> None:

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        loop = FakeLoop()
        made = telemetry(loop, tmp_path, settings=ServiceSettings(foxglove_port=port))
        made.start()
        made.put(snapshot(BEGIN))
        made.stop()
    assert str(port) in loop.alarms["foxglove"]
    assert made.recording.path is not None
    assert len(read_run(made.recording.path)) == 1


CHILD = """
import sys, time
sys.path.insert(0, {tests!r})
from made_runs import *
from test_telemetry import telemetry
from pathlib import Path
made = telemetry(FakeLoop(), Path({folder!r}))
made.start()
for k in range(100000):
    t = BEGIN + k * PERIOD
    made.put(snapshot(t, samples=samples_between(t - PERIOD, t)))
    print(k + 1, flush=True)
    time.sleep(PERIOD)
"""


def test_the_recording_of_a_killed_run_opens_and_lacks_only_the_end(tmp_path: Path) -> None:
    script = CHILD.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    given = 0
    for line in child.stdout:
        given = int(line)
        if given >= 200:
            break
    os.kill(child.pid, signal.SIGKILL)
    given = max([given, *(int(line) for line in child.stdout.read().split() if line.isdigit())])
    child.stdout.close()
    assert child.wait() == -signal.SIGKILL
    (path,) = tmp_path.glob("*.mcap")
    run = read_run(path)
    assert not run.complete
    assert given - 100 <= len(run) <= given + 1  # 0.1 s are at stake; the machine may be slow
    np.testing.assert_allclose(run.time, np.arange(len(run)) * PERIOD, atol=1e-6)
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader

    count = 0
    with path.open("rb") as stream, suppress(EndOfFile):  # which a killed recording has early
        for _, channel, _ in NonSeekingReader(stream).iter_messages(log_time_order=False):
            count += channel.topic == "/pressure"
    assert count == len(run)
