"""Metrics for Prometheus, computed when they are read; the control loop does nothing for them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from math import isfinite
from typing import TYPE_CHECKING, Any

from stiffopt.control.state import Snapshot, State
from stiffopt.control.state_fields import Kind, entries
from stiffopt.errors import MissingExtraError

if TYPE_CHECKING:
    from stiffopt.control.loop import ControlLoop
    from stiffopt.daemon.telemetry import Telemetry

__all__ = ["CONTENT_TYPE", "Metrics"]

_SHARED = {"pressure_pascals": "Gauge pressures of the channels."}
"""Help of metrics that several fields share."""

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of what `Metrics.render` returns."""


class Metrics:
    """The metrics of a control loop and its telemetry, as text for Prometheus.

    Parameters
    ----------
    name :
        Of the rig; a label.
    loop :
        What is watched.
    telemetry :
        Its recording is watched too.

    Raises
    ------
    MissingExtraError
        prometheus-client is not installed.
    """

    def __init__(self, name: str, loop: ControlLoop, telemetry: Telemetry | None = None) -> None:
        try:
            from prometheus_client import CollectorRegistry
        except ImportError:
            raise MissingExtraError("prometheus-client", "daemon") from None
        self._name, self._loop, self._telemetry = name, loop, telemetry
        self._seen: Counter[tuple[str, str]] = Counter()
        self._next_event = 0
        self._lock = threading.Lock()
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(_Collector(self))

    def render(self) -> bytes:
        """Return all metrics as text; from any thread."""
        from prometheus_client import generate_latest

        with self._lock:
            return generate_latest(self._registry)

    def _families(self) -> Iterator[Any]:
        now = self._loop.snapshot()
        yield from self._of_state(now)
        yield from self._of_timing(now)
        yield from self._of_fields(now)
        yield from self._of_events()
        if self._telemetry is not None:
            yield self._counter(
                "telemetry_dropped", "Snapshots never logged.", self._telemetry.dropped
            )
            yield self._counter("log_bytes", "Bytes recorded.", self._telemetry.written)

    def _of_state(self, now: Snapshot) -> Iterator[Any]:
        states = self._gauges("state", "Where in its life the loop is: 1 for its state.", "state")
        for state in State:
            states.add_metric([self._name, str(state)], float(state == now.state))
        yield states
        alarms = self._gauges("alarm", "What is wrong now: 1 for each alarm.", "kind")
        for alarm in now.alarms:
            alarms.add_metric([self._name, alarm.kind], 1.0)
        yield alarms

    def _of_timing(self, now: Snapshot) -> Iterator[Any]:
        from prometheus_client.core import HistogramMetricFamily

        timing = now.timing
        yield from self._of_fields(timing)
        edges, counts = timing.lateness
        total, buckets = 0, []
        for edge, count in zip((*edges, float("inf")), counts, strict=True):
            total += count
            buckets.append(("+Inf" if edge == float("inf") else f"{edge:g}", float(total)))
        late = HistogramMetricFamily(
            "stiffopt_lateness_seconds", "How late ticks begin.", labels=["rig"]
        )
        late.add_metric([self._name], buckets, sum_value=None)
        yield late

    def _of_fields(self, record: Any) -> Iterator[Any]:
        """Yield the metrics of a record whose definitions name one."""
        shared: dict[str, Any] = {}
        for entry in entries(type(record)):
            name, about = entry.shown.metric, _sentence(entry.shown.about)
            value = getattr(record, entry.name) if name else None
            if value is None:
                continue
            if entry.kind is Kind.COUNT:
                yield self._counter(name, about, value)
            elif entry.kind is Kind.NUMBERS:
                labels = ("channel", "kind") if entry.shown.label else ("channel",)
                about = _SHARED.get(name, about)
                family = shared.setdefault(name, self._gauges(name, about, *labels))
                for channel, number in enumerate(value.tolist(), start=1):
                    if isfinite(number):
                        of = (str(channel), entry.shown.label)[: len(labels)]
                        family.add_metric([self._name, *of], number)
            elif isfinite(value):
                yield self._gauge(name, about, value)
        yield from shared.values()

    def _of_events(self) -> Iterable[Any]:
        from prometheus_client.core import CounterMetricFamily

        events, self._next_event = self._loop.events.since(self._next_event)
        self._seen.update((event.kind, str(event.severity)) for event in events)
        family = CounterMetricFamily(
            "stiffopt_events", "What has happened.", labels=["rig", "kind", "severity"]
        )
        for (kind, severity), count in sorted(self._seen.items()):
            family.add_metric([self._name, kind, severity], count)
        yield family

    def _gauges(self, name: str, text: str, *labels: str) -> Any:
        from prometheus_client.core import GaugeMetricFamily

        return GaugeMetricFamily(f"stiffopt_{name}", text, labels=["rig", *labels])

    def _gauge(self, name: str, text: str, value: float) -> Any:
        family = self._gauges(name, text)
        family.add_metric([self._name], value)
        return family

    def _counter(self, name: str, text: str, value: float) -> Any:
        from prometheus_client.core import CounterMetricFamily

        family = CounterMetricFamily(f"stiffopt_{name}", text, labels=["rig"])
        family.add_metric([self._name], value)
        return family


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


class _Collector:
    """Adapts `Metrics` to the registry of prometheus_client."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    def collect(self) -> Iterator[Any]:
        return self._metrics._families()
