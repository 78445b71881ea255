"""Bags of recorded runs: rosbags reads them, and they say what the recording says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg

import ros_types
from made_runs import BEGIN, PERIOD, FakeLoop, event, snapshot, ticks
from stiffopt.cli.main import main
from stiffopt.control.state import Severity, State
from stiffopt.daemon.run_log import RecordedRun, read_run
from stiffopt.ros import bag as bag_module
from stiffopt.ros import messages as m
from stiffopt.ros.bag import definition
from stiffopt.ros.messages import ros_name
from stiffopt.ros.published import PUBLISHED
from test_telemetry import recorded


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    loop = FakeLoop()
    loop.events.all.append(event(0.5, "tracker-missing", "It sees nothing.", Severity.WARNING))
    given = ticks(100)
    given += [
        snapshot(BEGIN + 1 + k * PERIOD, state=State.HOLDING, reason="lost") for k in range(50)
    ]
    return recorded(tmp_path_factory.mktemp("runs"), loop, given)


def test_rosbags_reads_the_bag_of_a_run(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "monday"
    assert main(["log", "export", str(run_file), "--bag", "--out", str(out)]) == 0
    run = read_run(run_file)
    with AnyReader([out]) as reader:
        assert f"{reader.message_count} messages" in capsys.readouterr().out
        assert reader.start_time == int(run.about["start_ns"]) + round(run.time[0] * 1e9)
        assert reader.end_time - reader.start_time == pytest.approx(1.49e9, rel=0.02)
        heard: dict[str, list[Any]] = {}
        for connection, moment, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            heard.setdefault(connection.topic, []).append((moment, message))
    pressures = heard["/stiffopt/pressure"]
    assert len(pressures) == len(run)
    np.testing.assert_allclose([p.position for _, p in pressures], run.measured)
    for moment, message in pressures:
        stamp = message.header.stamp
        assert abs(moment - (stamp.sec * 10**9 + stamp.nanosec)) < 1000
    tips = [t.pose.position for _, t in heard["/stiffopt/tip"]]
    expected = run.tip_position[np.isfinite(run.tip_position).all(axis=1)]
    np.testing.assert_allclose([[t.x, t.y, t.z] for t in tips], expected)
    states = [s.data for _, s in heard["/stiffopt/state"]]
    assert states[0] == "active"
    assert states[-1] == "holding: lost"
    (line,) = [line for _, line in heard["/rosout"] if "tracker-missing" in line.msg]
    assert line.level == 30
    assert len(heard["/stiffopt/markers"]) >= 7
    assert {t.child_frame_id for _, tf in heard["/tf"] for t in tf.transforms} >= {"tip", "target"}


def test_the_definitions_in_a_bag_are_those_of_ros_2() -> None:
    store = ros_types.typestore("jazzy")
    for kind, _, _ in PUBLISHED.values():
        name = ros_name(kind)
        written = get_types_from_msg(definition(kind), name)
        for each, (_, fields) in written.items():
            assert fields == store.fielddefs[each][1], each
    assert definition(m.PointStamped).startswith("std_msgs/Header header\n")


def test_snapshots_of_a_recording_are_those_of_the_run(run_file: Path) -> None:
    run: RecordedRun = read_run(run_file)
    found = list(run.snapshots())
    assert len(found) == len(run)
    np.testing.assert_allclose([each.time for each in found], run.time)
    np.testing.assert_array_equal([each.commanded for each in found], run.commanded)
    assert {each.state for each in found} == {State.ACTIVE, State.HOLDING}
    assert found[-1].reason == "lost"
    assert all(each.target_quaternion is None for each in found)


def test_a_bag_replaces_nothing_and_is_whole_or_not_there(
    run_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert main(["log", "export", str(run_file), "--bag", "--out", str(tmp_path)]) == 2
    assert "exists; give another folder" in capsys.readouterr().err
    assert main(["log", "export", str(run_file), "--bag", "--csv"]) == 2
    monkeypatch.setattr(bag_module, "_about", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["log", "export", str(run_file), "--bag", "--out", str(tmp_path / "bag")])
    assert not list(tmp_path.iterdir())
