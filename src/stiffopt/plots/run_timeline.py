"""What happened in a run, on a line of time: states, alarms, events."""

from __future__ import annotations

from typing import Any

from stiffopt.daemon.run_log import RecordedRun, RunEvent, RunSpan
from stiffopt.plots.figures import _literal

__all__ = ["SHADES", "draw_timeline", "timeline_rows"]

SHADES = {
    "unconfigured": "#c9cdd2",
    "inactive": "#c9cdd2",
    "active": "#7fb77e",
    "holding": "#f2b134",
    "fault": "#d9534f",
}
"""Of the states."""
_ALARM = "#e07b39"
_SEVERITIES = {"info": "#4e79a7", "warning": "#e0a100", "error": "#b00020"}
_MOST_ALARMS = 6  # kinds that have a row
_HALF = 0.36  # of a row, that a band fills to each side
_LONGEST = 20  # letters of a name
_LETTER = 0.0095  # of the width that a letter takes
_APART = 0.012  # of the width between two numbers


def timeline_rows(run: RecordedRun) -> int:
    """Return how many rows the panel has."""
    return 1 + len(_alarm_kinds(run)) + bool(run.events)


def draw_timeline(axes: Any, run: RecordedRun, listed: list[RunEvent]) -> None:
    """Draw bands for states and alarms, and marks for events; those that are listed by number."""
    kinds = _alarm_kinds(run)
    labels = ["state", *kinds, *(["events"] if run.events else [])]
    width = max(float(run.time[-1] - run.time[0]), 1e-3)
    for span in run.states:
        _band(axes, span, 0, SHADES[span.kind])
        if (span.end - span.begin) / width > _LETTER * (len(span.kind) + 1):
            middle = (span.begin + span.end) / 2
            axes.text(middle, 0, span.kind, ha="center", va="center", fontsize=8, clip_on=True)
    for span in run.alarms:
        if span.kind in kinds:
            _band(axes, span, 1 + kinds.index(span.kind), _ALARM)
    if run.events:
        _draw_events(axes, run, listed, len(labels) - 1, width)
    names = [_literal(_short(label)) for label in labels]
    axes.set_yticks(range(len(labels)), names)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0, labelsize=8)
    axes.tick_params(axis="x", labelsize=9)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _band(axes: Any, span: RunSpan, row: int, colour: str) -> None:
    axes.fill_between([span.begin, span.end], row - _HALF, row + _HALF, color=colour, linewidth=0.6)


def _draw_events(
    axes: Any, run: RecordedRun, listed: list[RunEvent], row: int, width: float
) -> None:
    numbers = {id(event): number for number, event in enumerate(listed, start=1)}
    last = -float("inf")
    for event in run.events:
        colour = _SEVERITIES.get(event.severity, _SEVERITIES["info"])
        axes.vlines(event.time, row - _HALF, row + _HALF, color=colour, linewidth=1.6)
        number = numbers.get(id(event))
        if number is not None and event.time - last > _APART * width:
            last = event.time
            axes.annotate(
                str(number), (event.time, row), xytext=(2, 0), textcoords="offset points",
                va="center", fontsize=8, color=colour, weight="bold",
            )  # fmt: skip


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 3]}..."


def _alarm_kinds(run: RecordedRun) -> list[str]:
    """Return the kinds of alarms that have a row: those that stood longest."""
    stood: dict[str, float] = {}
    for span in run.alarms:
        stood[span.kind] = stood.get(span.kind, 0.0) + span.end - span.begin
    kept = sorted(stood, key=lambda kind: -stood[kind])[:_MOST_ALARMS]
    return [kind for kind in stood if kind in kept]
