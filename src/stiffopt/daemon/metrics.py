"""Metrics for Prometheus, computed when they are read: they cost the control loop nothing."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from itertools import accumulate
from math import isfinite
from typing import TYPE_CHECKING, Any

from stiffopt.control.state import Snapshot, State
from stiffopt.control.state_fields import Kind, entries
from stiffopt.errors import require_package

if TYPE_CHECKING:
    from stiffopt.control.loop import ControlLoop
    from stiffopt.daemon.telemetry import Telemetry


_SHARED = {"pressure_pascals": "Gauge pressures of the channels."}
"""Help texts of metrics that several fields share."""


class Metrics:
    """The metrics of a control loop and its telemetry, as text for Prometheus.

    Each has the rig's name as a label. Raises `MissingExtraError` without prometheus-client.
    """

    def __init__(self, name: str, loop: ControlLoop, telemetry: Telemetry | None = None) -> None:
        require_package("prometheus-client", "daemon", "prometheus_client")
        from prometheus_client import CollectorRegistry

        self._name, self._loop, self._telemetry = name, loop, telemetry
        self._seen: Counter[tuple[str, str]] = Counter()  # events
        self._next_event = 0
        self._lock = threading.Lock()
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)

    def render(self) -> bytes:
        """Return all metrics as text; callable from any thread."""
        from prometheus_client import generate_latest

        with self._lock:
            return generate_latest(self._registry)

    def collect(self) -> Iterator[Any]:
        """Yield all metrics; called by the registry."""
        now = self._loop.snapshot()
        yield from self._of_state(now)
        yield from self._of_fields(now.timing)
        yield self._lateness(now)
        yield from self._of_fields(now)
        yield self._events()
        if self._telemetry is not None:
            dropped, written = self._telemetry.dropped, self._telemetry.recording.written
            yield self._counter("telemetry_dropped", "Snapshots never logged.", dropped)
            yield self._counter("log_bytes", "Bytes recorded.", written)

    def _of_state(self, now: Snapshot) -> Iterator[Any]:
        states = self._gauges("state", "Where in its life the loop is: 1 for its state.", "state")
        for state in State:
            states.add_metric([self._name, str(state)], float(state == now.state))
        yield states
        alarms = self._gauges("alarm", "What is wrong now: 1 for each alarm.", "kind")
        for alarm in now.alarms:
            alarms.add_metric([self._name, alarm.kind], 1.0)
        yield alarms

    def _lateness(self, now: Snapshot) -> Any:
        from prometheus_client.core import HistogramMetricFamily

        timing = now.timing
        edges = [*(f"{edge:g}" for edge in timing.lateness_edges), "+Inf"]
        totals = map(float, accumulate(timing.lateness_counts))
        buckets = list(zip(edges, totals, strict=True))
        late = HistogramMetricFamily(
            "stiffopt_lateness_seconds", "How late ticks begin.", labels=["rig"]
        )
        late.add_metric([self._name], buckets, sum_value=None)
        return late

    def _of_fields(self, record: Any) -> Iterator[Any]:
        """Yield the metrics of a record's fields that define one."""
        shared: dict[str, Any] = {}
        for entry in entries(type(record)):
            name, about = entry.shown.metric, entry.shown.about
            about = f"{about[:1].upper()}{about[1:]}."
            value = getattr(record, entry.name) if name else None
            if value is None:
                continue
            if entry.kind is Kind.COUNT:
                yield self._counter(name, about, value)
            elif entry.kind in (Kind.NUMBERS, Kind.FLAGS):
                labels = ("channel", "kind") if entry.shown.label else ("channel",)
                about = _SHARED.get(name, about)
                family = shared.setdefault(name, self._gauges(name, about, *labels))
                for channel, number in enumerate(map(float, value), start=1):
                    if isfinite(number):
                        of = (str(channel), entry.shown.label)[: len(labels)]
                        family.add_metric([self._name, *of], number)
            elif isfinite(value):
                family = self._gauges(name, about)
                family.add_metric([self._name], value)
                yield family
        yield from shared.values()

    def _events(self) -> Any:
        from prometheus_client.core import CounterMetricFamily

        events, self._next_event = self._loop.events.since(self._next_event)
        self._seen.update((event.kind, str(event.severity)) for event in events)
        family = CounterMetricFamily(
            "stiffopt_events", "What has happened.", labels=["rig", "kind", "severity"]
        )
        for (kind, severity), count in sorted(self._seen.items()):
            family.add_metric([self._name, kind, severity], count)
        return family

    def _gauges(self, name: str, text: str, *labels: str) -> Any:
        from prometheus_client.core import GaugeMetricFamily

        return GaugeMetricFamily(f"stiffopt_{name}", text, labels=["rig", *labels])

    def _counter(self, name: str, text: str, value: float) -> Any:
        from prometheus_client.core import CounterMetricFamily

        family = CounterMetricFamily(f"stiffopt_{name}", text, labels=["rig"])
        family.add_metric([self._name], value)
        return family
