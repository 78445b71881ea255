"""Metrics: what Prometheus reads is how things stand when it asks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from made_runs import BEGIN, FakeLoop, event, snapshot
from stiffopt.control.state import Alarm, Severity, State, Timing
from stiffopt.daemon.metrics import Metrics

parser = pytest.importorskip("prometheus_client.parser")


class FakeTelemetry:
    dropped = 3
    recording = SimpleNamespace(written=12345)


def read(metrics: Metrics) -> dict[tuple[str, tuple[str, ...]], float]:
    """Return values by name and labels; the label of the rig is checked and left out."""
    found = {}
    for family in parser.text_string_to_metric_families(metrics.render().decode()):
        for line in family.samples:
            labels: dict[str, Any] = dict(line.labels)
            assert labels.pop("rig") == 'a "rig"'
            found[line.name, tuple(labels.values())] = line.value
    return found


def test_what_is_read_is_how_things_stand() -> None:
    loop = FakeLoop()
    alarm = Alarm("tracker-missing", "The tracker sees nothing.", BEGIN)
    loop.now = snapshot(BEGIN + 1.0, state=State.HOLDING, alarms=(alarm,))
    found = read(Metrics('a "rig"', loop, FakeTelemetry()))
    assert found["stiffopt_state", ("holding",)] == 1
    assert sum(value for (name, _), value in found.items() if name == "stiffopt_state") == 1
    assert found["stiffopt_alarm", ("tracker-missing",)] == 1
    assert found["stiffopt_ticks_total", ()] == 7
    assert found["stiffopt_overruns_total", ()] == 2
    assert found["stiffopt_tick_time_seconds", ()] == pytest.approx(3e-4)
    assert found["stiffopt_position_error_meters", ()] == pytest.approx(loop.now.position_error)
    for channel in range(6):
        for kind in ("commanded", "measured", "plan"):
            value = found["stiffopt_pressure_pascals", (str(channel + 1), kind)]
            assert value == pytest.approx(getattr(loop.now, kind)[channel])
    assert found["stiffopt_telemetry_dropped_total", ()] == 3
    assert found["stiffopt_log_bytes_total", ()] == 12345


def test_the_histogram_of_lateness_counts_what_is_below() -> None:
    found = read(Metrics('a "rig"', FakeLoop()))
    buckets = {labels[0]: v for (name, labels), v in found.items() if name.endswith("_bucket")}
    assert buckets == {"0.0001": 90, "0.001": 99, "+Inf": 100}
    assert ("stiffopt_log_bytes_total", ()) not in found


def test_a_loop_that_has_not_begun_can_be_read() -> None:
    loop = FakeLoop()
    object.__setattr__(loop.now, "timing", Timing())
    object.__setattr__(loop.now, "measured", np.full(6, np.nan))
    found = read(Metrics('a "rig"', loop))
    assert found["stiffopt_lateness_seconds_bucket", ("+Inf",)] == 0
    assert ("stiffopt_pressure_pascals", ("1", "measured")) not in found
    assert ("stiffopt_angle_error_radians", ()) not in found  # nothing was asked


def test_each_event_is_counted_once() -> None:
    loop = FakeLoop()
    metrics = Metrics('a "rig"', loop)
    loop.events.all += [event(0, "armed", "Armed."), event(1, "jump", "A jump.", Severity.ERROR)]
    read(metrics)
    loop.events.all.append(event(2, "jump", "Another.", Severity.ERROR))
    found = read(metrics)
    assert found["stiffopt_events_total", ("armed", "info")] == 1
    assert found["stiffopt_events_total", ("jump", "error")] == 2


def test_two_instances_have_registries_of_their_own() -> None:
    assert Metrics('a "rig"', FakeLoop()).render() == Metrics('a "rig"', FakeLoop()).render()
